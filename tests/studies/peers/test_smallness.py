"""Dense rows for methods of small systems."""

from __future__ import annotations

import numpy as np
from peers.smallness import dense_rows

from kcons.comparison import test_systems


def test_dense_rows_are_those_of_the_set():
    rng = np.random.default_rng(0)
    for name in ("triple-pendulum", "rotor", "sphere", "butane"):
        system = test_systems.build(name)
        value, jacobian = dense_rows(system.constraint_set)
        x = system.positions + 0.01 * rng.standard_normal(system.positions.shape)
        np.testing.assert_allclose(value(x.ravel()), system.constraint_set.value(x), rtol=0, atol=1e-15)
        np.testing.assert_allclose(jacobian(x.ravel()), system.constraint_set.jacobian(x).toarray(), rtol=0, atol=1e-15)
