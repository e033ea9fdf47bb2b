"""How well a trajectory, of whatever MD engine, kept its constraints.

- `atom_names`, `files`: names, and what files say
- `frames`: what is found in one frame after another
- `rank_by_pieces`, `compiling`, `workers`: large files in little time and memory
- `findings`, `result`, `temperature`: what was found, and what it says
- `bound_rows`, `reading`, `conclusions`: before the first frame, along the frames, after the last
- `constraint_check`, `check_files`, `report`: the check, from Python and from the command line
"""

from kcons.mdanalysis.check.constraint_check import ConstraintCheck

__all__ = ["ConstraintCheck"]
