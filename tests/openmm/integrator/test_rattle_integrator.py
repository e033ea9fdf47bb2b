"""RattleIntegrator: compiled leapfrog steps between two ends are RATTLE."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import openmm
import pytest
from openmm import app, unit
from openmm_systems import (
    PLATFORMS,
    alanine,
    context_of,
    dumbbell,
    masses_of,
    potential_energy,
    residuals,
    started,
    state_of,
    total_energy,
    water_box,
)

from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.openmm import ProjectedIntegrator, RattleIntegrator
from kcons.openmm.integrator.guard import Guard

platforms = pytest.mark.parametrize("platform", PLATFORMS)


def both(system, x, v, platform="Reference", **arguments):
    """Context and integrator of each kind."""
    made = [kind(1e-3, tolerance=1e-12, **arguments) for kind in (RattleIntegrator, ProjectedIntegrator)]
    return [(started(system, integrator, x, v, platform), integrator) for integrator in made]


def assert_same(ours, theirs, x_within, v_within):
    (x, v), (y, w) = state_of(ours), state_of(theirs)
    np.testing.assert_allclose(x, y, rtol=0, atol=x_within)
    np.testing.assert_allclose(v, w, rtol=0, atol=v_within)


# -- the motion -------------------------------------------------------------------------------------


@platforms
def test_same_motion_as_the_program(platform):
    system, x, v = alanine()
    (ours, compiled), (theirs, program) = both(system, x, v, platform)
    for steps in (1, 2, 3, 14):
        compiled.step(steps)
        program.step(steps)
    # The CPU platform has forces in single precision, which differ from run to run in the order of sums.
    exact = platform == "Reference"
    assert_same(ours, theirs, 1e-12 if exact else 1e-7, 1e-10 if exact else 1e-4)
    assert ours.getStepCount() == 20
    assert ours.getTime() / unit.picosecond == pytest.approx(0.02, rel=1e-12)
    assert residuals(system, ours)[1] < 1e-11


def test_calls_do_not_change_the_motion():
    system, x, v = alanine()
    ends = []
    for calls, check_every in (([40], 0), ([3, 7, 10, 20], 0), ([20, 5, 15], 7)):
        context = started(system, integrator := RattleIntegrator(1e-3, tolerance=1e-13, check_every=check_every), x, v)
        for steps in calls:
            integrator.step(steps)
        ends.append(state_of(context))
    for there, speeds in ends[1:]:
        np.testing.assert_allclose(there, ends[0][0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(speeds, ends[0][1], rtol=0, atol=1e-10)


def test_checks_wait_for_the_end_of_a_call_that_is_near(monkeypatch):
    system, x, v = dumbbell()
    context = started(system, integrator := RattleIntegrator(1e-3, check_every=10), x, v)
    checked = []
    check = Guard.check
    monkeypatch.setattr(Guard, "check", lambda guard: checked.append(context.getStepCount()) or check(guard))
    for steps in (8, 7, 12, 16, 34):
        integrator.step(steps)
    # What is due at 10 waits for 15, what is due at 25 for 27; what is due at 37 does not wait for 43.
    assert checked == [15, 27, 37, 47, 57, 67, 77]


def test_kinetic_energy_is_that_of_the_velocities():
    system, x, v = alanine()
    context = started(system, integrator := RattleIntegrator(1e-3), x, v)
    integrator.step(10)
    speeds = state_of(context)[1]
    kinetic = 0.5 * masses_of(system) @ np.einsum("ij,ij->i", speeds, speeds)
    assert total_energy(context) - potential_energy(context) == pytest.approx(kinetic, rel=1e-12)
    assert integrator.kinetic_energy() / unit.kilojoule_per_mole == pytest.approx(kinetic, rel=1e-12)


def test_force_evaluations():
    """One a step, in however many calls; and one more for a start, or where somebody has changed something."""
    system, x, v = dumbbell()
    calls = []

    def spring(state):
        calls.append(1)
        return 0.0, np.zeros((2, 3))

    system.addForce(openmm.PythonForce(spring))
    context = started(system, integrator := RattleIntegrator(1e-3), x, v)
    counts = []
    for steps, change in ((10, False), (10, False), (2, False), (1, False), (7, False), (10, True), (3, False)):
        if change:
            context.setVelocities(v)
        calls.clear()
        integrator.step(steps)
        counts.append(len(calls) - steps)
    assert counts == [1, 0, 0, 0, 0, 1, 0]


# -- what others change between calls ----------------------------------------------------------------


def _warmer(context, integrator):
    context.setVelocities(1.1 * state_of(context)[1])


def _elsewhere(context, integrator):
    context.setPositions(state_of(context)[0] + np.array([0.05, 0.0, 0.1]))


def _stronger(context, integrator):
    context.setParameter("k", 90.0)


def _finer(context, integrator):
    integrator.setStepSize(0.0005)


def _updated(context, integrator):
    force = next(f for f in context.getSystem().getForces() if isinstance(f, openmm.CustomBondForce))
    force.setBondParameters(0, 0, 1, [4.0])
    force.updateParametersInContext(context)


@pytest.mark.parametrize("change", [_warmer, _elsewhere, _stronger, _finer, _updated])
def test_changes_between_calls(change):
    ends = []
    for kind in (RattleIntegrator, ProjectedIntegrator):
        system, x, v = dumbbell()
        pull = openmm.CustomBondForce("s*r")
        pull.addPerBondParameter("s")
        pull.addBond(0, 1, [1.0])
        system.addForce(pull)
        context = started(system, integrator := kind(1e-3, tolerance=1e-13), x, v)
        integrator.step(10)
        change(context, integrator)
        integrator.step(10)
        ends.append(state_of(context))
    np.testing.assert_allclose(ends[0][0], ends[1][0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(ends[0][1], ends[1][1], rtol=0, atol=1e-11)


@pytest.mark.parametrize("kind", [RattleIntegrator, ProjectedIntegrator])
def test_change_of_the_box(kind):
    """OpenMM keeps the forces of a CustomIntegrator when the box is changed; `step` sees that."""
    system, x = water_box(27)
    wider = 1.02 * np.array([row._value for row in system.getDefaultPeriodicBoxVectors()])
    context = started(system, integrator := kind(1e-3, tolerance=1e-12), x, np.zeros_like(x))
    integrator.step(5)
    context.setPeriodicBoxVectors(*wider)
    fresh = context_of(system, other := kind(1e-3, tolerance=1e-12))
    fresh.setPeriodicBoxVectors(*wider)
    fresh.setPositions(state_of(context)[0])
    fresh.setVelocities(state_of(context)[1])
    integrator.step(5)
    other.step(5)
    assert_same(context, fresh, 1e-7, 1e-4)  # SETTLE has lengths in single precision


def test_andersen_thermostat_acts_on_velocities_at_x():
    """Leapfrog steps would give it those of half a step before: then there are none."""
    system, x, v = dumbbell()
    calls = []

    def nothing(state):
        calls.append(1)
        return 0.0, np.zeros((2, 3))

    system.addForce(openmm.PythonForce(nothing))
    system.addForce(openmm.AndersenThermostat(300.0, 50.0))
    context = started(system, integrator := RattleIntegrator(1e-3), x, v)
    integrator.step(10)
    calls.clear()
    integrator.step(10)
    assert len(calls) == 10
    assert residuals(system, context)[1] < 1e-9


@pytest.mark.usefixtures("without_device")
def test_steps_without_python():
    """What OpenMM makes of it where Python is not asked is RATTLE as well."""
    system, x, v = alanine()
    (ours, compiled), (theirs, program) = both(system, x, v)
    openmm._openmm.CompoundIntegrator_step(compiled, 10)
    program.step(10)
    np.testing.assert_array_equal(state_of(ours), state_of(theirs))


# -- failures ----------------------------------------------------------------------------------------


def test_arguments():
    assert RattleIntegrator(2 * unit.femtoseconds).getStepSize() == 0.002 * unit.picosecond
    integrator = RattleIntegrator(0.002)
    assert integrator.getConstraintTolerance() == 1e-10 and integrator.check_every == 1000
    assert repr(integrator) == "<RattleIntegrator: 2 fs>"
    for call, given in ((integrator.setStepSize, np.nan), (integrator.setConstraintTolerance, 0.0)):
        with pytest.raises(InputError):
            call(given)
    integrator.setConstraintTolerance(1e-7)
    assert integrator._verlet.getConstraintTolerance() == 1e-7


# -- a citizen of OpenMM ------------------------------------------------------------------------------


@pytest.mark.parametrize("how", [copy.copy, copy.deepcopy, lambda i: pickle.loads(pickle.dumps(i))])
def test_copies(how):
    system, x, v = alanine()
    first = RattleIntegrator(1e-3, tolerance=1e-9, check_every=50)
    first.setIntegrationForceGroups({0, 1})
    second = how(first)
    assert second.getStepSize() == first.getStepSize()
    assert (second.getConstraintTolerance(), second.check_every) == (1e-9, 50)
    assert second.getIntegrationForceGroups() == first.getIntegrationForceGroups() == 3
    contexts = [started(system, integrator, x, v) for integrator in (first, second)]
    first.step(10)
    second.step(10)
    np.testing.assert_array_equal(*map(state_of, contexts))


def test_force_groups():
    system, x, v = dumbbell()
    for group, strength in ((1, 30.0), (2, 5.0)):
        extra = openmm.CustomBondForce(f"{strength}*r")
        extra.addBond(0, 1, [])
        extra.setForceGroup(group)
        system.addForce(extra)
    field = openmm.CustomExternalForce("9*x")
    field.addParticle(0, [])
    field.setForceGroup(3)
    system.addForce(field)
    (ours, compiled), (theirs, program) = both(system, x, v)
    del ours, theirs
    ends = []
    for made in (compiled, program):
        fresh = copy.copy(made)
        fresh.setIntegrationForceGroups({0, 1, 2})
        context = started(system, fresh, x, v)
        fresh.step(10)
        ends.append(state_of(context))
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-11)
    with pytest.raises(UnsupportedError, match="before it is created"):
        fresh.setIntegrationForceGroups({0})


# -- checks where calls end -------------------------------------------------------------------------


@pytest.mark.parametrize("through", ["calls", "a Simulation"])
def test_the_ends_of_calls_are_checked(through):
    """OpenMM's solvers do not converge on redundant rows, and nothing is due for a thousand steps."""
    turns = np.arange(6) * np.pi / 3
    system, x = openmm.System(), 0.14 * np.c_[np.cos(turns), np.sin(turns), np.zeros(6)]
    for _ in x:
        system.addParticle(12.0)
    for i, j in [*[(k, (k + 1) % 6) for k in range(6)], (0, 3), (1, 4), (2, 5)]:
        system.addConstraint(i, j, float(np.linalg.norm(x[i] - x[j])))
    integrator = RattleIntegrator(2e-3)
    context = started(system, integrator, x)
    context.setVelocitiesToTemperature(300, 3)
    simulation = app.Simulation.__new__(app.Simulation)
    simulation.context, simulation.integrator, simulation.reporters = context, integrator, []
    simulation._usesPBC = False
    step = integrator.step if through == "calls" else simulation.step
    with pytest.raises(ConvergenceError, match=r"is off by .*The Context is back at step 0"):
        step(100)
    assert context.getStepCount() == 0


@pytest.mark.parametrize(("given", "checks"), [({}, 1), ({"check_every": 1000}, 0), ({"check_every": 0}, 0)])
def test_checks_of_ends_are_spared_like_others(monkeypatch, given, checks):
    """The first says what one costs; with an interval that was asked for, ends are none of it."""
    system, x, v = dumbbell()
    integrator = RattleIntegrator(1e-4, **given)
    context = started(system, integrator, x, v)
    integrator.step(0)
    made, check = [], Guard.check

    def dear(self):
        made.append(self.since_check)
        check(self)
        self._cost = 1e6

    monkeypatch.setattr(Guard, "check", dear)
    for _ in range(20):
        integrator.step(10)
    assert len(made) == checks and context.getStepCount() == 200
