"""What a row is held at: a number, the value found at the start, or a function of time, with its derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import LARGEST, as_float_array, check_call, check_range, positive, read_only
from kcons.constraints.arguments import FloatArray as FloatArray
from kcons.errors import InputError

TimeFunction: TypeAlias = Callable[[float], ArrayLike]
Function: TypeAlias = Callable[[Any], FloatArray]


@dataclass(frozen=True)
class MovingTarget:
    """A target that is a given function of time.

    Parameters
    ----------
    value, rate, acceleration : callable
        The target, its first and its second time derivative, each a function of the time that
        returns a number or an array of one number a row. Derivatives left out are taken from
        `value` by central differences of eighth order with step `time_step`; give them where
        more than about ten digits of the acceleration matter.
    time_step : float
        Step of the differences, in the caller's unit of time: a small part (about 1/50) of the
        time over which the target changes.
    """

    value: TimeFunction
    rate: TimeFunction | None = None
    acceleration: TimeFunction | None = None
    time_step: float = 0.02

    def __post_init__(self) -> None:
        for name in ("value", "rate", "acceleration"):
            of = "" if name == "value" else f"{name} of the "
            check_call(f"the {of}target", getattr(self, name), ("t",))
        positive(self.time_step, "the time_step of the target")

    def at(self, time: float, rows: int) -> FloatArray:
        """Target at `time`, shape (rows,)."""
        return _per_row(self.value(time), rows, f" at t = {time:g}")

    def rate_at(self, time: float, rows: int, period: float | None = None) -> FloatArray:
        """First time derivative, shape (rows,), of values that may jump by a `period`."""
        if self.rate is not None:
            return _per_row(self.rate(time), rows, f" at t = {time:g}")
        if self.acceleration is not None:
            raise InputError("a moving target with an acceleration also needs its rate", item="target")
        return first_derivative(lambda t: self.at(t, rows), time, self.time_step, period)

    def acceleration_at(self, time: float, rows: int, period: float | None = None) -> FloatArray:
        """Second time derivative, shape (rows,), of values that may jump by a `period`."""
        if self.acceleration is not None:
            return _per_row(self.acceleration(time), rows, f" at t = {time:g}")
        if self.rate is not None:
            return first_derivative(lambda t: self.rate_at(t, rows), time, self.time_step)
        return second_derivative(lambda t: self.at(t, rows), time, self.time_step, period)

    def check(self, name: str, time: float, rows: int, period: float | None = None) -> None:
        """Refuse derivatives that are not those of the target soon after `time`: atoms would leave it silently.

        `name` is what messages call the rows that it belongs to.
        """
        h, (function, jump) = self.time_step, (self.at, period) if self.rate is None else (self.rate_at, None)

        def rough(t: float) -> bool:
            coarse, fine = (first_derivative(partial(function, rows=rows), t, step, jump) for step in (h, h / 2))
            size = np.maximum(np.abs(coarse), np.abs(fine)) + 1e-9 * np.abs(function(t, rows)).max(initial=0.0) / h
            return bool((np.abs(fine - coarse) > ROUGH * size).any())

        # At two times so far apart that one kink does not count.
        if self.acceleration is None and rough(time + 5 * h) and rough(time + 15 * h):
            raise InputError(
                f"{name}: the target changes within less than the step of its differences, {h:g}; give its rate and "
                "acceleration, or MovingTarget(..., time_step=...), 1/50 of the time in which it changes",
                item="time_step",
            )
        for what, given, derivative, of, period_of in (
            ("rate", self.rate, self.rate_at, self.at, period),
            ("acceleration", self.acceleration, self.acceleration_at, self.rate_at, None),
        ):
            if given is None:
                continue
            own, whole = partial(derivative, rows=rows), partial(of, rows=rows)
            found = contradiction(own, whole, time, h, period_of)
            if found is not None:
                raise InputError(
                    f"{name}: the target contradicts itself: its {what} is {found.given:.6g} at t = {found.time:g}, "
                    f"but differences give {found.found:.6g}; correct it, or leave the derivatives out",
                    item="target",
                )


Target: TypeAlias = float | ArrayLike | MovingTarget | TimeFunction | None


def as_target(target: Target, rows: int) -> FloatArray | MovingTarget | None:
    """What a user gave as None, a read-only array of shape (rows,), or a `MovingTarget`."""
    if target is None or isinstance(target, MovingTarget):
        return target
    return MovingTarget(target) if callable(target) else read_only(np.array(_per_row(target, rows), order="C"))


def _per_row(target: Any, rows: int, when: str = "") -> FloatArray:
    if isinstance(target, float) and abs(target) <= LARGEST:
        return np.full(rows, target)
    array = as_float_array(target, "target")
    if array.ndim > 1 and array.size == rows:
        array = array.ravel()  # for example (n, 3) for three rows an atom
    if array.ndim > 1 or array.size not in (1, rows):
        raise InputError(f"the target{when} has shape {array.shape}; give one number or {rows}", item="target")
    check_range(array, f"the target of row {{row}}{when}", "target")
    return np.broadcast_to(array, (rows,))


# -- derivatives that a user gave, and central differences for those that were not given --------------

#: By how much of its size a given derivative may differ from differences that are smooth: these have more digits.
WRONG = 1e-3
#: By how much of their size differences with a step and with half of it differ where neither says anything.
ROUGH = 0.1


class Contradiction(NamedTuple):
    """The number in the array, the time, the derivative that was given there and the one found by differences."""

    number: int
    time: float
    given: float
    found: float


def contradiction(
    derivative: Function, function: Function, time: float, time_step: float, period: float | None = None
) -> Contradiction | None:
    """What a given derivative and differences of its function say soon after `time`; None where they agree.

    It is given that differences with a step and with half of it agree in.
    """
    told = None
    for later in (1.3, 2.7):  # at one alone there may be a kink
        t, h = time + later * time_step, 0.1 * time_step
        given = derivative(t)
        coarse, fine = (first_derivative_4(function, t, step, period) for step in (h, h / 2))
        size = np.maximum(np.abs(given), np.abs(fine)) + 1e-9 * np.abs(function(t)) / h
        wrong = (np.abs(fine - given) > WRONG * size) & (np.abs(fine - coarse) <= WRONG * size)
        if not wrong.any():
            return None
        k = int(np.argmax(wrong))
        told = Contradiction(k, t, float(given.flat[k]), float(fine.flat[k]))
    return told


# Weights of f(a + kh) -/+ f(a - kh), k = 1, 2, ...
FIRST_4 = (2 / 3, -1 / 12)
_FIRST_8 = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
_SECOND_8 = (8 / 5, -1 / 5, 8 / 315, -1 / 560)


def nearest_image(difference: FloatArray, period: float | FloatArray | None) -> FloatArray:
    """Differences of two values of a coordinate with this period, or without one.

    A period for each of several coordinates, 0 where there is none, belongs to the last axis.
    """
    if period is None:
        return difference
    whole = np.where(period > 0, period, np.inf) if isinstance(period, np.ndarray) else period
    return difference - period * np.round(difference / whole)


def first_derivative_4(function: Function, at: Any, step: Any, period: float | None = None) -> FloatArray:
    """df/ds, error of order step^4; best at a step of about 1e-3 of the scale of f (12 digits)."""
    return _first(function, at, step, FIRST_4, period)


def first_derivative(function: Function, at: Any, step: Any, period: float | None = None) -> FloatArray:
    """df/ds, error of order step^8; best at a step of about 1/50 of the scale of f (13 digits)."""
    return _first(function, at, step, _FIRST_8, period)


def second_derivative(function: Function, at: Any, step: Any, period: float | None = None) -> FloatArray:
    """d2f/ds2, error of order step^8; best at a step of about 1/50 of the scale of f (11 digits)."""
    center, step = function(at), exact_step(step, at)
    total = np.zeros_like(center)
    for k, c in enumerate(_SECOND_8, start=1):
        later, earlier = (nearest_image(function(at + sign * k * step) - center, period) for sign in (1, -1))
        total = total + c * (later + earlier)
    return total / step**2


def exact_step(step: Any, at: Any) -> Any:
    """A step that does not round where it is added: at late times that would be most of the difference."""
    return (at + step) - at


def _first(function: Function, at: Any, step: Any, weights: tuple[float, ...], period: float | None) -> FloatArray:
    total: FloatArray | float = 0.0
    step = exact_step(step, at)
    for k, c in enumerate(weights, start=1):
        total = total + c * nearest_image(function(at + k * step) - function(at - k * step), period)
    return np.asarray(total / step)
