"""Growth models with known solutions or invariants (notes section 3); the hypercycle has a module of its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import finite_number, numbers, positive
from kcons.errors import InputError
from kcons.models.growth.model import FloatArray, GrowthModel


class Logistic(GrowthModel):
    """dx/dt = alpha x - beta x^2 (notes eq. 65).

    Raises
    ------
    InputError
        If alpha or beta is not positive.
    """

    def __init__(self, alpha: float = 1.0, beta: float = 0.1) -> None:
        self.alpha, self.beta = _positive(alpha=alpha, beta=beta)
        super().__init__(lambda t, x: self.alpha - self.beta * x, n=1, vectorized=True)

    @property
    def plateau(self) -> float:
        """alpha/beta, the limit of every solution (notes eqs. 67, 68)."""
        return self.alpha / self.beta

    def exact(self, t: ArrayLike, x0: float) -> FloatArray:
        """x(t) (notes eq. 66), written so that no exponential overflows.

        Raises
        ------
        InputError
            A negative population; times before the one at which one above the plateau came from infinity.
        """
        exponent, x0 = -self.alpha * numbers(t, "t"), finite_number(x0, "x0")
        if x0 < 0:
            raise InputError(f"x0 is {x0:g}; populations are not negative", item="x0")
        if x0 > self.plateau and np.any(exponent >= -np.log1p(-self.plateau / x0)):
            since = np.log1p(-self.plateau / x0) / self.alpha
            raise InputError(f"x = {x0:g} at t = 0 came from infinity at t = {since:.6g}; give later times", item="t")
        # Either way with exponentials of what is not positive.
        up, down = np.exp(np.minimum(exponent, 0.0)), np.exp(-np.maximum(exponent, 0.0))
        fed = self.beta * x0 * np.expm1(-np.abs(exponent))
        return np.asarray(self.alpha * x0 * down / (self.alpha * up - np.where(exponent > 0, -fed, fed)))

    def jacobian(self, t: float, x: ArrayLike) -> FloatArray:
        """dV/dx, shape (1, 1)."""
        return np.asarray([[self.alpha - 2.0 * self.beta * numbers(x, "x")[0]]])


class LotkaVolterra(GrowthModel):
    """Prey x_1 and predators x_2 (notes eqs. 69, 70).

        dx_1/dt = x_1 (alpha_1 - beta_1 x_2),     dx_2/dt = -x_2 (beta_2 - alpha_2 x_1)

    Raises
    ------
    InputError
        If a parameter is not positive.
    """

    def __init__(self, alpha1: float = 1.0, beta1: float = 1.0, alpha2: float = 1.0, beta2: float = 2.0) -> None:
        self.alpha1, self.beta1, self.alpha2, self.beta2 = _positive(
            alpha1=alpha1, beta1=beta1, alpha2=alpha2, beta2=beta2
        )
        super().__init__(
            lambda t, x: np.stack([self.alpha1 - self.beta1 * x[1], self.alpha2 * x[0] - self.beta2]),
            n=2,
            vectorized=True,
        )

    @property
    def equilibrium(self) -> FloatArray:
        """(beta_2/alpha_2, alpha_1/beta_1) (notes eq. 74)."""
        return np.array([self.beta2 / self.alpha2, self.alpha1 / self.beta1])

    def invariant(self, x: ArrayLike) -> FloatArray:
        """G, constant along every solution (notes eq. 73); x of shape (2,) or (2, k)."""
        x = numbers(x, "x")
        prey, predators = x[0] / self.equilibrium[0], x[1] / self.equilibrium[1]
        return np.asarray(self.alpha1 * (predators - np.log(predators)) + self.beta2 * (prey - np.log(prey)))

    def invariant_gradient(self, x: ArrayLike) -> FloatArray:
        """dG/dx, shape of x."""
        x = numbers(x, "x")
        return np.stack([self.alpha2 - self.beta2 / x[0], self.beta1 - self.alpha1 / x[1]])

    def jacobian(self, t: float, x: ArrayLike) -> FloatArray:
        """dV/dx, shape (2, 2) (notes eq. 75)."""
        x1, x2 = numbers(x, "x")
        return np.array(
            [[self.alpha1 - self.beta1 * x2, -self.beta1 * x1], [self.alpha2 * x2, self.alpha2 * x1 - self.beta2]]
        )

    def divergence(self, x: ArrayLike) -> FloatArray:
        """div V = (alpha_1 - beta_1 x_2) - (beta_2 - alpha_2 x_1) (notes eq. 72)."""
        x = numbers(x, "x")
        return np.asarray((self.alpha1 - self.beta1 * x[1]) - (self.beta2 - self.alpha2 * x[0]))


def _positive(**parameters: float) -> tuple[float, ...]:
    return tuple(positive(value, name) for name, value in parameters.items())
