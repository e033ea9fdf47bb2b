"""Sampling error against time: what is measured is right, and what goes wrong is shown."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from kcons.comparison import test_systems
from kcons.comparison.averages import sampling
from kcons.errors import InputError
from kcons.steppers import State
from kcons.thermostats import Isokinetic, configurational_temperature, mean, thermal_velocities


@pytest.fixture(scope="module")
def dumbbells():
    return test_systems.build_fluid("thermostat-dumbbells", 8)


@pytest.fixture(scope="module")
def result(dumbbells):
    return sampling.compare(dumbbells.with_time_steps([0.02, 0.01]), most=800)


def test_all_thermostats_at_all_steps(result):
    assert [(m.method, m.setting) for m in result.measurements] == [
        (name, dt) for name in sampling.METHODS for dt in (0.02, 0.01)
    ]
    assert {m.status for m in result.measurements} == {"ok"}


def test_averages_are_those_of_a_run_by_hand(dumbbells, result):
    """The same start, steps and samples, put together here."""
    forces, kt = dumbbells.forces, dumbbells.thermal_energy
    _, x, _ = forces.metropolis(dumbbells.positions, kt, 3000, 10, 1, dumbbells.shift, dumbbells.turn)
    energies = []
    for k in range(16):
        part, x, _ = forces.metropolis(x, kt, 500, 10, (1, k), dumbbells.shift, dumbbells.turn)
        energies.append(part)
    plain = mean(np.concatenate(energies))
    assert result.reference["energy"] == pytest.approx(plain.value / 8, rel=1e-12)
    assert result.reference["standard_error"] == pytest.approx(plain.error / 8, rel=1e-12)
    assert result.reference["moves_of_each_molecule"] == 8000

    system, stepper = dumbbells.system(), Isokinetic(kt, momentum="conserved")
    state = stepper.step(system, State(x, thermal_velocities(system, x, kt, 1, zero_momentum=True)), 0.01)
    samples = []
    for _ in range(800):
        for _ in range(4):
            state = stepper.step(system, state, 0.01)
        samples.append((*forces.rigid_sample(state.positions), forces.potential(state.positions)))
    squares, curvatures, potentials = np.transpose(samples)
    thermal, energy = configurational_temperature(squares, curvatures), mean(potentials)
    m = result.of("isokinetic")[1]
    assert (m.steps, m.samples, m.evaluations) == (3200, 800, 3200)
    assert m.temperature_error == pytest.approx(thermal.value / kt - 1, rel=1e-9)
    assert m.temperature_standard_error == pytest.approx(thermal.error / kt, rel=1e-9)
    assert m.energy_error == pytest.approx((energy.value - plain.value) / 8, rel=1e-9)
    assert m.energy_standard_error == pytest.approx(math.hypot(energy.error, plain.error) / 8, rel=1e-9)


def test_the_notes_convention_is_found_to_be_hot(result):
    """3N/(g - 1) = 48/36; the others are at the temperature asked for, as far as these runs can tell."""
    assert result.scene["degrees_of_freedom"] == 37
    assert result.scene["notes_temperature_error"] == pytest.approx(1 / 3)
    for name in sampling.METHODS:
        m = result.of(name)[1]
        expected = 1 / 3 if name == "isokinetic-notes" else 0.0
        assert abs(m.temperature_error - expected) <= 4 * m.temperature_standard_error
        assert m.temperature_standard_error <= 0.08


def test_costs(result):
    for m in result.measurements:
        assert m.evaluations == m.steps  # all of them need one for each step
        waits = (m.temperature_standard_error / sampling.GOAL) ** 2
        assert m.evaluations_to_goal == pytest.approx(waits * m.evaluations)
        assert m.seconds_to_goal == pytest.approx(waits * m.steps * m.step_seconds)
        assert 0 < m.step_seconds < m.seconds


def test_runs_are_shown_as_they_grow(result):
    m = result.of("langevin")[0]
    assert [moment.steps for moment in m.growth] == [200, 400, 800, 1600]  # 50 samples are too few
    assert [moment.evaluations for moment in m.growth] == [200, 400, 800, 1600]
    seconds = [moment.seconds for moment in m.growth]
    assert seconds == sorted(seconds)
    last = m.growth[-1]
    assert (last.temperature_error, last.energy_error) == (m.temperature_error, m.energy_error)


def test_results_can_be_repeated(dumbbells, result):
    again = sampling.compare(dumbbells.with_time_steps([0.02, 0.01]), methods=["langevin"], most=800)
    assert [m.temperature_error for m in again.measurements] == [m.temperature_error for m in result.of("langevin")]
    other = sampling.compare(dumbbells.with_time_steps([0.02]), methods=["langevin"], most=64, seed=2)
    assert other.reference["energy"] != again.reference["energy"]


def test_the_budget_ends_runs(dumbbells):
    found = sampling.compare(dumbbells.with_time_steps([0.01]), methods=["isokinetic"], budget=0.3)
    (m,) = found.measurements
    assert m.status == "ok" and m.seconds <= 0.31
    assert found.settings["budget_seconds"] == 0.3
    found = sampling.compare(dumbbells, methods=["isokinetic"], budget=1e-3)
    assert {m.status for m in found.measurements} == {"partial"}
    assert all("too few for an error" in m.note and m.temperature_error is None for m in found.measurements)
    assert found.reference["moves_of_each_molecule"] >= 10 * sampling.FEWEST


def test_steps_that_are_too_large_are_shown(dumbbells):
    found = sampling.compare(dumbbells.with_time_steps([5.0, 0.01]), methods=["isokinetic", "nose-hoover"], most=64)
    assert [m.status for m in found.measurements] == ["failed", "ok", "failed", "ok"]
    assert all("Error" in m.note for m in found.measurements if m.status == "failed")


def test_water():
    found = sampling.compare(
        test_systems.build_fluid("thermostat-water").with_time_steps([2.0]), methods=["isokinetic"], most=100
    )
    (m,) = found.measurements
    assert found.scene["degrees_of_freedom"] == 159
    assert m.status == "ok" and abs(m.temperature_error) <= 5 * m.temperature_standard_error <= 0.3
    assert m.steps == 800  # a sample each 16 fs


def test_bad_input(dumbbells):
    with pytest.raises(InputError, match="there is no thermostat 'rattle'; there are isokinetic"):
        sampling.compare(dumbbells, methods=["rattle"])
    with pytest.raises(InputError, match="no thermostat is named"):
        sampling.compare(dumbbells, methods=[])
    with pytest.raises(InputError, match="give a positive number of seconds"):
        sampling.compare(dumbbells, budget=0)
    with pytest.raises(InputError, match="63 samples are too few"):
        sampling.compare(dumbbells, most=63)
    assert [m.name for m in sampling.chosen(["all"])] == list(sampling.METHODS)


def test_plain_data(result):
    data = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert data["format"] == "kcons-sampling-1"
    assert len(data["measurements"]) == 8
    assert data["measurements"][0]["growth"][-1]["steps"] == 1600
    assert data["environment"]["cpu"]


def test_shifts_and_turns_have_their_own_temperatures(dumbbells, result):
    """Both make up the whole, and both see the convention that is hot."""
    for m in result.measurements:
        assert set(m.kinds) == {"shift", "turn"}
        values = [m.kinds[name][0] for name in ("shift", "turn")]
        assert min(values) <= m.temperature_error <= max(values)
    for value, error in result.of("isokinetic-notes")[1].kinds.values():
        assert abs(value - 1 / 3) <= 4 * error <= 0.6
    atoms = sampling.compare(test_systems.build_fluid("thermostat", 8), methods=["langevin"], most=64)
    assert all(set(m.kinds) == {"shift"} for m in atoms.of("langevin"))
    assert atoms.of("langevin")[0].kinds["shift"][0] == pytest.approx(atoms.of("langevin")[0].temperature_error)


def test_extrapolated_to_step_zero(result):
    """By the weighted fit to both steps; the reference is one for both, and its error counts once."""
    fine, coarse = result.of("langevin")[1], result.of("langevin")[0]
    found = result.extrapolated("langevin")
    assert set(found) == {"temperature", "energy", "shift", "turn"}
    assert found["temperature"].value == pytest.approx((4 * fine.temperature_error - coarse.temperature_error) / 3)
    known = result.reference["standard_error"]
    own = [math.sqrt(m.energy_standard_error**2 - known**2) for m in (fine, coarse)]
    assert found["energy"].error == pytest.approx(math.hypot(math.hypot(4 * own[0], own[1]) / 3, known))
    assert result.to_dict()["extrapolated"]["langevin"]["turn"]["order"] == 2
    one = dataclasses.replace(result, measurements=[fine])
    assert one.extrapolated("langevin") == {} and one.to_dict()["extrapolated"] == {}
