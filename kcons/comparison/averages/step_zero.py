"""Averages at several time steps, extrapolated to step zero.

Averages of a thermostat of order p are off by c h^p and less. So a weighted fit of a + c h^p to runs at two or more
steps removes the bias (Coshic and Hummer, arXiv:2603.02383), at the price of noise: with steps h and 2h of order 2 the
value is (4 a(h) - a(2h))/3, and its error a third more than that of the finer run alone, or higher.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import numbers
from kcons.errors import InputError
from kcons.thermostats import Estimate

#: Probability of chi^2 below which the model is said not to fit.
DOUBTFUL = 0.01
#: Relative difference up to which two steps are one, computed in two ways.
ONE_STEP = 1e-9


@dataclass(frozen=True)
class Extrapolated:
    """An average at step zero.

    Attributes
    ----------
    value, error : float
    slope, slope_error : float
        c in a + c h^p: what a step costs.
    order : int
        p.
    chi_square : float
        Of the fit, with `freedom` degrees of freedom: steps less two.
    freedom : int
    probability : float
        That chi^2 is so large by chance; 1 where two steps leave nothing to judge by.
    """

    value: float
    error: float
    slope: float
    slope_error: float
    order: int
    chi_square: float
    freedom: int
    probability: float

    @property
    def fits(self) -> bool:
        """Whether the steps are fine enough for one power, as far as these runs can tell."""
        return self.probability >= DOUBTFUL

    @property
    def estimate(self) -> Estimate:
        return Estimate(self.value, self.error)


def extrapolate(steps: ArrayLike, averages: Sequence[tuple[float, float]], order: int = 2) -> Extrapolated:
    """Fit a + c h^p to averages with errors by weighted least squares.

    Parameters
    ----------
    steps : array_like, shape (n,)
        Time steps, n >= 2, at least two of them different.
    averages : sequence of (value, standard error)
        Of runs that are independent of each other.
    order : int
        p, that of the thermostat: 2 for all of kcons' but those of order 4 and 6.

    Warns
    -----
    UserWarning
        The model does not fit (chi^2): take finer steps, or leave the coarsest out.

    Raises
    ------
    InputError
        One step only; a step, an error or an order that is not positive; values that are not finite.
    """
    h, given = numbers(steps, "steps"), numbers([[float(v), float(e)] for v, e in averages], "averages")
    if h.ndim != 1 or given.shape != (len(h), 2):
        raise InputError(
            f"{np.shape(steps)} steps and {len(given)} averages do not go together: give each average its step",
            item="averages",
        )
    if not (np.isfinite(h).all() and (h > 0).all()):
        raise InputError(f"steps are {h.tolist()}; give positive numbers", item="steps")
    if not len(h) or np.ptp(h) <= ONE_STEP * h.max():
        raise InputError("averages at one step cannot be extrapolated; add runs at another", item="steps")
    values, errors = given.T
    if not (np.isfinite(given).all() and (errors > 0).all()):
        raise InputError("averages need finite values and positive errors", item="averages")
    if isinstance(order, bool) or int(order) != order or order < 1:
        raise InputError(f"order is {order!r}; give a whole number, 1 or more", item="order")
    scale = float(h.max())
    model = np.stack([np.ones_like(h), (h / scale) ** order], axis=1) / errors[:, None]
    covariance = np.linalg.inv(model.T @ model)
    found = covariance @ (model.T @ (values / errors))
    freedom = len(h) - 2
    chi_square = float(((model @ found - values / errors) ** 2).sum())
    if freedom:
        from scipy.special import gammaincc  # slow to import

        probability = float(gammaincc(0.5 * freedom, 0.5 * chi_square))
    else:
        chi_square, probability = 0.0, 1.0
    result = Extrapolated(
        value=float(found[0]),
        error=math.sqrt(covariance[0, 0]),
        slope=float(found[1]) / scale**order,
        slope_error=math.sqrt(covariance[1, 1]) / scale**order,
        order=int(order),
        chi_square=chi_square,
        freedom=freedom,
        probability=probability,
    )
    if not result.fits:
        warnings.warn(
            f"a + c h^{order} does not fit averages at steps {', '.join(f'{s:g}' for s in h)}: chi^2 is "
            f"{chi_square:.1f} for {freedom}. Take finer steps, or leave the coarsest out",
            stacklevel=2,
        )
    return result
