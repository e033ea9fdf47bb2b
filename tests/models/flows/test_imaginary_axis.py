"""Eigenvalues on the imaginary axis, counted in integers."""

import numpy as np
import pytest
import scipy.linalg
from exact_counts import in_skew_basis, left_axis_right

from kcons.models.flows.imaginary_axis import LARGEST, OnAxis, on_axis

R = np.array([[0.0, 1.0], [-1.0, 0.0]])
RESONANT = np.block([[R, np.eye(2)], [np.zeros((2, 2)), R]])


@pytest.mark.parametrize(
    ("blocks", "wanted"),
    [
        ([[[-1.0]]], OnAxis(0, 0, True)),
        ([R], OnAxis(0, 2, True)),
        ([R, R, 3 * R], OnAxis(0, 6, True)),
        ([RESONANT, [[-2.0]]], OnAxis(0, 4, False)),
        ([np.zeros((2, 2)), -np.eye(2)], OnAxis(2, 0, True)),
        ([[[0.0, 1.0], [0.0, 0.0]], R], OnAxis(2, 2, False)),
        ([RESONANT, R, np.zeros((2, 2))], OnAxis(2, 6, False)),
        ([R - np.eye(2), [[0.0]]], OnAxis(1, 0, True)),
        # Pairs of opposite signs, real or complex, are common roots too, but not on the axis.
        ([[[2.0]], [[-2.0]], R], OnAxis(0, 2, True)),
        ([R + np.eye(2), R - np.eye(2), 2 * R], OnAxis(0, 2, True)),
    ],
)
@pytest.mark.parametrize("seed", [None, 0, 1])
def test_counts(blocks, wanted, seed):
    A = scipy.linalg.block_diag(*blocks)
    if seed is not None:
        A = in_skew_basis(np.random.default_rng(seed), blocks)
    assert on_axis(A) == wanted


def test_the_last_digit_decides():
    assert on_axis(R + np.diag([1e-300, -1e-300])).imaginary == 2
    assert on_axis(R + np.diag([1e-300, 0.0])).imaginary == 0
    third = np.array([[0.0, 1 / 3], [-1 / 3, 0.0]])
    assert on_axis(third).imaginary == 2
    assert on_axis(np.kron(third, np.array([[1.0, 0.1], [0.1, 2.0]]))).imaginary == 4
    # Numbers from one end of their range to the other.
    assert on_axis(scipy.linalg.block_diag(1e-300 * R, 1e300 * R)).imaginary == 4


def test_springs_and_masses():
    # x'' = -K x with a symmetric K: all eigenvalues are imaginary, whatever the digits of K.
    rng = np.random.default_rng(0)
    K = rng.normal(size=(5, 5))
    K = K @ K.T
    K = 0.5 * (K + K.T)
    A = np.block([[np.zeros((5, 5)), np.eye(5)], [-K, np.zeros((5, 5))]])
    assert on_axis(A) == OnAxis(0, 10, True)


def test_agrees_with_another_count():
    rng = np.random.default_rng(1)
    for _ in range(300):
        A = rng.integers(-2, 3, (4, 4)).astype(float)
        found = on_axis(A)
        assert found.zero + found.imaginary == left_axis_right(A)[1]
        assert found.zero == 4 - _rank_of_power(A)


def _rank_of_power(A):
    return np.linalg.matrix_rank(np.linalg.matrix_power(A, 4))


def test_large_matrices_are_left_alone():
    assert on_axis(np.zeros((LARGEST + 1, LARGEST + 1))) is None
