"""Central difference formulas, for derivatives that a user did not give."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Weights of f(a + kh) -/+ f(a - kh), k = 1, 2, ...
_FIRST_4 = (2 / 3, -1 / 12)
_FIRST_8 = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
_SECOND_8 = (8 / 5, -1 / 5, 8 / 315, -1 / 560)

Function = Callable[[Any], NDArray[np.float64]]


def first_derivative_4(function: Function, at: Any, step: Any) -> NDArray[np.float64]:
    """df/ds, error of order step^4; best at a step of about 1e-3 of the scale of f (12 digits)."""
    return _first(function, at, step, _FIRST_4)


def first_derivative(function: Function, at: Any, step: Any) -> NDArray[np.float64]:
    """df/ds, error of order step^8; best at a step of about 1/50 of the scale of f (13 digits)."""
    return _first(function, at, step, _FIRST_8)


def second_derivative(function: Function, at: Any, step: Any) -> NDArray[np.float64]:
    """d2f/ds2, error of order step^8; best at a step of about 1/50 of the scale of f (11 digits)."""
    centre = function(at)
    total = np.zeros_like(centre)
    for k, c in enumerate(_SECOND_8, start=1):
        total = total + c * ((function(at + k * step) - centre) + (function(at - k * step) - centre))
    return total / step**2


def _first(function: Function, at: Any, step: Any, weights: tuple[float, ...]) -> NDArray[np.float64]:
    total: NDArray[np.float64] | float = 0.0
    for k, c in enumerate(weights, start=1):
        total = total + c * (function(at + k * step) - function(at - k * step))
    return np.asarray(total / step)
