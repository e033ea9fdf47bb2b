"""Boxes of dumbbells."""

from __future__ import annotations

import numpy as np
import pytest
from small_test_systems import end

from kcons.comparison import test_systems
from kcons.comparison.test_systems import dumbbells


@pytest.mark.parametrize("size", [8, 20])
def test_box_of_dumbbells(size):
    system = test_systems.build("dumbbells", size, seed=3)
    assert system.n_atoms == 2 * size
    assert system.motion.rank == size
    sigma, tangency = system.residuals(system.positions, system.velocities)
    assert sigma < 1e-14
    assert tangency < 1e-14
    d = system.positions[:, None] - system.positions
    d -= system.cell * np.round(d / system.cell)
    other = np.arange(2 * size)[:, None] // 2 != np.arange(2 * size) // 2
    assert np.linalg.norm(d, axis=2)[other].min() > 1.0  # no overlaps
    x, direction = system.positions, np.random.default_rng(1).standard_normal(system.positions.shape)
    slope = (system.potential.energy(x + 1e-6 * direction) - system.potential.energy(x - 1e-6 * direction)) / 2e-6
    assert slope == pytest.approx(-np.sum(system.potential.forces(x) * direction), rel=1e-6)
    # Forces do not see where the box begins, nor by which image an atom is given.
    moved = x + system.cell * np.array([0.3, 2.0, -1.0])
    np.testing.assert_allclose(system.potential.forces(moved), system.potential.forces(x), atol=1e-11)
    reference = system.reference()
    errors = [system.deviation(end(system, dt).positions, reference.positions) for dt in system.time_steps[1:]]
    np.testing.assert_allclose(np.diff(np.log2(errors)), -2.0, atol=0.1)
    assert reference.error < 1e-4 * errors[-1]


def test_forces_of_dumbbells_vanish_smoothly_at_the_cutoff():
    evaluate = dumbbells._with_cutoff(13.0, 2.5)
    for r, share in ((1.6, 1.0), (2.125, 0.5), (2.5 - 1e-3, 0.0), (2.5 + 1e-3, 0.0)):
        # Partners of both atoms out of reach; the pair meets through the boundary.
        x = np.array([[12.0, 0, 0], [12.0, 6, 0], [12.0 + r, 0, 0], [12.0 + r, 0, 6]])
        energy, forces = evaluate(x)
        assert energy == pytest.approx(share * 4 * (r**-12 - r**-6), abs=1e-13)
        if share == 1.0:
            assert forces[2, 0] == pytest.approx(24 * (2 * r**-13 - r**-7), rel=1e-13)
        elif share == 0.0:
            assert np.abs(forces).max() < 1e-9
        np.testing.assert_array_equal(forces[0], -forces[2])
        assert not forces[[1, 3]].any()
