"""Formulas as code: what is written is checked by its names, differentiated by SymPy, and kept in a file.

The file is a module of functions on plain numbers, or on arrays of one number a row: value and gradient, and what
accelerations need; of a formula that is linear in the velocities its coefficients, and what these need. It lies where
Numba can keep what it compiles of it, so that another process finds both.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import math
import os
import re
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numba
import numpy as np

from kcons.errors import InputError, UnsupportedError

#: Functions of formulas: name -> the one of NumPy; of the same name in SymPy, but for those below.
FUNCTIONS: dict[str, Any] = {
    **{name: getattr(np, name) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt")},
    **{f"a{name[3:]}": getattr(np, name) for name in ("arcsin", "arccos", "arctan", "arctan2")},
    "abs": np.abs,
}
_IN_SYMPY = {"abs": "Abs"}
_COORDINATE = re.compile(r"[xyz]([1-9]\d*)")
_SPEED = re.compile(r"v[xyz]([1-9]\d*)")
_OPERATIONS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}


def parsed(formula: str, parameters: Sequence[str], speeds: bool = False) -> tuple[ast.expr, set[int]]:
    """The tree of a formula, which may have velocities or not, and the atoms in it.

    Raises
    ------
    InputError
        What is no formula; unknown names and functions.
    """
    if not isinstance(formula, str):
        raise InputError(f"Formula: formula must be text, not {formula!r:.60}", item="formula")
    try:
        tree = ast.parse(formula.strip(), mode="eval").body
    except SyntaxError as error:
        remedy = "; write what is held at zero, the left side less the right one" if "=" in formula else ""
        raise InputError(f"Formula: {formula!r} cannot be read: {error.msg}{remedy}", item="formula") from None
    found = set()
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
                if name not in FUNCTIONS or len(args) != 1 + (name == "atan2"):
                    raise InputError(
                        f"Formula: {ast.unparse(node)} in {formula!r} is no function of formulas; these are "
                        f"{', '.join(sorted(FUNCTIONS))}, of one number each, atan2 of two",
                        item=name,
                    )
            case ast.Name(id=name):
                known_as = _COORDINATE.fullmatch(name) or _SPEED.fullmatch(name)
                if known_as and (speeds or name[0] != "v"):
                    found.add(int(known_as[1]))
                elif known_as:
                    raise InputError(
                        f"Formula: {name!r} in {formula!r} is a velocity; what is linear in velocities is held by "
                        "VelocityFormula",
                        item=name,
                    )
                elif name not in (*FUNCTIONS, *parameters, "t", "pi"):
                    places = "x1, y1, z1, x2, ..." + (", vx1, vy1, ..." if speeds else "")
                    known = ", ".join([places, "t", "pi", *parameters])
                    raise InputError(
                        f"Formula: {name!r} in {formula!r} is not known; known are {known}. Give it as a parameter: "
                        f"parameters={{{name!r}: ...}}",
                        item=name,
                    )
            case ast.Constant(value=int() | float()) | ast.UnaryOp(op=ast.USub() | ast.UAdd()):
                pass
            case ast.BinOp(op=operation) if type(operation) in _OPERATIONS:
                pass
            case ast.operator() | ast.unaryop() | ast.expr_context():
                pass
            case _:
                hint = "; a power is written **" if isinstance(node, ast.BinOp) else ""
                raise InputError(
                    f"Formula: {ast.unparse(node)!r} in {formula!r} is not allowed; use + - * / **, numbers, names "
                    f"and functions{hint}",
                    item="formula",
                )
    return tree, found


def evaluated(tree: ast.expr, names: dict[str, Any]) -> Any:
    """The value of a tree, with numbers or symbols for names and functions; ``names[""]`` makes constants."""
    match tree:
        case ast.Constant(value=value):
            return names[""](value)
        case ast.Name(id=name):
            return names[name]
        case ast.UnaryOp(op=operation, operand=operand):
            value = evaluated(operand, names)
            return -value if isinstance(operation, ast.USub) else value
        case ast.Call(func=ast.Name(id=name), args=args):
            return names[name](*(evaluated(each, names) for each in args))
        case ast.BinOp(left=left, op=operation, right=right):
            a, b = evaluated(left, names), evaluated(right, names)
            match operation:
                case ast.Add():
                    return a + b
                case ast.Sub():
                    return a - b
                case ast.Mult():
                    return a * b
                case ast.Div():
                    return a / b
            return a**b
    raise AssertionError(ast.dump(tree))


def undefined_part(tree: ast.expr, names: dict[str, Any]) -> str | None:
    """The smallest part of a tree that has no finite value with these numbers, in words; None if all have one."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.expr) and not (isinstance(tree, ast.Call) and node is tree.func):
            found = undefined_part(node, names)
            if found:
                return found
    with np.errstate(all="ignore"):
        value = evaluated(tree, names)
    if np.isfinite(value):
        return None
    inside = [node for node in ast.iter_child_nodes(tree) if isinstance(node, ast.expr)]
    with np.errstate(all="ignore"):
        if isinstance(tree, ast.Call):
            return f"{ast.unparse(tree)} is {value} where {ast.unparse(inside[1])} = {evaluated(inside[1], names):g}"
    return f"{ast.unparse(tree)} is {value}"


def width_of(formula: str, parameters: Sequence[str], speeds: bool = False) -> int:
    """Atoms a row.

    Raises
    ------
    InputError
        As `parsed`; a formula without atoms, or one that leaves some out.
    """
    numbers = parsed(formula, parameters, speeds)[1]
    if not numbers:
        raise InputError(
            f"Formula: {formula!r} names no coordinate; x1, y1, z1 are those of the first atom of a row, x2 ... of the "
            "second",
            item="formula",
        )
    width = max(numbers)
    if len(numbers) < width:
        left_out = min(set(range(1, width)) - numbers)
        raise InputError(
            f"Formula: {formula!r} names atom {width} of a row and not atom {left_out}; number them from 1 on",
            item="formula",
        )
    return width


@cache
def code_of(formula: str, width: int, parameters: tuple[str, ...], speeds: bool = False) -> Code:
    """The code of a formula over so many atoms a row; with `speeds`, of one that is linear in their velocities.

    Raises
    ------
    InputError
        As `width_of`; another width; a formula that does not change with the positions, or is not linear in the
        velocities.
    UnsupportedError
        SymPy is needed and not there.
    """
    tree, _ = parsed(formula, parameters, speeds)
    named = width_of(formula, parameters, speeds)
    if named != width:
        raise InputError(
            f"Formula: {formula!r} names {named} atoms a row, and atoms has {width} a row; give as many as the formula "
            "names",
            item="atoms",
        )
    return Code(tree, _module(formula, tree, width, parameters, speeds))


class Code:
    """What is computed of a formula.

    Attributes
    ----------
    row : callable
        ``row(r, p, t, out)`` for `kcons.solvers.sparse.row_functions`, to be compiled.
    first : callable
        Value and gradient of all rows: of the coordinates, the time and the parameters, an array each. Of velocities
        their coefficients.
    second : callable
        v^T (d2q/dr2) v, dq/dt and 2 (d2q/dr dt) . v + d2q/dt2, of the coordinates, the velocities, the time and the
        parameters. Of velocities v . (d coefficients/dt).
    plain_first, plain_second : callable
        The same of plain numbers, in a tenth of the time; what is undefined raises, or is complex.
    invariant, moving : bool
        Whether a common shift of all atoms changes nothing; whether the time is in it.
    """

    def __init__(self, tree: ast.expr, module: ModuleType) -> None:
        self.tree, self.row = tree, module.row
        self.first = FunctionType(module.first.py_func.__code__, _NUMPY)
        self.second = FunctionType(module.second.__code__, _NUMPY)
        self.plain_first, self.plain_second = module.first.py_func, module.second
        self.invariant, self.moving = bool(module.INVARIANT), bool(module.MOVING)


_NUMPY: dict[str, Any] = {**FUNCTIONS, "copysign": np.copysign, "__builtins__": {"abs": np.abs}}


def _module(formula: str, tree: ast.expr, width: int, parameters: tuple[str, ...], speeds: bool) -> ModuleType:
    """The module of a formula, from its file if there is one."""
    meant = repr((ast.unparse(tree), width, parameters, speeds)).encode()
    key = hashlib.sha256(Path(__file__).read_bytes() + meant).hexdigest()[:24]  # other code writes other files
    folder = _folder()
    path = folder / f"formula_{key}.py"
    if not path.exists():
        text = _written(formula, tree, width, parameters, speeds)
        handle, name = tempfile.mkstemp(dir=folder, suffix=".py")
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        os.replace(name, path)  # at once, for other processes
    spec = importlib.util.spec_from_file_location(f"kcons_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    # Numba looks for what it has kept by the names of modules.
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _folder() -> Path:
    """Where code is kept: with Numba's own files, or where caches of the user are, or until the process ends."""
    given = (
        os.environ.get("NUMBA_CACHE_DIR")
        or str(getattr(numba.config, "CACHE_DIR", ""))
        or os.environ.get("XDG_CACHE_HOME")
    )
    for folder in (Path(given or os.path.expanduser("~/.cache")) / "kcons-formulas", _passing):
        path = Path(folder() if callable(folder) else folder)
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(path, os.W_OK):
            return path
    raise UnsupportedError("there is no folder to write the code of a formula to; set NUMBA_CACHE_DIR to one")


@cache
def _passing() -> str:
    return tempfile.mkdtemp(prefix="kcons-formulas-")


def _written(formula: str, tree: ast.expr, width: int, parameters: tuple[str, ...], linear: bool) -> str:
    """The text of a module: exact derivatives with common parts computed once."""
    try:
        import sympy
        from sympy.printing.pycode import PythonCodePrinter
    except ImportError:
        raise UnsupportedError(
            "formulas are differentiated by SymPy, which is not installed: python -m pip install 'kcons[formulas]'. "
            "Custom takes a function and its gradient without it"
        ) from None

    class Printer(PythonCodePrinter):  # type: ignore[misc]
        """For numbers and arrays alike."""

        def _print_sign(self, expr: Any) -> str:
            return f"copysign(1.0, {self._print(expr.args[0])})"

        def _print_Exp1(self, expr: Any) -> str:
            return repr(math.e)

        def _print_Pi(self, expr: Any) -> str:
            return repr(math.pi)

    def constant(value: float) -> Any:
        return sympy.Rational(value) if 2 * value == int(2 * value) else sympy.Float(value)

    printer = Printer({"fully_qualified_modules": False})
    axes = [f"{axis}{atom}" for atom in range(1, width + 1) for axis in "xyz"]
    speeds = [f"v{name}" for name in axes]
    symbols = {name: sympy.Symbol(name, real=True) for name in (*axes, *speeds, *parameters, "t")}
    functions = {name: getattr(sympy, _IN_SYMPY.get(name, name)) for name in FUNCTIONS}
    value = sympy.sympify(evaluated(tree, {**functions, **symbols, "pi": sympy.pi, "": constant}))
    t = symbols["t"]
    steep = [value.diff(symbols[name]) for name in axes]
    slope = [value.diff(symbols[name]) for name in speeds] if linear else steep
    if all(part == 0 for part in slope):
        what = "velocities: it has none of them" if linear else "positions: its gradient is zero"
        raise InputError(f"Formula: {formula!r} does not change with the {what}; write one that does", item="formula")
    along = sum((part * symbols[v] for part, v in zip(slope, speeds, strict=True)), sympy.S.Zero)
    bend = sum((along.diff(symbols[n]) * symbols[v] for n, v in zip(axes, speeds, strict=True)), sympy.S.Zero)
    second = [bend, value.diff(t), 2 * along.diff(t) + value.diff(t, 2)]
    if linear:
        moving = [symbols[name] for name in speeds]
        rest = sympy.simplify(value.subs(dict.fromkeys(moving, 0)))
        if rest != 0 or any(part.has(*moving) for part in slope):
            raise InputError(
                f"VelocityFormula: {formula!r} is not a sum of velocities times functions of the positions and the time"
                + (f": {rest} is left without velocities; what the sum is held at is the target" if rest != 0 else ""),
                item="formula",
            )
        second = [bend + along.diff(t)]
    sums = [sum(steep[axis::3], sympy.S.Zero) for axis in range(3)]
    invariant = width > 1 and all(each == 0 or sympy.expand(each) == 0 for each in sums)

    def function(name: str, arguments: Sequence[str], results: Sequence[Any]) -> str:
        smooth = [part.replace(sympy.DiracDelta, lambda *_: sympy.S.Zero) for part in results]  # beside kinks of abs
        common, last = sympy.cse(smooth, symbols=(sympy.Symbol(f"_{k}") for k in range(10**6)))
        lines = [f"    {printer.doprint(part)} = {printer.doprint(what)}" for part, what in common]
        shown = ", ".join(printer.doprint(sympy.Float(what) if what.is_Integer else what) for what in last)
        return "\n".join([f"def {name}({', '.join(arguments)}):", *lines, f"    return ({shown},)\n"])

    # Of velocities: of where a flight ends, see `kcons.solvers.sparse.row_functions`.
    used = "flight" if linear else "first"
    places = [f"r[{k}]" for k in range((6 if linear else 3) * width)] + ["t"]
    places += [f"p[{k}]" for k in range(len(parameters))]
    row = ["def row(r, p, t, out):", f"    found = {used}({', '.join(places)})"]
    row += [f"    out[{k}] = found[{k}]" for k in range(3 * width + 1)]
    names = ", ".join(sorted({*FUNCTIONS, "copysign"} - {"abs"}))
    head = f"# Written by kcons for {formula!r}.\nfrom math import {names}\n\nimport numba\n"
    flags = '@numba.njit(fastmath={"contract", "arcp", "nsz"}, error_model="numpy")'
    ahead = [part + bent / 2 for part, bent in zip(slope, steep, strict=True)]
    flight = flags + "\n" + function("flight", [*axes, *speeds, "t", *parameters], [value, *ahead])
    return "\n\n".join(
        [
            head,
            f"INVARIANT, MOVING = {invariant}, {value.has(t)}",
            flags + "\n" + function("first", [*axes, "t", *parameters], slope if linear else [value, *slope]),
            *([flight] if linear else []),
            function("second", [*axes, *speeds, "t", *parameters], second),
            "\n".join(row) + "\n",
        ]
    )
