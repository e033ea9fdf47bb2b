"""Numbers some doubles wide for Numba kernels.

Kernels written with them read like scalar code and are vector code by construction: nothing depends on what the
auto-vectorizer recognizes, and Newton loops of unknown length may stand inside a kernel.

Arrays are handed to intrinsics only: an array handed to a Python function inside a loop costs reference counting, and
the call makes every vector register spill. They are read and written without checks of the index.
"""

from __future__ import annotations

import functools
import inspect
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models, register_default
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic

#: No 'nnan' (it calls NaN converged) and no 'reassoc' (it undoes differences).
FLAGS = ("contract", "arcp", "nsz")
DOUBLE = ir.DoubleType()
INT32 = ir.IntType(32)
INT64 = ir.IntType(64)
_POINT = ir.VectorType(DOUBLE, 4)
#: Of four numbers, those of a point.
POINT_MASK = ir.Constant(ir.VectorType(ir.IntType(1), 4), [1, 1, 1, 0])
_INSTRUCTIONS = ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv"))


def instruction(result: Any, *kinds: Any) -> Callable[[Callable[..., Any]], Any]:
    """Make a Numba intrinsic of a function of LLVM's builder and the values of its arguments.

    Parameters
    ----------
    result : Numba type, or what gives the signature for kinds of arguments
    *kinds : Numba type or None
        Of the arguments. None takes what is given; the function gets a contiguous array as the pointer to its first
        number, and no intrinsic is found for other arrays.
    """

    def made(emit: Callable[..., Any]) -> Any:
        def function(typingctx, *given):
            if any(isinstance(kind, types.Array) and kind.layout != "C" for kind in given):
                return None
            taken = [kind or own for kind, own in zip(kinds, given, strict=True)]

            def codegen(context, builder, sig, values):
                found = emit(builder, *map(functools.partial(first_of, context, builder), sig.args, values))
                return context.get_dummy_value() if found is None else _packed(context, builder, sig.return_type, found)

            return result(*taken), codegen

        names = ["typingctx", *list(inspect.signature(emit).parameters)[1:]]
        # Numba goes by the names of parameters, and would hand a variable number of them on as a tuple.
        given = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in names]
        function.__signature__ = inspect.Signature(given)  # type: ignore[attr-defined]
        return intrinsic(functools.wraps(emit, ("__module__", "__name__", "__qualname__", "__doc__"), ())(function))

    return made


def arithmetic(result: Any) -> Callable[[Callable[..., Any]], Any]:
    """Make a Numba intrinsic of a function that only computes with numbers and tuples of them.

    LLVM's instructions are written as the function runs once: Numba would take each operation for itself, which takes
    ten times as long. `result` is the type of what it returns, or what gives the signature for kinds of arguments.
    """

    def made(function: Callable[..., Any]) -> Any:
        @functools.wraps(function)
        def emit(builder, *values):
            return _values(function(*(_terms(builder, value) for value in values)))

        names = list(inspect.signature(function).parameters.values())
        emit.__signature__ = inspect.Signature([names[0].replace(name="builder"), *names])  # type: ignore[attr-defined]
        return instruction(result, *(None,) * len(names))(emit)

    return made


def _terms(builder: Any, value: Any) -> Any:
    """A value of LLVM, or the values in it, to compute with."""
    if isinstance(value.type, ir.ArrayType):
        return tuple(_terms(builder, each) for each in unpacked(builder, value))
    return _Term(builder, value)


def _values(found: Any) -> Any:
    return [_values(each) for each in found] if isinstance(found, tuple) else found.value


def unpacked(builder: Any, value: Any) -> list[Any]:
    """What is in a tuple of equal kinds."""
    return [builder.extract_value(value, k) for k in range(value.type.count)]


def _packed(context: Any, builder: Any, kind: Any, found: Any) -> Any:
    if not isinstance(found, list):
        return found
    entries = [_packed(context, builder, *each) for each in zip(kind.types, found, strict=True)]
    return context.make_tuple(builder, kind, entries)


class _Term:
    """A double or a vector of LLVM; + - * / with another, or with a number, make the next."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def _with(self, other: Any, name: str, swap: bool = False) -> _Term:
        pair = [self.value, other.value if isinstance(other, _Term) else DOUBLE(float(other))]
        width = next((value.type.count for value in pair if value.type != DOUBLE), 0)
        pair = [vectors(width).splat(self.builder, value) for value in pair] if width else pair
        return _Term(self.builder, getattr(self.builder, name)(*(pair[::-1] if swap else pair), flags=FLAGS))

    def unary(self, name: str) -> _Term:
        """The function that LLVM calls `name`, such as 'sqrt'."""
        width = f"v{self.value.type.count}" if self.value.type != DOUBLE else ""
        return _Term(self.builder, call(self.builder, f"llvm.{name}.{width}f64", self.value.type, [self.value]))

    def __neg__(self) -> _Term:
        return _Term(self.builder, self.builder.fneg(self.value, flags=FLAGS))


for _operator, _name in _INSTRUCTIONS:
    for _prefix in ("__", "__r"):
        _method = functools.partialmethod(_Term._with, name=_name, swap=_prefix == "__r")
        setattr(_Term, f"{_prefix}{_operator.__name__}__", _method)


def first_of(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Pointer to the first number of an array; other values as they are."""
    return context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value


def place(builder: Any, array: Any, start: Any, to: Any = None) -> Any:
    """Pointer to an entry behind a pointer; as one to a vector where `to` is its type."""
    found = builder.gep(array, [start], inbounds=True)
    return found if to is None else builder.bitcast(found, ir.PointerType(to))


class VectorType(types.Type):
    """Numba type of some doubles that are computed with together."""

    def __init__(self, width: int) -> None:
        super().__init__(name=f"Doubles{width}")
        self.width = width


@register_default(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: VectorType) -> None:
        super().__init__(manager, kind, ir.VectorType(DOUBLE, kind.width))


class Vectors:
    """Numbers of one width, see `vectors`.

    Attributes
    ----------
    kind : VectorType
        For signatures. + - * / take two of them, or one and a double; - one.
    llvm : llvmlite.ir.VectorType
    load, store : intrinsic
        ``load(array, start)``, ``store(array, start, value)``: those that begin at an entry of a flat float64 array.
    """

    def __init__(self, width: int) -> None:
        self.kind = VectorType(width)
        self.llvm = ir.VectorType(DOUBLE, width)
        self.load = reader(self.kind, self.llvm)
        self.store = writer(self.kind, self.llvm)
        one, number = self.kind, types.float64
        two = [signature(one, *pair) for pair in ((one, one), (one, number), (number, one))]
        for function, instruction in _INSTRUCTIONS:
            self._define(function, instruction, two)
        self._define(operator.neg, "fneg", [signature(one, one)])

    def splat(self, builder: Any, value: Any) -> Any:
        """All equal to one double; a vector stays as it is."""
        if value.type == self.llvm:
            return value
        one = builder.insert_element(ir.Constant(self.llvm, ir.Undefined), value, INT32(0))
        return shuffle(builder, one, one, [0] * self.llvm.count)

    def of(self, builder: Any, values: Any) -> Any:
        """Made of doubles."""
        result = ir.Constant(self.llvm, ir.Undefined)
        for lane, value in enumerate(values):
            result = builder.insert_element(result, value, INT32(lane))
        return result

    def all_true(self, builder: Any, test: Any) -> Any:
        """Whether a comparison holds for all."""
        bits = builder.bitcast(test, ir.IntType(self.llvm.count))
        return builder.icmp_unsigned("==", bits, ir.Constant(bits.type, 2**self.llvm.count - 1))

    def unary(self, name: str) -> Callable[..., Any]:
        """The function of each that LLVM calls `name`, such as 'sqrt'."""
        return arithmetic(self.kind)(lambda value: value.unary(name))  # type: ignore[no-any-return]

    def _define(self, function: Any, instruction: str, cases: list[Any]) -> None:
        infer_global(function)(type(f"_{instruction}_{self.kind.name}", (ConcreteTemplate,), {"cases": cases}))

        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return getattr(builder, instruction)(*(self.splat(builder, value) for value in args), flags=FLAGS)

        for case in cases:
            lower_builtin(function, *case.args)(lower)


@functools.cache
def vectors(width: int) -> Vectors:
    """Numbers `width` doubles wide."""
    return Vectors(width)


# -- for intrinsics -----------------------------------------------------------------------------------


def shuffle(builder: Any, left: Any, right: Any, mask: list[int]) -> Any:
    """Doubles of two vectors, by their numbers."""
    return builder.shuffle_vector(left, right, ir.Constant(ir.VectorType(INT32, len(mask)), mask))


def call(builder: Any, name: str, result: Any, args: Any) -> Any:
    """Call an LLVM intrinsic."""
    function_type = ir.FunctionType(result, [a.type for a in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, function_type, name), args)


def masked_point(builder: Any, at: Any) -> Any:
    """(x, y, z, 0) of the point at a pointer; the mask keeps the last one of an array from reading beyond it."""
    source = builder.bitcast(at, ir.PointerType(_POINT))
    rest = ir.Constant(_POINT, [0.0] * 4)
    return call(builder, "llvm.masked.load.v4f64.p0v4f64", _POINT, [source, INT32(8), POINT_MASK, rest])


def reader(kind: Any, vector: Any) -> Callable[..., Any]:
    """The intrinsic that reads from a flat float64 array; doubles where `vector` is None."""

    @instruction(kind, None, types.int64)
    def function(builder, array, start):
        return builder.load(place(builder, array, start, vector), align=8)

    return function


def writer(kind: Any, vector: Any) -> Callable[..., Any]:
    """The intrinsic that writes into one."""

    @instruction(types.void, None, types.int64, kind)
    def function(builder, array, start, value):
        builder.store(value, place(builder, array, start, vector), align=8)

    return function
