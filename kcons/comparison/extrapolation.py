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

from kcons.constraints.arguments import numbers, whole_number
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
    h, given = numbers(steps, "steps"), numbers(averages, "averages")
    if h.ndim != 1 or given.shape != (len(h), 2):
        raise InputError(
            f"steps of shape {h.shape} and averages of shape {given.shape} do not go together: give each step its "
            "(value, standard error)",
            item="averages",
        )
    if not (np.isfinite(h).all() and (h > 0).all()):
        raise InputError(f"steps are {h.tolist()}; give positive numbers", item="steps")
    if not len(h) or np.ptp(h) <= ONE_STEP * h.max():
        raise InputError("averages at one step cannot be extrapolated; add runs at another", item="steps")
    values, errors = given.T
    if not (np.isfinite(given).all() and (errors > 0).all()):
        raise InputError("averages need finite values and positive errors", item="averages")
    order = whole_number(order, "order")
    scale, finest = float(h.max()), float(errors.min())
    powers, weights = (h / scale) ** order, (finest / errors) ** 2
    # By pairs of averages, whose terms do not cancel however unequal the errors are.
    i, j = np.triu_indices(len(h), 1)
    shares = weights[i] * weights[j] / weights.sum()
    spread = float((shares * (powers[i] - powers[j]) ** 2).sum())
    if not spread > 0:
        raise InputError(
            f"of errors from {finest:g} to {errors.max():g} all but the smallest count for nothing: the averages tell "
            "no slope. Leave out what is so uncertain",
            item="averages",
        )
    slope = float((shares * (powers[i] - powers[j]) * (values[i] - values[j])).sum()) / spread
    centre = float(weights @ powers / weights.sum())
    value = float(weights @ values / weights.sum()) - centre * slope
    freedom = len(h) - 2
    if freedom:
        from scipy.special import gammaincc  # slow to import

        chi_square = float((((value + slope * powers - values) / errors) ** 2).sum())
        probability = float(gammaincc(0.5 * freedom, 0.5 * chi_square))
    else:
        chi_square, probability = 0.0, 1.0
    result = Extrapolated(
        value=value,
        error=finest * math.sqrt(1 / float(weights.sum()) + centre**2 / spread),
        slope=slope / scale**order,
        slope_error=finest / math.sqrt(spread) / scale**order,
        order=order,
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
