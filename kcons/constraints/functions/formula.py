"""Rows that are formulas of the coordinates of their atoms, or of these and linear in the velocities.

What is written is checked, differentiated, and kept in a file. Formulas come from files of others, too: names are those
of a list, and length and depth are bounded.

Derivatives are taken backwards through the operations, which are written down once each; second ones are complex steps
of the first. The file is a module of functions on plain numbers, or on arrays of one number a row. It lies where Numba
can keep what it compiles of it, so that another process finds both.
"""

from __future__ import annotations

import ast
import hashlib
import math
import os
import re
import sys
import tempfile
import uuid
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from keyword import iskeyword
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, Self

import numba
import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import FloatArray, Positive, as_float_array, refuse_other
from kcons.constraints.constraint import Constraint, RowKind
from kcons.constraints.functions.straight_line import Operand, Tape, differentiated
from kcons.constraints.target import Target
from kcons.errors import InputError, UnsupportedError

__all__ = ["Formula", "VelocityFormula"]

#: Characters of a formula, and levels of its tree (a sum of n terms has n).
MAX_LENGTH, MAX_DEPTH = 10_000, 200
#: Functions of formulas: name -> the one of NumPy.
FUNCTIONS: dict[str, Any] = {
    **{name: getattr(np, name) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt")},
    **{f"a{name[3:]}": getattr(np, name) for name in ("arcsin", "arccos", "arctan", "arctan2")},
    "abs": np.abs,
}
#: What a sum that vanishes may be off by, beside its parts, at places where these are of order one.
_SAME = 1e-9
_COORDINATE = re.compile(r"(v?)[xyz]([1-9][0-9]{0,5})")
_OPERATIONS: dict[type, Callable[[Any, Any], Any]]
_OPERATIONS = {ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide, ast.Pow: np.power}


def parsed(formula: str) -> ast.expr:
    """The tree of a formula that is neither too long nor too deep."""
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
    level: list[ast.AST] = [tree]
    for _ in range(MAX_DEPTH):
        level = [child for node in level for child in ast.iter_child_nodes(node) if isinstance(child, ast.expr)]
    if level:
        raise _too_large(formula, f"is nested in more than {MAX_DEPTH} levels")
    return tree


def _too_large(
    formula: str,
    what: str,
    remedy: str = "shorten it, put parentheses around parts of a long sum, or use Custom, which takes a function",
) -> InputError:
    return InputError(f"Formula: {formula!r:.60} {what}; {remedy}", item="formula")


def _value(tree: ast.expr, numbers: Mapping[str, Any], formula: str) -> Any:
    """The value of a part of a formula, with numbers for names."""

    def value(part: ast.expr) -> Any:
        return _value(part, numbers, formula)

    match tree:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            if not number <= sys.float_info.max:
                raise _too_large(formula, "has a number that is too large", "write it in other units")
            return float(number)
        case ast.Name(id=name) if name in numbers:
            return numbers[name]
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in FUNCTIONS and len(args) == 1 + (
            name == "atan2"
        ):
            return FUNCTIONS[name](*map(value, args))
        case ast.BinOp(left=left, op=operation, right=right) if type(operation) in _OPERATIONS:
            return _OPERATIONS[type(operation)](value(left), value(right))
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -value(operand)
        case ast.UnaryOp(op=ast.UAdd(), operand=operand):
            return value(operand)
    item = "formula"
    match tree:
        case ast.Call(func=ast.Name(id=item)):
            known = f"{', '.join(sorted(FUNCTIONS))}, of one number each, atan2 of two"
            what = f"is no function of formulas; these are {known}"
        case ast.Name(id=item) if item in FUNCTIONS:
            what = f"is a function; write what it is of, as in {item}(x1)"
        case ast.Name(id=item) if _COORDINATE.fullmatch(item):
            what = "is a velocity; what is linear in velocities is held by VelocityFormula"
        case ast.Name(id=item):
            known = ", ".join(["x1, y1, z1, x2, ...", *(name for name in numbers if not _COORDINATE.fullmatch(name))])
            what = f"is not known; known are {known}. Give it as a parameter: parameters={{{item!r}: ...}}"
        case _:
            hint = "; a power is written **" if isinstance(tree, ast.BinOp) else ""
            what = f"is not allowed; use + - * / **, numbers, names and functions{hint}"
    raise InputError(f"Formula: {ast.unparse(tree)!r} in {formula!r:.200} {what}", item=item)


class Code:
    """What is computed of a formula with parameters of these names; with `speeds`, of one that is linear in velocities.

    `row` and `rate` are those of a `Constraint`, `rate` None where the time is not in the formula; `width` are the
    atoms a row, and `invariant` says whether a common shift of all of them changes nothing.
    """

    def __init__(self, formula: str, parameters: tuple[str, ...], speeds: bool = False) -> None:
        tree = parsed(formula)
        places = [_COORDINATE.fullmatch(node.id) for node in ast.walk(tree) if isinstance(node, ast.Name)]
        atoms = {int(place[2]) for place in places if place and (speeds or not place[1])}
        self.width = width = max(atoms, default=0)
        if len(atoms) < width:
            least = min({*range(1, width + 1)} - atoms)
            what = f"atom {width} of a row and not atom {least}; number them from 1 on"
            raise InputError(f"Formula: {formula!r} names {what}", item="formula")
        n = 3 * width
        names = [
            f"{kind}{axis}{atom}" for kind in ("", "v")[: 1 + speeds] for atom in range(1, width + 1) for axis in "xyz"
        ]

        def value(r: Any, p: Any, t: Any) -> Any:
            known = {name: r[k] for k, name in enumerate(names)} | {name: p[k] for k, name in enumerate(parameters)}
            return _value(tree, {**known, "t": t, "pi": math.pi}, formula)

        with np.errstate(all="ignore"):  # of constants
            tape = differentiated(value, n + n * speeds)
        if not atoms:
            what = "no coordinate; x1, y1, z1 are those of the first atom of a row, x2 ... of the second"
            raise InputError(f"Formula: {formula!r} names {what}", item="formula")
        found, *slopes, moves = (_text(each) for each in tape.results)
        steep, slope = slopes[:n], slopes[n:] or slopes
        self.invariant = _look(formula, tape, n, speeds, len(parameters)) and width > 1
        ends = [f"{part} + 0.5*{bent}" for part, bent in zip(slope, steep, strict=True)] if speeds else slope
        texts = [_function("row", tape, [found, *ends])]
        if moves != "0.0":
            texts.append(_function("rate", tape, [moves]))
        module = _module("\n\n".join([f"# Written by kcons for {formula!r}.", "from numpy import *\n", *texts]))
        self.row, self.rate = module.row, getattr(module, "rate", None)


#: Each once.
code_of = cache(Code)


#: Operations of tapes, for real numbers and, to first order in imaginary parts, complex ones.
_TEXT = {
    **{name: f"{{}}{sign}{{}}" for sign, name in ((" + ", "add"), (" - ", "subtract"), ("*", "multiply"))},
    **{"divide": "{}/{}", "power": "{}**{}", "negative": "-{}", "copysign": "copysign({}, {}.real)"},
    "absolute": "copysign(1.0, {0}.real)*{0}",
    "arctan2": "arctan2({0}.real, {1}.real) + ({1}*({0} - {0}.real) - {0}*({1} - {1}.real))/({0}*{0} + {1}*{1})",
}


def _text(operand: Operand) -> str:
    if not isinstance(operand, tuple):
        return repr(operand) if operand >= 0 else f"({operand!r})"
    kind, k = operand
    return {"t": "t", "k": f"_{k}"}.get(kind, f"{kind}[{k}]")


def _function(name: str, tape: Tape, results: list[str]) -> str:
    """Code that puts results of a tape out, with the steps that these need."""
    needed, lines = " ".join(results), []
    for k, (operation, operands) in reversed(list(enumerate(tape.steps))):
        if re.search(rf"\b_{k}\b", needed):
            texts = [_text(each) for each in operands]
            if operation == "power" and isinstance(operands[1], float) and operands[1].is_integer():
                texts[1] = str(int(operands[1])) if 0 < operands[1] < 1000 else texts[1]
            lines.append(f"    _{k} = {_TEXT.get(operation, f'{operation}({{}})').format(*texts)}")
            needed += lines[-1]
    outs = [f"    out[{k}] = {each}" for k, each in enumerate(results)]
    return "\n".join([f"def {name}(r, p, t, out):", *reversed(lines), *outs]) + "\n"


def _look(formula: str, tape: Tape, n: int, speeds: bool, parameters: int) -> bool:
    """Whether common shifts change nothing, found out at random places; what is no row is refused.

    At complex ones, where all functions are defined, and whatever the signs of what is in ``abs``.
    """
    rng = np.random.default_rng(0)
    r, faster, p = (rng.normal(size=(size, 40, 2)) @ [1.0, 1.0j] for size in (2 * n, 2 * n, parameters + 1))
    signs = rng.choice([-1.0, 1.0], (len(tape.steps), 40))

    def looked(places: Any) -> Any:
        some = iter(signs)
        own: dict[str, Any] = {"absolute": lambda x: next(some) * x, "copysign": lambda _, x: next(some)}
        own["arctan2"] = lambda a, b: np.arctan(a / b)
        found = tape.run(places, p, p[-1], lambda name, *given: (own.get(name) or getattr(np, name))(*given))
        return np.array([np.broadcast_to(each, 40) for each in found[:-1]])

    with np.errstate(all="ignore"):
        value, *slopes = looked(r)
        steep, slope = np.array(slopes[:n]), np.array(slopes[n:] or slopes)
        if not np.isfinite([value, *slopes]).all(axis=0).any():
            raise InputError(
                f"Formula: {formula!r:.200} is finite nowhere; give numbers with a finite value", item="formula"
            )
        if np.isfinite(slopes).all() and not slope.any():
            what = "velocities: it has none of them" if speeds else "positions: its gradient is zero"
            raise InputError(
                f"Formula: {formula!r} does not change with the {what}; write one that does", item="formula"
            )
        if speeds:
            faster[:n] = r[:n]
            bent, rest = looked(faster)[1 + n :] - slope, looked(np.concatenate([r[:n], 0 * r[n:]]))[0]
            if not all(map(_vanishes, [rest, *bent], [value, *slope])):
                left = "" if _vanishes(rest, value) else "; at rest it is not 0: what the sum is held at is the target"
                raise InputError(
                    f"VelocityFormula: {formula!r} is not a sum of velocities times functions of the positions and the "
                    f"time{left}",
                    item="formula",
                )
        return all(_vanishes(steep[k::3].sum(axis=0), *steep[k::3]) for k in range(3))


def _vanishes(sums: Any, *parts: Any) -> bool:
    """Whether a sum is nothing beside its parts, at all places that are seen."""
    size = np.abs(parts).sum(axis=0)
    seen = np.isfinite(sums) & np.isfinite(size)
    return bool(seen.sum() > 5 and (np.abs(sums) <= _SAME * size)[seen].all())


def _module(text: str) -> ModuleType:
    """The module with this text, which is kept in a file: Numba keeps beside files what it compiles of them."""
    own = text.encode()
    try:
        path = _folder() / f"formula_{hashlib.sha256(own).hexdigest()[:24]}.py"
        if not path.is_file() or path.read_bytes() != own:
            unfinished = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
            try:
                unfinished.write_bytes(own)
                os.replace(unfinished, path)
            finally:
                unfinished.unlink(missing_ok=True)
    except OSError as error:
        raise UnsupportedError(
            f"the code of a formula cannot be written: {error}; set NUMBA_CACHE_DIR to a folder with space in it"
        ) from error
    # Numba looks for what it has kept by the names of modules.
    module = sys.modules[f"kcons_{path.stem}"] = ModuleType(f"kcons_{path.stem}")
    exec(compile(own, path, "exec"), module.__dict__)
    return module


def _folder() -> Path:
    """Where code is kept: with Numba's own files, or where caches of the user are, or until the process ends."""
    given = os.environ.get("NUMBA_CACHE_DIR") or getattr(numba.config, "CACHE_DIR", "")
    caches = given or os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    path = Path(caches) / "kcons-formulas"
    with suppress(OSError):
        path.mkdir(parents=True, exist_ok=True)
    return path if os.access(path, os.W_OK) else Path(_passing())


@cache
def _passing() -> str:
    return tempfile.mkdtemp(prefix="kcons-formulas-")


class Formula(Constraint):
    """A formula of the coordinates of a few atoms, differentiated exactly and compiled.

    Parameters
    ----------
    formula : str
        x1, y1, z1 are the coordinates of the first atom of a row, x2, ... those of the second, t is the time; with
        ``+ - * / **``, numbers, pi, the names of parameters, and the functions sin, cos, tan, asin, acos, atan,
        atan2, sinh, cosh, tanh, exp, log, sqrt, abs.
    atoms : array_like of int, shape (n_rows, width) or (width,)
        Atoms of each row, as many as the formula names; (n_rows,) where it names one.
    parameters : mapping of str to float or array_like of shape (n_rows,), optional
        Numbers by name, one for all rows or one for each.
    target : float, array_like, callable of time, MovingTarget or None
        Value held: 0 by default, None for what is found at the start.
    period : float, optional
        Period of the value, such as 2 pi.

    Notes
    -----
    Where the formula depends on differences of positions alone, which is found out, minimum images apply in periodic
    cells. The code is kept in files. An atom that crosses a corner, as of abs, loses speed: sqrt(q**2 + a**2) is round.

    Raises
    ------
    InputError
        Unknown names, atoms that are not named or not given, a formula that does not depend on the positions.
    SingularGeometryError
        When put into a set: no finite value or gradient, or a gradient of zero.

    Examples
    --------
    A bead on a wave that runs along x:

    >>> wave = Formula("z1 - a*sin(k*x1 - t)", 0, {"a": 0.1, "k": 2.0})
    >>> wave.n_rows, wave.moving
    (1, True)
    """

    held = ""
    singular = "value and gradient must be finite, and the gradient not zero; move the atoms, or write another formula"
    shared: ClassVar[tuple[str, ...]] = ("formula", "names", "period")
    per_row: Mapping[str, tuple[int, ...]] = {"values": ()}  # type: ignore[misc]
    values: FloatArray

    def __init__(
        self,
        formula: str,
        atoms: ArrayLike,
        parameters: Mapping[str, ArrayLike] | None = None,
        target: Target = 0.0,
        *,
        period: Positive | None = None,
    ) -> None:
        refuse_other(parameters, (Mapping, type(None)), "parameters", "numbers by name, such as {'k': 2.0}")
        refuse_other(formula, str, "formula", "text, such as 'x1**2 + y1**2 - 1'")
        given = dict(parameters or {})
        self.formula, self.names = formula, list(given)
        self.period = period
        for name in self.names:
            word = isinstance(name, str) and name.isidentifier() and not iskeyword(name)
            taken = word and (name in (*FUNCTIONS, "copysign", "t", "pi") or name.startswith(("_", "vx", "vy", "vz")))
            if not word or taken or (name[1:].isdigit() and name[0] in "xyz"):
                raise InputError(
                    f"Formula: {name!r:.60} cannot be the name of a parameter; give another word",
                    item=name if isinstance(name, str) else "parameters",
                )
        self.row_width = self.code().width
        super().__init__(atoms, target)
        columns = [self._of_each_row(name, value, ()) for name, value in given.items()]
        self.per_row = {"values": (len(columns),)}
        self._keep(values=np.stack(columns, axis=1) if columns else np.zeros((self.n_rows, 0)))
        self.translation_invariant = self.code().invariant

    def code(self) -> Code:
        """What is computed of the formula."""
        return code_of(self.formula, tuple(self.names), not self.holonomic)

    @property
    def row(self) -> Any:  # type: ignore[override]
        return self.code().row

    @property
    def rate(self) -> Any:  # type: ignore[override]
        return self.code().rate

    @classmethod
    def _rebuilt(cls, data: Mapping[str, Any]) -> Self:
        names, table = data["names"], as_float_array(data["values"], f"{cls.family}: values")
        if not isinstance(names, list | tuple) or table.shape[1:] != (len(names),):
            raise InputError(
                f"{cls.family} cannot be read: values have shape {table.shape} for the names {names!r:.80}; "
                "give a row of one number a name for each row",
                item="values",
            )
        more = {name: data[name] for name in cls.shared if name == "period"}
        return cls(data["formula"], data["atoms"], dict(zip(names, table.T, strict=True)), data["target"], **more)


class VelocityFormula(Formula):
    """A formula that is linear in the velocities of a few atoms (nonholonomic), differentiated exactly and compiled.

    Parameters
    ----------
    formula : str
        As for `Formula`, with vx1, vy1, vz1 for the velocity of the first atom of a row, vx2, ...: a sum of velocities,
        each times a function of coordinates, time and parameters.
    atoms : array_like of int, shape (n_rows, width) or (width,)
        Atoms of each row, as many as the formula names; (n_rows,) where it names one.
    parameters : mapping of str to float or array_like of shape (n_rows,), optional
        Numbers by name, one for all rows or one for each.
    target : float, array_like, callable of time, or MovingTarget
        What the sum is held at, 0 by default.

    Raises
    ------
    InputError
        A formula that is not linear in the velocities; else as `Formula`.

    Examples
    --------
    A bead whose velocity has a given angle with the radius, seen in the plane:

    >>> spiral = VelocityFormula("x1*vy1 - y1*vx1 - c*(x1*vx1 + y1*vy1)", 0, {"c": 2.0})
    >>> spiral.holonomic, spiral.moving
    (False, False)
    """

    holonomic = False
    kind = RowKind.VELOCITY
    shared: ClassVar[tuple[str, ...]] = ("formula", "names")

    def __init__(
        self, formula: str, atoms: ArrayLike, parameters: Mapping[str, ArrayLike] | None = None, target: Target = 0.0
    ) -> None:
        super().__init__(formula, atoms, parameters, target)
