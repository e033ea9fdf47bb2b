"""Jordan structure and names of linear flows."""

import numpy as np
import pytest

from kcons.errors import InputError
from kcons.flows import Kind, Stability, classify, jordan_block, jordan_blocks

TURN = np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.3, -0.5, 1.0]])

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
    R = np.array([[0.0, 1.0], [-1.0, 0.0]])
    coupled = np.block([[R, np.eye(2)], [np.zeros((2, 2)), R]])
    assert classify(np.kron(np.eye(2), R)).stability is Stability.STABLE
    assert classify(coupled).stability is Stability.UNSTABLE


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


def test_scale_does_not_matter():
    for scale in (1e-8, 1e8):
        assert classify(scale * jordan_block(-1.0, 2)).detail == "improper"
        assert str(classify(scale * np.array([[0.0, 1.0], [-1.0, 0.0]]))) == "stable centre"


@pytest.mark.parametrize("matrix", [[[1.0, 2.0]], [[np.nan]], [1.0], np.zeros((0, 0))])
def test_bad_matrices_are_refused(matrix):
    with pytest.raises(InputError):
        classify(matrix)
