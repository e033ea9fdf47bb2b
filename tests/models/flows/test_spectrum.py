"""Eigenvalues at their own scale: their errors and condition numbers."""

import numpy as np
import pytest
from exact_counts import in_skew_basis, unimodular

from kcons.errors import InputError
from kcons.models.flows.spectrum import spectrum


def off(found, known):
    """How far each known eigenvalue is from the nearest computed one, and the error given for that."""
    nearest = [int(np.argmin(abs(found.values - k))) for k in known]
    return abs(found.values[nearest] - known), found.errors[nearest]


@pytest.mark.parametrize(
    "known", [[-1e8, -3.0, 2.0], [-1e5, -1.0, 0.5, 7.0], [-1e10, 1.0], [3.0, -2.0, 5.0, -7.0, 11.0]]
)
@pytest.mark.parametrize("seed", range(5))
def test_errors_hold_and_are_not_much_too_large(known, seed):
    # Integer matrices of which every eigenvalue is known exactly.
    A = in_skew_basis(np.random.default_rng(seed), [np.array([[k]]) for k in known])
    found = spectrum(A)
    away, errors = off(found, np.array(known))
    assert np.all(away <= errors)
    # n cond n eps |A|: what moves an eigenvalue of a full matrix is of the size of its largest entries, and no more.
    n = len(known)
    assert np.all(errors <= 1.01 * n * found.conditions.max() * n * 2.3e-16 * np.linalg.norm(A))


def test_conditions_of_two_by_two():
    # The eigenvectors of [[1, c], [0, 2]] enclose an angle whose tangent is 1/c.
    for c in (0.0, 1.0, 1e3):
        found = spectrum([[1.0, c], [0.0, 2.0]])
        assert found.conditions == pytest.approx([np.hypot(1.0, c)] * 2, rel=1e-12)
    assert spectrum([[1.0, 1.0], [0.0, 1.0]]).conditions.min() > 1e14


def test_units_of_variables_do_not_matter():
    rng = np.random.default_rng(4)
    A = rng.normal(size=(5, 5))
    plain = spectrum(A)
    units = 2.0 ** rng.integers(-40, 40, 5)
    scaled = spectrum(A * units / units[:, None])
    order, other = (
        np.lexsort((plain.values.imag, plain.values.real)),
        np.lexsort((scaled.values.imag, scaled.values.real)),
    )
    assert scaled.values[other] == pytest.approx(plain.values[order], rel=1e-12)
    # As small errors as the best units allow, within what balancing to powers of two can miss.
    assert np.all(scaled.errors[other] < 10 * plain.errors[order])
    assert np.all(scaled.conditions[other] < 10 * plain.conditions[order])


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4], [4, 2, 0, 3, 1]])
def test_one_way_influence_leaves_each_scale_alone(order):
    # A fast pair drives a slow one; nothing comes back. Whatever the order of the variables.
    A = np.zeros((5, 5))
    A[:2, :2], A[2:4, 2:4], A[4, 4] = 1e12 * np.array([[-1.0, 2.0], [-2.0, -1.0]]), [[-1e-6, 1e-6], [-1e-6, -1e-6]], 3.0
    A[2, 0], A[4, 3] = 5e3, 1.0
    found = spectrum(A[np.ix_(order, order)])
    known = np.array([-1e12 + 2e12j, -1e12 - 2e12j, -1e-6 + 1e-6j, -1e-6 - 1e-6j, 3.0])
    away, errors = off(found, known)
    assert np.all(away <= errors)
    assert np.all(errors <= 1e-14 * abs(known))


def test_schur_form_and_its_basis():
    rng = np.random.default_rng(5)
    for n in (1, 2, 3, 6, 10):
        A = rng.normal(size=(n, n)) * (rng.random((n, n)) < 0.6)
        found = spectrum(A)
        assert pytest.approx(found.basis @ found.triangular, abs=1e-13 * n) == A @ found.basis
        assert np.array_equal(np.tril(found.triangular, -1), np.zeros((n, n)))
        assert np.array_equal(np.diag(found.triangular), found.values)
        assert set(found.values) == set(found.values.conj())


@pytest.mark.parametrize("size", [2, 3, 5])
def test_defective_eigenvalues_stay_within_their_errors(size):
    # Rounding scatters them by a root of itself; the bound goes the same way.
    for seed in range(10):
        rng = np.random.default_rng(seed)
        X, inverse = unimodular(rng, size)
        A = (X @ (3 * np.eye(size, dtype=int) + np.eye(size, k=1, dtype=int)).astype(object) @ inverse).astype(float)
        found = spectrum(A)
        assert np.all(abs(found.values - 3.0) <= found.errors)
        assert np.all(found.errors < 100 * np.linalg.norm(A) * 2.2e-16 ** (1 / size))


def test_given_errors_of_entries_are_allowed_for():
    A = np.array([[-1.0, 2.0, 0.0], [0.5, -3.0, 0.1], [0.0, 0.0, -0.4]])
    rng = np.random.default_rng(6)
    E = 1e-3 * np.array([[1.0, 0.0, 1.0], [1.0, 1.0, 0.0], [0.0, 1.0, 1.0]])
    found = spectrum(A, E)
    for _ in range(200):
        moved = np.linalg.eigvals(A + E * rng.uniform(-1, 1, (3, 3)))
        away, errors = off(found, moved)
        assert np.all(away <= errors)
    assert np.all(found.errors < 0.05)
    assert np.all(found.errors > spectrum(A).errors)


@pytest.mark.parametrize("error", [-1e-3, np.nan, np.inf, np.ones(2), np.ones((3, 2)), 1j, "much"])
def test_bad_errors_are_refused(error):
    with pytest.raises(InputError) as caught:
        spectrum(np.eye(2), error)
    assert caught.value.item == "error"


@pytest.mark.parametrize(
    "matrix",
    [
        np.array([[1.0, 1j], [0.0, 1.0]]),
        np.ma.masked_array(np.eye(2), mask=[[0, 1], [0, 0]]),
        [["a"]],
        np.array([[None]]),
    ],
)
def test_nothing_of_a_number_is_dropped(matrix):
    with pytest.raises(InputError) as caught:
        spectrum(matrix)
    assert caught.value.item == "matrix"


@pytest.mark.parametrize("scale", [1e-300, 1e-150, 1e150, 1e300])
def test_numbers_near_the_ends_of_their_range(scale):
    found = spectrum(scale * np.array([[-1.0, 2.0], [-2.0, -1.0]]))
    assert sorted(found.values.imag / scale) == pytest.approx([-2.0, 2.0], rel=1e-14)
    assert np.all(found.errors < 1e-13 * scale)
