"""Constraints in another unit of length: what is held in angstrom, given to an MD engine that counts in nanometers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

import numpy as np

from kcons.constraints import Constraint
from kcons.errors import UnsupportedError

#: Families whose targets are lengths or positions, those whose targets are angles, and what else has a length.
_LENGTHS = {
    "Distance", "DistanceDifference", "CenterDistance", "CenterOfMass", "RadiusOfGyration", "LinearCombination",
    "LinearRelation", "FixedAtoms", "Plane", "Line", "Sphere", "Cylinder", "Torus", "Ellipsoid",
}  # fmt: skip
_ANGLES = {"Angle", "Dihedral"}
_DATA = {"center": 1, "point": 1, "major_radius": 1, "inverse_axes": -1}

C = TypeVar("C", bound=Constraint)


def rescaled(constraint: C, factor: float) -> C:
    """The same constraint where every length is a number larger by `factor` (0.1 from angstrom to nm).

    Raises
    ------
    UnsupportedError
        Own functions, velocity rows, targets that move with time: what they mean in another unit is not known.
    """
    if factor == 1.0:
        return constraint
    if constraint.moving or constraint.family not in _LENGTHS | _ANGLES:
        what = "a target that moves" if constraint.moving else "own functions or velocities"
        raise UnsupportedError(
            f"{constraint!r} has {what}; it cannot be converted to another unit. Write it in the units of the host"
        )
    copy = constraint.with_target(None)
    if constraint.target is not None:
        target = np.asarray(constraint.target)
        copy.target = target.copy() if constraint.family in _ANGLES else target * factor
    for name, power in _DATA.items():
        if name in constraint.per_row:
            setattr(copy, name, getattr(constraint, name) * factor**power)
    copy._settle()
    return copy


def all_rescaled(constraints: Iterable[Constraint], factor: float) -> list[Constraint]:
    """`rescaled` for each."""
    return [rescaled(item, factor) for item in constraints]
