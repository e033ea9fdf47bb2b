"""Heavy hydrogens at 4 fs: what temperature is reported, and that of configurations."""

from __future__ import annotations

import json
import math
import runpy

import numpy as np
import pytest
from committed_pages import FOLDER, ROOT

RESULTS = FOLDER / "openmm_heavy_hydrogens.json"


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


def test_a_harmonic_oscillator_has_the_frequency_of_its_spring(example):
    """The analysis, on alanine whose wells are the only forces."""
    system, x = example["alanine"]("AllBonds")
    for k in reversed(range(system.getNumForces())):
        if type(system.getForce(k)).__name__ != "CustomExternalForce":
            system.removeForce(k)
    omega = example["harmonic"](system, x)
    masses = example["masses_of"](system)
    # Six motions of a rigid body among them: between the frequencies of the lightest and the heaviest atom.
    assert len(omega) == 66 - system.getNumConstraints()
    lowest, highest = np.sqrt(200 / masses.max()), np.sqrt(200 / masses.min())
    assert lowest * (1 - 1e-9) <= omega.min() <= omega.max() <= highest * (1 + 1e-9)  # differences of forces


@pytest.mark.validation
@pytest.mark.parametrize("name", ["kcons Langevin", "kcons NoseHooverMiddle"])
def test_configurations_at_4_fs_anew(example, name):
    """Half a minute; against the means of the committed run at 1 fs."""
    system, x = example["alanine"]("HBonds")
    found = example["sample"](system, example["start_of"](system, x, 1, 5000), name, 0.004, 1000.0)
    zero = json.loads(RESULTS.read_text(encoding="utf-8"))["parts"]["HBonds"]["runs"][0]
    for key in ("bonds", "angles") if name == "kcons Langevin" else ("angles",):
        error = math.hypot(found[key]["error"], zero[key]["error"])
        assert abs(found[key]["mean"] - zero[key]["mean"]) <= 3 * error
    assert abs(found["half"]["mean"] - 300) <= 3 * found["half"]["error"]
