"""Examples as commands."""

from __future__ import annotations

import io
import os
import runpy
import sys
from contextlib import redirect_stdout
from pathlib import Path
from unittest.mock import patch

ROOT = Path(__file__).parents[2]


def said(script: Path, *arguments: str) -> str:
    """What a script prints that is run as a command: in this process, where everything is imported already."""
    argv = [str(script), *arguments]
    with patch.object(sys, "argv", argv), patch.dict(os.environ), redirect_stdout(io.StringIO()) as out:
        try:
            runpy.run_path(str(script), run_name="__main__")
        except SystemExit as end:
            assert not end.code, end
    return out.getvalue()
