"""The assertions of OpenMM's own tests of integrators, on ours: first at their bounds, then at tighter ones.

Sources: tests/TestVerletIntegrator.h, TestCustomIntegrator.h and TestSettle.h of OpenMM.
"""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm_systems import context_of, state_of, total_energy

from kcons.openmm import ProjectedIntegrator
from kcons.openmm.integrator.schemes import SCHEMES

ALL = [*SCHEMES, "leapfrog"]
#: Orders beyond 2 cost several force evaluations: fewer steps show as much.
STEPS = {"rattle": 400, "leapfrog": 400, "geodesic": 100}

schemes = pytest.mark.parametrize("scheme", ALL)
#: Programs are run by the code of Reference on both; what differs on the CPU are the forces.
on_platforms = pytest.mark.parametrize(
    ("scheme", "platform"),
    [*((scheme, "Reference") for scheme in ALL), *((scheme, "CPU") for scheme in ("rattle", "geodesic", "leapfrog"))],
)


def charged(masses):
    system, force = openmm.System(), openmm.NonbondedForce()
    for i, m in enumerate(masses):
        system.addParticle(m)
        force.addParticle(0.2 if i % 2 == 0 else -0.2, 0.5, 5.0)
    system.addForce(force)
    return system


def staircase(n):
    return np.array([[i // 2, (i + 1) // 2, 0.0] for i in range(n)])


def watch(system, scheme, platform, x, v=None, dt=0.001, tolerance=1e-5, temperature=None, tangent=False):
    """Largest relative error of distances, of velocities along them, and of the energy, step by step."""
    steps = STEPS.get(scheme, 40)
    integrator = ProjectedIntegrator(dt, scheme, tolerance=tolerance)
    context = context_of(system, integrator, platform)
    context.setPositions(x)
    if v is None:
        integrator.setVelocitiesToTemperature(context, temperature, 7)
    else:
        context.setVelocities(v)
    table = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    pairs, lengths = np.array([row[:2] for row in table]), np.array([row[2]._value for row in table])
    first, worst = None, np.zeros(3)
    for step in range(steps):
        state = context.getState(positions=True, velocities=True, energy=True)
        r, u = (
            a[pairs[:, 0]] - a[pairs[:, 1]]
            for a in (state.getPositions(asNumpy=True)._value, state.getVelocities(asNumpy=True)._value)
        )
        distance = np.abs(np.linalg.norm(r, axis=1) / lengths - 1).max() if step else 0.0
        along = np.abs(np.einsum("ij,ij->i", r, u)).max() if tangent and step > 1 else 0.0
        energy = state.getKineticEnergy()._value + state.getPotentialEnergy()._value
        first = energy if step == 1 else first
        drift = abs(energy - first) / abs(first) if step > 1 else 0.0
        worst = np.maximum(worst, [distance, along, drift])
        integrator.step(1)
    return worst


@on_platforms
def test_single_bond(scheme, platform):
    """A harmonic oscillator; positions and velocities against the closed form, and the energy."""
    system, bond = openmm.System(), openmm.HarmonicBondForce()
    system.addParticle(2.0)
    system.addParticle(2.0)
    bond.addBond(0, 1, 1.5, 1.0)
    system.addForce(bond)
    dt = 0.01
    integrator = ProjectedIntegrator(dt, scheme)
    context = context_of(system, integrator, platform)
    context.setPositions([[-1, 0, 0], [1, 0, 0]])
    late = 0.5 * dt if scheme == "leapfrog" else 0.0
    speed = -0.25 * np.sin(late)
    context.setVelocities([[speed, 0, 0], [-speed, 0, 0]])
    first = total_energy(context)
    for step in range(STEPS.get(scheme, 40)):
        time = dt * step
        x, v = state_of(context)
        distance, rate = 1.5 + 0.5 * np.cos(time), -0.5 * np.sin(time - late)
        np.testing.assert_allclose(x, [[-distance / 2, 0, 0], [distance / 2, 0, 0]], atol=1e-4)
        np.testing.assert_allclose(v, [[-rate / 2, 0, 0], [rate / 2, 0, 0]], atol=1e-4)
        assert total_energy(context) == pytest.approx(first, rel=1e-4)
        assert total_energy(context) == pytest.approx(0.125, rel=1e-4)
        integrator.step(1)
    assert context.getState().getTime()._value == pytest.approx(dt * STEPS.get(scheme, 40), rel=1e-12)


@on_platforms
@pytest.mark.parametrize("bonds", [[(0, 1), (1, 2), (2, 3), (4, 5), (6, 7)], [(i, i + 1) for i in range(7)]])
def test_constraints(scheme, platform, bonds):
    system = charged([5.0, 10.0] * 4)
    for i, j in bonds:
        system.addConstraint(i, j, 1.0)
    v = np.random.default_rng(0).random((8, 3)) - 0.5
    distance, _, energy = watch(system, scheme, platform, staircase(8), v, dt=0.002)
    assert distance < 2e-5
    assert energy < 0.01
    distance, _, _ = watch(system, scheme, platform, staircase(8), v, dt=0.002, tolerance=1e-13)
    assert distance < 1e-12


@on_platforms
def test_velocity_constraints(scheme, platform):
    """Three particles for SHAKE, three for SETTLE, the rest for CCMA; no distance that a float rounds."""
    system = charged([5.0, 10.0] * 5)
    rows = [
        (0, 1, 1.0),
        (1, 2, 1.0),
        (3, 4, 1.0),
        (5, 4, 1.0),
        (3, 5, np.sqrt(2.0)),
        (6, 7, 1.0),
        (7, 8, 1.0),
        (8, 9, 1.0),
    ]
    for i, j, d in rows:
        system.addConstraint(i, j, d)
    v = np.random.default_rng(0).random((10, 3)) - 0.5
    tangent = scheme != "leapfrog"
    distance, along, energy = watch(system, scheme, platform, staircase(10), v, dt=0.002, tangent=tangent)
    assert distance < 2e-5
    assert along < 2e-5
    assert energy < 0.01
    system.setConstraintParameters(4, 3, 5, float(np.float32(np.sqrt(2.0))))
    distance, along, _ = watch(system, scheme, platform, staircase(10), v, dt=0.002, tangent=tangent, tolerance=1e-13)
    assert distance < 1e-12
    assert along < 1e-12


@on_platforms
def test_constrained_clusters(scheme, platform):
    system = charged([10.0, 10.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    for i, j in ((0, 1), (0, 2), (0, 3), (0, 4), (1, 5), (1, 6)):
        system.addConstraint(i, j, 1.0)
    for i, j in ((2, 3), (2, 4), (3, 4), (5, 6)):
        system.addConstraint(i, j, np.sqrt(2.0))
    x = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0], [1, 1, 0]], dtype=float)
    v = np.random.default_rng(0).random((7, 3)) - 0.5
    distance, _, energy = watch(system, scheme, platform, x, v)
    assert distance < 2e-5
    assert energy < 0.01
    distance, _, _ = watch(system, scheme, platform, x, v, tolerance=1e-13)
    assert distance < 1e-12


@on_platforms
@pytest.mark.parametrize("n", [2, 10, 35])
def test_constrained_chain(scheme, platform, n):
    """Freely jointed, force-free."""
    system = openmm.System()
    rng = np.random.default_rng(0)
    steps = rng.random((n, 3)) - 0.5
    x = np.cumsum(steps / np.linalg.norm(steps, axis=1)[:, None], axis=0)
    for i in range(n):
        system.addParticle(1.0)
        if i:
            system.addConstraint(i - 1, i, 1.0)
    distance, _, energy = watch(system, scheme, platform, x, temperature=300)
    assert distance < 2e-5
    assert energy < 0.01
    distance, _, _ = watch(system, scheme, platform, x, temperature=300, tolerance=1e-13)
    assert distance < 1e-12


@on_platforms
def test_constrained_massless_particles(scheme, platform):
    system = openmm.System()
    system.addParticle(0.0)
    system.addParticle(1.0)
    system.addConstraint(0, 1, 1.5)
    with pytest.raises(openmm.OpenMMException, match="massless"):
        context_of(system, ProjectedIntegrator(0.01, scheme), platform)
    system.setParticleMass(1, 0.0)
    integrator = ProjectedIntegrator(0.01, scheme)
    context = context_of(system, integrator, platform)
    context.setPositions([[-1, 0, 0], [1, 0, 0]])
    context.setVelocitiesToTemperature(300.0)
    integrator.step(1)
    x, v = state_of(context)
    assert (v == 0).all()
    np.testing.assert_array_equal(x, [[-1, 0, 0], [1, 0, 0]])
    assert integrator.degrees_of_freedom() == 0


@on_platforms
def test_settle(scheme, platform):
    system = openmm.System()
    force = openmm.NonbondedForce()
    x = []
    for i in range(10):
        for m, charge, sigma, epsilon in ((16.0, -0.82, 0.317, 0.65), (1.0, 0.41, 1.0, 0.0), (1.0, 0.41, 1.0, 0.0)):
            system.addParticle(m)
            force.addParticle(charge, sigma, epsilon)
        for a, b, d in ((0, 1, 0.1), (0, 2, 0.1), (1, 2, 0.163)):
            system.addConstraint(3 * i + a, 3 * i + b, d)
            force.addException(3 * i + a, 3 * i + b, 0, 1, 0)
        o = np.array([0.4 * (i % 4), 0.4 * (i // 4), 0.0])
        height = 0.163**2 / 0.2
        ends = np.array([[0.1, 0, 0], [0.1 - height, np.sqrt(0.163**2 - height**2), 0]])
        x += [o, *(o + ends)]
    system.addForce(force)
    v = np.random.default_rng(0).random((30, 3)) - 0.5
    distance, along, energy = watch(system, scheme, platform, np.array(x), v, tangent=scheme != "leapfrog")
    assert distance < 1e-5
    assert energy < (0.01 if scheme != "leapfrog" else 0.02)
    # SETTLE stores its distances as floats, which is all that is left.
    assert distance < 6e-8
    assert along < 1e-12


@schemes
def test_force_groups(scheme):
    system = openmm.System()
    system.addParticle(1.0)
    for group, energy in ((1, "x"), (2, "y")):
        force = openmm.CustomExternalForce(energy)
        force.addParticle(0)
        force.setForceGroup(group)
        system.addForce(force)
    integrator = ProjectedIntegrator(0.01, scheme)
    integrator.setIntegrationForceGroups({1})
    context = context_of(system, integrator)
    context.setPositions([[0, 0, 0]])
    integrator.step(1)
    ((a, b, c),) = state_of(context)[0]
    assert a < 0
    assert b == c == 0


@schemes
def test_conservation_laws(scheme):
    """A free chain keeps momentum and angular momentum, to OpenMM's 1e-4 and far better."""
    system = openmm.System()
    rng = np.random.default_rng(3)
    n = 8
    bonds = openmm.HarmonicBondForce()
    masses = np.array([10.0, 12.0] * 4)
    x = np.cumsum(rng.normal(size=(n, 3)), axis=0) * 0.1
    for i, m in enumerate(masses):
        system.addParticle(m)
        if i:
            system.addConstraint(i - 1, i, float(np.linalg.norm(x[i] - x[i - 1])))
    bonds.addBond(0, n - 1, 0.2, 500.0)
    system.addForce(bonds)
    integrator = ProjectedIntegrator(0.001, scheme, tolerance=1e-13)
    context = context_of(system, integrator)
    context.setPositions(x)
    integrator.setVelocitiesToTemperature(context, 300, 2)

    def momenta():
        x, v = state_of(context)
        p = masses[:, None] * v
        return p.sum(axis=0), np.cross(x, p).sum(axis=0)

    linear, angular = momenta()
    integrator.step(STEPS.get(scheme, 50))
    after = momenta()
    # What is left is the rounding of (x - xu)/h, of every drift and of every substep.
    assert np.abs(after[0] - linear).max() < 1e-4
    assert np.abs(after[0] - linear).max() < 1e-7
    if scheme != "leapfrog":
        assert np.abs(after[1] - angular).max() < 1e-4
        assert np.abs(after[1] - angular).max() < 1e-7
