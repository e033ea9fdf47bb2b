"""Pressure of atoms with constraints.

- `virial`: the stress of the constraint forces
"""

from kcons.ase.pressure.virial import constraint_virial, virial_of

__all__ = ["constraint_virial", "virial_of"]
