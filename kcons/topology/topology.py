"""What a file says about a system: atoms, residues, bonds, masses; the same for every MD engine.

`Topology` and `Snapshot` hold plain arrays, so that everything that is derived from them (which rows are held,
where virtual sites go) is derived once, for MDAnalysis, ASE and OpenMM alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import UnionType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

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

#: Standard atomic masses in dalton, for recognising elements.
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


def whole_molecules(snapshot: Snapshot, links: IntArray | None = None) -> Snapshot:
    """Every molecule in one piece: atoms moved to nearest images along bonds, from the first atom on.

    `links`, shape (n, 2), are what counts as bonded; by default the bonds of the topology.
    """
    if snapshot.lattice is None:
        return snapshot
    tree = spanning_tree(snapshot.topology.bonds if links is None else links, snapshot.topology.n_atoms)
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
