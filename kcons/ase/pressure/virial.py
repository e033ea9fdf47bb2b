"""The part of the constraints in virial and stress."""

from __future__ import annotations

import numpy as np
from ase import Atoms

from kcons.constraints.target import FloatArray
from kcons.motion.motion import Motion
from kcons.thermostats.pressure import constraint_virial

#: Places of the Voigt components xx, yy, zz, yz, xz, xy in a 3 x 3 matrix.
VOIGT = ((0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1))


def virial_of(motion: Motion, atoms: Atoms, forces: FloatArray) -> FloatArray:
    """`constraint_virial` at the present positions and momenta, which are zero where there are none."""
    x, masses = atoms.arrays["positions"], atoms.get_masses()[:, None]
    v = np.zeros_like(x)
    if "momenta" in atoms.arrays:
        np.divide(atoms.arrays["momenta"], masses, out=v, where=masses > 0)
    return constraint_virial(motion, x, v, forces)
