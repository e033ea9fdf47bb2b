"""Jordan structure, as far as double precision allows."""

import numpy as np
import pytest
import scipy.linalg
from exact_counts import in_skew_basis

from kcons.errors import InputError
from kcons.models.flows import LinearFlow, jordan_block, jordan_blocks, jordan_form

TURN = np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.3, -0.5, 1.0]])


@pytest.mark.parametrize("sizes", [(3,), (2, 1), (1, 1, 1)])
def test_block_sizes_in_a_skew_basis(sizes):
    J = np.zeros((3, 3))
    at = 0
    for size in sizes:
        J[at : at + size, at : at + size] = jordan_block(-0.7, size)
        at += size
    (block,) = jordan_blocks(TURN @ J @ np.linalg.inv(TURN))
    assert block.sizes == sizes
    assert block.eigenvalue == pytest.approx(-0.7, abs=1e-9)


def test_several_eigenvalues():
    J = np.zeros((5, 5))
    J[:2, :2], J[2:4, 2:4], J[4, 4] = jordan_block(0.5, 2), [[-1.0, 2.0], [-2.0, -1.0]], 0.5
    rng = np.random.default_rng(1)
    T = rng.normal(size=(5, 5))
    found = jordan_blocks(T @ J @ np.linalg.inv(T))
    assert [b.sizes for b in found] == [(2, 1), (1,), (1,)]
    assert [b.eigenvalue for b in found] == pytest.approx([0.5, -1 + 2j, -1 - 2j], abs=1e-7)


def complex_block(eigenvalue, size):
    """A block of a conjugate pair, as a real matrix."""
    pair = np.array([[eigenvalue.real, eigenvalue.imag], [-eigenvalue.imag, eigenvalue.real]])
    return np.kron(np.eye(size), pair) + np.kron(np.eye(size, k=1), np.eye(2))


STRUCTURES = {
    "4": ([jordan_block(-1.0, 4)], [(4,)]),
    "6": ([jordan_block(2.0, 6)], [(6,)]),
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
@pytest.mark.parametrize("seed", range(3))
def test_structure_of_matrices_that_are_exactly_so(name, seed):
    blocks, wanted = STRUCTURES[name]
    A = in_skew_basis(np.random.default_rng(seed), blocks)
    found = jordan_form(A)
    assert sorted(b.sizes for b in found.blocks) == sorted(wanted)
    assert all(b.certain and b.distance < 1e-13 for b in found.blocks)
    exact = scipy.linalg.block_diag(*blocks)
    assert sum(b.eigenvalue * sum(b.sizes) for b in found.blocks) == pytest.approx(np.trace(exact), abs=1e-10)
    # A T = T J, T is no smaller than its columns, and J has the form it should have.
    size = np.linalg.norm(A)
    assert np.linalg.norm(A @ found.T - found.T @ found.J) < 1e-13 * size * np.linalg.norm(found.T)
    assert np.linalg.matrix_rank(found.T, tol=1e-12) == len(A)
    assert np.array_equal(np.triu(np.tril(found.J, 1)), found.J)
    assert set(np.diag(found.J, 1)) <= {0.0, 1.0}


@pytest.mark.parametrize("name", ["4", "two eigenvalues", "pair", "long pair", "3, 2, 1 of zero"])
def test_exponential_by_blocks(name):
    A = in_skew_basis(np.random.default_rng(1), STRUCTURES[name][0])
    form, t = jordan_form(A), 0.4
    wanted = LinearFlow(A).propagator(t)
    found = form.propagator(t)
    assert abs(found - wanted).max() < 1e-13 * np.linalg.cond(form.T) * abs(wanted).max()
    assert np.linalg.cond(form.T) < 1e4
    # (13): T exp(Jt) T^-1.
    literal = form.T @ scipy.linalg.expm(form.J * t) @ np.linalg.inv(form.T)
    assert abs(found - literal).max() < 1e-12 * np.linalg.cond(form.T) * abs(wanted).max()


def test_couplings_near_the_rounding_are_not_certain():
    X = np.array([[2.0, 1.0, 0.0], [1.0, 1.0, 1.0], [0.0, 1.0, 3.0]])
    for coupling, sizes, certain in ((1e-6, (2, 1), True), (1e-14, None, False), (0.0, (1, 1, 1), True)):
        N = np.zeros((3, 3))
        N[0, 1] = coupling
        (found,) = jordan_blocks(X @ (N - np.eye(3)) @ np.linalg.inv(X))
        assert found.certain == certain
        assert sizes is None or found.sizes == sizes
    # In a triangular matrix nothing is rounded: the weakest coupling counts.
    (found,) = jordan_blocks([[-1.0, 1e-30], [0.0, -1.0]])
    assert (found.sizes, found.certain) == ((2,), True)


def test_neighbours_that_rounding_joins_are_told_as_uncertain():
    # A block of size 4 scatters by 1e-4: an eigenvalue 1e-3 away may belong to it, or not.
    A = in_skew_basis(np.random.default_rng(2), [jordan_block(1.0, 4), [[1.0 + 2**-10]]])
    found = jordan_blocks(A)
    assert not all(b.certain for b in found)
    assert sum(sum(b.sizes) for b in found) == 5
    # Two blocks so near that their errors overlap, though no matrix within rounding has all four equal.
    for apart in (2.0**-20, 2.0**-21):
        pair = in_skew_basis(np.random.default_rng(1), [jordan_block(1.0, 2), jordan_block(1.0 + apart, 2)])
        found = jordan_blocks(pair)
        assert sum(sum(b.sizes) for b in found) == 4
        assert not any(b.certain for b in found)
    # Both are farther apart than they scatter: nothing is joined.
    near = in_skew_basis(np.random.default_rng(2), [[[1.0]], [[1.0 + 2**-20]]])
    assert [(b.sizes, b.certain) for b in jordan_blocks(near)] == [((1,), True), ((1,), True)]


def test_errors_of_entries_join_what_they_may_make_equal():
    A = np.array([[1.0, 1.0], [0.0, 1.001]])
    assert [b.sizes for b in jordan_blocks(A)] == [(1,), (1,)]
    assert [b.sizes for b in jordan_blocks(A, 1e-5)] == [(2,)]


def test_distance_is_that_of_a_matrix_with_the_structure():
    A = np.array([[-1.0, 1.0], [-1e-20, -1.0]])
    (found,) = jordan_blocks(A)
    assert found.sizes == (2,)
    assert found.distance < 1e-15
    A = np.array([[-1.0, 1.0], [3e-16, -1.0]])
    (found,) = jordan_blocks(A)
    assert found.sizes == (2,)
    # The nearest defective matrix lacks the corner.
    assert found.distance == pytest.approx(3e-16 / np.linalg.norm(A), rel=0.5)


@pytest.mark.parametrize("matrix", [[[1.0, 2.0]], [[np.inf]], 1j * np.eye(2)])
def test_bad_matrices_are_refused(matrix):
    with pytest.raises(InputError):
        jordan_form(matrix)
