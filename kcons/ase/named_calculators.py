"""Calculators of ASE by name, as commands and plan files give them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from hashlib import sha256
from importlib import import_module
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from ase import Atoms
from ase.calculators.names import names as ase_names

from kcons.ase.binding import FORCES_ONLY
from kcons.errors import InputError, KconsError, UnsupportedError, did_you_mean, unknown

#: Endings of files that say what a calculator computes, not what it writes.
WEIGHTS = [".model", ".pt", ".pth", ".ckpt", ".pb", ".safetensors", ".h5", ".npz", ".xml", ".yace"]
WEIGHTS += [".eam", ".alloy", ".fs", ".adp"]
#: Calculators of ASE that take any setting, and know those alone that they list.
_FULLY_LISTED = ("emt", "lj", "morse")
#: Calculators that compute in this process, whatever their settings: others start programs that settings name.
LISTED = ("gfn2", "gfn1", *_FULLY_LISTED, "eam", "tip3p", "tip4p")


def refuse_unlisted(name: str, modules: Collection[str]) -> None:
    """Refuse a calculator that a file names, unless it is listed or of one of these modules; nothing is imported."""
    if name in LISTED:
        return
    module, _, attribute = name.partition(":") if ":" in name else (f"ase.calculators.{name}", "", name)
    if not (attribute and module) or (":" not in name and name not in ase_names):
        raise _no_calculator(name)
    if module not in modules:
        raise InputError(
            f"the calculator {name!r} runs code of the module {module}, or a program that its settings name. If you "
            f"trust where they come from, allow it: --allow-module {module} on the command line, "
            f"allow_modules=[{module!r}] in Python. Without that there are {', '.join(LISTED)}",
            item="calculator",
        )


def named_calculator(name: str, settings: Mapping[str, Any] | None = None) -> Any:
    """A calculator from its name.

    Parameters
    ----------
    name : str
        gfn2 or gfn1 (by tblite), the name of a calculator of ASE, or MODULE:NAME of what makes one.
    settings : mapping, optional
        Arguments of what makes it.

    Raises
    ------
    InputError
        There is none of that name, it does not take these settings, or what it makes is no calculator.
    UnsupportedError
        tblite is not installed.
    """
    given = dict(settings or {})
    try:
        if name in ("gfn1", "gfn2"):
            if find_spec("tblite") is None:
                raise UnsupportedError(f"{name} needs tblite: python -m pip install tblite")
            from tblite.ase import TBLite

            _refuse_unknown(name, TBLite, given)
            return TBLite(**{"method": f"GFN{name[-1]}-xTB", "verbosity": 0, **given})
        if ":" in name:
            kind = _made_by(name)
        else:
            from ase.calculators.calculator import get_calculator_class

            kind = get_calculator_class(name)
        if name in _FULLY_LISTED:
            _refuse_unknown(name, kind, given)
        made = kind(**given)
    except KconsError:
        raise
    except Exception as error:
        raise _no_calculator(name, error) from error
    if not _calculates(made):
        raise InputError(f"{name} makes no calculator of ASE: {made!r:.60}; name what does", item="calculator")
    return made


def _made_by(name: str) -> Any:
    """A class or function of a module, or of the package it belongs to; not what the module took from elsewhere."""
    module, _, attribute = name.partition(":")
    kind = getattr(import_module(module), attribute)
    home = str(getattr(kind, "__module__", "")).partition(".")[0]
    if not callable(kind) or home != module.partition(".")[0] or (isinstance(kind, type) and not _calculates(kind)):
        raise InputError(
            f"{name} is no calculator of ASE, nor a function of that module that makes one; name what is",
            item="calculator",
        )
    return kind


def _calculates(found: Any) -> bool:
    return hasattr(found, "get_potential_energy") and hasattr(found, "get_forces")


def _no_calculator(name: str, error: Exception | None = None) -> InputError:
    known = ["gfn2", "gfn1", *ase_names]
    hint = "" if name in known else did_you_mean(name, known)
    why = f" with these settings ({type(error).__name__}: {error})" if ":" in name or name in known else ""
    return InputError(
        f"there is no calculator {name!r}{why if error else ''}{hint}; there are gfn2, gfn1, those of ASE by "
        "name (emt, lj, ...), and MODULE:NAME for what makes any other",
        item="calculator",
    )


def _refuse_unknown(name: str, kind: Any, given: Mapping[str, Any]) -> None:
    known = list(kind.default_parameters)
    for key in given:
        if key not in known:
            raise InputError(f"{name} has no setting {unknown(key, known)}", item=key)


def described(calculator: Any, atoms: Atoms) -> list[Any]:
    """What tells a calculator from others: its kind, its parameters, and the calculators that it is made of.

    What it may take for the charge and the spin, initial charges and magnetic moments of the atoms and ``atoms.info``,
    is in it where there is any, and constraints of ASE that add forces. Plain data, the same in each process; of files
    of weights, the contents. What a calculator does not give as parameters is not in it.
    """
    initial = {k: atoms.arrays[k] for k in ("initial_charges", "initial_magmoms") if np.any(atoms.arrays.get(k, 0))}
    added = [item.todict() for item in atoms.constraints if isinstance(item, FORCES_ONLY)]
    return [_plain(part) for part in (*_kind(calculator), *filter(None, (initial, atoms.info)), *added)]


def _kind(calculator: Any) -> list[Any]:
    """Its class, its parameters, and those of what it is made of."""
    parts = getattr(getattr(calculator, "mixer", calculator), "calcs", ())
    kind, parameters = type(calculator), getattr(calculator, "parameters", {})
    return [f"{kind.__module__}.{kind.__qualname__}", parameters, [_kind(part) for part in parts]]


def _plain(value: Any) -> Any:
    """As data of JSON; of other objects their kind."""
    if isinstance(value, Mapping):
        return {str(key): _plain(value[key]) for key in sorted(value, key=str)}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, str | PathLike):
        file = Path(value)
        weights = file.suffix in WEIGHTS and file.is_file()
        return [str(file), sha256(file.read_bytes()).hexdigest()] if weights else str(value)
    return value if value is None or isinstance(value, int | float) else type(value).__qualname__
