"""SurfaceIntegrator: what it takes and refuses, checks, errors, multipliers, copies."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import openmm
import pytest
from openmm import unit
from openmm_systems import PLATFORMS
from surface_cases import (
    CENTER,
    KINDS,
    MASSES,
    POSITIONS,
    VELOCITIES,
    force_of,
    on_surface,
    started,
    state_of,
    system_of,
    worst,
)

from kcons.constraints import Custom, Cylinder, Distance, Formula, Line, MovingTarget, Plane, Sphere, Torus
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ConvergenceError, InputError, NonFiniteError, UnsupportedError
from kcons.motion import Motion
from kcons.openmm import ProjectedIntegrator
from kcons.openmm.surfaces.surface_integrator import SurfaceIntegrator, surface_parts

# -- what is refused --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("surfaces", "error", "words"),
    [
        ([], InputError, "no surface"),
        (Sphere([7], [0, 0, 0], 1.0), InputError, "particles 7 to 7"),
        (Sphere([0], [0, 0, 0]), InputError, "positions="),
        (Sphere([0], [0, 0, 0], -1.0), InputError, "not positive"),
        (Torus([0], [0, 0, 0], [0, 0, 1], 1.0, 0.0), InputError, "not positive"),
        ([Sphere([0], [0, 0, 0], 1.0), Plane([0], [0, 0, 1], 0.0)], UnsupportedError, "particle 0 is on two"),
        (Sphere([0], [0, 0, 0], lambda t: 1 + t), UnsupportedError, "moves with time"),
        (Sphere([0], [0, 0, 0], MovingTarget(lambda t: 1.0)), UnsupportedError, "moves with time"),
        (Line([0], [0, 0, 0], [0, 0, 1]), UnsupportedError, "particle 0 is on two"),
        (Formula("x1-t", [0]), UnsupportedError, "moves with time"),
        (Distance([0, 1], 1.0), UnsupportedError, "carrier"),
        (Custom([0], lambda r: float(r[0, 0]), target=0.0), UnsupportedError, "function of Python"),
    ],
)
def test_refused(surfaces, error, words):
    system = system_of()
    forces = system.getNumForces()
    with pytest.raises(error, match=words):
        SurfaceIntegrator(0.001, surfaces=surfaces, system=system, device=False)
    assert system.getNumForces() == forces


def test_needs_the_system():
    with pytest.raises(InputError, match="give system="):
        SurfaceIntegrator(0.001, surfaces=Sphere([0], [0, 0, 0], 1.0), device=False)


# -- the start --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["sphere", "torus", "formula", "rotated ellipsoid"])
@pytest.mark.parametrize("scheme", ["rattle", "geodesic", "suzuki4"])
def test_constraints_are_applied_outside_of_steps(kind, scheme):
    integrator, context = on_surface(kind, scheme, 0.01)
    context.setPositions(POSITIONS + np.array([[0, 0, 0], [0.005, 0.002, -0.003], [0, 0, 0]]))
    context.setVelocities(VELOCITIES)
    integrator.applyConstraints(context)
    integrator.applyVelocityConstraints(context)
    off, across = worst(integrator, context)
    assert off <= 1e-13
    assert across <= 1e-14
    integrator.check(context)


def test_open_targets_are_those_of_the_start():
    held = [Sphere([0], CENTER), Plane([2], [0, 0, 1]), Torus([1], CENTER, [0, 0, 1], 2.0)]
    quantity = unit.Quantity(POSITIONS * 10, unit.angstrom)
    parts = surface_parts(held, system=system_of(), positions=quantity)
    assert np.abs(parts[0].distances(POSITIONS)).max() <= 1e-14


# -- failures ---------------------------------------------------------------------------------------


def too_fast(scheme, platform, kind="sphere"):
    """Particle 2 flies past its surface within a step; the others do not."""
    system = system_of(potential="0", springs=0)
    surfaces = {
        "sphere": [Sphere([0, 2], [0, 0, 0], 1.0)],
        "torus": [Torus([0, 2], [0, 0, 0], [0, 0, 1], 0.7, 0.3)],
        "formula": [Formula("x1**2+y1**2+z1**2-1", [0, 2])],
        "both": [Sphere([0], [0, 0, 0], 1.0), Torus([2], [0, 0, 0], [0, 0, 1], 0.7, 0.3)],
    }[kind]
    integrator = SurfaceIntegrator(0.1 * unit.picosecond, scheme, surfaces=surfaces, system=system, device=False)
    x = np.array([[1.0, 0, 0], [5, 5, 5], [0, 1.0, 0]])
    return integrator, started(system, integrator, x, [[0, 0.5, 0], [1, 2, 3], [0, 0, 0.8]], platform)


@pytest.mark.parametrize("platform", PLATFORMS)
@pytest.mark.parametrize(
    ("scheme", "kind"),
    [(scheme, kind) for scheme in ("rattle", "suzuki4") for kind in ("sphere", "torus", "formula", "both")],
)
def test_a_step_without_solution_is_taken_back(scheme, kind, platform):
    integrator, context = too_fast(scheme, platform, kind)
    integrator.step(3)
    x, v = state_of(context)
    v[2] *= 40
    context.setVelocities(v)
    with pytest.raises(ConvergenceError, match=r"step 4: particle 2 finds no position .*time step too large") as caught:
        integrator.step(5)
    assert caught.value.atoms == (2,)
    assert caught.value.step == 4
    there, velocity = state_of(context)
    assert np.array_equal(there, x)
    assert np.abs(velocity - v).max() <= 1e-14
    assert context.getStepCount() == 3
    assert context.getTime()._value == pytest.approx(0.3)
    v[2] /= 40
    context.setVelocities(v)
    integrator.step(5)
    assert max(worst(integrator, context)) <= 1e-13


def falling(dt):
    system = system_of(potential="200*z", springs=0)
    integrator = SurfaceIntegrator(
        dt * unit.picosecond, "rattle", surfaces=[Sphere([0], [0, 0, 0], 1.0)], system=system, device=False
    )
    x = np.array([[0.6, 0, 0.8], [5, 5, 5], [0, 1.0, 0]])
    return integrator, started(system, integrator, x, np.zeros((3, 3)))


def test_a_first_step_without_solution_leaves_velocities_without_a_kick():
    integrator, context = falling(0.06)
    x, v = state_of(context)
    v[0, 1] = 40.0
    context.setVelocities(v)
    with pytest.raises(ConvergenceError, match=r"step 1: .*time step too large"):
        integrator.step(10)
    assert np.array_equal(state_of(context)[0], x)
    assert np.abs(state_of(context)[1] - v).max() <= 1e-14 * 40


def test_a_step_without_solution_in_the_middle_leaves_whole_velocities():
    (integrator, context), (other, twin) = falling(0.045), falling(0.045)
    with pytest.raises(ConvergenceError, match="time step too large"):
        integrator.step(1000)
    done = context.getStepCount()
    assert done > 2
    other.step(done)
    for here, there in zip(state_of(context), state_of(twin), strict=True):
        np.testing.assert_allclose(here, there, rtol=0, atol=1e-13 * np.abs(there).max())


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "rotated ellipsoid", "torus", "formula"])
@pytest.mark.parametrize("scheme", ["rattle", "geodesic", "suzuki4"])
def test_forces_that_are_not_finite(kind, scheme):
    atoms = np.array([0, 1, 2])
    # The root of a negative number once particle 1 has moved.
    system = system_of(potential="1e-30*sqrt(10+y-1e6*step(0.9-x)*step(y-0.72))", springs=0)
    surfaces = KINDS[kind](atoms, POSITIONS)
    integrator = SurfaceIntegrator(
        50 * unit.femtosecond, scheme, surfaces=surfaces, system=system, device=False, positions=POSITIONS
    )
    context = started(system, integrator, POSITIONS, VELOCITIES)
    with pytest.raises(NonFiniteError) as caught:
        integrator.step(200)
    assert caught.value.step is not None
    x, v = state_of(context)
    assert np.isfinite(x).all()
    assert np.isfinite(v).all()


# -- multipliers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_constraint_forces(kind):
    integrator, context = on_surface(kind, "rattle", 0.01)
    integrator.step(10)
    x, v = state_of(context)
    motion = Motion(ConstraintSet(integrator.surfaces, x, MASSES), x)
    expected = motion.constraint_force(x, v, force_of(x))
    assert integrator.constraint_forces(context) == pytest.approx(expected, abs=1e-11)
    assert integrator.multipliers(context) == pytest.approx(motion.multipliers(x, v, force_of(x)), abs=1e-11)
    assert integrator.degrees_of_freedom(context) == 6


# -- a citizen of OpenMM ----------------------------------------------------------------------------


def test_parts_in_a_projected_integrator():
    """Surfaces are parts like others."""
    for kind in ("rotated ellipsoid", "cylinder", "torus", "formula"):
        atoms = np.arange(3)
        system = system_of()
        parts = surface_parts(KINDS[kind](atoms, POSITIONS), system=system, positions=POSITIONS)
        integrator = ProjectedIntegrator(0.01, "suzuki4", parts=parts, device=False)
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
        context.setPositions(POSITIONS)
        context.setVelocities(VELOCITIES)
        integrator.applyVelocityConstraints(context)
        integrator.step(50)
        other, other_context = on_surface(kind, "suzuki4", 0.01)
        other.step(50)
        assert np.abs(state_of(context)[0] - state_of(other_context)[0]).max() <= 1e-12


@pytest.mark.parametrize("kind", ["sphere", "torus", "formula"])
def test_copies_and_pickles(kind):
    integrator, context = on_surface(kind, "rattle", 0.01)
    others = [pickle.loads(pickle.dumps(integrator)), copy.deepcopy(integrator)]
    xml = openmm.XmlSerializer.serialize(integrator)
    others.append(SurfaceIntegrator.from_xml(xml, parts=integrator.parts))
    system = pickle.loads(pickle.dumps(context.getSystem()))
    integrator.step(20)
    for other in others:
        assert isinstance(other, SurfaceIntegrator)
        there = started(system, other, POSITIONS, VELOCITIES)
        other.step(20)
        assert np.array_equal(state_of(there)[0], state_of(context)[0])


def test_periodic_boxes_do_not_repeat_surfaces():
    system = system_of(potential="0", springs=0)
    system.setDefaultPeriodicBoxVectors([2, 0, 0], [0, 2, 0], [0, 0, 2])
    bonds = openmm.CustomBondForce("0")
    bonds.setUsesPeriodicBoundaryConditions(True)
    system.addForce(bonds)
    integrator = SurfaceIntegrator(
        0.1 * unit.picosecond, surfaces=Cylinder([0], [0, 0, 0], [0, 0, 1], 0.5), system=system, device=False
    )
    context = started(system, integrator, [[0.5, 0, 0], [1, 1, 1], [1, 0, 1]], [[0, 0, 1], [0, 0, 0], [0, 0, 0]])
    integrator.step(30)
    assert state_of(context)[0][0] == pytest.approx([0.5, 0, 3.0], abs=1e-12)
    context.setPositions([[2.5, 0, 0], [1, 1, 1], [1, 0, 1]])
    with pytest.raises(InputError, match="not repeated in periodic boxes"):
        integrator.check(context)


def test_multipliers_know_which_forces_act():
    """Forces of a group that was left out entered them."""
    system = openmm.System()
    system.addParticle(10.0)
    idle = openmm.CustomExternalForce("100*x")
    idle.addParticle(0, [])
    idle.setForceGroup(3)
    system.addForce(idle)
    integrator = SurfaceIntegrator(2e-3, surfaces=Sphere([0], [0, 0, 0], 2.0), system=system, device=False)
    integrator.setIntegrationForceGroups({0})
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions([[2, 0, 0]])
    context.setVelocities([[0, 3, 0]])
    assert integrator.multipliers(context) == pytest.approx([-45])
    np.testing.assert_allclose(integrator.constraint_forces(context), [[-45, 0, 0]], atol=1e-12)


@pytest.mark.parametrize("n_particles", [2, 5])
def test_another_number_of_particles_is_refused(n_particles):
    """OpenMM reads beyond what it was given, or passes over the rest."""
    integrator = SurfaceIntegrator(
        1e-3, surfaces=Sphere([0], [0, 0, 0], 1.0), system=system_of(np.ones(n_particles)), device=False
    )
    context = openmm.Context(system_of(), integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions([[1, 0, 0], [2, 0, 0], [0, 3, 0]])
    with pytest.raises(InputError, match="the System has 3") as caught:
        integrator.step(1)
    assert caught.value.item == "system"


def test_a_simulation_is_no_context():
    integrator = SurfaceIntegrator(1e-3, surfaces=Sphere([0], [0, 0, 0], 1.0), system=system_of([1.0]), device=False)
    for call in (integrator.applyConstraints, integrator.multipliers):
        with pytest.raises(InputError, match="give the Context"):
            call("a Simulation")


def test_a_checkpoint_of_other_surfaces_does_not_bring_them_along():
    """It holds which particles are on spheres, and where these are."""
    made = []
    for atom in (0, 1):
        system = system_of([1.0, 1.0], "0", 0)
        integrator = SurfaceIntegrator(
            0.01, "geodesic", surfaces=Sphere([atom], [0, 0, 0], 1.0), system=system, device=False
        )
        context = started(system, integrator, [[1.0, 0, 0], [0, 1.0, 0]], [[0, 0.5, 0], [0.5, 0, 0]])
        integrator.step(1)
        made.append((integrator, context))
    made[1][1].loadCheckpoint(made[0][1].createCheckpoint())
    made[1][1].setPositions([[1.0, 0, 0], [0, 1.0, 0]])
    made[1][1].setVelocities([[0, 0.5, 0], [0.5, 0, 0]])
    made[1][0].step(50)
    x = state_of(made[1][1])[0]
    assert np.linalg.norm(x, axis=1) == pytest.approx([np.sqrt(1 + 0.25**2), 1.0], abs=1e-12)
