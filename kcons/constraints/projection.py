"""The theory, literally and densely: the oracle against which the fast engine is tested.

Pure functions on arrays. A is s x 3N, one row a constraint; M is diagonal, given as the masses of the
N atoms (or as 3N numbers). f and accelerations have length 3N or shape (N, 3) and come back as they came.
Generalized inverses, solvability and the projectors P take complex matrices too (appendix A.1); a mechanical system
is real, and its functions refuse complex numbers.
Cost grows as the cube of 3N: for systems of up to some hundred atoms, and for reading.

The mass-weighted matrix is B = A M^-1/2. Written with B+ in place of an inverse, every formula holds
for dependent rows as well: z, the acceleration and M_par+ are unique, and lambda is the one of least norm.

Equation numbers are those of the notes (G. R. Kneller, Systemes dynamiques); 'corrected' marks the
lines where their misprints were put right, see docs/equations.md.

References
----------
Bott & Duffin, Trans. AMS 74, 99 (1953). Penrose, Proc. Camb. Phil. Soc. 51, 406 (1955).
Gauss, J. reine angew. Math. 4, 232 (1829). Kneller, J. Chem. Phys. 125, 114107 (2006).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from kcons.errors import ContradictionError, InputError

FloatArray = NDArray[np.float64]
#: float64, or complex128 where a matrix or vector given is complex.
NumberArray = NDArray[Any]

#: Singular values of the row-normalized matrix below this part of the largest count as zero.
RANK_TOLERANCE = 1e-10
#: Rows contradict each other where b leaves the range of A by more than this part of its size.
SOLVABILITY_TOLERANCE = 1e-9


class PseudoInverse(NamedTuple):
    """A Moore-Penrose inverse A+, shape (n, s), and the rank of A."""

    matrix: NumberArray
    rank: int


class BottDuffinSolution(NamedTuple):
    """What solves the Bott-Duffin problem: the acceleration and the constraint force."""

    acceleration: FloatArray
    constraint_force: FloatArray


# -- generalized inverses (appendix A.1) ------------------------------------------------------------


def pseudo_inverse(matrix: ArrayLike) -> PseudoInverse:
    """A+, through the singular values of the row-normalized matrix (notes eqs. 154-158).

    The rank is found on rows of unit length, so that it does not depend on the units of the rows. With V an orthonormal
    basis of the row space, A = (A V) V^H is a full-rank factorisation and A+ = V (A V)+.
    """
    A = _matrix(matrix)
    V = row_space(A)
    return PseudoInverse(V @ _left_inverse(A @ V), V.shape[1])


def row_space(matrix: ArrayLike) -> NumberArray:
    """Orthonormal basis V of the space that the (conjugate) rows span, shape (n, rank); A+A = V V^H."""
    A = _matrix(matrix)
    return _row_space(A / _row_sizes(A)[:, None])


def full_rank_factors(matrix: ArrayLike) -> tuple[NumberArray, NumberArray]:
    """A = F G with F (s, r) and G (r, n), both of rank r (notes eq. 159).

    By QR with row exchanges, without any singular values: a second way to the rank and to A+.
    """
    A = _matrix(matrix)
    if A.size == 0:
        return np.zeros((len(A), 0), dtype=A.dtype), np.zeros((0, A.shape[1]), dtype=A.dtype)
    sizes = _row_sizes(A)
    Q, R, order = scipy.linalg.qr((A / sizes[:, None]).conj().T, mode="economic", pivoting=True)
    pivots = np.abs(np.diag(R))
    r = int(np.sum(pivots > RANK_TOLERANCE * pivots[0])) if pivots[0] > 0 else 0
    F = np.empty((len(A), r), dtype=A.dtype)
    F[order] = R[:r].conj().T
    return F * sizes[:, None], np.ascontiguousarray(Q[:, :r].conj().T)


def full_rank_pseudo_inverse(F: ArrayLike, G: ArrayLike) -> NumberArray:
    """A+ = G^H (G G^H)^-1 (F^H F)^-1 F^H of A = F G (notes eq. 160, corrected; H is T for real factors).

    As it is printed: the condition numbers of F and G enter squared.
    """
    F, G = _matrix(F), _matrix(G)
    Fh, Gh = F.conj().T, G.conj().T
    return np.asarray(Gh @ np.linalg.solve(G @ Gh, np.linalg.solve(Fh @ F, Fh)))


def penrose_residuals(matrix: ArrayLike, inverse: ArrayLike) -> FloatArray:
    """How far X is from being A+: violations of A X A = A, X A X = X, (A X)^H = A X, (X A)^H = X A (eqs. 154-157).

    Each residual is taken with the rows of A scaled to unit length (and X accordingly), relative to the size of the
    products it is made of: it counts roundings, whatever the units of the rows.
    """
    A, X = _matrix(matrix), _matrix(inverse)
    if X.shape != A.shape[::-1]:
        raise InputError(f"the inverse of a {A.shape} matrix has shape {A.shape[::-1]}, not {X.shape}", item="inverse")
    if A.size == 0:
        return np.zeros(4)
    sizes = _row_sizes(A)
    U, Y = A / sizes[:, None], X * sizes
    UY, YU = U @ Y, Y @ U
    u, y = np.linalg.norm(U, 2), np.linalg.norm(Y, 2)
    # A X = D (U Y) D^-1: its symmetry is one of D and U Y together.
    ratio = sizes[:, None] / sizes
    left = (ratio * UY - (ratio * UY).conj().T) / (ratio + ratio.T)
    off = [np.max(np.abs(R)) for R in (UY @ U - U, YU @ Y - Y, left, YU - YU.conj().T)]
    scale = np.array([u * y * u + u, y * u * y + y, u * y, u * y])
    return np.where(scale > 0, off / np.where(scale > 0, scale, 1.0), np.where(off, np.inf, 0.0))


def general_solution(matrix: ArrayLike, b: ArrayLike, y: ArrayLike) -> NumberArray:
    """x = A+ b + (1 - A+ A) y, every solution of A x = b as y runs over all vectors (notes eq. 163).

    Where A x = b has none, every x that makes the residual b - A x least; A+ b is the shortest (notes eqs. 167, 168).
    """
    A = _matrix(matrix)
    y = _numbers(y, "y")
    x = pseudo_inverse(A).matrix @ _vector(b, len(A), "b") + parallel_projector(A) @ y.ravel()
    return np.asarray(x).reshape(y.shape)


# -- solvability (eq. 95) ---------------------------------------------------------------------------


def _unsolved(matrix: ArrayLike, b: ArrayLike) -> FloatArray:
    """|A A+ b - b| row by row, rows of A scaled to unit length, shape (s,); 0 where it is within the tolerance."""
    A = _matrix(matrix)
    sizes = _row_sizes(A)
    b = _vector(b, len(A), "b") / sizes
    W = _row_space((A / sizes[:, None]).conj().T)
    miss = np.abs(W @ (W.conj().T @ b) - b)
    return miss * (miss > SOLVABILITY_TOLERANCE * np.max(np.abs(b), initial=0.0))


def is_solvable(matrix: ArrayLike, b: ArrayLike) -> bool:
    """Whether A A+ b = b: the rows do not contradict each other (notes eqs. 95, 162)."""
    return not _unsolved(matrix, b).any()


def require_solvable(matrix: ArrayLike, b: ArrayLike) -> None:
    """Raise `ContradictionError`, which names the rows that are off, where A A+ b differs from b (notes eq. 95)."""
    miss = _unsolved(matrix, b)
    if not miss.any():
        return
    worst = int(np.argmax(miss))
    rows = np.flatnonzero(miss > 1e-3 * miss[worst])
    raise ContradictionError(
        f"the rows contradict each other: A A+ b differs from b by {miss[worst]:.3g} in row {worst} (scaled to unit "
        f"length). Rows concerned: {', '.join(map(str, rows[:10]))}{', ...' if len(rows) > 10 else ''}; "
        "remove one of them or change its target",
        rows=rows.tolist(),
    )


# -- projectors (eqs. 96, 97) -----------------------------------------------------------------------


def perpendicular_projector(matrix: ArrayLike) -> NumberArray:
    """P_perp = A+ A onto the space of constraint forces (notes eq. 97)."""
    V = row_space(matrix)
    return np.asarray(V @ V.conj().T)


def parallel_projector(matrix: ArrayLike) -> NumberArray:
    """P_par = 1 - A+ A onto the space of admissible displacements (notes eq. 96)."""
    P = perpendicular_projector(matrix)
    return np.eye(len(P)) - P


def project_velocities(matrix: ArrayLike, masses: ArrayLike, v: ArrayLike, c: ArrayLike | float = 0.0) -> FloatArray:
    """The nearest velocities, in the mass metric, with A v = c: v - M^-1/2 B+ (A v - c)."""
    A, root, B = _weighted(matrix, masses)
    flat = _vector(v, A.shape[1], "v", real=True)
    off = A @ flat - np.broadcast_to(_numbers(c, "c", real=True), (len(A),))
    return np.asarray(flat - pseudo_inverse(B).matrix @ off / root).reshape(np.shape(v))


# -- dynamics (eqs. 99-107) -------------------------------------------------------------------------


def constrained_inverse(matrix: ArrayLike, masses: ArrayLike) -> FloatArray:
    """M_par+ = (P_par M P_par)+ = M^-1/2 (1 - B+ B) M^-1/2, shape (3N, 3N) (notes eqs. 106, 107).

    With independent rows it is M^-1 - M^-1 A^T (A M^-1 A^T)^-1 A M^-1.
    """
    _, root, B = _weighted(matrix, masses)
    return np.asarray(parallel_projector(B) / root / root[:, None])


def multipliers(matrix: ArrayLike, masses: ArrayLike, f: ArrayLike, b: ArrayLike) -> FloatArray:
    """The multipliers of z = A^T lambda, shape (s,); of least norm, in the rows as they are (notes eqs. 101-103).

    (A M^-1 A^T) lambda = b - A M^-1 f, solved by (B B^T)+ = (B+)^T B+.
    """
    A, root, B = _weighted(matrix, masses)
    B_plus = pseudo_inverse(B).matrix
    return np.asarray(B_plus.T @ (B_plus @ _lacking(A, root, f, b)))


def constraint_force(matrix: ArrayLike, masses: ArrayLike, f: ArrayLike, b: ArrayLike) -> FloatArray:
    """The force z = A^T (A M^-1 A^T)^-1 (b - A M^-1 f) = M^1/2 B+ (b - A M^-1 f), as f (notes eq. 104)."""
    A, root, B = _weighted(matrix, masses)
    z = root * (pseudo_inverse(B).matrix @ _lacking(A, root, f, b))
    return np.asarray(z).reshape(np.shape(f))


def acceleration(matrix: ArrayLike, masses: ArrayLike, f: ArrayLike, b: ArrayLike) -> FloatArray:
    """M_par+ f + M^-1 A^T (A M^-1 A^T)^-1 b, in the shape of f (notes eq. 105, corrected).

    The notes lost the M^-1 in front of A^T. In mass-weighted form the second term is M^-1/2 B+ b.
    """
    A, root, B = _weighted(matrix, masses)
    free = constrained_inverse(A, masses) @ _vector(f, A.shape[1], "f", real=True)
    driven = pseudo_inverse(B).matrix @ _vector(b, len(A), "b", real=True) / root
    return np.asarray(free + driven).reshape(np.shape(f))


def bott_duffin(matrix: ArrayLike, masses: ArrayLike, f: ArrayLike, b: ArrayLike) -> BottDuffinSolution:
    """Acceleration and constraint force as one linear problem (notes eqs. 98-100).

    M (a_par + A+ b) = f + z with a_par in V_par and z in V_perp. Both parts sit in one vector u, with
    a_par = P_par u and z = P_perp u, and (M P_par - P_perp) u = f - M A+ b has one solution. No mass-weighted
    matrix and no multipliers: an independent way to the same answer.
    """
    A = _matrix(matrix, real=True)
    n = A.shape[1]
    m = _masses(masses, n)
    P_perp = perpendicular_projector(A)
    P_par = np.eye(n) - P_perp
    a_perp = pseudo_inverse(A).matrix @ _vector(b, len(A), "b", real=True)
    # P_perp u may be given any unit: one of mass keeps both parts of the matrix of one size.
    unit = float(np.exp(np.mean(np.log(m))))
    u = np.linalg.solve(m[:, None] * P_par - unit * P_perp, _vector(f, n, "f", real=True) - m * a_perp)
    shape = np.shape(f)
    return BottDuffinSolution((P_par @ u + a_perp).reshape(shape), unit * (P_perp @ u).reshape(shape))


def gauss_function(trial: ArrayLike, masses: ArrayLike, f: ArrayLike) -> float:
    """Gauss's constraint of a trial acceleration, (1/2) |M^-1/2 (M a - f)|^2 (notes eqs. 89, 123).

    Among all accelerations with A a = b the true one has the least; there it is (1/2) z^T M^-1 z.
    """
    a = _numbers(trial, "trial", real=True).ravel()
    m = _masses(masses, len(a))
    off = m * a - _vector(f, len(a), "f", real=True)
    return float(0.5 * np.sum(off * off / m))


# -- pieces -----------------------------------------------------------------------------------------


def _numbers(values: ArrayLike, item: str, real: bool = False) -> NumberArray:
    """float64 or complex128; nothing of a number is dropped."""
    if isinstance(values, np.ma.MaskedArray):
        raise InputError(f"{item} is a masked array: give its numbers, filled or left out", item=item)
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise InputError(f"{item} is no array of numbers: {error}", item=item) from None
    if array.dtype.kind not in "biufc":
        raise InputError(f"{item} holds {array.dtype}, not numbers", item=item)
    if real and array.dtype.kind == "c":
        raise InputError(f"{item} is complex, but a mechanical system is real: give the real part", item=item)
    return array.astype(np.complex128 if array.dtype.kind == "c" else np.float64, copy=False)


def _matrix(values: ArrayLike, real: bool = False) -> NumberArray:
    array = _numbers(values, "matrix", real)
    if array.ndim != 2:
        raise InputError(f"a matrix has two axes, not shape {array.shape}", item="matrix")
    if not np.all(np.isfinite(array)):
        row = int(np.argmin(np.isfinite(array).all(axis=1)))
        raise InputError(f"row {row} of the matrix has a NaN or infinity", item="matrix")
    return array


def _vector(values: ArrayLike, length: int, item: str, real: bool = False) -> NumberArray:
    array = _numbers(values, item, real).ravel()
    if len(array) != length:
        raise InputError(f"{item} must have {length} entries, not {len(array)}", item=item)
    return array


def _weighted(matrix: ArrayLike, masses: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A, the diagonal of M^1/2, and B = A M^-1/2."""
    A = _matrix(matrix, real=True)
    root = np.sqrt(_masses(masses, A.shape[1]))
    return A, root, A / root


def _lacking(A: FloatArray, root: FloatArray, f: ArrayLike, b: ArrayLike) -> FloatArray:
    """b - A M^-1 f."""
    free = _vector(f, A.shape[1], "f", real=True) / root**2
    return np.asarray(_vector(b, len(A), "b", real=True) - A @ free)


def _masses(masses: ArrayLike, n: int) -> FloatArray:
    """The diagonal of M, shape (n,), of n/3 or n masses (notes eq. 79)."""
    m = _numbers(masses, "masses", real=True).ravel()
    m = np.repeat(m, 3) if 3 * m.size == n else m
    if len(m) != n:
        raise InputError(f"masses must have {n // 3} or {n} entries, not {len(m)}", item="masses")
    if not np.all(np.isfinite(m) & (m > 0)):
        raise InputError("masses must be positive and finite; hold an atom by three rows instead", item="masses")
    return m


def _row_sizes(A: NumberArray) -> FloatArray:
    """Lengths of the rows, 1 for rows that vanish, shape (s,)."""
    # In parts of a power of two near the largest entry, lest squares overflow or vanish.
    unit = np.exp2(np.frexp(np.max(np.abs(A), axis=1, initial=0.0))[1] - 1.0)
    sizes = np.asarray(unit * np.linalg.norm(A / unit[:, None], axis=1))
    return np.where(sizes > 0, sizes, 1.0)


def _row_space(A: NumberArray) -> NumberArray:
    """Orthonormal basis of what the conjugate rows span, by singular values."""
    _, singular, vt = np.linalg.svd(A, full_matrices=False)
    kept = (singular > RANK_TOLERANCE * singular.max(initial=0.0)) & (singular > 0)
    return np.ascontiguousarray(vt[kept].conj().T)


def _left_inverse(F: NumberArray) -> NumberArray:
    """F+ = (F^H F)^-1 F^H of a matrix with independent columns.

    By QR with the long rows first and columns exchanged, which keeps the digits of short rows.
    """
    order = np.argsort(-_row_sizes(F) * np.any(F, axis=1), kind="stable")
    found = scipy.linalg.lstsq(F[order], np.eye(len(F))[order], cond=0.0, lapack_driver="gelsy")
    return np.asarray(found[0])
