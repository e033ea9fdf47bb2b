"""Rows of kcons carried by PythonForces: exact, reversible, of the order of their scheme, and safe in failure."""

from __future__ import annotations

import copy
import sys
from pathlib import Path

import numpy as np
import openmm
import pytest
from openmm import app, unit

from kcons.constraint_set import ConstraintSet
from kcons.constraints import (
    Angle,
    CenterDistance,
    Custom,
    Dihedral,
    Distance,
    FixedAtoms,
    KnifeEdge,
    LinearRelation,
    MovingTarget,
    Plane,
    RadiusOfGyration,
    Sphere,
)
from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.motion import Motion
from kcons.openmm import ProjectedIntegrator
from kcons.openmm.carrier import CarriedConstraints
from kcons.openmm.requirements import refuse_single_precision
from kcons.openmm.transfer import hold
from kcons.steppers import BlanesMoan6, Rattle, System

NM, PS = unit.nanometer, unit.picosecond
PEPTIDE_FILE = Path(__file__).parent.parent / "data" / "alanine-dipeptide-implicit.pdb"
PEPTIDE = app.PDBFile(str(PEPTIDE_FILE))
PSI = [[6, 8, 14, 16]]


def context_of(system, integrator, platform="Reference"):
    properties = {"Threads": "1"} if platform == "CPU" else {}
    return openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform), properties)


def state_of(context):
    state = context.getState(positions=True, velocities=True)
    return (
        state.getPositions(asNumpy=True).value_in_unit(NM).copy(),
        state.getVelocities(asNumpy=True).value_in_unit(NM / PS).copy(),
    )


def start(context, part, x, temperature=300, seed=1):
    context.setPositions(x)
    part.apply_positions(context)
    context.setVelocitiesToTemperature(temperature, seed)
    part.apply_velocities(context)
    part.check(context)


def peptide(rows=True, scheme="rattle", dt=0.001, platform="Reference", constraints=app.AllBonds):
    """Alanine dipeptide with all bonds, and a dihedral, carried."""
    system = app.ForceField("amber14-all.xml").createSystem(
        PEPTIDE.topology, constraints=constraints, rigidWater=False, removeCMMotion=False
    )
    part = hold(system, [Dihedral(PSI)] if rows else [], PEPTIDE.positions, take="all")
    integrator = ProjectedIntegrator(dt, scheme, parts=[part])
    context = context_of(system, integrator, platform)
    start(context, part, PEPTIDE.positions)
    return part, integrator, context


def free(masses, force=None):
    """Particles under a force on each, or none."""
    system = openmm.System()
    for m in masses:
        system.addParticle(m)
    if force is not None:
        system.addForce(force)
    return system


def pull(strength, n):
    force = openmm.CustomExternalForce(f"-{strength}*z")
    for k in range(n):
        force.addParticle(k, [])
    return force


# -- exactness ------------------------------------------------------------------------------------


@pytest.mark.parametrize("platform", ["Reference", "CPU"])
def test_rows_are_held_to_rounding(platform):
    part, integrator, context = peptide(platform=platform)
    worst = np.zeros(2)
    held = part.motion.constraint_set
    for _ in range(50):
        integrator.step(4)
        x, v = state_of(context)
        rates = held.jacobian(x) @ v.ravel()
        worst = np.maximum(worst, [np.abs(held.value(x)).max(), np.abs(rates).max()])
    assert worst[0] <= 1e-14
    assert worst[1] <= 1e-13
    assert part.rank(context) == 22


def test_positions_come_back_to_the_last_bit():
    """Carrying v through x must not move x: without forces and rows in the way, x = x0 + v t exactly as without."""
    system = free([12.0] * 4)
    part = hold(system, Distance([[0, 1]]), np.eye(4, 3))
    plain = context_of(free([12.0] * 4), ProjectedIntegrator(0.001))
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


@pytest.mark.parametrize("scheme", ["rattle", "suzuki4", "blanes-moan6"])
def test_reversible(scheme):
    _, integrator, context = peptide(scheme=scheme)
    x, _ = state_of(context)
    integrator.step(20)
    there, speed = state_of(context)
    context.setVelocities(-speed)
    integrator.step(20)
    back, _ = state_of(context)
    assert np.abs(there - x).max() > 1e-3
    assert np.abs(back - x).max() <= 1e-12


@pytest.mark.parametrize(
    ("scheme", "order", "steps"),
    [("rattle", 2, (48, 96, 192)), ("suzuki4", 4, (24, 48, 96)), ("blanes-moan6", 6, (8, 12, 18, 24))],
)
def test_order_with_bonds_and_a_dihedral(scheme, order, steps):
    """Against a run of order 6 with far shorter steps, over 48 fs."""
    span = 0.048

    def end(name, count):
        _, integrator, context = peptide(scheme=name, dt=span / count)
        integrator.step(count)
        return state_of(context)[0]

    exact = end("blanes-moan6", 72)
    errors = [np.abs(end(scheme, count) - exact).max() for count in steps]
    slope = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize(("scheme", "stepper"), [("rattle", Rattle()), ("blanes-moan6", BlanesMoan6())])
def test_same_trajectory_as_the_stepper_of_the_core(scheme, stepper):
    part, integrator, context = peptide(scheme=scheme)
    bare = openmm.XmlSerializer.clone(context.getSystem())
    for k in reversed(range(bare.getNumForces())):
        if isinstance(bare.getForce(k), openmm.PythonForce):
            bare.removeForce(k)
    probe = context_of(bare, openmm.VerletIntegrator(0.001))

    def force(x, t):
        probe.setPositions(x)
        return probe.getState(forces=True).getForces(asNumpy=True)._value

    x, v = state_of(context)
    core = System(part.motion, force)
    state = core.initial_state(x, v)
    for _ in range(50):
        state = stepper.step(core, state, 0.001)
    integrator.step(50)
    x, v = state_of(context)
    assert np.abs(x - state.positions).max() <= 1e-11
    assert np.abs(v - state.velocities).max() <= 1e-9


def test_same_trajectory_as_openmm_with_its_own_constraints():
    _, integrator, context = peptide(rows=False)
    system = app.ForceField("amber14-all.xml").createSystem(
        PEPTIDE.topology, constraints=app.AllBonds, rigidWater=False, removeCMMotion=False
    )
    own = context_of(system, ProjectedIntegrator(0.001, tolerance=1e-12))
    x, v = state_of(context)
    own.setPositions(x)
    own.setVelocities(v)
    own.getIntegrator().step(100)
    integrator.step(100)
    assert np.abs(state_of(own)[0] - state_of(context)[0]).max() <= 1e-9


@pytest.mark.parametrize(("steps", "bound"), [(100, 1e-12), (4000, 1e-9)])
def test_one_bond_runs_as_openmms_own(steps, bound):
    x = np.array([[-0.5, 0, 0], [0.5, 0, 0]])
    v = np.array([[0.1, -0.5, 0.2], [0.1, 0.5, 0.1]])
    part = hold(system := free([1.0, 3.0], pull(3.0, 1)), Distance([[0, 1]], 1.0), x)
    carried = context_of(system, ProjectedIntegrator(0.002, parts=[part]))
    built_in = free([1.0, 3.0], pull(3.0, 1))
    built_in.addConstraint(0, 1, 1.0)
    own = context_of(built_in, ProjectedIntegrator(0.002, tolerance=1e-15))
    for context in (carried, own):
        context.setPositions(x)
        context.setVelocities(v)
        context.getIntegrator().step(steps)
    assert np.abs(state_of(carried)[0] - state_of(own)[0]).max() <= bound


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-6, 1e-10])
def test_a_protein_runs_as_with_ccma_within_its_tolerance(tolerance):
    pdb = app.PDBFile(str(PEPTIDE_FILE.parent / "5dfr_minimized.pdb"))
    system = app.ForceField("amber99sb.xml").createSystem(
        pdb.topology, constraints=app.AllBonds, rigidWater=False, removeCMMotion=False
    )
    nonbonded = next(k for k in range(system.getNumForces()) if isinstance(system.getForce(k), openmm.NonbondedForce))
    system.removeForce(nonbonded)
    moved = openmm.XmlSerializer.clone(system)
    part = hold(moved, [], pdb.positions, take="all")
    carried = context_of(moved, ProjectedIntegrator(0.001, parts=[part]))
    start(carried, part, pdb.positions)
    x, v = state_of(carried)
    own = context_of(system, ProjectedIntegrator(0.001, tolerance=tolerance))
    own.setPositions(x)
    own.setVelocities(v)
    for context in (carried, own):
        context.getIntegrator().step(10)
    assert np.abs(state_of(carried)[0] - state_of(own)[0]).max() <= tolerance


def test_leapfrog_is_verlet_of_openmm():
    part, integrator, context = peptide(rows=False, scheme="leapfrog")
    system = app.ForceField("amber14-all.xml").createSystem(
        PEPTIDE.topology, constraints=app.AllBonds, rigidWater=False, removeCMMotion=False
    )
    verlet = openmm.VerletIntegrator(0.001)
    verlet.setConstraintTolerance(1e-12)
    own = context_of(system, verlet)
    x, v = state_of(context)
    own.setPositions(x)
    own.setVelocities(v)
    verlet.step(100)
    integrator.step(100)
    assert np.abs(state_of(own)[0] - state_of(context)[0]).max() <= 1e-9
    with pytest.raises(ConvergenceError, match="step 101"):
        integrator.setStepSize(0.1)
        integrator.step(1)
    assert part.step_multipliers.shape == (21,)


# -- closed forms ---------------------------------------------------------------------------------


def test_free_sphere_runs_along_a_great_circle():
    """RATTLE on a sphere turns by asin(w dt) a step."""
    radius, speed, dt, steps = 0.5, 2.0, 0.01, 200
    part = hold(system := free([3.0]), Sphere([[0]], [0.1, 0, 0], radius), [[0.6, 0, 0]])
    context = context_of(system, ProjectedIntegrator(dt, parts=[part]))
    context.setPositions([[0.6, 0, 0]])
    context.setVelocities([[0, speed, 0]])
    part.check(context)
    context.getIntegrator().step(steps)
    angle = steps * np.arcsin(speed * dt / radius)
    x, v = state_of(context)
    assert np.abs(x[0] - [0.1 + radius * np.cos(angle), radius * np.sin(angle), 0]).max() <= 1e-12
    assert np.abs(v[0] - speed * np.array([-np.sin(angle), np.cos(angle), 0])).max() <= 1e-12


def test_dumbbell_turns_rigidly():
    dt, steps = 0.01, 100
    part = hold(system := free([1.0, 1.0]), Distance([[0, 1]]), [[-0.5, 0, 0], [0.5, 0, 0]])
    context = context_of(system, ProjectedIntegrator(dt, parts=[part]))
    context.setPositions([[-0.5, 0, 0], [0.5, 0, 0]])
    context.setVelocities([[0, -0.5, 0.2], [0, 0.5, 0.2]])
    context.getIntegrator().step(steps)
    angle = steps * np.arcsin(dt)
    x, _ = state_of(context)
    assert np.abs(x[1] - [0.5 * np.cos(angle), 0.5 * np.sin(angle), 0.2 * dt * steps]).max() <= 1e-12


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
    context.getIntegrator().step(200)
    part.check(context)
    report = part.report(context)
    assert report.residual <= 1e-12
    assert report.velocity_residual <= 1e-12
    assert np.abs(state_of(context)[0] - CROSS).max() > 0.01


@pytest.mark.parametrize("scheme", ["rattle", "suzuki4", "blanes-moan6"])
def test_velocity_rows_follow_the_core(scheme):
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
    for _ in range(20):
        state = integrator.scheme.step(core, state, 0.01)
    integrator.step(20)
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


# -- failure --------------------------------------------------------------------------------------


@pytest.mark.parametrize("platform", ["Reference", "CPU"])
def test_a_step_too_large_is_taken_back(platform):
    part = hold(system := free([1.0, 1.0]), Distance([[0, 1]]), [[-0.5, 0, 0], [0.5, 0, 0]])
    integrator = ProjectedIntegrator(0.1, parts=[part])
    context = context_of(system, integrator, platform)
    context.setPositions([[-0.5, 0, 0], [0.5, 0, 0]])
    context.setVelocities([[0, -0.5, 0], [0, 0.5, 0]])
    integrator.step(3)
    integrator.setStepSize(1.5)  # no solution where angle would be asin(1.5)
    before = state_of(context)
    with pytest.raises(ConvergenceError, match="step 4: time step too large") as caught:
        integrator.step(5)
    assert caught.value.step == 4
    assert caught.value.atoms == (0, 1)
    assert all(np.array_equal(a, b) for a, b in zip(before, state_of(context), strict=True))
    integrator.setStepSize(0.1)
    integrator.step(3)
    part.check(context)


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
def test_gpus_carry_positions_in_double_precision_only(precision):
    class Context:
        def getPlatform(self):
            return self

        def getPropertyNames(self):
            return ("DeviceIndex", "Precision")

        def getPropertyValue(self, context, name):
            return precision

        def getName(self):
            return "CUDA"

    if precision == "double":
        refuse_single_precision(Context())
        return
    with pytest.raises(UnsupportedError, match=f"CUDA platform carries positions in {precision} precision"):
        refuse_single_precision(Context())


def test_no_free_groups():
    system = free([1.0, 1.0])
    for group in range(30):
        force = openmm.HarmonicBondForce()
        force.setForceGroup(group)
        system.addForce(force)
    with pytest.raises(UnsupportedError, match="3 force groups, and 2 are free"):
        CarriedConstraints(system, Distance([[0, 1]]), np.eye(2, 3))


# -- as a force of OpenMM -------------------------------------------------------------------------


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
    assert other.motion is not part.motion
    again = context_of(system, ProjectedIntegrator(0.001, parts=[other]))
    again.setPositions(x)
    again.setVelocities(v)
    other.check(again)
    integrator.step(20)
    again.getIntegrator().step(20)
    assert np.array_equal(state_of(again)[0], state_of(context)[0])


def _xml(system):
    return openmm.XmlSerializer.serialize(system)


def test_rows_with_functions_that_cannot_be_pickled_stay():
    part = hold(system := free([1.0]), Custom([0], lambda r: r[0, 2], _up), [[0, 0, 0]])
    with pytest.raises(openmm.OpenMMException, match="could not be pickled"):
        openmm.XmlSerializer.serialize(system)
    assert part.rank() == 1


def test_a_system_without_rows_is_said_so():
    with pytest.raises(InputError, match="no sets of rows"):
        CarriedConstraints.of(free([1.0]))


def test_program_is_listed():
    _, integrator, _ = peptide()
    listing = integrator.listing()
    for words in ("solve for positions", "solve for velocities", "gradients are taken"):
        assert f"carried rows: {words}" in listing or words in listing
