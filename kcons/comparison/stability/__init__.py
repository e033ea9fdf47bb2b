"""How far methods can be pushed.

- `scenes`: small test systems
- `runs`: largest stable steps, drift of the energy, reversibility
- `fuzz`: random molecules
- `study`: all of it, kept as it comes in
- `report`: tables and a picture
"""

from kcons.comparison.stability.fuzz import Trial, trial
from kcons.comparison.stability.runs import attempt, drift, largest_step, reversal
from kcons.comparison.stability.scenes import SCENES
from kcons.comparison.stability.study import digest, put_into, run

__all__ = ["SCENES", "Trial", "attempt", "digest", "drift", "largest_step", "put_into", "reversal", "run", "trial"]
