"""Matrices of integers with known eigenvalues, and eigenvalues right of the imaginary axis counted without rounding."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import scipy.linalg


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


def _divided(a: list[Fraction], b: list[Fraction]) -> tuple[list[Fraction], list[Fraction]]:
    """Quotient and remainder of polynomials, lowest power first, no zeros at their ends."""
    rest, quotient = list(a), [Fraction(0)] * max(len(a) - len(b) + 1, 0)
    while len(rest) >= len(b):
        factor, shift = rest[-1] / b[-1], len(rest) - len(b)
        quotient[shift] = factor
        for k, c in enumerate(b):
            rest[shift + k] -= factor * c
        rest = _ended(rest[:-1])
    return quotient, rest


def _ended(p: list[Fraction]) -> list[Fraction]:
    while p and p[-1] == 0:
        p = p[:-1]
    return p


def _sign_changes(values: list[Fraction]) -> int:
    signs = [v > 0 for v in values if v]
    return sum(a != b for a, b in itertools.pairwise(signs))


def characteristic(A: np.ndarray) -> list[Fraction]:
    """det(l - A), lowest power first, from its values at n + 1 points."""
    n = len(A)
    exact = [[Fraction(float(v)) for v in row] for row in A]
    size = max((abs(v) for row in exact for v in row), default=Fraction(1)) or Fraction(1)
    points = [size * k for k in range(n + 1)]
    values = [_determinant([[x * (i == j) - exact[i][j] for j in range(n)] for i in range(n)]) for x in points]
    # Newton's divided differences, multiplied out.
    table, p = list(values), [Fraction(0)]
    for k in range(1, n + 1):
        for i in range(n, k - 1, -1):
            table[i] = (table[i] - table[i - 1]) / (points[i] - points[i - k])
    for k in range(n, -1, -1):
        shifted = [Fraction(0), *p]
        p = [a - points[k] * b for a, b in zip(shifted, [*p, Fraction(0)], strict=True)]
        p[0] += table[k]
    return _ended(p)


def _determinant(rows: list[list[Fraction]]) -> Fraction:
    rows, product = [list(r) for r in rows], Fraction(1)
    for k in range(len(rows)):
        pivot = next((i for i in range(k, len(rows)) if rows[i][k]), None)
        if pivot is None:
            return Fraction(0)
        if pivot != k:
            rows[k], rows[pivot] = rows[pivot], rows[k]
            product = -product
        product *= rows[k][k]
        for i in range(k + 1, len(rows)):
            factor = rows[i][k] / rows[k][k]
            rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    return product


def left_axis_right(A: np.ndarray) -> tuple[int, int, int]:
    """How many eigenvalues of the matrix as it is written lie left of the axis, on it, and right of it."""
    p = characteristic(A)
    mirrored = [c * (-1) ** k for k, c in enumerate(p)]
    a, b = p, mirrored
    while b:
        a, b = b, _divided(a, b)[1]
    symmetric, rest = a, _divided(p, a)[0]
    left, right = _halves(rest)
    # Of the part that is symmetric about the axis: as many left as right; the derivative tells them from those on it.
    on = 0
    while len(symmetric) > 1:
        slope = _ended([k * c for k, c in enumerate(symmetric)][1:])
        # In f + f' the roots on the axis have moved to the left, and no other root has crossed it (Routh).
        a, b = symmetric, slope
        while b:
            a, b = b, _divided(a, b)[1]
        simple = _divided(symmetric, a)[0]
        derived = _ended([k * c for k, c in enumerate(simple)][1:])
        _, beyond = _halves(_ended([x + y for x, y in zip(simple, [*derived, Fraction(0)], strict=False)]))
        off = 2 * beyond
        left, right, on = left + off // 2, right + off // 2, on + len(simple) - 1 - off
        symmetric = a
    return left, on, right


def _halves(p: list[Fraction]) -> tuple[int, int]:
    """Roots left and right of the axis of a polynomial with none on it (Cauchy's index, by Euclid's algorithm)."""
    n = len(p) - 1
    if n <= 0:
        return 0, 0
    # p(iw)/i^n = f(w) - i g(w), both real.
    f = [c * (1, 0, -1, 0)[(k - n) % 4] for k, c in enumerate(p)]
    g = [-c * (0, 1, 0, -1)[(k - n) % 4] for k, c in enumerate(p)]
    chain = [_ended(f), _ended(g)]
    while chain[-1]:
        chain.append([-c for c in _divided(chain[-2], chain[-1])[1]])
    chain.pop()
    far = _sign_changes([q[-1] * (-1) ** (len(q) - 1) for q in chain]) - _sign_changes([q[-1] for q in chain])
    return (n + far) // 2, (n - far) // 2
