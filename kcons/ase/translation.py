"""ASE's own constraints, as constraints of kcons, and back."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from ase import Atoms
from ase.geometry import find_mic

from kcons.ase.topology import require_atoms
from kcons.constraints import (
    Angle,
    CenterOfMass,
    Constraint,
    Dihedral,
    Distance,
    DistanceDifference,
    FixedAtoms,
    Line,
    LinearCombination,
    LinearRelation,
    Plane,
)
from kcons.constraints.constraint import IntArray
from kcons.errors import UnsupportedError


def from_ase_constraints(atoms: Atoms) -> list[Constraint]:
    """What the ASE constraints on `atoms` hold, as kcons constraints.

    Knows FixAtoms, FixBondLengths, FixInternals, FixLinearTriatomic, FixCom,
    FixSubsetCom, FixedPlane, FixedLine and FixCartesian. The atoms are not changed::

        held = from_ase_constraints(atoms)
        atoms.set_constraint()
        constrain(atoms, held)

    Raises
    ------
    UnsupportedError
        For any other ASE constraint, named.
    """
    require_atoms(atoms)
    return translated(atoms, atoms.constraints)


def translated(atoms: Atoms, items: Iterable[Any]) -> list[Constraint]:
    """As `from_ase_constraints`, for some constraints of `atoms`."""
    result: list[Constraint] = []
    for item in items:
        name = type(item).__name__
        if name not in _TRANSLATORS:
            raise UnsupportedError(
                f"{name} has no counterpart in kcons; known are {', '.join(sorted(_TRANSLATORS))}. Take it off, or "
                "hold what it means by a LinearCombination, a Formula or a Custom constraint"
            )
        result.extend(_TRANSLATORS[name](atoms, item))
    return result


def _internals(atoms: Atoms, item: Any) -> list[Constraint]:
    result: list[Constraint] = [
        DistanceDifference([row[:2] for row in rows], value, weights=[row[2] for row in rows])
        for value, rows in item.bondcombos
    ]
    for rows, family, unit in (
        (item.bonds, Distance, 1.0),
        (item.angles, Angle, np.pi / 180),
        (item.dihedrals, Dihedral, np.pi / 180),
    ):
        given = [row for row in rows if row[0] is not None]
        open_rows = [row for row in rows if row[0] is None]
        if given:
            result.append(family([list(row[1]) for row in given], [row[0] * unit for row in given]))
        if open_rows:
            result.append(family([list(row[1]) for row in open_rows]))
    return result


def _linear_triatomic(atoms: Atoms, item: Any) -> list[Constraint]:
    n, o, m = np.asarray(item.triples).T
    if item.bondlengths is None:
        x = atoms.positions
        lengths = np.stack([find_mic(x[end] - x[o], atoms.cell, atoms.pbc)[1] for end in (n, m)], axis=1)
    else:
        lengths = np.asarray(item.bondlengths)
    total = lengths.sum(axis=1)
    # The middle atom divides the line in the ratio of the two lengths.
    weights = lengths[:, ::-1] / total[:, None]
    ends = np.stack([n, m], axis=1)
    return [Distance(ends, total), LinearRelation(o, ends, weights)]


def _cartesian(atoms: Atoms, item: Any) -> list[Constraint]:
    index = _indices(atoms, item)[:, None]
    return [LinearCombination(index, np.eye(3)[axis][None, :]) for axis in np.flatnonzero(item.mask)]


def _indices(atoms: Atoms, item: Any) -> IntArray:
    return np.arange(len(atoms))[item.index]


_TRANSLATORS: dict[str, Callable[[Atoms, Any], list[Constraint]]] = {
    **dict.fromkeys(("Constraints", "ConstraintsWithFixedAtoms"), lambda atoms, item: list(item.constraints)),
    "FixAtoms": lambda atoms, item: [FixedAtoms(_indices(atoms, item))],
    "FixBondLengths": lambda atoms, item: [Distance(np.reshape(item.pairs, (-1, 2)), item.bondlengths)],
    "FixInternals": _internals,
    "FixLinearTriatomic": _linear_triatomic,
    "FixCartesian": _cartesian,
    "FixCom": lambda atoms, item: [CenterOfMass(_indices(atoms, item))],
    "FixSubsetCom": lambda atoms, item: [CenterOfMass(_indices(atoms, item))],
    "FixedPlane": lambda atoms, item: [Plane(_indices(atoms, item), item.dir)],
    "FixedLine": lambda atoms, item: [Line(_indices(atoms, item), None, item.dir)],
}


def ase_forms(rows: Sequence[Constraint]) -> tuple[list[dict[str, Any]], list[Constraint]]:
    """Constraints of ASE that hold the same, as `ase.constraints.dict2constraint` takes them, and what none holds.

    Known are fixed atoms; distances and their differences, angles and dihedrals; planes and lines; components of single
    atoms; centers of mass with all their components; all with targets that are found and rest.
    """
    kinds: dict[Callable[..., list[dict[str, Any]]] | None, list[Constraint]] = {}
    for item in rows:
        known = isinstance(item.target, np.ndarray) and item.n_rows and item.cell_offsets is None
        kinds.setdefault(_FORMS.get(item.family) if known else None, []).append(item)
    left = kinds.pop(None, [])
    forms = []
    for form, items in kinds.items():
        assert form is not None
        found = form(items)
        forms += found
        left += [] if found else items
    return forms, left


def _internal(items: list[Constraint]) -> list[dict[str, Any]]:
    parts: dict[str, list[Any]] = {"Distance": [], "Angle": [], "Dihedral": [], "DistanceDifference": []}
    for item in items:
        values = np.degrees(_targets(item)).tolist() if item.family in ("Angle", "Dihedral") else _targets(item)
        named = item.weighted_pairs() if isinstance(item, DistanceDifference) else item.atoms.tolist()
        parts[item.family] += [list(row) for row in zip(values, named, strict=True)]
    bonds, angles, dihedrals, sums = parts.values()
    if not (angles or dihedrals or sums):
        return [_named("FixBondLengths", pairs=[pair for _, pair in bonds], bondlengths=[d for d, _ in bonds])]
    more = {"bondcombos": sums} if sums else {}
    return [_named("FixInternals", bonds=bonds, angles_deg=angles, dihedrals_deg=dihedrals, mic=True, **more)]


def _directed(items: list[Constraint]) -> list[dict[str, Any]]:
    """Planes by their normals, lines by their directions; none where one atom has two of them."""
    atoms: dict[tuple[str, tuple[float, ...]], list[int]] = {}
    for item in items:
        name, directions, each = "FixedPlane", np.asarray(item.coefficients)[:, 0], item.atoms[:, 0]  # type: ignore[attr-defined]
        if item.family == "Line":
            name, directions, each = "FixedLine", np.cross(directions[::2], directions[1::2]), each[::2]
        for direction, atom in zip(directions.tolist(), each.tolist(), strict=True):
            atoms.setdefault((name, tuple(direction)), []).append(atom)
    every = [atom for found in atoms.values() for atom in found]
    if len(set(every)) < len(every):
        return []
    return [_named(name, indices=found, direction=list(along)) for (name, along), found in atoms.items()]


def _components(items: list[Constraint]) -> list[dict[str, Any]]:
    masks: dict[int, list[bool]] = {}
    for item in items:
        for atoms, coefficients in zip(item.atoms.tolist(), item.coefficients.tolist(), strict=True):  # type: ignore[attr-defined]
            axes = np.flatnonzero(coefficients[0])
            if len(atoms) != 1 or len(axes) != 1:
                return []
            masks.setdefault(atoms[0], [False] * 3)[int(axes[0])] = True
    atoms_of: dict[tuple[bool, ...], list[int]] = {}
    for atom, mask in masks.items():
        atoms_of.setdefault(tuple(mask), []).append(atom)
    return [_named("FixCartesian", a=sorted(found), mask=list(mask)) for mask, found in atoms_of.items()]


def _centers(items: list[Constraint]) -> list[dict[str, Any]]:
    axes: dict[tuple[int, ...], set[int]] = {}
    for item in items:
        for atoms, direction in zip(item.atoms.tolist(), item.directions.tolist(), strict=True):  # type: ignore[attr-defined]
            axes.setdefault(tuple(atoms), set()).add(int(np.argmax(direction)))
    if any(len(found) < 3 for found in axes.values()):
        return []
    return [_named("FixSubsetCom", indices=list(atoms)) for atoms in axes]


#: What makes the data of objects of ASE for rows of a family, and of those that one object holds together.
_FORMS: dict[str, Callable[[list[Constraint]], list[dict[str, Any]]]] = {
    **dict.fromkeys(("Distance", "DistanceDifference", "Angle", "Dihedral"), _internal),
    **dict.fromkeys(("Plane", "Line"), _directed),
    "FixedAtoms": lambda items: [_named("FixAtoms", indices=np.unique([a for c in items for a in c.atoms]).tolist())],
    "LinearCombination": _components,
    "CenterOfMass": _centers,
}


def _named(name: str, **kwargs: Any) -> dict[str, Any]:
    return {"name": name, "kwargs": kwargs}


def _targets(item: Constraint) -> list[float]:
    return [float(value) for value in item.target_at(0.0)]
