"""How well a trajectory, of whatever MD engine, kept its constraints.

- `atom_names`, `files`: names, and what files say
- `row_table`, `frame_kernels`, `rank_by_pieces`, `deviations`, `temperature`: one frame after another
- `memory`, `compiling`, `workers`: large files in little time and memory
- `findings`, `result`: what was found
- `constraint_check`, `check_files`, `report`: the check, from Python and from the command line
"""

from kcons.mdanalysis.check.constraint_check import ConstraintCheck

__all__ = ["ConstraintCheck"]
