"""A time step as data: operations one after another, each over a fraction of the step.

Steppers and thermostats say what a step is made of by the tuple that `operations` returns. Who makes it has a method
for each verb: `kcons.steppers.interpreter` runs operations on arrays, and `kcons.openmm` writes programs of OpenMM from
them. Time passes in the drifts, so that forces and constraints that depend on it are taken at the time of each drift's
end, also where a drift goes back.

`Program` has operations as the interpreter goes through them. What a row of it does is decided once: kicks are taken by
what follows them, in the same pass over the arrays, and drifts are cut into flights, which end by turns in two arrays,
so that the positions that forces are evaluated at are in an array of their own, which is never written to again.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Any, ClassVar, NamedTuple

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.solvers.addressable_solvers import address_of
from kcons.steppers import compiled_operations as kernel


@dataclass(frozen=True)
class Operation:
    """One of the things that a step consists of.

    Attributes
    ----------
    verb : str
        Name of the method that makes it.
    meaning : str
        What it does, in words.
    fraction : float
        The share of the step that it is over; 0 where it takes no time.
    group : str
        Whose forces it takes, where they come in groups (`kcons.thermostats.ForceGroups`); empty for all.
    """

    verb: ClassVar[str]
    meaning: ClassVar[str]
    fraction: ClassVar[float] = 0.0
    group: ClassVar[str] = ""

    def __str__(self) -> str:
        share = f"{self.fraction:.8g}" if isinstance(self, Timed) else ""
        return f"{self.verb:<9} {share:<13} {self.meaning}" + (f": {self.group}" if self.group else "")


@dataclass(frozen=True)
class Timed(Operation):
    """An operation over a fraction of the step."""

    fraction: float = field()  # type: ignore[misc]


@dataclass(frozen=True)
class Kick(Timed):
    """v changes by h M^-1 f, with the forces last evaluated."""

    verb, meaning = "kick", "change velocities by forces"
    group: str = ""  # type: ignore[misc]


class Settle(Timed):
    """v = P(v + h M^-1 f(x, v)), solved for v: the adjoint of a kick with forces that depend on velocities."""

    verb, meaning = "settle", "change velocities by the forces at the new velocities, by iteration, on the constraints"


@dataclass(frozen=True)
class Turn(Timed):
    """The isokinetic kick: v turns towards M_par^+ f and keeps its length (`kcons.thermostats.isokinetic`)."""

    verb, meaning = "turn", "change velocities by forces at constant kinetic energy"
    group: str = ""  # type: ignore[misc]


class Exchange(Timed):
    """Friction and noise of Langevin dynamics at fixed positions, along the constraints."""

    verb, meaning = "exchange", "let the heat bath act on velocities along the constraints"


class Chain(Timed):
    """A Nose-Hoover chain moves on, and scales the velocities."""

    verb, meaning = "chain", "move the Nose-Hoover chain, which scales velocities"


@dataclass(frozen=True)
class Fly(Timed):
    """A drift: free flight along the constraints.

    Attributes
    ----------
    flights : tuple of float
        The RATTLE drifts that it consists of, as fractions of the step.
    ends : tuple of float
        The fractions of the step at which they end.
    exact : bool
        Whether they follow great circles.
    """

    verb = "fly"
    flights: tuple[float, ...]
    ends: tuple[float, ...]
    exact: bool = False

    @property
    def meaning(self) -> str:  # type: ignore[override]
        """In words."""
        way = "along great circles" if self.exact else "along the constraints"
        return way if len(self.flights) == 1 else f"{way}, in {len(self.flights)} flights"


@dataclass(frozen=True)
class Evaluate(Operation):
    """Forces at the positions and the time that the step has come to."""

    verb, meaning = "evaluate", "forces at the new positions"
    group: str = ""  # type: ignore[misc]


class Project(Operation):
    """v becomes tangent to the constraints."""

    verb, meaning = "project", "velocities onto the constraints"


# -- lists ------------------------------------------------------------------------------------------


def mirrored(half: Sequence[float], middles: int = 1) -> tuple[float, ...]:
    """The first fractions, one or two equal ones in the middle that make the sum 1, and their mirror image."""
    middle = math.fsum([1.0 / middles, *((-2.0 / middles) * a for a in half)])
    return (*half, *[middle] * middles, *reversed(half))


def drifts_of(fractions: Sequence[float], flight: Sequence[float] = (1.0,), *, exact: bool = False) -> tuple[Fly, ...]:
    """Drifts over the fractions, each of them a composition of flights, which together take the whole step."""
    flat = [a * w for a in fractions for w in flight]
    nodes = [math.fsum(flat[:k]) for k in range(1, len(flat))] + [1.0]
    n = len(flight)
    return tuple(
        Fly(a, tuple(flat[k : k + n]), tuple(nodes[k : k + n]), exact)
        for a, k in zip(fractions, range(0, len(flat), n), strict=True)
    )


def splitting(
    kicks: tuple[float, ...],
    drifts: tuple[float, ...],
    flight: tuple[float, ...] = (1.0,),
    *,
    exact: bool = False,
    settled: bool = False,
) -> tuple[Operation, ...]:
    """Kicks and drifts in turn, with the longer of both first and last.

    Parameters
    ----------
    kicks, drifts, flight : tuple of float
        See `kcons.steppers.Splitting`.
    exact : bool
        Fly along great circles.
    settled : bool
        For forces that depend on velocities: about each drift half a kick, and one that is solved for.
    """
    done: list[Operation] = []
    stages = drifts_of(drifts, flight, exact=exact)
    if settled:
        for fraction, stage in zip(drifts, stages, strict=True):
            done += [Kick(0.5 * fraction), stage, Settle(0.5 * fraction)]
    else:
        first = [Kick(kicks[0])] if len(kicks) > len(drifts) else []
        for fraction, stage in zip(kicks[len(first) :], stages, strict=False):
            done += [stage, Evaluate(), Kick(fraction)]
        done = [*first, *done, *stages[len(kicks) - len(first) :], Project()]
    return tuple(done)


# -- programs ---------------------------------------------------------------------------------------

#: Operations that show positions to a force function, after which they are not written to again.
SHOWN = ("evaluate", "settle")


class Row(NamedTuple):
    """What is done at once."""

    name: str  # the interpreter's method
    verb: int  # what the kernel does
    here: int  # which array has the positions before it
    there: int  # and after it
    length: float  # of the flight, as a fraction of the step
    kick: float  # of the kick before it, likewise
    group: int  # whose forces
    begin: float  # the fractions of the step at which time is before it
    end: float  # and after it
    number: int = 0  # how many of the same name are before it in the step
    operation: Operation | None = None  # what it is made of; None for the end of the step
    function: Any = None  # the compiled function that is called


class Program:
    """A step as rows, the last of which is its end.

    Parameters
    ----------
    operations : sequence of Operation
    functions : mapping of str to compiled function, optional
        What the kernel calls for these verbs; those that it does not know and that are not here are left to Python.
    groups : sequence of str
        Names of the groups of forces, in the order in which the interpreter has them.
    parts : sequence of Operation, optional
        What is run: the operations, with what the program does between them.
    """

    def __init__(
        self,
        operations: Sequence[Operation],
        functions: Mapping[str, Any] | None = None,
        groups: Sequence[str] = ("",),
        parts: Sequence[Operation] | None = None,
    ) -> None:
        self.operations = tuple(operations)
        self.parts = self.operations if parts is None else tuple(parts)
        self.rows = list(_rows(self.parts, functions or {}, {name: k for k, name in enumerate(groups)}))
        flights = [row.operation for row in self.rows if isinstance(row.operation, Fly)]
        #: Whether what rounding takes is kept: there are several flights, or great circles.
        self.pairs = len(flights) > 1 or any(flight.exact for flight in flights)
        self.ends = [row.end for row in self.rows]
        #: Whether rows evaluate forces at positions that no force function has seen, and whether flights follow.
        self.shown = [row.name == "evaluate" and row.here == 1 for row in self.rows]
        self.flies = ["fly" in [later.name for later in self.rows[k:]] for k in range(len(self.rows))]
        self._numbers: FloatArray | None = None

    @property
    def numbers(self) -> FloatArray:
        """What a room begins with, of which the kernel reads the rows."""
        if self._numbers is None:
            begin, lines = np.zeros(kernel.ROOM), np.zeros((len(self.rows), kernel.WIDTH))
            begin[kernel.PAIRS], begin[kernel.ITERATIONS], begin[kernel.COUNT] = self.pairs, -1.0, len(self.rows)
            for line, row in zip(lines, self.rows, strict=True):
                line[: kernel.ADDRESS] = row.verb, row.here, row.there, row.length, row.kick, row.group
                if row.verb in (kernel.CALL, kernel.CIRCLE):
                    kind = kernel.FUNCTION if row.verb == kernel.CALL else kernel.CIRCLES
                    line[kernel.ADDRESS] = address_of(row.function, kind)
            self._numbers = np.append(begin, lines)
        return self._numbers

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_numbers": None}  # addresses are of no use elsewhere


def _rows(operations: Sequence[Operation], functions: Mapping[str, Any], groups: Mapping[str, int]) -> Iterator[Row]:
    kick = Kick(0.0)  # what is still to be taken
    here, time, met = 0, 0.0, Counter[str]()
    for number, operation in enumerate([*operations, None]):
        verb = "end_step" if operation is None else operation.verb
        if kick.fraction and verb not in ("fly", "project"):
            yield Row("kick", kernel.KICK, here, here, 0.0, kick.fraction, groups[kick.group], time, time)
            kick = Kick(0.0)
        if operation is None:
            yield Row("end_step", kernel.END, here, here, 0.0, 0.0, 0, 1.0, 1.0)
        elif isinstance(operation, Kick):
            kick = operation
        elif isinstance(operation, Fly):
            what = kernel.CIRCLE if operation.exact else kernel.FLY
            later = takewhile(lambda other: other.verb not in SHOWN, operations[number:])
            left = sum(len(other.flights) for other in later if isinstance(other, Fly))
            for length, end in zip(operation.flights, operation.ends, strict=True):
                left -= 1
                there, group = 1 + left % 2, groups.get(kick.group, 0)
                passed = length, kick.fraction, group, time, end
                yield Row(verb, what, here, there, *passed, 0, operation, kernel.fly_circles)
                here, time, kick = there, end, Kick(0.0)
        else:
            what = kernel.CALL if verb in functions else kernel.PROJECT if verb == "project" else kernel.PYTHON
            group = groups.get(kick.group if kick.fraction else operation.group, 0)
            times = (operation.fraction, kick.fraction, group, time, time, met[verb])
            yield Row(verb, what, here, here, *times, operation, functions.get(verb))
            met[verb] += 1
            kick, here = Kick(0.0), 0 if verb in SHOWN else here
