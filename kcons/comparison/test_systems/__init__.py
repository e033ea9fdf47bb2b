"""Built-in test systems with known solutions, small or at size N.

- `system`, `potential`, `minimal`: the contract, forces, solutions in minimal coordinates
- `sphere`, `fekete`, `bead`, `pendulums`, `rotor`: particles, beads, pendulums and tops
- `chain`, `butane`, `molecule`, `slab`: chains and molecules
- `lennard_jones`, `near_molecules`, `dumbbells`, `water`, `fluid`: fluids
- `openmm_engine`, `structure`, `any_file`: OpenMM's forces, PDB files, any file
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcons.comparison.test_systems.system import Reference, TestSystem, Units
from kcons.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from kcons.comparison.test_systems.fluid import Fluid

__all__ = [
    "FLUIDS",
    "SYSTEMS",
    "Entry",
    "Reference",
    "TestSystem",
    "Units",
    "build",
    "build_fluid",
    "from_file",
    "is_file",
    "is_other_file",
]

#: Files that are read as molecules.
SUFFIXES = (".pdb", ".ent", ".cif", ".pdbx", ".mmcif")
#: What can be chosen for molecules with forces of OpenMM only.
STRUCTURE_OPTIONS = frozenset({"constrain", "force_field", "platform", "add_hydrogens"})
#: What can be chosen for files that MDAnalysis reads only.
FILE_OPTIONS = frozenset({"coordinates", "forces", "select", "rigid_residues"})


@dataclass(frozen=True)
class Entry:
    """One line of `kcons compare --list`."""

    module: str
    text: str
    size: int
    quick_size: int
    unit: str
    options: Mapping[str, Any] = field(default_factory=dict)


SYSTEMS: Mapping[str, Entry] = {
    "water": Entry("water", "box of rigid TIP3P water, PME forces", 64, 8, "molecules"),
    "chain": Entry("chain", "zigzag chain, all bonds held", 100, 20, "bonds"),
    "chain-straight": Entry("chain", "straight chain", 100, 20, "bonds", {"shape": "straight"}),
    "chain-175": Entry("chain", "nearly straight chain, 175°", 100, 20, "bonds", {"shape": "175"}),
    "chain-free": Entry("chain", "freely jointed chain", 100, 20, "bonds", {"shape": "free"}),
    "sphere": Entry("sphere", "free particles on spheres; closed form", 10, 2, "particles"),
    "sphere-pendulum": Entry("sphere", "spherical pendulums", 10, 2, "particles", {"gravity": 1.0}),
    "sphere-pendulum-top": Entry(
        "sphere", "spherical pendulums from near the top", 10, 2, "particles", {"gravity": 1.0, "near_top": True}
    ),
    "fekete": Entry("fekete", "20 repelling particles on a sphere, with friction; known optimum", 20, 20, "particles"),
    "ethanol": Entry("molecule", "ethanol, all bonds and angles, GFN2-xTB forces", 1, 1, "molecule"),
    "butane": Entry("butane", "four-atom chain, bonds and angles held, free torsion", 1, 1, "molecule"),
    "dumbbells": Entry("dumbbells", "collision of two rigid dumbbells; a periodic box from 8 on", 2, 2, "dumbbells"),
    "rotor": Entry("rotor", "asymmetric top of 4 atoms; Euler's equations", 1, 1, "body"),
    "tennis-racket": Entry("rotor", "the same, about its middle axis", 1, 1, "body", {"start": "tennis-racket"}),
    "pendulum": Entry("pendulums", "planar pendulum from 179.9°; closed form", 1, 1, "pendulum"),
    "double-pendulum": Entry("pendulums", "planar double pendulum", 1, 1, "pendulum", {"kind": "double-pendulum"}),
    "triple-pendulum": Entry("pendulums", "planar triple pendulum", 1, 1, "pendulum", {"kind": "triple-pendulum"}),
    "bead-ellipse": Entry("bead", "bead on a vertical ellipse", 1, 1, "bead"),
    "bead-rotating": Entry(
        "bead", "the same while the ellipse turns: a constraint that moves", 1, 1, "bead", {"on": "rotating-ellipse"}
    ),
    "bead-torus": Entry("bead", "free bead on a torus", 1, 1, "bead", {"on": "torus"}),
    "alanine": Entry("structure", "alanine dipeptide, all bonds held; OpenMM", 1, 1, "molecule"),
    "dhfr": Entry("structure", "a protein, 2489 atoms, all bonds held; OpenMM", 1, 1, "system", {"structure": "dhfr"}),
    "dhfr-water": Entry(
        "structure", "the same in water, 23558 atoms; OpenMM", 1, 1, "system", {"structure": "dhfr-water"}
    ),
    "villin": Entry("structure", "protein in water, 8867 atoms; OpenMM", 1, 1, "system", {"structure": "villin"}),
    "slab": Entry("slab", "rigid CO on Cu(111), lower layers fixed, EMT forces", 1, 1, "molecules"),
}

#: Where averages are compared instead of trajectories.
FLUIDS: Mapping[str, Entry] = {
    "thermostat": Entry("fluid", "Lennard-Jones atoms at a temperature", 32, 16, "atoms"),
    "thermostat-dumbbells": Entry(
        "fluid", "rigid dumbbells at a temperature", 16, 8, "dumbbells", {"kind": "dumbbells"}
    ),
    "thermostat-water": Entry("fluid", "rigid TIP3P water at 400 K", 27, 27, "molecules", {"kind": "water"}),
}


def build_fluid(name: str, size: int | None = None, seed: int = 1, *, quick: bool = False) -> Fluid:
    """The fluid called `name`.

    Parameters
    ----------
    name : str
        A key of `FLUIDS`.
    size : int, optional
        Number of molecules.
    seed : int
        Of the orientations on the lattice.
    quick : bool
        A smaller default size.

    Raises
    ------
    InputError
        Unknown name; a size the fluid cannot be built at.
    """
    if name not in FLUIDS:
        raise InputError(
            f"there is no fluid {name!r}{did_you_mean(name, FLUIDS)}; there are {', '.join(FLUIDS)}", item="scene"
        )
    entry = FLUIDS[name]
    if size is None:
        size = entry.quick_size if quick else entry.size
    fluid: Fluid = import_module(f"kcons.comparison.test_systems.{entry.module}").build(size, seed, **entry.options)
    return fluid


def build(name: str, size: int | None = None, seed: int = 1, *, quick: bool = False, **options: Any) -> TestSystem:
    """The test system called `name`.

    Parameters
    ----------
    name : str
        A key of `SYSTEMS`.
    size : int, optional
        Number of molecules, bonds or particles.
    seed : int
    quick : bool
        A smaller default size, half the horizon.
    **options
        What the test system's own `build` takes, for example ``forces='ase'`` for water.

    Raises
    ------
    InputError
        Unknown name; a size the test system cannot be built at.
    """
    try:
        entry = SYSTEMS[name]
    except KeyError:
        raise InputError(
            f"there is no test system {name!r}{did_you_mean(name, SYSTEMS)}; there are {', '.join(SYSTEMS)}",
            item="scene",
        ) from None
    if size is None:
        size = entry.quick_size if quick else entry.size
    if entry.module != "structure" and set(options) & STRUCTURE_OPTIONS:
        names = ", ".join(key for key, other in SYSTEMS.items() if other.module == "structure")
        raise InputError(
            f"what to hold, the force field and the platform can be chosen for {names} and PDB files, not for {name!r}",
            item=sorted(set(options) & STRUCTURE_OPTIONS)[0],
        )
    module = import_module(f"kcons.comparison.test_systems.{entry.module}")
    test_system: TestSystem = module.build(size, seed, **{**entry.options, **options})
    return test_system.shortened(2) if quick else test_system


def from_file(path: Path | str, seed: int = 1, *, quick: bool = False, **options: Any) -> TestSystem:
    """The molecules of a PDB or mmCIF file with forces of OpenMM, or of any file that MDAnalysis reads.

    Parameters
    ----------
    path : path
    seed : int
    quick : bool
        Half the horizon.
    **options
        What `structure.from_file` takes: constrain, force_field, add_hydrogens, platform, relax; or, for
        other files and where one of coordinates, forces, select, rigid_residues is given, what
        `kcons.comparison.test_systems.any_file.from_file` takes.

    Raises
    ------
    InputError, UnsupportedError
        The file cannot be read, or does not fit the force field.
    """
    if by_mdanalysis(str(path), options):
        from kcons.comparison.test_systems import any_file

        test_system = any_file.from_file(path, seed, **options)
    else:
        from kcons.comparison.test_systems import structure

        test_system = structure.from_file(path, seed, **options)
    return test_system.shortened(2) if quick else test_system


def by_mdanalysis(name: str, options: Mapping[str, Any]) -> bool:
    """Whether MDAnalysis reads the file, and not OpenMM."""
    return not is_file(name) or bool(FILE_OPTIONS & set(options))


def is_file(name: str) -> bool:
    """Whether a name is that of a structure file and not of a test system."""
    return name not in SYSTEMS and Path(name).suffix.lower() in SUFFIXES


def is_other_file(name: str) -> bool:
    """Whether a name is that of a file that MDAnalysis may read: it exists, or has a suffix and is no test system."""
    return name not in SYSTEMS and name not in FLUIDS and (Path(name).is_file() or Path(name).suffix != "")
