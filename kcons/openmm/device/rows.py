"""Rows on the device: C text and arrays for the kernels, and the part of an integrator that measures and tells of them.

Positions end where x + M^-1 A(x)^T y fulfils the rows, by Newton's method, to the tolerance asked for; velocities where
A v = c. Impulses of the rows are summed on the device and read when asked.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import openmm

from kcons.constraints import Constraint, Distance
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.functions.straight_line import Function, function_of
from kcons.constraints.target import FloatArray, MovingTarget
from kcons.errors import ConvergenceError, InputError, KconsError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.openmm.callback_rows import CarriedConstraints, Engine, refuse_virtual_sites, with_massless_atoms
from kcons.openmm.device.clusters import (
    IN_CELLS,
    RELATIVE,
    STORED,
    Array,
    ItemWriter,
    Row,
    Shape,
    c_functions,
    large_clusters,
)
from kcons.openmm.integrator.guard import SystemRows, settled_rows
from kcons.openmm.integrator.part import SINGLE, Precision
from kcons.openmm.integrator.program import Program
from kcons.openmm.quantities import masses_of, positions_of
from kcons.plan.clusters import alike
from kcons.solvers.tolerances import PIVOT_TOLERANCE

#: Newton iterations at most; those after which a large cluster is factored again.
TURNS, CHORD = 30, 4
#: Knots of moving targets in a step; steps between two looks at functions of Python; steps that knots reach beyond.
KNOTS, BLOCK, BEYOND = 2, 500, 2
#: Arrays of impulses, and of what rounding has taken from their sums.
SUMS = ("rows_sums", "rows_lost")
_NONE = np.zeros(0, np.int64)
#: A pivot of a dependent row below this part of its diagonal is none in single precision.
PIVOT_SINGLE = 1e-4

_COMMON = f"""
#define ROWS_TURNS {TURNS}
#define ROWS_CHORD {CHORD}
#define ROWS_FAR ((mixed) 1e30)
#if defined(USE_DOUBLE_PRECISION) || defined(USE_MIXED_PRECISION)
#define ROWS_PIVOT ((mixed) {PIVOT_TOLERANCE})
#define ROWS_ROUNDING ((mixed) 4e-16)
#define ROWS_ADD(sums, lost, row, impulse) sums[row] -= impulse;
#else
#define ROWS_PIVOT ((mixed) {PIVOT_SINGLE})
#define ROWS_ROUNDING ((mixed) 5e-7)
/* What rounding takes from a long sum of single numbers comes back with the next one. */
#define ROWS_ADD(sums, lost, row, impulse) {{volatile mixed y_ = -(impulse)-lost[row], t_ = sums[row]+y_; \
  lost[row] = (t_-sums[row])-y_; sums[row] = t_;}}
#endif
#define ROWS_DOT(a, b) ((a)[0]*(b)[0]+(a)[1]*(b)[1]+(a)[2]*(b)[2])
#define ROWS_SHIFT(to, n) {{to[0] += n[0]*box0.x+n[1]*box1.x+n[2]*box2.x; \\
  to[1] += n[1]*box1.y+n[2]*box2.y; to[2] += n[2]*box2.z;}}
/* Moving target j or its rate, by polynomials between knots that have value, rate and acceleration; NaN beyond them.
   Times are those since knots[0], which single numbers of a long run could not tell apart. */
DEVICE mixed rows_moving(GLOBAL const mixed* knots, int j, mixed time, int rate) {{
  int last = (int) knots[3]-1;
  mixed u = (time-knots[1])*knots[2];
  if (!(u > (mixed) -0.01 && u < last+(mixed) 0.01)) return sqrt((mixed) -1);
  int k = max(min((int) u, last-1), 0);
  GLOBAL const mixed* a = knots+4+3*(j*(last+1)+k);
  mixed s = u-k, w = a[3]-a[0], c2 = a[2]/2, c3 = 10*w-6*a[1]-4*a[4]-(3*a[2]-a[5])/2;
  mixed c4 = -15*w+8*a[1]+7*a[4]+(3*a[2]-2*a[5])/2, c5 = 6*w-3*(a[1]+a[4])-(a[2]-a[5])/2;
  if (rate) return (a[1]+s*(2*c2+s*(3*c3+s*(4*c4+s*5*c5))))*knots[2];
  return a[0]+s*(a[1]+s*(c2+s*(c3+s*(c4+s*c5))));
}}
"""


def constraints_of(parts: Any) -> list[Constraint]:
    """The constraint objects of parts as they were given, targets that were found included; refuses other rows."""
    found: list[Constraint] = []
    for part in parts if isinstance(parts, Iterable) else (parts,):
        if isinstance(part, Constraint):
            found.append(part)
        elif hasattr(part, "given"):
            found += part.given
        else:
            raise UnsupportedError(
                f"{part!r} is not held on the device; give constraint objects of kcons, or leave it to the host "
                "(device=False)"
            )
    return found


def function_on_device(item: Constraint) -> Function:
    """The function of an object's rows; refuses what only Python can compute, and what cannot be written in C."""
    found = function_of(item)
    if found is None:
        raise UnsupportedError(
            f"{item!r} is a function of Python, which no device can call; write it as a Formula, or leave it to the "
            "host (device=False)"
        )
    c_functions("looked_at", found)
    return found


class DeviceRows(Engine):
    """What kernels hold: the System's constraints, pairs (n, 2) and lengths in nm (n,), and what was given beside them.

    Masses are 0 for particles that do not move; `positions` are on or near the constraints, nm, in a `cell` where rows
    take periodic images. Raises UnsupportedError for rows that only Python can compute and fixed atoms that move.
    Of the `set` of all rows, the System's first, `motion` is the engine; `scale` is the length held, 1 for all that is
    no length; `mover` and `shift` are numbers of moving targets and where cells begin, of other rows those of the next.
    `shapes`, `arrays` and `source` belong to the functions ``positions_NAME`` and ``velocities_NAME`` as C, which need
    `scratch` numbers of LOCAL memory in work-groups of the size `work_group`. Particles that are `fixed` do not move;
    rows of those that are `placed` have a place in space, as a State tells of it. `renew` is due after `block` steps.
    """

    def __init__(
        self,
        masses: FloatArray,
        system_rows: tuple[IntArray, FloatArray],
        parts: Sequence[Any],
        positions: FloatArray,
        cell: FloatArray | None = None,
        time: float = 0.0,
    ) -> None:
        pairs, lengths = system_rows
        given: list[Constraint] = [Distance(pairs, lengths)] if len(pairs) else []
        whole = with_massless_atoms((*given, *constraints_of(parts)), masses)
        motion = Motion(ConstraintSet(whole, positions, masses, cell=cell, time=time), positions, time=time)
        for item in motion.constraint_set.constraints:
            if item.fixes_atoms and item.moving:
                raise UnsupportedError(
                    f"{item!r} moves, which the device does not do; leave it to the host (device=False)"
                )
        # Rows that were converted stand in another order: then all are summed.
        self._summed_from = 0 if motion.conversions else len(pairs)
        super().__init__(motion, masses, cell)
        self.set, self.fixed = motion.constraint_set, motion.fixed_atoms
        held, plan = self.set, motion.plan
        self.target = held.target(time)
        size = np.concatenate([item.scale(time) for item in held.constraints] or [np.zeros(0)])
        self.scale = np.where(size > 0, size, 1.0)
        self.parameters: list[FloatArray] = []
        #: Objects whose rows stand in cells that are given.
        self._in_cells: list[Constraint] = []
        known: dict[Function, int] = {}
        atoms: list[IntArray] = []
        rows: list[Row] = []
        for item, start in zip(held.constraints, held.starts, strict=False):
            if not item.n_rows:
                continue
            self.parameters += list(item.parameters().reshape(item.n_rows, -1))
            atoms += list(item.atoms)
            number = -1 if item.fixes_atoms else known.setdefault(function_on_device(item), len(known))
            # OpenMM keeps molecules in one piece: its own constraints know no images.
            open_ = held.lattice is None or start + item.n_rows <= self._summed_from
            how = STORED if not item.relative else RELATIVE if open_ else IN_CELLS
            if how == IN_CELLS:
                self._in_cells.append(item)
            moves, period = isinstance(item.target, MovingTarget), item.period or 0.0
            for k in range(start, start + item.n_rows):
                flags = not item.holonomic, moves, bool(plan.eliminate_last[k]), bool(k >= self._summed_from)
                rows.append(Row(number, (), how, *flags, period))
        self.functions = list(known)
        sizes = [[row.moves, 3 * len(a) * (row.how == IN_CELLS)] for row, a in zip(rows, atoms, strict=True)]
        ends = np.cumsum([[0, 0], *sizes], axis=0)
        (self.mover, self.shift), (self.n_movers, self.n_cells) = ends[:-1].T, ends[-1].tolist()
        found = alike(plan.labels, plan.eliminate_last, rows, atoms).items()
        self._write([Shape(e.atoms, tuple(r._replace(atoms=a) for r, a in key), e.rows) for key, e in found])

    def _write(self, shapes: list[Shape]) -> None:
        """Code and arrays, once for clusters that look alike."""
        small = [each for each in shapes if not each.together]
        self.shapes = [each._replace(name=f"s{k}") for k, each in enumerate(small)]
        texts = [_COMMON]
        for number in sorted({row.function for shape in small for row in shape.rows}):
            texts.append(c_functions(f"rows_f{number}", self.functions[number]))
        order, tables = [_NONE], [np.zeros(1)]
        for shape in self.shapes:
            writer = ItemWriter(shape, self, sum(map(len, tables)), sum(map(len, order)))
            texts += [writer.positions(), writer.velocities()]
            tables.append(writer.table.ravel())
            order.append(shape.clusters.ravel())
        self.arrays = [Array("rows_numbers", "mixed", np.concatenate(tables))]
        self.scratch, self.work_group = 0, 64
        if large := [each for each in shapes if each.together]:
            arrays, rows, numbered, source = large_clusters(large, self, sum(map(len, order)))
            order.append(rows)
            self.arrays += arrays
            texts.append(source)
            self.shapes += numbered
            self.scratch, self.work_group = 2, 32 if max(len(shape.rows) for shape in large) <= 64 else 256
        self.source, self._order = "".join(texts), np.concatenate(order)
        placed = [each.atoms[:, a] for each in shapes for r in each.rows if r.how == STORED for a in r.atoms]
        self.placed: IntArray = np.unique(np.concatenate([*placed, _NONE]))
        self.block = BLOCK if self.n_movers else 10**9
        self._n_knots = 4 + self.n_movers * 3 * ((BLOCK + 2 * BEYOND) * KNOTS + 1)
        sizes = {"rows_knots": self._n_knots, "rows_cells": self.n_cells} | dict.fromkeys(SUMS, len(self._order))
        self.arrays += [Array(name, "mixed", np.zeros(max(size, 1)), name in SUMS) for name, size in sizes.items()]

    def renew(
        self, time: float, dt: float, steps: int, positions: FloatArray | None = None, cell: FloatArray | None = None
    ) -> dict[str, FloatArray]:
        """What functions of Python say for so many steps, at most `block`, and of positions where they have changed."""
        found: dict[str, FloatArray] = {}
        if self.n_movers and steps:
            # Times, those of knots, then value, rate and acceleration of moving rows at each knot, per spacing.
            start, spacing, count = -BEYOND * dt, dt / KNOTS, (steps + 2 * BEYOND) * KNOTS + 1
            times = time + start + spacing * np.arange(count)
            tables: list[Any] = [[time, start, 1 / spacing, count]]
            for item in self.set.constraints:
                if isinstance(of := item.target, MovingTarget):
                    # Rates and accelerations ask for the values at the same times.
                    of = replace(of, value=cache(of.value))
                    values = np.array([item.with_target(of).target_at(t) for t in times])
                    if item.period is not None:
                        values = np.unwrap(values, axis=0, period=item.period)
                    about = item.n_rows, item.period
                    rates, turns = (np.array([f(t, *about) for t in times]) for f in (of.rate_at, of.acceleration_at))
                    known = np.stack([values, spacing * rates, spacing**2 * turns], axis=2)
                    tables.append(known.swapaxes(0, 1).ravel())
            found["rows_knots"] = np.zeros(self._n_knots)
            found["rows_knots"][: sum(map(len, tables))] = np.concatenate(tables)
        if self.n_cells and positions is not None and self.set.lattice is not None:
            self.motion.set_cell(cell)
            cells = []  # whole ones that bring atoms beside the first one
            for item in self._in_cells:
                between = self.set.gather(item, positions) - positions[item.atoms]
                cells.append(np.round((between - between[:, :1]) @ self.set.lattice[1]).ravel())
            found["rows_cells"] = np.concatenate(cells)
        return found

    def multipliers(self, sums: FloatArray, time: float) -> FloatArray:
        """Mean multipliers by row of the `set`, from the array ``rows_sums`` of a time; NaN where they are not summed.

        A^T lambda is the force on the particles: kJ/mol over the unit of the row.
        """
        found = np.full(self.set.n_rows, np.nan)
        found[self._order] = np.asarray(sums)[: len(self._order)] / time
        found[: self._summed_from] = np.nan
        return found

    def failure(self, row: int, residual: float, step: int) -> KconsError:
        """The error for a row, by its number on the device, that could not be fulfilled in a step."""
        number = int(self._order[row])
        off = f"is off by {abs(residual):.3g}" if np.isfinite(residual) else "is not finite"
        return ConvergenceError(
            f"step {step}: row {self.set.row_name(number)} {off} after {TURNS} iterations on the device. Use a "
            "smaller time step, start nearer to the constraints, or leave out tolerance=, which may be below rounding",
            residual=abs(residual),
            iterations=TURNS,
            row=number,
            atoms=self.set.row_atoms(number).tolist(),
            step=step,
        )


class KernelRows(CarriedConstraints):
    """All rows of a Context that its kernels hold: those of parts and the System's constraints; nm, ps, dalton, radian.

    Targets left at None are taken from the positions at the first step. One that is a function is asked before each
    call of `step`, at every half step that the call will make.
    """

    def __init__(self, parts: Sequence[Any]) -> None:
        self._parts = parts
        self._carried = [part for part in parts if isinstance(part, CarriedConstraints)]
        self.given = list(constraints_of(parts))
        self.groups = frozenset().union(*(getattr(part, "groups", ()) for part in parts))
        #: Whether rows take periodic images: as `hold` was told, else as the System.
        self._wraps = not self._carried or any(part.motion.lattice is not None for part in self._carried)
        self._bound: DeviceRows | None = None
        self._of: tuple[Any, ...] = ()
        #: Time at which sums of multipliers began, and where the last call of `step` left it, ps.
        self._since = self.left = math.nan

    # -- a Context ------------------------------------------------------------------------------

    def serve(self, integrator: Any) -> None:
        """PythonForces of the rows know that kernels hold them, and ask for the time step where no program does."""
        for part in self._carried:
            part._engine.served = True
            other = part._engine._integrator()
            if other is None or other.program.on_device:
                part._engine._integrator = weakref.ref(integrator)

    def rows_at(
        self, masses: FloatArray, held: FloatArray, positions: FloatArray, cell: Any, time: float
    ) -> DeviceRows:
        """The rows for a System with constraints i, j, length, shape (n, 3); made where they are asked for first."""
        # What OpenMM's own solvers hold, to whom checks and `applyConstraints` leave them.
        held = held[(masses[held[:, :2].astype(np.int64)] > 0).any(axis=1)]  # between others OpenMM holds nothing
        pairs, lengths = held[:, :2].astype(np.int64), held[:, 2]
        lengths = np.where(settled_rows(pairs, lengths, len(masses)), lengths.astype(np.float32), lengths)
        # Between atoms that stay where single numbers have put them a length is what it is there.
        fixed = np.concatenate([_NONE, *(item.atoms.ravel() for item in self.given if item.fixes_atoms)])
        ends = positions[pairs]
        here, rounding = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1), 4 * SINGLE * np.abs(ends).max(axis=(1, 2))
        rounded = (ends == ends.astype(np.float32)).all(axis=(1, 2)) & (np.abs(here - lengths) <= rounding)
        lengths = np.where(np.isin(pairs, fixed).all(axis=1) & rounded, here, lengths)
        made_of = tuple(array.tobytes() for array in (masses, pairs, lengths))
        if self._bound is None or self._of != made_of:
            cell = cell if self._wraps else None
            self._bound = DeviceRows(masses, (pairs, lengths), self.given, positions, cell, time)
            self._of, self._slopes = made_of, None
        return self._bound

    def bind(self, context: openmm.Context) -> DeviceRows:
        """The rows for a Context, at its positions."""
        assert self.program is not None
        if not self.program.integrator.shared.planned:
            refuse_virtual_sites(context.getSystem(), self.atoms, masses_of(context.getSystem()))
            self.program.integrator.read("seed")  # makes the plan, which asks `rows_at`
        assert self._bound is not None
        return self._bound

    @property
    def atoms(self) -> IntArray:
        """Particles that a row of the parts touches, and of the System's constraints once they are known."""
        if self._bound is not None:
            return self._bound.atoms
        return np.unique(np.concatenate([_NONE, *(item.atoms.ravel() for item in self.given)]))

    @property
    def _engine(self) -> Any:  # type: ignore[override]
        if self._bound is None:
            raise InputError(
                "these rows are known at the first step of a Context; call integrator.applyConstraints(context) "
                "after its positions were set",
                item="context",
            )
        return self._bound

    @property
    def driven(self) -> bool:
        return any(item.moving or not item.holonomic for item in self.given)

    def attach(self, program: Program, context: openmm.Context) -> None:
        self.bind(context)

    def _state(self, context: openmm.Context) -> tuple[FloatArray, FloatArray, float]:
        self.bind(context)
        self._engine.precision = Precision.of(context)
        return super()._state(context)

    def take_precision(self, program: Program, precision: Precision) -> None:
        """Whatever the precision is: residuals are what it can hold."""

    def check_masses(self, system: openmm.System) -> None:
        """Kernels are made for the System of a Context, and its masses."""

    _check_system = check_masses

    def rank(self, context: openmm.Context | None = None) -> int:
        """Degrees of freedom that the rows take, beyond the constraints of the System."""
        assert context is not None
        self.bind(context)
        return super().rank() - SystemRows.of(context.getSystem()).rank(positions_of(context))

    # -- results --------------------------------------------------------------------------------

    def mean_multipliers(self, integrator: Any) -> FloatArray:
        """Multipliers averaged over all steps of an integrator since they were reset, by row of the set of `motion`.

        Impulses that the kernels have summed over the time: kJ/mol over the unit of the row; NaN for constraints of the
        System, and before the first step. They begin anew where the time was set, or a State of another time loaded.
        The weights of `Series.weights`, which blue-moon averages over configurations need, are not in them: take
        samples by `HeldCoordinatesReporter` where masses enter det Z.
        """
        rows, time = self.bind(integrator.context), float(integrator.context.getTime()._value) - self._since
        sums = integrator.read("rows_sums")
        return rows.multipliers(sums, time) if time > 0 else np.full(rows.set.n_rows, np.nan)

    def reset_multipliers(self, integrator: Any) -> None:
        """Begin the sums of `mean_multipliers` anew, as the first step does, and one after the time was set."""
        for name in SUMS:
            integrator.write(name, np.zeros(len(integrator.read(name))))
        self._since = self.left = float(integrator.context.getTime()._value)

    def __deepcopy__(self, memo: dict[int, object]) -> KernelRows:
        return KernelRows(self._parts)

    def __reduce__(self) -> tuple[Any, ...]:
        return KernelRows, (self._parts,)

    def __repr__(self) -> str:
        return f"<KernelRows: {sum(item.n_rows for item in self.given)} rows and the constraints of the System>"
