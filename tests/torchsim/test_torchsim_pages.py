"""Pages and pictures that need torch: their snippets run, and each name is described."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import pytest
from PIL import Image

import kcons.batched
import kcons.torchsim

ROOT = Path(__file__).parents[2]
PAGES = ["docs/batched.md", "docs/tutorials/torsions_at_once.md"]


@pytest.mark.parametrize("page", PAGES)
def test_snippets_run(page, tmp_path, monkeypatch):
    """Those of one page continue each other."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    text = (ROOT / page).read_text(encoding="utf-8")
    found = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert len(found) >= 2
    exec(compile("\n".join(found), page, "exec"), {"__name__": "snippet"})


def test_the_gallery_has_its_picture(tmp_path, monkeypatch):
    script = ROOT / "examples" / "gallery" / "torsions_at_once.py"
    monkeypatch.setattr(sys, "argv", [str(script), str(tmp_path), "4"])
    monkeypatch.setenv("MPLBACKEND", "Agg")
    runpy.run_path(str(script), run_name="__main__")
    with Image.open(tmp_path / "torsions_at_once.gif") as drawn:
        assert 2 <= drawn.n_frames <= 5


@pytest.mark.parametrize("package", [kcons.batched, kcons.torchsim], ids=lambda package: package.__name__)
def test_the_reference_has_all_public_names(package):
    text = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "reference").glob("*.md"))
    assert f".. automodule:: {package.__name__}\n" in text
    assert set(package.__all__) <= set(dir(package))
