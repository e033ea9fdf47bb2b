"""Tables and figures of the pages, from the result files in docs/results.

    python docs/make_tables.py

A page has a table between `<!-- table: FILE NAME -->` and `<!-- end -->`: FILE.csv is the result of a study in
examples/studies, and NAME one of the tables that the study makes of it. Figures go to docs/figures.
"""

from __future__ import annotations

import importlib.util
import re
import sys
from functools import cache
from pathlib import Path
from types import ModuleType

import pandas as pd

DOCS = Path(__file__).resolve().parent
STUDIES = DOCS.parent / "examples" / "studies"
sys.path[:0] = [str(DOCS.parent / "tests"), str(STUDIES)]

import harness  # noqa: E402

#: Which study has made a result file.
MADE_BY = {
    "hard_cases": "hard_cases",
    "precision": "solvers_alone",
    "scaling": "solvers_alone",
    "stability": "stability",
    "trajectory_check": "check_speed",
    "whole_comparison": "whole_comparison",
}
BLOCK = re.compile(r"<!-- table: (\w+) (\w+) -->\n.*?<!-- end -->", re.DOTALL)


@cache
def study(result: str) -> ModuleType:
    """The study that makes a result file."""
    name = MADE_BY[result]
    spec = importlib.util.spec_from_file_location(f"study_{name}", STUDIES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def markdown(table: pd.DataFrame) -> str:
    """Numbers and what looks like numbers to the right."""
    cells = [[str(cell).replace("|", r"\|") for cell in row] for row in table.astype(object).fillna("").to_numpy()]
    rules = ["---:" if all(re.match(r"[-–\d.]", row[k]) for row in cells) else "---" for k in range(len(table.columns))]
    return "\n".join(f"| {' | '.join(row)} |" for row in ([str(c) for c in table.columns], rules, *cells))


def renewed(text: str) -> str:
    """A page with its tables made again, each below the line that says of which run it is."""

    def block(match: re.Match[str]) -> str:
        result, name = match.groups()
        head, table = harness.read(harness.RESULTS / f"{result}.csv")
        made = (
            f"Commit {head['commit'][:8]}, {head['date'][:10]}; {head['machine']}; [all numbers](results/{result}.csv)."
        )
        shown = markdown(study(result).tables(table)[name])
        return f"<!-- table: {result} {name} -->\n{shown}\n\n{made}\n<!-- end -->"

    return BLOCK.sub(block, text)


def main() -> None:
    for page in DOCS.rglob("*.md"):
        text = page.read_text(encoding="utf-8")
        if (new := renewed(text)) != text:
            page.write_text(new, encoding="utf-8")
            print(page.relative_to(DOCS))
    for result in MADE_BY:
        figures = getattr(study(result), "figures", lambda table: {})
        for name, figure in figures(harness.read(harness.RESULTS / f"{result}.csv")[1]).items():
            figure.savefig(DOCS / "figures" / f"{name}.png", dpi=75)
            print(f"figures/{name}.png")


if __name__ == "__main__":
    main()
