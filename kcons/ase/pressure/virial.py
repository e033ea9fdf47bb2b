"""The part of the constraints in virial and stress."""

from __future__ import annotations

import sys

import numpy as np
from ase import Atoms

from kcons.ase.respect import require_on_surface
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.thermostats.pressure import constraint_virial
from kcons.thermostats.pressure.pieces import rows_open

#: Places of the Voigt components xx, yy, zz, yz, xz, xy in a 3 x 3 matrix.
VOIGT = ((0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1))


def virial_of(motion: Motion, atoms: Atoms, forces: FloatArray, time: float = 0.0) -> FloatArray:
    """`constraint_virial` at the present positions and momenta, which are zero where there are none.

    Raises
    ------
    UnsupportedError
        The atoms are off the constraints: what scales atoms with the cell and asks for the stress there, as ASE's
        StrainFilter, does not respect them. As `refuse_filters`.
    """
    try:
        require_on_surface(motion.constraint_set, atoms.arrays["positions"], time)
    except InputError as error:
        raise UnsupportedError(
            f"the stress is asked for off the constraints ({error}); StrainFilter and barostats that scale atoms leave "
            "them. Relax cells with FrechetCellFilter, or restore the atoms first"
        ) from error
    x, masses = atoms.arrays["positions"], atoms.get_masses()[:, None]
    refuse_filters(motion, x, time)
    v = np.zeros_like(x)
    if "momenta" in atoms.arrays:
        np.divide(atoms.arrays["momenta"], masses, out=v, where=masses > 0)
    return constraint_virial(motion, x, v, forces, time)


def refuse_filters(motion: Motion, x: FloatArray, time: float = 0.0) -> None:
    """Refuse a cell filter of ASE that asks for the stress where a row holds atoms in space along an axis it changes.

    They stay while the filter takes them to move along: its forces would not be the derivative of its energy.

    Raises
    ------
    UnsupportedError
    """
    held = motion.constraint_set
    if all(item.translation_invariant for item in held.constraints):
        return
    frame = sys._getframe(1)
    while frame.f_globals.get("__name__") != "ase.filters" or frame.f_code.co_name != "get_forces":
        if frame.f_back is None:
            return
        frame = frame.f_back
    cell_filter = frame.f_locals["self"]
    mask = np.broadcast_to(getattr(cell_filter, "mask", True), (3, 3))
    shut = ~rows_open(motion, x, time) & (mask.any(axis=0) | mask.any(axis=1))
    if shut.any():
        row, axis = np.argwhere(shut)[0]
        raise UnsupportedError(
            f"row {held.row_name(int(row))} holds atoms in space along {'xyz'[axis]}, and {type(cell_filter).__name__} "
            "takes them to move along with the cell: relax at this cell, leave the axis out of its mask, or hold these "
            "atoms relative to others"
        )
