"""Hydrogens of 1.5 to 3 dalton at 4 fs: the energy does not drift, and temperatures are those asked for."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from openmm import app
from openmm_systems import DATA, masses_of, residuals, started, state_of, total_energy

from kcons.openmm import Langevin, ProjectedIntegrator, RattleIntegrator

MASSES = (1.5, 3.0)
HELD = ("HBonds", "AllBonds")
heavy = pytest.mark.parametrize(("mass", "held"), [(m, h) for m in MASSES for h in HELD])


@cache
def prepared(mass, held):
    """Alanine dipeptide in implicit solvent near 300 K, after 2 ps of a thermostat; temperatures on the way."""
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    system = app.ForceField("amber14-all.xml", "implicit/obc2.xml").createSystem(
        pdb.topology, constraints=getattr(app, held), hydrogenMass=mass
    )
    integrator = ProjectedIntegrator(0.004, ensemble=Langevin(300, 20))
    integrator.setRandomNumberSeed(3)
    context = started(system, integrator, pdb.positions)
    integrator.minimizeEnergy(context, maxIterations=50)
    integrator.setVelocitiesToTemperature(context, 300, 1)
    integrator.step(250)
    temperatures = []
    for _ in range(250):
        integrator.step(10)
        temperatures.append(integrator.computeSystemTemperature()._value)
    return system, *state_of(context), np.array(temperatures)


def energies(integrator, mass, held, picoseconds):
    system, x, v, _ = prepared(mass, held)
    context = started(system, integrator, x, v)
    found = []
    steps = round(0.02 / integrator.getStepSize()._value)
    for _ in range(round(picoseconds / 0.02)):
        integrator.step(steps)
        found.append(total_energy(context))
    assert residuals(system, context)[0] < 1e-9
    return np.array(found)


@heavy
def test_masses_are_those_asked_for(mass, held):
    system = prepared(mass, held)[0]
    hydrogens = masses_of(system)[masses_of(system) < 4]
    assert len(hydrogens) == 12
    np.testing.assert_allclose(hydrogens, mass, rtol=1e-12)


@heavy
@pytest.mark.parametrize("kind", [ProjectedIntegrator, RattleIntegrator])
def test_energy_at_4_fs(mass, held, kind):
    """Off by the second power of the time step, and no drift beyond its error over 4 ps."""
    coarse, fine = (energies(kind(dt), mass, held, picoseconds=4) for dt in (0.004, 0.002))
    assert coarse.std() < 2.5 and 2.5 < coarse.std() / fine.std() < 6.5
    t = np.arange(len(coarse))
    slope, level = np.polyfit(t, coarse, 1)
    left = np.array([block.mean() for block in np.array_split(coarse - slope * t - level, 10)])
    middle = np.array([block.mean() for block in np.array_split(t, 10)])
    error = left.std(ddof=2) / np.sqrt(np.sum((middle - middle.mean()) ** 2))
    assert abs(slope) < 4 * error
