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
    """Clusters of one pattern in one system: atoms and rows, and by cluster parameters, scales, and cells of places."""

    clusters: Alike
    parameters: FloatArray
    scale: FloatArray
    offsets: FloatArray


_KNOWN: WeakKeyDictionary[Motion, dict[bool, dict[Pattern, Kind]]] = WeakKeyDictionary()


def kinds_of(motion: Motion, velocity_rows: bool) -> dict[Pattern, Kind]:
    """Clusters of an engine by pattern, with or without rows of velocities; looked for once.

    Raises
    ------
    UnsupportedError
        Rows that cannot be run on tensors; rows that depend on others in clusters where these are not known.
    """
    known = _KNOWN.setdefault(motion, {})
    if velocity_rows not in known:
        known[velocity_rows] = _kinds(motion, velocity_rows)
    return known[velocity_rows]


def _kinds(motion: Motion, velocity_rows: bool) -> dict[Pattern, Kind]:
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
        function = None if item.fixes_atoms else row_function(item)
        table = np.zeros((item.n_rows, 0)) if item.fixes_atoms else item.parameters()
        whole = np.zeros(item.n_rows, bool) if item.whole is None else item.whole
        cells = np.zeros((*item.atoms.shape, 3)) if item.cell_offsets is None else 1.0 * item.cell_offsets
        offsets += list((cells - cells[:, :1])[:, 1 if item.relative else 0 :])
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
    return found


@cache
def solver_of(pattern: Pattern, device: torch.device, compiled: bool) -> Any:
    """The equations of a pattern; of small ones compiled where that is asked for."""
    made: Clusters = Lanes(pattern) if pattern.small else Levels(pattern, device)
    if compiled and pattern.small:
        for name in ("newton", "finish", "newton_adjoint", "tangent", "tangent_adjoint"):
            setattr(made, name, torch.compile(getattr(made, name), dynamic=True))
    return made


class Group:
    """All clusters of one pattern in a batch.

    Parameters
    ----------
    pattern : Pattern
    parts : sequence of tuple
        Kinds, with the numbers of the systems of each, and where their atoms and rows begin.
    like : Tensor
        Of the device and the type of number.
    compiled : bool

    Attributes
    ----------
    solver : Clusters
    atoms, rows : Tensor of int
        Of each cluster in the batch, shape (n_atoms, n) and (n_rows, n).
    systems : Tensor of int, shape (n,)
    flat : Tensor of int, shape (3 n_atoms, n)
        Coordinates of the atoms.
    worst : Tensor, shape (n_rows, n)
        By how much rows were off at most since that was looked at, in parts of their scale.
    """

    def __init__(
        self, pattern: Pattern, parts: Sequence[tuple[Kind, IntArray, IntArray, IntArray]], like: Tensor, compiled: bool
    ) -> None:
        self.pattern, self.solver = pattern, solver_of(pattern, like.device, compiled)

        def of_all(of: Any, dtype: Any = None) -> Tensor:
            """Numbers of clusters in all systems, the last axis by cluster; of one where real ones are all alike."""
            tables = [np.concatenate([of(kind, *where) for where in zip(*w, strict=True)]) for kind, *w in parts]
            whole = np.moveaxis(np.concatenate(tables), 0, -1)
            if dtype is not None and whole.size and (whole == whole[..., :1]).all():
                whole = whole[..., :1]
            return torch.as_tensor(np.ascontiguousarray(whole), device=like.device, dtype=dtype)

        self.atoms = of_all(lambda kind, system, atom, row: kind.clusters.atoms + atom)
        self.rows = of_all(lambda kind, system, atom, row: kind.clusters.rows + row)
        self.systems = of_all(lambda kind, system, atom, row: np.full(len(kind.scale), system))
        self.p, self.scale, self.offsets = (of_all(lambda kind, *_, k=k: kind[k], like.dtype) for k in (1, 2, 3))
        self.flat = _flat(self.atoms)
        moving = [a for a in range(pattern.n_atoms) if a not in pattern.fixed]
        self.moving = None if not pattern.fixed else [3 * a + c for a in moving for c in range(3)]
        before, first, begin = [], [], []
        for row in pattern.rows:
            before += row.atoms[:-1] if row.relative else row.atoms
            first += row.atoms[:1] * len(row.places)
            begin += [len(begin)] * len(row.places)
        now = [atom for row in pattern.rows for atom in row.places]
        #: Coordinates of places, of the first atoms of their rows, and of the atoms before them.
        self.now, self.first, self.before = (_flat(self.atoms[some]) for some in (now, first, before))
        self.begin = torch.tensor(begin, device=like.device)
        marks = [[(row.relative, row.whole)] for row in pattern.rows for _ in row.places]
        self.relative, self.whole = torch.tensor(marks, device=like.device).unsqueeze(-1).unbind(2)
        self.mixed = len({row.relative for row in pattern.rows}) > 1
        self.worst = torch.zeros(self.rows.shape, dtype=like.dtype, device=like.device)
        self._known: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}

    def lanes(self, values: Tensor, numbers: Tensor, keep: bool) -> Tensor:
        """Values of all atoms or rows by cluster; kept where they are those of the batch."""
        if not keep:
            return values[numbers]
        key = id(numbers), id(values)
        if key not in self._known:
            found = values[numbers]
            alike_all = bool((found == found[..., :1]).all())
            self._known[key] = values, found[..., :1].contiguous() if alike_all else found
        return self._known[key][1]

    def places(self, x: Tensor) -> Tensor:
        """Places of rows, shape (places, 3, n), without images."""
        flat, n = x.reshape(-1), self.atoms.shape[1]
        here = flat[self.now].reshape(-1, 3, n)
        if not self.pattern.rows[0].relative and not self.mixed:
            return here
        first = flat[self.first].reshape(-1, 3, n)
        return here - (self.relative * first if self.mixed else first)

    def cells(self, x: Tensor, lattice: Tensor, tree: Tensor | None) -> Tensor:
        """Whole cells by which places count from where they are stored, (places, 3, n).

        `tree` are the cells by which atoms of whole rows are moved, shape (n_atoms, 3).
        """
        flat, n = x.reshape(-1), self.atoms.shape[1]
        turns = -self._turns(flat[self.now] - flat[self.before], lattice)
        sums = torch.cat([torch.zeros_like(turns[:1]), turns.cumsum(0)])
        found = sums[1:] - sums[self.begin]
        if tree is not None:
            cells = tree.reshape(-1)
            apart = (cells[self.now] - cells[self.first]).reshape(-1, 3, n)
            found = torch.where(self.whole, apart + self.offsets, found)
        return found * self.relative

    def passed(self, x: Tensor, start: Tensor, lattice: Tensor) -> Tensor:
        """Whole cells that places have been moved by from a start, as when positions are wrapped."""
        flat = (x - start).reshape(-1)
        return (self._turns(flat[self.now], lattice) - self._turns(flat[self.first], lattice)) * self.relative

    def _turns(self, step: Tensor, lattice: Tensor) -> Tensor:
        inverse = lattice[self.systems, 1]
        return torch.round(torch.einsum("exn,nxy->eyn", step.reshape(-1, 3, self.atoms.shape[1]), inverse))

    def put(self, into: Tensor, vector: Tensor) -> None:
        """Write a vector of atoms, (3 n_atoms, n), into a tensor of all atoms; those that are fixed keep theirs."""
        some = slice(None) if self.moving is None else self.moving
        into.view(-1)[self.flat[some]] = vector[some]


def _flat(atoms: Tensor) -> Tensor:
    """Numbers of coordinates, shape (3 n_atoms, n)."""
    return (3 * atoms.unsqueeze(1) + torch.arange(3, device=atoms.device)[:, None]).reshape(-1, atoms.shape[-1])
