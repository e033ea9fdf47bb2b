"""Large clusters: all numbers in one tensor, and sparse elimination of rows that share nothing at once, by levels."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcons.batched.clusters import Clusters, Pattern, Problem, Vector
from kcons.plan.clusters_alike import elimination


class _Program(NamedTuple):
    """Elimination by levels; of entries row, column, and the entry across the diagonal; entries on the diagonal.

    A level has rows that are eliminated at once, their factors, and products of these with what is beside the pivots. A
    factor has its entry, the row and a later row; a product the factor, the entry beside, and that it is taken from.
    """

    levels: list[tuple[Tensor, Tensor, Tensor]]
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
        levels.append((rows, _table(factor, 3, device), _table(product, 3, device)))
    row, column, across = _table(((i, j, numbers[j, i]) for i, j in numbers), 3, device)
    (diagonal,) = _table(([numbers[k, k]] for k in range(len(place))), 1, device)
    return _Program(levels, row, column, across, diagonal), numbers


class _Solution(torch.autograd.Function):
    """y of S y = b; its derivative is the solution with the transposed matrix."""

    @staticmethod
    def forward(s: Tensor, b: Tensor, program: _Program) -> Tensor:
        s, b = s.clone(), b.clone()
        for _, (entry, here, there), (which, beside, taken) in program.levels:
            factor = s[entry] / s[program.diagonal[here]]
            s.index_add_(0, taken, factor[which] * s[beside], alpha=-1)
            b.index_add_(0, there, factor * b[here], alpha=-1)
        for rows, (entry, here, there), _ in reversed(program.levels):
            b.index_add_(0, here, s[program.across[entry]] * b[there], alpha=-1)
            b[rows] = b[rows] / s[program.diagonal[rows]]
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
        self.program, entries = _program(pattern, device)
        rows = pattern.rows
        alike: dict[Any, list[Any]] = {}
        for kind in self.kinds:
            alike.setdefault((kind[0].function, kind[0].relative, kind[0].period), []).append(kind)
        self.kinds = []
        for some in alike.values():
            first, *numbers = zip(*some, strict=True)
            tables = [torch.tensor(each, dtype=torch.long, device=device).movedim(0, -1) for each in numbers]
            self.kinds.append((first[0], *tables))
        order = [k for kind in self.kinds for k in kind[1].tolist()]
        self.order = torch.tensor(order, device=device).argsort()
        ends = np.cumsum([0, *(len(row.atoms) for row in rows)]).tolist()
        self.slots = torch.tensor([i for k in order for i in range(*ends[k : k + 2])], device=device).argsort()
        self.atom, self.row = _table(((a, k) for k, row in enumerate(rows) for a in row.atoms), 2, device)
        products = [
            (entry, ends[k] + i, ends[other] + j, 3 * atom)
            for (k, other), entry in entries.items()
            for i, atom in enumerate(rows[k].atoms)
            for j, same in enumerate(rows[other].atoms)
            if atom == same and atom not in pattern.fixed
        ]
        self.products = _table(products, 4, device)

    def unpacked(self, packed: Tensor) -> Vector:
        return packed

    def packed(self, vector: Any, like: Tensor) -> Tensor:
        return vector.expand(len(vector), like.shape[-1])

    def take(self, vector: Any, numbers: Tensor) -> list[Any]:
        return list(vector[numbers].unbind(0))

    def evaluate(self, of: Problem, u: Vector | None) -> tuple[Any, Any]:
        values, slopes = super().evaluate(of, u)
        sizes = [len(kind[1]) for kind in self.kinds]

        def whole(value: Any, size: int) -> Tensor:
            return (of.x.new_zeros(()) + value).expand(size, of.x.shape[-1])

        steep = [torch.stack([whole(e, n) for e in some], 1) for some, n in zip(slopes, sizes, strict=True)]
        off = torch.cat([whole(value, n) for value, n in zip(values, sizes, strict=True)])[self.order]
        return off, torch.cat([each.reshape(-1, 3, of.x.shape[-1]) for each in steep])[self.slots]

    def couple(self, left: Any, right: Any, weights: Any) -> Tensor:
        entry, one, other, atom = self.products
        terms = (left[one] * (weights[atom].unsqueeze(1) * right[other])).sum(1)
        return _summed(terms, entry, len(self.program.row))

    def solve(self, s: Tensor, b: Any, transposed: bool = False) -> Vector:
        return _Solution.apply(s[self.program.across] if transposed else s, b, self.program)

    def diagonal(self, s: Tensor) -> Vector:
        return s[self.program.diagonal]

    def spread(self, slope: Any, lam: Any) -> Vector:
        some = self.row < len(lam)
        terms = slope[some] * lam[self.row[some]].unsqueeze(1)
        return _summed(terms, self.atom[some], self.pattern.n_atoms).reshape(3 * self.pattern.n_atoms, -1)

    def contract(self, slope: Any, v: Any) -> Vector:
        places = v.reshape(self.pattern.n_atoms, 3, -1)[self.atom]
        return _summed((slope * places).sum(1), self.row, len(self.pattern.rows))


def _summed(terms: Tensor, index: Tensor, count: int) -> Tensor:
    return terms.new_zeros(count, *terms.shape[1:]).index_add(0, index, terms)
