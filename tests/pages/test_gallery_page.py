"""The gallery: each script runs, is short, checks what it shows, and has its picture on the page."""

from __future__ import annotations

import runpy
import sys
from importlib.util import find_spec

import pytest
from committed_pages import DOCS, ROOT, text_of
from PIL import Image

PAGE = text_of("gallery.md")
SCRIPTS = sorted((ROOT / "examples" / "gallery").glob("*.py"))
#: What a script needs that is not among the extras of `all`; `.ci/run` has it in an environment of its own.
NEEDS = {"torsions_at_once": "torch_sim"}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_script_runs_and_is_on_the_page(script, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(script), str(tmp_path), "8"])
    monkeypatch.setenv("MPLBACKEND", "Agg")
    if find_spec(NEEDS.get(script.stem, "kcons")):
        runpy.run_path(str(script), run_name="__main__")
        with Image.open(tmp_path / f"{script.stem}.gif") as drawn:
            assert 2 <= drawn.n_frames <= 9
    text = text_of(script)
    assert len(text.splitlines()) <= 60 and "assert" in text and len(SCRIPTS) >= 5
    assert f"examples/gallery/{script.name}" in PAGE and f"](figures/{script.stem}.gif)" in PAGE
    with Image.open(DOCS / "figures" / f"{script.stem}.gif") as shown:
        assert shown.n_frames >= 20
