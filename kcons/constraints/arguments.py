"""What comes from outside: arrays as the compiled kernels need them, and what arguments may be.

Numbers are plain, in any consistent units; those with units are refused.
Arrays of the engine that are lent to functions of the user can be read and not changed.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    ParamSpec,
    TypeAlias,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.errors import InputError

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]

P = ParamSpec("P")
R = TypeVar("R")

_FLOAT = np.dtype(np.float64)
#: Kinds of dtype whose values are real numbers: boolean, integers, floating point.
_REAL = "biuf"
#: Larger numbers have squares, or sums of squares, that overflow.
LARGEST = 1e150


def as_float_array(values: ArrayLike | Any, item: str) -> FloatArray:
    """`values` themselves if they are an array of float64, or a float64 copy of real numbers.

    Complex numbers are refused, whose imaginary part would be lost; masked arrays, whose masks would be; Quantities,
    whose units would be.
    """
    if type(values) is np.ndarray and values.dtype is _FLOAT:
        return values
    refuse_units(values, item)
    parts = values if isinstance(values, list | tuple) else (values,)
    if any(isinstance(part, np.ma.MaskedArray) for part in parts):
        remedy = "give plain numbers (array.filled(...)), and leave out what is masked"
        raise InputError(f"{item} is a masked array; {remedy}", item=item)
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{item} is no array of numbers: {error}", item=item) from None
    if array.dtype.kind == "c":
        raise InputError(f"{item} has complex numbers; give real ones, for example their .real", item=item)
    if array.dtype.kind not in _REAL:
        raise InputError(f"{item} is no array of numbers: its dtype is {array.dtype}; give float64", item=item)
    return np.asarray(array, dtype=np.float64)


def as_array(values: ArrayLike, shape: tuple[int, ...], item: str) -> FloatArray:
    """`values` themselves if the kernels can take them, or a float64 copy of that shape."""
    if type(values) is np.ndarray and values.dtype is _FLOAT and values.shape == shape and values.flags.carray:
        return values
    array = as_float_array(values, item)
    if array.shape != shape:
        raise InputError(f"{item} must have shape {shape}, not {array.shape}", item=item)
    # Kernels are compiled for arrays that may be written to; for others Numba would compile them once more.
    return np.require(array, requirements=["C", "A", "W"])


def finite_array(values: ArrayLike | None, n_atoms: int, item: str) -> FloatArray:
    """A copy of values for each atom, shape (n_atoms, 3); `InputError` where they are not finite."""
    array = as_array(np.array(as_float_array(values, item)), (n_atoms, 3), item)
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        atom = int(np.argmax(bad))
        raise InputError(f"{item} of atom {atom} is not finite: {array[atom]}", item=item, atoms=[atom])
    return array


def check_range(values: FloatArray, say: str, item: str, atoms: IntArray | None = None) -> None:
    """Refuse values that are not finite or larger than `LARGEST`; `say` has {row} for the first of these."""
    good = np.abs(values) <= LARGEST
    if not good.all():
        row, *others = np.argwhere(~good)[0] if values.ndim else (0,)
        value = float(values[(row, *others)] if values.ndim else values)
        said = f"{value:g}, of which the square overflows; choose other units" if math.isfinite(value) else "not finite"
        raise InputError(f"{say.format(row=row)} is {said}", item=item, atoms=() if atoms is None else atoms[row])


def read_only_view(array: FloatArray) -> FloatArray:
    """The same numbers, for a function of the user: it can read them and not change them."""
    view = array.view()
    view.setflags(False)  # type: ignore[call-arg]  # write, which by name takes three times as long
    return view


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """The array itself, which nobody can change from now on."""
    array.setflags(write=False)
    return array


def check_out(out: FloatArray, shape: tuple[int, ...], item: str = "out") -> None:
    """Refuse arrays that results cannot be written into."""
    if not isinstance(out, np.ndarray) or out.dtype != _FLOAT or out.shape != shape or not out.flags.carray:
        raise InputError(f"{item} must be a writeable, contiguous float64 array of shape {shape}", item=item)


def atom_array(atoms: Any, name: str, item: str = "atoms") -> NDArray[Any]:
    """Atoms as an array of any shape, a single one as an array of one."""
    try:
        return np.atleast_1d(np.asarray(atoms))
    except (TypeError, ValueError, RuntimeError):
        raise InputError(
            f"{name}: rows name different numbers of atoms, {atoms!r:.80}; give rows of one width", item=item
        ) from None


def atom_table(atoms: Any, name: str, width: int | None, item: str = "atoms") -> IntArray:
    """Different atoms, a row of them for each row, shape (n, width); `item` is at fault where they are none.

    Of rows of one atom a list of atoms is taken, too.
    """

    def wrong(words: str, row: Any = ()) -> InputError:
        return InputError(f"{name}: {words}", item=item, atoms=row)

    table = atom_array(atoms, name, item)
    if table.size == 0:
        return np.zeros((0, width or (table.shape[1] if table.ndim == 2 else 0)), dtype=np.int64)
    if not np.issubdtype(table.dtype, np.integer):
        remedy = "; of a mask give np.flatnonzero(mask)" if table.dtype == bool else ""
        raise wrong(f"atom indices must be integers, not {table.dtype}{remedy}")
    table = table.astype(np.int64)
    table = table.reshape(-1, 1) if width == 1 and table.ndim < 2 else np.atleast_2d(table)
    if table.ndim != 2:
        raise wrong(f"atoms must have shape (n_rows, width), not {table.shape}")
    if width is not None and table.shape[1] != width:
        words = f"give the atoms of a row as one list, such as {list(range(width))}"
        raise wrong(f"a row has {width} atom{'s' if width > 1 else ''}, not shape {np.shape(atoms)}; {words}")
    if table.min() < 0:
        row, slot = np.argwhere(table < 0)[0]
        raise wrong(f"row {row} has the negative atom index {table[row, slot]}; count atoms from 0", table[row])
    ordered = np.sort(table, axis=1)
    repeated = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
    if repeated.any():
        row = int(np.argmax(repeated))
        raise wrong(f"row {row} names an atom twice: {tuple(table[row].tolist())}", table[row])
    return table


def check_pairs(pairs: ArrayLike, n_atoms: int | None = None, item: str = "bonds") -> IntArray:
    """Pairs of different atoms, shape (n, 2), a copy; of a number of atoms that need not be known yet."""
    table = atom_table(pairs, item, 2, item)
    if n_atoms is not None and table.max(initial=-1) >= n_atoms:
        raise InputError(f"{item} name atom {table.max()}; there are atoms 0 to {n_atoms - 1}", item=item)
    return table


def refuse_other(value: Any, kind: type | tuple[type, ...], item: str, remedy: str) -> None:
    """Raise `InputError` for what is no `kind`."""
    if not isinstance(value, kind):
        raise InputError(f"{item} is {value!r:.120}; give {remedy}", item=item)


def check_call(item: str, function: Any, arguments: tuple[str, ...], hint: str = "", needed: bool = False) -> None:
    """Refuse what is no function, or cannot be called with `arguments`; None, where none is needed, passes.

    `item` is what it is called in messages, `hint` ends their sentence.
    """
    if not callable(function) and (needed or function is not None):
        raise InputError(f"{item} is {function!r:.120}; give a function of {', '.join(arguments)}", item=item)
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # no function, or one that does not say what it takes
        return
    try:
        signature.bind(*arguments)
    except TypeError:
        called = f"{item} takes {signature}, but is called with ({', '.join(arguments)}){hint}"
        raise InputError(called, item=item) from None


def finite_number(value: Any, item: str) -> float:
    """`value` as a float."""
    if type(value) is float and math.isfinite(value):  # each call of the engine comes through here
        return value
    refuse_units(value, item)
    found = _float(value)
    if not math.isfinite(found):
        raise InputError(f"{item} is {value!r:.80}; give a finite number", item=item)
    return found


def _float(value: Any) -> float:
    """`value` as a float; NaN for what is no number, or too large for one."""
    try:
        return math.nan if np.ndim(value) or isinstance(value, str | bytes) else float(value)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # of objects that say they are arrays, the last
        return math.nan


def all_positive(values: ArrayLike, item: str) -> FloatArray:
    """Numbers above zero, infinite ones included, as an array of any shape."""
    array = as_float_array(values, item)
    if not np.all(array > 0):
        raise InputError(f"{item} {array[~(array > 0)].flat[0]:g} is not positive; give numbers above zero", item=item)
    return array


def unit(vectors: ArrayLike, item: str) -> FloatArray:
    """Vectors of length 1 along the given ones, shape (..., 3)."""
    array = as_float_array(vectors, item)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise InputError(f"{item} must be vectors of three numbers; its shape is {array.shape}", item=item)
    length = np.sqrt(np.einsum("...i,...i->...", array, array))
    if not np.all(np.isfinite(length) & (length > 0)):
        raise InputError(f"{item} has a vector that is zero or not finite; give a direction", item=item)
    return array / length[..., None]


def whole_number(value: Any, item: str, least: int = 1, most: int | None = None) -> int:
    """`value` as an int, from `least` to `most`."""
    try:
        found = int(value)
        good = bool(found == value) and least <= found and (most is None or found <= most)
    except (TypeError, ValueError, OverflowError):
        good = False
    if not good or isinstance(value, bool):
        bounds = f", {least} or more" if most is None else f" from {least} to {most}"
        raise InputError(f"{item} is {value!r:.80}; give a whole number{bounds}", item=item)
    return found


def _number_rule(good: Callable[[float], bool], words: str) -> Callable[[Any, str], float]:
    def rule(value: Any, item: str) -> float:
        number = math.nan if isinstance(value, bool) else _float(value)
        if not (math.isfinite(number) and good(number)):
            raise InputError(f"{item} is {value!r:.80}; give a {words}", item=item)
        return number

    return rule


#: `value` as a float: ``rule(value, item)``.
positive = _number_rule(lambda x: x > 0, "positive number")
not_negative = _number_rule(lambda x: x >= 0, "number of 0 or more")
share = _number_rule(lambda x: 0 <= x < 1, "number from 0 to less than 1")


def one_of(value: Any, item: str, words: tuple[Any, ...]) -> Any:
    """`value`, which has to be one of `words`."""
    if not isinstance(value, str | int | np.integer) or value not in words:
        *others, last = map(repr, words)
        raise InputError(f"{item} is {value!r:.80}; choose {', '.join(others)} or {last}", item=item)
    return value


#: For `checked`.
Positive: TypeAlias = Annotated[float, positive]
NotNegative: TypeAlias = Annotated[float, not_negative]
Finite: TypeAlias = Annotated[float, finite_number]
Count: TypeAlias = Annotated[int, whole_number]
FromZero: TypeAlias = Annotated[int, functools.partial(whole_number, least=0)]
Share: TypeAlias = Annotated[float, share]
#: What random numbers are drawn from, as in NumPy: a seed, a generator, or the operating system for None.
Rng: TypeAlias = int | np.random.Generator | None


def seed_from(rng: Rng, bits: int = 64) -> int:
    """A seed: a whole number of so many bits itself, or one drawn from a generator."""
    if isinstance(rng, int | np.integer) and not 0 <= rng < 2**bits:
        raise InputError(f"rng is {rng!r:.80}; give a whole number from 0 to {2**bits - 1}", item="rng")
    drawn = generator_of(rng)
    return int(rng if isinstance(rng, int | np.integer) else drawn.integers(2 ** (bits - 1)))


def generator_of(rng: Rng) -> np.random.Generator:
    """A generator itself, or one made from a seed."""
    try:
        return np.random.default_rng(rng)
    except (TypeError, ValueError):
        raise InputError(
            f"rng is {rng!r:.80}; give a whole number from 0 on, a numpy.random.Generator, or None", item="rng"
        ) from None


# -- numbers with units -----------------------------------------------------------------------------

_PLAIN = (int, float, bool, str, type(None))


#: What the numbers are that a family holds its rows at, where that is known.
LENGTH, ANGLE = "length", "angle"

PositiveLengths: TypeAlias = Annotated[ArrayLike, all_positive]
Directions: TypeAlias = Annotated[ArrayLike, unit]


def has_units(values: Any) -> bool:
    """Whether there are units, at the first number of nested lists."""
    while type(values) in (list, tuple) and len(values):
        values = values[0]
    if isinstance(values, _PLAIN):
        return False
    if type(values) is np.ndarray:
        return bool(values.dtype == object and values.size and has_units(values.flat[0]))
    return not callable(values) and (hasattr(values, "unit") or hasattr(values, "units"))


def quantity_text(values: Any) -> str:
    """The beginning of a Quantity in words, on one line."""
    words = " ".join(str(values).split())
    return words if len(words) <= 60 else f"{words[:50]} ..."


def refuse_units(values: Any, item: str) -> None:
    """Refuse Quantities: which units the other numbers are in is known to the user alone."""
    if has_units(values):
        remedy = "give plain numbers in the units of the run (nm, ps and radian in OpenMM)"
        raise InputError(f"{item} has units ({quantity_text(values)}); {remedy}", item=item)


# -- arguments looked at by what their annotations say ----------------------------------------------


Rule: TypeAlias = Callable[[Any, str], Any]


class Rules(NamedTuple):
    """What an annotation says of an argument."""

    optional: bool  #: Whether None may pass, unseen.
    rules: tuple[Rule, ...]


@functools.cache
def rules_of(function: Callable[..., Any]) -> dict[str, Rules]:
    """What ``Annotated`` and ``Literal`` say of each argument."""
    hints, found = get_type_hints(function, include_extras=True), {}
    for name in inspect.signature(function).parameters:
        hint = hints.get(name)
        kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        given = [kind for kind in kinds if kind is not NoneType]
        said = next((kind for kind in given if hasattr(kind, "__metadata__")), None)
        optional = len(given) < len(kinds) or (said is not None and NoneType in get_args(said.__origin__))
        told: tuple[Any, ...] = () if said is None else said.__metadata__
        if len(given) == 1 and get_origin(given[0]) is Literal:
            told = (functools.partial(one_of, words=get_args(given[0])),)
        found[name] = Rules(optional, tuple(part for part in told if callable(part)))
    return found


def checked(function: Callable[P, R], *, named: bool = False) -> Callable[P, R]:
    """Let the annotations of a function look at its arguments.

    A rule ``rule(value, item)`` of ``Annotated[type, rule, ...]`` gives what is taken in place of the value, or raises
    `InputError`; what is no word of a ``Literal`` is refused. With `named`, for an ``__init__``, items are called after
    the class too.
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def checked_function(*args: P.args, **kwargs: P.kwargs) -> R:
        rules, of = rules_of(function), f"{type(args[0]).__name__}: " if named else ""
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError as error:
            if named and len(atoms := [each for each in args[1:] if isinstance(each, int | np.integer)]) > 1:
                raise InputError(f"{of}{error}; give atoms as a list, such as {atoms}", item="atoms") from None
            raise
        for name, value in bound.arguments.items():
            optional, asked = rules[name]
            for rule in () if optional and value is None else asked:
                value = rule(value, f"{of}{name}")
            bound.arguments[name] = value
        return function(*bound.args, **bound.kwargs)

    return checked_function
