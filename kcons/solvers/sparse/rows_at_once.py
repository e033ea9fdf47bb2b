"""Functions of many rows at once, for rows of one atom: what is called once for each row there is a loop here.

The compiler makes vector code of the loop where the function allows it. Positions stand as all x, all y and all z; what
the function puts out stands row by row. Rows may share their parameters, or have them one after another.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, register_jitable

from kcons.constraints.compilation import cfunc
from kcons.solvers.sparse.elimination import FAST

#: The most rows that are taken at once.
BLOCK = 32
#: And the fewest for which this is worth the call.
FEWEST = 8
_NUMBERS = types.CPointer(types.float64)
_ROWS = types.void(types.int64, _NUMBERS, _NUMBERS, types.int64, types.float64, _NUMBERS)


@intrinsic
def _from(typingctx, numbers, start):  # type: ignore[no-untyped-def]
    """The numbers behind the first `start`."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.gep(args[0], [args[1]], inbounds=True)

    return _NUMBERS(_NUMBERS, types.int64), codegen


@intrinsic
def call_rows(typingctx, numbers, address, n, r, p, stride, time, out):  # type: ignore[no-untyped-def]
    """Call the function at `address` for n rows; r, p and out are places among the numbers."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        r, p, out = (builder.gep(data, [args[k]], inbounds=True) for k in (3, 4, 7))
        integer, double = ir.IntType(64), ir.DoubleType()
        pointer = ir.PointerType(double)
        kind = ir.FunctionType(ir.VoidType(), [integer, pointer, pointer, integer, double, pointer])
        function = builder.inttoptr(args[1], ir.PointerType(kind))
        builder.call(function, [args[2], r, p, args[5], args[6], out])
        return context.get_dummy_value()

    place = types.int64
    return types.void(numbers, place, place, place, place, place, types.float64, place), codegen


@functools.cache
def rows_at_once(function: Callable[..., None]) -> Any:
    """Of ``row(r, p, t, out)`` for one atom, compiled; has an `address`."""
    # Not compiled apart: what Numba keeps is found again by the function's name, and by no name that it gives itself.
    row = register_jitable(fastmath=FAST, error_model="numpy")(function)

    def rows(n, r, p, stride, t, out):  # type: ignore[no-untyped-def]
        if stride == 0:
            for i in range(n):
                row((r[i], r[BLOCK + i], r[2 * BLOCK + i]), p, t, _from(out, 4 * i))
        else:
            for i in range(n):
                row((r[i], r[BLOCK + i], r[2 * BLOCK + i]), _from(p, stride * i), t, _from(out, 4 * i))

    rows.__qualname__ = f"rows_at_once.{function.__qualname__}"  # each family has a file of its own
    return cfunc(_ROWS, cache=True, fastmath=FAST, error_model="numpy")(rows)
