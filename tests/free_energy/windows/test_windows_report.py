"""Tables and files of windows."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from window_samplers import Fake

from kcons.cli.terminal import rendered
from kcons.free_energy import Settings, Windows, pull_free_energy
from kcons.free_energy.windows import windows_report


@pytest.fixture
def found(tmp_path):
    windows = Windows(
        Fake(str(tmp_path / "diary"), fails=("window-0001-up",), shift=0.4),
        tmp_path / "out",
        Settings(production=640, every=10),
    )
    return windows.run(np.linspace(-np.pi, np.pi, 9)[:-1], executor=ThreadPoolExecutor(1))


def test_table_and_sentences(found):
    text = rendered(windows_report.table(found, [True]))
    assert "torsion (degrees)" in text and "-180" in text and "±" in text
    said = windows_report.summary(found)
    assert said.startswith("8 windows") and "window-0001-up failed: RuntimeError" in said
    assert "from the lowest to the highest point" in said
    low = min(w.hysteresis for w in found.windows if w.number != 1)
    assert ("(marked !)" in said) == (low < 0.01) == ("!" in text)


def test_files(found, tmp_path):
    paths = windows_report.write(found, tmp_path, [True])
    assert [path.name for path in paths] == ["free_energy.json", "profile.csv", "profile.png"]
    lines = paths[1].read_text().splitlines()
    assert lines[0] == "torsion (radian),F (kJ/mol),error (kJ/mol)"
    numbers = np.loadtxt(paths[1], delimiter=",", skiprows=1)
    np.testing.assert_allclose(numbers[:, 1], found.profile.F, rtol=1e-6, atol=1e-9)
    assert paths[2].read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("places", [[0.1, 0.5, 0.9], [0.1, 0.5], [0.1, 0.1, 0.5]], ids=str)
def test_a_profile_or_why_there_is_none(places, tmp_path):
    """What `integrate` takes: three windows at different places."""
    profile = len(set(places)) == 3
    windows = Windows(Fake(str(tmp_path / "diary")), tmp_path / "out", Settings(production=640, every=10))
    found = windows.run(places, executor=ThreadPoolExecutor(1))
    said = windows_report.summary(found)
    names = [path.name for path in windows_report.write(found, tmp_path, [True])]
    assert ("from the lowest to the highest point" in said) == ("profile.csv" in names) == profile
    assert ("no profile: 2 different windows are too few for a profile; give 3 or more" in said) == (not profile)


def test_a_formula_has_its_own_unit(found, tmp_path):
    """Of OpenMM it is in nm, and nobody knows whether it is a length."""
    text = rendered(windows_report.table(found, [None]))
    assert "torsion (own unit)" in text and "kJ/mol by own unit" in text and "angstrom" not in text
    (_, columns, _) = windows_report.write(found, tmp_path, [None])
    assert columns.read_text().startswith("torsion (own unit),F")


def test_pulls_beside_windows_that_do_not_reach_their_ends(found):
    pulled = pull_free_energy(np.linspace(0, 1, 20), thermal_energy=2.5)
    numbers, said = windows_report.of_pulls(found, pulled, np.array([0.1]), np.array([4.0]))
    assert numbers["windows"][0] == pytest.approx(found.profile.difference(0.1, 4.0 - 2 * np.pi).value)
    found.windows[:] = found.windows[:4]
    del found.profile
    numbers, said = windows_report.of_pulls(found, pulled, np.array([0.1]), np.array([4.0]))
    assert "windows" not in numbers and said.endswith("; the windows do not reach both ends")
