"""The projected equation of motion as an ordinary differential equation: for comparison, not for use.

a = M_par^+ f + M^-1 A^T (A M^-1 A^T)^+ b keeps A a = b, and so the constraints only as well as the integrator
does: they drift, and with them the energy. Projecting positions and velocities after each step keeps the
constraints and still leaves a drift of the energy, since the step is neither reversible nor symplectic.
Baumgarte's feedback turns the drift into a damped oscillator and never reaches zero.

References
----------
Notes, eq. 105 (corrected); Baumgarte, Comput. Methods Appl. Mech. Eng. 1, 1 (1972).
"""

from __future__ import annotations

from dataclasses import replace
from weakref import ref

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError
from kcons.steppers.stages.compiled_operations import check_finite
from kcons.steppers.state import State, System
from kcons.steppers.stepper import explained, stays

#: Friction times the step above which velocities grow that should die away: 2 for Verlet, 2.8 for Runge-Kutta.
STABLE = 2.0


class ProjectedVerlet:
    """Velocity Verlet on (105), the velocity in b predicted: order 2, one force evaluation, nothing conserved.

    Neither reversible nor symplectic. Not for use but for comparison: energy drifts by a thousand times what that of
    `Rattle` may, and without `project` the constraints drift too, until it diverges.

    Parameters
    ----------
    project : bool
        Whether to project positions (along the gradients at the start) before the force is evaluated, and velocities
        at the end of the step.
    """

    order: int = 2
    reversible = False
    symplectic = False
    force_evaluations: int = 1
    #: Of the feedback.
    rate = 0.0

    def __init__(self, *, project: bool = False) -> None:
        self.project = bool(project)

    @property
    def holds(self) -> bool:
        """Whether states are on the constraints."""
        return self.project

    def __repr__(self) -> str:
        return f"{type(self).__name__}({'project=True' if self.project else ''})"

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` where the stepper may not be used: here, nowhere."""

    def step(self, system: System, state: State, dt: float) -> State:
        """Advance by `dt`; the constraints drift.

        Raises
        ------
        ConvergenceError
            With `project`, if no positions on the constraints are near enough; carries `step`.
        NonFiniteError
            The motion diverged; carries `step`.
        InputError
            `dt` is not finite, or too long for the friction; the force function returned a wrong shape.
        """
        still = stays(state, dt)
        if still is not None:
            return still
        number = state.step + 1
        if system.friction is not None and system.friction.largest * abs(dt) > STABLE:
            raise InputError(
                f"{self!r} takes friction for a force, which is unstable in steps longer than "
                f"{system.shown_time(STABLE / system.friction.largest)}; this one is {system.shown_time(dt)}. Use a "
                "shorter step, or Rattle, which is exact",
                item="dt",
            )
        time, left_over = state.later(dt)
        try:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                x, v, forces = self._advance(system, state, dt, time)
                _refuse_diverged(x, v, number)
                if self.project:
                    system.motion.project_velocities(x, v, time=time, out=v)
        except ConvergenceError as error:
            raise explained(error, system, state, dt, number) from error
        return State(x, v, time, forces, number, None, left_over, None, state.barostat, (ref(system), x, v, time))

    def _advance(
        self, system: System, start: State, dt: float, time: float
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Positions, velocities, and forces where these are those at the end."""
        start, number = system.with_forces(start), start.step + 1
        x0, v0, f0 = system.taken(start)
        assert f0 is not None
        a0 = self._acceleration(system, x0, v0, f0, start.time, number)
        half = v0 + (0.5 * dt) * a0
        x = x0 + dt * half
        self._arrive(system, start, x, time)
        predicted = half + (0.5 * dt) * a0
        f = system.forces(x, predicted, time, number)
        v = half + (0.5 * dt) * self._acceleration(system, x, predicted, f, time, number)
        return x, v, None if system.velocity_dependent else f

    def _arrive(self, system: System, start: State, x: FloatArray, time: float) -> None:
        """With `project`, bring the new positions onto the constraints, in place."""
        check_finite(x, "position", start.step + 1)
        if self.project:
            system.motion.project_positions(x, start.positions, time=time, reference_time=start.time, out=x)

    def _acceleration(
        self, system: System, x: FloatArray, v: FloatArray, f: FloatArray, time: float, number: int
    ) -> FloatArray:
        _refuse_diverged(x, v, number)
        feedback, held = None, system.motion.constraint_set
        if self.rate:
            slip = held.jacobian(x, time) @ v.ravel() - held.velocity_target(x, time)
            feedback = -2 * self.rate * slip - self.rate**2 * held.value(x, time)
        return system.motion.acceleration(x, v, system.resisted(f, v), time, feedback=feedback)


class ProjectedRungeKutta4(ProjectedVerlet):
    """The classical Runge-Kutta scheme on (105): order 4, four force evaluations, nothing conserved.

    Neither reversible nor symplectic. Not for long runs, in which energy drifts steadily; use `BlanesMoan4` or
    `Suzuki4` there. Without `project` the constraints drift too.

    Parameters
    ----------
    project : bool
        Whether to project positions and velocities after each step.
    """

    order = 4
    force_evaluations = 4

    def _advance(
        self, system: System, start: State, dt: float, time: float
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        x0, v0, _ = system.taken(replace(start, forces=None))
        middle, number = start.time + 0.5 * dt, start.step + 1

        def slope(x: FloatArray, v: FloatArray, t: float) -> FloatArray:
            return self._acceleration(system, x, v, system.forces(x, v, t, number), t, number)

        a1 = slope(x0, v0, start.time)
        x2, v2 = x0 + 0.5 * dt * v0, v0 + 0.5 * dt * a1
        a2 = slope(x2, v2, middle)
        x3, v3 = x0 + 0.5 * dt * v2, v0 + 0.5 * dt * a2
        a3 = slope(x3, v3, middle)
        x4, v4 = x0 + dt * v3, v0 + dt * a3
        a4 = slope(x4, v4, time)
        x = x0 + (dt / 6) * (v0 + 2 * v2 + 2 * v3 + v4)
        v = v0 + (dt / 6) * (a1 + 2 * a2 + 2 * a3 + a4)
        self._arrive(system, start, x, time)
        return x, v, None


class Baumgarte(ProjectedRungeKutta4):
    """(105) with feedback, A a = b - 2 rate (A v - c) - rate^2 sigma, by Runge-Kutta: order 4, drift bounded.

    Four force evaluations. Neither reversible nor symplectic. Not where constraints are to hold: they are off by
    about the error of the scheme, and energy drifts.

    Parameters
    ----------
    rate : float
        Inverse time in which a violation dies away (critically damped); rate dt must stay below about 1.
        Velocity rows take the first feedback only.
    """

    def __init__(self, rate: float) -> None:
        if not (np.isfinite(rate) and rate > 0):
            raise InputError(f"rate is {rate}; give a positive number, for example 0.1/dt", item="rate")
        super().__init__()
        self.rate = float(rate)

    def __repr__(self) -> str:
        return f"Baumgarte(rate={self.rate:g})"


def _refuse_diverged(x: FloatArray, v: FloatArray, number: int) -> None:
    check_finite(x, "position", number)
    check_finite(v, "velocity", number)
