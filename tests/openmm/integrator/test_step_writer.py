"""Steps that hold parts: failures are taken back, changes from outside are seen."""

from __future__ import annotations

import copy

import numpy as np
import openmm
import pytest
from openmm import unit
from openmm_parts import HeldCoordinates
from openmm_systems import (
    PLATFORMS,
    dumbbell,
    holding,
    loose_alanine,
    masses_of,
    residuals,
    started,
    state_of,
    total_energy,
)

from kcons.errors import ConvergenceError, InputError
from kcons.openmm import ProjectedIntegrator
from kcons.openmm.integrator.ensemble import ConstantEnergy

platforms = pytest.mark.parametrize("platform", PLATFORMS)
PS = unit.picosecond


# -- parts ------------------------------------------------------------------------------------------


@platforms
@pytest.mark.parametrize("evaluates", [False, True])
@pytest.mark.parametrize("scheme", ["rattle", "geodesic", "suzuki4", "leapfrog"])
def test_part_is_held(scheme, evaluates, platform):
    system, x, v = loose_alanine()
    integrator = ProjectedIntegrator(5e-4, scheme, parts=[holding(evaluates=evaluates)])
    context = started(system, integrator, x, v, platform)
    energy = None
    for _ in range(20):
        integrator.step(5)
        now, speed = state_of(context)
        assert abs(now[0, 2] - x[0, 2]) < 1e-14
        if scheme != "leapfrog":
            assert speed[0, 2] == 0
        energy = total_energy(context) if energy is None else energy
        assert total_energy(context) == pytest.approx(energy, abs=0.5)
    assert integrator.degrees_of_freedom() == 3 * 22 - system.getNumConstraints() - 1
    assert context.getStepCount() == 100


@pytest.mark.parametrize("evaluates", [False, True])
def test_kept_forces_change_nothing(evaluates):
    """A part that holds nothing, with forces kept or not: the motion without it."""
    system, x, v = loose_alanine()
    nothing = HeldCoordinates([], 2, 0.0, 22, evaluates=evaluates)
    contexts = []
    for parts in ((), (nothing,)):
        integrator = ProjectedIntegrator(1e-3, "suzuki4", parts=parts)
        contexts.append(started(system, integrator, x, v))
        integrator.step(10)
    (x1, v1), (x2, v2) = (state_of(context) for context in contexts)
    np.testing.assert_allclose(x1, x2, atol=1e-12)
    np.testing.assert_allclose(v1, v2, atol=1e-10)


@pytest.mark.parametrize("evaluates", [False, True])
def test_failed_step_is_taken_back(evaluates):
    system, x, v = loose_alanine()
    part = holding(evaluates=evaluates)
    integrator = ProjectedIntegrator(1e-3, parts=[part])
    context = started(system, integrator, x, v)
    integrator.step(7)
    before = state_of(context)
    integrator.setGlobalVariableByName("steepest", -1.0)
    with pytest.raises(ConvergenceError, match="too steep") as caught:
        integrator.step(5)
    assert caught.value.step == 8
    np.testing.assert_array_equal(state_of(context), before)
    assert context.getStepCount() == 7
    assert context.getTime() / PS == pytest.approx(0.007, rel=1e-12)
    integrator.setGlobalVariableByName("steepest", np.inf)
    integrator.step(5)
    undisturbed = ProjectedIntegrator(1e-3, parts=[holding(evaluates=evaluates)])
    other = started(system, undisturbed, x, v)
    undisturbed.step(12)
    np.testing.assert_array_equal(state_of(context), state_of(other))


class Reluctant(HeldCoordinates):
    """Fails to project velocities where the global variable `reluctant` is 1."""

    def declare(self, program):
        super().declare(program)
        program.number("reluctant", "1 where velocities cannot be projected")

    def project(self, program):
        super().project(program)
        program.let("failed", f"select(reluctant,{self.code},failed)", "told to")


@pytest.mark.parametrize("scheme", ["geodesic", "suzuki4"])
def test_a_step_whose_last_projection_fails_is_not_counted(scheme):
    system, x, v = loose_alanine()
    integrator = ProjectedIntegrator(1e-3, scheme, parts=[Reluctant([0], 2, x[0, 2], 22)])
    context = started(system, integrator, x, v)
    integrator.step(3)
    before = state_of(context)
    integrator.setGlobalVariableByName("reluctant", 1.0)
    with pytest.raises(ConvergenceError) as caught:
        integrator.step(5)
    assert caught.value.step == 4
    assert context.getStepCount() == 3
    assert context.getTime() / PS == pytest.approx(0.003, rel=1e-12)
    np.testing.assert_array_equal(state_of(context), before)


def test_failure_in_the_middle_of_many_steps():
    system, x, v = loose_alanine()
    integrator = ProjectedIntegrator(1e-3, parts=[holding(steepest=2e-4)])
    context = started(system, integrator, x, v)
    with pytest.raises(ConvergenceError) as caught:
        integrator.step(1000)
    done = context.getStepCount()
    assert caught.value.step == done + 1
    assert 0 < done < 1000
    assert context.getTime() / PS == pytest.approx(1e-3 * done, rel=1e-9)


def test_applying_constraints_of_parts():
    system, x, v = loose_alanine()
    integrator = ProjectedIntegrator(1e-3, "suzuki4", parts=[holding()])
    moved = x.copy()
    moved[0] += 0.02
    context = started(system, integrator, moved, v)
    with pytest.raises(InputError, match="off the level"):
        integrator.step(1)
    np.testing.assert_array_equal(state_of(context), [moved, v])
    integrator.applyConstraints(context)
    now, speed = state_of(context)
    assert abs(now[0, 2] - x[0, 2]) < 1e-15
    np.testing.assert_array_equal(speed, v)
    integrator.applyVelocityConstraints(context)
    assert state_of(context)[1][0, 2] == 0
    np.testing.assert_array_equal(state_of(context)[0], now)
    assert context.getStepCount() == 0
    assert context.getTime() / PS == 0
    integrator.setVelocitiesToTemperature(context, 300 * unit.kelvin, 5)
    assert state_of(context)[1][0, 2] == 0
    assert residuals(system, context)[1] < 1e-9
    integrator.setGlobalVariableByName("steepest", -1.0)
    with pytest.raises(ConvergenceError):
        integrator.applyConstraints(context)
    np.testing.assert_array_equal(state_of(context)[0], now)


@pytest.mark.parametrize("change", ["parameter", "box", "positions", "force"])
def test_changes_from_outside_reach_kept_forces(change):
    """A part that evaluates makes the integrator keep forces from one step to the next."""
    system, x, v = dumbbell()
    system.removeConstraint(0)
    system.setDefaultPeriodicBoxVectors(*(3 * np.eye(3)))
    pair = openmm.CustomNonbondedForce("q/r")
    pair.addGlobalParameter("q", 20.0)
    pair.setNonbondedMethod(openmm.CustomNonbondedForce.CutoffPeriodic)
    for _ in range(2):
        pair.addParticle([])
    system.addForce(pair)
    spring = openmm.HarmonicBondForce()
    spring.addBond(0, 1, 0.2, 100.0)
    system.addForce(spring)
    contexts = []
    for parts in ((), (HeldCoordinates([], 0, 0.0, 2, evaluates=True),)):
        integrator = ProjectedIntegrator(1e-3, parts=parts)
        context = started(system, integrator, x, v)
        integrator.step(5)
        if change == "parameter":
            context.setParameter("q", -80.0)
        elif change == "box":
            context.setPeriodicBoxVectors(*(2.1 * np.eye(3)))
        elif change == "positions":
            context.setPositions(x)
        else:
            context.getSystem().getForce(2).setBondParameters(0, 0, 1, 0.5, 3000.0)
            context.getSystem().getForce(2).updateParametersInContext(context)
            integrator.refresh()
        integrator.step(1)
        contexts.append(state_of(context))
        spring.setBondParameters(0, 0, 1, 0.2, 100.0)
    np.testing.assert_allclose(contexts[0], contexts[1], rtol=1e-12)


class Friction(ConstantEnergy):
    """An ensemble that is seen to be right: v falls exponentially during kicks."""

    def declare(self, program):
        program.number("rate", "of the friction", 1e3 * np.log(4.0))

    def kick(self, program, h, force, impulse, project, tangent):
        project()
        return f"(v+{impulse or 0})*exp(-rate*{h})"


@pytest.mark.parametrize("parts", [False, True])
def test_an_ensemble_writes_the_kicks(parts):
    system, x, v = loose_alanine()
    integrator = ProjectedIntegrator(1e-3, parts=[holding()] if parts else [], ensemble=Friction(), tolerance=1e-12)
    context = started(system, integrator, x, v)
    integrator.applyVelocityConstraints(context)
    before = state_of(context)[1]
    integrator.step(1)
    mass = masses_of(system)
    kinetic = [mass @ np.sum(u**2, axis=1) for u in (before, state_of(context)[1])]
    # Of the bonds' curvature and the projection this knows nothing: they cost little.
    assert kinetic[1] / kinetic[0] == pytest.approx(1 / 16, rel=0.02)
    assert copy.copy(integrator).program.listing() == integrator.program.listing()
    assert integrator.program.listing().count("constrain velocities") == 3
