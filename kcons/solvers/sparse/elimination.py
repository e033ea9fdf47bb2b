"""Sparse elimination of A M^-1 A^T: order and pattern found once, numbers filled in at every solve.

Rows are eliminated by minimum degree (leaf first: chains and hydrocarbons have no fill), then renumbered in
postorder of the elimination tree, so that clusters, and branches within them, lie together in memory. The pattern
is symmetric; the numbers need not be (Newton's matrix for positions is not).

Storage, in elimination order: row k has diagonal `diagonal[k]` and, for every later row l = `columns[e]`
coupled to it, e in [start[k], start[k+1]), the pair upper[e] = A_kl and lower[e] = A_lk. Eliminating k
changes the pairs of its later rows; `targets` lists, pair by pair, which entry each one changes.

References
----------
George & Liu, Computer Solution of Large Sparse Positive Definite Systems (1981), chapters 4 and 5.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from kcons.constraints.compilation import njit, plain_if_small
from kcons.constraints.constraint import IntArray
from kcons.errors import UnsupportedError

UIntArray = NDArray[np.uint32]

#: `nnan` and `ninf` are left out on purpose: a NaN must fail every comparison with a tolerance.
FAST = {"contract", "arcp", "nsz"}

#: Updates of a factorization, each stored in four bytes.
MOST_UPDATES = 2.5e8

#: Places between a row and its children in the elimination tree, where other rows can stand between.
DISTANCE = 2


@dataclass(frozen=True)
class Pattern:
    """Elimination order and the pattern of the factors.

    Attributes
    ----------
    order : ndarray of int, shape (n_rows,)
        ``order[k]`` is the original row eliminated as number k.
    clusters : ndarray of int64, shape (n_clusters + 1,)
        Rows clusters[c] to clusters[c + 1] form cluster c.
    start : ndarray of int64, shape (n_rows + 1,)
    columns : ndarray of uint32
        Later rows coupled to each row.
    target_start : ndarray of int64, shape (n_rows + 1,)
    targets : ndarray of uint32
        Entries changed by eliminating a row, for p < q over its entries: that of (column p, column q).
    """

    order: IntArray
    clusters: IntArray
    start: IntArray
    columns: UIntArray
    target_start: IntArray
    targets: UIntArray


def make_pattern(
    row_start: IntArray, row_atoms: IntArray, n_atoms: int, eliminate_last: NDArray[np.bool_] | None = None
) -> Pattern:
    """Order the rows and find the pattern of their factors.

    Parameters
    ----------
    row_start, row_atoms : ndarray of int64
        Atoms of each row, compressed (row k: ``row_atoms[row_start[k]:row_start[k + 1]]``), only those
        through which rows are coupled: atoms of infinite mass are left out.
    n_atoms : int
        Number of atoms.
    eliminate_last : ndarray of bool, optional
        Rows to be eliminated after all others: those that depend on them, whose pivots then vanish to rounding. In
        another order the rows before them may be nearly dependent, and what is left of their pivots is no longer small.

    Raises
    ------
    UnsupportedError
        So many rows share an atom that the factors would not fit into memory.
    """
    eliminate_last = np.zeros(len(row_start) - 1, np.bool_) if eliminate_last is None else eliminate_last
    size = int(np.sum(np.bincount(row_atoms) ** 2)) if len(row_atoms) else 0
    atom_start = np.concatenate([[0], np.cumsum(np.bincount(row_atoms, minlength=n_atoms))])
    atom_rows = np.repeat(np.arange(len(eliminate_last)), np.diff(row_start))[np.argsort(row_atoms, kind="stable")]
    position, struct_start, struct = plain_if_small(_minimum_degree, size)(
        row_start, row_atoms, atom_start, atom_rows, eliminate_last
    )
    sizes = np.diff(struct_start).astype(np.float64)
    updates = float(np.sum(sizes * (sizes - 1) / 2))
    if updates > MOST_UPDATES:
        raise UnsupportedError(
            f"{len(row_start) - 1} rows are coupled so densely that eliminating them takes {updates:.1e} updates, more "
            f"than the {MOST_UPDATES:.1e} that fit into memory; one atom takes part in {np.bincount(row_atoms).max()} "
            "rows. Let atoms take part in fewer rows, and hold bodies of more than a thousand atoms by a rigid-body "
            "integrator"
        )
    return Pattern(*plain_if_small(_finish, size)(position, struct_start, struct))


@njit(cache=True)
def _minimum_degree(row_start, row_atoms, atom_start, atom_rows, eliminate_last):
    """Minimum-degree elimination; the position of each row, and by steps where its pattern begins, and the patterns."""
    n = len(row_start) - 1
    mark = np.full(n, -1, np.int32)
    begin = np.empty(n, np.int64)
    count = np.zeros(n, np.int32)
    room = np.empty(n, np.int32)
    pool = np.empty(max(16, 8 * n), np.int32)
    used = 0
    for k in range(n):
        begin[k] = used
        mark[k] = k
        for p in range(row_start[k], row_start[k + 1]):
            a = row_atoms[p]
            for q in range(atom_start[a], atom_start[a + 1]):
                other = atom_rows[q]
                if mark[other] != k:
                    mark[other] = k
                    if used + 1 >= len(pool):
                        pool = _grown(pool, used)
                    pool[used] = other
                    used += 1
                    count[k] += 1
        room[k] = count[k]

    # Rows by degree, then those that come last; of equal ones the one that came first, which peels all ends of a tree
    # evenly. A row whose degree changes is put in again: what was there before no longer counts.
    behind = (n + 1) * eliminate_last
    since = np.arange(n)
    waiting = [(count[k] + behind[k], since[k], k) for k in range(n)]
    heapq.heapify(waiting)
    pushed = n
    position = np.full(n, -1, np.int64)
    struct_start = np.zeros(n + 1, np.int64)
    struct = np.empty(max(16, 4 * n), np.int32)
    struct_used = 0
    mark[:] = -1
    for step in range(n):
        _, came, k = heapq.heappop(waiting)
        while since[k] != came:
            _, came, k = heapq.heappop(waiting)
        position[k] = step
        size = count[k]
        while struct_used + size > len(struct):
            struct = _grown(struct, struct_used)
        base = begin[k]
        for p in range(size):
            struct[struct_used + p] = pool[base + p]
        struct_start[step] = struct_used
        for p in range(size):
            i = np.int64(struct[struct_used + p])
            old = count[i]
            first = begin[i]
            # Drop k from i's list, then add those of k's neighbors that i does not know.
            new = 0
            for q in range(old):
                j = pool[first + q]
                if j != k:
                    pool[first + new] = j
                    mark[j] = i
                    new += 1
            mark[i] = i
            missing = 0
            for q in range(size):
                if mark[struct[struct_used + q]] != i:
                    missing += 1
            if new + missing > room[i]:
                need = new + missing + 4
                while used + need > len(pool):
                    pool = _grown(pool, used)
                for q in range(new):
                    pool[used + q] = pool[first + q]
                begin[i] = used
                first = used
                room[i] = need
                used += need
            for q in range(size):
                j = struct[struct_used + q]
                if mark[j] != i:
                    pool[first + new] = j
                    new += 1
            count[i] = new
            if new != old:
                since[i] = pushed
                heapq.heappush(waiting, (new + behind[i], pushed, i))
                pushed += 1
        struct_used += size
    struct_start[n] = struct_used
    return position, struct_start, struct[:struct_used].copy()


@register_jitable
def _grown(array, used):
    larger = np.empty(2 * len(array), array.dtype)
    larger[:used] = array[:used]
    return larger


@njit(cache=True)
def _finish(position, struct_start, struct):
    """Order by branches of the elimination tree, then columns and update targets in that order."""
    n = len(position)
    owner, parent, new = np.empty(n, np.int64), np.full(n, -1, np.int64), np.empty(n, np.int64)
    owner[position] = np.arange(n)
    for step in range(n):
        later = position[struct[struct_start[step] : struct_start[step + 1]]]
        if len(later) > 0:
            parent[step] = later.min()
    step_of, clusters = _interleaved_postorder(parent)
    new[step_of] = np.arange(n)
    sizes = np.diff(struct_start)[step_of]
    start, target_start = np.zeros(n + 1, np.int64), np.zeros(n + 1, np.int64)
    start[1:] = np.cumsum(sizes)
    target_start[1:] = np.cumsum(sizes * (sizes - 1) // 2)
    columns, targets = np.empty(start[n], np.uint32), np.empty(target_start[n], np.uint32)
    for k in range(n):
        step = step_of[k]
        found = new[position[struct[struct_start[step] : struct_start[step + 1]]]]
        columns[start[k] : start[k + 1]] = np.sort(found).astype(np.uint32)
    for k in range(n):
        t = target_start[k]
        for p in range(start[k], start[k + 1]):
            e = start[columns[p]]
            for q in range(p + 1, start[k + 1]):
                while columns[e] != columns[q]:
                    e += 1
                targets[t] = e
                t += 1
    return owner[step_of], clusters, start, columns, target_start, targets


@register_jitable
def _interleaved_postorder(parent):
    """Children before parents, branch by branch; neighboring branches of a tree alternate.

    A row waits for the pivots of its children, each a division late. So a row is put at least `DISTANCE`
    places behind its children where there are others to go first, those earliest in postorder.
    """
    n = len(parent)
    following = np.full(n, -1, np.int64)
    sibling = np.full(n, -1, np.int64)
    waiting = np.zeros(n, np.int64)
    for step in range(n - 1, -1, -1):
        if parent[step] >= 0:
            sibling[step] = following[parent[step]]
            following[parent[step]] = step
            waiting[parent[step]] += 1
    order = np.empty(n, np.int64)
    place = np.empty(n, np.int64)
    stack = np.empty(n, np.int64)
    clusters = np.empty(n + 1, np.int64)
    n_clusters = 0
    number = 0
    for root in range(n):
        if parent[root] >= 0:
            continue
        clusters[n_clusters] = number
        n_clusters += 1
        top = 0
        stack[0] = root
        while top >= 0:
            node = stack[top]
            if following[node] >= 0:
                top += 1
                stack[top] = following[node]
                following[node] = sibling[following[node]]
            else:
                order[number] = node
                place[node] = number
                number += 1
                top -= 1
    clusters[n_clusters] = n
    result = np.empty(n, np.int64)
    queue = np.empty(n, np.int64)
    since = np.empty(n, np.int64)
    for c in range(n_clusters):
        # Rows whose children have gone stand in a queue, and after their delay in a heap by place.
        ready = [np.int64(0) for _ in range(0)]
        for k in range(clusters[c], clusters[c + 1]):
            if waiting[order[k]] == 0:
                ready.append(k)
        head = tail = clusters[c]
        for k in range(clusters[c], clusters[c + 1]):
            while head < tail and (since[head] + DISTANCE <= k or len(ready) == 0):
                heapq.heappush(ready, place[queue[head]])
                head += 1
            node = order[heapq.heappop(ready)]
            result[k] = node
            above = parent[node]
            if above >= 0:
                waiting[above] -= 1
                if waiting[above] == 0:
                    queue[tail] = above
                    since[tail] = k
                    tail += 1
    return result, clusters[: n_clusters + 1].copy()


def number_atoms(
    flat: IntArray, slots: IntArray, clusters: IntArray, n_atoms: int
) -> tuple[UIntArray, IntArray, UIntArray]:
    """Atoms cluster by cluster in the order in which rows meet them, where clusters begin, and the slots' atoms so.

    Row k has the atoms ``flat[slots[k]:slots[k + 1]]``; an atom of infinite mass that stands in several clusters has a
    copy for each.
    """
    return plain_if_small(_number_atoms, len(flat))(flat, slots, clusters, n_atoms)  # type: ignore[no-any-return]


@njit(cache=True)
def _number_atoms(flat, slots, clusters, n_atoms):
    place = np.full(n_atoms, -1, np.int64)
    atoms = np.empty(len(flat), np.uint32)
    numbers = np.empty(len(flat), np.uint32)
    atom_start = np.zeros(len(clusters), np.int64)
    used = 0
    for c in range(len(clusters) - 1):
        base = used
        for p in range(slots[clusters[c]], slots[clusters[c + 1]]):
            a = flat[p]
            if place[a] < base:
                place[a] = used
                atoms[used] = a
                used += 1
            numbers[p] = place[a]
        atom_start[c + 1] = used
    return atoms[:used].copy(), atom_start, numbers


def make_triples(
    start: IntArray, columns: UIntArray, slots: IntArray, slot_atoms: UIntArray, w: NDArray[np.float64]
) -> tuple[UIntArray, UIntArray, NDArray[np.float64]]:
    """For each entry (k, l) of the matrix: pairs of slots of k and l on one movable atom, and its inverse mass."""
    found = plain_if_small(_make_triples, len(slot_atoms) + len(columns))(start, columns, slots, slot_atoms, w)
    return found  # type: ignore[no-any-return]


@njit(cache=True)
def _make_triples(start, columns, slots, slot_atoms, w):
    begin = np.zeros(len(columns) + 1, np.uint32)
    for fill in range(2):
        if fill == 1:
            sides = np.empty(2 * begin[-1], np.uint32)
            masses = np.empty(begin[-1])
        used = 0
        for k in range(len(start) - 1):
            for e in range(start[k], start[k + 1]):
                l = columns[e]
                for p in range(slots[k], slots[k + 1]):
                    for q in range(slots[l], slots[l + 1]):
                        if slot_atoms[p] == slot_atoms[q] and w[slot_atoms[p]] > 0:
                            if fill == 1:
                                sides[2 * used] = p
                                sides[2 * used + 1] = q
                                masses[used] = w[slot_atoms[p]]
                            used += 1
                begin[e + 1] = used
    return begin, sides, masses
