"""Windows as an input file describes them, in TOML.

A table of the file is a dataclass below, a key one of its fields. What may be given is said by the annotation,
its type or `Annotated[type, rule]`, as for arguments. A key without a default has to be there.
"""

from __future__ import annotations

import math
import sys
import tomllib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, make_dataclass
from functools import partial, reduce
from itertools import product
from os import PathLike
from pathlib import Path
from reprlib import repr as short
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints import Angle, Constraint, Dihedral, Distance, DistanceDifference, FixedAtoms
from kcons.constraints.arguments import Count, Positive, rules_of
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, unknown
from kcons.free_energy.windows.driver import Sampler, Settings
from kcons.steppers.files import as_path

#: Windows of an input file, at most.
MOST_WINDOWS = 100_000


#: How many atoms each kind of coordinate has, and what it becomes.
FAMILIES: dict[str, tuple[int, Callable[[ArrayLike], Constraint]]] = {
    "distance": (2, Distance),
    "difference": (4, lambda rows: DistanceDifference(np.reshape(rows, (-1, 2)))),
    "angle": (3, Angle),
    "dihedral": (4, Dihedral),
}
#: Values between which each kind lies, in angstrom and degrees; the others may have any.
_RANGES = {"distance": (0.0, math.inf), "angle": (0.0, 180.0)}


#: What values of TOML are called, one and several.
_WORDS: dict[Any, tuple[str, ...]] = {str: ("a text",), dict: ("a table",), bool: ("true or false",)}
_WORDS |= {float: ("a number", "numbers"), int: ("a whole number", "whole numbers")}


def _kinds(hint: Any) -> list[Any]:
    """The types that an annotation names, but None; of a number with a rule, which says more, a number."""
    if get_origin(hint) in (Union, UnionType):
        return [kind for part in get_args(hint) for kind in _kinds(part)]
    return [] if hint is NoneType else [float] if get_origin(hint) in (Annotated, Literal) else [hint]


def _is(value: Any, kind: Any) -> bool:
    if get_origin(kind) is list:
        return isinstance(value, list) and bool(value) and all(_is(each, *get_args(kind)) for each in value)
    if isinstance(value, bool) or kind is not float:
        return isinstance(value, kind) and isinstance(value, bool) == (kind is bool)
    return isinstance(value, int | float) and abs(value) <= sys.float_info.max


def _words(kind: Any, many: int = 0) -> str:
    return "lists of " * many + _words(get_args(kind)[0], 1) if get_origin(kind) is list else _WORDS[kind][many]


@dataclass(kw_only=True)
class Structure:
    file: str
    count_from: Literal[0, 1] = 0


@dataclass(kw_only=True)
class Forces:
    calculator: str | None = None
    settings: dict | None = None
    system: str | None = None


@dataclass(kw_only=True)
class Coordinate:
    name: str | None = None
    distance: list[int] | None = None
    difference: list[int] | None = None
    angle: list[int] | None = None
    dihedral: list[int] | None = None
    begin: float | None = field(default=None, metadata={"key": "from"})
    to: float | None = None
    windows: Count | None = None
    values: list[float] | None = None

    def __post_init__(self) -> None:
        families = [family for family in FAMILIES if getattr(self, family) is not None]
        self.family = families[0] if families else ""
        self.called = self.name or "-".join([*families, *map(str, getattr(self, self.family, ()))])
        if len(families) != 1:
            raise InputError(
                f"coordinate {self.called} is {' and '.join(families) or 'nothing'}; give the atoms of a "
                f"{', '.join(FAMILIES)}",
                item="coordinate",
            )
        ends = {"from": self.begin, "to": self.to, "windows": self.windows}
        given = [key for key, value in ends.items() if value is not None]
        if self.values is not None and given:
            raise InputError(f"coordinate {self.called} has values and {given[0]}; give one of them", item="coordinate")
        if self.values is None and len(given) < 3:
            raise InputError(f"coordinate {self.called}: give values, or from, to and windows", item="coordinate")
        self.count = len(self.values) if self.values is not None else self.windows or 0

    def constraint(self, first: int) -> Constraint:
        return coordinate_of(self.family, getattr(self, self.family), first)

    def places(self) -> FloatArray:
        """Where windows are, in angstrom and radian."""
        places = np.array(self.values, dtype=np.float64)
        if self.values is None:
            assert self.begin is not None and self.to is not None
            turn = self.family == "dihedral" and abs(self.to - self.begin) >= 360 - 1e-9
            places = np.linspace(float(self.begin), float(self.to), self.count, endpoint=not turn)
        low, high = _RANGES.get(self.family, (-math.inf, math.inf))
        for place in places[(places <= low) | (places >= high)].tolist():
            said = f"there is no {self.family} of {place:g} to hold {self.called} at; leave it out"
            raise InputError(said, item="coordinate")
        return np.radians(places) if self.family in ("angle", "dihedral") else places


@dataclass(kw_only=True)
class HeldRows:
    constrain: str | None = None
    fixed: list[int] | None = None
    distances: list[list[int]] | None = None

    def rows(self, atoms: Any, first: int) -> list[Constraint]:
        from kcons.ase import constraints_of

        found: list[Constraint] = [] if self.fixed is None else [FixedAtoms(counted(self.fixed, first))]
        if self.distances is not None:
            found.append(Distance([counted(pair, first) for pair in self.distances]))
        return found if self.constrain is None else [*found, *constraints_of(atoms, self.constrain, guess_bonds=True)]


@dataclass(kw_only=True)
class Improve:
    error: Positive
    most: Count
    below: Positive | None = None
    at_once: Count = 1


#: Keys of [sampling] that are arguments of `Windows`; the others are those of `Settings`.
_OF_WINDOWS = {"both_sides": bool, "rng": int}
_SAMPLING = get_type_hints(Settings, include_extras=True) | _OF_WINDOWS
#: Tables of a file.
_TABLES: dict[str, Any] = {
    "structure": Structure,
    "forces": Forces,
    "coordinate": Coordinate,
    "held": HeldRows,
    "sampling": make_dataclass("Sampling", [(key, kind | None, None) for key, kind in _SAMPLING.items()]),
    "improve": Improve,
}


@dataclass(frozen=True)
class InputFile:
    """An input file that was read.

    Attributes
    ----------
    sampler : Sampler
    settings : Settings
    targets : ndarray, shape (n, d)
        In angstrom and radian.
    options : dict
        Of `Windows`: both_sides, rng.
    improve : dict or None
        Of `Windows.improve`.
    """

    sampler: Sampler
    settings: Settings
    targets: FloatArray
    options: dict[str, Any]
    improve: dict[str, Any] | None


def read_input(file: str | PathLike[str], allow_modules: Collection[str] = ()) -> InputFile:
    """Read an input file; its paths count from where it lies.

    Nothing of what it names is imported or called, but for the calculators of `LISTED`, to look at their settings.

    Parameters
    ----------
    file : path
    allow_modules : collection of str
        Python modules of which it may take a calculator, and run their code.

    Raises
    ------
    InputError
        No TOML, unknown or missing keys, files that are not there, coordinates without values, more than 100,000
        windows; a calculator that is neither in `kcons.ase.named_calculators.LISTED` nor of one of these modules.
    """
    path = as_path(file, "file")
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is no TOML that can be read: {error}", item="file") from error
    tables: dict[str, Any] = {}
    for name, content in {"forces": {}, "sampling": {}, **data}.items():
        _refuse_unknown(name, _TABLES, "the input file")
        many = name == "coordinate"
        if many != isinstance(content, list):
            raise InputError(f"write {'[[coordinate]], once for each' if many else f'[{name}], once'}", item=name)
        read = [_read(_TABLES[name], name, each) for each in (content if many else [content])]
        tables[name] = read if many else read[0]
    for name, how in (("structure", "[structure] with file = ..."), ("coordinate", "[[coordinate]]")):
        if not tables.get(name):
            raise InputError(f"the input file has no {name}; write {how}", item=name)
    entries, coordinates = tables["coordinate"], {}
    for entry in entries:
        if entry.called in coordinates:
            raise InputError(f"two coordinates have the name {entry.called}; give each its own", item="coordinate")
        coordinates[entry.called] = entry.constraint(tables["structure"].count_from)
    if (count := math.prod(entry.count for entry in entries)) > MOST_WINDOWS:
        raise InputError(f"the input file has {count:,} windows; give at most {MOST_WINDOWS:,}", item="coordinate")
    targets = np.array(list(product(*(entry.places() for entry in entries))))
    sampling = {key: value for key, value in vars(tables["sampling"]).items() if value is not None}
    options = {key: sampling.pop(key) for key in _OF_WINDOWS if key in sampling}
    if "improve" in data and (len(coordinates) > 1 or count < 3):
        raise InputError(
            f"[improve] adds windows to a profile along one coordinate; the input file has {len(coordinates)}, with "
            f"{count} windows: leave it out, or begin with 3 windows or more along one",
            item="improve",
        )
    sampler = _sampler(path.parent, tables, coordinates, allow_modules)
    return InputFile(sampler, Settings(**sampling), targets, options, data.get("improve"))


def _read(kind: Any, name: str, entry: Any) -> Any:
    """A table as an object of a dataclass."""
    if not isinstance(entry, dict):
        raise InputError(f"{name} is {short(entry)}; write [{name}] and its keys below", item=name)
    own = {each.metadata.get("key", each.name): each for each in fields(kind)}
    hints, rules = get_type_hints(kind, include_extras=True), rules_of(kind)
    given: dict[str, Any] = {}
    for key, value in entry.items():
        _refuse_unknown(key, own, f"[{name}]")
        field_name, item = own[key].name, f"{key} of [{name}]"
        kinds = _kinds(hints[field_name])
        if not any(_is(value, each) for each in kinds):
            raise InputError(f"{item} is {short(value)}; give {', or '.join(map(_words, kinds))}", item=key)
        given[field_name] = reduce(lambda value, rule: rule(value, item), rules[field_name].rules, value)
    for key, each in own.items():
        if each.name not in given and each.default is MISSING:
            raise InputError(f"[{name}] has no {key}; write {key} = ...", item=key)
    return kind(**given)


def _refuse_unknown(key: str, known: Collection[str], where: str) -> None:
    if key not in known:
        raise InputError(f"{where} has an unknown key {unknown(key, known)}", item=key)


def coordinate_of(family: str, atoms: Sequence[int], first: int) -> Constraint:
    """A coordinate of one of `FAMILIES`, on atoms that are counted from `first`."""
    size, made = FAMILIES[family]
    if len(atoms) != size:
        raise InputError(f"{family} names {len(atoms)} atoms; give {size}", item=family)
    return made([counted(atoms, first)])


def counted(atoms: Sequence[int], first: int) -> list[int]:
    """Numbers from 0 of atoms that are counted from `first`."""
    if len(atoms) and min(atoms) < first:
        raise InputError(f"there is no atom {min(atoms)}; atoms are counted from {first}", item="atoms")
    return [atom - first for atom in atoms]


def read_structure(path: Path) -> Any:
    """The last structure of any file that ASE reads, as `Atoms`."""
    import ase.io

    return _opened("ASE", ase.io.read, path)


def _opened(program: str, read: Callable[[str], Any], path: Path) -> Any:
    """What a program reads from a file."""
    if not path.is_file():
        raise InputError(f"there is no file {path}", item="structure")
    try:
        return read(str(path))
    except Exception as error:
        raise InputError(f"{program} cannot read {path}: {type(error).__name__}: {error}", item="structure") from error


def _sampler(
    folder: Path, tables: Mapping[str, Any], coordinates: Mapping[str, Constraint], allow_modules: Collection[str]
) -> Sampler:
    forces, structure = tables["forces"], tables["structure"]
    place = folder / structure.file
    if (forces.calculator is None) == (forces.system is None):
        raise InputError(
            "give calculator or system in [forces]: a calculator of ASE, or the XML file of a System of OpenMM",
            item="forces",
        )
    if forces.system is not None:
        for given, key in ((forces.settings, "settings of [forces]"), (tables.get("held"), "[held]")):
            if given is not None:
                raise InputError(f"{key} is for a calculator of ASE, and no System; leave it out", item=key)
        from openmm import app

        from kcons.free_energy.windows.openmm_windows import OpenMMWindows, read_system

        system = read_system(folder / forces.system, "system")
        pdb = _opened("OpenMM", app.PDBxFile if place.suffix == ".cif" else app.PDBFile, place)
        return OpenMMWindows(pdb.topology, system, pdb.positions, coordinates)
    from kcons.ase.named_calculators import LISTED, named_calculator, refuse_unlisted
    from kcons.free_energy.windows.ase_windows import AseWindows

    atoms = read_structure(place)
    rows = tables.get("held", HeldRows()).rows(atoms, structure.count_from)
    refuse_unlisted(forces.calculator, allow_modules)
    make = partial(named_calculator, forces.calculator, forces.settings or {})
    if forces.calculator in LISTED:
        make()  # complain of settings
    return AseWindows(atoms, make, coordinates, rows)
