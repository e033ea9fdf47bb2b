"""A time step as data: operations one after another, each over a fraction of the step.

Steppers and thermostats say what a step is made of by the tuple that `operations` returns. Who makes it has a method
for each verb: `kcons.steppers.interpreter` runs operations on arrays, and `kcons.openmm` writes programs of OpenMM from
them. Time passes in the drifts, so that forces and constraints that depend on it are taken at the time of each drift's
end, also where a drift goes back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar


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
