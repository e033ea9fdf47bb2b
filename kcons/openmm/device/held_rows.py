"""What is held on the device: rows with their functions and numbers, and clusters that look alike.

Rows that share a moving atom are one cluster, as the engine's plan says. Clusters that look alike are one pattern,
whose code or tables are written once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from kcons.constraints import Constraint, Formula
from kcons.constraints.constraint import IntArray, RowKind
from kcons.constraints.target import FloatArray, MovingTarget
from kcons.errors import UnsupportedError
from kcons.motion.motion import Motion
from kcons.openmm.callback_rows.carried_constraints import CarriedConstraints
from kcons.openmm.device.c_writer import c_function, c_rate, openmm_expression

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
            function_of(item)
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
        elif hasattr(part, "given"):  # all of an integrator, as it has them
            found += part.given
        elif isinstance(part, CarriedConstraints):
            found += part.motion.sources[0].constraints
        else:
            raise UnsupportedError(
                f"{part!r} is not held on the device; give constraint objects of kcons, or leave it to the host "
                "(device=False)"
            )
    return found


def molecules_of(pairs: IntArray, parts: Any) -> list[IntArray]:
    """Atoms that OpenMM has to keep together, row by row: `pairs` of the System, shape (n, 2), and rows of parts."""
    return [
        row for table in [pairs, *(item.atoms for item in constraints_of(parts) if item.width > 1)] for row in table
    ]


# -- functions --------------------------------------------------------------------------------------


class Function(NamedTuple):
    """What rows are computed by. Rows of objects with the same function share its code.

    `known` are the first parameters where they are the same in all rows; a formula is a function of `numbers` (how
    many of positions, and of parameters), and `second` gives its rate, if the time is in it.
    """

    row: Callable[..., Any]
    known: tuple[float, ...] = ()
    second: Callable[..., Any] | None = None
    numbers: tuple[int, int] = (0, 0)
    is_distance: bool = False

    def _formula(self, r: Any, p: Any, t: Any, out: Any) -> None:
        places, parameters = self.numbers
        given = [*(r[k] for k in range(places)), t, *(p[k] for k in range(parameters))]
        out.update(enumerate(self.row(*given)))

    def text(self, name: str, space: str = "") -> str:
        """Its C function; with the time in it, also ``NAME_rate``."""
        places, parameters = self.numbers
        text = c_function(name, self._formula if places else self.row, space, self.known)
        if self.second is not None:
            text += c_rate(f"{name}_rate", self.second, places // 3, parameters, space)
        return text

    def expression(self) -> str:
        """Its value for a force of OpenMM, see `openmm_expression`."""
        return openmm_expression(self._formula if self.numbers[0] else self.row)


@cache
def _linear(size: int) -> Callable[..., None]:
    """The row of `LinearRows`, whose coefficients are their parameters."""

    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        out[0] = sum((p[k] * r[k] for k in range(size)), 0.0)
        out.update({1 + k: p[k] for k in range(size)})

    return row


def function_of(item: Constraint) -> Function:
    """The function of an object's rows.

    Raises
    ------
    UnsupportedError
        Rows that only Python can compute, or whose function cannot be written in C.
    """
    if item.functions or (item.row is None and item.kind is not RowKind.LINEAR):
        raise UnsupportedError(
            f"{item!r} is a function of Python, which no device can call; write it as a Formula, or leave it to the "
            "host (device=False)"
        )
    if isinstance(item, Formula):
        code = item.code()
        numbers = (3 if item.holonomic else 6) * item.width, len(item.names)
        found = Function(code.first, (), code.second if item.holonomic and code.moving else None, numbers)
    elif item.row is None:
        found = Function(_linear(3 * item.width))
    else:
        known = [float(item.width)] if item.uses_masses else item.parameters()[0, : item.alike].tolist()
        found = Function(item.row, tuple(known), is_distance=item.holds_length)
    found.text("looked_at")
    return found


# -- rows and clusters ------------------------------------------------------------------------------


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


@dataclass(frozen=True)
class Pattern:
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
    moving, in_cells : list of int
        Rows whose targets move, and rows whose atoms stand in cells that are given, in the order of tables.
    """

    def __init__(self, motion: Motion, summed_from: int, time: float) -> None:
        self.motion, self.set, self.summed_from = motion, motion.constraint_set, summed_from
        self.functions: list[Function] = []
        self.moving: list[int] = []
        self.in_cells: list[int] = []
        held = self.set
        self.target = held.target(time)
        size = np.concatenate([item.scale(time) for item in held.constraints] or [np.zeros(0)])
        self.scale = np.where(size > 0, size, 1.0)
        self.parameters: list[FloatArray] = []
        atoms: list[IntArray] = []
        rows: list[Row] = []
        last = motion.plan.eliminate_last
        self.doubtful = last.copy()
        for some in motion.plan.dependent:
            self.doubtful[some] = True
        known: dict[Function, int] = {}
        for item, start in zip(held.constraints, held.starts, strict=False):
            self.parameters += list(item.parameters().reshape(item.n_rows, -1))
            atoms += list(item.atoms)
            number = -1 if item.fixes_atoms else known.setdefault(function_of(item), len(known))
            # OpenMM keeps molecules in one piece: its own constraints know no images.
            open_ = held.lattice is None or start + item.n_rows <= summed_from
            how = np.full(item.n_rows, STORED if not item.relative else RELATIVE if open_ else NEAREST)
            if item.relative and item.whole is not None and not open_:
                how[item.whole] = IN_CELLS
            moves, period = isinstance(item.target, MovingTarget), item.period or 0.0
            if moves:
                self.moving += range(start, start + item.n_rows)
            for k in range(item.n_rows):
                flags = not item.holonomic, moves, bool(last[start + k]), bool(start + k >= summed_from)
                rows.append(Row(number, (), int(how[k]), *flags, period))
        self.functions += known
        self.patterns = self._patterns(rows, atoms)

    def _patterns(self, rows: list[Row], atoms: list[IntArray]) -> list[Pattern]:
        plan = self.motion.plan
        order = np.lexsort((plan.eliminate_last, plan.labels))
        order = order[plan.labels[order] >= 0]
        cuts = np.flatnonzero(np.diff(plan.labels[order])) + 1
        found: dict[tuple[Row, ...], tuple[list[list[int]], list[IntArray]]] = {}
        for cluster in np.split(order, cuts) if len(order) else []:
            place: dict[int, int] = {}
            pattern = []
            for row in cluster.tolist():
                local = tuple(place.setdefault(a, len(place)) for a in atoms[row].tolist())
                pattern.append(rows[row]._replace(atoms=local))
            mine = found.setdefault(tuple(pattern), ([], []))
            mine[0].append(list(place))
            mine[1].append(cluster)
        return [Pattern(key, np.array(each[0]), np.array(each[1])) for key, each in found.items()]

    def cells_of(self, x: FloatArray) -> FloatArray:
        """Whole cells that bring the atoms of the rows `in_cells` beside the first one, one row after another."""
        lattice = self.set.lattice
        found: list[FloatArray] = []
        made: dict[int, FloatArray] = {}
        for row in self.in_cells:
            item, k = self.set.locate(row)
            if id(item) not in made:
                assert lattice is not None
                cells = np.round((self.set.gather(item, x) - x[item.atoms]) @ lattice[1])
                made[id(item)] = cells - cells[:, :1]
            found.append(made[id(item)][k].ravel())
        return np.concatenate(found) if found else np.zeros(1)
