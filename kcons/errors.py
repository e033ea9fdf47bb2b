"""The exception tree.

Every error names the item that is wrong and says what to do about it. Each class also derives from
the built-in that fits (`ValueError`, `RuntimeError`, ...), and carries its data as attributes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from importlib import import_module
from typing import Any

__all__ = [
    "BudgetError",
    "CalculatorError",
    "CertificateError",
    "ConstraintError",
    "ContradictionError",
    "ConvergenceError",
    "ImageError",
    "InfeasibleError",
    "InputError",
    "KconsError",
    "MissingPackageError",
    "MissingSettingError",
    "NonFiniteError",
    "OccupiedError",
    "OverdeterminedError",
    "ReversibilityError",
    "SingularGeometryError",
    "UnreadableError",
    "UnsupportedError",
]


class KconsError(Exception):
    """Root of all errors raised by kcons; what they know besides the message are attributes, given by name."""

    atoms: tuple[int, ...] = ()  #: Atoms concerned, if any.
    step: int | None = None  #: Step number, where a stepper knows it.

    def __init__(self, message: str, **known: Any) -> None:
        super().__init__(message)
        for name, value in known.items():
            getattr(type(self), name)  # of an attribute that the kind does not have, an error
            setattr(self, name, tuple(map(int, value)) if name in ("atoms", "rows") else value)


class InputError(KconsError, ValueError):
    """An argument has the wrong shape, a NaN or infinity, a bad mass, index or cell."""

    #: The argument or array that is wrong, without the name of what takes it: of ``"Sphere: center"`` the center.
    item: str = ""

    def __init__(self, message: str, *, item: str = "", **known: Any) -> None:
        super().__init__(message, item=item.rpartition(": ")[2], **known)


class UnreadableError(InputError):
    """A file ends too early, or has no numbers, before anything could be told of it."""


class OccupiedError(InputError):
    """A place to write to has something else in it."""


class ConstraintError(KconsError, ValueError):
    """A constraint cannot be held as it is written."""

    rows: tuple[int, ...] = ()  #: Row numbers concerned.


class ContradictionError(ConstraintError):
    """Two constraints ask for different things (two lengths for one pair, triangle inequality)."""


class SingularGeometryError(ConstraintError):
    """A gradient is undefined or the rows are singular only at this geometry."""


class OverdeterminedError(ConstraintError):
    """The rows leave no degree of freedom although something moves."""


class BudgetError(ConstraintError):
    """A prescribed production of entropy cannot be met from the start of a run."""

    budget: float = math.nan  #: What was asked for, T(s_eq - s_0).
    consistent: float = math.nan  #: What the start allows.
    time: float = math.nan  #: When the prescription would fail; infinite if it would never end at equilibrium.


class ImageError(KconsError, ValueError):
    """Two atoms of a row have drifted half the cell apart, so that its image is about to become another one."""


class CertificateError(KconsError, RuntimeError):
    """Results that a solver took for right are off the constraints as the set defines them."""

    row: int = -1  #: The worst row.
    residual: float = math.nan  #: abs(sigma) or abs(A v - c) of that row, in its natural units.
    state: object = None  #: The last state that was certified, where a run knows one; None otherwise.


class ConvergenceError(KconsError, RuntimeError):
    """No solution was found within the tolerance; positions and velocities are unchanged."""

    residual: float = math.nan  #: Last residual (relative to the scale of the row).
    tolerance: float = math.nan  #: What was asked for.
    iterations: int = 0  #: Newton iterations done.
    row: int = -1  #: The worst row, -1 if unknown.
    cluster: int = -1  #: Number of its cluster, -1 if unknown.
    copy: int = -1  #: Number of the system in a batch, -1 elsewhere.
    positions: Any = None  #: The best place found by a search for a minimum, shape (n_atoms, 3), or None.


class InfeasibleError(ConvergenceError):
    """No positions satisfy the constraints: the residual cannot be made smaller."""


class ReversibilityError(ConvergenceError):
    """A step that was taken back did not end where it began."""


class NonFiniteError(KconsError, FloatingPointError):
    """A NaN or infinity appeared during a run."""

    item: str = ""  #: 'force', 'position', 'velocity' or 'energy'.
    atom: int = -1  #: First atom concerned, -1 if it is no per-atom quantity.


class CalculatorError(KconsError, RuntimeError):
    """A calculator raised an error of its own, which is its cause."""


class UnsupportedError(KconsError, NotImplementedError):
    """The MD engine or method cannot do this; the message says what to use instead."""


class MissingSettingError(UnsupportedError, AttributeError):
    """An object has no such setting; `hasattr` is False for what reads or changes it."""


class MissingPackageError(KconsError, ModuleNotFoundError):
    """A package that is an extra is not installed."""


#: Packages that not everybody needs, and the extra that installs each.
EXTRAS = {
    "ase": "ase",
    "matplotlib": "plots",
    "pandas": "plots",
    "openmm": "openmm",
    "MDAnalysis": "mdanalysis",
    "tblite": "xtb",
    "sympy": "models",
    "pymbar": "free-energy",
    "torch": "torch",
    "torch_sim": "torchsim",
}


def with_extra(error: ModuleNotFoundError, what: str) -> ModuleNotFoundError:
    """The same error; where a package of `EXTRAS` is missing, or too old, one that says how `what` gets it."""
    package = (error.name or "").partition(".")[0]
    if package not in EXTRAS or isinstance(error, MissingPackageError):
        return error
    return MissingPackageError(
        f"{what} needs {error.name}, which is not installed, or not in this version: "
        f"python -m pip install --upgrade 'kcons[{EXTRAS[package]}]'",
        name=error.name,
    )


def imported_late(package: str, names: Mapping[str, Iterable[str]]) -> Callable[[str], Any]:
    """`__getattr__` of a package: imports the module of a name, of those by module, when the name is asked for."""
    modules = {name: module for module, own in names.items() for name in own}

    def attribute(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        try:
            return getattr(import_module(f"{package}.{modules[name]}"), name)
        except ModuleNotFoundError as error:
            raise with_extra(error, f"{package}.{name}") from error

    return attribute


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """What to add to a sentence about a name that is not known; '' where nothing is like it."""
    names = {name.lower(): name for name in known}
    near = get_close_matches(word.lower(), names, n=1, cutoff=0.6)
    return f" (did you mean {names[near[0]]!r}?)" if near else ""


def unknown(word: str, known: Iterable[str]) -> str:
    """A name that is not known, with what there is instead, at the end of a sentence."""
    return f"{word!r}{did_you_mean(word, names := list(known))}; there are {', '.join(names)}"
