"""Matrices of integers with known eigenvalues, and eigenvalues right of the imaginary axis counted without rounding."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import scipy.linalg
import sympy

L = sympy.Symbol("L")


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
    """How many eigenvalues of the matrix as it is written lie left of the axis, on it, and right of it."""
    p = sympy.Poly(sympy.Matrix(len(A), len(A), [sympy.Rational(float(v)) for v in A.ravel()]).charpoly(L).as_expr(), L)
    symmetric = p.gcd(p.compose(sympy.Poly(-L, L)))
    left, right = _halves(p.quo(symmetric))
    # Of the part that is symmetric about the axis: as many left as right; the derivative tells them from those on it.
    on = 0
    while symmetric.degree() > 0:
        repeated = symmetric.gcd(symmetric.diff())
        simple = symmetric.quo(repeated)
        # In f + f' the roots on the axis have moved to the left, and no other root has crossed it (Routh).
        _, beyond = _halves(simple + simple.diff())
        left, right, on = left + beyond, right + beyond, on + simple.degree() - 2 * beyond
        symmetric = repeated
    return left, on, right


def _halves(p: sympy.Poly) -> tuple[int, int]:
    """Roots left and right of the axis of a polynomial with none on it (Cauchy's index, by Euclid's algorithm)."""
    n = p.degree()
    # p(iw)/i^n = f(w) - i g(w), both real.
    powers = [(k, c, (k - n) % 4) for (k,), c in p.terms()]
    f = sum(c * (1, 0, -1, 0)[turn] * L**k for k, c, turn in powers)
    g = sum(-c * (0, 1, 0, -1)[turn] * L**k for k, c, turn in powers)
    chain = [sympy.Poly(f, L), sympy.Poly(g, L)]
    while not chain[-1].is_zero:
        chain.append(-chain[-2].rem(chain[-1]))
    ends = [[side ** q.degree() * q.LC() > 0 for q in chain[:-1]] for side in (-1, 1)]
    below, above = (sum(a != b for a, b in itertools.pairwise(signs)) for signs in ends)
    return (n + below - above) // 2, (n - below + above) // 2
