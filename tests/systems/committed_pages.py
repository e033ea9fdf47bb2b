"""What examples print of their committed results, which pages of the documentation show."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "results"


def printed(script: str, results: str, option: str = "--show") -> str:
    """The output of an example for a file of results, without blanks at the ends of its lines."""
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / script), option, str(FOLDER / results)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip()
    return "\n".join(line.rstrip() for line in done.stdout.strip("\n").split("\n"))


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")
