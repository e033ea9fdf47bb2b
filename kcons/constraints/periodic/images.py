"""Which periodic image of each atom a row means.

Minimum images say it for a vector that is shorter than half the cell, and for no other. So rows are sorted at
set-up:

* A row is *plain* if a constant distance shorter than `NEARLY` half the cell is held between each two neighbors in
  its list of atoms. Minimum images along the list are then right at any time, whatever images are stored. Of a row that
  names its `Constraint.links` these are the neighbors; where they do not follow the list, the row is no plain one.
* All other rows are *whole* rows: distances nearly as long as half the cell and more (across a ring or an adsorbate),
  linear rows, free dihedrals and angles, centers of groups, moving targets. Their atoms are made whole along a
  spanning tree of the shortest links that the set has, held distances first, and the row takes positions in
  the images found there.

Rows with a place in space are neither: they take all of their atoms as they are stored. What solvers get is made
whole, so that these rows take off by how much (`ConstraintSet.moved`).

A link of the tree that no constant distance holds is *unheld*: its image is unambiguous only as long as it is
shorter than half the cell. `ConstraintSet.refuse_unheld_links` raises before it flips.

A framework that closes upon itself through the boundary (a sheet, a polymer) has rows whose images differ from
those of the tree by whole cells, the same at all times: `Constraint.cell_offsets`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from kcons.constraints.constraint import Constraint, IntArray, RowKind
from kcons.constraints.periodic.one_piece import BoolArray, connected, follow_parents, minimum_image, spanning_tree
from kcons.constraints.target import FloatArray

#: Rows of up to so many atoms offer links between all pairs of them, wider ones between neighbors in the list.
ALL_PAIRS_WIDTH = 12
#: A link that closes a framework through the boundary is a bond: not much longer than the longest of the tree.
BOND_LIKE = 1.5
#: Part of half the cell from which a held distance is followed along the tree: off its row it may be longer than half.
NEARLY = 0.9


@dataclass(frozen=True)
class Images:
    """The tree along which the atoms of whole rows, and all atoms tied to them, are made whole.

    Parents come before their children; a root is its own parent and keeps the image it is stored in.
    """

    atoms: IntArray
    parents: IntArray
    #: For unheld links the row they come from, -1 for others.
    unheld: IntArray
    #: The longest of the other links.
    longest: float = 0.0

    def make_whole(self, x: FloatArray, lattice: FloatArray) -> FloatArray:
        """Copy of `x`, shape (n_atoms, 3), with `atoms` in the images of the tree."""
        y = x.copy()
        follow_parents(y, self.atoms, self.parents, lattice)
        return y

    def follow(self, x: FloatArray, x_ref: FloatArray, y_ref: FloatArray, lattice: FloatArray) -> FloatArray:
        """Shifts, shape (k, 3), that bring `atoms` in `x` next to where they are in `y_ref`, by whole cells.

        `y_ref` is `x_ref` made whole: atoms move by less than half a cell from `x_ref` to `x`, if not wrapped.
        """
        step = x[self.atoms] - x_ref[self.atoms]
        cells = np.round((y_ref - x_ref)[self.atoms] @ lattice[1]) - np.round(step @ lattice[1])
        return cells @ lattice[0]

    def among(self, atoms: IntArray, rows: IntArray) -> Images | None:
        """The part of the tree between `atoms` and between rows `rows`, both sorted, by their places among these.

        An atom whose parent is not among them becomes a root: no row that is left needs what ties it to others.
        """
        keep = np.isin(self.atoms, atoms)
        if not keep.any():
            return None
        here, parents, unheld = self.atoms[keep], self.parents[keep], self.unheld[keep]
        parents = np.where(np.isin(parents, atoms), parents, here)
        # An unheld link may come from a row that is not among these; any of them may name it.
        place = np.minimum(np.searchsorted(rows, unheld), max(len(rows) - 1, 0))
        found = np.searchsorted(atoms, here), np.searchsorted(atoms, parents)
        return Images(*found, np.where(unheld < 0, -1, place), self.longest)

    def ancestors(self, needed: IntArray, n_atoms: int) -> IntArray:
        """`needed` and the atoms by which they are made whole."""
        parent, keep = np.arange(n_atoms), np.zeros(n_atoms, bool)
        parent[self.atoms] = self.parents
        while len(needed):
            keep[needed] = True
            needed = parent[needed]
            needed = needed[~keep[needed]]
        return self.atoms[keep[self.atoms]]


def find_images(
    constraints: Sequence[Constraint],
    starts: IntArray,
    x: FloatArray,
    lattice: FloatArray | None,
    half_width: float,
    time: float,
    ties: Sequence[Constraint] = (),
) -> tuple[list[Constraint], Images | None]:
    """Copies that know which of their rows are whole, with their cell_offsets; and the tree, None if all are plain.

    Targets may still be missing; `starts` are the first rows, `ties` what the constraints replace: rows that are held
    still and tie atoms together. A link of the tree as long as half the cell is refused: its image is ambiguous.
    """
    given = [item.changed(whole=None, cell_offsets=None) for item in constraints]
    if lattice is None:
        return given, None
    place = (x, lattice, half_width, time)
    tables = [
        _Links(item, int(start), *place)
        for item, start in zip(given, starts, strict=False)
        if item.relative and item.n_rows
    ]
    n_atoms = len(x)
    bonds = [table for table in tables if table.held]
    if any(table.unsure.any() for table in bonds):
        # Lengths as found are right in pieces whose links, laid end to end, are shorter than half the cell.
        pairs = np.concatenate([table.item.atoms for table in bonds])
        piece, _ = connected(pairs, n_atoms)
        reach = np.bincount(piece[pairs[:, 0]], weights=np.concatenate([table.lengths[:, 0] for table in bonds]))
        for table in bonds:
            table.unsure &= reach[piece[table.item.atoms[:, 0]]] >= half_width
    ties = [item for item in ties if item.holds_length and not item.moving and item.n_rows]
    others = [_Links(item.changed(whole=None, cell_offsets=None), 0, *place) for item in ties]
    held = [*bonds, *others]
    keys = np.concatenate([np.zeros(0, np.int64), *(t.short(n_atoms) for t in held)])
    for table in tables:
        table.sort_rows(keys, n_atoms)
    if not any(table.whole.any() or table.unsure.any() for table in tables):
        return given, None
    firm = np.zeros(n_atoms, bool)
    for item in given:
        if item.width == 1:
            firm[item.atoms] = True
    images, longest, component = _tree([*tables, *others], firm, x, lattice, half_width)
    y = images.make_whole(x, lattice)
    frameworks = np.zeros(int(component.max(initial=-1)) + 1, bool)
    for table in tables:
        table.find_closures(y, lattice, longest, component, frameworks)
        for k in table.untied(images, n_atoms):
            _refuse_long([table], table.start + int(k), table.item.atoms[k], float(table.lengths[k, 0]), half_width)
    pairs = np.concatenate([t.item.atoms for t in held] or [np.zeros((0, 2), np.int64)])
    ends = np.concatenate([pairs, pairs[:, ::-1]]).T
    neighbors = sp.csr_array((np.ones(ends.shape[1]), (ends[0], ends[1])), shape=(n_atoms, n_atoms))
    for table in tables:
        table.settle(component, frameworks, neighbors)
    needed = np.zeros(len(frameworks), bool)
    for table in tables:
        needed[component[table.item.atoms[table.whole].ravel()]] = True
    marked = {id(t.item): t.marked(needed[component[t.item.atoms[:, 0]]]) for t in tables}
    keep = needed[component[images.atoms]]
    result = [marked.get(id(item), item) for item in given]
    if not keep.any():
        return result, None
    return result, Images(images.atoms[keep], images.parents[keep], images.unheld[keep], images.longest)


class _Links:
    """The links that the rows of one constraint offer, between neighbors in the list and others.

    `whole` and `unsure` (distances whose target is still to be taken from one image or another) are by row.
    """

    def __init__(
        self, item: Constraint, start: int, x: FloatArray, lattice: FloatArray, half_width: float, time: float
    ) -> None:
        self.item, self.start, self.half_width, self.time = item, start, half_width, time
        chain = np.stack([np.arange(item.width - 1), np.arange(1, item.width)], axis=1)
        self.links = chain if item.links is None else item.links
        self._in_line = np.array_equal(self.links, chain)
        self.neighbors = item.linked
        raw = x[self.neighbors[..., 1]] - x[self.neighbors[..., 0]]
        nearest = minimum_image(raw, lattice)
        self.lengths = np.linalg.norm(nearest, axis=2)
        #: Held at one length for good.
        self.held = item.holds_length and not item.moving
        # Until the tree is known: the length found may be that of another image.
        self.unsure: BoolArray = np.full(item.n_rows, self.held and item.target is None)
        self.cell_offsets = np.zeros((item.n_rows, item.width, 3), np.int64)
        if self.held and item.target is not None:
            self.lengths = item.target_at(time)[:, None]
        self.whole: BoolArray = ~self.unsure & self.held & (self.lengths[:, 0] >= NEARLY * half_width)
        self._local: BoolArray = np.zeros(item.n_rows, np.bool_)

    def short(self, n_atoms: int) -> IntArray:
        """Keys of the pairs that constant distances shorter than half the cell tie."""
        pairs = np.sort(self.item.atoms[~self.whole & (self.lengths[:, 0] < self.half_width)], axis=1)
        return pairs[:, 0] * n_atoms + pairs[:, 1]

    def sort_rows(self, keys: IntArray, n_atoms: int) -> None:
        """Rows along links that are not among the held ones are whole rows."""
        if self.held:
            return
        pairs = np.sort(self.neighbors, axis=2)
        wanted = pairs[..., 0] * n_atoms + pairs[..., 1]
        found = np.isin(wanted, keys)
        # The compiled solvers know minimum images of distances, angles and dihedrals only.
        self.whole = np.logical_not(found.all(axis=1)) | (self.item.kind == RowKind.LINEAR) | (not self._in_line)

    def offered(self) -> tuple[NDArray[Any], ...]:
        """Links offered to the tree: pairs of atoms, lengths (NaN: unknown), rows, if held, if distances."""
        rows = np.repeat(np.arange(self.item.n_rows), len(self.links))
        pairs, lengths = self.neighbors.reshape(-1, 2), self.lengths.ravel()
        if self.item.links is None and 2 < self.item.width <= ALL_PAIRS_WIDTH and self.whole.any():
            a, b = np.triu_indices(self.item.width, 2)
            more = self.item.atoms[self.whole]
            pairs = np.concatenate([pairs, np.stack([more[:, a], more[:, b]], axis=-1).reshape(-1, 2)])
            lengths = np.concatenate([lengths, np.full(len(more) * len(a), np.nan)])
            rows = np.concatenate([rows, np.repeat(np.flatnonzero(self.whole), len(a))])
        kinds = (np.full(len(rows), kind) for kind in (self.held, self.item.holds_length))
        return pairs, lengths, self.start + rows, *kinds

    def find_closures(
        self, y: FloatArray, lattice: FloatArray, longest: FloatArray, component: IntArray, frameworks: BoolArray
    ) -> None:
        """Rows that mean minimum images rather than those of the tree, and which components close by them."""
        item = self.item
        label = component[item.atoms[:, 0]]
        r = y[item.atoms]
        apart = r[:, self.links[:, 1]] - r[:, self.links[:, 0]]
        cells = -np.round(apart @ lattice[1]).astype(np.int64)
        nearest = np.linalg.norm(apart + cells @ lattice[0], axis=2)
        differs = cells.any(axis=2)
        self._long = np.linalg.norm(apart, axis=2)[:, 0] >= NEARLY * self.half_width
        for k, (before, after) in enumerate(self.links):
            self.cell_offsets[:, after] = self.cell_offsets[:, before] + cells[:, k]
        if item.target is not None and item.holonomic:
            # The target tells which of the two is meant.
            other = r + self.cell_offsets @ lattice[0]
            with np.errstate(all="ignore"):
                closing = np.abs(item.sigma(other, self.time)) < 0.5 * np.abs(item.sigma(r, self.time))
        else:
            bonds = (nearest < self.half_width) & (nearest <= BOND_LIKE * longest[label][:, None])
            if item.links is not None:
                bonds = nearest < self.half_width
            closing = (bonds | ~differs).all(axis=1)
            self._local = (nearest < self.half_width).all(axis=1)
            self._nearest = nearest
        self._closing = closing & differs.any(axis=1)
        frameworks[label[self._closing]] = True

    def untied(self, images: Images, n_atoms: int) -> IntArray:
        """Distances of half the cell or more that close, through the boundary, what unheld links alone tie."""
        given = self.held and self.item.target is not None
        long = np.flatnonzero(self._closing & self.whole & given)
        if not len(long):
            return long
        tied = images.unheld < 0
        body, _ = connected(np.stack([images.atoms[tied], images.parents[tied]], axis=1), n_atoms)
        return long[body[self.item.atoms[long, 0]] != body[self.item.atoms[long, 1]]]

    def settle(self, component: IntArray, frameworks: BoolArray, held: sp.csr_array) -> None:
        """Rows beside the tree: in a body they have its images, in a framework they are local."""
        closing = self._closing | (frameworks[component[self.item.atoms[:, 0]]] & self._local)
        if self.held and self.item.target is None:
            # Lengths that are to be found, of rows that may as well close through the boundary as span a body; in a
            # body that is held by distances they are one side of a triangle of such.
            doubtful = self.cell_offsets.any(axis=(1, 2)) & ~closing & self._local
            for k in np.flatnonzero(doubtful):
                a, b = (held[[atom]] for atom in self.item.atoms[k])
                doubtful[k] = not a.multiply(b).nnz
            words = "apart across the boundary, and farther along the rows that tie them. Give the target of this row"
            apart = self._nearest[:, 0]
            self.item.refuse(
                doubtful,
                self.start,
                lambda k: f"its periodic image is ambiguous: its atoms are {apart[k]:g} {words}",
                "target",
            )
        if self.held:
            self.whole |= self.unsure & ~closing & (self.cell_offsets.any(axis=(1, 2)) | self._long)
        self.cell_offsets[~closing] = 0

    def marked(self, needed: BoolArray) -> Constraint:
        """A copy that knows its whole rows, and the cell_offsets of all rows whose atoms are made whole."""
        self.cell_offsets[~needed] = 0
        offsets = self.cell_offsets if self.cell_offsets.any() else None
        if offsets is None and not self.whole.any():
            return self.item
        return self.item.changed(whole=self.whole, cell_offsets=offsets)


def _tree(
    tables: Sequence[_Links], firm: BoolArray, x: FloatArray, lattice: FloatArray, half_width: float
) -> tuple[Images, FloatArray, IntArray]:
    """Spanning forest of the shortest links, held ones first; the longest link and the number of each component.

    Atoms that are `firm`, fixed or in a row of their own with a place in space, are not moved where that can be had.
    """
    from scipy.sparse.csgraph import minimum_spanning_tree  # slow to import

    n_atoms = len(x)
    pair, length, row, held, distance = map(np.concatenate, zip(*(table.offered() for table in tables), strict=True))
    pair = np.sort(pair, axis=1)
    unknown = np.isnan(length)
    apart = x[pair[unknown, 1]] - x[pair[unknown, 0]]
    length[unknown] = np.linalg.norm(minimum_image(apart, lattice), axis=1)
    # Held links as long as half the cell have no image of their own; they come last, to be refused. Links that nothing
    # holds may grow, so that distances that move are taken before such as are little shorter.
    order = np.lexsort((np.where(distance, length, BOND_LIKE * length), ~held, length >= half_width))
    _, first = np.unique(pair[order, 0] * n_atoms + pair[order, 1], return_index=True)
    chosen = order[np.sort(first)]
    ranks = np.arange(1.0, len(chosen) + 1)
    ends = pair[chosen].T.astype(np.int32)  # older SciPy makes no tree of wider indices
    graph = sp.csr_array((ranks, (ends[0], ends[1])), shape=(n_atoms, n_atoms))
    forest = minimum_spanning_tree(graph).tocoo()
    link = chosen[np.asarray(forest.data, dtype=np.int64) - 1]
    if np.any(length[link] >= half_width):
        worst = int(link[np.argmax(length[link])])
        _refuse_long(tables, int(row[worst]), pair[worst], float(length[worst]), half_width)
    component, count = connected(pair[link], n_atoms)
    longest = np.zeros(count)
    np.maximum.at(longest, component[pair[link, 0]], length[link])
    atoms, parents = spanning_tree(pair[link], n_atoms, np.argsort(~firm, kind="stable"))
    parent_of, unheld = np.empty(n_atoms, np.int64), np.full(n_atoms, -1)
    parent_of[atoms] = parents
    i, j = pair[link].T
    unheld[np.where(parent_of[j] == i, j, i)] = np.where(held[link], -1, row[link])
    tied = np.isin(atoms, pair[link])
    atoms, parents = atoms[tied], parents[tied]
    ties = float(np.max(length[link][held[link]], initial=0.0))
    return Images(atoms, parents, unheld[atoms], ties), longest, component


def _refuse_long(tables: Sequence[_Links], row: int, pair: IntArray, length: float, half_width: float) -> None:
    table = next(table for table in tables if 0 <= row - table.start < table.item.n_rows)
    item, (a, b), half = table.item, pair, f"half the box ({half_width:g})"
    what = f"target {length:g}" if item.holds_length else f"distance {length:g} of atoms {a} and {b}"
    remedy = "Use a larger cell, no cell, or list the atoms so that neighbors in the row are neighbors in space"
    words = f"{what} is not shorter than {half}, and no shorter rows tie these atoms together; its minimum image is"
    here = table.start + np.arange(item.n_rows) == row
    at_fault = "target" if item.holds_length else "positions"
    item.refuse(here, table.start, lambda k: f"{words} ambiguous. {remedy}", at_fault)
