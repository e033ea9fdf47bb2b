"""The page on speed shows the committed results and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_page_shows_the_committed_results():
    result = subprocess.run(
        [sys.executable, str(ROOT / "examples" / "03_engine_speed.py"), "--show", "docs/results/engine_speed.json"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    shown = "\n".join(line.rstrip() for line in result.stdout.strip("\n").split("\n"))
    page = (ROOT / "docs" / "speed.md").read_text(encoding="utf-8")
    assert shown in page
