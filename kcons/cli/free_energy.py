"""The commands `kcons scan` and `kcons freeenergy`."""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from kcons.cli.terminal import HELD, Command, Option, say_written, show
from kcons.errors import InputError

#: Option -> atoms it takes.
FAMILIES = {"distance": 2, "difference": 4, "angle": 3, "dihedral": 4}
ATOMS: dict[str, Any] = {"type": int, "metavar": "ATOM"}
VALUES: dict[str, Any] = {"nargs": "+", "type": float, "metavar": "VALUE"}
#: The exit status where some points failed; 2 is wrong use, or no point at all.
INCOMPLETE = 3


class _Coordinate(argparse.Action):
    """Coordinates in the order in which they are given, whatever their kind."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        family = (option_string or "").strip("-")
        setattr(namespace, self.dest, [*(getattr(namespace, self.dest) or []), (family, values)])


def _scan(chosen: argparse.Namespace) -> int:
    from kcons.ase import constraints_of
    from kcons.comparison.progress import Watcher
    from kcons.constraints import FixedAtoms
    from kcons.free_energy import scan
    from kcons.free_energy.windows.input_file import coordinate_of, counted, read_structure

    first = chosen.count_from
    coordinates, values = _grid(chosen)
    atoms = read_structure(chosen.structure)
    held: list[Any] = [FixedAtoms(counted(chosen.fix, first))] if chosen.fix else []
    held += [coordinate_of(f, four, first) for f in FAMILIES for four in getattr(chosen, f"hold_{f}") or ()]
    if chosen.constrain is not None:
        held += constraints_of(atoms, chosen.constrain, guess_bonds=True)
    atoms.calc = _calculator(chosen.calculator, chosen.settings)
    how: dict[str, Any] = {"held": held, "fmax": chosen.fmax, "both_ways": not chosen.one_way}
    folder: Path = chosen.out or Path(f"scan-{chosen.structure.stem}")
    begun: list[None] = []
    with Watcher(shown=True) as watcher, ExitStack() as pieces:

        def progress(done: int, points: int, line: str) -> None:
            if not begun:  # what is wrong with the input has been found by then
                begun.append(pieces.enter_context(watcher.piece("relaxed scan", 1.0)))
            watcher.advance(done / points)

        found = scan(atoms, coordinates, values, folder=folder, progress=progress, **how)
    written = found.write(folder)
    show(found.table().drop(columns="error").to_string(index=False, float_format="{:.4f}".format), found.summary())
    say_written(written)
    return INCOMPLETE if found.failed else 0


def _grid(chosen: argparse.Namespace) -> tuple[list[Any], list[Any]]:
    import numpy as np

    from kcons.free_energy.windows.input_file import Coordinate

    if not chosen.coordinates:
        raise InputError(
            "name what is scanned: --dihedral 0 1 2 3, --angle 0 1 2, --distance 0 1 or --difference 0 1 1 2",
            item="coordinates",
        )
    turn = [180.0] if all(family == "dihedral" for family, _ in chosen.coordinates) else []
    usual, count = {"from": [-angle for angle in turn], "to": turn, "steps": [24]}, len(chosen.coordinates)
    each = [_for_each(f"--{name}", getattr(chosen, name) or most, count) for name, most in usual.items()]
    coordinates, values = [], []
    for (family, atoms), low, high, n in zip(chosen.coordinates, *each, strict=True):
        if n < 0 or (n == 0 and low != high):
            raise InputError(f"--steps is {n}; give a positive number", item="steps")
        made = Coordinate(**{family: atoms}, values=np.linspace(low, high, int(n) + 1).tolist())
        coordinates.append(made.constraint(chosen.count_from))
        values.append(made.places())
    return coordinates, values


def _for_each(option: str, given: Any, count: int) -> list[float]:
    if not given:
        raise InputError(f"give {option}: only dihedrals have a range by themselves, a whole turn", item=option)
    if len(given) not in (1, count):
        raise InputError(f"{option} has {len(given)} numbers for {count} coordinates; give one for each", item=option)
    return list(given) * (count if len(given) == 1 else 1)


def _calculator(name: str, given: str) -> Any:
    try:
        settings = json.loads(given)
    except (ValueError, RecursionError):
        settings = None
    if not isinstance(settings, dict):
        raise InputError(f"--settings are {given}; give names and values as JSON: '{{\"charge\": 1}}'", item="settings")
    from kcons.ase.named_calculators import named_calculator

    return named_calculator(name, settings)


#: The table: options of each family are alike.
OF_FAMILIES = [
    option
    for family, size in FAMILIES.items()
    for option in (
        Option(f"--{family}", f"{size} atoms", action=_Coordinate, dest="coordinates", nargs=size, **ATOMS),
        Option(f"--hold-{family}", "held as it is; may be repeated", action="append", nargs=size, **ATOMS),
    )
]


# -- free energies ----------------------------------------------------------------------------------


def _free_energy(chosen: argparse.Namespace) -> int:
    from kcons.comparison.progress import Watcher
    from kcons.free_energy import Windows, read_input

    given = read_input(chosen.input, allow_modules=chosen.allow_module or ())
    folder: Path = chosen.out or Path(chosen.input.stem)
    windows = Windows(given.sampler, folder, given.settings, workers=chosen.workers, **given.options)
    watcher = Watcher(shown=True)
    with windows.taken(), watcher, watcher.piece(f"{len(given.targets)} windows in {folder}", 1.0):
        windows.progress = lambda done, total: watcher.advance(done / total)
        found = windows.run(given.targets)
        if given.improve and not found.failed:
            found = windows.improve(**given.improve)
        written = found.write(folder)
    show(found.table(), found.summary())
    say_written(written)
    return INCOMPLETE if found.failed else 0


COMMANDS = (
    Command(
        "scan",
        "minima of the energy with one or two coordinates held at given values",
        "One or two coordinates (difference: r(I, J) - r(K, L)) are held, in angstrom or degrees; all else is relaxed, "
        "from each neighbor. Goes on where it stopped. Exit status 0; 2 for wrong use, or if no point succeeded; 3 if "
        "some points failed.",
        (
            Option("structure", "any file that ASE reads; its last structure", type=Path),
            *OF_FAMILIES,
            Option("--from", "first value, one for each coordinate (dihedrals: -180)", **VALUES),
            Option("--to", "last value, one for each coordinate (dihedrals: 180)", **VALUES),
            Option("--steps", "from first to last value, for each (default 24)", nargs="+", type=int, metavar="N"),
            Option("--count-from", "number of the first atom (default 0)", type=int, choices=(0, 1), default=0),
            Option("--fix", "atoms that stay where they are", nargs="+", default=(), **ATOMS),
            Option("--constrain", "bonds (guessed from distances) and angles that are held as they are", choices=HELD),
            Option("--calculator", "gfn2 (default), another of ASE, MODULE:NAME", default="gfn2"),
            Option("--settings", "of the calculator, such as '{\"charge\": 1}'", default="{}", metavar="JSON"),
            Option("--fmax", "largest force left, eV/angstrom (default 0.01)", type=float, default=0.01),
            Option("--one-way", "relax each point from the first neighbor only", action="store_true"),
            Option("--out", "folder for all results (default ./scan-STRUCTURE)", type=Path),
        ),
        _scan,
        "relaxations",
    ),
    Command(
        "freeenergy",
        "free energy along held coordinates, from an input file",
        "Samples windows with coordinates held, and integrates their mean force. Goes on where it stopped: finished "
        "windows are kept one by one. Exit status 0; 2 for wrong use; 3 if some windows failed.",
        (
            Option("input", "structure, forces, coordinates and sampling, in TOML", type=Path, metavar="INPUT"),
            Option("--out", "folder of the windows and results (default ./INPUT without its ending)", type=Path),
            Option("--workers", "processes of this machine (default: one a core)", type=int),
            Option("--allow-module", "of a calculator, whose code then runs; may be repeated", action="append"),
        ),
        _free_energy,
        "windows",
    ),
)
