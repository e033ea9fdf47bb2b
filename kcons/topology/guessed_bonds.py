"""Bonds for systems that have none: by distance and covalent radii, the same for all MD engines."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from kcons.constraints import Angle
from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import connected, lined_up, minimum_image
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.topology.topology import BoolArray, Snapshot, bond_angles, sorted_pairs

#: Covalent radii in angstrom of elements that form bonds that could be held. Cordero et al., Dalton Trans. 2832 (2008).
RADII: dict[str, float] = {
    "H": 0.31, "B": 0.84, "C": 0.76, "N": 0.71, "O": 0.66, "F": 0.57, "Si": 1.11, "P": 1.07, "S": 1.05, "Cl": 1.02,
    "Ge": 1.20, "As": 1.19, "Se": 1.20, "Br": 1.20, "Te": 1.38, "I": 1.39,
}  # fmt: skip
#: Atoms closer than this times the sum of their radii are bonded. C-C up to 1.90, C-H 1.34, O-H 1.21 angstrom.
STRETCH = 1.25
#: Bonds longer than this times the sum are none of these atoms: those of another order of atoms, or of a cut molecule.
FAR = 2.0
#: Atoms closer than this, in angstrom, are one atom twice.
COINCIDENT = 0.3
#: Without elements: a bond is shorter than this times the geometric mean of its atoms' distances to their nearest
#: neighbors. C-C beside C-H has 1.40, C-S 1.51, Si-Si 1.59; hydrogen bonds begin at 1.7.
NEAREST = 1.62
#: A pair this much longer than both distances to a third atom is bonded to that one, not to each other.
ACROSS = 1.2
#: What is no picture of molecules: atoms with more of such neighbors (a fluid, a metal), angles sharper than this
#: (three-membered rings have 48 to 75 degrees), pairs that are this little further apart than bonded ones.
MOST_BONDS, SHARPEST, GAP = 6, np.radians(47.0), 1.02
#: Nearest neighbors further off than this times the median are at no bond length.
_LONE = 2.5


def guess_bonds(snapshot: Snapshot, atoms: BoolArray | None = None, among: BoolArray | None = None) -> IntArray:
    """Bonds that the distances suggest, shape (n, 2).

    Two atoms are bonded if they are closer than 1.25 times the sum of their covalent radii, under minimum images. A
    hydrogen keeps its nearest neighbor only. Metals and noble gases get no bonds. Bonds are returned where at least one
    of their atoms is marked in `atoms`; only those marked in `among` form any. Refused are systems without elements,
    positions that are not finite, and two atoms on top of each other.
    """
    topology = snapshot.topology
    radius = _radii(topology.elements)
    every = np.ones(topology.n_atoms, dtype=bool) if among is None else among
    able = np.flatnonzero((radius > 0) & every)
    if topology.n_atoms and not (topology.elements != "").any():
        raise InputError(
            "there are no bonds and no elements to guess them from; give a topology with bonds, or elements",
            item="elements",
        )
    x = snapshot.positions / snapshot.angstrom
    bad = every & ~np.isfinite(x).all(axis=1)
    if bad.any():
        atom = int(np.argmax(bad))
        raise InputError(f"position of {topology.atom_name(atom)} is not finite", item="positions", atoms=[atom])
    if len(able) < 2:
        return np.zeros((0, 2), np.int64)
    lattice = snapshot.in_unit(1.0).lattice
    reach = 2 * STRETCH * float(radius[able].max())
    pairs, away = close_pairs(x[able], lattice, reach)
    pairs = able[pairs]
    i, j = pairs.T
    near = away < STRETCH * (radius[i] + radius[j])
    hydrogen = topology.hydrogen
    near &= ~(hydrogen[i] & hydrogen[j]) | (away < 0.9)
    pairs, away = pairs[near], away[near]
    nearest = np.full(topology.n_atoms, np.inf)
    np.minimum.at(nearest, pairs, away[:, None])
    kept = (~hydrogen[pairs] | (away[:, None] <= nearest[pairs])).all(axis=1)
    if atoms is not None:
        kept &= atoms[pairs].any(axis=1)
    pairs, away = pairs[kept], away[kept]
    if len(away) and away.min() < COINCIDENT:
        i, j = (int(k) for k in pairs[np.argmin(away)])
        raise InputError(
            f"{topology.atom_name(i)} and {topology.atom_name(j)} are {away.min():.2g} angstrom apart: bonds cannot be "
            "guessed; remove double or alternative atoms, or give a topology with bonds",
            item="positions",
            atoms=[i, j],
        )
    return sorted_pairs(pairs)


def reaches(snapshot: Snapshot, bonds: IntArray) -> tuple[FloatArray, FloatArray]:
    """Length of each bond under minimum images, and the sum of its covalent radii (inf: not known), in angstrom."""
    i, j = bonds.T
    d = minimum_image(snapshot.positions[i] - snapshot.positions[j], snapshot.lattice)
    radius = _radii(snapshot.topology.elements)
    sums = np.where((radius[i] > 0) & (radius[j] > 0), radius[i] + radius[j], np.inf)
    return np.linalg.norm(d, axis=1) / snapshot.angstrom, sums


def _radii(elements: NDArray[np.str_]) -> FloatArray:
    """Covalent radii in angstrom, 0 where an element forms no bonds."""
    kinds, kind = np.unique(elements, return_inverse=True)
    return np.array([RADII.get(symbol, 0.0) for symbol in kinds.tolist()])[kind]


def bonds_without_elements(x: FloatArray, lattice: FloatArray | None, atoms: IntArray, able: BoolArray) -> IntArray:
    """Bonds that the distances alone suggest, where neither elements nor the unit of length are known, shape (n, 2).

    Two atoms are bonded if they are closer than `NEAREST` times the geometric mean of the distances of each to its
    nearest neighbor. Nothing is guessed where the molecules of `atoms` then do not look like molecules. Only atoms that
    are `able` and finite form bonds.
    """
    from scipy.spatial import cKDTree

    nothing = np.zeros((0, 2), np.int64)
    finite = np.flatnonzero(able & np.isfinite(x).all(axis=1))
    if len(finite) < 2:
        return nothing
    y = x[finite]
    # Atoms may be stored in any image: the nearest neighbor is looked for among the wrapped ones.
    wrapped = y if lattice is None else wrapped_into(y, lattice)[1]
    near = cKDTree(wrapped).query(wrapped, k=2)[0][:, 1]
    typical = float(np.median(near))
    if lattice is not None:
        # No bond is longer than a cell vector: an image of the atom itself would be nearer.
        typical = min(typical, float(np.linalg.norm(lattice[0][lattice[1].any(axis=0)], axis=1).min()))
    pairs, away = close_pairs(y, lattice, GAP * NEAREST * _LONE * typical)
    for side in (0, 1):
        np.minimum.at(near, pairs[:, side], away)
    near = np.minimum(near, _LONE * typical)
    if not np.all(away > 0):
        return nothing
    ratio = away / np.sqrt(near[pairs[:, 0]] * near[pairs[:, 1]])
    close = np.flatnonzero(ratio < GAP * NEAREST)
    close = close[~across(pairs[close], away[close])]
    pairs, ratio = pairs[close], ratio[close]
    bonds = sorted_pairs(pairs[ratio < NEAREST])
    molecule, _ = connected(bonds, len(y))
    wanted = np.zeros(len(x), dtype=bool)
    wanted[atoms] = True
    seen = np.isin(molecule, molecule[wanted[finite]])
    between = pairs[ratio >= NEAREST]
    torn = seen[between[:, 0]] & (molecule[between[:, 0]] == molecule[between[:, 1]])
    crowded = np.bincount(bonds.ravel(), minlength=len(y))[seen] > MOST_BONDS
    if torn.any() or crowded.any():
        return nothing
    kept = bonds[seen[bonds[:, 0]]]
    angles = bond_angles(kept, len(y))
    sharp = Angle(angles).measure(lined_up(y[angles], lattice), 0.0) < SHARPEST
    return nothing if np.any(sharp) else finite[kept]


def across(pairs: IntArray, lengths: FloatArray) -> BoolArray:
    """Which pairs are the long sides of triangles of pairs, as H-H in water; pairs with i < j, each once."""
    if not len(pairs):
        return np.zeros(0, dtype=bool)
    n = int(pairs.max()) + 1
    order = np.argsort(pairs[:, 0] * n + pairs[:, 1])
    code, length = (pairs[:, 0] * n + pairs[:, 1])[order], lengths[order]

    def number(a: IntArray, b: IntArray) -> IntArray:
        return np.searchsorted(code, np.minimum(a, b) * n + np.maximum(a, b)).clip(0, len(code) - 1)

    i, j, k = bond_angles(pairs, n).T
    side = number(i, k)
    closed = code[side] == np.minimum(i, k) * n + np.maximum(i, k)
    side = side[closed]
    legs = np.maximum(length[number(i, j)], length[number(j, k)])[closed]
    found = np.zeros(len(pairs), dtype=bool)
    found[order[side[length[side] > ACROSS * legs]]] = True
    return found


def close_pairs(x: FloatArray, lattice: FloatArray | None, reach: float) -> tuple[IntArray, FloatArray]:
    """Pairs closer than `reach` in any image, shape (n, 2), and their distances."""
    from scipy.spatial import cKDTree

    if lattice is None:
        pairs = cKDTree(x).query_pairs(reach, output_type="ndarray").astype(np.int64)
        return pairs, np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    fractional, y = wrapped_into(x, lattice)
    # Atoms within reach of a face of the cell are repeated beyond the opposite one.
    depth = reach * np.linalg.norm(lattice[1], axis=0)
    copies, owners = [], []
    for image in product(*(range(-int(n), int(n) + 1) for n in np.ceil(depth))):
        moved = fractional + image
        inside = (((moved > -depth) & (moved < 1 + depth)) | (depth == 0)).all(axis=1)
        copies.append(y[inside] + image @ lattice[0])
        owners.append(np.flatnonzero(inside))
    number = np.concatenate(owners)
    found = cKDTree(y).sparse_distance_matrix(cKDTree(np.concatenate(copies)), reach, output_type="ndarray")
    owned, away = np.sort(np.stack([found["i"], number[found["j"]]], axis=1), axis=1), found["v"]
    # The shortest image of each pair of different atoms.
    order = np.lexsort((away, owned[:, 1], owned[:, 0]))
    owned, away = owned[order], away[order]
    first = owned[:, 0] != owned[:, 1]
    first[1:] &= (owned[1:] != owned[:-1]).any(axis=1)
    return owned[first], away[first]


def wrapped_into(x: FloatArray, lattice: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fractional and Cartesian coordinates in the cell along its periodic axes."""
    pbc = lattice[1].any(axis=0)
    fractional = x @ np.linalg.inv(lattice[0])
    fractional[:, pbc] -= np.floor(fractional[:, pbc])
    return fractional, fractional @ lattice[0]
