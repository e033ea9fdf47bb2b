"""Python that OpenMM calls within a step: errors come through, nothing is kept, copies go on."""

from __future__ import annotations

import copy
import sys

import numpy as np
import openmm
import pytest
from carried_systems import context_of, free, peptide, state_of

from kcons.constraints import Custom
from kcons.openmm import ProjectedIntegrator
from kcons.openmm.carried.carried_constraints import CarriedConstraints
from kcons.openmm.carried.hold import hold


def _clumsy(r):
    if r[0, 0] > 0.05:
        raise ZeroDivisionError("user code")
    return r[0, 2]


def _up(r):
    return np.array([[0.0, 0.0, 1.0]])


def test_errors_of_user_functions_come_through():
    part = hold(system := free([1.0]), Custom([0], _clumsy, _up), [[0, 0, 0]])
    integrator = ProjectedIntegrator(0.01, parts=[part])
    context = context_of(system, integrator)
    context.setPositions([[0, 0, 0]])
    context.setVelocities([[1.0, 0, 0]])
    with pytest.raises(ZeroDivisionError, match="user code") as caught:
        integrator.step(100)
    assert "in step 6" in caught.value.__notes__[0]
    assert state_of(context)[0][0, 0] == pytest.approx(0.05, abs=1e-12)


def test_energies_and_forces_of_the_context_are_those_of_the_system():
    _, integrator, context = peptide()
    integrator.step(10)
    groups = integrator.getIntegrationForceGroups()
    every = context.getState(energy=True, forces=True)
    own = context.getState(energy=True, forces=True, groups=groups)
    assert every.getPotentialEnergy() == own.getPotentialEnergy()
    difference = every.getForces(asNumpy=True)._value - own.getForces(asNumpy=True)._value
    assert np.abs(difference).max() <= 1e-6
    integrator.step(10)


def test_callbacks_keep_no_memory():
    part, integrator, _ = peptide()
    integrator.step(5)
    nothing = part._engine._nothing
    before = sys.getrefcount(nothing)
    integrator.step(50)
    assert sys.getrefcount(nothing) == before


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda s: openmm.XmlSerializer.deserialize(_xml(s))])
def test_rows_travel_with_the_system(copied):
    part, integrator, context = peptide()
    x, v = state_of(context)
    system = copied(context.getSystem())
    other = CarriedConstraints.of(system)
    assert other is part
    again = context_of(system, ProjectedIntegrator(0.001, parts=[other]))
    again.setPositions(x)
    again.setVelocities(v)
    other.check(again)
    integrator.step(20)
    again.getIntegrator().step(20)
    np.testing.assert_allclose(state_of(again)[0], state_of(context)[0], rtol=0, atol=1e-13)


def _xml(system):
    return openmm.XmlSerializer.serialize(system)


def test_rows_with_functions_that_cannot_be_pickled_stay():
    part = hold(system := free([1.0]), Custom([0], lambda r: r[0, 2], _up), [[0, 0, 0]])
    with pytest.raises(openmm.OpenMMException, match="could not be pickled"):
        openmm.XmlSerializer.serialize(system)
    assert part.rank() == 1
