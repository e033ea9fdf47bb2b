"""Clusters of a batch by pattern: where their atoms, rows and numbers are in the tensors of all systems."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from kcons.batched.clusters import Clusters, Lanes, Levels, Pattern, Row
from kcons.batched.row_functions import row_function
from kcons.constraints.arguments import FloatArray, IntArray
from kcons.errors import UnsupportedError
from kcons.motion.motion import Motion
from kcons.plan.clusters_alike import Alike, alike


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
    held, plan, fixed = motion.constraint_set, motion.plan, set(motion.fixed_atoms.tolist())
    missing = int(((plan.labels >= 0) & ~plan.eliminate_last).sum()) + len(plan.pinned_rows) - motion.rank
    if missing:
        raise UnsupportedError(
            f"{missing} rows depend on others, in clusters of so many rows that nobody knows which; leave out what "
            "others hold (Motion.report names the kinds of clusters)"
        )
    what: list[Any] = []
    atoms: list[IntArray] = []
    parameters: list[FloatArray] = []
    offsets: list[FloatArray] = []
    for item, start in zip(held.constraints, held.starts, strict=False):
        if not item.n_rows:
            continue
        function = None if item.fixes_atoms else row_function(item)
        table = item.parameters().reshape(item.n_rows, -1)
        whole = np.zeros(item.n_rows, bool) if item.whole is None else item.whole
        cells = np.zeros((*item.atoms.shape, 3)) if item.cell_offsets is None else 1.0 * item.cell_offsets
        offsets += list((cells - cells[:, :1])[:, 1 if item.relative else item.width :])
        atoms, parameters = atoms + list(item.atoms), parameters + list(table)
        for k, row in enumerate(item.atoms.tolist()):
            still, last = tuple(a in fixed for a in row), bool(plan.eliminate_last[start + k])
            what.append(
                (function, item.relative, bool(whole[k]), float(item.period or 0.0), table.shape[1], still, last)
            )
    labels = plan.labels if velocity_rows else np.where(held.holonomic, plan.labels, -1)
    found: dict[Pattern, Kind] = {}
    for key, clusters in alike(labels, plan.eliminate_last, what, atoms).items():
        rows = tuple(Row(each[0], local, *each[1:5]) for each, local in key)
        still_atoms = {a for each, local in key for a, still in zip(local, each[5], strict=True) if still}
        rank = sum(not each[6] for each, _ in key)
        pattern = Pattern(rows, rank, clusters.atoms.shape[1], tuple(sorted(still_atoms)))
        numbers = (
            np.array([np.concatenate([t[row] for row in some]) for some in clusters.rows])
            for t in (parameters, offsets)
        )
        found[pattern] = Kind(clusters, next(numbers), held.scale[clusters.rows], next(numbers))
    known[velocity_rows] = found
    return found


@lru_cache(512)
def solver_of(pattern: Pattern, device: torch.device, compiled: bool) -> Any:
    """The equations of a pattern; of small ones compiled where that is asked for."""
    made: Clusters = Lanes(pattern) if pattern.small else Levels(pattern, device)
    if compiled and pattern.small:
        for name in ("newton", "newton_adjoint", "tangent", "tangent_adjoint"):
            setattr(made, name, torch.compile(getattr(made, name), dynamic=True))
    return made


class Group:
    """All clusters of one pattern in a batch.

    `parts` are kinds, with the numbers of their systems, and where atoms and rows of these begin. What has a last axis
    of n is by cluster: `atoms`, (n_atoms, n), their coordinates `flat`, (3 n_atoms, n), `rows`, (n_rows, n), `systems`,
    (n,), and `worst`, (n_rows, n), by how much rows were off at most since that was looked at, in parts of their scale.
    """

    def __init__(self, pattern: Pattern, parts: Sequence[tuple[Kind, IntArray]], like: Tensor, compiled: bool) -> None:
        self.pattern, self.solver = pattern, solver_of(pattern, like.device, compiled)

        def of_all(of: Any, dtype: Any = None) -> Tensor:
            """Numbers of clusters in all systems, the last axis by cluster; of one where real ones are all alike."""
            whole = np.moveaxis(np.concatenate([of(kind, *where) for kind, some in parts for where in some]), 0, -1)
            if dtype is not None and whole.size and (whole == whole[..., :1]).all():
                whole = whole[..., :1]
            return torch.as_tensor(np.ascontiguousarray(whole), device=like.device, dtype=dtype)

        self.atoms = of_all(lambda kind, system, atom, row: kind.clusters.atoms + atom)
        self.rows = of_all(lambda kind, system, atom, row: kind.clusters.rows + row)
        self.systems = of_all(lambda kind, system, atom, row: np.full(len(kind.scale), system))
        self.p, self.scale, self._offsets = (of_all(lambda kind, *_, k=k: kind[k], like.dtype) for k in (1, 2, 3))
        self.flat = _flat(self.atoms)
        self.moving = [3 * a + c for a in range(pattern.n_atoms) if a not in pattern.fixed for c in range(3)]
        # Of relative rows each atom but the first, and the one before it.
        some = [row for row in pattern.rows if row.relative]
        sizes = [len(row.atoms) - 1 for row in some]
        now = [a for row in some for a in row.atoms[1:]]
        before = [a for row in some for a in row.atoms[:-1]]
        first = [row.atoms[0] for row in some for _ in row.atoms[1:]]
        self._now, self._before, self._first = (_flat(self.atoms[each]) for each in (now, before, first))
        begins, whole = np.repeat([np.cumsum([0, *sizes])[:-1], [row.whole for row in some]], sizes, axis=1)
        self._begin = torch.as_tensor(begins, device=like.device)
        self._whole = torch.as_tensor(whole, device=like.device, dtype=torch.bool)[:, None, None]
        self.worst = torch.zeros(self.rows.shape, dtype=like.dtype, device=like.device)
        self._known: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}

    def lanes(self, values: Tensor, numbers: Tensor, keep: bool) -> Tensor:
        """Values of all atoms or rows by cluster; kept where they are those of the batch."""
        if not keep:
            return values[numbers]
        key = id(numbers), id(values)
        if key not in self._known:
            found = values[numbers]
            some = found[..., :1].contiguous()
            self._known[key] = values, some if bool((found == some).all()) else found
        return self._known[key][1]

    def coordinates(self, x: Tensor, lattice: Tensor | None, tree: Any) -> tuple[Tensor, Tensor | None]:
        """Of the atoms of clusters, and by how much the images that relative rows mean stand off: see `Problem`.

        The lattice has shape (n_systems, 2, 3, 3); `tree` gives whole cells by which atoms of whole rows stand off
        where they are stored, of the shape of x, or None.
        """
        flat, n = x.reshape(-1), self.atoms.shape[1]
        if lattice is None or not len(self._begin):
            return flat[self.flat], None
        cell, inverse = lattice[self.systems].unbind(1)
        step = (flat[self._now] - flat[self._before]).reshape(-1, 3, n)
        sums = -torch.round(torch.einsum("exn,nxy->eyn", step, inverse)).cumsum(0)
        cells = sums - torch.cat([torch.zeros_like(sums[:1]), sums])[self._begin]
        if (found := tree(x)) is not None:
            found = found.reshape(-1)
            apart = (found[self._now] - found[self._first]).reshape(-1, 3, n)
            cells = torch.where(self._whole, apart + self._offsets, cells)
        return flat[self.flat], torch.einsum("exn,nxy->eyn", cells, cell).reshape(-1, n)

    def put(self, into: Tensor, vector: Tensor) -> None:
        """Write a vector of atoms, (3 n_atoms, n), into a tensor of all atoms; those that are fixed keep theirs."""
        some = self.moving if self.pattern.fixed else slice(None)
        into.view(-1)[self.flat[some]] = vector[some]


def _flat(atoms: Tensor) -> Tensor:
    """Numbers of coordinates, shape (3 n_atoms, n)."""
    return (3 * atoms.unsqueeze(1) + torch.arange(3, device=atoms.device)[:, None]).reshape(-1, atoms.shape[-1])
