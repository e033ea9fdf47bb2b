"""Drude particles are refused by everything that kicks, before anything moves."""

from __future__ import annotations

from functools import cache

import numpy as np
import openmm
import pytest
from openmm import app
from openmm_ensembles import ENSEMBLES
from openmm_systems import started, state_of

from kcons.errors import UnsupportedError
from kcons.openmm import ProjectedIntegrator


@cache
def drude():
    """Two molecules of SWM4-NDP water: a Drude particle and a virtual site each."""
    field = app.ForceField("swm4ndp.xml")
    box = app.Modeller(app.Topology(), [])
    box.addSolvent(field, model="swm4ndp", boxSize=openmm.Vec3(1.9, 1.9, 1.9))
    box.delete(list(box.topology.residues())[2:])
    return field.createSystem(box.topology, removeCMMotion=False), box.positions


def refused(integrator, step, platform="Reference"):
    system, positions = drude()
    context = started(system, integrator, positions)
    before = state_of(context)
    with pytest.raises(UnsupportedError, match=r"DrudeForce.*DrudeLangevinIntegrator.*DrudeSCFIntegrator"):
        step(context)
    np.testing.assert_array_equal(state_of(context), before)
    assert context.getStepCount() == 0


@pytest.mark.parametrize("name", [None, *ENSEMBLES])
def test_drude_particles_are_refused(name):
    integrator = ProjectedIntegrator(0.0005, ensemble=ENSEMBLES[name](300) if name else None)
    refused(integrator, lambda context: integrator.step(1))
    if name is None:
        compound, ours = openmm.CompoundIntegrator(), ProjectedIntegrator(0.0005)
        refused(ours, lambda context: ours.setVelocitiesToTemperature(context, 300))
        compound.addIntegrator(ours := ProjectedIntegrator(0.0005))
        refused(compound, lambda context: ours.check(context))
