"""Functions of rows as lists of operations, from which engines in other languages are written.

The function `row` of a declaration is straight arithmetic with elementary functions, and loops over numbers that are
known. Run on symbols it writes down what it does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from kcons.constraints.constraint import Constraint, RowKind
from kcons.constraints.functions.formula import Formula
from kcons.errors import UnsupportedError

#: A number; or a position 'r', a parameter 'p', the time 't', or the result of a step 'k', and which one.
Operand: TypeAlias = float | tuple[str, int]

#: NumPy's functions of one or two numbers that rows may use.
ELEMENTARY = {"sqrt", "sin", "cos", "tan", "arcsin", "arccos", "arctan", "arctan2", "sinh", "cosh", "tanh", "exp"}
ELEMENTARY |= {"log", "absolute", "copysign", "rint", "add", "subtract", "multiply", "divide", "negative", "power"}


class Tape(NamedTuple):
    """What a function does, operation by operation: names as in `ELEMENTARY`, operands, and what it puts out."""

    steps: tuple[tuple[str, tuple[Operand, ...]], ...]
    results: tuple[Operand, ...]


class _Symbol(NDArrayOperatorsMixin):
    """A number that is not known, by its place; `steps` are those so far."""

    def __init__(self, place: tuple[str, int], steps: list[Any]) -> None:
        self.place, self.steps = place, steps

    @property
    def real(self) -> _Symbol:
        return self

    def conjugate(self) -> _Symbol:
        return self

    def __bool__(self) -> bool:
        raise TypeError("a branch")

    def __getattr__(self, name: str) -> Any:
        if name not in ELEMENTARY:
            raise AttributeError(name)
        return lambda *others: getattr(np, name)(self, *others)  # as elements of arrays are asked

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if any(isinstance(each, np.ndarray) and each.ndim for each in inputs):
            arrays = [np.array(each, dtype=object) if isinstance(each, _Symbol) else each for each in inputs]
            return getattr(ufunc, method)(*arrays, **options)
        name, given = ufunc.__name__, [_operand(each) for each in inputs]
        if name not in ELEMENTARY or method != "__call__" or set(options) - {"out"}:  # in place is another symbol
            raise TypeError(f"the function {name}")
        if name == "power" and given[1] == 0.5:
            name, given = "sqrt", given[:1]
        elif name == "power" and given[1] in (2, 3, 4):
            product, base = inputs[0], inputs[0]
            for _ in range(int(inputs[1]) - 1):
                product = product * base
            return product
        self.steps.append((name, tuple(given)))
        return _Symbol(("k", len(self.steps) - 1), self.steps)


def _operand(given: Any) -> Operand:
    return given.place if isinstance(given, _Symbol) else float(given)


class _Places:
    """Numbers of which the first are known."""

    def __init__(self, name: str, steps: list[Any], known: Sequence[float] = ()) -> None:
        self.name, self.steps, self.known = name, steps, known

    def __getitem__(self, k: int) -> Any:
        return self.known[k] if k < len(self.known) else _Symbol((self.name, k), self.steps)


def record(function: Callable[..., Any], known: Sequence[float] = (), remedy: str = "") -> Tape:
    """The tape of a function as `Constraint.row`.

    Parameters
    ----------
    function : callable
        Gets places r, parameters p, the time t and `out`.
    known : sequence of float
        The first parameters, where they are known: how many there are of something has to be.
    remedy : str
        What to do about a function that has none.

    Raises
    ------
    UnsupportedError
        The function branches, or calls what is no elementary function of NumPy.
    """
    steps: list[Any] = []
    out: dict[int, Any] = {}
    try:
        function(_Places("r", steps), _Places("p", steps, known), _Symbol(("t", 0), steps), out)
        results = tuple(_operand(value) for _, value in sorted(out.items()))
    except (TypeError, AttributeError, IndexError, ValueError) as error:
        raise UnsupportedError(
            f"{getattr(function, '__qualname__', function)} is more than elementary functions of NumPy without "
            f"branches ({error}){remedy}"
        ) from None
    return Tape(tuple(steps), results)


class Function(NamedTuple):
    """What rows are computed by. Rows of objects with the same function share its code.

    `known` are the first parameters where they are the same in all rows; a formula is a function of `numbers` (how
    many of positions, and of parameters), and `second` gives its rate, if the time is in it.
    """

    row: Callable[..., Any]
    known: tuple[float, ...] = ()
    second: Callable[..., Any] | None = None
    numbers: tuple[int, int] = (0, 0)
    is_distance: bool = False

    def tape(self, remedy: str = "") -> Tape:
        """See `record`."""
        places, parameters = self.numbers

        def formula(r: Any, p: Any, t: Any, out: Any) -> None:
            given = [*(r[k] for k in range(places)), t, *(p[k] for k in range(parameters))]
            out.update(enumerate(self.row(*given)))

        return record(formula if places else self.row, self.known, remedy)

    def rate_tape(self, remedy: str = "") -> Tape:
        """That of dq/dt, at rest, of a formula with the time in it."""
        places, parameters = self.numbers

        def rate(r: Any, p: Any, t: Any, out: Any) -> None:
            assert self.second is not None
            here = [r[k] for k in range(places)]
            out[0] = self.second(*here, *[0.0] * places, t, *(p[k] for k in range(parameters)))[1]

        return record(rate, (), remedy)


@cache
def _linear(size: int) -> Callable[..., None]:
    """The row of `LinearRows`, whose coefficients are their parameters."""

    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        out[0] = sum((p[k] * r[k] for k in range(size)), 0.0)
        out.update({1 + k: p[k] for k in range(size)})

    return row


def function_of(item: Constraint) -> Function | None:
    """The function of an object's rows; None where only Python can compute them."""
    if item.functions or (item.row is None and item.kind is not RowKind.LINEAR):
        return None
    if isinstance(item, Formula):
        code = item.code()
        numbers = (3 if item.holonomic else 6) * item.width, len(item.names)
        return Function(code.first, (), code.second if item.holonomic and code.moving else None, numbers)
    if item.row is None:
        return Function(_linear(3 * item.width))
    known = [float(item.width)] if item.uses_masses else item.parameters()[0, : item.alike].tolist()
    return Function(item.row, tuple(known), is_distance=item.holds_length)
