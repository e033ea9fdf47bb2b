"""Rows that are singular only at second order: found at set-up, converted to linear rows or refused.

Rows may depend on each other in two ways. Methane by all ten distances has nine independent gradients on
the whole surface: any nine rows hold what ten hold, and a pseudo-inverse deals with it. CO2 by three
distances has two independent gradients where it is straight, yet cannot bend, because a bend by e changes
a distance by e^2: no iteration converges there, and no first-order theory holds.

The difference is the solvability condition A A+ b = b (notes eq. 95): at a singular point of the second
kind there are admissible velocities, A v = 0, for which no acceleration exists. With omega^T A = 0 this
reads omega . (v^T d2sigma/dx2 v) = 0, which is tested here for random v.

A group of atoms held rigid by such rows is collinear or planar, and what the rows mean is linear:
x_a = (1 - c) x_i + c x_j on a line, x_a = c_i x_i + c_j x_j + c_k x_k in a plane, with one distance or
three between the bases. These rows are regular and hold all distances in the group.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray, MovingTarget
from kcons.constraints.vectors import row_norms
from kcons.errors import SingularGeometryError
from kcons.plan.independent_blocks import fixed_atoms, row_blocks
from kcons.plan.second_order.flat_bodies import MISFIT, FlatBody, find_flat_bodies, refusal, with_flat_bodies
from kcons.plan.second_order.singular_rows import DISPLACEMENT, BoolArray, LocalRows, unsolvable
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
_INTERNAL = frozenset({"Distance", "Angle", "Dihedral", "LinearRelation", "LinearCombination"})
_LEVELS: tuple[Callable[[Constraint], bool], ...] = (
    lambda item: True,
    lambda item: item.family in _INTERNAL and item.translation_invariant,
    lambda item: item.holds_length,
)


def without_second_order_rows(
    constraint_set: ConstraintSet, positions: FloatArray, time: float, *, convert: bool
) -> ConstraintSet:
    """The same set with second-order-singular rows replaced by linear ones.

    Parameters
    ----------
    constraint_set : ConstraintSet
    positions : ndarray, shape (n_atoms, 3)
        Positions on or near the surface.
    time : float
    convert : bool
        False refuses such rows instead.

    Returns
    -------
    ConstraintSet
        The given object itself if it is regular.

    Raises
    ------
    SingularGeometryError
        Rows that cannot be converted, or with ``convert=False``; the message says what to hold instead.
    """
    bodies: list[FlatBody] = []
    sigma: FloatArray | None = None
    for stack in _stacks(constraint_set, positions, time):
        sigma = constraint_set.value(positions, time) if sigma is None else sigma
        suspects = stack.suspects(constraint_set, positions, time)
        straight, done = stack.straight_triangles(constraint_set, suspects, time)
        bodies += straight
        for rows in stack.rows[suspects & ~done]:
            bodies += find_flat_bodies(LocalRows(constraint_set, rows, positions, time))
        regular = 0
        for rows in stack.rows[stack.off_target(constraint_set, positions, sigma, time) & ~suspects]:
            block = LocalRows(constraint_set, rows, positions, time).restored()
            regular += 1
            if block.singular(block.x):
                bodies += find_flat_bodies(block)
                regular = 0
            if regular >= _REGULAR_SAMPLES:
                break
        if bodies and not convert:
            raise refusal(bodies[0])
    if not bodies:
        return constraint_set
    return with_flat_bodies(constraint_set, bodies, positions, time)


@dataclass
class _Stack:
    """Blocks of one shape.

    Attributes
    ----------
    rows : ndarray of int, shape (n_blocks, n_rows)
    atoms : ndarray of int, shape (n_blocks, n_atoms)
    """

    rows: IntArray
    atoms: IntArray

    def chosen(self, which: IntArray | BoolArray) -> _Stack:
        return _Stack(self.rows[which], self.atoms[which])

    def suspects(self, constraint_set: ConstraintSet, x: FloatArray, time: float) -> BoolArray:
        """Blocks that are singular at second order at `x`, shape (n_blocks,)."""
        unit, curvature = self._dense(constraint_set, x, time)
        doubtful: BoolArray = np.asarray(np.isfinite(unit).all(axis=(1, 2)))
        doubtful[doubtful] = _deficient(unit[doubtful])
        if doubtful.any() and not doubtful.all():
            few = self.chosen(doubtful)
            doubtful[doubtful] = few.suspects(constraint_set, x, time)
            return doubtful
        if doubtful.any():
            extent = np.ptp(x[self.atoms], axis=1).max(axis=1)
            doubtful = unsolvable(unit, curvature, np.where(extent > 0, extent, 1.0))
        return doubtful

    def _dense(
        self, constraint_set: ConstraintSet, x: FloatArray, time: float
    ) -> tuple[FloatArray, Callable[[FloatArray], FloatArray]]:
        """Row-normalized A of each block, fixed atoms' columns zero, and the curvatures of the same rows."""
        n_blocks, n_rows = self.rows.shape
        n_atoms = self.atoms.shape[1]
        a = np.zeros((n_blocks, n_rows, n_atoms, 3))
        pieces: list[tuple[Constraint, FloatArray, IntArray, IntArray, IntArray]] = []
        for item, start in zip(constraint_set.constraints, constraint_set.starts, strict=False):
            block, row = np.nonzero((self.rows >= start) & (self.rows < start + item.n_rows))
            if len(block) == 0:
                continue
            part = item.select(self.rows[block, row] - start)
            slots = np.argmax(self.atoms[block][:, None, :] == part.atoms[:, :, None], axis=2)
            r = constraint_set.gather(part, x)
            with np.errstate(divide="ignore", invalid="ignore"):
                a[block[:, None], row[:, None], slots] = part.gradient(r, time)
            pieces.append((part, r, block, row, slots))
        free = ~np.isin(self.atoms, fixed_atoms(constraint_set))
        a *= free[:, None, :, None]
        unit = a.reshape(n_blocks, n_rows, -1)
        norms = np.linalg.norm(unit, axis=2)
        norms = np.where(norms > 0, norms, 1.0)

        def curvature(v: FloatArray) -> FloatArray:
            field = v.reshape(n_blocks, n_atoms, 3) * free[:, :, None]
            bent = np.zeros((n_blocks, n_rows))
            for part, r, block, row, slots in pieces:
                bent[block, row] = part.curvature(r, field[block[:, None], slots], time)
            return bent / norms

        return unit / norms[:, :, None], curvature

    def straight_triangles(
        self, constraint_set: ConstraintSet, suspects: BoolArray, time: float
    ) -> tuple[list[FlatBody], BoolArray]:
        """Collinear triatomics held by three distances, all at once, and which blocks they are."""
        done = np.zeros(len(self.rows), bool)
        if self.rows.shape[1] != 3 or self.atoms.shape[1] != 3:
            return [], done
        pairs = np.full((constraint_set.n_rows, 2), -1)
        for item, start in zip(constraint_set.constraints, constraint_set.starts, strict=False):
            if item.holds_length and not isinstance(item.target, MovingTarget):
                pairs[start : start + item.n_rows] = item.atoms
        sides = pairs[self.rows]
        plain = (sides >= 0).all(axis=(1, 2)) & ~np.isin(self.atoms, fixed_atoms(constraint_set)).any(axis=1)
        if not plain.any():
            return [], done
        length = constraint_set.target(time)[self.rows]
        order = np.argsort(length, axis=1)
        length = np.take_along_axis(length, order, axis=1)
        sides = np.take_along_axis(sides, order[:, :, None], axis=1)
        excess = np.abs(length[:, 0] + length[:, 1] - length[:, 2]) / length[:, 2]
        done = plain & ((suspects & (excess <= MISFIT)) | (excess <= _FLAT_TARGETS))
        bodies = []
        for k in np.flatnonzero(done):
            i, j = sides[k, 2]
            middle = self.atoms[k].sum() - i - j
            from_i = length[k, 0] if i in sides[k, 0] else length[k, 1]
            c = from_i / (length[k, 0] + length[k, 1])
            bodies.append(
                FlatBody(
                    atoms=self.atoms[k],
                    rows=self.rows[k],
                    bases=sides[k, 2],
                    pairs=sides[k, 2:],
                    lengths=length[k, 2:],
                    tied=np.array([middle]),
                    weights=np.array([[1.0 - c, c]]),
                    linearized=7,
                )
            )
        return bodies, done

    def off_target(self, constraint_set: ConstraintSet, x: FloatArray, sigma: FloatArray, time: float) -> BoolArray:
        """Blocks so far from their targets that their geometry says nothing about the surface."""
        miss = np.abs(sigma[self.rows] / constraint_set.scale[self.rows]).max(axis=1)
        result = miss > 1e-10
        if self.rows.shape[1] <= 3 or not result.any():
            return np.zeros_like(result)
        far = np.flatnonzero(result)
        unit, _ = self.chosen(far)._dense(constraint_set, x, time)
        if unit.shape[1] <= unit.shape[2]:
            # At a distance s from a flat geometry the smallest singular value is s, and the rows are off by s^2.
            smallest = np.linalg.svd(unit, compute_uv=False)[:, -1]
            far = far[miss[far] > 0.1 * smallest**2]
        result[:] = False
        result[far] = True
        return result


def _deficient(unit: FloatArray) -> BoolArray:
    """Which blocks have dependent rows, shape (n_blocks,)."""
    n_rows = unit.shape[1]
    if n_rows > unit.shape[2]:
        return np.ones(len(unit), bool)
    gram = unit @ unit.transpose(0, 2, 1)
    result = np.ones(len(unit), bool)
    if n_rows <= 12:
        # Eigenvalues sum to n_rows, so the smallest is at least det / (n_rows / (n_rows - 1))^(n_rows - 1).
        bound = np.linalg.det(gram) / (n_rows / (n_rows - 1)) ** (n_rows - 1)
        result = ~(bound > 1e-6)
    if not result.any():
        return result
    gram = gram[result]
    try:
        np.linalg.cholesky(gram - 1e-6 * np.eye(n_rows))
        result[:] = False
    except np.linalg.LinAlgError:
        squares = np.linalg.eigvalsh(gram)
        result[result] = squares[:, 0] <= LOST**2 * squares[:, -1]
    return result


def _stacks(constraint_set: ConstraintSet, positions: FloatArray, time: float) -> Iterator[_Stack]:
    """All blocks small enough for dense algebra, by shape; tests larger ones on the way."""
    rows: IntArray | None = None
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
                yield _Stack(members[starts[some] + np.arange(n_rows)], atoms[first_atom[some] + np.arange(n_atoms)])
        rows = np.sort(members[large[label]])
        if len(rows) == 0:
            return
    for k in np.flatnonzero(large).tolist():
        _check_large(constraint_set, members[starts[k] : starts[k + 1]], positions, time)


def _check_large(constraint_set: ConstraintSet, rows: IntArray, positions: FloatArray, time: float) -> None:
    """Refuse a block too large for dense algebra whose rank is lower here than at positions nearby."""
    part, atoms = constraint_set.subset(rows)
    x = positions[atoms]
    free = ~np.isin(atoms, fixed_atoms(constraint_set))
    shortest = float(part.measure(x, time).min())
    rng = np.random.default_rng(20090131)
    away = x + DISPLACEMENT * shortest * rng.standard_normal(x.shape) * free[:, None]
    here, nearby = (_lost_rows(part, y, free, time) for y in (x, away))
    if here > nearby:
        names = ", ".join(constraint_set.row_name(int(r)) for r in rows[:4])
        raise SingularGeometryError(
            f"constraint set singular at this geometry: the {len(rows)} rows {names}, ... have rank "
            f"{len(rows) - here} here but {len(rows) - nearby} at positions nearby. Hold collinear and coplanar "
            "groups by x_a = sum c_i x_i (LinearRelation) instead of all their distances",
            rows=rows,
            atoms=atoms,
        )


def _lost_rows(part: ConstraintSet, x: FloatArray, free: BoolArray, time: float) -> int:
    """Rows less rank: eigenvalues of A A^T below LOST^2, counted by Sylvester's law of inertia."""
    a = part.jacobian(x, time)
    a.data *= np.repeat(free, 3)[a.indices]
    norms = row_norms(a)
    a.data *= np.repeat(1.0 / np.where(norms > 0, norms, 1.0), np.diff(a.indptr))
    shifted = (a @ a.T - LOST**2 * sp.eye_array(part.n_rows)).tocsc()
    from scipy.sparse.linalg import splu  # slow to import, seldom needed

    factor = splu(shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return int(np.sum(factor.U.diagonal() < 0))
