"""Forces as rows: which atoms they touch, their terms one by one, and force groups for them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import openmm
from openmm import unit

from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.openmm.integrator.system_checks import ROW_NAME, groups_of
from kcons.openmm.quantities import nanometers

#: Force groups of OpenMM.
GROUPS = 32


@dataclass(frozen=True, eq=False)
class Row:
    """A Force as one row: its energy, as a plain number, is the coordinate q held at its target.

    Lengths are in nm and angles in radian, whatever the expression of the Force makes of them.

    Parameters
    ----------
    force : openmm.Force or int
        A Force that is in no System yet, or one of the System, or the number of a force group of the System whose
        Forces together are the coordinate.
    target : float, Quantity, str or None
        What q is held at, a Quantity in a unit of its kind; None takes the value at the initial positions. A name
        stands for a context parameter.
    rate : float, Quantity or str
        Change of the target in a ps. With a number or None as target, the target is that + rate t, t the time
        since the integrator was made, which States and checkpoints with the integrator's parameters carry to another
        one with the same program, and to no other. With a name as target whoever sets that changes it; the rate (a
        number or another name) then says how fast, so that velocities follow.
    period : float or Quantity, optional
        Period of q; differences are taken to the nearest image. Found where the coordinate is a plain dihedral.
    scale : float or Quantity, optional
        The tolerance is relative to this size; the larger of 1 and the target unless given.
    name : str, optional
        For messages.
    """

    force: openmm.Force | int
    target: float | unit.Quantity | str | None = None
    rate: float | unit.Quantity | str = 0.0
    period: float | unit.Quantity | None = None
    scale: float | unit.Quantity | None = None
    name: str = ""


def number(value: object, item: str, of: unit.Unit | None = None, per: unit.Unit = unit.dimensionless) -> float:
    """A finite number in nm, ps, radian, kJ/mol from a number or a Quantity.

    Parameters
    ----------
    value : float or Quantity
    item : str
        For messages.
    of : Unit, optional
        What a Quantity must be a multiple of; if that is not known, of what is made of lengths, angles, masses, charges
        and energies.
    per : Unit
        What that is divided by.

    Raises
    ------
    InputError
        It is neither, not finite, or of another unit.
    """
    if unit.is_quantity(value):
        fits = _may_be_a_coordinate(value.unit * per) if of is None else value.unit.is_compatible(of / per)  # type: ignore[attr-defined]
        if not fits:
            wanted = f"in {of / per}" if of is not None else "in nm, radian, kJ/mol or what the coordinate is in"
            raise InputError(f"{item} is {value}, and the coordinate is of another kind; give it {wanted}", item=item)
        value = value.value_in_unit_system(unit.md_unit_system)  # type: ignore[attr-defined]
    try:
        result = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise InputError(f"{item} is {value!r}; give a number or a Quantity", item=item) from None
    if not math.isfinite(result):
        raise InputError(f"{item} is {result}; give a finite number", item=item)
    return result


def _may_be_a_coordinate(of: unit.Unit) -> bool:
    """Whether Forces can have such energies: time is there only as a part of energies."""
    powers = {dimension.name: power for dimension, power in of.iter_base_dimensions() if power}
    mass, time = powers.pop("mass", 0), powers.pop("time", 0)
    return powers.keys() <= {"length", "angle", "amount", "charge"} and time in (0, -2 * mass)


# -- terms ------------------------------------------------------------------------------------------

#: For Forces made of terms: how many there are, the parameters of one, and the method that adds one.
_TERMS: dict[str, tuple[str, str, str]] = {
    "CustomBondForce": ("getNumBonds", "getBondParameters", "addBond"),
    "CustomAngleForce": ("getNumAngles", "getAngleParameters", "addAngle"),
    "CustomTorsionForce": ("getNumTorsions", "getTorsionParameters", "addTorsion"),
    "CustomCompoundBondForce": ("getNumBonds", "getBondParameters", "addBond"),
    "CustomCentroidBondForce": ("getNumBonds", "getBondParameters", "addBond"),
    "CustomExternalForce": ("getNumParticles", "getParticleParameters", "addParticle"),
    "HarmonicBondForce": ("getNumBonds", "getBondParameters", "addBond"),
    "HarmonicAngleForce": ("getNumAngles", "getAngleParameters", "addAngle"),
    "PeriodicTorsionForce": ("getNumTorsions", "getTorsionParameters", "addTorsion"),
    "RBTorsionForce": ("getNumTorsions", "getTorsionParameters", "addTorsion"),
}


def each_term(force: openmm.Force) -> list[openmm.Force]:
    """One Force for each variable of a CustomCVForce, or for each term of a Force made of terms.

    So a CustomBondForce with three bonds becomes three rows.

    Parameters
    ----------
    force : openmm.Force
        CustomCVForce (its energy expression plays no part), CustomBond-, CustomAngle-, CustomTorsion-,
        CustomCompoundBond-, CustomCentroidBond-, CustomExternalForce, HarmonicBond-, HarmonicAngle-,
        PeriodicTorsion- or RBTorsionForce. It is left as it is.

    Raises
    ------
    UnsupportedError
        The Force is none of these.
    """
    if isinstance(force, openmm.CustomCVForce):
        return [deepcopy(force.getCollectiveVariable(k)) for k in range(force.getNumCollectiveVariables())]
    kind = type(force).__name__
    if kind not in _TERMS:
        raise UnsupportedError(f"a {kind} has no terms to hold one by one; make a Force for each row")
    count, get, add = _TERMS[kind]
    terms = []
    for k in range(getattr(force, count)()):
        parameters = getattr(force, get)(k)
        term = _emptied(force, count)
        getattr(term, add)(*parameters)
        terms.append(term)
    return terms


def _emptied(force: openmm.Force, count: str) -> openmm.Force:
    """The Force without its terms; OpenMM has no method for that, but its XML has a list of them."""
    xml = openmm.XmlSerializer.serialize(force)
    tag = count.removeprefix("getNum")
    emptied, replaced = re.subn(rf"<{tag}>.*?</{tag}>", f"<{tag}/>", xml, count=1, flags=re.DOTALL)
    result = openmm.XmlSerializer.deserialize(emptied if replaced else xml)
    assert getattr(result, count)() == 0
    return result


# -- atoms ------------------------------------------------------------------------------------------


def atoms_of(force: openmm.Force) -> set[int] | None:
    """The particles a Force depends on; None where that cannot be told, or where it is all of them."""
    if isinstance(force, openmm.CustomCVForce):
        return _united(atoms_of(force.getCollectiveVariable(k)) for k in range(force.getNumCollectiveVariables()))
    if isinstance(force, openmm.CustomCentroidBondForce):
        bonds = [force.getBondParameters(k)[0] for k in range(force.getNumBonds())]
        return {atom for groups in bonds for g in groups for atom in force.getGroupParameters(g)[0]}
    if isinstance(force, openmm.RMSDForce | openmm.RGForce):
        return set(force.getParticles()) or None
    kind = type(force).__name__
    if kind not in _TERMS:
        return None
    count, get, _ = _TERMS[kind]
    atoms: set[int] = set()
    for k in range(getattr(force, count)()):
        for entry in _leading_atoms(force, getattr(force, get)(k)):
            atoms.add(int(entry))
    return atoms


def _leading_atoms(force: openmm.Force, parameters: Sequence) -> Sequence:
    if isinstance(force, openmm.CustomCompoundBondForce):
        return parameters[0]
    name = type(force).__name__
    width = 1 if "External" in name else 2 if "Bond" in name else 3 if "Angle" in name else 4
    return parameters[:width]


def _united(sets: Iterable[set[int] | None]) -> set[int] | None:
    united: set[int] = set()
    for atoms in sets:
        if atoms is None:
            return None
        united |= atoms
    return united


def moved_atoms(system: openmm.System, forces: Sequence[openmm.Force]) -> set[int]:
    """The particles whose positions determine the sum of the Forces; all where that cannot be told.

    Raises
    ------
    InputError
        One is not in the System.
    """
    atoms, every = _united(atoms_of(force) for force in forces), set(range(system.getNumParticles()))
    if atoms is not None and atoms - every:
        raise InputError(
            f"{forces[0].getName()} names particle {min(atoms - every)}; the System has {len(every)} particles",
            item="force",
            atoms=sorted(atoms - every),
        )
    return every if atoms is None else atoms


class Rigid:
    """The bodies that the constraints of a System make of its atoms."""

    def __init__(self, system: openmm.System) -> None:
        self._parent: dict[int, int] = {}
        for k in range(system.getNumConstraints()):
            i, j, _ = system.getConstraintParameters(k)
            a, b = self._root(i), self._root(j)
            self._parent[a] = b

    def _root(self, atom: int) -> int:
        root = atom
        while (up := self._parent.setdefault(root, root)) != root:
            root = up
        while (up := self._parent[atom]) != root:
            self._parent[atom] = root
            atom = up
        return root

    def holds(self, atoms: set[int]) -> bool:
        """Whether any of the atoms is constrained."""
        return any(atom in self._parent for atom in atoms)

    def bodies(self, atoms: set[int]) -> set[int]:
        """A number for each body that the atoms belong to, its own for an atom that nothing holds."""
        return {self._root(atom) if atom in self._parent else atom for atom in atoms}


# -- periods ----------------------------------------------------------------------------------------

_DIHEDRAL = re.compile(r"^(theta|dihedral\([pg]\d+,[pg]\d+,[pg]\d+,[pg]\d+\))$")


def period_of(force: openmm.Force) -> float:
    """2 pi where the coordinate is a dihedral and nothing else, 0 for no period."""
    if isinstance(force, openmm.CustomCVForce):
        names = [force.getCollectiveVariableName(k) for k in range(force.getNumCollectiveVariables())]
        expression = force.getEnergyFunction().replace(" ", "")
        return period_of(force.getCollectiveVariable(names.index(expression))) if expression in names else 0.0
    expressive = openmm.CustomTorsionForce | openmm.CustomCompoundBondForce | openmm.CustomCentroidBondForce
    if not isinstance(force, expressive):
        return 0.0
    bonds = force.getNumTorsions() if isinstance(force, openmm.CustomTorsionForce) else force.getNumBonds()
    plain = _DIHEDRAL.match(force.getEnergyFunction().replace(" ", ""))
    return 2 * math.pi if plain and bonds == 1 else 0.0


# -- units ------------------------------------------------------------------------------------------

#: Kinds of Forces whose value, or one of whose expressions, says what it is.
_LENGTHS = re.compile(r"^(r|x|y|z|distance\([pg]\d+,[pg]\d+\)|pointdistance\(.*\))$")
_ANGLES = re.compile(r"^(theta|(angle|dihedral)\([pg]\d+(,[pg]\d+)*\)|pointangle\(.*\)|pointdihedral\(.*\))$")


def unit_of(force: openmm.Force) -> unit.Unit | None:
    """Unit of the coordinate that a Force is, None where that cannot be told."""
    if isinstance(force, openmm.RMSDForce | openmm.RGForce):
        return unit.nanometer
    if not hasattr(force, "getEnergyFunction"):
        tells = not type(force).__name__.startswith(("Custom", "Python"))
        return unit.kilojoule_per_mole if tells else None
    expression = force.getEnergyFunction().replace(" ", "")
    if isinstance(force, openmm.CustomCVForce):
        names = [force.getCollectiveVariableName(k) for k in range(force.getNumCollectiveVariables())]
        return unit_of(force.getCollectiveVariable(names.index(expression))) if expression in names else None
    if _LENGTHS.match(expression):
        return unit.nanometer
    return unit.radian if _ANGLES.match(expression) else None


# -- groups -----------------------------------------------------------------------------------------


def used_groups(system: openmm.System) -> set[int]:
    """The force groups that Forces of the System are in."""
    return set().union(*(groups_of(force) for force in system.getForces()))


def place(system: openmm.System, forces: Sequence[openmm.Force | int]) -> list[int]:
    """A force group for each row; Forces that are in no System are added to this one, by the name of rows.

    Raises
    ------
    InputError
        A Force of another System, a group without Forces or named twice.
    UnsupportedError
        More rows than free force groups. Nothing is added then.
    """
    present = {int(force.this): force for force in system.getForces()}
    members: dict[int, list[openmm.Force]] = {}
    for force in present.values():
        members.setdefault(force.getForceGroup(), []).append(force)
    taken = used_groups(system)
    named = [force for force in forces if isinstance(force, int)]
    identities = [int(force.this) for force in forces if isinstance(force, openmm.Force)]
    for k, force in enumerate(forces):
        if isinstance(force, int):
            if force not in members or named.count(force) > 1:
                reason = "has no Forces" if force not in members else "is named more than once"
                raise InputError(f"row {k}: force group {force} of the System {reason}", item="force")
        elif identities.count(int(force.this)) > 1:
            raise InputError(f"row {k}: this {type(force).__name__} is named more than once", item="force")
        elif int(force.this) in present:
            if force.getForceGroup() in named:
                raise InputError(
                    f"row {k}: its Force is part of group {force.getForceGroup()}, a row too", item="force"
                )
        elif not force.thisown:
            raise InputError(
                f"row {k}: this {type(force).__name__} belongs to another System; give a copy of it", item="force"
            )

    def settled(force: openmm.Force | int) -> int | None:
        """The group of a row that can stay where it is."""
        if isinstance(force, int):
            return force
        alone = int(force.this) in present and members[force.getForceGroup()] == [present[int(force.this)]]
        reciprocal = any(
            getattr(other, "getReciprocalSpaceForceGroup", lambda: -1)() == force.getForceGroup()
            for other in present.values()
        )
        return force.getForceGroup() if alone and not reciprocal and force.getForceGroup() != 0 else None

    groups = [settled(force) for force in forces]
    free = sorted(set(range(1, GROUPS)) - taken)
    wanted = groups.count(None)
    if wanted > len(free):
        raise UnsupportedError(
            f"{wanted} rows need a force group each and {len(free)} are free ({sorted(taken)} are in use). Put Forces "
            "of the System that are evaluated together into one group, or hold more rows as constraint objects of kcons"
        )
    result = []
    for force, group in zip(forces, groups, strict=True):
        if group is None:
            assert isinstance(force, openmm.Force)
            group = free.pop(0)
            force.setForceGroup(group)
            if int(force.this) not in present:
                if force.getName() == type(force).__name__:
                    force.setName(f"{ROW_NAME}: {force.getName()}")
                system.addForce(force)
        result.append(group)
    return result


def forces_in(system: openmm.System, group: int) -> list[openmm.Force]:
    return [force for force in system.getForces() if force.getForceGroup() == group]


def found_values(
    system: openmm.System, rows: Sequence[Sequence[openmm.Force]], positions: object, box: Sequence | None = None
) -> FloatArray:
    """The energy of each row's Forces at the given positions, shape (len(rows),); evaluated apart from all else.

    Raises
    ------
    InputError
        Positions of the wrong shape, or at which a row is not a number.
    """
    x = nanometers(positions, system.getNumParticles())
    values = []
    for first in range(0, len(rows), GROUPS - 1):
        alone = openmm.System()
        for k in range(system.getNumParticles()):
            alone.addParticle(system.getParticleMass(k))
        a, b, c = system.getDefaultPeriodicBoxVectors() if box is None else box
        alone.setDefaultPeriodicBoxVectors(a, b, c)
        some = rows[first : first + GROUPS - 1]
        for group, forces in enumerate(some):
            for force in forces:
                copy = deepcopy(force)
                copy.setForceGroup(group)
                alone.addForce(copy)
        integrator = openmm.VerletIntegrator(0.001)
        context = openmm.Context(alone, integrator, openmm.Platform.getPlatform("Reference"))
        context.setPositions(x)
        values += [energy(context, group) for group in range(len(some))]
    for k, value in enumerate(values):
        if not math.isfinite(value):
            raise InputError(f"row {k} is {value} at these positions", item="positions")
    return np.array(values)


def energy(context: openmm.Context, group: int) -> float:
    """Energy of one force group in kJ/mol."""
    value = context.getState(getEnergy=True, groups=1 << group).getPotentialEnergy()
    return float(value.value_in_unit(unit.kilojoules_per_mole))
