"""Names of linear flows, and stability that is told, or cannot be."""

import numpy as np
import pytest
import scipy.linalg
from exact_counts import in_skew_basis, left_axis_right

from kcons.errors import InputError
from kcons.models.flows import Flow, HamiltonianFlow, Kind, Pendulum, Stability, classify, equilibrium_at, jordan_block

R = np.array([[0.0, 1.0], [-1.0, 0.0]])

NAMES = [
    ([[-1.0, 0.0], [0.0, -2.0]], Kind.NODE, Stability.ASYMPTOTIC, ""),
    ([[1.0, 0.3], [0.0, 2.0]], Kind.NODE, Stability.UNSTABLE, ""),
    ([[-1.0, 0.0], [0.0, -1.0]], Kind.NODE, Stability.ASYMPTOTIC, "star"),
    ([[-1.0, 1.0], [0.0, -1.0]], Kind.NODE, Stability.ASYMPTOTIC, "improper"),
    ([[-0.1, 1.0], [-1.0, -0.1]], Kind.FOCUS, Stability.ASYMPTOTIC, ""),
    ([[0.1, 1.0], [-1.0, 0.1]], Kind.FOCUS, Stability.UNSTABLE, ""),
    ([[0.0, 1.0], [1.0, 0.0]], Kind.SADDLE, Stability.UNSTABLE, ""),
    ([[0.0, 2.0], [-2.0, 0.0]], Kind.CENTRE, Stability.STABLE, ""),
    ([[0.0, 0.0], [0.0, -1.0]], Kind.DEGENERATE, Stability.STABLE, ""),
    ([[0.0, 0.0], [0.0, 0.0]], Kind.DEGENERATE, Stability.STABLE, ""),
    ([[0.0, 1.0], [0.0, 0.0]], Kind.DEGENERATE, Stability.UNSTABLE, ""),
    ([[-0.1, 1.0, 0.0], [-1.0, -0.1, 0.0], [0.0, 0.0, 1.0]], Kind.SADDLE, Stability.UNSTABLE, "saddle-focus"),
    ([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]], Kind.DEGENERATE, Stability.STABLE, ""),
]


@pytest.mark.parametrize(("matrix", "kind", "stability", "detail"), NAMES)
def test_names(matrix, kind, stability, detail):
    found = classify(matrix)
    assert (found.kind, found.stability, found.detail) == (kind, stability, detail)
    assert found.hyperbolic == all(abs(np.linalg.eigvals(np.array(matrix)).real) > 1e-6)


def test_purely_imaginary_blocks_that_are_defective_are_unstable():
    # Two equal oscillators, one driving the other: Re lambda = 0 everywhere, and yet t cos t.
    coupled = np.block([[R, np.eye(2)], [np.zeros((2, 2)), R]])
    assert classify(np.kron(np.eye(2), R)).stability is Stability.STABLE
    assert classify(coupled).stability is Stability.UNSTABLE


def test_scale_does_not_matter():
    for scale in (1e-8, 1e8):
        assert classify(scale * jordan_block(-1.0, 2)).detail == "improper"
        assert str(classify(scale * np.array([[0.0, 1.0], [-1.0, 0.0]]))) == "stable centre"


@pytest.mark.parametrize("matrix", [[[1.0, 2.0]], [[np.nan]], [1.0], np.zeros((0, 0)), 1j * np.eye(2)])
def test_bad_matrices_are_refused(matrix):
    with pytest.raises(InputError):
        classify(matrix)


@pytest.mark.parametrize(
    ("rates", "stability"),
    [
        ([-1e6, -2.0, 1.0], Stability.UNSTABLE),
        ([-1e5, -1.0, 0.5], Stability.UNSTABLE),
        ([-1e10, 1.0], Stability.UNSTABLE),
        ([-1e10, -1.0], Stability.ASYMPTOTIC),
        ([-1e300, 1e-300], Stability.UNSTABLE),
        ([-1e10, -1e-10, 0.0], Stability.STABLE),
    ],
)
def test_each_rate_counts_at_its_own_scale(rates, stability):
    found = classify(np.diag(rates))
    assert found.stability is stability
    assert found.hyperbolic == all(rates)
    assert sorted(found.eigenvalues.real) == sorted(rates)


@pytest.mark.parametrize("rates", [[-1e6, -2.0, 1.0], [-1e6, -2.0, -1.0], [-1e8, 3.0], [-1e8, -3.0]])
@pytest.mark.parametrize("seed", range(4))
def test_stiff_flows_in_a_skew_basis(rates, seed):
    found = classify(in_skew_basis(np.random.default_rng(seed), [np.array([[k]]) for k in rates]))
    assert found.stability is (Stability.UNSTABLE if max(rates) > 0 else Stability.ASYMPTOTIC)
    assert found.kind is (Kind.SADDLE if max(rates) > 0 else Kind.NODE)
    assert found.hyperbolic


def test_what_is_said_is_so():
    """Whatever is told about hundreds of awkward matrices is what integers say of them, entry by entry as written."""
    told = {s: 0 for s in Stability}
    for seed in range(750):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, 6))
        kind = seed % 5
        if kind == 0:  # small integers: many real parts of exactly zero, many defective ones
            A = rng.integers(-2, 3, (n, n)).astype(float)
        elif kind == 1:  # graded over 24 decades
            A = rng.normal(size=(n, n)) * 10.0 ** rng.integers(-12, 13, (n, n))
        elif kind == 2:  # with a structure of zeros
            A = rng.normal(size=(n, n)) * (rng.random((n, n)) < 0.4) * 10.0 ** rng.integers(-6, 7, (n, 1))
        elif kind == 3:  # blocks near the axis in a skew basis, rounded
            a = rng.choice([0.0, 1e-17, -1e-17, 1e-9, -1e-9])
            X = rng.normal(size=(4, 4))
            coupled = np.block([[R + a * np.eye(2), np.eye(2)], [np.zeros((2, 2)), R - a * np.eye(2)]])
            A = X @ coupled @ np.linalg.inv(X)
        else:  # a small real part next to fast rates
            A = np.diag([-1e9, 10.0 ** rng.integers(-12, 1) * rng.choice([-1, 1])]) + rng.normal(size=(2, 2)) * 1e-7
        left, on, right = left_axis_right(A)
        found = classify(A)
        told[found.stability] += 1
        if found.stability is Stability.ASYMPTOTIC:
            assert (on, right) == (0, 0), A
        elif found.stability is Stability.STABLE:
            assert on > 0 and right == 0, A
        elif found.stability is Stability.UNSTABLE:
            assert right > 0 or on > 1, A
        if kind == 0 and right == 0 < on:
            # Bounded, or growing like a power of t: small integers make that plain after some time.
            grown = np.abs(scipy.linalg.expm(A * 1e4)).max() > 1e3
            assert found.stability is (Stability.UNSTABLE if grown else Stability.STABLE), A
        if found.hyperbolic:
            assert on == 0, A
            assert (np.sum(found.eigenvalues.real < 0), np.sum(found.eigenvalues.real > 0)) == (left, right), A
    # The test would be empty if all were called unknown: of the rounded blocks all are, 150.
    assert told[Stability.UNKNOWN] < 250
    assert min(told.values()) > 20


def test_rounded_centres_cannot_be_told():
    # An oscillator in a skew basis: rounding has put the eigenvalues off the axis, to one side or the other.
    rng = np.random.default_rng(3)
    X = rng.normal(size=(4, 4))
    A = X @ np.kron(np.diag([1.0, 3.0]), R) @ np.linalg.inv(X)
    found = classify(A)
    assert left_axis_right(A)[1] < 4
    assert (found.kind, found.stability, found.hyperbolic) == (Kind.CENTRE, Stability.UNKNOWN, False)
    assert str(found) == "centre whose stability cannot be told"
    # As it is written, the same is exactly one; a part of 1e-17 makes it something else, which is said neither.
    assert classify(np.kron(np.diag([1.0, 3.0]), R)).stability is Stability.STABLE
    assert classify(R + 1e-17 * np.eye(2)).stability is Stability.UNKNOWN
    assert str(classify(R + 1e-13 * np.eye(2))) == "unstable focus"
    assert str(classify(R - 1e-13 * np.eye(2))) == "asymptotically stable focus"


def test_long_blocks_near_the_axis_cannot_be_told():
    # A change in the last digit moves the eigenvalues of a block of size 6 by some 1e-2.
    A = in_skew_basis(np.random.default_rng(0), [jordan_block(-1 / 1024, 6)])
    assert classify(A).stability is Stability.UNKNOWN
    assert classify(A - 4 * np.eye(6)).stability is Stability.ASYMPTOTIC
    assert classify(A + 4 * np.eye(6)).stability is Stability.UNSTABLE


def test_jacobians_by_differences_are_known_as_well_as_differences_are():
    pendulum = Pendulum(1.3)
    plain = HamiltonianFlow(pendulum.hamiltonian, 1)
    given = equilibrium_at(pendulum, [0.0, 0.0]).classification
    by_differences = equilibrium_at(plain, [0.0, 0.0]).classification
    assert (given.kind, given.stability) == (Kind.CENTRE, Stability.STABLE)
    assert (by_differences.kind, by_differences.stability) == (Kind.CENTRE, Stability.UNKNOWN)
    assert np.all(by_differences.errors > given.errors)
    off = min(abs(by_differences.eigenvalues - 1.3j))
    assert off < by_differences.errors[0] < 1e-6
    # A weak friction that differences do not see, and one that they do.
    for friction, stability in ((1e-14, Stability.UNKNOWN), (1e-3, Stability.ASYMPTOTIC)):
        damped = Flow(lambda t, X, c=friction: [X[1], -np.sin(X[0]) - c * X[1]], 2)
        assert equilibrium_at(damped, [0.0, 0.0]).classification.stability is stability


def test_points_that_are_not_quite_equilibria():
    # x' = x^2 has a double root, which a search finds to 1e-6: the slope 2e-6 there is that of the place.
    found = equilibrium_at(Flow(lambda t, X: [X[0] ** 2], 1, lambda t, X: [[2 * X[0]]]), [1e-6]).classification
    assert (found.kind, found.stability) == (Kind.DEGENERATE, Stability.UNKNOWN)
    cubic = Flow(lambda t, X: [X[0] ** 3], 1, lambda t, X: [[3 * X[0] ** 2]])
    assert equilibrium_at(cubic, [1e-4]).classification.stability is Stability.UNKNOWN


def test_errors_of_entries_decide_what_can_be_told():
    A = np.array([[-0.01, 1.0], [-1.0, -0.02]])
    assert classify(A).stability is Stability.ASYMPTOTIC
    assert classify(A, 1e-4).stability is Stability.ASYMPTOTIC
    assert classify(A, 0.05).stability is Stability.UNKNOWN
    # Zeros that may not be zeros.
    assert classify(R, 1e-12).stability is Stability.UNKNOWN


def test_conditions_and_errors_go_with_their_eigenvalues():
    found = classify([[-1.0, 1e4, 0.0], [0.0, -2.0, 0.0], [0.0, 0.0, 5.0]])
    assert found.eigenvalues.tolist() == [5.0, -1.0, -2.0]
    assert found.conditions == pytest.approx([1.0, np.hypot(1.0, 1e4), np.hypot(1.0, 1e4)], rel=1e-10)
    assert found.errors == pytest.approx(2.3e-16 * np.array([5.0, 1.0, 2.0]), rel=0.1)
