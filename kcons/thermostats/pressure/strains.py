"""The ways in which a cell may change.

A cell h (vectors as rows) becomes h S, S = exp(sum of e_k E_k), with generators E_k of unit trace where the volume
changes: e_k is then the change of ln V. In orthogonal kinds S is diagonal. 'flexible' keeps a lower triangular cell
triangular: the generators are those of lower triangular matrices, taken in the frame in which the cell is one.

The measure of the states is V dV for the volume times the invariant measure of shapes, so that volumes are spread alike
in all kinds. In the coordinates e_k this is V^(N+1) d e for orthogonal kinds. Lower triangular matrices have two
invariant measures, which differ by (S_11/S_33)^2 in a trial: see docs/constant_pressure.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.target import FloatArray
from kcons.errors import InputError

Kind = Literal["isotropic", "semi-isotropic", "anisotropic", "flexible", "lateral", "normal"]

_AXES = [np.diag(row) for row in np.eye(3)]
_PLANE = np.diag([0.5, 0.5, 0.0])


def _lower(i: int, j: int) -> FloatArray:
    matrix = np.zeros((3, 3))
    matrix[i, j] = 1.0
    return matrix


GENERATORS: dict[str, FloatArray] = {
    "isotropic": np.array([np.eye(3) / 3]),
    "semi-isotropic": np.array([_PLANE, _AXES[2]]),
    "anisotropic": np.array(_AXES),
    "flexible": np.array([*_AXES, _lower(1, 0), _lower(2, 0), _lower(2, 1)]),
    "lateral": np.array([_PLANE]),
    "normal": np.array([_AXES[2]]),
}

#: Largest change of a length in one trial: from one cell to another within a tenth, the images that rows mean can be
#: followed. Barostats propose no more, and the acceptance knows that.
MOST = 0.09


@dataclass(frozen=True, eq=False)
class Strains:
    """One kind.

    Attributes
    ----------
    kind : str
    generators : ndarray, shape (k, 3, 3)
    axes : ndarray of bool, shape (3,)
        Those along which lengths change.
    most : ndarray, shape (k,)
        Largest |e_k| of a trial.
    """

    kind: Kind
    generators: FloatArray
    axes: NDArray[np.bool_]
    most: FloatArray

    @classmethod
    def of(cls, kind: Kind) -> Strains:
        """By name.

        Raises
        ------
        InputError
            Unknown.
        """
        if not isinstance(kind, str) or kind not in GENERATORS:
            raise InputError(f"kind is {kind!r}; choose {', '.join(map(repr, GENERATORS))}", item="kind")
        generators = GENERATORS[kind]
        axes: NDArray[np.bool_] = np.asarray(np.diagonal(generators, axis1=1, axis2=2).sum(axis=0) > 0)
        return cls(kind, generators, axes, MOST / np.abs(generators).max(axis=(1, 2)))

    @cached_property
    def diagonals(self) -> FloatArray:
        """Of the generators, shape (k, 3)."""
        return np.ascontiguousarray(np.diagonal(self.generators, axis1=1, axis2=2))

    @cached_property
    def traces(self) -> FloatArray:
        return np.asarray(self.diagonals.sum(axis=1))

    @cached_property
    def sizes(self) -> FloatArray:
        """Sums of squares of the entries, shape (k,)."""
        return np.asarray((self.generators**2).sum(axis=(1, 2)))

    @property
    def flexible(self) -> bool:
        return self.kind == "flexible"

    def __len__(self) -> int:
        return len(self.generators)

    def frame(self, cell: FloatArray) -> FloatArray | None:
        """Rotation Q with cell = L Q, L lower triangular; None for the unit matrix."""
        if not self.flexible or not np.triu(cell, 1).any():
            return None
        q, r = np.linalg.qr(cell.T)
        return (q * np.sign(np.diag(r))).T

    def generators_in(self, frame: FloatArray | None) -> FloatArray:
        return self.generators if frame is None else np.einsum("ji,kjl,lm->kim", frame, self.generators, frame)

    def matrix(self, e: FloatArray, frame: FloatArray | None) -> FloatArray:
        """S."""
        if not self.flexible:
            return np.diag(np.exp(e @ self.diagonals))
        inner = _exponential(np.tensordot(e, self.generators, 1))
        return inner if frame is None else frame.T @ inner @ frame

    def log_measure(self, e: FloatArray, moving: NDArray[np.int64]) -> float:
        """ln of the factor by which the measure of states grows; `moving` pieces follow the cell along each axis."""
        logs = e @ self.diagonals  # ln S_ii
        shape = 2 * (logs[0] - logs[2]) if self.flexible else 0.0
        return float(logs @ moving + logs.sum() + shape)


def _exponential(a: FloatArray) -> FloatArray:
    """exp(a) for entries below 1 by its series, which leaves triangular matrices triangular to the last bit."""
    term = total = np.eye(3)
    for k in range(1, 20):
        term = term @ a / k
        total = total + term
    return total
