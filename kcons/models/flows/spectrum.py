"""Eigenvalues of a real matrix, each at its own scale: with how far it may be off, and its condition number.

Variables that act on each other in one direction only make the matrix block triangular: its eigenvalues are those of
the blocks, and small ones do not feel how large the others are. Each block is balanced (Parlett and Reinsch) and
brought to Schur form. How far a computed eigenvalue of a block may be off follows from the backward error of that,
which is of the size of the rounding of its entries.

References
----------
Golub and Van Loan, Matrix Computations, section 7.2. Demmel, Applied Numerical Linear Algebra, section 4.3.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import numbers
from kcons.errors import InputError
from kcons.models.flows.flow import FloatArray

EPSILON = float(np.finfo(np.float64).eps)

ComplexArray = NDArray[np.complex128]


class Spectrum(NamedTuple):
    """A = S T S^-1 with T upper triangular; eigenvalues in the order of its diagonal.

    Attributes
    ----------
    values : ndarray of complex, shape (n,)
    errors : ndarray, shape (n,)
        How far each may be off, for all changes of the entries by their rounding and by the errors given.
    conditions : ndarray, shape (n,)
        1/|y^H x| of the left and right eigenvectors of unit length, of the balanced matrix: by how much a change of the
        matrix is multiplied. Infinite, or near 1/(machine precision), where the matrix is defective.
    noise : ndarray, shape (n,)
        Norm of the change of its own block that was allowed for; 0 for an entry that is an eigenvalue as it stands.
    triangular : ndarray of complex, shape (n, n)
        T.
    basis : ndarray of complex, shape (n, n)
        S: a permutation, a scaling by powers of two, a unitary matrix.
    """

    values: ComplexArray
    errors: FloatArray
    conditions: FloatArray
    noise: FloatArray
    triangular: ComplexArray
    basis: ComplexArray


def square_matrix(matrix: ArrayLike) -> FloatArray:
    """A real square matrix of numbers.

    Raises
    ------
    InputError
    """
    A = numbers(matrix, "matrix")
    if A.ndim != 2 or A.shape[0] != A.shape[1] or A.size == 0:
        raise InputError(f"the matrix of a linear flow is square, not of shape {A.shape}", item="matrix")
    if not np.all(np.isfinite(A)):
        raise InputError("the matrix is not finite", item="matrix")
    return A


def spectrum(matrix: ArrayLike, error: ArrayLike = 0.0) -> Spectrum:
    """The eigenvalues of a real matrix and what is known about them.

    Parameters
    ----------
    matrix : array_like, shape (n, n)
    error : array_like, shape (n, n) or a number
        How far the entries may be off, beyond their rounding.

    Raises
    ------
    InputError
        A matrix that is not square, real and finite, or errors that are negative or do not belong to it.
    """
    A = square_matrix(matrix)
    E = numbers(error, "error")
    if E.ndim and E.shape != A.shape:
        raise InputError(f"errors are a number or of the shape of the matrix, {A.shape}, not {E.shape}", item="error")
    if not np.all(np.isfinite(E) & (E >= 0)):
        raise InputError("errors of entries are finite and not negative", item="error")
    E = np.broadcast_to(E, A.shape)
    n = len(A)
    order, blocks = _blocks((A != 0) | (E > 0))
    A, E = A[np.ix_(order, order)], E[np.ix_(order, order)]
    scaling, unitary = np.ones(n), np.zeros((n, n), dtype=np.complex128)
    values, diagonal = np.zeros(n, dtype=np.complex128), np.zeros((n, n), dtype=np.complex128)
    errors, noise = np.zeros(n), np.zeros(n)
    for at in blocks:
        size = at.stop - at.start
        if size == 1:
            values[at] = diagonal[at, at] = A[at, at]
            unitary[at, at] = 1.0
            noise[at] = E[at, at][0]
            errors[at] = EPSILON * np.abs(A[at, at][0]) + noise[at]
            continue
        # In parts of a power of two, lest norms leave the numbers.
        unit = np.exp2(np.frexp(np.max(np.abs(A[at, at]) + E[at, at]))[1] - 1.0)
        block, doubt = A[at, at] / unit, E[at, at] / unit
        _, (scaling[at], _) = scipy.linalg.matrix_balance(np.abs(block) + doubt, permute=False, separate=True)
        ratio = scaling[at] / scaling[at][:, None]
        own, triangular, unitary[at, at] = _schur(block * ratio)
        moved = size * EPSILON * np.linalg.norm(block * ratio) + np.linalg.norm(doubt * ratio)
        bounds = _bounds(triangular, float(moved))
        # Conjugates are known equally well.
        errors[at] = unit * np.max(np.where(own[:, None].conj() == own, bounds, 0.0), axis=1)
        values[at], diagonal[at, at], noise[at] = unit * own, unit * triangular, unit * moved
    T = unitary.conj().T @ (A * (scaling / scaling[:, None])) @ unitary
    for at in blocks:
        T[at.start :, at] = 0.0
        T[at, at] = diagonal[at, at]
    S = np.zeros((n, n), dtype=np.complex128)
    S[order] = scaling[:, None] * unitary
    return Spectrum(values, errors, _conditions(T), noise, T, S)


def _blocks(acts: NDArray[np.bool_]) -> tuple[NDArray[np.intp], list[slice]]:
    """An order of the variables in which the matrix is block upper triangular, and its blocks.

    Variables that act on each other, by whatever way round, make one block.
    """
    n = len(acts)
    reach = acts | np.eye(n, dtype=bool)
    while True:
        further = (reach.astype(np.float64) @ reach) > 0
        if np.array_equal(further, reach):
            break
        reach = further
    # Who is acted on from outside the block reaches fewer than who acts on it; members of one block reach the same.
    first = np.argmax(reach & reach.T, axis=1)
    order = np.lexsort((np.arange(n), first, -reach.sum(axis=1)))
    edges = [0, *(np.flatnonzero(np.diff(first[order])) + 1).tolist(), n]
    return order, [slice(a, b) for a, b in pairwise(edges)]


def _schur(block: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Eigenvalues, in exactly conjugate pairs, with T and the unitary matrix of the complex Schur form."""
    R, Q = scipy.linalg.schur(block, output="real")
    T, U = R.astype(np.complex128), Q.astype(np.complex128)
    for k in range(len(R) - 1):
        if R[k + 1, k] == 0.0:
            continue
        # [[a, b], [c, a]] with b and c of opposite signs: a +- iw, w^2 = -bc, and (b, iw) is an eigenvector.
        b, c = np.sqrt(abs(R[k, k + 1])), np.copysign(np.sqrt(abs(R[k + 1, k])), R[k, k + 1])
        turn = np.array([[b, 1j * c], [1j * c, b]]) / np.hypot(b, c)
        two = slice(k, k + 2)
        T[:, two], U[:, two] = T[:, two] @ turn, U[:, two] @ turn
        T[two] = turn.conj().T @ T[two]
        T[k + 1, k] = 0.0
        T[k, k], T[k + 1, k + 1] = R[k, k] + 1j * b * abs(c), R[k, k] - 1j * b * abs(c)
    return np.diag(T).copy(), T, U


def _bounds(T: ComplexArray, noise: float) -> FloatArray:
    """How far the eigenvalues of a triangular matrix move when it is changed by no more than `noise`.

    The smaller of two bounds: n cond_k noise (Demmel, theorem 4.5), and the one of Golub and Van Loan, theorem 7.2.3,
    which goes with a root of the noise and holds for defective matrices as well.
    """
    n = len(T)
    size = max(float(np.linalg.norm(T)), noise)
    departure = float(np.linalg.norm(np.triu(T, 1))) / size
    with np.errstate(over="ignore", invalid="ignore"):
        theta = noise / size * float(np.sum(departure ** np.arange(n)))
        by_condition = n * _conditions(T) * noise
    return np.minimum(by_condition, size * max(theta, theta ** (1.0 / n)))


def _conditions(T: ComplexArray) -> FloatArray:
    """1/|y^H x| of each eigenvalue of a triangular matrix, in the order of its diagonal."""
    _, left, right = scipy.linalg.eig(T, left=True, right=True)
    with np.errstate(divide="ignore"):
        return np.asarray(np.maximum(1.0, 1.0 / np.abs(np.einsum("ij,ij->j", left.conj(), right))))
