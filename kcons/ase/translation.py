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
    InputError
        No `Atoms`.
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
                f"{name} has no counterpart in kcons; known are {', '.join(sorted(_TRANSLATORS))}. "
                "A Custom constraint holds any function with a gradient"
            )
        result.extend(_TRANSLATORS[name](atoms, item))
    return result


def _bond_lengths(atoms: Atoms, item: Any) -> list[Constraint]:
    return [Distance(np.asarray(item.pairs).reshape(-1, 2), item.bondlengths)]


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
    "Constraints": lambda atoms, item: list(item.constraints),
    "FixAtoms": lambda atoms, item: [FixedAtoms(_indices(atoms, item))],
    "FixBondLengths": _bond_lengths,
    "FixInternals": _internals,
    "FixLinearTriatomic": _linear_triatomic,
    "FixCartesian": _cartesian,
    "FixCom": lambda atoms, item: [CenterOfMass(_indices(atoms, item))],
    "FixSubsetCom": lambda atoms, item: [CenterOfMass(_indices(atoms, item))],
    "FixedPlane": lambda atoms, item: [Plane(_indices(atoms, item), item.dir)],
    "FixedLine": lambda atoms, item: [Line(_indices(atoms, item), None, item.dir)],
}


def ase_form(rows: Sequence[Constraint]) -> dict[str, Any] | None:
    """One constraint of ASE that holds the same, as `ase.constraints.dict2constraint` takes it; None if there is none.

    Known are distances; distances, angles and dihedrals; fixed atoms; planes, or lines, of one direction; all with
    targets that are found and rest.
    """
    if not rows or not all(isinstance(item.target, np.ndarray) for item in rows):
        return None
    families = {item.family for item in rows}
    if families == {"Distance"}:
        pairs = [pair for item in rows for pair in item.atoms.tolist()]
        return _named("FixBondLengths", pairs=pairs, bondlengths=[d for item in rows for d in _targets(item)])
    if families <= {"Distance", "Angle", "Dihedral", "DistanceDifference"}:
        parts: dict[str, list[Any]] = {"Distance": [], "Angle": [], "Dihedral": [], "DistanceDifference": []}
        for item in rows:
            values = np.degrees(_targets(item)).tolist() if item.family in ("Angle", "Dihedral") else _targets(item)
            named = item.weighted_pairs() if isinstance(item, DistanceDifference) else item.atoms.tolist()
            parts[item.family] += [list(row) for row in zip(values, named, strict=True)]
        bonds, angles, dihedrals, sums = parts.values()
        more = {"bondcombos": sums} if sums else {}
        return _named("FixInternals", bonds=bonds, angles_deg=angles, dihedrals_deg=dihedrals, mic=True, **more)
    atoms = sorted({atom for item in rows for atom in item.atoms.ravel().tolist()})
    if families == {"FixedAtoms"}:
        return _named("FixAtoms", indices=atoms)
    if families in ({"Plane"}, {"Line"}):
        normals = np.concatenate([np.asarray(item.coefficients)[:, 0] for item in rows])  # type: ignore[attr-defined]
        if families == {"Line"}:
            normals = np.cross(normals[::2], normals[1::2])
        if len(normals) == len(atoms) and np.all(normals == normals[0]):
            name = "FixedPlane" if families == {"Plane"} else "FixedLine"
            return _named(name, indices=atoms, direction=normals[0].tolist())
    return None


def _named(name: str, **kwargs: Any) -> dict[str, Any]:
    return {"name": name, "kwargs": kwargs}


def _targets(item: Constraint) -> list[float]:
    return [float(value) for value in item.target_at(0.0)]
