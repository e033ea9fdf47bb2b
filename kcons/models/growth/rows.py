"""Rows: what a growth model is held to.

A row asks  sum_j A_j(x, t) dx_j/dt = b(x, t)  (notes eqs. 127, 128). Holonomic rows come from a function of the
state that keeps its value, sigma(x, t) = sigma0 (eq. 126), so that A = d sigma/dx and b = -d sigma/dt (eqs. 129, 130);
because they have a value, the state can be projected back on them to round-off.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import check_call, numbers, whole_number
from kcons.constraints.target import WRONG, contradicted, exact_step
from kcons.errors import ConstraintError, InputError
from kcons.models.growth.model import FloatArray, OfState, Populations, evaluate, taken

#: How far off, in parts of its own size, a start may lie from the rows that it is to keep.
START_TOLERANCE = 1e-10
EPSILON = float(np.finfo(np.float64).eps)
#: Step of differences, in ln x; they serve where half of it changes them by no more than this part.
STEP, SMOOTH = 0.005, 1e-6


class Row(ABC):
    """One row of A dx/dt = b."""

    #: Whether the row has a value that the state is projected on.
    holonomic: bool = False
    name: str = "row"
    #: Shape of parameters that differ from system to system, (N,); () where none do.
    lanes: tuple[int, ...] = ()

    @abstractmethod
    def gradient(self, p: Populations) -> FloatArray:
        """The row of A, shape of p.x."""

    @abstractmethod
    def rate(self, p: Populations) -> FloatArray | float:
        """b, a number a system."""

    def value(self, p: Populations) -> FloatArray | float:
        """sigma - sigma0, a number a system; 0 on the constraint."""
        raise NotImplementedError(f"{self.name} has no value")

    def size(self, p: Populations) -> FloatArray | float:
        """The size of the terms that `value` is the difference of: its round-off is some 1e-16 of this."""
        raise NotImplementedError(f"{self.name} has no value")

    def bind(self, p: Populations) -> Row:
        """The row that holds what it found at the start `p`."""
        return self

    def take(self, lanes: NDArray[np.intp]) -> Row:
        """The row of some of N systems side by side."""
        return self

    def check_derivatives(self, p: Populations) -> None:
        """Refuse derivatives that differences contradict, if it has any."""

    def check(self, p: Populations, number: int) -> None:
        """Refuse a start that is off the row.

        Raises
        ------
        ConstraintError
            If the start does not lie on it.
        """
        if not self.holonomic:
            return
        off = np.max(np.abs(self.value(p)) / np.maximum(self.size(p), np.finfo(np.float64).tiny))
        if not off <= START_TOLERANCE:
            raise ConstraintError(
                f"the start is off row {number} ({self.name}): relative deviation {off:.3g}. Start on it, or leave the "
                "target out to keep the value found at the start",
                rows=[number],
            )


class HolonomicRow(Row):
    """sigma(t, x) = target (notes eq. 126).

    Parameters
    ----------
    function : callable (t, x) -> float
        sigma.
    gradient : callable (t, x) -> (n,), optional
        d sigma/dx; by central differences where it is not given.
    time_derivative : callable (t, x) -> float, optional
        d sigma/dt at fixed x; left out, sigma does not depend on t.
    target : float, optional
        The value to be kept; left out, the one found at the start.
    vectorized : bool
        Whether the functions take x of shape (n, N) with times of shape (N,).
    """

    holonomic = True

    def __init__(
        self,
        function: OfState,
        gradient: OfState | None = None,
        time_derivative: OfState | None = None,
        *,
        target: float | None = None,
        vectorized: bool = False,
        name: str = "holonomic row",
    ) -> None:
        check_call(f"{name}: function", function, ("t", "x"))
        check_call(f"{name}: gradient", gradient, ("t", "x"))
        check_call(f"{name}: time_derivative", time_derivative, ("t", "x"))
        self._function = function
        self._gradient = gradient
        self._time_derivative = time_derivative
        self.target: float | FloatArray | None = None if target is None else _number(target, "target")
        self.vectorized = vectorized
        self.name = name

    def measure(self, p: Populations) -> FloatArray:
        """sigma itself."""
        return evaluate(self._function, p, 0, self.vectorized, self.name)

    def value(self, p: Populations) -> FloatArray:
        if self.target is None:
            raise ConstraintError(f"{self.name} has no target yet: it is set by the start, see bind()")
        return self.measure(p) - self.target

    def size(self, p: Populations) -> FloatArray:
        return np.sum(np.abs(self.gradient(p)) * p.x, axis=0) + np.abs(self.target if self.target is not None else 0.0)

    def gradient(self, p: Populations) -> FloatArray:
        if self._gradient is not None:
            return evaluate(self._gradient, p, len(p.x), self.vectorized, f"gradient of {self.name}")
        return relative_differences(self.measure, p)

    def rate(self, p: Populations) -> FloatArray | float:
        if self._time_derivative is None:
            return 0.0
        return -evaluate(self._time_derivative, p, 0, self.vectorized, f"time derivative of {self.name}")

    def bind(self, p: Populations) -> Self:
        self.check_derivatives(p)
        if self.target is not None:
            return self
        bound = copy.copy(self)
        bound.target = self.measure(p)
        return bound

    def check_derivatives(self, p: Populations) -> None:
        """Refuse derivatives that differences of sigma contradict: a wrong one moves off the row without a sign.

        Raises
        ------
        InputError
        """
        coarse, found = (relative_differences(self.measure, p, h) * p.x for h in (STEP, STEP / 2))
        size = np.abs(found).sum(axis=0)
        if self._gradient is not None:
            given = self.gradient(p) * p.x
            wrong = (np.abs(given - found) > WRONG * size) & (np.abs(found - coarse) <= WRONG * size)
            if wrong.any():
                k = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
                raise InputError(
                    f"gradient of {self.name}: {(given / p.x)[k]:.6g} for species {k[0]}, but differences of the "
                    f"function give {(found / p.x)[k]:.6g}; correct it, or leave it out",
                    item="gradient",
                )
        else:
            rough = np.abs(found - coarse) > SMOOTH * size + 1e-12 * self._magnitude(p)
            if rough.any():
                k = np.unravel_index(int(np.argmax(rough)), rough.shape)
                raise InputError(
                    f"{self.name} changes too fast with species {k[0]} for differences: give its gradient",
                    item="gradient",
                )
        if self._time_derivative is None:
            self._compare_rates(p, 0.0, "depends on time, but has no time_derivative: give it")
        else:
            self._compare_rates(p, -self.rate(p), "has another time_derivative than its differences: correct it")

    def _compare_rates(self, p: Populations, given: FloatArray | float, said: str) -> None:
        """Compare a derivative in time at the state `p` with differences, where these are smooth."""
        coarse, fine = (self._rate_by_differences(p, h) for h in (1e-3, 5e-4))
        wrong = contradicted(given, coarse, fine, 1e-9 * self._magnitude(p))
        for h in (1e-6, 1e-9) if np.any(wrong) else ():  # what changes faster is seen by these
            near = self._rate_by_differences(p, h)
            wrong &= ~(np.abs(near - given) <= WRONG * np.maximum(np.abs(near), np.abs(given)))
        if np.any(wrong):
            k = int(np.argmax(wrong))
            values = [float(np.broadcast_to(v, np.shape(wrong)).ravel()[k]) for v in (given, fine)]
            raise InputError(
                f"{self.name} {said} ({values[0]:.6g}; differences give {values[1]:.6g})", item="time_derivative"
            )

    def _rate_by_differences(self, p: Populations, h: float) -> FloatArray:
        h = exact_step(h, p.time)
        later, earlier = (self._at_time(Populations.from_logarithms(p.time + dt, p.log_x)) for dt in (h, -h))
        with np.errstate(all="ignore"):
            return (later - earlier) / (2 * h)

    def _at_time(self, p: Populations) -> FloatArray:
        """What changes with time at fixed x."""
        return self.measure(p)

    def _magnitude(self, p: Populations) -> FloatArray:
        return np.abs(self.measure(p))

    def take(self, lanes: NDArray[np.intp]) -> Self:
        return taken(self, lanes, "target")


class LinearRow(HolonomicRow):
    """sum_i c_i x_i = target; left out, the target is what the start gives.

    Parameters
    ----------
    coefficients : array_like, shape (n,)
    target : float or callable t -> (value, rate), optional
        A moving target returns its value and its time derivative.

    Raises
    ------
    InputError
        Coefficients that are not finite, or all zero.
    """

    def __init__(
        self,
        coefficients: ArrayLike,
        target: float | Callable[[float], tuple[float, float]] | None = None,
        *,
        name: str = "linear row",
    ) -> None:
        c = numbers(coefficients, "coefficients").copy()
        if callable(target):
            check_call(f"{name}: target", target, ("t",))
        if c.ndim != 1 or not np.all(np.isfinite(c)) or not np.any(c):
            raise InputError(f"{name}: give n finite coefficients that are not all zero", item="coefficients")
        self.coefficients: FloatArray = c
        self.vectorized = True
        self.name = name
        self.moving = target if callable(target) else None
        self.target = None if target is None or callable(target) else _number(target, "target")

    def _columns(self, p: Populations) -> FloatArray:
        if len(p.x) != len(self.coefficients):
            raise InputError(
                f"{self.name} has {len(self.coefficients)} coefficients, there are {len(p.x)} species",
                item="coefficients",
            )
        return self.coefficients.reshape(-1, *(1,) * (p.x.ndim - 1))

    def measure(self, p: Populations) -> FloatArray:
        return np.asarray(np.sum(self._columns(p) * p.x, axis=0))

    def gradient(self, p: Populations) -> FloatArray:
        return np.broadcast_to(self._columns(p), p.x.shape)

    def _moved(self, p: Populations, item: int) -> FloatArray:
        moving = self.moving
        assert moving is not None
        return np.asarray(np.vectorize(lambda t: self._pair(moving(t), t)[item], otypes=[np.float64])(p.time))

    def _pair(self, given: tuple[float, float], t: float) -> FloatArray:
        pair = numbers(given, "target")
        if pair.shape != (2,):
            raise InputError(
                f"the target of {self.name} gives {given!r:.80} at t = {t:g}; give (value, rate)", item="target"
            )
        return pair

    def value(self, p: Populations) -> FloatArray:
        return self.measure(p) - self._moved(p, 0) if self.moving else super().value(p)

    def rate(self, p: Populations) -> FloatArray | float:
        return self._moved(p, 1) if self.moving else 0.0

    def bind(self, p: Populations) -> Self:
        if not self.moving:
            return super().bind(p)
        self.check_derivatives(p)
        return self

    def check_derivatives(self, p: Populations) -> None:
        if self.moving:
            self._compare_rates(p, self.rate(p), "has another rate of its target than differences of it: correct it")

    def _at_time(self, p: Populations) -> FloatArray:
        return self._moved(p, 0)


class TotalPopulation(LinearRow):
    """sum_i x_i = target (notes eqs. 143, 144), for n species; left out, the target is the sum at the start."""

    def __init__(self, n: int, target: float | Callable[[float], tuple[float, float]] | None = None) -> None:
        super().__init__(np.ones(whole_number(n, "n")), target, name="total population")


class VelocityRow(Row):
    """sum_j A_j(t, x) dx_j/dt = b(t, x) (notes eq. 127), that need not come from any function of the state.

    Parameters
    ----------
    coefficients : callable (t, x) -> (n,), or array_like, shape (n,)
        A.
    rate : callable (t, x) -> float, or float
        b.
    vectorized : bool
        Whether the functions take x of shape (n, N) with times of shape (N,).
    """

    def __init__(
        self,
        coefficients: OfState | ArrayLike,
        rate: OfState | float = 0.0,
        *,
        vectorized: bool = False,
        name: str = "velocity row",
    ) -> None:
        for what, given in (("coefficients", coefficients), ("rate", rate)):
            if callable(given):
                check_call(f"{name}: {what}", given, ("t", "x"))
        self._coefficients = coefficients if callable(coefficients) else numbers(coefficients, "coefficients").copy()
        self._rate = rate if callable(rate) else _number(rate, "rate")
        self.vectorized = vectorized
        self.name = name

    def gradient(self, p: Populations) -> FloatArray:
        if callable(self._coefficients):
            return evaluate(self._coefficients, p, len(p.x), self.vectorized, f"coefficients of {self.name}")
        c = self._coefficients
        if c.shape != (len(p.x),):
            raise InputError(f"{self.name}: {c.shape} coefficients for {len(p.x)} species", item="coefficients")
        return np.broadcast_to(c.reshape(-1, *(1,) * (p.x.ndim - 1)), p.x.shape)

    def rate(self, p: Populations) -> FloatArray | float:
        if callable(self._rate):
            return evaluate(self._rate, p, 0, self.vectorized, f"rate of {self.name}")
        return self._rate


def relative_differences(
    measure: Callable[[Populations], FloatArray], p: Populations, step: float = STEP
) -> FloatArray:
    """d measure/dx by central differences in ln x, extrapolated to order six (steps h, h/2, h/4)."""
    gradient = np.empty_like(p.x)
    for i in range(len(p.x)):
        slopes = []
        for h in (step, step / 2, step / 4):
            ends = []
            for sign in (1.0, -1.0):
                log_x = p.log_x.copy()
                log_x[i] += sign * h
                ends.append(measure(Populations.from_logarithms(p.time, log_x)))
            # d/dx of a function that is linear in x comes out exactly.
            slopes.append((ends[0] - ends[1]) / (2.0 * np.sinh(h) * p.x[i]))
        first, second = (4 * slopes[1] - slopes[0]) / 3, (4 * slopes[2] - slopes[1]) / 3
        gradient[i] = (16 * second - first) / 15
    return gradient


def _number(value: float, item: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{item} is a number, not {value!r}", item=item) from None
    if not np.isfinite(number):
        raise InputError(f"{item} is not finite", item=item)
    return number
