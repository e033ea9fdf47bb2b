"""Motion on surfaces: on them to rounding, reversible, of the order of the scheme, equal to independent solutions."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm import unit
from openmm_systems import PLATFORMS
from reference import cases
from surface_cases import (
    KINDS,
    core_run,
    energy_of,
    on_surface,
    started,
    state_of,
    system_of,
    worst,
)

from kcons.constraints import Ellipsoid, Formula, Plane, Sphere, Torus
from kcons.errors import SingularGeometryError
from kcons.openmm.integrator.schemes import SCHEMES
from kcons.openmm.surfaces.surface_integrator import SurfaceIntegrator


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("scheme", "platform"),
    [("rattle", "CPU"), *((scheme, "Reference") for scheme in ("rattle", "geodesic", "blanes-moan6a"))],
)
def test_on_the_surface_and_along_it(kind, scheme, platform):
    integrator, context = on_surface(kind, scheme, 0.02, platform)
    for _ in range(3):
        integrator.step(20)
        off, across = worst(integrator, context)
        assert off <= 1e-14
        assert across <= 1e-14


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("scheme", "steps"), [("rattle", 20), ("geodesic", 20), ("suzuki4", 8), ("kahan-li6", 4), ("blanes-moan6a", 4)]
)
def test_the_steps_are_those_of_the_core(kind, scheme, steps):
    integrator, context = on_surface(kind, scheme, 0.04, atoms=(0, 2))
    integrator.step(steps)
    x, v = state_of(context)
    x_core, v_core = core_run(kind, SCHEMES[scheme](), 0.04, steps, atoms=(0, 2))
    assert np.abs(x - x_core).max() <= 1e-12
    assert np.abs(v - v_core).max() <= 1e-12


# -- reference solutions ----------------------------------------------------------------------------


def reference_context(name, scheme, dt):
    case = cases.load(name)
    system = openmm.System()
    field = openmm.CustomExternalForce("fx*x+fy*y+fz*z")
    for axis in "xyz":
        field.addPerParticleParameter(f"f{axis}")
    for k, mass in enumerate(case.masses):
        system.addParticle(mass)
        field.addParticle(k, (-case.force(case.initial.positions, case.initial.velocities)[k]).tolist())
    system.addForce(field)
    integrator = SurfaceIntegrator(dt, scheme, surfaces=case.constraints, system=system, device=False)
    start = case.initial
    return case, integrator, started(system, integrator, start.positions, start.velocities)


@pytest.mark.parametrize(
    ("name", "dt", "allowed"),
    [
        ("A01_sphere_free", 1 / 64, 2e-13),
        ("A02_spherical_pendulum_generic", 1 / 256, 1e-11),
        ("A02_spherical_pendulum_near_conical", 1 / 256, 1e-11),
        ("A02_spherical_pendulum_near_top_Lz", 1 / 256, 1e-10),
        ("A03_planar_pendulum_150deg", 1 / 256, 1e-10),
        ("A08_torus_geodesic", 1 / 128, 1e-10),
        ("A08_torus_inner_equator", 1 / 128, 1e-10),
    ],
)
def test_reference_solution(name, dt, allowed):
    scheme = "geodesic" if "free" in name else "blanes-moan6"
    case, integrator, context = reference_context(name, scheme, dt)
    for there in [s for s in case.solution if (s.time / dt).is_integer()][:2]:
        integrator.step(round(there.time / dt) - context.getStepCount())
        x, v = state_of(context)
        assert np.abs(x - there.positions).max() <= max(allowed, there.tolerance)
        assert np.abs(v - there.velocities).max() <= 10 * max(allowed, there.tolerance)
    assert context.getStepCount() > 0


@pytest.mark.parametrize("name", ["A02_spherical_pendulum_generic", "A08_torus_geodesic"])
def test_constraint_force_of_the_reference(name):
    case, integrator, context = reference_context(name, "rattle", 0.01)
    for there in case.solution:
        context.setPositions(there.positions)
        context.setVelocities(there.velocities)
        assert integrator.constraint_forces(context) == pytest.approx(there.constraint_forces, abs=1e-11)


# -- closed forms -----------------------------------------------------------------------------------


def free_on_sphere(scheme, dt, radius=2.0, center=(0.0, 0.0, 0.0), speed=1.0, platform="Reference", **arguments):
    """One particle without forces; turns by speed/radius in the xy plane."""
    system = openmm.System()
    system.addParticle(3.0)
    surface, step = Sphere([0], center, radius), dt * unit.picosecond
    integrator = SurfaceIntegrator(step, scheme, surfaces=surface, system=system, device=False, **arguments)
    start = np.array([[radius, 0.0, 0.0]]) + center
    return integrator, started(system, integrator, start, [[0.0, speed, 0.0]], platform)


@pytest.mark.parametrize("platform", PLATFORMS)
def test_rattle_turns_by_asin(platform):
    for speed in (0.1, 1.0, 1.9, 1.999):
        integrator, context = free_on_sphere("rattle", 1.0, speed=speed, platform=platform)
        integrator.step(50)
        angle = 50 * np.arcsin(speed / 2)
        x, v = state_of(context)
        assert x == pytest.approx(2 * np.array([[np.cos(angle), np.sin(angle), 0]]), abs=1e-11)
        assert v == pytest.approx(speed * np.array([[-np.sin(angle), np.cos(angle), 0]]), abs=1e-11)


@pytest.mark.parametrize("platform", PLATFORMS)
def test_geodesic_flies_great_circles_at_any_time_step(platform):
    for dt in (0.1, 3.0, 50.0):
        integrator, context = free_on_sphere("geodesic", dt, platform=platform)
        integrator.step(40)
        angle = 40 * dt / 2
        x, v = state_of(context)
        assert x == pytest.approx(2 * np.array([[np.cos(angle), np.sin(angle), 0]]), abs=2e-16 * 40 * angle + 1e-14)
        assert np.linalg.norm(v) == pytest.approx(1.0, abs=1e-13)


def test_great_circles_leave_resting_and_free_particles_alone():
    system = system_of(potential="0", springs=0)
    integrator = SurfaceIntegrator(
        0.1 * unit.picosecond, "geodesic", surfaces=Sphere([0, 1], [0, 0, 0], 1.0), system=system, device=False
    )
    x = np.array([[1.0, 0, 0], [0, 1.0, 0], [5.0, 0, 0]])
    context = started(system, integrator, x, [[0, 0, 0], [0, 0, 0.5], [0.1, 0.2, 0.3]])
    integrator.step(10)
    there, v = state_of(context)
    assert there[0] == pytest.approx([1, 0, 0], abs=1e-15)
    assert there[1] == pytest.approx([0, np.cos(0.5), np.sin(0.5)], abs=1e-14)
    assert there[2] == pytest.approx([5.1, 0.2, 0.3], abs=1e-14)
    assert v[2] == pytest.approx([0.1, 0.2, 0.3], abs=1e-15)


@pytest.mark.parametrize("radius", [1e-4, 1e4])
@pytest.mark.parametrize("scheme", ["rattle", "geodesic", "suzuki4"])
def test_small_and_large_radii(radius, scheme):
    integrator, context = free_on_sphere(scheme, 0.01, radius=radius, speed=radius)
    integrator.step(100)
    off, across = worst(integrator, context)
    assert off <= 1e-14 * radius
    assert across <= 1e-14
    angle = 100 * (np.arcsin(0.01) if scheme == "rattle" else 0.01)
    x, _ = state_of(context)
    assert np.arctan2(x[0, 1], x[0, 0]) == pytest.approx(angle, abs=1e-13 if scheme != "suzuki4" else 1e-8)


@pytest.mark.parametrize("scheme", ["rattle", "geodesic"])
@pytest.mark.parametrize("far", [1e3, 1e6])
def test_far_from_the_origin(far, scheme):
    integrator, context = free_on_sphere(scheme, 0.05, center=(far, -far, far))
    integrator.step(200)
    x, v = state_of(context)
    # As near as numbers of this size come; the velocity does not suffer.
    assert abs(np.linalg.norm(x - [far, -far, far]) - 2) <= 4 * np.spacing(far)
    assert abs(np.linalg.norm(v) - 1) <= 1e-12 + 200 * np.spacing(far)


# -- energies ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["sphere", "torus"])
def test_energy_has_no_slope(kind):
    integrator, context = on_surface(kind, "rattle", 0.01)
    energies = []
    for _ in range(400):
        integrator.step(20)
        energies.append(energy_of(context, integrator))
    times = 0.2 * np.arange(len(energies))
    slope = np.polyfit(times, energies, 1)[0]
    spread = np.std(energies)
    assert spread <= 1e-3
    # Consistent with none: the error of a slope fitted to numbers that scatter like this.
    assert abs(slope) <= 5 * spread / np.std(times) / np.sqrt(40)


# -- company ----------------------------------------------------------------------------------------


def test_surfaces_free_particles_and_bonds_do_not_disturb_each_other():
    """All in one System, and each kind alone: the same motion."""
    dt, steps = 0.01, 100
    x = np.array([[1.2, 0, 0], [0, 2.5, 0], [1, 1, 1], [0.5, 0, 0], [3, 3, 3], [5, 0, 0], [5, 1, 0], [0, 0, 0.5]])
    v = np.array([[0, 1, 0.5], [1, 0, 1], [1, -1, 0], [0, 0.3, 1], [1, 2, 3], [0, 0, 1], [0, 0, -1], [0.3, 0.7, 0]])
    surfaces = {
        0: Sphere([0], [0, 0, 0], 1.2),
        1: Torus([1], [0, 0, 0], [0, 0, 1], 2.0, 0.5),
        2: Plane([2], [0, 0, 1], 1.0),
        3: Formula("4*x1**2+y1**2+z1**2-1", [3]),
        7: Ellipsoid([7], [0, 0, 0], [0.3, 0.4, 0.5]),
    }
    masses = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]

    def run(held, scheme):
        system = system_of(masses, potential="0.5*(x^2+y*z)", springs=0)
        system.addConstraint(5, 6, 1.0)
        integrator = SurfaceIntegrator(dt, scheme, surfaces=[surfaces[k] for k in held], system=system, device=False)
        context = started(system, integrator, x, v)
        integrator.step(steps)
        assert max(worst(integrator, context)) <= 1e-13
        there, velocity = state_of(context)
        assert abs(np.linalg.norm(there[5] - there[6]) - 1) <= 1e-10
        assert abs((there[5] - there[6]) @ (velocity[5] - velocity[6])) <= 1e-9
        return there

    for scheme in ("rattle", "suzuki4"):
        together = run(surfaces, scheme)
        for k in surfaces:
            alone = run([k], scheme)
            assert np.abs(together[[k, 4]] - alone[[k, 4]]).max() <= 1e-13
            assert np.abs(together[5:7] - alone[5:7]).max() <= 1e-9


def test_a_particle_at_the_center_is_refused():
    system = system_of([1.0], "0", 0)
    integrator = SurfaceIntegrator(0.001, surfaces=Sphere([0], [1, 1, 1], 0.5), system=system, device=False)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions([[1, 1, 1]])
    with pytest.raises(SingularGeometryError, match="center of the sphere"):
        integrator.step(1)
