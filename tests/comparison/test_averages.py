"""Averages by step: counts are right, what is right is found so, what fails is shown."""

from __future__ import annotations

import functools
from dataclasses import replace
from unittest.mock import patch

import fluids
import numpy as np
import pandas as pd
import pytest
from small_test_systems import small

from kcons.cli import main
from kcons.comparison import SAMPLERS, Potential, add_sampler, compare_averages, figure, rank, read_csv, text
from kcons.comparison.averages import AVERAGES, choose_samplers, code, sample
from kcons.comparison.measure import COLUMNS
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError
from kcons.thermostats import Langevin, thermal_velocities


@functools.cache
def chain():
    return small("chain")


@functools.cache
def cheap():
    """The same chain with springs that are a tenth softer."""

    def softer(x):
        energy, forces = chain().potential.watched(x)
        return 0.9 * energy, 0.9 * forces

    return replace(chain(), potential=Potential(softer, "softer springs"))


#: One bond less.
FEWER = ConstraintSet(chain().constraint_set.constraints[0].select(range(4)), chain().positions, chain().masses)
UNIT = chain().units.time_unit
STEPS = {"langevin": 5, "isokinetic": 2.5, "langevin-respa": 10, "langevin-halfway": 10, "spheres": 10, "hmc": 10}


@functools.cache
def one(name, length=40_000.0, **options):
    step, several = STEPS.get(name, 2.5) * UNIT, SAMPLERS[name].several
    given = {"cheap": cheap() if several else None, "length": length * UNIT, **options}
    return sample(chain(), SAMPLERS[name], step, 0.01 / UNIT, **given)


@pytest.mark.parametrize("name", STEPS)
def test_temperatures_are_right_at_a_fine_step_and_evaluations_are_counted(name):
    row = one(name)
    assert row["status"] == "ok", row["note"]
    for kind in ("shift", "turn", "internal"):
        assert abs(row[kind]) <= 4 * row[f"{kind}_error"] < 1.0
    assert row["error"] == pytest.approx(
        max(abs(row[k]) + 2 * row[f"{k}_error"] for k in ("shift", "turn", "internal"))
    )
    # What it takes to know the temperatures to 1 %.
    waits = (max(row[f"{k}_error"] for k in ("shift", "turn", "internal")) / 0.01) ** 2
    assert row["seconds"] == pytest.approx(waits * row["steps"] * row["step_seconds"])
    calls = row["evaluations"] / waits
    if name == "hmc":
        assert row["accepted"] > 0.8 and row["cheap"] == 0 and calls > 6 * row["steps"]
        return
    assert calls == pytest.approx(row["steps"], abs=2)
    # Of two inner steps each ends where the next begins, and the expensive forces are asked for at one of these places.
    assert row["cheap"] == pytest.approx(2 * calls if SAMPLERS[name].several else 0, abs=3)


def test_the_notes_convention_is_found_to_be_hot():
    """2K = 3N kT: configurations of eight dumbbells in a box have 3N/(g - 1) = 48/36 of the temperature."""
    fluid = fluids.dumbbells(8)
    box = replace(
        small("dumbbells"),
        time_steps=(0.02, 0.01),
        constraint_set=fluid.constraint_set,
        positions=fluid.positions,
        velocities=thermal_velocities(fluid.system(), fluid.positions, fluid.thermal_energy, 1, zero_momentum=True),
        potential=Potential(fluid.forces.evaluate, "Lennard-Jones"),
        thermal_energy=fluid.thermal_energy,
    )
    found = {n: sample(box, SAMPLERS[n], 0.01, 1.0, length=160.0) for n in ("isokinetic", "isokinetic-notes")}
    for name, expected in (("isokinetic", 0.0), ("isokinetic-notes", 1 / 3)):
        for kind in ("shift", "turn"):
            assert abs(found[name][kind] - expected) <= 4 * found[name][f"{kind}_error"] < 0.3
    assert "internal" not in found["isokinetic"]


def test_results_can_be_repeated():
    assert one.__wrapped__("langevin")["turn"] == one("langevin")["turn"] != one("langevin", rng=2)["turn"]


def test_a_step_that_is_too_long_and_a_run_that_is_too_short_are_shown():
    """Between kicks an odd number of inner steps becomes even: they get shorter, and never longer than asked for."""
    failed = sample(small("water"), SAMPLERS["langevin"], 60 * UNIT, 0.01 / UNIT, length=60_000 * UNIT)
    assert failed["status"] == "failed" and "Error" in failed["note"] and "shift" not in failed
    short = one("langevin", 60.0)
    assert short["status"] == "partial" and "too few" in short["note"]
    run = sample(chain(), SAMPLERS["langevin-halfway"], 15 * UNIT, 0.01 / UNIT, cheap=cheap(), length=400 * UNIT)
    assert run["status"] == "partial" and run["cheap"] == pytest.approx(4 * run["steps"], abs=4)


@functools.cache
def table():
    return compare_averages(chain(), ["langevin", "isokinetic"], steps=[10.0, 5.0], budget=2.0)


def test_one_table_as_that_of_trajectories():
    found = table()
    assert list(found.columns) == [*COLUMNS, *AVERAGES] and set(found.status) == {"ok"}
    assert list(found.setting) == [5, 5, 10, 10, 5, 10]
    assert list(found.friction) == pytest.approx([16, 4, 16, 4, 0, 0])  # 1 in 12.5 and 1 in 50 steps of 5 fs, a ps
    assert found.attrs["environment"]["cpu"] and found.attrs["budget"] == 2.0


def row(title, error, seconds, setting=2.0, friction=5.0):
    known = {"method": title, "engine": "arrays", "adaptive": False, "status": "ok", "note": "", "rounds": 0}
    return {**known, "title": title, "error": error, "seconds": seconds, "evaluations": 100.0, "setting": setting,
            "friction": friction}  # fmt: skip


def made(*rows):
    found = pd.DataFrame(list(rows), columns=[*COLUMNS, *AVERAGES])
    found.attrs = {**table().attrs, "time": "fs", "long_time": "ps", "force_seconds": 1e-3}
    return found


def test_the_cheapest_that_is_right_is_named():
    rows = made(row("one", 0.008, 9.0), row("two", 0.009, 4.0), row("three", 0.02, 1.0), row("four", 0.005, 5.0))
    found = rank(rows, "temperature")
    assert list(found.table.method) == ["two", "four", "one"] and list(found.beyond.method) == ["three"]
    assert list(found.table.place) == [1, 1, 3]  # costs are known to a third
    words = text(rows, found)
    assert words.startswith(
        "Use two at 2 fs, 5/ps: the least processor time until the temperature is known to 1 %, 4.00 s, for a "
        "deviation of the temperature of the configurations of at most 0.01 (two standard errors included); equally "
    )
    none = rank(made(row("three", 0.02, 1.0)), "temperature")
    assert "the least is 0.02, by three at 2 fs, 5/ps. Longer runs (--budget)" in text(rows, none)
    assert rank(made(row("none", np.nan, np.nan)), "temperature") is None
    assert "No run can tell the deviation" in text(made({**row("x", 0.1, 1.0), "status": "partial"}), None)


def test_of_two_frictions_the_cheaper_one_that_is_right_is_ranked_and_the_better_one_drawn():
    rows = made(row("a", 0.005, 5.0, friction=1.0), row("a", 0.009, 2.0, friction=2.0), row("a", 0.02, 1.0, friction=3))
    assert list(rank(rows, "temperature").table.friction) == [2.0]
    (curve,) = (line for line in figure(rows).axes[0].lines if line.get_markerfacecolor() == "none")
    assert list(curve.get_ydata()) == [0.005]


def test_a_sampler_of_ones_own_goes_on_and_its_lines_run():
    kept = []
    with patch.dict(SAMPLERS):
        add_sampler("mine", lambda s: Langevin(s.thermal_energy, 2 * s.friction, s.seed), "twice the friction")
        compare_averages(chain(), ["mine"], steps=[5.0], budget=1.5, keep=kept.append)
        found = compare_averages(chain(), ["mine", "isokinetic"], steps=[5.0], budget=1.5, done=kept[-1])
        assert list(found.method) == ["mine", "mine", "isokinetic"]
        assert list(found.energy[:2]) == list(kept[-1].energy)
        space = {}
        exec(code(chain(), "mine", 5.0, 10.0, 'test_systems.build("chain", 5)'), space)
        assert space["end"].step == 1000 and space["stepper"].friction == pytest.approx(20 / (1000 * UNIT))
    assert code(chain(), "spheres", 5.0, 10.0, "x") == ""


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"methods": ["rattle"]}, "there is no thermostat 'rattle'; there are langevin"),
        ({"methods": []}, "give a list of langevin"),
        ({"methods": "langevin"}, "methods is 'langevin'; give a list of langevin"),
        ({"methods": ["spheres"]}, "spheres uses cheap forces"),
        ({"budget": 0}, "budget is 0; give a positive number"),
        ({"steps": [4.0, -3.0]}, "dt is -3.0; give a positive number"),
        ({"steps": [4.0, 4000.0]}, "a step of 4000 fs is too long"),
        ({"system": small("rotor")}, "rotor has no temperature"),
        ({"cheap": small("water")}, "different atoms"),
        ({"cheap": replace(chain(), constraint_set=FEWER)}, "different constraints"),
    ],
)
def test_what_cannot_be_is_refused_before_any_run(options, words, monkeypatch):
    ran = []
    monkeypatch.setattr("kcons.comparison.averages.sample", lambda *_, **__: ran.append(1) or {})
    given = {"system": chain(), "methods": ["langevin"], **options}
    with pytest.raises(InputError, match=words):
        compare_averages(**given)
    assert not ran


def test_a_run_needs_a_length_or_a_budget():
    either = "either length or budget"
    for given, words in (({}, either), ({"length": 1.0, "budget": 1.0}, either), ({"length": np.nan}, "length is")):
        with pytest.raises(InputError, match=words):
            sample(chain(), SAMPLERS["langevin"], UNIT, 1.0, **given)
    assert [s.name for s in choose_samplers(["all"], cheap=True)] == list(SAMPLERS)
    assert not any(s.several for s in choose_samplers(["all"]))


# -- the command ------------------------------------------------------------------------------------


def test_the_command_writes_the_same_files(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = "compare chain --size 4 --criterion temperature --methods langevin,isokinetic --dt 10 --budget 0.6"
    assert main.main(words.split()) == 0
    printed = capsys.readouterr().out
    assert "temperature of the configurations" in printed.splitlines()[0] and len(printed.splitlines()) <= 30
    folder = tmp_path / "compare-chain-averages"
    assert list(read_csv(folder / "compare.csv").method) == ["langevin", "langevin", "isokinetic"]
    assert {path.name for path in folder.glob("compare.*")} == {"compare.csv", "compare.png", "compare.txt"}
    assert main.main(f"{words} --resume --budget 2".split()) == 2


def test_expensive_and_cheap_forces_of_a_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    lines = ["9", "water"]
    for k in range(3):
        lines += [f"O {4 * k} 0 0", f"H {4 * k + 0.9572} 0 0", f"H {4 * k - 0.24} 0.9266 0"]
    (tmp_path / "water.xyz").write_text("\n".join(lines) + "\n")
    words = "compare water.xyz --slow tip3p --fast lj --methods spheres --dt 4 --budget 0.4 --out found"
    assert main.main(words.split()) == 0
    assert "isokinetic spheres" in capsys.readouterr().out
    found = read_csv(tmp_path / "found" / "compare.csv")
    assert set(found.setting) == {4.0} and (found.cheap > found.steps).all()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("compare run.pdb --slow gfn2", "--slow needs --fast: give the cheap forces, too"),
        ("compare run.pdb --fast lj", "--fast needs --slow: give the expensive forces, too"),
        ("compare chain --slow gfn2 --fast lj", "--slow and --fast are for files, not for 'chain'"),
        ("compare run.pdb --slow gfn2 --fast lj --methods rattle", "there is no thermostat 'rattle'"),
        ("compare run.pdb --slow gfn2 --fast gfn2", "--slow and --fast are the same: give cheaper forces to --fast"),
        ("compare run.pdb --slow gfn2 --fast lj --criterion error", "--criterion does not go with --slow and --fast"),
        ("compare run.pdb --slow gfn2 --fast lj --add-hydrogens", "--add-hydrogens does not go with"),
        ("compare run.pdb --slow gfn2 --fast lj --size 3", "--size does not go with"),
        ("compare run.pdb --slow gfn2 --fast lj --forces emt", "--forces does not go with"),
        ("compare run.pdb --slow gfn2 --fast lj --target-error 1", "leave --slow and --fast out"),
        ("compare rotor --criterion temperature", "rotor has no temperature"),
    ],
)
def test_options_that_do_not_go_together(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.pdb").touch()
    assert main.main(words.split()) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.glob("**/compare.*"))
