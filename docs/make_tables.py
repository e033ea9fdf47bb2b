"""Tables and figures of the pages, from the result files in docs/results.

    python docs/make_tables.py [FILE ...]

A page has a table between `<!-- table: FILE NAME -->` and `<!-- end -->`. FILE.csv is the result of a study in
examples/studies, and NAME one of the tables that the study makes of it; tables of FILE.json are made by
result_tables.py, and `steppers all` of the steppers. Figures go to docs/figures; with FILEs only their tables are made.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

DOCS = Path(__file__).resolve().parent
STUDIES = DOCS.parent / "examples" / "studies"
sys.path[:0] = [str(DOCS.parent / "tests"), str(STUDIES), str(DOCS)]

import drawn_pictures  # noqa: E402
import harness  # noqa: E402
import result_pictures  # noqa: E402
import result_tables  # noqa: E402

from kcons.comparison.machine import processor_of  # noqa: E402
from kcons.steppers import RungeKuttaNystrom  # noqa: E402
from kcons.steppers.splitting import SCHEMES  # noqa: E402

#: Which study has made a result file.
MADE_BY = {
    "hard_cases": "hard_cases",
    "openmm_device": "openmm_device",
    "openmm_surfaces": "openmm_surfaces",
    "precision": "solvers_alone",
    "scaling": "solvers_alone",
    "stability": "stability",
    "trajectory_check": "check_speed",
    "whole_comparison": "whole_comparison",
}
#: With an error and a unit, or without.
NUMBER = re.compile(r"[-+\d.,e]+( ± [\d.]+)?( \S{1,5})?")
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
    """Numbers and what looks like numbers to the right; a number, its error and its unit on one line."""
    cells = [[str(cell).replace("|", r"\|") for cell in row] for row in table.astype(object).fillna("").to_numpy()]
    cells = [[cell.replace(" ", "\u00a0") if NUMBER.fullmatch(cell) else cell for cell in row] for row in cells]
    rules = ["---:" if all(re.match(r"[-–\d.]", row[k]) for row in cells) else "---" for k in range(len(table.columns))]
    return "\n".join(f"| {' | '.join(row)} |" for row in ([str(c) for c in table.columns], rules, *cells))


def runs_of(data: Any) -> dict[str, str]:
    """The commits of a JSON file, each with its day and its processor."""
    found: dict[str, str] = {}
    if isinstance(data, dict):
        if data.get("commit") and "cpu" in data:
            found[data["commit"][:8]] = f"{data['date'][:10]}; {processor_of(data)}"
        data = list(data.values())
    for each in data if isinstance(data, list) else ():
        found = found | runs_of(each) | found
    return found


def steppers() -> pd.DataFrame:
    """What the steppers say of themselves."""
    rows = []
    for scheme, make in SCHEMES.items():
        stepper = make()
        flights = [abs(drift * part) for drift in stepper.drifts for part in stepper.flight]
        words = ("yes" if each else "no" for each in (stepper.reversible, stepper.symplectic))
        row = f"`{type(stepper).__name__}`", f"`{scheme}`", stepper.order, *words, stepper.force_evaluations
        refuses = isinstance(stepper, RungeKuttaNystrom)
        rows.append((*row, len(flights), f"{max(flights):.3g}", "no" if refuses else "yes"))
    head = "stepper|scheme|order|reversible|symplectic|forces a step|flights a step|longest flight"
    return pd.DataFrame(rows, columns=[*head.split("|"), "velocity-dependent forces"])


@cache
def results(name: str) -> tuple[str, dict[str, pd.DataFrame]]:
    """Of which run a result is, and its tables."""
    if name == "steppers":
        return "", {"all": steppers()}
    if name in MADE_BY:
        head, table = harness.read(harness.RESULTS / f"{name}.csv")
        made = (
            f"Commit {head['commit'][:8]}, {head['date'][:10]}; {head['machine']}; [all numbers](RESULTS/{name}.csv)."
        )
        return made, study(name).tables(table)
    data = json.loads((harness.RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    runs = runs_of(data) or {data["commit"][:8]: data["machine"]}
    device = f"; {data['device']}" if data.get("device") else ""
    words = "; commit ".join(f"{commit}, {run}" for commit, run in runs.items())
    made = f"Commit {words}{device}; [all numbers](RESULTS/{name}.json)."
    return made, result_tables.TABLES[name](data)


def renewed(text: str, folder: Path = DOCS, *files: str) -> str:
    """A page with its tables, or those of some files, made again, each above the line that says of which run it is."""

    def block(match: re.Match[str]) -> str:
        result, name = match.groups()
        made, tables = results(result)
        made = made and f"\n{made}\n".replace("RESULTS", os.path.relpath(harness.RESULTS, folder))
        return f"<!-- table: {result} {name} -->\n{markdown(tables[name])}\n{made}<!-- end -->"

    return BLOCK.sub(lambda match: block(match) if match[1] in (files or match.groups()) else match[0], text)


#: The picture of the front page: what is said, part of the whole comparison, engine, title of the other method, of
#: ours, and the step of the other one in fs (ours is the cheapest that errs no more).
FRONT = (
    ("Rigid water in ASE", "water-216", "ASE", "ASE Verlet + FixBondLengths", "ASE Verlet + kcons", 4.0),
    ("A molecule with xTB in ASE", "ethanol", "ASE", "ASE Verlet + FixBondLengths", "ASE Verlet + kcons", 2.0),
    ("A protein in OpenMM, accurately", "dhfr-hbonds", "OpenMM", "OpenMM Verlet, 1e-5",
     "OpenMM + kcons blanes-moan4", 0.5),
    ("The same, as usual", "dhfr-hbonds", "OpenMM", "OpenMM Verlet, 1e-5", "OpenMM + kcons rattle", 2.0),
)  # fmt: skip


def front_rows() -> list[tuple[str, str, float]]:
    """What is simulated, against what at which error, and how many times cheaper kcons is."""
    _, table = harness.read(harness.RESULTS / "whole_comparison.csv")
    rows = []
    for words, part, engine, other, mine, step in FRONT:
        here = table[(table.part == part) & (table.engine == engine) & (table.status == "ok")]
        (theirs,) = here[(here.title == other) & (here.setting == step)].itertuples()
        ours = here[(here.title == mine) & (here.error <= 1.02 * theirs.error)].seconds.min()
        against = f"against {other.split(' + ')[-1].split(',')[0]} at {step:g} fs, error {theirs.error:.0e} Å"
        rows.append((words, against, theirs.seconds / ours))
    data = json.loads((harness.RESULTS / "openmm_platforms.json").read_text(encoding="utf-8"))
    speed = {name: row["ratio"] for name, row in data["measurements"][1]["rows"].items()}  # of VerletIntegrator
    rows.append(("A protein in OpenMM on a GPU", "against VerletIntegrator at 2 fs", speed["kcons rattle"]))
    rows.append(("The same with a thermostat", "against LangevinMiddleIntegrator at 2 fs",
                 speed["kcons Langevin"] / speed["LangevinMiddleIntegrator"]))  # fmt: skip
    return rows


def front() -> Figure:
    """How many times cheaper kcons is, where it gains and where it does not."""
    rows = front_rows()
    drawn = Figure(figsize=(6.6, 4.8), layout="constrained")
    axes = drawn.subplots()
    for k, (words, against, gain) in enumerate(rows):
        color = "#1f77b4" if gain > 1.1 else "#999999"
        axes.barh(k + 0.22, gain - 1, left=1, color=color, height=0.4)
        told = f"{gain:,.0f} ×" if gain > 10 else f"{gain:.2g} ×"
        axes.text(max(gain, 1) * 1.1, k + 0.22, told, va="center", fontsize=13, weight="bold", color=color)
        axes.text(1.06, k - 0.22, words, va="center", fontsize=11)
        axes.text(4000, k - 0.22, against, va="center", ha="right", fontsize=9, color="#555555")
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set(xscale="log", xlim=(0.55, 4200), ylim=(len(rows) - 0.5, -0.5), yticks=[])
    axes.set_xlabel("how many times faster with kcons, at the same error (gray: nothing gained)")
    axes.set_xticks([1, 10, 100, 1000], ["1", "10", "100", "1000"])
    axes.minorticks_off()
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    return drawn


def main(*files: str) -> None:
    for page in DOCS.rglob("*.md"):
        text = page.read_text(encoding="utf-8")
        if (new := renewed(text, page.parent, *files)) != text:
            page.write_text(new, encoding="utf-8")
            print(page.relative_to(DOCS))
    if [results(file) for file in files]:  # an unknown one raises
        return
    front().savefig(DOCS / "figures" / "front.png", dpi=110)
    for name, picture in {**result_pictures.PICTURES, **drawn_pictures.PICTURES}.items():
        picture().savefig(DOCS / "figures" / f"{name}.png", dpi=110)
    result_pictures.hard_cases(results("hard_cases")[1]["verdicts"]).savefig(
        DOCS / "figures" / "hard-cases.png", dpi=110
    )
    for result in MADE_BY:
        figures = getattr(study(result), "figures", lambda table: {})
        for name, figure in figures(harness.read(harness.RESULTS / f"{result}.csv")[1]).items():
            figure.savefig(DOCS / "figures" / f"{name}.png", dpi=75)
            print(f"figures/{name}.png")


if __name__ == "__main__":
    main(*sys.argv[1:])
