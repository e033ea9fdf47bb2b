"""The projected equation of motion, integrated as an ordinary differential equation: for comparison, not for use.

a = M_par^+ f + M^-1 A^T (A M^-1 A^T)^+ b (notes eq. 105, corrected) keeps A a = b, and so the constraints only as
well as the integrator does: they drift, and with them the energy. Projecting positions and velocities after each step
keeps the constraints and still leaves a drift of the energy, since the step is neither reversible nor symplectic.
"""

from __future__ import annotations

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, UnsupportedError
from kcons.steppers.compiled_operations import check_finite
from kcons.steppers.state import State, System
from kcons.steppers.stepper import explained


class ProjectedEquation:
    """Velocity Verlet (order 2) or Runge-Kutta (4) on the projected equation; with `project`, each is projected."""

    reversible = False
    symplectic = False

    def __init__(self, order: int = 2, *, project: bool = False) -> None:
        self.order, self.force_evaluations = order, {2: 1, 4: 4}[order]
        self.holds = self.project = project

    def __repr__(self) -> str:
        return f"ProjectedEquation({self.order}{', project=True' if self.project else ''})"

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` for forces that depend on the velocities."""
        if system.velocity_dependent:
            raise UnsupportedError(f"{self!r} is made for forces of positions alone; use Rattle")

    def step(self, system: System, state: State, dt: float) -> State:
        """Advance by `dt`; the constraints drift. Errors carry `step`."""
        number, (time, left_over), motion = state.step + 1, state.later(dt), system.motion
        state = system.with_forces(state)
        x0, v0, f0 = system.kernel_arrays(state)
        assert f0 is not None

        def slope(x: FloatArray, v: FloatArray, t: float) -> FloatArray:
            check_finite(x, "position", number)
            return motion.acceleration(x, v, system.forces(x, v, t, number), t)

        def arrive(x: FloatArray) -> FloatArray:
            check_finite(x, "position", number)
            if self.project:
                motion.project_positions(x, state.positions, time=time, reference_time=state.time, out=x)
            return x

        forces = None
        try:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                a0 = motion.acceleration(x0, v0, f0, state.time)
                if self.order == 2:
                    half = v0 + (0.5 * dt) * a0
                    x, predicted = arrive(x0 + dt * half), half + (0.5 * dt) * a0
                    forces = system.forces(x, predicted, time, number)
                    v = half + (0.5 * dt) * motion.acceleration(x, predicted, forces, time)
                else:
                    middle = state.time + 0.5 * dt
                    v2 = v0 + 0.5 * dt * a0
                    a2 = slope(x0 + 0.5 * dt * v0, v2, middle)
                    v3 = v0 + 0.5 * dt * a2
                    a3 = slope(x0 + 0.5 * dt * v2, v3, middle)
                    v4 = v0 + dt * a3
                    a4 = slope(x0 + dt * v3, v4, time)
                    x = arrive(x0 + (dt / 6) * (v0 + 2 * v2 + 2 * v3 + v4))
                    v = v0 + (dt / 6) * (a0 + 2 * a2 + 2 * a3 + a4)
                if self.project:
                    motion.project_velocities(x, v, time=time, out=v)
        except ConvergenceError as error:
            raise explained(error, system, state, dt, number) from error
        check_finite(v, "velocity", number)
        return State(x, v, time, forces, number, None, left_over, None, state.barostat)
