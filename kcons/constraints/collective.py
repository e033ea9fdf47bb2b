"""Collective coordinates of groups: centers of mass, their distance, the radius of gyration.

They depend on the masses, which the constraint set supplies.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy import sqrt
from numpy.typing import ArrayLike

from kcons.constraints.arguments import FloatArray, atom_array, refuse_other, whole_number
from kcons.constraints.constraint import Constraint, Fault, RowKind
from kcons.constraints.linear import LinearRows
from kcons.constraints.target import Target
from kcons.errors import InputError

__all__ = ["CenterDistance", "CenterOfMass", "RadiusOfGyration"]


class MassWeighted(Constraint, base=True):
    """Rows that need the masses of their atoms: their parameters are the width and a weight for each atom."""

    uses_masses = True
    translation_invariant = True
    positive = "target"
    alike = 1

    def weights(self) -> FloatArray:
        """Shares of the atoms in the mass of their group, shape (n_rows, width)."""
        if self.masses is None:
            raise InputError(
                f"{self!r} needs the masses of its atoms; put it in a ConstraintSet, or call with_masses",
                item="masses",
            )
        return _shares(self.masses)

    def parameters(self) -> FloatArray:
        return np.hstack([np.full((self.n_rows, 1), float(self.width)), self.weights()])

    def faults(self, r: FloatArray, time: float) -> Iterator[Fault]:
        with np.errstate(invalid="ignore"):
            weightless = np.isnan(self.weights()).any(axis=1)
        yield weightless, lambda k: "all atoms of a group have mass 0; give one of them a mass", "masses"
        yield from super().faults(r, time)


class CenterOfMass(MassWeighted, LinearRows):
    """Cartesian components of the center of mass of a group, q = n . sum_i m_i r_i/M.

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

    kind = RowKind.LINEAR
    translation_invariant = False
    positive = ""
    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"directions": (3,)}
    directions: FloatArray

    def __init__(self, groups: ArrayLike, axes: Sequence[int] = (0, 1, 2), target: Target = None) -> None:
        chosen = atom_array(axes, "CenterOfMass: axes")
        whole = np.iterable(axes) and chosen.ndim == 1 and chosen.dtype.kind in "iu"
        if not (whole and 0 < len(chosen) == len(set(chosen.tolist())) and set(chosen.tolist()) <= {0, 1, 2}):
            raise InputError(f"CenterOfMass: axes must be some of 0, 1, 2, each once, not {axes!r:.60}", item="axes")
        table = np.atleast_2d(atom_array(groups, self.family))
        Constraint.__init__(
            self, np.repeat(table, len(chosen), axis=0), target, directions=np.tile(np.eye(3)[chosen], (len(table), 1))
        )

    def _settle(self) -> None:
        pass

    def parameters(self) -> FloatArray:
        return (self.weights()[:, :, None] * self.directions[:, None]).reshape(self.n_rows, 3 * self.width)


class CenterDistance(MassWeighted):
    """Distance between the centers of mass of two groups, q = |C_a - C_b|.

    In periodic cells the atoms of a row (group a, then group b) are made whole one after the other by
    minimum images; list them so that neighbors in the list are closer than half the box.

    Parameters
    ----------
    group_a, group_b : array_like of int, shape (width_a,) and (width_b,), or (n_rows, width)
        Atoms of the two groups; no atom may be in both.
    target : float, array_like, callable of time, MovingTarget or None
        Distance held.
    """

    singular = "the two centers coincide: gradient undefined; move the groups apart"
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

    def _settle(self) -> None:
        whole_number(self.split, "CenterDistance: split", 0)
        if self.n_rows and not 0 < self.split < self.width:
            raise InputError("CenterDistance: a group has no atoms", item="groups")

    def weights(self) -> FloatArray:
        """Those of the second group are negative."""
        super().weights()
        masses: Any = self.masses
        return np.hstack([_shares(masses[:, : self.split]), -_shares(masses[:, self.split :])])

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        n = int(p[0])
        x, y, z = 0.0 * r[0], 0.0 * r[0], 0.0 * r[0]
        for i in range(n):  # from the first atom, so that nothing is lost far from the origin
            w = p[1 + i]
            x, y, z = x + w * (r[3 * i] - r[0]), y + w * (r[3 * i + 1] - r[1]), z + w * (r[3 * i + 2] - r[2])
        q = sqrt(x * x + y * y + z * z)
        out[0] = q
        x, y, z = x / q, y / q, z / q
        for i in range(n):
            w = p[1 + i]
            out[1 + 3 * i], out[2 + 3 * i], out[3 + 3 * i] = w * x, w * y, w * z


class RadiusOfGyration(MassWeighted):
    """Radius of gyration of a group about its center C, q = sqrt(sum_i w_i |r_i - C|^2), sum w_i = 1.

    In periodic cells the atoms are made whole in the order of the list by minimum images; list them so that
    neighbors in the list are closer than half the box (along a chain, for example).

    Parameters
    ----------
    atoms : array_like of int, shape (width,) or (n_rows, width)
        Atoms of each row.
    target : float, array_like, callable of time, MovingTarget or None
        Radius held.
    mass_weighted : bool
        Whether the weights are the masses (default) or all equal.
    """

    singular = "all of its atoms coincide: gradient undefined; move them apart"
    shared = ("mass_weighted",)

    def __init__(self, atoms: ArrayLike, target: Target = None, *, mass_weighted: bool = True) -> None:
        self.mass_weighted = bool(mass_weighted)
        super().__init__(atoms, target)

    def _settle(self) -> None:
        refuse_other(self.mass_weighted, bool, "RadiusOfGyration: mass_weighted", "True or False")

    def weights(self) -> FloatArray:
        return super().weights() if self.mass_weighted else _shares(np.ones(self.atoms.shape))

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        n = int(p[0])
        x, y, z = 0.0 * r[0], 0.0 * r[0], 0.0 * r[0]
        for i in range(n):  # the center from the first atom, so that nothing is lost far from the origin
            w = p[1 + i]
            x, y, z = x + w * (r[3 * i] - r[0]), y + w * (r[3 * i + 1] - r[1]), z + w * (r[3 * i + 2] - r[2])
        square = 0.0 * r[0]
        for i in range(n):
            a, b, c = (r[3 * i] - r[0]) - x, (r[3 * i + 1] - r[1]) - y, (r[3 * i + 2] - r[2]) - z
            out[1 + 3 * i], out[2 + 3 * i], out[3 + 3 * i] = a, b, c
            square = square + p[1 + i] * (a * a + b * b + c * c)
        q = sqrt(square)
        out[0] = q
        for i in range(n):
            f = p[1 + i] / q
            for k in range(1 + 3 * i, 4 + 3 * i):
                out[k] = f * out[k]


def _shares(masses: FloatArray) -> FloatArray:
    return masses / masses.sum(axis=1, keepdims=True)
