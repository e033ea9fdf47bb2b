"""What is left out where nobody looks changes nothing."""

from __future__ import annotations

import copy
import re

import numpy as np
import openmm
import pytest
from openmm_systems import PLATFORMS, alanine, holding, loose_alanine, masses_of, residuals, started, state_of

from kcons.constraints import KnifeEdge, Plane
from kcons.errors import ConvergenceError
from kcons.openmm import CollectiveRows, ProjectedIntegrator, Row
from kcons.openmm.callback_rows.hold import hold
from tests.openmm.collective.test_collective_rows import bond

KINDS = [
    "part",
    "part that evaluates",
    "row",
    "moving row",
    "carried",
    "carried beside bonds",
    "carried, with a velocity",
]


def held(kind, **arguments):
    """An integrator of this kind in its Context, and its part."""
    system, x, v = loose_alanine()
    if kind == "carried":
        system, x, v = alanine()
        system = copy.deepcopy(system)
        part = hold(system, [], x, take="all")
    elif kind == "carried beside bonds":
        system = copy.deepcopy(system)
        part = hold(system, Plane([0], [0, 0, 1]), x)
        assert system.getNumConstraints()
    elif kind == "carried, with a velocity":
        part = hold(system, KnifeEdge(8, 20, [0, 0, 1]), x)
    elif kind.endswith("row"):
        rate = 0.05 if kind == "moving row" else 0.0
        system = copy.deepcopy(system)
        part = CollectiveRows(system, [Row(bond(4, 20), rate=rate), Row(bond(0, 9))], positions=x)
    else:
        part = holding(evaluates=kind.endswith("evaluates"), **arguments)
    integrator = ProjectedIntegrator(1e-3, parts=[part], tolerance=1e-13)
    context = started(system, integrator, x, v)
    integrator.applyVelocityConstraints(context)
    return integrator, context, part


def step_as_if_seen(integrator, steps):
    """Every step complete, and no step that goes on from what was kept."""
    for _ in range(steps):
        integrator.setGlobalVariableByName("behind", 0.0)
        integrator.step(1)


@pytest.mark.parametrize("kind", KINDS)
def test_calls_of_any_length_make_the_same_motion(kind):
    ends = []
    for blocks in ([12], [5, 7], [1] * 12, [3, 1, 8]):
        integrator, context, _ = held(kind)
        for steps in blocks:
            integrator.step(steps)
        ends.append(state_of(context))
    for other in ends[1:]:
        np.testing.assert_array_equal(other, ends[0])


@pytest.mark.parametrize("kind", KINDS)
def test_as_with_complete_steps(kind):
    integrator, context, part = held(kind)
    complete, other, twin = held(kind)
    for _ in range(3):
        integrator.step(10)
        step_as_if_seen(complete, 10)
        (x1, v1), (x2, v2) = state_of(context), state_of(other)
        assert np.abs(x1 - x2).max() <= 1e-12
        assert np.abs(v1 - v2).max() <= 1e-11 * np.abs(v1).max()
        if kind.endswith("row"):
            for name in ("multipliers", "mean_multipliers", "work"):
                ours, theirs = (getattr(p, name)(i) for p, i in ((part, integrator), (twin, complete)))
                np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-7, err_msg=name)
            assert np.abs(part.rates(context)).max() <= 1e-12
        if kind == "carried":
            np.testing.assert_allclose(part.step_multipliers, twin.step_multipliers, rtol=1e-7, atol=1e-4)


@pytest.mark.parametrize("change", ["positions", "velocities", "step size", "refresh"])
@pytest.mark.parametrize("kind", KINDS[:3])
def test_what_others_change_is_seen(kind, change):
    """The step after it is that of an integrator which starts there."""
    integrator, context, _ = held(kind)
    integrator.step(6)
    x, v = state_of(context)
    if change == "positions":
        context.setPositions(x + np.array([0.0, 0.01, 0.0]))
    elif change == "velocities":
        context.setVelocities(v * 0.5)
    elif change == "step size":
        integrator.setStepSize(0.5e-3)
    else:
        integrator.refresh()
    x, v = state_of(context)
    integrator.step(1)
    fresh, other, _ = held(kind)
    fresh.setStepSize(integrator.getStepSize())
    other.setPositions(x)
    other.setVelocities(v)
    fresh.step(1)
    np.testing.assert_allclose(state_of(context), state_of(other), rtol=0, atol=1e-12)


def test_failure_where_nobody_looked():
    """The state is complete, that of the step before, and the run can go on."""
    integrator, context, _ = held("part", steepest=2e-4)
    with pytest.raises(ConvergenceError) as caught:
        integrator.step(1000)
    done = context.getStepCount()
    assert caught.value.step == done + 1
    assert 3 < done < 97
    x, v = state_of(context)
    assert v[0, 2] == 0
    assert residuals(context.getSystem(), context)[1] <= 1e-12
    other, twin, _ = held("part")
    other.step(done)
    np.testing.assert_array_equal(state_of(twin)[0], x)
    assert np.abs(state_of(twin)[1] - v).max() <= 1e-12
    integrator.setGlobalVariableByName("steepest", np.inf)
    integrator.step(20)
    other.step(20)
    assert np.abs(state_of(twin)[0] - state_of(context)[0]).max() <= 1e-12


@pytest.mark.parametrize("agent", ["barostat", "thermostat", "momentum"])
def test_agents_of_the_system(agent):
    """A carried row stays exact where a barostat moves x between steps; a thermostat meets complete velocities."""
    system = openmm.System()
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.9)
    grid = np.array(list(np.ndindex(4, 4, 4))) * 0.5
    x = np.concatenate([grid, grid + np.array([0.15, 0, 0])])
    for _ in x:
        force.addParticle(0, 0.2, 0.5)
        system.addParticle(20.0)
    for k in range(64):
        force.addException(k, 64 + k, 0, 1, 0)
        system.addConstraint(k, 64 + k, 0.15)
    system.addForce(force)
    system.setDefaultPeriodicBoxVectors(*(2.0 * np.eye(3)))
    part = hold(system, [], x, take="all")
    if agent == "barostat":
        system.addForce(openmm.MonteCarloBarostat(50, 300, 3))
    elif agent == "thermostat":
        system.addForce(openmm.AndersenThermostat(300, 5))
    else:
        system.addForce(openmm.CMMotionRemover(1))
    integrator = ProjectedIntegrator(2e-3, parts=[part])
    context = started(system, integrator, x)
    integrator.setVelocitiesToTemperature(context, 300, 1)
    for _ in range(5):
        integrator.step(20)
        report = part.report(context)
        assert report.residual <= 1e-13
        assert report.velocity_residual <= 1e-13
    assert integrator.getGlobalVariableByName("lean") == float(agent != "thermostat")
    if agent == "barostat":
        edge = context.getState().getPeriodicBoxVectors(asNumpy=True)._value[0, 0]
        assert edge != 2.0
    if agent == "momentum":
        momentum = masses_of(system) @ state_of(context)[1]
        assert np.abs(momentum).max() <= 1e-3


@pytest.mark.parametrize("platform", PLATFORMS)
def test_leapfrog_knows_its_kinetic_energy(platform):
    system, x, v = alanine()
    energies, ends = [], []
    for blocks in ([10], [1] * 10):
        integrator = ProjectedIntegrator(1e-3, "leapfrog")
        context = started(system, integrator, x, v, platform)
        for steps in blocks:
            integrator.step(steps)
        energies.append(context.getState(energy=True).getKineticEnergy()._value)
        ends.append(state_of(context))
    np.testing.assert_array_equal(ends[0], ends[1])
    assert energies[0] == energies[1]


@pytest.mark.parametrize("platform", PLATFORMS)
def test_leapfrog_at_rest_has_no_kinetic_energy(platform):
    """Two particles pressed against each other at a held distance: half a kick and half of what holds it cancel."""
    system = openmm.System()
    press = openmm.CustomExternalForce("-100*sign*x")
    press.addPerParticleParameter("sign")
    for k, sign in enumerate((1.0, -1.0)):
        system.addParticle(4.0)
        press.addParticle(k, [sign])
    system.addForce(press)
    system.addConstraint(0, 1, 0.3)
    x = np.array([[-0.15, 0, 0], [0.15, 0, 0]])
    integrator = ProjectedIntegrator(0.01, "leapfrog")
    context = started(system, integrator, x, np.zeros((2, 3)), platform)
    integrator.step(7)
    there, v = state_of(context)
    assert np.abs(there - x).max() <= 1e-12
    assert np.abs(v).max() <= 1e-10
    # A kick of half a step alone is (0.01 100/4/2)^2 4 = 0.06 kJ/mol.
    assert context.getState(energy=True).getKineticEnergy()._value <= 1e-10


def ways(program):
    """Through its blocks, each left out or gone through once: what OpenMM lists when a Context is first used.

    Blocks that neither need forces nor change positions it passes over.
    """
    outer, here, counts = [], 1, False
    for kind, variable, expression in program.operations:
        if kind in ("when", "usual", "loop"):
            outer.append((here, counts))
            here, counts = 1, False
        elif kind == "end":
            before, also = outer.pop()
            here, counts = before * (1 + here if counts else here), counts or also
        else:
            counts = counts or kind == "others" or variable == "x" or bool(re.search(r"\b(f|energy)\d*\b", expression))
    return here


@pytest.mark.parametrize(("kind", "most"), [("row", 601), ("moving row", 601), ("carried", 181), ("part", 161)])
def test_few_ways_through_the_program(kind, most):
    """The set-up of a Context takes time for each."""
    assert ways(held(kind)[0].program) <= most
