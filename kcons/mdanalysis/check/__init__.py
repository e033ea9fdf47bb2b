"""How well a trajectory, of whatever MD engine, kept its constraints.

- `precision`, `endings`: what files can hold, and where they end
- `targets`: names of atoms, and what a parameter file says
- `deviations`: rows in one frame after another
- `result`, `report`: what was found, as data, text, picture and files
- `constraint_check`: the check, from Python and from files
"""

from kcons.mdanalysis.check.constraint_check import ConstraintCheck, check_trajectory
from kcons.mdanalysis.check.result import CheckResult

__all__ = ["CheckResult", "ConstraintCheck", "check_trajectory"]
