"""Rows that are singular at second order: the test, and one block of rows with dense algebra.

At a point where the rows of A depend on each other (omega^T A = 0) admissible velocities, A v = 0, need
omega . (v^T d2sigma/dx2 v) = 0, or no acceleration fulfils A a = b (solvability, notes eq. 95). Rows that
depend on each other on the whole surface fulfil it; rows that hold something at second order only do not.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import extent
from kcons.plan.independent_blocks import fixed_atoms
from kcons.solvers.tolerances import LOST

BoolArray = NDArray[np.bool_]

#: Directions that a step of Gauss-Newton leaves out. Towards a flat geometry singular values go with the square root of
#: the residual, to 1e-7, and have to count.
STEP_CUT = 1e-9
#: Size of the displacements that break special geometries, relative to the shortest row.
DISPLACEMENT = 1e-2
#: Part of the curvature outside the range of A that is more than rounding (or than the differences of a
#: user's gradient).
UNSOLVABLE = 1e-4
#: Families whose rows a linear or planar group makes superfluous.
_CONVERTIBLE = frozenset({"Distance", "Angle", "Dihedral"})


def unsolvable(unit: FloatArray, curvature: Callable[[FloatArray], FloatArray], extent: FloatArray) -> BoolArray:
    """Whether A a = -v^T (d2sigma/dx2) v has no solution for some v with A v = 0.

    Parameters
    ----------
    unit : ndarray, shape (n_blocks, n_rows, n_coordinates)
        A of several blocks, rows scaled to unit norm.
    curvature : callable
        Maps v, shape (n_blocks, n_coordinates), to the curvatures, shape (n_blocks, n_rows), of the scaled rows.
    extent : ndarray, shape (n_blocks,)
        Length scale of each block.

    References
    ----------
    Notes, eqs. 92 and 95.
    """
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
    """One block of rows on its own atoms, with dense algebra.

    Parameters
    ----------
    constraint_set : ConstraintSet
    rows : ndarray of int
        Rows of the block, sorted.
    positions : ndarray, shape (n_atoms, 3)
    time : float
    pinned : ndarray of bool, optional
        Fixed atoms of the block; by default those that FixedAtoms of the set hold.
    """

    def __init__(
        self,
        constraint_set: ConstraintSet,
        rows: IntArray,
        positions: FloatArray,
        time: float,
        pinned: BoolArray | None = None,
    ) -> None:
        self.rows = rows
        self.time = time
        self.set = constraint_set
        self.part, self.atoms = constraint_set.subset(rows)
        self.x = positions[self.atoms]
        if pinned is None:
            pinned = np.isin(self.atoms, fixed_atoms(constraint_set))
        self.pinned: BoolArray = pinned
        self.row_atoms = [self.part.row_atoms(k) for k in range(self.part.n_rows)]

    def inside(self, atoms: IntArray) -> IntArray:
        """Rows (block numbering) of convertible families with all their atoms among `atoms` (block numbering)."""
        chosen = np.zeros(len(self.atoms), bool)
        chosen[atoms] = True
        return np.array(
            [
                k
                for k, members in enumerate(self.row_atoms)
                if chosen[members].all() and self.part.locate(k)[0].family in _CONVERTIBLE
            ],
            dtype=np.int64,
        )

    def unit_jacobian(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Row-normalised A without the columns' part of fixed atoms, and the norms."""
        a = self.part.jacobian(x, self.time).toarray()
        a[:, np.repeat(self.pinned, 3)] = 0.0
        norms = np.linalg.norm(a, axis=1)
        return a / np.where(norms > 0, norms, 1.0)[:, None], norms

    def singular(self, x: FloatArray, rows: IntArray | None = None) -> bool:
        """Whether these rows (all by default) are singular at second order at `x`."""
        rows = np.arange(self.part.n_rows) if rows is None else rows
        if len(rows) < 2:
            return False
        unit, _ = self.unit_jacobian(x)

        def curvature(v: FloatArray) -> FloatArray:
            return self.unit_curvature(x, v)[None, rows]

        return bool(unsolvable(unit[None, rows], curvature, np.array([extent_of(x)]))[0])

    def unit_curvature(self, x: FloatArray, v: FloatArray) -> FloatArray:
        """v^T (d2sigma/dx2) v of the rows that `unit_jacobian` scales, shape (n_rows,)."""
        _, norms = self.unit_jacobian(x)
        field = np.where(self.pinned[:, None], 0.0, v.reshape(-1, 3))
        bent = [c.curvature(self.part.gather(c, x), field[c.atoms], self.time) for c in self.part.constraints]
        return np.asarray(np.concatenate(bent) / np.where(norms > 0, norms, 1.0))

    def stressed(self, x: FloatArray) -> IntArray:
        """Rows (block numbering) that take part in a dependence omega^T A = 0."""
        unit, _ = self.unit_jacobian(x)
        u, s, _ = np.linalg.svd(unit, full_matrices=True)
        rank = int(np.sum(s > LOST * s[0]))
        return np.flatnonzero(np.einsum("rk,rk->r", u[:, rank:], u[:, rank:]) > 1e-10)

    def rank(self, x: FloatArray, rows: IntArray | None = None) -> int:
        unit, _ = self.unit_jacobian(x)
        s = np.linalg.svd(unit if rows is None else unit[rows], compute_uv=False)
        return int(np.sum(s > LOST * s[0])) if len(s) else 0

    def restored(self) -> LocalRows:
        """The same block at positions that fulfil its targets, as nearly as Gauss-Newton gets there."""
        x = self.x.copy()
        held = self.part.holonomic
        for _ in range(60):
            sigma = self.part.value(x, self.time)
            # Towards a flat geometry the singular value is the square root of this, 1e-7: lost by any measure.
            if np.max(np.abs(sigma) / self.part.scale) < 1e-14:
                break
            unit, norms = self.unit_jacobian(x)
            step = np.linalg.lstsq(unit[held], -(sigma / np.where(norms > 0, norms, 1.0))[held], rcond=STEP_CUT)[0]
            x = x + step.reshape(x.shape)
        other = copy.copy(self)
        other.x = x
        return other

    def rigid_pairs(self) -> tuple[BoolArray, int]:
        """Pairs of atoms that keep their distance at positions nearby, and the rank there."""
        rng = np.random.default_rng(20090131)
        n = len(self.atoms)
        step = DISPLACEMENT * self._shortest()
        best, rigid = -1, np.eye(n, dtype=bool)
        for _ in range(3):
            x = self.x + step * rng.standard_normal(self.x.shape)
            x[self.pinned] = self.x[self.pinned]
            unit, _ = self.unit_jacobian(x)
            _, s, vt = np.linalg.svd(unit, full_matrices=True)
            rank = int(np.sum(s > LOST * s[0]))
            if rank <= best:
                continue
            best = rank
            # A few random motions show every pair that can move.
            motions = rng.standard_normal((8, vt.shape[0] - rank)) @ vt[rank:]
            motions = motions.reshape(8, n, 3)
            motions[:, self.pinned] = 0.0
            apart = self.unwrapped(x)
            apart = apart[:, None] - apart[None, :]
            lengths = np.linalg.norm(apart, axis=2) + np.eye(n)
            rates = np.zeros((n, n))
            for motion in motions:
                along = np.einsum("ijc,ijc->ij", apart / lengths[:, :, None], motion[:, None] - motion[None, :])
                rates = np.maximum(rates, np.abs(along))
            rigid = rates < 1e-7
        return rigid, best

    def unwrapped(self, x: FloatArray) -> FloatArray:
        """Positions made whole across the boundary, following the rows."""
        if self.part.lattice is None:
            return x
        whole = x.copy()
        placed = np.zeros(len(x), bool)
        placed[0] = True
        rows = [r for item in self.part.constraints for r in self.part.gather(item, x)]
        for _ in range(len(x)):
            before = int(placed.sum())
            for members, r in zip(self.row_atoms, rows, strict=True):
                known = placed[members]
                if known.any() and not known.all():
                    base = int(np.argmax(known))
                    whole[members[~known]] = whole[members[base]] + r[~known] - r[base]
                    placed[members] = True
            if placed.all() or int(placed.sum()) == before:
                break
        return whole

    def _shortest(self) -> float:
        lengths = [
            np.linalg.norm(np.diff(self.part.gather(c, self.x), axis=1), axis=2).min()
            for c in self.part.constraints
            if c.width > 1 and c.n_rows
        ]
        return float(min(lengths)) if lengths else extent_of(self.x)


def extent_of(x: FloatArray) -> float:
    """Length scale of a group of points."""
    size = extent(x)
    return size if size > 0 else max(float(np.max(np.abs(x))), 1.0)
