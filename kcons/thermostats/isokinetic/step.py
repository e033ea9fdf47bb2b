"""One step of the isokinetic thermostat, and the atoms that it acts on."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError
from kcons.steppers import State, System
from kcons.steppers.interpreter import Interpreter
from kcons.steppers.operations import Operation, Turn
from kcons.steppers.program import Program, Row
from kcons.steppers.stages.compiled_operations import check_finite
from kcons.thermostats.freedom import atom_numbers
from kcons.thermostats.isokinetic import kick as closed_form
from kcons.thermostats.isokinetic.kick import INTEGRAL, SIZE, SQUARE, TWICE

#: Kinetic energy below which v.f/2K may overflow.
SMALLEST = 1e-290
_MAX_ITERATIONS = 50


class _FirstTurn(Turn):
    """The turn that a step begins with, whose forces need not be projected: the drift takes out the rest."""

    verb = "first_turn"


def programs(operations: Sequence[Operation]) -> tuple[Program, Program, Program]:
    """A step compiled, with the turns in Python, and where targets move."""
    first, *others = operations
    assert isinstance(first, Turn)
    parts = _FirstTurn(first.fraction), *others
    functions = {"first_turn": closed_form.first_turn, "turn": closed_form.turn}
    return Program(parts, functions), Program(parts), Program(parts, python=("project", "fly"))


def split(system: System, x: FloatArray, v: FloatArray, time: float) -> tuple[FloatArray | None, FloatArray]:
    """v, projected, as the slowest velocities that the targets demand (None where they rest) and the rest."""
    motion = system.motion
    whole = motion.project_velocities(x, v, time=time)
    if not motion.plan.driven:
        return None, whole
    drive = motion.project_velocities(x, np.zeros_like(v), time=time)
    return drive, whole - drive


def left_for(twice: float, driven: float, step: int) -> float:
    """What moving targets leave of 2K."""
    left = twice - driven
    if not left > SMALLEST:
        raise InputError(
            f"moving targets alone have more kinetic energy than the thermostat allows at step {step}: raise the "
            "temperature, or move them slower",
            item="kinetic_energy",
        )
    return left


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


def constrained_acceleration(system: System, x: FloatArray, forces: FloatArray, time: float) -> FloatArray:
    """M_par^+ f."""
    with np.errstate(over="ignore"):  # velocities are checked
        return _acceleration(system, x, forces, time)


def _acceleration(system: System, x: FloatArray, forces: FloatArray, time: float) -> FloatArray:
    motion = system.motion
    if motion.plan.driven:
        return np.asarray(motion.project_forces(x, forces, time=time) * system.inverse_masses)
    pace = forces * system.weights
    return motion.project_velocities(x, pace, time=time, out=pace) if motion.rank else pace


class IsokineticStep(Interpreter):
    """Steps on their way; velocities are drive + v, the drive None where targets rest."""

    def __init__(
        self,
        system: System,
        share: ThermostattedAtoms,
        start: State,
        dt: float,
        made: tuple[Program, Program, Program],
        steps: int,
    ) -> None:
        assert start.thermostat is not None
        driven = system.motion.plan.driven
        program = made[2 if driven else 1 if system.packed is None else 0]
        masses = share.masses.ravel()
        numbers = np.concatenate((start.thermostat, masses, masses))
        super().__init__(system, start, dt, program, steps, numbers)
        self.share = share
        self.drive: FloatArray | None = None
        #: How long v must be, squared.
        self.left = float(start.thermostat[TWICE])
        if driven:
            self.drive, self.v[:] = split(system, self.x, self.v, self.time)
            assert self.drive is not None
            self.left = left_for(self.left, share.square(self.drive), self.number)

    # -- verbs ----------------------------------------------------------------------------------

    def fly(self, row: Row, begun: bool) -> None:
        if self.drive is not None:
            self._driven_flight(row)
            return
        super().fly(row, begun)

    def project(self, row: Row, begun: bool) -> None:
        if self.drive is None:
            super().project(row, begun)

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
        pace = _acceleration(self.system, self.place(row.here), self.forces, self.at(row.end))
        square, factor, growth, done = closed_form.after_drift(self.v, pace, share.masses, self.left, t)
        if not done:
            # The force is strong, and v runs against it.
            turned, more = closed_form.turned(factor * self.v, pace, share.masses, self.left, t)
            self.v[:] = turned if share.others is None else np.where(share.others, self.v + t * pace, turned)
            growth += more
        self.numbers[SQUARE] = square
        self.numbers[INTEGRAL] += growth

    def end(self, here: int) -> State:
        if self.drive is not None:
            self.v = self.drive + self.v
        return super().end(here)

    def variables(self) -> FloatArray:
        return self.numbers[:SIZE].copy()

    # -- moving targets ------------------------------------------------------------------------

    def _driven_flight(self, row: Row) -> None:
        """Moving targets do work: u is scaled by one factor before and after the flight, that which keeps K.

        So it is symmetric, of order 2 (Hairer, BIT 40, 726 (2000)).
        """
        system, share, x, h = self.system, self.share, self.place(row.here), self.length(row)
        assert self.drive is not None
        then, now = self.at(row.begin), self.at(row.end)
        out, log_factor, last = self.place(row.there), 0.0, math.inf
        for _ in range(_MAX_ITERATIONS):
            v = self.drive + self._times(math.exp(log_factor), self.v)
            np.add(x, h * v, out=out)
            system.motion.project_positions(
                out, x, time=now, reference_time=then, velocities=v, dt=h, flight=h, out=out
            )
            check_finite(out, "position", self.number)
            drive, u = split(system, out, v, now)
            assert drive is not None
            left = left_for(float(self.numbers[TWICE]), share.square(drive), self.number)
            u = self._times(math.exp(log_factor), u)
            miss = 0.5 * math.log(left / share.square(u))
            if abs(miss) <= 1e-15 or (abs(miss) < 1e-12 and abs(miss) >= last):
                break
            last = abs(miss)
            log_factor += 0.5 * miss
        else:
            raise ConvergenceError(
                "kinetic energy and moving targets cannot be kept together; time step too large",
                residual=last,
                tolerance=1e-12,
                iterations=_MAX_ITERATIONS,
            )
        self.drive, self.left = drive, left
        self.v[:] = u
        self.numbers[INTEGRAL] -= 2 * log_factor

    def _times(self, factor: float, u: FloatArray) -> FloatArray:
        return u * factor if self.share.others is None else np.where(self.share.others, u, u * factor)
