"""Operations of a step as the program that the interpreter goes through.

What a row does is decided here, once for a list of operations: kicks are taken by what follows them, in the same pass
over the arrays, and drifts are cut into flights, which end by turns in two arrays, so that the positions that forces
are evaluated at are in an array of their own, which is never written to again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import takewhile
from typing import Any, NamedTuple

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.solvers.addressable_solvers import address_of
from kcons.steppers import compiled_operations as kernel
from kcons.steppers.operations import Fly, Kick, Operation

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
