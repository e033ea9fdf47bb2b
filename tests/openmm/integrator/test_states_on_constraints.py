"""States brought onto constraints outside of steps, temperatures of what is left free, minima."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from collective_cases import CHAIN, angle, bond, chain_system, held_chain
from openmm import unit
from openmm_systems import (
    context_of,
    forces_at,
    holding,
    loose_alanine,
    masses_of,
    on_gpus,
    particles,
    potential_energy,
    residuals,
    started,
    state_of,
)

from kcons.errors import InputError, KconsError, NonFiniteError
from kcons.openmm import CollectiveRows, ProjectedIntegrator


def test_constraints_are_applied_to_positions_and_to_velocities_of_a_temperature():
    context, integrator, part = held_chain([bond(0, 3), angle(2, 3, 4)], constrained=True)
    context.setPositions(CHAIN + 0.002 * np.random.default_rng(4).normal(size=CHAIN.shape))
    integrator.applyConstraints(context)
    integrator.setVelocitiesToTemperature(context, 300, 5)
    v = state_of(context)[1]
    assert np.abs(part.residuals(context)).max() <= 1e-12 and np.abs(part.rates(context)).max() <= 1e-12
    assert residuals(context.getSystem(), context)[1] <= 1e-12
    integrator.setVelocitiesToTemperature(context, 300 * unit.kelvin, 5)
    assert np.array_equal(state_of(context)[1], v)  # the same seed, and kelvins with a unit


def test_what_cannot_be_applied_changes_nothing():
    context, integrator, _ = held_chain([bond(0, 3)])
    integrator.step(1)
    x, v = state_of(context)
    broken = x.copy()
    broken[2, 1] = np.nan
    context.setPositions(broken)
    with pytest.raises(KconsError):
        integrator.applyConstraints(context)
    after, w = state_of(context)
    assert np.array_equal(after, broken, equal_nan=True) and np.array_equal(w, v)


def test_no_degree_of_freedom_no_temperature():
    context = started(particles([0.0]), integrator := ProjectedIntegrator(1e-3), [[0, 0, 0]])
    assert integrator.degrees_of_freedom(context) == 0
    with pytest.raises(InputError, match="no degree of freedom"):
        integrator.computeSystemTemperature()


@pytest.mark.parametrize("platform", on_gpus("mixed"))
def test_before_the_first_step_forces_tell_what_they_tell(platform):
    """Where Forces have single numbers, an open tolerance is known before anything is brought onto rows."""
    system = chain_system()
    part = CollectiveRows(system, [bond(0, 3), angle(2, 3, 4)], positions=CHAIN)
    integrator = ProjectedIntegrator(0.002, parts=[part])
    context = context_of(system, integrator, platform)
    context.setPositions(CHAIN + 0.002 * np.random.default_rng(4).normal(size=CHAIN.shape))
    integrator.applyConstraints(context)
    assert np.abs(part.residuals(context)).max() < 5e-6


def test_degrees_of_freedom_are_counted_by_rank():
    """Five particles by all ten distances, nine of them independent: six, and three less with a motion remover."""
    x, every = 0.1 * np.random.default_rng(1).normal(size=(5, 3)), [(i, j) for i in range(5) for j in range(i)]
    for removers, count in (([], 6), ([openmm.CMMotionRemover()], 3)):
        system, integrator = particles([12.0] * 5, *removers, held=every, x=x), ProjectedIntegrator(0.001)
        context = started(system, integrator, x)
        assert integrator.degrees_of_freedom(context) == count and integrator.independent_momenta(context) == 6


def test_flat_and_straight_groups_move_like_bodies():
    """By all distances, which are singular at second order there; SETTLE gives a straight triangle no velocities."""
    for x, count in ([[0, 0, 0], [3, 0, 0], [3, 3, 0], [0, 3, 0]], 6), ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], 5):
        system = particles([12.0] * len(x), held=[(i, j) for i in range(len(x)) for j in range(i)], x=x)
        context = started(system, integrator := ProjectedIntegrator(0.001), x)
        assert integrator.degrees_of_freedom(context) == count
    with pytest.raises(NonFiniteError, match="let kcons hold"):
        integrator.setVelocitiesToTemperature(context, 300, 1)
    assert not state_of(context)[1].any()


def test_minimizer_keeps_parts():
    """The lowest energy on the constraints: forces along them vanish, and it lies above the free minimum."""
    system, x, v = loose_alanine()
    integrator = ProjectedIntegrator(1e-3, parts=[holding()], tolerance=1e-12)
    context = started(system, integrator, x, v)
    before = potential_energy(context)
    integrator.minimizeEnergy(context, tolerance=1.0)
    now, speed = state_of(context)
    np.testing.assert_array_equal(speed, v)
    assert abs(now[0, 2] - x[0, 2]) < 1e-12
    assert residuals(system, context)[0] < 1e-11
    assert potential_energy(context) < before - 15
    context.setVelocities(forces_at(context) / masses_of(system)[:, None])
    integrator.applyVelocityConstraints(context)
    left = masses_of(system)[:, None] * state_of(context)[1]
    assert np.sqrt(np.mean(left**2)) <= 1.0
    assert context.getStepCount() == 0
    held = potential_energy(context)
    free = ProjectedIntegrator(1e-3, tolerance=1e-12)
    other = started(system, free, now)
    free.minimizeEnergy(other, tolerance=1.0 * unit.kilojoule_per_mole / unit.nanometer)
    assert potential_energy(other) <= held + 1e-3
    integrator.step(5)
