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
from kcons.plan.clusters import joined

_GROUND = -1


def fixed_atoms(constraint_set: ConstraintSet) -> IntArray:
    """Atoms that FixedAtoms of the set hold, sorted."""
    fixed = [c.atoms[:, 0] for c in constraint_set.constraints if c.fixes_atoms]
    return np.unique(np.concatenate(fixed)) if fixed else np.zeros(0, np.int64)


def row_blocks(
    constraint_set: ConstraintSet, accept: Callable[[Constraint], bool], rows: IntArray | None = None
) -> tuple[IntArray, IntArray]:
    """Blocks of two rows and more, of the objects that `accept` takes and of `rows` (sorted; all by default).

    Velocity rows and fixed atoms never take part. Gives members and starts: block k consists of the rows
    ``members[starts[k]:starts[k + 1]]``, sorted; nothing for forests.
    """
    ground = fixed_atoms(constraint_set)
    ends: list[tuple[IntArray, IntArray, IntArray, bool]] = []
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
        ends.append((nodes[:, :-1].ravel(), nodes[:, 1:].ravel(), np.repeat(numbers, nodes.shape[1] - 1), False))
        if nodes.shape[1] > 2:
            ends.append((nodes[:, -1], nodes[:, 0], numbers, True))
    nothing = np.zeros(0, np.int64), np.zeros(1, np.int64)
    if not ends:
        return nothing
    u = np.concatenate([e[0] for e in ends])
    v = np.concatenate([e[1] for e in ends])
    row = np.concatenate([e[2] for e in ends])
    closing = np.concatenate([np.full(len(e[0]), e[3]) for e in ends])
    proper = u != v
    u, v, row, closing = u[proper], v[proper], row[proper], closing[proper]
    vertices, index = np.unique(np.concatenate([u, v]), return_inverse=True)
    u, v = index[: len(u)], index[len(u) :]
    sides = np.stack([u[~closing], v[~closing]], axis=1)
    n_parts = int(joined(2 * np.arange(len(sides) + 1), sides.ravel(), len(vertices)).max(initial=-1)) + 1
    if len(sides) == len(vertices) - n_parts:  # no edge closes a cycle
        return nothing
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
    blocks: IntArray = plain_if_small(_edge_blocks, len(u))(u, v, n_vertices)
    return blocks


@njit(cache=True)
def _edge_blocks(u, v, n_vertices):  # type: ignore[no-untyped-def]
    # Hopcroft and Tarjan 1973, with own stack.
    n_edges = len(u)
    start = np.zeros(n_vertices + 1, np.int64)
    for e in range(n_edges):
        start[u[e] + 1] += 1
        start[v[e] + 1] += 1
    for a in range(n_vertices):
        start[a + 1] += start[a]
    fill = start[:-1].copy()
    half = np.empty(2 * n_edges, np.int64)
    for e in range(n_edges):
        half[fill[u[e]]] = e
        fill[u[e]] += 1
        half[fill[v[e]]] = e
        fill[v[e]] += 1
    next_half = start[:-1].copy()
    found = np.full(n_vertices, -1, np.int64)
    low = np.zeros(n_vertices, np.int64)
    block = np.full(n_edges, -1, np.int64)
    open_edges = np.empty(n_edges, np.int64)
    path = np.empty(n_vertices, np.int64)
    via = np.empty(n_vertices, np.int64)
    n_open, clock, n_blocks = 0, 0, 0
    for root in range(n_vertices):
        if found[root] >= 0:
            continue
        found[root] = low[root] = clock
        clock += 1
        depth = 0
        path[0], via[0] = root, -1
        while depth >= 0:
            a = path[depth]
            if next_half[a] < start[a + 1]:
                e = half[next_half[a]]
                next_half[a] += 1
                if e == via[depth]:
                    continue
                b = u[e] + v[e] - a
                if found[b] < 0:
                    open_edges[n_open] = e
                    n_open += 1
                    found[b] = low[b] = clock
                    clock += 1
                    depth += 1
                    path[depth], via[depth] = b, e
                elif found[b] < found[a]:
                    open_edges[n_open] = e
                    n_open += 1
                    low[a] = min(low[a], found[b])
                continue
            depth -= 1
            if depth < 0:
                break
            p, e = path[depth], via[depth + 1]
            low[p] = min(low[p], low[a])
            if low[a] >= found[p]:
                while True:
                    n_open -= 1
                    last = open_edges[n_open]
                    block[last] = n_blocks
                    if last == e:
                        break
                n_blocks += 1
    return block
