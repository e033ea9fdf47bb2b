"""How well a trajectory, of whatever MD engine, kept its constraints.

- `atom_names`, `target_file`, `file_precision`, `endings`: what files say
- `row_table`, `frame_kernels`, `rank`, `deviations`, `temperature`: one frame after another
- `plain_dcd`, `memory`, `compiling`, `workers`: large files in little time and memory
- `findings`, `result`: what was found
- `constraint_check`, `check_files`, `report`: the check, from Python and from the command line
"""

from kcons.mdanalysis.check.constraint_check import ConstraintCheck

__all__ = ["ConstraintCheck"]
