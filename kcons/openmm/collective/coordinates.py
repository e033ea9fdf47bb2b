"""Forces as coordinates: what their energies are, which atoms they touch, and a force group for each."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import openmm
from openmm import unit

from kcons.constraints import Angle, CenterDistance, Dihedral, Distance
from kcons.constraints.constraint import Constraint
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.openmm.integrator.guard import ROW_NAME, forces_alone, groups_of
from kcons.openmm.quantities import energy_of, nanometers, number


@dataclass(frozen=True, eq=False)
class Row:
    """A Force as one row: its energy, as a plain number, is the coordinate q held at its target.

    Lengths are in nm and angles in radian, whatever the expression of the Force makes of them.

    Parameters
    ----------
    force : openmm.Force
        A Force that is in no System yet, or one of the System.
    target : float, Quantity or None
        What q is held at, a Quantity in a unit of its kind; None takes the value at the initial positions.
    rate : float or Quantity
        Change of the target in a ps: the target is target + rate t, t the time since the integrator was made, which
        States and checkpoints with the integrator's parameters carry to another one with the same program, and to no
        other.
    period : float or Quantity, optional
        Period of q; differences are taken to the nearest image. Found where the coordinate is a plain dihedral.
    name : str, optional
        For messages.
    """

    force: openmm.Force
    target: float | unit.Quantity | None = None
    rate: float | unit.Quantity = 0.0
    period: float | unit.Quantity | None = None
    name: str = ""


def finite_number(value: Any, item: str, of: unit.Unit | None = None, per: unit.Unit = unit.dimensionless) -> float:
    """A finite number in nm, ps, radian, kJ/mol from a number or a Quantity; `InputError` for others.

    A Quantity must be of unit `of` over `per`; if that is not known, of what is made of lengths, angles, masses,
    charges and energies, over `per`.
    """
    if of is None and unit.is_quantity(value):
        if not _may_be_a_coordinate(value.unit * per):
            raise InputError(
                f"{item} is {value}, and the coordinate is of another kind; give it in nm, radian, kJ/mol or what the "
                "coordinate is in",
                item=item,
            )
        value = value.value_in_unit_system(unit.md_unit_system)
    result = number(value, (unit.dimensionless if of is None else of) / per, item)
    if not math.isfinite(result):
        raise InputError(f"{item} is {result}; give a finite number", item=item)
    return result


def _may_be_a_coordinate(of: unit.Unit) -> bool:
    """Whether Forces can have such energies: time is there only as a part of energies."""
    powers = {dimension.name: power for dimension, power in of.iter_base_dimensions() if power}
    mass, time = powers.pop("mass", 0), powers.pop("time", 0)
    return powers.keys() <= {"length", "angle", "amount", "charge"} and time in (0, -2 * mass)


# -- terms ------------------------------------------------------------------------------------------

#: For Forces made of terms: what a term is called, and how many of its parameters are particles.
_TERMS = {
    "CustomBondForce": ("Bond", 2),
    "CustomAngleForce": ("Angle", 3),
    "CustomTorsionForce": ("Torsion", 4),
    "CustomCompoundBondForce": ("Bond", 0),
    "CustomCentroidBondForce": ("Bond", 0),
    "CustomExternalForce": ("Particle", 1),
    "HarmonicBondForce": ("Bond", 2),
    "HarmonicAngleForce": ("Angle", 3),
    "PeriodicTorsionForce": ("Torsion", 4),
    "RBTorsionForce": ("Torsion", 4),
}


def _terms(force: openmm.Force) -> list[Any]:
    """The parameters of each term of a Force that is made of terms."""
    term, _ = _TERMS[type(force).__name__]
    return [getattr(force, f"get{term}Parameters")(k) for k in range(getattr(force, f"getNum{term}s")())]


def _variables(force: openmm.CustomCVForce) -> list[openmm.Force]:
    return [force.getCollectiveVariable(k) for k in range(force.getNumCollectiveVariables())]


def _atoms_of(force: openmm.Force) -> set[int] | None:
    """The particles a Force depends on; None where that cannot be told, or where it is all of them."""
    if isinstance(force, openmm.CustomCVForce):
        found = [_atoms_of(variable) for variable in _variables(force)]
        return None if None in found else set().union(*found)  # type: ignore[arg-type]
    if isinstance(force, openmm.CustomCentroidBondForce):
        return {atom for groups, *_ in _terms(force) for g in groups for atom in force.getGroupParameters(g)[0]}
    if isinstance(force, openmm.CustomCompoundBondForce):
        return {int(atom) for atoms, *_ in _terms(force) for atom in atoms}
    if isinstance(force, openmm.RMSDForce | openmm.RGForce):
        return set(force.getParticles()) or None
    kind = type(force).__name__
    return {int(a) for term in _terms(force) for a in term[: _TERMS[kind][1]]} if kind in _TERMS else None


def moved_atoms(system: openmm.System, force: openmm.Force) -> set[int]:
    """The particles whose positions determine a Force; all where that cannot be told. `InputError` for others."""
    atoms, every = _atoms_of(force), set(range(system.getNumParticles()))
    if atoms is not None and atoms - every:
        raise InputError(
            f"{force.getName()} names particle {min(atoms - every)}; the System has {len(every)} particles",
            item="force",
            atoms=sorted(atoms - every),
        )
    return every if atoms is None else atoms


# -- coordinates that are plain ---------------------------------------------------------------------

_LENGTH = re.compile(r"^(r|x|y|z|distance\([pg]\d+,[pg]\d+\)|pointdistance\(.*\))$")
_ANGLE = re.compile(r"^(theta|(angle|dihedral)\([pg]\d+(,[pg]\d+)*\)|pointangle\(.*\)|pointdihedral\(.*\))$")
_DIHEDRAL = re.compile(r"^dihedral\([pg]\d+,[pg]\d+,[pg]\d+,[pg]\d+\)$")
_CONSTRAINTS: dict[tuple[str, str], Any] = {
    ("CustomBondForce", "r"): Distance,
    ("CustomAngleForce", "theta"): Angle,
    ("CustomTorsionForce", "theta"): Dihedral,
    ("CustomCompoundBondForce", "distance(p1,p2)"): Distance,
    ("CustomCompoundBondForce", "angle(p1,p2,p3)"): Angle,
    ("CustomCompoundBondForce", "dihedral(p1,p2,p3,p4)"): Dihedral,
    ("CustomCentroidBondForce", "distance(g1,g2)"): CenterDistance,
}


def _plain(force: openmm.Force) -> tuple[openmm.Force, str]:
    """A Force and its expression; of a CustomCVForce that is one of its variables, that variable's."""
    expression = force.getEnergyFunction().replace(" ", "") if hasattr(force, "getEnergyFunction") else ""
    if isinstance(force, openmm.CustomCVForce):
        names = [force.getCollectiveVariableName(k) for k in range(force.getNumCollectiveVariables())]
        return _plain(_variables(force)[names.index(expression)]) if expression in names else (force, "")
    return force, expression


def period_of(force: openmm.Force) -> float:
    """2 pi where the coordinate is a dihedral and nothing else, 0 for no period."""
    force, expression = _plain(force)
    kind = type(force).__name__
    torsion = kind == "CustomTorsionForce" and expression == "theta"
    points = kind in ("CustomCompoundBondForce", "CustomCentroidBondForce") and _DIHEDRAL.match(expression)
    return 2 * math.pi if (torsion or points) and len(_terms(force)) == 1 else 0.0


def unit_of(force: openmm.Force) -> unit.Unit | None:
    """Unit of the coordinate that a Force is, None where that cannot be told."""
    force, expression = _plain(force)
    if isinstance(force, openmm.RMSDForce | openmm.RGForce) or _LENGTH.match(expression):
        return unit.nanometer
    if _ANGLE.match(expression):
        return unit.radian
    return None if type(force).__name__.startswith(("Custom", "Python")) else unit.kilojoule_per_mole


def as_constraint(force: openmm.Force, target: float) -> Constraint | None:
    """The constraint of kcons that a Force of one plain term is, at a target in nm or radian; None if it is none."""
    force, expression = _plain(force)
    kind = _CONSTRAINTS.get((type(force).__name__, expression))
    terms = _terms(force) if kind is not None else []
    if kind is None or len(terms) != 1:
        return None
    if isinstance(force, openmm.CustomCentroidBondForce):
        groups = [force.getGroupParameters(g) for g in terms[0][0]]
        if any(weights for _, weights in groups):  # by mass without them, as in kcons
            return None
        return kind(*(list(atoms) for atoms, _ in groups), target)  # type: ignore[no-any-return]
    compound = isinstance(force, openmm.CustomCompoundBondForce)
    return kind(list(terms[0][0] if compound else terms[0][: _TERMS[type(force).__name__][1]]), target)


# -- force groups -----------------------------------------------------------------------------------


def free_groups(system: openmm.System, count: int, what: str, remedy: str = "use fewer groups for forces") -> list[int]:
    """The force groups that no force of the System uses, from 1 on; `UnsupportedError` if `what` needs more."""
    taken: set[int] = set().union(*(groups_of(force) for force in system.getForces()))
    free = sorted(set(range(1, 32)) - taken)
    if len(free) < count:
        raise UnsupportedError(
            f"{what} need {count} force groups, and {len(free)} are free ({sorted(taken)} are in use); {remedy}"
        )
    return free


def put_in_groups(system: openmm.System, forces: Sequence[openmm.Force]) -> list[int]:
    """Give each Force a group of its own, and add those that are in no System, by the name of rows; returns groups.

    Nothing was changed where that raises: `InputError` for a Force of another System, or one that is named twice,
    `UnsupportedError` for more rows than free force groups.
    """
    present = {int(force.this): force for force in system.getForces()}
    identities = [int(force.this) for force in forces]
    settled: list[int | None] = []
    for k, (force, identity) in enumerate(zip(forces, identities, strict=True)):
        wrong = ""
        if identities.count(identity) > 1:
            wrong = f"this {type(force).__name__} is named more than once"
        elif identity not in present and not force.thisown:
            wrong = f"this {type(force).__name__} belongs to another System; give a copy of it"
        if wrong:
            raise InputError(f"row {k}: {wrong}", item="force")
        group = force.getForceGroup()
        users = [int(other.this) for other in present.values() if group in groups_of(other)]
        settled.append(group if users == [identity] and group != 0 else None)
    count = settled.count(None)
    free = free_groups(system, count, f"{count} rows", "use fewer groups for forces, or hold constraint objects")
    groups = [free.pop(0) if group is None else group for group in settled]
    for force, group, identity in zip(forces, groups, identities, strict=True):
        force.setForceGroup(group)
        if identity not in present:
            if force.getName() == type(force).__name__:
                force.setName(f"{ROW_NAME}: {force.getName()}")
            system.addForce(force)
    return groups


def found_values(system: openmm.System, forces: Sequence[openmm.Force], positions: object) -> FloatArray:
    """The energy of each Force at the given positions, shape (len(forces),); evaluated apart from all else.

    `InputError` for positions of the wrong shape, or at which a row is not a number.
    """
    context = forces_alone(system, forces)
    context.setPositions(nanometers(positions, system.getNumParticles()))  # type: ignore[arg-type]
    values = np.array([energy_of(context, {group}) for group in range(len(forces))])
    for k, value in enumerate(values):
        if not math.isfinite(value):
            raise InputError(f"row {k} is {value} at these positions", item="positions")
    return values
