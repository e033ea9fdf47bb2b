"""Friction: velocities that die away at a rate, solved exactly on the constraints.

m dv/dt = ... - gamma m v is linear in the velocities. At fixed positions they fall off as exp(-gamma t); in free flight
with one rate for all atoms, way and time are related as if there were none, x = x0 + u (1 - exp(-gamma t))/gamma, also
along constraints. A drift of length h is therefore half the friction, a flight of length (2/gamma) sinh(gamma h/2), and
half the friction again: symmetric, exact without forces and targets that move, and of the order of the flights that it
is made of. Being linear, it spoils no splitting that is made for kinetic energies quadratic in the velocities.

References
----------
Leimkuhler and Matthews, Proc. R. Soc. A 472, 20160138 (2016), for splittings of this kind on constraints.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import FloatArray, as_float_array
from kcons.errors import InputError
from kcons.motion.motion import Motion

_EPS = float(np.finfo(float).eps)
#: Largest rate times length of a drift; exponentials of it are still numbers.
_MOST = 600.0
#: Terms of the exponential series of a matrix of norm 1 or less: 1/25! is far below rounding.
_TERMS = 25


class Friction:
    """Rates at which velocities die away.

    Where they differ, friction is solved at fixed positions, and flights are as long as for the middle of their range.

    Parameters
    ----------
    rates : array_like, shape () or (n_atoms,)
        gamma, in inverse units of time: for all atoms, or for each.
    motion : Motion
    inverse_masses : ndarray, shape (n_atoms, 1)
        0 for atoms that are fixed, on which nothing acts.

    Attributes
    ----------
    largest : float
        The largest rate of an atom that moves.
    uniform : bool
        Whether all that moves has the same.

    Raises
    ------
    InputError
        Wrong shape; a rate that is negative or not finite.
    """

    def __init__(self, rates: ArrayLike, motion: Motion, inverse_masses: FloatArray) -> None:
        n_atoms = motion.n_atoms
        given = as_float_array(rates, "friction")
        if given.shape not in ((), (n_atoms,)):
            raise InputError(
                f"friction has shape {given.shape}; give one rate, or one for each of {n_atoms} atoms", item="friction"
            )
        bad = ~(np.isfinite(given) & (given >= 0))
        if bad.any():
            atoms = np.flatnonzero(bad).tolist()[:1] if given.ndim else []
            raise InputError(
                f"friction is {given[bad].ravel()[0] if given.ndim else given}"
                f"{f' for atom {atoms[0]}' if given.ndim else ''}; give rates of 0 or more, in inverse units of time",
                item="friction",
                atoms=atoms,
            )
        self._motion, moving = motion, inverse_masses[:, 0] > 0
        each = np.where(moving, np.broadcast_to(given, (n_atoms,)), 0.0)
        least, self.largest = (float(end(each[moving])) for end in (np.min, np.max)) if moving.any() else (0.0, 0.0)
        self.uniform = least == self.largest
        self._rate = least if self.uniform else 0.5 * (least + self.largest)
        self._each, self._apart = each[:, None], _within_rows(motion, each, moving)
        with np.errstate(invalid="ignore"):  # fixed atoms may have any mass
            self._drag: FloatArray = np.where(moving, each * motion.masses, 0.0)[:, None]

    def force(self, v: FloatArray) -> FloatArray:
        """-gamma m v, shape (n_atoms, 3); 0 for fixed atoms."""
        return -self._drag * v

    def flight(self, h: float) -> float:
        """How long to fly between two halves of `damp` over `h`."""
        angle = 0.5 * self._rate * h
        if not abs(angle) < 0.5 * _MOST:
            raise InputError(
                f"friction leaves nothing of the velocities in a step of {self._rate * h:g} divided by its rate; use a "
                "shorter step",
                item="dt",
            )
        return 2.0 * math.sinh(angle) / self._rate if self._rate else h

    def damp(self, x: FloatArray, v: FloatArray, h: float, time: float) -> None:
        """Friction alone over `h`, at fixed positions: `v` is changed in place.

        Where rows tie atoms of different rates, dv/dt = -P gamma v with the projector P of the rows, and `v` is brought
        onto the constraints first; elsewhere each velocity has its own exponential.
        """
        if self.uniform or self._apart:
            v *= math.exp(-self._rate * h) if self.uniform else np.exp(-h * self._each)
            return
        motion = self._motion
        motion.project_velocities(x, v, time=time, out=v)
        pieces = max(1, math.ceil(abs(h) * self.largest))
        share = -h / pieces * self._each
        # What targets demand is no velocity along the constraints: P u is the nearest one less that.
        drive = motion.project_velocities(x, np.zeros_like(v), time=time) if motion.plan.driven else None
        for _ in range(pieces):
            term = v.copy()
            for k in range(1, _TERMS):
                term *= share / k
                motion.project_velocities(x, term, time=time, out=term)
                if drive is not None:
                    term -= drive
                v += term
                if float(np.abs(term).max()) <= 0.5 * _EPS * float(np.abs(v).max()):
                    break
        motion.project_velocities(x, v, time=time, out=v)


def _within_rows(motion: Motion, rates: FloatArray, moving: NDArray[np.bool_]) -> bool:
    """Whether no row ties atoms that move at different rates."""
    rows = motion.constraint_set.incidence.tocoo()
    inside = moving[rows.col]
    number, rate = rows.row[inside], rates[rows.col[inside]]
    least, most = np.full(rows.shape[0], np.inf), np.full(rows.shape[0], -np.inf)
    np.minimum.at(least, number, rate)
    np.maximum.at(most, number, rate)
    return bool(np.all(most <= least))
