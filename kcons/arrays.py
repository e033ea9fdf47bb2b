"""Arrays from outside, as the compiled kernels need them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.target import FloatArray
from kcons.errors import InputError

_FLOAT = np.dtype(np.float64)
#: Kinds of dtype whose values are real numbers: boolean, integers, floating point.
_REAL = "biuf"


def numbers(values: ArrayLike, item: str) -> FloatArray:
    """`values` themselves if they are an array of float64, or a float64 copy of real numbers.

    Raises
    ------
    InputError
        Complex numbers, whose imaginary part would be lost; masked arrays, whose masks would be; objects, text, rows of
        different length.
    """
    if type(values) is np.ndarray and values.dtype is _FLOAT:
        return values
    parts = values if isinstance(values, list | tuple) else (values,)
    if any(isinstance(part, np.ma.MaskedArray) for part in parts):
        raise InputError(
            f"{item} is a masked array; give plain numbers, for example array.filled(...), without what is masked",
            item=item,
        )
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{item} is no array of numbers: {error}", item=item) from None
    if array.dtype.kind == "c":
        raise InputError(f"{item} has complex numbers; give real ones, for example their .real", item=item)
    if array.dtype.kind not in _REAL:
        raise InputError(f"{item} is no array of numbers: its dtype is {array.dtype}; give float64", item=item)
    return array.astype(np.float64, copy=False)


def as_array(values: ArrayLike, shape: tuple[int, int], item: str) -> FloatArray:
    """`values` themselves if the kernels can take them, or a float64 copy of that shape."""
    if type(values) is np.ndarray and values.dtype is _FLOAT and values.shape == shape and values.flags.c_contiguous:
        return values
    try:
        array = np.ascontiguousarray(np.asarray(values, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise InputError(f"{item} is no array of numbers: {error}", item=item) from None
    if array.shape != shape:
        raise InputError(f"{item} must have shape {shape}, not {array.shape}", item=item)
    return array


def lent(array: FloatArray) -> FloatArray:
    """The same numbers, for a function of the user: it can read them and not change them."""
    view = array.view()
    view.setflags(write=False)
    return view


def check_out(out: FloatArray, shape: tuple[int, int], item: str = "out") -> None:
    """Refuse arrays that results cannot be written into.

    Raises
    ------
    InputError
    """
    if not isinstance(out, np.ndarray) or out.dtype != _FLOAT or out.shape != shape or not out.flags.carray:
        raise InputError(f"{item} must be a writeable, contiguous float64 array of shape {shape}", item=item)


def check_multipliers(multipliers: FloatArray, n_rows: int) -> None:
    """Refuse arrays that one multiplier a row cannot be written into.

    Raises
    ------
    InputError
    """
    good = isinstance(multipliers, np.ndarray) and multipliers.dtype == np.float64 and multipliers.shape == (n_rows,)
    if not good or not multipliers.flags.writeable:
        raise InputError(f"multipliers must be a writable float64 array of shape ({n_rows},)", item="multipliers")
