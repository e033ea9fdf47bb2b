"""Forces in groups that are asked for at steps of their own, on the way through a step and in states."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import as_float_array, check_call, read_only_view
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import State, System
from kcons.steppers.stages.compiled_operations import check_finite
from kcons.thermostats.freedom import carried

ForceFunction = Callable[[FloatArray, float], ArrayLike]

#: Difference of the forces of a state from the sum of those of its groups, relative to these, that is their rounding.
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
    def difference(
        cls, cheap: ForceFunction, expensive: ForceFunction, *, fast: str = "fast", slow: str = "slow"
    ) -> ForceGroups:
        """`cheap` forces as the fast group, `expensive` less `cheap` ones as the slow group: `expensive` in all.

        Parameters
        ----------
        cheap, expensive : callable
            Of the same atoms.
        fast, slow : str
            Names of the groups.

        Raises
        ------
        InputError
            Both are the same function, or both groups have one name.
        """
        if cheap == expensive:
            raise InputError("cheap and expensive forces are the same function; nothing is left to be slow", item=slow)
        if fast == slow:
            raise InputError(f"fast and slow forces are both called {fast!r}; give them two names", item="slow")
        return cls({fast: cheap, slow: _difference(cheap, expensive)})

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
