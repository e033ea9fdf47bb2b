"""Rows that kcons holds in OpenMM: periodic boxes, multipliers, moving targets, what is out of reach."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from carried_systems import start
from ensemble_runs import two_parts
from openmm import unit
from openmm_systems import context_of, dumbbell, field, particles, started, state_of

from kcons.constraints import Distance
from kcons.errors import InputError, UnsupportedError
from kcons.openmm import Isokinetic, Langevin, ProjectedIntegrator, hold


def pair(x, cutoff=1.0):
    """Two particles in a cube of 2 nm, their distance held."""
    system = particles([12.0, 12.0])
    nonbonded = openmm.NonbondedForce()
    nonbonded.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    nonbonded.setCutoffDistance(cutoff)
    for _ in range(2):
        nonbonded.addParticle(0, 0.1, 0)
    system.addForce(nonbonded)
    part = hold(system, Distance([[0, 1]]), x)
    context = context_of(system, ProjectedIntegrator(0.01, parts=[part]))
    start(context, part, x)
    return context, part


def test_rows_across_the_boundary_take_minimum_images():
    context, part = pair(np.array([[0.1, 0, 0], [1.9, 0, 0]]))
    assert part.motion.constraint_set.target() == pytest.approx([0.2], abs=1e-15)
    context.getIntegrator().step(50)
    part.check(context)
    # The box of the context counts, also where it changes.
    context.setPeriodicBoxVectors([2.1, 0, 0], [0, 2, 0], [0, 0, 2])
    with pytest.raises(InputError, match="off row"):
        part.check(context)


def test_a_box_too_small_stops_the_step():
    context, _ = pair(np.array([[0.1, 0, 0], [0.5, 0, 0]]), cutoff=0.2)
    context.setPeriodicBoxVectors([0.7, 0, 0], [0, 2, 0], [0, 0, 2])
    before = state_of(context)
    with pytest.raises(InputError, match="half the box"):
        context.getIntegrator().step(1)
    assert all(np.array_equal(a, b) for a, b in zip(before, state_of(context), strict=True))


@pytest.mark.usefixtures("without_device")
def test_multipliers_of_a_hanging_weight():
    """The rod of a weight at rest pulls with m g."""
    part = hold(system := particles([0.0, 2.0], field("19.6*z", 2)), Distance([[0, 1]]), [[0, 0, 0], [0, 0, -0.5]])
    context = context_of(system, ProjectedIntegrator(0.001, parts=[part]))
    context.setPositions([[0, 0, 0], [0, 0, -0.5]])
    assert part.multipliers(context)[0] == pytest.approx(-19.6, abs=1e-12)


def test_what_cannot_be_reached_leaves_positions_as_they_were():
    """That the rows are held: `test_every_ensemble`."""
    system, x, parts = two_parts()
    integrator = ProjectedIntegrator(0.002, parts=parts)
    x[5] = 0.0  # the center of the sphere: no nearest point
    context = started(system, integrator, x)
    with pytest.raises(Exception, match=r"Sphere\(5\)|particle 5|row") as caught:
        integrator.applyConstraints(context)
    assert type(caught.value).__module__ == "kcons.errors"
    assert np.array_equal(state_of(context)[0], x)


@pytest.mark.filterwarnings("ignore:the forces exert no torque")
@pytest.mark.parametrize("ensemble", [Isokinetic(300.0), Langevin(300.0, 5.0)], ids=str)
def test_moving_targets_are_refused_and_held_by_langevin(ensemble):
    system, x, _ = dumbbell()
    x = np.vstack([x, x[:1] + np.array([0.2, 0.1, 0.0])])
    system.addParticle(14.0)
    part = hold(system, [Distance([[0, 2]], lambda t: 0.2236 + 0.5 * t)], positions=x)
    context = started(system, integrator := ProjectedIntegrator(1e-3, parts=[part], ensemble=ensemble), x)
    integrator.applyConstraints(context)
    integrator.setVelocitiesToTemperature(context, 300, 2)
    if isinstance(ensemble, Isokinetic):
        with pytest.raises(UnsupportedError, match="needs constant targets"):
            integrator.step(1)
        return
    for _ in range(4):
        integrator.step(10)
        context.getState(energy=True, forces=True)  # evaluates all groups between steps
        r, u = state_of(context)
        d = r[2] - r[0]
        now = context.getTime().value_in_unit(unit.picosecond)
        assert abs(np.linalg.norm(d) - (0.2236 + 0.5 * now)) < 1e-12
        assert abs(d @ (u[2] - u[0]) / np.linalg.norm(d) - 0.5) < 1e-9
