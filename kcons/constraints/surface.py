"""Atoms held at places: fixed, in linear relations, on planes, lines and surfaces.

Every surface takes one atom or many; each atom is a row of its own (two rows on a line). Coordinates are
lengths: the distance from a point, an axis, a plane or a circle, so that gradients have norm 1. They are
taken from the positions as they are: surfaces are not repeated in periodic cells.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy import sqrt
from numpy.typing import ArrayLike

from kcons.constraints.arguments import (
    Directions,
    FloatArray,
    PositiveLengths,
    as_float_array,
    atom_array,
    atom_table,
    check_range,
    unit,
)
from kcons.constraints.constraint import Constraint, RowKind
from kcons.constraints.target import Target
from kcons.errors import InputError

__all__ = ["Ellipsoid", "FixedAtoms", "Line", "LinearCombination", "LinearRelation", "Plane", "Sphere", "Torus"]

_VECTOR = (3,)


class LinearCombination(Constraint):
    """A combination of Cartesian coordinates, q = sum_a c_a . r_a, one row; it has no curvature.

    Minimum images apply if a common shift of all atoms leaves every row of the object unchanged (coefficients that sum
    to zero); otherwise the positions are taken as they are.

    Parameters
    ----------
    atoms : array_like of int, shape (n_rows, width) or (width,)
        Atoms of each row.
    coefficients : array_like, shape (width, 3) or (n_rows, width, 3)
        What each coordinate is multiplied with.
    target : float, array_like, callable of time, MovingTarget or None
        Value held.
    """

    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"coefficients": (-1, 3)}
    kind = RowKind.LINEAR
    coefficients: FloatArray

    def __init__(self, atoms: ArrayLike, coefficients: ArrayLike, target: Target = None) -> None:
        super().__init__(atoms, target, coefficients=coefficients)

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


class LinearRelation(LinearCombination):
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
    """

    def __init__(self, atoms: ArrayLike, bases: ArrayLike, weights: ArrayLike, target: Target = 0.0) -> None:
        dependent = atom_table(atoms, self.family, 1)
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
        coefficients = np.einsum("na,ij->niaj", factors, np.eye(3)).reshape(-1, factors.shape[1], 3)
        super().__init__(np.repeat(np.hstack([dependent, base]), 3, axis=0), coefficients, target)


class FixedAtoms(LinearCombination):
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
        column = atom_table(atoms, self.family, 1)
        super().__init__(np.repeat(column, 3, axis=0), np.tile(np.eye(3), (len(column), 1))[:, None, :], target)
        values, counts = np.unique(column, return_counts=True)
        if len(values) < len(column):
            atom = int(values[np.argmax(counts > 1)])
            raise InputError(f"FixedAtoms names atom {atom} twice; name it once", item="atoms", atoms=[atom])


class Surface(Constraint, base=True):
    """Rows over one atom each, q(r), with a radius as the target."""

    row_width = 1
    positive = "radius"


class Sphere(Surface):
    """Distance from a point, q = |r - c|.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n_rows,)
        The atoms; each is one row.
    center : array_like, shape (3,) or (n_rows, 3)
        Center c, for all atoms or for each.
    radius : float, array_like, callable of time, MovingTarget or None
        Distance held; None takes the initial one.

    References
    ----------
    Notes, example 4 (there with q^2).
    """

    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"center": _VECTOR}
    length_powers = {"center": 1}
    singular = "atom {atom} lies at the center of the sphere: gradient undefined; move the atom"
    center: FloatArray

    def __init__(self, atoms: ArrayLike, center: ArrayLike, radius: Target = None) -> None:
        super().__init__(atoms, radius, center=center)

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        x, y, z = r[0] - p[0], r[1] - p[1], r[2] - p[2]
        q = sqrt(x * x + y * y + z * z)
        out[0], out[1], out[2], out[3] = q, x / q, y / q, z / q


class Torus(Surface):
    """Distance from a circle, q = sqrt((rho - R)^2 + z^2), rho and z taken about the axis through `center`.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n_rows,)
        The atoms; each is one row.
    center : array_like, shape (3,) or (n_rows, 3)
        Center of the circle.
    axis : array_like, shape (3,) or (n_rows, 3)
        Normal of its plane, of any length.
    major_radius : float or array_like of shape (n_rows,)
        Radius R of the circle.
    minor_radius : float, array_like, callable of time, MovingTarget or None
        Distance held; None takes the initial one.
    """

    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"center": _VECTOR, "axis": _VECTOR, "major_radius": ()}
    length_powers = {"center": 1, "major_radius": 1}
    singular = "atom {atom} lies on the axis or on the core circle of the torus: gradient undefined; move the atom"

    def __init__(
        self,
        atoms: ArrayLike,
        center: ArrayLike,
        axis: Directions,
        major_radius: PositiveLengths,
        minor_radius: Target = None,
    ) -> None:
        super().__init__(atoms, minor_radius, center=center, axis=axis, major_radius=major_radius)

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        x, y, z = r[0] - p[0], r[1] - p[1], r[2] - p[2]
        up = x * p[3] + y * p[4] + z * p[5]
        x, y, z = x - up * p[3], y - up * p[4], z - up * p[5]
        rho = sqrt(x * x + y * y + z * z)
        h = rho - p[6]
        q = sqrt(h * h + up * up)
        f, g = h / (rho * q), up / q
        out[0] = q
        out[1], out[2], out[3] = f * x + g * p[3], f * y + g * p[4], f * z + g * p[5]


class Ellipsoid(Surface):
    """Level of an ellipsoid, q = s (|y| - 1), y_i = (e_i . (r - c))/a_i; the surface is q = 0.

    n/s^2 is the sum of 1/a_i^2 over the n finite semi-axes, so that q is a length and its gradient of order one: s/a_i
    at the ends of the axes. A cylinder of radius R is one of semi-axes R, R and infinity, with q its distance from it.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n_rows,)
        The atoms; each is one row.
    center : array_like, shape (3,) or (n_rows, 3)
        Center c.
    semi_axes : array_like, shape (3,) or (n_rows, 3)
        Semi-axes a_i. An infinite one makes it a cylinder along that axis.
    rotation : array_like, shape (3, 3) or (n_rows, 3, 3), optional
        Orthonormal directions e_i of the axes, as columns; x, y, z by default.
    target : float, array_like, callable of time, MovingTarget or None
        0 holds the atoms on the ellipsoid, None on the similar one they start on.
    """

    positive = ""
    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"size": (), "center": _VECTOR, "matrix": (3, 3)}
    length_powers = {"size": 1, "center": 1, "matrix": -1}
    singular = "atom {atom} lies at the center of the ellipsoid: gradient undefined; move the atom"
    size: FloatArray  # s; the rows of the matrix are e_i/a_i

    def __init__(
        self,
        atoms: ArrayLike,
        center: ArrayLike,
        semi_axes: PositiveLengths,
        rotation: ArrayLike | None = None,
        target: Target = 0.0,
    ) -> None:
        super().__init__(atoms, target)
        inverse = self._of_each_row("semi_axes", 1.0 / np.asarray(semi_axes), _VECTOR)
        axes = self._of_each_row("rotation", np.eye(3) if rotation is None else rotation, (3, 3)).transpose(0, 2, 1)
        if np.any(np.abs(axes @ axes.transpose(0, 2, 1) - np.eye(3)) > 1e-10):
            raise InputError(
                "Ellipsoid: the columns of rotation are not orthonormal; give unit vectors at right angles",
                item="rotation",
            )
        if not np.all(inverse.any(axis=1)):
            raise InputError("Ellipsoid: a row has no finite semi-axis", item="semi_axes")
        size = np.sqrt(np.count_nonzero(inverse, axis=1) / np.square(inverse).sum(axis=1))
        self._keep(size=size, center=center, matrix=axes * inverse[:, :, None])

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        # p holds s, c and the rows of B.
        x, y, z = r[0] - p[1], r[1] - p[2], r[2] - p[3]
        a = p[4] * x + p[5] * y + p[6] * z
        b = p[7] * x + p[8] * y + p[9] * z
        c = p[10] * x + p[11] * y + p[12] * z
        length = sqrt(a * a + b * b + c * c)
        out[0] = p[0] * (length - 1.0)
        f = p[0] / length
        a, b, c = f * a, f * b, f * c
        out[1] = p[4] * a + p[7] * b + p[10] * c
        out[2] = p[5] * a + p[8] * b + p[11] * c
        out[3] = p[6] * a + p[9] * b + p[12] * c

    def scale(self, time: float = 0.0) -> FloatArray:
        return self.size


class Plane(LinearCombination):
    """Distance along a normal, q = n . r.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n_rows,)
        The atoms; each is one row.
    normal : array_like, shape (3,) or (n_rows, 3)
        Normal of the plane, of any length; n is its unit vector.
    offset : float, array_like, callable of time, MovingTarget or None
        n . r of the plane; None lets each atom keep its initial plane.
    """

    kind = RowKind.FUNCTION  # which is as fast as others of one atom, and faster than linear rows of any width
    row_width = 1

    def __init__(self, atoms: ArrayLike, normal: Directions, offset: Target = None) -> None:
        super().__init__(atoms, np.asarray(normal)[..., None, :], offset)

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        out[0], out[1], out[2], out[3] = p[0] * r[0] + p[1] * r[1] + p[2] * r[2], p[0], p[1], p[2]


class Line(LinearCombination):
    """Atoms on a straight line: two rows an atom, q = e_1 . r and e_2 . r, e_1 and e_2 normal to it.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n,)
        The atoms; each is two rows.
    point : array_like, shape (3,) or (n, 3), or None
        A point of the line; None lets each atom keep its initial line.
    direction : array_like, shape (3,) or (n, 3)
        Direction of the line, of any length.
    """

    row_width = 1

    def __init__(self, atoms: ArrayLike, point: ArrayLike | None, direction: Directions) -> None:
        column = atom_table(atoms, self.family, 1)
        along = _for_each(direction, len(column), "direction")
        # Normal to the line and to the coordinate axis it is farthest from.
        first = unit(np.cross(along, np.eye(3)[np.argmin(np.abs(along), axis=1)]), "direction")
        both = np.stack([first, np.cross(along, first)], axis=1).reshape(-1, 1, 3)
        places = None if point is None else np.repeat(_for_each(point, len(column), "point"), 2, axis=0)
        target = None if places is None else np.einsum("ki,ki->k", both[:, 0], places)
        super().__init__(np.repeat(column, 2, axis=0), both, target)


def _for_each(vectors: ArrayLike, count: int, name: str) -> FloatArray:
    array = as_float_array(vectors, name)
    if array.shape not in ((3,), (count, 3)):
        raise InputError(f"{name} has shape {array.shape}; give (3,) or ({count}, 3)", item=name)
    check_range(array, f"{name} of row {{row}}", name)
    return np.broadcast_to(array, (count, 3))
