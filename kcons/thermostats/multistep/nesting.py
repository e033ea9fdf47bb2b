"""The operations of a step with several time steps, one inside the other.

The slowest group kicks at the ends of the step, and between its kicks the next one makes its steps, and so on
(Tuckerman, Berne and Martyna, J. Chem. Phys. 97, 1990 (1992)). The innermost group moves the atoms, by a symmetric
scheme of order 2 or 4, with the heat bath in its middle. The same chain of operations may begin half a step later, so
that slow forces kick in the middle of a step, and states are those halfway between two kicks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from kcons.constraints.arguments import checked, whole_number
from kcons.errors import InputError
from kcons.steppers.operations import Evaluate, Exchange, Fly, Kick, Operation, Project, Turn, drifts_of
from kcons.steppers.splitting import SUZUKI_4
from kcons.thermostats.isokinetic.isokinetic import SCHEMES

#: Where the slowest forces kick: half at each end of the step, or once in its middle.
SlowKicks = Literal["ends", "middle"]
InnerOrder = Literal[2, 4]


@dataclass(frozen=True)
class Level:
    """A group of forces, and its steps in one step of the whole."""

    group: str
    steps: int


def levels_of(steps: Mapping[str, int] | None) -> tuple[Level, ...]:
    """Groups from the slowest to the fastest; None for all forces at once.

    Raises
    ------
    InputError
        Numbers of steps of which one does not divide the next, or of which the least is not 1.
    """
    if steps is None:
        return (Level("", 1),)
    if not isinstance(steps, Mapping) or not steps:
        raise InputError("steps must name each group of forces, as {'slow': 1, 'fast': 4}", item="steps")
    counts: list[int] = []
    for name, count in steps.items():
        try:
            counts.append(whole_number(count, "steps"))
        except InputError:
            raise InputError(
                f"group {name!r} takes {count!r} steps; give a whole number, 1 or more", item="steps"
            ) from None
    levels = sorted(map(Level, steps, counts), key=lambda level: level.steps)
    if levels[0].steps != 1:
        raise InputError(
            f"group {levels[0].group!r}, the slowest, takes {levels[0].steps} steps; it takes 1, the step itself",
            item="steps",
        )
    for outer, inner in pairwise(levels):
        if outer.steps == inner.steps:
            raise InputError(
                f"groups {outer.group!r} and {inner.group!r} both take {inner.steps} steps; add their forces to one",
                item="steps",
            )
        if inner.steps % outer.steps:
            raise InputError(
                f"the step of group {inner.group!r} does not divide that of {outer.group!r}: {inner.steps} steps are "
                f"no multiple of {outer.steps}",
                item="steps",
            )
    return tuple(levels)


def middle_of(levels: tuple[Level, ...], slow_kicks: SlowKicks) -> bool:
    """Whether the slowest group kicks in the middle of the step; `InputError` where that has none."""
    if slow_kicks == "ends":
        return False
    if len(levels) == 1:
        raise InputError("all forces are one group: there are no slow kicks in the middle", item="slow_kicks")
    if levels[1].steps % 2:
        raise InputError(
            f"group {levels[1].group!r} takes {levels[1].steps} steps, between which there is no middle for slow "
            "kicks; give an even number",
            item="slow_kicks",
        )
    return True


def nested(
    levels: tuple[Level, ...],
    order: int,
    flight: tuple[float, ...],
    *,
    turns: bool = False,
    exact: bool = False,
    middle: bool = False,
) -> tuple[Operation, ...]:
    """The operations of a step.

    Parameters
    ----------
    levels, order
        The groups, and the order of the innermost scheme.
    flight : tuple of float
        What each drift is made of, as fractions that add up to 1.
    turns : bool
        Kicks on spheres, before which velocities are put onto the constraints.
    exact : bool
        Fly along great circles.
    middle : bool
        The slowest group kicks once, in the middle.
    """
    kicks, drifts, _ = SCHEMES[order]
    inner, odd = levels[-1].steps, len(drifts) % 2 == 1
    halves = [d for k, d in enumerate(drifts) for d in ([d / 2] * 2 if odd and k == len(drifts) // 2 else [d])]
    flights = iter(drifts_of([d / inner for _ in range(inner) for d in halves], flight, exact=exact))
    if middle:
        group, count = levels[0].group, levels[1].steps
        done: list[Operation] = []
        for number in range(count):
            if 2 * number == count:
                done += [Evaluate(group), (Turn if turns else Kick)(1.0, group)]
            done += _level(levels, 1, kicks, drifts, flights, turns)
    else:
        done = list(_level(levels, 0, kicks, drifts, flights, turns))
    if not turns:
        done.append(Project())
    return tuple(done)


class Nesting:
    """Steps of all groups of forces, from the arguments of a stepper with several time steps.

    Attributes
    ----------
    names : tuple of str
        Groups from the slowest to the fastest.
    middle : bool
        Whether the slowest kicks in the middle.
    in_flights, on_circles : tuple of Operation
        A step, and one whose flights are great circles.
    evaluations : int
        Of forces in a step, those of all groups.
    words : list of str
        Steps, and what else is not as by default, as arguments.
    """

    @checked
    def __init__(
        self,
        steps: Mapping[str, int] | None,
        order: InnerOrder,
        substeps: int,
        slow_kicks: SlowKicks,
        turns: bool = False,
    ) -> None:
        levels = levels_of(steps)
        flight = (1.0 / substeps,) * substeps if order == 2 else SUZUKI_4
        self.names = tuple(level.group for level in levels)
        self.middle = middle_of(levels, slow_kicks)
        self.in_flights = nested(levels, order, flight, turns=turns, middle=self.middle)
        self.on_circles = nested(levels, order, (1.0,), turns=turns, exact=True, middle=self.middle)
        self.evaluations = sum(isinstance(operation, Evaluate) for operation in self.in_flights)
        counts = {level.group: level.steps for level in levels}
        self.words = ["" if steps is None else f", steps={counts}", "" if order == 2 else f", order={order}"]
        self.words[1] += ", slow_kicks='middle'" if self.middle else ""


def _level(
    levels: tuple[Level, ...],
    at: int,
    kicks: tuple[float, ...],
    drifts: tuple[float, ...],
    flights: Iterator[Fly],
    turns: bool,
) -> Iterator[Operation]:
    """A step of one group, with those of the faster ones in it."""

    def drift() -> Iterator[Operation]:
        yield next(flights)
        if turns:
            yield Project()

    push = Turn if turns else Kick
    group, length = levels[at].group, 1.0 / levels[at].steps
    if at + 1 < len(levels):
        yield push(0.5 * length, group)
        for _ in range(levels[at + 1].steps // levels[at].steps):
            yield from _level(levels, at + 1, kicks, drifts, flights, turns)
        yield Evaluate(group)
        yield push(0.5 * length, group)
        return
    center = len(drifts) // 2
    odd = len(drifts) % 2 == 1
    for k, fraction in enumerate(kicks):
        if not odd and k == center:
            yield from (push(0.5 * fraction * length, group), Exchange(length), push(0.5 * fraction * length, group))
        else:
            yield push(fraction * length, group)
        if k < len(drifts):
            yield from drift()
            if odd and k == center:
                yield Exchange(length)
                yield from drift()
            yield Evaluate(group)
