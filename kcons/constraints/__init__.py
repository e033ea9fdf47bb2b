"""What can be held: one family of constraints a module."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from kcons.constraints.constraint import Constraint, RowKind
from kcons.constraints.internal import Angle, Dihedral, Distance
from kcons.constraints.linear import FixedAtoms, LinearCombination, LinearRelation
from kcons.constraints.target import MovingTarget
from kcons.errors import InputError

__all__ = [
    "Angle",
    "Constraint",
    "Dihedral",
    "Distance",
    "FixedAtoms",
    "LinearCombination",
    "LinearRelation",
    "MovingTarget",
    "RowKind",
    "from_dict",
]

FAMILIES: dict[str, type[Constraint]] = {
    family.family: family for family in (Angle, Dihedral, Distance, FixedAtoms, LinearCombination, LinearRelation)
}


def from_dict(data: Mapping[str, Any]) -> Constraint:
    """Rebuild what `Constraint.todict` wrote.

    Raises
    ------
    InputError
        If the family is unknown or an entry is missing, unknown or of the wrong shape.
    """
    try:
        family = FAMILIES[data["family"]]
    except (KeyError, TypeError):
        raise InputError(
            f"no constraint family in {dict(data)!r:.80}; known are {', '.join(sorted(FAMILIES))}", item="family"
        ) from None
    return family.restored(data)
