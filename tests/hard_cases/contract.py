"""The contract of a program: it runs a `Problem` and shows every frame to a watcher."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from hard_cases.problem import Array, Problem
from kcons.comparison.runs import InAse, InOpenMM, OnArrays, Run
from kcons.steppers import Stepper


class CannotExpressError(Exception):
    """The program has no means to state the problem; the message says which are missing."""


@dataclass(frozen=True)
class Frame:
    """What is seen of a run: positions, velocities, energies; NaN where a program does not tell."""

    x: Array
    v: Array
    kinetic: float
    potential: float

    @property
    def energy(self) -> float:
        return self.kinetic + self.potential


Watch = Callable[[Frame], Any]


def together(*watches: Watch) -> Watch:
    """A watcher that tells several."""

    def watch(frame: Frame) -> None:
        for one in watches:
            one(frame)

    return watch


class NotIntactError(AssertionError):
    """A call that failed has changed its input."""


class Course(NamedTuple):
    """How a run is made, see `Program.run`."""

    dt: float
    steps: int
    project: bool = False
    stepper: Stepper | None = None


class Program:
    """Something that can run a problem; its name is one of `SYSTEMS`."""

    name = ""
    #: How long runs may be, as a part of what a case asks for.
    pace = 1.0

    def length(self, quick: bool, short: int, full: int) -> int:
        """Steps to run: `short` for a quick look, else `full`; fewer for slow programs."""
        return max(10, round(self.pace * (short if quick else full)))

    def run(
        self,
        problem: Problem,
        dt: float,
        steps: int,
        watch: Watch | None = None,
        *,
        every: int = 1,
        project: bool = False,
        wrap: bool = False,
        stepper: Stepper | None = None,
    ) -> Frame:
        """Run and return the last frame; `watch` sees the start and every `every` steps.

        `project` brings the start onto the constraints by the means the program offers for it, `wrap` puts atoms back
        into the cell after each step, `stepper` is for the core only.
        """
        run = self.begin(problem, Course(dt, steps, project, stepper))

        def frame() -> Frame:
            x, v = run.observe()
            return Frame(x, v, self.kinetic(problem, run, v), problem.potential(x))

        if watch:
            watch(frame())
        done = 0
        while done < steps:
            block = 1 if wrap else min(every, steps - done)
            run.advance(block)
            done += block
            if wrap:
                put(run, wrapped(run.observe()[0], problem.cell))
            if watch and done % every == 0:
                watch(seen := frame())
                if not np.all(np.isfinite(seen.x)):
                    return seen
        return frame()

    def begin(self, problem: Problem, course: Course) -> Run:
        """The engine, at the start."""
        raise NotImplementedError

    def kinetic(self, problem: Problem, run: Any, v: Array) -> float:
        """Kinetic energy of a run, at velocities v."""
        return problem.kinetic(v)

    def degrees_of_freedom(self, problem: Problem) -> int:
        """As the program counts them."""
        raise NotImplementedError


def wrapped(x: Array, cell: Any) -> Array:
    """Atoms put into the cell one by one; those inside are not touched."""
    lattice = np.asarray(cell, dtype=float)
    return np.asarray(x - np.floor(x @ np.linalg.inv(lattice)) @ lattice)


def put(run: Run, x: Array) -> None:
    """Other positions, such as those wrapped into a cell, and the velocities as they are."""
    if isinstance(run, OnArrays):
        run.state = replace(run.state, positions=x)
    elif isinstance(run, InAse):  # as atoms.wrap() does it: not through the constraints
        run.atoms.arrays["positions"][:] = x
    elif isinstance(run, InOpenMM):
        run.context.setPositions(x * run.length)
    else:
        raise TypeError(type(run).__name__)
