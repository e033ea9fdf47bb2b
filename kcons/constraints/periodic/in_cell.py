"""The periodic cell of a set of constraints, and which images its rows mean."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import numbers
from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.periodic.images import Images, image_error
from kcons.constraints.periodic.one_piece import lattice_of, lined_up, make_whole, minimum_image, spanning_tree
from kcons.constraints.target import FloatArray, nearest_image
from kcons.errors import InputError

#: Change of a cell vector, in parts of its length, over which images of atoms that nothing ties together are followed.
MOST_STRAIN = 0.1


class InCell:
    """Rows of a set in its cell, and the images they mean; `ConstraintSet` is what it holds.

    Attributes
    ----------
    lattice : ndarray, shape (2, 3, 3), or None
        Cell vectors as rows, and the inverse with zeros for directions without periodicity.
    images : Images or None
        The tree along which atoms of whole rows are made whole; see `kcons.constraints.periodic.images`.
    moved : ndarray, shape (n_atoms, 3), or None
        Whole cells by which the positions that the set is given were moved from where they are stored, in solvers:
        rows with a place in space take them off.
    """

    constraints: tuple[Constraint, ...]
    starts: IntArray
    lattice: FloatArray | None
    images: Images | None
    scale: FloatArray
    moved: FloatArray | None = None

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
        if np.shape(pbc) not in ((), (3,)):
            raise InputError(f"pbc is {pbc!r:.60}; give True, False, or one for each lattice vector", item="pbc")
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
        if self.lattice is None or all(c.holds_length and not c.moving for c in self.constraints if c.relative):
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

    def check_half_box(self, positions: FloatArray | None = None, before: FloatArray | None = None) -> None:
        """Check against half the box that images are unambiguous; without `positions`, of held distances only.

        Parameters
        ----------
        positions : ndarray, shape (n_atoms, 3), optional
        before : ndarray, shape (2, 3, 3), optional
            The cell before it changed: atoms that nothing ties together must keep their images.

        Raises
        ------
        InputError
            A constant distance that was shorter than half the box is so no longer.
        ImageError
            Atoms that nothing ties together are half the box apart.
        """
        if self.lattice is None:
            return
        longest, row = self._longest_plain
        if self.images is not None and self.images.longest >= self.half_width > longest:
            raise InputError(
                f"distances of {self.images.longest:g} tie the atoms of longer rows together, and are not shorter than "
                f"half the box ({self.half_width:g}); use a larger cell, or make a new ConstraintSet in this one",
                item="cell",
            )
        if longest >= self.half_width:
            raise InputError(
                f"row {self.row_name(row)}: target {longest:g} is not shorter than half the box "
                f"({self.half_width:g}); its minimum image is ambiguous. Use a larger cell, or make a new "
                "ConstraintSet in this one",
                item="target",
                atoms=self.row_atoms(row),
            )
        if positions is None:
            return
        self.refuse_loose_links(self.whole(positions))
        if before is not None:
            self.refuse_other_images(positions, before, None)
        for item, start in zip(self.constraints, self.starts, strict=False):
            if not item.relative or item.holds_length or item.n_rows == 0:
                continue
            length = np.linalg.norm(minimum_image(np.diff(positions[item.atoms], axis=1), self.lattice), axis=2)
            if item.whole is not None:
                length[item.whole] = 0.0
            k, slot = (int(i) for i in np.unravel_index(int(np.argmax(length)), length.shape))
            if length[k, slot] >= self.half_width:
                raise InputError(
                    f"row {start + k}, {item.row_name(k)}: neighbouring atoms are {length[k, slot]:g} apart, not less "
                    f"than half the box ({self.half_width:g}), although a shorter distance is held between them; "
                    "bring the positions onto the constraints first",
                    item="positions",
                    atoms=item.atoms[k, slot : slot + 2],
                )

    def refuse_other_images(
        self, x: FloatArray, before: FloatArray, time: float | None, numbers: IntArray | None = None
    ) -> None:
        """Raise `ImageError` where a changed cell gives atoms that nothing ties together other images than before.

        Positions may have been moved along with the cell or not: other images are right if with them the rows are
        fulfilled, or much nearer to that. Where the time is not known (None), moving rows are not.
        """
        if self.images is None or self.lattice is None:
            return
        y = self.whole(x)
        cells = np.round((self.images.make_whole(x, before) - x) @ before[1])
        changed = np.any(cells != np.round((y - x) @ self.lattice[1]), axis=1)
        if not changed.any():
            return
        as_before = x + cells @ self.lattice[0]

        def miss(c: Constraint, whole: FloatArray) -> FloatArray:
            if time is None and c.moving:
                return np.ones(c.n_rows)
            return np.abs(self._sigma(c, self._gather(c, x, whole), 0.0 if time is None else time))

        here = self._rows(lambda c: miss(c, y)) / self.scale
        there = self._rows(lambda c: miss(c, as_before)) / self.scale
        other = np.concatenate([changed[c.atoms].any(axis=1) & c.relative for c in self.constraints if c.n_rows])
        bad = other & (here > np.maximum(1e-9, 0.5 * there))
        if bad.any():
            row = int(np.argmax(np.where(bad, here, -1.0)))
            atoms = self.row_atoms(row)
            pair = atoms[[0, int(np.argmax(changed[atoms]))]]
            raise image_error(self.row_name(row), pair if numbers is None else numbers[pair], self.half_width)

    @cached_property
    def _longest_plain(self) -> tuple[float, int]:
        """Longest constant distance that was shorter than half the box at set-up, and its row."""
        longest, row = 0.0, 0
        for item, start in zip(self.constraints, self.starts, strict=False):
            if not item.holds_length or item.moving or item.n_rows == 0:
                continue
            lengths = item.target_at(0.0) if item.whole is None else np.where(item.whole, 0.0, item.target_at(0.0))
            if lengths.max() > longest:
                longest, row = float(lengths.max()), int(start + np.argmax(lengths))
        return longest, row

    def _sigma(self, c: Constraint, r: FloatArray, time: float) -> FloatArray:
        if not c.holonomic:
            return np.zeros(c.n_rows)
        return nearest_image(c.measure(r, time) - c.target_at(time), c.period)

    def _rows(self, function: Callable[[Constraint], FloatArray]) -> FloatArray:
        return joined([function(c) for c in self.constraints])

    def whole(self, x: FloatArray) -> FloatArray:
        """Positions in which atoms of whole rows stand in the images that these rows mean; see `periodic.images`.

        `x` itself where all rows are plain.
        """
        if self.lattice is None or self.images is None:
            return x
        return self.images.make_whole(x, self.lattice)

    @cached_property
    def placed(self) -> IntArray | None:
        """Atoms of `images` at which rows with a place in space look, but for `FixedAtoms`; None if there are none."""
        rows = [c.atoms.ravel() for c in self.constraints if not c.relative and not c.fixes_atoms]
        if self.images is None or not rows:
            return None
        found = np.intersect1d(self.images.atoms, np.concatenate(rows))
        return found if len(found) else None

    def moved_places(self, stored: FloatArray, x: FloatArray) -> FloatArray | None:
        """`moved` for positions `x`, where those of the atoms `placed` were `stored`; None if these did not move."""
        cells = x[self.placed] - stored
        if not cells.any():
            return None
        moved = np.zeros(x.shape)
        moved[self.placed] = cells
        return moved

    def gather(self, item: Constraint, x: FloatArray) -> FloatArray:
        """Positions of a constraint's atoms, shape (n_rows, width, 3), in the images that its rows mean."""
        return self._gather(item, x, self.whole(x))

    def _gather(self, item: Constraint, x: FloatArray, whole: FloatArray) -> FloatArray:
        if not item.relative:
            # A place in space is that of the positions as they are stored.
            return x[item.atoms] if self.moved is None else x[item.atoms] - self.moved[item.atoms]
        r = whole[item.atoms]
        if self.lattice is None:
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


def joined(pieces: Sequence[FloatArray]) -> FloatArray:
    return np.concatenate(pieces) if pieces else np.zeros(0)


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
