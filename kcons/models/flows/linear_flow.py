"""Linear flows dX/dt = A X, solved by exp(At) (notes section 1.2)."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from kcons.constraints.arguments import numbers
from kcons.models.flows.flow import FloatArray, Flow
from kcons.models.flows.jordan import JordanBlocks, JordanForm, jordan_form
from kcons.models.flows.spectrum import square_matrix
from kcons.models.flows.stability import Classification, classify


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
        A matrix that is not square, real and finite.
    """

    def __init__(self, matrix: ArrayLike) -> None:
        self.matrix: FloatArray = square_matrix(matrix).copy()
        super().__init__(lambda t, X: self.matrix @ X, len(self.matrix), lambda t, X: self.matrix)

    def propagator(self, t: float) -> FloatArray:
        """exp(At), shape (n, n) (notes eq. 9)."""
        return np.asarray(scipy.linalg.expm(self.matrix * t))

    def exact(self, t: ArrayLike, X0: ArrayLike) -> FloatArray:
        """X(t) = exp(At) X(0), shape (n,) or (k, n) (notes eq. 8)."""
        X0 = self._state(X0)
        times = numbers(t, "t")
        if times.ndim == 0:
            return self.propagator(float(times)) @ X0
        return np.array([self.propagator(float(s)) @ X0 for s in times])

    def jordan_form(self) -> JordanForm:
        """T and J with A = T J T^-1, as far as double precision allows (notes eqs. 10-13)."""
        return jordan_form(self.matrix)

    def jordan_blocks(self) -> list[JordanBlocks]:
        """Eigenvalues with the sizes of their blocks (notes eqs. 10-12)."""
        return self.jordan_form().blocks

    def classification(self) -> Classification:
        """Kind and stability (notes eq. 14, completed)."""
        return classify(self.matrix)
