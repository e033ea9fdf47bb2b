"""The page on the whole comparison shows the committed results, and these are complete."""

from __future__ import annotations

import re

import pytest
from committed_pages import FOLDER, ROOT, page

from kcons.comparison.work_precision import whole, whole_page
from kcons.comparison.work_precision.measurement import Comparison
from kcons.comparison.work_precision.parts_of_the_whole import PLAN

PARTS = whole.parts(FOLDER / "report")
PAGE = page("report.md")


def test_page_shows_the_committed_results():
    assert whole_page.results(PARTS) in PAGE


def test_page_shows_the_pictures_of_these_parts():
    shown = re.findall(r"^!\[(.*)\]\(figures/report-(.*)\.png\)$", PAGE, re.MULTILINE)
    assert sorted(shown) == sorted((part.heading, part.key) for part in PARTS if part.key in whole_page.PICTURES)
    assert {key for _, key in shown} == set(whole_page.PICTURES)
    for _, key in shown:
        assert (ROOT / "docs" / "figures" / f"report-{key}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.key)
def test_parts_were_measured_in_a_full_run(part):
    assert "comparison" in part.data or "result" in part.data, part.data.get("not run", part.data.get("failed"))
    assert part.data["environment"]["commit"]
    if "comparison" in part.data:
        assert part.data["comparison"]["settings"]["quick"] is False


def ratios(method, other, keys):
    """Times of a step of one method over those of another, at all steps that both made."""
    found = []
    for part in PARTS:
        if part.key in keys:
            compared = Comparison.from_dict(part.data["comparison"])
            times = {m.setting: m.step_seconds for m in compared.of(other) if m.status == "ok"}
            found += [
                m.step_seconds / times[m.setting]
                for m in compared.of(method)
                if m.setting in times and m.status == "ok"
            ]
    assert len(found) > 3 * len(keys)
    return found


def test_what_the_page_says_of_single_steps():
    words = " ".join(PAGE.split())
    molecules = {
        part.key for part in PARTS if part.key.startswith(("water-216", "water-900", "chain-1e2", "chain-1e3"))
    }
    molecules |= {"chain-1e4", "alanine-hbonds", "alanine-allbonds", "alanine-hangles", "dhfr-hbonds", "dhfr-allbonds"}
    pairs = (("openmm-rattle-1e-4", "openmm-verlet-1e-4"), ("openmm-rattle", "openmm-verlet-1e-12"))
    compiled = [ratio for pair in pairs for ratio in ratios(*pair, molecules)]
    assert f"{min(compiled):.1f} to {max(compiled):.1f} times as long as `VerletIntegrator` on molecules" in words
    chains = ratios("openmm-rattle-1e-4", "openmm-verlet-1e-4", {"chain-1e2", "chain-1e3"})
    assert f"({min(chains):.2f} to {max(chains):.2f} times on chains of 100 and 1000 bonds at 1e-4" in words
    tiny = [ratio for pair in pairs for ratio in ratios(*pair, {"dumbbells"})]
    assert f"up to {max(tiny):.1f} times on two dumbbells" in words
    interpreted = ratios("openmm-kcons-rattle", "openmm-verlet-1e-12", {"dhfr-hbonds", "dhfr-allbonds"})
    assert f"interpretation costs up to {max(interpreted) - 1:.0%}".replace("%", " %") in words
    alanine = ratios("openmm-kcons-rattle", "openmm-verlet-1e-12", {"alanine-hbonds", "alanine-allbonds"})
    assert f"on alanine steps take {min(alanine):.1f} to {max(alanine):.1f} times as long" in words
    few = ratios(
        "shake-1e-4",
        "rattle",
        {"rotor", "dumbbells", "chain-1e2", "alanine-hbonds", "alanine-allbonds", "alanine-hangles"},
    )
    assert f"{min(few):.1f} to {max(few):.1f} times as long on few bonds" in words


def test_no_part_is_missing():
    assert [part.key for part in PARTS] == [item.key for item in PLAN]
