"""The page of the whole comparison: one file, who wins where, and what is close."""

from __future__ import annotations

import copy
import dataclasses

import pytest
from tiny_whole_comparison import Page, measured_once, plan_tiny

from kcons.comparison.study import tables
from kcons.comparison.work_precision import whole, whole_page
from kcons.errors import InputError


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    plan_tiny(monkeypatch)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return measured_once(tmp_path_factory)


def test_page_is_one_file_with_everything(finished):
    page = Page()
    source = (finished / "index.html").read_text(encoding="utf-8")
    page.feed(source)
    assert page.addresses and all(address.startswith(("#", "data:")) for address in page.addresses)
    assert not {"iframe", "object", "embed", "form"} & set(page.tags)
    assert "fetch(" not in source and "XMLHttpRequest" not in source and "import(" not in source
    assert "url(" not in source and "@import" not in source
    assert page.tags.count("img") == 1 and page.tags.count("details") == 2
    for text in ("Who wins where", "Chain of 3 bonds", "Spheres", "A later test system", "not run: this version"):
        assert text in page.text
    environment = whole.read(finished, "sphere")["environment"]
    assert environment["cpu"] in page.text
    assert (environment["commit"] or "not from a repository") in page.text
    assert f"numpy {environment['versions']['numpy']}" in page.text


def test_winners_name_md_engine_and_gain(finished):
    table = whole_page.winners(whole.parts(finished))
    cells = [dict(zip(table.headings, row, strict=True)) for row in table.rows]
    (sphere,) = [row for row in cells if row["test system"] == "Spheres"]
    assert sphere["decided by"] == "force evaluations" and sphere["over"] == "SciPy DOP853 on eq. 105"
    # Where times decide, how well they repeat is said.
    margins = {
        part.heading: part.data["comparison"]["timing"]["margin"]
        for part in whole.parts(finished)
        if part.key in ("chain-3", "sphere")
    }
    for row in cells:
        by_time = row["decided by"] == "wall time"
        assert row["times repeat to"] == (f"{100 * margins[row['test system']]:.0f} %" if by_time else "")
    assert {row["decided by"] for row in cells} == {"wall time", "force evaluations"}
    text = tables.markdown(table.of((0, 1, 4)))
    assert text.splitlines()[0] == "| test system | MD engine | gain |"
    assert text.splitlines()[1] == "| --- | --- | ---: |"
    assert len(text.splitlines()) == 2 + len(table.rows)


def test_close_calls_are_named(finished):
    """Lines that only the margin saves are listed, and what beats kcons in both is counted."""
    (chain,) = [part for part in whole.parts(finished) if part.key == "chain-3"]

    def told(error, factor, margin):
        data = copy.deepcopy(chain.data)
        measured = data["comparison"]["measurements"]
        best = min((m for m in measured if m["method"] == "rattle"), key=lambda m: m["error"])
        peer = {**best, "method": "dop853", "title": "SciPy DOP853"}
        peer |= {"error": error * best["error"], "seconds_per_time": factor * best["seconds_per_time"]}
        data["comparison"]["measurements"] = [best, peer]
        data["comparison"]["timing"] = {"force_seconds": 1e-3, "margin": margin}
        return whole_page.results([dataclasses.replace(chain, data=data)])

    text = told(1.0, 0.8, 0.3)
    assert "In 1 of 1 lines of this table no other method is both cheaper and more accurate" in text
    assert "no other method is cheaper than kcons in 1 of them" in text
    assert "at the same error in 1 of the lines. These are ties:\n\n- Chain of 3 bonds: SciPy" in text
    assert "up to 20 % cheaper (wall time, arrays)" in text
    text = told(1.0, 0.8, 0.1)
    assert "no other method is cheaper than kcons in 0 of them" in text
    assert "cheaper at the same error in no line.\n" in text
    assert "In 0 of 1 lines of this table no other" in told(0.9, 0.8, 0.3)


def test_a_page_is_filled_between_its_marks_again_and_again(finished, tmp_path, monkeypatch):
    monkeypatch.setattr(whole_page, "PICTURES", ("sphere",))
    page = tmp_path / "page.md"
    page.write_text(f"head\n{whole_page.BEGIN}\nold\n{whole_page.END}\ntail\n")
    parts_of_the_whole = whole.parts(finished)
    assert whole_page.fill(page, parts_of_the_whole) == [
        page,
        tmp_path / "figures" / whole_page.WINNERS_PICTURE,
        tmp_path / "figures" / "report-sphere.png",
    ]
    first = page.read_text(encoding="utf-8")
    assert first.startswith("head\n") and first.endswith("\ntail\n") and "old" not in first
    assert "| test system | MD engine | decided by |" in first and "![Spheres](figures/report-sphere.png)" in first
    assert "full run" in first
    whole_page.fill(page, parts_of_the_whole)
    assert page.read_text(encoding="utf-8") == first
    page.write_text("no marks")
    with pytest.raises(InputError, match="no place for results"):
        whole_page.fill(page, parts_of_the_whole)


def test_the_page_opens_with_who_wins_where(finished):
    page = Page()
    page.feed((finished / "index.html").read_text(encoding="utf-8"))
    source = (finished / "index.html").read_text(encoding="utf-8")
    first = source.index("<section>")
    assert source.index("Who wins where</h2>") < source.index("<img", first) < source.index("<table", first)
    assert source.index("Where and with what</h2>") > source.index("Spheres</h2>")
    assert source.count('class="diagram"') == 2 and len(source) < 6e6


def test_commits_of_one_machine_are_one_row(finished):
    parts = whole.parts(finished)
    two = [dataclasses.replace(part, data=copy.deepcopy(part.data)) for part in parts]
    measured = [part for part in two if "environment" in part.data]
    assert len(whole_page._machines(two).rows) == 1
    measured[1].data["environment"]["commit"] = "another"
    table = whole_page._machines(two)
    assert len(table.rows) == 1 and ", another" in table.rows[0][3]
    measured[1].data["environment"]["cpu"] = "another processor"
    assert len(whole_page._machines(two).rows) == 2
