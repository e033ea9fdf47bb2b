"""Collective coordinates of groups: centres of mass, their distance, the radius of gyration.

They depend on the masses, which the constraint set supplies.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import atom_array, whole_number
from kcons.constraints.constraint import Constraint, RowKind
from kcons.constraints.target import FloatArray, Target
from kcons.constraints.vectors import dot, norm
from kcons.errors import InputError


class MassWeighted(Constraint):
    """Rows that need the masses of their atoms."""

    uses_masses = True
    #: What is at one point where a length vanishes and has no gradient, and what to do; not for components.
    singular_where: ClassVar[tuple[str, str] | None] = None

    def check(self, r: FloatArray, time: float, first_row: int) -> None:
        if self.masses is not None:
            with np.errstate(invalid="ignore"):
                weightless = np.asarray(np.isnan(self.parameters()).any(axis=1))
            self.refuse_input(
                weightless, first_row, lambda k: "all atoms of a group have mass 0; give one of them a mass", "masses"
            )
        if self.n_rows == 0 or self.singular_where is None:
            return
        what, remedy = self.singular_where
        self.refuse_singular(
            self.measure(r, time) == 0,
            first_row,
            lambda k, row: f"{what} of {row}, coincide: gradient undefined; {remedy}",
        )
        self.refuse_nonpositive(time, first_row)

    def _mass_table(self) -> FloatArray:
        if self.masses is None:
            raise InputError(
                f"{self!r} needs the masses of its atoms; put it in a ConstraintSet, or call with_masses",
                item="masses",
            )
        return self.masses


class CenterOfMass(MassWeighted):
    """Cartesian components of the centre of mass of a group, q = n . sum_i m_i r_i/M.

    Positions are taken as they are (unwrapped), in periodic cells too.

    Parameters
    ----------
    groups : array_like of int, shape (width,) or (n_groups, width)
        Atoms of each group; groups of different sizes need objects of their own.
    axes : sequence of int
        Components held, 0 for x to 2 for z: one row each, group after group.
    target : float, array_like of shape (n_groups, len(axes)), callable of time, MovingTarget or None
        Where they are held; None takes the initial values.
    """

    family = "CenterOfMass"
    kind = RowKind.LINEAR
    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"directions": (3,)}
    directions: FloatArray

    def __init__(self, groups: ArrayLike, axes: Sequence[int] = (0, 1, 2), target: Target = None) -> None:
        chosen = atom_array(axes, "CenterOfMass: axes")
        whole = np.iterable(axes) and chosen.ndim == 1 and chosen.dtype.kind in "iu"
        if not (whole and 0 < len(chosen) == len(set(chosen.tolist())) and set(chosen.tolist()) <= {0, 1, 2}):
            raise InputError(f"CenterOfMass: axes must be some of 0, 1, 2, each once, not {axes!r:.60}", item="axes")
        table = np.atleast_2d(atom_array(groups, self.family))
        super().__init__(np.repeat(table, len(chosen), axis=0), target)
        self._keep(directions=np.tile(np.eye(3)[chosen], (self.n_rows // len(chosen), 1)))

    def _weights(self) -> FloatArray:
        m = self._mass_table()
        return m / m.sum(axis=1, keepdims=True)

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        return np.asarray(np.einsum("ka,kai,ki->k", self._weights(), r, self.directions, optimize=True))

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        return self._weights()[:, :, None] * self.directions[:, None]

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        return np.zeros(self.n_rows)

    def scale(self, time: float = 0.0) -> FloatArray:
        return np.zeros(self.n_rows)

    def parameters(self) -> FloatArray:
        return (self._weights()[:, :, None] * self.directions[:, None]).reshape(self.n_rows, -1)


class CenterDistance(MassWeighted):
    """Distance between the centres of mass of two groups, q = |C_a - C_b|.

    In periodic cells the atoms of a row (group a, then group b) are made whole one after the other by
    minimum images; list them so that neighbours in the list are closer than half the box.

    Parameters
    ----------
    group_a, group_b : array_like of int, shape (width_a,) and (width_b,), or (n_rows, width)
        Atoms of the two groups; no atom may be in both.
    target : float, array_like, callable of time, MovingTarget or None
        Distance held.

    Notes
    -----
    With u the unit vector from C_b to C_a: dq/dr_i = +-u m_i/M; curvature (|W|^2 - (u.W)^2)/q, where W
    is the difference of the centres' velocities.
    """

    family = "CenterDistance"
    kind = RowKind.FUNCTION
    singular_where = ("the two centres", "move the groups apart")
    translation_invariant = True
    shared = ("split",)
    split: int

    def __init__(self, group_a: ArrayLike, group_b: ArrayLike, target: Target = None) -> None:
        try:
            a, b = (np.atleast_2d(atom_array(group, self.family)) for group in (group_a, group_b))
            table = np.hstack([a, b])
        except ValueError:
            raise InputError(
                "CenterDistance: group_a and group_b must have the same number of rows, each of equal sizes",
                item="groups",
            ) from None
        self.split = a.shape[1]
        super().__init__(table, target)
        self._settle()

    def _settle(self) -> None:
        whole_number(self.split, "CenterDistance: split", 0)
        if self.n_rows and not 0 < self.split < self.width:
            raise InputError("CenterDistance: a group has no atoms", item="groups")

    def _signed_weights(self) -> FloatArray:
        w = self._mass_table().copy()
        w[:, : self.split] /= w[:, : self.split].sum(axis=1, keepdims=True)
        w[:, self.split :] /= -w[:, self.split :].sum(axis=1, keepdims=True)
        return w

    def _difference(self, r: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("ka,kai->ki", self._signed_weights(), r - r[:, :1]))

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        return norm(self._difference(r))

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        d = self._difference(r)
        return self._signed_weights()[:, :, None] * (d / norm(d)[:, None])[:, None]

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        d, w = self._difference(r), self._difference(v)
        q = norm(d)
        across = np.cross(d / q[:, None], w)
        return dot(across, across) / q

    def parameters(self) -> FloatArray:
        return np.hstack([np.full((self.n_rows, 1), float(self.width)), self._signed_weights()])


class RadiusOfGyration(MassWeighted):
    """Radius of gyration of a group about its centre C, q = sqrt(sum_i w_i |r_i - C|^2), sum w_i = 1.

    In periodic cells the atoms are made whole in the order of the list by minimum images; list them so that
    neighbours in the list are closer than half the box (along a chain, for example).

    Parameters
    ----------
    atoms : array_like of int, shape (width,) or (n_rows, width)
        Atoms of each row.
    target : float, array_like, callable of time, MovingTarget or None
        Radius held.
    mass_weighted : bool
        Whether the weights are the masses (default) or all equal.

    Notes
    -----
    dq/dr_i = w_i (r_i - C)/q; curvature (sum_i w_i |v_i - V|^2 - (dq/dr . v)^2)/q, V the velocity of C.
    """

    family = "RadiusOfGyration"
    kind = RowKind.FUNCTION
    singular_where = ("all atoms", "move them apart")
    translation_invariant = True
    shared = ("mass_weighted",)

    def __init__(self, atoms: ArrayLike, target: Target = None, *, mass_weighted: bool = True) -> None:
        self.mass_weighted = bool(mass_weighted)
        super().__init__(atoms, target)

    def _weights(self) -> FloatArray:
        m = self._mass_table() if self.mass_weighted else np.ones(self.atoms.shape)
        return m / m.sum(axis=1, keepdims=True)

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        w = self._weights()
        s = _about_center(w, r)
        return np.sqrt(np.einsum("ka,kai,kai->k", w, s, s))

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        w = self._weights()
        s = _about_center(w, r)
        q = np.sqrt(np.einsum("ka,kai,kai->k", w, s, s))
        return w[:, :, None] * s / q[:, None, None]

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        w = self._weights()
        s, u = _about_center(w, r), _about_center(w, v)
        q = np.sqrt(np.einsum("ka,kai,kai->k", w, s, s))
        rate = np.einsum("ka,kai,kai->k", w, s, u) / q
        return np.asarray((np.einsum("ka,kai,kai->k", w, u, u) - rate**2) / q)

    def parameters(self) -> FloatArray:
        return np.hstack([np.full((self.n_rows, 1), float(self.width)), self._weights()])


def _about_center(w: FloatArray, r: FloatArray) -> FloatArray:
    """r - C, taken from the first atom so that nothing is lost far from the origin."""
    near = r - r[:, :1]
    return np.asarray(near - np.einsum("ka,kai->ki", w, near)[:, None])
