"""All hard cases through kcons; and programs that hold nothing, which they have to notice."""

from __future__ import annotations

import re

import numpy as np
import pytest

from hard_cases import thermostats
from hard_cases.case import OURS, Case, all_cases, judge, outcome, run_cell
from hard_cases.programs import CannotExpressError, Core
from hard_cases.steps import each_refused
from kcons.errors import InputError

CASES = all_cases()
#: Judges that take long.
SLOW = {"H16", "H35", "H33", "X42"}
#: Run at the length of the list; the others are shortened.
FULL = {"H01", "H06", "H07", "H08", "H13", "H16", "H26", "H30", "H31", "H32", "H41"}
#: What refusals of the core say: the item and the remedy.
SAID = {
    "H02": r"ContradictionError: constraints #0 and #1 on atoms \(0, 1\) have different targets 1\.0, 1\.001; remove",
    "H17": "InputError: atom 3 has mass 0; constrained atoms need positive mass .*FixedAtoms",
    "H18": r"SingularGeometryError: row 0, Distance\(0, 1\): atoms 0 and 1 coincide: gradient undefined",
    "H19": "InputError: position of atom 2 is not finite",
    "H20": "OverdeterminedError: rank 12 leaves no degree of freedom.*hold fewer rows",
    "H21": r"InfeasibleError: infeasible: residual cannot go below 0\.333333.*sum of squares.*Correct the longest",
    "H22": "InputError: .*needs non-zero kinetic energy: draw velocities first",
    "H23": "OverdeterminedError: g - 1 = 0: isokinetic temperature undefined",
    "H29": r"InputError: Distance: row 1 names an atom twice: \(2, 2\)",
    "H34": "BudgetError: .*not what the start can produce.*Leave the budget out",
    "H36": "BudgetError: the start is already at equilibrium.*start elsewhere",
    "H39": "warned: total momentum is not zero.*Take it out",
    "H40": "InputError: the cutoff 1 must be above 0 and at most half the box",
    "X06": "SingularGeometryError: row 2, Angle.*: angle constraint singular at 180 deg, use a linear constraint",
    "X10": "SingularGeometryError: .*10 linearized degrees of freedom here but 9 at positions nearby",
    "X33": r"InputError: initial positions are off row #[01] Distance\(0, [12]\) by 0\.2; pass project=True",
    "X34": "InputError: initial velocities violate the constraints: atom 4 .*pass project=True",
    "X35": "InputError: .*target 3 is not shorter than half the box.*Use a larger cell",
    "X40": r"ConvergenceError: step 1: time step too large \(dt = 1\.01\)",
    "X41": "ConvergenceError: .*too large for this geometry; use a smaller time step",
    "X60": "InfeasibleError: .*violate the triangle inequality",
    "X62": "NonFiniteError: non-finite force at step 50 on atom 0.*The state before this step is intact",
    "X70": r"ContradictionError: row #6 Distance\(0, 1\) lies between fixed atoms and is off by 0\.01; fix them",
}
#: What differs in the adapters: degrees of freedom, bad masses, thermostats, starts off the constraints, long steps.
IN_ENGINES = ("H05", "H13", "H17", "H20", "H22", "H23", "H24", "H39", "X04", "X33", "X40")


@pytest.mark.parametrize("number", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in CASES])
def test_core(number):
    """Right or refused, as the case asks for, and never silent."""
    cell = run_cell(CASES[number], "kcons", quick=number not in FULL)
    assert cell.met, cell.text
    assert cell.verdict in ("right", "refused")
    assert number not in SAID or (cell.verdict == "refused" and re.match(SAID[number], cell.text)), cell.text


@pytest.mark.validation
@pytest.mark.parametrize("number", [n for n in CASES if n not in FULL])
def test_core_at_full_length(number):
    cell = run_cell(CASES[number], "kcons", quick=False)
    assert cell.met, cell.text


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
        free = problem.but(pairs=(), lengths=None, triples=(), others=())
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
    Case("Y00", "a case", "a limit", kind, lambda program, quick: outcome())
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
        (BOUND, InputError("no", item="x"), "", "kcons", "refused", False),
        (RAISE, InputError("no", item="x"), "", "kcons", "refused", True),
        (WARN, InputError("no", item="x"), "", "kcons", "refused", True),
        (RAISE, IndexError("out of bounds"), "", "kcons in ASE", "crash/NaN", False),
        (BOUND, OF_OPENMM, "", "OpenMM", "crash/NaN", False),
        (RAISE, OF_OPENMM, "", "OpenMM", "refused", True),
        (WARN, LARGE, "the energy wanders", "kcons", "refused", True),
        (BOUND, LARGE, "the energy wanders", "kcons", "refused", False),
        (WARN, outcome(), "careful", "kcons", "refused", True),
        (RAISE, outcome(), "", "kcons", "silently wrong", False),
        (RAISE, CannotExpressError("no surfaces"), "", "ASE", "cannot express", False),
    ],
)
def test_verdicts(case, found, warned, program, verdict, met):
    cell = judge(case, found, warned, program)
    assert (cell.verdict, cell.met) == (verdict, met), cell.text
