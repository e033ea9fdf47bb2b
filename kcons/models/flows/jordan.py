"""The Jordan form as far as double precision allows (notes eqs. 10-13).

Block sizes are not continuous in the matrix: next to any matrix lie others whose eigenvalues are all different. What
numbers of finite precision can say is that a matrix lies within its rounding of one with the structure found. That is
what is looked for here: eigenvalues that rounding may make equal are taken together, brought to the top of the Schur
form, and what is left there after their mean is a nilpotent matrix up to rounding, whose null spaces, one after the
other, give the sizes (Kublanovskaya's staircase) and chains of generalized eigenvectors.

References
----------
Golub and Wilkinson, SIAM Review 18, 578 (1976). Kagstrom and Ruhe, ACM Trans. Math. Softw. 6, 398 (1980).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from kcons.models.flows.flow import FloatArray
from kcons.models.flows.spectrum import EPSILON, ComplexArray, Spectrum, spectrum

#: Singular values below this many times the noise of a block count as zero.
NULL = 100.0
#: Structures stand out where the least singular value that counts is so many times the largest that does not.
STANDS_OUT = 10.0
#: Eigenvalues that have no common structure are tried again as if known this many times better.
CLOSER = 8.0


class JordanBlocks(NamedTuple):
    """One eigenvalue and the sizes of its blocks (notes eqs. 11, 12).

    Attributes
    ----------
    eigenvalue : complex
        The mean of those that were taken as one.
    sizes : tuple of int
        Largest first; (1, 1) is two blocks of size 1.
    certain : bool
        Whether the structure stands out from rounding: no other eigenvalue lies so near that it might belong to these,
        and no coupling is so weak that it might be none. If not, it is one of several that the matrix may have.
    distance : float
        A matrix with this structure exactly lies so near, in parts of the norm of the (balanced) matrix.
    """

    eigenvalue: complex
    sizes: tuple[int, ...]
    certain: bool
    distance: float


class JordanForm(NamedTuple):
    """A = T J T^-1 (notes eq. 10).

    Attributes
    ----------
    T : ndarray of complex, shape (n, n)
        Chains of generalized eigenvectors, those of a block side by side.
    J : ndarray of complex, shape (n, n)
    blocks : list of JordanBlocks
        In the order of J.
    """

    T: ComplexArray
    J: ComplexArray
    blocks: list[JordanBlocks]

    def propagator(self, t: float) -> ComplexArray:
        """T exp(Jt) T^-1, block by block, shape (n, n) (notes eq. 13).

        Off exp(At) by the rounding times the condition number of T, which is large for matrices that are nearly
        defective; `LinearFlow.propagator` has no such error.
        """
        exponential = np.zeros_like(self.J)
        at = 0
        for blocks in self.blocks:
            for size in blocks.sizes:
                part = slice(at, at + size)
                exponential[part, part] = jordan_block_propagator(blocks.eigenvalue, size, t)
                at += size
        return np.asarray(np.linalg.solve(self.T.T, (self.T @ exponential).T).T)


def jordan_block(eigenvalue: complex, size: int) -> NDArray[np.inexact]:
    """lambda on the diagonal, ones above it, shape (size, size) (notes eq. 12)."""
    return np.asarray(eigenvalue * np.eye(size) + np.eye(size, k=1))


def jordan_block_propagator(eigenvalue: complex, size: int, t: float) -> NDArray[np.inexact]:
    """exp(J t) of one block in closed form: e^(lambda t) t^k/k! on the k-th diagonal, shape (size, size)."""
    terms = np.cumprod(np.concatenate([[1.0], t / np.arange(1.0, size)]))
    propagator = np.zeros((size, size))
    for k in range(size):
        propagator += np.diag(np.full(size - k, terms[k]), k)
    return np.asarray(np.exp(eigenvalue * t) * propagator)


def jordan_form(matrix: ArrayLike, error: ArrayLike = 0.0) -> JordanForm:
    """T and J of a real matrix (notes eqs. 10-12).

    Parameters
    ----------
    matrix : array_like, shape (n, n)
    error : array_like, shape (n, n) or a number
        How far the entries may be off, beyond their rounding.

    Raises
    ------
    InputError
        A matrix that is not square, real and finite, or errors that do not belong to it.
    """
    found = spectrum(matrix, error)
    pieces: list[tuple[JordanBlocks, ComplexArray]] = []
    for members in clusters(found.values, found.errors):
        mean = _mean(found.values[members])
        if mean.imag < 0:
            continue  # comes with its conjugate
        for blocks, chains in _structures(found, members):
            pieces.append((blocks, chains))
            if mean.imag > 0:
                pieces.append((blocks._replace(eigenvalue=blocks.eigenvalue.conjugate()), chains.conj()))
    pieces.sort(key=lambda piece: (-piece[0].eigenvalue.real, -piece[0].eigenvalue.imag))
    J = scipy.linalg.block_diag(*[jordan_block(b.eigenvalue, size) for b, _ in pieces for size in b.sizes])
    return JordanForm(np.concatenate([c for _, c in pieces], axis=1), J.astype(np.complex128), [b for b, _ in pieces])


def jordan_blocks(matrix: ArrayLike, error: ArrayLike = 0.0) -> list[JordanBlocks]:
    """Eigenvalues and block sizes, sorted by real part, largest first (notes eqs. 10-12); see `jordan_form`."""
    return jordan_form(matrix, error).blocks


def clusters(values: ComplexArray, errors: FloatArray) -> list[NDArray[np.intp]]:
    """Groups of eigenvalues whose discs overlap, one with another."""
    near = np.abs(values[:, None] - values) <= errors[:, None] + errors
    groups: list[NDArray[np.intp]] = []
    left = np.ones(len(values), dtype=bool)
    while left.any():
        group = np.zeros(len(values), dtype=bool)
        group[np.argmax(left)] = True
        while True:
            grown = np.asarray(near[group].any(axis=0))
            if np.array_equal(grown, group):
                break
            group = grown
        groups.append(np.flatnonzero(group))
        left &= ~group
    return groups


def _mean(values: ComplexArray) -> complex:
    """The mean of some eigenvalues: exactly real where they come in conjugate pairs, exact where all are equal."""
    if np.all(values == values[0]):
        return complex(values[0])
    return complex(np.mean(values.real), 0.0 if abs(np.sum(values.imag)) == 0.0 else np.mean(values.imag))


def _structures(
    found: Spectrum, members: NDArray[np.intp], closer: float = 1.0
) -> list[tuple[JordanBlocks, ComplexArray]]:
    """Blocks and chains of eigenvalues that may be one; of parts of them where they have no common structure."""
    values = found.values[members]
    mean, m = _mean(values), len(members)
    chosen = np.zeros(len(found.values), dtype=np.int32)
    chosen[members] = 1
    T, Q, *_ = scipy.linalg.lapack.ztrsen(chosen, found.triangular, np.eye(len(chosen), dtype=np.complex128), job="N")
    top, basis = T[:m, :m], found.basis @ Q[:, :m]
    size = float(scipy.linalg.norm(found.triangular)) or 1.0
    if m == 1:
        return [(JordanBlocks(mean, (1,), closer == 1.0, 0.0), _of_unit_length(basis))]
    # What the entries of `top` may be off by: from the Schur form, from the exchanges, and from the mean.
    noise = m * EPSILON * float(scipy.linalg.norm(np.triu(top, 1)))
    noise += max(float(found.noise[k]) or abs(found.values[k] - mean) for k in members)
    stairs = _staircase(top - mean * np.eye(m), NULL * noise)
    if stairs is None:
        radii = found.errors[members] / (CLOSER * closer)
        parts = clusters(values, radii)
        return [piece for part in parts for piece in _structures(found, members[part], CLOSER * closer)]
    widths, W, V, neglected, kept = stairs
    sizes = tuple(sum(w > k for w in widths) for k in range(widths[0]))
    certain = closer == 1.0 and kept > STANDS_OUT * NULL * noise
    chains = basis @ V @ _chains(W, widths)
    chains = np.concatenate([_of_unit_length(c) for c in np.split(chains, np.cumsum(sizes)[:-1], axis=1)], axis=1)
    return [(JordanBlocks(mean, sizes, certain, neglected / size), chains)]


def _of_unit_length(chain: ComplexArray) -> ComplexArray:
    """A chain of which the largest number is real."""
    largest = chain.ravel()[np.argmax(np.abs(chain))]
    return np.asarray(chain * (abs(largest) / largest) / scipy.linalg.norm(chain))


def _staircase(N: ComplexArray, zero: float) -> tuple[list[int], ComplexArray, ComplexArray, float, float] | None:
    """Null spaces of a nilpotent matrix and of what is left of it, one after the other.

    Returns the dimensions of them, which never grow, as singular values interlace; W, strictly upper triangular by
    blocks of these sizes, and the unitary V with V W V^H = N but for what was neglected; the norm of that; and the
    least singular value that was not taken as zero. None if N is not nilpotent to this accuracy.
    """
    m = len(N)
    W, V = N.copy(), np.eye(m, dtype=np.complex128)
    widths: list[int] = []
    start, neglected, kept = 0, 0.0, np.inf
    while start < m:
        _, singular, vh = np.linalg.svd(W[start:, start:])
        null = int(np.sum(singular <= zero))
        if null == 0:
            return None
        if null < len(singular):
            kept = min(kept, float(singular[-null - 1]))
        neglected += float(np.sum(singular[-null:] ** 2))
        turn = np.concatenate([vh[-null:], vh[:-null]]).conj().T
        W[:, start:] = W[:, start:] @ turn
        W[start:, :] = turn.conj().T @ W[start:, :]
        W[start:, : start + null] = 0.0
        V[:, start:] = V[:, start:] @ turn
        widths.append(null)
        start += null
    return widths, W, V, float(np.sqrt(neglected)), kept


def _chains(W: ComplexArray, widths: list[int]) -> ComplexArray:
    """C with W C = C J for a nilpotent W in staircase form; longest chains first."""
    edges = np.concatenate([[0], np.cumsum(widths)])
    chains: list[list[ComplexArray]] = []
    for level in reversed(range(len(widths))):
        for chain in chains:
            chain.insert(0, W @ chain[0])
        here = slice(edges[level], edges[level + 1])
        # What the chains that came down leave free at this level: ends of new chains.
        free = np.eye(widths[level])
        if chains:
            taken = np.stack([chain[0][here] for chain in chains], axis=1)
            free = np.linalg.qr(taken, mode="complete")[0][:, len(chains) :]
        for column in free.T:
            end = np.zeros(len(W), dtype=np.complex128)
            end[here] = column
            chains.append([end])
    return np.stack([vector for chain in chains for vector in chain], axis=1)
