"""The assertions of OpenMM's own tests of integrators, on schemes and ensembles, at OpenMM's bounds.

`test_openmm_accuracy` has tighter ones. Sources: TestVerletIntegrator.h, TestCustomIntegrator.h,
TestLangevinMiddleIntegrator.h, TestNoseHooverIntegrator.h and TestSettle.h among the tests of OpenMM.
"""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm import unit
from openmm_ensembles import ENSEMBLES
from openmm_systems import (
    GPUS,
    PLATFORMS,
    context_of,
    field,
    masses_of,
    pairs_force,
    particles,
    rows_of,
    started,
    state_of,
    total_energy,
)

from kcons.openmm import SCHEMES, Langevin, ProjectedIntegrator

GAS = unit.MOLAR_GAS_CONSTANT_R.value_in_unit(unit.kilojoule_per_mole / unit.kelvin)
T = 300.0
#: 1/ps. <K> of 12 ps then has a standard deviation of 1.8 % over seeds.
RATE = 20.0
MOMENTUM = "free"
AT_CONSTANT_ENERGY = {name: lambda dt, name=name, **given: ProjectedIntegrator(dt, name, **given) for name in SCHEMES}
#: Programs are run by the code of Reference also on the CPU, where forces differ: there a few of them will do.
ON_THE_CPU = ("rattle", "geodesic")
ENSEMBLE_MADE = {
    name: lambda dt, make=make, **given: ProjectedIntegrator(dt, ensemble=make(T, RATE, MOMENTUM), **given)
    for name, make in ENSEMBLES.items()
}
MADE = AT_CONSTANT_ENERGY | ENSEMBLE_MADE
#: Orders beyond 2 cost several force evaluations: fewer steps show as much.
STEPS = {name: 40 for name in SCHEMES if name != "rattle"}
#: On GPUs in mixed precision, which is what they are used in: without a thermostat, and one that scales velocities.
ON_GPUS = [p for p in GPUS if "mixed" in p.id or "none" in p.id]


def here(names):
    """Each on Reference, and on the CPU where that differs."""
    return [
        (name, place)
        for place in PLATFORMS
        for name in names
        if place != "CPU" or name not in SCHEMES or name in ON_THE_CPU
    ]


made = pytest.mark.parametrize(("name", "platform"), here(MADE))
at_constant_energy = pytest.mark.parametrize(("name", "platform"), here(AT_CONSTANT_ENERGY))
HERE_AND_THERE = [
    *(pytest.param(name, place, id=f"{place}-{name}") for name, place in here(MADE)),
    *(
        pytest.param(name, *p.values, id=f"{p.id}-{name}", marks=p.marks)
        for p in ON_GPUS
        for name in ("rattle", "NoseHoover")
    ),
]


def every_shape(coupled=True):
    """Pairs, an angle, a cluster, a chain and two rigid waters in one System, with charges; and their positions.

    Not `coupled` are pairs, a star and rigid waters: of a processor (pocl), OpenMM's solver for coupled bonds leaves
    6e-7 at a tolerance of 1e-8, with VerletIntegrator as well.
    """
    force, masses, x, rows = openmm.NonbondedForce(), [], [], []

    def add(weights, places, pairs):
        rows.extend((len(x) + i, len(x) + j) for i, j in pairs)
        for k, place in enumerate(places):
            force.addParticle(0.2 if k % 2 == 0 else -0.2, 0.3, 1.0)
            x.append(place)
        masses.extend(weights)

    shift = np.array([0.0, 0.0, 2.0])
    stairs = np.array([[k // 2, (k + 1) // 2, 0.0] for k in range(8)])
    add([5.0, 10.0] * 4, stairs, [*([(0, 1), (1, 2), (2, 3)] if coupled else []), (4, 5), (6, 7)])
    cluster = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0], [1, 1, 0]], dtype=float)
    around = [*([(0, 1), (1, 5), (1, 6)] if coupled else []), (0, 2), (0, 3), (0, 4)]
    add([10.0] * 2 + [1.0] * 5, cluster + shift, around)
    add([1.0] * 8, stairs + 2 * shift, [(k, k + 1) for k in range(0, 7, 1 if coupled else 2)])
    for k in range(2):
        water = np.array([[0, 0, 0], [1.0, 0, 0], [0.25, np.sqrt(15) / 4, 0]])  # sides 1, 1 and sqrt(1.5)
        add([16.0, 1.0, 1.0], water + 3 * shift + [2.0 * k, 0, 0], [(0, 1), (0, 2), (1, 2)])
    for i, j in rows:
        force.addException(i, j, 0, 1, 0)
    x = np.array(x)
    return particles(masses, force, held=rows, x=x), x


@pytest.mark.parametrize(("name", "platform"), here(AT_CONSTANT_ENERGY))
def test_single_bond(name, platform):
    """A harmonic oscillator; positions and velocities against the closed form, and the energy."""
    system = particles([2.0, 2.0], pairs_force(openmm.HarmonicBondForce(), (0, 1, 1.5, 1.0)))
    dt = 0.01
    context = started(system, integrator := MADE[name](dt), [[-1, 0, 0], [1, 0, 0]], None, platform)
    first = total_energy(context)
    for step in range(STEPS.get(name, 200)):
        time = dt * step
        x, v = state_of(context)
        distance, rate = 1.5 + 0.5 * np.cos(time), -0.5 * np.sin(time)
        np.testing.assert_allclose(x, [[-distance / 2, 0, 0], [distance / 2, 0, 0]], atol=1e-4)
        np.testing.assert_allclose(v, [[-rate / 2, 0, 0], [rate / 2, 0, 0]], atol=1e-4)
        assert total_energy(context) == pytest.approx(first, rel=1e-4)
        assert total_energy(context) == pytest.approx(0.125, rel=1e-4)
        integrator.step(1)
    assert context.getState().getTime()._value == pytest.approx(dt * STEPS.get(name, 200), rel=1e-12)


@pytest.mark.filterwarnings("ignore:the forces exert no torque")
@pytest.mark.parametrize("name, platform", HERE_AND_THERE)
def test_constraints_of_every_shape(name, platform):
    """Distances to 2e-5, velocities along them to 2e-5, the total energy to 1 %, at each step."""
    system, x = every_shape(coupled=platform in PLATFORMS)
    integrator = MADE[name](0.002)
    context = started(system, integrator, x, None, platform)
    integrator.setVelocitiesToTemperature(context, T, 3)
    v, masses = state_of(context)[1], masses_of(system)
    context.setVelocities(v - masses @ v / masses.sum())  # thermostats that scale velocities keep total momentum
    pairs, lengths = rows_of(system)
    energies = []
    steps = STEPS.get(name, 200)
    for step in range(steps):
        integrator.step(1)
        x, v = state_of(context)
        r, u = (a[pairs[:, 0]] - a[pairs[:, 1]] for a in (x, v))
        assert np.abs(np.linalg.norm(r, axis=1) / lengths - 1).max() < 2e-5
        assert np.abs(np.einsum("ij,ij->i", r, u)).max() < 2e-5
        if step % 20 == 0:
            energies.append(total_energy(context))
    if name in AT_CONSTANT_ENERGY:
        assert np.ptp(energies) < 0.01 * abs(energies[0])
    integrator.check()
    assert context.getState().getTime()._value == pytest.approx(0.002 * steps, rel=1e-9)


@pytest.mark.parametrize(("name", "platform"), here(ENSEMBLE_MADE))
def test_temperature(name, platform):
    """<K> = g kT/2 of a constrained chain in a field, to 6/sqrt(n), from 200 K; constant where it is to be."""
    x = np.cumsum(np.random.default_rng(0).normal(size=(8, 3)) * 0.1, axis=0)
    trap = field("50*(x^2+1.3*y^2+0.7*z^2)+20*x^4", 8)
    system = particles(np.arange(2.0, 10.0), trap, held=[(i - 1, i) for i in range(8) if i % 3], x=x)
    integrator = MADE[name](0.004, tolerance=1e-7)
    integrator.setRandomNumberSeed(1)  # before the Context, which reads it
    context = started(system, integrator, x, None, platform)
    integrator.setVelocitiesToTemperature(context, 200.0, 3)
    integrator.step(1000)
    n = 3000
    kinetic = []
    for _ in range(n // 2):
        integrator.step(2)
        kinetic.append(integrator.kinetic_energy()._value)
    freedom = integrator.degrees_of_freedom()
    assert freedom == 24 - 5
    wanted = 0.5 * (freedom - (name == "Isokinetic")) * GAS * T
    assert np.mean(kinetic) == pytest.approx(wanted, rel=6 / np.sqrt(n))
    if name == "Isokinetic":
        np.testing.assert_allclose(kinetic, wanted, rtol=1e-6)
    else:
        assert np.std(kinetic) > 0.1 * wanted


@pytest.mark.parametrize("platform", PLATFORMS)
def test_random_seed(platform):
    """The same seed, the same run; another, another."""
    system, x = every_shape()
    ends = []
    for seed in (5, 5, 10, 10):
        integrator = MADE["Langevin"](0.002)
        integrator.setRandomNumberSeed(seed)
        context = started(system, integrator, x, 0 * x, platform)
        integrator.step(10)
        ends.append(state_of(context)[0])
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[2], ends[3])
    assert np.abs(ends[0] - ends[2]).max() > 1e-4


@pytest.mark.parametrize(("name", "platform"), here(("rattle", *ENSEMBLE_MADE)))
def test_initial_temperature(name, platform):
    """Velocities that are drawn have the temperature on average, to 2 %; no particle alone."""
    n = 3000
    system = particles([10.0] * n, held=[(k - 1, k, 1.0) for k in range(1, n, 2)])
    x = np.random.default_rng(0).random((n, 3)) * 10
    x[1::2] = x[::2]
    x[1::2, 0] += 1.0
    integrator = MADE[name](0.001)
    context = started(system, integrator, x, None, platform)
    kinetic = []
    for seed in range(1, 11):
        integrator.setVelocitiesToTemperature(context, T, seed)
        kinetic.append(integrator.kinetic_energy()._value)
    assert np.mean(kinetic) == pytest.approx(0.5 * (3 * n - n // 2) * GAS * T, rel=0.02)  # four standard errors
    assert integrator.degrees_of_freedom() == 3 * n - n // 2


@pytest.mark.filterwarnings("ignore:total momentum", "ignore:the forces exert no torque")
@made
def test_massless_particles(name, platform):
    """Particles without mass stay where they are; a constraint between one and another with a mass is refused."""
    force = openmm.NonbondedForce()
    for _ in range(4):
        force.addParticle(0.1, 0.2, 0.5)
    system = particles([0.0, 1.0, 1.0, 0.0], force, held=[(1, 2, 1.0)])
    x = np.array([[-1.0, 0, 0], [0, 0, 0], [1, 0, 0], [2, 0.5, 0]])
    integrator = MADE[name](0.001)
    context = started(system, integrator, x, None, platform)
    integrator.setVelocitiesToTemperature(context, T, 1)
    integrator.step(10)
    now, v = state_of(context)
    np.testing.assert_array_equal(now[[0, 3]], x[[0, 3]])
    assert (v[[0, 3]] == 0).all()
    assert np.abs(now[1] - x[1]).max() > 1e-5
    system.addConstraint(0, 1, 1.0)
    with pytest.raises(openmm.OpenMMException, match="massless"):
        context_of(system, MADE[name](0.001), platform)


@pytest.mark.filterwarnings("ignore:the forces exert no torque")
@pytest.mark.filterwarnings("ignore:total momentum")
@made
def test_force_groups(name, platform):
    system = particles([1.0, 1.0], field("100*x", 1, 1), field("100*y", 1, 2))
    integrator = ProjectedIntegrator(0.01, ensemble=Langevin(0, 0)) if name == "Langevin" else MADE[name](0.01)
    integrator.setIntegrationForceGroups({1})
    context = started(system, integrator, np.zeros((2, 3)), [[0, 0, 0.0], [1.0, 0, 0]], platform)
    integrator.step(5)
    x = state_of(context)[0]
    assert x[0, 0] < -1e-3
    assert x[0, 1] == x[0, 2] == 0


@at_constant_energy
def test_momenta_are_conserved(name, platform):
    """To OpenMM's 1e-4, and to rounding."""
    system, x = every_shape()
    integrator = MADE[name](0.001, tolerance=1e-12)
    context = started(system, integrator, x, None, platform)
    integrator.setVelocitiesToTemperature(context, T, 2)
    masses = masses_of(system)[:, None]

    def momenta():
        x, v = state_of(context)
        return np.array([(masses * v).sum(axis=0), np.cross(x, masses * v).sum(axis=0)])

    before = momenta()
    integrator.step(STEPS.get(name, 200))
    off = np.abs(momenta() - before).max(axis=1)
    # The CPU platform has forces in single precision.
    assert off.max() < (1e-7 if platform == "Reference" else 1e-3)
