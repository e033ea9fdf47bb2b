"""The table of sampling errors says what was measured, and files hold it."""

from __future__ import annotations

import json
from io import StringIO

import pytest
from rich.console import Console

from kcons.comparison.averages import report
from kcons.comparison.averages.sampling import Moment, Sampled, SamplingComparison


def measured(**changes):
    growth = [Moment(400 * k, 400 * k, 0.02 * k, 0.03 / k, 0.02 / k**0.5, 0.1, 0.0123) for k in (1, 2, 4)]
    values = dict(
        method="isokinetic",
        title="isokinetic",
        setting=0.02,
        status="ok",
        steps=1600,
        samples=400,
        evaluations=1600,
        seconds=0.08,
        step_seconds=5e-5,
        temperature_error=0.0123,
        temperature_standard_error=0.0061,
        energy_error=-0.0234,
        energy_standard_error=0.0123,
        seconds_to_goal=0.03,
        evaluations_to_goal=595.4,
        growth=growth,
    )
    return Sampled(**{**values, **changes})


def comparison(*measurements):
    return SamplingComparison(
        scene={
            "name": "x",
            "title": "a title",
            "units": {"length": "σ", "energy": "ε", "time": "τ"},
            "degrees_of_freedom": 37,
            "notes_temperature_error": 1 / 3,
        },
        reference={"how": "Metropolis sampling", "energy": -2.5273, "standard_error": 0.0051},
        settings={},
        environment={"cpu": "a processor", "date": "today", "versions": {}, "commit": None},
        measurements=measurements,
    )


ROWS = (
    measured(),
    measured(setting=0.01, temperature_error=-0.05, seconds_to_goal=700.0),
    measured(method="langevin", title="Langevin", status="failed", note="step 3: oh", step_seconds=None),
    measured(method="nose-hoover", title="chain", status="partial", note="9 samples are too few"),
    measured(method="nose-hoover", title="chain", status="partial", note="9 samples are too few"),
)


def shown(result):
    page = StringIO()
    Console(file=page, width=150, color_system=None).print(report.table(result))
    return page.getvalue()


def line(text, word):
    return next(found for found in text.splitlines() if word in found).split()


def test_table():
    text = shown(comparison(*ROWS))
    assert "a title" in text and "ε a molecule" in text
    assert line(text, "isokinetic") == [
        "isokinetic", "0.02", "+1.23", "±", "0.61", "-0.023", "±", "0.012", "2.0", "50.0", "µs", "595", "30.0", "ms",
    ]  # fmt: skip
    assert line(text, " 0.01 ") == [
        "0.01", "-5.00", "±", "0.61", "-0.023", "±", "0.012", "8.2", "50.0", "µs", "595", "12", "min",
    ]  # fmt: skip
    assert line(text, "Langevin") == ["Langevin", "0.02", "failed", "[1]"]
    assert line(text, "chain") == ["chain", "0.02", "partial", "[2]", "50.0", "µs"]


def test_distance_in_standard_errors():
    assert report.off(measured()) == pytest.approx(0.0123 / 0.0061)
    assert report.off(measured(energy_error=0.123)) == pytest.approx(10)


@pytest.mark.parametrize(("error", "digits"), [(23.0, 0), (9.96, 0), (9.6, 1), (0.996, 1), (0.95, 2), (0.0123, 3)])
def test_two_digits_of_the_error(error, digits):
    assert report._digits(error) == digits


def test_explanation():
    text = report.explanation(comparison(*ROWS))
    assert text.startswith("[1] step 3: oh\n[2] 9 samples are too few\n")
    assert "Metropolis sampling, -2.527 ± 0.005 ε" in text
    assert "2K = 3N kT is off by +33.3%" in text and "g = 37" in text


def test_files(tmp_path):
    result = comparison(*ROWS)
    paths = report.write(result, tmp_path / "new", tables=["a", "b"])
    assert [path.name for path in paths] == ["compare.json", "compare.png", "compare.txt"]
    assert json.loads(paths[0].read_text(encoding="utf-8")) == json.loads(json.dumps(result.to_dict()))
    assert paths[1].read_bytes().startswith(b"\x89PNG")
    assert paths[2].read_text() == "a\nb\n"


def test_plot_without_anything_to_show(tmp_path):
    report.figure(comparison(ROWS[2])).savefig(tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_every_thermostat_has_a_style():
    from kcons.comparison.averages.sampling import METHODS

    assert set(report.STYLES) == set(METHODS)
    assert len(set(report.STYLES.values())) == len(METHODS)


def test_kinds_of_motion_and_step_zero():
    """A column for each kind, and a line for step zero; a model that does not fit is marked."""
    kinds = {"shift": (0.01, 0.001), "turn": (-0.02, 0.001)}
    rows = [
        measured(setting=dt, kinds=kinds, temperature_error=error, energy_standard_error=0.02)
        for dt, error in ((0.04, 0.16), (0.02, 0.04), (0.01, 0.5))
    ]
    text = shown(comparison(*rows))
    assert "T of shifts" in text and "T of turns" in text
    assert line(text, " 0.04 ")[5:11] == ["+1.00", "±", "0.10", "-2.00", "±", "0.10"]
    zero = line(text, "→ 0")
    assert zero[2].startswith("+") and zero[4].endswith("?")
    assert zero[5:11] == ["+1.00", "±", "0.08", "-2.00", "±", "0.08"]  # 0.1 (1/3 + 49/126)^(1/2)
    assert "→ 0" not in shown(comparison(rows[0]))
