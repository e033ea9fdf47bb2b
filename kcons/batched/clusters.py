"""Clusters that look alike, side by side: the equations of their multipliers, by positions, velocities and gradients.

Rows are computed by what the declaration of their family does, operation by operation, for many at once. Functions of
users that are written with NumPy become such a list too.

What is done with vectors is written once, by tables of numbers. Vectors of small clusters are lists with a tensor of
shape (clusters,) for each number (`Lanes`), so that one kernel does all of a step; those of larger ones are tensors, in
which rows that share nothing are eliminated together (`Levels`).
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from functools import reduce
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcons.constraints.functions.straight_line import Tape, differentiated, function_of
from kcons.errors import UnsupportedError
from kcons.plan.clusters import elimination

#: Rows, and atoms in all rows, up to which a vector is a list.
LANES_ROWS, LANES_PLACES = 6, 24

#: A list of tensors, or a tensor; numbers for it, a list or a tensor.
Vector = Any
Table = Any
#: Gradients along x, y and z, each a vector with a number for each atom of each row.
Slope = tuple[Vector, Vector, Vector]


#: Names of NumPy's functions among those of `operator`, which take plain numbers too, and of torch.
_NAMES = {"subtract": "sub", "multiply": "mul", "divide": "truediv", "negative": "neg", "power": "pow", "rint": "round"}
_NAMES |= {"absolute": "abs", "arcsin": "asin", "arccos": "acos", "arctan": "atan", "arctan2": "atan2"}


def tape_of(item: Any) -> Tape:
    """Value and gradient of a constraint's rows; refuses what is not written with NumPy's elementary functions.

    Of velocities a function of the middle of a flight and of the way; its gradient is by where the flight ends.
    """
    found = function_of(item)
    if found is not None:
        return found.tape()
    n, function = 3 * item.width, item.function

    def row(r: Any, p: Any, t: Any) -> Any:
        value = function(np.array([r[k] for k in range(n)], dtype=object).reshape(-1, 3))
        return value.item() if isinstance(value, np.ndarray) else value

    try:
        tape = differentiated(row, n)
    except (TypeError, AttributeError, IndexError, ValueError) as error:
        remedy = "write it with elementary functions of NumPy without branches, or as a Formula"
        raise UnsupportedError(f"{item!r} cannot be run on tensors ({error}); {remedy}") from error
    return tape._replace(results=tape.results[:-1])


class Row(NamedTuple):
    """A row of a pattern: what computes it, its atoms in the cluster, and how it takes them.

    The `tape` is that of `tape_of`. A `relative` row takes places from its first atom. Its atoms
    stand in the images of a tree where it is `whole`, and else each beside the one before it.
    """

    tape: Tape
    atoms: tuple[int, ...]
    holonomic: bool
    relative: bool
    whole: bool
    period: float
    parameters: int

    def evaluate(self, r: Sequence[Any], p: Sequence[Any]) -> tuple[Any, list[Any]]:
        """Value, and gradient by where the flight ends, of tensors of any one shape.

        `r` are coordinates x, y, z by atom, and the way behind them for velocity rows; `p` are parameters.
        """

        def perform(name: str, *given: Any) -> Any:
            name = _NAMES.get(name, name)
            if hasattr(operator, name):
                return getattr(operator, name)(*given)
            return getattr(torch, name)(*(each if isinstance(each, Tensor) else r[-1] * 0 + each for each in given))

        value, *slope = self.tape.run(r, p, 0.0, perform)
        return value, slope


class Pattern(NamedTuple):
    """Clusters that look alike: the `rank` first rows are solved for, the others depend on them."""

    rows: tuple[Row, ...]
    rank: int
    n_atoms: int

    @property
    def small(self) -> bool:
        return self.rank <= LANES_ROWS and sum(len(row.atoms) for row in self.rows) <= LANES_PLACES


class Problem(NamedTuple):
    """What clusters of one pattern are given; the last axis is by cluster, or 1 where all are alike.

    Coordinates of atoms, `x` and `start`, where directions are taken, (3 n_atoms, n); by how much the images that rows
    mean stand off there, for each atom of a relative row but the first, or None; whether rows of velocities count, by
    the way from start to x (`flies`); inverse masses `w`, what rows are `held` at, parameters `p`.
    """

    x: Tensor
    start: Tensor
    images: Tensor | None
    start_images: Tensor | None
    flies: bool
    w: Tensor
    held: Tensor
    p: Tensor

    @property
    def at_start(self) -> Problem:
        return self._replace(x=self.start, images=self.start_images, flies=False)


class Lanes:
    """Equations of the clusters of one pattern. Vectors are lists with a tensor for each number.

    Vectors of rows have shape (rank, n) or (n_rows, n), those of coordinates, all x before y and z, (3 n_atoms, n).
    `unpacked` makes vectors of tensors, `packed` tensors of vectors. Matrices are vectors of entries, the diagonal
    first. `take` gives what a vector has at some numbers, `summed` sums of what goes to each number, and `subtract`
    takes such terms from a vector, in place. `joined` puts together what was computed at once. `table` are numbers of a
    vector, and `columns` those of rows that are computed at once.
    """

    #: Whether rows that are computed alike are computed at once.
    together = False

    def __init__(self, pattern: Pattern) -> None:
        self.pattern, rows, n = pattern, pattern.rows, pattern.n_atoms
        images = [0, *accumulate(3 * (len(row.atoms) - 1) * row.relative for row in rows)]
        parameters = [0, *accumulate(row.parameters for row in rows)]
        alike: dict[Any, list[int]] = {}
        for k, row in enumerate(rows):
            key = k < pattern.rank, row.tape, row.relative, row.period
            alike.setdefault(key if self.together else k, []).append(k)
        #: Rows that are computed at once: one, and of all their numbers, those of coordinates, images and parameters.
        self.kinds: list[tuple[Row, Table, Table, Table, Table]] = []
        for some in alike.values():
            coordinates = [[c * n + a for a in rows[k].atoms for c in range(3)] for k in some]
            ranges = ([[*range(ends[k], ends[k + 1])] for k in some] for ends in (images, parameters))
            self.kinds.append((rows[some[0]], *map(self.columns, (some, coordinates, *ranges))))
        #: Rows and their atoms in the order in which gradients are computed; how many are those of so many first rows.
        slots = [
            (k, rows[k].atoms[i]) for some in alike.values() for i in range(len(rows[some[0]].atoms)) for k in some
        ]
        self.slot_rows, self.slot_atoms = (self.table([slot[i] for slot in slots]) for i in range(2))
        self.slots = {count: sum(k < count for k, _ in slots) for count in (pattern.rank, len(rows))}
        self._set_elimination(slots)

    def _set_elimination(self, slots: list[tuple[int, int]]) -> None:
        """Tables of matrices, and of their elimination by levels.

        A level has the rows that are eliminated at once in factors, and products of these with what is beside the
        pivots. A factor has its entry, the row, a later row, and the entry `across` the diagonal; a product the factor,
        the entry beside, and that it is taken from. A term of an entry has this entry and two slots.
        """
        mine: list[dict[int, int]] = [{} for _ in range(self.pattern.rank)]
        for k, (row, atom) in enumerate(slots[: self.slots[self.pattern.rank]]):
            mine[row][atom] = k
        found = elimination([*map(tuple, mine)], set())
        order, later = found.rows.tolist(), [found.rows[some].tolist() for some in found.later]
        pairs = [pair for here, some in zip(order, later, strict=True) for i in some for pair in ((here, i), (i, here))]
        entries = {pair: k for k, pair in enumerate([*((k, k) for k in range(len(order))), *pairs])}
        both = [(k, i, j, a) for (i, j), k in entries.items() for a in mine[i].keys() & mine[j].keys()]

        def tables(rows: list[tuple[int, ...]], width: int) -> list[Table]:
            return [self.table([row[k] for row in rows]) for k in range(width)]

        self.terms = tables([(k, mine[i][a], mine[j][a]) for k, i, j, a in both], 3)
        self.n_entries, self.levels = len(entries), []
        for begin, end in zip(found.levels[:-1], found.levels[1:], strict=True):
            factors: list[tuple[int, ...]] = []
            products: list[tuple[int, ...]] = []
            for here, some in zip(order[begin:end], later[begin:end], strict=True):
                for there in some:
                    products += [(len(factors), entries[here, j], entries[there, j]) for j in some]
                    factors.append((entries[there, here], here, there, entries[here, there]))
            self.levels.append((tables(factors, 4), tables(products, 3)))

    # -- rows -----------------------------------------------------------------------------------------

    def _places(self, kind: tuple[Row, Any, Any, Any, Any], x: Vector, apart: Tensor | None) -> list[Any]:
        """Coordinates of the atoms of rows; of relative ones how far they are from the first, and `apart` beside it."""
        row, _, coordinates, images, _ = kind
        found = list(self.take(x, coordinates))
        if row.relative:
            found = [a - found[k % 3] for k, a in enumerate(found[3:])]
            found = [0.0, 0.0, 0.0, *(found if apart is None else _added(found, list(self.take(apart, images))))]
        return found

    def evaluate(self, of: Problem, u: Vector | None = None) -> tuple[Vector, Slope]:
        """Values less what is held, and gradients, with atoms moved by `u`."""
        values, slopes = [], []
        for kind in self.kinds:
            row, numbers, coordinates, _, parameters = kind
            flies = of.flies and not row.holonomic
            r = self._places(kind, of.x, of.images)
            if u is not None:
                r = _added(r, self._places(kind, u, None))
            if flies:
                there = self._places(kind, of.start, of.start_images)
                r = [0.5 * (a + b) for a, b in zip(r, there, strict=True)]
                way = _each(operator.sub, list(self.take(of.x, coordinates)), list(self.take(of.start, coordinates)))
                r += way if u is None else _added(way, list(self.take(u, coordinates)))
            elif not row.holonomic:
                r += [0.0] * len(coordinates)
            value, slope = row.evaluate(r, list(self.take(of.p, parameters)))
            off = value - of.held[numbers]
            values.append(off - row.period * torch.round(off / row.period) if row.period else off)
            slopes.append(slope)
        return self.joined(values, slopes, of.x)

    # -- vectors --------------------------------------------------------------------------------------

    def table(self, numbers: list[int]) -> Table:
        return numbers

    def columns(self, rows: Any) -> Any:
        return rows[0]

    def unpacked(self, packed: Tensor) -> Vector:
        return list(packed.unbind(0))

    def packed(self, vector: Vector, like: Tensor) -> Tensor:
        lane = like[0]
        return torch.stack([each.expand_as(lane) if isinstance(each, Tensor) else lane * 0 + each for each in vector])

    def joined(self, values: list[Any], slopes: list[list[Any]], like: Tensor) -> tuple[Vector, Slope]:
        x, y, z = ([each for some in slopes for each in some[c::3]] for c in range(3))
        return values, (x, y, z)

    def take(self, vector: Vector, numbers: Table) -> Vector:
        return [vector[k] for k in numbers]

    def summed(self, terms: Vector, numbers: Table, count: int) -> Vector:
        found: dict[int, Any] = {}
        for k, term in zip(numbers, terms, strict=True):
            found[k] = found[k] + term if k in found else term
        return [found.get(k, 0.0) for k in range(count)]

    def subtract(self, vector: Vector, numbers: Table, terms: Vector) -> None:
        for k, term in zip(numbers, terms, strict=True):
            vector[k] = vector[k] - term

    def spread(self, slope: Slope, lam: Vector) -> Vector:
        """A^T lambda of the first rows, as many as have one."""
        end, n = self.slots[len(lam)], self.pattern.n_atoms
        force, atoms = self.take(lam, self.slot_rows[:end]), self.slot_atoms[:end]
        x, y, z = (self.summed(_times(steep[:end], force), atoms, n) for steep in slope)
        return torch.cat([x, y, z]) if isinstance(x, Tensor) else [*x, *y, *z]

    def contract(self, slope: Slope, v: Vector) -> Vector:
        """A v."""
        n = self.pattern.n_atoms
        parts = (_times(slope[c], self.take(v[c * n : (c + 1) * n], self.slot_atoms)) for c in range(3))
        return self.summed(reduce(_added, parts), self.slot_rows, len(self.pattern.rows))

    def couple(self, left: Slope, right: Slope, weights: Vector) -> Vector:
        """A W B^T of the rows that are solved for."""
        entry, one, other = self.terms
        w = self.take(weights[: self.pattern.n_atoms], self.slot_atoms)
        parts = (_times(self.take(a, one), self.take(_times(w, b), other)) for a, b in zip(left, right, strict=True))
        return self.summed(reduce(_added, parts), entry, self.n_entries)

    def solve(self, s: Vector, b: Vector) -> Vector:
        take, (s, b) = self.take, (v.clone() if isinstance(v, Tensor) else [*v] for v in (s, b))
        for (entry, here, there, _), (which, beside, taken) in self.levels:
            factor = _each(operator.truediv, take(s, entry), take(s, here))
            self.subtract(s, taken, _times(take(factor, which), take(s, beside)))
            self.subtract(b, there, _times(factor, take(b, here)))
        b = _each(operator.truediv, b, s[: len(b)])
        for (_, here, there, across), _ in reversed(self.levels):
            self.subtract(b, here, _times(_each(operator.truediv, take(s, across), take(s, here)), take(b, there)))
        return b

    # -- positions and velocities ---------------------------------------------------------------------

    def newton(self, of: Problem, lam: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One step of Newton's method: the next multipliers; what these ones come to.

        That is how far they move the atoms, and by how much all rows are off then, infinite where one has turned.
        """
        weights, known, rank = self.unpacked(of.w.repeat(3, 1)), self.unpacked(lam), self.pattern.rank
        there = self.evaluate(of.at_start)[1]
        u = _times(weights, self.spread(there, known))
        off, slope = self.evaluate(of, u)
        s = self.couple(slope, there, weights)
        step = self.solve(s, _each(operator.neg, off[:rank]))
        size = self.packed(off, of.x).abs()
        turned = self.packed(_each(lambda d: torch.where(d > 0, 0.0, torch.inf), s[:rank]), of.x)
        size = size + turned if rank == len(size) else torch.cat([size[:rank] + turned, size[rank:]])
        return self.packed(_added(known, step), of.x), self.packed(u, of.x), size

    def tangent(self, of: Problem, v: Tensor) -> tuple[Tensor, Tensor]:
        """Multipliers of velocities with A v as it is held, and by how much these change."""
        weights, slope = self.unpacked(of.w.repeat(3, 1)), self.evaluate(of)[1]
        off = _each(operator.sub, self.unpacked(of.held), self.contract(slope, self.unpacked(v)))
        mu = self.solve(self.couple(slope, slope, weights), off[: self.pattern.rank])
        return self.packed(mu, of.x), self.packed(_times(weights, self.spread(slope, mu)), of.x)

    def adjoint(self, of: Problem, lam: Tensor, pushed: Tensor, v: Tensor | None) -> tuple[Tensor, ...]:
        """Derivatives at the solution, positions `of.x` or velocities v there, by one solve with the transposed matrix.

        By what is projected, by positions of which directions are taken, by what is held and by inverse masses; of
        derivatives by how far atoms (or velocities) are `pushed`.
        """
        rank, known, h = self.pattern.rank, self.unpacked(lam), self.unpacked(pushed)
        weights, slope = self.unpacked(of.w.repeat(3, 1)), self.evaluate(of)[1]
        at = of.at_start if v is None else of
        there = self.evaluate(at)[1] if v is None else slope
        b = self.contract(there, _times(weights, h))[:rank]
        a = self.solve(self.couple(there, slope, weights), b)
        back = _each(operator.neg, self.spread(slope, a))
        z = _added(h, back)
        wz = _times(weights, z)

        def of_place(moved: Tensor) -> Tensor:
            found = self.evaluate(at, self.unpacked(moved))[1]
            total: Tensor = _dot(self.contract(found, wz)[:rank], known)
            if v is not None:
                return total - _dot(self.contract(found, self.unpacked(v))[:rank], a)
            if of.flies:  # the way and the middle of the flight change with where it starts
                return total - _dot(self.evaluate(of._replace(start=of.start + moved))[0][:rank], a)
            return total

        by_place = torch.func.grad(of_place)(torch.zeros_like(pushed))
        force = self.packed(self.spread(there, known), of.x) * self.packed(z, of.x)
        by_weight = force.reshape(3, -1, force.shape[-1]).sum(0)
        return self.packed(back, of.x), by_place, self.packed(a, of.x), by_weight

    # -- forces ---------------------------------------------------------------------------------------

    def respond(self, of: Problem, v: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """Multipliers lambda of all rows, those of least norm, and A^T lambda.

        A (a + W A^T lambda) is what is held, less the curvature along v.
        """
        count, rank, speeds = len(self.pattern.rows), self.pattern.rank, self.unpacked(v)
        weights, slope = self.unpacked(of.w.repeat(3, 1)), self.evaluate(of)[1]
        s = self.couple(slope, slope, weights)

        def along(moved: Tensor) -> Tensor:
            return self.packed(self.contract(self.evaluate(of, self.unpacked(moved))[1], speeds), v)

        bend = torch.func.jvp(along, (torch.zeros_like(v),), (v,))[1]
        b = of.held - bend - self.packed(self.contract(slope, self.unpacked(a)), v)
        lam = self.packed(self.solve(s, self.unpacked(b)[:rank]), v)
        if count > rank:  # the last rows are sums of the others: of all x with D x = lambda those of least norm
            units = torch.eye(count, dtype=v.dtype, device=v.device)[:, :, None].expand(-1, -1, v.shape[-1])
            forces = (_times(weights, self.spread(slope, self.unpacked(unit))) for unit in units)
            sums = [self.packed(self.solve(s, self.contract(slope, force)[:rank]), v) for force in forces]
            d = torch.stack(sums, 1).permute(2, 0, 1)
            lam = (d.mT @ torch.linalg.solve(d @ d.mT, lam.T.unsqueeze(-1))).squeeze(-1).T
        return lam, self.packed(self.spread(slope, self.unpacked(lam)), v)


def _each(act: Callable[..., Any], *vectors: Vector) -> Any:
    """Something done with each number of vectors."""
    return act(*vectors) if isinstance(vectors[0], Tensor) else [act(*some) for some in zip(*vectors, strict=True)]


def _added(one: Vector, other: Vector) -> Vector:
    return _each(operator.add, one, other)


def _times(one: Vector, other: Vector) -> Vector:
    return _each(operator.mul, one, other)


def _dot(one: Vector, other: Vector) -> Any:
    return sum((a * b).sum() for a, b in zip(one, other, strict=True))


class Levels(Lanes):
    """The same with vectors that are tensors."""

    together = True

    def __init__(self, pattern: Pattern, device: torch.device) -> None:
        self.device = device
        super().__init__(pattern)
        self.order = torch.cat([kind[1] for kind in self.kinds]).argsort()

    def table(self, numbers: list[Any]) -> Table:
        return torch.tensor(numbers, dtype=torch.long, device=self.device)

    def columns(self, rows: Any) -> Any:
        return self.table(rows).movedim(0, -1)

    def unpacked(self, packed: Tensor) -> Vector:
        return packed

    def packed(self, vector: Any, like: Tensor) -> Tensor:
        return vector.expand(len(vector), like.shape[-1])

    def joined(self, values: list[Any], slopes: list[list[Any]], like: Tensor) -> tuple[Vector, Slope]:
        sizes = [len(kind[1]) for kind in self.kinds]

        def whole(parts: list[list[Any]]) -> Tensor:
            shaped = ((e, (n, like.shape[-1])) for some, n in zip(parts, sizes, strict=True) for e in some)
            return torch.cat(
                [(e if isinstance(e, Tensor) else like.new_tensor(e)).expand(shape) for e, shape in shaped]
            )

        x, y, z = (whole([some[c::3] for some in slopes]) for c in range(3))
        return whole([[value] for value in values])[self.order], (x, y, z)

    def take(self, vector: Any, numbers: Tensor) -> Vector:
        return vector[numbers]

    def summed(self, terms: Tensor, numbers: Tensor, count: int) -> Vector:
        return terms.new_zeros(count, terms.shape[-1]).index_add(0, numbers, terms)

    def subtract(self, vector: Any, numbers: Tensor, terms: Tensor) -> None:
        vector.index_add_(0, numbers, terms, alpha=-1)
