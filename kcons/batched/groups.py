"""Clusters of a batch by pattern: where their atoms, rows and numbers are in the tensors of all systems."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from kcons.batched.clusters import Lanes, Levels, Pattern, Row
from kcons.batched.row_functions import row_function
from kcons.constraints.arguments import FloatArray, IntArray
from kcons.errors import UnsupportedError
from kcons.motion.motion import Motion
from kcons.plan.clusters import Alike, alike


class Kind(NamedTuple):
    """Clusters of one pattern in one system: atoms and rows, and by cluster parameters, scales, and cells of images."""

    clusters: Alike
    parameters: FloatArray
    scale: FloatArray
    offsets: FloatArray


_KNOWN: WeakKeyDictionary[Motion, dict[bool, dict[Pattern, Kind]]] = WeakKeyDictionary()


def kinds_of(motion: Motion, velocity_rows: bool) -> dict[Pattern, Kind]:
    """Clusters of an engine by pattern, with or without rows of velocities; looked for once.

    Refuses rows that cannot be run on tensors, and rows that depend on others in clusters where these are not known.
    """
    known = _KNOWN.setdefault(motion, {})
    if velocity_rows in known:
        return known[velocity_rows]
    held, plan = motion.constraint_set, motion.plan
    missing = int(((plan.labels >= 0) & ~plan.eliminate_last).sum()) + len(plan.pinned_rows) - motion.rank
    if missing:
        raise UnsupportedError(
            f"{missing} rows depend on others, in clusters of so many rows that nobody knows which; leave out what "
            "others hold (Motion.report names the kinds of clusters)"
        )
    what: list[tuple[Row, bool]] = []
    atoms: list[IntArray] = []
    parameters: list[FloatArray] = []
    offsets: list[FloatArray] = []
    for item, start in zip(held.constraints, held.starts, strict=False):
        n = item.n_rows
        if not n:
            continue
        function = None if item.fixes_atoms else row_function(item)
        table = item.parameters().reshape(n, -1)
        cells = np.zeros((*item.atoms.shape, 3)) if item.cell_offsets is None else 1.0 * item.cell_offsets
        offsets += list((cells - cells[:, :1])[:, 1 if item.relative else item.width :])
        atoms, parameters = atoms + list(item.atoms), parameters + list(table)
        whole, last = np.zeros(n) if item.whole is None else item.whole, plan.eliminate_last[start : start + n]
        row = Row(function, (), item.relative, False, item.period or 0.0, table.shape[1])  # type: ignore[arg-type]
        what += [(row._replace(whole=bool(w)), bool(l)) for w, l in zip(whole, last, strict=True)]
    labels = plan.labels if velocity_rows else np.where(held.holonomic, plan.labels, -1)
    found: dict[Pattern, Kind] = {}
    for key, clusters in alike(labels, plan.eliminate_last, what, atoms).items():
        rows = tuple(row._replace(atoms=local) for (row, _), local in key)
        pattern = Pattern(rows, sum(not last for (_, last), _ in key), clusters.atoms.shape[1])
        numbers = (
            np.array([np.concatenate([t[row] for row in some]) for some in clusters.rows])
            for t in (parameters, offsets)
        )
        found[pattern] = Kind(clusters, next(numbers), held.scale[clusters.rows], next(numbers))
    known[velocity_rows] = found
    return found


@lru_cache(512)
def solver_of(pattern: Pattern, device: torch.device, compiled: bool) -> Lanes:
    """The equations of a pattern; of small ones compiled where that is asked for."""
    made = Lanes(pattern) if pattern.small else Levels(pattern, device)
    if compiled and pattern.small:
        for name in ("newton", "tangent", "adjoint"):
            setattr(made, name, torch.compile(getattr(made, name), dynamic=True))
    return made


class Group:
    """All clusters of one pattern in a batch.

    `parts` are kinds, with the numbers of their systems, and where atoms and rows of these begin; `own` are numbers by
    atom and by row that do not change. What has a last axis of n is by cluster: `atoms`, (n_atoms, n), their
    coordinates `flat`, (3 n_atoms, n), `rows`, (n_rows, n), `systems`, (n,), and `worst`, (n_rows, n), by how much rows
    were off at most since that was looked at, in parts of their scale.
    """

    def __init__(
        self,
        pattern: Pattern,
        parts: Sequence[tuple[Kind, IntArray]],
        own: tuple[Sequence[Tensor], Sequence[Tensor]],
        compiled: bool,
    ) -> None:
        like = own[0][0]
        self.pattern, self.solver = pattern, solver_of(pattern, like.device, compiled)

        def of_all(of: Any, dtype: torch.dtype = torch.int64) -> Tensor:
            """Numbers of clusters in all systems, the last axis by cluster."""
            whole = np.concatenate([of(kind, *where) for kind, some in parts for where in some])
            return torch.as_tensor(np.ascontiguousarray(np.moveaxis(whole, 0, -1)), device=like.device, dtype=dtype)

        self.atoms = of_all(lambda kind, system, atom, row: kind.clusters.atoms + atom)
        self.rows = of_all(lambda kind, system, atom, row: kind.clusters.rows + row)
        self.systems = of_all(lambda kind, system, atom, row: np.full(len(kind.scale), system))
        self.p, self.scale, self._offsets = (
            _once(of_all(lambda kind, *_, k=k: kind[k], like.dtype)) for k in (1, 2, 3)
        )
        self._own = {id(each): _once(each[self.atoms]) for each in own[0]}
        self._own |= {id(each): _once(each[self.rows]) for each in own[1]}
        self.flat = _flat(self.atoms)
        # Of relative rows each atom but the first, and the one before it.
        some = [row for row in pattern.rows if row.relative]
        sizes = [len(row.atoms) - 1 for row in some]
        now = [a for row in some for a in row.atoms[1:]]
        before = [a for row in some for a in row.atoms[:-1]]
        first = [row.atoms[0] for row in some for _ in row.atoms[1:]]
        self._now, self._before, self._first = (_flat(self.atoms[each]) for each in (now, before, first))
        begins, whole = np.repeat([np.cumsum([0, *sizes])[:-1], [row.whole for row in some]], sizes, axis=1)
        self._begin = torch.as_tensor(begins, device=like.device)
        self._whole = torch.as_tensor(whole, device=like.device, dtype=torch.bool)[:, None]
        self._any_whole = bool(whole.any())
        self.worst = torch.zeros(self.rows.shape, dtype=like.dtype, device=like.device)

    def lanes(self, values: Tensor, numbers: Tensor) -> Tensor:
        """Values of all atoms or rows by cluster."""
        found = self._own.get(id(values))
        return values[numbers] if found is None else found

    def coordinates(self, x: Tensor, lattice: Tensor | None, tree: Any) -> tuple[Tensor, Tensor | None]:
        """Of the atoms of clusters, and by how much the images that relative rows mean stand off: see `Problem`.

        The lattice has shape (n_systems, 2, 3, 3); `tree` gives whole cells by which atoms of whole rows stand off
        where they are stored, of the shape of x.
        """
        flat, n = x.reshape(-1), self.atoms.shape[1]
        if lattice is None or not len(self._begin):
            return flat[self.flat], None

        def apart(values: Tensor, others: Tensor) -> Tensor:
            return (values[self._now] - values[others]).reshape(3, -1, n)

        cell, inverse = lattice[self.systems].unbind(1)
        sums = -torch.round(torch.einsum("xen,nxy->yen", apart(flat, self._before), inverse)).cumsum(1)
        cells = sums - torch.cat([torch.zeros_like(sums[:, :1]), sums], 1)[:, self._begin]
        if self._any_whole:
            found = apart(tree(x).reshape(-1), self._first) + self._offsets.movedim(1, 0)
            cells = torch.where(self._whole, found, cells)
        return flat[self.flat], torch.einsum("xen,nxy->eyn", cells, cell).reshape(-1, n)


def _once(values: Tensor) -> Tensor:
    """Values by cluster, one where real ones are all alike."""
    some = values[..., :1].contiguous()
    return some if bool((values == some).all()) else values


def _flat(atoms: Tensor) -> Tensor:
    """Numbers of coordinates, x before y and z, shape (3 n_atoms, n)."""
    return (3 * atoms + torch.arange(3, device=atoms.device)[:, None, None]).flatten(0, 1)
