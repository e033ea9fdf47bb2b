"""Rows given by Python functions, or by functions that Numba has compiled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import (
    TAKES_TIME,
    FloatArray,
    Positive,
    as_float_array,
    check_call,
    read_only_view,
)
from kcons.constraints.constraint import Constraint, Fault, RowKind
from kcons.constraints.target import (
    FIRST_4,
    WRONG,
    Target,
    exact_step,
    first_derivative,
    first_derivative_4,
    nearest_image,
    second_derivative,
)
from kcons.errors import InputError

__all__ = ["Custom", "CustomVelocity", "ImplicitSurface"]

_FLOAT = np.dtype(np.float64)
#: Places of a first derivative, in steps, and the weights of the values there.
_PLACES = (1, -1, 2, -2)
_DIFFERENCE = np.array([FIRST_4[0], -FIRST_4[0], FIRST_4[1], -FIRST_4[1]])


class PythonRows(Constraint, base=True):
    """Rows of functions, called once a row; what is not given is taken by differences."""

    held = ""
    time_dependent: bool
    time_step: float
    length: Any

    @property
    def moving(self) -> bool:
        return super().moving or self.time_dependent

    @property
    def called(self) -> tuple[Any, ...]:
        """The functions that kernels call where Numba has compiled all of them: value and gradient, or coefficients."""
        return tuple(getattr(self, name) for name in self.functions)

    def row_gradient(self, k: int, r: FloatArray, time: float) -> FloatArray:
        """Gradient, or coefficients, of row `k` alone, shape (width, 3), at an `r` that cannot be changed."""
        raise NotImplementedError

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        found = [self.row_gradient(k, read_only_view(r[k]), time) for k in range(self.n_rows)]
        return np.array(found).reshape(r.shape)

    def value_and_gradient(self, r: FloatArray, time: float) -> tuple[FloatArray, FloatArray]:
        return self.measure(r, time), self.gradient(r, time)

    def _take(self, time_dependent: bool, length: Any, time_step: float, **functions: Any) -> None:
        """Store what functions are called with, and how far apart; and look at the functions."""
        self.time_dependent, self.length, self.time_step = bool(time_dependent), length, time_step
        arguments = ("r", "t") if time_dependent else ("r",)
        for name, function in functions.items():
            check_call(f"{self.family}: {name}", function, arguments, TAKES_TIME, needed=name != "gradient")

    def _time(self, time: float) -> tuple[float, ...]:
        return (time,) if self.time_dependent else ()

    def _checked(self, found: Any, name: str, shape: tuple[int, ...], k: int | None = None) -> Any:
        """What a function returned for row `k`, or for all, as float64 of that shape."""
        if type(found) is float and not shape:
            return found
        if type(found) not in (np.ndarray, np.float64) or found.dtype is not _FLOAT:
            found = as_float_array(found, f"{self.family if k is None else self.row_name(k)}: {name}")
        if found.shape != shape:
            of = f"positions of shape ({self.n_rows}, 3)" if k is None else f"row {k}"
            raise InputError(
                f"{self.family}: {name} returned shape {found.shape} for {of}; it must return {shape or 'one number'}",
                item=name,
                atoms=() if k is None else self.atoms[k].tolist(),
            )
        return found


class Custom(PythonRows):
    """Any function of the positions of a few atoms, called once a row.

    What is not given is taken by central differences: the gradient from four values a coordinate, order four, at steps
    of 1e-3 `length` (about eleven digits if the function varies on the scale of `length`); the curvature from four
    gradients along v in the same way, or without these from eight values along v, order eight, at steps of `length`/50
    (about ten digits); time derivatives by eighth-order formulas with step `time_step`. A gradient that is given is
    compared with differences when the row is put into a set. `Formula` is differentiated exactly.

    Parameters
    ----------
    atoms : array_like of int, shape (n_rows, width) or (width,)
        Atoms of each row.
    function : callable
        ``function(r) -> float`` for positions of shape (width, 3); with `time_dependent`, ``(r, t)``.
    gradient : callable, optional
        ``gradient(r) -> (width, 3)``; with `time_dependent`, ``(r, t)``. Where Numba has compiled it and the function,
        kernels call both without Python.
    target : float, array_like, callable of time, MovingTarget or None
        Value held; None takes the initial one.
    time_dependent : bool
        Whether the functions take the time as their last argument.
    translation_invariant : bool
        Whether only differences of positions count; then minimum images apply in periodic cells.
    period : float, optional
        Period of the value, such as 2 pi.
    length : float, optional
        Length over which the function varies; by default the spread of the atoms of the row, 1 for one atom.
    time_step : float
        Step of the time differences: about 1/50 of the time over which the function changes.
    """

    functions: ClassVar[tuple[str, ...]] = ("function", "gradient_function")
    kind = RowKind.FUNCTION
    singular = "value and gradient must be finite, and the gradient not zero; move the atoms"

    def __init__(
        self,
        atoms: ArrayLike,
        function: Callable[..., Any],
        gradient: Callable[..., Any] | None = None,
        target: Target = None,
        *,
        time_dependent: bool = False,
        translation_invariant: bool = False,
        period: Positive | None = None,
        length: Positive | None = None,
        time_step: Positive = 0.02,
    ) -> None:
        super().__init__(atoms, target)
        self._take(time_dependent, length, time_step, function=function, gradient=gradient)
        self.function, self.gradient_function = function, gradient
        self.translation_invariant, self.period = bool(translation_invariant), period

    def measure(self, r: FloatArray, time: float, first: int = 0) -> FloatArray:
        """Values of the rows from `first` on."""
        return np.array([self.row_value(first + k, read_only_view(r[k]), time) for k in range(len(r))])

    def row_value(self, k: int, r: FloatArray, time: float) -> float:
        """Value of row `k` alone at `r`, shape (width, 3), which cannot be written to; for kernels."""
        found = self.function(r, time) if self.time_dependent else self.function(r)
        # Of Python and of NumPy.
        return found if isinstance(found, float) else float(self._checked(found, "function", (), k))

    def row_gradient(self, k: int, r: FloatArray, time: float) -> FloatArray:
        if self.gradient_function is None:
            return self._differenced_gradient(r[None], time, k)[0]
        found = self.gradient_function(r, time) if self.time_dependent else self.gradient_function(r)
        return np.asarray(self._checked(found, "gradient", r.shape, k))

    def _differenced_gradient(self, r: FloatArray, time: float, first: int = 0) -> FloatArray:
        step = 1e-3 * self._length(r)
        places = r + step[:, None, None] * _along(self.width)[:, None]
        values = np.array([self.measure(place, time, first) for place in places])
        slope = np.dot(_DIFFERENCE, nearest_image(values - values[0], self.period).reshape(4, -1))
        return np.ascontiguousarray((slope.reshape(3 * self.width, len(r)) / step).T).reshape(r.shape)

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        speed, start, length = np.sqrt(_contract(v, v)), np.zeros(self.n_rows), self._length(r)
        along = v / np.where(speed > 0, speed, 1.0)[:, None, None]

        def at(s: FloatArray) -> FloatArray:
            return r + s[:, None, None] * along

        if self.gradient_function is None:
            bent = second_derivative(lambda s: self.measure(at(s), time), start, 0.02 * length, self.period)
        else:
            bent = first_derivative_4(lambda s: _contract(self.gradient(at(s), time), along), start, 1e-3 * length)
        return bent * speed**2

    def time_terms(self, r: FloatArray, v: FloatArray, time: float) -> tuple[FloatArray, FloatArray]:
        if not self.time_dependent:
            return super().time_terms(r, v, time)
        h = self.time_step
        rate = first_derivative(lambda t: self.measure(r, t), time, h, self.period)
        second = second_derivative(lambda t: self.measure(r, t), time, h, self.period)
        mixed = first_derivative(lambda t: _contract(self.gradient(r, t), v), time, h) if v.any() else 0.0
        return rate, 2 * mixed + second

    def _length(self, r: FloatArray) -> FloatArray:
        """Length over which the coordinate varies: as given, the spread of the atoms, or 1."""
        if self.length is not None:
            return np.full(len(r), self.length)
        if self.width == 1:
            return np.ones(len(r))
        apart = r - r.mean(axis=1, keepdims=True)
        spread = np.sqrt(_contract(apart, apart) / max(self.width, 1))
        return np.where(spread > 0, spread, 1.0)

    def faults(self, r: FloatArray, time: float) -> Iterator[Fault]:
        yield from super().faults(r, time)
        if self.n_rows == 0:
            return
        # A wrong derivative would give wrong motion without any other sign.
        slope, length = self.gradient(r, time), self._length(r)
        size = np.sqrt(_contract(slope, slope))
        along = np.random.default_rng(0).normal(size=r.shape)
        along /= np.sqrt(_contract(along, along))[:, None, None]

        def at(s: FloatArray) -> FloatArray:
            return self.measure(r + s[:, None, None] * along, time)

        steps, start = (1e-3 * length, 0.5e-3 * length), np.zeros(self.n_rows)
        found, finer = (first_derivative_4(at, start, step, self.period) for step in steps)
        if self.gradient_function is None:
            yield (
                ~(np.abs(finer - found) <= WRONG * size),
                lambda k: (
                    f"differences with steps of {1e-3 * length[k]:g} and half of that disagree about the "
                    f"gradient, {found[k]:.3g} and {finer[k]:.3g}: it vanishes, or the function varies faster. "
                    "Move the atoms, give the length over which it varies (length=...), or its gradient"
                ),
            )
            return

        def worst(k: int) -> str:
            other = self._differenced_gradient(r, time)[k]
            a, i = np.unravel_index(int(np.argmax(np.abs(slope[k] - other))), other.shape)
            return (
                f"gradient gives {slope[k, a, i]:.6g} for {'xyz'[i]} of its atom {self.atoms[k, a]}, but differences "
                f"of the function give {other[a, i]:.6g}; correct it, or give the length over which the function "
                "varies (length=...)"
            )

        yield ~(np.abs(_contract(slope, along) - found) <= WRONG * size), worst, "gradient"


class ImplicitSurface(Custom):
    """Atoms on a surface given by a function of all of them at once, q = function(r); the surface is q = 0.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n_rows,)
        The atoms; each is one row.
    function : callable
        ``function(r) -> (n_rows,)`` for positions of shape (n_rows, 3); with `time_dependent`, ``(r, t)``.
    gradient : callable, optional
        As for `Custom`, for all atoms: ``gradient(r) -> (n_rows, 3)``.
    target : float, array_like, callable of time, MovingTarget or None
        Level held: 0 by default, None for the level each atom starts on.
    time_dependent, time_step
        As for `Custom`.
    length : float, optional
        Length over which the surface bends (a radius); 1 by default.

    Examples
    --------
    The plane z = 0.1 sin(t):

    >>> import numpy as np
    >>> wave = ImplicitSurface(
    ...     0,
    ...     lambda r, t: r[:, 2] - 0.1 * np.sin(t),
    ...     lambda r, t: np.tile([0.0, 0.0, 1.0], (len(r), 1)),
    ...     time_dependent=True,
    ... )
    >>> wave.moving
    True
    """

    row_width = 1

    def __init__(
        self,
        atoms: ArrayLike,
        function: Callable[..., Any],
        gradient: Callable[..., Any] | None = None,
        target: Target = 0.0,
        *,
        time_dependent: bool = False,
        length: Positive | None = None,
        time_step: Positive = 0.02,
    ) -> None:
        given: dict[str, Any] = {"time_dependent": time_dependent, "length": length, "time_step": time_step}
        super().__init__(atoms, function, gradient, target, **given)

    @property
    def kind(self) -> RowKind:  # type: ignore[override]
        """Kernels take rows one by one, and only what knows a single row can be asked for one."""
        return RowKind.FUNCTION if self.n_rows == 1 else RowKind.INTERPRETED

    @property
    def called(self) -> tuple[Any, ...]:
        return (None,)

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        if self.gradient_function is None:
            return self._differenced_gradient(r, time)
        found = self.gradient_function(read_only_view(r[:, 0]), *self._time(time))
        return np.asarray(self._checked(found, "gradient", (self.n_rows, 3))).reshape(r.shape)

    def row_value(self, k: int, r: FloatArray, time: float) -> float:
        return float(self.measure(r[None], time)[0])

    def row_gradient(self, k: int, r: FloatArray, time: float) -> FloatArray:
        return np.asarray(self.gradient(r[None], time)[0])

    def measure(self, r: FloatArray, time: float, first: int = 0) -> FloatArray:
        found = self.function(read_only_view(r[:, 0]), *self._time(time))
        return np.asarray(self._checked(found, "function", (self.n_rows,)))


class CustomVelocity(PythonRows):
    """A row whose coefficients are a function, called once a row.

    Parameters
    ----------
    atoms : array_like of int, shape (n_rows, width) or (width,)
        Atoms of each row.
    coefficients : callable
        ``coefficients(r) -> (width, 3)`` for positions of shape (width, 3); with `time_dependent`, ``(r, t)``. It must
        depend on nothing else. Its change along the motion is differenced, order four: about eleven digits.
        `VelocityFormula` is differentiated exactly.
    target : float, array_like, callable of time, or MovingTarget
        What the row is held at, 0 by default.
    time_dependent : bool
        Whether the functions take the time as their last argument.
    translation_invariant : bool
        Whether only differences of positions count; then minimum images apply in periodic cells.
    length, time_step : float
        Differences are taken at steps of at most 1e-3 `length`, and, with `time_dependent`, of `time_step`.
    """

    holonomic = False
    kind = RowKind.VELOCITY
    singular = "the coefficients are zero or not finite; move the atoms"
    functions: ClassVar[tuple[str, ...]] = ("coefficients",)

    def __init__(
        self,
        atoms: ArrayLike,
        coefficients: Callable[..., Any],
        target: Target = 0.0,
        *,
        time_dependent: bool = False,
        translation_invariant: bool = False,
        length: Positive = 1.0,
        time_step: Positive = 1e-3,
    ) -> None:
        super().__init__(atoms, target)
        self._take(time_dependent, length, time_step, coefficients=coefficients)
        self.coefficients, self.translation_invariant = coefficients, bool(translation_invariant)

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        return np.zeros(self.n_rows)

    def row_gradient(self, k: int, r: FloatArray, time: float) -> FloatArray:
        found = self.coefficients(read_only_view(r), *self._time(time))
        return np.asarray(self._checked(found, "coefficients", (self.width, 3), k))

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        speed = float(np.sqrt(_contract(v, v).max(initial=0.0)))
        if speed == 0:
            return np.zeros(self.n_rows)
        step = 1e-3 * self.length / speed
        if self.time_dependent:
            step = exact_step(min(step, self.time_step), time)
        return first_derivative_4(lambda s: _contract(self.gradient(r + s * v, time + s), v), 0.0, step)


@cache
def _along(width: int) -> FloatArray:
    """Displacements of `_PLACES` by coordinates, shape (12 width, width, 3)."""
    return np.concatenate([place * np.eye(3 * width) for place in _PLACES]).reshape(-1, width, 3)


def _contract(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("kai,kai->k", a, b))
