"""Random molecules: no fault is found, and faults that are planted are."""

from __future__ import annotations

import numpy as np

from kcons.comparison.stability import fuzz, trial


def test_fuzz_finds_no_fault():
    trials = [trial(seed) for seed in range(120)]
    found = fuzz.summary(trials)
    assert found["faults"] == []
    assert found["outcomes"]["solved"] > 60
    assert found["outcomes"]["refused in a step"] > 5
    assert set(found["shapes"]) == set(fuzz.SHAPES)


def test_trials_repeat():
    assert trial(7) == trial(7)
    assert trial(7) != trial(8)


def test_fuzz_sees_faults(monkeypatch):
    """A stepper that shifts one atom by 1e-6 is found; so is one that returns NaN."""
    steady = fuzz.Rattle

    class Sloppy(steady):
        off = 1e-6

        def step(self, system, state, dt):
            after = super().step(system, state, dt)
            after.positions[0, 0] += self.off
            return after

    class Broken(Sloppy):
        off = np.nan

    seed = next(s for s in range(100) if trial(s).outcome == "solved" and trial(s).shape == "tree")
    monkeypatch.setattr(fuzz, "STEPPERS", (Sloppy,))
    assert trial(seed).outcome == "silent"
    monkeypatch.setattr(fuzz, "STEPPERS", (Broken,))
    assert trial(seed).outcome == "NaN"
