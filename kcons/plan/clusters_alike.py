"""Clusters that look alike, for engines that solve many side by side, and an order of elimination by levels.

In each level rows of about the lowest degree are eliminated that share no entry, so that all of them can go at once;
rows that depend on others come last.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import BoolArray

#: Rows of one level have at most this many times the lowest degree, or this many neighbors more.
_ABOUT, _MORE = 1.5, 2


class Alike(NamedTuple):
    """Clusters with equal rows: their atoms, shape (n, n_atoms), and their rows in the set, shape (n, n_rows)."""

    atoms: IntArray
    rows: IntArray


def alike(
    labels: IntArray, last: BoolArray, rows: Sequence[Hashable], atoms: Sequence[IntArray]
) -> dict[tuple[tuple[Any, tuple[int, ...]], ...], Alike]:
    """Clusters by what they are made of: of each row what it is, and its atoms as they are met.

    Parameters
    ----------
    labels : ndarray of int, shape (n_rows,)
        Cluster of each row, -1 for none; see `Plan`.
    last : ndarray of bool, shape (n_rows,)
        Rows that come after the others of their cluster.
    rows : sequence
        What each row of the set is: equal for rows that are computed alike.
    atoms : sequence of ndarray of int
        Atoms of each row.
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

    rows: list[int]
    levels: list[int]
    later: list[list[int]]


def neighbors(atoms: Sequence[Sequence[int]]) -> list[set[int]]:
    """Rows that share an atom with each."""
    users: dict[int, set[int]] = {}
    for k, row in enumerate(atoms):
        for atom in row:
            users.setdefault(atom, set()).add(k)
    return [set().union(*(users[a] for a in row)) - {k} for k, row in enumerate(atoms)]


def elimination(neighbors: list[set[int]], last: set[int]) -> Order:
    """Order of elimination of rows by levels.

    Parameters
    ----------
    neighbors : list of set of int
        Rows that share a moving atom with each.
    last : set of int
        Rows that come after all others.
    """
    left, coupled = set(range(len(neighbors))), [set(each) for each in neighbors]
    order: list[int] = []
    levels = [0]
    found: dict[int, set[int]] = {}
    while left:
        candidates = sorted(left - last or left, key=lambda row: (len(coupled[row]), row))
        limit = max(_ABOUT * len(coupled[candidates[0]]), len(coupled[candidates[0]]) + _MORE)
        blocked: set[int] = set()
        chosen = []
        for row in candidates:
            if len(coupled[row]) > limit:
                break
            if row not in blocked:
                chosen.append(row)
                blocked |= coupled[row]
        for row in chosen:
            found[row] = around = coupled[row]
            for other in around:
                coupled[other] |= around
                coupled[other] -= {other, row}
        left -= set(chosen)
        order += chosen
        levels.append(len(order))
    place = {row: k for k, row in enumerate(order)}
    return Order(order, levels, [sorted(place[other] for other in found[row]) for row in order])
