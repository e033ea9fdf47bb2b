"""Molecules from any topology that MDAnalysis reads, with forces of OpenMM or of an ASE calculator."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kcons.comparison.test_systems.openmm_engine import ASE_LENGTH, OpenMMEngine
from kcons.comparison.test_systems.potential import Potential, of_calculator
from kcons.comparison.test_systems.structure import (
    FORCE_FIELD,
    TEMPERATURE,
    force_field_of,
    molecules_at_300_k,
    platform_of,
    system_of,
)
from kcons.comparison.test_systems.system import TestSystem
from kcons.constraints import Distance
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.topology.whole_molecules import whole_molecules

if TYPE_CHECKING:
    from kcons.topology.rows_by_name import HeldRows

#: Forces by name, beside those of OpenMM and what ASE knows.
CALCULATORS = ("emt", "lj", "tip3p", "gfn1", "gfn2")


@dataclass(frozen=True)
class Plan:
    """What is held in a file, before any forces.

    Attributes
    ----------
    title : str
    rows : HeldRows
        In angstrom.
    positions : ndarray, shape (n_atoms, 3)
        On the constraints.
    motion : Motion
    notes : tuple of str
        What was guessed.
    """

    title: str
    rows: HeldRows
    positions: FloatArray
    motion: Motion
    notes: tuple[str, ...]


def plan(
    path: Path | str,
    *,
    coordinates: Path | str | None = None,
    constrain: str = "hbonds",
    select: str = "all",
    angles: str = "angles",
) -> Plan:
    """Constraints of a file.

    Parameters
    ----------
    path : path
        A topology, or a file with both.
    coordinates : path, optional
        Coordinates or a trajectory, of which the first frame counts.
    constrain, select, angles
        As for `kcons.mdanalysis.constraints_of`.

    Raises
    ------
    InputError
        The files cannot be read or do not fit each other; what `constraints_of` raises.
    UnsupportedError
        MDAnalysis is not installed.
    """
    if find_spec("MDAnalysis") is None:
        raise UnsupportedError(f"{path} needs MDAnalysis; python -m pip install 'kcons[mdanalysis]'")
    for name in (path, *([coordinates] if coordinates else [])):
        if not Path(name).is_file():
            raise InputError(f"there is no file {name}", item="file")
    from kcons.mdanalysis import constraints_of, open_universe

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        universe = open_universe(path, coordinates)
        try:
            rows = constraints_of(
                universe,
                constrain,
                select=select,
                angles=angles,  # type: ignore[arg-type]
            )
        except KconsError as error:
            error.args = (f"{path}: {error}",)
            raise
    told = ("were guessed from distances", "no bond was guessed")
    notes = tuple(str(w.message) for w in caught if any(words in str(w.message) for words in told))
    held = rows.constraint_set
    start = rows.snapshot.positions
    motion = Motion(held, start)
    what = f"{Path(path).name}, {held.n_atoms} atoms, {constrain}: {rows.summary()}"
    return Plan(what, rows, motion.restore_positions(start), motion, notes)


def from_file(
    path: Path | str,
    rng: int = 1,
    *,
    coordinates: Path | str | None = None,
    constrain: str = "hbonds",
    select: str = "all",
    forces: str = "openmm",
    force_field: Sequence[str] | None = None,
    platform: str = "",
) -> TestSystem:
    """The molecules of a file at 300 K.

    Angles are held as distances of their ends, which all MD engines can do.

    Parameters
    ----------
    path, coordinates, constrain, select
        See `plan`.
    rng : int
        Of the velocities.
    forces : str
        'openmm'; 'emt', 'lj', 'tip3p', 'gfn1', 'gfn2', or the name of any calculator of ASE; or force fields of OpenMM
        by name, separated by commas: 'amber14-all,amber14/tip3p'. Of OpenMM's 'tip3p.xml' the ending has to be said.
    force_field : sequence of str, optional
        Files for openmm.app.ForceField, where forces are 'openmm'.
    platform : str
        Of OpenMM.

    Raises
    ------
    InputError, UnsupportedError
        As `plan`; unknown forces, or forces that do not fit the atoms.
    """
    named = _force_fields(forces)
    if named is not None and force_field is not None:
        raise InputError(f"forces are {forces!r} already; leave --forcefield out", item="force_field")
    found = plan(
        path,
        coordinates=coordinates,
        constrain=constrain,
        select=select,
        angles="distances",
    )
    for note in found.notes:
        warnings.warn(note, UserWarning, stacklevel=2)
    snapshot = found.rows.snapshot
    if len(found.rows.virtual_sites):
        raise UnsupportedError(
            f"{path} has {len(found.rows.virtual_sites)} virtual sites (TIP4P or the like); here every particle has to "
            "move by itself. `kcons plan` and kcons.mdanalysis.to_openmm take them"
        )
    snapshot = whole_molecules(replace(snapshot, positions=found.positions))
    x = snapshot.positions
    md_engine: OpenMMEngine | None = None
    if named is not None or forces.lower() == "openmm":
        md_engine = _openmm_engine(snapshot, found.rows, named or force_field or FORCE_FIELD, platform)
        potential = md_engine.potential()
    else:
        potential = _of_ase(snapshot, forces)
    masses, cell = snapshot.topology.masses, snapshot.cell
    if md_engine is not None:
        system = md_engine.system
        masses = np.array([system.getParticleMass(k)._value for k in range(len(x))])
    held = ConstraintSet(list(found.rows), x, masses, cell=cell, pbc=snapshot.pbc.tolist())
    return molecules_at_300_k(
        Path(path).stem,
        f"{found.title}, {TEMPERATURE:g} K; ",
        held,
        x,
        rng,
        potential=potential,
        symbols=[e or "X" for e in snapshot.topology.elements.tolist()],
        bonds=_distances(found.rows),
        cell=cell,
        openmm=md_engine,
    )


def _distances(rows: HeldRows) -> IntArray | None:
    """Pairs, where distances are all that is held."""
    if not all(isinstance(item, Distance) for item in rows):
        return None
    return np.concatenate([item.atoms for item in rows])


def _force_fields(forces: str) -> tuple[str, ...] | None:
    """Files of OpenMM that are named, None if something else is."""
    names = [name.strip() for name in forces.split(",")]
    if len(names) == 1 and names[0].lower() in ("openmm", *CALCULATORS):
        return None
    files = tuple(name if name.endswith(".xml") else f"{name}.xml" for name in names)
    if len(names) == 1 and files[0] != names[0] and not _has_force_field(files[0]):
        return None
    return files


def _has_force_field(file: str) -> bool:
    found = find_spec("openmm")
    if found is None or found.origin is None:
        return False
    return (Path(found.origin).parent / "app" / "data" / file).is_file()


def _openmm_engine(snapshot: Any, rows: HeldRows, force_field: Sequence[str], platform: str) -> OpenMMEngine:
    if find_spec("openmm") is None:
        raise UnsupportedError("these forces need OpenMM; python -m pip install openmm, or --forces emt, gfn2, ...")
    from kcons.openmm.topology import openmm_topology

    if not all(isinstance(item, Distance) for item in rows):
        raise UnsupportedError(
            "OpenMM's System holds distances only; leave out what needs linear rows (rigid residues), or give --forces "
            "of an ASE calculator"
        )
    topology, _ = openmm_topology(snapshot)
    platform = platform_of(snapshot.topology.n_atoms, platform)
    system = system_of(topology, force_field_of(force_field), None, False)
    for item in rows:
        lengths = (np.asarray(item.target) * ASE_LENGTH).tolist()
        for (i, j), length in zip(item.atoms.tolist(), lengths, strict=True):
            system.addConstraint(i, j, length)
    return OpenMMEngine(lambda: system, platform=platform, home=True)


def _of_ase(snapshot: Any, name: str) -> Potential:
    """Forces of an ASE calculator, tried once."""
    from kcons.ase.topology import atoms_of

    atoms = atoms_of(snapshot)
    calculator = _calculator(name, atoms)
    potential = of_calculator(atoms, calculator, f"ASE's {name}")
    try:
        finite = bool(np.all(np.isfinite(potential.forces(atoms.positions))))
    except Exception as error:  # calculators raise whatever they like
        text = " ".join(str(error.__cause__ or error).split()) or type(error).__name__
        raise InputError(
            f"the calculator {name} fails on these atoms: {text}; choose other --forces", item="forces"
        ) from error
    if not finite:
        raise InputError(f"the calculator {name} gives forces that are not finite; choose others", item="forces")
    potential.forget()
    return potential


def _calculator(name: str, atoms: Any) -> Any:
    from kcons.ase.named_calculators import named_calculator

    word, settings = name if ":" in name else name.lower(), {}
    if word == "tip3p":
        widths = atoms.cell.lengths()[atoms.pbc]
        cutoff = min(9.0, 0.49 * float(widths.min())) if len(widths) else 9.0
        settings = {"rc": cutoff, "width": min(1.0, cutoff / 3)}
    try:
        return named_calculator(word, settings)
    except InputError as error:
        raise InputError(
            f"no forces {name!r}; there are openmm, {', '.join(CALCULATORS)}, force fields of OpenMM by name (such as "
            f"amber14-all,amber14/tip3p), and the calculators of ASE that need no settings ({error})",
            item="forces",
        ) from error
