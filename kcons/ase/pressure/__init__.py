"""Pressure of atoms with constraints.

- `virial`: the stress of the constraint forces
- `atoms_system`: atoms as a system whose cell can change
"""

from kcons.ase.pressure.virial import constraint_virial, virial_of

__all__ = ["constraint_virial", "virial_of"]
