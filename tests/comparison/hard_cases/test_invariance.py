"""What must not matter, through the core."""

from __future__ import annotations

import pytest
from hard_case_runs import cases_of, check_core, verdict_on_careless


@pytest.mark.parametrize("number", cases_of("invariance"))
def test_core(number):
    check_core(number)


@pytest.mark.parametrize("number", ["H26", "X70"])
def test_a_program_that_holds_nothing_is_noticed(number):
    assert verdict_on_careless(number) == "silently wrong"
