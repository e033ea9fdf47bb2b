"""Heavy hydrogens at 4 fs: what temperature is reported, and that of configurations."""

from __future__ import annotations

import math
import runpy

import numpy as np
import pytest
from committed_pages import ROOT


@pytest.fixture(scope="module")
def example():
    return runpy.run_path(str(ROOT / "examples" / "studies/openmm_heavy_hydrogens.py"))


def test_langevin_reports_300_k_and_a_chain_without_noise_what_harmonic_vibrations_say(example):
    """40 ps: about 270 K at the ends of steps of 4 fs, 300 K in between, within three standard errors."""
    system, x = example["alanine"]("HBonds")
    start = example["start_of"](system, x, 1, 1000)
    omega = example["harmonic"](system, x)
    # 66 coordinates, 12 bonds with hydrogen; a carbonyl vibrates in 19 fs.
    assert len(omega) == 54
    assert 2e3 * math.pi / omega.max() == pytest.approx(19, abs=1)
    expected = 300 * (1 - np.mean((0.004 * omega) ** 2) / 4)
    for name, reported in (("kcons Langevin", 300.0), ("kcons NoseHooverMiddle", expected)):
        found = example["sample"](system, start, name, 0.004, 40.0)
        for key, kelvin in (("reported", reported), ("half", 300.0)):
            assert abs(found[key]["mean"] - kelvin) <= 3 * found[key]["error"] < 25
    assert expected < 280
