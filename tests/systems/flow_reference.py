"""Reads the reference cases of linear flows; they were computed with 45 digits."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

DATA = Path(__file__).parents[1] / "models" / "flows" / "data"
MECHANICS = Path(__file__).parents[1] / "reference" / "data"


@cache
def case(name: str) -> dict[str, Any]:
    path = DATA / f"{name}.json"
    return json.loads((path if path.exists() else MECHANICS / f"{name}.json").read_text(encoding="utf-8"))
