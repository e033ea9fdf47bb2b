"""Rows of constraints on tensors: what the declaration of a family does, operation by operation, for many rows at once.

Functions of users that are written with NumPy become such a list too, which torch differentiates.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcons.constraints import Constraint, CustomVelocity, ImplicitSurface
from kcons.constraints.functions.straight_line import Tape, function_of, record
from kcons.errors import UnsupportedError

_OPERATORS: dict[str, Callable[..., Any]] = {
    "add": operator.add,
    "subtract": operator.sub,
    "multiply": operator.mul,
    "divide": operator.truediv,
    "negative": operator.neg,
    "power": operator.pow,
}
_NAMES = {"rint": "round", "arcsin": "asin", "arccos": "acos", "arctan": "atan", "arctan2": "atan2", "absolute": "abs"}


def run(tape: Tape, r: Sequence[Any], p: Sequence[Any], t: Any) -> list[Any]:
    """Results of a tape at places, parameters and a time, tensors of any one shape."""

    def perform(name: str, *given: Any) -> Any:
        if name in _OPERATORS:  # which take plain numbers too
            return _OPERATORS[name](*given)
        tensors = (each if isinstance(each, Tensor) else r[-1] * 0 + each for each in given)
        return getattr(torch, _NAMES.get(name, name))(*tensors)

    return tape.run(r, p, t, perform)


class RowFunction(NamedTuple):
    """What rows are computed by, equal for rows that are computed alike.

    The `tape` has value and gradient of a declaration, and the value alone of a user's function. What is not
    `holonomic` is a function of the middle of a flight and of the way; `timed` is what depends on the time.
    """

    tape: Tape
    width: int
    holonomic: bool

    @property
    def timed(self) -> bool:
        return any(("t", 0) in operands for _, operands in self.tape.steps)

    def __call__(self, r: Sequence[Any], p: Sequence[Any], t: Any) -> tuple[Any, list[Any]]:
        """Value, and 3 width numbers of its gradient, by where the flight ends for velocity rows.

        `r` are coordinates x, y, z by atom, and the way behind them for velocity rows; `p` are parameters.
        """
        if len(self.tape.results) > 1:
            value, *slope = run(self.tape, r, p, t)
            return value, slope
        like = next(each for each in r if isinstance(each, Tensor))
        r = [each if isinstance(each, Tensor) else torch.full_like(like, each) for each in r]
        value, pull = torch.func.vjp(lambda *places: run(self.tape, places, p, t)[0], *r)
        slope, n = list(pull(torch.ones_like(value))), 3 * self.width
        if not self.holonomic:
            slope = [0.5 * middle + way for middle, way in zip(slope[:n], slope[n:], strict=True)]
        return value, slope


def row_function(item: Constraint) -> RowFunction:
    """The function of an object's rows; refuses what is not written with NumPy's elementary functions."""
    found = function_of(item)
    if found is not None:
        return RowFunction(found.tape(), item.width, item.holonomic)
    n, function = 3 * item.width, _of_user(item)

    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        places = np.array([r[k] for k in range(n if item.holonomic else 2 * n)], dtype=object).reshape(-1, 3)
        value = function(places[: item.width], *((t,) if item.time_dependent else ()))  # type: ignore[attr-defined]
        value = value if item.holonomic else (value * places[item.width :]).sum()
        out[0] = value.item() if isinstance(value, np.ndarray) else value

    try:
        return RowFunction(record(row), item.width, item.holonomic)
    except UnsupportedError as error:
        remedy = "write it with elementary functions of NumPy, or as a Formula"
        raise UnsupportedError(f"{item!r} cannot be run on tensors: {error}; {remedy}") from error


def _of_user(item: Any) -> Callable[..., Any]:
    if isinstance(item, ImplicitSurface):
        return lambda r, *t: item.function(r, *t)[0]
    return item.coefficients if isinstance(item, CustomVelocity) else item.function  # type: ignore[no-any-return]
