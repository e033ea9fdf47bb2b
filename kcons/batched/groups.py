"""Clusters of a batch by pattern: where their atoms, rows and numbers are in the tensors of all systems."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from kcons.batched.clusters import Clusters, Pattern, Row
from kcons.batched.lanes import Lanes
from kcons.batched.levels import Levels
from kcons.batched.row_functions import row_function
from kcons.constraints.arguments import FloatArray, IntArray
from kcons.errors import UnsupportedError
from kcons.motion.motion import Motion
from kcons.plan.clusters_alike import Alike, alike


class Kind(NamedTuple):
    """Clusters of one pattern in one system: atoms, rows, and by row parameters and how many cells off atoms are."""

    clusters: Alike
    parameters: FloatArray
    scale: FloatArray
    offsets: FloatArray


def kinds_of(motion: Motion, velocity_rows: bool = True) -> dict[Pattern, Kind]:
    """Clusters of an engine by pattern, with or without `velocity_rows`; looked for once.

    Raises
    ------
    UnsupportedError
        Rows that cannot be run on tensors; rows that depend on others in clusters where these are not known.
    """
    known = _KNOWN.setdefault(motion, {})
    if velocity_rows not in known:
        known[velocity_rows] = _kinds(motion, velocity_rows)
    return known[velocity_rows]


_KNOWN: WeakKeyDictionary[Motion, dict[bool, dict[Pattern, Kind]]] = WeakKeyDictionary()


def _kinds(motion: Motion, velocity_rows: bool) -> dict[Pattern, Kind]:
    held, plan = motion.constraint_set, motion.plan
    fixed = set(motion.fixed_atoms.tolist())
    rows: list[Any] = []
    atoms: list[IntArray] = []
    for item in held.constraints:
        function = None if item.fixes_atoms else row_function(item)
        whole = np.zeros(item.n_rows, bool) if item.whole is None else item.whole
        count = 0 if item.fixes_atoms else item.parameters().shape[1]
        for k in range(item.n_rows):
            flags = tuple(int(a) in fixed for a in item.atoms[k])
            rows.append((function, item.relative, bool(whole[k]), float(item.period or 0.0), count, flags))
        atoms += list(item.atoms)
    dropped = plan.eliminate_last
    solved = int(((plan.labels >= 0) & ~dropped).sum())
    if solved != motion.rank - len(plan.pinned_rows):
        raise UnsupportedError(
            f"{solved + len(plan.pinned_rows) - motion.rank} rows depend on others, in clusters of so many rows that "
            "nobody knows which; leave out what others hold (Motion.report names the kinds of clusters)"
        )
    labels = plan.labels if velocity_rows else np.where(held.holonomic, plan.labels, -1)
    found: dict[Pattern, Kind] = {}
    for key, clusters in alike(labels, dropped, list(zip(rows, dropped.tolist(), strict=True)), atoms).items():
        table = tuple(Row(what[0], local, *what[1:5]) for (what, _), local in key)
        still = {a for (what, _), local in key for a, held_still in zip(local, what[5], strict=True) if held_still}
        rank = sum(not depends for (_, depends), _ in key)
        pattern = Pattern(table, rank, clusters.atoms.shape[1], tuple(sorted(still)))
        found[pattern] = Kind(clusters, *_numbers(motion, pattern, clusters))
    return found


def _numbers(motion: Motion, pattern: Pattern, clusters: Alike) -> tuple[FloatArray, FloatArray, FloatArray]:
    held = motion.constraint_set
    parameters, offsets = [], []
    for k, row in enumerate(pattern.rows):
        numbers, cells = [], []
        for item, start in zip(held.constraints, held.starts, strict=False):
            mine = clusters.rows[:, k] - start
            here = np.flatnonzero((mine >= 0) & (mine < item.n_rows))
            if not len(here):
                continue
            numbers.append((here, item.parameters()[mine[here]]))
            off = np.zeros((len(here), item.width, 3)) if item.cell_offsets is None else item.cell_offsets[mine[here]]
            cells.append((here, off[:, 1:] - off[:, :1] if row.relative else 0.0 * off))
        for parts, into in ((numbers, parameters), (cells, offsets)):
            whole = np.zeros((len(clusters.rows), *parts[0][1].shape[1:]))
            for here, values in parts:
                whole[here] = values
            into.append(whole)
    return np.concatenate(parameters, 1), held.scale[clusters.rows], np.concatenate(offsets, 1)


@cache
def solver_of(pattern: Pattern, device: torch.device, compiled: bool) -> Any:
    """The equations of a pattern, their steps compiled where that is asked for."""
    made: Clusters = Lanes(pattern) if pattern.small else Levels(pattern, device)
    if compiled and pattern.small:
        for name in ("newton", "finish", "newton_adjoint", "tangent", "tangent_adjoint"):
            setattr(made, name, torch.compile(getattr(made, name), dynamic=True))
    return made


class Group:
    """All clusters of one pattern in a batch.

    Attributes
    ----------
    pattern : Pattern
    solver : Clusters
    atoms, rows : Tensor of int
        Of each cluster in the batch, shape (n_atoms, n) and (n_rows, n).
    systems : Tensor of int, shape (n,)
    worst : Tensor, shape (n_rows, n)
        By how much rows were off at most since that was looked at, in parts of their scale.
    """

    def __init__(
        self, pattern: Pattern, parts: Sequence[tuple[Kind, IntArray, IntArray, IntArray]], like: Tensor, compiled: bool
    ) -> None:
        self.pattern, self.solver = pattern, solver_of(pattern, like.device, compiled)
        atoms, rows, systems, parameters, scale, offsets = [], [], [], [], [], []
        for kind, numbers, first_atoms, first_rows in parts:
            count, n = len(numbers), len(kind.clusters.atoms)
            atoms.append((kind.clusters.atoms + first_atoms[:, None, None]).reshape(count * n, -1))
            rows.append((kind.clusters.rows + first_rows[:, None, None]).reshape(count * n, -1))
            systems.append(np.repeat(numbers, n))
            for table, values in ((parameters, kind.parameters), (scale, kind.scale), (offsets, kind.offsets)):
                table.append(np.tile(values, (count, *[1] * (values.ndim - 1))))
        device = like.device

        def numbers_of(tables: Sequence[FloatArray]) -> Tensor:
            """Last axis by cluster; of one where all are alike."""
            whole = np.moveaxis(np.concatenate(tables), 0, -1)
            if whole.size and (whole == whole[..., :1]).all():
                whole = whole[..., :1]
            return torch.as_tensor(np.ascontiguousarray(whole), device=device).to(like.dtype)

        self.atoms, self.rows = (torch.as_tensor(np.concatenate(t).T.copy(), device=device) for t in (atoms, rows))
        self.systems = torch.as_tensor(np.concatenate(systems), device=device)
        self.p, self.scale, self.offsets = numbers_of(parameters), numbers_of(scale), numbers_of(offsets)
        self.flat = _flat(self.atoms)
        self.moving = [a for a in range(pattern.n_atoms) if a not in pattern.fixed]
        self.moved = self.flat if not pattern.fixed else _flat(self.atoms[self.moving])
        self.coordinates = (
            None if not pattern.fixed else torch.tensor([3 * a + c for a in self.moving for c in range(3)])
        )
        places = [(atom, row) for row in pattern.rows for atom in row.places]
        self.now = _flat(self.atoms[[atom for atom, _ in places]])
        self.first = _flat(self.atoms[[row.atoms[0] for _, row in places]])
        self.relative = torch.tensor([[[row.relative]] for _, row in places], device=device)
        self.whole = torch.tensor([[[row.whole]] for _, row in places], device=device)
        #: Places before each in the list, the first of its row, and places from which those of a row begin.
        before, begin = [], []
        for row in pattern.rows:
            before += row.atoms[:-1] if row.relative else row.atoms
            begin += [len(begin)] * len(row.places)
        self.before, self.begin = _flat(self.atoms[before]), torch.tensor(begin, device=device)
        self.worst = torch.zeros(self.rows.shape, dtype=like.dtype, device=device)
        self._known: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}

    def lanes(self, values: Tensor, numbers: Tensor, keep: bool) -> Tensor:
        """Values of all atoms or rows by cluster; kept where they are those of the batch."""
        if not keep:
            return values[numbers]
        key = id(numbers), id(values)
        if key not in self._known:
            found = values[numbers]
            if found.shape[-1] and bool((found == found[..., :1]).all()):
                found = found[..., :1].contiguous()
            self._known[key] = values, found
        return self._known[key][1]

    def places(self, x: Tensor) -> Tensor:
        """Places of rows, shape (places, 3, n), without images."""
        flat, n = x.reshape(-1), self.atoms.shape[1]
        here = flat[self.now]
        if bool(self._all_relative):
            here = here - flat[self.first]
        elif self._any_relative:
            here = here.reshape(-1, 3, n) - self.relative * flat[self.first].reshape(-1, 3, n)
        return here.reshape(-1, 3, n)

    @property
    def _all_relative(self) -> bool:
        return all(row.relative for row in self.pattern.rows)

    @property
    def _any_relative(self) -> bool:
        return any(row.relative for row in self.pattern.rows)

    def cells(self, x: Tensor, lattice: Tensor, tree: Tensor | None) -> Tensor:
        """Whole cells by which places count from where they are stored, (places, 3, n).

        Parameters
        ----------
        x : Tensor, shape (n_atoms, 3)
        lattice : Tensor, shape (n_systems, 2, 3, 3)
        tree : Tensor, shape (n_atoms, 3), or None
            Cells by which atoms of whole rows are moved.
        """
        flat, n = x.reshape(-1), self.atoms.shape[1]
        inverse = lattice[self.systems, 1]
        step = (flat[self.now] - flat[self.before]).reshape(-1, 3, n)
        turns = -torch.round(torch.einsum("exn,nxy->eyn", step, inverse))
        sums = torch.cat([torch.zeros_like(turns[:1]), turns.cumsum(0)])
        found = sums[1:] - sums[self.begin]
        if tree is not None:
            cells = tree.reshape(-1)
            found = torch.where(
                self.whole, (cells[self.now] - cells[self.first]).reshape(-1, 3, n) + self.offsets, found
            )
        return found * self.relative

    def passed(self, x: Tensor, start: Tensor, lattice: Tensor) -> Tensor:
        """Whole cells that places have been moved by from a start, as when positions are wrapped."""
        flat, n = (x - start).reshape(-1), self.atoms.shape[1]
        inverse = lattice[self.systems, 1]
        turns = [
            torch.round(torch.einsum("exn,nxy->eyn", flat[t].reshape(-1, 3, n), inverse))
            for t in (self.now, self.first)
        ]
        return (turns[0] - turns[1]) * self.relative

    def put(self, into: Tensor, vector: Tensor) -> None:
        """Write a vector of atoms, (3 n_atoms, n), into a tensor of all atoms; those that are fixed keep theirs."""
        into.view(-1)[self.moved] = vector if self.coordinates is None else vector[self.coordinates]


def _flat(atoms: Tensor) -> Tensor:
    """Numbers of coordinates, shape (3 n_atoms, n)."""
    return (3 * atoms.unsqueeze(1) + torch.arange(3, device=atoms.device)[:, None]).reshape(-1, atoms.shape[-1])
