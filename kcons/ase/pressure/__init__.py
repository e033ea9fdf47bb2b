"""Pressure of atoms with constraints.

- `virial`: the stress of the constraint forces
- `atoms_system`: atoms as a system whose cell can change
- `reporter`: the pressure along a run
"""

from kcons.ase.pressure.virial import virial_of

__all__ = ["virial_of"]
