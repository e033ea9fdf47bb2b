"""SciPy's integrators with a projection after each step."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kcons.errors import InputError, UnsupportedError
from kcons.models.projected_steps import METHODS, check_sizes, projecting, solver_of, span_of, times_of


def turn(t, y):
    return np.array([-y[1], y[0]])


@pytest.mark.parametrize("method", METHODS)
def test_the_next_step_starts_from_the_projection(method):
    seen = []

    def project(t, y):
        seen.append(y / np.linalg.norm(y))
        return seen[-1]

    found = solve_ivp(turn, (0, 2), [1.0, 0.0], projecting(solver_of(method), project), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(found.y[:, 1:].T, seen)
    np.testing.assert_allclose(found.y[:, -1], [np.cos(2), np.sin(2)], rtol=0, atol=1e-3)
    # What projects to another place moves the rest of the run: here it counts the steps.
    stepper = projecting(solver_of(method), lambda t, y: y + 1)
    counted = solve_ivp(lambda t, y: 0 * y, (0, 2), [0.0], stepper, max_step=0.1)
    np.testing.assert_allclose(counted.y[0], np.arange(len(counted.t)), rtol=0, atol=1e-12)


def test_a_motion_that_has_settled_ends():
    stepper = projecting(METHODS["RK45"], lambda t, y: y, lambda t, y: t > 0.5)
    found = solve_ivp(turn, (0, 2), [1.0, 0.0], stepper, max_step=0.1)
    assert 0.5 < found.t[-1] < 0.7 and found.success


def test_bad_arguments_are_named():
    with pytest.raises(InputError, match="choose from RK23"):
        solver_of("Euler")
    with pytest.raises(UnsupportedError, match="use 'Radau' or 'BDF'"):
        solver_of("LSODA")
    for span in (3.0, (0.0, np.inf), (0.0, 1.0, 2.0), ("a", "b")):
        with pytest.raises(InputError, match="t_span"):
            span_of(span)
    for times in ([0.0, 2.0], [0.5, 0.2], [[0.5]], [np.nan], [0.5, 0.5]):
        with pytest.raises(InputError, match="t_eval"):
            times_of(times, 0.0, 1.0)
    np.testing.assert_array_equal(times_of([0.7, 0.2], 1.0, 0.0), [0.7, 0.2])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rtol", np.nan),
        ("rtol", -1.0),
        ("rtol", 0.0),
        ("rtol", 1e-16),
        ("rtol", [1e-9, 1e-9, 1e-9]),
        ("atol", -1e-9),
        ("atol", [1e-9, np.nan]),
        ("atol", [1e-9]),
        ("max_step", 0.0),
        ("max_step", np.nan),
        ("first_step", -0.1),
        ("first_step", "short"),
    ],
)
def test_tolerances_and_steps_that_cannot_be_are_named(name, value):
    """With a tolerance of NaN, SciPy tries the first step for ever."""
    with pytest.raises(InputError, match=name) as caught:
        check_sizes({name: value}, 2)
    assert caught.value.item == name


def test_tolerances_and_steps_that_can_be_are_taken():
    check_sizes({"rtol": [1e-9, 1e-3], "atol": 0.0, "max_step": np.inf, "first_step": None, "jac": len}, 2)
    check_sizes({}, 2)
