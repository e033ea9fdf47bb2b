"""Linear flows: exp(At), eigenvalues with their errors, Jordan structure, and stability that is told, or cannot be."""

from fractions import Fraction

import mpmath
import numpy as np
import pytest
import scipy.linalg
from model_references import case

from kcons.models.flows import (
    Flow,
    HamiltonianFlow,
    Kind,
    LinearFlow,
    Pendulum,
    Stability,
    classify,
    equilibrium_at,
    jordan_block,
    jordan_block_propagator,
    jordan_form,
    linear,
)
from kcons.models.flows.linear import on_axis, spectrum

R = np.array([[0.0, 1.0], [-1.0, 0.0]])
RESONANT = np.block([[R, np.eye(2)], [np.zeros((2, 2)), R]])


# Matrices of integers with known eigenvalues.


def unimodular(rng: np.random.Generator, n: int, largest: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """An integer matrix of determinant 1 and its inverse, both exact: products with integers stay so."""
    lower = np.tril(rng.integers(-largest, largest + 1, (n, n)), -1) + np.eye(n, dtype=int)
    upper = np.triu(rng.integers(-largest, largest + 1, (n, n)), 1) + np.eye(n, dtype=int)
    order = rng.permutation(n)
    X = (lower @ upper)[order].astype(object)
    inverse = np.round(np.linalg.inv(upper) @ np.linalg.inv(lower)).astype(int)[:, order].astype(object)
    assert np.array_equal(X @ inverse, np.eye(n, dtype=int))
    return X, inverse


def in_skew_basis(rng: np.random.Generator, blocks: list[np.ndarray]) -> np.ndarray:
    """X J X^-1, exact as long as its entries are below 2^53."""
    J = scipy.linalg.block_diag(*blocks)
    X, inverse = unimodular(rng, len(J))
    scaled = np.array([[Fraction(float(v)) for v in row] for row in J], dtype=object)
    A = X @ scaled @ inverse
    assert all(Fraction(float(v)) == v for v in A.ravel())
    return A.astype(float)


def left_axis_right(A: np.ndarray) -> tuple[int, int, int]:
    """How many eigenvalues lie left of the axis, on it, and right of it: with 200 digits, of which blocks keep 30."""
    with mpmath.workdps(200):
        beside_one = mpmath.matrix(scipy.linalg.block_diag(A, -1.0).tolist())  # of one variable alone there are none
        real = [mpmath.re(value) for value in mpmath.eig(beside_one, left=False, right=False)]
    left, right = sum(r < -1e-30 for r in real) - 1, sum(r > 1e-30 for r in real)
    return left, len(A) - left - right, right


def blocks_of(matrix):
    return jordan_form(matrix).blocks


# -- exp(At) ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["generic", "jordan3", "nilpotent", "stiff"])
def test_reference(name):
    given = case(f"A12_linear_{name}")
    flow = LinearFlow(given["A"])
    wanted = np.array(given["reference"]["x"])
    off = abs(flow.exact(given["times"], given["initial"]["x"]) - wanted)
    assert np.all(off < 1e-10 * np.abs(wanted).max(axis=1, keepdims=True))
    kinds = {"generic": Kind.SADDLE, "jordan3": Kind.NODE, "nilpotent": Kind.DEGENERATE, "stiff": Kind.NODE}
    assert classify(flow.matrix).kind is kinds[name]
    assert (classify(flow.matrix).stability is Stability.ASYMPTOTIC) == (kinds[name] is Kind.NODE)
    if name in ("jordan3", "nilpotent"):
        assert [b.sizes for b in jordan_form(flow.matrix).blocks] == [(3,)]


def test_series_and_group_property():
    A = np.random.default_rng(2).normal(size=(3, 3))
    flow, series, term = LinearFlow(A), np.eye(3), np.eye(3)
    for k in range(1, 40):
        term = term @ A * 0.7 / k
        series = series + term
    assert flow.propagator(0.7) == pytest.approx(series, rel=1e-13)
    assert flow.propagator(0.3) @ flow.propagator(0.4) == pytest.approx(series, rel=1e-12)
    J = jordan_block(-0.3, 4)
    assert LinearFlow(J).propagator(2.5) == pytest.approx(jordan_block_propagator(-0.3, 4, 2.5), rel=1e-13)


def test_integration_agrees():
    flow, X0 = LinearFlow(case("A12_linear_generic")["A"]), np.array(case("A12_linear_generic")["initial"]["x"])
    assert flow.solve((0.0, 5.0), X0).y[:, -1] == pytest.approx(flow.exact(5.0, X0), rel=1e-8)
    assert flow.divergence(0.0, X0) == pytest.approx(np.trace(flow.matrix))


# -- eigenvalues --------------------------------------------------------------------------------------


def off(found, known):
    """How far each known eigenvalue is from the nearest computed one, and the error given for that."""
    nearest = [int(np.argmin(abs(found.values - k))) for k in known]
    return abs(found.values[nearest] - known), found.errors[nearest]


@pytest.mark.parametrize("known", [[-1e8, -3.0, 2.0], [-1e5, -1.0, 0.5, 7.0], [-1e10, 1.0], [3.0, -2.0, 5.0, -7.0, 11]])
@pytest.mark.parametrize("seed", range(3))
def test_errors_hold_and_are_not_much_too_large(known, seed):
    # Integer matrices of which every eigenvalue is known exactly.
    A = in_skew_basis(np.random.default_rng(seed), [np.array([[k]]) for k in known])
    found, n = spectrum(A), len(known)
    away, errors = off(found, np.array(known))
    assert np.all(away <= errors)
    # n cond n eps |A|: what moves an eigenvalue of a full matrix is of the size of its largest entries, and no more.
    _, left, right = scipy.linalg.eig(found.triangular, left=True, right=True)
    condition = max(1 / abs(np.einsum("ij,ij->j", left.conj(), right)))
    assert np.all(errors <= 1.01 * n * condition * n * 2.3e-16 * np.linalg.norm(A))


def test_units_of_variables_do_not_matter():
    rng = np.random.default_rng(4)
    A, units = rng.normal(size=(5, 5)), 2.0 ** rng.integers(-40, 40, 5)
    plain, scaled = classify(A), classify(A * units / units[:, None])
    assert scaled.eigenvalues == pytest.approx(plain.eigenvalues, rel=1e-12)
    # As small errors as the best units allow, within what balancing to powers of two can miss.
    assert np.all(scaled.errors < 10 * plain.errors)
    for scale in (1e-150, 1e150):
        found = classify(scale * np.array([[-1.0, 2.0], [-2.0, -1.0]]))
        assert sorted(found.eigenvalues.imag / scale) == pytest.approx([-2.0, 2.0], rel=1e-14)
        assert np.all(found.errors < 1e-13 * scale)


def test_given_errors_of_entries_are_allowed_for():
    A, rng = np.array([[-1.0, 2.0, 0.0], [0.5, -3.0, 0.1], [0.0, 0.0, -0.4]]), np.random.default_rng(6)
    E = 1e-3 * np.array([[1.0, 0.0, 1.0], [1.0, 1.0, 0.0], [0.0, 1.0, 1.0]])
    found = spectrum(A, E)
    for _ in range(100):
        away, errors = off(found, np.linalg.eigvals(A + E * rng.uniform(-1, 1, (3, 3))))
        assert np.all(away <= errors)
    assert np.all((found.errors < 0.05) & (found.errors > spectrum(A).errors))


# -- Jordan blocks ------------------------------------------------------------------------------------


def complex_block(eigenvalue, size):
    """A block of a conjugate pair, as a real matrix."""
    pair = np.array([[eigenvalue.real, eigenvalue.imag], [-eigenvalue.imag, eigenvalue.real]])
    return np.kron(np.eye(size), pair) + np.kron(np.eye(size, k=1), np.eye(2))


STRUCTURES = {
    "4": ([jordan_block(-1.0, 4)], [(4,)]),
    "8": ([jordan_block(-1.0, 8)], [(8,)]),
    "4 and 1": ([jordan_block(-1.0, 4), [[-1.0]]], [(4, 1)]),
    "2 and 2": ([jordan_block(3.0, 2), jordan_block(3.0, 2)], [(2, 2)]),
    "3, 2, 1 of zero": ([jordan_block(0.0, 3), jordan_block(0.0, 2), [[0.0]]], [(3, 2, 1)]),
    "two eigenvalues": ([jordan_block(-1.0, 3), jordan_block(2.0, 2), [[2.0]]], [(2, 1), (3,)]),
    "stiff": ([jordan_block(-4096.0, 2), jordan_block(-1.0, 2), [[1.0]]], [(1,), (2,), (2,)]),
    "close": ([jordan_block(1.0, 3), [[1.0625]]], [(1,), (3,)]),
    "pair": ([complex_block(-1 + 2j, 2)], [(2,), (2,)]),
    "long pair": ([complex_block(1j, 3), [[0.0]]], [(3,), (1,), (3,)]),
    "ones": ([-np.eye(4)], [(1, 1, 1, 1)]),
}


@pytest.mark.parametrize("name", STRUCTURES)
@pytest.mark.parametrize("seed", range(2))
def test_structure_of_matrices_that_are_exactly_so(name, seed):
    blocks, wanted = STRUCTURES[name]
    A = in_skew_basis(np.random.default_rng(seed), blocks)
    found = jordan_form(A)
    assert sorted(b.sizes for b in found.blocks) == sorted(wanted)
    assert all(b.certain for b in found.blocks)
    exact = scipy.linalg.block_diag(*blocks)
    assert sum(b.eigenvalue * sum(b.sizes) for b in found.blocks) == pytest.approx(np.trace(exact), abs=1e-10)
    # A T = T J, T is no smaller than its columns, and J has the form it should have.
    assert np.linalg.norm(A @ found.T - found.T @ found.J) < 1e-13 * np.linalg.norm(A) * np.linalg.norm(found.T)
    assert np.linalg.matrix_rank(found.T, tol=1e-12) == len(A)
    assert np.array_equal(np.triu(np.tril(found.J, 1)), found.J)
    assert set(np.diag(found.J, 1)) <= {0.0, 1.0}


@pytest.mark.parametrize("name", ["4", "two eigenvalues", "pair", "long pair", "3, 2, 1 of zero"])
def test_exponential_by_blocks(name):
    A, t = in_skew_basis(np.random.default_rng(1), STRUCTURES[name][0]), 0.4
    form, wanted = jordan_form(A), LinearFlow(A).propagator(t)
    allowed = 1e-13 * np.linalg.cond(form.T) * abs(wanted).max()
    assert abs(form.propagator(t) - wanted).max() < allowed
    assert np.linalg.cond(form.T) < 1e4


def test_structures_that_rounding_allows():
    X = np.array([[2.0, 1.0, 0.0], [1.0, 1.0, 1.0], [0.0, 1.0, 3.0]])
    for coupling, sizes, certain in ((1e-6, (2, 1), True), (1e-14, None, False), (0.0, (1, 1, 1), True)):
        N = np.zeros((3, 3))
        N[0, 1] = coupling
        (found,) = blocks_of(X @ (N - np.eye(3)) @ np.linalg.inv(X))
        assert found.certain == certain
        assert sizes is None or found.sizes == sizes
    for corner in (-1e-20, 3e-16):  # the nearest defective matrix lacks the corner
        assert [b.sizes for b in blocks_of([[-1.0, 1.0], [corner, -1.0]])] == [(2,)]
    A = np.array([[1.0, 1.0], [0.0, 1.001]])
    assert [b.sizes for b in blocks_of(A)] == [(1,), (1,)]


def test_neighbors_that_rounding_joins_are_told_as_uncertain():
    # A block of size 4 scatters by 1e-4: an eigenvalue 1e-3 away may belong to it, or not.
    A = in_skew_basis(np.random.default_rng(2), [jordan_block(1.0, 4), [[1.0 + 2**-10]]])
    found = blocks_of(A)
    assert not all(b.certain for b in found)
    assert sum(sum(b.sizes) for b in found) == 5
    # Two blocks so near that their errors overlap, though no matrix within rounding has all four equal.
    for apart in (2.0**-20, 2.0**-21):
        found = blocks_of(in_skew_basis(np.random.default_rng(1), [jordan_block(1.0, 2), jordan_block(1.0 + apart, 2)]))
        assert sum(sum(b.sizes) for b in found) == 4
        assert not any(b.certain for b in found)
    # Both are farther apart than they scatter: nothing is joined.
    near = in_skew_basis(np.random.default_rng(2), [[[1.0]], [[1.0 + 2**-20]]])
    assert [(b.sizes, b.certain) for b in blocks_of(near)] == [((1,), True), ((1,), True)]


# -- names and stability ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("matrix", "name"),
    [
        ([[-1.0, 0.0], [0.0, -2.0]], "asymptotically stable node"),
        ([[1.0, 0.3], [0.0, 2.0]], "unstable node"),
        ([[-1.0, 0.0], [0.0, -1.0]], "asymptotically stable node"),
        (1e-8 * jordan_block(-1.0, 2), "asymptotically stable node"),
        ([[-0.1, 1.0], [-1.0, -0.1]], "asymptotically stable focus"),
        ([[0.0, 1.0], [1.0, 0.0]], "unstable saddle"),
        (1e8 * R, "stable center"),
        ([[0.0, 0.0], [0.0, -1.0]], "stable degenerate"),
        ([[0.0, 0.0], [0.0, 0.0]], "stable degenerate"),
        ([[0.0, 1.0], [0.0, 0.0]], "unstable degenerate"),
        ([[-0.1, 1.0, 0.0], [-1.0, -0.1, 0.0], [0.0, 0.0, 1.0]], "unstable saddle"),
        (scipy.linalg.block_diag(R, -1.0), "stable degenerate"),
        # Beside a rate of 1e10 rounding hides one of 1e-10.
        (np.diag([-1e10, -1e-10, 0.0]), "degenerate whose stability cannot be told"),
        # A part of 1e-13 is seen, one of 1e-17 is said neither to be there nor not.
        (R + 1e-13 * np.eye(2), "unstable focus"),
        (R - 1e-13 * np.eye(2), "asymptotically stable focus"),
        (R + 1e-17 * np.eye(2), "center whose stability cannot be told"),
    ],
)
def test_names(matrix, name):
    found = classify(matrix)
    assert str(found) == name
    assert found.hyperbolic == (name.split()[-1] in ("node", "focus", "saddle"))


def test_purely_imaginary_blocks_that_are_defective_are_unstable():
    # One of two equal oscillators drives the other: Re lambda = 0 everywhere, and yet t cos t.
    assert classify(np.kron(np.eye(2), R)).stability is Stability.STABLE
    assert classify(RESONANT).stability is Stability.UNSTABLE


def awkward(rng, kind):
    n = int(rng.integers(1, 6))
    if kind == 0:  # small integers: many real parts of exactly zero, many defective ones
        return rng.integers(-2, 3, (n, n)).astype(float)
    if kind == 1:  # graded over 24 decades
        return rng.normal(size=(n, n)) * 10.0 ** rng.integers(-12, 13, (n, n))
    if kind == 2:  # with a structure of zeros
        return rng.normal(size=(n, n)) * (rng.random((n, n)) < 0.4) * 10.0 ** rng.integers(-6, 7, (n, 1))
    if kind == 3:  # blocks near the axis in a skew basis, rounded
        a, X = rng.choice([0.0, 1e-17, -1e-17, 1e-9, -1e-9]), rng.normal(size=(4, 4))
        return X @ (RESONANT + np.diag([a, a, -a, -a])) @ np.linalg.inv(X)
    # a small real part next to fast rates
    return np.diag([-1e9, 10.0 ** rng.integers(-12, 1) * rng.choice([-1, 1])]) + rng.normal(size=(2, 2)) * 1e-7


def test_what_is_said_is_so():
    """Whatever is told about hundreds of awkward matrices is what integers say of them, entry by entry as written."""
    told = {s: 0 for s in Stability}
    for seed in range(500):
        A = awkward(np.random.default_rng(seed), seed % 5)
        left, on, right = left_axis_right(A)
        found = classify(A)
        told[found.stability] += 1
        if found.stability is Stability.ASYMPTOTIC:
            assert (on, right) == (0, 0), A
        elif found.stability is Stability.STABLE:
            assert on > 0 and right == 0, A
        elif found.stability is Stability.UNSTABLE:
            assert right > 0 or on > 1, A
        if seed % 5 == 0 and right == 0 < on:
            # Bounded, or growing like a power of t: small integers make that plain after some time.
            grown = np.abs(scipy.linalg.expm(A * 1e4)).max() > 1e3
            assert found.stability is (Stability.UNSTABLE if grown else Stability.STABLE), A
            assert on_axis(A) is None or on_axis(A)[0] == on
        if found.hyperbolic:
            assert on == 0, A
            assert (np.sum(found.eigenvalues.real < 0), np.sum(found.eigenvalues.real > 0)) == (left, right), A
    # The test would be empty if all were called unknown: of the rounded blocks all are, 100.
    assert told[Stability.UNKNOWN] < 167
    assert min(told.values()) > 20


def test_what_cannot_be_told():
    # A change in the last digit moves the eigenvalues of a block of size 6 by some 1e-2.
    A = in_skew_basis(np.random.default_rng(0), [jordan_block(-1 / 1024, 6)])
    assert classify(A).stability is Stability.UNKNOWN
    assert classify(A - 4 * np.eye(6)).stability is Stability.ASYMPTOTIC
    assert classify(A + 4 * np.eye(6)).stability is Stability.UNSTABLE
    # Errors of entries; zeros that may not be zeros.
    A = np.array([[-0.01, 1.0], [-1.0, -0.02]])
    assert [classify(A, e).stability for e in (0.0, 1e-4)] == [Stability.ASYMPTOTIC] * 2
    assert classify(A, 0.05).stability is classify(R, 1e-12).stability is Stability.UNKNOWN


def test_jacobians_by_differences_are_known_as_well_as_differences_are():
    given = equilibrium_at(Pendulum(1.3), [0.0, 0.0]).classification
    found = equilibrium_at(
        HamiltonianFlow(lambda q, p, t: Pendulum(1.3).energy([*q, *p]), 1), [0.0, 0.0]
    ).classification
    assert (str(given), str(found)) == ("stable center", "center whose stability cannot be told")
    assert np.all(found.errors > given.errors)
    assert min(abs(found.eigenvalues - 1.3j)) < found.errors[0] < 1e-6
    # x' = x^2 has a double root, which a search finds to 1e-6: the slope 2e-6 there is that of the place.
    for k, at in ((2, 1e-6), (3, 1e-4)):
        flow = Flow(lambda t, X, k=k: X**k, 1, lambda t, X, k=k: [k * X ** (k - 1)])
        assert str(equilibrium_at(flow, [at]).classification) == "degenerate whose stability cannot be told"


@pytest.mark.parametrize(
    ("blocks", "wanted"),
    [
        ([[[-1.0]]], (0, True)),
        ([R], (2, True)),
        ([R, R, 3 * R], (6, True)),
        ([RESONANT, [[-2.0]]], (4, False)),
        ([np.zeros((2, 2)), -np.eye(2)], (2, True)),
        ([[[0.0, 1.0], [0.0, 0.0]], R], (4, False)),
        ([RESONANT, R, np.zeros((2, 2))], (8, False)),
        ([R - np.eye(2), [[0.0]]], (1, True)),
        # Pairs of opposite signs, real or complex, are common roots too, but not on the axis.
        ([[[2.0]], [[-2.0]], R], None),
        ([R + np.eye(2), R - np.eye(2), 2 * R], None),
    ],
)
def test_eigenvalues_on_the_axis_are_counted_in_integers(blocks, wanted):
    assert on_axis(scipy.linalg.block_diag(*blocks)) == wanted
    assert on_axis(in_skew_basis(np.random.default_rng(0), blocks)) == wanted


def test_without_sympy_it_cannot_be_told(monkeypatch):
    monkeypatch.setattr(linear, "find_spec", lambda name: None)
    assert str(classify(R)) == "stable center"
    assert str(classify(scipy.linalg.block_diag(R, 3 * R))) == "center whose stability cannot be told"
