"""Steps through compiled halves: those made call by call, and the engine where a half cannot be done."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from thermostat_systems import ROWS, distance, molecules, springs, thermostats

from kcons.errors import NonFiniteError
from kcons.steppers import run
from kcons.thermostats import Isokinetic
from kcons.thermostats.isokinetic.fused_step import ENGINE, KICK

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
def test_steps_are_those_made_call_by_call(name, options, order) -> None:
    system, state = molecules(name, **options)
    halves, calls = thermostats(system, order=order)
    state = halves.start(system, state)
    close = 1e-9 if "at" in options else 2e-14
    for dt in (0.05, -0.02, 0.03):
        following, expected = halves.step(system, state, dt), calls.step(system, state, dt)
        assert distance(following, expected) <= close
        assert distance(following, state) > 1e-3
        np.testing.assert_allclose(following.forces, expected.forces, rtol=0, atol=close)
        np.testing.assert_allclose(following.thermostat, expected.thermostat, rtol=1e-12 + close, atol=close)
        state = following


@ORDERS
def test_a_part_of_the_atoms(order) -> None:
    """The others, held ones too, are only pushed."""
    system, state = molecules("triangles", ions=5)
    halves, calls = thermostats(system, order=order, atoms=np.arange(15), kinetic_energy=2.0)
    state = halves.start(system, state)
    for _ in range(3):
        following, expected = halves.step(system, state, 0.05), calls.step(system, state, 0.05)
        assert distance(following, expected) <= 2e-14
        state = following
    inside = 0.5 * system.masses[:15] @ np.einsum("ij,ij->i", state.velocities[:15], state.velocities[:15])
    assert inside == pytest.approx(2.0, rel=1e-14)


def test_kinetic_energy_stays() -> None:
    system, state = molecules("triangles", ions=3)
    thermostat = thermostats(system, kinetic_energy=2.0)[0]
    worst = 0.0
    for _ in range(300):
        state = run(system, state, 0.02, 10, stepper=thermostat)
        worst = max(worst, abs(system.kinetic_energy(state.velocities) / 2.0 - 1))
    assert worst <= 1e-14
    held = system.motion.constraint_set
    assert np.abs(held.value(state.positions)).max() <= 1e-14
    assert np.abs(held.jacobian(state.positions) @ state.velocities.ravel()).max() <= 1e-14


def test_what_came_in_stays_as_it_was() -> None:
    seen: list[tuple[np.ndarray, np.ndarray]] = []

    def force(x, t):
        seen.append((x, x.copy()))
        return springs(x, t)

    system, state = molecules(force=force)
    thermostat = thermostats(system)[0]
    state = thermostat.start(system, state)
    arrays = (state.positions, state.velocities, state.forces, state.thermostat)
    before = [a.copy() for a in arrays]
    for array in arrays:
        array.flags.writeable = False
    for order in (2, 4):
        Isokinetic(order=order).step(system, state, 0.05)
    assert all(np.array_equal(a, b) for a, b in zip(arrays, before, strict=True))
    assert len(seen) == 1 + 1 + 6
    assert all(np.array_equal(a, b) for a, b in seen)


@ORDERS
@EVERY
def test_any_layout_of_the_arrays(name, order) -> None:
    """Kernels read raw memory."""
    system, state = molecules(name)
    thermostat = thermostats(system, order=order)[0]
    state = thermostat.start(system, state)
    expected = thermostat.step(system, state, 0.05)
    for item in ("positions", "velocities", "forces"):
        turned = replace(state, **{item: np.asfortranarray(getattr(state, item))})
        assert distance(thermostat.step(system, turned, 0.05), expected) <= 1e-15


# -- where a half cannot be done --------------------------------------------------------------------


def test_the_engine_lands_where_many_iterations_are_needed(monkeypatch) -> None:
    """As a flight that the kernel gives up; the step is the same."""
    system, state = molecules("triangles")
    compiled, calls = thermostats(system)
    state = compiled.start(system, state)
    expected = calls.step(system, state, 0.05)
    stages = compiled._share(system).stages
    after = stages.after

    monkeypatch.setattr(stages, "after", lambda *given: (ENGINE, *after(*given)[1:]))
    assert distance(compiled.step(system, state, 0.05), expected) <= 1e-13
    monkeypatch.setattr(stages, "before", lambda *given: (ENGINE, None, None, 0.0))
    assert distance(compiled.step(system, state, 0.05), expected) <= 1e-13


def test_forces_too_strong_for_a_kick_without_projection() -> None:
    """Along the bonds, where nothing of them may be left."""
    system, state = molecules("triangles")

    def strong(x, t):
        d = x[1::3] - x[0::3]
        push = np.zeros_like(x)
        push[0::3], push[1::3] = -1e9 * d, 1e9 * d
        return springs(x, t) + push

    system.force = strong
    compiled, calls = thermostats(system)
    state = compiled.start(system, state)
    stages = compiled._share(system).stages
    given = (state.thermostat[2], state.thermostat[0], 0.01, 0.02)
    assert stages.before(state.positions, state.velocities, state.forces, *given, stages.tables())[0] == KICK
    after, expected = compiled.step(system, state, 0.02), calls.step(system, state, 0.02)
    assert distance(after, expected) <= 1e-6


@ORDERS
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_force_that_is_not_finite(order, bad) -> None:
    system, state = molecules("triangles", ions=2)
    thermostat = thermostats(system, order=order)[0]
    state = run(system, state, 0.01, 4, stepper=thermostat)
    before = state.positions.copy(), state.velocities.copy()

    def force(x, t):
        f = springs(x, t)
        f[7, 1] = bad
        return f

    system.force = force
    with pytest.raises(NonFiniteError, match="non-finite force at step 5 on atom 7") as caught:
        thermostat.step(system, state, 0.01)
    assert caught.value.step == 5
    assert np.array_equal(state.positions, before[0]) and np.array_equal(state.velocities, before[1])
