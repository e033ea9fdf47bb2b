"""Volumes and shapes of rigid ideal gases have their exact distributions."""

from __future__ import annotations

import numpy as np
import pytest
from pressure_systems import (
    DUMBBELL,
    METHANE,
    TRIANGLE,
    cells_of,
    gas,
    no_force,
    p_value,
    round_shape,
    started,
)
from scipy import stats

from kcons.thermostats import autocorrelation_time, mean
from kcons.thermostats.pressure import MonteCarloBarostat


@pytest.mark.parametrize("shape", [DUMBBELL, TRIANGLE, METHANE], ids=["dumbbell", "triangle", "methane of rank 9"])
def test_volumes_of_a_rigid_ideal_gas(shape):
    """V^N exp(-P V/kT): the N of molecules, whatever the number of their atoms and rows."""
    n, side = 100, 12.0
    system, x = gas(shape, n, side)
    barostat = MonteCarloBarostat((n + 1) / side**3, rng=1, width=0.25)
    volumes = np.linalg.det(cells_of(system, started(system, x, barostat), barostat, 1200))
    exact = stats.gamma(n + 1, scale=side**3 / (n + 1))
    assert p_value(volumes, exact) > 0.01
    error = exact.std() * np.sqrt(autocorrelation_time(volumes) / len(volumes))
    assert abs(volumes.mean() - exact.mean()) < 3 * error
    assert error < 0.01 * exact.mean()
    # It could tell the number of molecules from that of atoms.
    assert p_value(volumes, stats.gamma(n * len(shape) + 1, scale=side**3 / (n + 1))) < 1e-6


@pytest.mark.parametrize("kind", ["semi-isotropic", "anisotropic", "flexible"])
def test_volumes_of_other_kinds(kind):
    """The volume is spread as in cells of one shape."""
    n, side = 100, 12.0
    system, x = gas(DUMBBELL, n, side, force=no_force, potential=round_shape)
    barostat = MonteCarloBarostat((n + 1) / side**3, kind=kind, rng=1, width=0.09)
    cells = cells_of(system, started(system, x, barostat), barostat, 1500)
    assert p_value(np.linalg.det(cells), stats.gamma(n + 1, scale=side**3 / (n + 1))) > 0.01
    lengths = cells[-1][np.tril_indices(3)]
    assert np.all(np.triu(cells, 1) == 0)
    if kind != "flexible":
        assert np.all(cells[-1] == np.diag(np.diag(cells[-1])))
    if kind == "semi-isotropic":
        assert cells[-1][0, 0] == pytest.approx(cells[-1][1, 1], rel=1e-12)
        assert abs(cells[-1][0, 0] - cells[-1][2, 2]) > 1e-3
    assert len(np.unique(lengths)) > 1


def test_trials_of_few_pieces_end_at_what_a_trial_may_change():
    """Two pieces would be accepted in half of the trials with far wider ones; volumes are right all the same."""
    n, side = 2, 12.0
    system, x = gas(n=n, side=side)
    barostat = MonteCarloBarostat((n + 1) / side**3, every=1, rng=1, width=1.0)
    state = started(system, x, barostat)
    volumes = np.linalg.det(cells_of(system, state, barostat, 4000))
    assert np.abs(np.diff(np.log(volumes))).max() <= 0.27
    assert abs(mean(volumes).off(side**3)) < 3.5
