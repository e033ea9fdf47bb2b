"""Systems with collective rows."""

from __future__ import annotations

import itertools

import numpy as np
import openmm
from openmm import app, unit
from openmm_systems import DATA, particles, started

from kcons.openmm import CollectiveRows, ProjectedIntegrator

#: A bent chain with a branch: no three atoms in a line.
CHAIN = np.array(
    [[0.0, 0, 0], [0.14, 0.03, 0], [0.2, 0.15, 0.02], [0.1, 0.22, 0.1], [0.0, 0.2, 0.2], [0.08, 0.3, 0.25]]
)
MASSES = np.arange(1.0, 7.0)
PHI = (4, 6, 8, 14)
PSI = (6, 8, 14, 16)


STIFFNESS = 3000.0


def springs():
    force = openmm.HarmonicBondForce()
    for i, j in itertools.combinations(range(6), 2):
        force.addBond(i, j, float(np.linalg.norm(CHAIN[i] - CHAIN[j])) * 1.03, STIFFNESS)
    return force


def spring_forces(x, t=0.0):
    f = np.zeros_like(x)
    for i, j in itertools.combinations(range(6), 2):
        d = x[j] - x[i]
        r = np.linalg.norm(d)
        pull = STIFFNESS * (r - 1.03 * np.linalg.norm(CHAIN[i] - CHAIN[j])) * d / r
        f[i] += pull
        f[j] -= pull
    return f


def chain_system():
    return particles(MASSES, springs())


def energy_of(context, integrator):
    state = context.getState(energy=True, groups=integrator.getIntegrationForceGroups())
    return (state.getPotentialEnergy() + state.getKineticEnergy())._value


def some_velocities(scale=1.0, seed=1):
    return scale * np.random.default_rng(seed).normal(size=CHAIN.shape)


def bond(i, j, expression="r"):
    force = openmm.CustomBondForce(expression)
    force.addBond(i, j)
    return force


def angle(i, j, k):
    force = openmm.CustomAngleForce("theta")
    force.addAngle(i, j, k)
    return force


def dihedral(*atoms, expression="theta"):
    force = openmm.CustomTorsionForce(expression)
    force.addTorsion(*atoms)
    return force


def points(expression, atoms):
    force = openmm.CustomCompoundBondForce(len(atoms), expression)
    force.addBond(list(atoms))
    return force


def centers(a, b, weights=()):
    force = openmm.CustomCentroidBondForce(2, "distance(g1, g2)")
    force.addGroup(list(a), weights)
    force.addGroup(list(b))
    force.addBond([0, 1])
    return force


def with_variable(expression, **variables):
    force = openmm.CustomCVForce(expression)
    for name, variable in variables.items():
        force.addCollectiveVariable(name, variable)
    return force


def rmsd():
    reference = CHAIN + 0.02 * np.random.default_rng(5).normal(size=CHAIN.shape)
    return openmm.RMSDForce(reference, [0, 1, 2, 3, 4])


FORCES = {
    "bond": lambda: [bond(0, 3)],
    "angle": lambda: [angle(1, 2, 4)],
    "dihedral": lambda: [dihedral(0, 1, 2, 3)],
    "centers": lambda: [centers([0, 1], [3, 4, 5])],
    "gyration": lambda: [openmm.RGForce([0, 1, 2, 3, 4])],
    "rmsd": lambda: [rmsd()],
    "cosine": lambda: [points("cos(angle(p1, p2, p3))", (0, 2, 5))],
    "harmonic": lambda: [_harmonic(1, 5)],
    "variable": lambda: [with_variable("0.1*a + d^2", a=angle(0, 1, 2), d=bond(2, 5))],
    "three": lambda: [bond(0, 3), dihedral(0, 1, 2, 3), angle(2, 3, 4)],
}


def _harmonic(i, j):
    force = openmm.HarmonicBondForce()
    force.addBond(i, j, 0.1, 50.0)
    return force


def held_chain(rows, scheme="rattle", dt=0.002, platform="Reference", constrained=False, ensemble=None, **options):
    """The chain with rows, restored; (context, integrator, part)."""
    system = chain_system()
    if constrained:
        system.addConstraint(0, 1, float(np.linalg.norm(CHAIN[0] - CHAIN[1])))
        system.addConstraint(2, 3, float(np.linalg.norm(CHAIN[2] - CHAIN[3])))
    part = CollectiveRows(system, rows, positions=CHAIN, **options)
    integrator = ProjectedIntegrator(dt, scheme, parts=[part], tolerance=1e-13, ensemble=ensemble)
    context = started(system, integrator, CHAIN, some_velocities(), platform)
    part.restore(context)
    return context, integrator, part


def dipeptide(constraints=app.AllBonds, platform="Reference", scheme="rattle", dt=0.001):
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    field = app.ForceField("amber14-all.xml")
    system = field.createSystem(pdb.topology, constraints=constraints, removeCMMotion=False)
    positions = np.array(pdb.positions.value_in_unit(unit.nanometer))
    part = CollectiveRows(system, [dihedral(*PHI), dihedral(*PSI)], positions=positions)
    integrator = ProjectedIntegrator(dt, scheme, parts=[part], tolerance=1e-14)
    context = started(system, integrator, positions, platform=platform)
    context.applyConstraints(1e-14)
    context.setVelocitiesToTemperature(300, 1)
    part.restore(context)
    return context, integrator, part


def peptide(constraints=None):
    """Alanine dipeptide, its positions and its bonds."""
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    system = app.ForceField("amber14-all.xml").createSystem(pdb.topology, constraints=constraints)
    bonds = np.array([(b[0].index, b[1].index) for b in pdb.topology.bonds()])
    return system, np.array(pdb.getPositions(asNumpy=True)._value), bonds
