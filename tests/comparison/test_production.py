"""Which step is right for averages: told from runs, or said to be unknown."""

from __future__ import annotations

import re

import pytest

from kcons.comparison import production, test_systems
from kcons.comparison.production import check_steps, known, right, sentence


def row(step, off, error, kind, climb):
    worst = abs(off) + 2 * error
    return {"setting": step, "status": "ok", "error": worst, kind: off, f"{kind}_error": error, "climb": climb}


RIGHT, WRONG = row(2.0, 0.001, 0.002, "shift", 0.5), row(4.0, 0.08, 0.002, "turn", 0.3)
#: 3.5 standard errors from the truth: of several runs one may be; and far beyond.
DOUBTFUL, FAR = row(1.0, -0.137, 0.039, "turn", 0.1), row(1.0, -0.3, 0.02, "turn", 0.1)
VAGUE, CLIMBING = row(3.0, 0.01, 0.02, "turn", 0.1), row(4.0, 0.0, 0.002, "turn", 9.0)
FAILED = {"setting": 6.0, "status": "failed", "note": "ConvergenceError: no solution", "climb": 0.0}
FEW = {"setting": 3.0, "status": "partial", "note": "18 samples are too few for an error", "climb": 0.0}


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([RIGHT, WRONG], "the step may be 2 fs: .* At 4 fs turn motions are off by \\+8.0 % \\(± 0.4, two standard"),
        ([RIGHT], "the step may be 2 fs: .* longer ones were not tried"),
        ([RIGHT, CLIMBING], "the step may be 2 fs: .* At 4 fs the energy climbs"),
        ([RIGHT, FAILED], "the step may be 2 fs: .* At 6 fs ConvergenceError: no solution"),
        ([WRONG], "No step that was tried, from 4 fs on, is right for averages: turn motions are off by \\+8.0 %"),
        ([RIGHT, VAGUE], "A step of 2 fs is right for averages at 300 K; at 3 fs .* known to 4 % only .* --budget"),
        ([FAR], "No step that was tried, from 1 fs on, is right for averages: turn motions are off by -30.0 %"),
        ([DOUBTFUL], "At 1 fs the temperature of configurations is known to 7.8 % only"),
        ([FEW], "^At 3 fs 18 samples are too few for an error: give a larger --budget"),
        ([{**FEW, "climb": 9.0}], "No step that was tried, from 3 fs on, is right for averages: the energy climbs"),
        ([VAGUE], "At 3 fs the temperature of configurations is known to 4 % only"),
    ],
)
def test_sentences(rows, words):
    assert re.search(words, sentence(rows, "fs"))


def test_short_steps_of_a_fluid_are_right_and_long_ones_fail(monkeypatch):
    """Eight rigid waters: 1 fs cannot be told wrong, 40 fs ends with an error or a temperature that is off."""
    monkeypatch.setattr(production, "CLIMBS", 6.0)  # so short runs may seem to climb
    water = test_systems.build("water", 8, forces="ase")
    (short,) = check_steps(water, [1.0], 0.3)
    rows = check_steps(water, [1.0, 40.0], 3500 * short["step_seconds"])  # about as many steps on any machine
    first = rows[0]
    assert first["setting"] == 1.0 and all(abs(first[k]) < 4 * first[f"{k}_error"] for k in ("shift", "turn"))
    assert len(rows) == 2 and not right(rows[1]) and known(rows[1])


def test_the_climb_is_told_from_an_oscillation():
    chain = test_systems.build("chain", 4)
    assert abs(production._climb(chain, chain.time_steps[-1], 0.2)) < 10
