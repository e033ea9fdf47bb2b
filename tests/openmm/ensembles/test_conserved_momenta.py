"""Momenta that a System conserves: found, warned of, or refused."""

import pytest
from ensemble_runs import run
from openmm_systems import dumbbell, loose_alanine, masses_of

from kcons.openmm import Isokinetic, ProjectedIntegrator

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")


def test_momenta_that_are_conserved_are_found():
    system, x, v = dumbbell()
    ensemble = Isokinetic(300.0)
    context = run(system, integrator := ProjectedIntegrator(1e-4, ensemble=ensemble), x, v, 1)
    assert ensemble.count(integrator) == 5  # the field stands in space
    field = system.getForce(0)
    field.setEnergyFunction("k*x^2+c*0")
    with pytest.warns(UserWarning, match="total momentum is not zero"):
        context = run(system, integrator := ProjectedIntegrator(1e-4, ensemble=ensemble), x, v, 1)
    assert ensemble.count(integrator) == 3  # along y and z nothing acts
    free = Isokinetic(300.0, momentum="free")
    context = run(system, integrator := ProjectedIntegrator(1e-4, ensemble=free), x, v, 1)
    assert free.count(integrator) == 5
    del context


def test_a_free_cluster_is_warned_of():
    system, x, v = loose_alanine()
    masses = masses_of(system)
    with pytest.warns(UserWarning, match="no torque"):
        run(system, ProjectedIntegrator(1e-3, ensemble=Isokinetic(300.0)), x, v - masses @ v / masses.sum(), 1)
