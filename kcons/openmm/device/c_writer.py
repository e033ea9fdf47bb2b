"""Families of constraints as C: the function `row` of a declaration is run on symbols, which write down what it does.

A row is straight arithmetic with elementary functions, and loops over numbers that are known. The same text is compiled
as OpenCL C, CUDA, HIP and C++; its numbers are `mixed`. Expressions of OpenMM are made of it as well.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

from numpy.lib.mixins import NDArrayOperatorsMixin

from kcons.errors import UnsupportedError

#: Ufuncs that are operators in C, and functions that have another name there.
_OPERATORS = {"add": "+", "subtract": "-", "multiply": "*", "divide": "/", "true_divide": "/"}
_NAMES = {"absolute": "fabs", "arctan2": "atan2", "arcsin": "asin", "arccos": "acos", "arctan": "atan"}
_NAMES |= {
    name: name for name in ("sqrt", "sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "copysign", "rint")
}


def literal(number: float) -> str:
    """A number as C, in the precision of the kernel."""
    return f"((mixed) {float(number)!r})"


class _Symbol(NDArrayOperatorsMixin):
    """A number in C, by its text; `lines` are the statements so far."""

    def __init__(self, text: str, lines: list[str]) -> None:
        self.text, self.lines = text, lines

    @property
    def real(self) -> _Symbol:
        return self

    def __bool__(self) -> bool:
        raise TypeError("a branch")

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> _Symbol:
        given = [each.text if isinstance(each, _Symbol) else literal(each) for each in inputs]
        name = ufunc.__name__
        if name in _OPERATORS:
            text = _OPERATORS[name].join(given)
        elif name == "negative":
            text = f"-{given[0]}"
        elif name == "power" and inputs[1] == 0.5:
            text = f"sqrt({given[0]})"
        elif name == "power" and inputs[1] in (1, 2, 3, 4):
            text = "*".join(given[:1] * int(inputs[1]))
        elif name == "power":
            text = f"pow({given[0]}, {given[1]})"
        elif name in _NAMES and method == "__call__" and not options:
            text = f"{_NAMES[name]}({', '.join(given)})"
        else:
            raise TypeError(f"the function {name}")
        found = _Symbol(f"k{len(self.lines)}", self.lines)
        self.lines.append(f" mixed {found.text} = {text};\n")
        return found


class _Places:
    """An array in C of which some numbers are known."""

    def __init__(self, name: str, lines: list[str], known: Sequence[float] = ()) -> None:
        self.name, self.lines, self.known = name, lines, known

    def __getitem__(self, k: int) -> Any:
        return self.known[k] if k < len(self.known) else _Symbol(f"{self.name}[{k}]", self.lines)


def _run(function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except (TypeError, AttributeError, IndexError, ValueError) as error:
        raise UnsupportedError(
            f"{getattr(function, '__qualname__', function)} is not written in C, which has neither branches nor other "
            f"functions than elementary ones of NumPy ({error}); leave it to the host (device=False)"
        ) from None


def c_function(name: str, row: Callable[..., Any], space: str = "", known: Sequence[float] = ()) -> str:
    """The C function ``void NAME(const mixed* r, GLOBAL const mixed* p, mixed t, mixed* out)`` of a row.

    Parameters
    ----------
    name : str
    row : callable
        As `Constraint.row`.
    space : str
        Where positions and results are: '' for private memory, or 'GLOBAL '.
    known : sequence of float
        The first parameters, where they are known: how many there are of something has to be.

    Raises
    ------
    UnsupportedError
        The function does what C cannot be written for.
    """
    lines: list[str] = []
    out: dict[int, Any] = {}
    _run(row, _Places("r", lines), _Places("p", lines, known), _Symbol("t", lines), out)
    results = [f" out[{k}] = {v.text if isinstance(v, _Symbol) else literal(v)};\n" for k, v in sorted(out.items())]
    head = f"DEVICE void {name}({space}const mixed* r, GLOBAL const mixed* p, mixed t, {space}mixed* out)"
    return "".join([head, " {\n", *lines, *results, "}\n"])


def c_rate(name: str, second: Callable[..., Any], width: int, parameters: int, space: str = "") -> str:
    """The C function ``mixed NAME(const mixed* r, GLOBAL const mixed* p, mixed t)``: dq/dt of a formula, at rest.

    `second` gives it as its second result, see `Code`, of coordinates, velocities, the time and parameters.
    """
    lines: list[str] = []
    r, p = _Places("r", lines), _Places("p", lines)
    places, rest = [r[k] for k in range(3 * width)], [0.0] * (3 * width)
    rate = _run(second, *places, *rest, _Symbol("t", lines), *(p[k] for k in range(parameters)))[1]
    head = f"DEVICE mixed {name}({space}const mixed* r, GLOBAL const mixed* p, mixed t)"
    result = rate.text if isinstance(rate, _Symbol) else literal(rate)
    return "".join([head, " {\n", *lines, f" return {result};\n}}\n"])


def openmm_expression(row: Callable[..., Any]) -> str:
    """Definition of ``row_value``, the value of a row over one atom, for a force of OpenMM with parameters row_p0, ...

    Raises
    ------
    UnsupportedError
        The function is no expression.
    """
    lines: list[str] = []
    out: dict[int, Any] = {}
    _run(row, _Places("r", lines), _Places("p", lines), _Symbol("t", lines), out)
    found, needed = [f"row_value={out[0].text}"], {out[0].text}
    for line in reversed(lines):
        name, text = line.removeprefix(" mixed ").removesuffix(";\n").split(" = ")
        if name in needed:
            needed |= set(re.findall(r"\bk\d+", text))
            found.append(f"{name}=" + re.sub(r"pow\((.*), (.*)\)", r"(\1)^(\2)", text))
    text = "; ".join(found)
    for old, new in ((r"\bk(?=\d)", "row_k"), (r"\(mixed\) ", ""), (r"\bfabs\b", "abs"), (r"p\[(\d+)\]", r"row_p\1")):
        text = re.sub(old, new, text)
    text = re.sub(r"r\[(\d)\]", lambda place: "xyz"[int(place[1])], text)
    if wrong := re.search(r"\bt\b|rint|copysign", text):
        raise UnsupportedError(
            f"{getattr(row, '__qualname__', row)} has {wrong[0]!r} in it, which expressions of OpenMM do not have; "
            "leave it to the host (kcons.openmm.hold)"
        )
    return text
