"""Compiled steps: those by the engine, operation by operation, and the engine where a kernel cannot go on."""

from __future__ import annotations

import numpy as np
import pytest
from thermostat_systems import ROWS, distance, isokinetics, molecules, springs

from kcons.errors import ConvergenceError
from kcons.steppers import State
from kcons.steppers.stages.compiled_operations import PYTHON
from kcons.thermostats import Isokinetic
from kcons.thermostats.isokinetic.isokinetic import IsokineticStep, programs

ORDERS = pytest.mark.parametrize("order", [2, 4, 6])
EVERY = pytest.mark.parametrize("name", ROWS)


@ORDERS
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"ions": 5},
        {"cell": np.diag([9.0, 8.0, 7.0]), "pbc": True},
        {"at": 1e6, "force": lambda x, t: springs(x - 1e6, t)},
    ],
    ids=["plain", "ions", "periodic", "far"],
)
@EVERY
def test_steps_are_those_made_operation_by_operation(name, options, order) -> None:
    system, state = molecules(name, **options)
    compiled, calls = isokinetics(system, order=order)
    state = compiled.start(system, state)
    close = 1e-9 if "at" in options else 2e-14
    for dt in (0.05, -0.02, 0.03):
        following, expected = compiled.step(system, state, dt), calls.step(system, state, dt)
        assert distance(following, expected) <= close
        assert distance(following, state) > 1e-3
        np.testing.assert_allclose(following.forces, expected.forces, rtol=0, atol=close)
        np.testing.assert_allclose(following.thermostat, expected.thermostat, rtol=1e-12 + close, atol=close)
        state = following


# -- where a kernel cannot go on --------------------------------------------------------------------


def noted(monkeypatch, method: str) -> list[int]:
    """Steps in which Python made an operation."""
    calls: list[int] = []
    made = getattr(IsokineticStep, method)

    def note(self, row, begun):
        calls.append(self.number)
        return made(self, row, begun)

    monkeypatch.setattr(IsokineticStep, method, note)
    return calls


def test_the_engine_lands_where_many_iterations_are_needed(monkeypatch) -> None:
    """As a flight that the kernel gives up; steps are the same, and those without solution name row and step."""
    system, state = molecules("triangles", force=lambda x, t: 0 * x)
    compiled, calls = isokinetics(system)
    made, taken, failed = noted(monkeypatch, "fly"), 0, 0
    state = compiled.start(system, state)
    for dt in np.geomspace(0.3, 30.0, 30):
        outcomes = []
        made.clear()
        for each in (compiled, calls):
            try:
                outcomes.append(each.step(system, state, float(dt)))
            except ConvergenceError as error:
                outcomes.append(error)
            if each is compiled:
                taken += bool(made) and isinstance(outcomes[0], State)
        one, two = outcomes
        if isinstance(two, State):
            assert distance(one, two) <= 1e-10
        else:
            failed += 1
            assert (one.step, one.row, one.atoms) == (two.step, two.row, two.atoms) == (1, two.row, two.atoms)
            assert f"step 1: time step too large (dt = {dt:g})" in str(one)
    assert taken and failed


def test_forces_too_strong_for_a_kick_without_projection(monkeypatch) -> None:
    """Along the bonds, where nothing of them may be left."""
    system, state = molecules("triangles")

    def strong(x, t):
        d = x[1::3] - x[0::3]
        push = np.zeros_like(x)
        push[0::3], push[1::3] = -1e9 * d, 1e9 * d
        return springs(x, t) + push

    system.force = strong
    compiled, calls = isokinetics(system)
    state = compiled.start(system, state)
    made = noted(monkeypatch, "first_turn")
    after = compiled.step(system, state, 0.02)
    assert made == [1]
    assert distance(after, calls.step(system, state, 0.02)) <= 1e-6


def test_velocities_against_a_strong_force(monkeypatch) -> None:
    """Digits would be lost in the closed form; the tangent one takes over."""
    system, state = molecules(name="bent", n=2)
    pull = np.array([0.0, 0.0, 1e8])
    system.force = lambda x, t: system.masses[:, None] * pull
    v = np.tile([0.0, 0.0, -1.0], (len(system.masses), 1))
    compiled, calls = isokinetics(system)
    start = compiled.start(system, State(state.positions, v))
    made = noted(monkeypatch, "first_turn")
    after = compiled.step(system, start, 0.01)
    assert made == [1]
    assert distance(after, calls.step(system, start, 0.01)) <= 1e-13
    assert system.kinetic_energy(after.velocities) == pytest.approx(0.5 * system.masses.sum(), rel=1e-14)


@pytest.mark.parametrize("method", ["first_turn", "turn"])
def test_turns_by_python_are_those_of_the_kernel(method) -> None:
    """Where a function says that it has done nothing, the method does all."""
    system, state = molecules("tetrahedra", ions=3)
    thermostat = Isokinetic(momentum="free", order=4)
    start = thermostat.start(system, state)
    expected = thermostat.step(system, start, 0.05)
    program = programs(thermostat.operations())[0]
    program.rows[:] = [r._replace(verb=PYTHON, function=None) if r.name == method else r for r in program.rows]
    thermostat._programs = (program, *thermostat._programs[1:])
    after = thermostat.step(system, start, 0.05)
    assert distance(after, start) > 0 and distance(after, expected) <= 1e-14
    np.testing.assert_allclose(after.thermostat, expected.thermostat, rtol=1e-12, atol=1e-13)
