"""What rows tie together, and what may move as one without a change of any row."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.periodic.one_piece import BoolArray
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import extent, row_norms
from kcons.motion.motion import Motion

#: How far each atom is moved to see whether a row changes elsewhere, relative to the size of the system.
NEARBY = 1e-3
#: Change of a row, relative to its gradient, that is taken for rounding.
UNCHANGED = 1e-9


def bodies(motion: Motion, moving: BoolArray) -> IntArray:
    """What rows tie together, a number for each atom, shape (n_atoms,); -1 for atoms that do not move."""
    from scipy.sparse import diags
    from scipy.sparse.csgraph import connected_components  # slow to import

    joins = motion.constraint_set.incidence.astype(np.float64) @ diags(moving.astype(np.float64))
    found = connected_components(joins.T @ joins, directed=False)[1]
    label = np.full(len(moving), -1, dtype=np.int64)
    label[moving] = np.unique(found[moving], return_inverse=True)[1]
    return label


def rows_where(held: ConstraintSet, wanted: list[bool]) -> BoolArray:
    """Marks for all rows of the constraints that are wanted, shape (n_rows,)."""
    return np.repeat(np.array(wanted, dtype=bool), [item.n_rows for item in held.constraints])


def placed_rows(held: ConstraintSet) -> BoolArray:
    """Rows that know a place in space, shape (n_rows,)."""
    return rows_where(held, [not item.translation_invariant for item in held.constraints])


def row_changes(
    motion: Motion,
    positions: FloatArray,
    fields: Callable[[FloatArray], FloatArray],
    time: float = 0.0,
    size: float | None = None,
) -> Iterator[FloatArray]:
    """Changes of all rows by motions, relative to their gradients, here and at two places nearby, shape (n_rows, k).

    At a single place they may cancel by symmetry. Fixed atoms stay. Not finite where a surface is not defined. `fields`
    gets positions and gives the velocities of k motions as columns, shape (3 n_atoms, k); `size` is that of the system.
    """
    held, rng = motion.constraint_set, np.random.default_rng(0)
    size = size or extent(positions) or 1.0
    for spread in (0.0, NEARBY * size, NEARBY * size):
        shake = spread * rng.standard_normal(positions.shape)
        shake[motion.fixed_atoms] = 0.0
        x = positions + shake
        with np.errstate(all="ignore"):
            rows = held.jacobian(x, time)
            lengths = row_norms(rows)
            yield np.asarray(rows @ fields(x)) / np.where(lengths == 0, 1.0, lengths)[:, None]


def shifts(x: FloatArray) -> FloatArray:
    """All atoms along x, y and z, as `row_changes` asks for them."""
    return np.tile(np.eye(3), (len(x), 1))
