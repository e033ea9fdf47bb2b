"""Rows that are carried through OpenMM: failures, what a System must be like, copies and files."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from carried_systems import context_of, free, peptide, state_of
from openmm import unit

from kcons.constraints import Distance
from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.openmm import ProjectedIntegrator
from kcons.openmm.callback_rows.carried_constraints import CarriedConstraints, refuse_single_precision
from kcons.openmm.callback_rows.hold import hold
from kcons.openmm.integrator.precision import Precision

# -- failure --------------------------------------------------------------------------------------


@pytest.mark.parametrize("platform", ["Reference", "CPU"])
def test_a_step_too_large_is_taken_back(platform):
    part = hold(system := free([1.0, 1.0]), Distance([[0, 1]]), [[-0.5, 0, 0], [0.5, 0, 0]])
    integrator = ProjectedIntegrator(0.1 * unit.picosecond, parts=[part])
    context = context_of(system, integrator, platform)
    context.setPositions([[-0.5, 0, 0], [0.5, 0, 0]])
    context.setVelocities([[0, -0.5, 0], [0, 0.5, 0]])
    integrator.step(3)
    integrator.setStepSize(1.5 * unit.picosecond)  # no solution where angle would be asin(1.5)
    before = state_of(context)
    with pytest.raises(ConvergenceError, match="step 4: time step too large") as caught:
        integrator.step(5)
    assert caught.value.step == 4
    assert caught.value.atoms == (0, 1)
    assert all(np.array_equal(a, b) for a, b in zip(before, state_of(context), strict=True))
    integrator.setStepSize(0.1 * unit.picosecond)
    integrator.step(3)
    part.check(context)


def test_states_off_the_rows_are_refused_and_put_right():
    part = hold(system := free([1.0, 1.0]), Distance([[0, 1]], 1.0), [[0, 0, 0], [1.0, 0, 0]])
    context = context_of(system, ProjectedIntegrator(0.01, parts=[part]))
    context.setPositions([[0, 0, 0], [1.1, 0, 0]])
    with pytest.raises(InputError, match=r"off row #0 Distance\(0, 1\) by 0.1.*apply_positions"):
        part.check(context)
    part.apply_positions(context)
    assert np.abs(state_of(context)[0] - [[0.05, 0, 0], [1.05, 0, 0]]).max() <= 1e-14
    context.setVelocities([[0, 0, 0], [1.0, 1.0, 0]])
    with pytest.raises(InputError, match="apply_velocities"):
        part.check(context)
    part.apply_velocities(context)
    assert np.abs(state_of(context)[1] - [[0.5, 0, 0], [0.5, 1.0, 0]]).max() <= 1e-14
    part.check(context)


# -- what a System must be like -------------------------------------------------------------------


def test_constraints_left_in_the_system_must_not_share_atoms():
    system = free([12.0] * 3)
    system.addConstraint(1, 2, 1.0)
    part = CarriedConstraints(system, Distance([[0, 1]]), np.eye(3))
    part.add_to(system)
    context = context_of(system, ProjectedIntegrator(0.01, parts=[part]))
    context.setPositions(np.eye(3))
    with pytest.raises(UnsupportedError, match=r"constraint 0 .* atoms 1 and 2.*hold\(system"):
        part.check(context)


def test_forces_must_be_added():
    system = free([12.0] * 2)
    part = CarriedConstraints(system, Distance([[0, 1]]), np.eye(2, 3))
    context = context_of(system, ProjectedIntegrator(0.01, parts=[part]))
    context.setPositions(np.eye(2, 3))
    with pytest.raises(InputError, match="add_to"):
        part.check(context)


def test_changed_masses_are_noticed():
    part = hold(system := free([12.0] * 2), Distance([[0, 1]]), np.eye(2, 3))
    context = context_of(system, ProjectedIntegrator(0.01, parts=[part]))
    context.setPositions(np.eye(2, 3))
    system.setParticleMass(0, 4.0)
    with pytest.raises(InputError, match="masses have changed"):
        part.check(context)


def test_virtual_sites_are_refused():
    system = free([1.0, 1.0, 0.0])
    system.setVirtualSite(2, openmm.TwoParticleAverageSite(0, 1, 0.5, 0.5))
    with pytest.raises(UnsupportedError, match="atom 2 is a virtual site"):
        CarriedConstraints(system, Distance([[0, 2]]), np.eye(3))


@pytest.mark.parametrize("rows", [[], [Distance(np.zeros((0, 2), dtype=int))]])
def test_nothing_to_hold_is_refused(rows):
    with pytest.raises(InputError, match="no rows"):
        CarriedConstraints(free([1.0]), rows, [[0, 0, 0]])


def test_wrong_positions_are_refused():
    with pytest.raises(InputError, match=r"shape \(2, 3\)"):
        CarriedConstraints(free([1.0, 1.0]), Distance([[0, 1]]), [[0, 0, 0]])


@pytest.mark.parametrize("precision", ["single", "mixed", "double"])
def test_gpus_carry_positions_of_more_than_single_numbers(precision):
    if precision != "single":
        refuse_single_precision(Precision("CUDA", precision))
        return
    with pytest.raises(UnsupportedError, match=r"CUDA, single precision hands .*'mixed'.* or hold the rows by Coll"):
        refuse_single_precision(Precision("CUDA", precision))


def test_no_free_groups():
    system = free([1.0, 1.0])
    for group in range(30):
        force = openmm.HarmonicBondForce()
        force.setForceGroup(group)
        system.addForce(force)
    with pytest.raises(UnsupportedError, match="3 force groups, and 2 are free"):
        CarriedConstraints(system, Distance([[0, 1]]), np.eye(2, 3))


# -- as a force of OpenMM -------------------------------------------------------------------------


def test_a_system_without_rows_is_said_so():
    with pytest.raises(InputError, match="no sets of rows"):
        CarriedConstraints.of(free([1.0]))


def test_program_is_listed():
    _, integrator, _ = peptide()
    listing = integrator.listing()
    for words in ("solve for positions", "solve for velocities", "gradients are taken"):
        assert f"carried rows: {words}" in listing or words in listing
