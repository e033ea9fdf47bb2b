"""The part of the constraints in virial and stress."""

from __future__ import annotations

import numpy as np
from ase import Atoms

from kcons.ase.respect import require_on_surface
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.thermostats.pressure import constraint_virial

#: Places of the Voigt components xx, yy, zz, yz, xz, xy in a 3 x 3 matrix.
VOIGT = ((0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1))


def virial_of(motion: Motion, atoms: Atoms, forces: FloatArray, time: float = 0.0) -> FloatArray:
    """`constraint_virial` at the present positions and momenta, which are zero where there are none.

    Raises
    ------
    UnsupportedError
        The atoms are off the constraints: what scales atoms with the cell and asks for the stress there, as ASE's
        StrainFilter, does not respect them.
    """
    try:
        require_on_surface(motion.constraint_set, atoms.arrays["positions"], time)
    except InputError as error:
        raise UnsupportedError(
            f"the stress is asked for off the constraints ({error}); StrainFilter and barostats that scale atoms leave "
            "them. Relax cells with FrechetCellFilter, or restore the atoms first"
        ) from error
    x, masses = atoms.arrays["positions"], atoms.get_masses()[:, None]
    v = np.zeros_like(x)
    if "momenta" in atoms.arrays:
        np.divide(atoms.arrays["momenta"], masses, out=v, where=masses > 0)
    return constraint_virial(motion, x, v, forces, time)
