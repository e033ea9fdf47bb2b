"""Every hard case, shortened, through the core of kcons: right or refused, as it asks for, and never silent."""

from __future__ import annotations

import pytest

from kcons.comparison.hard_cases import OURS, all_cases, run_cell

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


@pytest.mark.parametrize("program", OURS[1:])
@pytest.mark.parametrize("number", ["H05", "H13", "H17", "H20", "H22", "H23", "H24", "H39", "X04", "X33", "X40"])
def test_parts_for_hosts(number, program):
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
