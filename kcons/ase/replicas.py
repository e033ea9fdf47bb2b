"""Constraints of a selection of atoms, and of a repeated cell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from ase import Atoms

from kcons.constraints import Constraint
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import UnsupportedError


def within(constraints: Sequence[Constraint], atoms: IntArray, n_atoms: int) -> tuple[Constraint, ...]:
    """Rows all of whose atoms are among `atoms`, of n_atoms, with these renumbered in their order."""
    new_index = np.full(n_atoms, -1, dtype=np.int64)
    new_index[atoms] = np.arange(len(atoms))
    kept = []
    for item in constraints:
        inside = np.flatnonzero((new_index[item.atoms] >= 0).all(axis=1))
        if len(inside):
            kept.append((item if len(inside) == item.n_rows else item.select(inside)).renumbered(new_index))
    return tuple(kept)


def tiled(constraints: Sequence[Constraint], times: tuple[int, int, int], n: int) -> tuple[Constraint, ...]:
    """The rows of all replicas of a cell of `n` atoms; `UnsupportedError` as of `Constraints.repeat`."""
    copies = times[0] * times[1] * times[2]
    result = []
    for item in constraints:
        if not (item.translation_invariant or item.held_in_place):
            raise UnsupportedError(
                f"{item!r} has a place in space and cannot be repeated; remove it with atoms.set_constraint() "
                "and add one for each replica afterwards"
            )
        rows = item.select(np.tile(np.arange(item.n_rows), copies))
        rows.atoms = rows.atoms + n * np.repeat(np.arange(copies), item.n_rows)[:, None]
        result.append(rows if item.translation_invariant else rows.with_target(None))
    return tuple(result)


def led_across(
    constraints: Sequence[Constraint], atoms: Atoms, times: tuple[int, int, int], n: int
) -> tuple[Constraint, ...]:
    """Rows of a repeated cell of `n` atoms, those across its old boundary led to the neighboring replica."""
    copies = times[0] * times[1] * times[2]
    if not atoms.pbc.any() or len(atoms) < n * copies:
        return tuple(constraints)
    x = atoms.arrays["positions"]
    cell = atoms.cell.array / np.array(times)[:, None]
    first = [item.select(np.arange(item.n_rows // copies)) for item in constraints]
    one = ConstraintSet(first, x[:n], atoms.get_masses()[:n], cell=cell, pbc=atoms.pbc)
    assert one.lattice is not None
    result = []
    for item, bound in zip(constraints, one.constraints, strict=True):
        if item.relative:
            replica, base = np.divmod(item.atoms, n)
            place = np.stack(np.unravel_index(replica, times), axis=-1)
            apart = one.gather(bound, x[:n]) - x[bound.atoms]
            cells = np.round((apart - apart[:, :1]) @ one.lattice[1]).astype(np.int64)
            place = (place + np.tile(cells, (copies, 1, 1))) % np.array(times)
            item = item.with_target(item.target)
            item.atoms = np.ravel_multi_index(tuple(np.moveaxis(place, -1, 0)), times) * n + base
        result.append(item)
    return tuple(result)
