"""Views of arrays inside kernels that are not counted among the arrays' users.

Numba counts the users of an array in memory that threads share; for each view that takes as long as a held bond does.
What is borrowed here is good only as long as something else holds the array, as its caller does.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from kcons.solvers.kernels.any_width import pointer

#: Types of pointers to doubles and to indices, as `at_piece` and `at_first` give them.
NUMBERS, INDICES = types.CPointer(types.float64), types.CPointer(types.uint32)


def view(context: Any, builder: Any, kind: Any, data: Any, *shape: Any) -> Any:
    """A contiguous array of `shape`, each of it a value, at the address `data`."""
    result = context.make_array(kind)(context, builder)
    size = context.get_constant(types.intp, context.get_abi_sizeof(context.get_data_type(kind.dtype)))
    steps = [size]
    for length in shape[:0:-1]:
        steps.insert(0, builder.mul(steps[0], length))
    pointer = builder.bitcast(data, result.data.type)
    context.populate_array(result, data=pointer, shape=shape, strides=steps, itemsize=size, meminfo=None)
    return result._getvalue()


@intrinsic
def _table_array(typingctx, room, header, k):  # type: ignore[no-untyped-def]
    kind = types.Array(room.dtype, 1, "C")

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        numbers, cuts = (
            context.make_array(t)(context, builder, a) for t, a in zip(sig.args[:2], args[:2], strict=True)
        )
        at = builder.mul(args[2], ir.Constant(args[2].type, 2))
        start = builder.load(builder.gep(cuts.data, [at]))
        end = builder.load(builder.gep(cuts.data, [builder.add(at, ir.Constant(at.type, 1))]))
        return view(context, builder, kind, builder.gep(numbers.data, [start]), builder.sub(end, start))

    return kind(room, header, types.int64), codegen


#: ``room[header[2 k] : header[2 k + 1]]`` of flat contiguous arrays, `header` of int64.
table_array: Any = _table_array


@intrinsic
def at_piece(typingctx, room, header, k):  # type: ignore[no-untyped-def]
    """Pointer to ``room[header[2 k]]``, where a piece begins.

    An array is handed on as seven values, and leaves code behind that counts its users: a kernel that knows the lengths
    of two dozen pieces without them is compiled in two thirds of the time.
    """
    kind = types.CPointer(room.dtype)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        at = builder.mul(args[2], ir.Constant(args[2].type, 2))
        begin = builder.load(pointer(context, builder, sig.args[1], args[1], at))
        return pointer(context, builder, sig.args[0], args[0], begin)

    return kind(room, header, types.int64), codegen


@intrinsic
def at_first(typingctx, array):  # type: ignore[no-untyped-def]
    """Pointer to the first number of a contiguous array."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return context.make_array(sig.args[0])(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), codegen


@intrinsic
def none_of(typingctx, array):  # type: ignore[no-untyped-def]
    """No numbers of a contiguous array: ``array[:0]``, in a tenth of the time to compile."""
    kind = types.Array(array.dtype, 1, "C")

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return view(context, builder, kind, data, context.get_constant(types.intp, 0))

    return kind(array), codegen


@intrinsic
def lattice_piece(typingctx, room, header, k):  # type: ignore[no-untyped-def]
    """The same as a lattice, shape (2, 3, 3)."""
    kind = types.Array(room.dtype, 3, "C")

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        numbers, cuts = (
            context.make_array(t)(context, builder, a) for t, a in zip(sig.args[:2], args[:2], strict=True)
        )
        at = builder.mul(args[2], ir.Constant(args[2].type, 2))
        start = builder.load(builder.gep(cuts.data, [at]))
        shape = [context.get_constant(types.intp, length) for length in (2, 3, 3)]
        return view(context, builder, kind, builder.gep(numbers.data, [start]), *shape)

    return kind(room, header, types.int64), codegen


def _flat(dtype: Any, copied: Any = None) -> Any:
    """All memory of a contiguous array as numbers of a type; of others what the function `copied` gives."""

    @intrinsic
    def function(typingctx, array):  # type: ignore[no-untyped-def]
        own = copied is None or array.layout == "C"
        kind = types.Array(dtype or array.dtype, 1, "C", readonly=own and not array.mutable)

        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            if not own:
                return context.compile_internal(builder, copied, sig, args)
            source = context.make_array(sig.args[0])(context, builder, args[0])
            size = source.nitems
            if dtype is not None:
                ratio = array.dtype.bitwidth // dtype.bitwidth
                size = builder.mul(size, ir.Constant(size.type, ratio))
            return view(context, builder, sig.return_type, source.data, size)

        return kind(array), codegen

    return function


#: All numbers of an array of any shape, in a row; and the same as integers of eight bytes.
flat: Any = _flat(None, lambda array: array.ravel())
bits: Any = _flat(types.int64, lambda array: array.ravel().view(types.int64))
# Memory of doubles as integers of eight, four and one bytes: what NumPy's `view` gives, which takes long to compile.
integers, halves, octets = _flat(types.int64), _flat(types.uint32), _flat(types.uint8)
