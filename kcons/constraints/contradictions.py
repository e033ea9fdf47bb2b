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


def agreed_targets(
    items: Sequence[Constraint], found: Sequence[bool], starts: IntArray, time: float
) -> list[Constraint]:
    """The items, which have targets, where one found from positions is the one given of the same row.

    They differ by the rounding of positions, by which both could not be held. `found` says it of each item, `starts`
    are their first rows. Refused are the same distance, angle or dihedral held at two values, and distances that
    violate the triangle inequality (0.1 s for 10^5 of them).
    """
    result = list(items)
    for family in {type(item): None for item in items if item.reversible and item.n_rows}:
        numbers = [n for n, item in enumerate(items) if type(item) is family]
        chosen = [items[n] for n in numbers]
        # A row and its reverse (j, i), (k, j, i), (l, k, j, i) name the same coordinate.
        atoms = np.concatenate([item.atoms for item in chosen])
        atoms = np.where((atoms[:, :1] > atoms[:, -1:]), atoms[:, ::-1], atoms)
        rows = np.concatenate([starts[n] + np.arange(items[n].n_rows) for n in numbers])
        target = np.concatenate([item.target_at(time) for item in chosen])
        open_ = np.repeat([found[n] for n in numbers], [item.n_rows for item in chosen])
        order = np.lexsort((open_, *atoms.T[::-1]))
        atoms, rows, target, open_ = atoms[order], rows[order], target[order], open_[order]
        _refuse_two_targets(atoms, rows, target, chosen[0].period)
        first = np.flatnonzero(np.concatenate([[True], (atoms[1:] != atoms[:-1]).any(axis=1)]))
        if chosen[0].holds_length:
            _refuse_impossible_triangles(atoms[first], rows[first], target[first])
        if open_.any() and not open_.all():
            agreed = np.where(open_, np.repeat(target[first], np.diff(np.append(first, len(atoms)))), target)
            back = np.empty_like(agreed)
            back[order] = agreed
            for n, part in zip(numbers, np.split(back, np.cumsum([item.n_rows for item in chosen])), strict=False):
                result[n] = items[n].with_target(part) if found[n] else items[n]
    return result


def _refuse_two_targets(atoms: IntArray, rows: IntArray, target: FloatArray, period: float | None) -> None:
    repeated = np.flatnonzero((atoms[1:] == atoms[:-1]).all(axis=1))
    difference = nearest_image(target[repeated + 1] - target[repeated], period)
    bad = np.abs(difference) > _SAME * np.maximum(np.abs(target[repeated]), np.abs(target[repeated + 1]))
    if bad.any():
        k = int(repeated[np.argmax(bad)])
        (one, first), (other, second) = sorted((int(rows[n]), float(target[n])) for n in (k, k + 1))
        raise ContradictionError(
            f"constraints #{one} and #{other} on atoms {tuple(atoms[k].tolist())} have different targets {first!r}, "
            f"{second!r}; remove one of them",
            rows=[one, other],
            atoms=atoms[k].tolist(),
        )


def _refuse_impossible_triangles(pairs: IntArray, rows: IntArray, length: FloatArray) -> None:
    """Triangle inequality over all triangles of held distances; `pairs` sorted, each once, smaller atom first.

    The least sum of squared deviations of a triangle with the excess e = d_3 - d_1 - d_2 is e^2/3: each
    side takes a third of the excess.
    """
    if len(pairs) < 3:
        return
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
