"""The points of a scan: values of one or two coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints import Constraint
from kcons.constraints.arguments import ANGLE, LENGTH, numbers
from kcons.constraints.target import FloatArray, nearest_image
from kcons.errors import InputError, UnsupportedError

#: Number of a value along each coordinate.
Point = tuple[int, ...]

#: Values this near to each other, relative to their range, are the same.
SAME = 1e-9


class Grid:
    """All combinations of the values of one or two coordinates, in angstrom or radian, up or down.

    Of dihedrals over a whole turn the last value, which is the first one again, is left out.
    """

    def __init__(self, coordinates: Sequence[Constraint], values: Sequence[ArrayLike]) -> None:
        self.coordinates = list(coordinates)
        if not 1 <= len(self.coordinates) <= 2:
            raise InputError(f"a scan has one or two coordinates, not {len(self.coordinates)}", item="coordinates")
        if len(values) != len(self.coordinates):
            raise InputError(
                f"{len(self.coordinates)} coordinates have {len(values)} lists of values; give one list for each",
                item="values",
            )
        for item in self.coordinates:
            if item.n_rows != 1:
                raise InputError(f"{item!r} has {item.n_rows} rows; a coordinate of a scan has one", item="coordinates")
            if item.moving or not item.holonomic:
                raise UnsupportedError(f"{item!r} moves with time or holds velocities; scan a coordinate of positions")
        made = [_axis(item, given) for item, given in zip(self.coordinates, values, strict=True)]
        self.values = [axis for axis, _ in made]
        #: Whether the first value of a coordinate follows on its last.
        self.rings = [ring for _, ring in made]

    @property
    def names(self) -> list[str]:
        return [item.row_name(0) for item in self.coordinates]

    @property
    def keys(self) -> list[str]:
        """Names without blanks for files: 'dihedral_0_1_2_3'."""
        found = ["_".join([item.family.lower(), *map(str, item.atoms[0].tolist()[:6])]) for item in self.coordinates]
        return [key + (f"_{n}" if key in found[:n] else "") for n, key in enumerate(found)]

    @property
    def in_degrees(self) -> list[bool]:
        """Which coordinates are angles, shown in degrees."""
        return [item.held == ANGLE for item in self.coordinates]

    @property
    def shape(self) -> Point:
        return tuple(len(axis) for axis in self.values)

    @property
    def points(self) -> list[Point]:
        return list(product(*map(range, self.shape)))

    def at(self, point: Point) -> list[float]:
        """The values at a point."""
        return [float(axis[n]) for axis, n in zip(self.values, point, strict=True)]

    def shown(self, point: Point) -> list[float]:
        """The values at a point, angles in degrees."""
        return [float(np.degrees(v)) if turn else v for v, turn in zip(self.at(point), self.in_degrees, strict=True)]

    def said(self, point: Point) -> str:
        """For messages: 'Dihedral(0, 1, 2, 3) = 30'."""
        return ", ".join(f"{name} = {v:.6g}" for name, v in zip(self.names, self.shown(point), strict=True))

    @property
    def units(self) -> list[str]:
        """Of the values as they are shown; formulas and functions have their own."""
        return [{ANGLE: "degrees", LENGTH: "angstrom"}.get(item.held, "own unit") for item in self.coordinates]

    def held_at(self, point: Point) -> list[Constraint]:
        """The coordinates with their values at a point as targets."""
        return [item.with_target(v) for item, v in zip(self.coordinates, self.at(point), strict=True)]

    def neighbors(self, point: Point) -> list[Point]:
        """One value further along one coordinate, either way."""
        found = []
        for axis, (n, size, ring) in enumerate(zip(point, self.shape, self.rings, strict=True)):
            for other in (n + 1, n - 1):
                if ring:
                    other %= size
                if 0 <= other < size and other != n:
                    found.append((*point[:axis], other, *point[axis + 1 :]))
        return list(dict.fromkeys(found))

    def apart(self, point: Point, place: Sequence[float]) -> float:
        """How far a point is from values, in steps of the grid."""
        off = np.subtract(self.at(point), place)
        steps = [float(np.diff(axis).mean()) if len(axis) > 1 else 1.0 for axis in self.values]
        periods = np.array([item.period or 0.0 for item in self.coordinates])
        return float(np.linalg.norm(nearest_image(off, periods) / steps))


def _axis(item: Constraint, given: ArrayLike) -> tuple[FloatArray, bool]:
    name = item.row_name(0)
    axis = np.atleast_1d(np.array(numbers(given, f"values of {name}")))
    if axis.ndim != 1 or not len(axis) or not np.isfinite(axis).all():
        raise InputError(f"the values of {name} are not a list of finite numbers", item="values")
    ring, span = False, float(np.ptp(axis))
    if np.diff(np.sort(axis)).min(initial=np.inf) <= SAME * span:
        raise InputError(f"two values of {name} are the same; give each once", item="values")
    if len(set(np.sign(np.diff(axis)).tolist())) > 1:
        raise InputError(f"the values of {name} go up and down; give them in order", item="values")
    if item.period is not None and len(axis) > 1:
        if span > item.period * (1 + SAME):
            raise InputError(
                f"the values of {name} span more than its period, {item.period:.6g}; give one turn", item="values"
            )
        if span > item.period * (1 - SAME):
            axis = axis[:-1]
        ring = len(axis) > 2 and item.period - float(np.ptp(axis)) <= 1.5 * float(np.abs(np.diff(axis)).max())
    return axis, ring
