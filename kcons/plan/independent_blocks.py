"""Blocks of rows: the pieces of a cluster whose ranks add up.

Two groups of rows that share one atom only (or only fixed atoms) cannot depend on each other: the forces
z = A^T lambda of one group add up to zero over its other atoms only if they do on the shared one. So the
rank of a cluster is the sum of the ranks of the 2-connected blocks of its graph, whose edges are the rows.
A row over several atoms is a cycle through them. Fixed atoms, and the frame of reference for rows that are
not translation invariant (spheres, planes), are one common vertex, the ground.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kcons.constraints.compilation import njit, plain_if_small
from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.periodic.one_piece import spanning_tree

_GROUND = -1


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
