"""Linear flows dX/dt = A X, solved by exp(At) (notes section 1.2)."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from kcons.flows.flow import FloatArray, Flow
from kcons.flows.stability import Classification, JordanBlocks, _square, classify, jordan_blocks


class LinearFlow(Flow):
    """dX/dt = A X (notes eq. 7).

    exp(At) is computed by scaling and squaring of a Pade approximant, not from eigenvectors: defective matrices, whose
    eigenvectors do not span, need no special treatment, nor do those that are nearly so.

    Parameters
    ----------
    matrix : array_like, shape (n, n)

    Raises
    ------
    InputError
        A matrix that is not square or not finite.
    """

    def __init__(self, matrix: ArrayLike) -> None:
        self.matrix: FloatArray = _square(matrix)
        super().__init__(lambda t, X: self.matrix @ X, len(self.matrix), lambda t, X: self.matrix)

    def propagator(self, t: float) -> FloatArray:
        """exp(At), shape (n, n) (notes eqs. 9, 13)."""
        return np.asarray(scipy.linalg.expm(self.matrix * t))

    def exact(self, t: ArrayLike, X0: ArrayLike) -> FloatArray:
        """X(t) = exp(At) X(0), shape (n,) or (k, n) (notes eq. 8)."""
        X0 = self._state(X0)
        times = np.asarray(t, dtype=np.float64)
        if times.ndim == 0:
            return self.propagator(float(times)) @ X0
        return np.array([self.propagator(float(s)) @ X0 for s in times])

    def jordan_blocks(self) -> list[JordanBlocks]:
        """Eigenvalues with the sizes of their blocks (notes eqs. 10-12)."""
        return jordan_blocks(self.matrix)

    def classification(self) -> Classification:
        """Kind and stability (notes eq. 14, completed)."""
        return classify(self.matrix)


def jordan_block(eigenvalue: float, size: int) -> FloatArray:
    """lambda on the diagonal, ones above it, shape (size, size) (notes eq. 12)."""
    return np.asarray(eigenvalue * np.eye(size) + np.eye(size, k=1))


def jordan_block_propagator(eigenvalue: float, size: int, t: float) -> FloatArray:
    """exp(J t) of one block in closed form: e^(lambda t) t^k/k! on the k-th diagonal, shape (size, size)."""
    terms = np.cumprod(np.concatenate([[1.0], t / np.arange(1.0, size)]))
    propagator = np.zeros((size, size))
    for k in range(size):
        propagator += np.diag(np.full(size - k, terms[k]), k)
    return np.asarray(np.exp(eigenvalue * t) * propagator)
