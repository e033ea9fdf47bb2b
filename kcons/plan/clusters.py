"""Which rows belong together, and what shape each cluster has; clusters that look alike; pieces whose ranks add up.

Two groups of rows that share one atom only (or only fixed atoms) cannot depend on each other: the forces
z = A^T lambda of one group add up to zero over its other atoms only if they do on the shared one. So the
rank of a cluster is the sum of the ranks of the 2-connected blocks of its graph, whose edges are the rows.
A row over several atoms is a cycle through them. Fixed atoms, and the frame of reference for rows that are
not translation invariant (spheres, planes), are one common vertex, the ground.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.compilation import njit, plain_if_small
from kcons.constraints.constraint import Constraint, IntArray, RowKind
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.periodic.one_piece import BoolArray, connected, spanning_tree
from kcons.constraints.target import FloatArray
from kcons.solvers.small_clusters import LARGEST

#: Fewer clusters alike than this are left to the sparse solver, which takes all shapes in one call.
LANES_CLUSTERS = 8

#: Shapes have the names of the solvers that serve them.
ShapeKind = Literal[
    "RigidTriangles", "SmallClusters", "Chains", "SparseDistances", "SingleRows", "SparseRows", "GeneralClusters"
]
_NONE = np.zeros(0, np.int64)
_GROUND = -1
#: Rows with more couplings than the fewest that a row has, by so many times and so many, wait for a later level: what
#: they would fill in costs more than the levels that they save.
MORE_TIMES, MORE = 1.2, 20


@dataclass(frozen=True)
class Shape:
    """Clusters that go to one solver.

    Attributes
    ----------
    kind : str
        Which solver serves them.
    rows : ndarray of int64
        Row numbers: (n_clusters, K) for 'RigidTriangles' and 'SmallClusters', flat otherwise.
    clusters : int
    independent : bool
        True if the graph alone shows that no row depends on others (trees of distances).
    atoms : ndarray of int64
        'RigidTriangles', 'SmallClusters': (n_clusters, n_local); 'Chains': atoms in path order, one path after another.
    pairs : ndarray of int64, shape (K, 2) or (n_rows, 2)
        'SmallClusters': local atoms of each row; 'SparseDistances': atoms of each row.
    starts : ndarray of int64
        'Chains': first atom of each path, and the end.
    """

    kind: ShapeKind
    rows: IntArray
    clusters: int
    independent: bool
    atoms: IntArray = field(default_factory=lambda: _NONE)
    pairs: IntArray = field(default_factory=lambda: _NONE)
    starts: IntArray = field(default_factory=lambda: _NONE)


def cluster_labels(constraint_set: ConstraintSet, pinned: IntArray) -> IntArray:
    """Cluster number of each row, by its first row: rows that share a movable atom belong together; -1 without one."""
    incidence = constraint_set.incidence
    n_rows, n_atoms = incidence.shape
    free = np.ones(n_atoms, dtype=bool)
    free[pinned] = False
    row = np.repeat(np.arange(n_rows), np.diff(incidence.indptr))
    inside = free[incidence.indices]
    links = np.stack([row[inside], n_rows + incidence.indices[inside]], axis=1)
    movable = np.bincount(row[inside], minlength=n_rows) > 0
    found = connected(links, n_rows + n_atoms)[0][:n_rows][movable]
    labels = np.full(n_rows, -1, dtype=np.int64)
    labels[movable] = (np.cumsum(np.bincount(found) > 0) - 1)[found]
    return labels


def atom_labels(constraint_set: ConstraintSet, labels: IntArray, inverse_masses: FloatArray) -> IntArray:
    """Cluster of each atom, by those of the rows; -1 for atoms that belong to none, and for fixed ones."""
    incidence = constraint_set.incidence
    found = np.full(constraint_set.n_atoms, -1, dtype=np.int64)
    of_entry = np.repeat(labels, np.diff(incidence.indptr))
    found[incidence.indices[of_entry >= 0]] = of_entry[of_entry >= 0]
    found[inverse_masses == 0] = -1
    return found


def classify(constraint_set: ConstraintSet, labels: IntArray, inverse_masses: FloatArray) -> Iterator[Shape]:
    """Sort the clusters by the shape of their graph; vectorized over clusters."""
    n_clusters = int(labels.max(initial=-1)) + 1
    if n_clusters == 0:
        return
    kinds, pairs = _row_tables(constraint_set)
    inside = labels >= 0
    n_rows = np.bincount(labels[inside], minlength=n_clusters)

    def only(rows: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return np.bincount(labels[inside & ~rows], minlength=n_clusters) == 0

    distances_only, compiled = only(kinds == RowKind.DISTANCE), only(kinds != RowKind.INTERPRETED)

    atom_label, movable = atom_labels(constraint_set, labels, inverse_masses), inverse_masses > 0
    incidence = constraint_set.incidence
    entry_label = np.repeat(labels, np.diff(incidence.indptr))
    n_atoms = np.bincount(atom_label[atom_label >= 0], minlength=n_clusters)
    anchored = np.zeros(n_clusters, dtype=bool)
    to_fixed = ~movable[incidence.indices] & (entry_label >= 0)
    anchored[entry_label[to_fixed]] = True

    tree = distances_only & ((n_rows == n_atoms - 1) | ((n_rows == n_atoms) & anchored))
    small = distances_only & ~anchored & (n_rows <= LARGEST)
    left_over = np.zeros(n_clusters, dtype=bool)
    if small.any():
        for shape, members in _small_shapes(pairs, labels, small, inverse_masses, tree):
            if shape is None:
                left_over[members] = True
            else:
                yield shape
    degree = np.zeros(constraint_set.n_atoms, dtype=np.int64)
    distance_rows = inside & (kinds == RowKind.DISTANCE)
    np.add.at(degree, pairs[distance_rows].ravel(), 1)
    largest = np.zeros(n_clusters, dtype=np.int64)
    np.maximum.at(largest, atom_label[atom_label >= 0], degree[atom_label >= 0])
    path = tree & ~anchored & ~small & (largest <= 2)
    sparse = distances_only & ~path & (~small | left_over)
    single = only(kinds == RowKind.FUNCTION) & (n_rows == 1)
    if constraint_set.images is not None:
        single &= ~anchored  # fixed atoms may be moved to another image, of which single rows know nothing
    kinds_of: tuple[tuple[ShapeKind, NDArray[np.bool_]], ...] = (
        ("Chains", path),
        ("SparseDistances", sparse & tree),
        ("SparseDistances", sparse & ~tree),
        ("SingleRows", single),
        ("SparseRows", compiled & ~distances_only & ~single),
        ("GeneralClusters", ~compiled),
    )
    for kind, chosen in kinds_of:
        if chosen.any():
            rows, clusters = np.flatnonzero(inside & chosen[np.maximum(labels, 0)]), int(chosen.sum())
            if kind == "Chains":
                yield _paths(rows, pairs[rows], constraint_set.n_atoms, clusters)
            else:
                yield Shape(kind, rows, clusters, bool((sparse & tree)[labels[rows[0]]]), pairs=pairs[rows])


def _row_tables(constraint_set: ConstraintSet) -> tuple[NDArray[np.int64], IntArray]:
    """Kind of each row, and the atoms of the distance rows (-1 elsewhere)."""
    kinds = np.zeros(constraint_set.n_rows, dtype=np.int64)
    pairs = np.full((constraint_set.n_rows, 2), -1, dtype=np.int64)
    for item, start in zip(constraint_set.constraints, constraint_set.starts, strict=False):
        rows = slice(start, start + item.n_rows)
        kinds[rows] = item.kind
        if item.cell_offsets is not None:  # whole cells between the atoms of a row: for no compiled solver
            kinds[start + np.flatnonzero(item.cell_offsets.any(axis=(1, 2)))] = RowKind.INTERPRETED
        if item.kind == RowKind.DISTANCE:
            pairs[rows] = item.atoms
    return kinds, pairs


def _small_shapes(
    pairs: IntArray, labels: IntArray, small: NDArray[np.bool_], w: FloatArray, tree: NDArray[np.bool_]
) -> Iterator[tuple[Shape | None, IntArray]]:
    """Groups of small clusters with the same graph and masses; None for those with too few alike."""
    rows = np.flatnonzero((labels >= 0) & small[np.maximum(labels, 0)])
    ends = pairs[rows]
    degree = np.zeros(len(w), dtype=np.int64)
    np.add.at(degree, ends.ravel(), 1)
    # Canonical orientation and order, so that equal clusters look equal: center first, then by mass.
    a, b = ends[:, 0], ends[:, 1]
    place = np.argsort(np.lexsort((w, -degree)))
    swap = place[a] > place[b]
    ends = np.where(swap[:, None], ends[:, ::-1], ends)
    a, b = ends[:, 0], ends[:, 1]
    order = np.lexsort((b, a, w[b], -degree[b], w[a], -degree[a], labels[rows]))
    rows, ends = rows[order], ends[order]
    cluster = labels[rows]
    numbers, first, sizes = np.unique(cluster, return_index=True, return_counts=True)
    waiting: list[tuple[Shape, IntArray]] = []
    for size in np.unique(sizes):
        chosen = np.flatnonzero(sizes == size)
        table = first[chosen][:, None] + np.arange(size)
        flat = ends[table].reshape(len(chosen), -1)
        met = np.argmax(flat[:, :, None] == flat[:, None, :], axis=2)
        new = met == np.arange(2 * size)
        local = np.take_along_axis(np.cumsum(new, axis=1) - 1, met, axis=1)
        mass_number = np.unique(w[flat], return_inverse=True)[1].reshape(flat.shape)
        signature = np.concatenate([local, mass_number], axis=1)
        _, group = np.unique(signature, axis=0, return_inverse=True)
        group = group.ravel()
        for g in range(int(group.max()) + 1):
            members = np.flatnonzero(group == g)
            one = members[0]
            where = np.flatnonzero(new[one])
            atoms = flat[members][:, where]
            local_pairs = local[one].reshape(-1, 2)
            shape = Shape(
                "RigidTriangles" if np.array_equal(local_pairs, [[0, 1], [0, 2], [1, 2]]) else "SmallClusters",
                rows[table[members]],
                len(members),
                bool(tree[numbers[chosen[one]]]),
                atoms=atoms,
                pairs=local_pairs,
            )
            waiting.append((shape, numbers[chosen[members]]))
    few = sum(shape.clusters < LANES_CLUSTERS for shape, _ in waiting)
    for shape, members in waiting:
        # A handful of groups is served in lanes however few their members.
        yield (None if few > 2 and shape.clusters < LANES_CLUSTERS else shape), members


def _paths(rows: IntArray, pairs: IntArray, n_atoms: int, clusters: int) -> Shape:
    """Order the rows and atoms of open chains from one end to the other."""
    ends = pairs.ravel()
    ends = ends[np.bincount(ends, minlength=n_atoms)[ends] == 1]
    label, _ = connected(pairs, n_atoms)
    # A chain begins with the end that comes first, and chains have the order of these.
    begins = ends[np.sort(np.unique(label[ends], return_index=True)[1])]
    number = np.full(len(label), -1)
    number[label[begins]] = np.arange(clusters)
    tree, _ = spanning_tree(pairs, n_atoms, np.concatenate([begins, np.arange(n_atoms)]))
    tree = tree[number[label[tree]] >= 0]
    chain = number[label[tree]]
    atoms = tree[np.argsort(chain, kind="stable")]
    place = np.empty(n_atoms, np.int64)
    place[atoms] = np.arange(len(atoms))
    order = np.argsort(place[pairs].max(axis=1))
    starts = np.concatenate([[0], np.cumsum(np.bincount(chain, minlength=clusters))])
    return Shape("Chains", rows[order], clusters, True, atoms=atoms, starts=starts, pairs=pairs[order])


# -- clusters alike ----------------------------------------------------------------------------------


class Alike(NamedTuple):
    """Clusters with equal rows: their atoms, shape (n, n_atoms), and their rows in the set, shape (n, n_rows)."""

    atoms: IntArray
    rows: IntArray


def alike(
    labels: IntArray, last: BoolArray, rows: Sequence[Hashable], atoms: Sequence[IntArray]
) -> dict[tuple[tuple[Any, tuple[int, ...]], ...], Alike]:
    """Clusters by what they are made of: of each row what it is, and its atoms as they are met.

    `labels` are the clusters of the rows, -1 for none; rows that are `last` come after the others of their cluster.
    `rows` say what each row is, equal for rows that are computed alike, and `atoms` are those of each row.
    """
    order = np.lexsort((last, labels))
    order = order[labels[order] >= 0]
    cuts = np.flatnonzero(np.diff(labels[order])) + 1
    found: dict[tuple[Any, ...], tuple[list[list[int]], list[IntArray]]] = {}
    for cluster in np.split(order, cuts) if len(order) else []:
        place: dict[int, int] = {}
        pattern = []
        for row in cluster.tolist():
            local = tuple(place.setdefault(a, len(place)) for a in atoms[row].tolist())
            pattern.append((rows[row], local))
        mine = found.setdefault(tuple(pattern), ([], []))
        mine[0].append(list(place))
        mine[1].append(cluster)
    return {key: Alike(np.array(each[0]), np.array(each[1])) for key, each in found.items()}


class Order(NamedTuple):
    """Rows in the order of elimination, where levels begin in it, and the later rows that each is coupled to."""

    rows: IntArray
    levels: IntArray
    later: list[IntArray]


def elimination(atoms: Sequence[Sequence[int]], last: set[int]) -> Order:
    """Order of elimination of rows by levels: in each level rows that share no entry, those with few couplings first.

    Parameters
    ----------
    atoms : sequence of sequence of int
        Atoms of each row; rows that share one are coupled.
    last : set of int
        Rows that come after all others that they are coupled to.
    """
    users: dict[int, set[int]] = {}
    for k, some in enumerate(atoms):
        for a in some:
            users.setdefault(a, set()).add(k)
    coupled = [set().union(*(users[a] for a in some)) - {k} for k, some in enumerate(atoms)]
    left, order, levels = set(range(len(atoms))), list[int](), [0]
    while left:
        beside: set[int] = set()
        ready = [(len(coupled[k]), k) for k in left if not (k in last and coupled[k] - last)]
        most = MORE_TIMES * min(ready)[0] + MORE
        for count, k in sorted(ready):
            if k not in beside and count <= most:
                order.append(k)
                beside |= coupled[k]
        for k in order[levels[-1] :]:
            for other in coupled[k]:
                coupled[other] |= coupled[k]
                coupled[other] -= {other, k}
        left.difference_update(order[levels[-1] :])
        levels.append(len(order))
    place = np.argsort(order)
    return Order(np.array(order), np.array(levels), [np.sort(place[list(coupled[k])]) for k in order])


# -- blocks ------------------------------------------------------------------------------------------


def fixed_atoms(constraint_set: ConstraintSet) -> IntArray:
    """Atoms that FixedAtoms of the set hold, sorted."""
    return fixed_rows(constraint_set)[0]


def fixed_rows(constraint_set: ConstraintSet) -> tuple[IntArray, IntArray]:
    """Fixed atoms, sorted, and their rows, three an atom; the first ones of an atom that is named again."""
    pairs = zip(constraint_set.constraints, constraint_set.starts, strict=False)
    found = [(item.atoms[::3, 0], start + np.arange(0, item.n_rows, 3)) for item, start in pairs if item.fixes_atoms]
    none = np.zeros(0, np.int64)
    atoms, rows = (np.concatenate([none, *parts]) for parts in (zip(*found, strict=True) if found else ([], [])))
    atoms, first = np.unique(atoms, return_index=True)
    return atoms, (rows[first][:, None] + np.arange(3)).ravel()


def row_blocks(
    constraint_set: ConstraintSet, accept: Callable[[Constraint], bool], rows: IntArray | None = None
) -> tuple[IntArray, IntArray]:
    """Blocks of two rows and more, of the objects that `accept` takes and of `rows` (sorted; all by default).

    Velocity rows and fixed atoms never take part. Gives members and starts: block k consists of the rows
    ``members[starts[k]:starts[k + 1]]``, sorted; nothing for forests.
    """
    ground = fixed_atoms(constraint_set)
    ends: list[tuple[IntArray, IntArray, IntArray]] = []
    for item, start in zip(constraint_set.constraints, constraint_set.starts, strict=False):
        if not item.holonomic or item.fixes_atoms or not accept(item) or item.n_rows == 0:
            continue
        numbers = np.arange(start, start + item.n_rows)
        nodes = item.atoms
        if rows is not None:
            lo, hi = np.searchsorted(rows, [start, start + item.n_rows])
            numbers = rows[lo:hi]
            nodes = nodes[numbers - start]
        if len(ground):
            nodes = np.where(np.isin(nodes, ground), _GROUND, nodes)
        if not item.translation_invariant:
            nodes = np.hstack([nodes, np.full((len(nodes), 1), _GROUND)])
        # A row of several atoms is a cycle through them.
        sides, ahead = (nodes.shape[1] if nodes.shape[1] > 2 else 1), np.roll(nodes, -1, axis=1)
        ends.append((nodes[:, :sides].ravel(), ahead[:, :sides].ravel(), np.repeat(numbers, sides)))
    if not ends:
        return np.zeros(0, np.int64), np.zeros(1, np.int64)
    u, v, row = (np.concatenate(parts) for parts in zip(*ends, strict=True))
    u, v, row = u[u != v], v[u != v], row[u != v]
    vertices, index = np.unique(np.concatenate([u, v]), return_inverse=True)
    u, v = index[: len(u)], index[len(u) :]
    block = edge_blocks(u, v, len(vertices))
    # A wide row has several edges, all in one block.
    keys = np.unique(block * constraint_set.n_rows + row)
    block, row = np.divmod(keys, constraint_set.n_rows)
    sizes = np.bincount(block)
    keep = sizes[block] > 1
    sizes = sizes[sizes > 1]
    return row[keep], np.concatenate([[0], np.cumsum(sizes)])


def edge_blocks(u: IntArray, v: IntArray, n_vertices: int) -> IntArray:
    """Number of the 2-connected block of each edge, from u to v, of a multigraph without loops."""
    vertices, parents = spanning_tree(np.stack([u, v], axis=1), n_vertices)
    place = np.argsort(vertices)
    blocks: IntArray = plain_if_small(_edge_blocks, len(u))(place[u], place[v], place[parents])
    return blocks


@njit(cache=True)
def _edge_blocks(u, v, parent):  # type: ignore[no-untyped-def]
    # Each edge and those of the tree on the way between its ends are one cycle. Vertices come after their parents,
    # breadth first; one stands for the edge to its parent, the first of a block for the block.
    block = np.arange(len(parent))
    for e in range(len(u)):
        a, b, cycle = u[e], v[e], -1
        while a != b:
            a, b = max(a, b), min(a, b)
            while block[a] != a:
                block[a] = block[block[a]]
                a = block[a]
            if cycle >= 0:
                block[max(a, cycle)] = min(a, cycle)
            cycle = a if cycle < 0 else min(a, cycle)
            a = parent[a]
    for k in range(len(block)):
        block[k] = block[block[k]]
    return block[np.maximum(u, v)]
