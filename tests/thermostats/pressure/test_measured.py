"""Pressures of a state, by pieces, by atoms and by energies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pressure_systems import METHANE, TRIANGLE, gas

from kcons.constraints import Distance, MovingTarget
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.motion import Motion
from kcons.steppers import run
from kcons.thermostats import (
    CellSystem,
    ConstantPressure,
    Langevin,
    MonteCarloBarostat,
    find_pieces,
    instantaneous_pressure,
    thermal_velocities,
)
from kcons.thermostats.barostats import Place

SIDE = 12.0


def springs(k=0.3):
    """Harmonic springs between minimum images of atoms 0, m, 2 m ... and their virial: a stress with shear."""

    def ends(x, h, m):
        d = x[::m][1:] - x[::m][:-1]
        return d - np.round(d @ np.linalg.inv(h)) @ h

    def functions(m):
        def potential(x, t, h):
            return 0.5 * k * (ends(x, h, m) ** 2).sum()

        def force(x, t, h):
            f, push = np.zeros_like(x), k * ends(x, h, m)
            f[::m][:-1] += push
            f[::m][1:] -= push
            return f

        def stress(x, t, h):
            d = ends(x, h, m)
            return k * d.T @ d / abs(np.linalg.det(h))

        return {"force": force, "potential": potential, "stress": stress}

    return functions


def started(shape=TRIANGLE, n=12, **functions):
    system, x = gas(shape, n, SIDE, **(functions or springs()(len(shape))))
    return system, system.initial_state(x, thermal_velocities(system, x, 1.0, 2))


@pytest.mark.parametrize("shape", [TRIANGLE, METHANE], ids=["triangle", "dependent rows"])
def test_three_ways_to_one_pressure(shape):
    """Of rigid molecules all agree at any instant: d/dt of sum m r.v about their centers is zero."""
    system, state = started(shape)
    state = run(system, state, 0.05, 5, stepper=Langevin(1.0, 1.0, rng=1))
    molecular, atomic, difference = (
        instantaneous_pressure(system, state, way) for way in ("molecular", "atomic", "difference")
    )
    assert np.trace(atomic) == pytest.approx(np.trace(molecular), abs=1e-12)
    assert np.trace(difference) == pytest.approx(np.trace(molecular), rel=1e-6)
    assert abs(atomic - molecular).max() > 1e-4  # in single directions they are equal in the mean only
    assert molecular == pytest.approx(molecular.T, abs=1e-14)
    assert system.cell == pytest.approx(SIDE * np.eye(3), abs=0)


def test_the_pressure_of_an_earlier_cell():
    """What is asked of a state is answered in its cell."""
    system, early = started()
    told = [instantaneous_pressure(system, early, way) for way in ("molecular", "atomic", "difference")]
    energy = system.total_energy(early)
    barostat = MonteCarloBarostat(1.0, every=1, width=0.2)
    run(system, early, 0.05, 5, stepper=ConstantPressure(Langevin(1.0, 1.0, rng=1), barostat))
    assert system.volume != pytest.approx(SIDE**3, rel=1e-3)
    for way, value in zip(("molecular", "atomic", "difference"), told, strict=True):
        assert instantaneous_pressure(system, early, way) == pytest.approx(value, abs=1e-13)
    system.set_cell(1.1 * system.cell, early.positions)
    assert system.total_energy(early) == pytest.approx(energy, rel=1e-14)


def test_a_rod_that_is_made_longer():
    """At rest but for that: 3 P V = mu (L'^2 + L L'') by the time of the state, the second of which the rod pushes."""
    time, mu = 0.7, 2.0 * 3.0 / 5.0
    rod = MovingTarget(lambda t: 2.0 + np.sin(t), np.cos, lambda t: -np.sin(t))
    length, rate, acceleration = rod.value(time), rod.rate(time), rod.acceleration(time)
    x = np.array([[5.0, 5.0, 5.0], [5.0 + length, 5.0, 5.0]])
    held = ConstraintSet(Distance([[0, 1]], rod), x, [2.0, 3.0], cell=np.full(3, SIDE), time=time)
    system = CellSystem(Motion(held, x, time=time), **springs(0.0)(1))
    found = instantaneous_pressure(system, system.initial_state(x, time=time), "atomic")
    assert np.trace(found) * SIDE**3 == pytest.approx(mu * (rate**2 + length * acceleration), rel=1e-12)


@pytest.mark.parametrize("kind", ["isotropic", "anisotropic"])
def test_the_mean_stress_along_each_axis_is_the_pressure(kind):
    """The slope of ln of the distribution that trials sample is V (P_kk - P)/kT + 1, along each axis.

    Its mean is zero, by parts: the mean of V (P_kk - P) is -kT, whatever the forces.
    """
    system, state = started()
    pressure, thermal, h = 0.02, 1.3, 1e-5
    barostat = MonteCarloBarostat(pressure, kind=kind)
    pieces = barostat.pieces(system, state.positions)
    before = Place(system, pieces, state, thermal, 1.0, False)
    stress = np.diag(instantaneous_pressure(system, state, thermal_energy=thermal))
    found = []
    for mode in range(len(barostat.strains)):
        slopes = []
        for e in (h, -h):
            e = e * np.eye(len(barostat.strains))[mode]
            matrix = barostat.strains.matrix(e, None)
            y = state.positions + pieces.moved(state.positions, matrix - np.eye(3), system.lattice)
            system.set_cell(before.cell @ matrix, y)
            after = Place(system, pieces, replace(state, positions=y), thermal, 1.0, False)
            slopes.append(barostat._log_chance(before, after, e))
            system.set_cell(before.cell, state.positions)
        found.append((slopes[0] - slopes[1]) / (2 * h))
    if kind == "isotropic":
        stress = np.array([stress.mean()])
    assert found == pytest.approx(SIDE**3 * (stress - pressure) / thermal + 1, rel=1e-7)
    assert np.ptp(stress) > 1e-3 or kind == "isotropic"


def test_what_is_refused():
    system, state = started()
    few, there = started(n=3)
    with pytest.raises(InputError, match="pieces are those of 9 atoms"):
        pieces = find_pieces(few, there.positions, np.ones(3, dtype=bool))
        instantaneous_pressure(system, state, pieces=pieces, thermal_energy=1.0)
    x = state.positions
    held = ConstraintSet(Distance([[0, 1]]), x, np.ones(len(x)), cell=np.full(3, SIDE))
    blind = CellSystem(Motion(held, x), lambda x, t, h: 0 * x, lambda x, t, h: 0.0)
    with pytest.raises(UnsupportedError, match="stress"):
        instantaneous_pressure(blind, blind.initial_state(x), thermal_energy=1.0)
    found = instantaneous_pressure(blind, blind.initial_state(x), "difference", thermal_energy=1.0)
    assert found == pytest.approx((len(x) - 1) / SIDE**3 * np.eye(3))
    endless = CellSystem(Motion(held, x), lambda x, t, h: 0 * x, lambda x, t, h: np.inf)
    with pytest.raises(NonFiniteError, match="inf and inf"):
        instantaneous_pressure(endless, endless.initial_state(x), "difference", thermal_energy=1.0)
    assert np.array_equal(endless.cell, SIDE * np.eye(3))


@pytest.mark.parametrize("kind", ["normal", "lateral", "isotropic"])
def test_the_mean_is_the_pressure_that_the_barostat_keeps(kind):
    """Along the axes it changes: differences scaled the others as well, and the mean had a third of each axis."""
    system, state = started()
    barostat = MonteCarloBarostat(0.02, kind=kind)
    pieces, axes = barostat.pieces(system, state.positions), barostat.strains.axes
    whole, told = (instantaneous_pressure(system, state, way, pieces=pieces) for way in ("molecular", "difference"))
    kept = np.diagonal(whole)[axes].mean()
    assert np.diagonal(told)[axes].mean() == pytest.approx(kept, rel=1e-5)
    assert kind == "isotropic" or kept != pytest.approx(np.trace(whole) / 3, rel=1e-3)
