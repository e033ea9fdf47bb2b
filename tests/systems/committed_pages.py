"""Examples as commands, and what they print of their committed results, which pages of the documentation show."""

from __future__ import annotations

import io
import os
import runpy
import sys
from contextlib import redirect_stdout
from pathlib import Path
from unittest.mock import patch

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "results"


def said(script: Path, *arguments: str) -> str:
    """What a script prints that is run as a command: in this process, where everything is imported already."""
    argv = [str(script), *arguments]
    with patch.object(sys, "argv", argv), patch.dict(os.environ), redirect_stdout(io.StringIO()) as out:
        try:
            runpy.run_path(str(script), run_name="__main__")
        except SystemExit as end:
            assert not end.code, end
    return out.getvalue()


def printed(script: str, results: str, option: str = "--show") -> str:
    """The output of an example for a file of results, without blanks at the ends of its lines."""
    out = said(ROOT / "examples" / script, option, str(FOLDER / results))
    assert out.strip()
    return "\n".join(line.rstrip() for line in out.strip("\n").split("\n"))


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")
