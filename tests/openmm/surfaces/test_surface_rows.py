"""Particles on surfaces: what is checked and put right, and Systems that surfaces do not go with."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from surface_cases import (
    KINDS,
    POSITIONS,
    VELOCITIES,
    on_surface,
    system_of,
    worst,
)

from kcons.constraints import Sphere
from kcons.errors import InputError, UnsupportedError
from kcons.openmm.surfaces.surface_integrator import SurfaceIntegrator


def bonded(system):
    system.addConstraint(1, 0, 1.0)


def barostat(system):
    forces = openmm.NonbondedForce()
    for _ in range(3):
        forces.addParticle(0, 0.1, 0)
    forces.setNonbondedMethod(forces.CutoffPeriodic)
    forces.setCutoffDistance(0.9)
    system.addForce(forces)
    system.addForce(openmm.MonteCarloBarostat(1.0, 300.0))


def centre_remover(system):
    system.addForce(openmm.CMMotionRemover())


def massless(system):
    system.setParticleMass(0, 0.0)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (bonded, r"particle 0 is on a surface and in the System's constraint \(1, 0\)"),
        (barostat, "MonteCarloBarostat"),
        (centre_remover, "CMMotionRemover"),
        (massless, "particle 0 has no mass"),
    ],
)
def test_systems_that_surfaces_do_not_go_with(spoil, words):
    surface = Sphere([0], [0, 0, 0], np.linalg.norm(POSITIONS[0]))
    system = system_of()
    spoil(system)
    with pytest.raises(UnsupportedError, match=words):
        SurfaceIntegrator(0.001, surfaces=surface, system=system)
    # Also where the System was not given.
    integrator = SurfaceIntegrator(0.001, surfaces=surface, n_particles=3)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(POSITIONS)
    with pytest.raises(UnsupportedError, match=words):
        integrator.surfaces[0].check(context)


@pytest.mark.parametrize("kind", KINDS)
def test_positions_and_velocities_are_checked_and_can_be_put_right(kind):
    integrator, context = on_surface(kind, "rattle", 0.01)
    integrator.check(context)
    context.setPositions(POSITIONS + np.array([[0, 0, 0], [0.05, 0.02, -0.03], [0, 0, 0]]))
    with pytest.raises(InputError, match=r"particle 1 is .* nm from its surface") as caught:
        integrator.check(context)
    assert caught.value.atoms == (1,)
    integrator.apply_positions(context)
    context.setVelocities(VELOCITIES)
    assert worst(integrator, context)[0] <= 1e-13
    with pytest.raises(InputError, match="across its surface"):
        integrator.check(context)
    integrator.apply_velocities(context)
    integrator.check(context)
    assert worst(integrator, context)[1] <= 1e-14
    integrator.step(3)
