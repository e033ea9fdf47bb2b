"""The committed results at constant pressure reach what they must."""

from __future__ import annotations

import importlib.util
import json

import numpy as np
import pytest
from committed_pages import FOLDER, ROOT
from scipy import stats

from kcons.comparison import volumes
from kcons.thermostats import MonteCarloBarostat

RESULTS = json.loads((FOLDER / "constant_pressure.json").read_text(encoding="utf-8"))
RUNS = RESULTS["runs"]
SLOPES = {(name, to): line for name, one in RUNS.items() for to, line in one.get("slopes", {}).items()}


def of(start, key):
    """Values with errors of the runs whose names begin so."""
    pairs = [one[key] for name, one in RUNS.items() if name.startswith(start)]
    assert len(pairs) >= 1
    return np.array(pairs)


def one_of(pairs):
    w = pairs[:, 1] ** -2
    return (w * pairs[:, 0]).sum() / w.sum(), w.sum() ** -0.5


def agree(pairs, most=3.5):
    mean, _ = one_of(pairs)
    assert np.all(np.abs(pairs[:, 0] - mean) < most * pairs[:, 1])


def test_each_barostat_of_openmm_beside_each_ensemble():
    """By p of the exact distribution, and of those with too many or too few molecules."""
    runs = json.loads((FOLDER / "openmm_barostats.json").read_text(encoding="utf-8"))["runs"]
    barostats, ensembles = ("isotropic", "three axes", "membrane", "flexible"), ("Langevin", "NoseHoover", "Isokinetic")
    assert set(runs) == {f"{b}, {e}" for b in barostats for e in ensembles}
    for barostat in barostats:
        found = [runs[f"{barostat}, {e}"] for e in ensembles]
        off = found[0]["off"]
        wrong = max(p for one in found for p in (one["less"], one["more"]))
        assert min(one["p"] for one in found) > 0.01 and wrong < 1e-3 and off <= 2


def test_density_of_water_is_that_of_openmm():
    ours, theirs = (volumes.pooled(of(f"water, {name}, seed", "density")) for name in ("Monte Carlo", "OpenMM"))
    error = np.hypot(*(one[1] * max(1.0, one[2]) for one in (ours, theirs)))
    assert abs(ours[0] - theirs[0]) < 2 * error
    assert abs(ours[0] / theirs[0] - 1) < 2e-3 > error / theirs[0]
    agree(of("water", "density"))
    agree(of("water", "compressibility"))


@pytest.mark.parametrize("fluid", ["dumbbells", "methane, 10 distances of rank 9"])
def test_barostats_and_thermostats_agree(fluid):
    for key in ("volume", "energy", "compressibility"):
        agree(of(fluid, key))


def test_dumbbells_in_openmm_are_those_of_the_core():
    """Beside the flexible, the anisotropic and the membrane barostat."""
    for key in ("volume", "energy", "compressibility"):
        ours, theirs = of("dumbbells", key), of("OpenMM,", key)
        assert len(theirs) == 3
        agree(np.concatenate([ours, theirs]))


def test_slopes_between_pressures_and_temperatures():
    assert len(SLOPES) == 16
    for (name, _), line in SLOPES.items():
        assert abs(line["found"] - line["exact"]) < 3 * line["error"]
        beside = 0.35 if name.startswith("OpenMM") else 0.2  # shorter runs
        assert line["error"] < beside * abs(line["exact"])
        assert line["physical_validation"] < 3
    off = np.array([(line["found"] - line["exact"]) / line["error"] for line in SLOPES.values()])
    assert stats.chi2(len(off)).sf((off**2).sum()) > 0.01


def test_a_barostat_costs_less_than_a_twentieth_of_a_step():
    """At its default frequency, with the error of the measurement."""
    costs = [one for name, one in RUNS.items() if name.startswith("cost")]
    assert len(costs) == 4
    for one in costs:
        assert one["every"] == MonteCarloBarostat(1.0).every
        assert one["ratio"] + 2 * one["error"] < 1.05


def test_the_crystal_is_the_same_along_all_axes():
    runs = [RUNS[f"crystal {seed}"] for seed in (1, 2)]
    agree(np.concatenate([run["sides"] for run in runs]))
    stress = np.concatenate([run["stress"] for run in runs])
    assert np.all(np.abs(stress[:, 0] - runs[0]["pressure"]) < 3.5 * stress[:, 1])
    mean, error = one_of(stress)
    assert abs(mean - runs[0]["pressure"]) < 3 * error < 0.05 * runs[0]["pressure"]
    for run in runs:
        assert run["order of places"] > 0.8
        assert run["steps"] > 100 * run["correlation"]


@pytest.mark.validation
def test_a_fluid_anew():
    """Against the committed volume."""
    spec = importlib.util.spec_from_file_location("example", ROOT / "examples" / "studies/constant_pressure.py")
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    found = example.run_fluid("dumbbells", "Monte Carlo", "isokinetic", 20_000, seed=9)
    agree(np.array([example.volumes.mean_and_error(found["volumes"]), one_of(of("dumbbells", "volume"))]))
