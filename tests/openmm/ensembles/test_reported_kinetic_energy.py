"""The kinetic energy that a State reports: with noise that of the middle of the step, else that of its velocities."""

from __future__ import annotations

import numpy as np
import pytest
from collective_cases import bond
from openmm import unit
from openmm_systems import (
    DEVICE,
    PLATFORMS,
    field,
    masses_of,
    on_gpus,
    particles,
    started,
    state_of,
    with_and_without_device,
)

from kcons.constraints import Distance
from kcons.openmm import (
    CollectiveRows,
    Isokinetic,
    Langevin,
    LangevinRespa,
    NoseHoover,
    NoseHooverMiddle,
    ProjectedIntegrator,
    Row,
    hold,
)
from kcons.openmm.ensembles.isokinetic_ensemble import GAS_CONSTANT

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")

#: A time step, and an oscillator whose velocities at the ends of steps have 1 - (w h)^2/4 = 0.64 of the temperature.
STEP, PART = 0.02, 0.64
SPRING = 12.0 * (1.2 / STEP) ** 2
TWO = {0: 1, 1: 4}


def oscillators(n=200, spring=SPRING):
    shares = ((1, 1.0), (0, 0.01))
    forces = [field(f"0.5*{share * spring}*(x^2+y^2+z^2)", n, group=group) for group, share in shares]
    x = np.random.default_rng(1).normal(0, np.sqrt(GAS_CONSTANT * 300 / SPRING), (n, 3))
    return particles([12.0] * n, *forces), x


def beside(system, x):
    """Two particles more, which move freely at their distance."""
    a, b = (system.addParticle(12.0) for _ in range(2))
    return a, b, np.vstack([x, [[0.0, 0, 0], [1.0, 0, 0]]])


def collective(system, x):
    a, b, x = beside(system, x)
    return x, [CollectiveRows(system, [Row(bond(a, b), 1.0)], positions=x)]


def carried(system, x):
    a, b, x = beside(system, x)
    return x, [hold(system, Distance([[a, b]], 1.0), x)]


def kelvins(integrator, context, platform):
    """Means of the reported temperature and of that of the velocities of a State, and a standard error."""
    masses, freedom = masses_of(context.getSystem()), integrator.degrees_of_freedom()
    values = []
    for _ in range(100):
        integrator.step(12)
        state = context.getState(energy=True, velocities=True)
        v = state.getVelocities(asNumpy=True)._value
        reported = 2 * state.getKineticEnergy()._value / (GAS_CONSTANT * freedom)
        asked = integrator.computeSystemTemperature()._value
        assert asked == pytest.approx(reported * integrator.ensemble.warmth(integrator), rel=1e-6)
        values.append((asked, masses @ np.einsum("ij,ij->i", v, v) / (GAS_CONSTANT * freedom)))
    blocks = np.array(values).reshape(20, 5, 2).mean(axis=1)
    return (*blocks.mean(axis=0), blocks[:, 0].std(ddof=1) / np.sqrt(20))


def bath(ensemble, step=STEP, parts=lambda system, x: (x, []), **options):
    def make(platform):
        system, x = oscillators()
        x, held = parts(system, x)
        integrator = ProjectedIntegrator(step * unit.picosecond, parts=held, ensemble=ensemble, **options)
        integrator.setRandomNumberSeed(11)
        return integrator, started(system, integrator, x, platform=platform)

    return make


BATHS = {
    "Langevin": bath(Langevin(300, 10.0)),
    "collective": bath(Langevin(300, 10.0), parts=collective),
    "carried": bath(Langevin(300, 10.0), parts=carried),
    "device": bath(Langevin(300, 10.0), device=True),
    "device at high friction": bath(Langevin(300, 100.0), device=True),
}


@pytest.mark.parametrize(
    ("name", "platform"),
    [
        *(pytest.param(name, "Reference", marks=DEVICE.marks if "device" in name else ()) for name in BATHS),
        *(("Langevin", "CPU"), pytest.param("device", "CPU", marks=DEVICE.marks)),
        *(pytest.param("Langevin", *p.values, id=p.id, marks=p.marks) for p in on_gpus("mixed")),
    ],
)
def test_with_noise_the_temperature_of_the_bath_is_reported(name, platform):
    """Velocities at the ends of steps, which the State has, are colder; temperatures within four standard errors."""
    integrator, context = BATHS[name](platform)
    integrator.setVelocitiesToTemperature(context, 300, 5)
    integrator.step(150)
    reported, of_velocities, error = kelvins(integrator, context, platform)
    assert abs(reported - 300) < 4 * error < 12
    assert of_velocities == pytest.approx(PART * 300, abs=4 * error)


@pytest.mark.parametrize("platform", PLATFORMS)
def test_of_several_time_steps_the_middle_of_the_last_inner_one_is_reported(platform):
    """The fast motion, of which the kick at the end takes a third; what is left is of the slow kicks."""
    integrator, context = bath(LangevinRespa(300, 10.0, TWO), 4 * STEP)(platform)
    integrator.setVelocitiesToTemperature(context, 300, 5)
    integrator.step(60)
    reported, of_velocities, error = kelvins(integrator, context, platform)
    assert abs(reported - 300) < 4 * error + 9
    assert of_velocities < 0.75 * reported


def test_the_middle_is_half_a_kick_before_the_end():
    system, x = oscillators(5)
    integrator = ProjectedIntegrator(STEP, ensemble=Langevin(300, 10.0))
    context = started(system, integrator, x)
    for steps in (1, 7):
        integrator.step(steps)
        state = context.getState(energy=True, velocities=True, forces=True)
        v = state.getVelocities(asNumpy=True)._value - 0.5 * STEP * state.getForces(asNumpy=True)._value / 12.0
        assert state.getKineticEnergy()._value == pytest.approx(6.0 * np.sum(v**2), rel=1e-12)
        assert integrator.kinetic_energy()._value == pytest.approx(6.0 * np.sum(v**2), rel=1e-12)


def energy_of(context):
    return context.getState(energy=True).getKineticEnergy()._value


@pytest.mark.parametrize("parts", [lambda system, x: (x, []), collective])
def test_of_velocities_that_others_have_set_it_is_theirs(parts):
    system, x = oscillators(5)
    x, held = parts(system, x)
    integrator = ProjectedIntegrator(STEP, parts=held, ensemble=Langevin(300, 10.0))
    integrator.setRandomNumberSeed(11)
    context = started(system, integrator, x)
    integrator.step(3)
    kept = context.getState(positions=True, velocities=True)
    reported = energy_of(context)
    v = state_of(context)[1]
    assert reported != pytest.approx(6.0 * np.sum(v**2), rel=1e-3)
    integrator.setVelocitiesToTemperature(context, 500, 3)
    assert energy_of(context) == pytest.approx(6.0 * np.sum(state_of(context)[1] ** 2), rel=1e-12)
    assert integrator.kinetic_energy()._value == energy_of(context)
    context.setVelocities(0 * v)
    assert energy_of(context) == 0
    context.setState(kept)
    assert energy_of(context) == reported
    integrator.applyVelocityConstraints(context)  # constraints applied alone are no step
    assert energy_of(context) == pytest.approx(reported, rel=1e-2)
    other = ProjectedIntegrator(STEP, parts=held, ensemble=Langevin(300, 10.0))
    fresh = started(system, other, x)
    fresh.setState(kept)
    assert energy_of(fresh) == pytest.approx(6.0 * np.sum(v**2), rel=1e-12)


@with_and_without_device
@pytest.mark.parametrize("platform", PLATFORMS)
def test_checkpoints_and_states_bring_it_along(platform, device):
    system, x = oscillators(5)
    integrators = [ProjectedIntegrator(STEP, ensemble=Langevin(300, 10.0), device=device) for _ in range(3)]
    ours, second, third = (started(system, one, x, platform=platform) for one in integrators)
    integrators[0].step(4)
    second.loadCheckpoint(ours.createCheckpoint())
    third.setState(ours.getState(positions=True, velocities=True, integratorParameters=True))
    assert energy_of(second) == energy_of(third) == energy_of(ours)


@pytest.mark.parametrize(
    "ensemble",
    [None, NoseHoover(300, 5.0), NoseHooverMiddle(300, 5.0), Isokinetic(300), Langevin(300, 0.0), Langevin(0, 10.0)],
    ids=["constant energy", "NoseHoover", "NoseHooverMiddle", "Isokinetic", "no friction", "0 K"],
)
def test_without_noise_it_is_that_of_the_velocities(ensemble):
    system, x = oscillators(5)
    integrator = ProjectedIntegrator(STEP, ensemble=ensemble)
    context = started(system, integrator, x, np.random.default_rng(3).normal(0, 0.5, x.shape))
    for steps in (1, 5):
        integrator.step(steps)
        assert energy_of(context) == pytest.approx(6.0 * np.sum(state_of(context)[1] ** 2), rel=1e-12)
