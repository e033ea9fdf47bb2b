"""Stochastic cell rescaling: exact volumes, the derivative it goes by, and the way to the pressure."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from pressure_systems import METHANE, cells_of, gas, no_force, p_value, round_shape, started
from scipy import stats

from kcons.thermostats import mean
from kcons.thermostats.langevin import noise_generator
from kcons.thermostats.pressure import CellRescaling, MonteCarloBarostat
from kcons.thermostats.pressure.barostat import Strains, energy_by_strain
from kcons.thermostats.pressure.pieces import find_pieces, lattice_of


@pytest.mark.parametrize("tau", [2.0, 30.0])
def test_volumes_of_a_rigid_ideal_gas(tau):
    """Also with steps that are long against tau, which are no longer those of an equation of motion."""
    n, side = 100, 12.0
    system, x = gas(METHANE, n, side)
    pressure = (n + 1) / side**3
    barostat = CellRescaling(pressure, tau, 1 / pressure, every=1, rng=2)
    state = started(system, x, barostat)
    volumes = np.linalg.det(cells_of(system, state, barostat, 1200))
    assert p_value(volumes, stats.gamma(n + 1, scale=1 / pressure)) > 0.01


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
    x = x + pieces.moved(x, np.linalg.inv(system.cell) @ cell - np.eye(3), lattice_of(system))
    system.set_cell(cell, x)
    found = energy_by_strain(system, pieces, x, system.forces(x, x, 0.0, 0), system.stress(x, 0.0))
    strains = Strains("flexible")
    frame = strains.frame(cell)
    for k, generator in enumerate(strains.generators_in(frame)):
        energies = []
        for h in (1e-5, -1e-5):
            matrix = strains.matrix(h * np.eye(6)[k], frame)
            system.set_cell(cell, x)
            y = x + pieces.moved(x, matrix - np.eye(3), lattice_of(system))
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
        monkeypatch.setattr("kcons.thermostats.pressure.barostat.noise_generator", turned)
        cells.append(cells_of(system, started(system, x, again), again, 40))
    first, second = (np.diagonal(found, axis1=1, axis2=2) for found in cells)
    assert second == pytest.approx(first[:, order], rel=1e-9)
    assert np.ptp(first, axis=1)[-1] > 0.05 and len(np.unique(first)) > 20


def round_stress(x, t, h):
    volume = abs(np.linalg.det(h))
    return 200 * volume ** (-5 / 3) * (h.T @ h - (h**2).sum() / 3 * np.eye(3))


@pytest.mark.parametrize("kind", ["semi-isotropic", "anisotropic", "flexible"])
def test_volumes_of_other_kinds(kind):
    """Beside a potential that keeps the shape of the cell and knows nothing of its volume."""
    n, side = 100, 12.0
    system, x = gas(n=n, side=side, force=no_force, potential=round_shape, stress=round_stress)
    pressure = (n + 1) / side**3
    barostat = CellRescaling(pressure, 8.0, 1 / pressure, every=1, rng=2, kind=kind)
    volumes = np.linalg.det(cells_of(system, started(system, x, barostat), barostat, 1200))
    assert p_value(volumes, stats.gamma(n + 1, scale=1 / pressure)) > 0.01


@pytest.mark.parametrize("kind", ["isotropic", "anisotropic", "flexible"])
def test_noise_of_few_pieces_stays_within_what_a_trial_may_change(kind):
    """Three pieces would change lengths by far more than 9 % in a trial, and all were rejected."""
    n, side = 3, 12.0
    system, x = gas(n=n, side=side, force=no_force, potential=round_shape, stress=round_stress)
    pressure = (n + 1) / side**3
    barostat = CellRescaling(pressure, 0.05, 1 / pressure, every=1, rng=2, kind=kind)
    state = started(system, x, barostat)
    volumes = np.linalg.det(cells_of(system, state, barostat, 3000))
    found = mean(volumes)
    assert len(np.unique(volumes)) > 0.6 * len(volumes)
    assert abs(found.off((n + 1) / pressure)) < 3.5 and found.error < 0.2 * side**3
