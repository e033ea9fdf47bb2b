"""A small whole comparison: a chain and a sphere, and one test system that is not there."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import pytest

from kcons.comparison.study import machine
from kcons.comparison.work_precision import parts_of_the_whole, whole
from kcons.comparison.work_precision.parts_of_the_whole import Item
from kcons.comparison.work_precision.timing_rounds import Rounds

TINY = (
    Item("chain-3", "Chain of 3 bonds", "chain", 3, budget=5, seconds=1, quick_seconds=1),
    Item("gone", "A later test system", "no such scene", seconds=1),
    Item("sphere", "Spheres", "sphere", 1, budget=5, seconds=1, quick_seconds=0),
)
METHODS = ["rattle", "blanes-moan4", "dop853", "verlet"]
#: No test looks at its times, but two are needed to say how well they repeat.
TWICE = Rounds(least=2, most=2, seconds=0.0, pass_seconds=1e-4)


def plan_tiny(patch):
    """Let the whole comparison be the tiny one."""
    for module in (parts_of_the_whole, whole):
        patch.setattr(module, "PLAN", TINY)
    patch.setattr(whole, "FULL_ROUNDS", TWICE)
    patch.setattr(whole, "methods_of", lambda item, system, quick: (METHODS, {}))
    patch.setattr(machine, "code_digest", lambda: "digest")


_FOLDERS: list[Path] = []


def measured_once(tmp_path_factory) -> Path:
    """Its folder, measured once by each process; to be read only."""
    if not _FOLDERS:
        folder = tmp_path_factory.mktemp("all")
        with pytest.MonkeyPatch.context() as patch:
            plan_tiny(patch)
            whole.run(TINY, folder)
        _FOLDERS.append(folder)
    return _FOLDERS[0]


class Page(HTMLParser):
    def __init__(self):
        super().__init__()
        self.addresses, self.text, self.tags, self.headings = [], "", [], []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.addresses += [value for name, value in attributes if name in ("href", "src", "action", "data", "srcset")]

    def handle_data(self, data):
        self.text += data
