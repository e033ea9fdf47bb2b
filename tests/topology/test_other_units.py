"""Constraints in another unit: the same surface in space."""

from __future__ import annotations

import numpy as np
import pytest
from constraint_cases import CASES, MASSES, scattered

from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import UnsupportedError
from kcons.topology.other_units import rescaled

X = scattered(0)
#: The power with which lengths stand in what is held, of the cases for which it is known.
POWERS = {
    name: dict(item.held.exponents).get("length", 0)
    for name, make in CASES.items()
    if (item := make()).held.exponents and item.holonomic and not item.moving
}


@pytest.mark.parametrize("name", POWERS)
def test_the_same_points_fulfil_it(name):
    bound = ConstraintSet(CASES[name]().with_target(None), X, MASSES).constraints[0]
    scaled = rescaled(bound, 0.1)
    held = ConstraintSet(scaled, X / 10, MASSES)
    assert np.abs(held.value(X / 10)).max() < 1e-15
    # Elsewhere both are off, by lengths that scale and angles that do not.
    y = X + 0.1 * np.random.default_rng(2).normal(size=X.shape)
    off = ConstraintSet(bound, X, MASSES).value(y)
    assert np.abs(off).max() > 1e-3
    np.testing.assert_allclose(held.value(y / 10), 0.1 ** POWERS[name] * off, rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("name", sorted(CASES.keys() - POWERS))
def test_what_has_no_known_units_is_refused(name):
    item = CASES[name]()
    with pytest.raises(UnsupportedError, match="target that moves" if item.moving else "own functions or velocities"):
        rescaled(item, 0.1)
