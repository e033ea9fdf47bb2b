"""Every hard case, shortened, through the core of kcons: right or refused, as it asks for, and never silent."""

from __future__ import annotations

import pytest

from kcons.comparison.hard_cases import all_cases, run_cell

CASES = all_cases()
#: Costly judges: the same numbers are tested in test_hard_cases_*.py of the core.
SLOW = {"H16", "H35", "H33", "X42"}


@pytest.mark.parametrize(
    "number", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in CASES]
)
def test_core(number):
    cell = run_cell(CASES[number], "kcons", quick=True)
    if cell.verdict == "cannot express":
        assert "no kcons." in cell.text  # growth models or flows are not there
        return
    assert cell.met, cell.text
    assert cell.verdict in ("right", "refused")


def test_all_cases_of_the_list_are_there():
    assert [name for name in CASES if name.startswith("H")] == [f"H{k:02d}" for k in range(1, 43)]
    assert sum(name.startswith("X") for name in CASES) >= 30
