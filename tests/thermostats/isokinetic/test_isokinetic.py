"""The isokinetic thermostat: the right motion, its order, and its constants."""

from __future__ import annotations

import functools
import io
import math
from dataclasses import replace

import numpy as np
import pytest
from reference import cases
from thermostat_systems import (
    dumbbells,
    integrated,
    quartic,
    quartic_potential,
    swirling,
    system,
    water_and_more,
    waves,
)

from kcons.constraints import Ellipsoid, Torus
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion
from kcons.steppers import State, System, run
from kcons.thermostats import Isokinetic, thermal_velocities

ORDERS = pytest.mark.parametrize("order", [2, 4, 6])
NAMES = [name for name in cases.NAMES if "isokinetic" in name]
#: Single atoms and free clusters: there is no temperature, and it is said.
HAS_NO_TEMPERATURE = "ignore:(total momentum|the forces exert):UserWarning"


@functools.cache
def referenced(name: str) -> System:
    case = cases.load(name)
    start = case.initial.positions
    motion = Motion(ConstraintSet(case.constraints, start, case.masses), start)
    return System(motion, lambda x, t: case.force(x, np.zeros_like(x)), potential=lambda x, t: case.potential(x))


def begin(name: str) -> State:
    return State(cases.load(name).initial.positions, cases.load(name).initial.velocities)


def error(a: State, b: cases.Snapshot) -> float:
    return max(np.abs(a.positions - b.positions).max(), np.abs(a.velocities - b.velocities).max())


#: Steps a unit of time for each order, few enough for errors to be above rounding.
STEPS = {2: (40, 80), 4: (8, 16), 6: (4, 8)}


def slope(counts, errors) -> float:
    return float(-np.polyfit(np.log(counts), np.log(errors), 1)[0])


# -- against independent solutions ------------------------------------------------------------------


@pytest.mark.filterwarnings(HAS_NO_TEMPERATURE)
@pytest.mark.parametrize("name", NAMES)
def test_reference_trajectories_to_their_tolerance(name):
    held, case, state = referenced(name), cases.load(name), begin(name)
    thermostat = Isokinetic(order=6)
    kinetic = held.kinetic_energy(state.velocities)
    steps = {"A10_isokinetic_lj4": 500, "A10_isokinetic_dumbbell_quartic": 120}.get(name, 100)
    for target in case.solution:
        span = target.time - state.time
        if target.time > 10:  # lj4 is chaotic
            break
        state = run(held, state, span / round(steps * span), round(steps * span), stepper=thermostat)
        assert error(state, target) <= target.tolerance, target.time
        assert state.velocities.ravel() @ state.forces.ravel() / (2 * kinetic) == pytest.approx(target.alpha, abs=1e-10)
        assert held.kinetic_energy(state.velocities) == pytest.approx(kinetic, rel=3e-15)


@pytest.mark.filterwarnings(HAS_NO_TEMPERATURE)
@ORDERS
@pytest.mark.parametrize("name", NAMES)
def test_order_on_the_reference_trajectories(name, order):
    held, target = referenced(name), cases.load(name).solution[0]
    counts = np.array(STEPS[order]) * (2 if "constant" not in name else 1)
    if "lj4" in name:
        counts = 12 * counts
    errors = [
        error(run(held, begin(name), target.time / n, n, stepper=Isokinetic(order=order)), target) for n in counts
    ]
    assert slope(counts, errors) == pytest.approx(order, abs=0.15), errors


def on_ellipsoid():
    a, s = np.array([1.2, 0.9, 0.7]), np.array([0.5, 0.6, math.sqrt(0.39)])
    return [Ellipsoid([0], [0, 0, 0], a)], [a * s, [2.0, 1.0, 0.0]], [1.5, 1.0]


def on_torus():
    return [Torus([0], [0, 0, 0], [0, 0, 1.0], 1.5, 0.5)], [[2.0, 0.0, 0.0]], [1.3]


@functools.cache
def solved(made):
    held = system(*made(), waves)
    x = np.array(made()[1])
    start = held.initial_state(x, thermal_velocities(held, x, 0.8, 3))
    return held, start, integrated(held, start, 1.0)


#: Many projections on curved surfaces, which the others have too.
COSTLY = {(on_ellipsoid, 4), (on_torus, 4), (on_torus, 6)}


@pytest.mark.parametrize(
    ("made", "order"),
    [
        pytest.param(
            made, order, id=f"{made.__name__}-{order}", marks=[pytest.mark.validation] * ((made, order) in COSTLY)
        )
        for made in (water_and_more, on_ellipsoid, on_torus)
        for order in (2, 4, 6)
    ],
)
def test_order_with_constraints(made, order):
    """Against Gauss's principle with v^T M as one more row, solved densely as an ordinary differential equation."""
    check_order(made, order, 2 * np.array(STEPS[order]))


def check_order(made, order, counts):
    held, start, exact = solved(made)
    kinetic = held.kinetic_energy(start.velocities)
    errors = []
    for n in counts:
        after = run(held, start, 1.0 / n, n, stepper=Isokinetic(order=order))
        errors.append(max(np.abs(after.positions - exact[0]).max(), np.abs(after.velocities - exact[1]).max()))
        assert held.kinetic_energy(after.velocities) == pytest.approx(kinetic, rel=1e-14)
    assert slope(counts, errors) == pytest.approx(order, abs=0.15), errors


# -- constants --------------------------------------------------------------------------------------


@pytest.mark.filterwarnings(HAS_NO_TEMPERATURE)
@ORDERS
def test_momenta_grow_with_the_potential(order):
    """P exp(-U/2K) and L exp(-U/2K) are constants of the motion, P even of kicks and drifts, for orders 2, 4, 6."""
    name = "A10_isokinetic_lj4"
    held, case = referenced(name), cases.load(name)
    start = begin(name)
    twice = 2 * held.kinetic_energy(start.velocities)
    m = case.masses[:, None]

    def momenta(state):
        boost = math.exp(-case.potential(state.positions) / twice)
        center = (m * state.positions).sum(axis=0) / m.sum()
        total = (m * state.velocities).sum(axis=0)
        turning = np.cross(state.positions - center, m * state.velocities).sum(axis=0)
        return np.concatenate([total, turning]) * boost

    expected = momenta(start)
    assert np.abs(expected).max() > 0.01
    n = {2: 4000, 4: 1600, 6: 500}[order]
    off = np.abs(momenta(run(held, start, 1.0 / n, n, stepper=Isokinetic(order=order))) - expected).max()
    assert off <= {2: 1e-5, 4: 1e-10, 6: 1e-10}[order] * np.abs(expected).max()


def test_conserved_energy_has_no_slope():
    held, x = dumbbells(2, force=quartic, potential=quartic_potential)
    thermostat = Isokinetic(0.5)
    state = thermostat.start(held, held.initial_state(x, thermal_velocities(held, x, 0.5, 4)))
    first = thermostat.conserved_energy(held, state)
    values = []
    run(
        held,
        state,
        0.01,
        20_000,
        stepper=thermostat,
        observers=[lambda s: values.append(thermostat.conserved_energy(held, s))],
        every=20,
    )
    assert first == values[0] == pytest.approx(quartic_potential(x), rel=1e-14)
    trend = np.polyfit(np.linspace(0, 200, len(values)), values, 1)[0]
    assert np.std(values) <= 2e-3
    # What a random walk leaves; a thermostat that leaks energy shows 1e-3 and more.
    assert abs(trend) <= 3e-5


def constancy(steps: int, every: int) -> float:
    rows, x, masses = water_and_more()
    held = system(rows, x, masses, lambda x, t: 3 * waves(x) - quartic(0.1 * x))
    thermostat = Isokinetic(0.5)
    state = thermostat.start(held, held.initial_state(x, thermal_velocities(held, x, 0.5, 4)))
    twice = (15 - 4 - 1) * 0.5
    worst = 0.0
    for _ in range(steps // every):
        state = run(held, state, 0.01, every, stepper=thermostat)
        worst = max(worst, abs(2 * held.kinetic_energy(state.velocities) / twice - 1))
    return worst


def test_kinetic_energy_is_constant():
    assert constancy(20_000, 100) <= 1e-14


@pytest.mark.validation
@pytest.mark.filterwarnings("ignore:no atom or body")
def test_kinetic_energy_is_constant_over_a_million_steps():
    assert constancy(1_000_000, 1000) <= 1e-13


@pytest.mark.parametrize(("momentum", "expected"), [("auto", 9), ("free", 12), ("conserved", 9)])
def test_a_loaded_run_of_other_degrees_of_freedom_begins_anew(momentum, expected):
    """Fewer rows, or another `momentum`, than the run had that was saved."""
    held, x = dumbbells(2, force=swirling, potential=None)
    v = thermal_velocities(held, x, 1.0, 1, zero_momentum=True)
    saved = run(held, State(x, v), 0.01, 5, stepper=Isokinetic(1.0))
    assert saved.thermostat[3] == 7
    file = io.BytesIO()
    saved.save(file)
    file.seek(0)
    free = system([], x, held.masses, swirling)
    after = run(free, State.load(file), 0.01, 5, stepper=Isokinetic(1.0, momentum=momentum))
    assert after.thermostat[3] == expected
    assert (held.masses[:, None] * after.velocities**2).sum() == pytest.approx(expected - 1, rel=1e-12)


@pytest.mark.parametrize("changed", ["temperature", "attribute", "convention"])
def test_a_run_that_goes_on_with_other_settings_takes_them(changed):
    held, x = dumbbells(3)
    thermostat = Isokinetic(1.0)
    state = run(held, State(x, thermal_velocities(held, x, 1.0, 1)), 0.01, 5, stepper=thermostat)
    g = int(state.thermostat[3])
    if changed == "temperature":
        thermostat, wanted = Isokinetic(2.0), 2.0 * (g - 1)
    elif changed == "attribute":
        thermostat.thermal_energy, wanted = 2.0, 2.0 * (g - 1)
    else:
        thermostat, wanted = Isokinetic(1.0, convention="notes"), 18.0
    after = run(held, state, 0.01, 5, stepper=thermostat)
    assert 2 * held.kinetic_energy(after.velocities) == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize("by_hand", [False, True])
def test_velocities_put_into_a_run_are_scaled_before_its_next_step(by_hand):
    """They had the length of their own in the first flight, and only then that of the thermostat."""
    held, x = dumbbells(3)
    thermostat = Isokinetic(1.0)
    state = run(held, State(x, thermal_velocities(held, x, 1.0, 1)), 0.01, 5, stepper=thermostat)
    put = replace(state, velocities=3 * state.velocities)
    if by_hand:
        put = State(state.positions, 3 * state.velocities, forces=state.forces, thermostat=state.thermostat)
    after = thermostat.step(held, put, 0.01)
    expected = Isokinetic(1.0).step(held, replace(state, thermostat=None), 0.01)
    np.testing.assert_allclose(after.positions, expected.positions, atol=1e-14)
    np.testing.assert_allclose(after.velocities, expected.velocities, atol=1e-13)


def test_positions_put_into_a_run_with_their_forces():
    """The square of the forces along the constraints is that of these."""
    held, x = dumbbells(3)
    thermostat = Isokinetic(1.0)
    state = run(held, State(x, thermal_velocities(held, x, 1.0, 1)), 0.01, 5, stepper=thermostat)
    there = state.positions + np.array([0.4, -0.3, 0.2])
    put = State(there, state.velocities, forces=held.force(there, 0.0), thermostat=state.thermostat)
    after = thermostat.step(held, put, 0.01)
    expected = Isokinetic(1.0).step(held, replace(put, forces=None), 0.01)
    assert after.thermostat[1] == pytest.approx(expected.thermostat[1], rel=1e-12)
    np.testing.assert_allclose(after.positions, expected.positions, atol=1e-14)
