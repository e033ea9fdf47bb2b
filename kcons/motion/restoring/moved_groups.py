"""Structures brought to a target: groups turn and shift as rigid pieces, bond lengths and angles stay as they were.

The point on the constraints that is nearest in the mass metric moves only the atoms that rows name, and for a far
target wrecks the bonds around them. So where rows are far off, or the nearest point changes other bonds or angles,

1. every row with a motion of its own makes it: a dihedral turns what lies beyond its bond, an angle turns what lies
   beyond one of its legs, a bond shifts the atoms on both of its sides, a distance between molecules shifts both;
2. where this does not do, in rings, between fixed atoms and for distances along a chain, all atoms of the molecules
   give way together, by least squares of what changes in bonds and angles;
3. what is left, mostly rounding, is done by the search for the nearest point.

What has fixed atoms stays where it is. A dihedral or an angle turns the lighter of its two sides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.sparse as sp

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.periodic.one_piece import minimum_image
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import cross
from kcons.errors import ConvergenceError, ImageError, InfeasibleError, KconsError, SingularGeometryError
from kcons.motion.certificate import off_row
from kcons.motion.restoring.kept_geometry import OFF, Bonds, Geometry
from kcons.motion.restoring.nearest_point import least_squares
from kcons.motion.restoring.rigid_pieces import Move, bend, stretch, torsion
from kcons.plan.plan import Plan
from kcons.solvers import tolerances

#: Rows that moved groups leave off by less than this (radian, or part of the length) are left to the search for the
#: nearest point.
NEAR = 0.25
#: Rounds in which every row makes its own motion, and how many motions there may be in all.
SWEEPS, MOST_MOVES = 40, 15_000
#: Steps in which all atoms give way, the weight of rows against that of a change which is just allowed, and rows and
#: atoms up to which this is tried.
EASING, HEAVY, MOST_ROWS, MOST_EASED = 60, 1e4, 400, 20_000


def restored(
    held: ConstraintSet,
    plan: Plan,
    x: FloatArray,
    time: float,
    bonds: Bonds | None,
    nearest: Callable[[FloatArray], FloatArray],
) -> FloatArray:
    """Positions on all rows with other bond lengths and angles as in `x`; a new array.

    Parameters
    ----------
    held : ConstraintSet
    plan : Plan
        That of `held`, or of its rows on the atoms they touch.
    x : ndarray, shape (n_atoms, 3)
    time : float
    bonds : callable or None
        Gives the bonds, shape (n, 2). None: see `kept_geometry.bonds_of`. Where it gives none, other lengths and
        angles may change.
    nearest : callable
        Gives the nearest point on the rows, or raises.

    Raises
    ------
    InfeasibleError
        Such positions were not found.
    """
    geometry = Geometry(held, plan.labels, x, time, bonds)
    ways: list[Callable[[], FloatArray | None]] = [lambda: x, lambda: moved(geometry)]

    if geometry.far() and not geometry.free and len(geometry.pieces.bonds):
        ways.reverse()
    ways.append(lambda: eased(geometry))
    error: KconsError | None = None
    for way in ways:
        begin = way()
        if begin is None:
            continue
        try:
            found = nearest(begin)
        except (ConvergenceError, ImageError, SingularGeometryError) as failure:
            error = error or failure
            continue
        wrong = _off(held, plan, found, time)
        if wrong is None:
            wrong = geometry.changed(found, strict=geometry.turned)
            if wrong is None:
                return found
        error = wrong
    assert error is not None
    raise error


def _off(held: ConstraintSet, plan: Plan, x: FloatArray, time: float) -> InfeasibleError | None:
    """What to raise if `x` is off a row by the set's own measure, the one that reports use."""
    with np.errstate(all="ignore"):
        miss = np.abs(held.value(x, time))
        # Rows between fixed atoms are as good as the places given.
        allowed = np.maximum(
            tolerances.ROUNDINGS * held.tolerance(x, time), np.where(plan.labels < 0, tolerances.NEAR * held.scale, 0.0)
        )
    row = off_row(miss, allowed)
    if row < 0:
        return None
    return InfeasibleError(
        f"the positions that were found miss row {held.row_name(row)} by {miss[row]:.6g}; check its target against its "
        "neighbors', or start nearer to a solution",
        residual=float(miss[row] / held.scale[row]),
        tolerance=float(allowed[row] / held.scale[row]),
        row=row,
        atoms=held.row_atoms(row),
    )


def moved(geometry: Geometry) -> FloatArray | None:
    """The start with pieces moved as the rows ask; None if they cannot come near."""
    if not geometry.usable or not np.isfinite(geometry.start[geometry.pieces.atoms]).all():
        return None
    return _Motions(geometry).moved()


def eased(geometry: Geometry) -> FloatArray | None:
    """The start with all atoms of its molecules moved, bonds and angles as near to theirs as the rows allow, or None.

    Least squares of the rows, weighed heavily, and of changes of bonds and of the ends of angles, in units of what may
    change.
    """
    held, time, start = geometry.held, geometry.time, geometry.start
    if not geometry.checked or not geometry.usable or held.n_rows > MOST_ROWS:
        return None
    ties, weights = geometry.ties()
    atoms = geometry.pieces.atoms
    if not np.any(weights > 0) or len(atoms) > MOST_EASED or not np.isfinite(start[atoms]).all():
        return None
    atoms = atoms[~geometry.pinned[atoms]]
    heavy = np.where(held.holonomic, HEAVY / held.scale, 0.0)
    x = geometry.placed()
    reach = 0.3 * float(ties.scale.min())
    with np.errstate(all="ignore"):
        least_squares(
            x,
            atoms,
            lambda y: np.concatenate([heavy * held.value(y, time), weights * ties.value(y)]),
            lambda y: sp.vstack(
                [sp.diags_array(heavy) @ held.jacobian(y, time), sp.diags_array(weights) @ ties.jacobian(y)]
            ),
            steps=EASING,
            still=1e-9 * reach,
            longest=reach,
        )
        left = np.abs(held.value(x, time)) / held.scale
    return x if np.all(left[held.holonomic] <= NEAR) else None


@dataclass(frozen=True)
class _Own:
    """A row with a motion of its own."""

    row: int
    part: ConstraintSet
    atoms: IntArray
    move: Move
    #: (i, j, k) of a distance that is changed by the angle at j.
    across: tuple[int, int, int] | None = None


class _Motions:
    """The motions of one restoration, made on positions with every molecule in one piece."""

    def __init__(self, geometry: Geometry) -> None:
        self.geometry, self.held, self.pieces = geometry, geometry.held, geometry.pieces
        self.time, self.pinned = geometry.time, geometry.pinned
        self._whole = self.pieces.whole(geometry.start, self.held.lattice)
        self._images = self._whole - geometry.start

    def moved(self) -> FloatArray | None:
        """See the function of this name."""
        held, y = self.held, self._whole.copy()
        self._follow_fixed(y)
        with np.errstate(all="ignore"):
            self._sweep(y)
            left = np.abs(held.value(y - self._images, self.time)) / held.scale
        if not np.all(left[held.holonomic] <= NEAR):
            return None
        return y - self._images

    def _follow_fixed(self, y: FloatArray) -> None:
        """Molecules with fixed atoms that are placed elsewhere go along, in place."""
        places = {
            int(a): item.target_at(self.time)[3 * n : 3 * n + 3]
            for item in self.held.constraints
            if item.fixes_atoms
            for n, a in enumerate(item.atoms[::3, 0])
        }
        for molecule in self.pieces.molecules:
            fixed = molecule[self.pinned[molecule]]
            if not len(fixed):
                continue
            target = np.array([places[int(a)] for a in fixed]) + self._images[fixed]
            if np.array_equal(y[fixed], target):
                continue
            here, there = y[fixed].mean(axis=0), target.mean(axis=0)
            u, _, vt = np.linalg.svd((y[fixed] - here).T @ (target - there))
            turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
            if len(fixed) < 3:
                turn = _turn_of_line(y[fixed] - here, target - there)
            y[molecule] = (y[molecule] - here) @ turn + there
            y[fixed] = target

    def _side(self, j: int, k: int, moves: IntArray, stays: IntArray) -> IntArray | None:
        """What lies beyond the bond j-k, if that contains all of one group, none of another, and no fixed atom."""
        side = self.pieces.beyond(j, k)
        return self._piece(side, moves, stays) if side is not None else None

    def _apart(self, moves: IntArray, stays: IntArray) -> IntArray | None:
        """The molecules of some atoms, if they have none of some others and no fixed atom."""
        return self._piece(self._molecules(moves), moves, stays)

    def _piece(self, atoms: IntArray, moves: IntArray, stays: IntArray) -> IntArray | None:
        inside = np.isin(np.concatenate([moves, stays]), atoms)
        wanted = np.arange(len(inside)) < len(moves)
        return atoms if np.array_equal(inside, wanted) and not self.pinned[atoms].any() else None

    def _lightest(self, found: list[tuple[IntArray | None, Move | None]]) -> Move | None:
        """Of the motions that are possible, that of the least mass."""
        able = [(float(self.held.masses[atoms].sum()), move) for atoms, move in found if atoms is not None and move]
        return min(able, key=lambda entry: entry[0])[1] if able else None

    def _own(self, family: str, atoms: IntArray) -> tuple[Move | None, tuple[int, int, int] | None]:
        """The motion that changes one row and, if possible, no other bond or angle."""
        image = partial(minimum_image, lattice=self.held.lattice)
        found: list[tuple[IntArray | None, Move | None]] = []
        if family == "Distance":
            i, k = atoms.tolist()

            def axis(x: FloatArray) -> FloatArray:
                return image(x[k] - x[i])

            move = self._shifted(np.array([k]), np.array([i]), axis)
            if move is not None:
                return move, None
            for j in self.geometry.between(i, k):
                move, _ = self._own("Angle", np.array([i, j, k]))
                if move is not None:
                    return move, (i, j, k)
            return None, None
        if family == "Angle":
            for i, j, k in (atoms.tolist(), atoms[::-1].tolist()):
                moves, stays = np.array([k]), np.array([i, j])
                piece = self._side(j, k, moves, stays) if self.pieces.bonded(j, k) else None
                if piece is None:
                    piece = self._apart(moves, stays)
                found.append((piece, None if piece is None else bend(piece, i, j, k)))
        elif family == "Dihedral":
            for i, j, k, l in (atoms.tolist(), atoms[::-1].tolist()):
                piece = None
                if self.pieces.bonded(j, k):
                    piece = self._side(j, k, np.array([k, l]), np.array([i, j]))
                if piece is None:
                    piece = self._apart(np.array([l]), np.array([i, j, k]))
                if piece is None:
                    piece = self._apart(np.array([k, l]), np.array([i, j]))
                found.append((piece, None if piece is None else torsion(piece, j, k)))
        return self._lightest(found), None

    def _owns(self) -> list[_Own]:
        """Motions of the rows that are off."""
        held = self.held
        off = self.geometry.misfit > OFF * 1e-3
        found: list[_Own] = []
        for item, first in zip(held.constraints, held.starts, strict=False):
            if item.family not in ("Distance", "Angle", "Dihedral", "CenterDistance"):
                continue
            for n in np.flatnonzero(off[first : first + item.n_rows]).tolist():
                row = int(first) + n
                part, atoms = held.subset(np.array([row]))
                if item.family == "CenterDistance":
                    move, across = self._centers(item.atoms[n], getattr(item, "split"), part, atoms), None  # noqa: B009
                else:
                    move, across = self._own(item.family, item.atoms[n])
                if move is not None:
                    found.append(_Own(row, part, atoms, move, across))
        return found

    def _shifted(self, a: IntArray, b: IntArray, axis: Callable[[FloatArray], FloatArray]) -> Move | None:
        """Shift what belongs to two groups along the way from b to a: the two sides of a bond, or molecules."""
        sides = None
        if len(a) == len(b) == 1 and self.pieces.bonded(int(a[0]), int(b[0])):
            sides = self.pieces.beyond(int(b[0]), int(a[0])), self.pieces.beyond(int(a[0]), int(b[0]))
        if sides is None or sides[0] is None or sides[1] is None:
            sides = self._molecules(a), self._molecules(b)
            if len(np.intersect1d(*sides)):
                return None
        able = [side if not self.pinned[side].any() else side[:0] for side in sides if side is not None]
        return stretch(able[0], able[1], self.held.masses, axis) if len(able[0]) or len(able[1]) else None

    def _molecules(self, atoms: IntArray) -> IntArray:
        """All atoms of the molecules of some atoms."""
        return np.unique(np.concatenate([self.pieces.molecule(a) for a in atoms.tolist()]))

    def _centers(self, atoms: IntArray, split: int, part: ConstraintSet, own: IntArray) -> Move | None:
        """Shift the molecules of two groups along the line of their centers."""
        mine = np.isin(own, atoms[:split])

        def axis(x: FloatArray) -> FloatArray:
            gradient = part.jacobian(x[own], self.time).toarray().reshape(-1, 3)
            return np.asarray(gradient[mine].sum(axis=0))

        return self._shifted(atoms[:split], atoms[split:], axis)

    def _sweep(self, y: FloatArray) -> None:
        """Let every row that is off make its motion, over and over, in place."""
        held, time = self.held, self.time
        owns = self._owns()
        last, made = np.inf, 0
        for _ in range(SWEEPS):
            largest = 0.0
            for own in owns:
                sigma = float(own.part.value(y[own.atoms], time)[0])
                size = abs(sigma) / float(held.scale[own.row])
                if not size > 1e-13:
                    continue
                largest = max(largest, size)
                amount = -sigma if own.across is None else self._opening(y, own.across, -sigma)
                made += 1
                if made > MOST_MOVES or not own.move.make(y, amount):
                    return
            if largest < 1e-12 or (largest > 0.9 * last and largest < 1e-9):
                break
            last = min(last, largest)

    def _opening(self, y: FloatArray, across: tuple[int, int, int], change: float) -> float:
        """By how much the angle i-j-k must grow for the distance i-k to grow by `change`."""
        i, j, k = across
        u, w = y[i] - y[j], y[k] - y[j]
        a, b = float(np.linalg.norm(u)), float(np.linalg.norm(w))
        now = float(np.arctan2(np.linalg.norm(cross(u, w)), u @ w))
        goal = float(np.linalg.norm(y[k] - y[i])) + change
        cosine = (a * a + b * b - goal * goal) / (2 * a * b)
        return float(np.arccos(np.clip(cosine, -1.0, 1.0))) - now


def _turn_of_line(a: FloatArray, b: FloatArray) -> FloatArray:
    """The least turn, as a matrix for rows from the left, that takes the line of one or two points to another."""
    u, w = a[0], b[0]
    lu, lw = float(np.linalg.norm(u)), float(np.linalg.norm(w))
    if lu == 0 or lw == 0:
        return np.eye(3)
    u, w = u / lu, w / lw
    axis, cosine = cross(u, w), float(u @ w)
    if cosine < -1 + 1e-12:
        axis = cross(u, np.eye(3)[int(np.argmin(np.abs(u)))])
        axis /= np.linalg.norm(axis)
        return 2 * np.outer(axis, axis) - np.eye(3)
    matrix = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return (np.eye(3) + matrix + matrix @ matrix / (1 + cosine)).T
