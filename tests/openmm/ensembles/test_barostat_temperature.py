"""A barostat of another temperature than the thermostat is told of."""

import warnings

import openmm
import pytest
from openmm_systems import context_of, water_box

from kcons.errors import InputError
from kcons.openmm import Isokinetic, Langevin, NoseHoover, NoseHooverMiddle, ProjectedIntegrator

ENSEMBLES = [
    Langevin(300, 1),
    NoseHoover(300, 5, momentum="free"),
    NoseHooverMiddle(300, 5, momentum="free"),
    Isokinetic(300, momentum="free"),
]
BAROSTATS = [
    lambda t: openmm.MonteCarloBarostat(1.0, t, 5),
    lambda t: openmm.MonteCarloAnisotropicBarostat(openmm.Vec3(1, 1, 1), t),
    lambda t: openmm.MonteCarloMembraneBarostat(1.0, 0.0, t, 0, 0),
    lambda t: openmm.MonteCarloFlexibleBarostat(1.0, t),
]


def started(barostat, ensemble):
    system, x = water_box(27)
    system.addForce(barostat)
    integrator = ProjectedIntegrator(1e-3, ensemble=ensemble)
    context = context_of(system, integrator)
    context.setPositions(x)
    integrator.setVelocitiesToTemperature(context, 300, 1)
    return integrator, context


@pytest.mark.parametrize(("ensemble", "barostat"), list(zip(ENSEMBLES, BAROSTATS, strict=True)))
def test_a_barostat_of_another_temperature(ensemble, barostat):
    integrator, context = started(barostat(310), ensemble)
    with pytest.warns(UserWarning, match=r"temperature of 310 K, and the integrator one of 300 K") as told:
        integrator.step(1)
    assert told[0].filename == __file__
    name = str(told[0].message).split("'")[1]
    context.setParameter(name, 300)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        integrator.step(1)
        integrator.setTemperature(300)
    with pytest.warns(UserWarning, match=r"temperature of 300 K, and the integrator one of 350 K") as told:
        integrator.setTemperature(350)
    assert told[0].filename == __file__


def test_without_a_temperature_there_is_nothing_to_compare():
    integrator, _ = started(openmm.MonteCarloBarostat(1.0, 310), Isokinetic(momentum="free"))
    integrator.step(1)


@pytest.mark.parametrize(
    "barostat",
    [
        openmm.MonteCarloBarostat(float("nan"), 300),
        openmm.MonteCarloAnisotropicBarostat(openmm.Vec3(1, float("inf"), 1), 300),
    ],
)
def test_a_pressure_that_is_none(barostat):
    """OpenMM accepts every trial then, and the box wanders."""
    with pytest.raises(InputError, match=r"Barostat has a pressure of .*; give a finite one"):
        started(barostat, Langevin(300, 1))
