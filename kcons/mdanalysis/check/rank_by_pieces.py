"""Rank of a large set, piece by piece, in bounded memory."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.motion.motion import Motion

#: Rows of one piece; a larger cluster is a piece of its own.
PIECE = 6_000


def rank_of(constraint_set: ConstraintSet, positions: FloatArray) -> int:
    """Number of independent rows at `positions`.

    Rows of different clusters are independent, so that whole clusters are counted a few thousand rows at a time.

    Raises
    ------
    KconsError
        What `kcons.motion.motion.Motion` refuses.
    """
    n = constraint_set.n_rows
    if n <= PIECE:
        return Motion(constraint_set, positions).rank if n else 0
    incidence = constraint_set.incidence
    atoms = incidence[:, constraint_set.touched]
    graph = sp.block_array([[None, atoms], [atoms.T, None]], format="csr")
    _, labels = sp.csgraph.connected_components(graph, directed=False)
    order = np.argsort(labels[:n], kind="stable")
    ends = np.append(np.flatnonzero(np.diff(labels[:n][order])) + 1, n)
    rank, start = 0, 0
    while start < n:
        # As many whole clusters as fit, at least one.
        fitting, next_one = np.searchsorted(ends, [start + PIECE, start], side="right")
        end = int(ends[max(fitting - 1, next_one)])
        part, numbers = constraint_set.subset(np.sort(order[start:end]))
        rank += Motion(part, positions[numbers]).rank
        start = end
    return rank
