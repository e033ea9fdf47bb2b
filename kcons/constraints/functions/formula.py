"""Rows that are formulas of the coordinates of their atoms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from keyword import iskeyword
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import ANY, MD_UNITS, atom_array, numbers, out_of_range, positive, without_units
from kcons.constraints.constraint import Constraint, RowKind
from kcons.constraints.functions.expressions import FUNCTIONS, Code, code_of, undefined_part, width_of
from kcons.constraints.target import FloatArray, Target
from kcons.errors import InputError


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
    cells. SymPy, which differentiates, is needed once for each formula; the code is kept in files.

    Raises
    ------
    InputError
        Unknown names, atoms that are not named or not given, a formula that does not depend on the positions.
    SingularGeometryError
        When put into a set: no finite value or gradient, or a gradient of zero.
    UnsupportedError
        SymPy is not installed.

    Examples
    --------
    A bead on a wave that runs along x:

    >>> wave = Formula("z1 - a*sin(k*x1 - t)", 0, {"a": 0.1, "k": 2.0})
    >>> wave.n_rows, wave.moving
    (1, True)
    """

    family = "Formula"
    held = ANY
    kind = RowKind.FUNCTION
    shared: ClassVar[tuple[str, ...]] = ("formula", "names", "period")
    #: Whether it is linear in velocities, which have names too.
    of_speeds: ClassVar[bool] = False
    values: FloatArray

    def __init__(
        self,
        formula: str,
        atoms: ArrayLike,
        parameters: Mapping[str, ArrayLike] | None = None,
        target: Target = 0.0,
        *,
        period: float | None = None,
    ) -> None:
        if not isinstance(parameters, Mapping | None):
            raise InputError(
                f"Formula: parameters is {parameters!r:.60}; give numbers by name, such as {{'k': 2.0}}",
                item="parameters",
            )
        given = dict(parameters or {})
        self.formula, self.names = formula, list(given)
        self.period = None if period is None else positive(period, "Formula: period")
        for name in self.names:
            if not isinstance(name, str):
                raise InputError(
                    f"Formula: {name!r:.60} cannot be the name of a parameter; give text", item="parameters"
                )
            taken = name in (*FUNCTIONS, "copysign", "t", "pi") or name.startswith(("_", "vx", "vy", "vz"))
            if not name.isidentifier() or iskeyword(name) or taken or (name[1:].isdigit() and name[0] in "xyz"):
                raise InputError(f"Formula: {name!r} cannot be the name of a parameter; give another one", item=name)
        alone = width_of(formula, self.names, self.of_speeds) == 1
        table = atom_array(atoms, self.family)
        super().__init__(table.reshape(-1, 1) if alone and table.ndim < 2 else table, target)
        columns = []
        for name, value in given.items():
            plain, matters = without_units(value, f"Formula: {name}", ANY)
            self.units = MD_UNITS if matters else self.units
            column = numbers(plain, f"Formula: {name}")
            if column.shape not in ((), (1,), (self.n_rows,)):
                raise InputError(
                    f"Formula: parameter {name!r} has shape {column.shape}; give one finite number, or one for each of "
                    f"the {self.n_rows} rows",
                    item=name,
                )
            wrong = out_of_range(column)
            if wrong is not None:
                raise InputError(f"Formula: parameter {name!r} is {wrong[1]}", item=name)
            columns.append(np.broadcast_to(column, (self.n_rows,)))
        self._keep_values(np.stack(columns, axis=1) if columns else np.zeros((self.n_rows, 0)))
        self.translation_invariant = self.code().invariant

    def _keep_values(self, values: ArrayLike) -> None:
        self.per_row = {"values": (len(self.names),)}  # type: ignore[misc]
        self._keep(values=values)

    def code(self) -> Code:
        """What is computed of the formula."""
        return code_of(self.formula, self.width, tuple(self.names), self.of_speeds)

    @property
    def moving(self) -> bool:
        return super().moving or self.code().moving

    def _arguments(self, time: float, *arrays: FloatArray) -> list[Any]:
        """Coordinates one by one, the time and the parameters, an array of one number a row each."""
        columns = [column for array in arrays for column in array.reshape(self.n_rows, -1).T]
        return [*columns, time, *self.values.T]

    def _plain(self, function: Callable[..., tuple[float, ...]], time: float, *arrays: FloatArray) -> FloatArray | None:
        """What a function of plain numbers gives for a single row, a row each; None where it is undefined."""
        numbers = [number for array in arrays for number in array.ravel().tolist()]
        try:
            found = np.array(function(*numbers, float(time), *self.values[0].tolist()))
        except (ValueError, ArithmeticError):
            return None
        return None if found.dtype.kind == "c" else found[:, None]

    def _first(self, r: FloatArray, time: float) -> FloatArray:
        """Value and gradient, shape (1 + 3 width, n_rows)."""
        if self.n_rows == 1:
            plain = self._plain(self.code().plain_first, time, r)
            if plain is not None:
                return plain
        with np.errstate(all="ignore"):
            found = self.code().first(*self._arguments(time, r))
        return np.array(np.broadcast_arrays(*found, np.zeros(self.n_rows))[:-1], dtype=np.float64)

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        return self._first(r, time)[0]

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        return np.ascontiguousarray(self._first(r, time)[1:].T).reshape(r.shape)

    def _second(self, r: FloatArray, v: FloatArray, time: float) -> Sequence[FloatArray]:
        if self.n_rows == 1:
            plain = self._plain(self.code().plain_second, time, r, v)
            if plain is not None:
                return list(plain)
        with np.errstate(all="ignore"):
            found = self.code().second(*self._arguments(time, r, v))
        return tuple(np.broadcast_to(np.asarray(part, dtype=np.float64), (self.n_rows,)) for part in found)

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        return self._second(r, v, time)[0]

    def acceleration_terms(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        curvature, _, mixed = self._second(r, v, time)
        return curvature + mixed

    def time_terms(self, r: FloatArray, v: FloatArray, time: float) -> tuple[FloatArray, FloatArray]:
        _, rate, mixed = self._second(r, v, time)
        return rate, mixed

    def scale(self, time: float = 0.0) -> FloatArray:
        # The unit of the formula is unknown: the set takes the size of the positions.
        return np.zeros(self.n_rows)

    def parameters(self) -> FloatArray:
        return self.values

    def check(self, r: FloatArray, time: float, first_row: int) -> None:
        if self.n_rows == 0:
            return
        value, slope = self.measure(r, time), self.gradient(r, time)
        size = np.linalg.norm(slope.reshape(self.n_rows, -1), axis=1)

        def said(k: int, row: str) -> str:
            axes = [f"{axis}{atom}" for atom in range(1, self.width + 1) for axis in "xyz"]
            numbers = dict(zip([*axes, "t", *self.names], [*r[k].ravel(), time, *self.values[k]], strict=True))
            numbers |= {f"v{axis}": 1.0 for axis in axes}
            part = undefined_part(self.code().tree, {**FUNCTIONS, **numbers, "pi": np.float64(np.pi), "": np.float64})
            what = part or f"its gradient is {'zero' if size[k] == 0 else 'not finite'}"
            return f"{row}, {self.formula!r}: {what} at the start; move the atoms, or write another formula"

        self.refuse_singular(~(np.isfinite(value) & np.isfinite(size) & (size > 0)), first_row, said)

    @classmethod
    def restored(cls, data: Mapping[str, Any]) -> Self:
        wanted = {"family", "atoms", "target", "values", *cls.shared}
        wrong = sorted(wanted.symmetric_difference(set(data) - {"units"}))
        if wrong:
            raise InputError(f"{cls.family} cannot be read: entries {wrong} are missing or unknown", item=wrong[0])
        table = numbers(data["values"], f"{cls.family}: values")
        if not isinstance(data["names"], list | tuple) or np.shape(table)[1:] != (len(data["names"]),):
            raise InputError(
                f"{cls.family} cannot be read: values have shape {table.shape} for the names {data['names']!r:.80}; "
                "give a row of one number a name for each row",
                item="values",
            )
        parameters = dict(zip(data["names"], table.T, strict=True))
        period = {name: data[name] for name in cls.shared if name == "period"}
        item = cls(data["formula"], data["atoms"], parameters, data["target"], **period)
        item.units = data.get("units")
        return item
