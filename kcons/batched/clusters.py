"""Clusters that look alike, side by side: the equations of their multipliers, by positions, velocities and gradients.

Numbers of a cluster are lists of tensors. Small clusters have a tensor of shape (clusters,) for each number, and their
elimination is written out (`lanes`); of larger ones a list has one tensor with all, and rows that share nothing are
eliminated together, by levels (`levels`). What is done with these is written once, for both.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcons.batched.row_functions import RowFunction

#: Rows, and atoms in all rows, up to which elimination is written out.
LANES_ROWS, LANES_PLACES = 6, 24

Vector = list[Any]


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

    @property
    def places(self) -> tuple[int, ...]:
        """Atoms of which it takes a place."""
        return self.atoms[1:] if self.relative else self.atoms


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

    Places of rows and those where directions are taken (`start`), (3 places, n), and how far atoms have come from there
    where rows of velocities count (`way`), (3 n_atoms, n); inverse masses `w`, what rows are `held` at, parameters `p`.
    """

    base: Tensor
    start: Tensor
    way: Tensor | None
    w: Tensor
    held: Tensor
    p: Tensor
    t: Tensor
    t_start: Tensor

    @property
    def at_start(self) -> Problem:
        return self._replace(base=self.start, way=None, t=self.t_start)


class Clusters:
    """Equations of the clusters of one pattern.

    Vectors of rows have shape (rank, n) or (n_rows, n), those of atoms (3 n_atoms, n). `rows_of`, `atoms_of` and
    `weights` make lists of vectors and of inverse masses, `packed` tensors of lists. `evaluate` gives values and
    gradients A with atoms moved, `couple` A W B^T of the rows that are solved for, `spread` A^T lambda, `contract` A v,
    `solved` the rows that are solved for, and `off` value less target.
    """

    rows_of: Any
    atoms_of: Any
    weights: Any
    packed: Any
    evaluate: Any
    couple: Any
    solve: Any
    diagonal: Any
    spread: Any
    contract: Any
    solved: Any
    off: Any

    def __init__(self, pattern: Pattern) -> None:
        self.pattern = pattern

    # -- positions ----------------------------------------------------------------------------------

    def newton(self, of: Problem, lam: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One step of Newton's method: the next multipliers; what these ones come to.

        That is how far they move the atoms, and by how much all rows are off then, infinite where one has turned.
        """
        weights, known, rank = self.weights(of.w), self.rows_of(lam), self.pattern.rank
        there = self.evaluate(of.at_start, None)[1]
        u = _times(weights, self.spread(there, known))
        value, slope = self.evaluate(of, u)
        off = self.off(value, self.rows_of(of.held))
        s = self.couple(slope, there, weights)
        step = self.solve(s, [-each for each in self.solved(off)])
        size = self.packed(off, of.base).abs()
        turned = self.packed([torch.where(d > 0, 0.0, torch.inf) for d in self.diagonal(s)], of.base)
        size = size + turned if rank == len(size) else torch.cat([size[:rank] + turned, size[rank:]])
        return self.packed(_added(known, step), of.base), self.packed(u, of.base), size

    def newton_adjoint(self, of: Problem, lam: Tensor, pushed: Tensor, bent: Tensor, _: Tensor) -> tuple[Tensor, ...]:
        """Derivatives at the solution `of.base`, by one solve with the transposed matrix.

        By positions, by those of the start, by targets and by inverse masses; of derivatives by how far atoms are
        `pushed` and by multipliers (`bent`).
        """
        there, slope = self.evaluate(of.at_start, None)[1], self.evaluate(of, None)[1]
        s = self.couple(slope, there, self.weights(of.w))

        def of_start(moved: Tensor, wz: Vector, a: Vector) -> Tensor:
            found = self.evaluate(of.at_start, self.atoms_of(moved))[1]
            total = _dot(self.solved(self.contract(found, wz)), self.rows_of(lam))
            if of.way is None:
                return total
            # The way and the middle of the flight change with where it starts.
            flown = of._replace(start=of.start + self.moved_places(moved), way=of.way - moved)
            return total - _dot(self.solved(self.evaluate(flown, None)[0]), a)

        return self._adjoint(of, there, slope, s, lam, pushed, bent, of_start)

    def _adjoint(
        self, of: Problem, there: Any, slope: Any, s: Any, lam: Tensor, pushed: Tensor, bent: Tensor, of_place: Any
    ) -> tuple[Tensor, ...]:
        """Of atoms moved by W B^T lambda, where A and what else depends on `of_place`."""
        weights, h = self.weights(of.w), self.atoms_of(pushed)
        b = _added(self.solved(self.contract(there, _times(weights, h))), self.rows_of(bent))
        a = self.solve(s, b, transposed=True)
        back = [-each for each in self.spread(slope, a)]
        z = _added(h, back)
        wz = _times(weights, z)
        by_place = torch.func.grad(lambda moved: of_place(moved, wz, a))(torch.zeros_like(pushed))
        force = self.packed(self.spread(there, self.rows_of(lam)), of.base) * self.packed(z, of.base)
        by_weight = force.reshape(-1, 3, force.shape[-1]).sum(1)
        return self.packed(back, of.base), by_place, self.packed(a, of.base), by_weight

    def moved_places(self, moved: Tensor) -> Tensor:
        """Changes of places where atoms move."""
        rows = [3 * atom + c for row in self.pattern.rows for atom in row.places for c in range(3)]
        first = [3 * row.atoms[0] + c for row in self.pattern.rows for _ in row.places for c in range(3)]
        relative = [[float(row.relative)] for row in self.pattern.rows for _ in row.places for c in range(3)]
        return moved[rows] - moved.new_tensor(relative) * moved[first]

    # -- velocities ---------------------------------------------------------------------------------

    def tangent(self, of: Problem, v: Tensor) -> tuple[Tensor, Tensor]:
        """Multipliers of velocities with A v as it is held, and by how much these change."""
        weights, slope = self.weights(of.w), self.evaluate(of, None)[1]
        speeds = zip(self.rows_of(of.held), self.contract(slope, self.atoms_of(v)), strict=True)
        mu = self.solve(self.couple(slope, slope, weights), self.solved([wanted - found for wanted, found in speeds]))
        return self.packed(mu, of.base), self.packed(_times(weights, self.spread(slope, mu)), of.base)

    def tangent_adjoint(self, of: Problem, mu: Tensor, pushed: Tensor, bent: Tensor, v: Tensor) -> tuple[Tensor, ...]:
        """As `newton_adjoint`: by velocities, positions, rates and inverse masses, at the velocities v found."""
        slope = self.evaluate(of, None)[1]
        s = self.couple(slope, slope, self.weights(of.w))

        def of_place(moved: Tensor, wz: Vector, a: Vector) -> Tensor:
            found = self.evaluate(of, self.atoms_of(moved))[1]
            speeds = _dot(self.solved(self.contract(found, self.atoms_of(v))), a)
            return _dot(self.solved(self.contract(found, wz)), self.rows_of(mu)) - speeds

        return self._adjoint(of, slope, slope, s, mu, pushed, bent, of_place)

    # -- forces ---------------------------------------------------------------------------------------

    def respond(self, of: Problem, v: Tensor, a: Tensor) -> tuple[Tensor, Tensor]:
        """Multipliers lambda of all rows, those of least norm, and A^T lambda.

        A (a + W A^T lambda) is what is held, less the curvature along v.
        """
        weights, slope = self.weights(of.w), self.evaluate(of, None)[1]
        s = self.couple(slope, slope, weights)

        def speeds(moved: Tensor, time: Tensor) -> Tensor:
            found = self.contract(self.evaluate(of._replace(t=time), self.atoms_of(moved))[1], self.atoms_of(v))
            return self.packed(found, v) + self.drift(of._replace(t=time), moved)

        bend = torch.func.jvp(speeds, (torch.zeros_like(v), of.t), (v, torch.ones_like(of.t)))[1]
        b = of.held - bend - self.packed(self.contract(slope, self.atoms_of(a)), v)
        lam = self.packed(self.solve(s, self.solved(self.rows_of(b))), v)
        lam = self._least_norm(slope, s, weights, lam)
        return lam, self.packed(self.spread(slope, self.rows_of(lam)), v)

    def drift(self, of: Problem, moved: Tensor | None = None) -> Tensor:
        """dq/dt of rows with the time in them, where atoms rest."""
        if not any(row.function.timed and row.function.holonomic for row in self.pattern.rows):
            return of.base.new_zeros(())
        u = None if moved is None else self.atoms_of(moved)
        along = (of.t,), (torch.ones_like(of.t),)
        return torch.func.jvp(lambda t: self.packed(self.evaluate(of._replace(t=t), u)[0], of.base), *along)[1]

    def _least_norm(self, slope: Any, s: Any, weights: Vector, lam: Tensor) -> Tensor:
        """Multipliers of all rows with the same force, where the last ones are sums D of those that are solved for."""
        count, rank = len(self.pattern.rows), self.pattern.rank
        if count == rank:
            return lam
        sums = []
        for row in range(rank, count):
            unit = lam.new_zeros(count, lam.shape[-1])
            unit[row] = 1.0
            force = _times(weights, self.spread(slope, self.rows_of(unit)))
            sums.append(self.packed(self.solve(s, self.solved(self.contract(slope, force))), lam))
        d = torch.stack(sums)
        metric = torch.einsum("krc,lrc->ckl", d, d) + torch.eye(count - rank, dtype=lam.dtype, device=lam.device)
        rest = torch.linalg.solve(metric, (d * lam).sum(1).T.unsqueeze(-1)).squeeze(-1)
        return torch.cat([lam - torch.einsum("krc,ck->rc", d, rest), rest.T])


def _added(one: Vector, other: Vector) -> Vector:
    return [a + b for a, b in zip(one, other, strict=True)]


def _times(one: Vector, other: Vector) -> Vector:
    return [a * b for a, b in zip(one, other, strict=True)]


def _dot(one: Vector, other: Vector) -> Any:
    return sum((a * b).sum() for a, b in zip(one, other, strict=True))
