"""Views of arrays inside kernels that are not counted among the arrays' users.

Numba counts the users of an array in memory that threads share; for each view that takes as long as a held bond does.
What is borrowed here is good only as long as something else holds the array, as its caller does.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from kcons.solvers.kernels.any_width import INT64, first_of, instruction, place

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


def _piece(*shape: int) -> Any:
    """The intrinsic for a piece of an array, of a fixed shape where one is given."""

    @intrinsic
    def function(typingctx, room, header, k):
        kind = types.Array(room.dtype, max(len(shape), 1), "C")

        def codegen(context, builder, sig, args):
            numbers, cuts = (first_of(context, builder, *each) for each in zip(sig.args[:2], args[:2], strict=True))
            at = builder.mul(args[2], INT64(2))
            start, end = (builder.load(place(builder, cuts, builder.add(at, INT64(side)))) for side in (0, 1))
            size = [context.get_constant(types.intp, length) for length in shape] or [builder.sub(end, start)]
            return view(context, builder, kind, place(builder, numbers, start), *size)

        return kind(room, header, types.int64), codegen

    return function


#: ``room[header[2 k] : header[2 k + 1]]`` of flat contiguous arrays, `header` of int64; and the same as a lattice.
table_array, lattice_piece = _piece(), _piece(2, 3, 3)


@instruction(lambda room, *others: types.CPointer(room.dtype)(room, *others), None, None, types.int64)
def at_piece(builder, room, header, k):
    """Pointer to ``room[header[2 k]]``, where a piece begins.

    An array is handed on as seven values, and leaves code behind that counts its users: a kernel that knows the lengths
    of two dozen pieces without them is compiled in two thirds of the time.
    """
    return place(builder, room, builder.load(place(builder, header, builder.mul(k, INT64(2)))))


@instruction(lambda array: types.CPointer(array.dtype)(array), None)
def at_first(builder, array):
    """Pointer to the first number of a contiguous array."""
    return array


def _flat(dtype: Any, copied: Any = None) -> Any:
    """All memory of a contiguous array as numbers of a type; of others what the function `copied` gives."""

    @intrinsic
    def function(typingctx, array):
        own = copied is None or array.layout == "C"
        kind = types.Array(dtype or array.dtype, 1, "C", readonly=own and not array.mutable)

        def codegen(context, builder, sig, args):
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
