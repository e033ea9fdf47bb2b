"""Distances, their differences, angles and dihedrals: internal coordinates of a molecule.

All depend on differences of positions alone, so minimum images apply in periodic cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import ANGLE, kept, numbers
from kcons.constraints.constraint import Constraint, IntArray, RowKind
from kcons.constraints.target import FloatArray, Target
from kcons.constraints.vectors import cross, dot, norm
from kcons.errors import InputError, SingularGeometryError

#: Sine of an angle below which atoms count as collinear: the gradient has then lost nine digits.
COLLINEAR = 1e-7
#: Fixed dihedrals beyond are degrees that were taken for radian.
MOST_TURNED = 6 * np.pi


class Distance(Constraint):
    """Length of the vector between two atoms, q = |r_0 - r_1|.

    Parameters
    ----------
    pairs : array_like of int, shape (n_rows, 2)
        The two atoms of each row.
    target : float, array_like, callable of time, MovingTarget or None
        Length held, in the unit of the positions.

    Notes
    -----
    With u = (r_0 - r_1)/q and w = v_0 - v_1: dq/dr_0 = u, v^T (d2q/dr2) v = (|w|^2 - (u.w)^2)/q.

    Examples
    --------
    >>> import numpy as np
    >>> bond = Distance([[0, 1]])
    >>> bond.measure(np.array([[[0.0, 0.0, 0.0], [0.0, 3.0, 4.0]]]), 0.0)
    array([5.])
    """

    family = "Distance"
    squared = True
    row_width = 2
    translation_invariant = True
    kind = RowKind.DISTANCE

    def __init__(self, pairs: ArrayLike, target: Target = None) -> None:
        super().__init__(pairs, target)

    @property
    def pairs(self) -> IntArray:
        """The one pair of each row, shape (n_rows, 1, 2)."""
        return self.atoms[:, None]

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        return norm(r[:, 0] - r[:, 1])

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        d = r[:, 0] - r[:, 1]
        u = d / norm(d)[:, None]
        return np.stack([u, -u], axis=1)

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        d = r[:, 0] - r[:, 1]
        w = v[:, 0] - v[:, 1]
        q = norm(d)
        # |u x w|^2 has no cancellation, unlike |w|^2 - (u.w)^2.
        across = cross(d / q[:, None], w)
        return dot(across, across) / q

    def check(self, r: FloatArray, time: float, first_row: int) -> None:
        if self.n_rows == 0:
            return
        self.refuse_singular(
            norm(r[:, 0] - r[:, 1]) == 0,
            first_row,
            lambda k, row: (
                f"atoms {self.atoms[k, 0]} and {self.atoms[k, 1]} coincide: distance gradient undefined "
                f"(row {first_row + k}); move them apart"
            ),
        )
        self.refuse_nonpositive(time, first_row)


class DistanceDifference(Constraint):
    """Difference of two distances, or any sum of distances with weights, q = sum_k w_k |r_i - r_j| over pairs (i, j).

    The coordinate of a proton that goes from one atom to another, |D - H| - |H - A|; ``bondcombos`` of ASE's
    FixInternals; sums of lengths in VASP's ICONST. In periodic cells each pair takes its shortest image, as `Distance`.

    Parameters
    ----------
    pairs : array_like of int, shape (n_pairs, 2) or (n_rows, n_pairs, 2)
        The pairs of atoms of each row. Rows that share atoms in different ways need objects of their own.
    target : float, array_like, callable of time, MovingTarget or None
        What each row is held at, in the unit of the positions; may be negative.
    weights : array_like, shape (n_pairs,)
        Weight of each distance, for all rows; 1 and -1 unless given.

    Notes
    -----
    With u = (r_i - r_j)/d of a pair and c = v_i - v_j: dq/dr_i = sum w u, v^T (d2q/dr2) v = sum w (|c|^2 - (u.c)^2)/d.

    Examples
    --------
    >>> import numpy as np
    >>> transfer = DistanceDifference([[0, 1], [1, 2]])
    >>> transfer.measure(np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 2.5]]]), 0.0)
    array([-0.5])
    """

    family = "DistanceDifference"
    translation_invariant = True
    kind = RowKind.FUNCTION
    shared = ("slots", "weights")
    #: Which atoms of a row are the pairs, and the weight of each pair.
    slots: tuple[tuple[int, int], ...]
    weights: tuple[float, ...]

    def __init__(self, pairs: ArrayLike, target: Target = None, *, weights: ArrayLike = (1.0, -1.0)) -> None:
        try:
            table = np.asarray(pairs)
        except ValueError:
            table = np.zeros(0)
        if table.ndim == 2:
            table = table[None]
        if table.ndim != 3 or table.shape[2] != 2 or not table.size or not np.issubdtype(table.dtype, np.integer):
            raise InputError(
                "DistanceDifference: pairs are pairs of atoms, [[0, 1], [1, 2]] for one row; for more rows of as many "
                "pairs each, a list of such",
                item="pairs",
            )
        found = [_in_one_list(row.tolist()) for row in table]
        for k, (_, slots) in enumerate(found):
            if slots != found[0][1]:
                raise InputError(
                    f"DistanceDifference: rows 0 and {k} share atoms in different ways; use one object for each",
                    item="pairs",
                )
        self.slots, self.weights = found[0][1], tuple(np.atleast_1d(numbers(weights, "weights")).ravel().tolist())
        super().__init__([atoms for atoms, _ in found], target)
        self._settle()

    def _settle(self) -> None:
        try:
            self.slots = tuple((int(i), int(j)) for i, j in self.slots)
            self.weights = tuple(float(w) for w in self.weights)
        except (TypeError, ValueError):
            raise InputError("DistanceDifference: slots are pairs and weights are numbers", item="slots") from None
        n = len(self.slots)
        if len(self.weights) != n or not np.all(np.isfinite(self.weights)) or not all(self.weights):
            raise InputError(
                f"DistanceDifference: weights are {self.weights}; give {n} finite {'number' if n == 1 else 'numbers'} "
                "other than 0, one for each pair",
                item="weights",
            )
        atoms = self.atoms[0] if self.n_rows else range(self.width)
        for i, j in self.slots:
            if i == j:
                raise InputError(f"DistanceDifference: a pair names atom {atoms[i]} twice", item="pairs")
        if len({frozenset(pair) for pair in self.slots}) < n:
            raise InputError("DistanceDifference: a pair comes twice; name it once and add the weights", item="pairs")
        if self.n_rows and {slot for pair in self.slots for slot in pair} != set(range(self.width)):
            raise InputError("DistanceDifference: slots and atoms do not belong together", item="slots")
        self.links = kept(np.array(_walk(self.slots)[1], dtype=np.int64))

    @property
    def pairs(self) -> IntArray:
        """The pairs of each row, shape (n_rows, n_pairs, 2)."""
        return self.atoms[:, np.array(self.slots)]

    def weighted_pairs(self) -> list[list[list[float]]]:
        """Of each row its pairs with their weights, [i, j, w], as ASE's ``bondcombos`` has them."""
        return [[[*pair, w] for pair, w in zip(row, self.weights, strict=True)] for row in self.pairs.tolist()]

    def _arms(self, r: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Vectors of the pairs, shape (n_rows, n_pairs, 3), and their lengths."""
        i, j = np.array(self.slots).T
        d = r[:, i] - r[:, j]
        return d, norm(d)

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        return np.asarray(self._arms(r)[1] @ np.array(self.weights))

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        d, q = self._arms(r)
        u = d / q[..., None]
        result = np.zeros_like(r)
        for k, ((i, j), w) in enumerate(zip(self.slots, self.weights, strict=True)):
            result[:, i] += w * u[:, k]
            result[:, j] -= w * u[:, k]
        return result

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        d, q = self._arms(r)
        across = cross(d / q[..., None], self._arms(v)[0])
        return np.asarray(dot(across, across) / q @ np.array(self.weights))

    def scale(self, time: float = 0.0) -> FloatArray:
        """0: what is held may be 0, and says nothing of the size of the lengths."""
        return np.zeros(self.n_rows)

    def parameters(self) -> FloatArray:
        row = [float(self.width), float(len(self.slots))]
        for (i, j), w in zip(self.slots, self.weights, strict=True):
            row += [i, j, w]
        return np.tile(row, (self.n_rows, 1))

    def check(self, r: FloatArray, time: float, first_row: int) -> None:
        if self.n_rows == 0:
            return
        lengths = self._arms(r)[1]
        for k, (i, j) in enumerate(self.slots):
            self.refuse_singular(
                lengths[:, k] == 0,
                first_row,
                lambda row, name, i=i, j=j: (  # type: ignore[misc]
                    f"atoms {self.atoms[row, i]} and {self.atoms[row, j]} of {name}, coincide: gradient undefined; "
                    "move them apart"
                ),
            )
        slope = np.sqrt(np.sum(self.gradient(r, time) ** 2, axis=(1, 2)))
        self.refuse_singular(
            slope < COLLINEAR * np.abs(self.weights).max(),
            first_row,
            lambda k, name: f"the gradient of {name}, vanishes: its atoms lie on a line; bend them, or hold a distance",
        )
        if min(self.weights) > 0:
            self.refuse_nonpositive(time, first_row)


def _walk(pairs: Sequence[Sequence[int]]) -> tuple[list[int], list[tuple[int, int]]]:
    """Atoms that pairs name, and pairs that lead to each atom from one before it, by their places in this list.

    Along a path, pairs lead from each atom to the next; see `Constraint.links`.
    """
    neighbors: dict[int, list[int]] = {}
    for i, j in pairs:
        neighbors.setdefault(i, []).append(j)
        neighbors.setdefault(j, []).append(i)
    place: dict[int, int] = {}
    links = []
    for root in sorted(neighbors, key=lambda atom: len(neighbors[atom])):  # an end of a path first
        ways = [(root, root)]
        while ways:
            before, atom = ways.pop()
            if atom in place:
                continue
            place[atom] = len(place)
            if atom != before:
                links.append((place[before], place[atom]))
            ways += [(atom, other) for other in reversed(neighbors[atom])]
    return list(place), links


def _in_one_list(pairs: list[list[int]]) -> tuple[list[int], tuple[tuple[int, int], ...]]:
    """Atoms that pairs name, and the pairs by their places in this list."""
    atoms, _ = _walk(pairs)
    place = {atom: k for k, atom in enumerate(atoms)}
    return atoms, tuple((place[i], place[j]) for i, j in pairs)


class Angle(Constraint):
    """Angle at the middle atom, q = atan2(|u x w|, u.w), u = r_0 - r_1, w = r_2 - r_1, in radian.

    Parameters
    ----------
    triples : array_like of int, shape (n_rows, 3)
        Atoms i, j, k of each row; j is the vertex.
    target : float, array_like, callable of time, MovingTarget or None
        Angle held, in radian, between 0 and pi, both excluded.

    Notes
    -----
    With e, f the unit vectors along the arms, n = e x f/sin q, e' = e x n and f' = n x f:
    dq/dr_0 = e'/|u|, dq/dr_2 = f'/|w|. These stay of order one up to 180 degrees, where the gradient of
    cos q vanishes (2.449 for unit arms). The arms turn with the in-plane rates a = e'.u'/|u| and
    b = f'.w'/|w|, and the out-of-plane rates alpha = n.u'/|u| and beta = n.w'/|w|, so that

    v^T (d2q/dr2) v = -2 [a (e.u')/|u| + b (f.w')/|w|] + ((alpha^2 + beta^2) cos q - 2 alpha beta)/sin q,

    where u' and w' are the velocities of the arms.
    """

    family = "Angle"
    row_width = 3
    held = ANGLE
    translation_invariant = True
    kind = RowKind.ANGLE

    def __init__(self, triples: ArrayLike, target: Target = None) -> None:
        super().__init__(triples, target)

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        u, w = r[:, 0] - r[:, 1], r[:, 2] - r[:, 1]
        return np.arctan2(norm(cross(u, w)), dot(u, w))

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        u, w, normal, _ = _arms(r)
        first = cross(u, normal) / dot(u, u)[:, None]
        last = cross(normal, w) / dot(w, w)[:, None]
        return np.stack([first, -first - last, last], axis=1)

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        u, w, n, sine = _arms(r)
        uu, ww = dot(u, u), dot(w, w)
        lu, lw = np.sqrt(uu), np.sqrt(ww)
        du, dw = v[:, 0] - v[:, 1], v[:, 2] - v[:, 1]
        a, b = dot(cross(u, n), du) / uu, dot(cross(n, w), dw) / ww
        alpha, beta = dot(n, du) / lu, dot(n, dw) / lw
        cosine = dot(u, w) / (lu * lw)
        in_plane = -2 * (a * dot(u, du) / uu + b * dot(w, dw) / ww)
        return in_plane + ((alpha**2 + beta**2) * cosine - 2 * alpha * beta) / sine

    def scale(self, time: float = 0.0) -> FloatArray:
        return np.ones(self.n_rows)

    def check(self, r: FloatArray, time: float, first_row: int) -> None:
        if self.n_rows == 0:
            return
        _refuse_coincident(self, r, first_row)
        angle = self.measure(r, time)
        self._refuse_straight(angle, "is", first_row)
        if self.target is None:
            return
        target = self.target_at(time)
        self.refuse_input(
            (target < -COLLINEAR) | (target > np.pi + COLLINEAR),
            first_row,
            lambda k: f"target {target[k]:g} is no angle between 0 and pi; targets are in radian",
            "target",
        )
        self._refuse_straight(target, "has the target", first_row)

    def _refuse_straight(self, angle: FloatArray, verb: str, first_row: int) -> None:
        def said(k: int, row: str) -> str:
            degrees = 180 if angle[k] > 1 else 0
            remedy = (
                "use a linear constraint (LinearRelation with the end atoms as bases)"
                if degrees == 180
                else "use a linear constraint, or distances"
            )
            return f"angle constraint singular at {degrees} deg, {remedy}: {row}, {verb} {np.degrees(angle[k]):.9g} deg"

        self.refuse_singular(np.sin(angle) < COLLINEAR, first_row, said)


class Dihedral(Constraint):
    """Dihedral angle of four atoms in radian, IUPAC sign, smooth through +-180 degrees.

    Parameters
    ----------
    quads : array_like of int, shape (n_rows, 4)
        Atoms i, j, k, l of each row; j-k is the axis.
    target : float, array_like, callable of time, MovingTarget or None
        Angle held, in radian; the nearest image modulo 2 pi counts. A number beyond three turns is refused.

    Notes
    -----
    With F = r_0 - r_1, G = r_1 - r_2, H = r_3 - r_2, P = F x G, Q = H x G, p = P/|P|^2, s = Q/|Q|^2,
    g = |G|, along any motion

    dq/dt = -g p.F' + (F.G/g) p.G' - (H.G/g) s.G' + g s.H',

    which gives the gradient, and, differentiated once more at constant velocities, the curvature.

    References
    ----------
    A. Blondel and M. Karplus, J. Comput. Chem. 17, 1132 (1996), eq. 27.
    """

    family = "Dihedral"
    row_width = 4
    held = ANGLE
    translation_invariant = True
    period = 2 * np.pi
    kind = RowKind.FUNCTION

    def __init__(self, quads: ArrayLike, target: Target = None) -> None:
        super().__init__(quads, target)

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        F, G, H = _legs(r)
        P, Q = cross(F, G), cross(H, G)
        return np.arctan2(dot(cross(Q, P), G) / norm(G), dot(P, Q))

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        F, G, H = _legs(r)
        P, Q = cross(F, G), cross(H, G)
        g = norm(G)
        p, s = P / dot(P, P)[:, None], Q / dot(Q, Q)[:, None]
        along_f = -g[:, None] * p
        along_g = (dot(F, G) / g)[:, None] * p - (dot(H, G) / g)[:, None] * s
        along_h = g[:, None] * s
        return np.stack([along_f, along_g - along_f, -along_g - along_h, along_h], axis=1)

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        F, G, H = _legs(r)
        dF, dG, dH = _legs(v)
        P, Q = cross(F, G), cross(H, G)
        dP, dQ = cross(dF, G) + cross(F, dG), cross(dH, G) + cross(H, dG)
        g = norm(G)
        dg = dot(G, dG) / g
        p, dp = _over_square(P, dP)
        s, ds = _over_square(Q, dQ)
        f, h = dot(F, G) / g, dot(H, G) / g
        df = (dot(dF, G) + dot(F, dG) - f * dg) / g
        dh = (dot(dH, G) + dot(H, dG) - h * dg) / g
        first = -dg * dot(p, dF) - g * dot(dp, dF) + df * dot(p, dG) + f * dot(dp, dG)
        last = dg * dot(s, dH) + g * dot(ds, dH) - dh * dot(s, dG) - h * dot(ds, dG)
        return first + last

    def scale(self, time: float = 0.0) -> FloatArray:
        return np.ones(self.n_rows)

    def check(self, r: FloatArray, time: float, first_row: int) -> None:
        if self.n_rows == 0:
            return
        _refuse_coincident(self, r, first_row)
        if self.target is not None and not self.moving:
            target = self.target_at(time)
            self.refuse_input(
                np.abs(target) > MOST_TURNED,
                first_row,
                lambda k: f"target {target[k]:g} is over three turns, and in radian; give np.radians({target[k]:g})",
                "target",
            )
        F, G, H = _legs(r)
        for first, second, three in ((F, G, slice(0, 3)), (H, G, slice(1, 4))):
            straight = norm(cross(first, second)) < COLLINEAR * norm(first) * norm(second)
            self.refuse_singular(straight, first_row, partial(_collinear, self.atoms[:, three]))


def _collinear(trios: IntArray, k: int, row: str) -> str:
    i, j, m = trios[k]
    return (
        f"dihedral constraint singular: atoms {i}, {j}, {m} of {row}, are collinear; bend them, or hold a dihedral of "
        "other atoms"
    )


def _arms(r: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Arms of an angle, unit normal of their plane, and the sine of the angle."""
    u, w = r[:, 0] - r[:, 1], r[:, 2] - r[:, 1]
    normal = cross(u, w)
    area = norm(normal)
    return u, w, normal / area[:, None], area / (norm(u) * norm(w))


def _legs(r: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    return r[:, 0] - r[:, 1], r[:, 1] - r[:, 2], r[:, 3] - r[:, 2]


def _over_square(a: FloatArray, da: FloatArray) -> tuple[FloatArray, FloatArray]:
    """a/|a|^2 and its derivative."""
    square = dot(a, a)[:, None]
    b = a / square
    return b, da / square - 2 * (dot(a, da)[:, None] / square) * b


def _refuse_coincident(item: Constraint, r: FloatArray, first_row: int) -> None:
    """Neighbouring atoms of a row at one point leave an angle undefined."""
    same = norm(np.diff(r, axis=1)) == 0
    if same.any():
        k, slot = (int(i) for i in np.argwhere(same)[0])
        i, j = item.atoms[k, slot : slot + 2]
        raise SingularGeometryError(
            f"atoms {i} and {j} coincide: gradient of row {first_row + k}, {item.row_name(k)}, undefined; "
            "move them apart",
            rows=[first_row + k],
            atoms=[i, j],
        )
