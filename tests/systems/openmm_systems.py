"""Systems and platforms that the tests of the OpenMM side share."""

from __future__ import annotations

import copy
from functools import cache
from pathlib import Path

import numpy as np
import openmm
import pytest
from openmm import app, unit
from openmm_parts import HeldCoordinates

from kcons.openmm.device import build

DATA = Path(__file__).resolve().parents[1] / "data"
#: What every test that is parametrised by platform runs on: they carry exact doubles and are on every machine.
#: Platforms of a GPU, or OpenCL on the CPU, may be there as well; no test depends on whether they are.
PLATFORMS = ("Reference", "CPU")
LONG = pytest.mark.validation
#: By the plugin, where there can be one: 'device' in the name of a test lets it have one, see tests/conftest.py.
DEVICE = pytest.param(True, id="device", marks=pytest.mark.skipif(bool(build.refusal()), reason=build.refusal()))
with_and_without_device = pytest.mark.parametrize("device", [False, DEVICE])
#: With several threads, forces are summed in any order, and no run is like another.
PROPERTIES = {"CPU": {"Threads": "1", "DeterministicForces": "true"}}


#: Platforms that compute as GPUs do, in each of their precisions: 'OpenCL mixed'. Debian's pocl-opencl-icd makes an
#: OpenCL platform of any processor.
_PRESENT = [openmm.Platform.getPlatform(k).getName() for k in range(openmm.Platform.getNumPlatforms())]
GPUS = [
    pytest.param(f"{name} {precision}", id=f"{name}-{precision}")
    for name in _PRESENT
    if name in ("CUDA", "HIP", "OpenCL")
    for precision in ("single", "mixed", "double")
] or [pytest.param("", id="none", marks=pytest.mark.skip(reason="no CUDA, HIP or OpenCL platform (pocl-opencl-icd)"))]


def on_gpus(*usual: str) -> list:
    """Platforms of a GPU: those of a usual run have one of these precisions, the others are for long runs.

    Each Context compiles its program, which takes seconds.
    """
    return [
        p if p.id.endswith((*usual, "none")) else pytest.param(*p.values, id=p.id, marks=[*p.marks, LONG]) for p in GPUS
    ]


def context_of(system, integrator, platform="Reference"):
    name, _, precision = platform.partition(" ")
    place = openmm.Platform.getPlatformByName(name)
    properties = {"Precision": precision} if precision else PROPERTIES.get(name, {})
    return openmm.Context(system, integrator, place, properties)


def started(system, integrator, x, v=None, platform="Reference"):
    """A Context at these positions and velocities."""
    context = context_of(system, integrator, platform)
    context.setPositions(x)
    if v is not None:
        context.setVelocities(v)
    return context


def image(k, signs=(-1, -1, -1)):
    """The place of particle k turned through the origin, about an axis, or at a plane."""
    return openmm.SymmetrySite(k, *map(openmm.Vec3, *np.diag(np.float64(signs))), openmm.Vec3(0, 0, 0), False)


def particles(masses, *forces, held=(), x=None):
    """A System of particles under forces; `held` are pairs at their distances at x, or (i, j, length)."""
    system = openmm.System()
    for mass in masses:
        system.addParticle(mass)
    for force in forces:
        system.addForce(force)
    for i, j, *length in held:
        system.addConstraint(i, j, length[0] if length else float(np.linalg.norm(np.subtract(x[i], x[j]))))
    return system


def field(expression, n, group=0, **parameters):
    """A force on each of n particles, or on some, with global parameters."""
    force = openmm.CustomExternalForce(expression)
    for name, value in parameters.items():
        force.addGlobalParameter(name, value)
    for k in range(n) if isinstance(n, int) else n:
        force.addParticle(k, [])
    force.setForceGroup(group)
    return force


def pairs_force(force, *terms):
    """A force of bonds, each of which has two particles and what else it needs."""
    for i, j, *parameters in terms:
        force.addBond(i, j, *parameters)
    return force


def state_of(context):
    state = context.getState(positions=True, velocities=True)
    return np.asarray(state.getPositions(asNumpy=True)._value), np.asarray(state.getVelocities(asNumpy=True)._value)


def total_energy(context):
    state = context.getState(energy=True)
    return (state.getKineticEnergy() + state.getPotentialEnergy()).value_in_unit(unit.kilojoule_per_mole)


def potential_energy(context):
    return context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)


def forces_at(context):
    state = context.getState(forces=True)
    return np.asarray(state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer))


def rows_of(system):
    table = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    pairs = np.array([(i, j) for i, j, _ in table])
    return pairs, np.array([d.value_in_unit(unit.nanometer) for *_, d in table])


def masses_of(system):
    return np.array([system.getParticleMass(k).value_in_unit(unit.dalton) for k in range(system.getNumParticles())])


def residuals(system, context):
    """Largest relative error of a distance, and of a velocity along it (per root mean square velocity)."""
    pairs, lengths = rows_of(system)
    x, v = state_of(context)
    r, u = (a[pairs[:, 0]] - a[pairs[:, 1]] for a in (x, v))
    d = np.linalg.norm(r, axis=1)
    along = np.einsum("ij,ij->i", r, u) / d
    return np.abs(d / lengths - 1).max(), np.abs(along).max() / np.sqrt(np.mean(v**2))


def dumbbell(length=0.1, masses=(12.0, 1.0), stiffness=50.0):
    """One bond in an anharmonic field that turns it."""
    turning = field("k*(x^2+1.3*y^2+0.7*z^2)+c*x*y^3", 2, k=stiffness, c=10 * stiffness)
    system = particles(masses, turning, held=[(0, 1, length)])
    x = np.array([[0.3, 0.1, 0.2], [0.3 + length, 0.1, 0.2]])
    v = np.array([[0.1, 0.4, -0.3], [0.1, -0.9, 0.8]])
    return system, x, v


def hexagon(rows):
    """Planar six-ring held by some of its 15 distances."""
    angles = np.arange(6) * np.pi / 3
    x = 0.14 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    pairs = sorted(
        ((i, j) for i in range(6) for j in range(i)), key=lambda ij: np.linalg.norm(x[ij[0]] - x[ij[1]]).round(6)
    )
    return particles([12.0] * 6, held=pairs[:rows], x=x), x


def water_box(n=27, spacing=0.31, exact=False):
    """Flexible-free TIP3P on a lattice in a periodic box, with reaction field; exact: lengths that a float holds."""
    system = openmm.System()
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    edge = round(n ** (1 / 3))
    side = edge * spacing
    force.setCutoffDistance(0.45 * side)
    oh, hh = 0.09572, 0.15139
    if exact:
        oh, hh = float(np.float32(oh)), float(np.float32(hh))
    rng = np.random.default_rng(1)
    x = []
    for place in np.ndindex(edge, edge, edge):
        first = system.getNumParticles()
        for m, charge, sigma, epsilon in ((15.999, -0.834, 0.31507, 0.6359), *[(1.008, 0.417, 0.1, 0.0)] * 2):
            system.addParticle(m)
            force.addParticle(charge, sigma, epsilon)
        for i, j, d in ((0, 1, oh), (0, 2, oh), (1, 2, hh)):
            system.addConstraint(first + i, first + j, d)
            force.addException(first + i, first + j, 0, 1, 0)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        height = np.sqrt(oh**2 - hh**2 / 4)
        shape = np.array([[0, 0, 0], [height, hh / 2, 0], [height, -hh / 2, 0]])
        x.extend(shape @ turn.T + spacing * np.array(place))
    system.addForce(force)
    system.setDefaultPeriodicBoxVectors(*(side * np.eye(3)))
    return system, np.array(x)


def alanine(held="AllBonds"):
    """Alanine dipeptide in vacuum, equilibrated at 300 K with all bonds held: system, x, v, the test's own copies."""
    system, x, v = _equilibrated_alanine(held)
    return copy.deepcopy(system), x.copy(), v.copy()


@cache
def _equilibrated_alanine(held):
    from kcons.openmm import ProjectedIntegrator

    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    constraints = None if held is None else getattr(app, held)
    system = app.ForceField("amber14-all.xml").createSystem(pdb.topology, constraints=constraints)
    integrator = ProjectedIntegrator(0.001, tolerance=1e-13)
    context = started(system, integrator, pdb.positions)
    integrator.minimizeEnergy(context, maxIterations=50)
    integrator.setVelocitiesToTemperature(context, 300, 1)
    integrator.step(200)
    return system, *state_of(context)


def loose_alanine():
    """The same with a flexible bond to its first atom, a hydrogen, and nothing that removes momentum."""
    system, x, v = alanine()
    # What is held in space does not go together with a CMMotionRemover.
    kinds = [type(force) for force in system.getForces()]
    system.removeForce(kinds.index(openmm.CMMotionRemover))
    for k in reversed(range(system.getNumConstraints())):
        i, j, d = system.getConstraintParameters(k)
        if 0 in (i, j):
            system.removeConstraint(k)
            bond = openmm.HarmonicBondForce()
            bond.addBond(i, j, d, 2e5)
            system.addForce(bond)
    return system, x, v


def free_alanine(nonbonded=True):
    """The same with nothing held, perhaps without long-range forces."""
    system, x, v = loose_alanine()
    for k in reversed(range(system.getNumConstraints())):
        system.removeConstraint(k)
    for k in reversed(range(system.getNumForces())):
        if not nonbonded and isinstance(system.getForce(k), openmm.NonbondedForce):
            system.removeForce(k)
    return system, x, v


#: Every kind, for a temperature (K).
BAROSTATS = {
    "isotropic": lambda kelvin: openmm.MonteCarloBarostat(1.0, kelvin, 5),
    "anisotropic": lambda kelvin: openmm.MonteCarloAnisotropicBarostat(openmm.Vec3(1, 1, 1), kelvin),
    "membrane": lambda kelvin: openmm.MonteCarloMembraneBarostat(1.0, 0.0, kelvin, 0, 0),
    "flexible": lambda kelvin: openmm.MonteCarloFlexibleBarostat(1.0, kelvin, 25, True),
}


def holding(**arguments):
    """A part that holds z of the atom that no constraint of `loose_alanine` touches."""
    return HeldCoordinates([0], 2, float(alanine()[1][0, 2]), 22, **arguments)


def volumes_under_pressure(system, integrator, context):
    """Volumes (nm^3) met in 80 steps under the barostat of the System, always on its constraints."""
    integrator.minimizeEnergy(context, maxIterations=20)
    integrator.setVelocitiesToTemperature(context, 300, 1)
    volumes = set()
    for _ in range(20):
        integrator.step(4)
        volumes.add(context.getState().getPeriodicBoxVolume() / unit.nanometer**3)
        assert residuals(system, context)[0] < 1e-7
    return volumes
