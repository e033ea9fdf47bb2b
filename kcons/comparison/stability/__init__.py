"""How far methods can be pushed.

- `small_systems`: the test systems
- `runs`: largest stable steps, drift of the energy, reversibility
- `fuzz`: random molecules
- `study`: all of it, kept as it comes in
- `report`: tables and a picture
"""

from kcons.comparison.stability.fuzz import Trial, trial
from kcons.comparison.stability.runs import attempt, drift, largest_step, reversal
from kcons.comparison.stability.small_systems import SYSTEMS
from kcons.comparison.stability.study import digest, put_into, run

__all__ = ["SYSTEMS", "Trial", "attempt", "digest", "drift", "largest_step", "put_into", "reversal", "run", "trial"]
