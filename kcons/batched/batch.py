"""Many systems, or many copies of one, held side by side on a device."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from kcons.batched.clusters import Lanes, Levels, Pattern, Problem, Row, tape_of
from kcons.constraints.arguments import FloatArray, IntArray, whole_number
from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.motion.report import Report
from kcons.plan.clusters import Alike, alike

#: Parts of its scale that a row may be off by, and so many roundings in single precision.
ACCEPTED, ROUNDINGS = 1e-10, 1e3
#: Projections after which failures are looked for, where looking waits for the device.
CHECK_EVERY = 100
#: Newton iterations after which there is no solution near, and those that are made where nobody looks.
MAX_ITERATIONS, UNWATCHED = 30, 5
#: Roundings that a row may be off by for the iterations to end.
ENOUGH = 2


class Batch:
    """Constrained motion of many systems at once, on PyTorch tensors, differentiable.

    Clusters of equal shape are solved side by side, whichever systems they belong to. Classes, names, rank,
    conversions, cells and refusals are those of the engines. All methods leave what they are given as it was.

    Parameters
    ----------
    motions : Motion or sequence of Motion
        Engines of the systems, one a system.
    copies : int
        How many times all of these are there.
    device : str or torch.device
    dtype : torch.dtype
        torch.float64 or torch.float32.
    compiled : bool
        Whether steps for small clusters are compiled by `torch.compile`, once for each shape: some ten seconds, after
        which a projection takes a third of the time, and a few launches on a GPU.
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
        What rows are held at.

    Raises
    ------
    UnsupportedError
        A row that moves with time, or a function of a user that cannot be run on tensors.
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
        given, copies = list(motions) if isinstance(motions, Iterable) else [motions], whole_number(copies, "copies")
        if not given or not all(isinstance(each, Motion) for each in given):
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
        whole = [copies, self.n_systems] if len({each.n_atoms for each in given}) == 1 else [copies]
        self._shapes = [(self.n_atoms, 3), *((k, self.n_atoms // k, 3) for k in whole)]
        self._numbers: dict[Motion, list[int]] = {}
        for number, each in enumerate(self.systems):
            self._numbers.setdefault(each, []).append(number)
        with torch.inference_mode(False):  # whose tensors have no versions, which tell that they were written to
            self.system_idx = self._joined(lambda each: np.zeros(each.n_atoms), torch.int64, range(self.n_systems))
            self.masses = self._joined(lambda each: each.masses)
            self.targets = self._joined(lambda each: each.constraint_set.target(0.0))
            self._calls = 0
            # Fixed atoms, in the order of their rows.
            self._fixed_rows = self._joined(lambda each: each.plan.pinned_rows, torch.int64, self.row_starts)
            self._fixed = self._joined(lambda each: each.fixed_atoms, torch.int64, self.atom_starts)
            self._free = self.masses > 0
            self._free[self._fixed] = False
            self._inverse_masses = self._inverse(self.masses)
            self._is_position = self._joined(lambda each: each.constraint_set.holonomic, torch.bool)
            self._holonomic = bool(self._is_position.all())
            self._rates = torch.where(self._is_position, 0.0, self.targets)
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
            self._known[velocity_rows] = [Group(pattern, each, self) for pattern, each in parts.items()]
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
        right = isinstance(x, Tensor) and x.shape in self._shapes and x.device.type == self.device.type
        if not right or x.dtype != self.dtype:
            wanted = f"{' or '.join(map(str, dict.fromkeys(self._shapes)))}, {self.dtype} on {self.device}"
            raise InputError(f"{item} must be a tensor of shape {wanted}; convert it", item=item)
        return x.reshape(-1, 3)

    def _all(self, values: Tensor, count: int, item: str) -> Tensor:
        if not isinstance(values, Tensor) or values.shape != (count,) or values.device.type != self.device.type:
            raise InputError(f"{item} must be a tensor of shape ({count},) on {self.device}", item=item)
        bad = ~values.isfinite() if item == "targets" else self._free & ~((values > 0) & values.isfinite())
        if bad.any():
            said = f"{item}[{int(bad.nonzero()[0])}] is {float(values[bad][0])}"
            raise InputError(f"{said}; give finite numbers, masses above 0", item=item)
        return values.to(self.dtype)

    def weights(self, masses: Tensor | None = None) -> Tensor:
        """Inverse masses, 0 for fixed atoms, shape (n_atoms,); of other `masses` than those of the engines.

        Raises
        ------
        UnsupportedError
            Rows that are defined by the masses of their engine, such as centers of mass.
        """
        if masses is None:
            return self._inverse_masses
        items = [each for motion in self._numbers for each in motion.constraint_set.constraints if each.uses_masses]
        if items:
            raise UnsupportedError(f"{items[0]!r} is defined by the masses of its Motion; make another with other ones")
        return self._inverse(self._all(masses, self.n_atoms, "masses"))

    def _task(self, of_positions: bool, flight: float = 0.0) -> Task:
        for item, own in zip(("masses", "targets"), self._given, strict=True):
            if getattr(self, item) is not own or own._version:  # numbers that follow from them are kept
                raise InputError(f"{item} of a Batch were written to; give other ones as {item}= of a call", item=item)
        flies = bool(not self._holonomic and flight != 0)
        return Task(self, self._groups(self._holonomic or flies or not of_positions), of_positions, flies)

    def _with_fixed(self, y: Tensor, rows: Tensor) -> Tensor:
        """With what the rows of fixed atoms say of these."""
        return y.index_copy(0, self._fixed, rows[self._fixed_rows].reshape(-1, 3)) if len(self._fixed) else y

    # -- what is asked --------------------------------------------------------------------------------

    def project_positions(self, x_new: Tensor, x_reference: Tensor, **options: Any) -> Tensor:
        """Positions on the rows: those of `solve_positions`, which tells the options and the errors."""
        return self.solve_positions(x_new, x_reference, **options)[0]

    def solve_positions(
        self,
        x_new: Tensor,
        x_reference: Tensor,
        *,
        flight: float = 0.0,
        targets: Tensor | None = None,
        masses: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Solve sigma(x_new + M^-1 A(x_reference)^T Lambda) = 0 for each system, by Newton's method.

        Derivatives are those of the solution, by one solve with the transposed matrix.

        Parameters
        ----------
        x_new, x_reference : Tensor, shape (n_atoms, 3) or (copies, atoms, 3)
            Positions to correct, and those whose gradients give the directions.
        flight : float
            Time from `x_reference` to `x_new`, for rows of velocities; see `Motion.project_positions`.
        targets : Tensor, shape (n_rows,), optional
            What rows are held at, in place of what the engines say.
        masses : Tensor, shape (n_atoms,), optional

        Returns
        -------
        positions, push : Tensor
            Those on the rows, and M^-1 A^T Lambda: velocities are to change by ``push/dt``, which knows nothing of the
            rounding of positions.

        Raises
        ------
        ConvergenceError
            No solution near enough, in this or an earlier call: see `check`.
        InputError
            Another shape or type of number.
        """
        x, start = self._flat(x_new, "x_new"), self._flat(x_reference, "x_reference")
        held = self.targets if targets is None else self._all(targets, self.n_rows, "targets")
        if not self._holonomic:
            held = torch.where(self._is_position, held, flight * held)
        task = self._task(True, flight)
        found, push = Projection.apply(self._with_fixed(x, held), start, held, self.weights(masses), task)
        self._calls += 1
        if self._calls >= self.check_every:
            self.check()
        return found.reshape(x_new.shape), push.reshape(x_new.shape)

    def project_velocities(self, x: Tensor, v: Tensor, *, masses: Tensor | None = None) -> Tensor:
        """Nearest admissible velocities in the mass metric: A v = c.

        Shapes and `masses` are as for `solve_positions`.
        """
        here, task = self._flat(x, "x"), self._task(False)
        speeds = self._with_fixed(self._flat(v, "v"), self._rates)
        return Projection.apply(speeds, here, self._rates, self.weights(masses), task)[0].reshape(v.shape)

    def multipliers(self, x: Tensor, v: Tensor, forces: Tensor, *, masses: Tensor | None = None) -> Tensor:
        """lambda of the constraint forces A^T lambda, in natural units; of least norm where rows depend on each other.

        Shapes are as for `solve_positions`; the result has shape (n_rows,), or (copies, rows) if copies are alike.
        """
        here, speed, f = self._flat(x, "x"), self._flat(v, "v"), self._flat(forces, "forces")
        w, rest, task = self.weights(masses), torch.zeros_like(self._rates), self._task(False)
        a = self._with_fixed(w[:, None] * f, rest)
        lam, held = rest, f.reshape(-1)
        for group in task.groups:
            of = task.problem(group, here, here, rest, w)
            each, force = group.solver.respond(of, speed.reshape(-1)[group.flat], a.reshape(-1)[group.flat])
            lam = lam.index_put((group.rows,), each)
            held = held.index_add(0, group.flat.reshape(-1), force.reshape(-1))
        # What fixed atoms' rows supply: M a less the forces and those of the other rows.
        inert = self.masses if masses is None else self._all(masses, self.n_atoms, "masses")
        lacking = (inert[:, None] * a - held.reshape(-1, 3))[self._fixed]
        lam = lam.index_copy(0, self._fixed_rows, lacking.reshape(-1))
        rows: Any = np.diff(self.row_starts[:: self.n_systems // len(x)]) if x.ndim == 3 else []
        return lam.reshape(len(x), -1) if len(set(rows)) == 1 else lam

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
        said = f"copy {copy}, row {held.row_name(row)} {said} in one of the last {calls} projections"
        remedy = "Take a smaller time step, or start on the rows (Motion.restore_positions)"
        where: dict[str, Any] = {"residual": residual, "row": row, "atoms": held.row_atoms(row).tolist()}
        error = ConvergenceError(f"{said}: there is no solution near enough. {remedy}", tolerance=limit, **where)
        error.copy = copy
        raise error

    def report(self, x: Tensor, v: Tensor | None = None) -> list[Report]:
        """What each system's engine reports of its positions, and velocities: residuals, rank, kinds of clusters."""

        def parts(values: Tensor, item: str) -> list[FloatArray]:
            return np.split(self._flat(values, item).detach().cpu().double().numpy(), self.atom_starts[1:-1])

        speeds: Any = [None] * self.n_systems if v is None else parts(v, "v")
        some = zip(self.systems, parts(x, "x"), speeds, strict=True)
        return [motion.report(here, speed, condition=False) for motion, here, speed in some]


# -- clusters of a batch by pattern ---------------------------------------------------------------------


#: Clusters of one pattern in one system: atoms and rows, and by cluster parameters, scales, and cells of images.
Kind = tuple[Alike, Any, Any, Any]
_KNOWN: WeakKeyDictionary[Motion, dict[bool, dict[Pattern, Kind]]] = WeakKeyDictionary()


def kinds_of(motion: Motion, velocity_rows: bool) -> dict[Pattern, Kind]:
    """Clusters of an engine by pattern, with or without rows of velocities; looked for once.

    Refuses rows that move or cannot be run on tensors, and those that depend on others where it is not known which.
    """
    known = _KNOWN.setdefault(motion, {})
    if velocity_rows in known:
        return known[velocity_rows]
    held, plan = motion.constraint_set, motion.plan
    missing = int(((plan.labels >= 0) & ~plan.eliminate_last).sum()) + len(plan.pinned_rows) - motion.rank
    if missing:
        remedy = "leave out what others hold (Motion.report names the kinds of clusters)"
        raise UnsupportedError(f"{missing} rows depend on others, in clusters too large to know which; {remedy}")
    what: list[tuple[Row, bool]] = []
    atoms: list[IntArray] = []
    parameters: list[FloatArray] = []
    offsets: list[FloatArray] = []
    for item, start in zip(held.constraints, held.starts, strict=False):
        n = item.n_rows
        if not n:
            continue
        if item.moving:
            raise UnsupportedError(f"{item!r} moves with time; hold it at rest, and give each step its targets=")
        table = item.parameters().reshape(n, -1)
        cells = np.zeros((*item.atoms.shape, 3)) if item.cell_offsets is None else 1.0 * item.cell_offsets
        offsets += list((cells - cells[:, :1])[:, 1 if item.relative else item.width :])
        atoms, parameters = atoms + list(item.atoms), parameters + list(table)
        whole, last = np.zeros(n) if item.whole is None else item.whole, plan.eliminate_last[start : start + n]
        tape: Any = None if item.fixes_atoms else tape_of(item)
        row = Row(tape, (), item.holonomic, item.relative, False, item.period or 0.0, table.shape[1])
        what += [(row._replace(whole=bool(w)), bool(l)) for w, l in zip(whole, last, strict=True)]
    labels = plan.labels if velocity_rows else np.where(held.holonomic, plan.labels, -1)
    found: dict[Pattern, Kind] = {}
    for key, clusters in alike(labels, plan.eliminate_last, what, atoms).items():
        rows = tuple(row._replace(atoms=local) for (row, _), local in key)
        pattern = Pattern(rows, sum(not last for (_, last), _ in key), clusters.atoms.shape[1])
        p, cells = (
            np.array([np.concatenate([t[k] for k in some]) for some in clusters.rows]) for t in (parameters, offsets)
        )
        found[pattern] = clusters, p, held.scale[clusters.rows], cells
    known[velocity_rows] = found
    return found


@lru_cache(512)
def solver_of(pattern: Pattern, device: torch.device, compiled: bool) -> Lanes:
    """The equations of a pattern; of small ones compiled where that is asked for."""
    made = Lanes(pattern) if pattern.small else Levels(pattern, device)
    if compiled and pattern.small:
        for name in ("newton", "tangent", "adjoint"):
            setattr(made, name, torch.compile(getattr(made, name), dynamic=True))
    return made


class Group:
    """All clusters of one pattern in a batch.

    `parts` are kinds, with the numbers of their systems, and where atoms and rows of these begin. What has a last axis
    of n is by cluster: `atoms`, (n_atoms, n), their coordinates `flat`, (3 n_atoms, n), `rows`, (n_rows, n), `systems`,
    (n,), and `worst`, (n_rows, n), by how much rows were off at most since that was looked at, in parts of their scale.
    """

    def __init__(self, pattern: Pattern, parts: Sequence[tuple[Kind, IntArray]], batch: Batch) -> None:
        like = batch._inverse_masses
        self.pattern, self.solver = pattern, solver_of(pattern, like.device, batch.compiled)

        def of_all(of: Any, dtype: torch.dtype = torch.int64) -> Tensor:
            """Numbers of clusters in all systems, the last axis by cluster."""
            whole = np.concatenate([of(kind, *where) for kind, some in parts for where in some])
            return torch.as_tensor(np.ascontiguousarray(np.moveaxis(whole, 0, -1)), device=like.device, dtype=dtype)

        self.atoms = of_all(lambda kind, system, atom, row: kind[0].atoms + atom)
        self.rows = of_all(lambda kind, system, atom, row: kind[0].rows + row)
        self.systems = of_all(lambda kind, system, atom, row: np.full(len(kind[2]), system))
        self.p, self.scale, self._offsets = (
            _once(of_all(lambda kind, *_, k=k: kind[k], like.dtype)) for k in (1, 2, 3)
        )
        #: Numbers by atom and by row that do not change.
        self._own = {id(like): _once(like[self.atoms])}
        self._own |= {id(each): _once(each[self.rows]) for each in (batch.targets, batch._rates)}
        self.flat = _flat(self.atoms)
        # Of relative rows each atom but the first, the one before it, and the first.
        slots = [(row, i) for row in pattern.rows if row.relative for i in range(1, len(row.atoms))]
        which = [[row.atoms[i], row.atoms[i - 1], row.atoms[0]] for row, i in slots]
        self._now, self._before, self._first = (_flat(self.atoms[[each[k] for each in which]]) for k in range(3))
        self._begin = torch.tensor([k - i + 1 for k, (_, i) in enumerate(slots)], device=like.device)
        self._whole = torch.tensor([row.whole for row, _ in slots], device=like.device)[:, None]
        self._any_whole = any(row.whole for row, _ in slots)
        self.worst = torch.zeros(self.rows.shape, dtype=like.dtype, device=like.device)

    def lanes(self, values: Tensor, numbers: Tensor) -> Tensor:
        """Values of all atoms or rows by cluster."""
        found = self._own.get(id(values))
        return values[numbers] if found is None else found

    def coordinates(self, x: Tensor, batch: Batch) -> tuple[Tensor, Tensor | None]:
        """Of the atoms of clusters, and by how much the images that relative rows mean stand off: see `Problem`."""
        flat, n = x.reshape(-1), self.atoms.shape[1]
        if batch._lattice is None or not len(self._begin):
            return flat[self.flat], None

        def apart(values: Tensor, others: Tensor) -> Tensor:
            return (values[self._now] - values[others]).reshape(3, -1, n)

        cell, inverse = batch._lattice[self.systems].unbind(1)
        sums = -torch.round(torch.einsum("xen,nxy->yen", apart(flat, self._before), inverse)).cumsum(1)
        cells = sums - torch.cat([torch.zeros_like(sums[:, :1]), sums], 1)[:, self._begin]
        if self._any_whole:
            found = apart(batch._tree_cells(x).reshape(-1), self._first) + self._offsets.movedim(1, 0)
            cells = torch.where(self._whole, found, cells)
        return flat[self.flat], torch.einsum("xen,nxy->eyn", cells, cell).reshape(-1, n)


def _once(values: Tensor) -> Tensor:
    """Values by cluster, one where real ones are all alike."""
    some = values[..., :1].contiguous()
    return some if bool((values == some).all()) else values


def _flat(atoms: Tensor) -> Tensor:
    """Numbers of coordinates, x before y and z, shape (3 n_atoms, n)."""
    return (3 * atoms + torch.arange(3, device=atoms.device)[:, None, None]).flatten(0, 1)


# -- projections as functions that torch differentiates ------------------------------------------------


class Task(NamedTuple):
    """What is solved for: `of_positions` or velocities, and whether rows of velocities count in positions (`flies`)."""

    batch: Batch
    groups: Sequence[Group]
    of_positions: bool
    flies: bool

    def problem(self, group: Group, x: Tensor, start: Tensor, held: Tensor, w: Tensor) -> Problem:
        """Of the clusters of a group, at positions x with directions of a start, which may be the same tensor."""
        there = group.coordinates(start, self.batch)
        here = there if x is start else group.coordinates(x, self.batch)
        flies = self.flies and any(not row.holonomic for row in group.pattern.rows)
        weights, wanted = group.lanes(w, group.atoms), group.lanes(held, group.rows)
        return Problem(here[0], there[0], here[1], there[1], flies, weights, wanted, group.p)


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
        if worst <= ENOUGH * eps or eps**0.5 > worst > 0.5 * before:
            break
        before = worst
    group.worst = torch.maximum(group.worst, size / group.scale)
    return lam, moved


class Projection(torch.autograd.Function):
    """Positions or velocities on the rows, and by how much they were moved.

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
        return found, push

    @staticmethod
    def backward(ctx: Any, by_found: Any, by_push: Any) -> Any:
        if torch.is_grad_enabled():  # PyTorch would leave out what second derivatives have of this without a word
            raise UnsupportedError("projections have first derivatives alone; leave out create_graph")
        found, place, held, w, multipliers = ctx.saved_tensors
        task = ctx.task
        by_found = torch.zeros_like(found) if by_found is None else by_found
        pushed = by_found if by_push is None else by_found + by_push
        sums = [torch.zeros_like(each) for each in (found, place, held, w)]
        for group in task.groups:
            of = task.problem(group, found if task.of_positions else place, place, held, w)
            rows = group.rows[: group.pattern.rank]
            v = None if task.of_positions else found.reshape(-1)[group.flat]
            parts = group.solver.adjoint(of, multipliers[rows], pushed.reshape(-1)[group.flat], v)
            for total, part, index in zip(sums, parts, (group.flat, group.flat, rows, group.atoms), strict=True):
                # Atoms that are fixed may belong to several clusters.
                total.view(-1).index_add_(0, index.reshape(-1), part.expand(index.shape).reshape(-1))
        return by_found + sums[0], *sums[1:], None
