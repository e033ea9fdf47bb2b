"""Constraints applied outside of steps, and temperatures of what is left free."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from collective_cases import CHAIN, angle, bond, chain_system, held_chain
from openmm_systems import context_of, masses_of, on_gpus, state_of

from kcons.errors import InputError, KconsError
from kcons.openmm import CollectiveRows, ProjectedIntegrator


def test_constraints_applied_by_the_integrator():
    context, integrator, part = held_chain([bond(0, 3), angle(2, 3, 4)], constrained=True)
    rng = np.random.default_rng(4)
    context.setPositions(state_of(context)[0] + 0.002 * rng.normal(size=CHAIN.shape))
    context.setVelocities(rng.normal(size=CHAIN.shape))
    integrator.applyConstraints(context)
    integrator.applyVelocityConstraints(context)
    assert np.abs(part.residuals(context)).max() <= 1e-12
    assert np.abs(part.rates(context)).max() <= 1e-12
    part.check(context)


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


def test_temperature_is_that_of_the_degrees_of_freedom():
    context, integrator, _ = held_chain([bond(0, 3)], constrained=True)
    v = state_of(context)[1]
    kinetic = 0.5 * masses_of(context.getSystem()) @ np.sum(v * v, axis=1)
    assert integrator.kinetic_energy()._value == pytest.approx(kinetic, rel=1e-12)
    warmth = 2 * kinetic / (8.31446261815324e-3 * integrator.degrees_of_freedom())
    assert integrator.computeSystemTemperature()._value == pytest.approx(warmth, rel=1e-9)


def test_no_degree_of_freedom_no_temperature():
    system = openmm.System()
    system.addParticle(0.0)
    integrator = ProjectedIntegrator(1e-3)
    context = context_of(system, integrator)
    context.setPositions([[0, 0, 0]])
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
