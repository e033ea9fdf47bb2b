"""The solver for z against dense algebra with many digits to spare."""

from fractions import Fraction

import numpy as np
import pytest

from kcons.errors import ContradictionError
from kcons.models.growth import ConstrainedGrowth, GrowthModel, TotalPopulation, VelocityRow, orthogonal_rows


def exact(x, rows, right, drift):
    """Multipliers and z of (A G A^T) lambda = b - A drift, for two rows, without any rounding but the last."""
    X, D = ([Fraction(float(v)) for v in a] for a in (x, drift))
    A = [[Fraction(float(v)) for v in row] for row in rows]
    M = [[sum(xi * a * c for xi, a, c in zip(X, one, two, strict=True)) for two in A] for one in A]
    r = [Fraction(float(b)) - sum(a * d for a, d in zip(row, D, strict=True)) for row, b in zip(A, right, strict=True)]
    det = M[0][0] * M[1][1] - M[0][1] * M[1][0]
    multipliers = [(r[0] * M[1][1] - r[1] * M[0][1]) / det, (r[1] * M[0][0] - r[0] * M[1][0]) / det]
    z = [sum(k * row[i] for k, row in zip(multipliers, A, strict=True)) for i in range(len(X))]
    return np.array([float(k) for k in multipliers]), np.array([float(v) for v in z])


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_agrees_with_the_dense_formula(m):
    rng = np.random.default_rng(m)
    x, A, b, drift = rng.random(6) + 0.1, rng.normal(size=(m, 6)), rng.normal(size=m), rng.normal(size=6)
    found = orthogonal_rows.solve(x, list(A), list(b), drift)
    multipliers = np.linalg.solve(A * x @ A.T, b - A @ drift)
    assert found.multipliers == pytest.approx(multipliers, rel=1e-11)
    assert found.z == pytest.approx(A.T @ multipliers, rel=1e-11)
    assert pytest.approx(b, rel=1e-11) == A @ (drift + x * found.z)


def test_side_by_side_is_one_by_one():
    rng = np.random.default_rng(5)
    x, drift = rng.random((5, 7)) + 0.1, rng.normal(size=(5, 7))
    rows = [rng.normal(size=(5, 7)) for _ in range(3)]
    right = [rng.normal(size=7), 0.5, rng.normal(size=7)]
    together = orthogonal_rows.solve(x, rows, right, drift)
    for k in range(7):
        single = orthogonal_rows.solve(
            x[:, k], [r[:, k] for r in rows], [np.broadcast_to(b, 7)[k] for b in right], drift[:, k]
        )
        assert together.z[:, k] == pytest.approx(single.z, rel=1e-14)
        assert together.multipliers[:, k] == pytest.approx(single.multipliers, rel=1e-13)


def test_nearly_dependent_rows_keep_their_accuracy():
    # Rows 1 and 1 + d: the determinant is the variance of d, 1e-18; A G A^T would have nothing left of it.
    d = 1e-9 * np.array([1.0, -2.0, 0.5])
    x, drift = np.array([0.2, 0.3, 0.5]), np.array([0.1, 0.2, -0.3])
    rate = 1e-10
    found = orthogonal_rows.solve(x, [np.ones(3), d], [0.0, rate], drift)
    assert not found.dependent.any()
    velocity = drift + x * found.z
    assert abs(velocity.sum()) < 1e-15
    assert d @ velocity == pytest.approx(rate, rel=1e-13)


def test_dependent_rows():
    x, drift = np.array([0.2, 0.3, 0.5]), np.array([0.1, 0.2, -0.3])
    once = orthogonal_rows.solve(x, [np.ones(3)], [0.4], drift)
    agreeing = orthogonal_rows.solve(x, [np.ones(3), 2 * np.ones(3)], [0.4, 0.8], drift)
    assert agreeing.dependent.tolist() == [False, True]
    assert agreeing.z == pytest.approx(once.z, rel=1e-15)
    assert agreeing.contradiction.max() < 1e-14
    against = orthogonal_rows.solve(x, [np.ones(3), 2 * np.ones(3)], [0.4, 0.9], drift)
    assert against.contradiction[1] > 0.01


def test_extinct_species_do_not_count():
    # x underflows to 0 while its row entry is -1e5, as that of a chemical potential does.
    x, drift = np.array([0.4, 0.6, 0.0]), np.array([0.1, -0.2, 0.0])
    found = orthogonal_rows.solve(x, [np.ones(3), np.array([1.0, 2.0, -1e5])], [0.0, 0.0], drift)
    assert drift[:2] + x[:2] * found.z[:2] == pytest.approx([0.0, 0.0], abs=1e-16)
    assert np.isfinite(found.z[2])


@pytest.mark.parametrize("apart", [1e-3, 1e-6, 1e-9])
def test_nearly_parallel_rows_stay_orthogonal(apart):
    # Once orthogonalised, a row that is parallel to another but for `apart` keeps 1e-16/apart of it: the velocity would
    # be off the first row by that much. Exact arithmetic says what z is; its relative error is the condition, 1/apart.
    rng = np.random.default_rng(3)
    x, drift = rng.random(6) + 0.1, rng.normal(size=6)
    rows = [np.ones(6), np.ones(6) + apart * rng.normal(size=6)]
    right = [0.3, 0.3 + apart * 0.7]
    found = orthogonal_rows.solve(x, rows, right, drift)
    multipliers, z = exact(x, rows, right, drift)
    velocity = drift + x * found.z
    # Sums of six terms, each rounded: six half units in the last place of what is summed, and one for the terms.
    rounding = 4 * np.finfo(float).eps * (np.abs(drift) + np.abs(x * found.z)).sum()
    assert abs(velocity.sum() - right[0]) < rounding
    assert abs(rows[1] @ velocity - right[1]) < rounding
    assert found.z == pytest.approx(z, abs=1e-15 / apart * abs(z).max())
    assert found.multipliers == pytest.approx(multipliers, rel=2e-15 / apart)


@pytest.mark.parametrize(("apart", "dependent"), [(4e-12, False), (2.5e-13, True)])
def test_rows_count_as_dependent_below_a_part_in_a_million_million(apart, dependent):
    x, drift = np.full(4, 0.25), np.array([0.1, 0.2, -0.3, 0.4])
    # The length of the second row across the first is `apart` of its own.
    rows = [np.ones(4), np.ones(4) + apart * np.array([1.0, -1.0, 1.0, -1.0])]
    found = orthogonal_rows.solve(x, rows, [0.4, 0.4], drift)
    assert found.dependent.tolist() == [False, dependent]


@pytest.mark.parametrize(("off", "refused"), [(4e-10, False), (2.5e-9, True)])
def test_dependent_rows_may_disagree_by_a_part_in_a_thousand_million(off, refused):
    model = GrowthModel(lambda t, x: 0.0 * x, n=2)
    x = np.array([0.5, 0.5])
    system = ConstrainedGrowth(model, [TotalPopulation(2, lambda t: (1.0, 1.0)), VelocityRow([1.0, 1.0], 1.0 + off)])
    if refused:
        with pytest.raises(ContradictionError, match="row 1") as caught:
            system.velocity(0.0, x)
        assert caught.value.rows == (1,)
    else:
        assert system.velocity(0.0, x) == pytest.approx([0.5, 0.5], rel=1e-14)
