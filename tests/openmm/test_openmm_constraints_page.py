"""The page on kcons' constraints in OpenMM shows the committed results and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent


def test_page_shows_the_committed_results():
    script = ROOT / "examples" / "08_openmm_constraints.py"
    result = subprocess.run(
        [sys.executable, str(script), "--show", "docs/results/openmm_constraints.json"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    shown = "\n".join(line.rstrip() for line in result.stdout.strip("\n").split("\n"))
    page = (ROOT / "docs" / "openmm_constraints.md").read_text(encoding="utf-8")
    assert shown in page
