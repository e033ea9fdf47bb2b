"""What a file says about a system: atoms, residues, bonds, masses; bonds by distance where it has none.

`Topology` and `Snapshot` hold plain arrays, so that everything that is derived from them (which rows are held,
where virtual sites go) is derived once, for MDAnalysis, ASE and OpenMM alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from types import UnionType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints import Angle
from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import (
    BoolArray,
    connected,
    lattice_of,
    lined_up,
    make_whole,
    minimum_image,
    neighbor_lists,
    spanning_tree,
)
from kcons.constraints.target import FloatArray
from kcons.errors import InputError

StrArray = NDArray[np.str_]

#: Standard atomic masses in dalton, for recognizing elements.
MASSES: dict[str, float] = {
    "H": 1.008, "He": 4.0026, "Li": 6.94, "Be": 9.0122, "B": 10.81, "C": 12.011, "N": 14.007, "O": 15.999,
    "F": 18.998, "Ne": 20.180, "Na": 22.990, "Mg": 24.305, "Al": 26.982, "Si": 28.085, "P": 30.974, "S": 32.06,
    "Cl": 35.45, "Ar": 39.95, "K": 39.098, "Ca": 40.078, "Ti": 47.867, "V": 50.942, "Cr": 51.996, "Mn": 54.938,
    "Fe": 55.845, "Co": 58.933, "Ni": 58.693, "Cu": 63.546, "Zn": 65.38, "Ga": 69.723, "Ge": 72.630, "As": 74.922,
    "Se": 78.971, "Br": 79.904, "Kr": 83.798, "Rb": 85.468, "Sr": 87.62, "Mo": 95.95, "Ru": 101.07, "Rh": 102.91,
    "Pd": 106.42, "Ag": 107.87, "Cd": 112.41, "Sn": 118.71, "Te": 127.60, "I": 126.90, "Xe": 131.29, "Cs": 132.91,
    "Ba": 137.33, "W": 183.84, "Ir": 192.22, "Pt": 195.08, "Au": 196.97, "Hg": 200.59, "Tl": 204.38, "Pb": 207.2,
}  # fmt: skip
_DEUTERIUM = 2.014
#: Elements with two letters that atom names within a molecule may begin with.
_LONG = ("CL", "BR", "SE", "SI", "FE", "ZN", "MG", "MN", "LI", "AL", "CU")
#: Ions whose name is no symbol.
_IONS = {
    "SOD": "Na", "POT": "K", "CLA": "Cl", "CAL": "Ca", "CES": "Cs", "LIT": "Li", "RUB": "Rb", "BAR": "Ba", "CIO": "Cs",
}  # fmt: skip
#: Names of massless sites.
_SITES = ("MW", "EP", "EPW", "LP", "M", "OM", "VS", "XX", "X", "DUM")
#: How far a mass may be from that of its element; hydrogens heavier than this took mass from their neighbors.
_NEAR, _HEAVY = 0.06, 1.2
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


@dataclass(frozen=True, eq=False)
class Topology:
    """Atoms, residues, bonds.

    Attributes
    ----------
    names : ndarray of str, shape (n_atoms,)
    elements : ndarray of str, shape (n_atoms,)
        Symbols; empty where there is none (virtual sites, unknown).
    masses : ndarray, shape (n_atoms,)
        In dalton; 0 for virtual sites and where unknown.
    residues : ndarray of int, shape (n_atoms,)
        Residue of each atom, from 0.
    residue_names, residue_ids, chains : ndarray of str, shape (n_residues,)
    bonds : ndarray of int, shape (n_bonds, 2)
        Pairs (i, j), i < j, sorted, each once.
    charges : ndarray, shape (n_atoms,), or None
        In units of the elementary charge.
    residues_known : bool
        Whether residues came with the system; otherwise molecules take their place, named by their formula.
    """

    names: StrArray
    elements: StrArray
    masses: FloatArray
    residues: IntArray
    residue_names: StrArray
    residue_ids: StrArray
    chains: StrArray
    bonds: IntArray
    charges: FloatArray | None = None
    residues_known: bool = True

    @property
    def n_atoms(self) -> int:
        return len(self.names)

    @property
    def n_residues(self) -> int:
        return len(self.residue_names)

    @property
    def hydrogen(self) -> BoolArray:
        return np.asarray(self.elements == "H")

    def atom_name(self, atom: int) -> str:
        """For example 'HW1 of SOL 12 (atom 33)'."""
        if not self.residues_known:
            return f"{self.names[atom]} (atom {atom})"
        return f"{self.names[atom]} of {self.residue_name(int(self.residues[atom]))} (atom {atom})"

    def residue_name(self, residue: int) -> str:
        """For example 'SOL 12'."""
        chain = str(self.chains[residue]).strip()
        return f"{self.residue_names[residue]} {self.residue_ids[residue]}" + (f" of chain {chain}" if chain else "")

    def with_bonds(self, bonds: ArrayLike) -> Topology:
        """The same atoms with other bonds."""
        return replace(self, bonds=sorted_pairs(bonds))

    def with_molecules(self) -> Topology:
        """Molecules in place of residues, named by their formulas in Hill's order (H2O, C2H6O)."""
        number, count = connected(self.bonds, self.n_atoms)
        symbols, code = np.unique(np.where(self.elements == "", "X", self.elements), return_inverse=True)
        table = np.zeros((count, len(symbols)), dtype=np.int64)
        np.add.at(table, (number, code), 1)
        kinds, kind = np.unique(table, axis=0, return_inverse=True)
        formulas = np.array([_formula(symbols, row) for row in kinds] or [""])
        ids = np.arange(1, count + 1).astype(str)
        return replace(
            self,
            residues=number,
            residue_names=formulas[kind.ravel()],
            residue_ids=ids,
            chains=np.full(count, ""),
            residues_known=False,
        )


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A topology with positions.

    Attributes
    ----------
    topology : Topology
    positions : ndarray, shape (n_atoms, 3)
    angstrom : float
        One angstrom in the unit of the positions: 1, or 0.1 for nm.
    cell : ndarray, shape (3, 3), or None
    pbc : ndarray of bool, shape (3,)
    velocities : ndarray, shape (n_atoms, 3), or None
        In units of the positions a picosecond.
    host : str
        Where it came from, for messages.
    indices : ndarray of int, shape (n_atoms,), or None
        The numbers that the atoms have there, where it may be a part.
    """

    topology: Topology
    positions: FloatArray
    angstrom: float = 1.0
    cell: FloatArray | None = None
    pbc: BoolArray = field(default_factory=lambda: np.zeros(3, dtype=bool))
    velocities: FloatArray | None = None
    host: str = ""
    indices: IntArray | None = None

    def __post_init__(self) -> None:
        if self.positions.shape != (self.topology.n_atoms, 3):
            raise InputError(
                f"{self.topology.n_atoms} atoms in the topology, but positions have shape {self.positions.shape}; give "
                "coordinates of the same system",
                item="positions",
            )

    @cached_property
    def lattice(self) -> FloatArray | None:
        """The periodic cell and its inverse, as `ConstraintSet.lattice`."""
        return lattice_of(self.cell, self.pbc)

    def in_unit(self, angstrom: float) -> Snapshot:
        """The same with another unit of length."""
        factor = angstrom / self.angstrom
        if factor == 1.0:
            return self
        return replace(
            self,
            positions=self.positions * factor,
            angstrom=angstrom,
            cell=None if self.cell is None else self.cell * factor,
            velocities=None if self.velocities is None else self.velocities * factor,
        )


# -- molecules made whole across the faces of the cell --------------------------------------------

#: No two images of an atom are that close, in angstrom.
_ROUNDING = 1e-3


def whole_groups(snapshot: Snapshot, atoms: IntArray) -> FloatArray:
    """Positions of groups, each made whole, shape (n, width, 3).

    By minimum images from atom to atom; atoms of one molecule, whose neighbors in the group may be farther away than
    half the cell, lie where its bonds say.
    """
    r = lined_up(snapshot.positions[atoms], snapshot.lattice)
    if snapshot.lattice is None or not len(snapshot.topology.bonds):
        return r
    y, molecule = _in_molecules(snapshot)
    for k in range(1, atoms.shape[1]):
        same = molecule[atoms[:, :k]] == molecule[atoms[:, k, None]]
        first = np.argmax(same, axis=1)
        bonded = same.any(axis=1)
        row = np.arange(len(atoms))
        meant = r[row, first] + y[atoms[:, k]] - y[atoms[row, first]]
        moved = bonded & (np.abs(meant - r[:, k]).max(axis=1) > _ROUNDING * snapshot.angstrom)
        # What comes after goes along.
        r[moved, k:] += (meant - r[:, k])[moved, None]
    return r


def _in_molecules(snapshot: Snapshot) -> tuple[FloatArray, IntArray]:
    """Positions of whole molecules, and a number for each; atoms of endless ones have a number each."""
    bonds, n = snapshot.topology.bonds, snapshot.topology.n_atoms
    y = whole_molecules(snapshot).positions
    molecule, count = connected(bonds, n)
    d = y[bonds[:, 0]] - y[bonds[:, 1]]
    around = np.abs(d - minimum_image(d, snapshot.lattice)).max(axis=1) > _ROUNDING * snapshot.angstrom
    endless = np.isin(molecule, molecule[bonds[around, 0]])
    return y, np.where(endless, count + np.arange(n), molecule)


def whole_molecules(snapshot: Snapshot, links: IntArray | None = None, roots: IntArray | None = None) -> Snapshot:
    """Every molecule in one piece: atoms moved to nearest images along bonds, from the first atom on.

    `links`, (n, 2), count as bonded; by default the bonds of the topology. The first of `roots` in a molecule stays.
    """
    if snapshot.lattice is None:
        return snapshot
    tree = spanning_tree(snapshot.topology.bonds if links is None else links, snapshot.topology.n_atoms, roots)
    x = make_whole(snapshot.positions, *tree, snapshot.lattice)
    return snapshot if np.array_equal(x, snapshot.positions) else replace(snapshot, positions=x)


# -- arrays ---------------------------------------------------------------------------------------


def sorted_pairs(pairs: ArrayLike) -> IntArray:
    """Pairs with i < j, sorted, each once, shape (n, 2)."""
    table = np.sort(np.asarray(pairs, dtype=np.int64).reshape(-1, 2), axis=1)
    if not len(table):
        return table
    code = np.unique(table[:, 0] * (int(table.max()) + 1) + table[:, 1])
    return np.stack(np.divmod(code, int(table.max()) + 1), axis=1)


def bond_angles(bonds: IntArray, n_atoms: int) -> IntArray:
    """All i-j-k with bonds i-j and j-k, i < k, sorted by (j, i, k), shape (n, 3)."""
    starts, ends = neighbor_lists(bonds, n_atoms)
    degree = np.diff(starts)
    found = []
    for d in np.unique(degree[degree > 1]).tolist():
        vertex = np.flatnonzero(degree == d)
        neighbors = ends[starts[vertex][:, None] + np.arange(d)]
        a, b = np.triu_indices(d, 1)
        center = np.repeat(vertex, len(a))
        found.append(np.stack([neighbors[:, a].ravel(), center, neighbors[:, b].ravel()], axis=1))
    if not found:
        return np.zeros((0, 3), np.int64)
    triples = np.concatenate(found)
    return triples[np.lexsort((triples[:, 2], triples[:, 0], triples[:, 1]))].astype(np.int64)


def split_residues(
    names: StrArray, residue_names: StrArray, residue_ids: Sequence[Any] | NDArray[Any], chains: StrArray | None = None
) -> tuple[IntArray, IntArray]:
    """Residue of each atom and the first atom of each residue, from columns with one entry an atom.

    A residue ends where its name, number or chain changes, and where all of its atom names come again, the first
    of them first (waters that all have one number). Other names that come again, as where atoms have symbols for names,
    are atoms of one residue; so is one name alone, unless it is that of an ion.
    """
    n = len(names)
    if n == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    ids = np.asarray(residue_ids)
    begins = np.ones(n, dtype=bool)
    begins[1:] = (residue_names[1:] != residue_names[:-1]) | (ids[1:] != ids[:-1])
    if chains is not None:
        begins[1:] |= chains[1:] != chains[:-1]
    residue = np.cumsum(begins) - 1
    _, code = np.unique(names, return_inverse=True)
    key = residue * (int(code.max()) + 1) + code
    order = np.argsort(key, kind="stable")
    again = np.flatnonzero(key[order][1:] == key[order][:-1])
    for number in np.unique(residue[order[again]]).tolist():
        atoms = np.flatnonzero(residue == number)
        unit = int(np.append(np.flatnonzero(code[atoms[1:]] == code[atoms[0]]), len(atoms) - 1)[0]) + 1
        once = code[atoms[:unit]]
        distinct = len(np.unique(once)) == unit and len(atoms) % unit == 0
        if unit == 1:
            distinct = _bare(str(residue_names[atoms[0]]).upper()) in {_bare(str(names[atoms[0]]).upper()), *_IONS}
        if distinct and (np.sort(code[atoms].reshape(-1, unit)) == np.sort(once)).all():
            begins[atoms[::unit]] = True
    return (np.cumsum(begins) - 1).astype(np.int64), np.flatnonzero(begins).astype(np.int64)


def as_written(positions: ArrayLike) -> FloatArray:
    """Positions in single precision as the decimals they were read from, in double precision.

    Files such as PDB and GRO have three decimals. Single precision keeps them up to rounding; where all coordinates
    are within their rounding of numbers with two to six decimals, these are meant. Nothing moves by more than the
    rounding of single precision.
    """
    single = np.asarray(positions)
    x = single.astype(np.float64)
    if single.dtype != np.float32 or not np.all(np.isfinite(x)):
        return x
    slack = 2.0 * np.spacing(np.abs(single)).astype(np.float64)
    for decimals in (2, 3, 4, 5, 6):
        rounded = np.round(x, decimals)
        if np.all(np.abs(rounded - x) <= slack):
            return rounded
    return x


# -- bonds by distance and covalent radii -----------------------------------------------------------


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


# -- elements -------------------------------------------------------------------------------------


def elements_of(names: StrArray, residues: IntArray, residue_names: StrArray, masses: FloatArray | None) -> StrArray:
    """Symbols by the names of atoms, corrected by masses where a file has them, shape (n_atoms,)."""
    size = np.bincount(residues, minlength=len(residue_names))[residues]
    alone = size == 1
    # One decision for each distinct name of an atom (or of a residue of one atom), not for each atom.
    text = np.char.upper(np.where(alone, np.char.add(np.char.add(names, "/"), residue_names[residues]), names))
    kinds, kind = np.unique(text, return_inverse=True)
    found = np.array([_symbol_of_ion(k) if "/" in k else _symbol(k) for k in kinds] or [""])[kind.ravel()]
    if masses is None:
        return np.asarray(found)
    symbols = np.array(list(MASSES))
    standard = np.array(list(MASSES.values()))
    order = np.argsort(standard)
    symbols, standard = symbols[order], standard[order]
    distinct, which = np.unique(masses, return_inverse=True)
    nearest = np.abs(standard[None, :] - distinct[:, None]).argmin(axis=1)
    sure = np.abs(standard[nearest] - distinct) < _NEAR
    known = (sure & (symbols[nearest] != "He"))[which.ravel()]
    # Where hydrogens are heavier than they are, their neighbors are lighter, as light as other elements.
    if ((found == "H") & (masses > _HEAVY) & (masses < MASSES["Li"])).any():
        known &= found == ""
    # Nothing else is lighter than helium; Drude particles are lighter than hydrogen.
    found = np.where((found == "") & (masses > MASSES["H"] - _NEAR) & (masses < 3.5), "H", found)
    found = np.where(known, symbols[nearest][which.ravel()], found)
    # Without mass there is no atom.
    return np.asarray(np.where(masses == 0, "", found))


def guessed_masses(guess: FloatArray, names: StrArray, elements: StrArray) -> FloatArray:
    """Masses, shape (n_atoms,), guessed by a host from names, or of elements where it took atoms for others.

    Elements have 'D' for deuterium.
    """
    kinds, kind = np.unique(np.char.add(np.char.add(elements, "/"), names), return_inverse=True)
    known = np.array([_mass(*k.split("/", 1)) for k in kinds.tolist()] or [0.0])[kind.ravel()]
    return np.where(np.abs(known - guess) > _NEAR, known, guess)


def _mass(element: str, name: str) -> float:
    """Of an atom by its element, 0 of a site; NaN where neither is known."""
    if element in ("", "H"):
        letters = "".join(c for c in _bare(name.upper()) if c.isalpha())
        element = "D" if element and letters == "D" else element
        if not element and letters in _SITES:
            return 0.0
    return _DEUTERIUM if element == "D" else MASSES.get(element, np.nan)


def _bare(name: str) -> str:
    return name.strip().lstrip("0123456789'*\" ").rstrip("+-0123456789 ")


def _symbol(name: str) -> str:
    """Element of an atom in a molecule; 'CA' is a carbon there."""
    word = _bare(name)
    letters = "".join(c for c in word if c.isalpha())
    if not letters or word in _SITES or letters in _SITES:
        return ""
    if letters == "D":
        return "H"
    long = next((two for two in _LONG if letters.startswith(two)), None)
    if long is not None:
        return long.capitalize()
    return letters[0] if letters[0] in "HBCNOFPSKI" else ""


def _symbol_of_ion(name: str) -> str:
    """Element of a residue of one atom, 'NAME/RESIDUE'; 'CA/CA' is calcium there, 'OW/SOL' an oxygen."""
    atom, _, residue = name.partition("/")
    for word in (_bare(atom), _bare(residue)):
        if word in _IONS:
            return _IONS[word]
        if word.capitalize() in MASSES:
            # A lone alpha carbon of a protein is no calcium: its residue is called otherwise.
            if word == "CA" and _bare(residue) not in ("CA", "CAL", "CA2", "ION"):
                return "C"
            return word.capitalize()
        if word == _bare(atom) and _symbol(word) in ("O", "H", "N") and _bare(residue) not in _IONS:
            return _symbol(word)
    return _symbol(atom)


def _formula(symbols: StrArray, counts: IntArray) -> str:
    present = {str(s): int(c) for s, c in zip(symbols, counts, strict=True) if c}
    order = sorted(present, key=lambda s: (s != "C", s != "H", s) if "C" in present else (False, False, s))
    return "".join(f"{s}{present[s] if present[s] > 1 else ''}" for s in order)


def whole_numbers(ids: StrArray) -> IntArray:
    """Numbers of residues whose ids may have letters; 0 where there are no digits."""
    digits = ["".join(c for c in text if c.isdigit() or c == "-") or "0" for text in ids.tolist()]
    return np.array([int(d) for d in digits], dtype=np.int64)


def require_standard_form(cell: FloatArray, engine: str, positive: bool = False) -> None:
    """Refuse a cell that has to be turned, and positions with it; if `positive`, also one turned inside out."""
    turned = np.abs(np.triu(cell, 1)).max() > 1e-6 * np.abs(cell).max()
    if turned or (positive and np.diag(cell).min() <= 0):
        raise InputError(
            f"{engine} wants the first cell vector along x, the second in the xy plane; turn cell and positions "
            "(ase: atoms.cell.standard_form()) before",
            item="cell",
        )


# -- messages -------------------------------------------------------------------------------------


def require_kind(given: Any, kind: type | UnionType, item: str, wanted: str) -> None:
    """Refuse what is no `kind`; `wanted` says of such a one what it is and where it comes from."""
    if not isinstance(given, kind):
        each = "; of several, give one at a time" if isinstance(given, list | tuple) else ""
        raise InputError(f"{item} must be {wanted}, not {type(given).__name__}{each}", item=item)


def listed(names: Iterable[str], most: int = 12) -> str:
    """Names in a sentence, shortened."""
    distinct = sorted({str(n) for n in names})
    return ", ".join(distinct[:most]) + (f", ... ({len(distinct)} in all)" if len(distinct) > most else "")


def selected_numbers(select: Any, n: int, item: str = "select", name: str = "the selection") -> IntArray:
    """Numbers of the atoms that a mask or a list of numbers names.

    Refused are words, which only MDAnalysis understands, nothing selected, and atoms that do not exist.
    """
    given = np.asarray(select)
    if given.dtype == bool and given.shape == (n,):
        given = np.flatnonzero(given)
    if given.ndim != 1 or (given.size and not np.issubdtype(given.dtype, np.integer)):
        raise InputError(
            f"{item} {select!r:.60}: give 'all', a mask of {n} entries, or numbers of atoms; selections in words are "
            "for kcons.mdanalysis",
            item=item,
        )
    if not given.size:
        raise InputError(f"{name} has no atoms; widen it", item=item)
    if given.min() < 0 or given.max() >= n:
        beyond = int(given.min() if given.min() < 0 else given.max())
        raise InputError(f"{name} names atom {beyond}; there are atoms 0 to {n - 1}", item=item)
    return given.astype(np.int64)
