"""The report on a set, and the condition numbers in it against singular values of the whole matrix."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion
from kcons.motion import report as reports
from kcons.motion.report import worst_condition

WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])
TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
METHANE = np.vstack([np.zeros(3), 0.629 * TETRAHEDRON])
TRIANGLE = list(combinations(range(3), 2))


def mixed_system(extra: int = 0) -> tuple[Motion, np.ndarray]:
    """Water, methane by ten distances, an angle with its bonds, a radius of gyration; atoms from `extra` on."""
    x = np.vstack([WATER, METHANE + 5, 1.1 * WATER - 5, WATER[:, ::-1] + 9])
    rows = [
        held.Distance(TRIANGLE),
        held.Distance([(3 + i, 3 + j) for i, j in combinations(range(5), 2)]),
        held.Distance([(8, 9), (8, 10)]),
        held.Angle([(9, 8, 10)]),
        held.RadiusOfGyration([[11, 12, 13]]),
    ]
    numbers = np.arange(len(x)) + extra
    rows = [c.renumbered(numbers) for c in rows]
    whole = np.vstack([np.arange(3.0 * extra).reshape(extra, 3) + 50, x])
    masses = np.concatenate([np.ones(extra), [16.0, 1, 1], [12.0, 1, 1, 1, 1], [16.0, 1, 1], [3.0, 4, 5]])
    return Motion(ConstraintSet(rows, whole, masses), whole), whole


@pytest.mark.parametrize("extra", [0, 100])
def test_report_says_it_all(extra: int) -> None:
    motion, x = mixed_system(extra)
    whole = motion.constraint_set
    v = np.random.default_rng(0).normal(size=x.shape)
    report = motion.report(x, v)
    assert (report.rows, report.rank, report.degrees_of_freedom) == (17, 16, 3 * len(x) - 16)
    assert [(k.solver, k.clusters, k.rows, k.rank) for k in report.kinds] == [
        ("RigidTriangles", 1, 3, 3),
        ("SparseDistances", 1, 10, 9),
        ("SingleRows", 1, 1, 1),
        ("SparseRows", 1, 3, 3),
    ]
    A = whole.jacobian(x).toarray()
    for kind, rows in zip(report.kinds, (range(3), range(3, 13), [16], range(13, 16)), strict=True):
        B = A[list(rows)] / np.sqrt(np.repeat(whole.masses, 3))
        s = np.linalg.svd(B / np.linalg.norm(B, axis=1)[:, None], compute_uv=False)
        assert kind.condition == pytest.approx(s[0] / s[s > 1e-9][-1], rel=1e-9)
        assert whole.row_name(rows[0]) == kind.example
    assert report.condition == max(k.condition for k in report.kinds)
    unit = A / np.linalg.norm(A, axis=1)[:, None]
    assert report.velocity_residual == pytest.approx(np.abs(unit @ v.ravel()).max(), rel=1e-12)
    assert report.iterations == 0 and all(k.iterations == 0 for k in report.kinds)
    text = str(report)
    for kind in report.kinds:
        assert kind.solver in text and kind.example in text and f"{kind.condition:.3g}" in text
    assert "rows 17, rank 16" in text and "condition" in text and "iterations" in text
    assert f"degrees of freedom {report.degrees_of_freedom}" in text


def test_the_worst_row_is_named_and_the_condition_is_found_where_it_is_asked_for() -> None:
    motion, x = mixed_system()
    off = x.copy()
    off[9] += 0.3
    report = motion.report(off, condition=False)
    assert report.worst_row in ("#13 Distance(8, 9)", "#15 Angle(9, 8, 10)")
    assert report.residual == np.abs(motion.constraint_set.value(off)).max()
    assert np.isnan([report.condition, report.velocity_residual, *(k.condition for k in report.kinds)]).all()
    assert report.worst_row in str(report) and " - " in str(report) and "nan" not in str(report)


# -- condition ------------------------------------------------------------------------------------------


def dense(whole: ConstraintSet, x: np.ndarray, inverse_masses: np.ndarray, rows: np.ndarray) -> float:
    B = whole.jacobian(x).toarray()[rows] * np.repeat(np.sqrt(inverse_masses), 3)
    s = np.linalg.svd(B / np.linalg.norm(B, axis=1)[:, None], compute_uv=False)
    return float(s[0] / s[s > 1e-9 * s[0]][-1])


def chain(n: int) -> tuple[ConstraintSet, np.ndarray]:
    rng = np.random.default_rng(n)
    k = np.arange(n)
    x = np.stack([0.99 * k, 0.01 * (k % 2), 0.005 * rng.normal(size=n)], axis=1)
    return ConstraintSet(held.Distance(np.stack([k[:-1], k[1:]], axis=1)), x, np.full(n, 7.0)), x


@pytest.mark.parametrize("n", [2, 30, reports.DENSE_ROWS + 1, reports.DENSE_ROWS + 2, 900])
def test_one_cluster(n: int) -> None:
    """Straight-ish chains, whose condition grows with their length: the dense and the sparse way."""
    whole, x = chain(n)
    w, rows = 1 / whole.masses, np.arange(n - 1)
    found = worst_condition(whole.jacobian(x), w, rows, np.zeros(n - 1, int), deficiency=0)
    assert found == pytest.approx(dense(whole, x, w, rows), rel=1e-6 if n - 1 <= reports.DENSE_ROWS else 1e-3)
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
    monkeypatch.setattr(reports, "PORTION", 1)
    again = worst_condition(whole.jacobian(x), w, np.arange(len(pairs)), labels, deficiency=0)
    assert again == found
    some = np.flatnonzero(labels == 3)
    one = worst_condition(whole.jacobian(x), w, some, labels, deficiency=0)
    assert one == pytest.approx(dense(whole, x, w, some), rel=1e-9)


def test_out_of_reach_is_not_a_number() -> None:
    n = reports.DENSE_DEPENDENT_ROWS + 3
    whole, x = chain(n)
    labels = np.zeros(n - 1, int)
    assert np.isnan(worst_condition(whole.jacobian(x), 1 / whole.masses, np.arange(n - 1), labels, deficiency=1))
    # A gradient of zero has no direction.
    two = ConstraintSet(held.Distance([0, 1]), WATER[:2], np.ones(2))
    jacobian = two.jacobian(WATER[:2])
    jacobian.data[:] = 0.0
    assert np.isnan(worst_condition(jacobian, np.ones(2), np.arange(1), np.zeros(1, int), deficiency=0))
