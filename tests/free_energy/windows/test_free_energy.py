"""What windows have found, put together."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from window_samplers import Fake

from kcons.cli.terminal import rendered
from kcons.errors import InputError
from kcons.free_energy import FreeEnergy, MeanForce, Settings, WindowResult, Windows
from kcons.free_energy.windows.driver import combine_sides, with_error

PERIOD = 2 * np.pi


def of_two_sides(apart):
    """A window whose sides, with errors of 0.1 and 0.2, differ by so much."""
    sides = {
        name: MeanForce(("a", "b"), np.zeros(2), force, error**2 * np.eye(2), force, 100, 50.0)
        for name, force, error in (("up", np.zeros(2), 0.1), ("down", np.array(apart), 0.2))
    }
    return combine_sides(np.zeros(2), sides, Fake("", scales=np.ones(2)))


def test_sides_that_differ_by_more_than_chance_widen_the_error():
    by_chance, hardly = of_two_sides([0.4, 0.1]), of_two_sides([1.0, 0.1])
    assert by_chance.p_value > 0.01 > hardly.p_value
    np.testing.assert_allclose(by_chance.covariance, 0.0125 * np.eye(2))
    np.testing.assert_allclose(hardly.covariance, 0.0125 * np.eye(2) + [[0.25, 0.025], [0.025, 0.0025]])


def result(place, slope, d=1):
    at, force = np.full(d, place), np.full(d, slope)
    return WindowResult("ab", at, force, 1e-4 * np.eye(d), force, 1, 1.0, sides={}, p_value=np.nan)


def found(degrees, names=("torsion",), periods=(PERIOD,)):
    windows = [result(q, -2 * np.sin(2 * q), len(names)) for q in np.radians(degrees)]
    return FreeEnergy(names, np.array(periods), windows)


def test_a_torsion_may_be_given_beyond_its_period():
    beyond = found([0, 90, 180, 270, 405, 495, 585, 675]).profile
    within = found([0, 45, 90, 135, 180, 225, 270, 315]).profile
    np.testing.assert_allclose(np.degrees(beyond.windows), np.arange(0, 360, 45), atol=1e-9)
    assert beyond.closure is not None
    assert np.abs(beyond.F - within.F).max() < 1e-6 * within.error.max()
    with pytest.raises(InputError, match="1 different windows"):
        _ = found([10, 370, 730]).profile
    with pytest.raises(InputError, match="0 different windows"):
        _ = found([]).profile


@pytest.mark.parametrize("there", [[150, 165, 180, 195, 210], [150, 165, 180, -165, -150], [510, -195, 180, 195, -150]])
def test_windows_across_the_end_of_a_turn_are_a_part_of_it(there):
    """However they are written, no profile is made where there are no windows."""
    part = found(there)
    np.testing.assert_allclose(np.degrees(part.profile.x[-1] - part.profile.x[0]), 60.0)
    assert part.profile.closure is None and part.profile.error.max() < 0.1
    assert part.profile.difference(part.profile.x[0], part.profile.x[100]).value == pytest.approx(0.5, abs=0.01)
    assert max(np.degrees(part.profile.next_windows(3))) <= np.degrees(part.profile.x[-1]) + 1e-9


@pytest.mark.filterwarnings("ignore:a barrier that comes three times")
def test_a_turn_with_gaps_of_any_width_is_closed():
    for there in ([0, 90, 135, 180, 202, 225, 270, 292, 315], [0, 120, 240], np.arange(-180, 181, 30)):
        assert found(there).profile.closure is not None
    half = found(range(0, 100, 10)).profile
    assert half.closure is None and half.difference(0, np.pi / 2).value == pytest.approx(-2.0, abs=0.02)


def test_surfaces_of_a_part_of_a_turn():
    places = [(a, b) for a in (40, 60, 80, 100) for b in (-40, -15, 15, 40)]
    windows = [replace(result(0, 0, 2), value=np.radians(p), force=9 * np.sin(np.radians(p))) for p in places]
    surface = FreeEnergy(("a", "b"), np.full(2, PERIOD), windows).surface
    assert surface.periods == (None, None)


@pytest.fixture
def sampled(tmp_path):
    return run(tmp_path, np.linspace(-np.pi, np.pi, 9)[:-1], fails=("window--2.35619449-up",), shift=0.4)


def run(folder, places, **fake):
    how = {"settings": Settings(production=640, every=10), "executor": ThreadPoolExecutor(1)}
    return Windows(Fake(str(folder / "diary"), **fake), folder / "out", **how).run(places)


def test_table_and_sentences(sampled):
    text = rendered(sampled.table())
    assert "torsion (degrees)" in text and "-180" in text and "±" in text
    said = sampled.summary()
    assert said.startswith("8 windows") and "window--2.35619449-up failed: RuntimeError" in said
    assert "from the lowest to the highest point" in said
    low = min(w.p_value for w in sampled.windows if len(w.sides) == 2)
    assert ("(marked !)" in said) == (low < 0.01) == ("!" in text)
    assert with_error(123.4, 12.3) == "123 ± 12" and with_error(-2e-9, 3e-17) == "0.000000 ± 3.0e-17"


def test_files(sampled, tmp_path):
    paths = sampled.write(tmp_path)
    assert [path.name for path in paths] == ["free_energy.json", "profile.csv", "profile.png"]
    assert paths[1].read_text().splitlines()[0] == "torsion (radian),F (kJ/mol),error (kJ/mol)"
    numbers = np.loadtxt(paths[1], delimiter=",", skiprows=1)
    np.testing.assert_allclose(numbers[:, 1], sampled.profile.F, rtol=1e-6, atol=1e-9)
    assert paths[2].read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("places", [[0.1, 0.5, 0.9], [0.1, 0.5], [0.1, 0.1, 0.5]], ids=str)
def test_a_profile_or_why_there_is_none(places, tmp_path):
    """What `integrate` takes: three windows at different places."""
    profile, found = len(set(places)) == 3, run(tmp_path, places)
    said = found.summary()
    names = [path.name for path in found.write(tmp_path)]
    assert ("from the lowest to the highest point" in said) == ("profile.csv" in names) == profile
    assert ("no profile: 2 different windows are too few for a profile; give 3 or more" in said) == (not profile)


def test_no_profile_of_other_windows_is_left(tmp_path):
    """A file of fewer windows, in the folder of more."""
    assert len(run(tmp_path, [0.1, 0.5, 0.9]).write(tmp_path)) == 3
    assert run(tmp_path, [0.1, 0.5]).write(tmp_path) == [tmp_path / "free_energy.json"]
    assert not sorted(tmp_path.glob("profile.*"))


def test_a_formula_has_its_own_unit(sampled, tmp_path):
    """Of OpenMM it is in nm, and nobody knows whether it is a length."""
    sampled.angles = (None,)
    text = rendered(sampled.table())
    assert "torsion (own unit)" in text and "kJ/mol per own unit" in text and "angstrom" not in text
    (_, columns, _) = sampled.write(tmp_path)
    assert columns.read_text().startswith("torsion (own unit),F")
