"""Rows that are carried through OpenMM: each kind, periodic boxes, multipliers."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from carried_systems import context_of, free, peptide, pull, start, state_of

from kcons.constraints import (
    Angle,
    CenterDistance,
    Custom,
    Dihedral,
    Distance,
    DistanceDifference,
    FixedAtoms,
    KnifeEdge,
    LinearRelation,
    MovingTarget,
    Plane,
    RadiusOfGyration,
    Sphere,
)
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError
from kcons.motion import Motion
from kcons.openmm import ProjectedIntegrator
from kcons.openmm.callback_rows.hold import hold
from kcons.steppers import System

# -- kinds of rows --------------------------------------------------------------------------------

CROSS = np.array([[0.0, 0, 0], [0.15, 0, 0], [0.2, 0.14, 0], [0.25, 0.15, 0.13], [0.4, 0.1, 0.1], [0.1, -0.1, 0.3]])


def _height(r):
    return r[0, 2] - 0.3 * r[1, 0] ** 2


def _slope(r):
    return np.array([[0.0, 0.0, 1.0], [-0.6 * r[1, 0], 0.0, 0.0]])


KINDS = {
    "angle": [Angle([[0, 1, 2]]), Distance([[0, 1], [1, 2]])],
    "dihedral": [Dihedral([[0, 1, 2, 3]])],
    "surfaces": [Sphere([5], [0, 0, 0]), Plane([4], [0, 0, 1])],
    "relation": [LinearRelation([3], [1, 2], [0.5, 0.5], None)],
    "difference": [DistanceDifference([[0, 1], [1, 2], [3, 4]], weights=[1.0, -1.0, 0.5])],
    "gyration": [RadiusOfGyration([range(6)])],
    "centers": [CenterDistance([0, 1, 2], [3, 4])],
    "custom": [Custom([3, 4], _height, _slope)],
    "fixed and redundant": [FixedAtoms([0]), Distance([[0, 1]]), Distance([[1, 0]])],
    "knife edge": [KnifeEdge(4, 5, [0.0, 1.0, 0.0]), Distance([[4, 5]])],
}


@pytest.mark.parametrize("rows", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize("scheme", ["rattle", "suzuki4"])
def test_every_kind_is_held(rows, scheme):
    system = free([12.0, 1.0, 14.0, 16.0, 32.0, 4.0], pull(20.0, 6))
    part = hold(system, rows, CROSS)
    context = context_of(system, ProjectedIntegrator(0.001, scheme, parts=[part]))
    start(context, part, CROSS)
    # Drifts with velocity rows are solved by iteration, and a step of the composition has five.
    context.getIntegrator().step(60 if scheme == "suzuki4" and "KnifeEdge" in {row.family for row in rows} else 200)
    part.check(context)
    report = part.report(context)
    assert report.residual <= 1e-12
    assert report.velocity_residual <= 1e-12
    assert np.abs(state_of(context)[0] - CROSS).max() > 0.01


@pytest.mark.parametrize(("scheme", "steps"), [("rattle", 20), ("suzuki4", 8), ("blanes-moan6", 3)])
def test_velocity_rows_follow_the_core(scheme, steps):
    rows = KINDS["knife edge"]
    masses = [12.0, 1.0, 14.0, 16.0, 32.0, 4.0]
    system = free(masses, pull(20.0, 6))
    part = hold(system, rows, CROSS)
    integrator = ProjectedIntegrator(0.01, scheme, parts=[part])
    context = context_of(system, integrator)
    start(context, part, CROSS)
    x, v = state_of(context)
    core = System(Motion(ConstraintSet(rows, CROSS, masses), CROSS), lambda x, t: np.tile([0, 0, 20.0], (6, 1)))
    state = core.initial_state(x, v)
    for _ in range(steps):
        state = integrator.scheme.step(core, state, 0.01)
    integrator.step(steps)
    assert np.abs(state_of(context)[0] - state.positions).max() <= 1e-11


@pytest.mark.parametrize("scheme", ["rattle", "geodesic", "suzuki4", "blanes-moan6"])
def test_moving_target_is_met_at_the_right_time(scheme):
    length = MovingTarget(
        lambda t: 1 + 0.1 * np.sin(3 * t), lambda t: 0.3 * np.cos(3 * t), lambda t: -0.9 * np.sin(3 * t)
    )
    rows, x = [Distance([[0, 1]], length)], np.array([[0.0, 0, 0], [1.0, 0, 0]])
    system = free([3.0, 1.0], pull(2.0, 1))
    part = hold(system, rows, x)
    integrator = ProjectedIntegrator(0.02, scheme, parts=[part])
    context = context_of(system, integrator)
    context.setPositions(x)
    context.setVelocities([[0, 0.1, 0], [0.05, 1.0, 0.3]])
    part.apply_velocities(context)
    part.check(context)
    x0, v0 = state_of(context)
    core = System(Motion(ConstraintSet(rows, x, [3.0, 1.0]), x), lambda x, t: np.array([[0, 0, 2.0], [0, 0, 0]]))
    state = core.initial_state(x0, v0)
    for k in range(1, 51):
        integrator.step(1)
        context.getState(energy=True, forces=True)  # evaluates all groups between steps
        state = integrator.scheme.step(core, state, 0.02)
        there, speed = state_of(context)
        assert np.linalg.norm(there[1] - there[0]) == pytest.approx(1 + 0.1 * np.sin(0.06 * k), abs=1e-13)
    assert np.abs(there - state.positions).max() <= 1e-11
    assert np.abs(speed - state.velocities).max() <= 1e-10


def test_particles_without_mass_are_fixed():
    part = hold(system := free([0.0, 2.0]), Distance([[0, 1]]), [[0, 0, 0], [0.4, 0, 0]])
    context = context_of(system, ProjectedIntegrator(0.01, parts=[part]))
    context.setPositions([[0, 0, 0], [0.4, 0, 0]])
    context.setVelocities([[0, 0, 0], [0, 1.0, 0]])
    context.getIntegrator().step(10)
    angle = 10 * np.arcsin(0.01 / 0.4)
    assert part.rank() == 1
    assert np.abs(state_of(context)[0] - [[0, 0, 0], [0.4 * np.cos(angle), 0.4 * np.sin(angle), 0]]).max() <= 1e-13


# -- periodic boxes -------------------------------------------------------------------------------


def test_rows_across_the_boundary_take_minimum_images():
    system = free([12.0, 12.0])
    nonbonded = openmm.NonbondedForce()
    nonbonded.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    for _ in range(2):
        nonbonded.addParticle(0, 0.1, 0)
    system.addForce(nonbonded)
    x = np.array([[0.1, 0, 0], [1.9, 0, 0]])
    part = hold(system, Distance([[0, 1]]), x)
    assert part.motion.constraint_set.target() == pytest.approx([0.2], abs=1e-15)
    context = context_of(system, ProjectedIntegrator(0.01, parts=[part]))
    start(context, part, x)
    context.getIntegrator().step(50)
    part.check(context)
    # The box of the context counts, also where it changes.
    context.setPeriodicBoxVectors([2.1, 0, 0], [0, 2, 0], [0, 0, 2])
    with pytest.raises(InputError, match="off row"):
        part.check(context)


def test_a_box_too_small_stops_the_step():
    system = free([12.0, 12.0])
    nonbonded = openmm.NonbondedForce()
    nonbonded.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    nonbonded.setCutoffDistance(0.2)
    for _ in range(2):
        nonbonded.addParticle(0, 0.1, 0)
    system.addForce(nonbonded)
    x = np.array([[0.1, 0, 0], [0.5, 0, 0]])
    part = hold(system, Distance([[0, 1]]), x)
    integrator = ProjectedIntegrator(0.01, parts=[part])
    context = context_of(system, integrator)
    start(context, part, x)
    context.setPeriodicBoxVectors([0.7, 0, 0], [0, 2, 0], [0, 0, 2])
    before = state_of(context)
    with pytest.raises(InputError, match="half the box"):
        integrator.step(1)
    assert all(np.array_equal(a, b) for a, b in zip(before, state_of(context), strict=True))


# -- multipliers ----------------------------------------------------------------------------------


def test_multipliers_of_a_hanging_weight():
    """The rod of a weight at rest pulls with m g."""
    part = hold(system := free([0.0, 2.0], pull(-19.6, 2)), Distance([[0, 1]]), [[0, 0, 0], [0, 0, -0.5]])
    context = context_of(system, ProjectedIntegrator(0.001, parts=[part]))
    context.setPositions([[0, 0, 0], [0, 0, -0.5]])
    assert part.multipliers(context)[0] == pytest.approx(-19.6, abs=1e-12)
    with pytest.raises(InputError, match="two steps"):
        part.step_multipliers  # noqa: B018
    # The first steps still move by the tolerance of the solver, 1e-14 of the length, divided by dt^2.
    context.getIntegrator().step(4)
    assert part.step_multipliers[0] == pytest.approx(-19.6, abs=1e-9)


def test_multipliers_of_a_step_are_of_second_order():
    errors = []
    steps = (8, 16, 32)
    for count in steps:
        part, integrator, context = peptide(dt=0.008 / count)
        integrator.step(count)
        exact = part.multipliers(context)
        context.getState(energy=True, forces=True)  # evaluates all groups between steps
        integrator.step(1)
        errors.append(np.abs(part.step_multipliers - exact).max())
    slope = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(2, abs=0.15)
