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

from abc import ABC, abstractmethod
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.target import FloatArray, MovingTarget, Target, as_target
from kcons.errors import InputError

IntArray = NDArray[np.int64]


class RowKind(IntEnum):
    """Rows that the compiled solvers evaluate themselves; INTERPRETED rows call Python."""

    INTERPRETED = 0
    DISTANCE = 1  # no parameters
    ANGLE = 2  # atoms i, j, k with vertex j; no parameters; coordinate theta
    DIHEDRAL = 3  # atoms i, j, k, l; no parameters; coordinate phi, smooth through +-180 degrees
    LINEAR = 4  # sum_a c_a . r_a; parameters c, 3 numbers an atom, at most 4 atoms
    SPHERE = 5  # |r - c|; parameters c
    CYLINDER = 6  # distance from the axis; parameters c, unit axis


class Constraint(ABC):
    """Rows of one family.

    Parameters
    ----------
    atoms : array_like of int, shape (n_rows, width) or (width,)
        Atoms of each row, in the order the family documents.
    target : float, array_like, MovingTarget, callable of time, or None
        What each row is held at; None takes the value found when the set is built.
    """

    family: ClassVar[str]
    holonomic: ClassVar[bool] = True
    #: True if q depends on differences of positions alone, so that minimum images apply.
    translation_invariant: ClassVar[bool] = False
    #: Period of the coordinate (2 pi for dihedrals); sigma is taken to the nearest image.
    period: ClassVar[float | None] = None
    kind: ClassVar[RowKind] = RowKind.INTERPRETED

    def __init__(self, atoms: ArrayLike, target: Target = None) -> None:
        self.atoms: IntArray = _atom_table(atoms, type(self).__name__)
        self.target: FloatArray | MovingTarget | None = as_target(target, self.n_rows)

    @property
    def n_rows(self) -> int:
        return int(self.atoms.shape[0])

    @property
    def width(self) -> int:
        return int(self.atoms.shape[1])

    @property
    def moving(self) -> bool:
        """Whether value or gradient depend on time explicitly."""
        return isinstance(self.target, MovingTarget)

    @abstractmethod
    def measure(self, r: FloatArray, time: float) -> FloatArray:
        """Natural coordinate q, shape (n_rows,), from positions `r` of shape (n_rows, width, 3)."""

    @abstractmethod
    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        """dq/dr (position rows) or the coefficients of v (velocity rows), shape (n_rows, width, 3)."""

    @abstractmethod
    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        """v^T (d2q/dr2) v, or for velocity rows v . (d coefficients/dt along v, time terms included)."""

    def time_terms(self, r: FloatArray, v: FloatArray, time: float) -> tuple[FloatArray, FloatArray]:
        """(dq/dt, 2 (d2q/dr dt) . v + d2q/dt2) at fixed target, for coordinates that move by themselves."""
        zero = np.zeros(self.n_rows)
        return zero, zero

    def scale(self) -> FloatArray:
        """Natural size of each row, shape (n_rows,): the length held, or 1 radian for angles."""
        if isinstance(self.target, np.ndarray):
            return np.maximum(np.abs(self.target), np.finfo(float).tiny)
        return np.ones(self.n_rows)

    def parameters(self) -> FloatArray:
        """Numbers for the compiled kernels, shape (n_rows, p); see `RowKind`."""
        return np.zeros((self.n_rows, 0))

    def check(self, r: FloatArray, time: float, first_row: int) -> None:
        """Raise a typed error if a row is undefined at `r` or its target is impossible.

        `first_row` is the number of this object's first row in its set, for messages.
        """

    def with_masses(self, masses: FloatArray) -> Constraint:
        """Copy that knows the masses of its atoms, shape (n_rows, width); most families need none."""
        return self

    def with_target(self, target: Target) -> Constraint:
        """Copy of this object held at another target."""
        copy = object.__new__(type(self))
        copy.__dict__.update(self.__dict__)
        copy.target = as_target(target, self.n_rows)
        return copy

    def select(self, rows: Sequence[int] | IntArray) -> Constraint:
        """Copy with some of the rows; families with per-row data extend it."""
        rows = np.asarray(rows, dtype=np.int64)
        copy = self.with_target(None)
        copy.atoms = self.atoms[rows]
        if isinstance(self.target, np.ndarray):
            copy.target = self.target[rows]
        elif self.target is not None:
            copy.target = _selected(self.target, rows, self.n_rows)
        return copy

    def renumbered(self, new_index: IntArray) -> Constraint:
        """Copy with atom a replaced by new_index[a]."""
        copy = self.with_target(self.target)
        copy.atoms = np.asarray(new_index, dtype=np.int64)[self.atoms]
        return copy

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
        if isinstance(self.target, MovingTarget):
            raise InputError(
                f"{self.family} has a target that is a function of time; it cannot be written to a file. "
                "Attach it again after reading.",
                item="target",
            )
        target = None if self.target is None else self.target.tolist()
        return {"family": self.family, "atoms": self.atoms.tolist(), "target": target, **self._data()}

    def _data(self) -> dict[str, Any]:
        """Constructor arguments beyond atoms and target, as plain data."""
        return {}

    def __repr__(self) -> str:
        what = self.row_name(0) if self.n_rows == 1 else f"{self.family}({self.n_rows} rows)"
        return f"<{what}>"


def _selected(target: MovingTarget, rows: IntArray, n_rows: int) -> MovingTarget:
    return MovingTarget(
        value=lambda t: target.at(t, n_rows)[rows],
        rate=lambda t: target.rate_at(t, n_rows)[rows],
        acceleration=lambda t: target.acceleration_at(t, n_rows)[rows],
    )


def _atom_table(atoms: ArrayLike, name: str) -> IntArray:
    table = np.asarray(atoms)
    if table.size and not np.issubdtype(table.dtype, np.integer):
        raise InputError(f"{name}: atom indices must be integers, not {table.dtype}", item="atoms")
    table = np.atleast_2d(table.astype(np.int64))
    if table.ndim != 2:
        raise InputError(f"{name}: atoms must have shape (n_rows, width), not {table.shape}", item="atoms")
    if table.size and table.min() < 0:
        row, slot = np.argwhere(table < 0)[0]
        raise InputError(
            f"{name}: row {row} has the negative atom index {table[row, slot]}; count atoms from 0",
            item="atoms",
            atoms=table[row],
        )
    if table.shape[1] > 1:
        ordered = np.sort(table, axis=1)
        repeated = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
        if repeated.any():
            row = int(np.argmax(repeated))
            raise InputError(
                f"{name}: row {row} names an atom twice: {tuple(table[row].tolist())}", item="atoms", atoms=table[row]
            )
    return table
