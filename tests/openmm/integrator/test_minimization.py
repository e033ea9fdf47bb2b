"""Minimization with constraints kept."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm import app, unit
from openmm_systems import (
    DATA,
    PLATFORMS,
    alanine,
    forces_at,
    holding,
    loose_alanine,
    masses_of,
    potential_energy,
    residuals,
    started,
    state_of,
)

from kcons.openmm import ProjectedIntegrator

platforms = pytest.mark.parametrize("platform", PLATFORMS)


# -- minimization -----------------------------------------------------------------------------------


@platforms
def test_minimizer_of_openmm_keeps_the_constraints(platform):
    system, _, _ = alanine()
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    made = app.Simulation(
        pdb.topology, system, integrator := ProjectedIntegrator(1e-3), openmm.Platform.getPlatformByName(platform)
    )
    made.context.setPositions(pdb.positions)
    made.minimizeEnergy()
    made.step(1)
    assert residuals(system, made.context)[0] < 1e-9
    integrator.minimizeEnergy(tolerance=1.0)
    assert residuals(system, made.context)[0] < 1e-9


def test_minimizer_keeps_parts():
    """The lowest energy on the constraints: forces along them vanish, and it lies above the free minimum."""
    system, x, v = loose_alanine()
    integrator = ProjectedIntegrator(1e-3, parts=[holding()], tolerance=1e-12)
    context = started(system, integrator, x, v)
    before = potential_energy(context)
    integrator.minimizeEnergy(context, tolerance=1.0)
    now, speed = state_of(context)
    np.testing.assert_array_equal(speed, v)
    assert abs(now[0, 2] - x[0, 2]) < 1e-12
    assert residuals(system, context)[0] < 1e-11
    assert potential_energy(context) < before - 15
    context.setVelocities(forces_at(context) / masses_of(system)[:, None])
    integrator.applyVelocityConstraints(context)
    left = masses_of(system)[:, None] * state_of(context)[1]
    assert np.sqrt(np.mean(left**2)) <= 1.0
    assert context.getStepCount() == 0
    held = potential_energy(context)
    free = ProjectedIntegrator(1e-3, tolerance=1e-12)
    other = started(system, free, now)
    free.minimizeEnergy(other, tolerance=1.0 * unit.kilojoule_per_mole / unit.nanometer)
    assert potential_energy(other) <= held + 1e-3
    integrator.step(5)
