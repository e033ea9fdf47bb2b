"""Particles on surfaces by kernels: the same motion as without the plugin, on the surface to rounding."""

from __future__ import annotations

import copy

import numpy as np
import openmm
import pytest
from openmm_systems import on_gpus
from surface_cases import KINDS, started, state_of, system_of, worst

from kcons.constraints import Sphere
from kcons.errors import KconsError, SingularGeometryError
from kcons.openmm import SurfaceIntegrator


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


@pytest.mark.parametrize("platform", on_gpus("mixed", "single"))
def test_the_device_holds_surfaces_to_rounding_in_every_precision(platform):
    """Also where forces are single numbers, with the tolerance that the platform has."""
    integrator, context = all_kinds(True, platform=platform)
    integrator.step(50)
    off, across = worst(integrator, context)
    single = "single" in platform
    assert off <= (4e-7 if single else 2e-13)
    assert across <= (1e-6 if single else 1e-15)


def test_the_device_refuses_particles_that_are_not_there():
    with pytest.raises(KconsError, match="9"):
        SurfaceIntegrator(0.001, surfaces=Sphere([9], [0, 0, 0]), positions=np.ones((3, 3)), device=True)


@pytest.mark.parametrize("place", [0.0, 1e3])
@pytest.mark.parametrize("device", [False, True])
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
