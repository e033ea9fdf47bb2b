"""Clusters that look alike, side by side: the equations of their multipliers, by positions, velocities and gradients.

Numbers of a cluster are lists of tensors. Small clusters have a tensor of shape (clusters,) for each number, and their
elimination is written out (`Lanes`); of larger ones a list has one tensor with all, and rows that share nothing are
eliminated together, by levels (`Levels`). What is done with these is written once, for both.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
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

    @property
    def of_flight(self) -> bool:
        """Whether rows of velocities are among its rows."""
        return any(not row.function.holonomic for row in self.rows)


class Flight(NamedTuple):
    """For rows of velocities: places where atoms come from, how far they have come, (3 n_atoms, n), and the mean time."""

    start: Tensor
    way: Tensor
    time: Tensor


class Clusters(ABC):
    """Equations of the clusters of one pattern; the last axis of all arguments is by cluster.

    `base` are places of rows, shape (3 places, n); `w` inverse masses, (n_atoms, n or 1); `p` parameters, (all, n or
    1); t times. Vectors of rows have shape (rank, n) or (n_rows, n), those of atoms (3 n_atoms, n).
    """

    def __init__(self, pattern: Pattern) -> None:
        self.pattern = pattern
        now = [atom for row in pattern.rows for atom in row.places]
        first = [row.atoms[0] if row.relative else pattern.n_atoms for row in pattern.rows for _ in row.places]
        #: Atoms of places, and those that these count from; the number of atoms where they count from nothing.
        self.now, self.first = torch.tensor(now), torch.tensor(first)

    # -- what a representation says ---------------------------------------------------------------

    @abstractmethod
    def rows_of(self, packed: Tensor) -> Vector:
        """A vector of rows as a list."""

    @abstractmethod
    def atoms_of(self, packed: Tensor) -> Vector:
        """A vector of atoms as a list."""

    @abstractmethod
    def weights(self, w: Tensor) -> Vector:
        """Inverse masses, as a list for the coordinates of atoms."""

    @abstractmethod
    def packed(self, vector: Vector, like: Tensor) -> Tensor:
        """The tensor of a list."""

    @abstractmethod
    def evaluate(
        self, base: Tensor, u: Vector | None, p: Tensor, t: Any, flight: Flight | None = None, slope: bool = True
    ) -> tuple[Vector, Any]:
        """Values, and gradients unless `slope` is False, where atoms have moved by u from `base`."""

    @abstractmethod
    def couple(self, left: Any, right: Any, weights: Vector) -> Any:
        """A W B^T of two gradients, of the rows that are solved for."""

    @abstractmethod
    def solve(self, s: Any, b: Vector, transposed: bool = False) -> Vector:
        """y of S y = b, or of S^T y = b."""

    @abstractmethod
    def diagonal(self, s: Any) -> Vector:
        """Of a matrix, as a list of rows."""

    @abstractmethod
    def spread(self, slope: Any, lam: Vector) -> Vector:
        """A^T lambda by atom, of all rows or of those that are solved for."""

    @abstractmethod
    def contract(self, slope: Any, v: Vector) -> Vector:
        """A v of all rows."""

    @abstractmethod
    def lengths(self, slope: Any) -> Vector:
        """Of the gradients of all rows."""

    @abstractmethod
    def solved(self, rows: Vector) -> Vector:
        """Of a vector of all rows those that are solved for."""

    @abstractmethod
    def off(self, value: Vector, targets: Vector) -> Vector:
        """Value less target, of periodic rows to the nearest image."""

    # -- positions ----------------------------------------------------------------------------------

    def newton(
        self,
        base: Tensor,
        start: Tensor,
        way: Tensor | None,
        w: Tensor,
        targets: Tensor,
        p: Tensor,
        t: Tensor,
        t_start: Tensor,
        lam: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """One step of Newton's method: multipliers, and by how much rows were off before; infinite where they turned.

        The gradients at the `start` are the directions, and multipliers zero their lengths at first.
        """
        weights, known = self.weights(w), self.rows_of(lam)
        there = self.evaluate(start, None, p, t_start)[1]
        u = _times(weights, self.spread(there, known))
        value, slope = self.evaluate(base, u, p, t, None if way is None else Flight(start, way, 0.5 * (t + t_start)))
        off = self.solved(self.off(value, self.rows_of(targets)))
        s = self.couple(slope, there, weights)
        step = self.solve(s, [-each for each in off])
        size = [torch.where(d > 0, o.abs(), torch.inf) for d, o in zip(self.diagonal(s), off, strict=True)]
        return self.packed(_added(known, step), base), self.packed(size, base)

    def finish(
        self,
        base: Tensor,
        start: Tensor,
        way: Tensor | None,
        w: Tensor,
        targets: Tensor,
        p: Tensor,
        t: Tensor,
        t_start: Tensor,
        lam: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """How far multipliers move the atoms, and by how much all rows are off there."""
        there = self.evaluate(start, None, p, t_start)[1]
        u = _times(self.weights(w), self.spread(there, self.rows_of(lam)))
        value, _ = self.evaluate(
            base, u, p, t, None if way is None else Flight(start, way, 0.5 * (t + t_start)), slope=False
        )
        off = self.off(value, self.rows_of(targets))
        return self.packed(u, base), self.packed([each.abs() for each in off], base)

    def newton_adjoint(
        self,
        base: Tensor,
        start: Tensor,
        way: Tensor | None,
        w: Tensor,
        p: Tensor,
        t: Tensor,
        t_start: Tensor,
        lam: Tensor,
        pushed: Tensor,
        bent: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Derivatives at the solution `base`, by one solve with the transposed matrix.

        Parameters
        ----------
        pushed, bent : Tensor
            Derivatives by how far atoms were moved, and by multipliers.

        Returns
        -------
        tuple of Tensor
            By positions, by positions of the start, by targets and by inverse masses, (n_atoms, n).
        """
        weights, known, h = self.weights(w), self.rows_of(lam), self.atoms_of(pushed)
        flight = None if way is None else Flight(start, way, 0.5 * (t + t_start))
        there = self.evaluate(start, None, p, t_start)[1]
        slope = self.evaluate(base, None, p, t, flight)[1]
        s = self.couple(slope, there, weights)
        b = _added(self.solved(self.contract(there, _times(weights, h))), self.rows_of(bent))
        a = self.solve(s, b, transposed=True)
        back = [-each for each in self.spread(slope, a)]
        z = _added(h, back)
        wz = _times(weights, z)

        def of_start(moved_by: Tensor) -> Tensor:
            u = self.atoms_of(moved_by)
            slopes = self.evaluate(start, u, p, t_start)[1]
            total = _dot(self.solved(self.contract(slopes, wz)), known)
            if way is not None:
                # The way and the middle of the flight change with where it starts.
                moved = Flight(start + self._places(moved_by), way - moved_by, 0.5 * (t + t_start))
                total = total - _dot(self.solved(self.evaluate(base, None, p, t, moved)[0]), a)
            return total

        by_start = torch.func.grad(of_start)(torch.zeros_like(pushed))
        force = self.packed(self.spread(there, known), base) * self.packed(z, base)
        by_weight = force.reshape(-1, 3, force.shape[-1]).sum(1)
        return self.packed(back, base), by_start, self.packed(a, base), by_weight

    def _places(self, moved: Tensor) -> Tensor:
        """Changes of places where atoms move."""
        by_atom = moved.reshape(self.pattern.n_atoms, 3, -1)
        by_atom = torch.cat([by_atom, torch.zeros_like(by_atom[:1])])
        now, first = (index.to(moved.device) for index in (self.now, self.first))
        return (by_atom[now] - by_atom[first]).reshape(-1, moved.shape[-1])

    # -- velocities ---------------------------------------------------------------------------------

    def tangent(self, base: Tensor, w: Tensor, p: Tensor, t: Tensor, v: Tensor, rates: Tensor) -> tuple[Tensor, Tensor]:
        """By how much velocities change so that A v = rates, and the multipliers."""
        weights = self.weights(w)
        slope = self.evaluate(base, None, p, t)[1]
        s = self.couple(slope, slope, weights)
        b = [r - each for each, r in zip(self.contract(slope, self.atoms_of(v)), self.rows_of(rates), strict=True)]
        mu = self.solve(s, self.solved(b))
        return self.packed(_times(weights, self.spread(slope, mu)), base), self.packed(mu, base)

    def tangent_adjoint(
        self,
        base: Tensor,
        w: Tensor,
        p: Tensor,
        t: Tensor,
        v: Tensor,
        mu: Tensor,
        pushed: Tensor,
        bent: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Derivatives by velocities, positions, rates and inverse masses, at the velocities v that were found."""
        weights, known, h = self.weights(w), self.rows_of(mu), self.atoms_of(pushed)
        slope = self.evaluate(base, None, p, t)[1]
        s = self.couple(slope, slope, weights)
        a = self.solve(s, _added(self.solved(self.contract(slope, _times(weights, h))), self.rows_of(bent)))
        back = [-each for each in self.spread(slope, a)]
        z = _added(h, back)
        wz, here = _times(weights, z), self.atoms_of(v)

        def of_place(moved_by: Tensor) -> Tensor:
            slopes = self.evaluate(base, self.atoms_of(moved_by), p, t)[1]
            return _dot(self.solved(self.contract(slopes, wz)), known) - _dot(
                self.solved(self.contract(slopes, here)), a
            )

        by_place = torch.func.grad(of_place)(torch.zeros_like(pushed))
        force = self.packed(self.spread(slope, known), base) * self.packed(z, base)
        by_weight = force.reshape(-1, 3, force.shape[-1]).sum(1)
        return self.packed(back, base), by_place, self.packed(a, base), by_weight

    # -- forces ---------------------------------------------------------------------------------------

    def respond(self, base: Tensor, w: Tensor, p: Tensor, t: Tensor, v: Tensor, a: Tensor, rates: Tensor) -> Tensor:
        """Multipliers of all rows with A (a + W A^T lambda) = rates less the curvature along v, those of least norm."""
        weights = self.weights(w)
        slope = self.evaluate(base, None, p, t)[1]
        s = self.couple(slope, slope, weights)

        def speeds(moved_by: Tensor, time: Tensor) -> Tensor:
            u = self.atoms_of(moved_by)
            found = self.contract(self.evaluate(base, u, p, time)[1], self.atoms_of(v))
            return self.packed(found, v) + self.drift(base, u, p, time)

        bend = torch.func.jvp(speeds, (torch.zeros_like(v), t), (v, torch.ones_like(t)))[1]
        b = rates - bend - self.packed(self.contract(slope, self.atoms_of(a)), v)
        lam = self.packed(self.solve(s, self.solved(self.rows_of(b))), v)
        return self._least_norm(slope, s, weights, lam)

    def drift(self, base: Tensor, u: Vector | None, p: Tensor, t: Tensor) -> Tensor:
        """dq/dt of rows with the time in them, where atoms rest."""

        def values(time: Tensor) -> Tensor:
            return self.packed(self.evaluate(base, u, p, time)[0], base)

        if not any(row.function.timed and row.function.holonomic for row in self.pattern.rows):
            return base.new_zeros(())
        return torch.func.jvp(values, (t,), (torch.ones_like(t),))[1]

    def _least_norm(self, slope: Any, s: Any, weights: Vector, lam: Tensor) -> Tensor:
        """Multipliers of all rows with the same force, where the last ones are sums D of those that are solved for."""
        count, rank = len(self.pattern.rows), self.pattern.rank
        if count == rank:
            return lam
        sums = []
        for row in range(rank, count):
            unit = torch.zeros(count, lam.shape[-1], dtype=lam.dtype, device=lam.device)
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
