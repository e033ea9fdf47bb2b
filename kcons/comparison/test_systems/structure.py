"""Molecules out of PDB files with an OpenMM force field: alanine dipeptide, proteins, and a user's own file."""

from __future__ import annotations

import lzma
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from ase import units

from kcons.comparison.test_systems.openmm_engine import ASE_LENGTH, OpenMMEngine, place, properties
from kcons.comparison.test_systems.potential import Potential
from kcons.comparison.test_systems.registry import STRUCTURE_OPTIONS, add_system
from kcons.comparison.test_systems.system import TestSystem, thermal_velocities
from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.motion.motion import Motion

TEMPERATURE = 300.0
#: createSystem's names.
CONSTRAIN = {"hbonds": "HBonds", "allbonds": "AllBonds", "hangles": "HAngles"}
FORCE_FIELD = ("amber14-all.xml", "amber14/tip3pfb.xml")
#: Cutoff of PME in nm, less in narrow boxes, and the least; where dispersion begins to be switched off.
CUTOFF, SHORTEST, SWITCH = 0.9, 0.4, 0.9
#: Tight enough that the order of a method can be seen, at a tenth more cost than OpenMM's default.
EWALD_TOLERANCE = 5e-5
#: Up to this size OpenMM's Reference platform, which computes in double precision, is fast enough.
FEW_ATOMS, MANY_ATOMS = 200, 3000
#: A distance that is off by this fraction is no distance of a whole molecule.
TORN = 0.5


#: File (of the package, or of OpenMM where none is named), what is held, steps of minimization, and what it is.
STRUCTURES: Mapping[str, tuple[str, str, int, str]] = {
    "alanine": ("alanine-dipeptide-implicit.pdb.xz", "allbonds", 100, "alanine dipeptide in vacuum"),
    "dhfr": ("5dfr_minimized.pdb.xz", "allbonds", 20, "dihydrofolate reductase in vacuum"),
    "dhfr-water": ("5dfr_solv-cube_equil.pdb.xz", "hbonds", 10, "dihydrofolate reductase in water"),
    "villin": ("", "hbonds", 20, "villin headpiece in water"),
}


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
    _need_openmm()
    from openmm import app

    name, held, relax, text = STRUCTURES[structure]
    if name:
        with resources.files("kcons.comparison.test_systems").joinpath(f"data/{name}").open("rb") as file:
            lines = lzma.decompress(file.read()).decode()
    else:
        lines = (Path(app.__file__).parent / "data" / "test.pdb").read_text()
    molecule = app.PDBFile(StringIO(lines))
    return _test_system(
        structure,
        text,
        molecule.topology,
        _nanometers(molecule),
        rng,
        constrain=constrain or held,
        field=force_field_of(force_field),
        platform=platform,
        relax=relax,
    )


def from_file(
    path: Path | str,
    rng: int = 1,
    *,
    constrain: str = "hbonds",
    force_field: Sequence[str] = FORCE_FIELD,
    add_hydrogens: bool = False,
    platform: str = "",
    relax: int = 100,
) -> TestSystem:
    """The molecules of a PDB or mmCIF file at 300 K, relaxed a little.

    Parameters
    ----------
    path : path
    rng : int
        Of the velocities.
    constrain : {'hbonds', 'allbonds', 'hangles'}
        What is held, beside rigid water: createSystem's HBonds, AllBonds or HAngles.
    force_field : sequence of str
        Files for openmm.app.ForceField.
    add_hydrogens : bool
        Whether missing hydrogens are added, at pH 7.
    platform : str
        Of OpenMM; by default Reference, in double precision, up to 200 atoms and CPU above.
    relax : int
        Steps of minimization, at most.

    Raises
    ------
    InputError
        The file cannot be read, the force field does not know a residue, a molecule is cut, the box is too narrow.
    UnsupportedError
        OpenMM is not installed; virtual sites.
    """
    _need_openmm()
    from openmm import app

    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no file {path}", item="file")
    try:
        kind = app.PDBFile if path.suffix.lower() in (".pdb", ".ent") else app.PDBxFile
        molecule = kind(StringIO(path.read_text(encoding="utf-8", errors="replace")))
        topology, x = molecule.topology, _nanometers(molecule)
    except Exception as error:  # OpenMM's readers raise whatever went wrong inside of them
        raise InputError(
            f"{path} cannot be read; does it hold molecules, in the format of its ending? "
            f"({type(error).__name__}: {error})",
            item="file",
        ) from error
    if not len(x):
        raise InputError(f"{path} has no atoms", item="file")
    bad = ~np.isfinite(x).all(axis=1)
    if bad.any():
        atom = list(topology.atoms())[int(np.argmax(bad))]
        where = f"{atom.name} of {atom.residue.name} {atom.residue.id}"
        raise InputError(f"{path}: the position of {where} is not finite; mend the file", item="file")
    field = force_field_of(force_field)
    if add_hydrogens:
        topology, x = _with_hydrogens(topology, molecule.positions, field)
    return _test_system(
        path.stem,
        path.name,
        topology,
        x,
        rng,
        constrain=constrain,
        field=field,
        platform=platform,
        relax=relax,
    )


# -- OpenMM's System --------------------------------------------------------------------------------


def _need_openmm() -> None:
    if find_spec("openmm") is None:
        raise UnsupportedError("this test system needs OpenMM; python -m pip install openmm")


def _nanometers(molecule: Any) -> FloatArray:
    return np.array(molecule.getPositions(asNumpy=True)._value, dtype=float)


def force_field_of(files: Sequence[str]) -> Any:
    from openmm import app

    try:
        return app.ForceField(*files)
    except Exception as error:
        raise InputError(
            f"force field {' '.join(files)}: {error}; give files that OpenMM has, or paths, such as "
            f"--forcefield {' '.join(FORCE_FIELD)}",
            item="forcefield",
        ) from error


def _with_hydrogens(topology: Any, positions: Any, field: Any) -> tuple[Any, FloatArray]:
    import openmm
    from openmm import app

    modeller = app.Modeller(topology, positions)
    try:
        # Without a platform the fastest is taken, of whatever precision, and hydrogens differ from machine to machine.
        modeller.addHydrogens(field, platform=openmm.Platform.getPlatformByName("CPU"))
    except ValueError as error:
        raise _explained(error, topology) from error
    from openmm import unit

    return modeller.topology, np.array(modeller.positions.value_in_unit(unit.nanometer), dtype=float)


def _explained(error: Exception, topology: Any) -> InputError:
    """What createSystem says about a residue, with the name it has in the file and what to do."""
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


def system_of(topology: Any, field: Any, constraints: Any, rigid_water: bool) -> Any:
    from openmm import app

    box = _box(topology)
    if box is None:
        options: dict[str, Any] = {"nonbondedMethod": app.NoCutoff}
    else:
        width = float(min(np.diag(box)))
        cutoff = min(CUTOFF, 0.45 * width)
        if cutoff < SHORTEST:
            raise InputError(
                f"the box is {width:g} nm wide, too narrow for periodic forces; remove it (CRYST1) from the file, or "
                "fill a larger one with water",
                item="box",
            )
        options = {
            "nonbondedMethod": app.PME,
            "nonbondedCutoff": cutoff,
            "switchDistance": SWITCH * cutoff,
            "ewaldErrorTolerance": EWALD_TOLERANCE,
        }
    try:
        return field.createSystem(
            topology, constraints=constraints, rigidWater=rigid_water, removeCMMotion=False, **options
        )
    except ValueError as error:
        raise _explained(error, topology) from error


def _box(topology: Any) -> FloatArray | None:
    """Box vectors in nm, shape (3, 3); None where there is none, or one angstrom as a placeholder."""
    vectors = topology.getPeriodicBoxVectors()
    if vectors is None:
        return None
    box = np.array([list(v) for v in vectors._value], dtype=float)
    return None if np.diag(box).max() < 0.2 else box


# -- the test system --------------------------------------------------------------------------------------


def _test_system(
    name: str,
    text: str,
    topology: Any,
    x: FloatArray,
    rng: int,
    *,
    constrain: str,
    field: Any,
    platform: str,
    relax: int,
) -> TestSystem:
    from openmm import app

    from kcons.openmm.integrator.system_checks import SystemRows

    if constrain not in CONSTRAIN:
        raise InputError(
            f"cannot constrain {constrain!r} by a force field of OpenMM; there are {', '.join(CONSTRAIN)} (allangles "
            "and none with kcons compare --forces)",
            item="constrain",
        )
    box = _box(topology)
    if box is None:
        topology.setPeriodicBoxVectors(None)
    platform = platform_of(len(x), platform)
    system = system_of(topology, field, getattr(app, CONSTRAIN[constrain]), True)
    _refuse_sites(system, topology)
    rows = SystemRows.of(system)
    if not rows.n_rows:
        raise InputError(f"nothing is held in {text} with constrain = {constrain}; try allbonds", item="constrain")
    _refuse_torn(rows, x, topology)
    if relax:
        x = _relaxed(system_of(topology, field, None, False), x, platform, relax)
    # SETTLE's lengths are rounded to single precision: with the same ones, all MD engines run the same system.
    held = ConstraintSet(Distance(rows.pairs, rows.lengths / ASE_LENGTH), x / ASE_LENGTH, rows.masses)
    md_engine = OpenMMEngine(lambda: system, platform=platform, home=True)
    what = f"{text}, {len(x)} atoms, {CONSTRAIN[constrain]}: {rows.n_rows} distances"
    return molecules_at_300_k(
        name,
        f"{what}, {TEMPERATURE:g} K; {'PME, ' if box is not None else ''}",
        held,
        x / ASE_LENGTH,
        rng,
        potential=md_engine.potential(),
        symbols=[atom.element.symbol if atom.element is not None else "X" for atom in topology.atoms()],
        bonds=rows.pairs,
        cell=None if box is None else box / ASE_LENGTH,
        openmm=md_engine,
    )


def molecules_at_300_k(
    name: str, title: str, held: ConstraintSet, x: FloatArray, rng: int, *, potential: Potential, **more: Any
) -> TestSystem:
    """A test system of molecules from a file: on the constraints, with thermal velocities, steps and horizon."""
    motion = Motion(held, x)
    on = motion.restore_positions(x)
    return TestSystem(
        name=name,
        title=title + potential.name,
        constraint_set=held,
        positions=on,
        velocities=thermal_velocities(motion, on, TEMPERATURE, rng),
        potential=potential,
        thermal_energy=units.kB * TEMPERATURE,
        **steps_of(len(x)),
        **more,
    )


def platform_of(n_atoms: int, platform: str) -> str:
    """The platform of OpenMM that was asked for, or by default one that is fast enough."""
    platform = platform or ("Reference" if n_atoms <= FEW_ATOMS else "CPU")
    place(platform)  # complain before the long part
    return platform


def steps_of(n_atoms: int) -> dict[str, Any]:
    """Horizon, time steps, tolerances and reference pace of molecules, such as a system of this size can pay for."""
    few = n_atoms <= FEW_ATOMS
    steps = (4.0, 2.0, 1.0) if n_atoms > MANY_ATOMS else (4.0, 2.0, 1.0, 0.5)
    return {
        "horizon": (48 if few else 24) * units.fs,
        "time_steps": tuple(dt * units.fs for dt in steps),
        "tolerances": (1e-3, 1e-4, 1e-5),
        "reference_pace": 1.0 if few else 2.0,
    }


def _refuse_sites(system: Any, topology: Any) -> None:
    for atom in topology.atoms():
        if system.isVirtualSite(atom.index):
            raise UnsupportedError(
                f"the force field puts virtual sites into residue {atom.residue.name} {atom.residue.id}; here every "
                "particle has to move by itself: take a water model with three sites, such as amber14/tip3pfb.xml"
            )


def _refuse_torn(rows: Any, x: FloatArray, topology: Any) -> None:
    """Molecules that are cut at the box cannot be held: OpenMM's constraints know no images."""
    off = np.abs(rows.stretches(x))
    row = int(np.argmax(off))
    if off[row] < TORN:
        return
    i, j = rows.pairs[row].tolist()
    atoms = list(topology.atoms())
    names = " and ".join(f"{a.name} of {a.residue.name} {a.residue.id}" for a in (atoms[i], atoms[j]))
    raise InputError(
        f"{names} are {np.linalg.norm(x[i] - x[j]):.3g} nm apart and to be held at {rows.lengths[row]:.3g} nm; make "
        "molecules whole that are cut at the edge of the box, or mend the file",
        item="file",
        atoms=[i, j],
    )


def _relaxed(flexible: Any, x: FloatArray, platform: str, iterations: int) -> FloatArray:
    """Fewer overlaps, by OpenMM's minimizer with nothing held."""
    import openmm
    from openmm import unit

    context = openmm.Context(flexible, openmm.VerletIntegrator(0.001), place(platform), properties(platform))
    context.setPositions(x)
    openmm.LocalEnergyMinimizer.minimize(context, 10.0, iterations)
    state = context.getState(positions=True)
    return np.asarray(state.getPositions(asNumpy=True).value_in_unit(unit.nanometer))


for _name, _text, _unit in (
    ("alanine", "alanine dipeptide, all bonds held; OpenMM", "molecule"),
    ("dhfr", "a protein, 2489 atoms, all bonds held; OpenMM", "system"),
    ("dhfr-water", "the same in water, 23558 atoms; OpenMM", "system"),
    ("villin", "protein in water, 8867 atoms; OpenMM", "system"),
):
    add_system(_name, build, _text, unit=_unit, only=True, takes=STRUCTURE_OPTIONS[:3], structure=_name)
