"""Clusters that look alike, side by side: the equations of their multipliers, by positions, velocities and gradients.

Vectors of small clusters are lists with a tensor of shape (clusters,) for each number, and their elimination is written
out (`Lanes`), so that one kernel does all of a step; those of larger ones are tensors, and rows that share nothing are
eliminated together (`Levels`). What is done with these is written once, for both.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcons.batched.row_functions import RowFunction
from kcons.plan.clusters_alike import elimination

#: Rows, and atoms in all rows, up to which elimination is written out.
LANES_ROWS, LANES_PLACES = 6, 24

#: A list of tensors, or a tensor; lists of rows with None where two share no atom, or a tensor (entries, n).
Vector = Any
Matrix = Any


class Row(NamedTuple):
    """A row of a pattern: what computes it, its atoms in the cluster, and how it takes them.

    A `relative` row takes places from its first atom. Its atoms stand in the images of a tree where it is `whole`, and
    else each beside the one before it.
    """

    function: RowFunction
    atoms: tuple[int, ...]
    relative: bool
    whole: bool
    period: float
    parameters: int


class Pattern(NamedTuple):
    """Clusters that look alike: the `rank` first rows are solved for, the others depend on them.

    `fixed` are atoms that do not move.
    """

    rows: tuple[Row, ...]
    rank: int
    n_atoms: int
    fixed: tuple[int, ...]

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
    t: Tensor
    t_start: Tensor

    @property
    def at_start(self) -> Problem:
        return self._replace(x=self.start, images=self.start_images, flies=False, t=self.t_start)


class Clusters:
    """Equations of the clusters of one pattern.

    Vectors of rows have shape (rank, n) or (n_rows, n), those of atoms (3 n_atoms, n). `unpacked` makes vectors of
    tensors, `packed` tensors of vectors, and `take` lists of what a vector has at some numbers. `couple` gives A W B^T
    of the rows that are solved for, `spread` A^T lambda, `contract` A v.
    """

    unpacked: Any
    packed: Any
    take: Any
    couple: Any
    solve: Any
    diagonal: Any
    spread: Any
    contract: Any

    def __init__(self, pattern: Pattern) -> None:
        self.pattern = pattern
        #: Rows that are computed at once: the first, and of all their numbers, those of coordinates of their atoms, of
        #: images, and of parameters.
        self.kinds: list[tuple[Row, Any, Any, Any, Any]] = []
        image = parameter = 0
        for k, row in enumerate(pattern.rows):
            ends = image + 3 * (len(row.atoms) - 1) * row.relative, parameter + row.parameters
            coordinates = [3 * atom + c for atom in row.atoms for c in range(3)]
            self.kinds.append((row, k, coordinates, [*range(image, ends[0])], [*range(parameter, ends[1])]))
            image, parameter = ends

    def weights(self, w: Tensor) -> Vector:
        return self.unpacked(w.repeat_interleave(3, 0))

    def _places(self, kind: tuple[Row, Any, Any, Any, Any], x: Vector, apart: Tensor | None) -> list[Any]:
        """Coordinates of the atoms of rows; of relative ones how far they are from the first, and `apart` beside it."""
        row, _, coordinates, images, _ = kind
        found = self.take(x, coordinates)
        if row.relative:
            found = [a - found[k % 3] for k, a in enumerate(found[3:])]
            found = [0.0, 0.0, 0.0, *(found if apart is None else _added(found, self.take(apart, images)))]
        return found

    def evaluate(self, of: Problem, u: Vector | None) -> tuple[Any, Any]:
        """Values less what is held, and gradients, with atoms moved by `u`."""
        values, slopes = [], []
        for kind in self.kinds:
            row, numbers, coordinates, _, parameters = kind
            flies = of.flies and not row.function.holonomic
            r = self._places(kind, of.x, of.images)
            if u is not None:
                r = _added(r, self._places(kind, u, None))
            if flies:
                there = self._places(kind, of.start, of.start_images)
                r = [0.5 * (a + b) for a, b in zip(r, there, strict=True)]
                way = _each(operator.sub, self.take(of.x, coordinates), self.take(of.start, coordinates))
                r += way if u is None else _added(way, self.take(u, coordinates))
            elif not row.function.holonomic:
                r += [0.0] * len(coordinates)
            t = 0.5 * (of.t + of.t_start) if flies else of.t
            value, slope = row.function(r, self.take(of.p, parameters), t)
            off = value - of.held[numbers]
            values.append(off - row.period * torch.round(off / row.period) if row.period else off)
            slopes.append(slope)
        return values, slopes

    # -- positions ----------------------------------------------------------------------------------

    def newton(self, of: Problem, lam: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One step of Newton's method: the next multipliers; what these ones come to.

        That is how far they move the atoms, and by how much all rows are off then, infinite where one has turned.
        """
        weights, known, rank = self.weights(of.w), self.unpacked(lam), self.pattern.rank
        there = self.evaluate(of.at_start, None)[1]
        u = _times(weights, self.spread(there, known))
        off, slope = self.evaluate(of, u)
        s = self.couple(slope, there, weights)
        step = self.solve(s, _each(operator.neg, off[:rank]))
        size = self.packed(off, of.x).abs()
        turned = self.packed(_each(lambda d: torch.where(d > 0, 0.0, torch.inf), self.diagonal(s)), of.x)
        size = size + turned if rank == len(size) else torch.cat([size[:rank] + turned, size[rank:]])
        return self.packed(_added(known, step), of.x), self.packed(u, of.x), size

    def newton_adjoint(self, of: Problem, lam: Tensor, pushed: Tensor, bent: Tensor, _: Tensor) -> tuple[Tensor, ...]:
        """Derivatives at the solution `of.x`, by one solve with the transposed matrix.

        By positions, by those of the start, by targets and by inverse masses; of derivatives by how far atoms are
        `pushed` and by multipliers (`bent`).
        """
        there, slope = self.evaluate(of.at_start, None)[1], self.evaluate(of, None)[1]
        s = self.couple(slope, there, self.weights(of.w))

        def of_start(moved: Tensor, wz: Vector, a: Vector) -> Tensor:
            found = self.evaluate(of.at_start, self.unpacked(moved))[1]
            total = _dot(self.contract(found, wz)[: self.pattern.rank], self.unpacked(lam))
            if not of.flies:
                return total
            # The way and the middle of the flight change with where it starts.
            flown = of._replace(start=of.start + moved)
            return total - _dot(self.evaluate(flown, None)[0][: self.pattern.rank], a)

        return self._adjoint(of, there, slope, s, lam, pushed, bent, of_start)

    def _adjoint(
        self, of: Problem, there: Any, slope: Any, s: Any, lam: Tensor, pushed: Tensor, bent: Tensor, of_place: Any
    ) -> tuple[Tensor, ...]:
        """Of atoms moved by W B^T lambda, where A and what else depends on `of_place`."""
        weights, h = self.weights(of.w), self.unpacked(pushed)
        b = _added(self.contract(there, _times(weights, h))[: self.pattern.rank], self.unpacked(bent))
        a = self.solve(s, b, transposed=True)
        back = _each(operator.neg, self.spread(slope, a))
        z = _added(h, back)
        wz = _times(weights, z)
        by_place = torch.func.grad(lambda moved: of_place(moved, wz, a))(torch.zeros_like(pushed))
        force = self.packed(self.spread(there, self.unpacked(lam)), of.x) * self.packed(z, of.x)
        by_weight = force.reshape(-1, 3, force.shape[-1]).sum(1)
        return self.packed(back, of.x), by_place, self.packed(a, of.x), by_weight

    # -- velocities ---------------------------------------------------------------------------------

    def tangent(self, of: Problem, v: Tensor) -> tuple[Tensor, Tensor]:
        """Multipliers of velocities with A v as it is held, and by how much these change."""
        weights, slope = self.weights(of.w), self.evaluate(of, None)[1]
        off = _each(operator.sub, self.unpacked(of.held), self.contract(slope, self.unpacked(v)))
        mu = self.solve(self.couple(slope, slope, weights), off[: self.pattern.rank])
        return self.packed(mu, of.x), self.packed(_times(weights, self.spread(slope, mu)), of.x)

    def tangent_adjoint(self, of: Problem, mu: Tensor, pushed: Tensor, bent: Tensor, v: Tensor) -> tuple[Tensor, ...]:
        """As `newton_adjoint`: by velocities, positions, rates and inverse masses, at the velocities v found."""
        slope = self.evaluate(of, None)[1]
        s = self.couple(slope, slope, self.weights(of.w))

        def of_place(moved: Tensor, wz: Vector, a: Vector) -> Tensor:
            found = self.evaluate(of, self.unpacked(moved))[1]
            speeds = _dot(self.contract(found, self.unpacked(v))[: self.pattern.rank], a)
            return _dot(self.contract(found, wz)[: self.pattern.rank], self.unpacked(mu)) - speeds

        return self._adjoint(of, slope, slope, s, mu, pushed, bent, of_place)

    # -- forces ---------------------------------------------------------------------------------------

    def respond(self, of: Problem, v: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """Multipliers lambda of all rows, those of least norm, and A^T lambda.

        A (a + W A^T lambda) is what is held, less the curvature along v.
        """
        weights, slope = self.weights(of.w), self.evaluate(of, None)[1]
        s = self.couple(slope, slope, weights)

        def speeds(moved: Tensor, time: Tensor) -> Tensor:
            found = self.contract(self.evaluate(of._replace(t=time), self.unpacked(moved))[1], self.unpacked(v))
            return self.packed(found, v) + self.drift(of._replace(t=time), moved)

        bend = torch.func.jvp(speeds, (torch.zeros_like(v), of.t), (v, torch.ones_like(of.t)))[1]
        b = of.held - bend - self.packed(self.contract(slope, self.unpacked(a)), v)
        lam = self.packed(self.solve(s, self.unpacked(b)[: self.pattern.rank]), v)
        lam = self._least_norm(slope, s, weights, lam)
        return lam, self.packed(self.spread(slope, self.unpacked(lam)), v)

    def drift(self, of: Problem, moved: Tensor | None = None) -> Tensor:
        """dq/dt of rows with the time in them, where atoms rest."""
        if not any(row.function.timed and row.function.holonomic for row in self.pattern.rows):
            return of.x.new_zeros(())
        u = None if moved is None else self.unpacked(moved)
        along = (of.t,), (torch.ones_like(of.t),)
        return torch.func.jvp(lambda t: self.packed(self.evaluate(of._replace(t=t), u)[0], of.x), *along)[1]

    def _least_norm(self, slope: Any, s: Any, weights: Vector, lam: Tensor) -> Tensor:
        """Multipliers of all rows with the same force, where the last ones are sums D of those that are solved for."""
        count, rank = len(self.pattern.rows), self.pattern.rank
        if count == rank:
            return lam
        sums = []
        for row in range(rank, count):
            unit = lam.new_zeros(count, lam.shape[-1])
            unit[row] = 1.0
            force = _times(weights, self.spread(slope, self.unpacked(unit)))
            sums.append(self.packed(self.solve(s, self.contract(slope, force)[: self.pattern.rank]), lam))
        d = torch.stack(sums)
        metric = torch.einsum("krc,lrc->ckl", d, d) + torch.eye(count - rank, dtype=lam.dtype, device=lam.device)
        rest = torch.linalg.solve(metric, (d * lam).sum(1).T.unsqueeze(-1)).squeeze(-1)
        return torch.cat([lam - torch.einsum("krc,ck->rc", d, rest), rest.T])


def _each(act: Callable[..., Any], *vectors: Vector) -> Any:
    """Something done with each number of vectors."""
    return act(*vectors) if isinstance(vectors[0], Tensor) else [act(*some) for some in zip(*vectors, strict=True)]


def _added(one: Vector, other: Vector) -> Vector:
    return _each(operator.add, one, other)


def _times(one: Vector, other: Vector) -> Vector:
    return _each(operator.mul, one, other)


def _dot(one: Vector, other: Vector) -> Any:
    return sum((a * b).sum() for a, b in zip(one, other, strict=True))


class Lanes(Clusters):
    """Clusters with a tensor for each number; gradients are lists of numbers by row."""

    def unpacked(self, packed: Tensor) -> Vector:
        return list(packed.unbind(0))

    def take(self, vector: Vector, numbers: Any) -> list[Any]:
        return [vector[k] for k in numbers]

    def packed(self, vector: Vector, like: Tensor) -> Tensor:
        lane = like[0]
        return torch.stack([each.expand_as(lane) if isinstance(each, Tensor) else lane * 0 + each for each in vector])

    def couple(self, left: Any, right: Any, weights: Vector) -> Matrix:
        rows = self.pattern.rows[: self.pattern.rank]
        slot = [{a: 3 * i for i, a in enumerate(row.atoms) if a not in self.pattern.fixed} for row in rows]
        heavy = [
            {a: [weights[3 * a] * right[k][i + c] for c in range(3)] for a, i in mine.items()}
            for k, mine in enumerate(slot)
        ]

        def entry(k: int, other: int) -> Any:
            terms = [
                left[k][i + c] * each
                for atom, i in slot[k].items()
                for c, each in enumerate(heavy[other].get(atom, ()))
            ]
            return sum(terms[1:], terms[0]) if terms else None

        return [[entry(k, other) for other in range(len(rows))] for k in range(len(rows))]

    def solve(self, s: Matrix, b: Vector, transposed: bool = False) -> Vector:
        n, b = len(b), list(b)
        s = [[s[j][i] if transposed else s[i][j] for j in range(n)] for i in range(n)]
        for k in range(n):
            s[k][k] = 1.0 / s[k][k]
            for i in range(k + 1, n):
                if s[i][k] is None:
                    continue
                factor = s[i][k] * s[k][k]
                for j in range(k + 1, n):
                    if s[k][j] is not None:
                        s[i][j] = -factor * s[k][j] if s[i][j] is None else s[i][j] - factor * s[k][j]
                b[i] = b[i] - factor * b[k]
        for k in reversed(range(n)):
            for j in range(k + 1, n):
                if s[k][j] is not None:
                    b[k] = b[k] - s[k][j] * b[j]
            b[k] = b[k] * s[k][k]
        return b

    def diagonal(self, s: Matrix) -> Vector:
        return [s[k][k] for k in range(len(s))]

    def spread(self, slope: Any, lam: Vector) -> Vector:
        found: Vector = [0.0] * (3 * self.pattern.n_atoms)
        for row, steep, each in zip(self.pattern.rows, slope, lam, strict=False):
            for i, k in enumerate(3 * atom + c for atom in row.atoms for c in range(3)):
                found[k] = found[k] + steep[i] * each
        return found

    def contract(self, slope: Any, v: Vector) -> Vector:
        return [
            sum(steep[3 * i + c] * v[3 * atom + c] for i, atom in enumerate(row.atoms) for c in range(3))
            for row, steep in zip(self.pattern.rows, slope, strict=True)
        ]


class Levels(Clusters):
    """Clusters whose numbers are all in one tensor; gradients have shape (atoms in rows, 3, n).

    A level of elimination has rows that are eliminated at once, their factors, and products of these with what is
    beside the pivots. A factor has its entry, the row and a later row; a product the factor, the entry beside, and that
    it is taken from. The entry beyond the diagonal from one is `across`.
    """

    def __init__(self, pattern: Pattern, device: torch.device) -> None:
        super().__init__(pattern)
        rows = pattern.rows
        moving = [tuple(a for a in row.atoms if a not in pattern.fixed) for row in rows[: pattern.rank]]
        found = elimination(moving, set())
        place, later = found.rows.tolist(), [found.rows[some].tolist() for some in found.later]
        pairs = [pair for here, some in zip(place, later, strict=True) for i in some for pair in ((here, i), (i, here))]
        entries = {pair: k for k, pair in enumerate([*((k, k) for k in range(len(place))), *pairs])}
        self.levels = []
        for begin, end in zip(found.levels[:-1], found.levels[1:], strict=True):
            factor: list[tuple[int, int, int]] = []
            product: list[tuple[int, int, int]] = []
            for here, some in zip(place[begin:end], later[begin:end], strict=True):
                for there in some:
                    product += [(len(factor), entries[here, j], entries[there, j]) for j in some]
                    factor.append((entries[there, here], here, there))
            done = torch.tensor(place[begin:end], device=device)
            self.levels.append((done, _table(factor, 3, device), _table(product, 3, device)))
        self.across = torch.tensor([entries[j, i] for i, j in entries], device=device)
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
        return _summed(terms, entry, len(self.across))

    def solve(self, s: Tensor, b: Any, transposed: bool = False) -> Vector:
        s, b = (s[self.across] if transposed else s.clone()), b.clone()
        for _, (entry, here, there), (which, beside, taken) in self.levels:
            factor = s[entry] / s[here]
            s.index_add_(0, taken, factor[which] * s[beside], alpha=-1)
            b.index_add_(0, there, factor * b[here], alpha=-1)
        for rows, (entry, here, there), _ in reversed(self.levels):
            b.index_add_(0, here, s[self.across[entry]] * b[there], alpha=-1)
            b[rows] = b[rows] / s[rows]
        return b

    def diagonal(self, s: Tensor) -> Vector:
        return s[: self.pattern.rank]

    def spread(self, slope: Any, lam: Any) -> Vector:
        some = self.row < len(lam)
        terms = slope[some] * lam[self.row[some]].unsqueeze(1)
        return _summed(terms, self.atom[some], self.pattern.n_atoms).reshape(3 * self.pattern.n_atoms, -1)

    def contract(self, slope: Any, v: Any) -> Vector:
        places = v.reshape(self.pattern.n_atoms, 3, -1)[self.atom]
        return _summed((slope * places).sum(1), self.row, len(self.pattern.rows))


def _summed(terms: Tensor, index: Tensor, count: int) -> Tensor:
    return terms.new_zeros(count, *terms.shape[1:]).index_add(0, index, terms)


def _table(entries: Iterable[Iterable[int]], width: int, device: torch.device) -> Tensor:
    rows = [list(each) for each in entries]
    return torch.tensor(rows, dtype=torch.long, device=device).reshape(len(rows), width).T
