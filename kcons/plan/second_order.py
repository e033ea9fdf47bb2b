"""Rows that are singular only at second order: found at set-up, converted to linear rows or refused.

Rows may depend on each other in two ways. Methane by all ten distances has nine independent gradients on
the whole surface: any nine rows hold what ten hold, and a pseudo-inverse deals with it. CO2 by three
distances has two independent gradients where it is straight, yet cannot bend, because a bend by e changes
a distance by e^2: no iteration converges there, and no first-order theory holds.

The difference is the solvability condition A A+ b = b (notes eq. 95): at a singular point of the second
kind there are admissible velocities, A v = 0, for which no acceleration exists. With omega^T A = 0 this
reads omega . (v^T d2sigma/dx2 v) = 0, which is tested here for random v.

A group of atoms held rigid by such rows is collinear or planar, or has a part that is, and what the rows mean is
linear: x_a = sum_i c_i x_i over two bases on a line, three in a plane, four in space, with one, three or six
distances between the bases. These rows are regular and hold all distances in the group.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import scipy.sparse as sp

from kcons.constraints.constraint import Constraint, IntArray, RowKind
from kcons.constraints.constraint_set import ConstraintSet, whole_bodies
from kcons.constraints.internal import Distance
from kcons.constraints.periodic.one_piece import BoolArray
from kcons.constraints.surface import LinearRelation
from kcons.constraints.target import FloatArray, MovingTarget
from kcons.constraints.vectors import extent, row_norms
from kcons.errors import SingularGeometryError
from kcons.plan.clusters import fixed_atoms, row_blocks
from kcons.solvers.tolerances import LOST

#: Larger blocks are first reduced to their internal coordinates, then to their distances, and what is
#: still larger is tested by sparse inertia counts.
DENSE_LIMIT = 900
DENSE_ENTRIES = 4_000_000
#: Triangles whose targets are as flat as this are linear groups wherever their atoms are at the start.
_FLAT_TARGETS = 1e-12
#: Blocks of one shape that start off their targets are analyzed where they belong, until this many in a
#: row turn out regular.
_REGULAR_SAMPLES = 100
_LEVELS: tuple[Callable[[Constraint], bool], ...] = (
    lambda item: True,
    lambda item: item.translation_invariant and (item.reversible or item.kind is RowKind.LINEAR),
    lambda item: item.holds_length,
)
#: Directions that a step of Gauss-Newton leaves out. Towards a flat geometry singular values go with the square root of
#: the residual, to 1e-7, and have to count.
STEP_CUT = 1e-9
#: Size of the displacements that break special geometries, relative to the shortest row.
DISPLACEMENT = 1e-2
#: Part of the curvature outside the range of A that is more than rounding (or than the differences of a
#: user's gradient).
UNSOLVABLE = 1e-4
#: Extent across a line or plane, relative to the extent along it, that still counts as flat.
FLAT = 1e-6
#: Relative misfit between the targets and a flat geometry above which the conversion is refused.
MISFIT = 1e-6
#: Bases are exchanged where the volume that they span grows by more than this part.
LARGER = 1e-3
#: Of rigid groups of one, two and three dimensions: where they lie, what they are, their degrees of freedom, and what
#: holds them.
_GROUPS = (
    ("on a line", "linear", "collinear", 5, "one distance and x_b = c x_a + (1-c) x_c (LinearRelation)"),
    ("in a plane", "planar", "coplanar", 6, "three distances and x_a = c_i x_i + c_j x_j + c_k x_k (LinearRelation)"),
    ("in space", "rigid", "in part coplanar", 6, "six distances and x_a = sum of four c_i x_i (LinearRelation)"),
)


def without_second_order_rows(constraint_set: ConstraintSet, positions: FloatArray, time: float) -> ConstraintSet:
    """The same set with second-order-singular rows replaced by linear ones; the given object itself if it is regular.

    Raises
    ------
    SingularGeometryError
        Rows that cannot be converted; the message says what to hold instead.
    """
    bodies: list[FlatBody] = []
    miss: FloatArray | None = None
    for stack in _stacks(constraint_set, positions, time):
        miss = np.abs(constraint_set.value(positions, time) / constraint_set.scale) if miss is None else miss
        suspects = stack.suspects(positions)
        straight, done = stack.straight_triangles(suspects)
        bodies += straight
        for rows in stack.rows[suspects & ~done]:
            bodies += find_flat_bodies(LocalRows(constraint_set, rows, positions, time))
        regular = 0
        for rows in stack.rows[stack.off_target(positions, miss) & ~suspects]:
            block = LocalRows(constraint_set, rows, positions, time).restored()
            regular += 1
            if block.singular(block.x):
                bodies += find_flat_bodies(block)
                regular = 0
            if regular >= _REGULAR_SAMPLES:
                break
    return with_flat_bodies(constraint_set, bodies, positions, time) if bodies else constraint_set


@dataclass
class Blocks:
    """Blocks of one shape of a set, at a time.

    Attributes
    ----------
    rows : ndarray of int, shape (n_blocks, n_rows)
    atoms : ndarray of int, shape (n_blocks, n_atoms)
    pinned : ndarray of int
        Fixed atoms of the set.
    """

    held: ConstraintSet
    time: float
    rows: IntArray
    atoms: IntArray
    pinned: IntArray

    def chosen(self, which: IntArray | BoolArray) -> Blocks:
        return replace(self, rows=self.rows[which], atoms=self.atoms[which])

    def suspects(self, x: FloatArray) -> BoolArray:
        """Blocks that are singular at second order at `x`, shape (n_blocks,)."""
        unit, _, curvature = self.dense(x)
        doubtful: BoolArray = np.asarray(np.isfinite(unit).all(axis=(1, 2)))
        if unit.shape[1] <= unit.shape[2]:  # dependent rows
            squares = np.linalg.eigvalsh(unit[doubtful] @ unit[doubtful].transpose(0, 2, 1))
            doubtful[doubtful] = squares[:, 0] <= LOST**2 * squares[:, -1]
        if doubtful.any() and not doubtful.all():
            doubtful[doubtful] = self.chosen(doubtful).suspects(x)
        elif doubtful.any():
            size = np.ptp(x[self.atoms], axis=1).max(axis=1)
            doubtful = _unsolvable(unit, curvature, np.where(size > 0, size, 1.0))
        return doubtful

    def dense(self, x: FloatArray) -> tuple[FloatArray, FloatArray, Callable[[FloatArray], FloatArray]]:
        """Row-normalized A of each block, fixed atoms' columns zero, its norms, and the curvatures of the same rows."""
        n_blocks, n_rows = self.rows.shape
        n_atoms = self.atoms.shape[1]
        a = np.zeros((n_blocks, n_rows, n_atoms, 3))
        pieces: list[tuple[Constraint, FloatArray, IntArray, IntArray, IntArray]] = []
        for item, start in zip(self.held.constraints, self.held.starts, strict=False):
            block, row = np.nonzero((self.rows >= start) & (self.rows < start + item.n_rows))
            if len(block) == 0:
                continue
            part = item.select(self.rows[block, row] - start)
            slots = np.argmax(self.atoms[block][:, None, :] == part.atoms[:, :, None], axis=2)
            r = self.held.gather(part, x)
            with np.errstate(divide="ignore", invalid="ignore"):
                a[block[:, None], row[:, None], slots] = part.gradient(r, self.time)
            pieces.append((part, r, block, row, slots))
        free = ~np.isin(self.atoms, self.pinned)
        a *= free[:, None, :, None]
        unit = a.reshape(n_blocks, n_rows, -1)
        norms = np.linalg.norm(unit, axis=2)
        norms = np.where(norms > 0, norms, 1.0)

        def curvature(v: FloatArray) -> FloatArray:
            field = v.reshape(n_blocks, n_atoms, 3) * free[:, :, None]
            bent = np.zeros((n_blocks, n_rows))
            for part, r, block, row, slots in pieces:
                bent[block, row] = part.curvature(r, field[block[:, None], slots], self.time)
            return bent / norms

        return unit / norms[:, :, None], norms, curvature

    def straight_triangles(self, suspects: BoolArray) -> tuple[list[FlatBody], BoolArray]:
        """Collinear triatomics held by three distances, all at once, and which blocks they are."""
        done = np.zeros(len(self.rows), bool)
        lengths = [np.full(c.n_rows, c.holds_length and not c.moving) for c in self.held.constraints]
        plain = np.concatenate(lengths)[self.rows].all(axis=1) & ~np.isin(self.atoms, self.pinned).any(axis=1)
        if self.rows.shape[1] != 3 or self.atoms.shape[1] != 3 or not plain.any():
            return [], done
        length = self.held.target(self.time)[self.rows]
        order = np.argsort(length, axis=1)
        length = np.take_along_axis(length, order, axis=1)
        rows = np.take_along_axis(self.rows, order, axis=1)
        excess = np.abs(length[:, 0] + length[:, 1] - length[:, 2])
        done = plain & (excess <= length[:, 2] * np.where(suspects, MISFIT, _FLAT_TARGETS))
        found = np.flatnonzero(done)
        ends, side = (self.held.incidence[rows[found, k]].indices.reshape(-1, 2).astype(np.int64) for k in (2, 0))
        nearer = np.where((ends[:, :1] == side).any(axis=1), 0, 1)
        c = length[found, nearer] / (length[found, 0] + length[found, 1])
        middle = self.atoms[found].sum(axis=1) - ends.sum(axis=1)
        bodies = [
            FlatBody(self.atoms[k], self.rows[k], pair, pair[None], length[k, 2:], m[None], np.array([[1.0 - w, w]]))
            for k, pair, m, w in zip(found, ends, middle, c, strict=True)
        ]
        return bodies, done

    def off_target(self, x: FloatArray, miss: FloatArray) -> BoolArray:
        """Blocks so far from their targets, by what rows miss, that their geometry says nothing about the surface."""
        result = np.zeros(len(self.rows), bool)
        if self.rows.shape[1] <= 3:
            return result
        miss = miss[self.rows].max(axis=1)
        far = np.flatnonzero(miss > 1e-10)
        if len(far):
            unit = self.chosen(far).dense(x)[0]
            if unit.shape[1] <= unit.shape[2]:
                # At a distance s from a flat geometry the smallest singular value is s, and the rows are off by s^2.
                smallest = np.linalg.svd(unit, compute_uv=False)[:, -1]
                far = far[miss[far] > 0.1 * smallest**2]
            result[far] = True
        return result


def _stacks(constraint_set: ConstraintSet, positions: FloatArray, time: float) -> Iterator[Blocks]:
    """All blocks small enough for dense algebra, by shape; refuses larger ones whose rank is higher nearby."""
    rows: IntArray | None = None
    pinned = fixed_atoms(constraint_set)
    for accept in _LEVELS:
        members, starts = row_blocks(constraint_set, accept, rows)
        sizes = np.diff(starts)
        if len(sizes) == 0:
            return
        label = np.repeat(np.arange(len(sizes)), sizes)
        incidence = constraint_set.incidence[members]
        touched = np.repeat(label, np.diff(incidence.indptr)) * constraint_set.n_atoms + incidence.indices
        label_of_atom, atoms = np.divmod(np.unique(touched), constraint_set.n_atoms)
        widths = np.bincount(label_of_atom, minlength=len(sizes))
        first_atom = np.concatenate([[0], np.cumsum(widths)])
        large = (np.minimum(sizes, 3 * widths) > DENSE_LIMIT) | (sizes * 3 * widths > DENSE_ENTRIES)
        shapes = np.stack([sizes, widths], axis=1)
        for n_rows, n_atoms in np.unique(shapes[~large], axis=0):
            same = np.flatnonzero((sizes == n_rows) & (widths == n_atoms))
            chunk = max(1, DENSE_ENTRIES // int(n_rows * 3 * n_atoms))
            for lo in range(0, len(same), chunk):
                some = same[lo : lo + chunk, None]
                of_some = members[starts[some] + np.arange(n_rows)], atoms[first_atom[some] + np.arange(n_atoms)]
                yield Blocks(constraint_set, time, *of_some, pinned)
        rows = np.sort(members[large[label]])
        if len(rows) == 0:
            return
    for k in np.flatnonzero(large).tolist():
        block = LocalRows(constraint_set, members[starts[k] : starts[k + 1]], positions, time)
        here, nearby = (_sparse_rank(block, x) for x in (block.x, block.nearby(np.random.default_rng(20090131))))
        if here < nearby:
            raise _unresolved(block, here, nearby)


def _sparse_rank(block: LocalRows, x: FloatArray) -> int:
    """Eigenvalues of A A^T above LOST^2, counted by Sylvester's law of inertia."""
    a = block.part.jacobian(x, block.time)
    a.data *= ~np.repeat(block.pinned, 3)[a.indices]
    norms = row_norms(a)
    a.data *= np.repeat(1.0 / np.where(norms > 0, norms, 1.0), np.diff(a.indptr))
    shifted = (a @ a.T - LOST**2 * sp.eye_array(block.part.n_rows)).tocsc()
    from scipy.sparse.linalg import splu  # slow to import, seldom needed

    factor = splu(shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return int(np.sum(factor.U.diagonal() > 0))


# -- one block ----------------------------------------------------------------------------------------------


def _unsolvable(unit: FloatArray, curvature: Callable[[FloatArray], FloatArray], extent: FloatArray) -> BoolArray:
    """Whether A a = -v^T (d2sigma/dx2) v has no solution for some v with A v = 0 (notes eqs. 92, 95), of each block."""
    u, s, vt = np.linalg.svd(unit, full_matrices=True)
    cut = LOST * s[:, :1]
    lost = np.ones(unit.shape[:2], bool)
    lost[:, : s.shape[1]] = s <= cut
    free = np.ones((len(unit), unit.shape[2]), bool)
    free[:, : s.shape[1]] = s <= cut
    rng = np.random.default_rng(20060921)
    result = np.zeros(len(unit), bool)
    for _ in range(3):
        v = np.einsum("bk,bkn->bn", np.where(free, rng.standard_normal(free.shape), 0.0), vt)
        b = curvature(v)
        outside = np.where(lost, np.einsum("brk,br->bk", u, b), 0.0)
        # Rigid translations have no curvature but rounding.
        size = np.linalg.norm(b, axis=1) + 1e-9 * np.einsum("bn,bn->b", v, v) / extent
        result |= np.linalg.norm(outside, axis=1) > UNSOLVABLE * size
    return result


class LocalRows:
    """One block of rows (sorted) on its own atoms; `pinned` are the fixed ones, by default those of the set."""

    def __init__(
        self,
        constraint_set: ConstraintSet,
        rows: IntArray,
        positions: FloatArray,
        time: float,
        pinned: BoolArray | None = None,
    ) -> None:
        self.rows, self.time, self.set = rows, time, constraint_set
        self.part, self.atoms = constraint_set.subset(rows)
        self.x = positions[self.atoms]
        self.pinned: BoolArray = np.isin(self.atoms, fixed_atoms(constraint_set)) if pinned is None else pinned
        every = np.arange(self.part.n_rows)[None], np.arange(len(self.atoms))[None]
        self.alone = Blocks(self.part, time, *every, np.flatnonzero(self.pinned))

    def inside(self, atoms: IntArray) -> IntArray:
        """Rows (block numbering) that a rigid group of `atoms` (block numbering) makes superfluous."""
        rows = [np.isin(item.atoms, atoms).all(axis=1) & item.reversible for item in self.part.constraints]
        return np.flatnonzero(np.concatenate(rows))

    def linear(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Row-normalized A without the columns of fixed atoms, and its norms."""
        unit, norms, _ = self.alone.dense(x)
        return unit[0], norms[0]

    def decomposed(self, x: FloatArray, rows: IntArray | slice = slice(None)) -> tuple[FloatArray, int]:
        """v^T of these rows (all by default), with all singular vectors, and how many are above `LOST`."""
        _, s, vt = np.linalg.svd(self.linear(x)[0][rows], full_matrices=True)
        return vt, int(np.sum(s > LOST * s[0]))

    def singular(self, x: FloatArray, rows: IntArray | None = None) -> bool:
        """Whether these rows (all by default) are singular at second order at `x`."""
        some = self.alone if rows is None else replace(self.alone, rows=rows[None])
        return some.rows.size > 1 and bool(some.suspects(x)[0])

    def restored(self) -> LocalRows:
        """The same block at positions that fulfil its targets, as nearly as Gauss-Newton gets there."""
        x = self.x.copy()
        held = self.part.holonomic
        for _ in range(60):
            sigma = self.part.value(x, self.time)
            # Towards a flat geometry the singular value is the square root of this, 1e-7: lost by any measure.
            if np.max(np.abs(sigma) / self.part.scale) < 1e-14:
                break
            unit, norms = self.linear(x)
            step = np.linalg.lstsq(unit[held], -(sigma / norms)[held], rcond=STEP_CUT)[0]
            x = x + step.reshape(x.shape)
        other = copy.copy(self)
        other.x = x
        return other

    def nearby(self, rng: np.random.Generator) -> FloatArray:
        """Positions of the movable atoms displaced at random, by less than rows are long."""
        wide = [c for c in self.part.constraints if c.width > 1 and c.n_rows]
        sides = [np.linalg.norm(np.diff(self.part.gather(c, self.x), axis=1), axis=2).min() for c in wide]
        step = DISPLACEMENT * min(sides, default=extent(self.x) or max(float(np.abs(self.x).max()), 1.0))
        return self.x + step * rng.standard_normal(self.x.shape) * ~self.pinned[:, None]

    def rigid_pairs(self) -> tuple[BoolArray, int]:
        """Pairs of atoms that keep their distance at positions nearby, and the rank there."""
        rng, n, best = np.random.default_rng(20090131), len(self.atoms), -1
        for _ in range(3):
            vt, rank = self.decomposed(x := self.nearby(rng))
            if rank > best:
                # A few random motions show every pair that can move.
                motions = (rng.standard_normal((8, len(vt) - rank)) @ vt[rank:]).reshape(8, n, 3)
                motions[:, self.pinned] = 0.0
                apart = self.unwrapped(x)
                apart = apart[:, None] - apart[None, :]
                apart /= (np.linalg.norm(apart, axis=2) + np.eye(n))[:, :, None]
                rates = np.abs(np.einsum("ijc,mijc->mij", apart, motions[:, :, None] - motions[:, None])).max(axis=0)
                rigid, best = rates < 1e-7, rank
        return rigid, best

    def unwrapped(self, x: FloatArray) -> FloatArray:
        """Positions made whole across the boundary, following the rows."""
        found = [item.with_target(None) for item in self.part.constraints]
        return whole_bodies(found, self.part.whole(x), self.part.lattice)


# -- linear and planar groups -------------------------------------------------------------------------------


@dataclass(frozen=True)
class FlatBody:
    """A rigid group on a line (two bases), in a plane (three) or in space (four), and what holds it regularly.

    Attributes
    ----------
    atoms, rows : ndarray of int
        The atoms, and the rows that the linear ones replace.
    bases : ndarray of int, shape (n_bases,)
    pairs, lengths : ndarray, shape (n_pairs, 2) and (n_pairs,)
        Distances between the bases.
    tied : ndarray of int, shape (n,)
        The other atoms.
    weights : ndarray, shape (n, n_bases)
        x_tied = weights @ x_bases.
    """

    atoms: IntArray
    rows: IntArray
    bases: IntArray
    pairs: IntArray
    lengths: FloatArray
    tied: IntArray
    weights: FloatArray

    def __str__(self) -> str:
        """For example 'atoms 0, 1, 2 on a line: 1 distance and 3 linear rows in place of 3 rows'."""
        distances, linear = len(self.pairs), 3 * len(self.tied)
        return (
            f"atoms {_listed(self.atoms)} {_GROUPS[len(self.bases) - 2][0]}: {distances} "
            f"distance{'s' if distances > 1 else ''} and {linear} linear rows in place of {len(self.rows)} rows"
        )

    def renumbered(self, atoms: IntArray, rows: IntArray) -> FlatBody:
        """The same body where atom a is called atoms[a] and row k rows[k]."""
        named = {name: atoms[getattr(self, name)] for name in ("atoms", "bases", "pairs", "tied")}
        return replace(self, rows=rows[self.rows], **named)


def find_flat_bodies(block: LocalRows) -> list[FlatBody]:
    """Rigid groups that make a block singular at second order, as linear rows.

    Raises
    ------
    SingularGeometryError
        If the block is singular for another reason, or a group's targets do not fit its flat geometry.
    """
    rigid, generic = block.rigid_pairs()
    x = block.unwrapped(block.x)
    groups = [atoms for atoms in _cliques(rigid) if block.singular(block.x, block.inside(atoms))]
    if not groups:
        raise _unresolved(block, block.decomposed(block.x)[1], generic)
    bodies = _without_repeats(block, [_body(block, atoms, x) for atoms in groups])
    _check_result(block, bodies, generic)
    return [body.renumbered(block.atoms, block.rows) for body in bodies]


def affine_dimension(x: FloatArray) -> int:
    """1 for points on a line, 2 in a plane, 3 otherwise, up to `FLAT`."""
    s = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    return max(1, int(np.sum(s > FLAT * s[0])))


def _cliques(rigid: BoolArray) -> list[IntArray]:
    """Rigid bodies of three atoms and more: two of them share a hinge (two atoms) at most."""
    bodies: list[BoolArray] = []
    for i, j in np.argwhere(np.triu(rigid, 1)):
        common = rigid[i] & rigid[j]
        common[[i, j]] = False
        for body in bodies:
            if body[i] and body[j]:
                common &= ~body
        while common.any():
            k = int(np.argmax(common))
            body = rigid[i] & rigid[j] & rigid[k]
            bodies.append(body)
            common &= ~body
    return [np.flatnonzero(b) for b in bodies]


def _body(block: LocalRows, atoms: IntArray, x: FloatArray) -> FlatBody:
    """What holds a group: bases, their distances, and the weights of the other atoms."""
    inside = block.inside(atoms)
    located = [block.part.locate(int(k)) for k in inside]
    if any(isinstance(item.target, MovingTarget) for item, _ in located):
        raise _refused(block, atoms, inside, x, "since a target among these atoms is a function of time")
    plane = _fitted(block, atoms, inside, x)
    bases, weights = _bases(block, atoms, plane)
    held = np.array(list(combinations(bases, 2)))
    lengths = np.linalg.norm(plane[held[:, 0]] - plane[held[:, 1]], axis=1)
    pairs, others = atoms[held], np.setdiff1d(np.arange(len(atoms)), bases)
    for item, row in located:
        if item.holds_length:
            same = np.flatnonzero((np.sort(pairs, axis=1) == np.sort(item.atoms[row])).all(axis=1))
            # A base distance that was held stays at its own target, to the last bit.
            lengths[same] = np.asarray(item.target)[row]
    return FlatBody(atoms, inside, atoms[bases], pairs, lengths, atoms[others], weights[others])


def _fitted(block: LocalRows, atoms: IntArray, inside: IntArray, x: FloatArray) -> FloatArray:
    """Coordinates along the line, in the plane or in space that fulfil the targets, shape (n, dimension).

    Gauss-Newton along a line or within a plane, where the rows are regular; starts from the present positions.
    """
    center, flat = x[atoms].mean(axis=0), affine_dimension(x[atoms])
    axes = np.linalg.svd(x[atoms] - center)[2][:flat]
    plane = (x[atoms] - center) @ axes.T
    columns = (3 * atoms[:, None] + np.arange(3)).ravel()
    scale = block.part.scale[inside]
    whole = x.copy()
    best, miss, worst = plane, np.inf, 0
    for _ in range(30):
        whole[atoms] = center + plane @ axes
        sigma = block.part.value(whole, block.time)[inside] / scale
        if not np.abs(sigma).max() < miss:
            break
        best, worst, miss = plane, int(np.argmax(np.abs(sigma))), float(np.abs(sigma).max())
        if miss < 1e-16:
            break
        a = block.part.jacobian(whole, block.time)[inside][:, columns].toarray()
        a = np.einsum("rnc,fc->rnf", a.reshape(len(inside), len(atoms), 3), axes).reshape(len(inside), -1)
        plane = plane + np.linalg.lstsq(a / scale[:, None], -sigma, rcond=STEP_CUT)[0].reshape(plane.shape)
    if not miss <= MISFIT:
        name = block.set.row_name(int(block.rows[inside[worst]]))
        why = f"since the targets do not fit a {_GROUPS[flat - 1][1]} group: row {name} stays off by {miss:.2g}"
        raise _refused(block, atoms, inside, x, f"{why} (relative)")
    return best


def _bases(block: LocalRows, atoms: IntArray, plane: FloatArray) -> tuple[IntArray, FloatArray]:
    """Bases far apart, one more than dimensions, fixed atoms preferred; and all atoms' weights."""
    from scipy.linalg import qr  # slow to import

    system = np.vstack([plane.T / np.abs(plane).max(), np.ones(len(plane))])
    preferred = system * np.where(block.pinned[atoms], 2.0, 1.0)
    bases = qr(preferred, mode="r", pivoting=True)[1][: len(system)]
    while True:  # an atom that weighs more than the base it would replace spans a larger volume
        shares = np.abs(np.linalg.solve(preferred[:, bases], preferred))
        base, atom = np.unravel_index(int(np.argmax(shares)), shares.shape)
        if shares[base, atom] <= 1 + LARGER:
            break
        bases[base] = atom
    bases = np.sort(bases)
    weights = np.linalg.solve(system[:, bases], system).T
    # Round so that the weights sum to one: the relation then does not depend on the origin.
    weights[:, -1] = 1.0 - weights[:, :-1].sum(axis=1)
    return bases, weights


def _without_repeats(block: LocalRows, bodies: list[FlatBody]) -> list[FlatBody]:
    """Leave out base distances that other bodies hold already (two planar groups with a common edge)."""
    if len(bodies) < 2:
        return bodies
    rank = _rebuilt(block, bodies).decomposed(block.x)[1]
    for b in range(len(bodies)):
        for k in reversed(range(len(bodies[b].pairs))):
            body = bodies[b]
            fewer = replace(body, pairs=np.delete(body.pairs, k, axis=0), lengths=np.delete(body.lengths, k))
            trial = [*bodies[:b], fewer, *bodies[b + 1 :]]
            if _rebuilt(block, trial).decomposed(block.x)[1] == rank:
                bodies = trial
    return bodies


def _rebuilt(block: LocalRows, bodies: list[FlatBody]) -> LocalRows:
    rebuilt = with_flat_bodies(block.part, bodies, block.x, block.time)
    return LocalRows(rebuilt, np.arange(rebuilt.n_rows), block.x, block.time, pinned=block.pinned)


def _check_result(block: LocalRows, bodies: list[FlatBody], generic: int) -> None:
    """The new rows must be regular, and the replaced ones must follow from them, to second order.

    First order is not enough: flat plates hinged in a ring can fold as long as each is held alone, while the
    distances between them resist the fold at second order.
    """
    new = _rebuilt(block, bodies)
    vt, rank = new.decomposed(block.x)
    apart = np.abs(block.linear(block.x)[0] @ vt[rank:].T).max(initial=0.0)
    both = new.part.replaced([*new.part.constraints, *block.part.constraints], block.x, block.time)
    together = LocalRows(both, np.arange(both.n_rows), block.x, block.time, pinned=block.pinned)
    if apart > 1e-4 or new.singular(block.x) or together.singular(block.x):
        raise _unresolved(block, block.decomposed(block.x)[1], generic)


def with_flat_bodies(
    constraint_set: ConstraintSet, bodies: Sequence[FlatBody], positions: FloatArray, time: float
) -> ConstraintSet:
    """The set with the bodies' rows replaced: what is kept, then distances between bases, then relations."""
    drop = np.unique(np.concatenate([b.rows for b in bodies]))
    pieces: list[Constraint] = []
    for item, start in zip(constraint_set.constraints, constraint_set.starts, strict=False):
        lo, hi = np.searchsorted(drop, [start, start + item.n_rows])
        if lo == hi:
            pieces.append(item)
        elif hi - lo < item.n_rows:
            pieces.append(item.select(np.setdiff1d(np.arange(item.n_rows), drop[lo:hi] - start)))
    pairs = np.concatenate([b.pairs for b in bodies])
    lengths = np.concatenate([b.lengths for b in bodies])
    # Bodies that share an edge hold it once.
    _, first = np.unique(np.sort(pairs, axis=1), axis=0, return_index=True)
    first.sort()
    if len(first):
        pieces.append(Distance(pairs[first], lengths[first]))
    for n_bases in (2, 3, 4):
        same = [b for b in bodies if len(b.bases) == n_bases and len(b.tied)]
        if same:
            pieces.append(
                LinearRelation(
                    np.concatenate([b.tied for b in same]),
                    np.concatenate([np.tile(b.bases, (len(b.tied), 1)) for b in same]),
                    np.concatenate([b.weights for b in same]),
                )
            )
    new = constraint_set.replaced(pieces, positions, time)
    new.conversions = tuple(bodies)
    return new


def _listed(atoms: IntArray) -> str:
    return ", ".join(str(a) for a in atoms[:8]) + (", ..." if len(atoms) > 8 else "")


def _refused(block: LocalRows, atoms: IntArray, inside: IntArray, x: FloatArray, why: str) -> SingularGeometryError:
    """The error for a flat group that cannot be converted."""
    linearized = 3 * int(np.sum(~block.pinned[atoms])) - block.decomposed(block.x, inside)[1]
    _, _, shape, freedom, remedy = _GROUPS[affine_dimension(x[atoms]) - 1]
    named = block.atoms[atoms]
    return SingularGeometryError(
        f"constraint set singular at this geometry: {linearized} linearized degrees of freedom but the rigid body "
        f"has {freedom} (atoms {_listed(named)} are {shape}); hold {remedy} instead; it cannot be converted, {why}",
        rows=block.rows[inside],
        atoms=named,
    )


def _unresolved(block: LocalRows, here: int, generic: int) -> SingularGeometryError:
    names = ", ".join(block.set.row_name(int(r)) for r in block.rows[:4]) + (", ..." if len(block.rows) > 4 else "")
    free = 3 * int(np.sum(~block.pinned))
    return SingularGeometryError(
        f"constraint set singular at this geometry: {free - here} linearized degrees of freedom here but "
        f"{free - generic} at positions nearby; rows {names} resist some motion only at second order, and no linear "
        "or planar rigid group explains it. Leave out the rows that do this, start from another geometry, or hold "
        "the atoms by x_a = sum c_i x_i (LinearRelation)",
        rows=block.rows,
        atoms=block.atoms,
    )
