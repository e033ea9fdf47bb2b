"""The page on surfaces shows the committed results and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent


def test_page_shows_the_committed_results():
    result = subprocess.run(
        [
            sys.executable,
            str(ROOT / "examples" / "09_openmm_surfaces.py"),
            "--show",
            "docs/results/openmm_surfaces.json",
        ],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    shown = "\n".join(line.rstrip() for line in result.stdout.strip("\n").split("\n"))
    assert shown in (ROOT / "docs" / "openmm_surfaces.md").read_text(encoding="utf-8")
