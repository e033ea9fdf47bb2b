"""All hard cases, shortened, through kcons; and programs that hold nothing, which they have to notice."""

from __future__ import annotations

import numpy as np
import pytest

from hard_cases import thermostats
from hard_cases.case import OURS, Case, all_cases, judge, outcome, run_cell
from hard_cases.contract import CannotExpressError
from hard_cases.programs import Core
from hard_cases.steps import each_refused
from kcons.errors import InputError

CASES = all_cases()
#: Judges that take long.
SLOW = {"H16", "H35", "H33", "X42"}
#: What differs in the adapters: degrees of freedom, bad masses, thermostats, starts off the constraints, long steps.
IN_ENGINES = ("H05", "H13", "H17", "H20", "H22", "H23", "H24", "H39", "X04", "X33", "X40")


@pytest.mark.parametrize("number", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in CASES])
def test_core(number):
    """Right or refused, as the case asks for, and never silent."""
    cell = run_cell(CASES[number], "kcons", quick=True)
    assert cell.met, cell.text
    assert cell.verdict in ("right", "refused")


@pytest.mark.parametrize("program", OURS[1:])
@pytest.mark.parametrize("number", IN_ENGINES)
def test_in_ase_and_openmm(number, program):
    cell = run_cell(CASES[number], program, quick=True)
    assert cell.verdict in ("right", "refused"), cell.text
    assert cell.met, cell.text


def test_coarse_positions_in_openmm_are_told():
    """At 1e6 nm positions are rounded to 1e-10 nm: the energy wanders, and a warning says so."""
    cell = run_cell(CASES["H12"], "kcons in OpenMM", quick=True)
    assert cell.verdict == "refused"
    assert "OpenMM rounds positions" in cell.text


def test_all_cases_of_the_list_are_there():
    assert [name for name in CASES if name.startswith("H")] == [f"H{k:02d}" for k in range(1, 43)]
    assert sum(name.startswith("X") for name in CASES) >= 30


# -- what the cases must notice -----------------------------------------------------------------------


class Careless(Core):
    """Forgets what is to be held."""

    def run(self, problem, *args, **options):
        free = problem.but(pairs=(), lengths=None, triples=(), angles=None, others=())
        return super().run(free, *args, **options)


@pytest.mark.parametrize("number", ["X05", "X16", "X24", "X33", "X60", "X70", "H09", "H26"])
def test_a_program_that_holds_nothing_is_noticed(number):
    case = CASES[number]
    try:
        found = case.function(Careless(), True)
    except Exception as error:
        found = error
    cell = judge(case, found, program="kcons")
    assert (cell.verdict, cell.met) == ("silently wrong", False), cell.text


@pytest.mark.parametrize("number", ["H22", "H23"])
def test_a_thermostat_that_refuses_nothing_is_noticed(number, monkeypatch):
    monkeypatch.setattr(thermostats, "_step", lambda program, problem, *args, **options: problem.v)
    cell = judge(CASES[number], CASES[number].function(Core(), True), program="kcons")
    assert (cell.verdict, cell.met) == ("silently wrong", False)


def test_all_calls_have_to_be_refused():
    def refuse():
        raise InputError("no", item="x")

    def cannot():
        raise CannotExpressError("no such thing")

    with pytest.raises(InputError, match="no"):
        each_refused({"one": refuse, "two": refuse})
    (check,) = each_refused({"one": refuse, "two": lambda: 0.0}).checks
    assert check.name == "two: accepted;" and not check.passed
    with pytest.raises(CannotExpressError):
        each_refused({"one": cannot, "two": refuse})


# -- verdicts -----------------------------------------------------------------------------------------

BOUND, RAISE, WARN = (
    Case("Y00", "a case", "a limit", kind, "bodies", lambda program, quick: outcome())
    for kind in ("bound", "raise", "warn-or-raise")
)
SMALL, LARGE, NAN = outcome(("energy", 1e-9, 1e-8)), outcome(("energy", 1e-7, 1e-8)), outcome(("energy", np.nan, 1.0))
OF_OPENMM = type("OpenMMException", (Exception,), {})("Particle coordinate is NaN")


@pytest.mark.parametrize(
    ("case", "found", "warned", "program", "verdict", "met"),
    [
        (BOUND, SMALL, "", "kcons", "right", True),
        (BOUND, LARGE, "", "kcons", "silently wrong", False),
        *((case, NAN, "", "kcons", "crash/NaN", False) for case in (BOUND, RAISE, WARN)),
        (BOUND, outcome(("energy", np.inf, 1.0)), "", "kcons", "crash/NaN", False),
        (BOUND, InputError("no", item="x"), "", "kcons", "refused", False),
        (RAISE, InputError("no", item="x"), "", "kcons", "refused", True),
        (WARN, InputError("no", item="x"), "", "kcons", "refused", True),
        (RAISE, RuntimeError("Did not converge"), "", "ASE", "refused", True),
        (RAISE, IndexError("out of bounds"), "", "kcons in ASE", "crash/NaN", False),
        (BOUND, OF_OPENMM, "", "OpenMM", "crash/NaN", False),
        (RAISE, OF_OPENMM, "", "OpenMM", "refused", True),
        (WARN, LARGE, "the energy wanders", "kcons", "refused", True),
        (BOUND, LARGE, "the energy wanders", "kcons", "refused", False),
        (WARN, outcome(), "careful", "kcons", "refused", True),
        (RAISE, outcome(), "", "kcons", "silently wrong", False),
        (RAISE, CannotExpressError("no surfaces"), "", "ASE", "cannot express", False),
        (RAISE, ImportError("No module named 'openmm'"), "", "OpenMM", "cannot express", False),
    ],
)
def test_verdicts(case, found, warned, program, verdict, met):
    cell = judge(case, found, warned, program)
    assert (cell.verdict, cell.met) == (verdict, met), cell.text
