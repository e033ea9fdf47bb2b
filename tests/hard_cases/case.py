"""What a hard case is, and how its outcome is judged.

A case is a function of a program and of `quick`. It sets a problem up, lets the program run it, and returns checks:
measured numbers with their limits, found by closed forms, invariants or the dense theory, never by the method that
is judged. What the function raises is a refusal.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, NamedTuple

from hard_cases.programs import PROGRAMS, CannotExpressError, Program, quiet
from kcons.errors import KconsError

#: 'bound': the checks must hold; 'raise': a refusal is asked for; 'warn-or-raise': either will do.
Kind = Literal["bound", "raise", "warn-or-raise"]
Verdict = Literal["right", "refused", "silently wrong", "crash/NaN", "cannot express"]

#: Columns of the table, in order.
SYSTEMS = ("kcons", "kcons in ASE", "kcons in OpenMM", "ASE", "OpenMM")
OURS = SYSTEMS[:3]
#: Modules that hold cases.
THEMES = "bodies rings chains starts steps long_runs inputs invariance thermostats growth_models"
#: Which programs reasons are of that a case gives by these names.
_NAMES = {
    "ase": ("ASE",),
    "openmm": ("OpenMM",),
    "peers": ("ASE", "OpenMM"),
    "in_ase": ("kcons in ASE",),
    "in_openmm": ("kcons in OpenMM",),
    "md_engines": SYSTEMS[1:],
}


class Check(NamedTuple):
    """A measured number and what it may be at most."""

    name: str
    value: float
    limit: float

    @property
    def passed(self) -> bool:
        return self.value <= self.limit

    def __str__(self) -> str:
        return f"{self.name} {self.value:.3g} (limit {self.limit:.3g})"


class Outcome(NamedTuple):
    """What a case function returns: its checks and a remark. `remark` also says where a run was shortened."""

    checks: tuple[Check, ...]
    remark: str = ""

    def named(self, name: str) -> list[Check]:
        """The checks, of a part of a case."""
        return [check._replace(name=f"{name}: {check.name}") for check in self.checks]


def outcome(*checks: tuple[str, float, float], remark: str = "") -> Outcome:
    """An outcome from (name, value, limit)."""
    return Outcome(tuple(Check(name, float(value), float(limit)) for name, value, limit in checks), remark)


Function = Callable[[Program, bool], Outcome]


@dataclass(frozen=True)
class Case:
    """A hard case: H01 to H42 are those of the list, X01 and on others; `limit` says in words what must be true."""

    number: str
    title: str
    limit: str
    kind: Kind
    function: Function
    #: Programs that cannot be asked, with the reason.
    cannot: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Cell:
    """The verdict on one program in one case; `met` where it is right, or refused where that is asked for."""

    verdict: Verdict
    met: bool
    #: The number against its limit, the error's type and text, or the reason.
    text: str
    #: The first check that failed, or the one nearest to its limit.
    check: Check | None = None


_CASES: dict[str, Case] = {}


def case(number: str, title: str, limit: str, kind: Kind = "bound", **more: Any) -> Callable[[Function], Function]:
    """Register a function as a case.

    `more` are further arguments of the function, and reasons by program, such as ``ase="no surfaces"``.
    """

    def register(function: Function) -> Function:
        assert number not in _CASES, number
        reasons = {name: more[key] for key in _NAMES if key in more for name in _NAMES[key]}
        given = {key: value for key, value in more.items() if key not in _NAMES}
        _CASES[number] = Case(number, title, limit, kind, partial(function, **given), reasons)
        return function

    return register


def all_cases() -> dict[str, Case]:
    """All cases by number, in the order of the numbers."""
    for theme in THEMES.split():
        importlib.import_module(f"hard_cases.{theme}")
    return dict(sorted(_CASES.items()))


def judge(case: Case, found: Outcome | BaseException, warned: str = "", program: str = "") -> Cell:
    """The verdict on what a case function returned or raised, and on the text of a warning, if there was one.

    Of kcons only typed errors count as refusals.
    """
    if isinstance(found, BaseException):
        words = " ".join(str(found).split())
        if isinstance(found, CannotExpressError):
            return Cell("cannot express", False, words)
        if program in OURS and not isinstance(found, KconsError):
            return Cell("crash/NaN", False, f"untyped {type(found).__name__}: {words}")
        met = case.kind != "bound"
        nan = not met and type(found).__name__ == "OpenMMException" and "NaN" in words
        return Cell("crash/NaN" if nan else "refused", met, f"{type(found).__name__}: {words}")
    failed = next((check for check in found.checks if not check.passed), None)
    check = failed or max(
        found.checks, key=lambda check: check.value / check.limit if check.limit else 0.0, default=None
    )
    notes = "; ".join(part for part in (found.remark, f"warned: {warned}" if warned else "") if part)
    tail = f"; {notes}" if notes else ""
    broken = next((check for check in found.checks if not math.isfinite(check.value)), None)
    if broken:
        return Cell("crash/NaN", False, f"{broken.name} is {broken.value}{tail}", check)
    if failed and warned and case.kind != "raise":
        return Cell("refused", case.kind == "warn-or-raise", f"warned: {warned}; {failed}", check)
    if check is None:
        told = warned and case.kind != "bound"
        return Cell("refused", True, notes) if told else Cell("silently wrong", False, f"accepted without a word{tail}")
    return Cell("silently wrong" if failed else "right", not failed, f"{check}{tail}", check)


def run_cell(case: Case, program: str, quick: bool) -> Cell:
    """The verdict on one program in one case."""
    if program in case.cannot:
        return Cell("cannot express", False, case.cannot[program])
    warned = ""
    try:
        found, warned = quiet(lambda: case.function(PROGRAMS[program](), quick))
    except Exception as error:
        found = error
    return judge(case, found, warned, program)


def run_numbered(number: str, program: str, quick: bool) -> Cell:
    """A cell by the number of its case: cases do not travel to other processes."""
    return run_cell(all_cases()[number], program, quick)
