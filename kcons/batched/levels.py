"""Large clusters: all numbers in one tensor, and sparse elimination of rows that share nothing at once, by levels."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcons.batched.clusters import Clusters, Pattern, Problem, Vector
from kcons.plan.clusters_alike import elimination


class _Level(NamedTuple):
    """Rows that are eliminated at once; their factors, and products of these with what is beside the pivots.

    A factor has its entry, the row and a later row; a product the factor, the entry beside, and that it is taken from.
    """

    rows: Tensor
    factor: Tensor
    product: Tensor


class _Program(NamedTuple):
    """Levels; of entries row, column, and the entry across the diagonal; entries on the diagonal."""

    levels: list[_Level]
    row: Tensor
    column: Tensor
    across: Tensor
    diagonal: Tensor


def _table(entries: Iterable[Iterable[int]], width: int, device: torch.device) -> Tensor:
    rows = [list(each) for each in entries]
    return torch.tensor(rows, dtype=torch.long, device=device).reshape(len(rows), width).T


def _program(pattern: Pattern, device: torch.device) -> tuple[_Program, dict[tuple[int, int], int]]:
    """Elimination of the rows that are solved for, and their entries by number, those that fill in among them."""
    moving = [tuple(a for a in row.atoms if a not in pattern.fixed) for row in pattern.rows[: pattern.rank]]
    order = elimination(moving, set())
    place, later = order.rows.tolist(), [order.rows[some].tolist() for some in order.later]
    pairs = [pair for here, some in zip(place, later, strict=True) for i in some for pair in ((here, i), (i, here))]
    numbers = {pair: k for k, pair in enumerate([*((k, k) for k in place), *pairs])}
    levels = []
    for begin, end in zip(order.levels[:-1], order.levels[1:], strict=True):
        factor: list[tuple[int, int, int]] = []
        product: list[tuple[int, int, int]] = []
        for here, some in zip(place[begin:end], later[begin:end], strict=True):
            for there in some:
                product += [(len(factor), numbers[here, j], numbers[there, j]) for j in some]
                factor.append((numbers[there, here], here, there))
        rows = torch.tensor(place[begin:end], device=device)
        levels.append(_Level(rows, _table(factor, 3, device), _table(product, 3, device)))
    row, column, across = _table(((i, j, numbers[j, i]) for i, j in numbers), 3, device)
    (diagonal,) = _table(([numbers[k, k]] for k in range(len(place))), 1, device)
    return _Program(levels, row, column, across, diagonal), numbers


class _Solution(torch.autograd.Function):
    """y of S y = b; its derivative is the solution with the transposed matrix."""

    @staticmethod
    def forward(s: Tensor, b: Tensor, program: _Program) -> Tensor:
        s, b = s.clone(), b.clone()
        for level in program.levels:
            entry, here, there = level.factor
            which, beside, taken = level.product
            factor = s[entry] / s[program.diagonal[here]]
            s.index_add_(0, taken, factor[which] * s[beside], alpha=-1)
            b.index_add_(0, there, factor * b[here], alpha=-1)
        for level in reversed(program.levels):
            entry, here, there = level.factor
            b.index_add_(0, here, s[program.across[entry]] * b[there], alpha=-1)
            b[level.rows] = b[level.rows] / s[program.diagonal[level.rows]]
        return b

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Tensor) -> None:
        ctx.program = inputs[2]
        ctx.save_for_backward(inputs[0], output)

    @staticmethod
    def backward(ctx: Any, *given: Tensor) -> Any:
        s, y = ctx.saved_tensors
        a = _Solution.apply(s[ctx.program.across], given[0], ctx.program)
        return -a[ctx.program.row] * y[ctx.program.column], a, None


class Levels(Clusters):
    """See `Clusters`; gradients have shape (atoms in rows, 3, n), matrices (entries, n)."""

    def __init__(self, pattern: Pattern, device: torch.device) -> None:
        super().__init__(pattern)
        self.program, numbers = _program(pattern, device)
        rows = pattern.rows
        alike: dict[Any, list[int]] = {}
        columns: list[list[Any]] = [[], [], [], [row.atoms for row in rows], [row.places for row in rows]]
        ends = [0, 0, 0]
        for k, row in enumerate(rows):
            alike.setdefault((row.function, row.relative), []).append(k)
            for c, size in enumerate((len(row.atoms), len(row.places), row.parameters)):
                columns[c].append(range(ends[c], ends[c] + size))
                ends[c] += size
        slots = columns[0]
        #: Of rows of one function the first, and of each its places, parameters, atoms, and atoms of places.
        self.alike = [
            (rows[some[0]], *(_table([c[k] for k in some], len(c[some[0]]), device).T for c in columns[1:]))
            for some in alike.values()
        ]
        order = [k for some in alike.values() for k in some]
        self.order = torch.tensor(order, device=device).argsort()
        self.slots = torch.tensor([i for k in order for i in slots[k]], device=device).argsort()
        self.atom, self.row = _table(((a, k) for k, row in enumerate(rows) for a in row.atoms), 2, device)
        self.period = torch.tensor([[row.period or torch.inf] for row in rows], dtype=torch.float64, device=device)
        products = [
            (entry, slots[k][i], slots[other][j], atom)
            for (k, other), entry in numbers.items()
            for i, atom in enumerate(rows[k].atoms)
            for j, same in enumerate(rows[other].atoms)
            if atom == same and atom not in pattern.fixed
        ]
        self.products = _table(products, 4, device)

    def rows_of(self, packed: Tensor) -> Vector:
        return [packed]

    def atoms_of(self, packed: Tensor) -> Vector:
        return [packed.reshape(self.pattern.n_atoms, 3, -1)]

    def weights(self, w: Tensor) -> Vector:
        return [w.unsqueeze(1)]

    def packed(self, vector: Vector, like: Tensor) -> Tensor:
        return vector[0].expand(*vector[0].shape[:-1], like.shape[-1]).reshape(-1, like.shape[-1])

    def evaluate(self, of: Problem, u: Vector | None) -> tuple[Vector, Any]:
        n, zero = of.base.shape[-1], of.base.new_zeros(())
        values, slopes = [], []
        for row, places, parameters, atoms, taken in self.alike:
            function = row.function
            flies = of.way is not None and not function.holonomic
            r = of.base.reshape(-1, 3, n)[places]
            if u is not None:
                r = r + (u[0][taken] - u[0][atoms[:, :1]] if row.relative else u[0][taken])
            if flies:
                r = 0.5 * (r + of.start.reshape(-1, 3, n)[places])
            if row.relative:
                r = torch.cat([torch.zeros_like(r[:, :1]), r], 1)
            if not function.holonomic:
                come = torch.zeros_like(r)
                if of.way is not None:
                    come = of.way.reshape(-1, 3, n)[atoms] + (0.0 if u is None else u[0][atoms])
                r = torch.cat([r, come], 1)
            numbers, coordinates = of.p[parameters].unbind(1), r.reshape(len(r), -1, n).unbind(1)
            value, steep = function(coordinates, numbers, 0.5 * (of.t + of.t_start) if flies else of.t)
            values.append((zero + value).expand(len(r), n))
            slopes.append(torch.stack([(zero + e).expand(len(r), n) for e in steep], 1).reshape(-1, 3, n))
        return [torch.cat(values)[self.order]], torch.cat(slopes)[self.slots]

    def couple(self, left: Any, right: Any, weights: Vector) -> Tensor:
        entry, one, other, atom = self.products
        terms = (left[one] * (weights[0][atom] * right[other])).sum(1)
        return _summed(terms, entry, len(self.program.row))

    def solve(self, s: Tensor, b: Vector, transposed: bool = False) -> Vector:
        return [_Solution.apply(s[self.program.across] if transposed else s, b[0], self.program)]

    def diagonal(self, s: Tensor) -> Vector:
        return [s[self.program.diagonal]]

    def spread(self, slope: Any, lam: Vector) -> Vector:
        some = self.row < len(lam[0])
        terms = slope[some] * lam[0][self.row[some]].unsqueeze(1)
        return [_summed(terms, self.atom[some], self.pattern.n_atoms)]

    def contract(self, slope: Any, v: Vector) -> Vector:
        return [_summed((slope * v[0][self.atom]).sum(1), self.row, len(self.pattern.rows))]

    def solved(self, rows: Vector) -> Vector:
        return [rows[0][: self.pattern.rank]]

    def off(self, value: Vector, targets: Vector) -> Vector:
        found = value[0] - targets[0]
        period = self.period.to(found.dtype)
        turns = torch.round(found / period)
        return [found - torch.where(turns != 0, period * turns, 0.0)]


def _summed(terms: Tensor, index: Tensor, count: int) -> Tensor:
    return terms.new_zeros(count, *terms.shape[1:]).index_add(0, index, terms)
