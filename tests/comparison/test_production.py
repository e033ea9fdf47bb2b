"""Which step is right for averages: told from runs, or said to be unknown."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.comparison import production, test_systems
from kcons.comparison.production import StepCheck, check_steps, sentence

RIGHT = StepCheck(2.0, 0.001, 0.002, "shift", 0.5)
WRONG = StepCheck(4.0, 0.08, 0.002, "turn", 0.3)
VAGUE = StepCheck(3.0, 0.01, 0.02, "turn", 0.1)
CLIMBING = StepCheck(4.0, 0.0, 0.002, "turn", 9.0)
FAILED = StepCheck(6.0, np.nan, np.nan, "", np.nan, "ConvergenceError: no solution")


@pytest.mark.parametrize(
    ("checks", "words"),
    [
        ([RIGHT, WRONG], "the step may be 2 fs: .* At 4 fs turn motions are off by \\+8.0 %"),
        ([RIGHT], "the step may be 2 fs: .* longer ones were not tried"),
        ([RIGHT, CLIMBING], "the step may be 2 fs: .* At 4 fs the energy climbs"),
        ([RIGHT, FAILED], "the step may be 2 fs: .* At 6 fs ConvergenceError: no solution"),
        ([WRONG], "No step that was tried, from 4 fs on, is right for averages: turn motions are off by \\+8.0 %"),
        ([RIGHT, VAGUE], "A step of 2 fs is right for averages at 300 K; at 3 fs .* known to 4 % only .* --budget"),
        ([VAGUE], "At 3 fs the temperature of configurations is known to 4 % only"),
    ],
)
def test_sentences(checks, words):
    import re

    assert re.search(words, sentence(checks, "fs"))


def test_what_is_known_and_right():
    assert RIGHT.right and RIGHT.known and not WRONG.right and WRONG.known
    assert not VAGUE.right and not VAGUE.known and not CLIMBING.right and CLIMBING.known
    assert FAILED.known and not FAILED.right


def test_short_steps_of_a_fluid_are_right_and_long_ones_fail():
    """Eight rigid waters: 1 fs cannot be told wrong, 40 fs ends with an error or a temperature that is off."""
    water = test_systems.build("water", 8, forces="ase")
    checks = check_steps(water, [1.0, 40.0], 3.0)
    assert checks[0].step == 1.0 and abs(checks[0].off) < 4 * checks[0].error
    assert len(checks) == 2 and not checks[1].right and checks[1].known


def test_the_climb_is_told_from_an_oscillation():
    chain = test_systems.build("chain", 4)
    assert abs(production._climb(chain, chain.time_steps[-1], 0.2)) < 10
