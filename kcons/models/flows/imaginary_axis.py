"""Whether eigenvalues lie on the imaginary axis exactly: in integers, of a matrix as it is written.

A real part of zero is no matter of accuracy: the least change of an entry makes it positive or negative. Only a matrix
whose numbers are meant as they stand has one, and there it can be decided, since doubles are integers times a power of
two. Eigenvalues iw are common roots of the even and the odd part of the characteristic polynomial.
"""

from __future__ import annotations

import itertools
import math
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcons.models.flows.flow import FloatArray

#: Variables up to which the polynomials are worth their time.
LARGEST = 24

#: Coefficients, that of the highest power first; none for the polynomial 0.
Polynomial = list[Fraction]


class OnAxis(NamedTuple):
    """Eigenvalues with a real part of exactly zero.

    Attributes
    ----------
    zero : int
        How many are 0, by multiplicity.
    imaginary : int
        How many others lie on the axis, by multiplicity.
    bounded : bool
        Whether all their Jordan blocks have size 1, so that no power of t grows; asked only where no eigenvalue has its
        negative off the axis.
    """

    zero: int
    imaginary: int
    bounded: bool


def on_axis(matrix: FloatArray) -> OnAxis | None:
    """The eigenvalues on the axis, or None for a matrix with more than `LARGEST` variables."""
    n = len(matrix)
    if n > LARGEST:
        return None
    entries = [[Fraction(float(v)) for v in row] for row in matrix]
    unit = max(v.denominator for row in entries for v in row)
    A = np.array([[int(v * unit) for v in row] for row in entries], dtype=object)
    p = [Fraction(c) for c in _characteristic(A)]
    zero = n + 1 - len(_trimmed(p[::-1]))
    rest = p[: n + 1 - zero]
    # p(l) = E(l^2) + l O(l^2): common roots s = l^2, each with its multiplicity.
    even, odd = _trimmed(rest[::-1][0::2][::-1]), _trimmed(rest[::-1][1::2][::-1])
    factors = _square_free(_common(even, odd)) if odd else _square_free(even)
    imaginary = 2 * sum(k * _negative_roots(f) for k, f in enumerate(factors, start=1))
    if zero <= 1 and len(factors) <= 1:
        return OnAxis(zero, imaginary, True)
    # The least polynomial of A has simple roots on the axis if this one, with each of them once, vanishes at A.
    least = rest
    for k, f in enumerate(factors, start=1):
        squared = [c for pair in zip(f, [Fraction(0)] * len(f), strict=True) for c in pair][:-1]
        for _ in range(k - 1):
            least = _divided(least, squared)[0]
    least = least + [Fraction(0)] * min(zero, 1)
    common = math.lcm(*(c.denominator for c in least))
    value = np.zeros((n, n), dtype=object)
    for c in least:
        value = value @ A + int(c * common) * np.eye(n, dtype=object)
    return OnAxis(zero, imaginary, not np.any(value))


def _characteristic(A: NDArray[Any]) -> list[int]:
    """det(l - A) of integers, by Faddeev's and Leverrier's recursion."""
    n = len(A)
    unit = np.array([[int(i == j) for j in range(n)] for i in range(n)], dtype=object)
    M, c = np.zeros((n, n), dtype=object), [1]
    for k in range(1, n + 1):
        M = A @ M + c[-1] * unit
        c.append(-int(np.trace(A @ M)) // k)
    return c


def _trimmed(p: Polynomial) -> Polynomial:
    first = next((k for k, c in enumerate(p) if c), len(p))
    return p[first:]


def _divided(a: Polynomial, b: Polynomial) -> tuple[Polynomial, Polynomial]:
    """Quotient and remainder."""
    quotient, rest = [], list(a)
    while len(rest) >= len(b):
        factor = rest[0] / b[0]
        quotient.append(factor)
        rest = [r - factor * (b[k] if k < len(b) else 0) for k, r in enumerate(rest)][1:]
    return quotient, _trimmed(rest)


def _common(a: Polynomial, b: Polynomial) -> Polynomial:
    """The greatest common divisor, its leading coefficient 1."""
    while b:
        a, b = b, _divided(a, b)[1]
        b = [c / abs(b[0]) for c in b]
    return [c / a[0] for c in a]


def _derivative(p: Polynomial) -> Polynomial:
    return [c * (len(p) - 1 - k) for k, c in enumerate(p[:-1])]


def _square_free(p: Polynomial) -> list[Polynomial]:
    """Factors of which the k-th has the roots of multiplicity k, each once (Yun)."""
    factors: list[Polynomial] = []
    if len(p) <= 1:
        return factors
    slope = _derivative(p)
    shared = _common(p, slope)
    b, c = _divided(p, shared)[0], _divided(slope, shared)[0]
    while len(b) > 1:
        steps = _derivative(b)
        width = max(len(c), len(steps))
        d = _trimmed([x - y for x, y in zip(_padded(c, width), _padded(steps, width), strict=True)])
        factor = _common(b, d)
        factors.append(factor)
        b, c = _divided(b, factor)[0], _divided(d, factor)[0]
    return factors


def _padded(p: Polynomial, width: int) -> Polynomial:
    return [Fraction(0)] * (width - len(p)) + p


def _negative_roots(p: Polynomial) -> int:
    """How many roots of a polynomial without double roots, and not 0 at 0, are negative (Sturm)."""
    if len(p) <= 1:
        return 0
    chain = [p, _derivative(p)]
    while len(chain[-1]) > 1:
        rest = [-c for c in _divided(chain[-2], chain[-1])[1]]
        chain.append([c / abs(rest[0]) for c in rest])
    far = [q[0] * (-1) ** (len(q) - 1) for q in chain]
    near = [q[-1] for q in chain]
    return _changes(far) - _changes(near)


def _changes(values: list[Fraction]) -> int:
    signs = [v > 0 for v in values if v]
    return sum(a != b for a, b in itertools.pairwise(signs))
