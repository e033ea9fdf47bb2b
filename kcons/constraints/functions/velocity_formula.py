"""Rows linear in the velocities that are formulas."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.constraint import RowKind
from kcons.constraints.functions.formula import Formula
from kcons.constraints.target import FloatArray, Target


class VelocityFormula(Formula):
    """A formula that is linear in the velocities of a few atoms (nonholonomic), differentiated exactly and compiled.

    Parameters
    ----------
    formula : str
        As for `Formula`, with vx1, vy1, vz1 for the velocity of the first atom of a row, vx2, ...: a sum of velocities,
        each times a function of coordinates, time and parameters.
    atoms : array_like of int, shape (n_rows, width) or (width,)
        Atoms of each row, as many as the formula names; (n_rows,) where it names one.
    parameters : mapping of str to float or array_like of shape (n_rows,), optional
        Numbers by name, one for all rows or one for each.
    target : float, array_like, callable of time, or MovingTarget
        What the sum is held at, 0 by default.

    Raises
    ------
    InputError
        As `Formula`; a formula that is not linear in the velocities.
    SingularGeometryError
        When put into a set: coefficients that are all zero, or not finite.
    UnsupportedError
        SymPy is not installed.

    Examples
    --------
    A bead whose velocity has a given angle with the radius, seen in the plane:

    >>> spiral = VelocityFormula("x1*vy1 - y1*vx1 - c*(x1*vx1 + y1*vy1)", 0, {"c": 2.0})
    >>> spiral.holonomic, spiral.moving
    (False, False)
    """

    family = "VelocityFormula"
    holonomic = False
    kind = RowKind.VELOCITY
    shared: ClassVar[tuple[str, ...]] = ("formula", "names")
    of_speeds = True

    def __init__(
        self,
        formula: str,
        atoms: ArrayLike,
        parameters: Mapping[str, ArrayLike] | None = None,
        target: Target = 0.0,
    ) -> None:
        super().__init__(formula, atoms, parameters, 0.0 if target is None else target)

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        return np.zeros(self.n_rows)

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        return np.ascontiguousarray(self._first(r, time).T).reshape(r.shape)

    def time_terms(self, r: FloatArray, v: FloatArray, time: float) -> tuple[FloatArray, FloatArray]:
        return np.zeros(self.n_rows), np.zeros(self.n_rows)
