"""The committed results of long time steps reach what they must."""

from __future__ import annotations

import importlib.util
import json
import math
import sys
from itertools import pairwise
from pathlib import Path

import pytest

from kcons.thermostats import slow_share

ROOT = Path(__file__).parents[2]
RESULT = json.loads((ROOT / "docs" / "results" / "long_steps.json").read_text(encoding="utf-8"))
SMALL = {(row["spheres"], row["auxiliary"], row["wrong"]): row for row in RESULT["small"]["runs"]}
WATER = {row["name"]: row for row in RESULT["water"]}
REACH = {part["name"]: part for part in RESULT["reach"]["splittings"]}
FAR = {row["name"]: row for row in REACH["pairs to 7 A, long waves"]["water"]}


@pytest.mark.parametrize("key", [key for key in SMALL if not key[2]], ids=lambda key: f"{key[0]} {key[1]}")
def test_every_choice_of_spheres_agrees_with_metropolis(key):
    """All six observables within three standard errors, of at most one hundredth."""
    row = SMALL[key]
    assert max(map(abs, row["off"])) <= 3
    known = RESULT["small"]["metropolis"]
    assert all(error <= 0.02 * abs(value) for value, error in row["averages"])
    assert len(row["off"]) == len(known) == 6


@pytest.mark.parametrize("key", [key for key in SMALL if key[2]], ids=lambda key: f"{key[0]} {key[1]}")
def test_the_wrong_radius_is_rejected(key):
    assert max(map(abs, SMALL[key]["off"])) >= 20


def test_all_choices_were_made():
    assert {key[:2] for key in SMALL} >= {("split", n) for n in (0, 1, 2, 4)} | {
        (kind, 1) for kind in ("axes", "cluster", "global")
    }


def off(name):
    """Bias of the energy in percent and its standard error."""
    return WATER[name]["bias"]


def test_nothing_explodes_on_spheres():
    """Up to 64 fs no energy is off by more than 5 %; Langevin dynamics at 24 fs and low friction is by more than 10."""
    spheres = [row for row in RESULT["water"] if row["bath"] in ("split", "axes", "cluster") and row["ps"] > 40]
    assert max(row["outer"] for row in spheres) == 64
    assert all(abs(row["bias"][0]) < 5 for row in spheres)
    assert off("langevin 5/ps, 24 fs")[0] > 10


@pytest.mark.parametrize(("name", "most"), [("split 20/ps, 24 fs", 0.5), ("split 20/ps, 32 fs, auxiliary 0", 1.0)])
def test_bias_of_split_spheres(name, most):
    """Of the energy, as measured; temperatures of turns say more, see the page."""
    value, error = off(name)
    assert abs(value) <= most and error <= 0.25


@pytest.mark.parametrize(("name", "most"), [("split 20/ps, 24 fs", 0.5), ("split 20/ps, 32 fs, auxiliary 0", 1.0)])
def test_bias_of_split_spheres_with_other_seeds(name, most):
    """The mean of seeds that no setting was chosen by."""
    known, _ = WATER["plain 5/ps, 2 fs"]["energy"]
    seen = [row["energy"] for row in RESULT["fresh"] if row["name"] == name]
    assert len(seen) == 2 and all(doubt < 0.005 * abs(known) for _, doubt in seen)
    assert 100 * abs(sum(value for value, _ in seen) / 2 - known) <= most * abs(known)


def test_halfway_between_slow_kicks_langevin_has_both_temperatures_right_at_16_fs():
    """And the energy within half a percent; at the kicks turns are hotter by a tenth and more."""
    row, known = WATER["langevin 5/ps, 16 fs, halfway"], RESULT["water"][0]
    assert abs(row["bias"][0]) <= 0.5 and row["bias"][1] <= 0.15
    for kind in ("shift", "turn"):
        assert abs(row[kind][0] - 1) <= 2.5 * row[kind][1] <= 0.12
    assert WATER["langevin 5/ps, 16 fs"]["turn"][0] > 1.1
    assert known["slow_per_turning"] >= 8 * row["slow_per_turning"]


def test_what_spheres_gain_by_the_energy_alone():
    """Read halfway at 48 fs; turns are wrong there."""
    spheres, langevin = WATER["split 5/ps, 48 fs, halfway"], WATER["langevin 5/ps, 16 fs, halfway"]
    assert abs(spheres["bias"][0]) <= 0.25 and spheres["bias"][1] <= 0.15 < langevin["bias"][0]
    found = [round(row[kind]) for row in (spheres, langevin) for kind in ("slow_per_turning", "slow_per_sample")]
    assert found == [73, 17, 147, 57] and spheres["turn"][0] == pytest.approx(1.22, abs=0.005)


def test_the_share_of_the_stiffness_foretells_how_hot_turns_are():
    """At 24 fs and 20/ps, halfway; the direct part of an Ewald sum, whose slow rest is as stiff as any, explodes."""
    found = {}
    for name, part in REACH.items():
        row = next((row for row in part["water"] if row["name"] == "langevin 20/ps, 24 fs, halfway"), None)
        if row is not None:
            found[name] = (part["share"], row["turn"], row["bias"])
    share, turn, bias = found.pop("direct part to 9 A")
    assert share > 0.1 and turn[0] > 2 and bias[0] > 10
    assert len(found) == 4
    ordered = sorted(found.values())
    assert all(softer[1][0] < stiffer[1][0] for softer, stiffer in pairwise(ordered))
    assert ordered[1][1][0] - ordered[0][1][0] > 2 * math.hypot(ordered[1][1][1], ordered[0][1][1])
    assert ordered[0][0] < 0.03 and abs(ordered[0][1][0] - 1) <= 0.02
    assert ordered[-1][0] > 0.1 and ordered[-1][1][0] > 1.3


def pooled(name, key):
    """The mean of both seeds and its error."""
    first, second = (FAR[f"{name}{seed}, halfway"][key] for seed in ("", ", seed 2"))
    return (first[0] + second[0]) / 2, math.hypot(first[1], second[1]) / 2


@pytest.mark.parametrize(
    ("name", "energy", "turn"),
    [
        ("langevin 5/ps, 24 fs", 0.3, 0.015),
        ("split 5/ps, 48 fs", 0.3, 0.03),
        ("split 5/ps, 64 fs", 0.5, 0.04),
        ("split 20/ps, 64 fs, auxiliary 0", 0.3, 0.03),
    ],
)
def test_with_long_waves_inside(name, energy, turn):
    """Bias of the energy in percent, and of the temperature of turns, of two seeds."""
    value, error = pooled(name, "bias")
    assert abs(value) <= energy and error <= 0.25
    value, error = pooled(name, "turn")
    assert abs(value - 1) <= turn and error <= 0.01


def test_spheres_at_32_fs_are_right_with_long_waves_inside():
    """The energy to 0.5 %, both temperatures to 1 %."""
    row = FAR["split 20/ps, 32 fs, auxiliary 0, halfway"]
    assert abs(row["bias"][0]) <= 0.5 and max(abs(row[kind][0] - 1) for kind in ("shift", "turn")) <= 0.01
    turn, error = FAR["split 20/ps, 24 fs, auxiliary 0, halfway"]["turn"]
    assert f"{100 * (turn - 1):.1f} {100 * error:.1f}" == "0.5 0.6"


@pytest.mark.parametrize(
    ("splitting", "name", "seeds", "energy"),
    [
        ("pairs to 7 A, long waves", "split 20/ps, 24 fs", 4, 0.5),
        ("pairs to 9 A, long waves", "split 20/ps, 24 fs", 4, 0.5),
        ("pairs to 9 A, long waves", "split 20/ps, 32 fs", 2, 1.0),
        ("pairs to 9 A, long waves", "split 5/ps, 64 fs", 3, 1.0),
    ],
)
def test_spheres_with_inner_steps_of_2_fs_are_right(splitting, name, seeds, energy):
    """Means over seeds: the energy as near as must be, both temperatures within 1 %, and errors that can tell."""
    means = script("studies/long_steps_reach").over_seeds(REACH[splitting]["water"], RESULT["reach"]["reference"])
    (row,) = (row for row in means if row["name"].startswith(f"{name}, inner 2"))
    assert row["seeds"] == seeds and abs(row["bias"][0]) <= energy and row["bias"][1] <= 0.15
    for kind in ("shift", "turn"):
        assert abs(row[kind][0] - 1) <= 0.01 and row[kind][1] <= 0.006


def test_inner_steps_of_2_fs_cool_turns_a_little():
    """By 1.9 K, over all pairs of methods that ran with both; each the mean of its seeds."""
    pairs = []
    for rows in (part["water"] for part in REACH.values()):
        turns = {}
        for row in rows:
            turns.setdefault(identity(row), []).append(row["turn"])
        for (inner, *rest), fine in turns.items():
            coarse = turns.get((4, *rest), [])
            if inner == 2 and coarse:
                (new, doubt), (old, more) = map(script("studies/long_steps_reach").mean, (fine, coarse))
                pairs.append((new - old, math.hypot(doubt, more)))
    weights = [1 / error**2 for _, error in pairs]
    mean = sum(w * off for w, (off, _) in zip(weights, pairs, strict=True)) / sum(weights)
    assert len(pairs) == 7 and f"{-300 * mean:.1f} ± {300 / math.sqrt(sum(weights)):.1f}" == "1.9 ± 0.9"


def identity(row):
    """What a run is of, besides its seed; the inner step first."""
    return row["inner"], row["bath"], row["outer"], row["friction"], row["auxiliary"]


def test_what_spheres_gain_with_long_waves_inside():
    """Slow evaluations while a dipole turns, where turns are equally hot: half as many again for Langevin dynamics."""
    spheres, langevin = FAR["split 5/ps, 64 fs, halfway"], FAR["langevin 5/ps, 32 fs, halfway"]
    assert abs(spheres["turn"][0] - langevin["turn"][0]) <= 2 * math.hypot(spheres["turn"][1], langevin["turn"][1])
    assert langevin["slow_per_turning"] >= 1.5 * spheres["slow_per_turning"]


def test_baths_cost_little():
    """At most a tenth of a step with forces of 1 ms."""
    assert all(value <= 100 for value in RESULT["cost"]["over_constant_energy_us"].values())


def script(name):
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    example = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    return example


def test_long_waves_are_what_pairs_leave():
    """Of all the stiffness: less than a twentieth is left by both, a tenth and more by damped pairs alone."""
    example = script("studies/long_steps_reach")
    left = []
    for waves in (0, 14):
        method = example.Method("langevin", 5, 16, waters=64, switch=(4.0, 6.0), damp=0.4, waves=waves)
        box = example.water.Water(method)
        left.append(slow_share(box.system, [box.start.positions]))
    assert left[0] > 0.1 and left[1] < 0.05


@pytest.mark.validation
@pytest.mark.parametrize("kind", ["split", "axes", "cluster"])
def test_spheres_against_metropolis(kind):
    """As the example does, shorter; the wrong radius is far off."""
    example = script("studies/long_steps")
    known = example.metropolis(1000, 2000)
    for wrong in (False, True):
        found = example.small_run(kind, 1, 64, wrong, 6000)
        worst = max(abs(a.value - b.value) / math.hypot(a.error, b.error) for a, b in zip(found, known, strict=True))
        assert (worst > 10) if wrong else (worst <= 3.5)


def test_beyond_64_fs():
    """At 384 fs nothing is off by three standard errors; Langevin dynamics at 5/ps has hot turns at 192 fs."""
    rows = {row["name"].removesuffix(", halfway"): row for row in RESULT["beyond"]["water"]}
    for name, row in rows.items():
        if row["outer"] == 384:
            assert all(abs(row[kind][0] - 1) <= 3 * row[kind][1] for kind in ("shift", "turn")), name
            assert abs(row["bias"][0]) <= 0.5 and row["slow_per_turning"] < 13
    hot = [rows[f"langevin 5/ps, 192 fs, inner 2{seed}"]["turn"] for seed in ("", ", seed 2")]
    cool = [rows[f"split 5/ps, 384 fs, inner 2{seed}"]["turn"] for seed in ("", ", seed 2", ", seed 3")]
    (value, error), (best, doubt) = (
        (sum(t for t, _ in seen) / len(seen) - 1, math.hypot(*(e for _, e in seen)) / len(seen)) for seen in (hot, cool)
    )
    assert value > 3 * error and best <= 0.01 and doubt < 0.007
