"""Rows of constraints on tensors: what the declaration of a family does, operation by operation, for many rows at once.

Functions of users are traced: written with NumPy they become such a list too, and functions of torch are called under
`torch.func.vmap`; both are differentiated by torch.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcons.constraints import Constraint, CustomVelocity, ImplicitSurface
from kcons.constraints.functions.straight_line import Operand, Tape, function_of, record
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
    known = {"r": r, "p": p, "k": (made := [])}

    def value(operand: Operand) -> Any:
        if not isinstance(operand, tuple):
            return operand
        return t if operand[0] == "t" else known[operand[0]][operand[1]]

    for name, operands in tape.steps:
        given = [value(each) for each in operands]
        if name not in _OPERATORS:  # which take plain numbers too
            given = [each if isinstance(each, Tensor) else r[-1] * 0 + each for each in given]
        made.append(_OPERATORS.get(name) or getattr(torch, _NAMES.get(name, name)))
        made[-1] = made[-1](*given)
    return [value(each) for each in tape.results]


class RowFunction(NamedTuple):
    """What rows are computed by, equal for rows that are computed alike.

    `tape` has value and gradient of a declaration, and the value alone of a function of NumPy; `called` is a function
    of torch, of positions of shape (width, 3) and, where it is `timed`, the time. What is not `holonomic` is a function
    of the middle of a flight and of the way.
    """

    tape: Tape | None
    called: Callable[..., Any] | None
    width: int
    holonomic: bool
    timed: bool

    def __call__(self, r: Sequence[Any], p: Sequence[Any], t: Any) -> tuple[Any, list[Any]]:
        """Value, and 3 width numbers of its gradient, by where the flight ends for velocity rows.

        `r` are coordinates x, y, z by atom, and the way behind them for velocity rows; `p` are parameters.
        """
        if self.tape is not None and len(self.tape.results) > 1:
            value, *slope = run(self.tape, r, p, t)
            return value, slope
        like = next(each for each in r if isinstance(each, Tensor))
        r = [each if isinstance(each, Tensor) else torch.full_like(like, each) for each in r]
        value, pull = torch.func.vjp(lambda *places: self.value(places, p, t), *r)
        slope, n = list(pull(torch.ones_like(value))), 3 * self.width
        if not self.holonomic:
            slope = [0.5 * middle + way for middle, way in zip(slope[:n], slope[n:], strict=True)]
        return value, slope

    def value(self, r: Sequence[Any], p: Sequence[Any], t: Any) -> Any:
        """Value alone."""
        if self.tape is not None:
            return run(self.tape, r, p, t)[0]
        places = torch.stack(torch.broadcast_tensors(*r), -1)
        flat = places.reshape(-1, places.shape[-1] // 3, 3)
        return torch.func.vmap(lambda each: self._of_one(each, t))(flat).reshape(places.shape[:-1])

    def _of_one(self, places: Any, t: Any) -> Any:
        """The user's function of the places of one row, and the way behind them."""
        assert self.called is not None
        found = self.called(places[: self.width], *((t,) if self.timed else ()))
        return found if self.holonomic else (found * places[self.width :]).sum()


def row_function(item: Constraint) -> RowFunction:
    """The function of an object's rows.

    Raises
    ------
    UnsupportedError
        A function of Python that is written neither with NumPy's elementary functions nor with torch.
    """
    found = function_of(item)
    if found is not None:
        tape = found.tape()
        timed = any(("t", 0) in operands for _, operands in tape.steps)
        return RowFunction(tape, None, item.width, item.holonomic, timed)
    function = RowFunction(None, _called(item), item.width, item.holonomic, item.time_dependent)  # type: ignore[attr-defined]
    n = (3 if item.holonomic else 6) * item.width

    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        value = function._of_one(np.array([r[k] for k in range(n)], dtype=object).reshape(-1, 3), t)
        out[0] = value.item() if isinstance(value, np.ndarray) else value

    try:
        return function._replace(tape=record(row), called=None)
    except UnsupportedError as error:
        try:
            function([*torch.arange(1.0, 1.0 + n).sin()], (), torch.zeros(()))
        except Exception as other:  # whatever the function of a user raises
            raise UnsupportedError(
                f"{item!r} cannot be run on tensors: {error}; called with tensors it raises {type(other).__name__}: "
                f"{other}. Write it with torch or with elementary functions of NumPy, or as a Formula"
            ) from other
        return function


def _called(item: Any) -> Callable[..., Any]:
    if isinstance(item, ImplicitSurface):
        return lambda r, *t: item.function(r, *t)[0]
    return item.coefficients if isinstance(item, CustomVelocity) else item.function  # type: ignore[no-any-return]
