"""What one step of a program makes OpenMM do, counted by walking through the program."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import openmm

from kcons.errors import UnsupportedError
from kcons.openmm.integrator.interface import Integrator
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program

_GROUP = re.compile(r"\b(f|energy)(\d*)\b")
#: Sums that are 0 in a step where all goes well and nobody has moved x.
_QUIET = ("moved", "unsolved")
_BLOCKS = ("loop", "when", "usual")


@dataclass
class StepCounts:
    """What OpenMM does in one step.

    Attributes
    ----------
    passes : int
        Computations for each degree of freedom, sums among them: on a GPU a kernel each (sums two).
    constraint_solves : int
        Calls of the System's constraint solvers.
    force_evaluations : int
        Evaluations of the applied forces.
    row_evaluations : int
        Evaluations of force groups that carry rows; with PythonForces, calls of Python.
    synchronisations : int
        Numbers that the host waits for: sums, and energies of force groups.
    """

    passes: int = 0
    constraint_solves: int = 0
    force_evaluations: int = 0
    row_evaluations: int = 0
    synchronisations: int = 0


def count_step(program: Program, *, iterations: int = 2, **values: float) -> StepCounts:
    """Count one step, after two others, in which all solves converge and nobody has changed the state.

    Parameters
    ----------
    program : Program
    iterations : int
        How often loops run whose end depends on positions.
    **values
        Global variables where they differ from those of a new integrator, for example between=1.
    """
    walk = _Walk(program, iterations, {"dt": 0.001, "dt_last": 0.001, "stale": 0.0, **values})
    walk.run(0, len(program.operations))
    for _ in range(2):  # what the steps before leave behind matters
        walk.counts = StepCounts()
        walk.run(0, len(program.operations))
    return walk.counts


def forces_at_old_positions(program: Program) -> bool:
    """Whether GPUs compute forces at old positions where the System has constraints.

    They keep what a computation makes of x as a difference, which forces do not see, until the next constraints are
    applied to positions; where no such line follows anywhere below, x is changed at once.
    """
    holds = [k for k, operation in enumerate(program.operations) if operation[:2] == ("hold", "x")]
    kept = False
    for k, (kind, variable, expression) in enumerate(program.operations):
        if kept and _GROUP.search(expression):
            return True
        if kind == "hold" and variable == "x":
            kept = False
        elif kind == "each" and variable == "x":
            kept = bool(holds) and k < holds[-1]
    return False


def refuse_old_positions(integrator: Integrator, system: openmm.System, precision: Precision) -> None:
    """Raise where rows would be computed at old positions."""
    concerned = integrator.parts and precision.rounds_lengths and system.getNumConstraints()
    if concerned and forces_at_old_positions(integrator.program):
        raise UnsupportedError(
            f"{precision} computes these rows at old positions where the System has constraints as well; give "
            "CollectiveRows meets_system=True; with constraint objects take scheme 'rattle' at constant energy or let "
            "kcons hold all constraints (hold(system, ..., take='all', keep_water=False)); or run on the CPU platform"
        )


class _Unknown:
    """A number that depends on positions."""

    def _same(self, *_: Any) -> _Unknown:
        return self

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = _same
    __pow__ = __rpow__ = __neg__ = __gt__ = __lt__ = __ge__ = __le__ = _same
    __eq__ = __ne__ = _same  # type: ignore[assignment]
    __hash__ = None  # type: ignore[assignment]


UNKNOWN = _Unknown()


def _known(function: Callable[..., float]) -> Callable[..., Any]:
    return lambda *a: UNKNOWN if any(isinstance(x, _Unknown) for x in a) else function(*a)


def _select(condition: Any, yes: Any, no: Any) -> Any:
    return UNKNOWN if isinstance(condition, _Unknown) else (yes if condition != 0 else no)


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "select": _select,
    "step": _known(lambda x: 1.0 if x >= 0 else 0.0),
    "delta": _known(lambda x: 1.0 if x == 0 else 0.0),
    "abs": _known(abs),
    "floor": _known(math.floor),
    "sqrt": _known(math.sqrt),
    "exp": _known(math.exp),
    "log": _known(math.log),
    "sinh": _known(math.sinh),
    "min": _known(min),
    "max": _known(max),
}


class _Walk:
    def __init__(self, program: Program, iterations: int, values: Mapping[str, float]) -> None:
        self.program, self.iterations = program, iterations
        self.values: dict[str, Any] = {**program.numbers, **program.settings, **values}
        self.counts = StepCounts()
        #: Groups that carry rows, None for all; those of several time steps carry forces.
        self.rows: frozenset[int] | None = getattr(program.integrator, "row_groups", None)
        #: Group of the last evaluation, and whether it gave forces as well.
        self.group: str | None = None
        self.forces = False
        self.scope: dict[str, Any] = dict(_FUNCTIONS)
        for name, table in program.tables.items():
            self.scope[name] = lambda k, table=table: UNKNOWN if isinstance(k, _Unknown) else table[int(k)]

    def run(self, first: int, end: int) -> None:
        k = first
        while k < end:
            kind, variable, expression = self.program.operations[k]
            if kind in _BLOCKS:
                close = self._close(k)
                for _ in range(self.iterations if kind == "loop" else 1):
                    holds = self._value(expression)
                    # What depends on positions is that something is wrong, or in a loop that it is not solved yet.
                    if holds is False or (isinstance(holds, _Unknown) and kind == "when"):
                        break
                    self.run(k + 1, close)
                else:
                    while kind == "loop" and self._value(expression) is True:
                        self.run(k + 1, close)
                k = close
            else:
                self._do(k, kind, variable, expression)
            k += 1

    def _close(self, k: int) -> int:
        depth = 0
        for j in range(k, len(self.program.operations)):
            kind = self.program.operations[j][0]
            depth += (kind in _BLOCKS) - (kind == "end")
            if depth == 0:
                return j
        raise ValueError("a block without end")

    def _forces_follow(self, k: int, group: str) -> bool:
        """Whether OpenMM computes forces together with the energy of computation k: not for one that moves x."""
        for kind, variable, expression in self.program.operations[k + 1 :]:
            if variable == "x" or kind == "others":
                return False
            if kind in ("each", "sum") and ("f", group) in _GROUP.findall(expression):
                return True
        return False

    def _do(self, k: int, kind: str, variable: str, expression: str) -> None:
        counts = self.counts
        for name, group in _GROUP.findall(expression):
            if group != self.group or (name == "f" and not self.forces):
                self.group = group
                self.forces = name == "f" or self._forces_follow(k, group)
                if group and (self.rows is None or int(group) in self.rows):
                    counts.row_evaluations += 1
                else:
                    counts.force_evaluations += 1
            counts.synchronisations += name == "energy"
        if kind in ("each", "sum"):
            counts.passes += 1
        if kind == "hold":
            counts.constraint_solves += 1
        if kind == "sum":
            counts.synchronisations += 1
            self.values[variable] = 0.0 if variable in _QUIET else UNKNOWN
        if kind == "let":
            value = self._value(expression)
            if not (variable == "failed" and isinstance(value, _Unknown)):
                self.values[variable] = value
        if kind in ("each", "hold") and variable == "x":
            self.group = None

    def _value(self, expression: str) -> Any:
        code = re.sub(r"(?<![<>!=])=(?!=)", "==", expression.replace("^", "**"))
        names = {name: UNKNOWN for name in re.findall(r"\benergy\d*\b", code)}
        try:
            return eval(code, {"__builtins__": {}}, {**self.scope, **self.values, **names})
        except ZeroDivisionError:
            return UNKNOWN
