"""Rows measured at the state of a Context, against dense algebra on kcons' own constraints."""

import numpy as np
import pytest
from collective_cases import CHAIN, FORCES, MASSES, bond, chain_system, context_of, held_chain, some_velocities

from kcons.constraints import Angle, Dihedral, Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import SingularGeometryError
from kcons.openmm import ProjectedIntegrator
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
