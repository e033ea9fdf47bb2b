"""Rows measured at the state of a Context, against dense algebra on kcons' own constraints."""

import numpy as np
import openmm
import pytest
from collective_cases import CHAIN, FORCES, MASSES, bond, chain_system, context_of, held_chain, some_velocities
from openmm_systems import GPUS, started

from kcons.constraints import Angle, Dihedral, Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import SingularGeometryError
from kcons.openmm import ProjectedIntegrator, Row, positions_of
from kcons.openmm.collective import CollectiveRows
from kcons.openmm.collective.measured_rows import MeasuredRows, applied_groups, owner, variables_of

WEIGHTS = np.repeat(1.0 / np.array(MASSES), 3)
THREE = [Distance([0, 3]), Dihedral([0, 1, 2, 3]), Angle([2, 3, 4])]


def dense(rows):
    return ConstraintSet(rows, CHAIN, MASSES).jacobian(CHAIN).toarray()


def test_gradients_and_gram_matrix():
    context, _, part = held_chain(FORCES["three"]())
    rows = MeasuredRows(part, context)
    wanted = dense(THREE)
    gradients, directions, gram = rows.gram()
    np.testing.assert_allclose(gradients.reshape(3, -1), wanted, atol=1e-10)
    np.testing.assert_allclose(directions.reshape(3, -1), wanted * WEIGHTS, atol=1e-10)
    np.testing.assert_allclose(gram, (wanted * WEIGHTS) @ wanted.T, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(rows.slopes(), wanted @ rows.velocities.ravel(), atol=1e-10)
    assert rows.rank() == 3 and np.abs(rows.sigma()).max() < 1e-12
    assert np.array_equal(rows.masses, MASSES)


def test_directions_are_along_the_constraints_of_the_system():
    """M_par^+ A^T: what is left of M^-1 A^T beside the rows of the System, whose state stays what it was."""
    context, _, part = held_chain(FORCES["three"](), constrained=True)
    system = context.getSystem()
    pairs = [system.getConstraintParameters(k)[:2] for k in range(system.getNumConstraints())]
    held, rows = dense([Distance(pairs)]), MeasuredRows(part, context)
    before = rows.positions.copy(), rows.velocities.copy()
    a = rows.gradients().reshape(3, -1)
    pushed = a * WEIGHTS
    inner = (held * WEIGHTS) @ held.T
    wanted = pushed - (np.linalg.solve(inner, held @ pushed.T).T @ held) * WEIGHTS
    np.testing.assert_allclose(rows.directions(rows.gradients()).reshape(3, -1), wanted, atol=1e-9)
    after = MeasuredRows(part, context)
    assert np.array_equal(after.positions, before[0]) and np.array_equal(after.velocities, before[1])


def test_dependent_rows_are_counted_and_named():
    system = chain_system()
    part = CollectiveRows(system, [bond(0, 3), bond(1, 2), bond(3, 0)], positions=CHAIN)
    context = context_of(system, ProjectedIntegrator(0.001, parts=[part]), CHAIN, some_velocities())
    rows = MeasuredRows(part, context)
    assert rows.rank() == 2
    with pytest.raises(SingularGeometryError, match="row 2") as caught:
        rows.gram()
    assert caught.value.rows == (2,)


def test_the_integrator_that_holds_them():
    context, integrator, part = held_chain([bond(0, 3)])
    assert owner(part, context) is integrator
    assert {"x1", "kT"}.isdisjoint(variables_of(integrator)) and len(variables_of(integrator)) > 3
    assert applied_groups(part, context) == set(range(32)) - part.groups


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
        assert part.tolerance == MeasuredRows(part, context).finest
