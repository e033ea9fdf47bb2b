"""Molecules of a file, or of one that comes with the package; forces of OpenMM or of an ASE calculator."""

from __future__ import annotations

import lzma
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from ase import units

from kcons.comparison.test_systems.openmm_engine import ASE_LENGTH, OpenMMEngine, place
from kcons.comparison.test_systems.potential import Potential, of_calculator
from kcons.comparison.test_systems.registry import SYSTEMS, add_system
from kcons.comparison.test_systems.system import TestSystem, thermal_velocities
from kcons.constraints import Distance
from kcons.constraints.arguments import Rng, seed_from
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.topology.topology import whole_molecules

if TYPE_CHECKING:
    from kcons.topology.rows_by_name import HeldRows

TEMPERATURE = 300.0
#: Files that OpenMM reads; all others, and these where only a part is held, are read by MDAnalysis.
SUFFIXES = (".pdb", ".ent", ".cif", ".pdbx", ".mmcif")
FORCE_FIELD = ("amber14-all.xml", "amber14/tip3pfb.xml")
#: Forces by name, beside those of OpenMM and what ASE knows.
CALCULATORS = ("emt", "lj", "tip3p", "gfn1", "gfn2")
#: Cutoff of PME in nm, less in narrow boxes, and the least; where dispersion begins to be switched off.
CUTOFF, SHORTEST, SWITCH = 0.9, 0.4, 0.9
#: Tight enough that the order of a method can be seen, at a tenth more cost than OpenMM's default.
EWALD_TOLERANCE = 5e-5
#: Up to this size OpenMM's Reference platform, which computes in double precision, is fast enough.
FEW_ATOMS, MANY_ATOMS = 200, 3000

#: File (of the package, or of OpenMM where none is named), what is held, and what it is.
STRUCTURES: Mapping[str, tuple[str, str, str]] = {
    "alanine": ("alanine-dipeptide-implicit.pdb.xz", "allbonds", "alanine dipeptide in vacuum"),
    "dhfr": ("5dfr_minimized.pdb.xz", "allbonds", "dihydrofolate reductase in vacuum"),
    "dhfr-water": ("5dfr_solv-cube_equil.pdb.xz", "hbonds", "dihydrofolate reductase in water"),
    "villin": ("", "hbonds", "villin headpiece in water"),
}


def is_file(name: str) -> bool:
    """Whether a name is that of a file: it exists, or has a suffix, and is no test system."""
    return name not in SYSTEMS and (Path(name).is_file() or Path(name).suffix != "")


@dataclass(frozen=True)
class Plan:
    """What is held in a file, before any forces: rows in angstrom, positions on them, and what was guessed."""

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
    hydrogens: Any = None,
    frame: int = 0,
) -> Plan:
    """Constraints of a file.

    Parameters
    ----------
    path : path
        A topology, or a file with both.
    coordinates : path, optional
        Coordinates or a trajectory, of which one `frame` counts.
    constrain, select, angles
        As for `kcons.mdanalysis.constraints_of`.
    hydrogens : openmm.app.ForceField, optional
        By which hydrogens that are missing are added, at pH 7.

    Raises
    ------
    InputError
        The files cannot be read or do not fit each other; what `constraints_of` raises.
    UnsupportedError
        MDAnalysis is needed and not installed.
    """
    path = Path(path)
    for name in (path, coordinates or path):
        if not Path(name).is_file():
            raise InputError(f"there is no file {name}", item="file")
    by_openmm = path.suffix.lower() in SUFFIXES and coordinates is None and select == "all" and find_spec("openmm")
    if hydrogens is not None and not by_openmm:
        raise InputError("hydrogens are added to PDB and mmCIF files alone, all of them held", item="add_hydrogens")
    if not by_openmm and find_spec("MDAnalysis") is None:
        raise UnsupportedError(f"{path} needs MDAnalysis; python -m pip install 'kcons[mdanalysis]'")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            if by_openmm:
                rows = _by_openmm(path.read_text("utf-8", "replace"), path, constrain, angles, hydrogens)
            else:
                from kcons.mdanalysis import constraints_of, open_universe

                universe = open_universe(path, coordinates)
                if coordinates is not None:
                    _ = universe.trajectory[frame]
                rows = constraints_of(universe, constrain, select=select, angles=angles)  # type: ignore[arg-type]
        except KconsError as error:
            error.args = (f"{path}: {error}",)
            raise
    told = ("were guessed from distances", "no bond was guessed", "its cell is not read")
    said = (str(w.message).partition(", or pass guess_bonds=")[0] for w in caught)
    return _planned(path.name, rows, constrain, tuple(line for line in said if any(words in line for words in told)))


def _planned(name: str, rows: HeldRows, constrain: str, notes: tuple[str, ...] = ()) -> Plan:
    motion = Motion(rows.constraint_set, rows.snapshot.positions)
    what = f"{name}, {rows.constraint_set.n_atoms} atoms, {constrain}: {rows.summary()}"
    return Plan(what, rows, motion.restore_positions(rows.snapshot.positions), motion, notes)


def _by_openmm(text: str, path: Path, constrain: str, angles: str, hydrogens: Any = None) -> HeldRows:
    """Rows of a PDB or mmCIF file, in angstrom."""
    from openmm import app

    from kcons.openmm.topology import snapshot_of
    from kcons.topology.rows_by_name import Holding, rows_of

    try:
        kind = app.PDBFile if path.suffix.lower() in (".pdb", ".ent", ".xz", "") else app.PDBxFile
        molecule = kind(StringIO(text))
        topology, x = molecule.topology, molecule.positions
        if not topology.getNumAtoms():
            raise ValueError("it has no atoms")
    except Exception as error:  # OpenMM's readers raise whatever went wrong inside of them
        said = f"does it hold molecules, in the format of its ending? ({type(error).__name__}: {error})"
        raise InputError(f"it cannot be read; {said}", item="file") from error
    if hydrogens is not None:
        modeller = app.Modeller(topology, x)
        try:
            # Without a platform the fastest is taken, of whatever precision, and hydrogens differ between machines.
            modeller.addHydrogens(hydrogens, platform=place("CPU"))
        except ValueError as error:
            raise _explained(error, topology) from error
        topology, x = modeller.topology, modeller.positions
    snapshot = snapshot_of(topology, x).in_unit(1.0)
    holding = Holding(constrain, angles=angles)  # type: ignore[arg-type]
    return rows_of(snapshot, holding, np.asarray, "mend the file")


def from_file(
    path: Path | str,
    rng: Rng = 1,
    *,
    quick: bool = False,
    coordinates: Path | str | None = None,
    frame: int = 0,
    constrain: str = "hbonds",
    select: str = "all",
    forces: str = "openmm",
    force_field: Sequence[str] | None = None,
    add_hydrogens: bool = False,
    platform: str = "",
) -> TestSystem:
    """The molecules of a file at 300 K.

    Distances are held at those of the force field, or as they are in the file where it has none; angles are held as
    distances of their ends, which all MD engines can do.

    Parameters
    ----------
    path, coordinates, frame, constrain, select
        See `plan`.
    rng : int, numpy.random.Generator or None
        Of the velocities.
    quick : bool
        Half the horizon.
    forces : str
        'openmm'; 'emt', 'lj', 'tip3p', 'gfn1', 'gfn2', or the name of any calculator of ASE; or force fields of OpenMM
        by name, separated by commas: 'amber14-all,amber14/tip3p'. Of OpenMM's 'tip3p.xml' the ending has to be said.
    force_field : sequence of str, optional
        Files for openmm.app.ForceField, where forces are 'openmm'.
    add_hydrogens : bool
        Whether hydrogens that a PDB or mmCIF file lacks are added, at pH 7.
    platform : str
        Of OpenMM; by default Reference, in double precision, up to 200 atoms and CPU above.

    Raises
    ------
    InputError, UnsupportedError
        As `plan`; unknown forces, or forces that do not fit the atoms.
    """
    named = _force_fields(forces)
    if named is not None and force_field is not None:
        raise InputError(f"forces are {forces!r} already; leave --forcefield out", item="force_field")
    fields = named or force_field or FORCE_FIELD
    hydrogens = force_field_of(fields) if add_hydrogens else None
    how: dict[str, Any] = {"coordinates": coordinates, "frame": frame, "constrain": constrain, "select": select}
    found = plan(path, **how, angles="distances", hydrogens=hydrogens)
    for note in found.notes:
        warnings.warn(note, UserWarning, stacklevel=2)
    of_openmm = named is not None or forces.lower() == "openmm"
    system = _test_system(Path(path).stem, found, seed_from(rng), fields if of_openmm else forces, platform)
    return system.shortened(2) if quick else system


def build(
    size: int,
    rng: int,
    *,
    structure: str,
    constrain: str = "",
    force_field: Sequence[str] = FORCE_FIELD,
    platform: str = "",
) -> TestSystem:
    """One of the structures that come with the package, or with OpenMM; options as for `from_file`."""
    _need_openmm("this test system needs OpenMM")
    from openmm import app

    name, held, text = STRUCTURES[structure]
    if name:
        with resources.files("kcons.comparison.test_systems").joinpath(f"data/{name}").open("rb") as file:
            lines = lzma.decompress(file.read()).decode()
    else:
        lines = (Path(app.__file__).parent / "data" / "test.pdb").read_text()
    held = constrain or held
    found = _planned(text, _by_openmm(lines, Path(name), held, "distances"), held)
    return _test_system(structure, found, rng, force_field, platform)


def _test_system(name: str, found: Plan, rng: int, forces: str | Sequence[str], platform: str) -> TestSystem:
    """What a plan comes to with forces: a calculator of ASE by name, or force fields of OpenMM."""
    if sites := len(found.rows.virtual_sites):
        raise UnsupportedError(
            f"{name} has {sites} virtual sites (TIP4P or the like); here every particle has to move by itself. "
            "`kcons plan` and kcons.mdanalysis.to_openmm take them"
        )
    snapshot = whole_molecules(replace(found.rows.snapshot, positions=found.positions))
    x, rows, masses = snapshot.positions, list(found.rows), snapshot.topology.masses
    engine = None
    if isinstance(forces, str):
        potential = _of_ase(snapshot, forces)
    else:
        from kcons.openmm.integrator.guard import SystemRows

        engine = _openmm_engine(snapshot, found.rows, forces, platform)
        potential, of_system = engine.potential(), SystemRows.of(engine.system)
        # SETTLE's lengths are rounded to single precision: with the same ones, all MD engines run the same system.
        rows, masses = [Distance(of_system.pairs, of_system.lengths / ASE_LENGTH)], of_system.masses
    held = ConstraintSet(rows, x, masses, cell=snapshot.cell, pbc=snapshot.pbc.tolist())
    motion = Motion(held, x)
    x = motion.restore_positions(x)
    few = len(x) <= FEW_ATOMS
    steps = (4.0, 2.0, 1.0) if len(x) > MANY_ATOMS else (4.0, 2.0, 1.0, 0.5)
    return TestSystem(
        name=name,
        title=f"{found.title}, {TEMPERATURE:g} K; {potential.name}",
        constraint_set=held,
        positions=x,
        velocities=thermal_velocities(motion, x, TEMPERATURE, rng),
        potential=potential,
        symbols=[e or "X" for e in snapshot.topology.elements.tolist()],
        horizon=(48 if few else 24) * units.fs,
        time_steps=tuple(dt * units.fs for dt in steps),
        tolerances=(1e-3, 1e-4, 1e-5),
        bonds=np.concatenate([item.atoms for item in rows]) if all(isinstance(r, Distance) for r in rows) else None,
        cell=snapshot.cell,
        openmm=engine,
        reference_pace=1.0 if few else 2.0,
        thermal_energy=units.kB * TEMPERATURE,
    )


# -- forces of OpenMM -------------------------------------------------------------------------------


def _need_openmm(what: str) -> None:
    if find_spec("openmm") is None:
        raise UnsupportedError(f"{what}; python -m pip install openmm, or --forces emt, gfn2, ... for files")


def _force_fields(forces: str) -> tuple[str, ...] | None:
    """Files of OpenMM that are named, None if something else is."""
    names = [name.strip() for name in forces.split(",")]
    if len(names) == 1 and names[0].lower() in ("openmm", *CALCULATORS):
        return None
    files = tuple(name if name.endswith(".xml") else f"{name}.xml" for name in names)
    found = find_spec("openmm")
    data = Path(found.origin).parent / "app" / "data" if found is not None and found.origin else Path()
    known = len(names) > 1 or files[0] == names[0] or (data / files[0]).is_file()
    return files if known else None


def force_field_of(files: Sequence[str]) -> Any:
    _need_openmm("these forces need OpenMM")
    from openmm import app

    try:
        return app.ForceField(*files)
    except Exception as error:
        remedy = f"give files that OpenMM has, or paths, such as --forcefield {' '.join(FORCE_FIELD)}"
        raise InputError(f"force field {' '.join(files)}: {error}; {remedy}", item="forcefield") from error


def _openmm_engine(snapshot: Any, rows: Sequence[Any], force_field: Sequence[str], platform: str) -> OpenMMEngine:
    """Distances are those of the force field, where it has them."""
    field = force_field_of(force_field)
    from openmm import app

    from kcons.openmm.topology import openmm_topology

    if not all(isinstance(item, Distance) for item in rows):
        raise UnsupportedError("OpenMM's System holds distances only; give --forces of an ASE calculator")
    platform = platform or ("Reference" if snapshot.topology.n_atoms <= FEW_ATOMS else "CPU")
    place(platform)  # complain before the long part
    topology, known = openmm_topology(snapshot)[0], {}
    stiff = _system_of(topology, field, constraints=app.HAngles, rigidWater=True)
    for i, j, length in map(stiff.getConstraintParameters, range(stiff.getNumConstraints())):
        known[min(i, j), max(i, j)] = length._value
    system = _system_of(topology, field, constraints=None, rigidWater=False)
    for item in rows:
        lengths = (np.asarray(item.target) * ASE_LENGTH).tolist()
        for (i, j), length in zip(item.atoms.tolist(), lengths, strict=True):
            system.addConstraint(i, j, known.get((min(i, j), max(i, j)), length))
    return OpenMMEngine(lambda: system, platform=platform, home=True)


def _system_of(topology: Any, field: Any, **held: Any) -> Any:
    from openmm import app

    vectors = topology.getPeriodicBoxVectors()
    options: dict[str, Any] = {"nonbondedMethod": app.NoCutoff}
    if vectors is not None:
        width = min(float(vectors[k][k]._value) for k in range(3))
        cutoff = min(CUTOFF, 0.45 * width)
        if cutoff < SHORTEST:
            remedy = "remove it (CRYST1) from the file, or fill a larger one with water"
            raise InputError(f"the box is {width:g} nm wide, too narrow for periodic forces; {remedy}", item="box")
        options = {"nonbondedMethod": app.PME, "nonbondedCutoff": cutoff, "switchDistance": SWITCH * cutoff}
        options["ewaldErrorTolerance"] = EWALD_TOLERANCE
    try:
        return field.createSystem(topology, removeCMMotion=False, **held, **options)
    except ValueError as error:
        raise _explained(error, topology) from error


def _explained(error: Exception, topology: Any) -> InputError:
    """What OpenMM says about a residue, with the name it has in the file and what to do."""
    text = re.sub(r"\s*For more information.*", "", " ".join(str(error).split()))
    found = re.match(r"No template found for residue (\d+) \((.*?)\)\.\s*(.*)", text)
    if found is None:
        return InputError(f"the force field does not fit: {text}", item="forcefield")
    residue = list(topology.residues())[int(found[1])]
    where = f"residue {residue.name} {residue.id} of chain {residue.chain.id}"
    if re.search(r"missing \d+ H atoms?\b(?!,| and)", found[3]):
        remedy = "add hydrogens: --add-hydrogens"
    else:
        remedy = "give a force field that has it (--forcefield FILE ...), or take it out of the file"
    remedy += "; small molecules need none with other forces, --forces gfn2"
    return InputError(f"the force field has no template for {where}: {found[3]} Remedy: {remedy}", item="residue")


# -- forces of ASE ----------------------------------------------------------------------------------


def _of_ase(snapshot: Any, name: str) -> Potential:
    """Forces of an ASE calculator, tried once."""
    from kcons.ase.topology import atoms_of

    atoms = atoms_of(snapshot)
    potential = of_calculator(atoms, _calculator(name, atoms), f"ASE's {name}")
    try:
        finite = bool(np.all(np.isfinite(potential.forces(atoms.positions))))
    except Exception as error:  # calculators raise whatever they like
        said = f"fails on these atoms: {' '.join(str(error.__cause__ or error).split()) or type(error).__name__}"
        raise InputError(f"the calculator {name} {said}; choose other --forces", item="forces") from error
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


for _name, _text, _unit in (
    ("alanine", "alanine dipeptide, all bonds held; OpenMM", "molecule"),
    ("dhfr", "a protein, 2489 atoms, all bonds held; OpenMM", "system"),
    ("dhfr-water", "the same in water, 23558 atoms; OpenMM", "system"),
    ("villin", "protein in water, 8867 atoms; OpenMM", "system"),
):
    _takes = ("constrain", "force_field", "platform")
    add_system(_name, build, _text, unit=_unit, only=True, takes=_takes, options={"structure": _name})
