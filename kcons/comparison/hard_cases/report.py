"""The table of hard cases for the terminal, as a picture, as a page, and as Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcons.comparison.hard_cases.case import OURS
from kcons.comparison.study import html_page, tables
from kcons.comparison.study.report_files import made_by
from kcons.comparison.study.tables import Marked, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Colour, sign and meaning of each verdict.
VERDICTS = {
    "right": ("#2a9d4a", "+", "the numbers meet their limits"),
    "refused": ("#8ecae6", "R", "an error or warning that says why"),
    "silently wrong": ("#d0342c", "W", "ran through, and a number misses its limit"),
    "crash/NaN": ("#6a040f", "X", "NaN, a dead process, or no answer"),
    "cannot express": ("#d9d9d9", "-", "no means to state the problem"),
}
_STYLES = {
    "right": "green",
    "refused": "cyan",
    "silently wrong": "bold red",
    "crash/NaN": "bold magenta",
    "cannot express": "dim",
}


def table(result: Mapping[str, Any]) -> Table:
    """Verdicts for the terminal: cases by programs."""
    systems = result["systems"]
    rows = [
        [name, result["cases"][name]["title"], *(_short(row.get(system)) for system in systems)]
        for name, row in _rows(result)
    ]
    return Table(["case", "title", *systems], rows, words=range(2 + len(systems)), title="Hard cases")


def _short(cell: Mapping[str, Any] | None) -> str:
    if cell is None:
        return ""
    return Marked(f"{cell['verdict']}{'' if _in_order(cell) else ' !'}", _STYLES[cell["verdict"]])


def _in_order(cell: Mapping[str, Any]) -> bool:
    return bool(cell["met"]) or cell["verdict"] == "cannot express"


def summary(result: Mapping[str, Any]) -> str:
    """Counts for each program, and what falls short in kcons."""
    lines = []
    for system in result["systems"]:
        cells = [row[system] for _, row in _rows(result) if system in row]
        counts = Counter(cell["verdict"] for cell in cells)
        met = sum(cell["met"] for cell in cells)
        words = ", ".join(f"{counts[verdict]} {verdict}" for verdict in VERDICTS if counts[verdict])
        lines.append(f"{system}: {met} of {len(cells)} as asked for ({words})")
    for name, row in _rows(result):
        for system in OURS:
            cell = row.get(system)
            if cell and not _in_order(cell):
                lines.append(f"{name}, {system}: {cell['verdict']}: {cell['text']}")
    return "\n".join(lines)


def failures(result: Mapping[str, Any]) -> list[str]:
    """Cells of kcons that are silently wrong or NaN."""
    return [
        f"{name}, {system}: {row[system]['text']}"
        for name, row in _rows(result)
        for system in OURS
        if system in row and row[system]["verdict"] in ("silently wrong", "crash/NaN")
    ]


def _rows(result: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    return [(name, result["cells"][name]) for name in result["cases"] if name in result["cells"]]


def picture(result: Mapping[str, Any]) -> Figure:
    """Cases by programs, coloured by verdict."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch, Rectangle

    rows = _rows(result)
    systems = result["systems"]
    figure = Figure(figsize=(11.0, 1.6 + 0.24 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for k, (name, row) in enumerate(rows):
        for j, system in enumerate(systems):
            cell = row.get(system)
            if cell is None:
                continue
            colour, sign, _ = VERDICTS[cell["verdict"]]
            axes.add_patch(Rectangle((j - 0.48, k - 0.45), 0.96, 0.9, color=colour))
            light = cell["verdict"] in ("cannot express", "refused")
            axes.text(j, k, sign, ha="center", va="center", fontsize=7, color="black" if light else "white")
        axes.text(-0.6, k, f"{name}  {result['cases'][name]['title']}"[:74], ha="right", va="center", fontsize=7)
    axes.set_xlim(-0.5, len(systems) - 0.5)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xticks(range(len(systems)), systems, fontsize=9)
    axes.xaxis.tick_top()
    axes.set_yticks([])
    axes.set_frame_on(False)
    axes.tick_params(length=0)
    keys = [Patch(color=colour, label=f"{sign}  {name}: {words}") for name, (colour, sign, words) in VERDICTS.items()]
    figure.legend(handles=keys, loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    return figure


def write(result: Mapping[str, Any], folder: Path) -> list[Path]:
    """Write hard_cases.png and hard_cases.html into a folder; the JSON is kept by the study."""
    figure = picture(result)
    png = folder / "hard_cases.png"
    figure.savefig(png, dpi=110)
    by_theme: dict[str, list[str]] = {}
    for name, _ in _rows(result):
        by_theme.setdefault(result["cases"][name]["theme"], []).append(name)
    sections = [html_page.Section("All cases", figures=[figure], literal=summary(result))]
    for theme, names in by_theme.items():
        sections.append(html_page.Section(theme.replace("_", " ").capitalize(), tables=[_detail(result, names)]))
    sections.append(html_page.Section("Made by", literal=made_by(result)))
    html = html_page.write(
        folder / "hard_cases.html",
        "Hard cases of constrained dynamics",
        sections,
        introduction=[
            "Each case is run by the core of kcons, by its parts for ASE and OpenMM, and by ASE and OpenMM "
            "themselves. Judges are closed forms, Euler's equations, invariants and the dense theory, none of which "
            "shares code with the solvers.",
            "Peers run at the settings that are best for them: FixBondLengths at 1e-13, OpenMM in double precision "
            "(Reference platform) at a tolerance of 1e-12.",
        ],
    )
    return [png, html]


def _detail(result: Mapping[str, Any], names: list[str]) -> Table:
    rows, marks = [], []
    for name in names:
        case = result["cases"][name]
        for k, system in enumerate(result["systems"]):
            cell = result["cells"][name].get(system)
            if cell is None:
                continue
            first = k == 0
            rows.append(
                [
                    name if first else "",
                    case["title"] if first else "",
                    case["limit"] if first else "",
                    system,
                    cell["verdict"],
                    cell["text"][:400],
                    f"{cell['seconds']:.1f}",
                ]
            )
            marks.append("" if cell["verdict"] == "cannot express" else ("good" if cell["met"] else "bad"))
    headings = ["case", "title", "what must be true", "program", "verdict", "number or reason", "s"]
    return Table(headings, rows, words=range(6), marks=marks)


def markdown(result: Mapping[str, Any]) -> str:
    """The table for the documentation."""
    systems = result["systems"]
    rows = [
        [name, result["cases"][name]["title"], *(_words(row.get(system)) for system in systems)]
        for name, row in _rows(result)
    ]
    return tables.markdown(Table(["", "", *systems], rows, words=range(2 + len(systems))))


def _words(cell: Mapping[str, Any] | None) -> str:
    """Verdict and the number or error that decides it."""
    if cell is None:
        return ""
    if cell["verdict"] == "cannot express":
        return "–"
    if cell["verdict"] == "refused":
        kind = cell["text"].split(":", 1)[0]
        return f"refused ({kind})" if kind.isidentifier() else "refused (warned)"
    if not cell["checks"]:
        return f"**{cell['verdict']}**"
    checks = cell["checks"]
    bad = [c for c in checks if not c["passed"]]
    told = bad[0] if bad else max(checks, key=lambda c: c["value"] / c["limit"] if c["limit"] else 0.0)
    # Files hold null for NaN.
    number = f"{told['name']} {'nan' if told['value'] is None else format(told['value'], '.2g')}"
    return f"right: {number}" if cell["verdict"] == "right" else f"**{cell['verdict']}**: {number}"
