"""Clusters that look alike, for engines that solve many side by side, and an order of elimination by levels.

Rows are ordered by nested dissection: rows that cross a cut of the molecule come after those on its sides, which share
no entry. In each level are rows whose earlier ones are all eliminated.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import BoolArray


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
    """Order of elimination of rows by levels.

    Parameters
    ----------
    atoms : sequence of sequence of int
        Atoms of each row; rows that share one are coupled.
    last : set of int
        Rows that come after those that they cross a cut with.
    """
    backwards: list[int] = []
    left = [list(range(len(atoms)))]
    while left:
        one, other, across = _cut(atoms, left.pop())
        backwards += sorted(across, key=lambda k: (k in last, k), reverse=True)
        left += [part for part in (one, other) if part]
    order = np.array(backwards[::-1])
    users: dict[int, list[int]] = {}
    later: list[set[int]] = [set() for _ in atoms]
    level = np.zeros(len(atoms), dtype=np.int64)
    for place, k in enumerate(order):
        for a in atoms[k]:
            for earlier in users.setdefault(a, []):
                later[earlier].add(place)
            users[a].append(place)
    for place, mine in enumerate(later):
        if mine:
            later[min(mine)] |= mine - {min(mine)}
            level[min(mine)] = max(level[min(mine)], level[place] + 1)
    by_level = np.argsort(level, kind="stable")
    new = np.argsort(by_level)
    counts = np.bincount(level)
    return Order(
        order[by_level],
        np.concatenate([[0], np.cumsum(counts)]),
        [np.sort(new[list(later[place])]) for place in by_level],
    )


def _cut(atoms: Sequence[Sequence[int]], rows: list[int]) -> tuple[list[int], list[int], list[int]]:
    """Rows on both sides of a cut, which share no atom, and rows that cross it; it parts a subtree of the atoms."""
    users: dict[int, list[int]] = {}
    for k in rows:
        for a in atoms[k]:
            users.setdefault(a, []).append(k)
    above = _tree(atoms, users, next(iter(users)))
    found = {k for a in above for k in users[a]}
    if len(found) < len(rows):
        return sorted(found), [k for k in rows if k not in found], []
    above = _tree(atoms, users, list(above)[-1])
    place = {a: m for m, a in enumerate(above)}
    parent = [place.get(a, 0) for a in above.values()]
    crossing, inside = [0] * len(parent), [0] * len(parent)
    for k in rows:
        left = {place[a] for a in atoms[k]}
        while len(left) > 1:
            m = max(left)
            crossing[m] += 1
            left = left - {m} | {parent[m]}
        inside[min(left)] += 1
    for m in range(len(parent) - 1, 0, -1):
        inside[parent[m]] += inside[m]

    cuts = [m for m in range(1, len(parent)) if 0 < inside[m] < len(rows) - crossing[m]]
    if not cuts:
        return [], [], rows
    best = min(cuts, key=lambda m: crossing[m] / min(inside[m], len(rows) - inside[m] - crossing[m]))
    within = [m == best for m in range(len(parent))]
    for m in range(best + 1, len(parent)):
        within[m] = within[parent[m]]
    sides: tuple[list[int], list[int], list[int]] = [], [], []
    for k in rows:
        some = [within[place[a]] for a in atoms[k]]
        sides[0 if all(some) else 2 if any(some) else 1].append(k)
    return sides


def _tree(atoms: Sequence[Sequence[int]], users: dict[int, list[int]], root: int) -> dict[int, int]:
    """Atoms that hang together with one, by distance, and the one before each; neighbors in a row are joined."""
    above, seen = {root: -1}, set[int]()
    for a in (line := [root]):
        for k in users[a]:
            if k not in seen:
                seen.add(k)
                at = atoms[k].index(a)
                for way in (atoms[k][at:], atoms[k][at::-1]):
                    for before, b in pairwise(way):
                        if b not in above:
                            above[b] = before
                            line.append(b)
    return above
