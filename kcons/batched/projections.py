"""Projections as functions that torch differentiates: by the equations at the solution.

What is kept for the derivative is where atoms were and are, and multipliers; nothing of the iterations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcons.batched.clusters import Problem
from kcons.batched.groups import Group

#: Newton iterations after which there is no solution near, and those that are made where nobody looks.
MAX_ITERATIONS, UNWATCHED = 30, 5
#: Roundings that a row may be off by for the iterations to end.
ROUNDINGS = 2


class Task(NamedTuple):
    """What is solved for.

    `of_positions` or of velocities, and whether rows of velocities count in positions as well (`flies`); times of what
    is projected and of where directions are taken; cells, and cells by which atoms of whole rows stand off where they
    are stored; inverse masses and targets that are the batch's `own`, which do not change from call to call.
    """

    of_positions: bool
    flies: bool
    groups: Sequence[Group]
    t: Tensor
    t_start: Tensor
    lattice: Tensor | None
    tree: Callable[[Tensor], Tensor | None]
    own: tuple[Tensor, Tensor]

    def problem(self, group: Group, x: Tensor, start: Tensor, held: Tensor, w: Tensor) -> Problem:
        """Of the clusters of a group, at positions x with directions of a start, which may be the same tensor."""
        there = group.coordinates(start, self.lattice, self.tree)
        here = there if x is start else group.coordinates(x, self.lattice, self.tree)
        flies = self.flies and any(not row.function.holonomic for row in group.pattern.rows)
        weights = group.lanes(w, group.atoms, w is self.own[0])
        wanted = group.lanes(held, group.rows, held is self.own[1])
        return Problem(here[0], there[0], here[1], there[1], flies, weights, wanted, group.p, self.t, self.t_start)


def _solve(group: Group, of: Problem) -> tuple[Tensor, Tensor]:
    """Multipliers, and how far they move the atoms, by Newton's method; notes by how much rows are off then.

    On a processor residuals are looked at in each iteration; on a GPU that would wait for it.
    """
    eps, watched = torch.finfo(of.x.dtype).eps, of.x.device.type == "cpu"
    count, before = MAX_ITERATIONS if watched else UNWATCHED, torch.inf
    following = of.x.new_zeros(group.pattern.rank, of.x.shape[-1])
    for _ in range(count + 1):
        lam = following
        following, moved, size = group.solver.newton(of, lam)
        worst = float((size / group.scale).max()) if watched else torch.inf
        # Near the end an iteration that gains nothing shows what rounding leaves.
        if not worst > ROUNDINGS * eps or eps**0.5 > worst > 0.5 * before:
            break
        before = worst
    group.worst = torch.maximum(group.worst, size / group.scale)
    return lam, moved


class Projection(torch.autograd.Function):
    """Positions or velocities on the rows, by how much they were moved, and multipliers by row.

    Of what is projected, of positions whose gradients give the directions, of what rows are held at, and of inverse
    masses.
    """

    @staticmethod
    def forward(ctx: Any, given: Tensor, place: Tensor, held: Tensor, w: Tensor, task: Task) -> Any:
        push, multipliers = torch.zeros_like(given), torch.zeros_like(held)
        for group in task.groups:
            of = task.problem(group, given if task.of_positions else place, place, held, w)
            if task.of_positions:
                lam, moved = _solve(group, of)
            else:
                lam, moved = group.solver.tangent(of, given.reshape(-1)[group.flat])
            group.put(push, moved)
            multipliers[group.rows[: group.pattern.rank]] = lam
        found = given + push
        ctx.task = task
        ctx.save_for_backward(found, place, held, w, multipliers)
        ctx.set_materialize_grads(False)
        return found, push, multipliers

    @staticmethod
    def backward(ctx: Any, by_found: Any, by_push: Any, by_multipliers: Any) -> Any:
        found, place, held, w, multipliers = ctx.saved_tensors
        task = ctx.task
        by_found = torch.zeros_like(found) if by_found is None else by_found
        pushed = by_found if by_push is None else by_found + by_push
        sums = [torch.zeros_like(each) for each in (found, place, held, w)]
        for group in task.groups:
            of = task.problem(group, found if task.of_positions else place, place, held, w)
            adjoint = group.solver.newton_adjoint if task.of_positions else group.solver.tangent_adjoint
            rows = group.rows[: group.pattern.rank]
            bent = torch.zeros_like(multipliers[rows]) if by_multipliers is None else by_multipliers[rows]
            here, h = found.reshape(-1)[group.flat], pushed.reshape(-1)[group.flat]
            parts = adjoint(of, multipliers[rows], h, bent, here)
            for k, (part, index) in enumerate(zip(parts, (group.flat, group.flat, rows, group.atoms), strict=True)):
                # Atoms that are fixed may belong to several clusters.
                flat = sums[k].reshape(-1).index_add(0, index.reshape(-1), part.expand(index.shape).reshape(-1))
                sums[k] = flat.reshape(sums[k].shape)
        return by_found + sums[0], *sums[1:], None
