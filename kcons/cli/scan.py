"""The command `kcons scan`."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcons.cli.parser import Command, Option
from kcons.cli.terminal import say_written, show
from kcons.errors import InputError

if TYPE_CHECKING:
    from kcons.constraints import Constraint

#: Option -> atoms it takes.
FAMILIES = {"distance": 2, "difference": 4, "angle": 3, "dihedral": 4}
#: The exit status where some points failed; 2 is wrong use, or no point at all.
INCOMPLETE = 3


class _Coordinate(argparse.Action):
    """Coordinates in the order in which they are given, whatever their kind."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        family = (option_string or "").strip("-")
        setattr(namespace, self.dest, [*(getattr(namespace, self.dest) or []), (family, values)])


def _scan(chosen: argparse.Namespace) -> int:
    from kcons.constraints import FixedAtoms
    from kcons.free_energy.windows.input_file import counted, read_structure

    coordinates, values = _grid(chosen)
    atoms = read_structure(chosen.structure)
    held: list[Constraint] = [FixedAtoms(counted(chosen.fix, chosen.count_from))] if chosen.fix else []
    held += [_made(f, numbers, chosen) for f in FAMILIES for numbers in getattr(chosen, f"hold_{f}") or ()]
    if chosen.constrain is not None:
        from kcons.ase import constraints_of

        held += constraints_of(atoms, chosen.constrain, guess_bonds=True)
    atoms.calc = _calculator(chosen.calculator, chosen.settings)
    held += getattr(atoms.calc, "held", [])

    from kcons.comparison.progress import Watcher
    from kcons.free_energy import scan

    how = {"held": held, "fmax": chosen.fmax, "both_ways": not chosen.one_way}
    folder: Path = chosen.out or Path(f"scan-{chosen.structure.stem}")
    with Watcher(shown=True) as watcher, watcher.piece("relaxed scan", 1.0):

        def progress(done: int, points: int, line: str) -> None:
            watcher.advance(done / points)

        found = scan(atoms, coordinates, values, folder=folder, progress=progress, **how)
    written = found.write(folder)
    show(found.table(), found.summary())
    say_written(written)
    return INCOMPLETE if found.failed else 0


def _made(family: str, atoms: Sequence[int], chosen: argparse.Namespace) -> Constraint:
    from kcons.free_energy.windows.input_file import FAMILIES, counted

    return FAMILIES[family]([counted(atoms, chosen.count_from)])


def _grid(chosen: argparse.Namespace) -> tuple[list[Constraint], list[Any]]:
    import numpy as np

    if not chosen.coordinates:
        raise InputError(
            "name what is scanned: --dihedral 0 1 2 3, --angle 0 1 2, --distance 0 1 or --difference 0 1 1 2",
            item="coordinates",
        )
    count = len(chosen.coordinates)
    turns = all(family == "dihedral" for family, _ in chosen.coordinates)
    begin = _for_each("--from", chosen.begin or ([-180.0] if turns else []), count)
    end = _for_each("--to", chosen.end or ([180.0] if turns else []), count)
    steps = _for_each("--steps", chosen.steps or [24], count)
    coordinates, values = [], []
    for (family, atoms), low, high, n in zip(chosen.coordinates, begin, end, steps, strict=True):
        if n < 0 or (n == 0 and low != high):
            raise InputError(f"--steps is {n}; give a positive number", item="steps")
        axis = np.linspace(low, high, int(n) + 1)
        if family == "angle" and (min(low, high) <= 0 or max(low, high) >= 180):
            raise InputError(f"--angle from {low:g} to {high:g}: angles are between 0 and 180 degrees", item="angle")
        coordinates.append(_made(family, atoms, chosen))
        values.append(np.radians(axis) if family in ("angle", "dihedral") else axis)
    return coordinates, values


def _for_each(option: str, given: Sequence[float], count: int) -> list[float]:
    if not given:
        raise InputError(f"give {option}: only dihedrals have a range by themselves, a whole turn", item=option)
    if len(given) not in (1, count):
        raise InputError(f"{option} has {len(given)} numbers for {count} coordinates; give one for each", item=option)
    return list(given) * (count if len(given) == 1 else 1)


def _calculator(name: str, given: str) -> Any:
    try:
        settings = json.loads(given)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"--settings is no JSON: {error}; give such as '{{\"charge\": 1}}'", item="settings"
        ) from error
    if not isinstance(settings, dict):
        raise InputError("--settings are names and values, such as '{\"charge\": 1}'", item="settings")
    if not name.endswith(".xml"):
        from kcons.ase.named_calculators import named_calculator

        return named_calculator(name, settings)
    import openmm

    from kcons.free_energy.scans.system_calculator import SystemCalculator, read_system

    system = read_system(Path(name), "calculator")
    try:
        return SystemCalculator(system, **settings)
    except (TypeError, openmm.OpenMMException) as error:
        raise InputError(f'--settings of a System are {{"platform": NAME}}: {error}', item="settings") from error


def _options() -> Iterator[Option]:
    """The table: options of each family are alike."""
    more = {
        "distance": "; a second coordinate makes the scan two-dimensional",
        "difference": ": the distance of the first two less that of the last two",
    }
    values: dict[str, Any] = {"nargs": "+", "type": float, "metavar": "VALUE"}
    yield Option("structure", "any file that ASE reads; its last structure", type=Path)
    for family, size in FAMILIES.items():
        how: dict[str, Any] = {"nargs": size, "type": int, "metavar": "ATOM"}
        said = f"{size} atoms{more.get(family, '')}"
        yield Option(f"--{family}", said, action=_Coordinate, dest="coordinates", **how)
        yield Option(f"--hold-{family}", "held as it is; may be repeated", action="append", **how)
    yield Option("--from", "first value, one for each coordinate (dihedrals: -180)", dest="begin", **values)
    yield Option("--to", "last value, one for each coordinate (dihedrals: 180)", dest="end", **values)
    yield Option("--steps", "from the first value to the last, for each (default 24)", nargs="+", type=int, metavar="N")
    yield Option("--count-from", "number of the first atom (default 0)", type=int, choices=(0, 1), default=0)
    yield Option("--fix", "atoms that stay where they are", nargs="+", type=int, default=(), metavar="ATOM")
    said = "bonds (guessed from distances) and angles that are held as they are"
    yield Option("--constrain", said, choices=("hbonds", "allbonds", "hangles", "allangles"))
    said = (
        "gfn2 (default) or gfn1, by tblite; emt, lj, ...: one of ASE by name; MODULE:NAME: what makes one; "
        "FILE.xml: a System of OpenMM, with what it constrains"
    )
    yield Option("--calculator", said, default="gfn2")
    said = "of the calculator, such as '{\"charge\": 1}'"
    yield Option("--settings", said, default="{}", metavar="JSON")
    yield Option("--fmax", "largest force left, eV/angstrom (default 0.01)", type=float, default=0.01)
    yield Option("--one-way", "relax each point from the first neighbor only", action="store_true")
    yield Option("--out", "folder for all results (default ./scan-STRUCTURE)", type=Path)


COMMAND = Command(
    "scan",
    "minima of the energy with one or two coordinates held at given values",
    "A relaxed scan: distances, their differences, angles or dihedrals are held exactly at each of their values, all "
    "else is relaxed, from all neighboring points (torsions are driven both ways). Atoms are counted from 0, unless "
    "--count-from 1 is given; lengths are in angstrom, angles in degrees. Goes on where it stopped. Exit status 0; 2 "
    "for wrong use, or if no point succeeded; 3 if some points failed.",
    tuple(_options()),
    _scan,
    "relaxations",
)
