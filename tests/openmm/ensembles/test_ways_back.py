"""Drifts that are taken back in the program of a step."""

from __future__ import annotations

import copy

import numpy as np
import openmm
import pytest
from ensemble_runs import warm
from openmm import unit
from openmm_systems import alanine, context_of, started, state_of, water_box

from kcons.errors import NonFiniteError, UnsupportedError
from kcons.openmm import ProjectedIntegrator, WaysBackIntegrator, hold


@pytest.mark.parametrize(("scheme", "dt"), [("rattle", 2e-3), ("geodesic", 2e-3), ("blanes-moan4", 4e-3)])
def test_steps_are_those_of_the_plain_integrator(scheme, dt):
    system, x, v = alanine()
    ends = []
    for kind in (ProjectedIntegrator, WaysBackIntegrator):
        integrator = kind(dt, scheme, tolerance=1e-13)
        ends.append(_after(system, integrator, x, v, 10))
    np.testing.assert_allclose(ends[1][0], ends[0][0], atol=1e-11)
    np.testing.assert_allclose(ends[1][1], ends[0][1], atol=1e-8)
    assert 0 < integrator.missed() < 1e-11
    integrator.forget_ways()
    assert integrator.missed() == 0


def _after(system, integrator, x, v, steps):
    context = started(system, integrator, x, v)
    integrator.step(steps)
    return state_of(context)


def test_the_way_back_of_a_large_step_is_not_finite():
    """Waters that turn by more than SETTLE can take back."""
    system, x = water_box(8)
    for dt in (0.002, 0.03):
        integrator = WaysBackIntegrator(dt * unit.picosecond, check_every=0)
        context = context_of(system, integrator)
        context.setPositions(x)
        integrator.setVelocitiesToTemperature(context, 600, 3)
        if dt < 0.01:
            integrator.step(1)
            assert integrator.missed() < 1e-12
            continue
        with pytest.raises(NonFiniteError):
            integrator.step(1)
        assert not integrator.missed() < 1e-3


def test_what_is_taken_back_is_so_by_the_step_from_its_end():
    """Also where a kick pushes so far across a constraint that the solver, from there, finds the other end of it."""
    system, length, h = openmm.System(), 0.1, 0.1
    for mass in (1e9, 1.0):
        system.addParticle(mass)
    system.addConstraint(0, 1, length)
    push = openmm.CustomExternalForce("f*x")
    push.addGlobalParameter("f", 2.6 * length / h**2)  # 1.3 lengths in a step
    push.addParticle(1)
    system.addForce(push)
    integrator = WaysBackIntegrator(h * unit.picosecond)
    context = context_of(system, integrator)
    begun = np.array([[0.0, 0, 0], [0, length, 0]])
    context.setPositions(begun)
    context.setVelocities([[0.0, 0, 0], [2.166 * length / h, 0, 0]])
    integrator.step(1)
    x, v = state_of(context)
    assert integrator.missed() < 1e-9
    assert x[1, 0] > 0.8 * length
    integrator.forget_ways()
    context.setPositions(x)
    context.setVelocities(-v)
    integrator.step(1)
    assert integrator.missed() < 1e-9
    np.testing.assert_allclose(state_of(context)[0], begun, atol=1e-6)


def test_it_takes_no_forces():
    one, two = (kind(2e-3, "blanes-moan4").counts() for kind in (ProjectedIntegrator, WaysBackIntegrator))
    assert two.force_evaluations == one.force_evaluations
    assert two.constraint_solves - one.constraint_solves == 4 * 30  # drifts of five flights each


def test_parts_and_the_leapfrog_are_refused():
    system, x, _ = alanine()
    with pytest.raises(UnsupportedError, match="takes back whole trajectories"):
        WaysBackIntegrator(1e-3, parts=[hold(system, [], positions=x, take="all")])
    with pytest.raises(UnsupportedError, match="not for the leapfrog"):
        WaysBackIntegrator(1e-3, "leapfrog")


def test_copies_are_of_the_same_kind():
    system, x = water_box(8)
    copied = copy.deepcopy(WaysBackIntegrator(2e-3, "blanes-moan4"))
    assert type(copied) is WaysBackIntegrator
    context = warm(system, copied, x, 1)
    copied.step(1)
    assert context.getStepCount() == 1
    assert copied.missed() < 1e-12
