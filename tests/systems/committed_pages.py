"""Examples as commands."""

from __future__ import annotations

import io
import os
import re
import runpy
import sys
from contextlib import redirect_stdout
from pathlib import Path
from unittest.mock import patch

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def text_of(page: Path | str) -> str:
    """Of a page, or of one of docs/."""
    return (DOCS / page).read_text(encoding="utf-8")


def blocks(text: str, language: str) -> list[str]:
    """What stands between the fences of a language."""
    return re.findall(rf"^```{re.escape(language)}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def entries(page: Path) -> list[str]:
    """What the tables of contents of a page name."""
    return [
        line
        for listing in blocks(text_of(page), "{toctree}")
        for line in listing.splitlines()
        if line and line[0] != ":"
    ]


def said(script: Path, *arguments: str) -> str:
    """What a script prints that is run as a command: in this process, where everything is imported already."""
    argv = [str(script), *arguments]
    with patch.object(sys, "argv", argv), patch.dict(os.environ), redirect_stdout(io.StringIO()) as out:
        try:
            runpy.run_path(str(script), run_name="__main__")
        except SystemExit as end:
            assert not end.code, end
    return out.getvalue()
