"""When a step of Newton's method is halved, given up, or made with the factor of the one before."""

import numpy as np
import pytest

from kcons.solvers.sparse.step_control import (
    MAX_ITERATIONS,
    factor_serves,
    go_back,
    hopeless,
    keep,
    overshot,
    refines,
)


@pytest.mark.parametrize(
    ("careful", "iteration", "error", "total", "best", "expected"),
    [
        (True, 3, 0.1, 0.2, 0.15, True),
        (True, 3, 0.1, 0.2, 0.3, False),
        (True, 3, 0.1, 0.29999, 0.3, True),
        (True, 3, 0.1, np.nan, 0.3, True),
        (True, 0, 0.1, 0.2, 0.15, False),
        (False, 3, 0.1, 0.2, 0.15, False),
        (True, 3, 1e-11, 0.2, 0.15, False),
    ],
)
def test_steps_that_gain_nothing_are_halved(careful, iteration, error, total, best, expected):
    assert overshot(careful, iteration, error, total, best) == expected


def test_newton_is_given_up():
    assert not hopeless(MAX_ITERATIONS - 1, 1e5, 0.1)
    assert hopeless(MAX_ITERATIONS, 1e-3, 0.1)
    assert hopeless(2, 1.1e6, 0.1) and not hopeless(2, 1.1e6, 10.0)
    assert not hopeless(0, 1e9, np.inf)


@pytest.mark.parametrize(
    ("error", "previous", "expected"), [(1e-9, 1e-3, True), (1e-4, 1e-3, False), (1e-8, 1e-1, True), (1e-2, 1.0, False)]
)
def test_a_factor_serves_again_while_it_gains(error, previous, expected):
    assert factor_serves(True, error, previous) == expected
    assert not factor_serves(False, error, previous)


def test_half_the_way_back():
    values, kept = np.arange(6.0), np.full(6, 10.0)
    keep(4, 6, values, kept)
    np.testing.assert_array_equal(kept, [10, 10, 10, 10, 4, 5])
    values += 2.0
    go_back(3, 6, values, kept)
    np.testing.assert_array_equal(values, [2, 3, 4, 7.5, 5, 6])


def test_refinement_ends_where_it_does_not_help():
    assert refines(1, 1e-10, 1e-8, 1e-15)
    assert not refines(1, 1e-16, 1e-8, 1e-15)
    assert not refines(3, 6e-14, 1e-13, 1e-15)
    assert not refines(9, 1e-10, 1e-8, 1e-15)
