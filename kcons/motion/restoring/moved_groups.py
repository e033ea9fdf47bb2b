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

import warnings
from collections.abc import Callable

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
from kcons.plan.clusters import fixed_atoms
from kcons.plan.plan import Plan
from kcons.solvers import tolerances

#: Moves atoms in place by an amount; False where it is undefined.
Move = Callable[[FloatArray, float], bool]
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
    ways: list[Callable[[], FloatArray | None]] = [lambda: x, _Motions(geometry).moved]
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
        error = error if isinstance(error, InfeasibleError) else wrong
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
            bold=True,
        )
        left = np.abs(held.value(x, time)) / held.scale
    return x if np.all(left[held.holonomic] <= NEAR) else None


class _Motions:
    """The motions of one restoration, made on positions with every molecule in one piece."""

    def __init__(self, geometry: Geometry) -> None:
        self.geometry, self.held = geometry, geometry.held
        self.time, self.pinned = geometry.time, geometry.pinned

    def moved(self) -> FloatArray | None:
        """The start with pieces moved as the rows ask; None if they cannot come near."""
        held, start = self.held, self.geometry.start
        if not self.geometry.usable or not np.isfinite(start[self.geometry.pieces.atoms]).all():
            return None
        self.pieces = self.geometry.pieces
        y = self.pieces.whole(start, held.lattice)
        self._images = y - start
        self._follow_fixed(y)
        with np.errstate(all="ignore"):
            self._sweep(y)
            left = np.abs(held.value(y - self._images, self.time)) / held.scale
        return y - self._images if np.all(left[held.holonomic] <= NEAR) else None

    def _follow_fixed(self, y: FloatArray) -> None:
        """Molecules with fixed atoms that are placed elsewhere go along, in place."""
        from scipy.spatial.transform import Rotation  # slow to import, rarely needed

        held, places = fixed_atoms(self.held), self.geometry.placed() + self._images
        for molecule in self.pieces.molecules:
            fixed = molecule[np.isin(molecule, held)]
            target = places[fixed]
            if np.array_equal(y[fixed], target):
                continue
            here, there = y[fixed].mean(axis=0), target.mean(axis=0)
            if len(fixed) > 1:
                arms = np.stack([target - there, y[fixed] - here])[:, : None if len(fixed) > 2 else 1]
                with warnings.catch_warnings(action="ignore"):  # of atoms on one line, of which any turn does
                    turn, _ = Rotation.align_vectors(*arms)
                y[molecule] = here + turn.apply(y[molecule] - here)
            y[molecule] += there - here
            y[fixed] = target

    def _own(self, family: str, atoms: IntArray) -> Move | None:
        """The motion that changes one row and, if possible, no other bond or angle: that of the lighter piece."""
        if family == "Distance":
            return self._shifted(*atoms.tolist())
        able: list[tuple[float, Move]] = []
        for order in (atoms, atoms[::-1]):
            i, j, k = order[:3].tolist()
            pieces = [self._piece(self.pieces.beyond(j, k), order, 2)]
            for last in range(1, len(order) - 1):
                molecules = np.unique(np.concatenate([self.pieces.molecule(a) for a in order[-last:].tolist()]))
                pieces.append(self._piece(molecules, order, len(order) - last))
            for piece in pieces:
                if piece is not None:
                    move = _torsion(piece, j, k) if family == "Dihedral" else _bend(piece, i, j, k)
                    able.append((float(self.held.masses[piece].sum()), move))
                    break
        return min(able, key=lambda entry: entry[0])[1] if able else None

    def _piece(self, piece: IntArray | None, order: IntArray, first: int) -> IntArray | None:
        """A piece with the atoms of a row from `first` on, with none of those before, and no fixed atom; else None."""
        if piece is None or self.pinned[piece].any():
            return None
        return piece if np.array_equal(np.isin(order, piece), np.arange(len(order)) >= first) else None

    def _shifted(self, i: int, k: int) -> Move | None:
        """Shift the two sides of a bond, or two molecules, along the way between two atoms, their center at rest."""
        one, other = self.pieces.beyond(i, k), self.pieces.beyond(k, i)
        if one is None or other is None:
            one, other = self.pieces.molecule(k), self.pieces.molecule(i)
            if np.isin(i, one):
                return None
        one, other = (side[:0] if self.pinned[side].any() else side for side in (one, other))
        if not (len(one) or len(other)):
            return None
        a, b = (float(self.held.masses[side].sum()) for side in (one, other))
        part = (b / (a + b) if a + b > 0 else 0.5) if len(one) and len(other) else float(len(one) > 0)

        def move(x: FloatArray, amount: float) -> bool:
            way = minimum_image(x[k] - x[i], self.held.lattice)
            size = float(np.linalg.norm(way))
            if size > 0:
                x[one] += amount * part / size * way
                x[other] += amount * (part - 1.0) / size * way
            return size > 0

        return move

    def _owns(self) -> list[tuple[int, ConstraintSet, IntArray, Move]]:
        """Rows that are off and have a motion of their own, each as a set of its own with its atoms, and the motion."""
        found = []
        for item, first, miss in self.geometry.off_rows():
            if item.family in ("Distance", "Angle", "Dihedral"):
                for n in np.flatnonzero(miss > OFF * 1e-3).tolist():
                    move = self._own(item.family, item.atoms[n])
                    if move is not None:
                        found.append((first + n, *self.held.subset(np.array([first + n])), move))
        return found

    def _sweep(self, y: FloatArray) -> None:
        """Let every row that is off make its motion, over and over, in place."""
        held, time = self.held, self.time
        owns = self._owns()
        last, made = np.inf, 0
        for _ in range(SWEEPS):
            largest = 0.0
            for row, part, atoms, move in owns:
                sigma = float(part.value(y[atoms], time)[0])
                size = abs(sigma) / float(held.scale[row])
                if not size > 1e-13:
                    continue
                largest = max(largest, size)
                made += 1
                if made > MOST_MOVES or not move(y, -sigma):
                    return
            if largest < 1e-12 or (largest > 0.9 * last and largest < 1e-9):
                break
            last = min(last, largest)


def _bend(atoms: IntArray, i: int, j: int, k: int) -> Move:
    """Turn about j in the plane of i, j, k: with k among `atoms`, the angle i-j-k grows by the amount."""

    def move(x: FloatArray, amount: float) -> bool:
        u, w = x[i] - x[j], x[k] - x[j]
        normal = cross(u, w)
        if not np.linalg.norm(normal) > 1e-9 * np.linalg.norm(u) * np.linalg.norm(w):
            normal = cross(u, np.eye(3)[int(np.argmin(np.abs(u)))])  # straight: any plane does
        return _turn(x, atoms, x[j], normal, amount)

    return move


def _torsion(atoms: IntArray, j: int, k: int) -> Move:
    """Turn about the line from j to k: with the last atom of a dihedral among `atoms`, it grows by the amount."""
    return lambda x, amount: _turn(x, atoms, x[j], x[k] - x[j], amount)


def _turn(x: FloatArray, atoms: IntArray, origin: FloatArray, axis: FloatArray, angle: float) -> bool:
    """Turn atoms about an axis (right-handed) in place; False where it has no length."""
    size = float(np.linalg.norm(axis))
    if not size > 0:
        return False
    axis = axis / size
    arm = x[atoms] - origin
    across = arm - (arm @ axis)[:, None] * axis
    # In this form small turns lose nothing: 1 - cos is taken from the half angle.
    x[atoms] += np.sin(angle) * cross(axis, arm) - 2 * np.sin(angle / 2) ** 2 * across
    return True
