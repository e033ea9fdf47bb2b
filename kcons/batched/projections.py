"""Projections of positions and velocities as functions that torch differentiates: by the equations at the solution.

What is kept for the derivative is positions before and after, and multipliers; nothing of the iterations.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcons.batched.groups import Group

#: Newton iterations after which there is no solution near, and those of a time step where nobody looks.
MAX_ITERATIONS, UNWATCHED = 30, 6


class Task(NamedTuple):
    """What is solved for: clusters, times, cells, and which tensors are those of the batch.

    Attributes
    ----------
    groups : sequence of Group
    t, t_start : Tensor
        Times of what is projected and of the reference.
    lattice : Tensor, shape (n_systems, 2, 3, 3), or None
    tree : callable
        Cells by which atoms of whole rows stand off where they are stored.
    own : tuple of Tensor
        Targets and inverse masses that do not change from call to call.
    flies : bool
        Whether rows of velocities count in positions.
    watched : bool
        Whether residuals are looked at in each iteration, which waits for the device.
    """

    groups: Sequence[Group]
    t: Tensor
    t_start: Tensor
    lattice: Tensor | None
    tree: Any
    own: tuple[Tensor, Tensor]
    flies: bool
    watched: bool

    def numbers(self, group: Group, targets: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        """Inverse masses and targets of clusters."""
        return (
            group.lanes(w, group.atoms, w is self.own[1]),
            group.lanes(targets, group.rows, targets is self.own[0]),
        )

    def places(self, group: Group, x: Tensor, start: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor | None]:
        """Places of rows at x and at the start, (3 places, n), and the way of atoms where rows of velocities count."""
        n = group.atoms.shape[1]
        here = group.places(x)
        there = here if start is None else group.places(start)
        if self.lattice is not None:
            origin = x if start is None else start
            cells = group.cells(origin, self.lattice, self.tree(origin))
            cell = self.lattice[group.systems, 0]
            there = there + torch.einsum("exn,nxy->eyn", cells, cell)
            if start is None:
                here = there
            else:
                cells = cells - group.passed(x, start, self.lattice)
                here = here + torch.einsum("exn,nxy->eyn", cells, cell)
        way = None
        if self.flies and start is not None and group.pattern.of_flight:
            way = (x - start).reshape(-1)[group.flat]
        return here.reshape(-1, n), there.reshape(-1, n), way


def _solve(task: Task, group: Group, given: tuple[Any, ...]) -> tuple[Tensor, Tensor]:
    """Multipliers, and how far they move the atoms, by Newton's method; notes what rows are off by."""
    base, rank, solver = given[0], group.pattern.rank, group.solver
    eps = torch.finfo(base.dtype).eps
    lam = base.new_zeros(rank, base.shape[-1])
    before = moved = None
    for iteration in range(1, MAX_ITERATIONS + 1):
        lam, size = solver.newton(*given, lam)
        last = iteration == (MAX_ITERATIONS if task.watched else UNWATCHED)
        # The next error is about the square of this one.
        if not last and task.watched and float((size / group.scale[:rank]).max()) > 0.05 * eps**0.5:
            continue
        if not last and not task.watched:
            continue
        moved, off = solver.finish(*given, lam)
        off = off / group.scale
        if task.watched:
            worst = float(off.max())
            if not last and worst > 30 * eps and (before is None or worst < 0.5 * before):
                before = worst
                continue
        break
    off[:rank] = torch.where(torch.isinf(size), size, off[:rank])
    group.worst = torch.maximum(group.worst, off)
    return lam, moved


class Positions(torch.autograd.Function):
    """Positions on the rows, by how much atoms moved, and multipliers by row.

    Of positions, those of the reference, targets and inverse masses.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, start: Tensor, targets: Tensor, w: Tensor, task: Task) -> Any:
        push, multipliers = torch.zeros_like(x), torch.zeros_like(targets)
        for group in task.groups:
            weights, held = task.numbers(group, targets, w)
            base, there, way = task.places(group, x, start)
            lam, moved = _solve(task, group, (base, there, way, weights, held, group.p, task.t, task.t_start))
            group.put(push, moved)
            multipliers[group.rows[: group.pattern.rank]] = lam
        y = x + push
        ctx.task = task
        ctx.save_for_backward(y, start, targets, w, multipliers)
        ctx.set_materialize_grads(False)
        return y, push, multipliers

    @staticmethod
    def backward(ctx: Any, by_y: Any, by_push: Any, by_multipliers: Any) -> Any:
        y, start, targets, w, multipliers = ctx.saved_tensors
        task = ctx.task
        by_y = torch.zeros_like(y) if by_y is None else by_y
        pushed = by_y if by_push is None else by_y + by_push
        sums = [torch.zeros_like(each) for each in (y, start, targets, w)]
        for group in task.groups:
            weights, _ = task.numbers(group, targets, w)
            base, there, way = task.places(group, y, start)
            rows = group.rows[: group.pattern.rank]
            lam = multipliers[rows]
            bent = torch.zeros_like(lam) if by_multipliers is None else by_multipliers[rows]
            h = pushed.reshape(-1)[group.flat]
            found = group.solver.newton_adjoint(base, there, way, weights, group.p, task.t, task.t_start, lam, h, bent)
            _sum_up(sums, found, (group.flat, group.flat, rows, group.atoms))
        return by_y + sums[0], sums[1], sums[2], sums[3], None


class Velocities(torch.autograd.Function):
    """Velocities with A v = rates, by how much they changed, and multipliers by row.

    Of positions, velocities, rates and inverse masses.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, v: Tensor, rates: Tensor, w: Tensor, task: Task) -> Any:
        push, multipliers = torch.zeros_like(v), torch.zeros_like(rates)
        for group in task.groups:
            weights, wanted = task.numbers(group, rates, w)
            base, _, _ = task.places(group, x)
            moved, mu = group.solver.tangent(base, weights, group.p, task.t, v.reshape(-1)[group.flat], wanted)
            group.put(push, moved)
            multipliers[group.rows[: group.pattern.rank]] = mu
        found = v + push
        ctx.task = task
        ctx.save_for_backward(x, found, rates, w, multipliers)
        ctx.set_materialize_grads(False)
        return found, push, multipliers

    @staticmethod
    def backward(ctx: Any, by_v: Any, by_push: Any, by_multipliers: Any) -> Any:
        x, v, rates, w, multipliers = ctx.saved_tensors
        task = ctx.task
        by_v = torch.zeros_like(v) if by_v is None else by_v
        pushed = by_v if by_push is None else by_v + by_push
        sums = [torch.zeros_like(each) for each in (v, x, rates, w)]
        for group in task.groups:
            weights, _ = task.numbers(group, rates, w)
            base, _, _ = task.places(group, x)
            rows = group.rows[: group.pattern.rank]
            mu = multipliers[rows]
            bent = torch.zeros_like(mu) if by_multipliers is None else by_multipliers[rows]
            here, h = v.reshape(-1)[group.flat], pushed.reshape(-1)[group.flat]
            found = group.solver.tangent_adjoint(base, weights, group.p, task.t, here, mu, h, bent)
            _sum_up(sums, found, (group.flat, group.flat, rows, group.atoms))
        return sums[1], by_v + sums[0], sums[2], sums[3], None


def _sum_up(sums: list[Tensor], found: Sequence[Tensor], places: Sequence[Tensor]) -> None:
    """Add what clusters have found; atoms that are fixed may belong to several."""
    for k, (values, index) in enumerate(zip(found, places, strict=True)):
        flat = sums[k].reshape(-1).index_add(0, index.reshape(-1), values.expand(index.shape).reshape(-1))
        sums[k] = flat.reshape(sums[k].shape)
