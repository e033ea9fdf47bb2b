"""Rows at the state of a Context: measured against dense algebra, brought onto their targets, checked."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from collective_cases import (
    CHAIN,
    FORCES,
    MASSES,
    angle,
    bond,
    chain_system,
    dihedral,
    held_chain,
    peptide,
    points,
    some_velocities,
)
from openmm import app
from openmm_systems import GPUS, started, state_of

from kcons import ConstraintSet
from kcons.constraints import Angle, Dihedral, Distance
from kcons.constraints.projection import project_velocities
from kcons.errors import ConstraintError, ConvergenceError, InfeasibleError, SingularGeometryError, UnsupportedError
from kcons.openmm import CollectiveRows, ProjectedIntegrator, Row, positions_of, velocities_of

THREE = [Distance([0, 3]), Dihedral([0, 1, 2, 3]), Angle([2, 3, 4])]


def test_gradients_and_rates():
    context, _, part = held_chain(FORCES["three"]())
    wanted = ConstraintSet(THREE, CHAIN, MASSES).jacobian(CHAIN).toarray()
    np.testing.assert_allclose(part.gradients(context).reshape(3, -1), wanted, atol=1e-10)
    np.testing.assert_allclose(part.rates(context), wanted @ velocities_of(context).ravel(), atol=1e-10)
    assert part.rank(context) == 3 and np.abs(part.residuals(context)).max() < 1e-12


@pytest.mark.parametrize("platform", ["Reference", *(p for p in GPUS if "mixed" in str(p.id))])
def test_an_angle_is_held_far_from_the_origin_of_a_wide_box(platform):
    """Forces in single precision see coordinates of 7 nm to 5e-7 nm, whatever the State has: there is a floor."""
    system = openmm.System()
    system.setDefaultPeriodicBoxVectors(*(8.0 * np.eye(3)))
    bonds, nonbonded = openmm.HarmonicBondForce(), openmm.NonbondedForce()
    nonbonded.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    for _ in range(3):
        system.addParticle(12.0)
        nonbonded.addParticle(0.0, 0.3, 0.0)
    for j in (0, 2):
        bonds.addBond(1, j, 0.1, 1e5)
    system.addForce(bonds)
    system.addForce(nonbonded)
    angle = openmm.CustomAngleForce("theta")
    angle.addAngle(0, 1, 2, [])
    x = np.array([7.1, 7.2, 7.3]) + 0.1 * np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    part = CollectiveRows(system, [Row(angle, np.pi / 2)])
    integrator = ProjectedIntegrator(0.001, parts=[part])
    context = started(system, integrator, x, platform=platform)
    part.restore(context)  # before the first step
    context.setVelocities(np.random.default_rng(1).normal(size=(3, 3)))
    part.apply_velocities(context)
    integrator.step(300)
    u, v = (positions_of(context)[j] - positions_of(context)[1] for j in (0, 2))
    off = abs(np.arccos(u @ v / np.linalg.norm(u) / np.linalg.norm(v)) - np.pi / 2)
    if platform == "Reference":
        assert off < 1e-12 and part.tolerance == 1e-13
    else:
        assert off < 3e-5 and 2e-6 < part.tolerance < 2e-5
        assert part.tolerance == part.finest(context)


def test_dependent_rows_are_named():
    context, integrator, part = _held_without_check([bond(0, 3), Row(bond(0, 3), name="again")])
    assert part.rank(context) == 1
    with pytest.raises(SingularGeometryError, match="row 1 \\(again\\)") as caught:
        part.check(context)
    assert caught.value.rows == (1,)
    with pytest.raises(SingularGeometryError, match="again"):
        integrator.step(1)


def test_row_that_repeats_a_constraint_of_the_system_is_named():
    context, integrator, part = _held_without_check([bond(1, 2), bond(0, 1)], constrained=True)
    assert part.rank(context) == 1
    with pytest.raises(SingularGeometryError, match="row 1"):
        part.check(context)
    with pytest.raises(SingularGeometryError, match="row 1"):
        integrator.step(1)


def _held_without_check(rows, constrained=False):
    system = chain_system()
    if constrained:
        system.addConstraint(0, 1, float(np.linalg.norm(CHAIN[0] - CHAIN[1])))
    part = CollectiveRows(system, rows, positions=CHAIN)
    integrator = ProjectedIntegrator(0.001, parts=[part], tolerance=1e-13)
    return started(system, integrator, CHAIN, some_velocities()), integrator, part


def test_functions_that_cannot_be_copied_are_refused():
    context, _, part = _held_without_check([Row(openmm.PythonForce(lambda state: (0.0, 0.0 * CHAIN)), 0.3)])
    with pytest.raises(UnsupportedError, match="Define the function in a module"):
        part.restore(context)


def test_row_without_gradient_is_named():
    context, integrator, part = _held_without_check([openmm.RMSDForce(CHAIN, list(range(6)))])
    with pytest.raises((SingularGeometryError, ConstraintError), match="row 0"):
        part.check(context)
    with pytest.raises((SingularGeometryError, ConstraintError), match="row 0"):
        integrator.step(1)


def test_a_start_off_the_rows_is_refused_and_can_be_restored():
    system = chain_system()
    part = CollectiveRows(system, [Row(bond(0, 3), 0.3)])
    integrator = ProjectedIntegrator(0.002, parts=[part])
    context = started(system, integrator, CHAIN, some_velocities())
    with pytest.raises(ConstraintError, match="restore"):
        integrator.step(1)
    v = state_of(context)[1]
    part.apply_positions(context)
    assert np.array_equal(state_of(context)[1], v)
    part.apply_velocities(context)
    part.check(context)
    integrator.step(10)
    assert np.abs(part.residuals(context)).max() <= 1e-12


def test_positions_that_cannot_be_restored_stay():
    system = chain_system()
    part = CollectiveRows(system, [Row(points("cos(angle(p1, p2, p3))", (0, 2, 5)), 1.5, name="impossible")])
    integrator = ProjectedIntegrator(0.002, parts=[part])
    context = started(system, integrator, CHAIN, some_velocities())
    x, v = state_of(context)
    with pytest.raises((ConvergenceError, SingularGeometryError), match="impossible"):
        part.apply_positions(context)
    assert np.array_equal(state_of(context)[0], x)
    assert np.array_equal(state_of(context)[1], v)


@pytest.mark.parametrize("constrained", [False, True])
def test_velocity_projection_is_the_nearest_in_the_mass_metric(constrained):
    context, _, part = held_chain([bond(0, 3), angle(2, 3, 4)], constrained=constrained)
    v = some_velocities(seed=9)
    context.setVelocities(v)
    part.apply_velocities(context)
    held = [Distance([0, 3]), Angle([2, 3, 4]), *[Distance([[0, 1], [2, 3]])] * constrained]
    A = ConstraintSet(held, CHAIN, MASSES).jacobian(CHAIN).toarray()
    assert state_of(context)[1] == pytest.approx(project_velocities(A, MASSES, v), abs=1e-12)


@pytest.mark.parametrize("constraints", [None, app.HBonds, app.AllBonds])
def test_far_torsions_keep_bonds_and_angles(constraints):
    system, x, bonds = peptide(constraints)
    names = [(4, 6, 8, 14), (6, 8, 14, 16)]
    targets = np.radians([-60.0, -45.0])
    rows = CollectiveRows(system, [Row(dihedral(*a), float(t)) for a, t in zip(names, targets, strict=True)])
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
    system, x, _ = peptide()
    rows = CollectiveRows(system, [Row(bond(4, 8), 0.6)])
    context = started(system, ProjectedIntegrator(1e-3, parts=[rows]), x)
    with pytest.raises(InfeasibleError):
        rows.apply_positions(context)
    np.testing.assert_array_equal(state_of(context)[0], x)


def _sine(*atoms):
    force = openmm.CustomTorsionForce("sin(theta)")
    force.addTorsion(*atoms)
    return force


def test_rows_of_any_function_are_left_to_newton():
    system, x, _ = peptide()
    rows = CollectiveRows(system, [Row(_sine(4, 6, 8, 14), 0.4)])
    context = started(system, ProjectedIntegrator(1e-3, parts=[rows]), x)
    rows.apply_positions(context)
    assert abs(rows.values(context)[0] - 0.4) < 1e-11
    with pytest.raises(ConvergenceError):
        CollectiveRows(system, [Row(_sine(6, 8, 14, 16), 1.5)]).apply_positions(
            started(system, openmm.VerletIntegrator(1e-3), x)
        )
