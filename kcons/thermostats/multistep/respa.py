"""Langevin dynamics on constraints with several time steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from kcons.constraints.arguments import Rng
from kcons.constraints.target import FloatArray
from kcons.steppers import State, System
from kcons.steppers.interpreter import Interpreter
from kcons.steppers.operations import Evaluate
from kcons.steppers.program import Row
from kcons.thermostats.langevin import Langevin, LangevinStep, listed_and_made
from kcons.thermostats.multistep.force_groups import GroupedForces, group_names
from kcons.thermostats.multistep.nesting import InnerOrder, Nesting, SlowKicks


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
    order : {2, 4}
        Of the innermost scheme, with 1 or 6 evaluations of its forces a step. The whole is of order 2.
    substeps : int
        RATTLE substeps in each drift, for order 2.
    conserve_momentum : bool
        See `Langevin`.
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
        order: InnerOrder = 2,
        substeps: int = 3,
        conserve_momentum: bool = False,
        slow_kicks: SlowKicks = "ends",
    ) -> None:
        super().__init__(thermal_energy, friction, rng, substeps=substeps, conserve_momentum=conserve_momentum)
        self.nesting = Nesting(steps, order, self.substeps, slow_kicks)
        self.inner_order = order
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
