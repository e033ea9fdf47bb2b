"""What can be held: one kind of constraint a module.

- `compilation`: compiled kernels, and where they are kept
- `arguments`, `target`, `vectors`: arrays and Quantities from outside, targets and their derivatives, arithmetic
- `constraint`: the contract of a family
- `internal`: distances and their differences, angles, dihedrals
- `linear`: fixed atoms, linear relations
- `surface`, `collective`: surfaces, groups
- `functions`: functions of one's own
- `velocity`: rows linear in the velocities
- `contradictions`: targets that exclude each other
- `periodic`: which images rows mean, and the cell
- `constraint_set`: many constraints as one sigma, A and b
- `projection`: the theory, dense and literal
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from kcons.constraints import compilation as compilation  # before any kernel is declared
from kcons.constraints.collective import CenterDistance, CenterOfMass, RadiusOfGyration
from kcons.constraints.constraint import FAMILIES, Constraint, RowKind
from kcons.constraints.functions.custom import Custom, CustomVelocity, ImplicitSurface
from kcons.constraints.functions.formula import Formula, VelocityFormula
from kcons.constraints.internal import Angle, Dihedral, Distance, DistanceDifference
from kcons.constraints.linear import FixedAtoms, LinearCombination, LinearRelation
from kcons.constraints.surface import Cylinder, Ellipsoid, Line, Plane, Sphere, Torus
from kcons.constraints.target import MovingTarget
from kcons.constraints.velocity import KnifeEdge, LinearVelocity, Rolling
from kcons.errors import InputError

__all__ = [
    "Angle",
    "CenterDistance",
    "CenterOfMass",
    "Constraint",
    "Custom",
    "CustomVelocity",
    "Cylinder",
    "Dihedral",
    "Distance",
    "DistanceDifference",
    "Ellipsoid",
    "FixedAtoms",
    "Formula",
    "ImplicitSurface",
    "KnifeEdge",
    "Line",
    "LinearCombination",
    "LinearRelation",
    "LinearVelocity",
    "MovingTarget",
    "Plane",
    "RadiusOfGyration",
    "Rolling",
    "RowKind",
    "Sphere",
    "Torus",
    "VelocityFormula",
    "from_dict",
]


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
