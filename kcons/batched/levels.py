"""Large clusters: all numbers in one tensor, and sparse elimination of rows that share nothing at once, by levels."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcons.batched.clusters import Clusters, Flight, Pattern, Vector
from kcons.plan.clusters_alike import elimination, neighbors


class _Level(NamedTuple):
    """Rows that are eliminated at once: pivots, factors of later rows with the row and the entry, and products."""

    rows: Tensor
    pivot: Tensor
    #: Of each factor: its entry, that of the pivot, the row eliminated and the later row.
    factor: Tensor
    #: Of each product: the factor, the entry beside the pivot, and the entry it is taken from.
    product: Tensor
    #: Of each entry right of a pivot: the entry, the row eliminated and the later row.
    right: Tensor


class _Program(NamedTuple):
    """What elimination does: levels; entries by row and column, and the entry across the diagonal."""

    levels: list[_Level]
    row: Tensor
    column: Tensor
    across: Tensor
    diagonal: Tensor
    numbers: dict[tuple[int, int], int]


def _program(pattern: Pattern) -> _Program:
    """Entries of the matrix of the rows that are solved for, those that fill in among them."""
    moving = [tuple(a for a in row.atoms if a not in pattern.fixed) for row in pattern.rows[: pattern.rank]]
    order = elimination(neighbors(moving), set())
    place = order.rows
    numbers: dict[tuple[int, int], int] = {}
    for k, later in enumerate(order.later):
        for i, j in [(k, k), *((k, i) for i in later), *((i, k) for i in later)]:
            numbers[place[i], place[j]] = len(numbers)
    levels = []
    for begin, end in zip(order.levels[:-1], order.levels[1:], strict=True):
        factor, product, right = [], [], []
        for k in range(begin, end):
            here = place[k]
            for i in order.later[k]:
                there = place[i]
                right.append((numbers[here, there], here, there))
                for j in order.later[k]:
                    product.append((len(factor), numbers[here, place[j]], numbers[there, place[j]]))
                factor.append((numbers[there, here], numbers[here, here], here, there))
        rows = place[begin:end]
        tables = (
            torch.tensor(t, dtype=torch.long).reshape(-1, n).T for t, n in ((factor, 4), (product, 3), (right, 3))
        )
        levels.append(_Level(torch.tensor(rows), torch.tensor([numbers[k, k] for k in rows]), *tables))
    row, column = torch.tensor(list(numbers), dtype=torch.long).T
    across = torch.tensor([numbers[j, i] for i, j in numbers])
    return _Program(levels, row, column, across, torch.tensor([numbers[k, k] for k in range(pattern.rank)]), numbers)


class _Solution(torch.autograd.Function):
    """y of S y = b; its derivative is the solution with the transposed matrix."""

    @staticmethod
    def forward(s: Tensor, b: Tensor, program: _Program) -> Tensor:
        s, b = s.clone(), b.clone()
        for level in program.levels:
            entry, pivot, here, there = level.factor
            factor = s[entry] / s[pivot]
            which, beside, taken = level.product
            s.index_add_(0, taken, factor[which] * s[beside], alpha=-1)
            b.index_add_(0, there, factor * b[here], alpha=-1)
        for level in reversed(program.levels):
            entry, here, there = level.right
            b.index_add_(0, here, s[entry] * b[there], alpha=-1)
            b[level.rows] = b[level.rows] / s[level.pivot]
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


class _Group(NamedTuple):
    """Rows of one function: places and parameters of each, its atoms, and its first atom."""

    number: int
    places: Tensor
    parameters: Tensor
    atoms: Tensor
    taken: Tensor


class Levels(Clusters):
    """See `Clusters`; gradients have shape (atoms in rows, 3, n), matrices (entries, n)."""

    def __init__(self, pattern: Pattern, device: torch.device) -> None:
        super().__init__(pattern)
        self.program = _moved(_program(pattern), device)
        rows, numbers = pattern.rows, self.program.numbers
        alike: dict[Any, list[int]] = {}
        for k, row in enumerate(rows):
            alike.setdefault((row.function, row.relative), []).append(k)
        place, number, slot = 0, 0, 0
        places, parameters, slots = [], [], []
        for row in rows:
            places.append(range(place, place := place + len(row.places)))
            parameters.append(range(number, number := number + row.parameters))
            slots.append(range(slot, slot := slot + len(row.atoms)))
        self.groups = [
            _Group(
                some[0],
                *(_table([t[k] for k in some], device) for t in (places, parameters)),
                *(_table([t(rows[k]) for k in some], device) for t in (lambda r: r.atoms, lambda r: r.places)),
            )
            for some in alike.values()
        ]
        order = [k for some in alike.values() for k in some]
        self.order = torch.tensor(order, device=device).argsort()
        self.slots = torch.tensor([i for k in order for i in slots[k]], device=device).argsort()
        self.atom = torch.tensor([a for row in rows for a in row.atoms], device=device)
        self.row = torch.tensor([k for k, row in enumerate(rows) for _ in row.atoms], device=device)
        self.period = torch.tensor([[row.period] for row in rows], device=device, dtype=torch.float64)
        products = [
            (entry, slots[k][i], slots[other][j], atom)
            for (k, other), entry in numbers.items()
            for i, atom in enumerate(rows[k].atoms)
            for j, same in enumerate(rows[other].atoms)
            if atom == same and atom not in pattern.fixed
        ]
        self.products = _table(products, device).T

    def rows_of(self, packed: Tensor) -> Vector:
        return [packed]

    def atoms_of(self, packed: Tensor) -> Vector:
        return [packed.reshape(self.pattern.n_atoms, 3, -1)]

    def weights(self, w: Tensor) -> Vector:
        return [w.unsqueeze(1)]

    def packed(self, vector: Vector, like: Tensor) -> Tensor:
        (found,) = vector
        return found.expand(*found.shape[:-1], like.shape[-1]).reshape(-1, like.shape[-1])

    def evaluate(
        self, base: Tensor, u: Vector | None, p: Tensor, t: Any, flight: Flight | None = None, slope: bool = True
    ) -> tuple[Vector, Any]:
        n = base.shape[-1]
        places = base.reshape(-1, 3, n)
        values, slopes = [], []
        for group in self.groups:
            row = self.pattern.rows[group.number]
            r = places[group.places]
            if u is not None:
                r = r + (u[0][group.taken] - u[0][group.atoms[:, :1]] if row.relative else u[0][group.taken])
            if flight is not None and not row.function.holonomic:
                r = 0.5 * (r + flight.start.reshape(-1, 3, n)[group.places])
            if row.relative:
                r = torch.cat([torch.zeros_like(r[:, :1]), r], 1)
            if not row.function.holonomic:
                way = torch.zeros_like(r)
                if flight is not None:
                    come = flight.way.reshape(-1, 3, n)
                    way = (come if u is None else come + u[0])[group.atoms]
                r = torch.cat([r, way], 1)
            time = t if flight is None or row.function.holonomic else flight.time
            numbers = p[group.parameters].unbind(1)
            coordinates = r.reshape(len(r), -1, n).unbind(1)
            if slope:
                value, steep = row.function(coordinates, numbers, time)
                full = [base.new_zeros(()) + each for each in steep]
                slopes.append(torch.stack([e.expand(len(r), n) for e in full], 1).reshape(-1, 3, n))
            else:
                value = row.function.value(coordinates, numbers, time)
            values.append((base.new_zeros(()) + value).expand(len(r), n))
        return [torch.cat(values)[self.order]], torch.cat(slopes)[self.slots] if slope else None

    def couple(self, left: Any, right: Any, weights: Vector) -> Tensor:
        entry, one, other, atom = self.products
        terms = (left[one] * (weights[0][atom] * right[other])).sum(1)
        return terms.new_zeros(len(self.program.row), terms.shape[-1]).index_add(0, entry, terms)

    def solve(self, s: Tensor, b: Vector, transposed: bool = False) -> Vector:
        return [_Solution.apply(s[self.program.across] if transposed else s, b[0], self.program)]

    def diagonal(self, s: Tensor) -> Vector:
        return [s[self.program.diagonal]]

    def spread(self, slope: Any, lam: Vector) -> Vector:
        some = slice(None) if len(lam[0]) == len(self.pattern.rows) else self.row < len(lam[0])
        terms = slope[some] * lam[0][self.row[some]].unsqueeze(1)
        return [terms.new_zeros(self.pattern.n_atoms, *terms.shape[1:]).index_add(0, self.atom[some], terms)]

    def contract(self, slope: Any, v: Vector) -> Vector:
        terms = (slope * v[0][self.atom]).sum(1)
        return [terms.new_zeros(len(self.pattern.rows), terms.shape[-1]).index_add(0, self.row, terms)]

    def lengths(self, slope: Any) -> Vector:
        squares = (slope * slope).sum(1)
        total = squares.new_zeros(len(self.pattern.rows), squares.shape[-1])
        return [total.index_add(0, self.row, squares).sqrt()]

    def solved(self, rows: Vector) -> Vector:
        return [rows[0][: self.pattern.rank]]

    def off(self, value: Vector, targets: Vector) -> Vector:
        found = value[0] - targets[0]
        period = self.period.to(found.dtype)
        return [
            torch.where(period > 0, found - period * torch.round(found / torch.where(period > 0, period, 1)), found)
        ]


def _table(entries: Any, device: torch.device) -> Tensor:
    return torch.tensor([list(each) for each in entries], dtype=torch.long, device=device)


def _moved(program: _Program, device: torch.device) -> _Program:
    levels = [_Level(*(table.to(device) for table in level)) for level in program.levels]
    return _Program(levels, *(table.to(device) for table in program[1:5]), program.numbers)
