"""Rows on the device, from the declarations of families and the plan of the engine: C text and arrays for the kernels.

Positions end where x + M^-1 A(x)^T y fulfils the rows, by Newton's method, to the tolerance asked for; velocities where
A v = c. Residuals are compared so that NaN fails. Impulses of the rows are summed on the device and read when asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from kcons.constraints import Constraint, Distance
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray, MovingTarget
from kcons.errors import ConvergenceError, InputError, KconsError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.openmm.callback_rows import with_massless_atoms
from kcons.openmm.device.c_writer import c_functions
from kcons.openmm.device.held_rows import IN_CELLS, STORED, HeldRows, Pattern, constraints_of
from kcons.openmm.device.kernels import Array, Shape
from kcons.openmm.device.large_clusters import LargeClusters, group_size
from kcons.openmm.device.small_clusters import ItemWriter, Record

#: Newton iterations at most; those after which a large cluster is factored again.
TURNS, CHORD = 30, 4
#: Knots of moving targets in a step; steps between two looks at functions of Python; steps that knots reach beyond.
KNOTS, BLOCK, BEYOND = 2, 500, 2
#: A pivot of a dependent row below this part of its diagonal is none.
PIVOT, PIVOT_SINGLE = 1e-10, 1e-4

_COMMON = f"""
#define ROWS_TURNS {TURNS}
#define ROWS_CHORD {CHORD}
#define ROWS_FAR ((mixed) 1e30)
#ifdef SINGLE
#define ROWS_PIVOT ((mixed) {PIVOT_SINGLE})
#define ROWS_ROUNDING ((mixed) 5e-7)
#else
#define ROWS_PIVOT ((mixed) {PIVOT})
#define ROWS_ROUNDING ((mixed) 4e-16)
#endif
/* The shortest image of a vector. */
#define ROWS_NEAR(a, b, c) {{mixed n_ = rint(c/box2.z); a -= n_*box2.x; b -= n_*box2.y; c -= n_*box2.z; \\
  n_ = rint(b/box1.y); a -= n_*box1.x; b -= n_*box1.y; a -= rint(a/box0.x)*box0.x;}}
/* Moving target j or its rate, by polynomials between knots that have value, rate and acceleration; NaN beyond them. */
DEVICE mixed rows_moving(GLOBAL const mixed* knots, int j, mixed time, int rate) {{
  int last = (int) knots[2]-1;
  mixed u = (time-knots[0])*knots[1];
  if (!(u > (mixed) -0.01 && u < last+(mixed) 0.01)) return sqrt((mixed) -1);
  int k = max(min((int) u, last-1), 0);
  GLOBAL const mixed* a = knots+3+3*(j*(last+1)+k);
  mixed s = u-k, w = a[3]-a[0], c2 = a[2]/2, c3 = 10*w-6*a[1]-4*a[4]-(3*a[2]-a[5])/2;
  mixed c4 = -15*w+8*a[1]+7*a[4]+(3*a[2]-2*a[5])/2, c5 = 6*w-3*(a[1]+a[4])-(a[2]-a[5])/2;
  if (rate) return (a[1]+s*(2*c2+s*(3*c3+s*(4*c4+s*5*c5))))*knots[1];
  return a[0]+s*(a[1]+s*(c2+s*(c3+s*(c4+s*c5))));
}}
"""


class DeviceRows:
    """What kernels hold: see `rows_of`.

    Attributes
    ----------
    set : ConstraintSet
        All rows, those of the System's constraints first.
    motion : Motion
        The engine that has planned them.
    shapes : list of Shape
    arrays : list of Array
    source : str
        C text: functions of rows, and ``positions_NAME`` and ``velocities_NAME`` of each shape.
    scratch, work_group : int
        Numbers of LOCAL memory that a work-group needs, and its size.
    fixed : ndarray of int
        Particles that do not move, whatever their mass.
    placed : ndarray of int
        Particles whose rows have a place in space, so that positions as they are told of count.
    block : int
        Steps after which `renew` is due.
    looks : bool
        Whether that takes positions.
    """

    def __init__(self, motion: Motion, summed_from: int, time: float) -> None:
        held = self._held = HeldRows(motion, summed_from, time)
        self.motion, self.set, self.fixed = motion, motion.constraint_set, motion.fixed_atoms
        small = [pattern for pattern in held.patterns if pattern.small]
        large = [pattern for pattern in held.patterns if not pattern.small]
        used = sorted({row.function for pattern in small for row in pattern.rows})
        texts = [_COMMON, *(c_functions(f"rows_f{f}", held.functions[f]) for f in used)]
        self.shapes: list[Shape] = []
        order: list[IntArray] = []
        tables = [np.zeros(1)]
        for number, pattern in enumerate(small):
            record = self._record(pattern, sum(table.size for table in tables))
            texts.append(ItemWriter(f"s{number}", pattern, record, sum(map(len, order)), held).text())
            tables.append(record.table.ravel())
            order.append(pattern.clusters.ravel())
            self.shapes.append(Shape(f"s{number}", pattern.atoms, False, pattern.rank))
        self.arrays = [Array("rows_numbers", "mixed", np.concatenate(tables))]
        if large:
            clusters = LargeClusters(large, held, sum(map(len, order)))
            for pattern, first in zip(large, clusters.firsts, strict=True):
                self.shapes.append(Shape("large", pattern.atoms, True, pattern.rank, first))
            order.append(clusters.rows)
            self.arrays += clusters.arrays
            texts.append(clusters.source)
        self._order: IntArray = np.concatenate([*order, np.zeros(0, np.int64)]).astype(np.int64)
        self.source, self.scratch, self.work_group = "".join(texts), 2 if large else 0, group_size(large)
        placed = [each.atoms[:, a] for each in held.patterns for r in each.rows if r.how == STORED for a in r.atoms]
        self.placed: IntArray = np.unique(np.concatenate([*placed, np.zeros(0, np.int64)]))
        self.block, self.looks = (BLOCK if held.moving else 10**9), bool(held.in_cells)
        knots = np.zeros(3 + len(held.moving) * 3 * ((BLOCK + 2 * BEYOND) * KNOTS + 1))
        cells = np.zeros(max(3 * sum(len(self.set.row_atoms(row)) for row in held.in_cells), 1))
        self.arrays += [Array("rows_knots", "mixed", knots), Array("rows_cells", "mixed", cells)]
        self.arrays.append(Array("rows_sums", "mixed", np.zeros(max(len(self._order), 1)), saved=True))

    def _record(self, pattern: Pattern, start: int) -> Record:
        """The numbers of a small pattern; its rows in cells come after those before."""
        held = self._held
        first = 3 * sum(len(self.set.row_atoms(row)) for row in held.in_cells)
        record = Record(pattern, held, start, first)
        if record.cell_size:
            some = [k for k in range(len(pattern.rows)) if pattern.rows[k].how == IN_CELLS]
            held.in_cells += pattern.clusters[:, some].ravel().tolist()
        return record

    def renew(
        self, time: float, dt: float, steps: int, positions: FloatArray | None = None, cell: FloatArray | None = None
    ) -> dict[str, FloatArray]:
        """What functions of Python and positions say for the next steps, by the name of the array.

        Parameters
        ----------
        time, dt : float
            Where the steps begin, and the time step, ps.
        steps : int
            At most `block`.
        positions : ndarray, shape (n_particles, 3), optional
            Needed where it `looks`.
        cell : ndarray, shape (3, 3), optional

        Raises
        ------
        InputError
            A target that is no length; a cell that a row does not fit into.
        """
        found: dict[str, FloatArray] = {}
        if self._held.moving:
            found["rows_knots"] = self._knots(time - BEYOND * dt, dt / KNOTS, (steps + 2 * BEYOND) * KNOTS + 1)
        if self.looks:
            assert positions is not None
            if cell is not None:
                self.motion.set_cell(cell)
            found["rows_cells"] = self._held.cells_of(positions)
        return found

    def _knots(self, start: float, spacing: float, count: int) -> FloatArray:
        """Times, then value, rate and acceleration of each moving row at each knot, in units of the spacing."""
        full = next(len(array.values) for array in self.arrays if array.name == "rows_knots")
        times = start + spacing * np.arange(count)
        tables = []
        for item in self.set.constraints:
            if isinstance(item.target, MovingTarget):
                of, n, period = item.target, item.n_rows, item.period
                values = np.array([item.target_at(t) for t in times])
                if period is not None:
                    values = np.unwrap(values, axis=0, period=period)
                rates = np.array([of.rate_at(t, n, period) for t in times]) * spacing
                bends = np.array([of.acceleration_at(t, n, period) for t in times]) * spacing**2
                tables.append(np.stack([values, rates, bends], axis=2).swapaxes(0, 1).ravel())
        table = np.concatenate([[start, 1 / spacing, count], *tables])
        return np.concatenate([table, np.zeros(full - len(table))])

    def multipliers(self, sums: FloatArray, time: float) -> FloatArray:
        """Mean multipliers by row of the `set`, from the array ``rows_sums`` of a time; NaN where they are not summed.

        A^T lambda is the force on the particles: kJ/mol over the unit of the row.
        """
        found = np.full(self.set.n_rows, np.nan)
        found[self._order] = np.asarray(sums)[: len(self._order)] / time
        found[: self._held.summed_from] = np.nan
        return found

    def failure(self, row: int, residual: float, step: int) -> KconsError:
        """The error for a row, by its number on the device, that could not be fulfilled in a step."""
        number = int(self._order[row])
        off = f"is off by {abs(residual):.3g}" if np.isfinite(residual) else "is not finite"
        return ConvergenceError(
            f"step {step}: row {self.set.row_name(number)} {off} after {TURNS} iterations on the device; the step was "
            "taken back. Use a smaller time step, or start nearer to the constraints",
            residual=abs(residual),
            iterations=TURNS,
            row=number,
            atoms=self.set.row_atoms(number).tolist(),
            step=step,
        )


def rows_of(
    masses: FloatArray,
    system_rows: tuple[IntArray, FloatArray],
    parts: Sequence[Any],
    positions: FloatArray | None = None,
    cell: FloatArray | None = None,
    time: float = 0.0,
) -> DeviceRows:
    """The System's constraints and those of parts, for kernels.

    Parameters
    ----------
    masses : ndarray, shape (n_particles,)
        0 for particles that do not move.
    system_rows : (ndarray of int, shape (n, 2), ndarray, shape (n,))
        Pairs and lengths in nm of the System's constraints.
    parts : sequence of CarriedConstraints or Constraint
        What else is held.
    positions : ndarray, shape (n_particles, 3), optional
        On or near the constraints, nm. Without them targets have to be given, and there must be no `cell`.
    cell : ndarray, shape (3, 3), optional
        Box vectors, nm, where rows take periodic images.
    time : float

    Raises
    ------
    UnsupportedError
        Rows that only Python can compute; fixed atoms that move.
    KconsError
        What `ConstraintSet` and `Motion` raise.
    """
    pairs, lengths = system_rows
    given: list[Constraint] = [Distance(pairs, lengths)] if len(pairs) else []
    given += constraints_of(parts)
    if positions is None:
        unknown = next((item for item in given if item.target is None), None)
        if unknown is not None or cell is not None:
            raise InputError("targets and images are found from positions, which are not known", item="positions")
        # Rank is that of a place that is nothing special.
        positions = np.random.default_rng(0).normal(size=(len(masses), 3)) * max(1.0, len(masses) ** (1 / 3))
    given = list(with_massless_atoms(tuple(given), masses))
    held = ConstraintSet(given, positions, masses, cell=cell, time=time)
    motion = Motion(held, positions, time=time)
    for item in motion.constraint_set.constraints:
        if item.fixes_atoms and item.moving:
            raise UnsupportedError(f"{item!r} moves, which the device does not do; leave it to the host (device=False)")
    # Rows that were converted stand in another order: then all are summed.
    return DeviceRows(motion, 0 if motion.conversions else len(pairs), time)
