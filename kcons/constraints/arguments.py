"""Arrays from outside, as the compiled kernels need them, and arrays that are lent to functions of the user."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.errors import InputError

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]

_FLOAT = np.dtype(np.float64)
#: Kinds of dtype whose values are real numbers: boolean, integers, floating point.
_REAL = "biuf"


def numbers(values: ArrayLike | Any, item: str) -> FloatArray:
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
            f"{item} is a masked array; give plain numbers (array.filled(...)), and leave out what is masked",
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
    return np.asarray(array, dtype=np.float64)


def as_array(values: ArrayLike, shape: tuple[int, int], item: str) -> FloatArray:
    """`values` themselves if the kernels can take them, or a float64 copy of that shape."""
    if type(values) is np.ndarray and values.dtype is _FLOAT and values.shape == shape and values.flags.carray:
        return values
    array = numbers(values, item)
    if array.shape != shape:
        raise InputError(f"{item} must have shape {shape}, not {array.shape}", item=item)
    # Kernels are compiled for arrays that may be written to; for others Numba would compile them once more.
    return np.require(array, requirements=["C", "A", "W"])


def lent(array: FloatArray) -> FloatArray:
    """The same numbers, for a function of the user: it can read them and not change them."""
    view = array.view()
    view.setflags(False)  # type: ignore[call-arg]  # write, which by name takes three times as long
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


def check_pairs(pairs: ArrayLike, n_atoms: int) -> IntArray:
    """Pairs of different atoms, shape (n, 2).

    Raises
    ------
    InputError
        Another shape; numbers that are no integers; atoms that do not exist.
    """
    table = np.asarray(pairs)
    if table.size == 0:
        return np.zeros((0, 2), np.int64)
    if table.ndim != 2 or table.shape[1] != 2 or not np.issubdtype(table.dtype, np.integer):
        raise InputError(f"bonds must be pairs of atoms, shape (n, 2), not {table.dtype} {table.shape}", item="bonds")
    bad = (table < 0).any(axis=1) | (table >= n_atoms).any(axis=1) | (table[:, 0] == table[:, 1])
    if bad.any():
        i, j = table[int(np.argmax(bad))].tolist()
        raise InputError(
            f"bonds has the pair ({i}, {j}); give two different atoms of 0 to {n_atoms - 1}", item="bonds", atoms=[i, j]
        )
    return table.astype(np.int64)
