"""Structures brought to a target: groups turn and shift as rigid pieces, bond lengths and angles stay as they were.

The point on the constraints that is nearest in the mass metric moves only the atoms that rows name, and for a far
target wrecks the bonds around them. So where rows are far off, or the nearest point changes other bonds or angles,

1. every row with a motion of its own makes it: a dihedral turns what lies beyond its bond, an angle turns what lies
   beyond one of its legs, a bond shifts what lies beyond it, a distance between molecules shifts one of them;
2. rows that are still off are reached by turns about all bonds between their atoms and by motions of whole molecules,
   with damped Newton steps;
3. what is left, rounding or small misfits in rings, is done by the search for the nearest point.

Of the two sides of a bond the lighter one moves, or the one without fixed atoms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from kcons.constraint_set import ConstraintSet
from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InfeasibleError, KconsError, SingularGeometryError
from kcons.guessed_bonds import NEAREST, bonds_without_elements
from kcons.pieces import Move, Pieces, bend, free_motions, stretch, torsion
from kcons.plan import Plan
from kcons.topology import BoolArray, bond_angles, connected, sorted_pairs

#: Other bonds may change by this part of their length (0.02 angstrom for C-C), other angles by this much in radian.
BOND_KEPT, ANGLE_KEPT = 0.0125, np.radians(2.0)
#: Displacements below this part of the distance to the nearest neighbour leave bonds and angles as they are.
STILL = 3e-3
#: Rows off by more than this (radian, or part of the length) are far: pieces move first.
FAR = 0.25
#: What pieces may leave to the search for the nearest point, in the same unit.
NEAR = 0.25
#: Rounds in which every row makes its own motion, and how many motions there may be in all.
SWEEPS, MOST_MOVES = 40, 15_000
#: Rows and motions beyond which no Newton steps among them are tried; steps, and starts from turned bonds.
MOST_ROWS, MOST_MOTIONS, STEPS, KICKS = 400, 400, 40, 3
#: Largest turn of one step, in radian.
_LONGEST_TURN = 0.5
#: Rows off by no more than this are fulfilled as far as motions are concerned.
_OFF = 1e-9
#: Rows that hold what bonds and angles are made of.
_INTERNAL = ("Distance", "Angle", "Dihedral", "CenterDistance")
#: Bonds and angles that are examined for being held by the rows.
_MOST_EXAMINED = 200


def restored(
    held: ConstraintSet,
    plan: Plan,
    x: FloatArray,
    time: float,
    bonds: IntArray | None,
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
    bonds : ndarray of int, shape (n, 2), or None
        None: see `bonds_of`. An empty array: no bonds but those that rows hold.
    nearest : callable
        Gives the nearest point on the rows, or raises.

    Raises
    ------
    InfeasibleError
        Such positions were not found.
    """
    search = _Search(held, plan, x, time, bonds)
    ways = [lambda: x, search.moved]
    if search.far() and len(search.pieces.bonds):
        ways.reverse()
    error: KconsError | None = None
    noisy: list[FloatArray] = []
    for way in ways:
        begin = way()
        if begin is None:
            continue
        try:
            found = nearest(begin)
        except (ConvergenceError, SingularGeometryError) as failure:
            error = error or failure
            continue
        wrong = search.off(found)
        if wrong is None:
            wrong = search.changed(found, strict=search.turned)
            if wrong is None:
                return found
            noisy.append(found)
        error = wrong
    for found in noisy:
        if search.changed(found, strict=False) is None:
            return found
    assert error is not None
    raise error


def bonds_of(held: ConstraintSet, x: FloatArray, time: float, given: IntArray | None) -> IntArray:
    """What counts as a bond, shape (n, 2).

    Those that are given and the distances that rows hold, unless they are longer than atoms in one molecule are bonded
    (the third side of a rigid triangle, the ends of a chain). Without given ones, also what the distances suggest
    between atoms that held distances do not join.
    """
    pairs = [item.atoms for item in held.constraints if item.family == "Distance"]
    lengths = [item.target_at(time) for item in held.constraints if item.family == "Distance"]
    rows = np.concatenate([*pairs, np.zeros((0, 2), np.int64)])
    target = np.concatenate([*lengths, np.zeros(0)])
    others = given
    if others is None:
        others = bonds_without_elements(x, held.lattice, held.touched, held.masses > 0)
        fragment, _ = connected(rows, held.n_atoms)
        others = others[fragment[others[:, 0]] != fragment[others[:, 1]]]
    known = np.concatenate([rows, others])
    away = held.minimum_image(x[others[:, 0]] - x[others[:, 1]])
    length = np.concatenate([target, np.linalg.norm(away, axis=1)])
    shortest = np.full(held.n_atoms, np.inf)
    for side in (0, 1):
        np.minimum.at(shortest, known[:, side], length)
    bonded = length < NEAREST * np.sqrt(shortest[known[:, 0]] * shortest[known[:, 1]])
    return sorted_pairs(known[bonded])


@dataclass(frozen=True)
class _Own:
    """A row with a motion of its own."""

    row: int
    part: ConstraintSet
    atoms: IntArray
    move: Move
    #: (i, j, k) of a distance that is changed by the angle at j.
    across: tuple[int, int, int] | None = None


class _Search:
    """One restoration: its bonds, its motions, and the checks of what was found."""

    def __init__(self, held: ConstraintSet, plan: Plan, x: FloatArray, time: float, bonds: IntArray | None) -> None:
        self.held, self.plan, self.start, self.time, self._given = held, plan, x, time, bonds
        fixed = [c for c in held.constraints if c.family == "FixedAtoms"]
        self.pinned = np.zeros(held.n_atoms, dtype=bool)
        for item in fixed:
            self.pinned[item.atoms.ravel()] = True
        with np.errstate(all="ignore"):
            self.misfit = np.abs(held.value(x, time)) / held.scale
        self.usable = bool(np.isfinite(x[held.touched]).all())
        self.tolerance_of_loose = np.where(plan.labels < 0, 1e-10 * held.scale, 0.0)

    @cached_property
    def pieces(self) -> Pieces:
        bonds = bonds_of(self.held, self.start, self.time, self._given)
        return Pieces(self.held.n_atoms, bonds, self.held.touched)

    def far(self) -> bool:
        """Whether a row of lengths or angles is far off."""
        return self.usable and any(
            bool(np.any(miss > FAR)) for item, miss in self._off_rows() if item.translation_invariant
        )

    def _off_rows(self) -> list[tuple[Constraint, FloatArray]]:
        """Constraints and by how much their rows are off."""
        held = self.held
        return [
            (item, self.misfit[first : first + item.n_rows])
            for item, first in zip(held.constraints, held.starts, strict=False)
            if item.holonomic
        ]

    @cached_property
    def turned(self) -> bool:
        """Whether something other than bonds is off: then angles are to be what they were, whatever the bonds are."""
        for item, miss in self._off_rows():
            off = item.atoms[miss > _OFF]
            if item.family in ("Angle", "Dihedral", "CenterDistance") and len(off):
                return True
            if item.family == "Distance" and not all(self.pieces.bonded(i, k) for i, k in off.tolist()):
                return True
        return False

    @cached_property
    def checked(self) -> bool:
        """Whether bonds are to be as they were; guessed ones only if rows of lengths and angles alone are off."""
        if self._given is not None:
            return len(self._given) > 0
        return all(item.family in _INTERNAL or not np.any(miss > _OFF) for item, miss in self._off_rows())

    # -- checks ---------------------------------------------------------------------------------

    def off(self, x: FloatArray) -> ConvergenceError | None:
        """What to raise if `x` is off a row by the set's own measure."""
        held = self.held
        with np.errstate(all="ignore"):
            miss = np.abs(held.value(x, self.time))
            allowed = np.maximum(held.tolerance(x, self.time), self.tolerance_of_loose)
        bad = ~(miss <= allowed)
        if not bad.any():
            return None
        row = int(np.argmax(np.where(np.isfinite(miss), np.where(bad, miss / allowed, 0.0), np.inf)))
        return InfeasibleError(
            f"the positions that were found miss row {held.row_name(row)} by {miss[row]:.6g}; check its target against "
            "its neighbours', or start nearer to a solution",
            residual=float(miss[row] / held.scale[row]),
            tolerance=float(allowed[row] / held.scale[row]),
            row=row,
            atoms=held.row_atoms(row),
        )

    def changed(self, x: FloatArray, *, strict: bool) -> InfeasibleError | None:
        """What to raise if a bond or an angle that no row holds has changed.

        Unless `strict`, angles may change as much as the bonds around them that rows hold were off.
        """
        held, start = self.held, self.start
        move = np.linalg.norm(x - start, axis=1)
        if not self.checked or not np.any(move > 0):
            return None
        if float(move.max()) <= STILL * _closest(start, move > 0):
            return None
        bonds = self.pieces.bonds
        angles = bond_angles(bonds, held.n_atoms)
        length, before = self._lengths(x, bonds), self._lengths(start, bonds)
        slack = BOND_KEPT * before
        held_off = self._held_lengths
        table = {pair: miss for pair, miss in zip(map(tuple, held_off[0].tolist()), held_off[1].tolist(), strict=True)}
        free = np.array([tuple(pair) not in table for pair in bonds.tolist()], dtype=bool)
        wrong = free & ~(np.abs(length - before) <= slack)
        turn, angle_before = self._angles(x, angles), self._angles(start, angles)
        bent = np.abs(turn - angle_before)
        suspects = np.flatnonzero(~(bent <= ANGLE_KEPT))
        legs = self._moved_legs
        around = np.zeros(held.n_atoms)
        for side in (0, 1):
            np.add.at(around, held_off[0][:, side], held_off[1])
        odd = []
        for number in suspects.tolist():
            i, j, k = angles[number].tolist()
            noise = 0.0 if strict else 2.0 * float(np.sum(around[[i, j, k]]))
            if bent[number] > max(ANGLE_KEPT, noise) and not {(j, i), (j, k)} & legs:
                odd.append(number)
        worst: list[tuple[float, IntArray, str]] = [
            (abs(length[n] - before[n]) / slack[n], bonds[n], f"from {before[n]:.4g} to {length[n]:.4g}")
            for n in np.flatnonzero(wrong).tolist()
        ] + [
            (
                bent[n] / ANGLE_KEPT,
                angles[n],
                f"from {np.degrees(angle_before[n]):.4g} to {np.degrees(turn[n]):.4g} degrees",
            )
            for n in odd
        ]
        worst.sort(key=lambda entry: -entry[0])
        if len(worst) <= _MOST_EXAMINED:
            worst = [entry for entry in worst if not self._follows(x, entry[1])]
        if not worst:
            return None
        _, atoms, words = worst[0]
        row = int(np.argmax(np.where(np.isfinite(self.misfit), self.misfit, np.inf)))
        what = ("the bond " if len(atoms) == 2 else "the angle ") + "-".join(str(a) for a in atoms)
        return InfeasibleError(
            f"row {held.row_name(row)} was reached only with {what} changed {words}, which no row asks for. Start "
            "nearer to the target, check the bonds, or hold what may change; with bonds=[] nothing but the rows is "
            "looked at",
            residual=float(self.misfit[row]),
            row=row,
            atoms=held.row_atoms(row),
        )

    @cached_property
    def _held_lengths(self) -> tuple[IntArray, FloatArray]:
        """Pairs whose distance a row holds, i < j, and by which part of it they were off."""
        pairs, miss = [np.zeros((0, 2), np.int64)], [np.zeros(0)]
        for item, first in zip(self.held.constraints, self.held.starts, strict=False):
            if item.family == "Distance":
                pairs.append(np.sort(item.atoms, axis=1))
                miss.append(self.misfit[first : first + item.n_rows])
        return np.concatenate(pairs), np.concatenate(miss)

    @cached_property
    def _moved_legs(self) -> set[tuple[int, int]]:
        """(vertex, end) of the legs of angles that were off: other angles with such a leg change with them."""
        legs: set[tuple[int, int]] = set()
        for item, first in zip(self.held.constraints, self.held.starts, strict=False):
            off = np.flatnonzero(self.misfit[first : first + item.n_rows] > 1e-6)
            if item.family == "Angle":
                for i, j, k in item.atoms[off].tolist():
                    legs |= {(j, i), (j, k)}
            elif item.family == "Distance":
                for i, k in item.atoms[off].tolist():
                    for j in self._between(i, k):
                        legs |= {(j, i), (j, k)}
        return legs

    def _between(self, i: int, k: int) -> list[int]:
        """Atoms bonded to both of two that are not bonded to each other."""
        if self.pieces.bonded(i, k):
            return []
        return np.intersect1d(self.pieces.neighbours(i), self.pieces.neighbours(k)).tolist()

    def _lengths(self, x: FloatArray, pairs: IntArray) -> FloatArray:
        return np.linalg.norm(self.held.minimum_image(x[pairs[:, 1]] - x[pairs[:, 0]]), axis=1)

    def _angles(self, x: FloatArray, triples: IntArray) -> FloatArray:
        u = self.held.minimum_image(x[triples[:, 0]] - x[triples[:, 1]])
        w = self.held.minimum_image(x[triples[:, 2]] - x[triples[:, 1]])
        return np.arctan2(np.linalg.norm(np.cross(u, w), axis=1), np.einsum("ni,ni->n", u, w))

    def _follows(self, x: FloatArray, atoms: IntArray) -> bool:
        """Whether the rows hold a bond or an angle: its gradient lies in the span of theirs."""
        from scipy.sparse.linalg import lsqr  # slow to import, rarely needed

        centre = x[atoms[1]]
        arms = {int(a): self.held.minimum_image(x[a] - centre) for a in atoms if a != atoms[1]}
        gradient = np.zeros(x.shape)
        if len(atoms) == 2:
            gradient[atoms[0]] = arms[int(atoms[0])]
        else:
            u, w = (arms[int(a)] for a in atoms[[0, 2]])
            # That of the cosine: the angle's own is undefined where it is straight.
            lu, lw = np.linalg.norm(u), np.linalg.norm(w)
            cosine = u @ w / (lu * lw)
            gradient[atoms[0]] = (w / lw - cosine * u / lu) / lu
            gradient[atoms[2]] = (u / lu - cosine * w / lw) / lw
        gradient[atoms[1]] = -gradient.sum(axis=0)
        target = gradient.ravel()
        size = np.linalg.norm(target)
        if size == 0:
            return False
        rows, columns = self._gradients(x)
        if not len(columns):
            return False
        left = target[columns] / size
        if np.linalg.norm(left) < 1 - 1e-6:
            return False
        answer = lsqr(rows.T, left, atol=1e-12, btol=1e-12, iter_lim=4 * sum(rows.shape))[0]
        return bool(np.linalg.norm(left - rows.T @ answer) < 1e-5)

    def _gradients(self, x: FloatArray) -> tuple[sp.csr_array, IntArray]:
        """Unit gradients of all rows on the atoms they touch, and which coordinates these are."""
        columns = (3 * self.held.touched[:, None] + np.arange(3)).ravel()
        rows = sp.csr_array(self.held.jacobian(x, self.time))[:, columns]
        size = np.sqrt(np.asarray(rows.multiply(rows).sum(axis=1)).ravel())
        return sp.csr_array(sp.diags_array(1.0 / np.where(size > 0, size, 1.0)) @ rows), columns

    # -- motions --------------------------------------------------------------------------------

    def moved(self) -> FloatArray | None:
        """The start with pieces moved as the rows ask; None if they cannot come near."""
        held = self.held
        if not self.usable:
            return None
        pieces = self.pieces
        if not np.isfinite(self.start[pieces.atoms]).all():
            return None
        self._left = MOST_MOVES
        whole = pieces.whole(self.start, held.minimum_image)
        self._images = whole - self.start
        y = whole.copy()
        self._follow_fixed(y)
        with np.errstate(all="ignore"):
            if not self._sweep(y):
                self._newton(y)
            left = np.abs(held.value(y - self._images, self.time)) / held.scale
        if not np.all(left[held.holonomic] <= NEAR):
            return None
        return y - self._images

    def _follow_fixed(self, y: FloatArray) -> None:
        """Molecules with fixed atoms that are placed elsewhere go along, in place."""
        places = {
            int(a): item.target_at(self.time)[3 * n : 3 * n + 3]
            for item in self.held.constraints
            if item.family == "FixedAtoms"
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
        image = self.held.minimum_image
        found: list[tuple[IntArray | None, Move | None]] = []
        if family == "Distance":
            i, k = atoms.tolist()

            def axis(x: FloatArray) -> FloatArray:
                return image(x[k] - x[i])

            move = self._shifted(np.array([k]), np.array([i]), axis)
            if move is not None:
                return move, None
            for j in self._between(i, k):
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
        off = self.misfit > 1e-12
        found: list[_Own] = []
        for item, first in zip(held.constraints, held.starts, strict=False):
            if item.family not in ("Distance", "Angle", "Dihedral", "CenterDistance"):
                continue
            for n in np.flatnonzero(off[first : first + item.n_rows]).tolist():
                row = int(first) + n
                part, atoms = held.subset(np.array([row]))
                if item.family == "CenterDistance":
                    move, across = self._centres(item.atoms[n], getattr(item, "split"), part, atoms), None  # noqa: B009
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

    def _centres(self, atoms: IntArray, split: int, part: ConstraintSet, own: IntArray) -> Move | None:
        """Shift the molecules of two groups along the line of their centres."""
        mine = np.isin(own, atoms[:split])

        def axis(x: FloatArray) -> FloatArray:
            gradient = part.jacobian(x[own], self.time).toarray().reshape(-1, 3)
            return np.asarray(gradient[mine].sum(axis=0))

        return self._shifted(atoms[:split], atoms[split:], axis)

    def _sweep(self, y: FloatArray) -> bool:
        """Let every row that is off make its motion, over and over, in place; whether all rows are fulfilled then."""
        held, time = self.held, self.time
        owns = self._owns()
        last = np.inf
        for _ in range(SWEEPS):
            largest = 0.0
            for own in owns:
                sigma = float(own.part.value(y[own.atoms], time)[0])
                size = abs(sigma) / float(held.scale[own.row])
                if not size > 1e-13:
                    continue
                largest = max(largest, size)
                amount = -sigma if own.across is None else self._opening(y, own.across, -sigma)
                self._left -= 1
                if self._left < 0 or not own.move.make(y, amount):
                    return False
            if largest < 1e-12 or (largest > 0.9 * last and largest < 1e-9):
                break
            last = min(last, largest)
        left = np.abs(held.value(y - self._images, time)) / held.scale
        return bool(np.all(left[held.holonomic] < 1e-8))

    def _opening(self, y: FloatArray, across: tuple[int, int, int], change: float) -> float:
        """By how much the angle i-j-k must grow for the distance i-k to grow by `change`."""
        i, j, k = across
        u, w = y[i] - y[j], y[k] - y[j]
        a, b = float(np.linalg.norm(u)), float(np.linalg.norm(w))
        now = float(np.arctan2(np.linalg.norm(np.cross(u, w)), u @ w))
        goal = float(np.linalg.norm(y[k] - y[i])) + change
        cosine = (a * a + b * b - goal * goal) / (2 * a * b)
        return float(np.arccos(np.clip(cosine, -1.0, 1.0))) - now

    # -- Newton steps ---------------------------------------------------------------------------

    def _motions(self) -> list[Move]:
        """Turns about bonds that some row sees, and motions of whole molecules that rows hold."""
        held, pieces = self.held, self.pieces
        indptr, indices = held.incidence.indptr, held.incidence.indices
        width = np.diff(indptr)
        moves: list[Move] = []
        mark = np.zeros(held.n_atoms, dtype=bool)
        for j, k in pieces.bridges():
            side, rest = pieces.beyond(j, k), pieces.beyond(k, j)
            assert side is not None and rest is not None
            options = [(atoms, a, b) for atoms, a, b in ((side, j, k), (rest, k, j)) if not self.pinned[atoms].any()]
            if not options or min(len(side), len(rest)) < 2:
                continue
            atoms, a, b = min(options, key=lambda option: float(held.masses[option[0]].sum()))
            mark[:] = False
            mark[atoms] = True
            mark[b] = False
            inside = np.add.reduceat(mark[indices].astype(np.int64), indptr[:-1]) if len(indices) else np.zeros(0)
            if np.any((inside > 0) & (inside < width)):
                moves.append(torsion(atoms, a, b))
        for molecule in pieces.molecules:
            moves += free_motions(molecule, molecule[self.pinned[molecule]])
        return moves + [own.move for own in self._owns()]

    def _newton(self, y: FloatArray) -> None:
        """Damped Newton steps in the parameters of all motions, from the present place and from turned ones."""
        held = self.held
        if held.n_rows > MOST_ROWS:
            return
        moves = self._motions()
        if not moves or len(moves) > MOST_MOTIONS:
            return
        masses = held.masses[self.pieces.atoms]
        usual = float(np.median(masses[masses > 0])) if np.any(masses > 0) else 1.0
        heavy = np.clip(held.masses / usual, 1e-3, 1e3)
        begin, best = y.copy(), (self._error(y), y.copy())
        rng = np.random.default_rng(0)
        for kick in range(KICKS + 1):
            here = begin.copy()
            if kick:
                for move in moves:
                    if move.turns:
                        move.make(here, float(rng.uniform(-0.3, 0.3)) * kick)
            error = self._descend(here, moves, heavy)
            if error < best[0]:
                best = error, here
            if best[0] < 1e-12 or self._left < 0:
                break
        y[:] = best[1]

    def _error(self, y: FloatArray) -> float:
        value = self.held.value(y - self._images, self.time) / self.held.scale
        return float(value @ value) if np.isfinite(value).all() else np.inf

    def _descend(self, y: FloatArray, moves: list[Move], heavy: FloatArray) -> float:
        """Levenberg-Marquardt steps in place; the sum of squares of the misfits where they end."""
        held, time, atoms = self.held, self.time, self.pieces.atoms
        place = np.full(held.n_atoms, -1)
        place[atoms] = np.arange(len(atoms))
        columns = (3 * atoms[:, None] + np.arange(3)).ravel()
        rows = np.flatnonzero(held.holonomic)
        error, damping = self._error(y), 1e-4
        for _ in range(STEPS):
            self._left -= len(moves)
            if error < 1e-24 or not np.isfinite(error) or self._left < 0:
                break
            x = y - self._images
            sigma = (held.value(x, time) / held.scale)[rows]
            fields = np.zeros((len(atoms), 3, len(moves)))
            size = np.empty(len(moves))
            for n, move in enumerate(moves):
                field = move.field(y)
                fields[place[move.atoms], :, n] = field
                size[n] = np.sqrt(np.sum(heavy[move.atoms, None] * field**2))
            weight = np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)
            jacobian = sp.csr_array(held.jacobian(x, time))[rows][:, columns]
            slope = (jacobian @ fields.reshape(-1, len(moves))) * weight / held.scale[rows, None]
            gram = slope @ slope.T
            trace = float(np.trace(gram))
            if not np.isfinite(trace) or trace == 0:
                break
            for _ in range(8):
                step = np.linalg.solve(gram + (damping * trace / len(rows) + 1e-300) * np.eye(len(rows)), sigma)
                amounts = -weight * (slope.T @ step)
                longest = max((abs(a) for a, move in zip(amounts, moves, strict=True) if move.turns), default=0.0)
                if longest > _LONGEST_TURN:
                    amounts *= _LONGEST_TURN / longest
                trial = y.copy()
                self._left -= len(moves)
                for amount, move in zip(amounts, moves, strict=True):
                    if amount:
                        move.make(trial, float(amount))
                new = self._error(trial)
                if new < error:
                    break
                damping *= 8
            else:
                break
            slow = new > 0.999 * error
            y[:], error, damping = trial, new, max(damping / 10, 1e-12)
            if slow and error > 1e-20:
                break
        return error


def _turn_of_line(a: FloatArray, b: FloatArray) -> FloatArray:
    """The least turn, as a matrix for rows from the left, that takes the line of one or two points to another."""
    u, w = a[0], b[0]
    lu, lw = float(np.linalg.norm(u)), float(np.linalg.norm(w))
    if lu == 0 or lw == 0:
        return np.eye(3)
    u, w = u / lu, w / lw
    axis, cosine = np.cross(u, w), float(u @ w)
    if cosine < -1 + 1e-12:
        axis = np.cross(u, np.eye(3)[int(np.argmin(np.abs(u)))])
        axis /= np.linalg.norm(axis)
        return 2 * np.outer(axis, axis) - np.eye(3)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return (np.eye(3) + cross + cross @ cross / (1 + cosine)).T


def _closest(x: FloatArray, chosen: BoolArray) -> float:
    """The least distance of some atoms to their nearest neighbours."""
    from scipy.spatial import cKDTree

    if len(x) < 2:
        return np.inf
    good = np.isfinite(x).all(axis=1)
    asked = x[np.logical_and(chosen, good)]
    return float(cKDTree(x[good]).query(asked, k=2)[0][:, 1].min(initial=np.inf))
