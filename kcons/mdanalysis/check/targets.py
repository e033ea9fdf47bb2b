"""Names of atoms, and lengths and angles that a parameter file gives rows of such names.

A TOML file lists lengths by elements or atom names; the first entry that fits a row gives its target::

    unit = "angstrom"            # or "nm"

    [[length]]
    atoms = ["OW", "HW?"]        # names, with * and ?
    residue = "SOL"              # optional
    value = 1.0

    [[length]]
    elements = ["C", "H"]
    value = 1.09

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
from kcons.mdanalysis.topology import texts

#: Entries by the family of rows that they are for, and how many atoms these have.
_KINDS = {"Distance": ("length", 2), "Angle": ("angle", 3)}
_UNITS = {"angstrom": 1.0, "Å": 1.0, "A": 1.0, "nm": 10.0, "nanometer": 10.0}
_KEYS = {"atoms", "elements", "residue", "value"}


class AtomNames:
    """What all atoms of a Universe are called: names, elements, residues, '' where its topology does not say.

    Elements are then what names and masses tell, `known`, or first letters.
    """

    def __init__(self, universe: Any, known: NDArray[np.str_]) -> None:
        self.names, self.residues, self._numbers, elements = (
            texts(universe.atoms, name, len(universe.atoms)) for name in ("names", "resnames", "resids", "elements")
        )
        first = np.char.lstrip(self.names, "0123456789'\"*").astype("U1")
        self.elements: NDArray[np.str_] = np.where(elements == "", np.where(known == "", first, known), elements)

    def atom(self, index: int) -> str:
        """For example 'SOL12:OW', or 'atom 35' where there are no names."""
        name = self.names[index]
        if not name:
            return f"atom {index}"
        residue = f"{self.residues[index]}{self._numbers[index]}"
        return f"{residue}:{name}" if residue else str(name)

    def row(self, atoms: NDArray[np.int64]) -> str:
        """Atoms of a row, up to four; a residue is named once."""
        shown, previous = [], ""
        for a in atoms[:4].tolist():
            label = self.atom(a)
            head, colon, name = label.rpartition(":")
            shown.append(name if colon and head == previous else label)
            previous = head
        return "–".join(shown) + ("–…" if len(atoms) > 4 else "")


class Rule(NamedTuple):
    """One entry: 'atoms' or 'elements' and their patterns, that of the residue, the target in angstrom or radian."""

    by: str
    patterns: list[str]
    residue: str
    target: float

    def fits(self, names: AtomNames, atoms: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which rows it fits, in either direction; `atoms` of shape (n_rows, width)."""
        if self.by == "elements":
            labels, wanted = np.char.capitalize(names.elements), [pattern.capitalize() for pattern in self.patterns]
        else:
            labels, wanted = names.names, self.patterns
        forth, back = (_all_match(labels, atoms, patterns) for patterns in (wanted, wanted[::-1]))
        return (forth | back) & _all_match(names.residues, atoms, [self.residue] * len(wanted))


def _all_match(labels: NDArray[np.str_], atoms: NDArray[np.int64], patterns: Sequence[str]) -> NDArray[np.bool_]:
    found = np.ones(len(atoms), dtype=bool)
    for slot, pattern in enumerate(patterns):
        if pattern != "*":
            distinct, place = np.unique(labels[atoms[:, slot]], return_inverse=True)
            found &= np.array([fnmatchcase(str(label), pattern) for label in distinct], dtype=bool)[place]
    return found


class TargetFile:
    """Targets that a file gives.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    InputError
        A file that is missing or malformed, an entry with a wrong number of names, a value out of range.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise InputError(
                f"there is no file {path} with targets; give 'topology', 'first', 'mean', or a TOML file of lengths",
                item="targets",
            )
        try:
            data = tomllib.loads(self.path.read_text(encoding="utf-8"))
        except (ValueError, OSError, RecursionError) as error:
            raise InputError(f"{path}: no readable TOML ({error})", item="targets") from None
        for wrong in sorted(set(data) - {"unit", "length", "angle"}):
            raise InputError(f"{path}: {wrong!r} is unknown; there are unit, [[length]] and [[angle]]", item="targets")
        unit = data.get("unit", "angstrom")
        if unit not in _UNITS:
            raise InputError(f"{path}: unit {unit!r} is unknown; give 'angstrom' or 'nm'", item="unit")
        self.rules = {
            family: [
                self._rule(kind, width, f"{path}: [[{kind}]] number {number}", entry, _UNITS[unit])
                for number, entry in enumerate(data.get(kind, []), 1)
            ]
            for family, (kind, width) in _KINDS.items()
        }
        if not any(self.rules.values()):
            raise InputError(f"{path} has no [[length]] and no [[angle]]", item="targets")

    @staticmethod
    def _rule(kind: str, width: int, where: str, entry: Any, scale: float) -> Rule:
        if not isinstance(entry, dict) or not set(entry) <= _KEYS or "value" not in entry:
            raise InputError(f"{where} needs value, and atoms or elements; residue is optional", item="targets")
        by = [key for key in ("atoms", "elements") if key in entry]
        if len(by) != 1:
            raise InputError(f"{where}: give either atoms or elements", item="targets")
        patterns, value = entry[by[0]], entry["value"]
        if not isinstance(patterns, list) or len(patterns) != width or not all(isinstance(p, str) for p in patterns):
            raise InputError(f"{where}: {by[0]} must be {width} names, not {patterns!r}", item=by[0])
        top = 180.0 if kind == "angle" else sys.float_info.max
        if not isinstance(value, int | float) or isinstance(value, bool) or not 0 < value < top:
            what = "an angle between 0 and 180 degrees" if kind == "angle" else "a positive length"
            raise InputError(f"{where}: value is {value!r}; give {what}", item="value")
        target = math.radians(value) if kind == "angle" else float(value) * scale
        return Rule(by[0], patterns, str(entry.get("residue", "*")), target)

    def apply(self, constraints: Sequence[Constraint], names: AtomNames) -> list[Constraint]:
        """Constraints with the targets that the file gives; families other than distances and angles keep theirs.

        Raises
        ------
        InputError
            A row that no entry fits.
        """
        return [self._held(item, names) if item.family in _KINDS else item for item in constraints]

    def _held(self, item: Constraint, names: AtomNames) -> Constraint:
        targets = np.full(item.n_rows, np.nan)
        for rule in self.rules[item.family]:
            open_rows = np.flatnonzero(np.isnan(targets))
            targets[open_rows[rule.fits(names, item.atoms[open_rows])]] = rule.target
        missing = np.flatnonzero(np.isnan(targets))
        if len(missing):
            atoms, kind = item.atoms[missing[0]], _KINDS[item.family][0]
            raise InputError(
                f"{self.path} has no {kind} for {names.row(atoms)} ({'-'.join(names.elements[atoms])}; "
                f"{len(missing)} rows in all); add a [[{kind}]] with atoms or elements that fit",
                item="targets",
                atoms=atoms.tolist(),
            )
        return item.with_target(targets)
