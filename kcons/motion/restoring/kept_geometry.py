"""Bond lengths and angles of a structure, and whether they are still what they were."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from kcons.constraints import Distance, DistanceDifference
from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.periodic.one_piece import connected, make_whole, minimum_image, neighbor_lists, spanning_tree
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import cross
from kcons.errors import InfeasibleError
from kcons.plan.clusters import edge_blocks, fixed_rows
from kcons.solvers.rank_revealing import independent
from kcons.topology.topology import NEAREST, BoolArray, across, bond_angles, bonds_without_elements, sorted_pairs

#: Other bonds may change by this part of their length (0.02 angstrom for C-C), other angles by this much in radian.
BOND_KEPT, ANGLE_KEPT = 0.0125, np.radians(2.0)
#: Displacements below this part of the distance to the nearest neighbor leave bonds and angles as they are.
STILL = 3e-3
#: Rows off by more than this (radian, or part of the length) are far.
FAR = 0.25
#: Rows off by no more than this are fulfilled as far as motions are concerned.
OFF = 1e-9
#: Rows that hold what bonds and angles are made of.
_INTERNAL = ("Distance", "DistanceDifference", "Angle", "Dihedral", "CenterDistance")
#: Gives the bonds of a system, shape (n, 2).
Bonds = Callable[[], IntArray]
#: Bonds and angles that are examined for being held by the rows, and rows of a cluster up to which they are.
_MOST_EXAMINED, _MOST_ROWS = 200, 600


def bonds_of(held: ConstraintSet, x: FloatArray, time: float, given: IntArray | None) -> IntArray:
    """What counts as a bond, shape (n, 2).

    Those that are given and the distances that rows hold, unless they are longer than atoms in one molecule are bonded
    (the third side of a rigid triangle, the ends of a chain). Without given ones, also what the distances suggest
    between atoms that held distances do not join.
    """
    tables = [item.atoms for item in held.constraints if item.holds_length]
    rows = np.sort(np.concatenate([*tables, np.zeros((0, 2), np.int64)]), axis=1)
    targets = [item.target_at(time) for item in held.constraints if item.holds_length]
    sure = given
    if sure is None:
        sure = bonds_without_elements(x, held.lattice, held.touched, held.masses > 0)
        fragment, _ = connected(rows, held.n_atoms)
        sure = sure[fragment[sure[:, 0]] != fragment[sure[:, 1]]]
    pairs, first = np.unique(np.concatenate([np.sort(sure, axis=1), rows]), axis=0, return_index=True)
    length = np.linalg.norm(minimum_image(x[pairs[:, 0]] - x[pairs[:, 1]], held.lattice), axis=1)
    # What is to become longer was a bond, and what is to become shorter will be one.
    order = {tuple(pair): n for n, pair in enumerate(pairs.tolist())}
    place = np.array([order[tuple(pair)] for pair in rows.tolist()], dtype=np.int64)
    np.minimum.at(length, place, np.concatenate([*targets, np.zeros(0)]))
    kept = ~across(pairs, length)
    shortest = np.full(held.n_atoms, np.inf)
    for side in (0, 1):
        np.minimum.at(shortest, pairs[kept, side], length[kept])
    kept &= (first < len(sure)) | (length < NEAREST * np.sqrt(shortest[pairs[:, 0]] * shortest[pairs[:, 1]]))
    return pairs[kept]


class MoleculeGraph:
    """The bonds of the molecules to which some atoms belong, and what is left where one of them is cut.

    Parameters
    ----------
    n_atoms : int
    bonds : ndarray of int, shape (n, 2)
    atoms : ndarray of int
        Molecules with none of these are left out.

    Attributes
    ----------
    bonds : ndarray of int, shape (n, 2)
        Those of the molecules that are kept; i < j, sorted.
    atoms : ndarray of int
        All atoms of these molecules, molecule by molecule; what lies beyond a bond stands together.
    molecules : list of ndarray of int
    """

    def __init__(self, n_atoms: int, bonds: IntArray, atoms: IntArray) -> None:
        pairs = sorted_pairs(bonds)
        label, _ = connected(pairs, n_atoms)
        chosen = np.zeros(n_atoms, dtype=bool)
        chosen[atoms] = True
        kept = np.zeros(n_atoms, dtype=bool)
        kept[np.isin(label, label[atoms])] = True
        self.bonds = pairs[kept[pairs].all(axis=1)] if len(pairs) else pairs
        self._starts, self._ends = neighbor_lists(self.bonds, n_atoms)
        order, parents = spanning_tree(self.bonds, n_atoms)
        self._lay_out(order[kept[order]], parents[kept[order]], n_atoms)

    def neighbors(self, atom: int) -> IntArray:
        """Atoms bonded to one."""
        return self._ends[self._starts[atom] : self._starts[atom + 1]]

    def _lay_out(self, order: IntArray, parents: IntArray, n_atoms: int) -> None:
        """Put what hangs from an atom behind it, and find the bridges: bonds that are blocks of their own."""
        parent, size = np.arange(n_atoms), np.ones(n_atoms, dtype=np.int64)
        parent[order] = parents
        tree = list(zip(order.tolist(), parents.tolist(), strict=True))
        for atom, above in reversed(tree):
            if atom != above:
                size[above] += size[atom]
        begin, free, used = np.zeros(n_atoms, dtype=np.int64), np.zeros(n_atoms, dtype=np.int64), 0
        for atom, above in tree:
            if atom == above:
                begin[atom], used = used, used + size[atom]
            else:
                begin[atom] = free[above]
                free[above] += size[atom]
            free[atom] = begin[atom] + 1
        self.atoms = order[np.argsort(begin[order])]
        self._parent, self._begin, self._end = parent, begin, begin + size
        self.molecules = [self._hanging(root) for root in self.atoms.tolist() if parent[root] == root]
        i, j = self.bonds.T
        block = edge_blocks(i, j, n_atoms) if len(self.bonds) else i
        self._bridge = np.zeros(n_atoms, dtype=bool)  # by the far atom of each
        self._bridge[np.where(parent[j] == i, j, i)[np.bincount(block)[block] == 1]] = True

    def _hanging(self, atom: int) -> IntArray:
        """An atom and all that hang from it."""
        return self.atoms[self._begin[atom] : self._end[atom]]

    def molecule(self, atom: int) -> IntArray:
        """All atoms of the molecule of one of `atoms`."""
        while self._parent[atom] != atom:
            atom = int(self._parent[atom])
        return self._hanging(atom)

    def bonded(self, j: int, k: int) -> bool:
        """Whether two atoms are."""
        return bool(np.any(self.neighbors(j) == k))

    def beyond(self, j: int, k: int) -> IntArray | None:
        """Atoms on the side of k when the bond j-k is cut; None if there is no bond, or one in a ring."""
        if self._parent[k] == j and self._bridge[k]:
            return self._hanging(k)
        if self._parent[j] == k and self._bridge[j]:
            return np.setdiff1d(self.molecule(j), self._hanging(j), assume_unique=True)
        return None

    def whole(self, x: FloatArray, lattice: FloatArray | None) -> FloatArray:
        """Positions with every molecule in one piece: each atom in the image next to the one it was reached from."""
        return make_whole(x, self.atoms, self._parent[self.atoms], lattice)


class Geometry:
    """The start of a restoration: its bonds and angles, how far its rows are off, and what may not change.

    Parameters
    ----------
    held : ConstraintSet
    labels : ndarray of int, shape (n_rows,)
        Cluster of each row, -1 where it has none.
    start : ndarray, shape (n_atoms, 3)
    time : float
    bonds : callable or None
        Gives pairs of atoms, shape (n, 2); asked only where they are needed. See `bonds_of`.

    Attributes
    ----------
    misfit : ndarray, shape (n_rows,)
        |sigma| at the start, in units of the scale of each row.
    usable : bool
        Whether the atoms that rows touch have finite positions.
    pinned : ndarray of bool, shape (n_atoms,)
        Fixed atoms.
    """

    def __init__(
        self, held: ConstraintSet, labels: IntArray, start: FloatArray, time: float, bonds: Bonds | None
    ) -> None:
        self.held, self.labels, self.start, self.time, self._bonds = held, labels, start, time, bonds
        # Particles without mass are sites or walls: whoever places them does so, not a bond.
        self.pinned = np.equal(held.masses, 0.0)
        self.pinned[fixed_rows(held)[0]] = True
        with np.errstate(all="ignore"):
            self.misfit = np.abs(held.value(start, time)) / held.scale
        self.usable = bool(np.isfinite(start[held.touched]).all())
        self._spans: dict[tuple[int, ...], tuple[IntArray, FloatArray]] = {}

    @cached_property
    def _given(self) -> IntArray | None:
        return None if self._bonds is None else self._bonds()

    @property
    def free(self) -> bool:
        """Whether no bonds are given, and that was said: the nearest point is wanted, whatever else changes."""
        return self._given is not None and not len(self._given)

    @cached_property
    def pieces(self) -> MoleculeGraph:
        bonds = bonds_of(self.held, self.start, self.time, self._given)
        return MoleculeGraph(self.held.n_atoms, bonds, self.held.touched)

    def far(self) -> bool:
        """Whether a row of lengths or angles is far off."""
        return self.usable and any(
            bool(np.any(miss > FAR)) for item, _, miss in self.off_rows() if item.translation_invariant
        )

    def off_rows(self) -> list[tuple[Constraint, int, FloatArray]]:
        """Constraints on positions, their first rows, and by how much their rows are off."""
        held = self.held
        return [
            (item, int(first), self.misfit[first : first + item.n_rows])
            for item, first in zip(held.constraints, held.starts, strict=False)
            if item.holonomic
        ]

    @cached_property
    def turned(self) -> bool:
        """Whether bonds are given, or something else than bonds is off: then all angles are to be what they were."""
        if self._given is not None:
            return True
        for item, _, miss in self.off_rows():
            off = item.atoms[miss > OFF]
            if item.family in ("Angle", "Dihedral", "CenterDistance") and len(off):
                return True
            if item.holds_length and not all(self.pieces.bonded(i, k) for i, k in off.tolist()):
                return True
        return False

    @cached_property
    def checked(self) -> bool:
        """Whether bonds and angles are to be as they were.

        Those that are not given only where the start is a structure: no rows but those of lengths and angles are off,
        and of several distances that are held not most are far off.
        """
        if self._given is not None:
            return not self.free
        lengths = self._held_lengths[1]
        if len(lengths) > 1 and np.sum(lengths > FAR) > 0.5 * len(lengths):
            return False
        return all(item.family in _INTERNAL or not np.any(miss > OFF) for item, _, miss in self.off_rows())

    def changed(self, x: FloatArray, *, strict: bool) -> InfeasibleError | None:
        """What to raise if a bond or an angle that no row holds has changed.

        Unless `strict`, angles between bonds that rows hold may change as much as the bonds around them were off.
        """
        held, start = self.held, self.start
        self._spans.clear()
        move = np.linalg.norm(x - start, axis=1)
        if not np.any(move > 0) or not np.isfinite(start[move > 0]).all():
            return None
        if float(move.max()) <= STILL * _closest(start, move > 0) or not self.checked:
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
            loose = not strict and (min(i, j), max(i, j)) in table and (min(j, k), max(j, k)) in table
            noise = 2.0 * float(np.sum(around[[i, j, k]])) if loose else 0.0
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
            "nearer to the target, check the bonds, or hold what may change; Constraints(rows).restore(atoms, "
            "bonds=[]) in ASE, restore_positions(..., bonds=[]) of a Motion look at nothing but the rows",
            residual=float(self.misfit[row]),
            row=row,
            atoms=held.row_atoms(row),
        )

    def ties(self) -> tuple[ConstraintSet, FloatArray]:
        """Lengths of bonds and distances across angles as at the start, and weights in which 1 is what may change."""
        bonds, angles = self.pieces.bonds, bond_angles(self.pieces.bonds, self.held.n_atoms)
        legs = self._moved_legs
        kept = [not {(j, i), (j, k)} & legs for i, j, k in angles.tolist()]
        ends = sorted_pairs(angles[np.array(kept, dtype=bool)][:, [0, 2]])
        lengths, across = self._lengths(self.start, bonds), self._lengths(self.start, ends)
        held = {tuple(pair) for pair in self._held_lengths[0].tolist()}
        weights = np.concatenate([1.0 / (BOND_KEPT * lengths), 1.0 / (ANGLE_KEPT * across)])
        weights[[tuple(pair) in held for pair in [*bonds.tolist(), *ends.tolist()]]] = 0.0
        rows = [Distance(bonds, lengths), Distance(ends, across)]
        return self.held.replaced(rows, self.start, self.time), weights

    def placed(self) -> FloatArray:
        """The start with fixed atoms in their places; a new array."""
        x = self.start.copy()
        atoms, rows = fixed_rows(self.held)
        x[atoms] = self.held.target(self.time)[rows].reshape(-1, 3)
        return x

    @cached_property
    def _held_lengths(self) -> tuple[IntArray, FloatArray]:
        """Pairs whose distance a row holds, alone or with others, i < j, and by which part of it they were off."""
        pairs, miss = [np.zeros((0, 2), np.int64)], [np.zeros(0)]
        for item, _, off in self.off_rows():
            if isinstance(item, Distance | DistanceDifference):
                named = item.pairs
                pairs.append(np.sort(named.reshape(-1, 2), axis=1))
                miss.append(np.repeat(off, named.shape[1]))
        return np.concatenate(pairs), np.concatenate(miss)

    @cached_property
    def _moved_legs(self) -> set[tuple[int, int]]:
        """(vertex, end) of the legs of what was off and turns them: other angles with such a leg change with them."""
        legs: set[tuple[int, int]] = set()
        for item, _, miss in self.off_rows():
            off = np.flatnonzero(miss > 1e-6)
            if item.family == "Angle":
                for i, j, k in item.atoms[off].tolist():
                    legs |= {(j, i), (j, k)}
            elif isinstance(item, DistanceDifference):  # an atom that goes from one neighbor to another
                legs |= {leg for i, k in item.pairs[off].reshape(-1, 2).tolist() for leg in ((i, k), (k, i))}
            elif item.holds_length:
                for i, k in item.atoms[off].tolist():
                    for j in self.between(i, k):
                        legs |= {(j, i), (j, k)}
        return legs

    def between(self, i: int, k: int) -> list[int]:
        """Atoms bonded to both of two that are not bonded to each other."""
        if self.pieces.bonded(i, k):
            return []
        return np.intersect1d(self.pieces.neighbors(i), self.pieces.neighbors(k)).tolist()

    def _lengths(self, x: FloatArray, pairs: IntArray) -> FloatArray:
        return np.linalg.norm(minimum_image(x[pairs[:, 1]] - x[pairs[:, 0]], self.held.lattice), axis=1)

    def _angles(self, x: FloatArray, triples: IntArray) -> FloatArray:
        u = minimum_image(x[triples[:, 0]] - x[triples[:, 1]], self.held.lattice)
        w = minimum_image(x[triples[:, 2]] - x[triples[:, 1]], self.held.lattice)
        return np.arctan2(np.linalg.norm(cross(u, w), axis=1), np.einsum("ni,ni->n", u, w))

    def _follows(self, x: FloatArray, atoms: IntArray) -> bool:
        """Whether the rows hold a bond or an angle: its gradient lies in the span of theirs."""
        u, w = (minimum_image(x[a] - x[atoms[1]], self.held.lattice) for a in atoms[[0, -1]])
        ends = [u]
        if len(atoms) == 3:
            # That of the cosine: the angle's own is undefined where it is straight.
            lu, lw = np.linalg.norm(u), np.linalg.norm(w)
            cosine = u @ w / (lu * lw)
            ends = [(w / lw - cosine * u / lu) / lu, (u / lu - cosine * w / lw) / lw]
        gradient = np.zeros(x.shape)
        for atom, end in zip(atoms[::2], ends, strict=True):
            gradient[atom] += end
            gradient[atoms[1]] -= end
        columns, basis = self._span(x, atoms)
        square, along = float(np.vdot(gradient, gradient)), basis @ gradient.ravel()[columns]
        return square > 0 and bool(square - along @ along < 1e-12 * square)

    def _span(self, x: FloatArray, atoms: IntArray) -> tuple[IntArray, FloatArray]:
        """The columns and an orthonormal basis of the gradients of the rows around some atoms."""
        incidence, labels = self.held.incidence, self.labels
        touching = np.unique(incidence.T.tocsr()[atoms].indices)
        clusters = np.unique(labels[touching])
        key = tuple(clusters.tolist())
        if key not in self._spans:
            rows = np.union1d(touching[labels[touching] < 0], np.flatnonzero(np.isin(labels, clusters[clusters >= 0])))
            table = sp.csr_array(self.held.jacobian(x, self.time))[rows]
            columns = np.unique(table.indices)
            basis = np.zeros((0, len(columns)))
            if 0 < len(rows) <= _MOST_ROWS:
                dense = table[:, columns].toarray()
                size = np.linalg.norm(dense, axis=1, keepdims=True)
                _, weight, basis = np.linalg.svd(dense / np.where(size > 0, size, 1.0), full_matrices=False)
                basis = basis[independent(weight)]
            self._spans[key] = columns, basis
        return self._spans[key]


def _closest(x: FloatArray, chosen: BoolArray) -> float:
    """The least distance of some atoms to their nearest neighbors."""
    from scipy.spatial import cKDTree

    if len(x) < 2:
        return np.inf
    good = np.isfinite(x).all(axis=1)
    asked = x[np.logical_and(chosen, good)]
    return float(cKDTree(x[good]).query(asked, k=2)[0][:, 1].min(initial=np.inf))
