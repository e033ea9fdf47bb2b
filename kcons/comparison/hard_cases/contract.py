"""What a program is: it takes a `Problem` and is watched on its way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from kcons.comparison.hard_cases.problem import Array, Problem
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

    every: int
    project: bool
    wrap: bool
    stepper: Stepper | None


class Program:
    """Something that can run a problem.

    Attributes
    ----------
    name : str
        As in `SYSTEMS`.
    """

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
        """Run and return the last frame.

        Parameters
        ----------
        problem : Problem
        dt, steps
        watch : callable, optional
            Sees the start and every `every` steps.
        project : bool
            Whether to bring the start onto the constraints by the means the program offers for it.
        wrap : bool
            Whether to put atoms back into the cell after each step.
        stepper : Stepper, optional
            For the core only.
        """
        return self.go(problem, dt, steps, watch, Course(every, project, wrap, stepper))

    def go(self, problem: Problem, dt: float, steps: int, watch: Watch | None, course: Course) -> Frame:
        """What `run` does."""
        raise NotImplementedError

    def degrees_of_freedom(self, problem: Problem) -> int:
        """As the program counts them."""
        raise NotImplementedError
