"""Rows that are carried through OpenMM: each kind, periodic boxes, multipliers."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from carried_systems import start
from openmm_systems import context_of, field, particles, state_of

from kcons.constraints import Distance
from kcons.errors import InputError
from kcons.openmm import ProjectedIntegrator
from kcons.openmm.callback_rows import hold


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
