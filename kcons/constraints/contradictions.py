"""Constraints that ask for different things, found from their targets alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp

from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.target import FloatArray, nearest_image
from kcons.errors import ContradictionError, InfeasibleError

#: Relative difference of two targets (radian for angles) that counts as rounding.
_SAME = 1e-10
#: Neighbors of ends looked at together while searching triangles; bounds the memory.
_CHUNK = 2_000_000


def refuse_contradictions(items: Sequence[Constraint], starts: IntArray, time: float) -> None:
    """Raise if targets of `items`, which have them, contradict each other at a time; `starts` are their first rows.

    Looks for the same distance, angle or dihedral held at two values (`ContradictionError`), and for triangles of
    distances that violate the triangle inequality (`InfeasibleError`): about 0.1 s for 10^5 distances.
    """
    for family in {type(item): None for item in items if item.reversible}:
        chosen = [(item, start) for item, start in zip(items, starts, strict=False) if type(item) is family]
        # A row and its reverse (j, i), (k, j, i), (l, k, j, i) name the same coordinate.
        atoms = np.concatenate([item.atoms for item, _ in chosen])
        atoms = np.where((atoms[:, :1] > atoms[:, -1:]), atoms[:, ::-1], atoms)
        rows = np.concatenate([start + np.arange(item.n_rows) for item, start in chosen])
        target = np.concatenate([item.target_at(time) for item, _ in chosen])
        order = np.lexsort(atoms.T[::-1])
        atoms, rows, target = atoms[order], rows[order], target[order]
        _refuse_two_targets(atoms, rows, target, chosen[0][0].period)
        if chosen[0][0].holds_length:
            _refuse_impossible_triangles(atoms, rows, target)


def found_as_given(items: Sequence[Constraint], found: Sequence[bool], time: float) -> list[Constraint]:
    """Lengths that were found from positions (as `found` says of each item) as given where another row gives the same
    one.

    They differ by the rounding of positions, by which both could not be held.
    """
    result = list(items)
    numbers = [n for n, item in enumerate(items) if item.holds_length and not item.moving]
    if not any(found[n] for n in numbers) or all(found[n] for n in numbers):
        return result
    pairs = np.concatenate([np.sort(items[n].atoms, axis=1) for n in numbers])
    width = int(pairs.max(initial=0)) + 1
    key = pairs[:, 0] * width + pairs[:, 1]
    length = np.concatenate([items[n].target_at(time) for n in numbers])
    open_ = np.concatenate([np.full(items[n].n_rows, found[n]) for n in numbers])
    given, first = np.unique(key[~open_], return_index=True)
    if not len(given):
        return result
    place = np.minimum(np.searchsorted(given, key), len(given) - 1)
    same = open_ & (given[place] == key)
    if same.any():
        length[same] = length[~open_][first][place[same]]
        ends = np.cumsum([items[n].n_rows for n in numbers])
        for n, part in zip(numbers, np.split(length, ends[:-1]), strict=True):
            if found[n]:
                result[n] = items[n].with_target(part)
    return result


def _refuse_two_targets(atoms: IntArray, rows: IntArray, target: FloatArray, period: float | None) -> None:
    repeated = np.flatnonzero((atoms[1:] == atoms[:-1]).all(axis=1))
    difference = nearest_image(target[repeated + 1] - target[repeated], period)
    bad = np.abs(difference) > _SAME * np.maximum(np.abs(target[repeated]), np.abs(target[repeated + 1]))
    if bad.any():
        k = int(repeated[np.argmax(bad)])
        raise ContradictionError(
            f"constraints #{rows[k]} and #{rows[k + 1]} on atoms {tuple(atoms[k].tolist())} have different targets "
            f"{float(target[k])!r}, {float(target[k + 1])!r}; remove one of them",
            rows=rows[k : k + 2].tolist(),
            atoms=atoms[k].tolist(),
        )


def _refuse_impossible_triangles(pairs: IntArray, rows: IntArray, length: FloatArray) -> None:
    """Triangle inequality over all triangles of held distances; `pairs` sorted, smaller atom first.

    The least sum of squared deviations of a triangle with the excess e = d_3 - d_1 - d_2 is e^2/3: each
    side takes a third of the excess.
    """
    if len(pairs) < 3:
        return
    first = np.concatenate([[True], (pairs[1:] != pairs[:-1]).any(axis=1)])
    pairs, rows, length = pairs[first], rows[first], length[first]
    atoms, ends = np.unique(pairs, return_inverse=True)
    i, j = ends.reshape(pairs.shape).T
    side = np.arange(1.0, len(pairs) + 1)
    sides = sp.coo_array((side, (i, j)), shape=(len(atoms), len(atoms))).tocsr()
    sides = sides + sides.T
    linked = sides.astype(bool).astype(np.float64)
    work = np.cumsum(np.diff(sides.indptr)[i])
    for some in np.split(np.arange(len(pairs)), np.searchsorted(work, np.arange(_CHUNK, work[-1], _CHUNK))):
        # Where both ends of a distance are linked to a third atom: the two other sides.
        one = sides[i[some]].multiply(linked[j[some]]).tocoo()
        two = linked[i[some]].multiply(sides[j[some]]).tocoo()
        members = np.stack([some[one.row], one.data.astype(int) - 1, two.data.astype(int) - 1], axis=1)
        d = length[members]
        excess = d[:, 0] - d[:, 1] - d[:, 2]
        bad = excess > _SAME * d[:, 0]
        if bad.any():
            t = int(np.argmax(bad))
            best = float(excess[t]) ** 2 / 3
            named = np.unique(pairs[members[t]]).tolist()
            held = ", ".join(f"#{row} = {value:g}" for row, value in sorted(zip(rows[members[t]], d[t], strict=True)))
            raise InfeasibleError(
                f"infeasible: residual cannot go below {best:.6g} (sum of squares); the distances of atoms "
                f"{tuple(named)} ({held}) violate the triangle inequality by {excess[t]:.6g}. "
                "Correct the longest or remove it",
                residual=best,
                row=int(rows[members[t, 0]]),
                atoms=named,
            )
