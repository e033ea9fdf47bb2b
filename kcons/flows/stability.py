"""Linear stability: Jordan structure, named classification, and whether a linear flow stays bounded.

The notes' criterion Re lambda <= 0 (eq. 14) is completed: where Re lambda = 0, the Jordan blocks must be 1 x 1, or the
solution grows like a power of t.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from kcons.errors import InputError
from kcons.flows.flow import FloatArray

#: Eigenvalues closer than this, in parts of the norm of A, count as one: those of a block of size 2 or 3 come out no
#: better than eps^(1/2), eps^(1/3).
CLUSTER = 2e-5
#: A real or imaginary part below this part of the norm counts as zero.
ZERO = 1e-9


class Kind(Enum):
    """What the flow looks like around an equilibrium."""

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


class JordanBlocks(NamedTuple):
    """One eigenvalue and the sizes of its blocks (notes eqs. 11, 12), largest first."""

    eigenvalue: complex
    sizes: tuple[int, ...]


class Classification(NamedTuple):
    """Kind and stability of a linear flow.

    Attributes
    ----------
    kind : Kind
    stability : Stability
    detail : str
        'star' or 'improper' for nodes with one eigenvalue only; 'saddle-focus'; otherwise empty.
    eigenvalues : ndarray of complex, shape (n,)
    hyperbolic : bool
        Whether no eigenvalue has a vanishing real part. Only then does the linear flow decide about the stability of
        an equilibrium of a flow that is not linear.
    """

    kind: Kind
    stability: Stability
    detail: str
    eigenvalues: NDArray[np.complex128]
    hyperbolic: bool

    def __str__(self) -> str:
        return f"{self.stability.value} {self.detail + ' ' if self.detail else ''}{self.kind.value}"


def jordan_blocks(matrix: ArrayLike, cluster: float = CLUSTER) -> list[JordanBlocks]:
    """Eigenvalues and block sizes, sorted by real part, largest first (notes eqs. 10-12).

    The sizes follow from the ranks of the powers of A - lambda on the invariant subspace of each group of eigenvalues.
    They are not continuous in A; `cluster` says what counts as equal.
    """
    A = _square(matrix)
    scale = max(float(np.linalg.norm(A, 2)), np.finfo(np.float64).tiny)
    T, _ = scipy.linalg.schur(A, output="complex")
    groups = _groups(np.diag(T), cluster * scale)
    blocks = []
    for group in groups:
        mean = complex(np.mean(group))
        near = 1.5 * max((abs(v - mean) for v in group), default=0.0) + 1e-12 * scale

        def inside(v: complex, mean: complex = mean, near: float = near) -> bool:
            return abs(v - mean) <= near

        T, _, m = scipy.linalg.schur(A, output="complex", sort=inside)
        N = T[:m, :m] - mean * np.eye(m)
        blocks.append(JordanBlocks(_clean(mean, scale), _sizes(N, cluster, scale)))
    return sorted(blocks, key=lambda b: (-round(b.eigenvalue.real / scale, 9), -b.eigenvalue.imag))


def _groups(values: NDArray[np.complex128], distance: float) -> list[list[complex]]:
    """Eigenvalues that lie together, each within `distance` of another of its group."""
    groups: list[list[complex]] = []
    for value in values:
        touching = [g for g in groups if any(abs(value - other) <= distance for other in g)]
        merged = [complex(value)] + [v for g in touching for v in g]
        groups = [g for g in groups if g not in touching] + [merged]
    return groups


def _sizes(N: NDArray[np.complex128], cluster: float, scale: float) -> tuple[int, ...]:
    """Block sizes of a matrix that is nilpotent but for round-off."""
    m = len(N)
    # How many blocks there are of size k and more: the drop in rank from N^(k-1) to N^k.
    ranks, power = [m], np.eye(m, dtype=np.complex128)
    for k in range(1, m + 1):
        power = power @ N
        singular = np.linalg.svd(power, compute_uv=False)
        ranks.append(int(np.sum(singular > cluster * scale**k)))
    ranks.append(0)
    drops = [ranks[k - 1] - ranks[k] for k in range(1, m + 1)]
    sizes: list[int] = []
    for k in range(m, 0, -1):
        exactly = drops[k - 1] - (drops[k] if k < m else 0)
        sizes += [k] * max(exactly, 0)
    return tuple(sizes)


def _clean(value: complex, scale: float) -> complex:
    """The eigenvalue without parts that are round-off."""
    real = value.real if abs(value.real) > ZERO * scale else 0.0
    imag = value.imag if abs(value.imag) > ZERO * scale else 0.0
    return complex(real, imag)


def classify(matrix: ArrayLike, cluster: float = CLUSTER) -> Classification:
    """Name the flow dX/dt = A X.

    Node: all eigenvalues real and of one sign; focus: real parts of one sign, some eigenvalues complex; saddle: real
    parts of both signs; centre: all purely imaginary; degenerate: an eigenvalue 0, or zero real parts among others.

    Raises
    ------
    InputError
        A matrix that is not square or not finite.
    """
    A = _square(matrix)
    blocks = jordan_blocks(A, cluster)
    values = [b.eigenvalue for b in blocks]
    # The sign of a real part: of the group, since the members of a defective one scatter.
    signs = {int(np.sign(v.real)) for v in values}
    complex_ = any(v.imag != 0 for v in values)
    detail = ""
    if any(v == 0 for v in values) or (0 in signs and len(signs) > 1):
        kind = Kind.SADDLE if {1, -1} <= signs and all(v != 0 for v in values) else Kind.DEGENERATE
    elif signs == {0}:
        kind = Kind.CENTRE
    elif len(signs) > 1:
        kind = Kind.SADDLE
        detail = "saddle-focus" if complex_ else ""
    elif complex_:
        kind = Kind.FOCUS
    else:
        kind = Kind.NODE
        if len(values) == 1 and len(A) > 1:
            detail = "star" if blocks[0].sizes[0] == 1 else "improper"
    if 1 in signs or any(b.eigenvalue.real == 0 and b.sizes[0] > 1 for b in blocks):
        stability = Stability.UNSTABLE
    else:
        stability = Stability.STABLE if 0 in signs else Stability.ASYMPTOTIC
    return Classification(kind, stability, detail, np.linalg.eigvals(A).astype(np.complex128), 0 not in signs)


def _square(matrix: ArrayLike) -> FloatArray:
    A = np.asarray(matrix, dtype=np.float64)
    if A.ndim != 2 or A.shape[0] != A.shape[1] or A.size == 0:
        raise InputError(f"the matrix of a linear flow is square, not of shape {A.shape}", item="matrix")
    if not np.all(np.isfinite(A)):
        raise InputError("the matrix is not finite", item="matrix")
    return A
