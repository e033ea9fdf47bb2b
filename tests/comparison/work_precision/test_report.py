"""Tables, plots and files say what was measured."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from io import StringIO

import pytest
from rich.console import Console

from kcons.comparison.work_precision import answer, measure, recommendation, report
from kcons.comparison.work_precision.measure import Comparison, Measurement

UNITS = {"length": "Å", "energy": "eV", "time": "fs", "long_time": "ps"}


def measured(**changes):
    values = dict(
        method="rattle",
        title="kcons RATTLE",
        setting=2.0,
        adaptive=False,
        status="ok",
        steps=12,
        steps_planned=12,
        error=1.25e-3,
        constraint_residual=4e-15,
        velocity_residual=6e-16,
        energy_slope=3.0e-4,
        energy_slope_error=1e-5,
        step_seconds=1.5e-3,
        constraint_seconds=2e-5,
        setup_seconds=0.1,
        evaluations_per_time=500.0,
        seconds_per_time=0.75,
    )
    return Measurement(**{**values, **changes})


def comparison(*measurements):
    return Comparison(
        scene={"name": "x", "title": "a title", "horizon": 24.0, "units": UNITS},
        reference={"how": "closed form", "error": 1e-9},
        settings={},
        environment={"cpu": "a processor", "date": "today", "versions": {}, "commit": None},
        measurements=measurements,
    )


ROWS = (
    measured(),
    measured(setting=1.0, error=3.126e-4, energy_slope=1e-6, evaluations_per_time=1000.0, seconds_per_time=1.5),
    measured(method="ase-bonds", title="peer", status="partial", steps=1, error=None, note="too slow", step_seconds=9),
    measured(method="ase-bonds", title="peer", setting=1.0, status="not run", error=None, note="too slow"),
    measured(method="ase-internals", title="other", status="failed", error=None, note="step 3: RuntimeError: oh"),
    measured(method="dop853", title="scipy", adaptive=True, setting=1e-5, error=1e-6),
    measured(method="verlet", title="baseline", status="baseline", error=None, constraint_seconds=None),
)


def text_of(found, **options):
    page = StringIO()
    Console(file=page, width=200, color_system=None).print(report.table(found, **options))
    return page.getvalue()


def test_table_shows_every_measurement():
    text = text_of(comparison(*ROWS))
    lines = [line for line in text.splitlines() if line.strip()]
    assert "a title" in lines[0]
    for unit in ("fs", "Å, rad", "eV/ps", "a ps"):
        assert unit in text
    (first,) = (line for line in lines if "kcons RATTLE" in line)
    assert first.split()[2:] == [
        *("2", "1.25e-03", "4e-15", "6e-16", "3.0e-04"),
        *("1.50", "ms", "20.0", "µs", "500", "750", "ms"),
    ]
    # A slope within its error is in brackets, a method's name stands once.
    second = lines[lines.index(first) + 1]
    assert second.split()[:2] == ["1", "3.13e-04"]
    assert "(1.0e-06)" in second
    assert "1 step only [1]" in text
    assert "not run [1]" in text
    assert "failed [2]" in text
    assert "rtol 1e-05" in text


def test_narrow_table_leaves_columns_out():
    text = text_of(comparison(*ROWS), narrow=True)
    assert "slope" not in text
    assert "1.25e-03" in text
    assert max(len(line.rstrip()) for line in text.splitlines()) < 100


def test_width_fits_a_table():
    page = StringIO()
    Console(file=page, width=report.WIDTH, color_system=None).print(report.table(comparison(*ROWS)))
    assert "…" not in page.getvalue()


def test_whether_a_table_fits_is_measured():
    usual, long = comparison(*ROWS), comparison(*ROWS, measured(title="a stepper with a very long name indeed"))
    assert report.fits(usual, report.WIDTH)
    assert not report.fits(long, report.WIDTH)
    for found in (usual, long):
        width = next(w for w in range(60, 300) if report.fits(found, w))

        def shown(wide, found=found):
            page = StringIO()
            Console(file=page, width=wide, color_system=None).print(report.table(found))
            return page.getvalue()

        assert "…" not in shown(width)
        assert shown(width).count("\n") == shown(300).count("\n") < shown(width - 1).count("\n")


def test_reference_is_drawn_where_errors_come_near_it(tmp_path):
    assert not report._reference_in_sight(comparison(*ROWS))  # 1e-9 against 1e-6
    assert report._reference_in_sight(comparison(*ROWS, measured(error=5e-8)))
    assert not report._reference_in_sight(comparison(measured(error=None), measured(error=float("nan"))))


def test_order_is_that_of_the_finest_steps():
    errors = {8.0: 0.3, 4.0: 0.2, 2.0: 1.6e-3, 1.0: 1e-4}
    found = comparison(*(measured(setting=step, error=error) for step, error in errors.items()))
    assert found.observed_order("rattle") == pytest.approx(4.0)


def test_explanation_has_notes_reference_and_order():
    text = report.explanation(comparison(*ROWS))
    assert "[1] too slow" in text
    assert "[2] step 3: RuntimeError: oh" in text
    assert "closed form, good to 1e-09 Å" in text
    assert "t = 24 fs" in text
    assert "kcons RATTLE 2.00" in text
    assert "scipy" not in text.split("observed order")[1]


def test_order_ignores_what_the_reference_cannot_resolve():
    found = comparison(measured(), measured(setting=1.0, error=3.126e-4), measured(setting=0.001, error=2e-9))
    assert found.observed_order("rattle") == pytest.approx(2.0, abs=1e-3)
    assert comparison(measured()).observed_order("rattle") is None


def test_files(tmp_path):
    found = comparison(*ROWS)
    paths = report.write(found, tmp_path / "new" / "folder", tables=["TABLE"])
    assert [p.name for p in paths] == ["compare.json", "compare.png", "compare.txt"]
    data = json.loads(paths[0].read_text())
    assert data["format"] == "kcons-compare-1"
    assert data["measurements"][0]["error"] == 1.25e-3
    assert data["observed_order"] == {"rattle": pytest.approx(2.0, abs=1e-3)}
    assert data["environment"]["cpu"] == "a processor"
    assert paths[1].read_bytes().startswith(b"\x89PNG")
    assert paths[2].read_text() == "TABLE\n"


def test_not_a_number_becomes_null(tmp_path):
    (path, _) = report.write(comparison(measured(error=float("nan"))), tmp_path)
    assert json.loads(path.read_text())["measurements"][0]["error"] is None


def test_plot_has_both_panels_with_units():
    figure = report.figure(comparison(*ROWS))
    left, right = figure.axes
    assert (left.get_xscale(), left.get_yscale(), right.get_xscale()) == ("log", "log", "log")
    assert left.get_xlabel() == "force evaluations per simulated ps"
    assert right.get_xlabel() == "wall time per simulated ps / s"
    assert left.get_ylabel() == "rms error an atom at 24 fs / Å"
    curves = {line.get_label(): line for line in left.lines}
    assert list(curves["kcons RATTLE"].get_xdata()) == [500.0, 1000.0]
    assert list(curves["kcons RATTLE"].get_ydata()) == [1.25e-3, 3.126e-4]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    # Curves are named beside the panel, in their colours; what is no curve stands in the legend.
    names = {text.get_text(): text.get_color() for text in right.texts}
    assert set(names) == {"kcons RATTLE", "scipy"} and not set(names) & set(labels)
    assert names["kcons RATTLE"] == curves["kcons RATTLE"].get_color()
    assert any(label.startswith("baseline") for label in labels)
    assert any("stopped for the budget" in label for label in labels)
    # Methods differ in colour and marker.
    assert len({colour for colour, _ in report.STYLES.values()}) == len(report.STYLES)


def test_an_error_that_is_an_energy_has_the_unit_of_one():
    found = comparison(*ROWS)
    found = replace(found, scene={**found.scene, "error": "energy above the optimum"})
    heading = text_of(found).splitlines()[3].split()
    assert heading[:4] == ["method", "fs", "eV", "Å,"]
    assert "good to 1e-09 eV" in report.explanation(found)
    assert report.figure(found).axes[0].get_ylabel() == "energy above the optimum at 24 fs / eV"
    assert "for an error of at most 0.0013 eV (what" in answer.sentence(answer.answer(found))
    entry = {**asdict(ROWS[0]), "target": 2e-3, "reached": True, "decides": "wall time", "code": ""}
    said = recommendation.sentences(replace(found, recommendation=entry))
    assert "at most 0.002 eV" in said and "error 1.25e-03 eV" in said


def test_methods_differ_in_colour_and_marker(monkeypatch):
    from kcons.comparison.methods import methods

    assert set(report.STYLES) <= set(methods.METHODS)
    many = dict.fromkeys([*methods.METHODS, *(f"stepper-{k}" for k in range(len(report.SPARE)))])
    monkeypatch.setattr(report, "METHODS", many)
    known = [name for name in many if name in report.STYLES]
    others = [name for name in many if name not in report.STYLES][: len(report.SPARE)]
    styles = {name: report.style(name) for name in known + others}
    assert len({colour for colour, _ in styles.values()}) == len(styles)
    # Methods of OpenMM may share markers with those of other MD engines, which are of other colours.
    in_openmm = [styles[name][1] for name in known if name.startswith("openmm")]
    rest = [styles[name][1] for name in [*known, *others] if name not in known or not name.startswith("openmm")]
    assert len(set(in_openmm)) == len(in_openmm)
    assert len(set(rest)) == len(rest) - 1  # both baselines have the same
    assert report.style("unheard of") == ("black", "x")


def test_plot_without_any_error(tmp_path):
    # All peers failed: still a picture, no warning.
    nothing = report.figure(comparison(measured(status="failed", error=None, step_seconds=None)))
    nothing.savefig(tmp_path / "x.png")
    assert (tmp_path / "x.png").stat().st_size > 1000


def test_environment_is_json(tmp_path):
    json.dumps(measure.environment())
