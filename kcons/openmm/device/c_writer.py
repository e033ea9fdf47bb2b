"""Families of constraints as C: what the function `row` of a declaration does, written down operation by operation.

The same text is compiled as OpenCL C, CUDA, HIP and C++; its numbers are `mixed`. Expressions of OpenMM are made of it
as well.
"""

from __future__ import annotations

import re

from kcons.constraints.functions.straight_line import Function, Operand, Tape, record
from kcons.errors import UnsupportedError

#: Operations that are operators in C, and functions that have another name there.
_OPERATORS = {"add": "+", "subtract": "-", "multiply": "*", "divide": "/"}
_NAMES = {"absolute": "fabs", "power": "pow", "arctan2": "atan2", "arcsin": "asin", "arccos": "acos", "arctan": "atan"}
#: Where a function has no tape.
REMEDY = ", and is not written in C; leave it to the host (device=False)"


def literal(number: float) -> str:
    """A number as C, in the precision of the kernel."""
    return f"((mixed) {float(number)!r})"


def _text(operand: Operand) -> str:
    if not isinstance(operand, tuple):
        return literal(operand)
    name, k = operand
    return {"k": f"k{k}", "t": "t"}.get(name, f"{name}[{k}]")


def _lines(tape: Tape) -> str:
    lines = []
    for k, (name, operands) in enumerate(tape.steps):
        given = [_text(each) for each in operands]
        if name in _OPERATORS:
            text = _OPERATORS[name].join(given)
        elif name == "negative":
            text = f"-{given[0]}"
        else:
            text = f"{_NAMES.get(name, name)}({', '.join(given)})"
        lines.append(f" mixed k{k} = {text};\n")
    return "".join(lines)


def c_functions(name: str, function: Function, space: str = "") -> str:
    """A row as ``void NAME(const mixed* r, GLOBAL const mixed* p, mixed t, mixed* out)``.

    With the time in a formula, also its dq/dt, ``mixed NAME_rate(const mixed* r, GLOBAL const mixed* p, mixed t)``.

    Parameters
    ----------
    name : str
    function : Function
    space : str
        Where positions and results are: '' for private memory, or 'GLOBAL '.

    Raises
    ------
    UnsupportedError
        The function does what C cannot be written for.
    """
    tape = function.tape(REMEDY)
    results = "".join(f" out[{k}] = {_text(each)};\n" for k, each in enumerate(tape.results))
    places = f"{space}const mixed* r, GLOBAL const mixed* p, mixed t"
    text = f"DEVICE void {name}({places}, {space}mixed* out) {{\n{_lines(tape)}{results}}}\n"
    if function.rate is not None:
        rate = record(function.rate, function.known, REMEDY)
        text += f"DEVICE mixed {name}_rate({places}) {{\n{_lines(rate)} return {_text(rate.results[0])};\n}}\n"
    return text


def openmm_expression(function: Function) -> str:
    """Definition of ``row_value``, the value of a row over one atom, for a force of OpenMM with parameters row_p0, ...

    Raises
    ------
    UnsupportedError
        The function is no expression.
    """
    tape = function.tape(REMEDY)
    found, needed = [f"row_value={_text(tape.results[0])}"], {tape.results[0]}
    for line, k in reversed(list(zip(_lines(tape).splitlines(), range(len(tape.steps)), strict=True))):
        if ("k", k) in needed:
            needed |= set(tape.steps[k][1])
            name, text = line.removeprefix(" mixed ").removesuffix(";").split(" = ")
            found.append(f"{name}=" + re.sub(r"pow\((.*), (.*)\)", r"(\1)^(\2)", text))
    text = re.sub(r"copysign\(\(\(mixed\) 1\.0\), (\w+)\)", r"(2*step(\1)-1)", "; ".join(found))
    for old, new in ((r"\bk(?=\d)", "row_k"), (r"\(mixed\) ", ""), (r"\bfabs\b", "abs"), (r"p\[(\d+)\]", r"row_p\1")):
        text = re.sub(old, new, text)
    text = re.sub(r"r\[(\d)\]", lambda place: "xyz"[int(place[1])], text)
    if wrong := re.search(r"\bt\b|rint|copysign", text):
        what = getattr(function.row, "__qualname__", function.row)
        raise UnsupportedError(
            f"{what} has {wrong[0]!r} in it, which expressions of OpenMM do not have; leave it to the host "
            "(kcons.openmm.hold)"
        )
    return text
