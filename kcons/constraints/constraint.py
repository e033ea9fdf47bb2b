"""The contract that every family of constraints fulfils.

A constraint object holds `n_rows` rows of one family, each over `width` atoms. Row k is

* a holonomic (position) row: sigma_k(x, t) = q_k(r_k, t) - target_k(t) = 0, q the *natural coordinate*
  (a length, an angle in radian, a Cartesian component), or
* a velocity row: eta_k = a_k(r_k, t) . v - target_k(t) = 0, linear in v.

Both are differentiated to A a = b (notes eqs. 81-92): A_k is `gradient`, and

* position rows: b = target'' - (curvature + time_terms[1]),  A v = target' - time_terms[0];
* velocity rows: b = target'  - curvature,                    A v = target.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import IntEnum
from typing import Any, ClassVar, NoReturn, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import (
    ANGLE,
    LENGTH,
    as_float_array,
    atom_table,
    check_range,
    checked,
    read_only,
    rules_of,
)
from kcons.constraints.compilation import has_a_file, njit
from kcons.constraints.target import FloatArray, MovingTarget, Target, as_target, contradiction, nearest_image
from kcons.errors import ConstraintError, InputError, SingularGeometryError, UnsupportedError

IntArray = NDArray[np.int64]
#: Rows that are marked, what is said of row k, and the argument at fault, if one is.
Fault: TypeAlias = tuple[Any, ...]
#: A step along which derivatives are imaginary parts: its square vanishes beside 1, and a power of two does not round.
_COMPLEX_STEP = 2.0**-100

#: Rows that loop over more atoms are compiled, where others are taken at once.
WIDE = 6

#: What each row has an entry of, in all families.
_BY_ROW = ("atoms", "target", "masses", "whole", "cell_offsets")

#: All families by name.
FAMILIES: dict[str, type[Constraint]] = {}


class RowKind(IntEnum):
    """Rows that the compiled solvers evaluate themselves; INTERPRETED rows call Python."""

    INTERPRETED = 0
    DISTANCE = 1  # no parameters
    ANGLE = 2  # atoms i, j, k with vertex j; no parameters; coordinate theta
    LINEAR = 3  # sum_a c_a . r_a; parameters c, 3 numbers an atom
    FUNCTION = 4  # a function that the kernels call; see `kcons.solvers.sparse.row_functions`
    VELOCITY = 6  # linear in the velocities, coefficients from a function; 5 and 7 are functions of differences


class Constraint:
    """Rows of one family.

    A family declares `row`, a function of numbers, and what its parameters are; value, gradient, curvature, compiled
    kernels, files and errors follow from it. Families without such a function (linear rows, functions of users) say
    what `value_and_gradient` and `curvature` are.

    Parameters
    ----------
    atoms : array_like of int, shape (n_rows, width) or (width,)
        Atoms of each row, in the order the family documents.
    target : float, array_like, MovingTarget, callable of time, or None
        What each row is held at; None takes the value found when the set is built.
    **data : array_like
        What is listed in `per_row`, for all rows or for each.

    Notes
    -----
    Arrays of constraints cannot be changed: engines have copies of what stands in them. Make another one instead.
    """

    family: ClassVar[str]
    holonomic: ClassVar[bool] = True
    #: Puts the value into ``out[0]`` and the gradient behind it, x, y, z by atom: of the positions ``r[0]``, ``r[1]``,
    #: ... of the atoms of one row in the same order, of its `parameters`, ``p[0]``, ... and of the time t. Written with
    #: + - * /, ``numpy.sqrt`` and the like, so that it can be compiled, and takes arrays of many rows and complex
    #: numbers (``numpy.arctan2`` of real parts: only gradients are differentiated). Of a velocity row a . v, of the
    #: middle of a flight and, behind it, its way d: the value a . d, and its change by the end, a + (da/dr)^T d/2.
    row: Any = None
    #: Puts dq/dt into ``out[0]``, where `row` depends on t: of the same.
    rate: Any = None
    #: How many of the parameters, the first ones, are the same in all rows of an object: numbers of atoms and the like.
    alike: int = 0
    #: Atoms a row, where the family fixes it.
    row_width: int | None = None
    #: Data held for each row: name -> shape of one row's entry, -1 standing for the width.
    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {}
    #: Which of these are lengths, and with which power, where units change.
    length_powers: ClassVar[Mapping[str, int]] = {}
    #: Plain numbers or flags that all rows of the object have in common.
    shared: ClassVar[tuple[str, ...]] = ()
    #: Python functions the object holds; with one of them it cannot be written to a file.
    functions: ClassVar[tuple[str, ...]] = ()
    #: What targets are: `LENGTH`, `ANGLE`, or nothing for something else.
    held: ClassVar[str] = LENGTH
    #: What the target is called where it has to be above zero; nothing where it may be any number.
    positive: str = ""
    below: ClassVar[float] = math.inf  #: What a positive target stays below.
    #: Where the gradient is undefined, and the remedy, with {atom} for the first one.
    singular: ClassVar[str] = "its gradient is undefined; move the atoms"
    #: Whether the coordinate depends on the masses of its atoms.
    uses_masses: ClassVar[bool] = False
    #: Whether the same atoms in reverse order name the same coordinate.
    reversible: ClassVar[bool] = False
    #: Whether rows fix all of an atom, three rows each, so that it moves as with infinite mass.
    fixes_atoms: ClassVar[bool] = False

    #: True if q depends on differences of positions alone, so that minimum images apply.
    translation_invariant: bool = False
    #: Pairs of slots between which vectors count, those from a slot to a later one that nothing before led to; shape
    #: (n, 2). In a cell each takes its shortest image. None where all atoms of a row count relative to each other.
    links: IntArray | None = None
    #: Period of the coordinate (2 pi for dihedrals); sigma is taken to the nearest image.
    period: float | None = None
    kind: RowKind = RowKind.INTERPRETED
    #: Masses of the atoms, shape (n_rows, width), once `with_masses` was called and if they are used.
    masses: FloatArray | None = None
    #: Rows that take their atoms in the images of the set's tree, and how many cells their atoms lie from these,
    #: shape (n_rows, width, 3); None for no rows and for no cells. Set by `kcons.constraints.periodic.images`.
    whole: NDArray[np.bool_] | None = None
    cell_offsets: IntArray | None = None

    def __init_subclass__(cls, base: bool = False, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        cls.family = cls.__name__
        # The name of a family of another module is not taken from it.
        if not base and FAMILIES.get(cls.family, cls).__module__ == cls.__module__:
            FAMILIES[cls.family] = cls
        if cls.row is not None and cls.kind is RowKind.INTERPRETED:
            cls.kind = RowKind.FUNCTION if cls.holonomic else RowKind.VELOCITY
        if "__init__" in cls.__dict__ or cls.__init__ is Constraint.__init__:
            cls.__init__ = checked(cls.__init__, named=True)  # type: ignore[method-assign]

    def __init__(self, atoms: ArrayLike, target: Target = None, **data: ArrayLike) -> None:
        self.atoms: IntArray = read_only(atom_table(atoms, type(self).__name__, self.row_width))
        target = 0.0 if target is None and not self.holonomic else target
        self.target: FloatArray | MovingTarget | None = as_target(target, self.n_rows)
        self._keep(**data)
        self._settle()

    def _keep(self, **data: ArrayLike) -> None:
        """Store data listed in `per_row`, for all rows; copies, which users cannot change."""
        for name, value in data.items():
            setattr(self, name, read_only(np.array(self._of_each_row(name, value, self.per_row[name]), order="C")))

    def _of_each_row(self, name: str, value: ArrayLike, entry: tuple[int, ...]) -> FloatArray:
        """Numbers for all rows or for each, spread over the rows; `entry` is the shape of one row's."""
        shape = (self.n_rows, *(self.width if size < 0 else size for size in entry))
        array = as_float_array(value, f"{self.family}: {name}")
        if array.shape not in (shape[1:], (1, *shape[1:]), shape):
            words = f"give {shape[1:] or 'one number'} for all, or {shape}"
            raise InputError(f"{self.family}: {name} has shape {array.shape}; {words}", item=name)
        check_range(array := np.broadcast_to(array, shape), f"{self.family}: {name} of row {{row}}", name, self.atoms)
        return array

    def __setstate__(self, own: dict[str, Any]) -> None:
        for value in own.values():
            if isinstance(value, np.ndarray):
                read_only(value)
        self.__dict__.update(own)

    def _settle(self) -> None:
        """Derive and check what follows from the per-row data; called once, when these were set."""

    @property
    def holds_length(self) -> bool:
        """Whether each row holds the length between two atoms: what ties them together."""
        return self.kind is RowKind.DISTANCE

    @property
    def n_rows(self) -> int:
        return int(self.atoms.shape[0])

    @property
    def width(self) -> int:
        return int(self.atoms.shape[1])

    @property
    def moving(self) -> bool:
        """Whether value or gradient depend on time explicitly."""
        return isinstance(self.target, MovingTarget) or self.rate is not None

    def _evaluated(self, r: NDArray[Any], time: complex, row: Any = None) -> NDArray[Any]:
        """What `row` puts out, shape (1 + 3 width, n_rows): for all rows at once, or compiled where loops are long."""
        out = np.zeros((self.n_rows, 1 + 3 * self.width), r.dtype)
        if not self.n_rows:
            return out.T
        row, table, places = row or self.row, self.parameters(), r.reshape(self.n_rows, -1)
        if not self.holonomic:  # at the end of a flight that has gone nowhere
            places = np.concatenate([places, np.zeros(places.shape)], axis=1)
        if self.alike and self.width > WIDE:
            compiled = _compiled(row)
            for k in range(self.n_rows):
                compiled(places[k], table[k], time, out[k])
        else:
            row(places.T, [*table[0, : self.alike], *table.T[self.alike :]], time, out.T)
        return out.T

    def value_and_gradient(self, r: FloatArray, time: float) -> tuple[FloatArray, FloatArray]:
        """q, shape (n_rows,), and dq/dr, of the shape of `r`, (n_rows, width, 3); of velocity rows 0 and a."""
        with np.errstate(all="ignore"):  # either may be undefined where the other is not
            out = self._evaluated(r, time)
        return out[0], np.ascontiguousarray(out[1:].T).reshape(r.shape)

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        """Natural coordinate q, shape (n_rows,), from positions `r` of shape (n_rows, width, 3)."""
        return self.value_and_gradient(r, time)[0]

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        """dq/dr (position rows) or the coefficients of v (velocity rows), shape (n_rows, width, 3)."""
        return self.value_and_gradient(r, time)[1]

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        """v^T (d2q/dr2) v, or for velocity rows v . (d coefficients/dt along v, time terms included)."""
        return self._bent(r + (1j * _COMPLEX_STEP) * v, v, time if self.holonomic else time + 1j * _COMPLEX_STEP)

    def _bent(self, r: NDArray[Any], v: FloatArray, time: complex) -> FloatArray:
        """Change of gradient times v along imaginary parts."""
        if not self.n_rows:
            return np.zeros(0)
        slope = self._evaluated(r, time)[1:].imag
        return np.asarray(np.einsum("ck,kc->k", slope, v.reshape(self.n_rows, -1)) / _COMPLEX_STEP)

    def time_terms(self, r: FloatArray, v: FloatArray, time: float) -> tuple[FloatArray, FloatArray]:
        """(dq/dt, 2 (d2q/dr dt) . v + d2q/dt2) at fixed target, for coordinates that move by themselves."""
        if self.rate is None or not self.holonomic:
            return np.zeros(self.n_rows), np.zeros(self.n_rows)
        step = 1j * _COMPLEX_STEP
        with np.errstate(all="ignore"):
            rate = self._evaluated(r, time, self.rate)[0]
            changes = self._evaluated(r + step * v, time + step, self.rate)[0].imag / _COMPLEX_STEP
            return rate, self._bent(r + 0j, v, time + step) + changes

    def scale(self, time: float = 0.0) -> FloatArray:
        """Natural size of each row, shape (n_rows,): the length held, or 1 radian for angles.

        0 where the row has no size of its own; the set then takes the size of the positions.
        """
        if self.held is ANGLE:
            return np.ones(self.n_rows)
        return self.target_at(time) if self.positive and self.target is not None else np.zeros(self.n_rows)

    def target_at(self, time: float) -> FloatArray:
        """What each row is held at, shape (n_rows,)."""
        if self.target is None:
            raise ConstraintError(f"{self!r} has no target; put it in a ConstraintSet first")
        if not isinstance(self.target, MovingTarget):
            return self.target
        target = self.target.at(time, self.n_rows)
        if self.positive and not (possible := (target > 0) & (target < self.below)).all():
            k = int(np.argmin(possible))  # without the number of the row, which only the set knows
            remedy = f"give a function that stays between 0 and {self.below:.6g}, or end the run before"
            said = f"{self.row_name(k)}: {self.positive} {target[k]:g} is not possible at t = {time:g}; {remedy}"
            raise InputError(said, item="target", atoms=self.atoms[k].tolist())
        return target

    def sigma(self, r: FloatArray, time: float) -> FloatArray:
        """q - target of each row, the nearest image where q has a period; 0 of velocity rows, shape (n_rows,)."""
        if not self.holonomic:
            return np.zeros(self.n_rows)
        return nearest_image(self.measure(r, time) - self.target_at(time), self.period)

    def parameters(self) -> FloatArray:
        """Numbers for `row` and the compiled kernels, shape (n_rows, p): the width, where `alike`, and the data."""
        data = [getattr(self, name) for name in self.per_row]
        flat = [array.reshape(self.n_rows, math.prod(array.shape[1:])) for array in data]
        return np.hstack([np.full((self.n_rows, min(self.alike, 1)), float(self.width)), *flat])

    @property
    def linked(self) -> IntArray:
        """Pairs of atoms, shape (n_rows, n, 2): those of `links`, or neighbors in the list."""
        if self.links is None:
            return np.stack([self.atoms[:, :-1], self.atoms[:, 1:]], axis=-1)
        return self.atoms[:, self.links]

    @property
    def relative(self) -> bool:
        """Whether a row depends on where its atoms lie relative to each other, and so on their images."""
        return self.translation_invariant and self.width > 1

    def check(self, r: FloatArray, time: float, first_row: int) -> None:
        """Raise a typed error if a row is undefined at `r` or its target is impossible.

        `first_row` is the number of this object's first row in its set, for messages.
        """
        for bad, say, *item in self.faults(r, time):
            self.refuse(bad, first_row, say, *item)

    def faults(self, r: FloatArray, time: float) -> Iterator[Fault]:
        """What `check` refuses."""
        with np.errstate(all="ignore"):
            value, slope = self.value_and_gradient(r, time)
            size = np.sqrt(np.einsum("kai,kai->k", slope, slope))
        yield ~(np.isfinite(value) & np.isfinite(size) & (size > 0)), lambda k: self.undefined(k, r[k], time)
        if self.holonomic and self.row and not type(self).__module__.startswith("kcons."):
            yield from self._contradictions(r, time)
        if self.positive and self.target is not None:
            length, remedy = self.target_at(time), "give a length greater than zero, or None to hold the present one"
            yield ~(length > 0), lambda k: f"{self.positive} {length[k]:g} is not positive; {remedy}", self.positive

    def _contradictions(self, r: FloatArray, time: float) -> Iterator[Fault]:
        """Derivatives of a family of the user that differences contradict: motion would be wrong without a sign."""
        way = np.random.default_rng(0).normal(size=r.shape)

        def steep(s: float) -> FloatArray:
            return np.asarray(np.sum(self.gradient(r + s * way, time) * way, axis=(1, 2)))

        with np.errstate(all="ignore"):
            slope = contradiction(steep, lambda s: self.measure(r + s * way, time), 0.0, 0.01, self.period)
            moved = contradiction(lambda t: self.time_terms(r, 0 * r, t)[0], lambda t: self.measure(r, t), time, 0.02)
        for item, found in (("row", slope), ("rate", moved)):
            if found is not None:
                said = f"gives {found.given:.6g}, but differences of the value give {found.found:.6g}; correct it"
                yield np.arange(self.n_rows) == found.number, lambda k, it=f"a derivative of `{item}` {said}": it, item

    def undefined(self, k: int, r: FloatArray, time: float) -> str:
        """What is said of row `k`, which has no gradient at `r`, shape (width, 3)."""
        return self.singular.format(atom=self.atoms[k, 0])

    def refuse(self, bad: NDArray[np.bool_], first_row: int, say: Callable[[int], str], item: str = "") -> None:
        """Raise for the first row that is marked, with what `say` says of it.

        `InputError` where an `item` is at fault, else `SingularGeometryError`.
        """
        if bad.any():
            k = int(np.argmax(bad))
            message, atoms = f"row {first_row + k}, {self.row_name(k)}: {say(k)}", self.atoms[k].tolist()
            if item:
                raise InputError(message, item=item, atoms=atoms)
            raise SingularGeometryError(message, rows=[first_row + k], atoms=atoms)

    def refuse_zero(self, coefficients: FloatArray) -> None:
        """Refuse rows whose coefficients, shape (n_rows, width, 3), are all zero."""
        zero = ~np.any(coefficients, axis=(1, 2))
        self.refuse(zero, 0, lambda k: f"all coefficients of row {k} are zero; remove the row", "coefficients")

    def changed(self, **own: Any) -> Self:
        """Copy with other attributes, of which nothing is checked."""
        copy = object.__new__(type(self))
        copy.__dict__.update(self.__dict__ | own)
        return copy

    def with_masses(self, masses: FloatArray) -> Self:
        """Copy that knows the masses of its atoms, shape (n_rows, width); most families need none."""
        if not self.uses_masses:
            return self
        return self.changed(masses=read_only(np.array(masses, dtype=np.float64, order="C")))

    def with_target(self, target: Target) -> Self:
        """Copy of this object held at another target."""
        return self.changed(target=as_target(target, self.n_rows))

    def rescaled(self, factor: float) -> Self:
        """The same where every length is a number larger by `factor` (0.1 from angstrom to nm).

        Raises
        ------
        UnsupportedError
            Own functions, velocity rows, targets that move with time: what they mean in another unit is not known.
        """
        if factor == 1.0:
            return self
        if self.moving or not self.held:
            what = "a target that moves" if self.moving else "a value in a unit of its own"
            raise UnsupportedError(
                f"{self!r} has {what}; it cannot be converted to another unit. Write it in the units of the host"
            )
        own = {name: getattr(self, name) * factor**power for name, power in self.length_powers.items()}
        if self.target is not None and self.held is LENGTH:
            own["target"] = np.asarray(self.target) * factor
        copy = self.changed(**{name: read_only(array) for name, array in own.items()})
        copy._settle()
        return copy

    def select(self, rows: Sequence[int] | IntArray) -> Self:
        """Copy with some of the rows, their targets and their data."""
        rows = np.asarray(rows, dtype=np.int64)
        data = {name: getattr(self, name) for name in (*_BY_ROW, *self.per_row)}
        own: dict[str, Any] = {name: read_only(a[rows]) for name, a in data.items() if isinstance(a, np.ndarray)}
        if isinstance(self.target, MovingTarget):
            target, n, period = self.target, self.n_rows, self.period
            own["target"] = MovingTarget(
                value=lambda t: target.at(t, n)[rows],
                rate=lambda t: target.rate_at(t, n, period)[rows],
                acceleration=lambda t: target.acceleration_at(t, n, period)[rows],
            )
        return self.changed(**own)

    def renumbered(self, new_index: IntArray) -> Self:
        """Copy with atom a replaced by new_index[a]."""
        return self.changed(atoms=read_only(np.asarray(new_index, dtype=np.int64)[self.atoms]))

    def row_name(self, row: int) -> str:
        """For example 'Distance(4, 5)'."""
        atoms = self.atoms[row]
        shown = ", ".join(str(a) for a in atoms[:6]) + (", ..." if len(atoms) > 6 else "")
        return f"{self.family}({shown})"

    def todict(self) -> dict[str, Any]:
        """Plain data from which `kcons.constraints.from_dict` rebuilds the object.

        Raises
        ------
        InputError
            If the object holds Python functions, which cannot be written to a file.
        """
        held = [name for name in self.functions if getattr(self, name) is not None]
        if isinstance(self.target, MovingTarget):
            held.append("target")
        if held:
            raise InputError(
                f"{self.family} holds a Python function ({', '.join(held)}); it cannot be written to a file. "
                "Leave it out, and attach it again after reading",
                item=held[0],
            )
        target = None if self.target is None else self.target.tolist()  # type: ignore[union-attr]
        data = {name: getattr(self, name).tolist() for name in self.per_row}
        data |= {name: getattr(self, name) for name in self.shared}
        return {"family": self.family, "atoms": self.atoms.tolist(), "target": target, **data}

    @classmethod
    def restored(cls, data: Mapping[str, Any]) -> Self:
        """The object that `todict` wrote.

        Raises
        ------
        InputError
            If an entry is missing or unknown.
        """
        names = {"family", "atoms", "target", *cls.per_row, *cls.shared}
        if cls.functions or set(data) != names:
            wrong = sorted(names.symmetric_difference(data)) or list(cls.functions)
            raise InputError(f"{cls.family} cannot be read: entries {wrong} are missing or unknown", item=wrong[0])
        return cls._rebuilt(data)

    @classmethod
    def _rebuilt(cls, data: Mapping[str, Any]) -> Self:
        item, rules = object.__new__(cls), rules_of(cls.__init__)
        for name in cls.shared:
            setattr(item, name, data[name])
        for name in cls.per_row.keys() & rules.keys():
            for rule in rules[name].rules:  # of directions too, which have length 1 where they are written
                taken = rule(data[name], f"{cls.family}: {name}")
                if np.abs(taken - np.asarray(data[name])).max(initial=0.0) > 1e-10:
                    raise InputError(f"{cls.family} cannot be read: {name} has vectors not of length 1", item=name)
        Constraint.__init__(item, data["atoms"], data["target"], **{name: data[name] for name in cls.per_row})
        return item

    def adjust_positions(self, *_: Any) -> NoReturn:
        """What ASE calls, by this name or another, where the object itself was given to ``atoms.set_constraint``."""
        raise UnsupportedError(f"{self!r} is on Atoms by itself; take it off, and kcons.ase.constrain(atoms, [...])")

    adjust_forces = adjust_momenta = get_removed_dof = adjust_positions

    def __repr__(self) -> str:
        what = self.row_name(0) if self.n_rows == 1 else f"{self.family}({self.n_rows} rows)"
        return f"<{what}>"


@functools.cache
def _compiled(row: Callable[[Any, Any, Any, Any], None]) -> Any:
    return njit(cache=has_a_file(row), error_model="numpy")(row)


def constraints_in(given: Constraint | Iterable[Constraint], item: str) -> list[Constraint]:
    """One constraint, or several, as a list; `InputError` for something else."""
    found: list[Any]
    found = [given] if isinstance(given, Constraint | str) or not isinstance(given, Iterable) else list(given)
    for entry in found:
        if not isinstance(entry, Constraint):
            raise InputError(f"{item} has {entry!r}, which is no kcons constraint; see kcons.constraints", item=item)
    return found
