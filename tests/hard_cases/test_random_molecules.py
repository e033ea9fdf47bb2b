"""Random molecules: no fault is found, and faults that are planted are."""

from __future__ import annotations

from collections import Counter

import numpy as np

from hard_cases import random_molecules
from hard_cases.random_molecules import trial


def test_random_molecules_finds_no_fault():
    trials = [trial(seed) for seed in range(120)]
    outcomes = Counter(t.outcome for t in trials)
    assert not set(outcomes) & set(random_molecules.FAULTS)
    assert outcomes["solved"] > 60
    assert outcomes["refused in a step"] > 5
    assert {t.shape for t in trials} == set(random_molecules.SHAPES)


def test_trials_repeat():
    assert trial(7) == trial(7)
    assert trial(7) != trial(8)


def test_random_molecules_sees_faults(monkeypatch):
    """A stepper that shifts one atom by 1e-6 is found; so is one that returns NaN."""
    steady = random_molecules.Rattle

    class Sloppy(steady):
        off = 1e-6

        def step(self, system, state, dt):
            after = super().step(system, state, dt)
            after.positions[0, 0] += self.off
            return after

    class Broken(Sloppy):
        off = np.nan

    seed = next(s for s in range(100) if trial(s).outcome == "solved" and trial(s).shape == "tree")
    monkeypatch.setattr(random_molecules, "STEPPERS", (Sloppy,))
    assert trial(seed).outcome == "silent"
    monkeypatch.setattr(random_molecules, "STEPPERS", (Broken,))
    assert trial(seed).outcome == "NaN"
