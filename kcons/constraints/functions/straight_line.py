"""Functions of rows as lists of operations: these are differentiated, and written in other languages.

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
from kcons.errors import UnsupportedError

#: A number; or a position 'r', a parameter 'p', the time 't', or the result of a step 'k', and which one.
Operand: TypeAlias = float | tuple[str, int]


class Tape(NamedTuple):
    """What a function does, operation by operation: names as in `ELEMENTARY`, operands, and what it puts out."""

    steps: tuple[tuple[str, tuple[Operand, ...]], ...]
    results: tuple[Operand, ...]

    def run(self, r: Any, p: Any, t: Any, perform: Callable[..., Any]) -> list[Any]:
        """Results at places, parameters and a time; `perform` takes the name of an operation, and what it is of."""
        made: list[Any] = []
        known = {"r": r, "p": p, "t": [t], "k": made}

        def value(operand: Operand) -> Any:
            return known[operand[0]][operand[1]] if isinstance(operand, tuple) else operand

        for name, operands in self.steps:
            made.append(perform(name, *map(value, operands)))
        return list(map(value, self.results))


#: Steps so far, each once, with their numbers.
_Steps: TypeAlias = dict[tuple[str, tuple[Operand, ...]], int]


class _Symbol(NDArrayOperatorsMixin):
    """A number that is not known, by its place; `steps` are those so far."""

    def __init__(self, place: tuple[str, int], steps: _Steps) -> None:
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
        return _Symbol(("k", self.steps.setdefault((name, tuple(given)), len(self.steps))), self.steps)


def _operand(given: Any) -> Operand:
    return given.place if isinstance(given, _Symbol) else float(given)


class _Places:
    """Numbers of which the first are known."""

    def __init__(self, name: str, steps: _Steps, known: Sequence[float] = ()) -> None:
        self.name, self.steps, self.known = name, steps, known

    def __getitem__(self, k: int) -> Any:
        return self.known[k] if k < len(self.known) else _Symbol((self.name, k), self.steps)


def record(function: Callable[..., Any], known: Sequence[float] = (), remedy: str = "") -> Tape:
    """The tape of a function as `Constraint.row`; `UnsupportedError` where it branches or calls other functions.

    `known` are the first parameters, where they are known: how many there are of something has to be. `remedy` says
    what to do about a function that has no tape.
    """
    steps: _Steps = {}
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


#: NumPy's functions of one or two numbers that rows may use: what they change by with each; y is their result.
ELEMENTARY: dict[str, Callable[..., tuple[Any, ...]]] = {
    "add": lambda y, a, b: (1.0, 1.0),
    "subtract": lambda y, a, b: (1.0, -1.0),
    "multiply": lambda y, a, b: (b, a),
    "divide": lambda y, a, b: (1.0 / b, -y / b),
    "power": lambda y, a, b: (b * a ** (b - 1.0), y * np.log(a)),
    "negative": lambda y, a: (-1.0,),
    "absolute": lambda y, a: (np.copysign(1.0, a),),
    "copysign": lambda y, a, b: (np.copysign(1.0, a) * np.copysign(1.0, b), 0.0),
    "rint": lambda y, a: (0.0,),
    "sqrt": lambda y, a: (0.5 / y,),
    "exp": lambda y, a: (y,),
    "log": lambda y, a: (1.0 / a,),
    "sin": lambda y, a: (np.cos(a),),
    "cos": lambda y, a: (-np.sin(a),),
    "tan": lambda y, a: (1.0 + y * y,),
    "sinh": lambda y, a: (np.cosh(a),),
    "cosh": lambda y, a: (np.sinh(a),),
    "tanh": lambda y, a: (1.0 - y * y,),
    "arcsin": lambda y, a: (1.0 / np.sqrt(1.0 - a * a),),
    "arccos": lambda y, a: (-1.0 / np.sqrt(1.0 - a * a),),
    "arctan": lambda y, a: (1.0 / (1.0 + a * a),),
    "arctan2": lambda y, a, b: (b / (a * a + b * b), -a / (a * a + b * b)),
}


def _times(a: Any, b: Any) -> Any:
    for one, other in ((a, b), (b, a)):
        if isinstance(one, float) and abs(one) == 1.0:
            return other if one > 0 else -other
    return a * b


def differentiated(function: Callable[[Any, Any, Any], Any], places: int) -> Tape:
    """Value, derivatives by places, and by the time, of a function of places r, parameters p and the time."""
    steps: _Steps = {}

    def number(operand: Operand) -> Any:
        return _Symbol(operand, steps) if isinstance(operand, tuple) else np.float64(operand)

    value = _operand(function(_Places("r", steps), _Places("p", steps), _Symbol(("t", 0), steps)))
    slopes: dict[Operand, Any] = {value: 1.0}
    for (name, operands), k in reversed(list(steps.items())):
        if ("k", k) not in slopes:
            continue
        slope = slopes["k", k]
        for operand, part in zip(operands, ELEMENTARY[name](number(("k", k)), *map(number, operands)), strict=True):
            if isinstance(operand, tuple):
                own = _times(slope, part)
                slopes[operand] = slopes[operand] + own if operand in slopes else own
    by = [*(("r", k) for k in range(places)), ("t", 0)]
    results = value, *(_operand(slopes.get(each, 0.0)) for each in by)
    return Tape(tuple(steps), results)


class Function(NamedTuple):
    """What rows are computed by. Rows of objects with the same function share its code.

    `known` are the first parameters where they are the same in all rows; `rate` is that of a `Constraint`.
    """

    row: Callable[..., Any]
    known: tuple[float, ...] = ()
    rate: Callable[..., Any] | None = None
    is_distance: bool = False

    def tape(self, remedy: str = "") -> Tape:
        """See `record`."""
        return record(self.row, self.known, remedy)


@cache
def _linear(size: int) -> Callable[..., None]:
    """The row of `LinearCombination`, whose coefficients are their parameters."""

    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        out[0] = sum((p[k] * r[k] for k in range(size)), 0.0)
        out.update({1 + k: p[k] for k in range(size)})

    return row


def function_of(item: Constraint) -> Function | None:
    """The function of an object's rows; None where only Python can compute them."""
    if item.functions or (item.row is None and item.kind is not RowKind.LINEAR):
        return None
    if item.row is None:
        return Function(_linear(3 * item.width))
    known = [float(item.width)] if item.uses_masses else item.parameters()[:1, : item.alike].ravel().tolist()
    return Function(item.row, tuple(known), item.rate if item.holonomic else None, item.holds_length)
