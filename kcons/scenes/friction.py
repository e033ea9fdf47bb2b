"""Friction for scenes that come to rest: any stepper with its velocities scaled down before and after each step."""

from __future__ import annotations

import math
from dataclasses import replace

from kcons.steppers import State, Stepper, System


class Damped:
    """A stepper between two half steps of friction, v' = -gamma v, each solved exactly.

    Friction keeps velocities tangent to constraints at rest. The scheme is symmetric, of order 2 whatever the stepper.

    Parameters
    ----------
    stepper : Stepper
    friction : float
        gamma, in inverse units of time.
    """

    order = 2
    reversible = True
    symplectic = False

    def __init__(self, stepper: Stepper, friction: float) -> None:
        self.stepper = stepper
        self.friction = friction
        self.force_evaluations = stepper.force_evaluations

    def check(self, system: System) -> None:
        self.stepper.check(system)

    def step(self, system: System, state: State, dt: float) -> State:
        """Advance by `dt`."""
        share = math.exp(-0.5 * self.friction * dt)
        after = self.stepper.step(system, replace(state, velocities=share * state.velocities), dt)
        return replace(after, velocities=share * after.velocities)
