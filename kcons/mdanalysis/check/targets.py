"""Lengths and angles that a parameter file gives rows, by what their atoms are called.

A TOML file lists lengths by elements or atom names; the first entry that fits a row gives its target::

    unit = "angstrom"            # or "nm"

    [[length]]
    atoms = ["OW", "HW?"]        # names, with * and ?
    residue = "SOL"              # optional
    value = 1.0

    [[angle]]
    elements = ["H", "O", "H"]   # the vertex in the middle
    value = 104.52               # degrees
"""

from __future__ import annotations

import math
import sys
import tomllib
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcons.constraints import Constraint
from kcons.errors import InputError
from kcons.topology.topology import Topology

#: Entries by the family of rows that they are for, and how many atoms these have.
_KINDS = {"Distance": ("length", 2), "Angle": ("angle", 3)}
_UNITS = {"angstrom": 1.0, "Å": 1.0, "A": 1.0, "nm": 10.0, "nanometer": 10.0}


def label(topology: Topology, atoms: Sequence[int]) -> str:
    """Up to four atoms, for example 'SOL12:OW–HW1', or 'atom 35' where there are no names; a residue is named once."""
    shown, previous = [], -1
    for atom in atoms[:4]:
        residue, name = int(topology.residues[atom]), topology.names[atom]
        if not (name and topology.residues_known):
            residue, name = -1, f"atom {atom}"
        elif residue != previous:
            name = f"{topology.residue_names[residue]}{topology.residue_ids[residue]}:{name}"
        shown.append(str(name))
        previous = residue
    return "–".join(shown) + ("–…" if len(atoms) > 4 else "")


class Rule(NamedTuple):
    """One entry: 'atoms' or 'elements' and their patterns, that of the residue, the target in angstrom or radian."""

    by: str
    patterns: list[str]
    residue: str
    target: float

    def fits(self, topology: Topology, atoms: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which rows it fits, in either direction; `atoms` of shape (n_rows, width)."""
        labels, wanted = topology.names, self.patterns
        if self.by == "elements":
            labels, wanted = topology.elements, [pattern.capitalize() for pattern in self.patterns]
        forth, back = (_all_match(labels[atoms], patterns) for patterns in (wanted, wanted[::-1]))
        residues = topology.residue_names[topology.residues[atoms]]
        return (forth | back) & _all_match(residues, [self.residue] * len(wanted))


def _all_match(labels: NDArray[np.str_], patterns: Sequence[str]) -> NDArray[np.bool_]:
    columns = zip(labels.T.tolist(), patterns, strict=True)
    return np.all([[fnmatchcase(each, pattern) for each in column] for column, pattern in columns], axis=0)


def read_targets(path: str | Path) -> dict[str, list[Rule]]:
    """Entries of a parameter file, by the family of rows that they are for."""
    if not Path(path).is_file():
        remedy = "give 'topology', 'first', 'mean', or a TOML file of lengths"
        raise InputError(f"there is no file {path} with targets; {remedy}", item="targets")
    try:
        data = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError) as error:
        raise InputError(f"{path}: no readable TOML ({error})", item="targets") from None
    for wrong in sorted(set(data) - {"unit", "length", "angle"}):
        raise InputError(f"{path}: {wrong!r} is unknown; there are unit, [[length]] and [[angle]]", item="targets")
    unit = data.get("unit", "angstrom")
    if unit not in _UNITS:
        raise InputError(f"{path}: unit {unit!r} is unknown; give 'angstrom' or 'nm'", item="unit")
    rules = {
        family: [
            _rule(kind, width, f"{path}: [[{kind}]] number {number}", entry, _UNITS[unit])
            for number, entry in enumerate(data.get(kind, []), 1)
        ]
        for family, (kind, width) in _KINDS.items()
    }
    if not any(rules.values()):
        raise InputError(f"{path} has no [[length]] and no [[angle]]", item="targets")
    return rules


def _rule(kind: str, width: int, where: str, entry: Any, scale: float) -> Rule:
    if not (isinstance(entry, dict) and "value" in entry and set(entry) <= {"atoms", "elements", "residue", "value"}):
        raise InputError(f"{where} needs value, and atoms or elements; residue is optional", item="targets")
    by = [key for key in ("atoms", "elements") if key in entry]
    if len(by) != 1:
        raise InputError(f"{where}: give either atoms or elements", item="targets")
    patterns, value, angle = entry[by[0]], entry["value"], kind == "angle"
    if not isinstance(patterns, list) or len(patterns) != width or not all(isinstance(p, str) for p in patterns):
        raise InputError(f"{where}: {by[0]} must be {width} names, not {patterns!r}", item=by[0])
    if type(value) not in (int, float) or not 0 < value < (180.0 if angle else sys.float_info.max):
        what = "an angle between 0 and 180 degrees" if angle else "a positive length"
        raise InputError(f"{where}: value is {value!r}; give {what}", item="value")
    return Rule(by[0], patterns, str(entry.get("residue", "*")), math.radians(value) if angle else float(value) * scale)


def with_targets(path: str | Path, constraints: Sequence[Constraint], topology: Topology) -> list[Constraint]:
    """Constraints with the targets that a file gives; families other than distances and angles keep theirs."""
    rules = read_targets(path)
    held = []
    for item in constraints:
        targets = np.full(item.n_rows, np.nan)
        for rule in rules.get(item.family, ()):
            left = np.flatnonzero(np.isnan(targets))
            targets[left[rule.fits(topology, item.atoms[left])]] = rule.target
        missing = np.flatnonzero(np.isnan(targets))
        if item.family in rules and len(missing):
            atoms, kind = item.atoms[missing[0]], _KINDS[item.family][0]
            raise InputError(
                f"{path} has no {kind} for {label(topology, atoms.tolist())} ({'-'.join(topology.elements[atoms])}; "
                f"{len(missing)} rows in all); add a [[{kind}]] with atoms or elements that fit",
                item="targets",
                atoms=atoms.tolist(),
            )
        held.append(item.with_target(targets) if item.family in rules else item)
    return held
