"""Dynamics with virtual sites: energies, forces, temperatures and averages are those of sites at the right place."""

from __future__ import annotations

import copy

import numpy as np
import openmm
import pytest
from ensemble_runs import twice_kinetic
from openmm import unit
from openmm_systems import (
    PLATFORMS,
    dumbbell,
    forces_at,
    masses_of,
    on_gpus,
    residuals,
    started,
    state_of,
    total_energy,
)
from virtual_site_systems import prepared

from kcons.errors import UnsupportedError
from kcons.openmm import Isokinetic, Langevin, NoseHoover, ProjectedIntegrator
from kcons.openmm.ensembles.isokinetic_ensemble import GAS_CONSTANT
from kcons.openmm.integrator.guard import parts_of_steps

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")

MODELS = ("tip4pew", "tip4pd", "tip5p", "mixed")
#: Integrators at constant energy and their orders.
CONSERVING = {
    "rattle": (lambda dt: ProjectedIntegrator(dt, tolerance=1e-13), 2),
    "geodesic": (lambda dt: ProjectedIntegrator(dt, "geodesic", tolerance=1e-13), 2),
    "yoshida4": (lambda dt: ProjectedIntegrator(dt, "yoshida4", tolerance=1e-13), 4),
}


def spread(model, integrator, time, platform="Reference"):
    """How far the total energy is off along a run, root mean square."""
    system, x, v = prepared(model)
    context = started(system, integrator, x, v, platform)
    energies = [total_energy(context)]
    for _ in range(round(time / integrator.getStepSize()._value)):
        integrator.step(1)
        energies.append(total_energy(context))
    assert context.getState().getTime()._value == pytest.approx(time)
    assert residuals(system, context)[0] < 1e-7
    return float(np.sqrt(np.mean(np.subtract(energies, energies[0]) ** 2)))


# -- where sites are -------------------------------------------------------------------------------


def test_which_steps_are_made_in_parts():
    """Forces of the middle of a program are those of sites at its beginning, on Reference and CPU."""
    system, x, v = prepared("tip4pew")
    for platform in PLATFORMS:
        plain = openmm.CustomIntegrator(1e-3)
        plain.addPerDofVariable("seen", 0)
        plain.addComputePerDof("x", "x+dt*v")
        plain.addConstrainPositions()
        plain.addComputePerDof("seen", "f")
        context = started(system, plain, x, v, platform)
        plain.step(1)
        seen, now = np.array(plain.getPerDofVariableByName("seen")), forces_at(context)
        massive = masses_of(system) > 0
        assert np.abs(seen - now)[massive].max() > 1e-3 * np.abs(now).max()
        del context
        context = started(system, integrator := ProjectedIntegrator(1e-3), x, v, platform)
        assert parts_of_steps(context, integrator)
        del context
    system, x, v = dumbbell()
    context = started(system, integrator := ProjectedIntegrator(1e-3), x, v)
    assert not parts_of_steps(context, integrator)


@pytest.mark.parametrize("platform", on_gpus("mixed"))
def test_gpus_place_sites_where_positions_are_constrained(platform):
    system, x, v = prepared("tip4pew")
    integrator = ProjectedIntegrator(1e-3)
    context = started(system, integrator, x, v, platform)
    assert not parts_of_steps(context, integrator)


# -- constant energy --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "kind"), [*((model, "rattle") for model in MODELS), *(("tip5p", k) for k in CONSERVING if k != "rattle")]
)
def test_energy_is_conserved_to_the_order_of_the_scheme(model, kind):
    made, order = CONSERVING[kind]
    steps = np.array([2e-3, 1e-3, 5e-4]) / (2 if model == "mixed" else 1)
    errors = [spread(model, made(dt), 0.02) for dt in steps]
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, abs=0.25)


@pytest.mark.parametrize("model", MODELS)
def test_the_motion_is_that_of_openmm(model):
    """VerletIntegrator, whose velocities are half a step behind, has the same positions."""
    system, x, v = prepared(model)
    dt, tolerance = 1e-3, 1e-12
    verlet = openmm.VerletIntegrator(dt)
    verlet.setConstraintTolerance(tolerance)
    context = started(system, verlet, x, v)
    inverse = np.divide(1, masses_of(system), out=np.zeros(len(x)), where=masses_of(system) > 0)
    # Half a kick back, with accelerations along the constraints.
    context.setVelocities(inverse[:, None] * forces_at(context))
    context.applyVelocityConstraints(tolerance)
    context.setVelocities(v - 0.5 * dt * state_of(context)[1])
    ours = started(system, integrator := ProjectedIntegrator(dt, tolerance=tolerance), x, v)
    for steps in (1, 4, 25):
        verlet.step(steps)
        integrator.step(steps)
        assert np.abs(state_of(ours)[0] - state_of(context)[0]).max() < 1e-8
    assert np.abs(state_of(context)[0] - x).max() > 1e-3


def test_how_steps_are_divided_into_calls_changes_nothing():
    system, x, v = prepared("tip4pew")
    for made in (
        lambda: ProjectedIntegrator(1e-3),
        lambda: ProjectedIntegrator(1e-3, "blanes-moan4"),
        lambda: ProjectedIntegrator(1e-3, ensemble=Isokinetic()),
    ):
        ends = []
        for calls in ((12,), (1,) * 12, (5, 7)):
            context = started(system, integrator := made(), x, v)
            for steps in calls:
                integrator.step(steps)
            assert context.getStepCount() == 12
            ends.append(state_of(context))
        np.testing.assert_array_equal(ends[0], ends[1])
        np.testing.assert_array_equal(ends[0], ends[2])


def test_a_step_costs_one_evaluation_of_forces():
    system, x, v = prepared("tip4pew")
    system, calls = copy.deepcopy(system), []

    def nothing(state):
        calls.append(1)
        return 0.0, np.zeros((len(x), 3))

    system.addForce(openmm.PythonForce(nothing))
    for integrator in (
        ProjectedIntegrator(1e-3),
        ProjectedIntegrator(1e-3, ensemble=Langevin(300, 1)),
        ProjectedIntegrator(1e-3, ensemble=Isokinetic(momentum="conserved")),
    ):
        context = started(system, integrator, x, v)
        integrator.step(1)
        calls.clear()
        integrator.step(10)
        assert len(calls) == 10
        del context


@pytest.mark.parametrize("platform", on_gpus("mixed"))
def test_gpus_place_sites_within_steps(platform):
    """As on Reference, as far as forces and lengths of the precision go."""
    system, x, v = prepared("tip4pew")
    for made in (
        lambda: ProjectedIntegrator(1e-3),
        lambda: ProjectedIntegrator(1e-3, "yoshida4"),
    ):
        ends = []
        for place in ("Reference", platform):
            context = started(system, integrator := made(), x, v, place)
            integrator.step(10)
            ends.append(state_of(context)[0])
        assert np.abs(ends[1] - ends[0]).max() < 2e-6


# -- ensembles --------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["tip4pew", "mixed"])
@pytest.mark.parametrize("ensemble", [Isokinetic(), NoseHoover(300, 20)], ids=["Isokinetic", "NoseHoover"])
def test_energies_of_thermostats_are_conserved_to_second_order(model, ensemble):
    system, x, v = prepared(model)
    errors = []
    steps = np.array([2e-3, 1e-3, 5e-4]) / (2 if model == "mixed" else 1)
    for dt in steps:
        integrator = ProjectedIntegrator(dt, tolerance=1e-13, ensemble=ensemble)
        context = started(system, integrator, x, v)
        integrator.step(1)
        energies, kinetic = [], []
        for _ in range(round(0.02 / dt)):
            integrator.step(1)
            energies.append(integrator.ensemble.conserved_energy(integrator))
            kinetic.append(integrator.kinetic_energy()._value)
        assert (np.ptp(kinetic) < 1e-12 * kinetic[0]) == (type(ensemble) is Isokinetic)
        errors.append(np.std(energies))
        del context
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(2, abs=0.25)


# -- what cannot be done ----------------------------------------------------------------------------


def test_programs_that_openmm_runs_by_itself_are_refused():
    """A CompoundIntegrator runs programs as wholes; where sites are placed at their ends, forces would be old."""
    system, x, v = prepared("tip4pew")
    compound = openmm.CompoundIntegrator()
    ours = ProjectedIntegrator(1e-3)
    compound.addIntegrator(ours)
    compound.addIntegrator(openmm.VerletIntegrator(1e-3))
    context = started(system, compound, x, v)
    with pytest.raises(UnsupportedError, match=r"particle 3 is a virtual site.*CompoundIntegrator.*integrator alone"):
        ours.attach(context)


def test_temperature_of_a_simulation_does_not_count_sites():
    system, x, v = prepared("tip5p")
    integrator = ProjectedIntegrator(1e-3)
    context = started(system, integrator, x, v)
    integrator.step(3)
    freedom = 6 * 8
    assert integrator.degrees_of_freedom() == freedom
    found = integrator.computeSystemTemperature() / unit.kelvin
    assert found == pytest.approx(twice_kinetic(system, state_of(context)[1]) / (freedom * GAS_CONSTANT))
