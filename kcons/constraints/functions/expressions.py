"""Formulas as code: what is written is checked, differentiated by SymPy, and kept in a file.

Formulas come from files of others, too. So names are those of a list, and length, depth and the size of the second
derivatives are bounded before SymPy sees anything. It sees numbers as they are computed with, in double precision: it
would find 9**9**9 to the last digit.

The file is a module of functions on plain numbers, or on arrays of one number a row: value and gradient, and what
accelerations need; of a formula that is linear in the velocities its coefficients, and what these need. It lies where
Numba can keep what it compiles of it, so that another process finds both.
"""

from __future__ import annotations

import ast
import hashlib
import logging
import math
import os
import re
import sys
import tempfile
import uuid
from collections.abc import Sequence
from functools import cache
from itertools import count
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numba
import numpy as np

from kcons.errors import InputError, UnsupportedError

logger = logging.getLogger("kcons")

#: Characters of a formula, levels of its tree (a sum of n terms has n), and parts of its second derivatives.
MAX_LENGTH, MAX_DEPTH, MAX_PARTS = 10_000, 200, 20_000
#: Functions of formulas: name -> the one of NumPy; of the same name in SymPy, but for those below.
FUNCTIONS: dict[str, Any] = {
    **{name: getattr(np, name) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt")},
    **{f"a{name[3:]}": getattr(np, name) for name in ("arcsin", "arccos", "arctan", "arctan2")},
    "abs": np.abs,
}
_IN_SYMPY = {"abs": "Abs"}
#: What a sum that vanishes may be off by, beside its parts, at places where these are of order one.
_SAME = 1e-9
_COORDINATE = re.compile(r"[xyz]([1-9][0-9]{0,5})")
_SPEED = re.compile(r"v[xyz]([1-9][0-9]{0,5})")
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
    if len(formula) > MAX_LENGTH:
        raise _too_large(formula, f"has {len(formula)} characters, and at most {MAX_LENGTH} are read")
    try:
        tree = ast.parse(formula.strip(), mode="eval").body
    except (SyntaxError, ValueError) as error:  # of bytes that are no text, a ValueError
        remedy = "; write what is held at zero, the left side less the right one" if "=" in formula else ""
        what = error.msg if isinstance(error, SyntaxError) else error
        raise InputError(f"Formula: {formula!r:.200} cannot be read: {what}{remedy}", item="formula") from None
    except (RecursionError, MemoryError):
        raise _too_large(formula, "is nested too deeply") from None
    _check_depth(formula, tree)
    found, called = set(), set()
    for node in ast.walk(tree):  # what contains something comes before it
        match node:
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
                called.add(node.func)
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
                elif name in FUNCTIONS and node not in called:
                    raise InputError(
                        f"Formula: {name} in {formula!r} is a function; write what it is of, as in {name}(x1)",
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
            case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
                if not value <= sys.float_info.max:
                    raise _too_large(formula, "has a number that is too large", "write it in other units")
            case ast.UnaryOp(op=ast.USub() | ast.UAdd()):
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
    if _parts(tree)[2] > MAX_PARTS:
        raise _too_large(formula, f"has second derivatives of more than {MAX_PARTS} parts")
    return _with_numbers(formula, tree), found


def _too_large(
    formula: str,
    what: str,
    remedy: str = "shorten it, put parentheses around parts of a long sum, or use Custom, which takes a function",
) -> InputError:
    return InputError(f"Formula: {formula!r:.60} {what}; {remedy}", item="formula")


def _check_depth(formula: str, tree: ast.expr) -> None:
    level: list[ast.AST] = [tree]
    for _ in range(MAX_DEPTH):
        level = [child for node in level for child in ast.iter_child_nodes(node) if isinstance(child, ast.expr)]
        if not level:
            return
    raise _too_large(formula, f"is nested in more than {MAX_DEPTH} levels")


def _is_number(tree: ast.expr) -> bool:
    return not any(isinstance(node, ast.Name) and node.id not in (*FUNCTIONS, "pi") for node in ast.walk(tree))


def _with_numbers(formula: str, tree: ast.expr) -> ast.expr:
    """The tree with the values of parts that have no names; `InputError` where one of them is no number."""
    if isinstance(tree, ast.Constant):
        return tree
    if not _is_number(tree):
        for field, part in ast.iter_fields(tree):
            if field == "args":
                setattr(tree, field, [_with_numbers(formula, each) for each in part])
            elif isinstance(part, ast.expr) and field != "func":
                setattr(tree, field, _with_numbers(formula, part))
        return tree
    known = {**FUNCTIONS, "pi": np.float64(np.pi), "": np.float64}
    what = undefined_part(tree, known)
    if what is not None:
        raise InputError(f"Formula: {what} in {formula!r:.200}; give numbers with a finite value", item="formula")
    with np.errstate(all="ignore"):
        return ast.copy_location(ast.Constant(float(evaluated(tree, known))), tree)


def _operands(tree: ast.expr) -> list[ast.expr]:
    """The parts of a formula that an operation or a function is done with."""
    match tree:
        case ast.Call(args=args):
            return args
        case ast.BinOp(left=left, right=right):
            return [left, right]
        case ast.UnaryOp(operand=operand):
            return [operand]
    return []


def _parts(tree: ast.expr) -> tuple[int, int, int]:
    """About how many parts a formula, its first and its second derivative along a direction are written with."""
    match tree:
        case ast.Name(id=name):
            return 1, int(name != "pi"), 0
        case ast.UnaryOp(operand=operand):
            return _parts(operand)
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub(), right=right):
            a, b = _parts(left), _parts(right)
            return a[0] + b[0], a[1] + b[1], a[2] + b[2]
        case ast.BinOp(left=left, right=right) | ast.Call(args=[left, right]):
            a, b = _parts(left), _parts(right)
            size = a[0] + b[0] + 1
            first = bool(a[1]) * (a[1] + b[0] + 1) + bool(b[1]) * (a[0] + b[1] + 1)
            both = 2 * (a[1] + b[1] + 1) if a[1] and b[1] else 0
            return size, first, bool(a[2]) * (a[2] + b[0]) + bool(b[2]) * (a[0] + b[2]) + both + first
        case ast.Call(args=[inner]):
            size, first, second = _parts(inner)
            return size + 1, bool(first) * (size + first + 1), bool(first) * (2 * (size + first) + second + 1)
    return 1, 0, 0


def evaluated(tree: ast.expr, names: dict[str, Any]) -> Any:
    """The value of a tree, with numbers or symbols for names and functions.

    ``names[""]`` makes constants, and ``names["**"]``, if it is there, exponents that are constants.
    """
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
            exponent = isinstance(operation, ast.Pow) and isinstance(right, ast.Constant) and "**" in names
            a, b = evaluated(left, names), evaluated(right, {**names, "": names["**"]} if exponent else names)
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
    inside = _operands(tree)
    for node in inside:
        found = undefined_part(node, names)
        if found:
            return found
    with np.errstate(all="ignore"):
        value = evaluated(tree, names)
    if np.isfinite(value):
        return None
    with np.errstate(all="ignore"):
        if isinstance(tree, ast.Call):
            return f"{ast.unparse(tree)} is {value} where {ast.unparse(inside[0])} = {evaluated(inside[0], names):g}"
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
        left_out = next(k for k in count(1) if k not in numbers)
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
        of where a flight ends: of the coordinates in its middle, the way, the time and the parameters.
    second : callable
        v^T (d2q/dr2) v, dq/dt and 2 (d2q/dr dt) . v + d2q/dt2, of the coordinates, the velocities, the time and the
        parameters. Of velocities v . (d coefficients/dt).
    invariant, moving : bool
        Whether a common shift of all atoms changes nothing; whether the time is in it.
    """

    def __init__(self, tree: ast.expr, module: ModuleType) -> None:
        self.tree, self.row = tree, module.row
        self.first = FunctionType(module.first.py_func.__code__, _NUMPY)
        self.second = FunctionType(module.second.__code__, _NUMPY)
        self.invariant, self.moving = bool(module.INVARIANT), bool(module.MOVING)


_NUMPY: dict[str, Any] = {**FUNCTIONS, "copysign": np.copysign, "__builtins__": {"abs": np.abs}}


def _module(formula: str, tree: ast.expr, width: int, parameters: tuple[str, ...], speeds: bool) -> ModuleType:
    """The module of a formula, from its file if there is one that is whole."""
    meant = repr((formula.strip(), width, parameters, speeds)).encode()
    key = hashlib.sha256(Path(__file__).read_bytes() + meant).hexdigest()[:24]  # other code writes other files
    path = _folder() / f"formula_{key}.py"
    text = _whole(path)
    if text is None:
        text = _written(formula, tree, width, parameters, speeds).encode()
        unfinished = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
        try:
            unfinished.write_bytes(_digest(text) + text)
            os.replace(unfinished, path)
        except OSError as error:
            unfinished.unlink(missing_ok=True)
            raise UnsupportedError(
                f"the code of a formula cannot be written to {path.parent}: {error}; set NUMBA_CACHE_DIR to a folder "
                "with space in it"
            ) from error
    # Numba looks for what it has kept by the names of modules.
    module = sys.modules[f"kcons_{path.stem}"] = ModuleType(f"kcons_{path.stem}")
    exec(compile(b"\n" + text, path, "exec"), module.__dict__)  # the digest is the first line
    return module


def _digest(text: bytes) -> bytes:
    return f"# {hashlib.sha256(text).hexdigest()}\n".encode()


def _whole(path: Path) -> bytes | None:
    """The code in a file, None where there is none or where it is not what its first line is the digest of."""
    if not path.is_file():
        return None
    head, newline, text = path.read_bytes().partition(b"\n")
    if head + newline == _digest(text):
        return text
    logger.warning("the kept code of a formula is damaged (%s); it is written anew", path)
    return None


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

        def _print_Integer(self, expr: Any) -> str:
            if abs(expr.p) < 2**53:
                return str(expr.p)
            return repr(float(expr)) if abs(expr.p) < 2**1023 else repr(math.copysign(1e308, expr.p))

        def _print_Rational(self, expr: Any) -> str:
            return f"{self._print_Integer(sympy.Integer(expr.p))}/{self._print_Integer(sympy.Integer(expr.q))}"

    printer = Printer({"fully_qualified_modules": False})
    axes = [f"{axis}{atom}" for atom in range(1, width + 1) for axis in "xyz"]
    speeds = [f"v{name}" for name in axes]
    symbols = {name: sympy.Symbol(name, real=True) for name in (*axes, *speeds, *parameters, "t")}
    functions = {name: getattr(sympy, _IN_SYMPY.get(name, name)) for name in FUNCTIONS}
    value = sympy.sympify(evaluated(tree, {**functions, **symbols, "pi": sympy.pi, "": sympy.Float, "**": _exponent}))
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
        rest = value.subs(dict.fromkeys(moving, 0))
        rest = sympy.S.Zero if _is_zero([rest], value) else rest
        if rest != 0 or any(part.has(*moving) for part in slope):
            raise InputError(
                f"VelocityFormula: {formula!r} is not a sum of velocities times functions of the positions and the time"
                + (f": {rest} is left without velocities; what the sum is held at is the target" if rest != 0 else ""),
                item="formula",
            )
        second = [bend + along.diff(t)]
    invariant = width > 1 and all(_is_zero(steep[k::3], None) for k in range(3))

    def function(name: str, arguments: Sequence[str], results: Sequence[Any]) -> str:
        smooth = [part.replace(sympy.DiracDelta, lambda *_: sympy.S.Zero) for part in results]  # beside kinks of abs
        common, last = sympy.cse(smooth, symbols=(sympy.Symbol(f"_{k}") for k in range(10**6)))
        lines = [f"    {printer.doprint(part)} = {printer.doprint(what)}" for part, what in common]
        shown = ", ".join(printer.doprint(sympy.Float(what) if what.is_Integer else what) for what in last)
        return "\n".join([f"def {name}({', '.join(arguments)}):", *lines, f"    return ({shown},)\n"])

    # Of velocities: of where a flight ends, see `kcons.solvers.sparse.row_functions`.
    ends = [part + bent / 2 for part, bent in zip(slope, steep, strict=True)] if linear else slope
    places = [f"r[{k}]" for k in range((6 if linear else 3) * width)] + ["t"]
    places += [f"p[{k}]" for k in range(len(parameters))]
    row = ["def row(r, p, t, out):", f"    found = first({', '.join(places)})"]
    row += [f"    out[{k}] = found[{k}]" for k in range(3 * width + 1)]
    names = ", ".join(sorted({*FUNCTIONS, "copysign"} - {"abs"}))
    head = f"# Written by kcons for {formula!r}.\nfrom math import {names}\n\nimport numba\n"
    flags = '@numba.njit(fastmath={"contract", "arcp", "nsz"}, error_model="numpy")'
    return "\n\n".join(
        [
            head,
            f"INVARIANT, MOVING = {invariant}, {value.has(t)}",
            flags + "\n" + function("first", [*axes, *(speeds if linear else []), "t", *parameters], [value, *ends]),
            function("second", [*axes, *speeds, "t", *parameters], second),
            "\n".join(row) + "\n",
        ]
    )


def _exponent(value: float) -> Any:
    """A power that is a number: whole ones and halves are written as such."""
    import sympy

    return sympy.Rational(value) if abs(value) <= 1000 and 2 * value == int(2 * value) else sympy.Float(value)


def _is_zero(parts: Sequence[Any], size: Any) -> bool:
    """Whether a sum vanishes everywhere, whatever the signs of what is in ``abs``; `size` is what it is small beside.

    Where SymPy does not see it, it is found at random places, complex ones, where all functions are defined.
    """
    import sympy

    def free(part: Any) -> Any:
        return part.replace(sympy.sign, lambda inner: sympy.Symbol(f"sign of {inner}")).replace(
            sympy.DiracDelta, lambda *_: sympy.S.Zero
        )

    parts = [free(part) for part in parts]
    total = sum(parts, sympy.S.Zero)
    if total == 0:
        return True
    beside = parts if size is None else [size]
    names = sorted(set().union(*(part.free_symbols for part in [*parts, *beside])), key=str)
    function = sympy.lambdify(names, [total, *beside], "numpy")
    places = np.random.default_rng(0).normal(size=(len(names), 40, 2)) @ [1.0, 1.0j]
    with np.errstate(all="ignore"):
        found, *others = (np.broadcast_to(np.asarray(part, dtype=complex), 40) for part in function(*places))
        near = np.abs(found) <= _SAME * sum(np.abs(other) for other in others)
    seen = np.isfinite(found) & np.isfinite(sum(others))
    return bool(seen.sum() > 5 and near[seen].all())
