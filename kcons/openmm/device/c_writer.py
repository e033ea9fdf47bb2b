"""Families of constraints as C: what the function `row` of a declaration does, written down operation by operation.

The same text is compiled as OpenCL C, CUDA, HIP and C++; its numbers are `mixed`.
"""

from __future__ import annotations

from kcons.constraints.functions.straight_line import Function, Operand, Tape, record

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
