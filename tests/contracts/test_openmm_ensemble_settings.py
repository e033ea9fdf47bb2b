"""Ensembles in OpenMM and targets that move."""

import numpy as np
import pytest
from openmm import unit
from openmm_systems import context_of, dumbbell, state_of

from kcons.constraints import Distance
from kcons.errors import UnsupportedError
from kcons.openmm import Isokinetic, Langevin, ProjectedIntegrator, hold

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")


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
