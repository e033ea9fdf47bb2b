"""Isokinetic cases through the core; a thermostat that does nothing is noticed."""

from __future__ import annotations

import pytest
from hard_case_runs import CASES, cases_of, check_core

from kcons.comparison.hard_cases import judge, thermostats
from kcons.comparison.hard_cases.programs import Core


@pytest.mark.parametrize("number", cases_of("thermostats"))
def test_core(number):
    check_core(number)


@pytest.mark.parametrize("number", ["H22", "H23"])
def test_a_thermostat_that_refuses_nothing_is_noticed(number, monkeypatch):
    monkeypatch.setattr(thermostats, "_step", lambda program, problem, *args, **options: problem.v)
    case = CASES[number]
    cell = judge(case, case.function(Core(), True), program="kcons")
    assert (cell.verdict, cell.met) == ("silently wrong", False)
