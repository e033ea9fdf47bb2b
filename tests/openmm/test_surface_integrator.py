"""Particles on surfaces in OpenMM: on them to rounding, equal to independent solutions, what is taken and refused."""

from __future__ import annotations

import copy

import numpy as np
import openmm
import pytest
from ensemble_runs import run
from openmm import unit
from openmm_systems import DEVICE, PLATFORMS, field, on_gpus, particles, with_and_without_device
from surface_cases import (
    CENTER,
    KINDS,
    MASSES,
    POSITIONS,
    VELOCITIES,
    core_run,
    force_of,
    on_surface,
    started,
    state_of,
    system_of,
    worst,
)

from kcons.constraints import Distance, Plane, Sphere, Torus
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError, KconsError, NonFiniteError, SingularGeometryError, UnsupportedError
from kcons.motion import Motion
from kcons.openmm import SCHEMES, SurfaceIntegrator

# -- what is refused --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("surfaces", "error", "words"),
    [
        ([], InputError, "no surface"),
        (Sphere([7], [0, 0, 0], 1.0), InputError, "7"),
        (Sphere([0], [0, 0, 0]), InputError, "positions="),
        (Sphere([1], [0, 0, 0], 1.0), InputError, "constrains its particles: give positions="),
        (Torus([0], [0, 0, 0], [0, 0, 1], 1.0, 0.0), InputError, "radius"),
        (Distance([0, 1], 1.0), UnsupportedError, r"kcons\.openmm\.hold"),
    ],
)
def test_refused(surfaces, error, words):
    system = system_of()
    system.addConstraint(1, 2, 1.0)
    before = openmm.XmlSerializer.serialize(system)
    with pytest.raises(error, match=words):
        SurfaceIntegrator(0.001, surfaces=surfaces, system=system, device=False)
    assert openmm.XmlSerializer.serialize(system) == before
    with pytest.raises(InputError, match="give system="):
        SurfaceIntegrator(0.001, surfaces=Sphere([0], [0, 0, 0], 1.0), device=False)


@DEVICE.marks[0]
def test_the_device_refuses_particles_that_are_not_there():
    with pytest.raises(KconsError, match="9"):
        SurfaceIntegrator(0.001, surfaces=Sphere([9], [0, 0, 0]), positions=np.ones((3, 3)), device=True)


# -- motion -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("scheme", "steps"), [("rattle", 20), ("geodesic", 20), ("suzuki4", 8), ("blanes-moan6a", 4)])
def test_the_steps_are_those_of_the_core(kind, scheme, steps):
    """On the surface and along it."""
    integrator, context = on_surface(kind, scheme, 0.04, atoms=(0, 2))
    integrator.step(steps)
    x, v = state_of(context)
    x_core, v_core = core_run(kind, SCHEMES[scheme](), 0.04, steps, atoms=(0, 2))
    assert np.abs(x - x_core).max() <= 1e-12
    assert np.abs(v - v_core).max() <= 1e-12
    assert max(worst(integrator, context)) <= 1e-14


@pytest.mark.parametrize("platform", on_gpus("mixed"))
def test_on_a_gpu_without_the_plugin(platform):
    if platform.endswith("single"):
        with pytest.raises(UnsupportedError, match="single precision"):
            on_surface("torus", "rattle", 0.02, platform)
        return
    integrator, context = on_surface("torus", "rattle", 0.02, platform)
    integrator.step(20)
    off, across = worst(integrator, context)
    assert off <= 1e-9
    assert across <= 1e-6


@pytest.mark.parametrize("platform", PLATFORMS)
@pytest.mark.parametrize("dt", [0.1, 3.0, 50.0])
def test_great_circles_at_any_time_step(platform, dt):
    """Without forces: one particle turns in the xy plane, one rests, and one is on no surface."""
    system, x = particles([3.0] * 3), np.array([[2.0, 0, 0], [0, 2.0, 0], [5.0, 0, 0]])
    surface, v = Sphere([0, 1], [0, 0, 0], 2.0), [[0, 1.0, 0], [0, 0, 0], [0.1, 0.2, 0.3]]
    integrator = SurfaceIntegrator(dt * unit.picosecond, "geodesic", surfaces=surface, system=system, device=False)
    context = started(system, integrator, x, v, platform)
    integrator.step(40)
    angle, (there, u) = 40 * dt / 2, state_of(context)
    assert there[0] == pytest.approx(2 * np.array([np.cos(angle), np.sin(angle), 0]), abs=2e-16 * 40 * angle + 1e-14)
    assert np.linalg.norm(u[0]) == pytest.approx(1.0, abs=1e-13)
    assert there[1] == pytest.approx(x[1], abs=1e-15)
    assert there[2] == pytest.approx(x[2] + 40 * dt * np.array(v[2]), rel=1e-14)
    assert u[2] == pytest.approx(v[2], abs=1e-15)


def test_a_curve_and_a_surface_that_moves():
    """Two surfaces for a particle, also one that a constraint of the System ties; a radius that grows."""
    system = system_of(potential="0.1*x*z", springs=0)
    system.addConstraint(0, 1, 1.0)
    surfaces = [
        Sphere([0], [0, 0, 0], 1.0),
        Plane([0], [0, 0, 1], 0.0),
        Sphere([2], [0, 0, 0], lambda t: 1 + 0.1 * t),
    ]
    x = np.array([[1.0, 0, 0], [1.0, 0, 1.0], [0, 1.0, 0]])
    integrator = SurfaceIntegrator(0.01, surfaces=surfaces, system=system, positions=x, device=False)
    context = run(system, integrator, x, [[0, 0.5, 0], [0.2, 0.3, 0.1], [0.3, 0, 0]], 100)
    there, _ = state_of(context)
    assert np.linalg.norm(there[0]) == pytest.approx(1, abs=1e-14)
    assert there[0, 2] == pytest.approx(0, abs=1e-15)
    assert np.linalg.norm(there[0] - there[1]) == pytest.approx(1, abs=1e-14)
    assert np.linalg.norm(there[2]) == pytest.approx(1.1, abs=1e-13)
    assert integrator.multipliers(context).shape == (3,)
    assert integrator.constraint_forces(context)[1] == pytest.approx(np.zeros(3))


# -- outside of steps -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["sphere", "torus", "formula"])
def test_positions_and_velocities_are_checked_and_can_be_put_right(kind):
    integrator, context = on_surface(kind, "rattle", 0.01)
    context.setPositions(POSITIONS + np.array([[0, 0, 0], [0.05, 0.02, -0.03], [0, 0, 0]]))
    with pytest.raises(InputError, match=r"positions are off row .*\(1\)") as caught:
        integrator.check(context)
    assert caught.value.atoms == (1,)
    integrator.applyConstraints(context)
    context.setVelocities(VELOCITIES)
    with pytest.raises(InputError, match="velocities are off row"):
        integrator.check(context)
    integrator.applyVelocityConstraints(context)
    integrator.check(context)
    assert max(worst(integrator, context)) <= 1e-13


@pytest.mark.parametrize(("kind", "scheme"), [("torus", "rattle"), ("cylinder", "suzuki4"), ("sphere", "geodesic")])
def test_forces_that_are_not_finite(kind, scheme):
    # The root of a negative number once particle 1 has moved.
    system = system_of(potential="1e-30*sqrt(10+y-1e6*step(0.9-x)*step(y-0.72))", springs=0)
    surfaces = KINDS[kind](np.arange(3), POSITIONS)
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


def test_open_targets_are_those_of_the_start():
    held = [Sphere([0], CENTER), Plane([2], [0, 0, 1]), Torus([1], CENTER, [0, 0, 1], 2.0)]
    quantity = unit.Quantity(POSITIONS * 10, unit.angstrom)
    integrator = SurfaceIntegrator(0.001, surfaces=held, system=system_of(), positions=quantity, device=False)
    for item in integrator.surfaces:
        assert item.measure(POSITIONS[item.atoms], 0.0) == pytest.approx(item.target_at(0.0), abs=1e-15)


def test_multipliers_know_which_forces_act():
    """Forces of a group that was left out entered them."""
    system = particles([10.0], field("100*x", 1, group=3))
    integrator = SurfaceIntegrator(2e-3, surfaces=Sphere([0], [0, 0, 0], 2.0), system=system, device=False)
    integrator.setIntegrationForceGroups({0})
    context = started(system, integrator, [[2, 0, 0]], [[0, 3, 0]])
    assert integrator.multipliers(context) == pytest.approx([-45])
    np.testing.assert_allclose(integrator.constraint_forces(context), [[-45, 0, 0]], atol=1e-12)


# -- by the plugin ----------------------------------------------------------------------------------

needs_device = DEVICE.marks[0]


def all_kinds(device, scheme="rattle", platform="Reference", **options):
    """A particle on each kind of surface, with springs between them."""
    rng = np.random.default_rng(5)
    x = np.array([1.2, 0.3, 0.8]) + 0.3 * rng.normal(size=(len(KINDS), 3))
    system = system_of(np.linspace(1.0, 20.0, len(KINDS)))
    surfaces = [make(np.array([k]), x[k : k + 1]) for k, make in enumerate(KINDS.values())]
    integrator = SurfaceIntegrator(
        0.01, scheme, surfaces=surfaces, system=system, positions=x, device=device, **options
    )
    return integrator, started(system, integrator, x, rng.normal(size=x.shape), platform)


@needs_device
@pytest.mark.parametrize("scheme", ["rattle", "suzuki4"])
def test_the_device_holds_the_same_surfaces(scheme):
    (here, context), (there, other) = (all_kinds(device, scheme) for device in (False, True))
    for integrator in (here, there):
        integrator.step(50)
    for found, wanted in zip(state_of(other), state_of(context), strict=True):
        assert np.abs(found - wanted).max() <= 1e-11
    off, across = worst(there, other)
    assert off <= 2e-15
    assert across <= 1e-15
    assert other.getSystem().getNumForces() == context.getSystem().getNumForces() - 3
    np.testing.assert_allclose(there.constraint_forces(other), here.constraint_forces(context), atol=1e-9)
    again = copy.copy(there)
    assert isinstance(again, SurfaceIntegrator)
    assert len(again.surfaces) == len(KINDS)


@needs_device
@pytest.mark.parametrize("platform", on_gpus("mixed", "single"))
def test_the_device_holds_surfaces_to_rounding_in_every_precision(platform):
    """Also where forces are single numbers, with the tolerance that the platform has."""
    integrator, context = all_kinds(True, platform=platform)
    integrator.step(50)
    off, across = worst(integrator, context)
    single = "single" in platform
    assert off <= (4e-7 if single else 2e-13)
    assert across <= (1e-6 if single else 1e-15)


@pytest.mark.parametrize("place", [0.0, 1e3])
@with_and_without_device
def test_a_particle_at_the_center_is_refused_and_one_far_from_the_origin_is_held(place, device):
    system, center = system_of([1.0], "0", 0), np.array([[place, -place, place]])
    integrator = SurfaceIntegrator(0.001, surfaces=Sphere([0], center, 0.5), system=system, device=device)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(center)
    with pytest.raises(SingularGeometryError, match="center of the sphere"):
        integrator.step(1)
    context.setPositions(center + np.array([0.5, 0, 0]))
    context.setVelocities([[0, 1, 0]])
    integrator.step(200)
    x, v = state_of(context)
    assert abs(np.linalg.norm(x - center) - 0.5) <= 1e-15 + 4 * np.spacing(place)
    assert abs(np.linalg.norm(v) - 1) <= 1e-12 + 200 * np.spacing(place)
