"""Windows as a file describes them, in TOML."""

from __future__ import annotations

import math
import sys
import tomllib
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, fields
from functools import partial
from itertools import product
from os import PathLike
from pathlib import Path
from reprlib import repr as short
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints import Angle, Constraint, Dihedral, Distance, FixedAtoms
from kcons.constraints.arguments import whole_number
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError, did_you_mean
from kcons.free_energy.windows.window import Sampler, Settings
from kcons.steppers.files import as_path

#: Tables of a plan, and what the values of their keys are.
TABLES: dict[str, dict[str, str]] = {
    "structure": {"file": "a text", "count_from": "0 or 1"},
    "forces": {
        **dict.fromkeys(("calculator", "system", "platform"), "a text"),
        **dict.fromkeys(("settings", "properties"), "a table"),
    },
    "coordinate": {
        "name": "a text",
        **dict.fromkeys(("distance", "angle", "dihedral"), "whole numbers"),
        **dict.fromkeys(("from", "to"), "a number"),
        "windows": "a whole number above 0",
        "values": "numbers",
    },
    "held": {"constrain": "a text", "fixed": "whole numbers", "distances": "pairs of whole numbers"},
    # What there is more to say of settings, they say themselves.
    "sampling": {**dict.fromkeys((f.name for f in fields(Settings)), "one value"), "both_sides": "true or false"}
    | {"approach": "a number, or numbers", "seed": "one value"},
    "improve": {
        **dict.fromkeys(("error", "below"), "a number above 0"),
        **dict.fromkeys(("most", "at_once"), "a whole number above 0"),
    },
    "pulls": {
        **dict.fromkeys(("from", "to"), "a number, or numbers"),
        **dict.fromkeys(("count", "steps"), "one value"),
        "both_ways": "true or false",
    },
    "workers": {"processes": "a whole number above 0", "scheduler": "a text"},
}
#: Windows of a plan, at most.
MOST_WINDOWS = 100_000
#: Steps of a pull unless they are given.
_PULL = 20000
FAMILIES: dict[str, type[Constraint]] = {"distance": Distance, "angle": Angle, "dihedral": Dihedral}


@dataclass(frozen=True)
class PlanFile:
    """A plan that was read.

    Attributes
    ----------
    sampler : Sampler
    settings : Settings
    targets : ndarray, shape (n, d)
        In angstrom and radian.
    options : dict
        Of `Windows`: both_sides, approach, seed.
    improve : dict or None
        Of `Windows.improve`.
    pulls : dict or None
        Of `Windows.pull`: start and end in angstrom and radian, count, both_ways.
    pull_steps : int
        Steps of each of these.
    processes : int or None
    scheduler : str or None
        Address of a scheduler of Dask.
    """

    sampler: Sampler
    settings: Settings
    targets: FloatArray
    options: dict[str, Any]
    improve: dict[str, Any] | None
    pulls: dict[str, Any] | None
    pull_steps: int
    processes: int | None
    scheduler: str | None

    def executor(self) -> AbstractContextManager[Executor | None]:
        """Where the windows run; None for processes of this machine."""
        return nullcontext() if self.scheduler is None else _Cluster(self.scheduler)


class _Cluster(AbstractContextManager["Executor | None"]):
    """The executor of a Dask cluster."""

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ModuleNotFoundError:
            raise UnsupportedError(
                "a scheduler is one of Dask, which is not installed: python -m pip install 'dask[distributed]'"
            ) from None
        try:
            self._client = Client(address, timeout="10s")
        except (OSError, ValueError) as error:
            raise InputError(f"no scheduler of Dask answers at {address}: {error}", item="scheduler") from error

    def __enter__(self) -> Executor:
        found: Executor = self._client.get_executor(pure=False)
        return found

    def __exit__(self, *_: object) -> None:
        self._client.close()


def read_plan(file: str | PathLike[str], allow_modules: Collection[str] = ()) -> PlanFile:
    """Read a plan; its paths count from where it lies.

    Nothing of what a plan names is imported or called, but for the calculators of `LISTED`, to look at their settings.

    Parameters
    ----------
    file : path
    allow_modules : collection of str
        Python modules of which the plan may take a calculator, and run their code.

    Raises
    ------
    InputError
        No TOML, unknown or missing keys, files that are not there, coordinates without values, more than 100,000
        windows; a calculator that is neither in `kcons.ase.named_calculators.LISTED` nor of one of these modules.
    """
    path = as_path(file, "plan")
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"there is no file {path}", item="plan") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error}", item="plan") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is no TOML: {error}", item="plan") from error
    except RecursionError:
        raise InputError(
            f"{path}: lists or tables are too deep in each other; a plan needs two levels", item="plan"
        ) from None
    _refuse_unknown(data)
    coordinates, values = {}, []
    for entry in data.get("coordinate", []):
        name, item, places = _coordinate(entry, data.get("structure", {}).get("count_from", 0))
        if name in coordinates:
            raise InputError(f"two coordinates have the name {name}; give each its own", item="coordinate")
        coordinates[name] = item
        values.append(places)
    if not coordinates:
        raise InputError("the plan has no [[coordinate]]", item="coordinate")
    settings = dict(data.get("sampling", {}))
    options = {key: settings.pop(key) for key in ("both_sides", "approach", "seed") if key in settings}
    if "approach" in options:
        options["approach"] = _in_radian("approach", options["approach"], coordinates)
    workers = data.get("workers", {})
    _refuse_more(math.prod(map(len, values)), "coordinate")
    targets = np.array(list(product(*values)))
    if "improve" in data and (len(coordinates) > 1 or len(targets) < 3):
        raise InputError(
            f"[improve] adds windows to a profile along one coordinate; the plan has {len(coordinates)}, with "
            f"{len(targets)} windows: leave it out, or begin with 3 windows or more along one",
            item="improve",
        )
    pulls = _pulls(data["pulls"], coordinates, targets) if "pulls" in data else None
    return PlanFile(
        _sampler(data, path.parent, coordinates, allow_modules),
        Settings(**settings),
        targets,
        options,
        data.get("improve"),
        pulls,
        data.get("pulls", {}).get("steps", _PULL),
        workers.get("processes"),
        workers.get("scheduler"),
    )


def _refuse_more(windows: int, item: str) -> None:
    if windows > MOST_WINDOWS:
        raise InputError(f"the plan has {windows:,} windows; give at most {MOST_WINDOWS:,}", item=item)


def _refuse_unknown(data: Mapping[str, Any]) -> None:
    for table, content in data.items():
        _refuse(table, TABLES, "the plan")
        if (table == "coordinate") != isinstance(content, list):
            brackets = "[[coordinate]], once for each" if table == "coordinate" else f"[{table}], once"
            raise InputError(f"write {brackets}", item=table)
        for entry in content if isinstance(content, list) else [content]:
            if not isinstance(entry, dict):
                raise InputError(f"{table} is {short(entry)}; write [{table}] and its keys below", item=table)
            for key in entry:
                _refuse(key, TABLES[table], f"[{table}]")
                wanted = TABLES[table][key]
                if not _is(entry[key], wanted):
                    raise InputError(f"{key} of [{table}] is {short(entry[key])}; give {wanted}", item=key)
    for key in ("error", "most") if "improve" in data else ():
        if key not in data["improve"]:
            raise InputError(f"[improve] has no {key}; give error (kJ/mol) and most, a number of windows", item=key)


def _is(value: Any, wanted: str) -> bool:
    """Whether a value of TOML is what is wanted."""
    if wanted == "one value":
        return not isinstance(value, dict | list)
    if wanted in ("a text", "a table", "true or false"):
        return isinstance(value, {"a text": str, "a table": dict, "true or false": bool}[wanted])
    if wanted == "pairs of whole numbers":
        return isinstance(value, list) and all(_is(pair, "whole numbers") and len(pair) == 2 for pair in value)
    if wanted == "a number, or numbers":
        return _is(value, "a number") or _is(value, "numbers")
    if wanted == "0 or 1":
        return _is(value, "a whole number") and value in (0, 1)
    if wanted.endswith("numbers"):
        return isinstance(value, list) and bool(value) and all(_is(v, "a " + wanted[:-1]) for v in value)
    kinds = int if "whole" in wanted else (int, float)
    number = isinstance(value, kinds) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
    return number and (value > 0 or "above 0" not in wanted)


def _refuse(key: str, known: Any, where: str) -> None:
    if key not in known:
        hint = did_you_mean(key, known)
        raise InputError(f"{where} has an unknown key {key!r}{hint}; there are {', '.join(known)}", item=key)


def _coordinate(entry: Mapping[str, Any], first: int) -> tuple[str, Constraint, FloatArray]:
    families = [family for family in FAMILIES if family in entry]
    name = entry.get("name") or "-".join([*families, *map(str, entry.get(families[0] if families else "", []))])
    if len(families) != 1:
        raise InputError(
            f"coordinate {name} is {' and '.join(families) or 'nothing'}; give the atoms of a {', '.join(FAMILIES)}",
            item="coordinate",
        )
    (family,) = families
    item = FAMILIES[family]([counted(entry[family], first)])
    both = [key for key in ("from", "to", "windows") if key in entry and "values" in entry]
    if both:
        raise InputError(f"coordinate {name} has values and {both[0]}; give one of them", item="coordinate")
    if "values" in entry:
        places = np.array(entry["values"], dtype=np.float64)
    elif {"from", "to", "windows"} <= set(entry):
        turn = family == "dihedral" and abs(entry["to"] - entry["from"]) >= 360 - 1e-9
        _refuse_more(entry["windows"], "windows")
        places = np.linspace(entry["from"], entry["to"], entry["windows"], endpoint=not turn)
    else:
        raise InputError(f"coordinate {name}: give values, or from, to and windows", item="coordinate")
    if places.ndim != 1 or not len(places):
        raise InputError(f"coordinate {name} has no values", item="coordinate")
    low, high = {"distance": (0.0, math.inf), "angle": (0.0, 180.0), "dihedral": (-math.inf, math.inf)}[family]
    for place in places[(places <= low) | (places >= high)].tolist():
        raise InputError(f"there is no {family} of {place:g} to hold {name} at; leave it out", item="coordinate")
    return name, item, places if family == "distance" else np.radians(places)


def _pulls(entry: Mapping[str, Any], coordinates: Mapping[str, Constraint], targets: FloatArray) -> dict[str, Any]:
    """Arguments of `Windows.pull`; by default from the first window to the last."""
    found = {key: entry[key] for key in ("count", "both_ways") if key in entry}
    for key, argument, place in (("from", "start", targets[0]), ("to", "end", targets[-1])):
        if key in entry:
            place = _in_radian(f"{key} of [pulls]", np.atleast_1d(entry[key]), coordinates)
        found[argument] = place
    for key, low in (("count", 5), ("steps", 1)):
        whole_number(entry.get(key, low), f"{key} of [pulls]", low)
    if np.array_equal(found["start"], found["end"]):
        raise InputError("[pulls] begin where they end; give from and to", item="pulls")
    return found


def counted(atoms: Sequence[int], first: int) -> list[int]:
    """Numbers from 0 of atoms that are counted from `first`.

    Raises
    ------
    InputError
        One below the first.
    """
    if len(atoms) and min(atoms) < first:
        raise InputError(f"there is no atom {min(atoms)}; atoms are counted from {first}", item="atoms")
    return [atom - first for atom in atoms]


def _in_radian(key: str, given: ArrayLike, coordinates: Mapping[str, Constraint]) -> FloatArray:
    """Values of the coordinates, or one for all of them, angles of degrees in radian."""
    values = np.array(given, dtype=np.float64)
    if values.shape not in ((), (len(coordinates),)):
        raise InputError(
            f"{key} has {values.size} values; give one for each of {', '.join(coordinates)}", item=key.split()[0]
        )
    return np.where([isinstance(item, Distance) for item in coordinates.values()], values, np.radians(values))


def _sampler(
    data: Mapping[str, Any], folder: Path, coordinates: Mapping[str, Constraint], allow_modules: Collection[str]
) -> Sampler:
    structure, forces, held = data.get("structure", {}), data.get("forces", {}), data.get("held", {})
    if "file" not in structure:
        raise InputError("the plan has no structure; write [structure] with file = ...", item="structure")
    place = folder / structure["file"]
    if not place.is_file():
        raise InputError(f"there is no file {place}", item="structure")
    if ("calculator" in forces) == ("system" in forces):
        raise InputError(
            "give calculator or system in [forces]: a calculator of ASE, or the XML file of a System of OpenMM",
            item="forces",
        )
    for key, other in (("settings", "system"), ("platform", "calculator"), ("properties", "calculator")):
        if key in forces and other in forces:
            raise InputError(f"{key} of [forces] says nothing to a {other}; leave it out", item=key)
    if "system" in forces:
        if held:
            raise InputError("in OpenMM the System says what is held; leave out [held]", item="held")
        return _of_openmm(place, folder / forces["system"], forces, coordinates)
    import ase.io

    from kcons.ase import constraints_of
    from kcons.ase.named_calculators import LISTED, named_calculator, refuse_unlisted
    from kcons.free_energy.windows.ase_windows import AseWindows

    try:
        atoms: Any = ase.io.read(place)
    except Exception as error:
        raise InputError(f"ASE cannot read {place}: {type(error).__name__}: {error}", item="structure") from error
    first = structure.get("count_from", 0)
    rows: list[Constraint] = []
    if "fixed" in held:
        rows.append(FixedAtoms(counted(held["fixed"], first)))
    if "distances" in held:
        rows.append(Distance([counted(pair, first) for pair in held["distances"]]))
    if "constrain" in held:
        rows += constraints_of(atoms, held["constrain"], guess_bonds=True)
    refuse_unlisted(forces["calculator"], allow_modules)
    make = partial(named_calculator, forces["calculator"], forces.get("settings", {}))
    if forces["calculator"] in LISTED:
        make()  # complain of settings
    return AseWindows(atoms, make, coordinates, rows)


def _of_openmm(
    structure: Path, system: Path, forces: Mapping[str, Any], coordinates: Mapping[str, Constraint]
) -> Sampler:
    from openmm import app

    from kcons.free_energy.scans.system_calculator import read_system
    from kcons.free_energy.windows.openmm_windows import OpenMMWindows

    made = read_system(system, "system")
    try:
        pdb = app.PDBxFile(str(structure)) if structure.suffix == ".cif" else app.PDBFile(str(structure))
    except Exception as error:
        raise InputError(
            f"OpenMM cannot read {structure}: {type(error).__name__}: {error}", item="structure"
        ) from error
    return OpenMMWindows(
        pdb.topology,
        made,
        pdb.positions,
        coordinates,
        platform=forces.get("platform"),
        properties=forces.get("properties"),
    )
