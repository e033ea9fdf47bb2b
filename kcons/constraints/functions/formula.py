"""Rows that are formulas of the coordinates of their atoms, or of these and linear in the velocities."""

from __future__ import annotations

from collections.abc import Mapping
from keyword import iskeyword
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import (
    ANY,
    MD_UNITS,
    FloatArray,
    as_float_array,
    atom_array,
    positive,
    refuse_other,
    without_units,
)
from kcons.constraints.constraint import Constraint, RowKind
from kcons.constraints.functions.expressions import FUNCTIONS, Code, code_of, undefined_part
from kcons.constraints.target import Target
from kcons.errors import InputError

__all__ = ["Formula", "VelocityFormula"]


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
    cells. The code is kept in files.

    Raises
    ------
    InputError
        Unknown names, atoms that are not named or not given, a formula that does not depend on the positions.
    SingularGeometryError
        When put into a set: no finite value or gradient, or a gradient of zero.

    Examples
    --------
    A bead on a wave that runs along x:

    >>> wave = Formula("z1 - a*sin(k*x1 - t)", 0, {"a": 0.1, "k": 2.0})
    >>> wave.n_rows, wave.moving
    (1, True)
    """

    held = ANY
    kind = RowKind.FUNCTION
    shared: ClassVar[tuple[str, ...]] = ("formula", "names", "period")
    per_row: Mapping[str, tuple[int, ...]] = {"values": ()}  # type: ignore[misc]
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
        period: Annotated[float, ANY, positive] | None = None,
    ) -> None:
        refuse_other(parameters, (Mapping, type(None)), "parameters", "numbers by name, such as {'k': 2.0}")
        refuse_other(formula, str, "formula", "text, such as 'x1**2 + y1**2 - 1'")
        given = dict(parameters or {})
        self.formula, self.names = formula, list(given)
        self.period = period
        for name in self.names:
            if not isinstance(name, str):
                raise InputError(
                    f"Formula: {name!r:.60} cannot be the name of a parameter; give text", item="parameters"
                )
            taken = name in (*FUNCTIONS, "copysign", "t", "pi") or name.startswith(("_", "vx", "vy", "vz"))
            if not name.isidentifier() or iskeyword(name) or taken or (name[1:].isdigit() and name[0] in "xyz"):
                raise InputError(f"Formula: {name!r} cannot be the name of a parameter; give another one", item=name)
        self.row_width = self.code().width
        table = atom_array(atoms, self.family)
        super().__init__(table.reshape(-1, 1) if self.row_width == 1 and table.ndim < 2 else table, target)
        columns = []
        for name, value in given.items():
            plain, matters = without_units(value, f"Formula: {name}", ANY)
            self.units = MD_UNITS if matters else self.units
            columns.append(self._of_each_row(name, plain, ()))
        self.per_row = {"values": (len(columns),)}
        self._keep(values=np.stack(columns, axis=1) if columns else np.zeros((self.n_rows, 0)))
        self.translation_invariant = self.code().invariant

    def code(self) -> Code:
        """What is computed of the formula."""
        return code_of(self.formula, tuple(self.names), self.of_speeds)

    @property
    def row(self) -> Any:  # type: ignore[override]
        return self.code().row

    @property
    def rate(self) -> Any:  # type: ignore[override]
        return self.code().rate

    def undefined(self, k: int, r: FloatArray, time: float) -> str:
        axes = [f"{axis}{atom}" for atom in range(1, self.width + 1) for axis in "xyz"]
        numbers = dict(zip([*axes, "t", *self.names], [*r.ravel(), time, *self.values[k]], strict=True))
        numbers |= {f"v{axis}": 1.0 for axis in axes} | {"pi": np.pi}
        what = undefined_part(self.code().tree, {name: np.float64(value) for name, value in numbers.items()})
        if what is None:
            flat = not self.select([k]).gradient(r[None], time).any()
            what = f"its gradient is {'zero' if flat else 'not finite'}"
        return f"{self.formula!r}: {what} at the start; move the atoms, or write another formula"

    @classmethod
    def _rebuilt(cls, data: Mapping[str, Any]) -> Self:
        names, table = data["names"], as_float_array(data["values"], f"{cls.family}: values")
        if not isinstance(names, list | tuple) or table.shape[1:] != (len(names),):
            raise InputError(
                f"{cls.family} cannot be read: values have shape {table.shape} for the names {names!r:.80}; "
                "give a row of one number a name for each row",
                item="values",
            )
        more = {name: data[name] for name in cls.shared if name == "period"}
        return cls(data["formula"], data["atoms"], dict(zip(names, table.T, strict=True)), data["target"], **more)


class VelocityFormula(Formula):
    """A formula that is linear in the velocities of a few atoms (nonholonomic), differentiated exactly and compiled.

    Parameters
    ----------
    formula : str
        As for `Formula`, with vx1, vy1, vz1 for the velocity of the first atom of a row, vx2, ...: a sum of velocities,
        each times a function of coordinates, time and parameters.
    atoms : array_like of int, shape (n_rows, width) or (width,)
        Atoms of each row, as many as the formula names; (n_rows,) where it names one.
    parameters : mapping of str to float or array_like of shape (n_rows,), optional
        Numbers by name, one for all rows or one for each.
    target : float, array_like, callable of time, or MovingTarget
        What the sum is held at, 0 by default.

    Raises
    ------
    InputError
        As `Formula`; a formula that is not linear in the velocities.
    SingularGeometryError
        When put into a set: coefficients that are all zero, or not finite.

    Examples
    --------
    A bead whose velocity has a given angle with the radius, seen in the plane:

    >>> spiral = VelocityFormula("x1*vy1 - y1*vx1 - c*(x1*vx1 + y1*vy1)", 0, {"c": 2.0})
    >>> spiral.holonomic, spiral.moving
    (False, False)
    """

    holonomic = False
    kind = RowKind.VELOCITY
    shared: ClassVar[tuple[str, ...]] = ("formula", "names")
    of_speeds = True

    def __init__(
        self,
        formula: str,
        atoms: ArrayLike,
        parameters: Mapping[str, ArrayLike] | None = None,
        target: Target = 0.0,
    ) -> None:
        super().__init__(formula, atoms, parameters, target)
