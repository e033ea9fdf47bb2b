"""Blanes and Moan's splittings: coefficients, order with rows that move and velocity rows, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from stepper_problems import HOLONOMIC, VELOCITY_ROWS, GlobalError, named, observed_order
from stepper_systems import NYSTROM, rotor, system_of

from kcons.constraints import Sphere
from kcons.errors import UnsupportedError
from kcons.steppers import BlanesMoan4, BlanesMoan6, BlanesMoan6a, KahanLi6, Suzuki4, run

SPLITTINGS = pytest.mark.parametrize("stepper", NYSTROM, ids=repr)
#: Coarse, since these are so accurate that finer steps end in round-off.
STEPS = {
    "spherical_pendulum": {4: [4, 8], 6: [1, 3]},
    "free_rotor": {4: [8, 16], 6: [4, 8]},
    "growing_rod": {4: [8, 16], 6: [4, 8]},
    "skate": {4: [4, 8], 6: [2, 4]},
    "driven_atom": {4: [4, 8], 6: [2, 4]},
}


def check_order(stepper, problem: GlobalError) -> None:
    steps = STEPS[named(problem)][stepper.order]
    assert observed_order(stepper, problem, steps) == pytest.approx(stepper.order, abs=0.15)


@SPLITTINGS
@pytest.mark.parametrize("problem", HOLONOMIC, ids=named)
def test_observed_order(stepper, problem: GlobalError) -> None:
    check_order(stepper, problem)


def titled(each: object) -> str:
    """The same name in every process."""
    return named(each) if callable(each) else repr(each)


#: A skate, which is not integrable, and an atom that is driven.
SKATE, DRIVEN = VELOCITY_ROWS


@pytest.mark.parametrize("stepper, problem", [(BlanesMoan4(), SKATE), (BlanesMoan6(), DRIVEN)], ids=titled)
def test_observed_order_with_velocity_rows(stepper, problem: GlobalError) -> None:
    check_order(stepper, problem)


@pytest.mark.validation
@pytest.mark.parametrize(
    "stepper, problem",
    [(BlanesMoan6(), SKATE), (BlanesMoan4(), DRIVEN), (BlanesMoan6a(), SKATE), (BlanesMoan6a(), DRIVEN)],
    ids=titled,
)
def test_observed_order_with_velocity_rows_of_the_others(stepper, problem: GlobalError) -> None:
    check_order(stepper, problem)


@SPLITTINGS
def test_coefficients_are_symmetric_and_complete(stepper) -> None:
    for fractions in (stepper.kicks, stepper.drifts, stepper.flight):
        assert fractions == fractions[::-1]
        assert sum(fractions) == pytest.approx(1, abs=1e-15)


def test_fewest_evaluations_of_their_order() -> None:
    """At the same cost in forces the error is below that of the compositions."""
    system, state = rotor(omega=1.0, force=lambda x, t: -x + 0.1 * x**3)
    exact = run(system, state, 0.01, 200, stepper=BlanesMoan6())

    def error(stepper, evaluations: int) -> float:
        n = evaluations // stepper.force_evaluations
        return float(np.abs(run(system, state, 2 / n, n, stepper=stepper).positions - exact.positions).max())

    assert 2 * error(BlanesMoan4(), 240) < error(Suzuki4(), 240)
    assert 10 * error(BlanesMoan6(), 198) < error(KahanLi6(), 198)


@SPLITTINGS
def test_velocity_dependent_forces_are_refused(stepper) -> None:
    system, state = rotor(force=lambda x, v, t: -v, velocity_dependent=True)
    before = state.positions.copy()
    for attempt in (lambda: stepper.check(system), lambda: stepper.step(system, state, 0.1)):
        with pytest.raises(UnsupportedError, match="depend on the velocities; use Suzuki4 or KahanLi6"):
            attempt()
    assert np.array_equal(state.positions, before)


@SPLITTINGS
def test_drifts_fly_along_great_circles_where_they_can(stepper) -> None:
    """On a sphere without forces nothing is left of the error, however large the step."""
    positions = np.array([[2.0, 0.0, 0.0]])
    system = system_of([Sphere(0, [0, 0, 0], 2.0)], positions, [1.0])
    end = run(system, system.initial_state(positions, [[0.0, 3.0, 0.0]]), 5.0, 2, stepper=stepper)
    np.testing.assert_allclose(end.positions[0], [2 * np.cos(15.0), 2 * np.sin(15.0), 0.0], rtol=0, atol=1e-13)


def test_states_between_drifts_carry_no_forces() -> None:
    system, state = rotor(force=lambda x, t: -x)
    assert BlanesMoan6a().step(system, state, 0.1).forces is None
    np.testing.assert_array_equal(
        BlanesMoan6().step(system, state, 0.1).forces, -BlanesMoan6().step(system, state, 0.1).positions
    )
