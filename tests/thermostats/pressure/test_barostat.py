"""What barostats have in common; volumes and shapes of cells that are known exactly; cell rescaling."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from pressure_systems import DUMBBELL, METHANE, TRIANGLE, cells_of, gas, no_force, p_value, round_shape, started
from scipy import stats

from kcons.errors import NonFiniteError
from kcons.steppers import State
from kcons.thermostats import CellRescaling, MonteCarloBarostat, mean
from kcons.thermostats.barostats import Strains
from kcons.thermostats.cells import energy_by_strain, find_pieces
from kcons.thermostats.noise import noise_generator


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


def test_a_trial_is_a_function_of_the_state_and_the_seed():
    system, x = gas(n=4)
    barostat = MonteCarloBarostat(0.01, every=3, rng=5, width=0.2)
    state = started(system, x, barostat)
    after = barostat.move(system, state, 1.0, 1.0)
    for again in (pickle.loads(pickle.dumps(barostat)), copy.deepcopy(barostat), copy.copy(barostat)):
        system.set_cell(state.cell, x)
        assert repr(again) == repr(barostat)
        assert np.array_equal(again.move(system, state, 1.0, 1.0).barostat, after.barostat)
    system.set_cell(state.cell, x)
    other = MonteCarloBarostat(0.01, every=3, rng=6, width=0.2)
    assert not np.array_equal(other.move(system, state, 1.0, 1.0).barostat, after.barostat)


def monte_carlo(pressure, width=0.25, **options):
    return MonteCarloBarostat(pressure, rng=1, width=width, **options)


def rescaling(pressure, tau=8.0, **options):
    return CellRescaling(pressure, tau, 1 / pressure, every=1, rng=2, **options)


@pytest.mark.parametrize(
    ("make", "shape"),
    [
        *((monte_carlo, shape) for shape in (DUMBBELL, TRIANGLE, METHANE)),
        *((partial(rescaling, tau=tau), METHANE) for tau in (2.0, 30.0)),
    ],
    ids=["dumbbell", "triangle", "methane of rank 9", "rescaling", "rescaling by steps that are long"],
)
def test_volumes_of_a_rigid_ideal_gas(make, shape):
    """V^N exp(-P V/kT): the N of molecules, whatever the number of their atoms and rows."""
    n, side = 100, 12.0
    system, x = gas(shape, n, side)
    barostat = make((n + 1) / side**3)
    volumes = np.linalg.det(cells_of(system, started(system, x, barostat), barostat, 1200))
    exact = stats.gamma(n + 1, scale=side**3 / (n + 1))
    assert p_value(volumes, exact) > 0.01
    error = mean(volumes).error
    assert abs(volumes.mean() - exact.mean()) < 3 * error
    # It could tell the number of molecules from that of atoms.
    assert p_value(volumes, stats.gamma(n * len(shape) + 1, scale=side**3 / (n + 1))) < 1e-6
    assert make is not monte_carlo or error < 0.01 * exact.mean()


def round_stress(x, t, h):
    volume = abs(np.linalg.det(h))
    return 200 * volume ** (-5 / 3) * (h.T @ h - (h**2).sum() / 3 * np.eye(3))


@pytest.mark.parametrize("make", [partial(monte_carlo, width=0.09), rescaling], ids=["Monte Carlo", "rescaling"])
@pytest.mark.parametrize("kind", ["semi-isotropic", "anisotropic", "flexible"])
def test_volumes_of_other_kinds(kind, make):
    """The volume is spread as in cells of one shape, beside a potential that keeps the shape of the cell."""
    n, side = 100, 12.0
    system, x = gas(DUMBBELL, n, side, force=no_force, potential=round_shape, stress=round_stress)
    barostat = make((n + 1) / side**3, kind=kind)
    cells = cells_of(system, started(system, x, barostat), barostat, 1500)
    assert p_value(np.linalg.det(cells), stats.gamma(n + 1, scale=side**3 / (n + 1))) > 0.01
    last = cells[-1]
    assert np.all(np.triu(cells, 1) == 0)
    if kind != "flexible":
        assert np.all(last == np.diag(np.diag(last)))
    if kind == "semi-isotropic":
        assert last[0, 0] == pytest.approx(last[1, 1], rel=1e-12) and abs(last[0, 0] - last[2, 2]) > 1e-3
    assert len(np.unique(last[np.tril_indices(3)])) > 1


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
    cells = chain("flexible", 2, lambda h: -0.5 * (h**2).sum(), 10000)
    for i, expected in enumerate((stats.chi(3), stats.chi(2), stats.chi(1))):
        assert p_value(cells[:, i, i], expected) > 0.01
    for i, j in ((1, 0), (2, 0), (2, 1)):
        assert p_value(cells[:, i, j], stats.norm()) > 0.01


def waves(k=0.7):
    """A field that is periodic in the cell, its forces and stress."""

    def phase(x, h):
        return 2 * np.pi * x @ np.linalg.inv(h).sum(axis=1)

    def potential(x, t, h):
        return k * np.cos(phase(x, h)).sum() + 0.3 * (h**2).sum()

    def force(x, t, h):
        return k * np.sin(phase(x, h))[:, None] * 2 * np.pi * np.linalg.inv(h).sum(axis=1)

    def stress(x, t, h):  # the phase is that of fractional coordinates, which a strain does not change
        return 0.6 * h.T @ h / abs(np.linalg.det(h))

    return {"force": force, "potential": potential, "stress": stress}


@pytest.mark.parametrize("turned", [False, True])
def test_energy_by_strain_is_the_derivative(turned):
    system, x = gas(METHANE, 6, **waves())
    rng = np.random.default_rng(5)
    cell = np.tril(0.5 * rng.standard_normal((3, 3))) + 12 * np.eye(3)
    if turned:
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        cell = cell @ (turn * np.sign(np.linalg.det(turn)))
    pieces = find_pieces(system, x, np.ones(3, bool))
    x = x + pieces.moved(x, np.linalg.inv(system.cell) @ cell - np.eye(3), system.lattice)
    system.set_cell(cell, x)
    found, _ = energy_by_strain(system, pieces, State(x, x))
    strains = Strains("flexible")
    frame = strains.frame(cell)
    for k, generator in enumerate(strains.generators_in(frame)):
        energies = []
        for h in (1e-5, -1e-5):
            matrix = strains.matrix(h * np.eye(6)[k], frame)
            system.set_cell(cell, x)
            y = x + pieces.moved(x, matrix - np.eye(3), system.lattice)
            system.set_cell(cell @ matrix, y)
            energies.append(system.energy(y, 0.0, 0))
        assert (found * generator).sum() == pytest.approx((energies[0] - energies[1]) / 2e-5, rel=1e-6, abs=1e-6)


class Turned:
    """A generator whose numbers are those of other axes."""

    def __init__(self, inner, order):
        self.inner, self.order, self.random = inner, order, inner.random

    def standard_normal(self, n):
        return self.inner.standard_normal(n)[self.order]

    def integers(self, n):
        return self.order.index(int(self.inner.integers(n)))


@pytest.mark.parametrize("order", [[1, 2, 0], [1, 0, 2]])
@pytest.mark.parametrize(
    "barostat",
    [
        CellRescaling(0.06, 2.0, 16.0, every=1, rng=2, kind="anisotropic"),
        MonteCarloBarostat(0.06, every=1, rng=2, kind="anisotropic", width=0.05),
    ],
    ids=["rescaling", "Monte Carlo"],
)
def test_no_axis_is_another_than_the_others(barostat, order, monkeypatch):
    """The same system with its axes in another order, and the same noise: the same cells in that order."""
    cells = []
    for taken in ([0, 1, 2], order):
        system, x = gas(METHANE, 6, **waves())
        x = np.ascontiguousarray(x[:, taken])
        again = copy.deepcopy(barostat)
        turned = lambda *key, taken=taken: Turned(noise_generator(*key), taken)  # noqa: E731
        monkeypatch.setattr("kcons.thermostats.barostats.noise_generator", turned)
        cells.append(cells_of(system, started(system, x, again), again, 40))
    first, second = (np.diagonal(found, axis1=1, axis2=2) for found in cells)
    assert second == pytest.approx(first[:, order], rel=1e-9)
    assert np.ptp(first, axis=1)[-1] > 0.05 and len(np.unique(first)) > 20


@pytest.mark.parametrize("kind", ["isotropic", "anisotropic", "flexible"])
def test_noise_of_few_pieces_stays_within_what_a_trial_may_change(kind):
    """Three pieces would change lengths by far more than 9 % in a trial, and all were rejected."""
    n, side = 3, 12.0
    system, x = gas(n=n, side=side, force=no_force, potential=round_shape, stress=round_stress)
    pressure = (n + 1) / side**3
    barostat = CellRescaling(pressure, 0.05, 1 / pressure, every=1, rng=2, kind=kind)
    state = started(system, x, barostat)
    volumes = np.linalg.det(cells_of(system, state, barostat, 1500 if kind == "isotropic" else 3000))
    found = mean(volumes)
    assert len(np.unique(volumes)) > 0.6 * len(volumes)
    assert abs(found.off((n + 1) / pressure)) < 3.5 and found.error < 0.2 * side**3
