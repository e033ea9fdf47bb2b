"""The whole comparison: what is measured once is not measured again, and the page shows all of it."""

from __future__ import annotations

import pytest
from matplotlib.figure import Figure
from tiny_whole_comparison import METHODS, TINY, TWICE, Page, measured_once, plan_tiny

from kcons.cli import main
from kcons.comparison import test_systems
from kcons.comparison.methods.methods import STEPPERS, USUAL_STEPPERS
from kcons.comparison.study import machine
from kcons.comparison.study.study import Watcher
from kcons.comparison.work_precision import whole, whole_page
from kcons.comparison.work_precision.measurement import Comparison
from kcons.comparison.work_precision.parts_of_the_whole import Item
from kcons.errors import InputError


class Listener(Watcher):
    def __init__(self, interrupt_at=""):
        self.parts, self.times, self.interrupt_at = [], [], interrupt_at

    def overall(self, what, done, total):
        if self.interrupt_at and self.interrupt_at in what:
            raise KeyboardInterrupt
        self.parts.append(what)
        self.times.append((done, total))


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    plan_tiny(monkeypatch)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return measured_once(tmp_path_factory)


@pytest.fixture
def empty_pictures(monkeypatch):
    """Drawing takes longer than measuring: for tests of what is measured when."""
    monkeypatch.setattr(whole_page.report, "figure", lambda found: Figure(figsize=(1, 1)))


def test_files_of_every_part(finished):
    names = {path.name for path in finished.iterdir()}
    assert names >= {"index.html", "gone.json"}
    for key in ("chain-3", "sphere"):
        assert names >= {f"{key}.json", f"{key}.png", f"{key}.txt"}
    assert not [name for name in names if name.endswith(".unfinished")]
    assert "kcons RATTLE" in (finished / "sphere.txt").read_text(encoding="utf-8")


def test_numbers_come_back_as_they_were(finished):
    data = whole.read(finished, "chain-3")
    found = Comparison.from_dict(data["comparison"])
    assert list(dict.fromkeys(m.method for m in found.measurements)) == METHODS
    assert found.timing["repeats"] == TWICE.least and found.timing["margin"] is not None
    for m in found.of("rattle"):
        assert m.title == "kcons RATTLE" and m.error > 0 and m.steps == round(80 / m.setting)
    assert found.observed_order("rattle") == pytest.approx(2.0, abs=0.1)
    assert data["key"]["code"] == "digest"
    assert data["environment"]["versions"]["numpy"]
    # Small enough to be kept with the documentation.
    assert (finished / "chain-3.json").stat().st_size < 10_000


def test_what_cannot_be_run_is_said(finished):
    assert whole.read(finished, "gone")["not run"] == "this version of kcons has no test system 'no such scene'"


@pytest.mark.usefixtures("empty_pictures")
def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        whole.run(TINY, tmp_path, watcher=Listener("Spheres"))
    assert (tmp_path / "index.html").exists()
    assert not (tmp_path / "sphere.json").exists()
    first = (tmp_path / "chain-3.json").read_bytes()
    listener = Listener()
    whole.run(TINY, tmp_path, watcher=listener)
    assert listener.parts[0] == "chain-3: measured already"
    assert not any("Chain" in part for part in listener.parts)
    assert any("Spheres" in part for part in listener.parts)
    assert (tmp_path / "chain-3.json").read_bytes() == first
    assert (tmp_path / "sphere.json").exists()


def test_other_code_system_or_settings_are_measured_anew(finished, monkeypatch):
    item = TINY[0]
    key = whole.read(finished, item.key)["key"]
    assert key == whole.key_of(item, False)
    assert key != whole.key_of(item, True)
    assert key != whole.key_of(Item("chain-3", "Chain of 3 bonds", "chain", 4, budget=5), False)
    monkeypatch.setattr(machine, "code_digest", lambda: "another")
    assert key != whole.key_of(item, False)


@pytest.mark.usefixtures("empty_pictures")
def test_fresh_measures_again_and_half_a_file_is_no_result(tmp_path, monkeypatch):
    monkeypatch.setattr(whole, "methods_of", lambda item, system, quick: (["rattle"], {}))
    (tmp_path / "sphere.json").write_text('{"format": "kcons-rep')
    assert whole.read(tmp_path, "sphere") is None
    sphere = TINY[2:3]
    whole.run(sphere, tmp_path)
    again, once = Listener(), Listener()
    whole.run(sphere, tmp_path, watcher=once)
    whole.run(sphere, tmp_path, fresh=True, watcher=again)
    assert once.parts == ["sphere: measured already"]
    assert again.parts == ["1 of 1: Spheres"]


def test_quick_leaves_large_parts_out_and_keeps_to_its_time(tmp_path):
    listener = Listener()
    whole.run(TINY, tmp_path, quick=True, limit=1e-9, watcher=listener)
    assert whole.read(tmp_path, "sphere")["not run"] == "in the full run only"
    assert whole.read(tmp_path, "chain-3")["not run"] == "the time of a quick run was over"
    assert all(done <= total for done, total in listener.times)


def test_a_system_that_cannot_be_built_is_a_failure_and_is_tried_again(tmp_path):
    bad = (Item("chain-0", "No chain", "chain", 0),)
    for _ in range(2):
        listener = Listener()
        whole.run(bad, tmp_path, watcher=listener)
        assert listener.parts == ["1 of 1: No chain"]
    assert "at least one bond" in whole.read(tmp_path, "chain-0")["failed"]


def test_redraw_makes_the_same_page_from_the_numbers(finished, tmp_path, capsys):
    for path in finished.glob("*.json"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    assert main.main(["compare", "--all", "--redraw", str(tmp_path)]) == 0
    assert f"wrote {tmp_path / 'index.html'}" in capsys.readouterr().out
    texts = []
    for folder in (finished, tmp_path):
        page = Page()
        page.feed((folder / "index.html").read_text(encoding="utf-8"))
        texts.append(page.text)
    assert texts[0] == texts[1]
    assert (tmp_path / "sphere.png").exists()


@pytest.mark.usefixtures("empty_pictures")
def test_command(tmp_path, capsys):
    assert main.main(["compare", "--all", "--only", "sphere", "--out", str(tmp_path / "o")]) == 0
    printed = capsys.readouterr()
    assert "index.html" in printed.out
    assert "1 of 1: Spheres; about 1.00 s left" in printed.err
    assert main.main(["compare", "--all", "--list"]) == 0
    assert "chain-3" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["compare", "--all", "--only", "nothing"], "no part 'nothing'"),
        (["compare", "chain", "--all"], "--all runs all test systems"),
        (["compare", "--all", "--target-error", "1e-6"], "--all runs all test systems"),
    ],
)
def test_mistakes(arguments, text, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main.main(arguments) == 2
    assert text in capsys.readouterr().err


def test_there_is_nothing_to_redraw(tmp_path):
    with pytest.raises(InputError, match="no results"):
        whole.redraw(tmp_path)


# -- the real plan ----------------------------------------------------------------------------------


def test_methods_are_the_usual_ones_of_every_md_engine(monkeypatch):
    monkeypatch.undo()
    system = test_systems.build("chain", 3)
    names, left_out = whole.methods_of(Item("x", "x", "chain"), system, False)
    for name in ("rattle", "blanes-moan6", "ase-kcons", "ase-bonds", "ase-internals", "dop853", "verlet"):
        assert name in names
    assert "openmm-middle-bath" not in names
    assert not left_out
    assert set(STEPPERS) | {"extrapolation"} <= set(names)
    quick, _ = whole.methods_of(Item("x", "x", "chain"), system, True)
    assert {name for name in quick if name in STEPPERS} == set(USUAL_STEPPERS)
    kept, out = whole.methods_of(Item("x", "x", "chain", without={"ase-i": "slow", "dop": "why"}), system, False)
    assert out == {"ase-internals": "slow", "dop853": "why", "dop853-projected": "why"} and not set(out) & set(kept)
