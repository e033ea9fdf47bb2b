"""What passes through a program: positions to the last bit, velocities to the last digits."""

from __future__ import annotations

import numpy as np
import pytest
from carried_systems import context_of, free, state_of

from kcons.constraints import Distance
from kcons.openmm import ProjectedIntegrator
from kcons.openmm.callback_rows.hold import hold
from kcons.steppers import System, run


def test_positions_come_back_to_the_last_bit():
    """Carrying v through x must not move x: without forces and rows in the way, x = x0 + v t exactly as without."""
    system = free([12.0] * 4)
    part = hold(system, Distance([[0, 1]]), np.eye(4, 3))
    plain = context_of(free([12.0] * 4), ProjectedIntegrator(0.001))
    carried = context_of(system, ProjectedIntegrator(0.001, parts=[part]))
    x = np.eye(4, 3) + 1e-3
    v = np.array([[0.1, 0.1, 0.3], [0.1, 0.1, 0.3], [0.7, -0.3, 0.123456789], [1 / 3, 1e-9, 1e5]])
    for context in (plain, carried):
        context.setPositions(x)
        context.setVelocities(v)
        context.getIntegrator().step(20)
    (x_plain, v_plain), (x_carried, v_carried) = state_of(plain), state_of(carried)
    assert np.array_equal(x_plain[2:], x_carried[2:])
    assert np.array_equal(v_plain[2:], v_carried[2:])


def in_frame_of_its_centre(ratio):
    """A chain without forces whose masses are 1 and `ratio` in turn; masses, positions, velocities on the rows."""
    rng = np.random.default_rng(0)
    n = 12
    masses = np.where(np.arange(n) % 2 == 0, 1.0, ratio)
    k = np.arange(n)
    x = np.stack([0.1 * k, 0.05 * (k % 2), 0.02 * np.sin(k)], axis=1)
    x = x @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    x -= masses @ x / masses.sum()
    v = 0.1 * rng.normal(size=(n, 3)) / np.sqrt(masses)[:, None]
    v -= masses @ v / masses.sum()
    return masses, x, v


@pytest.mark.parametrize("every", [1, 500], ids=["looked at each step", "looked at now and then"])
@pytest.mark.parametrize("scheme", ["rattle", "suzuki4"])
@pytest.mark.parametrize("ratio", [10.0, 1e6])
def test_the_centre_of_mass_stays(scheme, every, ratio):
    """What rounds positions, and velocities on their way, must not add up in the momenta."""
    masses, x, v = in_frame_of_its_centre(ratio)
    system = free(masses)
    part = hold(system, Distance([[k, k + 1] for k in range(len(masses) - 1)]), x)
    integrator = ProjectedIntegrator(0.01, scheme=scheme, parts=[part])
    context = context_of(system, integrator)
    context.setPositions(x)
    context.setVelocities(v)
    part.apply_velocities(context)
    for _ in range(1000 // every):
        integrator.step(every)
        x, _ = state_of(context)
    assert np.abs(masses @ x / masses.sum()).max() <= 2e-15
    held = part.motion.constraint_set
    v = state_of(context)[1]
    assert np.abs(held.jacobian(x) @ v.ravel()).max() <= 1e-15


@pytest.mark.parametrize("every", [1, 50])
def test_velocities_are_those_of_the_core(every):
    """To the last digits, also where somebody looks at each step; carried with x they have three digits less."""
    masses, x, v = in_frame_of_its_centre(10.0)
    rows = Distance([[k, k + 1] for k in range(len(masses) - 1)])
    system = free(masses)
    part = hold(system, rows, x)
    core = System(part.motion)
    state = core.initial_state(x, v, project=True)
    integrator = ProjectedIntegrator(0.01, parts=[part])
    context = context_of(system, integrator)
    context.setPositions(x)
    context.setVelocities(state.velocities)
    for _ in range(500 // every):
        integrator.step(every)
        found = state_of(context)
        state = run(core, state, 0.01, every)
    assert np.abs(found[0] - state.positions).max() <= 1e-13
    assert np.abs(found[1] - state.velocities).max() <= 1e-13
