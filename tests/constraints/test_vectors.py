"""Arithmetic on arrays of vectors."""

import numpy as np
import pytest

from kcons.constraints.arguments import unit
from kcons.constraints.vectors import cross, dot, first_true, norm
from kcons.errors import InputError


def test_products_are_those_of_numpy():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 5, 4, 3))
    assert np.array_equal(cross(a, b), np.cross(a, b))
    np.testing.assert_allclose(dot(a, b), (a * b).sum(axis=-1), rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(norm(a), np.linalg.norm(a, axis=-1), rtol=1e-15)
    assert np.array_equal(cross(a[0, 0], b[0]), np.cross(a[0, 0], b[0]))


def test_directions():
    np.testing.assert_allclose(unit([[3, 0, 4], [0, 0, -2]], "axis"), [[0.6, 0, 0.8], [0, 0, -1]])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([[1.0, 2.0]], r"axis must be vectors of three numbers; its shape is \(1, 2\)"),
        (1.0, "axis must be vectors of three numbers"),
        ([0.0, 0.0, 0.0], "axis has a vector that is zero or not finite"),
        ([[1.0, 0, 0], [np.nan, 0, 0]], "zero or not finite"),
        ([np.inf, 0.0, 0.0], "zero or not finite"),
    ],
)
def test_what_is_no_direction_is_refused(given, message):
    with pytest.raises(InputError, match=message) as caught:
        unit(given, "axis")
    assert caught.value.item == "axis"


def test_the_first_that_is_true():
    assert first_true(np.array([False, True, True])) == 1
    assert first_true(np.zeros(3, bool)) is None and first_true(np.zeros(0, bool)) is None
