"""Condition numbers of clusters, dense and sparse, against the singular values of the whole matrix."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import condition
from kcons.motion.condition import worst_condition

WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])


def dense(whole: ConstraintSet, x: np.ndarray, inverse_masses: np.ndarray, rows: np.ndarray) -> float:
    B = whole.jacobian(x).toarray()[rows] * np.repeat(np.sqrt(inverse_masses), 3)
    s = np.linalg.svd(B / np.linalg.norm(B, axis=1)[:, None], compute_uv=False)
    return float(s[0] / s[s > 1e-9 * s[0]][-1])


def chain(n: int) -> tuple[ConstraintSet, np.ndarray]:
    rng = np.random.default_rng(n)
    k = np.arange(n)
    x = np.stack([0.99 * k, 0.01 * (k % 2), 0.005 * rng.normal(size=n)], axis=1)
    return ConstraintSet(held.Distance(np.stack([k[:-1], k[1:]], axis=1)), x, np.full(n, 7.0)), x


@pytest.mark.parametrize("n", [2, 30, condition.DENSE_ROWS + 1, condition.DENSE_ROWS + 2, 900])
def test_one_cluster(n: int) -> None:
    """Straight-ish chains, whose condition grows with their length: the dense and the sparse way."""
    whole, x = chain(n)
    w, rows = 1 / whole.masses, np.arange(n - 1)
    found = worst_condition(whole.jacobian(x), w, rows, np.zeros(n - 1, int), deficiency=0)
    assert found == pytest.approx(dense(whole, x, w, rows), rel=1e-6 if n - 1 <= condition.DENSE_ROWS else 1e-3)
    assert found > min(0.2 * n, 50)


def test_worst_of_many_clusters_of_several_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    x = np.concatenate([WATER + 5 * k + 0.3 * rng.normal(size=(3, 3)) for k in range(20)])
    pairs = [(3 * k + i, 3 * k + j) for k in range(20) for i, j in list(combinations(range(3), 2))[: 2 + k % 2]]
    order = rng.permutation(len(pairs))
    pairs = np.array(pairs)[order]
    whole = ConstraintSet(held.Distance(pairs), x, rng.uniform(1, 20, 60))
    labels = pairs[:, 0] // 3
    w = 1 / whole.masses
    w[6] = 0.0  # a fixed atom
    expected = max(dense(whole, x, w, np.flatnonzero(labels == k)) for k in range(20))
    found = worst_condition(whole.jacobian(x), w, np.arange(len(pairs)), labels, deficiency=0)
    assert found == pytest.approx(expected, rel=1e-9)
    # Portions of one cluster each give the same.
    monkeypatch.setattr(condition, "PORTION", 1)
    again = worst_condition(whole.jacobian(x), w, np.arange(len(pairs)), labels, deficiency=0)
    assert again == found
    some = np.flatnonzero(labels == 3)
    one = worst_condition(whole.jacobian(x), w, some, labels, deficiency=0)
    assert one == pytest.approx(dense(whole, x, w, some), rel=1e-9)


def test_dependent_rows_do_not_count() -> None:
    x = np.vstack([WATER, [[0.1, 0.2, 1.0]], [[0.3, 0.4, -1.2]]])
    pairs = np.array(list(combinations(range(5), 2)))
    whole = ConstraintSet(held.Distance(pairs), x, np.ones(5))
    found = worst_condition(whole.jacobian(x), np.ones(5), np.arange(10), np.zeros(10, int), deficiency=1)
    assert found == pytest.approx(dense(whole, x, np.ones(5), np.arange(10)), rel=1e-9)
    assert found < 100


def test_out_of_reach_is_not_a_number() -> None:
    n = condition.DENSE_DEPENDENT_ROWS + 3
    whole, x = chain(n)
    labels = np.zeros(n - 1, int)
    assert np.isnan(worst_condition(whole.jacobian(x), 1 / whole.masses, np.arange(n - 1), labels, deficiency=1))
    # A gradient of zero has no direction.
    two = ConstraintSet(held.Distance([0, 1]), WATER[:2], np.ones(2))
    jacobian = two.jacobian(WATER[:2])
    jacobian.data[:] = 0.0
    assert np.isnan(worst_condition(jacobian, np.ones(2), np.arange(1), np.zeros(1, int), deficiency=0))
