"""Rows given by Python functions, or by functions that Numba has compiled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import FloatArray, Positive, as_float_array, check_call, read_only_view
from kcons.constraints.constraint import Constraint, Fault, RowKind
from kcons.constraints.target import FIRST_4, WRONG, Target, first_derivative_4, nearest_image, second_derivative
from kcons.errors import InputError

__all__ = ["Custom"]

_FLOAT = np.dtype(np.float64)
#: Places of a first derivative, in steps, and the weights of the values there.
_PLACES = (1, -1, 2, -2)
_DIFFERENCE = np.array([FIRST_4[0], -FIRST_4[0], FIRST_4[1], -FIRST_4[1]])


class Custom(Constraint):
    """Any function of the positions of a few atoms, called once a row.

    What is not given is taken by central differences: the gradient from four values a coordinate, order four, at steps
    of 1e-3 `length` (about eleven digits if the function varies on the scale of `length`); the curvature from four
    gradients along v in the same way, or without these from eight values along v, order eight, at steps of `length`/50
    (about ten digits). A gradient that is given is compared with differences when the row is put into a set. `Formula`
    is differentiated exactly, and may depend on the time.

    Parameters
    ----------
    atoms : array_like of int, shape (n_rows, width) or (width,)
        Atoms of each row.
    function : callable
        ``function(r) -> float`` for positions of shape (width, 3).
    gradient : callable, optional
        ``gradient(r) -> (width, 3)``. Where Numba has compiled it and the function, kernels call both without Python.
    target : float, array_like, callable of time, MovingTarget or None
        Value held; None takes the initial one.
    translation_invariant : bool
        Whether only differences of positions count; then minimum images apply in periodic cells.
    period : float, optional
        Period of the value, such as 2 pi.
    length : float, optional
        Length over which the function varies; by default the spread of the atoms of the row, 1 for one atom.
    """

    held = ""
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
        translation_invariant: bool = False,
        period: Positive | None = None,
        length: Positive | None = None,
    ) -> None:
        super().__init__(atoms, target)
        for name, given in (("function", function), ("gradient", gradient)):
            hint = "; what depends on the time is written as a Formula"
            check_call(f"Custom: {name}", given, ("r",), hint, needed=name == "function")
        self.function, self.gradient_function, self.length = function, gradient, length
        self.translation_invariant, self.period = bool(translation_invariant), period

    def row_value(self, k: int, r: FloatArray) -> float:
        """Value of row `k` alone at `r`, shape (width, 3), which cannot be written to; for kernels."""
        found = self.function(r)
        # Of Python and of NumPy.
        return found if isinstance(found, float) else float(self._checked(found, "function", (), k))

    def row_gradient(self, k: int, r: FloatArray) -> FloatArray:
        """Gradient of row `k` alone, shape (width, 3), at an `r` that cannot be written to; for kernels."""
        if self.gradient_function is None:
            return self._differences(k, r, 1e-3)
        return np.asarray(self._checked(self.gradient_function(r), "gradient", r.shape, k))

    def _checked(self, found: Any, name: str, shape: tuple[int, ...], k: int) -> Any:
        """What a function returned for row `k`, as float64 of that shape."""
        if type(found) not in (np.ndarray, np.float64) or found.dtype is not _FLOAT:
            found = as_float_array(found, f"{self.row_name(k)}: {name}")
        if found.shape != shape:
            raise InputError(
                f"Custom: {name} returned shape {found.shape} for row {k}; it must return {shape or 'one number'}",
                item=name,
                atoms=self.atoms[k].tolist(),
            )
        return found

    def _differences(self, k: int, r: FloatArray, part: float) -> FloatArray:
        """Gradient of row `k` by differences with a step of a part of its length."""
        step = part * self._length(r)
        values = np.array([self.row_value(k, read_only_view(r + step * along)) for along in _along(self.width)])
        slope = np.dot(_DIFFERENCE, nearest_image(values - values[0], self.period).reshape(4, -1))
        return np.asarray(slope.reshape(r.shape) / step)

    def _length(self, r: FloatArray) -> float:
        """Length over which a row varies: as given, the spread of its atoms, or 1."""
        if self.length is not None:
            return float(self.length)
        apart = r - r.mean(axis=0)
        spread = float(np.sqrt(np.vdot(apart, apart) / len(r)))
        return spread if spread > 0 else 1.0

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        return np.array([self.row_value(k, read_only_view(r[k])) for k in range(self.n_rows)])

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        return np.array([self.row_gradient(k, read_only_view(r[k])) for k in range(self.n_rows)]).reshape(r.shape)

    def value_and_gradient(self, r: FloatArray, time: float) -> tuple[FloatArray, FloatArray]:
        return self.measure(r, time), self.gradient(r, time)

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        return np.array([self._row_curvature(k, r[k], v[k]) for k in range(self.n_rows)])

    def _row_curvature(self, k: int, r: FloatArray, v: FloatArray) -> float:
        speed, length = float(np.sqrt(np.vdot(v, v))), self._length(r)
        along = v / (speed or 1.0)

        def value(s: float) -> Any:
            return self.row_value(k, read_only_view(r + s * along))

        def slope(s: float) -> Any:
            return np.vdot(self.row_gradient(k, read_only_view(r + s * along)), along)

        if self.gradient_function is None:
            bent = second_derivative(value, 0.0, 0.02 * length, self.period)
        else:
            bent = first_derivative_4(slope, 0.0, 1e-3 * length)
        return float(bent) * speed**2

    def faults(self, r: FloatArray, time: float) -> Iterator[Fault]:
        yield from super().faults(r, time)
        # A wrong derivative would give wrong motion without any other sign.
        slope, given = self.gradient(r, time), self.gradient_function is not None
        other = np.array([self._differences(k, r[k], 0.5e-3) for k in range(self.n_rows)]).reshape(r.shape)
        off, size = (np.sqrt(np.einsum("kai,kai->k", each, each)) for each in (slope - other, slope))

        def worst(k: int) -> str:
            a, i = np.unravel_index(int(np.argmax(np.abs(slope[k] - other[k]))), other[k].shape)
            found, finer = f"{slope[k, a, i]:.6g} for {'xyz'[i]} of its atom {self.atoms[k, a]}", other[k, a, i]
            if given:
                return (
                    f"gradient gives {found}, but differences of the function give {finer:.6g}; correct it, or give "
                    "the length over which the function varies (length=...)"
                )
            return (
                f"differences give {found}, and with half of their step {finer:.6g}: the gradient vanishes, or the "
                f"function varies faster than over {self._length(r[k]):g}. Move the atoms, give the length over which "
                "it varies (length=...), or its gradient"
            )

        yield ~(off <= WRONG * size), worst, "gradient" * given


@cache
def _along(width: int) -> FloatArray:
    """Displacements of `_PLACES` by coordinates, shape (12 width, width, 3)."""
    return np.concatenate([place * np.eye(3 * width) for place in _PLACES]).reshape(-1, width, 3)
