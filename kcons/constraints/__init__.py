"""What can be held: one kind of constraint a module.

- `compilation`: compiled kernels, and where they are kept
- `arguments`, `target`, `vectors`: arrays and Quantities from outside, targets and their derivatives, arithmetic
- `constraint`: the contract of a family
- `surface`: fixed atoms, linear relations, surfaces
- `internal`: distances and their differences, angles, dihedrals, groups
- `functions`: functions of one's own
- `periodic`: which images rows mean
- `constraint_set`: many constraints as one sigma, A and b, in their cell
- `projection`: the theory, dense and literal
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from kcons.constraints import internal, surface
from kcons.constraints.constraint import FAMILIES, Constraint, RowKind
from kcons.constraints.functions import custom, formula
from kcons.constraints.functions.custom import *
from kcons.constraints.functions.formula import *
from kcons.constraints.internal import *
from kcons.constraints.surface import *
from kcons.constraints.target import MovingTarget
from kcons.errors import InputError

__all__ = ["Constraint", "MovingTarget", "RowKind", "from_dict"]
__all__ += internal.__all__ + surface.__all__ + custom.__all__ + formula.__all__


def from_dict(data: Mapping[str, Any]) -> Constraint:
    """Rebuild what `Constraint.todict` wrote.

    Raises
    ------
    InputError
        If the family is unknown or an entry is missing or unknown.
    """
    try:
        family = FAMILIES[data["family"]]
    except (KeyError, TypeError, IndexError, ValueError):
        raise InputError(
            f"no constraint family in {data!r:.80}; known are {', '.join(sorted(FAMILIES))}", item="family"
        ) from None
    return family.restored(data)
