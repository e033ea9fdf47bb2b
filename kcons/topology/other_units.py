"""Constraints in another unit of length: what is held in angstrom, given to an MD engine that counts in nanometers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

import numpy as np

from kcons.constraints import Constraint
from kcons.constraints.arguments import read_only
from kcons.errors import UnsupportedError

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
    powers = dict(constraint.held.exponents or {"unknown": 1})
    if constraint.moving or not powers.keys() <= {"length", "angle"}:
        what = "a target that moves" if constraint.moving else "own functions or velocities"
        raise UnsupportedError(
            f"{constraint!r} has {what}; it cannot be converted to another unit. Write it in the units of the host"
        )
    own = {name: getattr(constraint, name) * factor**power for name, power in constraint.length_powers.items()}
    if constraint.target is not None:
        own["target"] = np.asarray(constraint.target) * factor ** powers.get("length", 0)
    copy = constraint.changed(**{name: read_only(array) for name, array in own.items()})
    copy._settle()
    return copy


def all_rescaled(constraints: Iterable[Constraint], factor: float) -> list[Constraint]:
    """`rescaled` for each."""
    return [rescaled(item, factor) for item in constraints]
