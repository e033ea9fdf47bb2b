"""The time of targets, by a program that is run by hand."""

from __future__ import annotations

import openmm
import pytest

from kcons.errors import ConstraintError
from kcons.openmm import CollectiveRows, ProjectedIntegrator, Row
from kcons.openmm.collective.clock import Clock
from kcons.openmm.integrator.program import Program

STEP = 0.5


def clockwork():
    """A step with two drifts that may fail, and the variables afterwards."""
    system = openmm.System()
    system.addParticle(1.0)
    integrator = openmm.CustomIntegrator(STEP)
    p = Program(integrator)
    for name in ("stage", "first_stage", "good_steps", "failed", "held1"):
        p.number(name, name)
    clock = Clock(1)
    clock.declare(p)
    for drift in (0, 1):
        p.let("stage", str(drift), "number of the drift")
        clock.begin(p)
        clock.drift(p, "0.5*dt")
    p.let("good_steps", "good_steps+1-failed", "count")
    p.hand_over()
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions([[0, 0, 0]])

    def step(**values):
        for name, value in values.items():
            integrator.setGlobalVariableByName(name, value)
        integrator.step(1)
        return {name: integrator.getGlobalVariableByName(name) for name in p.numbers}

    return clock, step, context


def test_time_goes_on_with_steps_that_are_kept():
    clock, step, context = clockwork()
    for n in (1, 2, 3):
        found = step()
        assert clock.now(found) == n * STEP
        assert found["clock1"] == n * STEP
    assert context.getStepCount() == 3


def test_a_step_that_failed_takes_no_time():
    clock, step, context = clockwork()
    step()
    assert clock.now(step(failed=1)) == STEP
    assert clock.now(step(failed=0)) == 2 * STEP
    assert context.getStepCount() == 3


def test_constraints_alone_take_no_time():
    clock, step, context = clockwork()
    step()
    found = step(first_stage=1)
    assert (clock.now(found), found["clock1"]) == (STEP, STEP)
    assert context.getStepCount() == 2


def molecule():
    """A System of three particles, and a Force that is the distance of two of them."""
    system, springs, bond = openmm.System(), openmm.HarmonicBondForce(), openmm.CustomBondForce("r")
    for mass in (12.0, 16.0, 14.0):
        system.addParticle(mass)
    springs.addBond(1, 2, 0.15, 1e4)
    system.addForce(springs)
    bond.addBond(0, 1)
    return system, bond


def test_a_state_of_another_program_has_no_time_of_targets():
    """The pull begins anew there; the error says how to go on instead, and that way ends where one run would."""
    states = []
    for scheme in ("rattle", "geodesic"):
        system, bond = molecule()
        rows = CollectiveRows(system, [Row(bond, 0.15, 0.5)])
        integrator = ProjectedIntegrator(0.002, scheme, parts=[rows])
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
        context.setPositions([[0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.15, 0.15, 0.0]])
        if states:
            context.setState(states[0])
            with pytest.raises(ConstraintError, match=r"call restore.*set_target\(integrator, 0, 0\.17\)"):
                integrator.step(1)
            rows.set_target(integrator, 0, 0.17)
        integrator.step(20)
        states.append(context.getState(positions=True, velocities=True))
    assert abs(rows.values(context)[0] - (0.15 + 0.5 * 0.002 * 40)) < 1e-12
    context.setPositions([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.3, 0.15, 0.0]])
    with pytest.raises(ConstraintError) as caught:  # the time of these targets is known
        rows.check(context)
    assert "call restore" in str(caught.value) and "set_target" not in str(caught.value)
