"""The Gaussian isokinetic thermostat: constant kinetic energy as a velocity constraint.

Gauss's principle with the row v^T M (notes, eqs. 111-113) gives dv/dt = M_par^+ f - alpha v with
alpha = v.f/(2K). The row is M^-1-orthogonal to those of the holonomic constraints wherever v is tangent to them, so
that a kick at fixed positions has the closed form it has without constraints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import Positive, checked
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, OverdeterminedError, UnsupportedError
from kcons.steppers import Splitting, State, System
from kcons.steppers.interpreter import Interpreter
from kcons.steppers.operations import Evaluate, Kick, Operation, Project, Turn, mirrored, splitting
from kcons.steppers.program import Program, Row
from kcons.steppers.splitting import KAHAN_LI_6, SUZUKI_4
from kcons.steppers.stages.compiled_operations import check_finite
from kcons.thermostats.freedom import (
    LOOK_AT,
    Momentum,
    atom_numbers,
    carried,
    freedom,
    may_be,
    refuse_dissipation,
    warn_of_bodies_apart,
    warn_of_conserved_momenta,
)
from kcons.thermostats.isokinetic import kick as closed_form
from kcons.thermostats.isokinetic.kick import INTEGRAL, SIZE, SQUARE, TWICE

Convention = Literal["exact", "notes"]

#: Relative difference from the kinetic energy wanted at the start that is taken for rounding.
ROUNDING = 1e-12
#: The same of a state that goes on, whose velocities went through steps, or through momenta.
KEPT = 1e-9
#: Kinetic energy below which v.f/2K may overflow.
SMALLEST = 1e-290

_S6 = (0.0792036964311957, 0.353172906049774, -0.0420650803577195)
_S6_OTHER = (0.209515106613362, -0.143851773179818)
_S10 = (0.0502627644003922, 0.413514300428344, 0.0450798897943977, -0.188054853819569, 0.541960678450780)
_S10_OTHER = (0.148816447901042, -0.132385865767784, 0.067307604692185, 0.432666402578175)

#: Kicks, drifts, and the composition each drift is flown by, for each order. Kicks are quadratic in the velocities, so
#: that the Runge-Kutta-Nystrom splittings of `kcons.steppers` lose their order here; these hold for any two flows
#: (S_6 and S_10 of Blanes and Moan).
SCHEMES: dict[int, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    2: ((0.5, 0.5), (1.0,), (1.0,)),
    4: (mirrored(_S6), mirrored(_S6_OTHER, 2), SUZUKI_4),
    6: (mirrored(_S10), mirrored(_S10_OTHER, 2), KAHAN_LI_6),
}


class _FirstTurn(Turn):
    """The turn that a step begins with, whose forces need not be projected: the drift takes out the rest."""

    verb = "first_turn"


def programs(operations: Sequence[Operation]) -> tuple[Program, Program]:
    """A step compiled, and with the turns in Python."""
    first, *others = operations
    assert isinstance(first, Turn)
    parts = _FirstTurn(first.fraction), *others
    functions = {"first_turn": closed_form.first_turn, "turn": closed_form.turn}
    return Program(parts, functions), Program(parts)


class ThermostattedAtoms:
    """The atoms that a thermostat acts on, and sums over them."""

    def __init__(self, system: System, atoms: ArrayLike | None) -> None:
        inside = system.inverse_masses[:, 0] > 0
        if atoms is not None:
            chosen = np.zeros(system.n_atoms, dtype=bool)
            chosen[atom_numbers(atoms, system.n_atoms)] = True
            inside = inside & chosen
        self.n_moving = int(inside.sum())
        #: Masses of the thermostatted atoms for each coordinate; 0 for the others.
        self.masses: FloatArray = np.repeat(np.where(inside, system.masses, 0.0)[:, None], 3, axis=1)
        #: Coordinates of other atoms that move, None if there are none.
        others = (self.masses == 0) & (system.weights > 0)
        self.others = others if others.any() else None

    def square(self, v: FloatArray) -> float:
        """v^T M v."""
        return float(closed_form.square_sum(v, self.masses))

    def scaled(self, v: FloatArray, square: float) -> FloatArray:
        """v with the length that v^T M v = `square` demands, other atoms as they are."""
        has = self.square(v)
        factor = math.sqrt(square / has) if has > 0 else math.nan
        return np.where(self.masses > 0, v * factor, v)

    def push_square(self, system: System, state: State) -> float:
        """f . M_par^+ f at the state."""
        assert state.forces is not None
        pace = constrained_acceleration(system, system.near_origin(state)[0], state.forces, state.time)
        return float(closed_form.square_sum(pace, self.masses))


@np.errstate(over="ignore")  # velocities are checked
def constrained_acceleration(system: System, x: FloatArray, forces: FloatArray, time: float) -> FloatArray:
    """M_par^+ f."""
    motion = system.motion
    pace = forces * system.weights
    return motion.project_velocities(x, pace, time=time, out=pace) if motion.rank else pace


class Isokinetic(Splitting):
    """Constant kinetic energy on constraints at rest: order 2, 4 or 6.

    Kicks follow the closed form at fixed forces; drifts fly along the constraints, after which the velocities are
    brought back to the length they had. Configurations are canonical at temperature T for
    2K = (g - 1) kT, g being the independent momenta: 3 n less the rank of the rows, less 1 for each direction in which
    total momentum is conserved. That is the default ('exact'). Velocities are spread over a sphere, not by Maxwell and
    Boltzmann: the kinetic temperature 2K/(g k) reads (g - 1)/g T.

    Symplectic it cannot be: the flow compresses phase space at the rate -(g - 1) alpha. It follows the exact motion
    backwards, with a negative time step, to the order of the scheme.

    Parameters
    ----------
    thermal_energy : float, optional
        k_B T in the units of energy in use; without it K stays what it is at the start.
    order : {2, 4, 6}
        1, 6 and 10 force evaluations a step.
    convention : {'exact', 'notes'}
        2K = (g - 1) k_B T, or 2K = 3 n k_B T of the notes (eq. 111), n atoms that can move; their configurations are
        hotter than T.
    atoms : array_like of int or bool, optional
        Thermostat these only. No row may couple them to others.
    momentum : {'auto', 'conserved', 'free'}
        See `kcons.thermostats.freedom`.

    Warns
    -----
    UserWarning
        At the start of a run: total momentum is conserved but for a factor exp(U/2K), and not zero; or a temperature is
        asked for and forces exert no torque, so that the same holds of angular momentum. Neither samples a temperature.
        After 20,000 steps: a temperature is asked for, and no body, which rows tie together, feels another.

    Notes
    -----
    `State.thermostat` holds 2K, the integral of alpha over time, f.M_par^+ f and g. U + 2K int(alpha) is conserved
    (`conserved_energy`).

    References
    ----------
    Notes, eqs. 111-113; Evans, Hoover et al., Phys. Rev. A 28, 1016 (1983); closed form: Zhang, J. Chem. Phys. 106,
    6102 (1997); splittings: Blanes and Moan, J. Comput. Appl. Math. 142, 313 (2002).
    """

    reversible = False  # to the order of the scheme only: drifts are followed by a change of length
    symplectic = False

    @checked
    def __init__(
        self,
        thermal_energy: Positive | None = None,
        *,
        order: Literal[2, 4, 6] = 2,
        convention: Convention = "exact",
        atoms: ArrayLike | None = None,
        momentum: Momentum = "auto",
    ) -> None:
        super().__init__(*SCHEMES[order])
        self.order, self.thermal_energy = order, thermal_energy
        self.convention: Convention = convention
        self.atoms = None if atoms is None else np.atleast_1d(atoms)
        self.momentum: Momentum = momentum
        self._shares: tuple[System, ThermostattedAtoms] | None = None
        operations: list[Operation] = []
        for operation in splitting(*SCHEMES[order]):
            # Velocities are on the constraints whenever they turn.
            operations += [Turn(operation.fraction)] if isinstance(operation, Kick) else [operation]
            if isinstance(operation, Evaluate):
                operations.append(Project())
        self._operations = tuple(operations[:-1])
        self._programs = programs(self._operations)

    def __repr__(self) -> str:
        given = [f"{self.thermal_energy!r}"] if self.thermal_energy is not None else []
        if self.order != 2:
            given.append(f"order={self.order}")
        if self.convention != "exact":
            given.append(f"convention={self.convention!r}")
        if self.atoms is not None:
            given.append(f"atoms=<{len(self.atoms)} atoms>")
        return f"Isokinetic({', '.join(given)})"

    def operations(self, system: System | None = None) -> tuple[Operation, ...]:
        return self._operations

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` for targets that move, velocity-dependent forces, and friction besides its own."""
        refuse_dissipation(system, "closed kick; use Langevin for friction, or leave it out")
        if system.motion.plan.driven:
            raise UnsupportedError(
                "targets move, or rows hold velocities, and do work that no closed kick takes out; use Langevin"
            )

    # -- steps ----------------------------------------------------------------------------------

    def start(self, system: System, state: State) -> State:
        """The state with its forces, and with the kinetic energy that the thermostat keeps.

        Velocities off the constraints are projected, then scaled; those that are right to rounding stay as they are to
        the last bit. A state with variables of another temperature or energy, or of other atoms, begins anew.

        Raises
        ------
        InputError
            All velocities are zero; the state carries variables of another thermostat.
        OverdeterminedError
            g is 1 (a temperature asked for), or 0.
        UnsupportedError
            A row couples the thermostatted atoms to others.
        """
        self.check(system)
        if not state.is_of(system):
            state = replace(state, forces=None, thermostat=None)  # degrees of freedom are those of another system, too
        elif not state.has_forces_of(system):
            state = replace(state, forces=None)
        share = self._share(system)
        if carried(state, 4, "Isokinetic") and self._goes_on_from(system, share, state):
            if state.forces is None or self._left is None or state.positions is not self._left[3]:
                state = self._pushed(system, share, system.with_forces(state))
            return state
        state = system.with_forces(state)
        assert state.forces is not None
        velocities = system.motion.project_velocities(state.positions, state.velocities, time=state.time)
        found = share.square(velocities)
        if not found > SMALLEST:
            raise InputError(
                "the isokinetic thermostat needs non-zero kinetic energy: draw velocities first "
                "(kcons.thermostats.thermal_velocities)",
                item="velocities",
            )
        free = freedom(system, state, state.forces, self.atoms, self.momentum)
        twice = self._twice_kinetic(share, free.count, found)
        turns = free.turns and self.thermal_energy is not None
        warn_of_conserved_momenta(system.masses, state.velocities, free.directions, turns, stacklevel=8)
        off = float(np.abs(velocities - state.velocities).max())
        if off <= ROUNDING * float(np.abs(velocities).max()) and abs(found - twice) <= ROUNDING * twice:
            velocities = state.velocities
        else:
            velocities = share.scaled(velocities, twice)
        variables = np.array([twice, 0.0, share.push_square(system, state), free.count])
        return replace(state, velocities=velocities, thermostat=variables)

    def _pushed(self, system: System, share: ThermostattedAtoms, state: State) -> State:
        """The state with f.M_par^+ f of its forces, which is kept where it is that but for rounding."""
        assert state.thermostat is not None
        variables, square = state.thermostat.copy(), share.push_square(system, state)
        if abs(variables[2] - square) <= KEPT * square:
            return state
        variables[2] = square
        return replace(state, thermostat=variables)

    def _goes_on_from(self, system: System, share: ThermostattedAtoms, state: State) -> bool:
        """Whether the variables of the state are those of this temperature or energy, and of these atoms and rows."""
        left = self._left
        same = left is not None and state.thermostat is left[0] and self.thermal_energy == left[1]
        if same and left is not None and state.velocities is left[2]:
            return True  # most often, and in no time
        assert state.thermostat is not None
        twice, _, _, count = state.thermostat.tolist()
        if not same:
            if abs(self._twice_kinetic(share, count, twice) - twice) > ROUNDING * twice:
                return False
            if not may_be(count, system, state, self.atoms, self.momentum):
                return False
        return abs(share.square(state.velocities) - twice) <= KEPT * twice

    def _twice_kinetic(self, share: ThermostattedAtoms, count: float, found: float) -> float:
        if self.thermal_energy is None:
            return found
        if self.convention == "notes":
            return 3 * share.n_moving * self.thermal_energy
        if count < 2:
            raise OverdeterminedError(
                "g - 1 = 0: isokinetic temperature undefined for a single degree of freedom; leave thermal_energy out "
                "and give velocities of the kinetic energy wanted, or use Langevin"
            )
        return (count - 1) * self.thermal_energy

    def _share(self, system: System) -> ThermostattedAtoms:
        known = self._shares
        if known is None or known[0] is not system:
            known = self._shares = (system, ThermostattedAtoms(system, self.atoms))
        return known[1]

    def begun(self, system: System, state: State, dt: float, steps: int) -> Interpreter:
        begin = self.start(system, state)
        if begin.step == LOOK_AT and self.thermal_energy is not None and self.atoms is None:
            warn_of_bodies_apart(system, begin, stacklevel=7)
        return IsokineticStep(system, self._share(system), begin, dt, self._programs, steps)

    def at_once(self, state: State, steps: int) -> int:
        return min(steps, LOOK_AT - state.step) if state.step < LOOK_AT else steps

    def depends_on(self, system: System, state: State) -> Any:
        return self.thermal_energy, state.step == LOOK_AT

    def note(self, state: State) -> None:
        self._left = state.thermostat, self.thermal_energy, state.velocities, state.positions

    # -- what can be read -----------------------------------------------------------------------

    def friction(self, system: System, state: State) -> float:
        """alpha = v.f/(2K) at the state (notes, eq. 113)."""
        state = self.start(system, state)
        assert state.forces is not None
        share = self._share(system)
        v = system.motion.project_velocities(state.positions, state.velocities, time=state.time)
        return float(closed_form.raw_sums(v, state.forces, system.weights, share.masses)[0]) / share.square(v)

    def conserved_energy(self, system: System, state: State) -> float:
        """U + 2K int(alpha dt), which the exact motion conserves where all atoms are thermostatted.

        Needs `System.potential`.
        """
        state = self.start(system, state)
        assert state.thermostat is not None
        potential = system.total_energy(state) - system.kinetic_energy(state.velocities)
        return potential + float(state.thermostat[0] * state.thermostat[1])


class IsokineticStep(Interpreter):
    """Steps on their way."""

    def __init__(
        self,
        system: System,
        share: ThermostattedAtoms,
        start: State,
        dt: float,
        made: tuple[Program, Program],
        steps: int,
    ) -> None:
        assert start.thermostat is not None
        program = made[1 if system.packed is None else 0]
        masses = share.masses.ravel()
        numbers = np.concatenate((start.thermostat, masses, masses))
        super().__init__(system, start, dt, program, steps, numbers)
        self.share = share
        #: How long v must be, squared.
        self.left = float(start.thermostat[TWICE])

    def first_turn(self, row: Row, begun: bool) -> None:
        """With forces as they are: the drift takes out what they would do across the constraints."""
        t, system, share = row.length * self.dt, self.system, self.share
        check_finite(self.forces, "force", self.number)
        if not begun:
            growth, done = closed_form.before_drift(
                self.v, self.forces, system.weights, share.masses, float(self.numbers[SQUARE]), self.left, t
            )
            if done:
                self.numbers[INTEGRAL] += growth
                return
        self._turn_by_projected_forces(row, t)

    def turn(self, row: Row, begun: bool) -> None:
        """Bring v, projected, to its length, and follow the closed form."""
        check_finite(self.v, "velocity", self.number)
        self._turn_by_projected_forces(row, row.length * self.dt)
        check_finite(self.v, "velocity", self.number)

    def _turn_by_projected_forces(self, row: Row, t: float) -> None:
        share = self.share
        check_finite(self.forces, "force", self.number)
        pace = constrained_acceleration(self.system, self.place(row.here), self.forces, self.at(row.end))
        square, factor, growth, done = closed_form.after_drift(self.v, pace, share.masses, self.left, t)
        if not done:
            # The force is strong, and v runs against it.
            turned, more = closed_form.turned(factor * self.v, pace, share.masses, self.left, t)
            self.v[:] = turned if share.others is None else np.where(share.others, self.v + t * pace, turned)
            growth += more
        self.numbers[SQUARE] = square
        self.numbers[INTEGRAL] += growth

    def variables(self) -> FloatArray:
        return self.numbers[:SIZE].copy()
