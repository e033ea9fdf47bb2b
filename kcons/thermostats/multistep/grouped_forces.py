"""The forces of each group on the way through a step, and in the state that it ends in."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from kcons.constraints.arguments import read_only_view
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.steppers import State, System
from kcons.steppers.stages.compiled_operations import check_finite
from kcons.thermostats.freedom import carried
from kcons.thermostats.multistep.force_groups import ForceGroups

#: Difference of the forces of a state from the sum of those of its groups, relative to these, that is their rounding.
SAME = 1e-12


@dataclass
class GroupedForces:
    """Forces by the names of their groups.

    A state carries them, if there are two or more, in the order of their names behind the variables of its thermostat
    and a number that stands for the names, so that a run that is continued evaluates nothing anew. Where the slowest
    group, the first, kicks in the middle of steps it carries none, and each step begins with an evaluation of the
    others.

    Attributes
    ----------
    system : System
    names : tuple of str
        One empty name where forces come in no groups.
    now : dict of str to ndarray, shape (n_atoms, 3)
        Those last evaluated.
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
        """Forces at a state, evaluated where it has none, and the variables of its thermostat (see `carried`).

        Raises
        ------
        InputError
            The state carries variables of another thermostat, or forces of groups of other names.
        """
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
        """Forces of one group at positions as the force function sees them.

        Raises
        ------
        NonFiniteError, InputError
            With the number of the step.
        """
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
