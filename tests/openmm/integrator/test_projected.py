"""ProjectedIntegrator as a citizen of OpenMM: arguments, settings, restarts, reporters."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm import unit
from openmm_parts import HeldCoordinates
from openmm_systems import dumbbell, holding, started, state_of, water_box

from kcons.errors import InputError, UnsupportedError
from kcons.openmm import ProjectedIntegrator


def test_only_one_part_may_share_atoms_with_the_system():
    alone, *meeting = (holding() for _ in range(3))
    assert ProjectedIntegrator(0.001, parts=alone).parts == (alone,)
    for part in meeting:
        part.meets_system = True
    with pytest.raises(UnsupportedError, match="only one part"):
        ProjectedIntegrator(0.001, parts=meeting)


class Witness(HeldCoordinates):
    """Holds nothing; sees whether the forces that were kept are those at x."""

    def __init__(self, n):
        super().__init__([], 0, 0.0, n)

    def declare(self, program):
        super().declare(program)
        program.number("gap", "kept forces against those at x")
        program.number("worst_gap", "the largest one")

    def remember(self, program):
        program.sum("gap", "(force-f)^2", "both at x")
        program.let("worst_gap", "max(worst_gap,gap)", "the largest one")


def test_barostat_with_a_part_that_keeps_forces():
    """Box and positions change at the beginning of a step; the forces of that step must be the new ones."""
    system, x = water_box(64)
    system.addForce(openmm.MonteCarloBarostat(1.0, 300.0, 1))
    integrator = ProjectedIntegrator(5e-4, "suzuki4", parts=[Witness(192)])
    context = started(system, integrator, x)
    integrator.setVelocitiesToTemperature(context, 300, 1)
    volumes = set()
    for _ in range(10):
        integrator.step(2)
        volumes.add(context.getState().getPeriodicBoxVolume() / unit.nanometer**3)
    assert len(volumes) > 5
    assert integrator.getGlobalVariableByName("worst_gap") == 0


def test_force_groups_of_rows_never_act():
    integrator = ProjectedIntegrator(1e-3, parts=[holding(groups={5, 7})])
    everything = set(range(32)) - {5, 7}

    def groups():
        mask = integrator.getIntegrationForceGroups()
        return {g for g in range(32) if (mask >> g) & 1}

    assert groups() == everything
    for chosen in ({0, 3}, set()):
        integrator.setIntegrationForceGroups(chosen)
        assert groups() == chosen
    for all_of_them in (-1, 0xFFFFFFFF, set(range(32))):
        integrator.setIntegrationForceGroups(all_of_them)
        assert groups() == everything
    for bad in ({0, 7}, 1 << 5):
        with pytest.raises(InputError, match="carry constraint rows"):
            integrator.setIntegrationForceGroups(bad)
    system, x, v = dumbbell()
    context = started(system, bound := ProjectedIntegrator(1e-3), x, v)
    for late in ({0}, -1):
        with pytest.raises(UnsupportedError, match="before"):
            bound.setIntegrationForceGroups(late)
    del context


def test_restart_of_rigid_water_bit_for_bit():
    """SETTLE changes velocities that are on the constraints already in their last digits: it is not to be called."""
    system, x = water_box()
    contexts = []
    for _ in range(2):
        integrator = ProjectedIntegrator(1e-3)
        contexts.append((integrator, started(system, integrator, x)))
    (first, through), (second, again) = contexts
    first.minimizeEnergy(maxIterations=10)
    first.setVelocitiesToTemperature(through, 300, 1)
    first.step(10)
    again.loadCheckpoint(through.createCheckpoint())
    first.step(10)
    second.step(10)
    np.testing.assert_array_equal(state_of(again), state_of(through))


@pytest.mark.parametrize("call", ["check", "applyConstraints", "setVelocitiesToTemperature", "degrees_of_freedom"])
def test_contexts_of_other_integrators_are_refused(call):
    """The clock of that Context was moved then, and its state checked in place of this one's."""
    system, x, v = dumbbell()
    integrator, other = ProjectedIntegrator(1e-3), ProjectedIntegrator(1e-3)
    context, foreign = started(system, integrator, x, v), started(system, other, x, v)
    arguments = (300,) if call == "setVelocitiesToTemperature" else ()
    for given, words in ((foreign, "another integrator"), ("no Context", "context is a str")):
        with pytest.raises(InputError, match=words):
            getattr(integrator, call)(given, *arguments)
    integrator.step(3)
    assert (context.getStepCount(), foreign.getStepCount()) == (3, 0)
    assert foreign.getTime()._value == 0
    np.testing.assert_array_equal(state_of(foreign)[1], v)
