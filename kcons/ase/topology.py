"""Topologies of ASE `Atoms`: residues as ASE's readers leave them, bonds where there are any."""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any, Unpack

import numpy as np
from ase import Atoms, units
from ase.data import atomic_masses, atomic_numbers, chemical_symbols
from numpy.typing import NDArray

from kcons.constraints import Distance
from kcons.constraints.arguments import check_pairs, positive
from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import connected
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.topology.rows_by_name import HeldRows, Holding, Options, rows_of, with_options
from kcons.topology.topology import (
    Snapshot,
    Topology,
    elements_of,
    guess_bonds,
    require_kind,
    selected_numbers,
    sorted_pairs,
    split_residues,
    whole_numbers,
)

#: Where the bonds of an `Atoms` object are kept: pairs of atoms, in ``atoms.info``.
BONDS = "bonds"
#: ASE's unit of time in ps, to the power that velocities need.
PS = 1000 * units.fs
_ITEM = f"atoms.info[{BONDS!r}]"
REMEDY = f"put pairs of atoms into {_ITEM}"


@with_options
def constraints_of(atoms: Atoms, constrain: str | None = "hbonds", **options: Unpack[Options]) -> HeldRows:
    """Rows by name for ASE `Atoms`, in angstrom; give them to `kcons.ase.constrain`.

    Residues are those of ``atoms.arrays['residuenames']`` and ``['residuenumbers']``, as ASE reads them from PDB files;
    without them, molecules are found by their bonds and water by its composition. Bonds are the pairs in
    ``atoms.info['bonds']``; missing ones are guessed.

    Parameters
    ----------
    atoms : ase.Atoms
    **options
    """
    return rows_of(snapshot_of(atoms), Holding(constrain, **options), partial(selected_numbers, n=len(atoms)), REMEDY)


def rigid_water(atoms: Atoms, geometry: str | tuple[float, float] | None = None) -> Distance:
    """Hold all water molecules rigid, and nothing else: three distances each.

    A water is an oxygen with two hydrogens so near that they are bonded to it, whatever names and bonds atoms have.

    Parameters
    ----------
    atoms : ase.Atoms
    geometry : str, (float, float) or None
        A named model, such as 'tip3p' (0.9572 angstrom, 104.52 degrees), or O-H length and H-O-H angle in degrees. None
        holds each molecule as it is.

    Raises
    ------
    InputError
        No water, or one that is odd. (A hydrogen too far from all atoms to be bonded gives a warning.)
    """
    require_atoms(atoms)
    numbers = np.where(np.isin(atoms.numbers, (1, 8)), atoms.numbers, atomic_numbers["Ar"])  # which has no bonds
    others = Atoms(numbers, atoms.positions, masses=atoms.get_masses(), cell=atoms.cell, pbc=atoms.pbc)
    with warnings.catch_warnings(action="ignore"):  # of hydrogens elsewhere
        found = constraints_of(others, "none", water_geometry=geometry, guess_bonds=True)
        loose = found.loose_hydrogens
        loose = np.setdiff1d(loose, guess_bonds(snapshot_of(atoms), np.isin(range(len(atoms)), loose)))
    if len(loose):
        text = f"{len(loose)} hydrogens have no bond, the first of which is {loose[0]}: no held water has them"
        warnings.warn(f"{text}. Move them nearer; if faces cut molecules, set atoms.cell and atoms.pbc", stacklevel=2)
    assert isinstance(found[0], Distance)
    return found[0]


def require_atoms(atoms: object) -> None:
    """Refuse anything else, such as the list that ``ase.io.read`` gives of several frames."""
    require_kind(atoms, Atoms, "atoms", "an ase.Atoms object, as ase.io.read(file) gives it")


def velocities_of(atoms: Atoms, dynamics: Any = None, *, momenta: FloatArray | None = None) -> FloatArray:
    """As ``atoms.get_velocities()``, or of other momenta, but 0 for fixed atoms without mass: ASE divides 0 by 0."""
    if hasattr(dynamics, "motion"):  # of kcons, which knows those of fixed atoms that move: these have no momenta
        return dynamics.state.velocities  # type: ignore[no-any-return]
    momenta, masses = atoms.get_momenta() if momenta is None else momenta, atoms.get_masses()[:, np.newaxis]
    return np.divide(momenta, masses, out=np.zeros_like(momenta), where=(masses != 0.0) | (momenta != 0.0))


def snapshot_of(atoms: Atoms) -> Snapshot:
    """Topology and positions of `atoms`.

    Atoms with names and residues get the element that the name says, since ASE reads PDB files without a column of
    elements as if 'HG' were mercury; `repair_elements` corrects the atoms themselves.
    """
    require_atoms(atoms)
    n = len(atoms)
    arrays = atoms.arrays
    symbols = np.array(chemical_symbols)[atoms.numbers]
    elements = np.where(atoms.numbers == 0, "", symbols)
    names = np.char.strip(np.asarray(arrays.get("atomtypes", symbols)).astype(str))
    called, chains = (np.asarray(arrays.get(each, [""] * n)).astype(str) for each in ("residuenames", "chainids"))
    called, numbers = np.char.strip(called), np.asarray(arrays.get("residuenumbers", np.ones(n, np.int64)))
    known = "residuenames" in arrays
    residues, first = np.zeros(n, np.int64), np.arange(min(n, 1))
    if known:
        residues, first = split_residues(names, called, numbers, chains)
    residue_names, ids, chains = called[first], numbers[first].astype(str), chains[first]
    if known and "atomtypes" in arrays:
        elements = _repaired(elements, names, residues, residue_names)
    masses = atoms.get_masses()
    if "masses" not in arrays:
        masses = np.array([atomic_masses[atomic_numbers[e]] if e else 0.0 for e in elements.tolist()])
    bonds = check_pairs(atoms.info.get(BONDS, np.zeros((0, 2), np.int64)), n, _ITEM)
    charges = atoms.get_initial_charges() if "initial_charges" in arrays else None
    topology = Topology(
        names,
        elements,
        masses,
        residues,
        residue_names,
        ids,
        chains,
        sorted_pairs(bonds),
        charges,
        residues_known=known,
    )
    cell = atoms.cell.array.copy() if atoms.pbc.any() else None
    velocities = velocities_of(atoms) * PS if "momenta" in arrays else None
    return Snapshot(topology, atoms.positions.copy(), 1.0, cell, atoms.pbc.copy(), velocities, "Atoms object")


def bonds_of(atoms: Atoms) -> IntArray:
    """Bonds of `atoms`: the pairs in ``atoms.info['bonds']``; those of molecules without any there are guessed.

    Atoms of elements that form no covalent bonds, and those whose position is not finite, have none. Shape (n, 2).
    """
    with warnings.catch_warnings(action="ignore"):
        snapshot = snapshot_of(atoms)
    given, lacking = snapshot.topology.bonds, atoms.numbers > 0
    lacking[given] = False
    if not lacking.any():
        return given
    found = guess_bonds(snapshot, lacking, np.isfinite(atoms.positions).all(axis=1))
    molecule, _ = connected(np.concatenate([given, found]), len(atoms))
    return np.concatenate([given, found[~np.isin(molecule[found[:, 0]], molecule[given])]])


def repair_elements(atoms: Atoms) -> int:
    """Give atoms of residues the elements that their names say, in place; how many changed.

    ASE's reader takes atom names for symbols where a PDB file has no column of elements. Elements other than hydrogen
    are left, with a warning, where some of them can only have come from such a column.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*the names are followed")
        topology = snapshot_of(atoms).topology
    numbers = np.array([atomic_numbers[e] if e else 0 for e in topology.elements.tolist()], dtype=np.int64)
    changed = int(np.sum(numbers != atoms.numbers))
    atoms.numbers[:] = numbers
    return changed


def repartition_hydrogen_mass(atoms: Atoms, mass: float = 3.0) -> int:
    """Give hydrogens more mass, in place, and take it from the heavy atoms that they are bonded to; how many have it.

    This slows the angles of hydrogens, so that with their bonds held steps may be 4 fs; averages of configurations stay
    as they are. The same as OpenMM's ``hydrogenMass``: water stays as it is. A second call with the same mass changes
    nothing. Momenta stay: draw velocities afterwards.

    Parameters
    ----------
    atoms : ase.Atoms
        Bonds are the pairs in ``atoms.info['bonds']``; without them they are guessed.
    mass : float
        Of each hydrogen that is bonded to a heavy atom, in dalton.

    Raises
    ------
    InputError
        A heavy atom would be lighter than its hydrogens. Nothing is changed then.
    """
    mass = positive(mass, "mass")
    bonds = bonds_of(atoms)
    light = atoms.numbers == 1
    pairs = bonds[light[bonds].sum(axis=1) == 1]
    pairs = np.where(light[pairs[:, :1]], pairs, pairs[:, ::-1])  # hydrogen, heavy
    count, among = (np.bincount(end, minlength=len(atoms)) for end in (bonds.ravel(), pairs[:, 1]))
    pairs = pairs[~((atoms.numbers == 8) & (count == 2) & (among == 2))[pairs[:, 1]]]
    # Of a bridge, from the first of its heavy atoms.
    pairs = pairs[np.unique(pairs[:, 0], return_index=True)[1]]
    masses = atoms.get_masses()
    np.subtract.at(masses, pairs[:, 1], mass - masses[pairs[:, 0]])
    masses[pairs[:, 0]] = mass
    left = masses[pairs[:, 1]]
    if len(pairs) and left.min() < mass:
        atom = int(pairs[np.argmin(left), 1])
        raise InputError(
            f"hydrogens of {mass:g} dalton leave {left.min():.3g} to atom {atom} ({atoms.symbols[atom]}), to which "
            "they are bonded; give a smaller mass",
            item="mass",
            atoms=[atom],
        )
    atoms.set_masses(masses)
    return len(pairs)


def atoms_of(snapshot: Snapshot) -> Atoms:
    """`Atoms` with names, residues, bonds, masses, charges, cell and velocities."""
    snapshot = snapshot.in_unit(1.0)
    topology = snapshot.topology
    numbers = [atomic_numbers.get(e, 0) if e else 0 for e in topology.elements.tolist()]
    atoms = Atoms(numbers, positions=snapshot.positions, masses=topology.masses, cell=snapshot.cell, pbc=snapshot.pbc)
    atoms.new_array("atomtypes", topology.names)
    if topology.residues_known:
        atoms.new_array("residuenames", topology.residue_names[topology.residues])
        atoms.new_array("residuenumbers", whole_numbers(topology.residue_ids)[topology.residues])
        atoms.new_array("chainids", topology.chains[topology.residues])
    if topology.charges is not None:
        atoms.set_initial_charges(topology.charges)
    if len(topology.bonds):
        atoms.info[BONDS] = topology.bonds
    if snapshot.velocities is not None:
        atoms.set_velocities(snapshot.velocities / PS)
    return atoms


def _had_elements(elements: NDArray[np.str_], by_name: NDArray[np.str_], names: NDArray[np.str_]) -> bool:
    """Whether an atom has the right element where ASE, by the name alone, takes two letters for a symbol."""
    right = (elements == by_name) & (np.char.str_len(elements) == 1) & (by_name != "H")
    return any(name[:2].capitalize() in atomic_numbers for name in set(names[right].tolist()) if name[1:2].isalpha())


def _repaired(
    elements: NDArray[np.str_], names: NDArray[np.str_], residues: IntArray, residue_names: NDArray[np.str_]
) -> NDArray[np.str_]:
    """Elements by name where a name contradicts the symbol."""
    by_name = elements_of(names, residues, residue_names, None)
    wrong = (by_name != elements) & (by_name != "") & (np.char.upper(elements) != np.char.upper(by_name))
    # A name that begins otherwise says nothing about the element (C1 of a chlorine, X1): the symbol stays.
    start = np.array([name.lstrip("0123456789")[:2].upper() for name in names[wrong].tolist()] or [""])[: wrong.sum()]
    wrong[np.flatnonzero(wrong)] = np.char.upper(elements[wrong]) == start
    # Hydrogens may have been added by a program that writes no elements, other atoms come from one file.
    left = wrong & (by_name != "H")
    if left.any() and _had_elements(elements, by_name, names):
        atom = int(np.argmax(left))
        warnings.warn(
            f"{int(left.sum())} elements are not what names suggest, such as {elements[atom]} of {names[atom]} in "
            f"{residue_names[residues[atom]]}; they are left, since other atoms have elements that ASE read from the "
            "file and not from names. Set atoms.symbols where they are wrong",
            stacklevel=4,
        )
        wrong &= ~left
    if not wrong.any():
        return elements
    atom = int(np.argmax(wrong))
    warnings.warn(
        f"{int(wrong.sum())} atoms have elements that their names contradict, such as {names[atom]} of "
        f"{residue_names[residues[atom]]}, which is no {elements[atom]}; the names are followed. "
        "kcons.ase.repair_elements(atoms) corrects the atoms",
        stacklevel=4,
    )
    return np.where(wrong, by_name, elements)
