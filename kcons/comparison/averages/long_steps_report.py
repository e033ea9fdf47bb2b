"""Tables, plots and files of what `kcons.comparison.averages.long_steps` found."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kcons.comparison.averages.long_steps import DOUBT, METHODS, StepComparison, Stepped, best
from kcons.comparison.study import report_files
from kcons.comparison.study.curves import Curve, Panel, draw
from kcons.comparison.study.tables import Marked, Table, footnotes, numbered, verdict
from kcons.comparison.test_systems.system import Units

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Colour-blind safe (Okabe and Ito), and a marker each.
STYLES: dict[str, tuple[str, str]] = {
    "langevin": ("#009E73", "s"),
    "langevin-respa": ("#D55E00", "^"),
    "langevin-halfway": ("#E69F00", "v"),
    "spheres": ("#0072B2", "o"),
    "hmc": ("#CC79A7", "D"),
}
KINDS = {"shift": "T of shifts\n%", "turn": "T of turns\n%", "internal": "T inside\n%"}


def table(runs: Sequence[Stepped], units: Units, title: str = "") -> Table:
    """One line for each method and step, with the friction that came out best."""
    kept = best(runs)
    kinds = [kind for kind in KINDS if any(kind in run.kinds for run in kept)]
    known = any(run.energy_off is not None for run in kept)
    energy = f"<U> off by\n{units.energy}" if known else f"<U>\n{units.energy}"
    headings = [
        "method",
        f"step\n{units.time}",
        f"friction\n1/{units.long_time}",
        f"calls\na {units.long_time}",
        *(KINDS[kind] for kind in kinds),
        energy,
        "calls for a\nsample",
    ]
    notes = numbered(run.note for run in kept)
    rows = []
    for run in kept:
        friction = f"{run.friction * _scale(units):.3g}" if run.friction else ""
        cells = [METHODS[run.method].title, f"{run.step:.4g}", friction]
        cells.append(f"{run.per_time * _scale(units):,.0f}" if run.length else "")
        if run.status != "ok":
            blank = [""] * (len(headings) - 5)
            rows.append([*cells, verdict(run.status, run.status, notes.get(run.note)), *blank])
            continue
        cells += [_percent(run, kind) for kind in kinds]
        cells.append(_pair(*(run.energy_off or run.energy), known))
        cells.append(f"{run.correlation:,.0f}" + (f" [{notes[run.note]}]" if run.note else ""))
        rows.append(cells)
    return Table(headings, rows, title=title, grouped=True)


def _scale(units: Units) -> float:
    return units.long_time_unit / units.time_unit


def _percent(run: Stepped, kind: str) -> str:
    if kind not in run.kinds:
        return ""
    value, error = run.kinds[kind]
    text = f"{100 * value:+.1f} ± {100 * error:.1f}"
    return Marked(text, "yellow") if abs(value) > DOUBT * error else text


def _pair(value: float, error: float, signed: bool) -> str:
    text = f"{value:+.4f} ± {error:.4f}" if signed else f"{value:.4f} ± {error:.4f}"
    return Marked(text, "yellow") if signed and abs(value) > DOUBT * error else text


def explanation(runs: Sequence[Stepped]) -> str:
    """What the columns mean."""
    lines = [
        *footnotes(numbered(run.note for run in best(runs))),
        "calls: evaluations of the expensive forces. T: temperatures of configurations off the one asked for.",
        "calls for a sample: evaluations for one independent sample of the energy.",
    ]
    if any(run.energy_off is not None for run in runs):
        lines.append("<U> off by: less Metropolis sampling, a molecule.")
    lines.append(
        "frictions: those of the least bias beyond three standard errors, then of the fewest calls for a sample."
    )
    return "\n".join(lines)


def figure(runs: Sequence[Stepped], units: Units, title: str = "") -> Figure:
    """Size of the bias against evaluations of the expensive forces, with standard errors as bars."""
    # Runs that were all too short leave an empty diagram.
    kinds = [kind for kind in KINDS if any(kind in run.kinds for run in runs)] or ["shift"]
    panels = [_panel(runs, units, kind) for kind in kinds]
    return draw([panels], (4.2 * len(panels) + 1.5, 4.6), title=title, legend=2)


def _panel(runs: Sequence[Stepped], units: Units, kind: str) -> Panel:
    curves = []
    for name, (colour, marker) in STYLES.items():
        seen = sorted((r for r in best(runs) if r.method == name and kind in r.kinds), key=lambda r: r.per_time)
        if not seen:
            continue
        at = [run.per_time * _scale(units) for run in seen]
        off = [100 * abs(run.kinds[kind][0]) for run in seen]
        style = {"color": colour, "marker": marker, "linewidth": 1.2}
        curves.append(Curve(at, off, METHODS[name].title, style))
        for x, run in zip(at, seen, strict=True):
            value, error = 100 * abs(run.kinds[kind][0]), 100 * run.kinds[kind][1]
            bar = [max(value - error, min(value, 0.1 * error)), value + error]
            curves.append(Curve([x, x], bar, style={"color": colour, "linewidth": 1.0}))
    heading = KINDS[kind].partition("\n")[0]
    return Panel(curves, f"calls of the expensive forces a {units.long_time}", f"{heading} off by / %", plain="xy")


def write(comparison: StepComparison, folder: Path, *, tables: Sequence[str] = ()) -> list[Path]:
    """Put compare.json, compare.png and, if given, the table as text into `folder`; the paths written."""
    picture = figure(comparison.runs, comparison.units, comparison.title)
    return report_files.write(folder, "compare", comparison.to_dict(), picture, tables)
