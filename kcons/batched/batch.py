"""Many systems, or many copies of one, held side by side on a device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcons.batched.groups import Group, Kind, kinds_of
from kcons.batched.projections import Positions, Task, Velocities
from kcons.constraints.arguments import IntArray
from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.motion.motion import Motion

#: Parts of its scale that a row may be off by, in double precision; in single precision so many roundings.
ACCEPTED, ROUNDINGS = 1e-10, 1e3
#: Projections after which failures are looked for, where looking waits for the device.
CHECK_EVERY = 100


class Solved(NamedTuple):
    """Positions on the rows, by how much atoms were moved, M^-1 A^T Lambda, and Lambda by row in natural units."""

    positions: Tensor
    push: Tensor
    multipliers: Tensor


@dataclass(frozen=True)
class BatchReport:
    """How well rows are held.

    Attributes
    ----------
    residual, velocity_residual : Tensor, shape (n_systems,)
        max |sigma| in natural units, and max |A v - c| with rows scaled to unit norm, or None without velocities.
    ranks, degrees_of_freedom : Tensor, shape (n_systems,)
    worst : tuple of int and str
        The system, and the name of its row, with the largest |sigma| for its scale.
    clusters : tuple of str
        A line for each kind of cluster.
    """

    residual: Tensor
    velocity_residual: Tensor | None
    ranks: Tensor
    degrees_of_freedom: Tensor
    worst: tuple[int, str]
    clusters: tuple[str, ...]

    def __str__(self) -> str:
        system, row = self.worst
        lines = [
            f"{len(self.ranks)} systems, rank {int(self.ranks.sum())}, degrees of freedom "
            f"{int(self.degrees_of_freedom.sum())}",
            f"max |sigma| {float(self.residual.max()):.2e} (system {system}, {row})",
        ]
        if self.velocity_residual is not None:
            lines.append(f"max |A v - c| {float(self.velocity_residual.max()):.2e}")
        return "\n".join([*lines, *self.clusters])


class Batch:
    """Constrained motion of many systems at once, on PyTorch tensors, differentiable.

    Clusters of equal shape are solved side by side, whichever systems they belong to. Classes, names, rank,
    conversions and refusals are those of the engines.

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
        which a projection takes half of the time on a processor, and a few launches on a GPU.
    check_every : int, optional
        Projections of positions after which failures are looked for: 1 on a processor, and 100 on a GPU, where looking
        waits for the device.

    Attributes
    ----------
    systems : tuple of Motion
    n_systems, n_atoms, n_rows : int
        All together.
    atom_starts, row_starts : ndarray of int, shape (n_systems + 1,)
        Where atoms and rows of each system begin; atoms of all systems follow each other.
    masses : Tensor, shape (n_atoms,)
    targets : Tensor, shape (n_rows,)
        What rows are held at; of moving targets, at time 0.

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
            raise InputError(
                "a Batch is made of kcons.Motion objects: give one and the number of copies, or a list of them",
                item="motions",
            )
        if dtype not in (torch.float64, torch.float32):
            raise InputError(f"dtype is {dtype}; give torch.float64 or torch.float32", item="dtype")
        self.systems = tuple(given * copies)
        self.device, self.dtype, self.compiled = torch.device(device), dtype, compiled
        self.check_every = check_every or (1 if self.device.type == "cpu" else CHECK_EVERY)
        self.n_systems = len(self.systems)
        self.atom_starts = _starts([each.n_atoms for each in self.systems])
        self.row_starts = _starts([each.constraint_set.n_rows for each in self.systems])
        self.n_atoms, self.n_rows = int(self.atom_starts[-1]), int(self.row_starts[-1])
        self._by_motion: dict[Motion, list[int]] = {}
        for number, each in enumerate(self.systems):
            self._by_motion.setdefault(each, []).append(number)
        self.masses = self._joined(lambda each: each.masses)
        self.targets = self._joined(lambda each: each.constraint_set.target(0.0))
        self.ranks = self._joined(lambda each: np.array([each.rank]), torch.int64)
        self.degrees_of_freedom = self._joined(lambda each: np.array([each.degrees_of_freedom]), torch.int64)
        self._fixed_rows, self._fixed_atoms = self._pinned()
        fixed = torch.zeros(self.n_atoms, dtype=torch.bool, device=self.device)
        fixed[self._fixed_atoms] = True
        self._free, self._massless = ~fixed & (self.masses > 0), (~fixed & (self.masses <= 0))[:, None]
        self.inverse_masses = self._inverse(self.masses)
        self._still = torch.zeros(self.n_rows, dtype=dtype, device=self.device)
        sets = [each.constraint_set for each in self._by_motion]
        self._moving = any(held.moving for held in sets)
        self._holonomic = all(bool(held.holonomic.all()) for held in sets)
        self._is_position = self._joined(lambda each: each.constraint_set.holonomic, torch.bool)
        self._lattice = self._lattices()
        self._tree = self._parents()
        self._groups = self._grouped(True)
        self._calls = 0

    def _joined(self, of: Any, dtype: torch.dtype | None = None) -> Tensor:
        """An array of each system, one after another."""
        known = {each: of(each) for each in self._by_motion}
        whole = np.concatenate([known[each] for each in self.systems])
        return torch.as_tensor(whole, device=self.device).to(dtype or self.dtype)

    def _pinned(self) -> tuple[Tensor, Tensor]:
        rows, atoms = [], []
        for number, each in enumerate(self.systems):
            rows.append(each.plan.pinned_rows + self.row_starts[number])
            held = [int(each.constraint_set.row_atoms(int(row))[0]) for row in each.plan.pinned_rows[::3]]
            atoms.append(np.array(held, dtype=np.int64) + self.atom_starts[number])
        return tuple(torch.as_tensor(np.concatenate(t), device=self.device) for t in (rows, atoms))  # type: ignore[return-value]

    def _inverse(self, masses: Tensor) -> Tensor:
        return torch.where(self._free, 1.0 / torch.where(self._free, masses, 1.0), 0.0)

    def _grouped(self, velocity_rows: bool) -> list[Group]:
        parts: dict[Any, list[tuple[Kind, IntArray, IntArray, IntArray]]] = {}
        for motion, numbers in self._by_motion.items():
            some = np.array(numbers)
            for pattern, kind in kinds_of(motion, velocity_rows).items():
                where = some, self.atom_starts[some], self.row_starts[some]
                parts.setdefault(pattern, []).append((kind, *where))
        return [Group(pattern, each, self.masses, self.compiled) for pattern, each in parts.items()]

    @cached_property
    def _position_groups(self) -> list[Group]:
        """Without rows of velocities."""
        return self._groups if self._holonomic else self._grouped(False)

    # -- cells ----------------------------------------------------------------------------------------

    def _lattices(self) -> Tensor | None:
        """Cells and their inverses, with zeros for directions without periodicity; None where no row has images."""
        if all(each.constraint_set.lattice is None for each in self._by_motion):
            return None
        open_ = np.stack([np.eye(3), np.zeros((3, 3))])
        found = self._joined(lambda each: (open_ if each.lattice is None else each.lattice)[None])
        return found.reshape(-1, 2, 3, 3)

    def set_cell(self, cells: Tensor) -> None:
        """Change the periodic cells, as barostats do; which directions are periodic stays as it is.

        Parameters
        ----------
        cells : Tensor, shape (n_systems, 3, 3) or (3, 3)
            Lattice vectors as rows.

        Raises
        ------
        InputError
            Cells of another shape, or for systems without.
        """
        if self._lattice is None:
            raise InputError("no system of this batch has a periodic cell; make Motions with one", item="cells")
        whole = torch.as_tensor(cells, dtype=self.dtype, device=self.device)
        if whole.shape not in ((3, 3), (self.n_systems, 3, 3)):
            raise InputError(
                f"cells have shape {tuple(whole.shape)}; give (3, 3) or ({self.n_systems}, 3, 3)", item="cells"
            )
        periodic = self._lattice[:, 1].any(1, keepdim=True)
        whole = torch.where(periodic.transpose(1, 2), whole.expand(self.n_systems, 3, 3), self._lattice[:, 0])
        self._lattice = torch.stack([whole, torch.linalg.inv(whole) * periodic], 1)

    def _parents(self) -> list[Tensor]:
        """By turns the atoms next to which each is moved, ever farther along its tree; none where no row needs it."""

        def parents(each: Motion) -> IntArray:
            found = np.arange(each.n_atoms)
            images = each.constraint_set.images
            if images is not None:
                found[images.atoms] = images.parents
            return found

        if all(each.constraint_set.images is None for each in self._by_motion):
            return []
        found = [self._joined(parents, torch.int64)]
        found[0] += torch.as_tensor(np.repeat(self.atom_starts[:-1], np.diff(self.atom_starts)), device=self.device)
        while bool((found[-1] != found[-1][found[-1]]).any()):
            found.append(found[-1][found[-1]])
        return found

    def _tree_cells(self, x: Tensor) -> Tensor | None:
        """Cells by which atoms of whole rows stand off where they are stored, (n_atoms, 3)."""
        if not self._tree:
            return None
        assert self._lattice is not None
        parent = self._tree[0]
        cells = -torch.round(torch.einsum("nx,nxy->ny", x - x[parent], self._lattice[self.system_idx, 1]))
        for parent in self._tree[:-1]:
            cells = cells + cells[parent]
        return cells

    @cached_property
    def system_idx(self) -> Tensor:
        """System of each atom, shape (n_atoms,)."""
        return torch.as_tensor(np.repeat(np.arange(self.n_systems), np.diff(self.atom_starts)), device=self.device)

    # -- what is asked --------------------------------------------------------------------------------

    def _flat(self, x: Tensor, item: str) -> Tensor:
        if not isinstance(x, Tensor) or x.shape[-1:] != (3,) or x.numel() != 3 * self.n_atoms:
            raise InputError(
                f"{item} must be a tensor of shape ({self.n_atoms}, 3), or (copies, atoms, 3), not "
                f"{tuple(getattr(x, 'shape', ())) or type(x).__name__}",
                item=item,
            )
        if x.dtype is not self.dtype or x.device.type != self.device.type:
            raise InputError(
                f"{item} are {x.dtype} on {x.device}, and this batch works with {self.dtype} on {self.device}; convert "
                "them, or use Batch.to",
                item=item,
            )
        return x.reshape(-1, 3)

    def _all(self, values: Tensor, count: int, item: str) -> Tensor:
        """Numbers of all systems, from those or from the numbers of one of many copies."""
        if isinstance(values, Tensor) and values.ndim == 1 and len(values) and count % len(values) == 0:
            same = len(values) == count or len(self._by_motion) == 1
            if same and len(values) in (count, count // self.n_systems):
                return values.to(self.dtype).repeat(count // len(values))
        raise InputError(
            f"{item} must be a tensor of shape ({count},), or of one system where all are copies of it", item=item
        )

    def weights(self, masses: Tensor | None) -> Tensor:
        if masses is None:
            return self.inverse_masses
        for motion in self._by_motion:
            for item in motion.constraint_set.constraints:
                if item.uses_masses:
                    raise UnsupportedError(
                        f"{item!r} is defined by the masses of its engine; other masses need another Motion"
                    )
        return self._inverse(self._all(masses, self.n_atoms, "masses"))

    def _targets_at(self, time: float) -> Tensor:
        return self._joined(lambda each: each.constraint_set.target(time)) if self._moving else self.targets

    def _rates_at(self, time: float, order: int) -> Tensor:
        if not self._moving and self._holonomic:
            return self._still
        return self._joined(lambda each: each.constraint_set.target_rates(time, order))

    def _task(self, time: float, reference_time: float, targets: Tensor, flight: float = 0.0) -> Task:
        return Task(
            self._groups if flight or self._holonomic else self._position_groups,
            *(torch.tensor(t, dtype=self.dtype, device=self.device) for t in (time, reference_time)),
            self._lattice,
            self._tree_cells,
            (self.targets, self.inverse_masses),
            flight != 0,
            self.device.type == "cpu",
        )

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

        Parameters
        ----------
        x_new, x_reference : Tensor, shape (n_atoms, 3) or (copies, atoms, 3)
            Positions to correct, and those whose gradients give the directions.
        time, reference_time : float
            Times of both; `reference_time` defaults to `time`.
        flight : float
            As for `Motion.project_positions`: time from `x_reference` to `x_new`, for rows of velocities.
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

        References
        ----------
        Derivatives are those of the solution: one solve with the transposed matrix A(x) M^-1 A(x_reference)^T.
        """
        x, start = self._flat(x_new, "x_new"), self._flat(x_reference, "x_reference")
        reference_time = time if reference_time is None else reference_time
        held = self._targets_at(time) if targets is None else self._all(targets, self.n_rows, "targets")
        if not self._holonomic:
            middle = self._targets_at(0.5 * (time + reference_time)) if targets is None else held
            held = torch.where(self._is_position, held, flight * middle)
        if len(self._fixed_atoms):
            x = x.index_copy(0, self._fixed_atoms, held[self._fixed_rows].reshape(-1, 3))
        task = self._task(time, reference_time, self.targets, flight)
        y, push, multipliers = Positions.apply(x, start, held, self.weights(masses), task)
        self._calls += 1
        if self._calls >= self.check_every:
            self.check()
        return Solved(y.reshape(x_new.shape), push.reshape(x_new.shape), self._shaped(multipliers, x_new))

    def project_positions(self, x_new: Tensor, x_reference: Tensor, **options: Any) -> Tensor:
        """Positions on the rows, as `solve_positions`, which tells the options and the errors."""
        return self.solve_positions(x_new, x_reference, **options).positions

    def project_velocities(
        self,
        x: Tensor,
        v: Tensor,
        *,
        time: float = 0.0,
        masses: Tensor | None = None,
    ) -> Tensor:
        """Nearest admissible velocities in the mass metric: A v = c.

        Parameters
        ----------
        x, v : Tensor, shape (n_atoms, 3) or (copies, atoms, 3)
        time : float
        masses : Tensor, shape (n_atoms,) or (atoms of one system,), optional
        """
        here, speed = self._flat(x, "x"), self._flat(v, "v")
        rates = self._speeds(here, time)
        return self._tangent(here, speed, rates, self.weights(masses), time).reshape(v.shape)

    def _tangent(self, x: Tensor, v: Tensor, rates: Tensor, w: Tensor, time: float) -> Tensor:
        if len(self._fixed_atoms):
            v = v.index_copy(0, self._fixed_atoms, rates[self._fixed_rows].reshape(-1, 3))
        task = self._task(time, time, self.targets, 1.0)._replace(own=(self._still, self.inverse_masses))
        found: Tensor = Velocities.apply(x, v, rates, w, task)[0]
        return found

    def _speeds(self, x: Tensor, time: float) -> Tensor:
        """c of A v = c."""
        rates = self._rates_at(time, 1)
        if not self._moving:
            return rates
        return rates - self._of_groups(x, time, lambda g, base, t: g.solver.drift(base, None, g.p, t))

    def _of_groups(self, x: Tensor, time: float, of: Any) -> Tensor:
        """Numbers of all rows."""
        task = self._task(time, time, self.targets, 1.0)
        found = torch.zeros_like(self._still)
        for group in task.groups:
            values = of(group, task.places(group, x)[0], task.t)
            found = found.index_copy(0, group.rows.reshape(-1), values.expand(group.rows.shape).reshape(-1))
        return found

    def project_forces(self, x: Tensor, forces: Tensor) -> Tensor:
        """What is left of forces on the surface, for optimizers: M M_par^+ f, as `Motion.project_forces`."""
        here, f = self._flat(x, "x"), self._flat(forces, "forces")
        w = self.inverse_masses.unsqueeze(1)
        found = self._tangent(here, w * f, self._still, self.inverse_masses, 0.0)
        return torch.where(
            self._free[:, None], found * self.masses[:, None], torch.where(self._massless, f, 0.0)
        ).reshape(forces.shape)

    def multipliers(
        self, x: Tensor, v: Tensor, forces: Tensor, *, time: float = 0.0, masses: Tensor | None = None
    ) -> Tensor:
        """lambda of the constraint forces A^T lambda, in natural units; of least norm where rows depend on each other.

        Parameters
        ----------
        x, v, forces : Tensor, shape (n_atoms, 3) or (copies, atoms, 3)
        time : float
        masses : Tensor, shape (n_atoms,) or (atoms of one system,), optional

        Returns
        -------
        Tensor, shape (n_rows,) or (copies, rows)
        """
        here, speed, f = self._flat(x, "x"), self._flat(v, "v"), self._flat(forces, "forces")
        w = self.weights(masses)
        rates = self._rates_at(time, 2)
        a = w.unsqueeze(1) * f
        if len(self._fixed_atoms):
            a = a.index_copy(0, self._fixed_atoms, rates[self._fixed_rows].reshape(-1, 3))
        task = self._task(time, time, self.targets, 1.0)._replace(own=(self._still, self.inverse_masses))

        def of(group: Group, base: Tensor, t: Tensor) -> Tensor:
            weights, wanted = task.numbers(group, rates, w)
            moving, pulled = speed.reshape(-1)[group.flat], a.reshape(-1)[group.flat]
            wanted = wanted.expand(group.rows.shape)
            return group.solver.respond(base, weights, group.p, t, moving, pulled, wanted)

        lam = self._of_groups(here, time, of)
        if len(self._fixed_atoms):
            # What fixed atoms' rows supply: M a - f less the other rows' forces.
            masses = self.masses if masses is None else self._all(masses, self.n_atoms, "masses")
            rest = masses[:, None] * a - f - self._force(here, lam, time)
            lam = lam.index_copy(0, self._fixed_rows, rest[self._fixed_atoms].reshape(-1))
        return self._shaped(lam, x)

    def _force(self, x: Tensor, lam: Tensor, time: float) -> Tensor:
        """A^T lambda of all rows but those of fixed atoms."""
        task = self._task(time, time, self.targets, 1.0)
        found = x.new_zeros(x.numel())
        for group in task.groups:
            slope = group.solver.evaluate(task.places(group, x)[0], None, group.p, task.t)[1]
            force = group.solver.spread(slope, group.solver.rows_of(lam[group.rows]))
            packed = group.solver.packed(force, lam[group.rows])
            found = found.index_add(0, group.flat.reshape(-1), packed.reshape(-1))
        return found.reshape(-1, 3)

    def _shaped(self, rows: Tensor, like: Tensor) -> Tensor:
        return rows.reshape(like.shape[0], -1) if like.ndim == 3 else rows

    # -- what is told ---------------------------------------------------------------------------------

    def check(self) -> None:
        """Look at the residuals of all projections of positions since the last look.

        Raises
        ------
        ConvergenceError
            A row of a system was off, or not finite: with the numbers of both in its attributes `copy` and `row`. Where
            several calls are looked at together, positions since the last look are not right.
        """
        calls, self._calls = self._calls, 0
        limit = max(ACCEPTED, ROUNDINGS * torch.finfo(self.dtype).eps)
        for group in {id(g): g for g in [*self._groups, *self._position_groups]}.values():
            worst, bad = group.worst, ~(group.worst <= limit)
            if not bool(bad.any()):
                continue
            k, lane = (int(i) for i in bad.nonzero()[0])
            residual = float(worst[k, lane])
            system = int(group.systems[lane])
            row = int(group.rows[k, lane]) - int(self.row_starts[system])
            for each in [*self._groups, *self._position_groups]:
                each.worst = torch.zeros_like(each.worst)
            held = self.systems[system].constraint_set
            where = "" if calls == 1 else f" in one of the last {calls} projections"
            off = f"is off by {residual:.3g} of its scale" if np.isfinite(residual) else "has turned or is not finite"
            error = ConvergenceError(
                f"copy {system}, row {held.row_name(row)} {off}{where}: no solution near enough. Take a smaller time "
                "step, or start from positions on the rows (Motion.restore_positions)",
                residual=residual,
                tolerance=limit,
                row=row,
                atoms=held.row_atoms(row).tolist(),
            )
            error.copy = system
            raise error

    def report(self, x: Tensor, v: Tensor | None = None, *, time: float = 0.0) -> BatchReport:
        """How far positions, and velocities, are off the rows, by system."""
        here = self._flat(x, "x")
        with torch.no_grad():
            task = self._task(time, time, self.targets, 1.0)
            targets = self._targets_at(time)
            sigma, share = torch.zeros_like(self._still), torch.zeros_like(self._still)
            speed = None if v is None else torch.zeros_like(self._still)
            rates = None if v is None else self._speeds(here, time)
            lines = []
            for group in task.groups:
                solver, base = group.solver, task.places(group, here)[0]
                value, slope = solver.evaluate(base, None, group.p, task.t)
                off = solver.packed(solver.off(value, solver.rows_of(targets[group.rows])), base).abs()
                off = torch.where(self._is_position[group.rows], off, 0.0)
                sigma[group.rows], share[group.rows] = off, off / group.scale
                if v is not None and speed is not None and rates is not None:
                    moving = self._flat(v, "v").reshape(-1)[group.flat]
                    found = solver.packed(solver.contract(slope, solver.atoms_of(moving)), base) - rates[group.rows]
                    ones = torch.ones_like(base[:1]).expand(3 * group.pattern.n_atoms, -1)
                    speed[group.rows] = found.abs() / solver.packed(solver.lengths(slope), ones)
                example = self.systems[int(group.systems[0])].constraint_set.row_name(
                    int(group.rows[0, 0]) - int(self.row_starts[int(group.systems[0])])
                )
                name = "closed" if group.pattern.small else "sparse"
                lines.append(f"{group.atoms.shape[1]} clusters of {len(group.rows)} rows ({name}), such as {example}")
            where = int(share.argmax()) if self.n_rows else -1
            system = int(np.searchsorted(self.row_starts, where, side="right")) - 1
            name = "no rows"
            if where >= 0:
                name = self.systems[system].constraint_set.row_name(where - int(self.row_starts[system]))
            return BatchReport(
                self._largest(sigma),
                None if speed is None else self._largest(speed),
                self.ranks,
                self.degrees_of_freedom,
                (max(system, 0), name),
                tuple(lines),
            )

    def _largest(self, rows: Tensor) -> Tensor:
        """Of rows by system."""
        numbers = np.repeat(np.arange(self.n_systems), np.diff(self.row_starts))
        index = torch.as_tensor(numbers, device=self.device)
        return rows.new_zeros(self.n_systems).scatter_reduce(0, index, rows, "amax")

    # -- other batches --------------------------------------------------------------------------------

    def select(self, systems: Sequence[int]) -> Batch:
        """A batch of some of the systems, in this order, with their cells."""
        numbers = [int(k) for k in systems]
        if any(not -self.n_systems <= k < self.n_systems for k in numbers):
            raise InputError(f"there are systems 0 to {self.n_systems - 1}, not {numbers}", item="systems")
        return self._again([self.systems[k] for k in numbers], numbers, self.device, self.dtype)

    def to(self, device: str | torch.device | None = None, dtype: torch.dtype | None = None) -> Batch:
        """The same batch on another device, or with another type of number."""
        every = list(range(self.n_systems))
        return self._again(list(self.systems), every, device or self.device, dtype or self.dtype)

    def _again(self, systems: list[Motion], numbers: list[int], device: Any, dtype: torch.dtype) -> Batch:
        made = Batch(systems, device=device, dtype=dtype, compiled=self.compiled, check_every=self.check_every)
        if self._lattice is not None and made._lattice is not None:
            made._lattice = self._lattice[numbers].to(made.device, made.dtype)
        return made

    def __repr__(self) -> str:
        return f"<Batch: {self.n_rows} rows on {self.n_atoms} atoms of {self.n_systems} systems>"


def _starts(counts: Sequence[int]) -> IntArray:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
