"""Constraints from an MDAnalysis `Universe`, with its selection language."""

from __future__ import annotations

import warnings
from typing import Any, Unpack

import MDAnalysis
import numpy as np
from MDAnalysis.coordinates.memory import MemoryReader
from MDAnalysis.guesser import tables
from MDAnalysis.lib.mdamath import triclinic_box, triclinic_vectors
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, NonFiniteError, did_you_mean
from kcons.motion.motion import Motion
from kcons.steppers import State
from kcons.topology.rows_by_name import HeldRows, Holding, Options, rows_of, with_options
from kcons.topology.topology import (
    Snapshot,
    Topology,
    as_written,
    elements_of,
    guessed_masses,
    listed,
    require_kind,
    require_standard_form,
    sorted_pairs,
)

__all__ = ["constraints_of", "selected", "snapshot_of"]

#: Cells narrower than this, in angstrom, are none: files without one have lengths of 1.
NARROWEST = 2.0
#: Vectors whose volume is this part of the product of their lengths or less span no cell.
_FLAT = 1e-6
_REMEDY = "load a topology that has them (PSF, TPR, PRMTOP, MOL2, ...)"


@with_options
def constraints_of(universe: Any, constrain: str | None = "hbonds", **options: Unpack[Options]) -> HeldRows:
    """Rows by name, in angstrom, with targets of the present frame.

    Parameters
    ----------
    universe : Universe or AtomGroup
        Atoms of a group are counted within the group; those of a Universe as it counts them.
    **options
    """
    _require_atoms(universe)
    group = universe.atoms

    def numbers(words: Any) -> IntArray:
        return np.flatnonzero(np.isin(group.indices, selected(group, words)))

    return rows_of(snapshot_of(universe), Holding(constrain, **options), numbers, _REMEDY)


def selected(universe: Any, words: Any) -> IntArray:
    """Numbers of the atoms that a selection matches, or that an AtomGroup has, as the Universe counts them.

    Raises
    ------
    InputError
        Words that MDAnalysis does not understand, or that match nothing; with names that exist. Atoms that are not
        among those of `universe`; neither words nor an AtomGroup.
    """
    if isinstance(words, MDAnalysis.AtomGroup):
        if not len(words) or words.universe is not universe.universe or not words.issubset(universe.atoms):
            raise InputError(f"{words!r} as a selection: give some of the atoms of {universe!r}", item="select")
        return words.unique.indices.astype(np.int64)
    if not isinstance(words, str):
        raise InputError(
            f"selection {words!r:.60}: give words of MDAnalysis, such as 'protein' or 'index 0:9', or an AtomGroup",
            item="select",
        )
    try:
        found = universe.atoms.select_atoms(words)
    except Exception as error:  # MDAnalysis raises SelectionError, and others for odd words
        why = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"selection {words!r} cannot be read: {why}", item="select") from error
    if not len(found):
        raise InputError(f"selection {words!r} matches nothing{_hint(universe.atoms, words)}", item="select")
    return found.indices.astype(np.int64)


def _hint(group: Any, words: str) -> str:
    """What there is instead of what a selection asks for."""
    tokens = words.replace("(", " ").replace(")", " ").split()
    asked = dict(zip(tokens, [*tokens[1:], ""], strict=True))
    for keyword in ("resname", "name", "segid", "element"):
        if keyword in asked and hasattr(group, f"{keyword}s"):
            present = np.unique(getattr(group, f"{keyword}s").astype(str)).tolist()
            if (given := asked[keyword]) not in present:
                return f": no {keyword} {given}{did_you_mean(given, present)}; there are {listed(present)}"
    if "resid" in asked and hasattr(group, "resids"):
        return f"; residues are numbered {group.resids.min()} to {group.resids.max()}"
    return "; names are those of the topology, case counts"


def snapshot_of(universe: Any) -> Snapshot:
    """Topology, positions and cell of a Universe or AtomGroup at the present frame.

    MDAnalysis keeps positions in single precision; decimals of the file they came from are restored.

    Raises
    ------
    InputError
        No Universe or AtomGroup; no coordinates; an atom that is twice in a group, or at alternate locations.
    """
    _require_atoms(universe)
    group = universe.atoms
    whole = group.universe
    if not len(group):
        raise InputError("there are no atoms in the group", item="atoms")
    _, first = np.unique(group.indices, return_index=True)
    for twice in np.setdiff1d(np.arange(len(group)), first).tolist():
        said = f"the group has atom {group.indices[twice]} of its Universe twice, the second time in place {twice}"
        raise InputError(f"{said}; take group.unique", item="atoms", atoms=[twice])
    try:
        step = whole.trajectory.ts
        x = as_written(group.positions)
    except (AttributeError, MDAnalysis.exceptions.NoDataError):
        said = f"{host_of(whole)} has no coordinates; load a coordinates file beside it"
        raise InputError(said, item="positions") from None
    require_angstrom(whole.trajectory)
    # Of a part, only the atoms of the part; but whole residues keep their numbers.
    described = topology_of(universe)
    _refuse_alternates(group, described)
    cell = None
    if step.dimensions is not None and np.all(step.dimensions[:3] > NARROWEST):
        cell = triclinic_vectors(as_written(np.asarray(step.dimensions)), dtype=np.float64)
    velocities = as_written(group.velocities) if step.has_velocities and velocities_known(whole.trajectory) else None
    return Snapshot(described, x, 1.0, cell, np.full(3, cell is not None), velocities, host_of(whole), group.indices)


def _refuse_alternates(group: Any, topology: Topology) -> None:
    """An atom at two places is two atoms in MDAnalysis, and no molecule."""
    places = np.char.strip(_texts(group, "altLocs"))
    if not (places != places[0]).any():
        return
    there: dict[tuple[int, str], int] = {}
    for atom in np.flatnonzero(places != "").tolist():
        other = there.setdefault((int(topology.residues[atom]), str(topology.names[atom])), atom)
        if places[atom] != places[other]:
            raise InputError(
                f"{topology.atom_name(other)} is at alternate locations, {places[other]} and {places[atom]}: give one "
                f"of them, such as universe.select_atoms('not altloc {places[atom]}'), or take one out of the file",
                item="atoms",
                atoms=[other, atom],
            )


def require_angstrom(reader: Any) -> None:
    """Refuse coordinates that MDAnalysis was told to leave in nanometers."""
    length = (getattr(reader, "units", None) or {}).get("length")
    if getattr(reader, "convert_units", True) is False and length not in (None, "Angstrom", "A"):
        raise InputError(
            f"positions are in {length}, since the Universe was made with convert_units=False; make it without",
            item="positions",
        )


def _require_atoms(universe: Any) -> None:
    if not isinstance(getattr(universe, "atoms", None), MDAnalysis.AtomGroup):
        wanted = "a Universe or AtomGroup, as MDAnalysis.Universe(topology, coordinates) gives it"
        require_kind(universe, MDAnalysis.Universe, "universe", wanted)


def topology_of(universe: Any) -> Topology:
    """Names, elements, residues, bonds and masses of a Universe or AtomGroup."""
    group, whole = universe.atoms, universe.universe
    n = len(group)
    _, first, residues = np.unique(group.resindices, return_index=True, return_inverse=True)
    # Residues by their first atoms in the group, which need not be in the order of the Universe.
    order = np.argsort(first)
    heads, residues = group[first[order]], np.argsort(order)[residues].astype(np.int64)
    names = _texts(group, "names" if hasattr(group, "names") else "types")
    residue_names = _texts(heads, "resnames")
    masses = np.asarray(group.masses, dtype=np.float64) if hasattr(group, "masses") else np.zeros(n)
    attributes = whole._topology.attrs
    measured = hasattr(group, "masses") and not all(a.is_guessed for a in attributes if a.attrname == "masses")
    elements = np.char.capitalize(np.char.strip(_texts(group, "elements")))
    heavy = elements == "D"
    elements = np.where(heavy, "H", elements)
    lacking = elements == ""
    if lacking.any():
        found = elements_of(names, residues, residue_names, masses if measured else None)
        elements = np.where(lacking, found, elements)
    if hasattr(group, "masses") and not measured:
        # Masses that somebody set later are theirs.
        mended = guessed_masses(masses, names, np.where(heavy, "D", elements))
        # What MDAnalysis gives by elements or types, whatever the atoms are.
        kinds = _texts(group, "elements" if hasattr(group, "elements") else "types").tolist()
        guess = [float(tables.masses.get(k, tables.masses.get(k.upper(), 0.0))) for k in kinds]
        masses = np.where(masses == guess, mended, masses)
    chains = _texts(heads, "chainIDs" if hasattr(group, "chainIDs") else "segids")
    # Without the objects that MDAnalysis makes of them.
    pairs = next((a.values for a in attributes if a.attrname == "bonds"), ())
    bonds = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    if n != len(whole.atoms) or not np.array_equal(group.indices, np.arange(n)):
        new = np.full(len(whole.atoms), -1, dtype=np.int64)
        new[group.indices] = np.arange(n)
        bonds = new[bonds]
        bonds = bonds[(bonds >= 0).all(axis=1)]
    return Topology(
        names=names,
        elements=elements,
        masses=masses,
        residues=residues,
        residue_names=residue_names,
        residue_ids=_texts(heads, "resids") if hasattr(group, "resids") else group.resindices[first[order]].astype(str),
        chains=np.where(chains == "SYSTEM", "", chains),
        bonds=sorted_pairs(bonds),
        charges=np.asarray(group.charges, dtype=np.float64) if hasattr(group, "charges") else None,
        residues_known=bool((np.char.strip(residue_names) != "").any()),
    )


def _texts(group: Any, name: str) -> NDArray[np.str_]:
    """An attribute of the atoms as text; '' where there is none."""
    return np.asarray(getattr(group, name)).astype(str) if hasattr(group, name) else np.full(len(group), "")


def check_box(cell: FloatArray, pbc: ArrayLike = True, stacklevel: int = 2) -> None:
    """Refuse a cell that no box of MDAnalysis can be, and warn of one that is periodic in some directions only."""
    if cell.shape != (3, 3):
        raise InputError(f"the cell is {cell.tolist()}; give three vectors as rows", item="cell")
    if not np.isfinite(cell).all():
        raise NonFiniteError(f"the cell is not finite: {cell.tolist()}", item="cell")
    if cell.any() and abs(np.linalg.det(cell)) <= _FLAT * np.prod(np.linalg.norm(cell, axis=1)):
        raise InputError(
            f"the cell {cell.tolist()} has no volume; give it a vector in each direction (ase: atoms.center(vacuum=10, "
            "axis=2)), or none",
            item="cell",
        )
    if not np.all(pbc):
        warnings.warn("boxes of files, OpenMM are periodic in all directions; this cell is not", stacklevel=stacklevel)
    require_standard_form(cell, "MDAnalysis")


def dimensions_of(cell: FloatArray, pbc: ArrayLike = True, stacklevel: int = 2) -> NDArray[np.float32]:
    """Lengths and angles of a cell, with a positive diagonal: those of others would be of its mirror image."""
    check_box(cell, pbc, stacklevel + 1)
    return np.asarray(triclinic_box(*(cell * np.where(np.diag(cell) < 0, -1.0, 1.0)[:, None])))


def cell_of(state: State, motion: Motion | None) -> FloatArray | None:
    """The cell that a state is written with; refuses one that is not that of `motion` any more."""
    cell, lattice = state.cell, None if motion is None else motion.lattice
    if lattice is None:
        return cell
    if cell is not None and not (cell == lattice[0])[lattice[1].any(axis=0)].all():
        raise InputError(
            "the state is in another cell than its System is now; write states during the run, or call "
            "system.enter(state) before",
            item="state",
        )
    return lattice[0]


def host_of(whole: Any) -> str:
    """Where a `Snapshot` of a Universe says that it came from."""
    return f"topology {getattr(whole, 'filename', None) or 'of the Universe'}"


def velocities_known(reader: Any) -> bool:
    """Whether velocities are in angstrom/ps: of dumps of LAMMPS nobody tells their unit."""
    named = (getattr(reader, "units", None) or {}).get("velocity", "")
    return named is not None or isinstance(reader, MemoryReader)
