"""Several time steps on constraints: forces in groups, the operations of a step, Langevin dynamics made of them.

The slowest group kicks at the ends of the step, and between its kicks the next one makes its steps, and so on
(Tuckerman, Berne and Martyna, J. Chem. Phys. 97, 1990 (1992)). The innermost group moves the atoms, with the heat bath
in the middle of its steps. The same chain of operations may begin half a step later, so that slow forces kick in the
middle of a step, and states are those halfway between two kicks.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import Rng, as_float_array, check_call, checked, read_only_view, whole_number
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import State, System
from kcons.steppers.interpreter import Interpreter
from kcons.steppers.operations import Evaluate, Exchange, Fly, Kick, Operation, Project, Turn, drifts_of
from kcons.steppers.program import Row
from kcons.steppers.stages.compiled_operations import check_finite
from kcons.thermostats.freedom import carried
from kcons.thermostats.langevin import Langevin, LangevinStep, listed_and_made

ForceFunction = Callable[[FloatArray, float], ArrayLike]

#: Forces of a state that differ from the sum of its groups by at most this fraction are taken for the same.
SAME = 1e-12


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
        total: FloatArray | None = None
        for name in self.groups:
            f = self.of(name, x, time)
            if total is None:
                total = np.array(f)
            elif f.shape != total.shape:
                raise InputError(
                    f"group {name!r} gives forces of shape {f.shape}, the groups before it {total.shape}: they are of "
                    "different systems",
                    item=name,
                )
            else:
                total += f
        assert total is not None
        return total

    def of(self, name: str, x: FloatArray, time: float) -> FloatArray:
        """Forces of one group."""
        f = as_float_array(self.groups[name](x, time), f"forces of group {name!r}")
        self.evaluations[name] += 1
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
    for name in names:
        if name not in force.groups:
            raise InputError(f"there is no group {name!r} of forces; there are {', '.join(force.groups)}", item="steps")
    for name in force.groups:
        if name not in names:
            raise InputError(f"group {name!r} of the forces has no number of steps; add it to steps", item="steps")


@dataclass
class GroupedForces:
    """Forces that were last evaluated, by the names of their groups; one empty name where they come in no groups.

    A state carries them, if there are two or more, in the order of their names behind the variables of its thermostat
    and a number that stands for the names, so that a run that is continued evaluates nothing anew. Where the slowest
    group, the first, kicks in the middle of steps it carries none, and each step begins with an evaluation of the
    others.
    """

    system: System
    names: tuple[str, ...]
    now: dict[str, FloatArray]
    middle: bool = False

    @classmethod
    def of(
        cls,
        system: System,
        state: State,
        names: tuple[str, ...],
        variables: int,
        name: str,
        *,
        marked: bool = False,
        middle: bool = False,
    ) -> tuple[GroupedForces, FloatArray | None]:
        """Forces at a state, evaluated where it has none, and the variables of its thermostat (see `carried`)."""
        size = 3 * system.n_atoms
        stored = len(names) * size + 1 if len(names) > 1 and not middle else 0
        known = carried(state, variables + stored, name, marked=marked)
        x, _, forces = system.kernel_arrays(state)
        found = cls(system, names, {}, middle)
        if forces is not None and not stored and not middle:
            found.now[names[0]] = forces
        elif forces is not None and known and stored:
            assert state.thermostat is not None
            if state.thermostat[variables] != _number_of(names):
                raise InputError(
                    f"the state carries forces of groups of other names than {', '.join(names)}; name the groups as "
                    "they were, or begin from its positions and velocities: State(state.positions, state.velocities)",
                    item="groups",
                )
            parts = state.thermostat[variables + 1 :].reshape(len(names), *x.shape)
            found.now.update(zip(sorted(names), parts, strict=True))
            # Positions and their forces may have been put together with variables of another place.
            if not np.all(np.abs(parts.sum(axis=0) - forces) <= SAME * np.abs(parts).max()):
                found.now.clear()
        for group in names[1:] if middle else names:
            if group not in found.now:
                found.evaluate(group, x, state.time, state.step)
        return found, None if state.thermostat is None else state.thermostat[:variables]

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

    def closed(self, variables: FloatArray) -> FloatArray:
        """What a state carries: the variables of the thermostat, and forces."""
        if len(self.names) == 1 or self.middle:
            return variables
        forces = [self.now[name].ravel() for name in sorted(self.names)]
        return np.concatenate([variables, [_number_of(self.names)], *forces])


def _number_of(names: tuple[str, ...]) -> float:
    return float(zlib.crc32("\n".join(sorted(names)).encode()))


#: Where the slowest forces kick: half at each end of the step, or once in its middle.
SlowKicks = Literal["ends", "middle"]


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
    flight: tuple[float, ...],
    *,
    turns: bool = False,
    exact: bool = False,
    middle: bool = False,
) -> tuple[Operation, ...]:
    """The operations of a step.

    Parameters
    ----------
    levels
        The groups.
    flight : tuple of float
        What each drift is made of, as fractions that add up to 1.
    turns : bool
        Kicks on spheres, before which velocities are put onto the constraints.
    exact : bool
        Fly along great circles.
    middle : bool
        The slowest group kicks once, in the middle.
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
    words : tuple of str
        Steps, and where slow forces kick, as arguments where these are not the defaults.
    """

    @checked
    def __init__(
        self,
        steps: Mapping[str, int] | None,
        substeps: int,
        slow_kicks: SlowKicks,
        turns: bool = False,
    ) -> None:
        levels = levels_of(steps)
        self.names = tuple(level.group for level in levels)
        self.middle = middle_of(levels, slow_kicks)
        self.in_flights = nested(levels, (1.0 / substeps,) * substeps, turns=turns, middle=self.middle)
        self.on_circles = nested(levels, (1.0,), turns=turns, exact=True, middle=self.middle)
        self.evaluations = sum(isinstance(operation, Evaluate) for operation in self.in_flights)
        counts = {level.group: level.steps for level in levels}
        self.words = "" if steps is None else f", steps={counts}", ", slow_kicks='middle'" if self.middle else ""


class LangevinRespa(Langevin):
    """Langevin dynamics on constraints with several time steps: kicks of slow forces about steps of fast ones.

    Each group of forces kicks at the ends of its own step, and the fastest one moves the atoms by geodesic BAOAB, with
    friction and noise in the middle of each of its steps. Slow forces in steps of half a period of the fastest motion,
    or of its multiples, drive it (resonance), by the share of its stiffness that they have (`slow_share`): with bonds
    to hydrogen or whole molecules held and near pairs as fast forces, 8 to 16 fs are safe. `IsokineticSpheres` takes
    longer steps.

    Parameters
    ----------
    thermal_energy : float
        k_B T in the units of energy in use.
    friction : float
        gamma, in inverse units of time; 0 for constant energy.
    rng : int, numpy.random.Generator or None
        As for `Langevin`.
    steps : mapping of str to int, optional
        Steps of each group of forces in one step, ``{"slow": 1, "medium": 4, "fast": 12}``; each divides the next. The
        System has the forces, as `ForceGroups`. Without it all forces are one group.
    substeps : int
        RATTLE substeps in each drift.
    slow_kicks : {'ends', 'middle'}
        Where the slowest forces kick: half at each end of the step, or once in its middle. States halfway between two
        slow kicks are nearer to the canonical distribution than those at the kicks; they know no slow forces, so that
        each energy that is read costs an evaluation, and the other groups are evaluated once more a step.

    Raises
    ------
    InputError
        As for `Langevin`; numbers of steps that do not divide each other.

    Notes
    -----
    `State.thermostat` holds the heat, as for `Langevin`, and the forces of the groups.

    References
    ----------
    Tuckerman, Berne and Martyna, J. Chem. Phys. 97, 1990 (1992); Leimkuhler and Matthews, Proc. R. Soc. A 472, 20160138
    (2016).
    """

    def __init__(
        self,
        thermal_energy: float,
        friction: float,
        rng: Rng,
        *,
        steps: Mapping[str, int] | None = None,
        substeps: int = 3,
        slow_kicks: SlowKicks = "ends",
    ) -> None:
        super().__init__(thermal_energy, friction, rng, substeps=substeps)
        self.nesting = Nesting(steps, self.substeps, slow_kicks)
        both = self.nesting.in_flights, self.nesting.on_circles
        self._in_flights, self._great_circles = (listed_and_made(each, self.nesting.names) for each in both)
        self.force_evaluations = self.nesting.evaluations

    def __repr__(self) -> str:
        given = "".join(self.nesting.words)
        return f"LangevinRespa({self.thermal_energy!r}, {self.friction!r}, rng={self.seed}{given})"

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` or `InputError` where the groups of forces are not those that have steps, too."""
        super().check(system)
        group_names(system.force, self.nesting.names)

    def depends_on(self, system: System, state: State) -> Any:
        # Where slow forces kick in the middle, each step begins with an evaluation of the others.
        return None if self.nesting.middle else super().depends_on(system, state)

    def begun(self, system: System, state: State, dt: float, steps: int) -> Interpreter:
        self.refuse_back(system, dt)
        return RespaStep(system, state, dt, self, steps)


class RespaStep(LangevinStep):
    """Steps on their way."""

    simple = False

    def __init__(self, system: System, start: State, dt: float, thermostat: LangevinRespa, steps: int) -> None:
        nesting = thermostat.nesting
        self.groups, _ = GroupedForces.of(system, start, nesting.names, 1, "LangevinRespa", middle=nesting.middle)
        super().__init__(system, start, dt, thermostat, 1 if nesting.middle else steps)
        self.forces = self.groups.stacked()

    def evaluate(self, row: Row, begun: bool) -> None:
        assert isinstance(row.operation, Evaluate)
        self.show(row)
        self.groups.evaluate(row.operation.group, self.whole(self.x), self.at(row.end), self.number)
        self.forces = self.groups.stacked()

    def applied(self, here: int) -> FloatArray | None:
        return self.groups.total()

    def variables(self) -> FloatArray:
        return self.groups.closed(super().variables())
