"""Rows of constraints on tensors: what the declaration of a family does, operation by operation, for many rows at once.

Functions of users that are written with NumPy become such a list too.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcons.constraints import Constraint, Custom
from kcons.constraints.functions.straight_line import Tape, differentiated, function_of
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

    The `tape` has value and gradient. What is not `holonomic` is a function of the middle of a flight and of the way;
    its gradient is by where the flight ends. `timed` is what depends on the time.
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
        value, *slope = run(self.tape, r, p, t)
        return value, slope


def row_function(item: Constraint) -> RowFunction:
    """The function of an object's rows; refuses what is not written with NumPy's elementary functions."""
    found = function_of(item)
    if found is not None:
        return RowFunction(found.tape(), item.width, item.holonomic)
    assert isinstance(item, Custom)
    function, n = item.function, 3 * item.width

    def row(r: Any, p: Any, t: Any) -> Any:
        value = function(np.array([r[k] for k in range(n)], dtype=object).reshape(-1, 3))
        return value.item() if isinstance(value, np.ndarray) else value

    try:
        tape = differentiated(row, n)
    except (TypeError, AttributeError, IndexError, ValueError) as error:
        raise UnsupportedError(
            f"{item!r} cannot be run on tensors ({error}); write it with elementary functions of NumPy without "
            "branches, or as a Formula"
        ) from error
    return RowFunction(tape._replace(results=tape.results[:-1]), item.width, item.holonomic)
