"""Hard cases, shortened, through the core of kcons; and a program that holds nothing, which they have to notice."""

from __future__ import annotations

import pytest

from kcons.comparison.hard_cases import all_cases, judge, run_cell
from kcons.comparison.hard_cases.programs import Core

CASES = all_cases()
#: Costly judges: the same numbers are tested in test_hard_cases_*.py of the core.
SLOW = {"H16", "H35", "H33", "X42"}


def cases_of(theme):
    """Numbers of the cases of one module, for `parametrize`."""
    found = [number for number, case in CASES.items() if case.theme == theme]
    assert found, theme
    return [pytest.param(number, marks=pytest.mark.slow) if number in SLOW else number for number in found]


def check_core(number):
    """Right or refused, as the case asks for, and never silent."""
    cell = run_cell(CASES[number], "kcons", quick=True)
    if cell.verdict == "cannot express":
        assert "no kcons." in cell.text  # growth models or flows are not there
        return
    assert cell.met, cell.text
    assert cell.verdict in ("right", "refused")


class Careless(Core):
    """Forgets what is to be held."""

    def run(self, problem, *args, **options):
        free = problem.but(pairs=(), lengths=None, triples=(), angles=None, others=())
        return super().run(free, *args, **options)


def verdict_on_careless(number):
    """Of a case on a program that holds nothing and says nothing."""
    case = CASES[number]
    try:
        found = case.function(Careless(), True)
    except Exception as error:
        found = error
    cell = judge(case, found, program="kcons")
    assert not cell.met, cell.text
    return cell.verdict
