"""How outcomes become verdicts."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.comparison.hard_cases import CannotExpressError, Case, all_cases, judge, outcome
from kcons.errors import InputError


def case_of(kind):
    return Case("Y00", "a case", "a limit", kind, "bodies", lambda program, quick: outcome())


BOUND, RAISE, WARN = (case_of(kind) for kind in ("bound", "raise", "warn-or-raise"))


def test_numbers_within_limits_are_right():
    cell = judge(BOUND, outcome(("residual", 1e-12, 1e-10), ("energy", 1e-9, 1e-8)))
    assert (cell.verdict, cell.met) == ("right", True)
    assert "energy 1e-09 (limit 1e-08)" in cell.text


def test_a_number_beyond_its_limit_is_silently_wrong():
    cell = judge(BOUND, outcome(("residual", 1e-12, 1e-10), ("energy", 1e-7, 1e-8)))
    assert (cell.verdict, cell.met) == ("silently wrong", False)
    assert cell.text.startswith("energy")


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("case", [BOUND, RAISE, WARN])
def test_nan_is_nan_whatever_is_asked_for(case, value):
    cell = judge(case, outcome(("residual", value, 1.0)))
    assert (cell.verdict, cell.met) == ("crash/NaN", False)


@pytest.mark.parametrize(("case", "met"), [(BOUND, False), (RAISE, True), (WARN, True)])
def test_refusals(case, met):
    cell = judge(case, InputError("no", item="x"), program="kcons")
    assert (cell.verdict, cell.met, cell.text) == ("refused", met, "InputError: no")
    assert judge(case, RuntimeError("Did not converge"), program="ASE").verdict == "refused"


def test_of_kcons_untyped_errors_are_crashes():
    cell = judge(RAISE, IndexError("out of bounds"), program="kcons in ASE")
    assert (cell.verdict, cell.met) == ("crash/NaN", False)


def test_nan_errors_of_openmm_are_crashes_where_numbers_are_asked_for():
    error = type("OpenMMException", (Exception,), {})("Particle coordinate is NaN")
    assert judge(BOUND, error, program="OpenMM").verdict == "crash/NaN"
    assert judge(RAISE, error, program="OpenMM").verdict == "refused"


def test_warnings_are_not_silence():
    late = outcome(("energy", 1.0, 0.1))
    assert judge(WARN, late, "the energy wanders").met
    cell = judge(BOUND, late, "the energy wanders")
    assert (cell.verdict, cell.met) == ("refused", False)
    assert judge(WARN, outcome(), "careful").verdict == "refused"
    assert judge(RAISE, outcome()).verdict == "silently wrong"


def test_what_cannot_be_said():
    assert judge(RAISE, CannotExpressError("no surfaces")).text == "no surfaces"
    assert judge(RAISE, ImportError("No module named 'openmm'")).verdict == "cannot express"


def test_all_cases_of_the_list_are_there():
    names = list(all_cases())
    assert [name for name in names if name.startswith("H")] == [f"H{k:02d}" for k in range(1, 43)]
    assert sum(name.startswith("X") for name in names) >= 30
