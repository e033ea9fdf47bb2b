"""Cases for MD engines, and what is told of coarse positions."""

from __future__ import annotations

import pytest

from kcons.comparison.hard_cases import OURS, all_cases, run_cell

CASES = all_cases()


@pytest.mark.parametrize("program", OURS[1:])
@pytest.mark.parametrize("number", ["H05", "H13", "H17", "H20", "H22", "H23", "H24", "H39", "X04", "X33", "X40"])
def test_parts_for_md_engines(number, program):
    cell = run_cell(CASES[number], program, quick=True)
    assert cell.verdict in ("right", "refused"), cell.text
    assert cell.met, cell.text


def test_coarse_positions_in_openmm_are_told():
    """At 1e6 nm positions are rounded to 1e-10 nm: the energy wanders, and a warning says so."""
    cell = run_cell(CASES["H12"], "kcons in OpenMM", quick=True)
    assert cell.verdict == "refused"
    assert "OpenMM rounds positions" in cell.text
