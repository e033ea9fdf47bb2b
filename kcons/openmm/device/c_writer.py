"""Families of constraints as C: the function `row` of a declaration, translated from its syntax tree.

A row is straight arithmetic with elementary functions, loops over a range, and calls of other functions of that kind,
which are written in place. The same text is compiled as OpenCL C, CUDA, HIP and C++, its numbers being `mixed`.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from kcons.errors import UnsupportedError

#: Functions of NumPy, `math` and Python by name: what they are called in C.
FUNCTIONS = {name: name for name in ("sqrt", "sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "copysign")}
FUNCTIONS |= {"abs": "fabs", "absolute": "fabs", "fabs": "fabs", "arctan2": "atan2", "atan2": "atan2"}
FUNCTIONS |= {"arcsin": "asin", "asin": "asin", "arccos": "acos", "acos": "acos", "arctan": "atan", "atan": "atan"}
_SIGNS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
#: Loops of up to so many turns are written out: what they index then stays in registers.
UNROLLED = 12


class _Value(NamedTuple):
    """An expression: its text, whether it is whole, and its number where that is known."""

    text: str
    whole: bool = False
    number: float | None = None


def literal(number: float) -> str:
    """A number as C, in the precision of the kernel."""
    return f"((mixed) {float(number)!r})"


def c_function(
    name: str,
    row: Callable[..., Any],
    space: str = "",
    *,
    known: Mapping[int, float] | None = None,
    names: Mapping[str, int] | None = None,
) -> str:
    """The C function ``void NAME(const mixed* r, GLOBAL const mixed* p, mixed t, mixed* out)`` of a row.

    Parameters
    ----------
    name : str
    row : callable
        As `Constraint.row`.
    space : str
        Where positions and results are: '' for private memory, or 'GLOBAL '.
    known : mapping of int to float, optional
        Parameters whose values are known, by their place.
    names : mapping of str to int, optional
        Names in the function that stand for whole numbers.
    Raises
    ------
    UnsupportedError
        The function is not written in what can be translated.
    """
    writer = _Writer(row, known or {}, names or {})
    arguments = [argument.arg for argument in _parsed(row).args.args]
    writer.inline(row, dict(zip(arguments, ("r", "p", "t", "out"), strict=True)))
    head = f"DEVICE void {name}({space}const mixed* r, GLOBAL const mixed* p, mixed t, {space}mixed* out)"
    return "".join([head, " {\n", *writer.declared(), *writer.lines, "}\n"])


class _Writer:
    def __init__(self, row: Callable[..., Any], known: Mapping[int, float], names: Mapping[str, int]) -> None:
        self.row, self.known, self.names = row, known, names
        self.integers: set[str] = set()
        self.numbers: set[str] = set()
        self.scopes: list[tuple[str, Any, dict[str, Any]]] = []
        self.lines: list[str] = []
        self.calls = 0

    # -- functions ------------------------------------------------------------------------------

    def declared(self) -> list[str]:
        """Declarations of all variables."""
        kinds = ("int", self.integers), ("mixed", self.numbers)
        return [f" {kind} {', '.join(sorted(names))};\n" for kind, names in kinds if names]

    def inline(self, function: Callable[..., Any], bound: dict[str, Any]) -> list[_Value]:
        """Write the statements of a function whose arguments are `bound`; what it returns."""
        definition = _parsed(function)
        self.scopes.append((f"v{self.calls}_", inspect.getclosurevars(function), dict(bound)))
        self.calls += 1
        result: list[_Value] = []
        for statement in definition.body:
            if isinstance(statement, ast.Return):
                assert statement.value is not None
                given = statement.value.elts if isinstance(statement.value, ast.Tuple) else [statement.value]
                result = [self.value(each) for each in given]
            else:
                self.statement(statement)
        self.scopes.pop()
        return result

    def _named(self, name: str) -> Any:
        """What a name outside of the function stands for."""
        if name in self.names:
            return self.names[name]
        outside = self.scopes[-1][1]
        for place in (outside.nonlocals, outside.globals, outside.builtins):
            if name in place:
                return place[name]
        raise self._refused(f"the name {name}")

    def _refused(self, what: str) -> UnsupportedError:
        return UnsupportedError(
            f"{self.row.__qualname__} has {what}, which is not written in C; write a row with + - * / **, elementary "
            "functions of NumPy and loops over range, or leave it to the host (device=False)"
        )

    # -- statements -----------------------------------------------------------------------------

    def statement(self, node: ast.stmt) -> None:
        match node:
            case ast.Expr(value=ast.Constant()) | ast.Pass():
                return
            case ast.Assign(targets=targets, value=value):
                for target in targets:
                    self._assign(target, value)
            case ast.AnnAssign(target=target, value=ast.expr() as value):
                self._assign(target, value)
            case ast.AugAssign(target=target, op=op, value=value):
                old = ast.parse(ast.unparse(target), mode="eval").body
                self._assign(target, ast.BinOp(old, op, value))
            case ast.For(target=ast.Name(id=name), iter=ast.Call(func=ast.Name(id="range"), args=args), orelse=[]):
                self._loop(name, [self.value(each) for each in args], node.body)
            case _:
                raise self._refused(repr(ast.unparse(node).splitlines()[0]))

    def _assign(self, target: ast.expr, node: ast.expr) -> None:
        if not isinstance(target, ast.Tuple):
            if isinstance(target, ast.Name) and (made := self._called(node)) is not None and len(made) != 1:
                self.scopes[-1][2][target.id] = self._kept(made)
            else:
                self._store(target, self.value(node))
            return
        if isinstance(node, ast.Tuple):
            found = [self.value(each) for each in node.elts]
        elif (made := self._called(node)) is not None:
            found = made
        else:
            raise self._refused(repr(ast.unparse(node)))
        for part, value in zip(target.elts, self._kept(found), strict=True):  # all are known before one is stored
            self._store(part, value)

    def _kept(self, values: list[_Value]) -> list[_Value]:
        kept = []
        for value in values:
            if value.number is None:
                self.calls += 1
                name = f"k{self.calls}"
                (self.integers if value.whole else self.numbers).add(name)
                self.lines.append(f" {name} = {value.text};\n")
                value = _Value(name, value.whole)
            kept.append(value)
        return kept

    def _store(self, target: ast.expr, value: _Value) -> None:
        if isinstance(target, ast.Subscript):
            self.lines.append(f" {self.value(target).text} = {value.text};\n")
            return
        if not isinstance(target, ast.Name):
            raise self._refused(repr(ast.unparse(target)))
        prefix, _, here = self.scopes[-1]
        name = prefix + target.id
        if value.whole and value.number is not None:
            here[target.id] = value
            return
        if name in (self.numbers if value.whole else self.integers):
            raise self._refused(f"{target.id} as a whole number and as another one")
        (self.integers if value.whole else self.numbers).add(name)
        here[target.id] = _Value(name, value.whole)
        self.lines.append(f" {name} = {value.text};\n")

    def _loop(self, name: str, bounds: list[_Value], body: list[ast.stmt]) -> None:
        first, last = (_Value("0", True, 0), bounds[0]) if len(bounds) == 1 else (bounds[0], bounds[1])
        if len(bounds) > 2 or not (first.whole and last.whole):
            raise self._refused("a range with a step, or of what is no whole number")
        here = self.scopes[-1][2]
        turns = None if first.number is None or last.number is None else int(last.number - first.number)
        if turns is not None and turns <= UNROLLED:
            for k in range(turns):
                here[name] = _whole(int(first.number or 0) + k)
                for each in body:
                    self.statement(each)
            return
        prefix = self.scopes[-1][0]
        changed = {n.id for each in body for n in ast.walk(each) if isinstance(n, ast.Name)}
        for old in changed & set(here):  # whole numbers that are known now need not be known in the next turn
            if isinstance(here[old], _Value) and here[old].number is not None:
                self.integers.add(prefix + old)
                self.lines.append(f" {prefix}{old} = {here[old].text};\n")
                here[old] = _Value(prefix + old, True)
        place = prefix + name
        self.integers.add(place)
        here[name] = _Value(place, True)
        self.lines.append(f" for ({place} = {first.text}; {place} < {last.text}; {place}++) {{\n")
        for each in body:
            self.statement(each)
            for known in [n for n, v in here.items() if isinstance(v, _Value) and v.whole and v.number is not None]:
                if known in changed:
                    raise self._refused(f"{known}, a number that changes in a loop,")
        self.lines.append(" }\n")

    # -- expressions ----------------------------------------------------------------------------

    def value(self, node: ast.expr) -> _Value:
        match node:
            case ast.Constant(value=bool()):
                raise self._refused(ast.unparse(node))
            case ast.Constant(value=int() as whole):
                return _whole(whole)
            case ast.Constant(value=float() as given):
                return _Value(literal(given), False, given)
            case ast.Name(id=name):
                found = self.scopes[-1][2].get(name)
                found = self._named(name) if found is None else found
                if isinstance(found, _Value):
                    return found
                if isinstance(found, int):
                    return _whole(found)
                if isinstance(found, float):
                    return _Value(literal(found), False, found)
                if found == "t":
                    return _Value("t")
            case ast.Attribute(value=inner, attr="real"):
                return self.value(inner)
            case ast.Subscript(value=ast.Name(id=name), slice=index):
                array, place = self.scopes[-1][2].get(name), self.value(index)
                if isinstance(array, list) and place.number is not None:
                    return array[int(place.number)]
                if array == "p" and place.number in self.known:
                    number = self.known[int(place.number or 0)]
                    return _Value(literal(number), False, number)
                if isinstance(array, str) and place.whole:
                    return _Value(f"{array}[{place.text}]")
            case ast.UnaryOp(op=ast.USub() | ast.UAdd() as op, operand=operand):
                inner_value, sign = self.value(operand), "-" if isinstance(op, ast.USub) else "+"
                known = inner_value.number
                known = -known if known is not None and sign == "-" else known
                return _Value(f"({sign}{inner_value.text})", inner_value.whole, known)
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                return self._power(self.value(left), self.value(right))
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _SIGNS:
                return self._joined(self.value(left), _SIGNS[type(op)], self.value(right))
            case ast.Call(func=ast.Name(id="int"), args=[inner]):
                made = self.value(inner)
                return _whole(int(made.number)) if made.number is not None else _Value(f"((int) {made.text})", True)
            case ast.Call():
                found = self._called(node)
                if found is not None and len(found) == 1:
                    return found[0]
        raise self._refused(repr(ast.unparse(node)))

    def _joined(self, a: _Value, sign: str, b: _Value) -> _Value:
        if a.whole and b.whole and sign != "/":
            if a.number is not None and b.number is not None:
                x, y = int(a.number), int(b.number)
                return _whole(x + y if sign == "+" else x - y if sign == "-" else x * y)
            return _Value(f"({a.text}{sign}{b.text})", True)
        return _Value(f"({_number(a)}{sign}{_number(b)})")

    def _power(self, base: _Value, exponent: _Value) -> _Value:
        x, n = _number(base), exponent.number
        if n == 0.5:
            return _Value(f"sqrt({x})")
        if n is not None and n == int(n) and 1 <= abs(n) <= 4:
            (kept,) = self._kept([_Value(x)])
            product = "*".join([kept.text] * abs(int(n)))
            return _Value(f"({product})" if n > 0 else f"(1/({product}))")
        return _Value(f"pow({x}, {_number(exponent)})")

    def _called(self, node: ast.expr) -> list[_Value] | None:
        """What a call gives, one value or several; None where nothing is called."""
        if not isinstance(node, ast.Call) or node.keywords:
            return None
        function = self._function(node.func)
        name = getattr(function, "__name__", "")
        if name in FUNCTIONS and getattr(function, "__module__", None) in (None, "math", "numpy", "builtins"):
            arguments = ", ".join(_number(self.value(each)) for each in node.args)
            return [_Value(f"{FUNCTIONS[name]}({arguments})")]
        plain = getattr(function, "py_func", function)
        if not inspect.isfunction(plain):
            return None
        names = [argument.arg for argument in _parsed(plain).args.args]
        given = self._kept([self.value(each) for each in node.args])
        return self.inline(plain, dict(zip(names, given, strict=True)))

    def _function(self, node: ast.expr) -> Any:
        if isinstance(node, ast.Name):
            return int if node.id == "int" else self._named(node.id)
        if isinstance(node, ast.Attribute):
            return getattr(self._function(node.value), node.attr, None)
        return None


def _whole(number: int) -> _Value:
    return _Value(str(number) if number >= 0 else f"({number})", True, number)


def _number(value: _Value) -> str:
    """An operand that is no whole number, so that nothing is divided or called as one."""
    if not value.whole:
        return value.text
    return literal(value.number) if value.number is not None else f"((mixed) {value.text})"


def _parsed(function: Callable[..., Any]) -> ast.FunctionDef:
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    except (OSError, TypeError, SyntaxError):
        tree = None
    if not isinstance(tree, ast.FunctionDef):
        raise UnsupportedError(
            f"the text of {function.__qualname__} is not to be had, so it cannot be written in C; define it by def in "
            "a file, or leave it to the host (device=False)"
        )
    return tree


def c_rate(name: str, second: Callable[..., Any], width: int, parameters: int, space: str = "") -> str:
    """The C function ``mixed NAME(const mixed* r, GLOBAL const mixed* p, mixed t)``: dq/dt of a formula, at rest.

    `second` gives it as its second result, see `Code`, of coordinates, velocities, the time and parameters.
    """
    writer = _Writer(second, {}, {})
    names = [argument.arg for argument in _parsed(second).args.args]
    rest = [_Value(literal(0.0), False, 0.0)] * (3 * width)
    given = [*(_Value(f"r[{k}]") for k in range(3 * width)), *rest, _Value("t")]
    given += [_Value(f"p[{k}]") for k in range(parameters)]
    found = writer.inline(second, dict(zip(names, given, strict=True)))
    head = f"DEVICE mixed {name}({space}const mixed* r, GLOBAL const mixed* p, mixed t)"
    return "".join([head, " {\n", *writer.declared(), *writer.lines, f" return {found[1].text};\n}}\n"])
