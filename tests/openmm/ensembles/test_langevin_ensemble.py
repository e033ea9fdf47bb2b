"""Langevin dynamics on the constraints in OpenMM."""

import numpy as np
import pytest
from ensemble_runs import run, twice_kinetic
from openmm_systems import alanine, context_of, state_of, water_box

from kcons.errors import UnsupportedError
from kcons.openmm import Langevin, ProjectedIntegrator
from kcons.openmm.ensembles.isokinetic_ensemble import GAS_CONSTANT

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")


# -- Langevin ------------------------------------------------------------------------------------------


def test_langevin_without_friction_is_the_drift_in_two_halves():
    """Order 2, and no noise."""
    system, x, v = alanine()
    exact = state_of(run(system, ProjectedIntegrator(2.5e-4, "blanes-moan6", tolerance=1e-13), x, v, 64))[0]
    errors = []
    for n in (16, 32, 64):
        integrator = ProjectedIntegrator(0.016 / n, tolerance=1e-13, ensemble=Langevin(300.0, 0.0))
        errors.append(np.abs(state_of(run(system, integrator, x, v, n))[0] - exact).max())
    slope = np.polyfit(np.log([4, 2, 1]), np.log(errors), 1)[0]
    assert slope == pytest.approx(2, abs=0.15)


def test_langevin_is_refused_where_it_cannot_be():
    for scheme in ("suzuki4", "blanes-moan4", "isokinetic4"):
        with pytest.raises(UnsupportedError):
            ProjectedIntegrator(1e-3, scheme, ensemble=Langevin(300.0, 1.0))


def test_langevin_velocities_have_the_temperature_of_the_tangent_plane():
    """A chain of rigid waters without forces: <v A> = 0 exactly, and <2K> = g kT within three standard errors."""
    system, x = water_box()
    system.removeForce(0)
    integrator = ProjectedIntegrator(2e-3, ensemble=Langevin(300.0, 200.0))
    integrator.setRandomNumberSeed(11)
    context = context_of(system, integrator)
    context.setPositions(x)
    integrator.setVelocitiesToTemperature(context, 300, 7)
    values = []
    for _ in range(400):
        integrator.step(5)  # friction x time = 2: independent draws
        values.append(twice_kinetic(system, state_of(context)[1]) / GAS_CONSTANT / (6 * 27))
    error = np.std(values) / 20
    assert abs(np.mean(values) - 300) <= 3 * error
    # The variance of a chi-square distribution with g degrees of freedom.
    assert np.var(values) == pytest.approx(300**2 * 2 / (6 * 27), rel=0.3)
