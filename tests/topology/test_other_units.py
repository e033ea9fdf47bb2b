"""Constraints in another unit: the same surface in space."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import constraints as c
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import UnsupportedError
from kcons.topology.other_units import rescaled

X = np.array([[0.1, 0.2, 0.3], [1.2, 0.1, -0.2], [1.9, 1.1, 0.4], [0.7, 2.0, 1.3]])
MASSES = np.array([1.0, 2.0, 3.0, 4.0])
FAMILIES = [
    c.Distance([[0, 1]]),
    c.DistanceDifference([[0, 1], [1, 2]]),
    c.Angle([[0, 1, 2]]),
    c.Dihedral([[0, 1, 2, 3]]),
    c.LinearRelation([3], [0, 1, 2], [0.2, 0.3, 0.5], None),
    c.LinearCombination([0, 1], [[0, 0, 1.0], [0, 0, -1.0]]),
    c.FixedAtoms([2]),
    c.CenterOfMass([0, 1, 2]),
    c.CenterDistance([0, 1], [2, 3]),
    c.RadiusOfGyration([0, 1, 2, 3]),
    c.Sphere([1], [0.3, 0.1, 0.2]),
    c.Cylinder([1], [0.1, 0.0, 0.3], [0, 0.2, 1.0]),
    c.Torus([2], [0.0, 0.0, 0.0], [0, 0, 1.0], 1.5),
    c.Ellipsoid([3], [0.0, 0.1, 0.0], [1.0, 2.0, 3.0], target=None),
    c.Plane([0], [1.0, 1.0, 0.0]),
    c.Line([1], None, [1.0, 0.0, 0.5]),
]


@pytest.mark.parametrize("item", FAMILIES, ids=lambda item: item.family)
def test_the_same_points_fulfil_it(item):
    bound = ConstraintSet(item, X, MASSES).constraints[0]
    scaled = rescaled(bound, 0.1)
    held = ConstraintSet(scaled, X / 10, MASSES)
    assert np.abs(held.value(X / 10)).max() < 1e-15
    # Elsewhere both are off, by lengths that scale and angles that do not.
    y = X + 0.1 * np.random.default_rng(2).normal(size=X.shape)
    off = ConstraintSet(bound, X, MASSES).value(y)
    factor = 1.0 if item.family in ("Angle", "Dihedral") else 0.1
    assert np.abs(off).max() > 1e-3
    np.testing.assert_allclose(held.value(y / 10), factor * off, rtol=1e-9, atol=1e-14)


def test_what_has_no_known_units_is_refused():
    with pytest.raises(UnsupportedError, match="target that moves"):
        rescaled(c.Distance([[0, 1]], lambda t: 1.0 + t), 0.1)
    with pytest.raises(UnsupportedError, match="own functions"):
        rescaled(c.LinearVelocity([0], [[1.0, 0, 0]]), 0.1)
