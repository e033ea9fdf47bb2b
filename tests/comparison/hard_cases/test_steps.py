"""Steps that are too long, zero or backwards, through the core; refusals of several calls."""

from __future__ import annotations

import math

import pytest
from hard_case_runs import cases_of, check_core, verdict_on_careless

from kcons.comparison.hard_cases.contract import CannotExpressError
from kcons.comparison.hard_cases.steps import chain_in_springs, each_refused, water_in_field
from kcons.errors import InputError


@pytest.mark.parametrize("number", cases_of("steps"))
def test_core(number):
    check_core(number)


def refuse():
    raise InputError("no", item="x")


def test_all_calls_have_to_be_refused():
    with pytest.raises(InputError, match="no"):
        each_refused({"one": refuse, "two": refuse})
    (check,) = each_refused({"one": refuse, "two": lambda: 0.0}).checks
    assert check.name == "two: accepted;" and not check.passed
    worst, other = each_refused({"one": lambda: 0.1, "two": lambda: 0.3}).checks
    assert (worst.value, other.value) == (0.3, 0.1)


def test_what_cannot_be_asked_is_no_refusal():
    def cannot():
        raise CannotExpressError("no such thing")

    with pytest.raises(CannotExpressError):
        each_refused({"one": cannot, "two": refuse})


@pytest.mark.parametrize("made", [water_in_field, chain_in_springs])
def test_problems_start_on_their_constraints(made):
    problem, fastest = made()
    assert problem.residual(problem.x) < 1e-14
    assert math.isclose(problem.kinetic(problem.tangent(problem.v)), problem.kinetic(problem.v), rel_tol=1e-12)
    assert fastest > 0


def test_a_program_that_holds_nothing_is_noticed():
    assert verdict_on_careless("H09") == "silently wrong"
