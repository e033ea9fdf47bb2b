"""Atoms held on surfaces and curves.

Every surface takes one atom or many; each atom is a row of its own (two rows on a line). Coordinates are
lengths: the distance from a point, an axis, a plane or a circle, so that gradients have norm 1. They are
taken from the positions as they are: surfaces are not repeated in periodic cells.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import numpy as np
from numpy import sqrt
from numpy.typing import ArrayLike

from kcons.constraints.arguments import (
    Directions,
    FloatArray,
    Lengths,
    PositiveLengths,
    as_float_array,
    atom_column,
    check_range,
    read_only,
    unit,
)
from kcons.constraints.constraint import Constraint, Fault, RowKind
from kcons.constraints.linear import LinearRows
from kcons.constraints.target import Target
from kcons.errors import InputError

__all__ = ["Cylinder", "Ellipsoid", "Line", "Plane", "Sphere", "Torus"]

_VECTOR = (3,)


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

    def __init__(self, atoms: ArrayLike, center: Lengths, radius: Target = None) -> None:
        super().__init__(atoms, radius, center=center)

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        x, y, z = r[0] - p[0], r[1] - p[1], r[2] - p[2]
        q = sqrt(x * x + y * y + z * z)
        out[0], out[1], out[2], out[3] = q, x / q, y / q, z / q


class Cylinder(Surface):
    """Distance from an axis, q = |d - (d.n) n|, d = r - p.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n_rows,)
        The atoms; each is one row.
    point : array_like, shape (3,) or (n_rows, 3)
        A point p of the axis.
    axis : array_like, shape (3,) or (n_rows, 3)
        Direction n of the axis, of any length.
    radius : float, array_like, callable of time, MovingTarget or None
        Distance held; None takes the initial one.
    """

    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"point": _VECTOR, "axis": _VECTOR}
    length_powers = {"point": 1}
    singular = "atom {atom} lies on the axis of the cylinder: gradient undefined; move the atom"

    def __init__(self, atoms: ArrayLike, point: Lengths, axis: Directions, radius: Target = None) -> None:
        super().__init__(atoms, radius, point=point, axis=axis)

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        x, y, z = r[0] - p[0], r[1] - p[1], r[2] - p[2]
        along = x * p[3] + y * p[4] + z * p[5]
        x, y, z = x - along * p[3], y - along * p[4], z - along * p[5]
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
    major_radius: FloatArray

    def __init__(
        self,
        atoms: ArrayLike,
        center: Lengths,
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

    s is the geometric mean of the semi-axes, so that q is a length and its gradient of order one: s/a_i at
    the ends of the axes.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n_rows,)
        The atoms; each is one row.
    center : array_like, shape (3,) or (n_rows, 3)
        Center c.
    semi_axes : array_like, shape (3,) or (n_rows, 3)
        Semi-axes a_i. An infinite one makes it an elliptic cylinder along that axis.
    rotation : array_like, shape (3, 3) or (n_rows, 3, 3), optional
        Orthonormal directions e_i of the axes, as columns; x, y, z by default.
    target : float, array_like, callable of time, MovingTarget or None
        0 holds the atoms on the ellipsoid, None on the similar one they start on.
    """

    positive = ""
    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {
        "center": _VECTOR,
        "inverse_axes": _VECTOR,
        "rotation": (3, 3),
    }
    length_powers = {"center": 1, "inverse_axes": -1}
    singular = "atom {atom} lies at the center of the ellipsoid: gradient undefined; move the atom"
    center: FloatArray
    inverse_axes: FloatArray
    rotation: FloatArray

    def __init__(
        self,
        atoms: ArrayLike,
        center: Lengths,
        semi_axes: PositiveLengths,
        rotation: ArrayLike | None = None,
        target: Target = 0.0,
    ) -> None:
        super().__init__(
            atoms,
            target,
            center=center,
            inverse_axes=1.0 / np.asarray(semi_axes),
            rotation=np.eye(3) if rotation is None else rotation,
        )

    def _settle(self) -> None:
        error = self.rotation.transpose(0, 2, 1) @ self.rotation - np.eye(3)
        if np.any(np.abs(error) > 1e-10):
            raise InputError(
                "Ellipsoid: the columns of rotation are not orthonormal; give unit vectors at right angles",
                item="rotation",
            )
        finite = self.inverse_axes > 0
        if np.any(self.inverse_axes < 0) or not np.all(finite.any(axis=1)):
            raise InputError("Ellipsoid: a row has no finite positive semi-axis", item="semi_axes")

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        # y = B (r - c); p holds s, c and the rows of B = D^-1 R^T.
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

    def parameters(self) -> FloatArray:
        matrix = self.rotation.transpose(0, 2, 1) * self.inverse_axes[:, :, None]
        return np.hstack([self.scale()[:, None], self.center, matrix.reshape(self.n_rows, 9)])

    def scale(self, time: float = 0.0) -> FloatArray:
        finite = self.inverse_axes > 0
        logs = np.log(np.where(finite, self.inverse_axes, 1.0)).sum(axis=1)
        return np.asarray(np.exp(-logs / finite.sum(axis=1)))

    def faults(self, r: FloatArray, time: float) -> Iterator[Fault]:
        yield from super().faults(r, time)
        if self.target is not None:
            target, words = self.target_at(time), "lies beyond the center of the ellipsoid; use 0 for its surface"
            yield ~(target > -self.scale()), lambda k: f"target {target[k]:g} {words}", "target"


class Plane(LinearRows):
    """Distance along a normal, q = n . r.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n_rows,)
        The atoms; each is one row.
    normal : array_like, shape (3,) or (n_rows, 3)
        Normal of the plane, of any length; n is its unit vector.
    offset : float, array_like, callable of time, MovingTarget or None
        n . r of the plane.
    point : array_like, shape (3,) or (n_rows, 3), optional
        A point of the plane, instead of `offset`. Without either, each atom keeps its initial plane.
    """

    kind = RowKind.FUNCTION  # which is as fast as others of one atom, and faster than linear rows of any width
    row_width = 1

    def __init__(
        self, atoms: ArrayLike, normal: Directions, offset: Target = None, *, point: Lengths | None = None
    ) -> None:
        if offset is not None and point is not None:
            raise InputError("Plane: give either offset or point, not both", item="point")
        n = np.asarray(normal)
        super().__init__(atoms, offset, coefficients=n if n.ndim == 1 else n[:, None])
        if point is not None:
            self.target = _held(self, point)

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        out[0], out[1], out[2], out[3] = p[0] * r[0] + p[1] * r[1] + p[2] * r[2], p[0], p[1], p[2]


class Line(LinearRows):
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

    def __init__(self, atoms: ArrayLike, point: Lengths | None, direction: Directions) -> None:
        column = atom_column(atoms, self.family)
        along = _for_each(direction, len(column), "direction")
        # Normal to the line and to the coordinate axis it is farthest from.
        first = unit(np.cross(along, np.eye(3)[np.argmin(np.abs(along), axis=1)]), "direction")
        both = np.stack([first, np.cross(along, first)], axis=1).reshape(-1, 1, 3)
        super().__init__(np.repeat(column, 2, axis=0), None, coefficients=both)
        if point is not None:
            self.target = _held(self, np.repeat(_for_each(point, len(column), "point"), 2, axis=0))


def _for_each(vectors: ArrayLike, count: int, name: str) -> FloatArray:
    array = as_float_array(vectors, name)
    if array.shape not in ((3,), (count, 3)):
        raise InputError(f"{name} has shape {array.shape}; give (3,) or ({count}, 3)", item=name)
    return np.broadcast_to(array, (count, 3))


def _held(item: LinearRows, point: ArrayLike) -> FloatArray:
    points = _for_each(point, item.n_rows, "point")
    check_range(points, f"{item.family}: point of row {{row}}", "point")
    return read_only(np.asarray(np.einsum("ki,ki->k", item.coefficients[:, 0], points)))
