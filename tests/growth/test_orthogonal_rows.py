"""The solver for z against dense algebra with many digits to spare."""

import numpy as np
import pytest

from kcons.growth import orthogonal_rows


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
