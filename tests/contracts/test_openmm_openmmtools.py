"""openmmtools: its ContextCache, MCMC moves and thermodynamic states run with kcons' integrators.

Replica exchange is a tutorial.

openmmtools compares integrators by copies of them whose variables it sets to 0, copies variables by their numbers from
one to another, and asks for `getTemperature` to see whether there is a thermostat.
"""

from __future__ import annotations

import copy
import warnings

import numpy as np
import openmm
import pytest
from openmm import unit
from openmm_ensembles import ENSEMBLES
from openmm_systems import water_box

from kcons.openmm import CollectiveRows, Langevin, LangevinRespa, NoseHoover, ProjectedIntegrator

with warnings.catch_warnings(action="ignore"):
    openmmtools = pytest.importorskip("openmmtools", reason="openmmtools is not installed")
    from openmmtools import cache, mcmc, states

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:the forces exert no torque"),
]

BATHS = {
    "constant energy": lambda kelvin: None,
    "LangevinRespa": lambda kelvin: LangevinRespa(kelvin, 5.0, {0: 1, 1: 2}),
    **ENSEMBLES,
}
MAKERS = {name: lambda kelvin, of=of: ProjectedIntegrator(0.001, ensemble=of(kelvin)) for name, of in BATHS.items()}


def trapped():
    """Rigid waters in a weak well, and its positions."""
    system, x = water_box(8)
    well = openmm.CustomExternalForce("5*(x^2+y^2+z^2)")
    for k in range(0, 24, 3):
        well.addParticle(k)
    well.setForceGroup(1)
    system.addForce(well)
    return system, x


def reference_cache():
    return cache.ContextCache(platform=openmm.Platform.getPlatformByName("Reference"))


@pytest.mark.parametrize("name", MAKERS)
def test_moves_at_several_temperatures_share_a_context(name):
    """Each step is at the temperature of its state, and no part of a run is lost."""
    system, x = trapped()
    contexts = reference_cache()
    here = [states.ThermodynamicState(system, temperature=kelvin * unit.kelvin) for kelvin in (300, 340)]
    moves = [
        mcmc.IntegratorMove(MAKERS[name](kelvin), n_steps=5, reassign_velocities=True, n_restart_attempts=0)
        for kelvin in (300, 340)
    ]
    place = states.SamplerState(positions=x * unit.nanometer)
    for _ in range(2):
        for state in here:
            for move in moves:
                before = place.positions / unit.nanometer
                move.apply(state, place, context_cache=contexts)
                assert np.abs(place.positions / unit.nanometer - before).max() > 1e-5
                kelvin = state.temperature / unit.kelvin
                context, integrator = contexts.get_context(state, MAKERS[name](kelvin))
                assert integrator.context is context
                if hasattr(integrator, "getTemperature"):
                    assert integrator.getTemperature() / unit.kelvin == kelvin
    assert len(contexts) == 1
    d = np.linalg.norm(place.positions[1] / unit.nanometer - place.positions[0] / unit.nanometer)
    assert abs(d - system.getConstraintParameters(0)[2]._value) < 1e-6


@pytest.mark.parametrize("name", MAKERS)
def test_what_openmmtools_asks_of_an_integrator(name):
    system, x = trapped()
    ran, kelvin = MAKERS[name](320), 320 * unit.kelvin
    state = states.ThermodynamicState(system, temperature=kelvin)
    assert state._is_integrator_thermostated(ran) == (name in BATHS and name != "constant energy")
    context = state.create_context(ran, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(x)
    context.setVelocitiesToTemperature(kelvin, 1)
    ran.step(3)
    same = cache.ContextCache._generate_integrator_id
    assert same(ran) == same(MAKERS[name](300)) == same(copy.deepcopy(ran))
    ran.step(3)


def test_integrators_that_differ_in_more_have_contexts_of_their_own():
    same = cache.ContextCache._generate_integrator_id
    others = ProjectedIntegrator(0.001, "suzuki4"), ProjectedIntegrator(0.001, ensemble=NoseHoover(300, 2.0))
    made = [*(maker(300) for maker in MAKERS.values()), *others]
    assert len({same(integrator) for integrator in made}) == len(made)


def test_a_move_with_a_row_that_is_held():
    system, x = trapped()
    distance = openmm.CustomBondForce("r")
    distance.addBond(0, 3)
    rows = CollectiveRows(system, [distance], positions=x, meets_system=True)
    integrator = ProjectedIntegrator(0.001, ensemble=Langevin(300, 5.0), parts=[rows])
    move = mcmc.IntegratorMove(integrator, n_steps=5, reassign_velocities=True, n_restart_attempts=0)
    place, contexts = states.SamplerState(positions=x * unit.nanometer), reference_cache()
    for kelvin in (300, 340, 300):
        state = states.ThermodynamicState(system, temperature=kelvin * unit.kelvin)
        move.apply(state, place, context_cache=contexts)
    y = place.positions / unit.nanometer
    assert abs(np.linalg.norm(y[0] - y[3]) - np.linalg.norm(x[0] - x[3])) < 1e-9
