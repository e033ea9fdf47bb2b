"""The kinetic energy that a State reports: with noise that of the middle of the step, else that of its velocities."""

from __future__ import annotations

import numpy as np
import pytest
from collective_cases import bond
from openmm import unit
from openmm_systems import DEVICE, PLATFORMS, field, on_gpus, particles, started, state_of, with_and_without_device

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
STEP = 0.02
SPRING = 12.0 * (1.2 / STEP) ** 2


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
    "several steps": bath(LangevinRespa(300, 10.0, {0: 1, 1: 4}), 4 * STEP),
    "device at high friction": bath(Langevin(300, 100.0), device=True),
}


@pytest.mark.parametrize(
    ("name", "platform"),
    [
        *(pytest.param(name, "Reference", marks=DEVICE.marks if "device" in name else ()) for name in BATHS),
        *(("Langevin", "CPU"), ("several steps", "CPU"), pytest.param("device", "CPU", marks=DEVICE.marks)),
        *(pytest.param("Langevin", *p.values, id=p.id, marks=p.marks) for p in on_gpus("mixed")),
    ],
)
def test_with_noise_it_is_that_half_a_kick_before_the_end(name, platform):
    """There velocities have the temperature of the bath; those at the ends of steps, which the State has, are colder.

    Of several time steps it is that of the last inner one, before the slow kick too.
    """
    integrator, context = BATHS[name](platform)
    integrator.setVelocitiesToTemperature(context, 300, 5)
    near = 1e-12 if platform in PLATFORMS and name not in ("collective", "carried") else 1e-6
    for steps in (1, 7):
        integrator.step(steps)
        reported, v = energy_of(context), state_of(context)[1]
        for group, share in ((1, 0.5), (0, 2.0 if "several" in name else 0.5)):
            forces = context.getState(forces=True, groups={group}).getForces(asNumpy=True)._value
            v = v - share * STEP * forces / 12.0
        # What moves rows goes by positions, which have fewer digits of it.
        assert reported == pytest.approx(6.0 * np.sum(v**2), rel=near)
        assert integrator.kinetic_energy()._value == pytest.approx(reported, rel=1e-12)
        kelvins = 2 * reported / (GAS_CONSTANT * integrator.degrees_of_freedom())
        assert integrator.computeSystemTemperature()._value == pytest.approx(kelvins, rel=1e-6)


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
