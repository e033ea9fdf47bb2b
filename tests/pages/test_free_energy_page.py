"""Free energies: the page shows the committed results, and they are within their errors."""

from __future__ import annotations

import json

from committed_pages import FOLDER, page

from kcons.free_energy import Settings

FOUND = json.loads((FOLDER / "free_energy.json").read_text(encoding="utf-8"))
WAYS = ("proposed", "trapezoidal rule", "spline")
TEXT = " ".join(page("free_energy.md").split())


def test_three_thermostats_agree_with_the_quadrature():
    chain = FOUND["chain"]
    assert chain["degrees of freedom"] <= 12 and chain["steps"] >= 400_000
    assert f"{chain['runs']} runs of {chain['steps'] // chain['runs']:,} steps each" in TEXT
    assert f"{chain['quadrature']:.2f} by quadrature" in TEXT
    for name, row in chain["thermostats"].items():
        off = (row["mean force"] - chain["quadrature"]) / row["error"]
        line = f"| {name} | {row['mean force']:.2f} ± {row['error']:.2f} | {off:+.1f} | {row['raw multiplier']:.2f} |"
        assert line in TEXT
        assert abs(off) < 3 and row["error"] < 0.01 * chain["quadrature"]


def test_alanine_dipeptide_against_mbar():
    found = FOUND["alanine dipeptide"]
    assert f"square difference is {found['root mean square difference']:.2f} kJ/mol" in TEXT
    assert f"the largest {found['largest difference below 30 kJ/mol']:.2f};" in TEXT
    ours, theirs = found["largest error of the windows"], found["largest error of MBAR"]
    assert f"standard error {ours:.2f} of the windows and {theirs:.2f} of MBAR" in TEXT
    low = [k for k, energies in enumerate(zip(found["held"], found["MBAR"], strict=True)) if max(energies) < 30]
    bands = [sum(found[name][k] for k in low) / len(low) for name in ("error", "MBAR error")]
    assert bands[0] <= bands[1] and "MBAR, the mean {:.2f} and {:.2f}.".format(*bands) in TEXT
    steps, windows = f"{found['steps of each method']:,}", found["windows"]
    assert f"{windows} windows from both sides" in TEXT and f"({steps}, 4 fs)" in TEXT
    assert found["root mean square difference"] < (ours**2 + theirs**2) ** 0.5
    assert found["largest difference below 30 kJ/mol"] < 0.3
    assert not found["doubtful windows"] and "two sides of every window agree (p > 0.01)" in TEXT


def test_pulls_against_windows():
    found = FOUND["pulls"]
    assert f"{found['pulls each way']} pulls of {found['steps'] * 4 // 1000} ps each way" in TEXT
    assert "{:.1f} ± {:.1f} kJ/mol by BAR, {:.1f} ± {:.1f} by".format(*found["BAR"], *found["Jarzynski"]) in TEXT
    assert "{:.1f} ± {:.1f} by the windows".format(*found["windows"]) in TEXT
    assert f"{found['lost']:.1f} are lost" in TEXT
    assert f"{found['standard errors off']:+.1f} standard errors" in TEXT
    assert f"BAR would be {-found['with the velocities of the run']:.1f} lower" in TEXT
    assert abs(found["standard errors off"]) < 3


def test_what_recording_costs():
    found = FOUND["recording"]
    one, two = found["1 held"], found["2 held"]
    assert f"every {found['every']} steps, as windows are by default, costs {100 * one['50']:.1f} % of the run" in TEXT
    assert f"every 10 steps {100 * one['10']:.0f} %" in TEXT
    assert one["50"] <= 0.05 and two["50"] <= 0.05
    assert Settings().every == found["every"] == 50


def test_where_windows_are_put():
    for name, row in FOUND["placement"].items():
        numbers = " | ".join("more than 64" if row[way] is None else str(row[way]) for way in WAYS)
        assert f"| {name} | {numbers} |" in TEXT
        assert row["trapezoidal rule"] is None or 2 * row["proposed"] <= row["trapezoidal rule"]
    saved = [name for name, row in FOUND["placement"].items() if 2 * row["proposed"] <= row["spline"]]
    assert saved == ["Lennard-Jones"]


def test_killed_runs():
    found = json.loads((FOLDER / "killed_runs.json").read_text(encoding="utf-8"))
    for kind in ("windows", "scan"):
        row = found[kind]
        assert row["kills"] == 30 and row["lost"] == 0 and row["result"] == "identical"
        assert row["finished after each"] == sorted(row["finished after each"]) and row["finished after each"][-1] > 20
    assert "30 SIGKILLs" in TEXT and f"{found['windows']['in all']} runs of windows" in TEXT
    assert f"{found['scan']['in all']} relaxations" in TEXT


def test_butane_beside_its_relaxed_scan():
    found = json.loads((FOLDER / "butane.json").read_text(encoding="utf-8"))
    for name, (value, error) in found["free energy"].items():
        energy = found["relaxed scan"][name]
        assert f"| {name} | {value:.1f} ± {error:.1f} | {energy:.1f} |" in TEXT
        assert abs(value - energy) < 3 * error
    worst, second = sorted(found["hysteresis"])[:2]
    assert second > 0.1 and "two sides of nine windows agree (p > 0.1)" in TEXT
    assert worst > 0.01 and f"100° differ with p = {worst:.3f}" in TEXT
