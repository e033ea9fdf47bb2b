"""What is held on the device: rows with their functions and numbers, and clusters that look alike.

Rows that share a moving atom are one cluster, as the engine's plan says. Clusters that look alike are one pattern,
whose code or tables are written once.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from kcons.constraints import Constraint
from kcons.constraints.constraint import IntArray
from kcons.constraints.functions.straight_line import Function, function_of
from kcons.constraints.target import FloatArray, MovingTarget
from kcons.errors import UnsupportedError
from kcons.motion.motion import Motion
from kcons.openmm.device.c_writer import c_functions
from kcons.plan.clusters_alike import alike

#: Rows, atoms of a cluster and atoms of a row up to which a work-item has the cluster in registers.
ITEM_ROWS, ITEM_ATOMS, ITEM_WIDTH = 6, 10, 4
#: How rows take their atoms, see `clusters.c`.
STORED, RELATIVE, NEAREST, IN_CELLS = range(4)


def refusal(parts: Any) -> str:
    """Why parts of an integrator cannot be held on the device; '' if they can.

    Parameters
    ----------
    parts : Part, Constraint or sequence of such
        Of the integrator.
    """
    try:
        for item in constraints_of(parts):
            function_on_device(item)
    except UnsupportedError as error:
        return str(error)
    return ""


def constraints_of(parts: Any) -> list[Constraint]:
    """The constraint objects of parts as they were given, targets that were found included.

    Raises
    ------
    UnsupportedError
        Rows of another kind.
    """
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
    """The function of an object's rows.

    Raises
    ------
    UnsupportedError
        Rows that only Python can compute, or whose function cannot be written in C.
    """
    found = function_of(item)
    if found is None:
        raise UnsupportedError(
            f"{item!r} is a function of Python, which no device can call; write it as a Formula, or leave it to the "
            "host (device=False)"
        )
    c_functions("looked_at", found)
    return found


class Row(NamedTuple):
    """A row of a pattern: number of its function, its atoms in the cluster, how it takes them, and what it is."""

    function: int
    atoms: tuple[int, ...]
    how: int
    rolls: bool
    moves: bool
    depends: bool
    summed: bool
    period: float


class Pattern(NamedTuple):
    """Clusters that look alike: its rows, those that depend on others last.

    `clusters` are their rows in the set, shape (n, n_rows), `atoms` their particles, shape (n, n_atoms).
    """

    rows: tuple[Row, ...]
    atoms: IntArray
    clusters: IntArray

    @property
    def small(self) -> bool:
        """Whether a work-item has a cluster."""
        widest = max(len(row.atoms) for row in self.rows)
        return len(self.rows) <= ITEM_ROWS and self.atoms.shape[1] <= ITEM_ATOMS and widest <= ITEM_WIDTH

    @property
    def rank(self) -> int:
        return sum(not row.depends for row in self.rows)


class HeldRows:
    """All rows of an engine, as the device has them.

    Parameters
    ----------
    motion : Motion
    summed_from : int
        The first row whose multipliers are summed.
    time : float

    Attributes
    ----------
    functions : list of Function
    patterns : list of Pattern
    target, scale : ndarray, shape (n_rows,)
        The scale is what tolerances are relative to: the length held, 1 for all that is no length.
    parameters : list of ndarray
        Of each row.
    doubtful : ndarray of bool, shape (n_rows,)
        Rows of clusters in which rows depend on others.
    mover, cell : ndarray of int, shape (n_rows,)
        Number of a row's moving target, and where its cells begin; of other rows the number of the next.
    n_movers, n_cells : int
    """

    def __init__(self, motion: Motion, summed_from: int, time: float) -> None:
        self.motion, self.summed_from = motion, summed_from
        self.set = held = motion.constraint_set
        plan = motion.plan
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
            open_ = held.lattice is None or start + item.n_rows <= summed_from
            how = np.full(item.n_rows, STORED if not item.relative else RELATIVE if open_ else NEAREST)
            if item.relative and item.whole is not None and not open_:
                how[item.whole] = IN_CELLS
                self._in_cells.append(item)
            moves, period = isinstance(item.target, MovingTarget), item.period or 0.0
            for k in range(start, start + item.n_rows):
                flags = not item.holonomic, moves, bool(plan.eliminate_last[k]), bool(k >= summed_from)
                rows.append(Row(number, (), int(how[k - start]), *flags, period))
        self.functions = list(known)
        sizes = [[row.moves, 3 * len(a) * (row.how == IN_CELLS)] for row, a in zip(rows, atoms, strict=True)]
        ends = np.cumsum([[0, 0], *sizes], axis=0)
        (self.mover, self.cell), (self.n_movers, self.n_cells) = ends[:-1].T, ends[-1].tolist()
        self.patterns = [
            Pattern(tuple(row._replace(atoms=local) for row, local in key), each.atoms, each.rows)
            for key, each in alike(plan.labels, plan.eliminate_last, rows, atoms).items()
        ]

    def cells_of(self, x: FloatArray) -> FloatArray:
        """Whole cells that bring the atoms of rows that need it beside the first one, one row after another."""
        found = [np.zeros(0)]
        for item in self._in_cells:
            assert self.set.lattice is not None
            cells = np.round((self.set.gather(item, x) - x[item.atoms]) @ self.set.lattice[1])
            found.append((cells - cells[:, :1])[item.whole].ravel())
        return np.concatenate(found)

    def knots(self, start: float, spacing: float, count: int) -> FloatArray:
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
