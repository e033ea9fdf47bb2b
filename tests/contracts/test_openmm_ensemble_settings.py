"""Ensembles in OpenMM: degrees of freedom, refusals, copies and files."""

import copy
import pickle

import numpy as np
import openmm
import pytest
from ensemble_runs import run, twice_kinetic
from openmm import unit
from openmm_ensembles import ENSEMBLES
from openmm_systems import alanine, context_of, dumbbell, state_of

from kcons.constraints import Distance
from kcons.errors import InputError, OverdeterminedError, UnsupportedError
from kcons.openmm import (
    CollectiveRows,
    Isokinetic,
    Langevin,
    ProjectedIntegrator,
    Row,
    hold,
)
from kcons.openmm.ensembles.isokinetic_ensemble import GAS_CONSTANT

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")


# -- isokinetic: g, refusals, settings -----------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:total momentum")
def test_what_cannot_be_thermostatted_is_refused():
    for arguments, match in (
        ({"temperature": 0.0}, "temperature"),
        ({"temperature": float("nan")}, "temperature"),
        ({"convention": "other"}, "convention"),
        ({"momentum": "maybe"}, "momentum"),
    ):
        with pytest.raises(InputError, match=match):
            Isokinetic(**arguments)
    for scheme in ("suzuki4", "kahan-li6", "blanes-moan4", "blanes-moan6"):
        with pytest.raises(UnsupportedError, match="isokinetic4"):
            ProjectedIntegrator(1e-3, scheme, ensemble=Isokinetic(300.0))
    system, x, v = dumbbell()
    with pytest.raises(InputError, match="non-zero kinetic energy"):
        run(system, ProjectedIntegrator(1e-3, ensemble=Isokinetic(300.0)), x, 0 * v, 1)
    one = openmm.System()
    for m in (1.0, 0.0):
        one.addParticle(m)
    planes = CollectiveRows(one, [Row(_plane("x"), 0.0), Row(_plane("y"), 0.0)])
    integrator = ProjectedIntegrator(1e-3, parts=[planes], ensemble=Isokinetic(300.0))
    with pytest.raises(OverdeterminedError, match="g - 1 = 0"):
        run(one, integrator, np.zeros((2, 3)), [[0, 0, 1.0], [0, 0, 0]], 1)


def _plane(name):
    force = openmm.CustomExternalForce(name)
    force.addParticle(0, [])
    return force


def test_moving_targets_are_refused_and_held_by_langevin():
    for ensemble in (Isokinetic(300.0), Langevin(300.0, 5.0)):
        system, x, v = dumbbell()
        x = np.vstack([x, x[:1] + np.array([0.2, 0.1, 0.0])])
        v = np.vstack([v, [[0.1, 0, 0]]])
        system.addParticle(14.0)
        part = hold(system, [Distance([[0, 2]], lambda t: 0.2236 + 0.5 * t)], positions=x)
        integrator = ProjectedIntegrator(1e-3, parts=[part], ensemble=ensemble)
        context = context_of(system, integrator)
        context.setPositions(x)
        integrator.applyConstraints(context)
        integrator.setVelocitiesToTemperature(context, 300, 2)
        if isinstance(ensemble, Isokinetic):
            with pytest.raises(UnsupportedError, match="needs constant targets"):
                integrator.step(1)
            continue
        for _ in range(4):
            integrator.step(10)
            context.getState(energy=True, forces=True)  # evaluates all groups between steps
            r, u = state_of(context)
            d = r[2] - r[0]
            now = context.getTime().value_in_unit(unit.picosecond)
            assert abs(np.linalg.norm(d) - (0.2236 + 0.5 * now)) < 1e-12
            assert abs(d @ (u[2] - u[0]) / np.linalg.norm(d) - 0.5) < 1e-9


@pytest.mark.parametrize(
    "ensemble", [Isokinetic(300.0, convention="notes"), *(make(300.0) for make in ENSEMBLES.values())], ids=repr
)
def test_copies_files_and_temperatures(ensemble):
    system, x, v = alanine()
    integrator = ProjectedIntegrator(1e-3, ensemble=ensemble)
    integrator.setRandomNumberSeed(5)
    twins = [copy.copy(integrator), pickle.loads(pickle.dumps(integrator))]
    context = run(system, integrator, x, v, 20)
    first = state_of(context)
    for twin in twins:
        assert repr(twin.ensemble) == repr(ensemble)
        assert np.array_equal(state_of(run(system, twin, x, v, 20)), first)
    integrator.setTemperature(350 * unit.kelvin)
    integrator.step(2)
    assert repr(integrator.ensemble).count("350 K") == 1
    if isinstance(ensemble, Isokinetic):
        k = twice_kinetic(system, state_of(context)[1])
        momenta = 66 if ensemble.convention == "notes" else 41
        assert abs(k / (momenta * GAS_CONSTANT * 350) - 1) <= 1e-13
    with pytest.raises(UnsupportedError, match="ensemble"):
        ProjectedIntegrator(1e-3).setTemperature(300)
