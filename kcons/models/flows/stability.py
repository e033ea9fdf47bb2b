"""Linear stability: named classification, and whether a linear flow stays bounded.

The notes' criterion Re lambda <= 0 (eq. 14) is completed: where Re lambda = 0, the Jordan blocks must be 1 x 1, or the
solution grows like a power of t. Eigenvalues are judged at their own scale, each with how far it may be off; a real
part smaller than that is zero only if the matrix as it is written says so exactly. Else stability cannot be told.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from kcons.models.flows.flow import FloatArray
from kcons.models.flows.imaginary_axis import on_axis
from kcons.models.flows.jordan import clusters, jordan_blocks
from kcons.models.flows.spectrum import ComplexArray, spectrum, square_matrix


class Kind(Enum):
    """What the flow looks like around an equilibrium; a real part within its error counts as zero."""

    NODE = "node"
    FOCUS = "focus"
    SADDLE = "saddle"
    CENTRE = "centre"
    DEGENERATE = "degenerate"


class Stability(Enum):
    """What becomes of a small deviation."""

    ASYMPTOTIC = "asymptotically stable"
    STABLE = "stable"
    UNSTABLE = "unstable"
    #: No eigenvalue is known to lie to the right of the axis, and not all are known to lie left of it or on it.
    UNKNOWN = "cannot be told"


class Classification(NamedTuple):
    """Kind and stability of a linear flow.

    Attributes
    ----------
    kind : Kind
    stability : Stability
    detail : str
        'star' or 'improper' for nodes with one eigenvalue only; 'saddle-focus'; otherwise empty.
    eigenvalues : ndarray of complex, shape (n,)
        Sorted by real part, largest first.
    hyperbolic : bool
        Whether all real parts are known not to vanish. Only then does the linear flow decide about the stability of an
        equilibrium of a flow that is not linear.
    errors : ndarray, shape (n,)
        How far each eigenvalue may be off.
    conditions : ndarray, shape (n,)
        The condition number of each eigenvalue, of the balanced matrix; infinite or nearly so for a defective one.
    """

    kind: Kind
    stability: Stability
    detail: str
    eigenvalues: ComplexArray
    hyperbolic: bool
    errors: FloatArray
    conditions: FloatArray

    def __str__(self) -> str:
        named = self.detail.endswith(self.kind.value) or not self.detail
        name = (self.detail or self.kind.value) if named else f"{self.detail} {self.kind.value}"
        if self.stability is Stability.UNKNOWN:
            return f"{name} whose stability cannot be told"
        return f"{self.stability.value} {name}"


def classify(matrix: ArrayLike, error: ArrayLike = 0.0) -> Classification:
    """Name the flow dX/dt = A X (notes eq. 14, completed).

    Node: all eigenvalues real and of one sign; focus: real parts of one sign, some eigenvalues complex; saddle: real
    parts of both signs; centre: all purely imaginary; degenerate: an eigenvalue 0, or zero real parts among others.

    Parameters
    ----------
    matrix : array_like, shape (n, n)
    error : array_like, shape (n, n) or a number
        How far the entries may be off, beyond their rounding: of a Jacobian by differences, for example. Without any,
        real parts of exactly zero are found, for up to 24 variables.

    Raises
    ------
    InputError
        A matrix that is not square, real and finite, or errors that do not belong to it.
    """
    A = square_matrix(matrix)
    found = spectrum(A, error)
    groups = clusters(found.values, found.errors)
    means, signs = [], []
    for group in groups:
        real, off = found.values[group].real, found.errors[group]
        means.append(complex(np.mean(found.values[group])))
        signs.append(1 if np.all(real > off) else -1 if np.all(real < -off) else 0)
    off_zero = [abs(m) > max(found.errors[g]) for m, g in zip(means, groups, strict=True)]
    turning = any(abs(m.imag) > max(found.errors[g]) for m, g in zip(means, groups, strict=True))
    kind, detail = _kind(set(signs), not all(off_zero), turning)
    if kind is Kind.NODE and len(groups) == 1 and len(A) > 1:
        blocks = jordan_blocks(A, error)
        if len(blocks) == 1:
            detail = "star" if blocks[0].sizes[0] == 1 else "improper"
    stability = _stability(signs, groups, A, exact=not np.any(error))
    order = np.lexsort((-found.values.imag, -found.values.real))
    return Classification(
        kind, stability, detail, found.values[order], 0 not in signs, found.errors[order], found.conditions[order]
    )


def _kind(signs: set[int], zero: bool, turning: bool) -> tuple[Kind, str]:
    """From the signs of the real parts; whether an eigenvalue is 0, and whether one is complex."""
    if zero or (0 in signs and len(signs) == 2):
        return Kind.DEGENERATE, ""
    if signs == {0}:
        return Kind.CENTRE, ""
    if len(signs) > 1:
        return Kind.SADDLE, "saddle-focus" if turning and 0 not in signs else ""
    return (Kind.FOCUS if turning else Kind.NODE), ""


def _stability(signs: list[int], groups: list[np.ndarray], A: FloatArray, *, exact: bool) -> Stability:
    if 1 in signs:
        return Stability.UNSTABLE
    unknown = sum(len(g) for g, sign in zip(groups, signs, strict=True) if sign == 0)
    if not unknown:
        return Stability.ASYMPTOTIC
    axis = on_axis(A) if exact else None
    if axis is None or axis.zero + axis.imaginary != unknown:
        return Stability.UNKNOWN
    return Stability.STABLE if axis.bounded else Stability.UNSTABLE
