"""Clusters that look alike, for engines that solve many side by side, and an order of elimination by levels."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import BoolArray

#: Rows with more couplings than the fewest that a row has, by so many times and so many, wait for a later level: what
#: they would fill in costs more than the levels that they save.
MORE_TIMES, MORE = 1.2, 20


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
