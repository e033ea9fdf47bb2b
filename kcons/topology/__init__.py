"""What a file says about a system, and the rows that follow from it.

- `topology`: atoms, residues, masses, bonds, given or by distance, for every MD engine; molecules made whole
- `rigid_groups`: rigid groups of atoms as rows; massless sites that three atoms place
- `angle_rows`: rows that hold all angles, none too many
- `rows_by_name`: rows by name: bonds with hydrogens, all bonds, angles, rigid water; the options for what is held
"""

from kcons.topology.rows_by_name import HeldRows, Holding, rows_of
from kcons.topology.topology import Snapshot, Topology, bond_angles

__all__ = ["HeldRows", "Holding", "Snapshot", "Topology", "bond_angles", "rows_of"]
