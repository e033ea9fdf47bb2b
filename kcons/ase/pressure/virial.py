"""The part of the constraints in virial and stress."""

from __future__ import annotations

import numpy as np
from ase import Atoms

from kcons.constraints.target import FloatArray
from kcons.motion.motion import Motion

#: Places of the Voigt components xx, yy, zz, yz, xz, xy in a 3 x 3 matrix.
VOIGT = ((0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1))


def constraint_virial(motion: Motion, x: FloatArray, v: FloatArray, f: FloatArray) -> FloatArray:
    """sum_i r_i (x) z_i over the rows that hold the system together, symmetric, shape (3, 3).

    z is the instantaneous constraint force, the velocity-dependent part of b included. Rows that depend on
    differences of positions only enter with these differences, so that the origin does not matter. Rows
    with a place in space (fixed atoms, surfaces, centres of mass) are external forces, like walls, and
    have no share.

    References
    ----------
    Notes, eqs. 101-104. Atomic virial with constraints: Ciccotti and Ryckaert, Comput. Phys. Rep. 4, 345 (1986).
    """
    held = motion.constraint_set
    lam = motion.multipliers(x, v, f)
    virial = np.zeros((3, 3))
    for item, start in zip(held.constraints, held.starts, strict=False):
        if not (item.holonomic and item.translation_invariant and item.n_rows):
            continue
        r = held.gather(item, x)
        push = lam[start : start + item.n_rows, None, None] * item.gradient(r, 0.0)
        virial += np.einsum("kai,kaj->ij", r - r[:, :1], push)
    return 0.5 * (virial + virial.T)


def virial_of(motion: Motion, atoms: Atoms, forces: FloatArray) -> FloatArray:
    """`constraint_virial` at the present positions and momenta, which are zero where there are none."""
    x, masses = atoms.arrays["positions"], atoms.get_masses()[:, None]
    v = np.zeros_like(x)
    if "momenta" in atoms.arrays:
        np.divide(atoms.arrays["momenta"], masses, out=v, where=masses > 0)
    return constraint_virial(motion, x, v, forces)
