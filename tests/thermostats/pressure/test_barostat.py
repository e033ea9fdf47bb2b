"""What barostats have in common; volumes and shapes of cells that are known exactly."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import replace

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

from kcons.constraints import FixedAtoms
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.motion import Motion
from kcons.thermostats import mean
from kcons.thermostats.pressure import CellRescaling, CellSystem, MonteCarloBarostat
from kcons.thermostats.pressure.barostat import Strains


def test_widths_go_to_an_acceptance_of_one_half_and_trials_are_counted():
    system, x = gas(n=100)
    barostat = MonteCarloBarostat(101 / 12**3, width=1e-4, kind="semi-isotropic")
    state = started(system, x, barostat)
    for k in range(400):
        state = barostat.move(system, state, 1.0, 1.0)
        vars(state)["step"] = k
    assert np.isnan(barostat.acceptance(replace(state, barostat=None))).all()
    tried, _, widths = state.barostat[11:].reshape(3, 2)
    assert tried.sum() == 400
    assert np.all(np.exp(widths) > 0.03)
    assert np.all(barostat.acceptance(state) > 0.4)


def test_a_trial_is_a_function_of_the_state_and_the_seed():
    system, x = gas(n=10)
    barostat, other = MonteCarloBarostat(0.01, width=0.2), MonteCarloBarostat(0.01, width=0.2, rng=1)
    state = started(system, x, barostat)
    cell = system.cell
    once = barostat.move(system, state, 1.0, 1.0)
    for again, same in ((barostat, True), (other, False)):
        system.set_cell(cell, x)
        found = again.move(system, state, 1.0, 1.0)
        assert np.array_equal(found.barostat, once.barostat) == same


def test_overlaps_are_rejected():
    system, x = gas(n=10, force=lambda x, t, h: x, potential=lambda x, t, h: 0.0 if h[0, 0] >= 12 else np.inf)
    barostat = MonteCarloBarostat(1e6, width=0.2)
    state = started(system, x, barostat)
    for k in range(10):
        state = barostat.move(system, state, 1.0, 1.0)
        vars(state)["step"] = k
        assert np.array_equal(system.cell, 12 * np.eye(3))
        assert np.array_equal(state.positions, x)


@pytest.mark.parametrize("energy", [np.inf, -np.inf])
@pytest.mark.parametrize("barostat", [MonteCarloBarostat(1.0), CellRescaling(1.0, 1.0, 1.0)])
def test_an_energy_that_judges_nothing(barostat, energy):
    """Otherwise all trials would be accepted."""
    functions = {"potential": lambda x, t, h: energy, "stress": lambda x, t, h: np.zeros((3, 3))}
    system, x = gas(n=4, force=no_force, **functions)
    state = started(system, x, barostat)
    with pytest.raises(NonFiniteError, match="inf at step 0, by which no trial"):
        barostat.move(system, state, 1.0, 1.0)
    assert np.array_equal(system.cell, 12 * np.eye(3))


def test_a_cell_too_small_for_the_cutoff_is_refused_at_the_start():
    system, x = gas(n=4)
    with pytest.raises(InputError, match=r"width of 12, less than twice the cutoff \(6.1\)"):
        MonteCarloBarostat(1.0, cutoff=6.1).pieces(system, x)


def test_remainders_of_far_positions_are_kept():
    """What rounding takes from positions 1e6 away is known still after a trial."""
    system, x = gas(n=3)
    state = system.initial_state(x + 1e6, project=True)
    assert state.remainder is not None
    barostat = MonteCarloBarostat(0.0, width=0.2)
    vars(state)["barostat"] = barostat.begin(system)
    after = barostat.move(system, state, 1.0, 1.0)
    assert after.positions is not state.positions
    pairs = np.arange(6).reshape(-1, 2)
    d = np.diff(after.positions[pairs], axis=1)[:, 0]
    d -= np.round(d @ np.linalg.inv(after.cell)) @ after.cell
    d += np.diff(after.remainder[pairs], axis=1)[:, 0]
    assert np.linalg.norm(d, axis=1) == pytest.approx(np.ones(3), abs=2e-9)


def test_angles_of_the_cell_and_atoms_held_in_space():
    _, x = gas(n=2)
    held = ConstraintSet(FixedAtoms([0]), x, np.ones(4), cell=np.full(3, 12.0))
    system = CellSystem(Motion(held, x))
    barostat = MonteCarloBarostat(1.0, kind="flexible", held="stay")
    with pytest.raises(UnsupportedError, match="angles"):
        barostat.pieces(system, x)


def test_copies_know_no_pieces_of_systems():
    system, x = gas(n=4)
    barostat = MonteCarloBarostat(0.01, every=3, rng=5, width=0.2)
    state = started(system, x, barostat)
    after = barostat.move(system, state, 1.0, 1.0)
    for again in (pickle.loads(pickle.dumps(barostat)), copy.deepcopy(barostat), copy.copy(barostat)):
        system.set_cell(state.cell, x)
        assert repr(again) == repr(barostat)
        assert np.array_equal(again.move(system, state, 1.0, 1.0).barostat, after.barostat)


@pytest.mark.parametrize("shape", [DUMBBELL, TRIANGLE, METHANE], ids=["dumbbell", "triangle", "methane of rank 9"])
def test_volumes_of_a_rigid_ideal_gas(shape):
    """V^N exp(-P V/kT): the N of molecules, whatever the number of their atoms and rows."""
    n, side = 100, 12.0
    system, x = gas(shape, n, side)
    barostat = MonteCarloBarostat((n + 1) / side**3, rng=1, width=0.25)
    volumes = np.linalg.det(cells_of(system, started(system, x, barostat), barostat, 1200))
    exact = stats.gamma(n + 1, scale=side**3 / (n + 1))
    assert p_value(volumes, exact) > 0.01
    error = mean(volumes).error
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


def chain(kind, n, log_weight, steps, size=0.5, seed=1):
    """Metropolis' walk over cells, accepted as the barostats do."""
    strains, rng = Strains(kind), np.random.default_rng(seed)
    h, found = np.eye(3), np.empty((steps, 3, 3))
    for k in range(steps):
        e = size * (2 * rng.random(len(strains)) - 1)
        other = h @ strains.matrix(e, strains.frame(h))
        log = log_weight(other) - log_weight(h) + strains.log_measure(e, np.full(3, n))
        if math.log(rng.random()) < log:
            h = other
        found[k] = h
    return found


def test_shapes_of_a_flexible_cell():
    """V^N dV times the measure of shapes is dh for N = 2: under exp(-|h|^2/2) all nine entries are normal.

    Of the lower triangular factor of such a matrix the diagonal is chi(3), chi(2), chi(1), the rest normal.
    """
    cells = chain("flexible", 2, lambda h: -0.5 * (h**2).sum(), 30000)
    for i, expected in enumerate((stats.chi(3), stats.chi(2), stats.chi(1))):
        assert p_value(cells[:, i, i], expected) > 0.01
    for i, j in ((1, 0), (2, 0), (2, 1)):
        assert p_value(cells[:, i, j], stats.norm()) > 0.01
