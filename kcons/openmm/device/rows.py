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
from kcons.constraints.functions.straight_line import Function
from kcons.constraints.target import FloatArray, MovingTarget
from kcons.errors import ConvergenceError, KconsError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.openmm.callback_rows import with_massless_atoms
from kcons.openmm.device.c_writer import c_functions
from kcons.openmm.device.held_rows import (
    IN_CELLS,
    NEAREST,
    RELATIVE,
    STORED,
    Row,
    Shape,
    constraints_of,
    function_on_device,
)
from kcons.openmm.device.kernels import Array
from kcons.openmm.device.large_clusters import large_clusters
from kcons.openmm.device.small_clusters import ItemWriter
from kcons.plan.clusters_alike import alike

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
/* Where atom a of a list is, after atom b before it, by the shortest image of the vector between them. */
#define ROWS_STEP(to, at, from, a, b) {{ \\
  mixed u_ = from[a]-from[b], v_ = from[(a)+1]-from[(b)+1], w_ = from[(a)+2]-from[(b)+2]; \\
  mixed n_ = rint(w_/box2.z); u_ -= n_*box2.x; v_ -= n_*box2.y; w_ -= n_*box2.z; \\
  n_ = rint(v_/box1.y); u_ -= n_*box1.x; v_ -= n_*box1.y; u_ -= rint(u_/box0.x)*box0.x; \\
  to[at] = to[(at)-3]+u_; to[(at)+1] = to[(at)-2]+v_; to[(at)+2] = to[(at)-1]+w_;}}
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
    """What kernels hold: the System's constraints and what was given beside them.

    Parameters
    ----------
    masses : ndarray, shape (n_particles,)
        0 for particles that do not move.
    system_rows : (ndarray of int, shape (n, 2), ndarray, shape (n,))
        Pairs and lengths in nm of the System's constraints.
    parts : sequence of CarriedConstraints or Constraint
        What else is held.
    positions : ndarray, shape (n_particles, 3)
        On or near the constraints, nm.
    cell : ndarray, shape (3, 3), optional
        Box vectors, nm, where rows take periodic images.
    time : float

    Attributes
    ----------
    motion : Motion
        The engine of all rows.
    set : ConstraintSet
        All rows, those of the System's constraints first.
    functions : list of Function
    target, scale : ndarray, shape (n_rows,)
        The scale is what tolerances are relative to: the length held, 1 for all that is no length.
    parameters : list of ndarray
        Of each row.
    doubtful : ndarray of bool, shape (n_rows,)
        Rows of clusters in which rows depend on others.
    mover, cell : ndarray of int, shape (n_rows,)
        Number of a row's moving target, and where its cells begin; of other rows the number of the next.
    n_movers, n_cells : int
    shapes : list of Shape
    arrays : list of Array
    source : str
        C text: functions of rows, and ``positions_NAME`` and ``velocities_NAME`` of each shape.
    scratch, work_group : int
        Numbers of LOCAL memory that a work-group needs, and its size.
    fixed, placed : ndarray of int
        Particles that do not move, whatever their mass; those whose rows have a place in space, so that positions as
        they are told of count.
    block : int
        Steps after which `renew` is due.

    Raises
    ------
    UnsupportedError
        Rows that only Python can compute; fixed atoms that move.
    KconsError
        What `ConstraintSet` and `Motion` raise.
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
        self.motion, self.set, self.fixed = motion, motion.constraint_set, motion.fixed_atoms
        self._write(self._alike(time))

    def _alike(self, time: float) -> list[Shape]:
        """What is known of rows, and clusters that look alike, whose code or tables are written once."""
        held, plan = self.set, self.motion.plan
        self.target = held.target(time)
        size = np.concatenate([item.scale(time) for item in held.constraints] or [np.zeros(0)])
        self.scale = np.where(size > 0, size, 1.0)
        self.doubtful = plan.eliminate_last.copy()
        for some in plan.dependent:
            self.doubtful[some] = True
        self.parameters: list[FloatArray] = []
        #: Objects whose rows stand in cells that are given.
        self._in_cells: list[Constraint] = []
        known: dict[Function, int] = {}
        atoms: list[IntArray] = []
        rows: list[Row] = []
        for item, start in zip(held.constraints, held.starts, strict=False):
            self.parameters += list(item.parameters().reshape(item.n_rows, -1))
            atoms += list(item.atoms)
            number = -1 if item.fixes_atoms else known.setdefault(function_on_device(item), len(known))
            # OpenMM keeps molecules in one piece: its own constraints know no images.
            open_ = held.lattice is None or start + item.n_rows <= self._summed_from
            how = np.full(item.n_rows, STORED if not item.relative else RELATIVE if open_ else NEAREST)
            if item.relative and item.whole is not None and not open_:
                how[item.whole] = IN_CELLS
                self._in_cells.append(item)
            moves, period = isinstance(item.target, MovingTarget), item.period or 0.0
            for k in range(start, start + item.n_rows):
                flags = not item.holonomic, moves, bool(plan.eliminate_last[k]), bool(k >= self._summed_from)
                rows.append(Row(number, (), int(how[k - start]), *flags, period))
        self.functions = list(known)
        sizes = [[row.moves, 3 * len(a) * (row.how == IN_CELLS)] for row, a in zip(rows, atoms, strict=True)]
        ends = np.cumsum([[0, 0], *sizes], axis=0)
        (self.mover, self.cell), (self.n_movers, self.n_cells) = ends[:-1].T, ends[-1].tolist()
        return [
            Shape(each.atoms, tuple(row._replace(atoms=local) for row, local in key), each.rows)
            for key, each in alike(plan.labels, plan.eliminate_last, rows, atoms).items()
        ]

    def _write(self, shapes: list[Shape]) -> None:
        """Code and arrays."""
        small = [each for each in shapes if not each.together]
        self.shapes = [each._replace(name=f"s{k}") for k, each in enumerate(small)]
        texts = [_COMMON]
        for number in sorted({row.function for shape in small for row in shape.rows}):
            texts.append(c_functions(f"rows_f{number}", self.functions[number]))
        order, tables = [np.zeros(0, np.int64)], [np.zeros(1)]
        for shape in self.shapes:
            writer = ItemWriter(shape, self, sum(map(len, tables)), sum(map(len, order)))
            texts.append(writer.text())
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
        self.placed: IntArray = np.unique(np.concatenate([*placed, np.zeros(0, np.int64)]))
        self.block = BLOCK if self.n_movers else 10**9
        self._n_knots = 3 + self.n_movers * 3 * ((BLOCK + 2 * BEYOND) * KNOTS + 1)
        self.arrays += [
            Array("rows_knots", "mixed", np.zeros(self._n_knots)),
            Array("rows_cells", "mixed", np.zeros(max(self.n_cells, 1))),
            Array("rows_sums", "mixed", np.zeros(max(len(self._order), 1)), saved=True),
        ]

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
            Needed where there are `n_cells`.
        cell : ndarray, shape (3, 3), optional

        Raises
        ------
        InputError
            A target that is no length; a cell that a row does not fit into.
        """
        found: dict[str, FloatArray] = {}
        if self.n_movers:
            known = self._knots(time - BEYOND * dt, dt / KNOTS, (steps + 2 * BEYOND) * KNOTS + 1)
            found["rows_knots"] = np.pad(known, (0, self._n_knots - len(known)))
        if self.n_cells:
            assert positions is not None
            if cell is not None:
                self.motion.set_cell(cell)
            found["rows_cells"] = self._cells(positions)
        return found

    def _cells(self, x: FloatArray) -> FloatArray:
        """Whole cells that bring the atoms of rows that need it beside the first one, one row after another."""
        found = [np.zeros(0)]
        for item in self._in_cells:
            assert self.set.lattice is not None
            cells = np.round((self.set.gather(item, x) - x[item.atoms]) @ self.set.lattice[1])
            found.append((cells - cells[:, :1])[item.whole].ravel())
        return np.concatenate(found)

    def _knots(self, start: float, spacing: float, count: int) -> FloatArray:
        """Times, then value, rate and acceleration of each moving row at each knot, in units of the spacing."""
        times = start + spacing * np.arange(count)
        tables = []
        for item in self.set.constraints:
            if isinstance(of := item.target, MovingTarget):
                values = np.array([item.target_at(t) for t in times])
                if item.period is not None:
                    values = np.unwrap(values, axis=0, period=item.period)
                slopes = (
                    spacing**order * np.array([each(t, item.n_rows, item.period) for t in times])
                    for order, each in ((1, of.rate_at), (2, of.acceleration_at))
                )
                tables.append(np.stack([values, *slopes], axis=2).swapaxes(0, 1).ravel())
        return np.concatenate([[start, 1 / spacing, count], *tables])

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
            f"step {step}: row {self.set.row_name(number)} {off} after {TURNS} iterations on the device; the step was "
            "taken back. Use a smaller time step, or start nearer to the constraints",
            residual=abs(residual),
            iterations=TURNS,
            row=number,
            atoms=self.set.row_atoms(number).tolist(),
            step=step,
        )
