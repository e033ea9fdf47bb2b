"""Distances, their differences, angles, dihedrals, and collective coordinates of groups of atoms.

All but centers of mass depend on differences of positions alone, so minimum images apply in periodic cells.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy import arctan2, sqrt
from numpy.typing import ArrayLike

from kcons.constraints.arguments import (
    ANGLE,
    as_float_array,
    atom_array,
    atom_table,
    check_pairs,
    read_only,
    refuse_other,
    whole_number,
)
from kcons.constraints.constraint import Constraint, Fault, IntArray, RowKind
from kcons.constraints.periodic.one_piece import spanning_tree
from kcons.constraints.surface import LinearCombination
from kcons.constraints.target import FloatArray, Target
from kcons.constraints.vectors import cross, norm
from kcons.errors import InputError

__all__ = ["Angle", "CenterDistance", "CenterOfMass", "Dihedral", "Distance", "DistanceDifference", "RadiusOfGyration"]

#: Sine of an angle below which atoms count as collinear: the gradient has then lost nine digits.
COLLINEAR = 1e-7
#: Fixed dihedrals beyond are degrees that were taken for radian.
MOST_TURNED = 6 * np.pi


class Internal(Constraint, base=True):
    """Rows whose gradient is undefined where two atoms of a pair lie at one point."""

    translation_invariant = True

    @property
    def pairs(self) -> IntArray:
        """The pairs of each row, shape (n_rows, n_pairs, 2): neighbors in its list of atoms."""
        return self.linked

    def coincident(self, k: int, r: FloatArray) -> str:
        """What is said of two atoms of row `k` at one point; nothing where there are none."""
        for i, j in self.pairs[k]:
            if norm(r[self.atoms[k] == i] - r[self.atoms[k] == j]) == 0:
                return f"atoms {i} and {j} coincide: gradient undefined; move them apart"
        return ""

    def undefined(self, k: int, r: FloatArray, time: float) -> str:
        return self.coincident(k, r) or super().undefined(k, r, time)


class Distance(Internal):
    """Length of the vector between two atoms, q = |r_0 - r_1|.

    Parameters
    ----------
    pairs : array_like of int, shape (n_rows, 2)
        The two atoms of each row.
    target : float, array_like, callable of time, MovingTarget or None
        Length held, in the unit of the positions.
    """

    positive = "target"
    row_width = 2
    reversible = True
    kind = RowKind.DISTANCE

    def __init__(self, pairs: ArrayLike, target: Target = None) -> None:
        super().__init__(pairs, target)

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        x, y, z = r[0] - r[3], r[1] - r[4], r[2] - r[5]
        q = sqrt(x * x + y * y + z * z)
        x, y, z = x / q, y / q, z / q
        out[0], out[1], out[2], out[3] = q, x, y, z
        out[4], out[5], out[6] = -x, -y, -z


class DistanceDifference(Internal):
    """Difference of two distances, or any sum of distances with weights, q = sum_k w_k |r_i - r_j| over pairs (i, j).

    The coordinate of a proton that goes from one atom to another, |D - H| - |H - A|; ``bondcombos`` of ASE's
    FixInternals; sums of lengths in VASP's ICONST. In periodic cells each pair takes its shortest image, as `Distance`.

    Parameters
    ----------
    pairs : array_like of int, shape (n_pairs, 2)
        The pairs of atoms of the one row.
    target : float, callable of time, MovingTarget or None
        What it is held at, in the unit of the positions; may be negative.
    weights : array_like, shape (n_pairs,)
        Weight of each distance; 1 and -1 unless given.

    Examples
    --------
    >>> import numpy as np
    >>> transfer = DistanceDifference([[0, 1], [1, 2]])
    >>> transfer.measure(np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 2.5]]]), 0.0)
    array([-0.5])
    """

    singular = "its gradient vanishes: its atoms lie on a line; bend them, or hold a distance"
    shared = ("slots", "weights")
    #: Which atoms of a row are the pairs, and the weight of each pair.
    slots: tuple[tuple[int, int], ...]
    weights: tuple[float, ...]

    def __init__(self, pairs: ArrayLike, target: Target = None, *, weights: ArrayLike = (1.0, -1.0)) -> None:
        table = check_pairs(pairs, item="pairs").tolist()
        atoms = _walk(table)[0]
        self.slots = tuple((atoms.index(i), atoms.index(j)) for i, j in table)
        self.weights = tuple(np.ravel(as_float_array(weights, "weights")).tolist())
        super().__init__([atoms], target)

    def _settle(self) -> None:
        try:
            self.slots = tuple((int(i), int(j)) for i, j in self.slots)
            self.weights = tuple(float(w) for w in self.weights)
        except (TypeError, ValueError):  # of files
            raise InputError("DistanceDifference: slots are pairs and weights are numbers", item="slots") from None
        n = len(self.slots)
        if len(self.weights) != n or not np.all(np.isfinite(self.weights)) or not all(self.weights):
            words = f"weights are {self.weights}; give one for each of {n} pairs, finite and not 0"
            raise InputError(f"DistanceDifference: {words}", item="weights")
        if self.n_rows and {slot for pair in self.slots for slot in pair} != set(range(self.width)):
            raise InputError("DistanceDifference: slots and atoms do not belong together", item="slots")
        self.links = read_only(_walk(self.slots)[1])
        self.alike = 2 + 3 * n
        self.positive = "target" if min(self.weights) > 0 else ""

    @property
    def pairs(self) -> IntArray:
        """The pairs of each row, shape (n_rows, n_pairs, 2)."""
        return self.atoms[:, np.array(self.slots)]

    def weighted_pairs(self) -> list[list[list[float]]]:
        """Of each row its pairs with their weights, [i, j, w], as ASE's ``bondcombos`` has them."""
        return [[[*pair, w] for pair, w in zip(row, self.weights, strict=True)] for row in self.pairs.tolist()]

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        # p holds the number of atoms, that of pairs, and of each pair i, j and w.
        for k in range(3 * int(p[0])):
            out[1 + k] = 0.0
        q = 0.0
        for n in range(int(p[1])):
            i, j, w = 3 * int(p[2 + 3 * n]), 3 * int(p[3 + 3 * n]), p[4 + 3 * n]
            x, y, z = r[i] - r[j], r[i + 1] - r[j + 1], r[i + 2] - r[j + 2]
            d = sqrt(x * x + y * y + z * z)
            q += w * d
            f = w / d
            x, y, z = f * x, f * y, f * z
            out[1 + i], out[2 + i], out[3 + i] = out[1 + i] + x, out[2 + i] + y, out[3 + i] + z
            out[1 + j], out[2 + j], out[3 + j] = out[1 + j] - x, out[2 + j] - y, out[3 + j] - z
        out[0] = q

    def parameters(self) -> FloatArray:
        pairs = np.column_stack([self.slots, self.weights])
        return np.tile([self.width, len(pairs), *pairs.ravel()], (self.n_rows, 1))

    def faults(self, r: FloatArray, time: float) -> Iterator[Fault]:
        yield from super().faults(r, time)
        size = np.linalg.norm(self.gradient(r, time), axis=(1, 2))
        yield size < COLLINEAR * np.abs(self.weights).max(), lambda k: self.singular


def _walk(pairs: Sequence[Sequence[int]]) -> tuple[list[int], IntArray]:
    """Atoms that pairs name, along a path one after the other, and `Constraint.links` by their places in this list."""
    named = list(dict.fromkeys(atom for pair in pairs for atom in pair))
    ends = np.array([[named.index(atom) for atom in pair] for pair in pairs], dtype=np.int64).reshape(-1, 2)
    ends_first = np.argsort(np.bincount(ends.ravel()), kind="stable")
    atoms, parents = spanning_tree(ends, len(named), ends_first)
    place = np.argsort(atoms)
    links = np.stack([place[parents], place[atoms]], axis=1)
    return [named[k] for k in atoms.tolist()], links[parents != atoms]


def angle_between(ux: Any, uy: Any, uz: Any, wx: Any, wy: Any, wz: Any) -> tuple[Any, ...]:
    """Angle between two arms u and w and its gradients by both: dq/du = u x (u x w) / (u^2 |u x w|)."""
    cx, cy, cz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    c = sqrt(cx * cx + cy * cy + cz * cz)
    fu = 1.0 / ((ux * ux + uy * uy + uz * uz) * c)
    fw = 1.0 / ((wx * wx + wy * wy + wz * wz) * c)
    ax, ay, az = uy * cz - uz * cy, uz * cx - ux * cz, ux * cy - uy * cx
    bx, by, bz = cy * wz - cz * wy, cz * wx - cx * wz, cx * wy - cy * wx
    value = arctan2(c.real, (ux * wx + uy * wy + uz * wz).real)
    return value, fu * ax, fu * ay, fu * az, fw * bx, fw * by, fw * bz


class Angle(Internal):
    """Angle at the middle atom, q = atan2(|u x w|, u.w), u = r_0 - r_1, w = r_2 - r_1, in radian.

    Its gradient stays of order one up to 180 degrees, where that of cos q vanishes (2.449 for unit arms).

    Parameters
    ----------
    triples : array_like of int, shape (n_rows, 3)
        Atoms i, j, k of each row; j is the vertex.
    target : float, array_like, callable of time, MovingTarget or None
        Angle held, in radian, between 0 and pi, both excluded.
    """

    positive = "target"
    below = np.pi
    row_width = 3
    reversible = True
    held = ANGLE
    kind = RowKind.ANGLE

    def __init__(self, triples: ArrayLike, target: Target = None) -> None:
        super().__init__(triples, target)

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        out[0], ax, ay, az, bx, by, bz = angle_between(
            r[0] - r[3], r[1] - r[4], r[2] - r[5], r[6] - r[3], r[7] - r[4], r[8] - r[5]
        )
        out[1], out[2], out[3] = ax, ay, az
        out[4], out[5], out[6] = -ax - bx, -ay - by, -az - bz
        out[7], out[8], out[9] = bx, by, bz

    @staticmethod
    def _straight(angle: Any, verb: str = "is") -> str:
        return (
            f"angle constraint singular at {np.degrees(angle):.0f} deg, use a linear constraint (LinearRelation with "
            f"the end atoms as bases at 180 deg), or distances: it {verb} {np.degrees(angle):.9g} deg"
        )

    def faults(self, r: FloatArray, time: float) -> Iterator[Fault]:
        angle = self.measure(r, time)
        yield ~(np.sin(angle) >= COLLINEAR), lambda k: self.coincident(k, r[k]) or self._straight(angle[k])
        if self.target is not None:
            target, words = self.target_at(time), "is no angle between 0 and pi; targets are in radian"
            outside = (target < -COLLINEAR) | (target > np.pi + COLLINEAR)
            yield outside, lambda k: f"target {target[k]:g} {words}", "target"
            yield np.sin(target) < COLLINEAR, lambda k: self._straight(target[k], "has the target")
        yield from super().faults(r, time)


class Dihedral(Internal):
    """Dihedral angle of four atoms in radian, IUPAC sign, smooth through +-180 degrees.

    Parameters
    ----------
    quads : array_like of int, shape (n_rows, 4)
        Atoms i, j, k, l of each row; j-k is the axis.
    target : float, array_like, callable of time, MovingTarget or None
        Angle held, in radian; the nearest image modulo 2 pi counts. A number beyond three turns is refused.

    References
    ----------
    A. Blondel and M. Karplus, J. Comput. Chem. 17, 1132 (1996), eq. 27.
    """

    row_width = 4
    reversible = True
    held = ANGLE
    period = 2 * np.pi

    def __init__(self, quads: ArrayLike, target: Target = None) -> None:
        super().__init__(quads, target)

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        # f = i - j, g = j - k, h = l - k; a = f x g, b = h x g.
        fx, fy, fz = r[0] - r[3], r[1] - r[4], r[2] - r[5]
        gx, gy, gz = r[3] - r[6], r[4] - r[7], r[5] - r[8]
        hx, hy, hz = r[9] - r[6], r[10] - r[7], r[11] - r[8]
        ax, ay, az = fy * gz - fz * gy, fz * gx - fx * gz, fx * gy - fy * gx
        bx, by, bz = hy * gz - hz * gy, hz * gx - hx * gz, hx * gy - hy * gx
        size = sqrt(gx * gx + gy * gy + gz * gz)
        a2 = ax * ax + ay * ay + az * az
        b2 = bx * bx + by * by + bz * bz
        sx, sy, sz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
        out[0] = arctan2(((sx * gx + sy * gy + sz * gz) / size).real, (ax * bx + ay * by + az * bz).real)
        ga, gb = size / a2, size / b2
        fa = (fx * gx + fy * gy + fz * gz) / (a2 * size)
        hb = (hx * gx + hy * gy + hz * gz) / (b2 * size)
        tx, ty, tz = fa * ax - hb * bx, fa * ay - hb * by, fa * az - hb * bz
        out[1], out[2], out[3] = -ga * ax, -ga * ay, -ga * az
        out[4], out[5], out[6] = tx + ga * ax, ty + ga * ay, tz + ga * az
        out[7], out[8], out[9] = -tx - gb * bx, -ty - gb * by, -tz - gb * bz
        out[10], out[11], out[12] = gb * bx, gb * by, gb * bz

    def faults(self, r: FloatArray, time: float) -> Iterator[Fault]:
        if self.target is not None and not self.moving:
            target = self.target_at(time)
            words = "is over three turns, and in radian; give np.radians"
            yield np.abs(target) > MOST_TURNED, lambda k: f"target {target[k]:g} {words}({target[k]:g})", "target"
        legs = np.diff(r, axis=1)
        sizes = norm(cross(legs[:, :-1], legs[:, 1:])), norm(legs)
        straight = sizes[0] <= COLLINEAR * sizes[1][:, :-1] * sizes[1][:, 1:]
        yield straight.any(axis=1), lambda k: self._straight(k, r[k], int(np.argmax(straight[k])))

    def _straight(self, k: int, r: FloatArray, first: int) -> str:
        atoms = ", ".join(map(str, self.atoms[k, first : first + 3]))
        return self.coincident(k, r) or (
            f"dihedral constraint singular: atoms {atoms} are collinear; bend them, or hold a dihedral of other atoms"
        )


# -- groups -----------------------------------------------------------------------------------------


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
                f"{self!r} needs the masses of its atoms; put it in a ConstraintSet, or call with_masses", item="masses"
            )
        return _shares(self.masses)

    def parameters(self) -> FloatArray:
        return np.hstack([np.full((self.n_rows, 1), float(self.width)), self.weights()])

    def faults(self, r: FloatArray, time: float) -> Iterator[Fault]:
        with np.errstate(invalid="ignore"):
            weightless = np.isnan(self.weights()).any(axis=1)
        yield weightless, lambda k: "all atoms of a group have mass 0; give one of them a mass", "masses"
        yield from super().faults(r, time)


class CenterOfMass(MassWeighted, LinearCombination):
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
        a, b = (atom_table(group, self.family, None, "groups") for group in (group_a, group_b))
        if len(a) != len(b):
            raise InputError("CenterDistance: group_a and group_b have different numbers of rows", item="groups")
        self.split = a.shape[1]
        super().__init__(np.hstack([a, b]), target)

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
