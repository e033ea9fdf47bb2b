"""Rows linear in the positions: combinations of coordinates, relations between atoms, fixed atoms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import FloatArray, as_float_array, atom_array, atom_column
from kcons.constraints.constraint import Constraint, RowKind
from kcons.constraints.target import MovingTarget, Target
from kcons.errors import InputError

__all__ = ["FixedAtoms", "LinearCombination", "LinearRelation"]


class LinearRows(Constraint, base=True):
    """Rows q = sum_a c_a . r_a with constant coefficients, shape (n_rows, width, 3), which are their parameters.

    They have no curvature. Minimum images apply if a common shift of all atoms leaves every row of the
    object unchanged (coefficients that sum to zero); otherwise the positions are taken as they are.
    """

    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"coefficients": (-1, 3)}
    kind = RowKind.LINEAR
    coefficients: FloatArray

    def _settle(self) -> None:
        c = self.coefficients
        self.translation_invariant = bool(
            self.width > 1 and np.all(np.abs(c.sum(axis=1)) <= 1e-12 * np.abs(c).sum(axis=1).max(initial=0.0))
        )
        self.refuse_zero(c)

    def value_and_gradient(self, r: FloatArray, time: float) -> tuple[FloatArray, FloatArray]:
        slope = self.parameters().reshape(r.shape)
        return np.asarray(np.einsum("kai,kai->k", slope, r)), slope

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        return np.zeros(self.n_rows)

    def parameters(self) -> FloatArray:
        return self.coefficients.reshape(self.n_rows, 3 * self.width)


class LinearCombination(LinearRows):
    """A combination of Cartesian coordinates, q = sum_a c_a . r_a, one row.

    Parameters
    ----------
    atoms : array_like of int, shape (n_rows, width) or (width,)
        Atoms of each row.
    coefficients : array_like, shape (width, 3) or (n_rows, width, 3)
        What each coordinate is multiplied with.
    target : float, array_like, callable of time, MovingTarget or None
        Value held.

    Examples
    --------
    Two atoms kept at the same height:

    >>> level = LinearCombination([0, 1], [[0, 0, 1], [0, 0, -1]], target=0.0)
    >>> level.n_rows
    1
    """

    def __init__(self, atoms: ArrayLike, coefficients: ArrayLike, target: Target = None) -> None:
        super().__init__(atoms, target, coefficients=coefficients)


class LinearRelation(LinearRows):
    """An atom at a fixed combination of others, r_a = sum_i w_i r_i: three rows (x, y, z) an atom.

    What holds a linear rigid group (two bases) or a planar one (three bases) where distances alone would
    be singular: hold the distances between the bases and tie every other atom to them.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n,)
        The dependent atoms.
    bases : array_like of int, shape (n_bases,) or (n, n_bases)
        Atoms they are tied to.
    weights : array_like, shape (n_bases,) or (n, n_bases)
        w_i. With weights that sum to 1 the relation is independent of the origin, and minimum images apply.
    target : array_like of shape (n, 3), callable of time, MovingTarget, or None
        What r_a - sum_i w_i r_i is held at; zero by default, None takes the initial value.

    Examples
    --------
    The carbon of CO2 in the middle of its oxygens:

    >>> relation = LinearRelation(0, [1, 2], [0.5, 0.5])
    >>> relation.n_rows, relation.translation_invariant
    (3, True)
    """

    def __init__(self, atoms: ArrayLike, bases: ArrayLike, weights: ArrayLike, target: Target = 0.0) -> None:
        dependent = atom_column(atoms, self.family)
        base, w = np.atleast_2d(atom_array(bases, self.family)), as_float_array(weights, "weights")
        try:
            base = np.broadcast_to(base, (len(dependent), base.shape[-1]))
            w = np.broadcast_to(w, base.shape)
        except ValueError:
            raise InputError(
                f"LinearRelation: {len(dependent)} atoms, bases of shape {np.shape(bases)} and weights of shape "
                f"{np.shape(weights)} do not fit; give n_bases bases and as many weights, for all atoms or for each",
                item="weights",
            ) from None
        factors = np.hstack([np.ones((len(w), 1)), -w])
        super().__init__(
            np.repeat(np.hstack([dependent, base]), 3, axis=0),
            target,
            coefficients=np.einsum("na,ij->niaj", factors, np.eye(3)).reshape(-1, factors.shape[1], 3),
        )


class FixedAtoms(LinearRows):
    """Atoms held at given points: three rows (x, y, z) an atom, in the order of `atoms`.

    The engine gives them infinite mass; their multipliers are the reaction forces. Each may be named once.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n,)
        The atoms.
    target : array_like of shape (n, 3), callable of time returning (n, 3), MovingTarget, or None
        Where they are held; None takes the initial positions.
    """

    row_width = 1
    fixes_atoms = True

    def __init__(self, atoms: ArrayLike, target: Target = None) -> None:
        column = atom_column(atoms, self.family)
        if not callable(target) and not isinstance(target, MovingTarget | None):
            place = as_float_array(target, "target")
            target = np.tile(place, len(column)) if place.shape == (3,) else place
        super().__init__(
            np.repeat(column, 3, axis=0), target, coefficients=np.tile(np.eye(3), (len(column), 1))[:, None, :]
        )
        values, counts = np.unique(column, return_counts=True)
        if np.any(counts > 1):
            atom = int(values[np.argmax(counts > 1)])
            raise InputError(f"FixedAtoms names atom {atom} twice; name it once", item="atoms", atoms=[atom])
