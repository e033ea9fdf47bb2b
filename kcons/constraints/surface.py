"""Atoms held on surfaces and curves.

Every surface takes one atom or many; each atom is a row of its own (two rows on a line). Coordinates are
lengths: the distance from a point, an axis, a plane or a circle, so that gradients have norm 1. They are
taken from the positions as they are: surfaces are not repeated in periodic cells.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import atom_array, kept, numbers, out_of_range
from kcons.constraints.constraint import Constraint, RowKind
from kcons.constraints.linear import LinearRows
from kcons.constraints.target import FloatArray, Target
from kcons.constraints.vectors import dot, first_true, norm, unit
from kcons.errors import InputError

_VECTOR = (3,)


class Surface(Constraint):
    """Rows over one atom each, q(r), with a radius as the target."""

    row_width = 1
    #: Where the gradient is undefined, for the error.
    singular_at: ClassVar[str]

    def __init__(self, atoms: ArrayLike, target: Target) -> None:
        super().__init__(atom_array(atoms, self.family).reshape(-1, 1), target)

    def _singular(self, r: FloatArray) -> FloatArray:
        """A length that vanishes where the gradient is undefined, shape (n_rows,)."""
        return self.measure(r, 0.0)

    def check(self, r: FloatArray, time: float, first_row: int) -> None:
        if self.n_rows == 0:
            return
        self.refuse_singular(
            ~(self._singular(r) > 0),
            first_row,
            lambda k, row: (
                f"atom {self.atoms[k, 0]} lies {self.singular_at}: gradient of {row}, undefined; move the atom"
            ),
        )
        self.refuse_nonpositive(time, first_row, "radius")


class Sphere(Surface):
    """Distance from a point, q = |r - c|; gradient u = (r - c)/q, curvature (|v|^2 - (u.v)^2)/q.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n_rows,)
        The atoms; each is one row.
    center : array_like, shape (3,) or (n_rows, 3)
        Centre c, for all atoms or for each.
    radius : float, array_like, callable of time, MovingTarget or None
        Distance held; None takes the initial one.

    Raises
    ------
    InputError
        Wrong shapes, numbers that are not finite, a radius that is not positive.
    SingularGeometryError
        When put into a set: an atom at the centre.

    References
    ----------
    Notes, example 4 (there with q^2).
    """

    family = "Sphere"
    kind = RowKind.FUNCTION
    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"center": _VECTOR}
    singular_at = "at the centre of the sphere"
    center: FloatArray

    def __init__(self, atoms: ArrayLike, center: ArrayLike, radius: Target = None) -> None:
        super().__init__(atoms, radius)
        self._keep(center=center)

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        return norm(r[:, 0] - self.center)

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        d = r - self.center[:, None]
        return d / norm(d)[..., None]

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        d = r[:, 0] - self.center
        q = norm(d)
        across = np.cross(d / q[:, None], v[:, 0])
        return dot(across, across) / q

    def parameters(self) -> FloatArray:
        return self.center


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

    family = "Cylinder"
    kind = RowKind.FUNCTION
    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"point": _VECTOR, "axis": _VECTOR}
    singular_at = "on the axis of the cylinder"
    point: FloatArray
    axis: FloatArray

    def __init__(self, atoms: ArrayLike, point: ArrayLike, axis: ArrayLike, radius: Target = None) -> None:
        super().__init__(atoms, radius)
        self._keep(point=point, axis=unit(axis, "axis"))

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        return norm(_across(r[:, 0] - self.point, self.axis))

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        d = _across(r[:, 0] - self.point, self.axis)
        return (d / norm(d)[:, None])[:, None]

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        d = _across(r[:, 0] - self.point, self.axis)
        q = norm(d)
        around = dot(np.cross(self.axis, d / q[:, None]), v[:, 0])
        return around**2 / q

    def parameters(self) -> FloatArray:
        return np.hstack([self.point, self.axis])


class Torus(Surface):
    """Distance from a circle, q = sqrt((rho - R)^2 + z^2), rho and z taken about the axis through `center`.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n_rows,)
        The atoms; each is one row.
    center : array_like, shape (3,) or (n_rows, 3)
        Centre of the circle.
    axis : array_like, shape (3,) or (n_rows, 3)
        Normal of its plane, of any length.
    major_radius : float or array_like of shape (n_rows,)
        Radius R of the circle.
    minor_radius : float, array_like, callable of time, MovingTarget or None
        Distance held; None takes the initial one.

    Notes
    -----
    With h = rho - R along a straight line: q' = (h rho' + z z')/q,
    q'' = (rho'^2 + h rho'' + z'^2 - q'^2)/q and rho'' = (velocity around the axis)^2/rho.
    """

    family = "Torus"
    kind = RowKind.FUNCTION
    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"center": _VECTOR, "axis": _VECTOR, "major_radius": ()}
    singular_at = "on the axis or on the core circle of the torus"
    center: FloatArray
    axis: FloatArray
    major_radius: FloatArray

    def __init__(
        self,
        atoms: ArrayLike,
        center: ArrayLike,
        axis: ArrayLike,
        major_radius: ArrayLike,
        minor_radius: Target = None,
    ) -> None:
        super().__init__(atoms, minor_radius)
        self._keep(center=center, axis=unit(axis, "axis"), major_radius=major_radius)
        self._settle()

    def _settle(self) -> None:
        _positive(self, "major_radius", self.major_radius)

    def _parts(self, r: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """h = rho - R, z, and the vector of length rho from the axis."""
        d = r[:, 0] - self.center
        outward = _across(d, self.axis)
        return norm(outward) - self.major_radius, dot(d, self.axis), outward

    def _singular(self, r: FloatArray) -> FloatArray:
        return np.minimum(norm(self._parts(r)[2]), self.measure(r, 0.0))

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        h, z, _ = self._parts(r)
        return np.hypot(h, z)

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        h, z, outward = self._parts(r)
        q = np.hypot(h, z)
        e = outward / norm(outward)[:, None]
        return ((h / q)[:, None] * e + (z / q)[:, None] * self.axis)[:, None]

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        h, z, outward = self._parts(r)
        q, rho = np.hypot(h, z), norm(outward)
        e = outward / rho[:, None]
        radial, up = dot(e, v[:, 0]), dot(self.axis, v[:, 0])
        around = dot(np.cross(self.axis, e), v[:, 0])
        # rho'^2 + z'^2 - q'^2 is the square of the velocity around the tube.
        twist = (h * up - z * radial) / q
        return (twist**2 + h * around**2 / rho) / q

    def parameters(self) -> FloatArray:
        return np.hstack([self.center, self.axis, self.major_radius[:, None]])


class Ellipsoid(Constraint):
    """Level of an ellipsoid, q = s (|y| - 1), y_i = (e_i . (r - c))/a_i; the surface is q = 0.

    s is the geometric mean of the semi-axes, so that q is a length and its gradient of order one: s/a_i at
    the ends of the axes.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n_rows,)
        The atoms; each is one row.
    center : array_like, shape (3,) or (n_rows, 3)
        Centre c.
    semi_axes : array_like, shape (3,) or (n_rows, 3)
        Semi-axes a_i. An infinite one makes it an elliptic cylinder along that axis.
    rotation : array_like, shape (3, 3) or (n_rows, 3, 3), optional
        Orthonormal directions e_i of the axes, as columns; x, y, z by default.
    target : float, array_like, callable of time, MovingTarget or None
        0 holds the atoms on the ellipsoid, None on the similar one they start on.
    """

    family = "Ellipsoid"
    row_width = 1
    kind = RowKind.FUNCTION
    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {
        "center": _VECTOR,
        "inverse_axes": _VECTOR,
        "rotation": (3, 3),
    }
    center: FloatArray
    inverse_axes: FloatArray
    rotation: FloatArray

    def __init__(
        self,
        atoms: ArrayLike,
        center: ArrayLike,
        semi_axes: ArrayLike,
        rotation: ArrayLike | None = None,
        target: Target = 0.0,
    ) -> None:
        super().__init__(atom_array(atoms, self.family).reshape(-1, 1), target)
        axes = numbers(semi_axes, "semi_axes")
        if not np.all(axes > 0):
            raise InputError(f"Ellipsoid: semi-axes must be positive, not {axes}", item="semi_axes")
        self._keep(center=center, inverse_axes=1.0 / axes, rotation=np.eye(3) if rotation is None else rotation)
        self._settle()

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

    @property
    def _size(self) -> FloatArray:
        """s, shape (n_rows,)."""
        finite = self.inverse_axes > 0
        logs = np.log(np.where(finite, self.inverse_axes, 1.0)).sum(axis=1)
        return np.asarray(np.exp(-logs / finite.sum(axis=1)))

    def _scaled(self, d: FloatArray) -> FloatArray:
        """D^-1 R^T d."""
        return np.asarray(np.einsum("kji,kj->ki", self.rotation, d)) * self.inverse_axes

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        return self._size * (norm(self._scaled(r[:, 0] - self.center)) - 1.0)

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        y = self._scaled(r[:, 0] - self.center)
        slope = y * self.inverse_axes * (self._size / norm(y))[:, None]
        return np.asarray(np.einsum("kji,ki->kj", self.rotation, slope))[:, None]

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        y, w = self._scaled(r[:, 0] - self.center), self._scaled(v[:, 0])
        length = norm(y)
        across = np.cross(y / length[:, None], w)
        return self._size * dot(across, across) / length

    def parameters(self) -> FloatArray:
        matrix = self.rotation.transpose(0, 2, 1) * self.inverse_axes[:, :, None]
        return np.hstack([self._size[:, None], self.center, matrix.reshape(self.n_rows, 9)])

    def scale(self, time: float = 0.0) -> FloatArray:
        return self._size

    def check(self, r: FloatArray, time: float, first_row: int) -> None:
        self.refuse_singular(
            norm(self._scaled(r[:, 0] - self.center)) == 0,
            first_row,
            lambda k, row: (
                f"atom {self.atoms[k, 0]} lies at the centre of the ellipsoid: gradient of {row}, undefined; "
                "move the atom"
            ),
        )
        if self.target is None:
            return
        target = self.target_at(time)
        self.refuse_input(
            ~(target > -self._size),
            first_row,
            lambda k: f"target {target[k]:g} lies beyond the centre of the ellipsoid; use 0 for its surface",
            "target",
        )


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

    family = "Plane"
    kind = RowKind.FUNCTION
    row_width = 1

    def __init__(
        self, atoms: ArrayLike, normal: ArrayLike, offset: Target = None, *, point: ArrayLike | None = None
    ) -> None:
        if offset is not None and point is not None:
            raise InputError("Plane: give either offset or point, not both", item="point")
        super().__init__(atom_array(atoms, self.family).reshape(-1, 1), offset)
        n = unit(normal, "normal")
        self._keep(coefficients=n if n.ndim == 1 else n[:, None])
        self._settle()
        if point is not None:
            self.target = _held(self, point)


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

    family = "Line"
    row_width = 1

    def __init__(self, atoms: ArrayLike, point: ArrayLike | None, direction: ArrayLike) -> None:
        column = atom_array(atoms, self.family).reshape(-1, 1)
        super().__init__(np.repeat(column, 2, axis=0), None)
        along = _for_each(unit(direction, "direction"), len(column), "direction")
        # Normal to the line and to the coordinate axis it is farthest from.
        first = unit(np.cross(along, np.eye(3)[np.argmin(np.abs(along), axis=1)]), "direction")
        self._keep(coefficients=np.stack([first, np.cross(along, first)], axis=1).reshape(-1, 1, 3))
        self._settle()
        if point is not None:
            self.target = _held(self, np.repeat(_for_each(point, len(column), "point"), 2, axis=0))


def _across(d: FloatArray, axis: FloatArray) -> FloatArray:
    """Part of d normal to the unit axis."""
    return np.cross(axis, np.cross(d, axis))


def _for_each(vectors: ArrayLike, count: int, name: str) -> FloatArray:
    array = numbers(vectors, name)
    if array.shape not in ((3,), (count, 3)):
        raise InputError(f"{name} has shape {array.shape}; give (3,) or ({count}, 3)", item=name)
    return np.broadcast_to(array, (count, 3))


def _held(item: LinearRows, point: ArrayLike) -> FloatArray:
    points = _for_each(point, item.n_rows, "point")
    wrong = out_of_range(points)
    if wrong is not None:
        raise InputError(f"{item.family}: point is {wrong[1]}", item="point")
    return kept(np.asarray(np.einsum("ki,ki->k", item.coefficients[:, 0], points)))


def _positive(item: Constraint, name: str, values: FloatArray) -> None:
    k = first_true(~(values > 0))
    if k is not None:
        raise InputError(
            f"{item.row_name(k)}: {name} {values[k]:g} is not positive", item=name, atoms=item.atoms[k].tolist()
        )
