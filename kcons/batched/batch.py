"""Many systems, or many copies of one, held side by side on a device."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcons.batched.clusters import Problem
from kcons.batched.groups import Group, kinds_of
from kcons.constraints.arguments import IntArray, whole_number
from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.motion.report import Report

#: Parts of its scale that a row may be off by, and so many roundings in single precision.
ACCEPTED, ROUNDINGS = 1e-10, 1e3
#: Projections after which failures are looked for, where looking waits for the device.
CHECK_EVERY = 100
#: Newton iterations after which there is no solution near, and those that are made where nobody looks.
MAX_ITERATIONS, UNWATCHED = 30, 5
#: Roundings that a row may be off by for the iterations to end.
ENOUGH = 2


class Solved(NamedTuple):
    """Positions on the rows, by how much atoms were moved, M^-1 A^T Lambda, and Lambda by row in natural units."""

    positions: Tensor
    push: Tensor
    multipliers: Tensor


class Batch:
    """Constrained motion of many systems at once, on PyTorch tensors, differentiable.

    Clusters of equal shape are solved side by side, whichever systems they belong to. Classes, names, rank,
    conversions, cells and refusals are those of the engines. All methods leave what they are given as it was.

    Parameters
    ----------
    motions : Motion or sequence of Motion
        Engines of the systems, one a system; the same object may come any number of times.
    copies : int
        How many times all of these are there.
    device : str or torch.device
    dtype : torch.dtype
        torch.float64 or torch.float32.
    compiled : bool
        Whether steps for small clusters are compiled by `torch.compile`, once for each shape: some ten seconds, after
        which a projection takes a third of the time on a processor, and a few launches on a GPU.
    check_every : int, optional
        Projections of positions after which failures are looked for: 1 on a processor, and 100 on a GPU, where looking
        waits for the device.

    Attributes
    ----------
    systems : tuple of Motion
    n_systems, n_atoms, n_rows : int
        All together.
    atom_starts, row_starts : ndarray of int, shape (n_systems + 1,)
        Where atoms and rows of each system begin; those of all systems follow each other.
    system_idx : Tensor, shape (n_atoms,)
        System of each atom.
    masses : Tensor, shape (n_atoms,)
    targets : Tensor, shape (n_rows,)
        What rows are held at; of moving targets, at time 0.
    ranks, degrees_of_freedom : Tensor, shape (n_systems,)

    Raises
    ------
    UnsupportedError
        A function of a user that cannot be run on tensors.
    InputError
        No systems, no copies, or another type of number.
    """

    def __init__(
        self,
        motions: Motion | Sequence[Motion],
        copies: int = 1,
        *,
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float64,
        compiled: bool = False,
        check_every: int | None = None,
    ) -> None:
        given = [motions] if isinstance(motions, Motion) else list(motions)
        if not given or copies < 1 or not all(isinstance(each, Motion) for each in given):
            raise InputError("give a kcons.Motion and the number of copies, or a list of Motions", item="motions")
        if dtype not in (torch.float64, torch.float32):
            raise InputError(f"dtype is {dtype}; give torch.float64 or torch.float32", item="dtype")
        self.systems = tuple(given * copies)
        self.device, self.dtype, self.compiled = torch.device(device), dtype, compiled
        often = 1 if self.device.type == "cpu" else CHECK_EVERY
        self.check_every = often if check_every is None else whole_number(check_every, "check_every")
        self.n_systems = len(self.systems)
        self.atom_starts = np.cumsum([0, *(each.n_atoms for each in self.systems)])
        self.row_starts = np.cumsum([0, *(each.constraint_set.n_rows for each in self.systems)])
        self.n_atoms, self.n_rows = int(self.atom_starts[-1]), int(self.row_starts[-1])
        self._numbers: dict[Motion, list[int]] = {}
        for number, each in enumerate(self.systems):
            self._numbers.setdefault(each, []).append(number)
        self.system_idx = torch.as_tensor(
            np.repeat(np.arange(self.n_systems), np.diff(self.atom_starts)), device=self.device
        )
        self.masses = self._joined(lambda each: each.masses)
        self.targets = self._joined(lambda each: each.constraint_set.target(0.0))
        self.ranks = self._joined(lambda each: [each.rank], torch.int64)
        self.degrees_of_freedom = self._joined(lambda each: [each.degrees_of_freedom], torch.int64)
        self._still, self._calls = torch.zeros_like(self.targets), 0
        # Fixed atoms, in the order of their rows.
        self._fixed_rows = self._joined(lambda each: each.plan.pinned_rows, torch.int64, self.row_starts)
        self._fixed = self._joined(_fixed_atoms, torch.int64, self.atom_starts)
        self._free = self.masses > 0
        self._free[self._fixed] = False
        self._inverse_masses = self._inverse(self.masses)
        self._moving = any(each.constraint_set.moving for each in self._numbers)
        self._is_position = self._joined(lambda each: each.constraint_set.holonomic, torch.bool)
        self._holonomic = bool(self._is_position.all())
        self._set_lattices()
        self._given, self._known = (self.masses, self.targets), dict[bool, list[Group]]()
        self._groups(True)

    def _joined(self, of: Any, dtype: torch.dtype | None = None, starts: Any = None) -> Tensor:
        """Numbers of each system, one after another; those of atoms or rows from where these of a system begin."""
        known = {each: np.asarray(of(each)) for each in self._numbers}
        begins = np.zeros(self.n_systems, int) if starts is None else starts
        whole = np.concatenate([known[each] + start for each, start in zip(self.systems, begins, strict=False)])
        return torch.as_tensor(whole, device=self.device, dtype=dtype or self.dtype)

    def _inverse(self, masses: Tensor) -> Tensor:
        return torch.where(self._free, 1.0 / torch.where(self._free, masses, 1.0), 0.0)

    def _groups(self, velocity_rows: bool) -> list[Group]:
        """All clusters, with or without rows of velocities."""
        if velocity_rows not in self._known:
            parts: dict[Any, list[Any]] = {}
            for motion, numbers in self._numbers.items():
                for pattern, kind in kinds_of(motion, velocity_rows).items():
                    where = np.stack([numbers, self.atom_starts[numbers], self.row_starts[numbers]], axis=1)
                    parts.setdefault(pattern, []).append((kind, where))
            own = [self._inverse_masses], [self.targets, self._still]
            self._known[velocity_rows] = [Group(pattern, each, own, self.compiled) for pattern, each in parts.items()]
        return self._known[velocity_rows]

    # -- cells ----------------------------------------------------------------------------------------

    def _set_lattices(self) -> None:
        """Cells and their inverses, with zeros for directions without periodicity, and the trees of whole rows."""
        self._lattice: Tensor | None = None
        if all(each.lattice is None for each in self._numbers):
            return
        open_ = np.stack([np.eye(3), np.zeros((3, 3))])
        self._lattice = self._joined(lambda each: [open_ if each.lattice is None else each.lattice])

        def parents(each: Motion) -> IntArray:
            found, images = np.arange(each.n_atoms), each.constraint_set.images
            if images is not None:
                found[images.atoms] = images.parents
            return found

        # By turns atoms farther along the tree.
        self._tree = [self._joined(parents, torch.int64, self.atom_starts)]
        while bool((self._tree[-1] != self._tree[-1][self._tree[-1]]).any()):
            self._tree.append(self._tree[-1][self._tree[-1]])

    def _tree_cells(self, x: Tensor) -> Tensor:
        """Cells by which atoms of whole rows stand off where they are stored, (n_atoms, 3)."""
        assert self._lattice is not None
        inverse = self._lattice[self.system_idx, 1]
        cells = -torch.round(torch.einsum("nx,nxy->ny", x - x[self._tree[0]], inverse))
        for parent in self._tree[:-1]:
            cells = cells + cells[parent]
        return cells

    # -- what is given --------------------------------------------------------------------------------

    def _flat(self, x: Tensor, item: str) -> Tensor:
        if not isinstance(x, Tensor) or x.shape[-1:] != (3,) or x.numel() != 3 * self.n_atoms:
            shape = tuple(x.shape) if isinstance(x, Tensor) else type(x).__name__
            wanted = f"a tensor of shape ({self.n_atoms}, 3) or (copies, atoms, 3)"
            raise InputError(f"{item} must be {wanted}, not {shape}", item=item)
        if x.dtype != self.dtype or x.device.type != self.device.type:
            here = f"{self.dtype} on {self.device}; convert it"
            raise InputError(f"{item}: {x.dtype} on {x.device}, but this batch is {here}", item=item)
        return x.reshape(-1, 3)

    def _all(self, values: Tensor, count: int, item: str) -> Tensor:
        """Numbers of all systems, from those or from the numbers of one of many copies."""
        sizes = {count, count // self.n_systems} if len(self._numbers) == 1 else {count}
        if not isinstance(values, Tensor) or values.ndim != 1 or len(values) not in sizes:
            wanted = f"({count},), or those of one system where all are copies"
            raise InputError(f"{item} must be a tensor of shape {wanted}", item=item)
        return values.to(self.dtype).repeat(count // max(len(values), 1))

    def weights(self, masses: Tensor | None = None) -> Tensor:
        """Inverse masses, 0 for fixed atoms, shape (n_atoms,); of other `masses` than those of the engines.

        Raises
        ------
        UnsupportedError
            Rows that are defined by the masses of their engine, such as centers of mass.
        """
        if masses is None:
            return self._inverse_masses
        for item in (item for motion in self._numbers for item in motion.constraint_set.constraints):
            if item.uses_masses:
                raise UnsupportedError(f"{item!r} is defined by the masses of its Motion; make another with other ones")
        return self._inverse(self._all(masses, self.n_atoms, "masses"))

    def _targets_at(self, time: float) -> Tensor:
        return self._joined(lambda each: each.constraint_set.target(time)) if self._moving else self.targets

    def _rates_at(self, time: float, order: int) -> Tensor:
        if not self._moving and self._holonomic:
            return self._still
        return self._joined(lambda each: each.constraint_set.target_rates(time, order))

    def _task(self, of_positions: bool, time: float, start: float, flight: float = 0.0) -> Task:
        for item, own in zip(("masses", "targets"), self._given, strict=True):
            if getattr(self, item) is not own or own._version:  # numbers that follow from them are kept
                raise InputError(f"{item} of a Batch were written to; give other ones as {item}= of a call", item=item)
        new = partial(torch.full, (), dtype=self.dtype, device=self.device)
        t, t_start = (each if isinstance(each, Tensor) else new(each) for each in (time, start))
        flies = bool(not self._holonomic and flight != 0)
        return Task(self, self._groups(self._holonomic or flies or not of_positions), of_positions, flies, t, t_start)

    def _with_fixed(self, y: Tensor, rows: Tensor) -> Tensor:
        """With what the rows of fixed atoms say of these."""
        return y.index_copy(0, self._fixed, rows[self._fixed_rows].reshape(-1, 3)) if len(self._fixed) else y

    # -- what is asked --------------------------------------------------------------------------------

    def solve_positions(
        self,
        x_new: Tensor,
        x_reference: Tensor,
        *,
        time: float = 0.0,
        reference_time: float | None = None,
        flight: float = 0.0,
        targets: Tensor | None = None,
        masses: Tensor | None = None,
    ) -> Solved:
        """Solve sigma(x_new + M^-1 A(x_reference)^T Lambda) = 0 for each system, by Newton's method.

        Derivatives are those of the solution, by one solve with the transposed matrix.

        Parameters
        ----------
        x_new, x_reference : Tensor, shape (n_atoms, 3) or (copies, atoms, 3)
            Positions to correct, and those whose gradients give the directions.
        time, reference_time : float
            Times of both; `reference_time` defaults to `time`.
        flight : float
            Time from `x_reference` to `x_new`, for rows of velocities; see `Motion.project_positions`.
        targets : Tensor, shape (n_rows,) or (rows of one system,), optional
            What rows are held at, in place of what the engines say.
        masses : Tensor, shape (n_atoms,) or (atoms of one system,), optional

        Returns
        -------
        Solved
            Velocities are to change by ``push/dt``, which knows nothing of the rounding of positions.

        Raises
        ------
        ConvergenceError
            No solution near enough, in this or an earlier call: see `check`.
        InputError
            Another shape or type of number.
        """
        x, start = self._flat(x_new, "x_new"), self._flat(x_reference, "x_reference")
        reference_time = time if reference_time is None else reference_time
        held = self._targets_at(time) if targets is None else self._all(targets, self.n_rows, "targets")
        if not self._holonomic:
            middle = held if targets is not None else self._targets_at(0.5 * (time + reference_time))
            held = torch.where(self._is_position, held, flight * middle)
        task = self._task(True, time, reference_time, flight)
        found = Projection.apply(self._with_fixed(x, held), start, held, self.weights(masses), task)
        self._calls += 1
        if self._calls >= self.check_every:
            self.check()
        positions, push, multipliers = found
        return Solved(positions.reshape(x_new.shape), push.reshape(x_new.shape), _by_copy(multipliers, x_new))

    def project_positions(self, x_new: Tensor, x_reference: Tensor, **options: Any) -> Tensor:
        """Positions on the rows: those of `solve_positions`, which tells the options and the errors."""
        return self.solve_positions(x_new, x_reference, **options).positions

    def project_velocities(self, x: Tensor, v: Tensor, *, time: float = 0.0, masses: Tensor | None = None) -> Tensor:
        """Nearest admissible velocities in the mass metric: A v = c.

        Shapes and `masses` are as for `solve_positions`, the `time` is that of positions.
        """
        here, task = self._flat(x, "x"), self._task(False, time, time)
        rates = self._rates_at(time, 1)
        speeds = self._with_fixed(self._flat(v, "v"), rates)
        return Projection.apply(speeds, here, rates, self.weights(masses), task)[0].reshape(v.shape)

    def multipliers(
        self, x: Tensor, v: Tensor, forces: Tensor, *, time: float = 0.0, masses: Tensor | None = None
    ) -> Tensor:
        """lambda of the constraint forces A^T lambda, in natural units; of least norm where rows depend on each other.

        Shapes are as for `solve_positions`; the result has shape (n_rows,) or (copies, rows).
        """
        here, speed, f = self._flat(x, "x"), self._flat(v, "v"), self._flat(forces, "forces")
        w, rates, task = self.weights(masses), self._rates_at(time, 2), self._task(False, time, time)
        a = self._with_fixed(w[:, None] * f, rates)
        lam, held = torch.zeros_like(rates), f.reshape(-1)
        for group in task.groups:
            of = task.problem(group, here, here, rates, w)
            of = of._replace(held=of.held.expand(group.rows.shape))
            each, force = group.solver.respond(of, speed.reshape(-1)[group.flat], a.reshape(-1)[group.flat])
            lam = lam.index_put((group.rows,), each)
            held = held.index_add(0, group.flat.reshape(-1), force.reshape(-1))
        if len(self._fixed):
            # What fixed atoms' rows supply: M a less the forces and those of the other rows.
            inert = self.masses if masses is None else self._all(masses, self.n_atoms, "masses")
            rest = (inert[:, None] * a - held.reshape(-1, 3))[self._fixed]
            lam = lam.index_copy(0, self._fixed_rows, rest.reshape(-1))
        return _by_copy(lam, x)

    # -- what is told ---------------------------------------------------------------------------------

    def check(self) -> None:
        """Look at the residuals of all projections of positions since the last look.

        Raises
        ------
        ConvergenceError
            A row of a system was off, or not finite: with the numbers of both as `copy` and `row`. Where several calls
            are looked at together, positions since the last look are not right.
        """
        calls, self._calls = self._calls, 0
        limit = max(ACCEPTED, ROUNDINGS * torch.finfo(self.dtype).eps)
        groups = [group for known in self._known.values() for group in known]
        if all(bool((group.worst <= limit).all()) for group in groups):
            return
        off, rows = (torch.cat([of(group).ravel() for group in groups]) for of in (lambda g: g.worst, lambda g: g.rows))
        for group in groups:
            group.worst = torch.zeros_like(group.worst)
        k = int(torch.nan_to_num(off, nan=torch.inf).argmax())
        residual, copy = float(off[k]), int(np.searchsorted(self.row_starts, int(rows[k]), "right")) - 1
        row, held = int(rows[k] - self.row_starts[copy]), self.systems[copy].constraint_set
        said = f"is off by {residual:.3g} of its scale" if np.isfinite(residual) else "has turned or is not finite"
        error = ConvergenceError(
            f"copy {copy}, row {held.row_name(row)} {said} in one of the last {calls} projections: there is no "
            "solution near enough. Take a smaller time step, or start on the rows (Motion.restore_positions)",
            residual=residual,
            tolerance=limit,
            row=row,
            atoms=held.row_atoms(row).tolist(),
        )
        error.copy = copy
        raise error

    def report(self, x: Tensor, v: Tensor | None = None, *, time: float = 0.0) -> list[Report]:
        """What each system's engine reports of its positions, and velocities: residuals, rank, kinds of clusters."""
        both = (x, x) if v is None else (x, v)
        here, speed = (self._flat(each, "x or v").detach().cpu().double().numpy() for each in both)
        parts = [slice(*ends) for ends in pairwise(self.atom_starts)]
        return [
            motion.report(here[some], None if v is None else speed[some], time, condition=False)
            for motion, some in zip(self.systems, parts, strict=True)
        ]

    def __repr__(self) -> str:
        return f"<Batch: {self.n_rows} rows on {self.n_atoms} atoms of {self.n_systems} systems>"


def _fixed_atoms(motion: Motion) -> list[int]:
    return [motion.constraint_set.row_atoms(row)[0] for row in motion.plan.pinned_rows[::3]]


def _by_copy(rows: Tensor, like: Tensor) -> Tensor:
    return rows.reshape(like.shape[0], -1) if like.ndim == 3 else rows


# -- projections as functions that torch differentiates ------------------------------------------------


class Task(NamedTuple):
    """What is solved for: `of_positions` or of velocities, and whether rows of velocities count in positions (`flies`).

    At times of what is projected and of where directions are taken.
    """

    batch: Batch
    groups: Sequence[Group]
    of_positions: bool
    flies: bool
    t: Tensor
    t_start: Tensor

    def problem(self, group: Group, x: Tensor, start: Tensor, held: Tensor, w: Tensor) -> Problem:
        """Of the clusters of a group, at positions x with directions of a start, which may be the same tensor."""
        batch = self.batch
        there = group.coordinates(start, batch._lattice, batch._tree_cells)
        here = there if x is start else group.coordinates(x, batch._lattice, batch._tree_cells)
        flies = self.flies and any(not row.function.holonomic for row in group.pattern.rows)
        weights, wanted = group.lanes(w, group.atoms), group.lanes(held, group.rows)
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
        if not worst > ENOUGH * eps or eps**0.5 > worst > 0.5 * before:
            break
        before = worst
    group.worst = torch.maximum(group.worst, size / group.scale)
    return lam, moved


class Projection(torch.autograd.Function):
    """Positions or velocities on the rows, by how much they were moved, and multipliers by row.

    Of what is projected, of positions whose gradients give the directions, of what rows are held at, and of inverse
    masses. Derivatives are those of the equations at the solution; nothing of the iterations is kept.
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
            push.view(-1)[group.flat] = moved  # nothing for fixed atoms, which may belong to several clusters
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
            rows = group.rows[: group.pattern.rank]
            bent = torch.zeros_like(multipliers[rows]) if by_multipliers is None else by_multipliers[rows]
            v = None if task.of_positions else found.reshape(-1)[group.flat]
            parts = group.solver.adjoint(of, multipliers[rows], pushed.reshape(-1)[group.flat], bent, v)
            for k, (part, index) in enumerate(zip(parts, (group.flat, group.flat, rows, group.atoms), strict=True)):
                # Atoms that are fixed may belong to several clusters.
                flat = sums[k].reshape(-1).index_add(0, index.reshape(-1), part.expand(index.shape).reshape(-1))
                sums[k] = flat.reshape(sums[k].shape)
        return by_found + sums[0], *sums[1:], None
