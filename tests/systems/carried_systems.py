"""Systems with rows that are carried through OpenMM."""

from __future__ import annotations

import numpy as np
from openmm import app
from openmm_systems import DATA, context_of, particles, started, state_of

from kcons.constraints import Dihedral, Distance
from kcons.openmm import ProjectedIntegrator, hold

PEPTIDE_FILE = DATA / "alanine-dipeptide-implicit.pdb"
PEPTIDE = app.PDBFile(str(PEPTIDE_FILE))
PSI = [[6, 8, 14, 16]]


def start(context, part, x, temperature=300, seed=1):
    context.setPositions(x)
    part.apply_positions(context)
    context.setVelocitiesToTemperature(temperature, seed)
    part.apply_velocities(context)
    part.check(context)


def peptide(rows=True, scheme="rattle", dt=0.001, platform="Reference", constraints=app.AllBonds):
    """Alanine dipeptide with all bonds, and a dihedral, carried."""
    system = app.ForceField("amber14-all.xml").createSystem(
        PEPTIDE.topology, constraints=constraints, rigidWater=False, removeCMMotion=False
    )
    part = hold(system, [Dihedral(PSI)] if rows else [], PEPTIDE.positions, take="all")
    integrator = ProjectedIntegrator(dt, scheme, parts=[part])
    context = context_of(system, integrator, platform)
    start(context, part, PEPTIDE.positions)
    return part, integrator, context


def _longer(t):
    return 0.3 + 0.05 * t


def driven():
    """Two particles, a distance that grows."""
    x = np.array([[0.0, 0, 0], [0.3, 0, 0]])
    system = particles([12.0, 12.0])
    return system, hold(system, Distance([[0, 1]], _longer), x), x


def begun(system, part, x, **options):
    integrator = ProjectedIntegrator(0.01, parts=[part], **options)
    context = started(system, integrator, x)
    integrator.applyVelocityConstraints(context)
    return integrator, context


def off_target(context):
    x = state_of(context)[0]
    return abs(np.linalg.norm(x[0] - x[1]) - _longer(context.getTime()._value))
