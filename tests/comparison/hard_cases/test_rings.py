"""Planar rings and sheets through the core; their shapes."""

from __future__ import annotations

import numpy as np
import pytest
from hard_case_runs import cases_of, check_core, verdict_on_careless

from kcons.comparison.hard_cases.rings import META, PARA, SIDES, ring, sheet


@pytest.mark.parametrize("number", cases_of("rings"))
def test_core(number):
    check_core(number)


def test_a_hexagon_has_six_sides_six_and_three_diagonals():
    x = ring(6, 1.39)
    for pairs, count, length in ((SIDES, 6, 1.39), (META, 6, 1.39 * np.sqrt(3)), (PARA, 3, 2.78)):
        assert len({frozenset(pair) for pair in pairs}) == count
        np.testing.assert_allclose([np.linalg.norm(x[i] - x[j]) for i, j in pairs], length, rtol=1e-14)


def test_a_sheet_is_a_honeycomb():
    x, near = sheet(4, 4)
    assert len(x) == 32
    assert np.bincount(np.ravel(near)).max() == 3
    bonds = {frozenset(pair) for pair in near}
    far = [np.linalg.norm(x[i] - x[j]) for i in range(32) for j in range(i) if frozenset((i, j)) not in bonds]
    assert min(far) == pytest.approx(1.42 * np.sqrt(3), rel=1e-12)


def test_a_program_that_holds_nothing_is_noticed():
    assert verdict_on_careless("X16") == "silently wrong"
