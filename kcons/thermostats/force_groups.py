"""Several time steps on constraints: forces in groups, and the operations of a step.

The slowest group kicks at the ends of the step, and between its kicks the next one makes its steps, and so on
(Tuckerman, Berne and Martyna, J. Chem. Phys. 97, 1990 (1992)). The innermost group moves the atoms, with the heat bath
in the middle of its steps. The same chain of operations may begin half a step later, so that slow forces kick in the
middle of a step, and states are those halfway between two kicks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import as_float_array, check_call, read_only_view, whole_number
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import State, System
from kcons.steppers.compiled_operations import check_finite
from kcons.steppers.operations import Evaluate, Exchange, Fly, Kick, Operation, Project, Turn, drifts_of

ForceFunction = Callable[[FloatArray, float], ArrayLike]


class ForceGroups:
    """Applied forces as a sum of groups. It is the force function of a `System`: called, it gives the sum.

    Parameters
    ----------
    groups : mapping of str to callable
        Forces ``force(x, t)``, shape (n_atoms, 3), by name.

    Attributes
    ----------
    evaluations : dict of str to int
        How often each group was asked for.

    Raises
    ------
    InputError
        No groups; a name that is no text; one function in two groups, whose forces would count twice.
    """

    def __init__(self, groups: Mapping[str, ForceFunction]) -> None:
        if not isinstance(groups, Mapping) or not groups:
            raise InputError("there are no groups of forces; give a mapping of names to functions", item="groups")
        for name, force in groups.items():
            if not isinstance(name, str) or not name:
                raise InputError(f"a group of forces is called {name!r}; give it a name, a text", item="groups")
            if force is None:
                raise InputError(f"the force of group {name!r} is None; give a function of x, t", item=name)
            check_call(f"the force of group {name!r}", force, ("x", "t"))
            # By value: a method is another object each time it is looked up.
            other = next(other for other in groups if groups[other] == force)
            if other != name:
                raise InputError(
                    f"groups {other!r} and {name!r} overlap: both are {force!r}, whose forces would count "
                    "twice. Put it into one of them",
                    item=name,
                )
        self.groups: dict[str, ForceFunction] = dict(groups)
        self.evaluations = dict.fromkeys(self.groups, 0)

    @classmethod
    def difference(cls, cheap: ForceFunction, expensive: ForceFunction) -> ForceGroups:
        """`cheap` forces as the group 'fast', `expensive` less `cheap` ones as 'slow': `expensive` in all.

        Raises
        ------
        InputError
            Both are the same function.
        """
        if cheap == expensive:
            raise InputError(
                "cheap and expensive forces are the same function; nothing is left to be slow", item="slow"
            )
        return cls({"fast": cheap, "slow": _difference(cheap, expensive)})

    def __repr__(self) -> str:
        return f"ForceGroups({', '.join(self.groups)})"

    def __call__(self, x: FloatArray, time: float) -> FloatArray:
        """The sum over all groups."""
        first, *others = [np.array(self.of(name, x, time)) for name in self.groups]  # functions may share an array
        for f in others:
            first += f
        return first

    def of(self, name: str, x: FloatArray, time: float) -> FloatArray:
        """Forces of one group."""
        f = as_float_array(self.groups[name](x, time), f"forces of group {name!r}")
        self.evaluations[name] += 1
        if f.shape != x.shape:
            raise InputError(
                f"group {name!r} gives forces of shape {f.shape}; give a function of these atoms, {x.shape}",
                item=name,
            )
        return f


def _difference(cheap: ForceFunction, expensive: ForceFunction) -> ForceFunction:
    """Expensive forces less cheap ones at the same place."""

    def force(x: FloatArray, time: float) -> FloatArray:
        # A function may use its array again, also where both share it.
        less = np.array(as_float_array(cheap(x, time), "cheap forces"))
        whole = as_float_array(expensive(x, time), "expensive forces")
        if less.shape != whole.shape:
            raise InputError(
                f"cheap forces have shape {less.shape}, expensive ones {whole.shape}: they are of different systems, "
                "and their difference is none",
                item="forces",
            )
        return whole - less

    return force


def group_names(force: object, names: tuple[str, ...]) -> None:
    """Refuse forces that are in no groups (`UnsupportedError`), or not in those that a stepper has steps for."""
    if names == ("",):
        return
    if not isinstance(force, ForceGroups):
        raise UnsupportedError(
            f"the System has no groups of forces, and {', '.join(names)} were given steps; make it with "
            "System(motion, ForceGroups({...}))"
        )
    if set(names) != set(force.groups):
        raise InputError(
            f"steps are given to {', '.join(names)}; give them to the groups of the forces: {', '.join(force.groups)}",
            item="steps",
        )


class GroupedForces:
    """Forces that were last evaluated, by the names of their groups; one empty name where they come in no groups.

    Where the slowest group, the first, kicks in the middle of steps, each step begins with an evaluation of the others.
    `left` is what a bath remembers of the steps before: where they ended, and their forces.
    """

    def __init__(
        self,
        system: System,
        state: State,
        names: tuple[str, ...],
        middle: bool = False,
        left: tuple[FloatArray, GroupedForces] | None = None,
    ) -> None:
        self.system, self.names, self.middle = system, names, middle
        self.now: dict[str, FloatArray] = {}
        x, _, forces = system.kernel_arrays(state)
        if forces is not None and not middle:
            if len(names) == 1:
                self.now[names[0]] = forces
            elif left is not None and left[0] is state.positions and left[1].system is system:
                self.now.update(left[1].now)
        for group in names[1:] if middle else names:
            if group not in self.now:
                self.evaluate(group, x, state.time, state.step)

    def evaluate(self, name: str, x: FloatArray, time: float, step: int) -> None:
        """Forces of one group at positions as the force function sees them; errors have the number of the step."""
        system = self.system
        force = system.force
        if not name or not isinstance(force, ForceGroups):
            self.now[name] = system.forces(x, x, time, step)
            return
        f = system.accepted(force.of(name, read_only_view(x), time), step, True)
        check_finite(f, "force", step)
        self.now[name] = f

    def stacked(self) -> FloatArray:
        """Those of all groups one after another, shape (n_groups n_atoms, 3)."""
        if len(self.names) == 1:
            return self.now[self.names[0]]
        none = np.zeros((self.system.n_atoms, 3))
        return np.concatenate([self.now.get(name, none) for name in self.names])

    def total(self) -> FloatArray | None:
        """Their sum, None where the slowest ones are those of another place."""
        if self.middle:
            return None
        first, *others = (self.now[name] for name in self.names)
        return first if not others else first + sum(others[1:], start=others[0])


#: Where the slowest forces kick: half at each end of the step, or once in its middle.
SlowKicks = Literal["ends", "middle"]


class Level(NamedTuple):
    """A group of forces, and its steps in one step of the whole."""

    group: str
    steps: int


def levels_of(steps: Mapping[str, int] | None) -> tuple[Level, ...]:
    """Groups from the slowest to the fastest; None for all forces at once.

    Refused are numbers of steps of which one does not divide the next, or of which the least is not 1.
    """
    if steps is None:
        return (Level("", 1),)
    if not isinstance(steps, Mapping) or not steps:
        raise InputError("steps must name each group of forces, as {'slow': 1, 'fast': 4}", item="steps")
    counts = [whole_number(count, "steps") for count in steps.values()]
    levels = sorted(map(Level, steps, counts), key=lambda level: level.steps)
    if levels[0].steps != 1 or any(b.steps == a.steps or b.steps % a.steps for a, b in pairwise(levels)):
        raise InputError(
            f"one of the steps {dict(steps)} does not divide the next: give 1 to the slowest group, and to each other "
            "one a multiple of the number before; groups of the same number are one group",
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
    flight: tuple[float, ...],
    *,
    turns: bool = False,
    exact: bool = False,
    middle: bool = False,
) -> tuple[Operation, ...]:
    """The operations of a step of these groups.

    `flight` is what each drift is made of, as fractions that add up to 1. With `turns`, kicks are on spheres, before
    which velocities are put onto the constraints; `exact` drifts fly along great circles; in the `middle`, the slowest
    group kicks once.
    """
    inner = levels[-1].steps
    flights = iter(drifts_of([0.5 / inner] * (2 * inner), flight, exact=exact))
    if middle:
        group, count = levels[0].group, levels[1].steps
        done: list[Operation] = []
        for number in range(count):
            if 2 * number == count:
                done += [Evaluate(group), (Turn if turns else Kick)(1.0, group)]
            done += _level(levels, 1, flights, turns)
    else:
        done = list(_level(levels, 0, flights, turns))
    if not turns:
        done.append(Project())
    return tuple(done)


def _level(levels: tuple[Level, ...], at: int, flights: Iterator[Fly], turns: bool) -> Iterator[Operation]:
    """A step of one group, with those of the faster ones in it."""
    group, length = levels[at].group, 1.0 / levels[at].steps
    kick = (Turn if turns else Kick)(0.5 * length, group)
    settled = (Project(),) if turns else ()
    yield kick
    if at + 1 < len(levels):
        for _ in range(levels[at + 1].steps // levels[at].steps):
            yield from _level(levels, at + 1, flights, turns)
    else:
        yield from (next(flights), *settled, Exchange(length), next(flights), *settled)
    yield from (Evaluate(group), kick)
