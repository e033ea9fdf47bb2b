"""The periodic cell of a set of constraints, and which images its rows mean."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import numbers
from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.images import Images, image_error
from kcons.constraints.one_piece import lattice_of, lined_up, make_whole, spanning_tree
from kcons.constraints.target import FloatArray
from kcons.errors import InputError

#: Change of a cell vector, in parts of its length, over which images of atoms that nothing ties together are followed.
MOST_STRAIN = 0.1


class InCell:
    """What a set of constraints knows of its cell; `ConstraintSet` is what it holds.

    Attributes
    ----------
    lattice : ndarray, shape (2, 3, 3), or None
        Cell vectors as rows, and the inverse with zeros for directions without periodicity.
    images : Images or None
        The tree along which atoms of whole rows are made whole; see `kcons.constraints.images`.
    """

    constraints: tuple[Constraint, ...]
    starts: IntArray
    lattice: FloatArray | None
    images: Images | None

    def locate(self, row: int) -> tuple[Constraint, int]:
        """The constraint object that holds `row`, and the row's number within it."""
        k = int(np.searchsorted(self.starts, row, side="right")) - 1
        return self.constraints[k], int(row - self.starts[k])

    def row_name(self, row: int) -> str:
        """For example '#3 Distance(4, 5)'."""
        item, k = self.locate(row)
        return f"#{row} {item.row_name(k)}"

    def row_atoms(self, row: int) -> IntArray:
        """Atoms of one row."""
        item, k = self.locate(row)
        return item.atoms[k]

    def _set_cell(self, cell: ArrayLike | None, pbc: bool | Sequence[bool]) -> None:
        self.lattice: FloatArray | None = None
        if cell is None:
            return
        matrix = contiguous(cell, "cell")
        if matrix.shape == (3,):
            matrix = np.diag(matrix)
        if matrix.shape != (3, 3):
            raise InputError(f"cell must have shape (3, 3) or (3,), not {matrix.shape}", item="cell")
        if not np.all(np.isfinite(matrix)):
            raise InputError("cell has a NaN or infinity", item="cell")
        self.lattice = lattice_of(matrix, pbc)

    def with_cell(self, cell: ArrayLike | None, pbc: bool | Sequence[bool] = True) -> None:
        """Change the cell in place (barostats); targets are unchanged.

        Raises
        ------
        InputError
            A degenerate cell; a first cell, or a new periodic direction, for rows that have to be sorted by their
            images, which needs positions; a change by more than a tenth for atoms that nothing ties together.
        """
        before = self.lattice
        self._set_cell(cell, pbc)
        if self.lattice is None or all(c.family == "Distance" and not c.moving for c in self.constraints if c.relative):
            return
        if before is not None and self.images is not None and np.any(self.images.loose >= 0):
            change = np.linalg.norm(self.lattice[0] - before[0], axis=1) / np.linalg.norm(before[0], axis=1)
            change = change[self.lattice[1].any(axis=0)]  # the vector of a direction without periodicity is arbitrary
            if np.any(change > MOST_STRAIN):
                self.lattice = before
                raise InputError(
                    f"the cell changes by {change.max():.0%} at once, more than a tenth: which images rows mean among "
                    "atoms that nothing ties together cannot be followed; make a new ConstraintSet with the cell",
                    item="cell",
                )
        periodic = np.zeros(3, bool) if before is None else before[1].any(axis=0)
        if np.any(self.lattice[1].any(axis=0) & ~periodic):
            self.lattice = before
            raise InputError(
                "this set was made without this periodic direction, and which images its rows mean has to be found "
                "anew; make a new ConstraintSet with the cell",
                item="cell",
            )

    @property
    def half_width(self) -> float:
        """Half the smallest perpendicular width of the periodic cell; infinite without one."""
        if self.lattice is None:
            return np.inf
        norms = np.linalg.norm(self.lattice[1], axis=0)
        return 0.5 / float(norms.max())

    def refuse_loose_links(self, whole: FloatArray, numbers: IntArray | None = None) -> None:
        """Raise `ImageError` where atoms of a row, made whole, are half the cell apart and nothing ties them.

        `numbers` are the names of the atoms in messages, if not their own numbers.
        """
        if self.images is None or self.lattice is None:
            return
        link = self.images.reached_half(whole, self.lattice)
        if link >= 0:
            pair = np.array([self.images.parents[link], self.images.atoms[link]])
            row = int(self.images.loose[link])
            raise image_error(self.row_name(row), pair if numbers is None else numbers[pair], self.half_width)

    @cached_property
    def _longest_plain(self) -> tuple[float, int]:
        """Longest constant distance that was shorter than half the box at set-up, and its row."""
        longest, row = 0.0, 0
        for item, start in zip(self.constraints, self.starts, strict=False):
            if item.family != "Distance" or item.moving or item.n_rows == 0:
                continue
            lengths = item.target_at(0.0) if item.whole is None else np.where(item.whole, 0.0, item.target_at(0.0))
            if lengths.max() > longest:
                longest, row = float(lengths.max()), int(start + np.argmax(lengths))
        return longest, row

    def whole(self, x: FloatArray) -> FloatArray:
        """Positions in which atoms of whole rows stand in the images that these rows mean; see `constraints.images`.

        `x` itself where all rows are plain.
        """
        if self.lattice is None or self.images is None:
            return x
        return self.images.make_whole(x, self.lattice)

    def gather(self, item: Constraint, x: FloatArray) -> FloatArray:
        """Positions of a constraint's atoms, shape (n_rows, width, 3), in the images that its rows mean."""
        return self._gather(item, x, self.whole(x))

    def _gather(self, item: Constraint, x: FloatArray, whole: FloatArray) -> FloatArray:
        # Fixed atoms stand where they are told to, in no other image.
        r = (x if item.family == "FixedAtoms" else whole)[item.atoms]
        if self.lattice is None or not item.relative:
            return r
        if item.whole is None:
            return lined_up(r, self.lattice)
        plain = ~item.whole
        if plain.any():
            r[plain] = lined_up(r[plain], self.lattice)
        if item.windings is not None:
            r[item.whole] += item.windings[item.whole] @ self.lattice[0]
        return r

    def _one_piece(self, item: Constraint, r: FloatArray, together: FloatArray) -> FloatArray:
        """`r` of open rows from positions in one piece, where these mean the same images."""
        if self.lattice is None or not item.relative:
            return r
        near = together[item.atoms]
        same = ~np.round(np.diff(near, axis=1) @ self.lattice[1]).any(axis=(1, 2))
        if item.whole is not None:
            same &= ~item.whole
        return np.where(same[:, None, None], near, r)


def contiguous(values: ArrayLike, item: str) -> FloatArray:
    return np.ascontiguousarray(numbers(values, item))


def whole_bodies(constraints: Sequence[Constraint], x: FloatArray, lattice: FloatArray | None) -> FloatArray:
    """Positions in which what open plain rows tie together is not cut by the boundary; `x` itself where nothing is.

    `x` has the atoms of whole rows in the images that these mean.

    Each atom is rounded once, so that lengths and angles of one body fit each other to rounding wherever its atoms are
    stored. Rows that close through the boundary still do.
    """
    pairs = [
        np.stack([atoms[:, :-1], atoms[:, 1:]], axis=-1).reshape(-1, 2)
        for c in constraints
        for atoms in [c.atoms if c.whole is None else c.atoms[~c.whole]]
        if c.relative and c.target is None
    ]
    if lattice is None or not pairs:
        return x
    links = np.concatenate(pairs)
    if not np.round((x[links[:, 1]] - x[links[:, 0]]) @ lattice[1]).any():
        return x
    return make_whole(x, *spanning_tree(links, len(x)), lattice)
