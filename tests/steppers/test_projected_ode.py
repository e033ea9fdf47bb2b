"""The projected equation: order, what it conserves and what it does not, feedback."""

from __future__ import annotations

import numpy as np
import pytest
from stepper_problems import FRICTION, HOLONOMIC, VELOCITY_ROWS, GlobalError, named
from stepper_systems import PROJECTED, rotor, slope, spherical_pendulum

from kcons.errors import InputError
from kcons.steppers import Baumgarte, ProjectedRungeKutta4, ProjectedVerlet, run

SCHEMES = pytest.mark.parametrize("stepper", PROJECTED, ids=repr)


@SCHEMES
@pytest.mark.parametrize("problem", [*HOLONOMIC, *VELOCITY_ROWS, *FRICTION], ids=named)
def test_observed_order(stepper, problem: GlobalError) -> None:
    # The rod that grows is late in reaching its order.
    dts = 1.0 / np.array([64, 128] if problem is HOLONOMIC[2] else [32, 64])
    errors = [problem(stepper, dt) for dt in dts]
    assert slope(dts, errors) == pytest.approx(stepper.order, abs=0.15)


def violation(stepper, dt: float, steps: int) -> float:
    system, state = spherical_pendulum()
    end = run(system, state, dt, steps, stepper=stepper)
    return float(np.abs(system.motion.constraint_set.value(end.positions)).max())


def test_constraints_drift_without_projection_and_not_with_it() -> None:
    assert violation(ProjectedRungeKutta4(), 0.05, 200) > 1e-9
    assert violation(ProjectedVerlet(), 0.05, 200) > 1e-5
    assert violation(ProjectedRungeKutta4(project=True), 0.05, 200) <= 1e-15
    assert violation(ProjectedVerlet(project=True), 0.05, 200) <= 1e-15


def test_feedback_bounds_the_drift() -> None:
    free = [violation(ProjectedRungeKutta4(), 0.05, n) for n in (200, 800)]
    assert free[1] > 3 * free[0]
    assert violation(Baumgarte(2.0), 0.05, 800) < free[1] / 10


def test_feedback_brings_a_violation_down() -> None:
    """Critically damped: (1 + rate t) exp(-rate t) of it is left."""
    system, state = rotor(omega=0.0)
    off = state.positions * (1 + 1e-6)
    state = type(state)(off, state.velocities)
    end = run(system, state, 0.01, 200, stepper=Baumgarte(2.0))
    left = np.linalg.norm(end.positions[0] - end.positions[1]) - 1.2
    assert left == pytest.approx(1.2e-6 * 5 * np.exp(-4.0), rel=1e-4)


@pytest.mark.parametrize("rate", [0.0, -1.0, np.nan, np.inf])
def test_bad_rate(rate) -> None:
    with pytest.raises(InputError, match="rate is"):
        Baumgarte(rate)
