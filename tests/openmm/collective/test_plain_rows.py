"""Rows of Forces that are internal coordinates: the same as kcons' constraints, and brought to far targets alike."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm import app
from openmm_systems import DATA, started, state_of

from kcons import ConstraintSet
from kcons.constraints import Angle, CenterDistance, Dihedral, Distance
from kcons.errors import ConvergenceError, InfeasibleError
from kcons.openmm import CollectiveRows, ProjectedIntegrator, Row
from kcons.openmm.collective.plain_rows import as_constraint
from kcons.openmm.topology import bonds_of


def loose(constraints=None):
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    system = app.ForceField("amber14-all.xml").createSystem(pdb.topology, constraints=constraints)
    bonds = np.array([(b[0].index, b[1].index) for b in pdb.topology.bonds()])
    return system, np.array(pdb.getPositions(asNumpy=True)._value), bonds


def torsion(atoms, expression="theta"):
    force = openmm.CustomTorsionForce(expression)
    force.addTorsion(*atoms)
    return force


def bond(atoms, expression="r"):
    force = openmm.CustomBondForce(expression)
    force.addBond(*atoms)
    return force


def bend(atoms):
    force = openmm.CustomAngleForce("theta")
    force.addAngle(*atoms)
    return force


def points(expression, atoms):
    force = openmm.CustomCompoundBondForce(len(atoms), expression)
    force.addBond(atoms)
    return force


def centres(a, b, weights=()):
    force = openmm.CustomCentroidBondForce(2, "distance(g1,g2)")
    force.addGroup(a, weights)
    force.addGroup(b)
    force.addBond([0, 1])
    return force


def variable(force):
    outer = openmm.CustomCVForce("q")
    outer.addCollectiveVariable("q", force)
    return outer


@pytest.mark.parametrize(
    ("force", "kind"),
    [
        (bond((4, 14)), Distance),
        (bend((4, 6, 8)), Angle),
        (torsion((4, 6, 8, 14)), Dihedral),
        (points("distance(p1, p2)", (3, 9)), Distance),
        (points("angle(p1,p2,p3)", (3, 9, 12)), Angle),
        (points("dihedral(p1,p2,p3,p4)", (6, 8, 14, 16)), Dihedral),
        (centres([0, 1, 2], [14, 15, 16]), CenterDistance),
        (variable(torsion((4, 6, 8, 14))), Dihedral),
    ],
)
def test_the_constraint_measures_what_the_force_does(force, kind):
    system, x, _ = loose()
    rows = CollectiveRows(system, [Row(force, 0.5)])
    context = started(system, ProjectedIntegrator(1e-3, parts=[rows]), x)
    placed = next(f for f in system.getForces() if f.getForceGroup() in rows.groups)
    row = as_constraint(placed, 0.5)
    assert type(row) is kind
    held = ConstraintSet([row], x, [system.getParticleMass(k)._value for k in range(len(x))])
    off = held.residuals(x, None, 0.0).sigma[0]
    np.testing.assert_allclose(off, rows.at(context).sigma()[0] if kind is Dihedral else rows.values(context)[0] - 0.5)


@pytest.mark.parametrize(
    "force",
    [
        bond((4, 14), "r^2"),
        torsion((4, 6, 8, 14), "cos(theta)"),
        points("distance(p1,p2)-distance(p2,p3)", (3, 9, 12)),
        centres([0, 1, 2], [14, 15], (1.0, 2.0, 1.0)),
        variable(bond((4, 14), "sqrt(r)")),
        openmm.HarmonicBondForce(),
    ],
)
def test_others_are_no_plain_rows(force):
    assert as_constraint(force, 0.5) is None


def test_several_terms_are_no_plain_row():
    force = bond((4, 14))
    force.addBond(4, 16)
    assert as_constraint(force, 0.5) is None


@pytest.mark.parametrize("constraints", [None, app.HBonds, app.AllBonds])
def test_far_torsions_keep_bonds_and_angles(constraints):
    system, x, bonds = loose(constraints)
    names = [(4, 6, 8, 14), (6, 8, 14, 16)]
    targets = np.radians([-60.0, -45.0])
    rows = CollectiveRows(system, [Row(torsion(a), float(t)) for a, t in zip(names, targets, strict=True)])
    context = started(system, ProjectedIntegrator(1e-3, parts=[rows]), x)
    rows.restore(context)
    y = state_of(context)[0]
    np.testing.assert_allclose(rows.values(context), targets, atol=1e-11)
    lengths = [np.linalg.norm(r[bonds[:, 0]] - r[bonds[:, 1]], axis=1) for r in (x, y)]
    held = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    free = [k for k, pair in enumerate(map(set, bonds.tolist())) if all({i, j} != pair for i, j, _ in held)]
    assert np.abs(lengths[1] - lengths[0])[free].max(initial=0.0) < 0.002
    for i, j, d in held:
        assert abs(np.linalg.norm(y[i] - y[j]) / d._value - 1) < 1e-9


def test_a_target_out_of_reach_is_infeasible():
    """Two atoms of one bonded chain, farther apart than its bonds and angles let them."""
    system, x, _ = loose()
    rows = CollectiveRows(system, [Row(bond((4, 8)), 0.6)])
    context = started(system, ProjectedIntegrator(1e-3, parts=[rows]), x)
    with pytest.raises(InfeasibleError):
        rows.apply_positions(context)
    np.testing.assert_array_equal(state_of(context)[0], x)
    rows.apply_positions(context, bonds=[])  # whatever becomes of the bonds
    assert abs(rows.values(context)[0] - 0.6) < 1e-11


def test_a_network_of_springs_is_no_molecule():
    rng = np.random.default_rng(4)
    x = rng.uniform(size=(7, 3))
    system, force = openmm.System(), openmm.HarmonicBondForce()
    for i in range(7):
        system.addParticle(12.0)
        for j in range(i):
            force.addBond(i, j, float(np.linalg.norm(x[i] - x[j])), 1000.0)
    system.addForce(force)
    assert len(bonds_of(system, x)) == 0
    chain = openmm.System()
    springs = openmm.HarmonicBondForce()
    for i in range(7):
        chain.addParticle(12.0)
        if i:
            springs.addBond(i - 1, i, float(np.linalg.norm(x[i - 1] - x[i])), 1000.0)
    chain.addForce(springs)
    assert len(bonds_of(chain, x)) == 6


def test_rows_of_any_function_are_left_to_newton():
    system, x, _ = loose()
    rows = CollectiveRows(system, [Row(torsion((4, 6, 8, 14), "sin(theta)"), 0.4)])
    context = started(system, ProjectedIntegrator(1e-3, parts=[rows]), x)
    assert rows.apply_positions(context) > 0
    assert abs(rows.values(context)[0] - 0.4) < 1e-11
    with pytest.raises(ConvergenceError):
        CollectiveRows(system, [Row(torsion((6, 8, 14, 16), "sin(theta)"), 1.5)]).apply_positions(
            started(system, openmm.VerletIntegrator(1e-3), x)
        )
