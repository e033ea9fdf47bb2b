"""How chains are laid out in strips of eight lanes.

A strip is a table of slots by lanes. A long chain is cut into eight pieces,
one a lane, so that the bond from a piece to the next is the bond of its last
slot; of short chains, each takes a lane.
"""

import numpy as np
from numpy.typing import NDArray

from kcons.solvers.kernels.eight_wide import WIDTH

SHORT = 32
"""Atoms of the longest chain that gets one lane instead of eight."""

Strip = tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_], NDArray[np.int64]]


def _strip(
    begin: NDArray[np.int64], step: NDArray[np.int64], size: NDArray[np.int64], chain: NDArray[np.int64]
) -> Strip:
    """Tables (slot, lane) of path atoms, which are real, and the same of rows.

    A slot beyond the end of a chain repeats its last atom. A chain begins at
    `begin` in the path; chain number c has c rows fewer before it than atoms.
    """
    last = size - 1
    place = begin + np.clip(step, 0, last)
    return place, step <= last, step < last, begin - chain + np.clip(step, 0, last - 1)


def whole_slots(present: NDArray[np.bool_]) -> int:
    """Where the slots begin that lack a bond in some lane; the separators' do not count."""
    lacking = np.flatnonzero(~present[:-1].all(axis=1))
    return WIDTH * int(lacking[0] if len(lacking) else len(present) - 1)


def long_strip(begin: int, size: int, chain: int) -> Strip:
    """One chain cut into eight pieces."""
    n_slots = -(-size // WIDTH)
    step = np.arange(WIDTH) * n_slots + np.arange(n_slots)[:, None]
    return _strip(np.asarray(begin), step, np.asarray(size), np.asarray(chain))


def short_strip(bounds: NDArray[np.int64], sizes: NDArray[np.int64], chains: NDArray[np.int64]) -> Strip:
    """Up to eight chains, a lane each; idle lanes stay behind the last chain's end."""
    lane_chain = chains[np.minimum(np.arange(WIDTH), len(chains) - 1)]
    idle = np.arange(WIDTH) >= len(chains)
    step = np.arange(sizes[chains].max())[:, None] + np.where(idle, sizes[lane_chain], 0)
    return _strip(bounds[lane_chain], step, sizes[lane_chain], lane_chain)
