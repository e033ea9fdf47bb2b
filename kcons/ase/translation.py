"""ASE's own constraints, as constraints of kcons."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from ase import Atoms
from ase.geometry import find_mic

from kcons.ase.constraints_object import Constraints
from kcons.constraints import (
    Angle,
    CenterOfMass,
    Constraint,
    Dihedral,
    Distance,
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

    Knows FixAtoms, FixBondLengths, FixInternals (bonds, angles, dihedrals), FixLinearTriatomic, FixCom,
    FixSubsetCom, FixedPlane, FixedLine and FixCartesian. The atoms are not changed::

        held = from_ase_constraints(atoms)
        atoms.set_constraint()
        constrain(atoms, held)

    Raises
    ------
    UnsupportedError
        For any other ASE constraint, named.
    """
    return translated(atoms, atoms.constraints)


def translated(atoms: Atoms, items: Iterable[Any]) -> list[Constraint]:
    """As `from_ase_constraints`, for some constraints of `atoms`."""
    result: list[Constraint] = []
    for item in items:
        if isinstance(item, Constraints):
            result.extend(item.constraints)
            continue
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
    if item.bondcombos:
        raise UnsupportedError(
            "FixInternals holds combinations of bond lengths (bondcombos); use a Custom constraint for them"
        )
    result: list[Constraint] = []
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
