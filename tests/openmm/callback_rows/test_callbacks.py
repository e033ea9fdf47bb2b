"""Between OpenMM and the engine: what passes, errors, copies of a System, what a System must be like."""

from __future__ import annotations

import copy
import gc
import pickle
import sys

import numpy as np
import openmm
import pytest
from carried_systems import begun, driven, off_target, peptide
from openmm_systems import context_of, particles, started, state_of

from kcons.constraints import Custom, Distance
from kcons.errors import InputError, UnsupportedError
from kcons.openmm import CarriedConstraints, ProjectedIntegrator, hold
from kcons.openmm.integrator.part import Precision

# -- what passes ------------------------------------------------------------------------------------


def test_positions_come_back_to_the_last_bit():
    """Carrying v through x must not move x: without forces and rows in the way, x = x0 + v t exactly as without."""
    system = particles([12.0] * 4)
    part = hold(system, Distance([[0, 1]]), np.eye(4, 3))
    plain = context_of(particles([12.0] * 4), ProjectedIntegrator(0.001))
    carried = context_of(system, ProjectedIntegrator(0.001, parts=[part]))
    x = np.eye(4, 3) + 1e-3
    v = np.array([[0.1, 0.1, 0.3], [0.1, 0.1, 0.3], [0.7, -0.3, 0.123456789], [1 / 3, 1e-9, 1e5]])
    for context in (plain, carried):
        context.setPositions(x)
        context.setVelocities(v)
        context.getIntegrator().step(20)
    (x_plain, v_plain), (x_carried, v_carried) = state_of(plain), state_of(carried)
    assert np.array_equal(x_plain[2:], x_carried[2:])
    assert np.array_equal(v_plain[2:], v_carried[2:])


# -- errors -----------------------------------------------------------------------------------------


def _clumsy(r):
    if r[0, 0] > 0.05:
        raise ZeroDivisionError("user code")
    return r[0, 2]


def _up(r):
    return np.array([[0.0, 0.0, 1.0]])


def test_errors_of_user_functions_come_through():
    part = hold(system := particles([1.0]), Custom([0], _clumsy, _up), [[0, 0, 0]])
    integrator = ProjectedIntegrator(0.01, parts=[part])
    context = started(system, integrator, [[0, 0, 0]], [[1.0, 0, 0]])
    with pytest.raises(ZeroDivisionError, match="user code") as caught:
        integrator.step(100)
    assert "in step 6" in caught.value.__notes__[0]
    assert state_of(context)[0][0, 0] == pytest.approx(0.05, abs=1e-12)


def test_energies_and_forces_of_the_context_are_those_of_the_system():
    _, integrator, context = peptide()
    integrator.step(10)
    every = context.getState(energy=True, forces=True)
    own = context.getState(energy=True, forces=True, groups=integrator.getIntegrationForceGroups())
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


# -- copies -----------------------------------------------------------------------------------------


def test_rows_belong_to_their_system():
    """Copies of the System, and pickles of the integrator, are refused; without the part, so is the integrator."""
    system, part, _ = driven()
    for copied in (copy.deepcopy, openmm.XmlSerializer.serialize):
        with pytest.raises(openmm.OpenMMException, match="could not be pickled"):
            copied(system)
    with pytest.raises(UnsupportedError, match="belong to their System"):
        pickle.dumps(ProjectedIntegrator(0.01, parts=[part]))


def test_copies_of_an_integrator_take_turns_with_the_rows_of_the_system():
    system, part, x = driven()
    integrator, context = begun(system, part, x)
    integrator.step(5)
    other = copy.deepcopy(integrator)
    again = started(system, other, x)
    other.applyVelocityConstraints(again)
    other.setStepSize(0.004)
    for _ in range(2):
        for one, place in ((other, again), (integrator, context)):
            one.step(5)
            assert off_target(place) < 1e-12


# -- what a System must be like -----------------------------------------------------------------------


def _shares(system):
    system.addConstraint(1, 2, 1.0)
    part = CarriedConstraints(system, Distance([[0, 1]]), np.eye(3))
    part.add_to(system)
    return part


def _not_added(system):
    return CarriedConstraints(system, Distance([[0, 1]]), np.eye(3))


def _lighter(system):
    part = hold(system, Distance([[0, 1]]), np.eye(3))
    system.setParticleMass(0, 4.0)
    return part


def _later(system):
    part = hold(system, Distance([[0, 1]]), np.eye(3))
    system.addConstraint(1, 2, 1.0)
    return part


@pytest.mark.parametrize(
    ("made", "error", "words"),
    [
        (_shares, UnsupportedError, r"constraint 0 .* atoms 1 and 2.*hold\(system"),
        (_not_added, InputError, "no forces that carry"),
        (_lighter, InputError, "masses have changed"),
        (_later, InputError, "got constraints after"),
    ],
)
def test_a_system_that_does_not_go_with_the_rows_is_refused(made, error, words):
    system = particles([12.0] * 3)
    part = made(system)
    context = started(system, ProjectedIntegrator(0.01, parts=[part]), np.eye(3))
    with pytest.raises(error, match=words):
        part.check(context)


def test_masses_that_change_in_a_run_are_noticed_at_the_next_check():
    system = particles([12.0] * 2)
    part = hold(system, Distance([[0, 1]]), np.eye(2, 3))
    integrator = ProjectedIntegrator(0.01, parts=[part])
    context = started(system, integrator, np.eye(2, 3))
    integrator.step(5)
    system.setParticleMass(0, 4.0)
    context.reinitialize(True)
    with pytest.raises(InputError, match="masses have changed"):
        integrator.step(100)


def test_an_integrator_that_does_not_hold_the_rows_is_refused():
    """The constraints that moved to the rows would be held by nobody."""
    system = particles([12.0] * 2)
    hold(system, Distance([[0, 1]]), np.eye(2, 3))
    verlet = openmm.VerletIntegrator(0.01)
    context = started(system, verlet, np.eye(2, 3))
    with pytest.raises(openmm.OpenMMException, match=r"does not hold the rows of hold.* parts=\[rows\]"):
        verlet.step(2)
    del context


def test_rows_that_need_the_time_are_not_held_without_their_integrator():
    """Nobody else knows the time step: a CompoundIntegrator keeps no object of Python."""
    system = particles([12.0] * 2)
    part = hold(system, Distance([[0, 1]], lambda t: np.sqrt(2) + t), np.eye(2, 3))
    both = openmm.CompoundIntegrator()
    both.addIntegrator(ProjectedIntegrator(0.01, parts=[part], device=False))
    gc.collect()
    context = started(system, both, np.eye(2, 3))
    with pytest.raises(openmm.OpenMMException, match="keep a reference"):
        both.step(1)
    del context


def test_gpus_must_carry_positions_of_more_than_single_numbers():
    integrator = ProjectedIntegrator(0.01, parts=[driven()[1]], device=False)
    for precision in ("mixed", "double"):
        integrator.take_precision(Precision("CUDA", precision))
    with pytest.raises(UnsupportedError, match=r"CUDA, single precision hands .*'mixed'.* or hold the rows by Coll"):
        integrator.take_precision(Precision("CUDA", "single"))
