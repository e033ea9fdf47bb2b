"""Constraint objects of kcons in OpenMM's motion: exactness, order, closed forms, targets that move."""

from __future__ import annotations

import numpy as np
import pytest
from carried_systems import (
    begun,
    context_of,
    driven,
    free,
    off_target,
    pull,
    state_of,
)
from openmm import unit

from kcons.constraints import Angle, CenterOfMass, Distance, FixedAtoms, RadiusOfGyration, Sphere
from kcons.errors import InputError
from kcons.openmm import ProjectedIntegrator, hold
from kcons.steppers import System, run


def test_particles_without_mass_take_no_degree_of_freedom():
    """Bonds to a particle that OpenMM does not move, and one that is held there as well: two degrees go, not eight."""
    system = free([0.0, 12.0, 12.0, 0.0])
    x = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0.5, 0.5, 0.5]])
    part = hold(system, [Distance([[0, 1], [1, 2]]), FixedAtoms([3])], x)
    integrator = ProjectedIntegrator(0.001, parts=[part])
    context = context_of(system, integrator)
    context.setPositions(x)
    assert part.rank(context) == 2
    assert integrator.degrees_of_freedom(context) == 2 * 3 - 2
    context.setVelocities([[0, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0, 0]])
    integrator.step(5)
    twice = 2 * integrator.kinetic_energy() / (4 * unit.MOLAR_GAS_CONSTANT_R)
    assert integrator.computeSystemTemperature() / unit.kelvin == pytest.approx(twice / unit.kelvin, rel=1e-12)


@pytest.mark.parametrize("calls", [[40], [1, 2, 3]])
def test_targets_move_with_the_time_after_a_new_step_size(calls):
    """On Reference and CPU, OpenMM's clock goes on with the first step size within a call."""
    integrator, context = begun(*driven())
    integrator.step(20)
    integrator.setStepSize(0.005)
    for steps in calls:
        integrator.step(steps)
        assert off_target(context) < 1e-12


def test_time_that_is_set_is_no_way_of_moving_targets():
    """What a step would have to go is made into velocity of all that hangs on the rows."""
    integrator, context = begun(*driven())
    integrator.step(2)
    context.setTime(3.0)
    with pytest.raises(InputError, match="positions are off row"):
        integrator.step(1)


@pytest.mark.usefixtures("without_device")
def test_steps_within_a_call_have_the_time_of_a_new_step_size():
    """Targets moved with the old one in the middle of a call, and leapt back before its end."""
    seen = []

    def target(t):
        seen.append(t)
        return 0.3 + 0.05 * t

    x = np.array([[0.0, 0, 0], [0.3, 0, 0]])
    system = free([12.0, 12.0])
    integrator, _ = begun(system, hold(system, Distance([[0, 1]], target), x), x)
    integrator.step(20)
    integrator.setStepSize(0.005)
    seen.clear()
    integrator.step(40)
    np.testing.assert_allclose(seen[:38], 0.2 + 0.005 * np.arange(1, 39), rtol=0, atol=1e-12)


@pytest.mark.parametrize("platform", ["Reference", "CPU"])
@pytest.mark.parametrize("tie", [Angle([[0, 1, 2]]), RadiusOfGyration([[0, 1, 2]]), Distance([[0, 1], [1, 2]])])
def test_places_of_a_molecule_that_is_stored_in_several_images(platform, tie):
    """As the whole molecule without a cell, each place moved along with the image in which its atom is stored."""
    whole = np.array([[0.98, 0.5, 0.5], [1.03, 0.5, 0.55], [1.06, 0.54, 0.5]])
    ends = []
    for images in (np.zeros((3, 3)), np.array([[0, 0, 0], [-1.0, 0, 0], [-1, 2, 0]])):
        system = free([12.0, 1.0, 16.0], pull(20.0, 3))
        system.setDefaultPeriodicBoxVectors([1, 0, 0], [0, 1, 0], [0, 0, 1])
        places = whole + images + [[0, 0.1, 0], [0, -0.1, 0], [0, 0, 0]]
        rows = [Sphere([0, 1], places[:2]), CenterOfMass([[1, 2]], axes=(0,)), tie]
        part = hold(system, rows, whole + images, periodic=bool(images.any()))
        integrator = ProjectedIntegrator(0.001, parts=[part])
        context = context_of(system, integrator, platform)
        context.setPositions(whole + images)
        context.setVelocities(part.motion.project_velocities(whole + images, np.full((3, 3), 0.3)))
        integrator.step(100)
        x, v = state_of(context)
        centers = np.linalg.norm(x[:2] - places[:2], axis=1)
        np.testing.assert_allclose(centers, np.linalg.norm((whole + images - places)[:2], axis=1), rtol=0, atol=1e-12)
        ends.append((x - images, v))
    assert np.abs(ends[0][0] - whole).max() > 0.005
    np.testing.assert_allclose(ends[0][0], ends[1][0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(ends[0][1], ends[1][1], rtol=0, atol=1e-7)


def in_frame_of_its_center(ratio):
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


@pytest.mark.parametrize("every", [1, 50])
@pytest.mark.usefixtures("without_device")
def test_velocities_are_those_of_the_core(every):
    """To the last digits, also where somebody looks at each step; carried with x they have three digits less."""
    masses, x, v = in_frame_of_its_center(10.0)
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
