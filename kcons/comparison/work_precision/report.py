"""What a comparison looks like: a table, a plot, a JSON file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from kcons.comparison.methods.methods import METHODS
from kcons.comparison.study import json_files
from kcons.comparison.study.html_page import PageTable
from kcons.comparison.work_precision.fronts import ARRAYS, EVERY_HOST, Cost, Standing, verdict
from kcons.comparison.work_precision.measurement import Comparison, Measurement, duration

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Colour-blind safe (Okabe and Ito), and a marker each; 6 is matplotlib's upward caret.
STYLES: dict[str, tuple[str, str | int]] = {
    "rattle": ("#0072B2", "o"),
    "ase-kcons": ("#56B4E9", "s"),
    "ase-bonds": ("#D55E00", "^"),
    "ase-internals": ("#CC79A7", "v"),
    "dop853": ("#009E73", "D"),
    "dop853-projected": ("#00593d", 8),
    "extrapolation": ("#1b7837", 9),
    "verlet": ("#333333", 6),
    "ase-verlet": ("#999999", 6),
    # OpenMM: its own in reds, the darker the tighter; kcons in it in blues, its solver in greens.
    "openmm-verlet-1e-4": ("#fcbba1", "<"),
    "openmm-verlet": ("#fb6a4a", "^"),
    "openmm-verlet-1e-6": ("#ef3b2c", ">"),
    "openmm-verlet-1e-8": ("#cb181d", "v"),
    "openmm-verlet-1e-10": ("#99000d", "1"),
    "openmm-verlet-1e-12": ("#67000d", "2"),
    "openmm-middle": ("#fe9929", "x"),
    "openmm-nose-hoover": ("#993404", "+"),
    "openmm-kcons-rattle": ("#9ecae1", "o"),
    "openmm-kcons-suzuki4": ("#6baed6", "P"),
    "openmm-kcons-blanes-moan4": ("#4292c6", "h"),
    "openmm-kcons-kahan-li6": ("#2171b5", "*"),
    "openmm-kcons-blanes-moan6": ("#084594", "p"),
    "openmm-rattle-1e-4": ("#80cdc1", "3"),
    "openmm-rattle-1e-6": ("#35978f", "4"),
    "openmm-rattle": ("#01665e", "d"),
    "openmm-held-rattle": ("#74c476", "s"),
    "openmm-held-blanes-moan6": ("#006d2c", "D"),
    "openmm-free": ("#cccccc", 6),
    # Peers: sweeps in browns, LAMMPS in violets, DAE solvers in greys.
    "shake-1e-4": ("#dfc27d", 4),
    "shake-1e-8": ("#a6611a", 5),
    "lammps-shake-1e-8": ("#9e9ac8", 7),
    "lammps-rattle-1e-8": ("#6a51a3", "x"),
    "mici": ("#f768a1", "2"),
    "dae-radau": ("#525252", "3"),
    "dae-ida": ("#969696", "4"),
}

#: For methods that have no style of their own, in their order.
SPARE: tuple[tuple[str, str | int], ...] = (
    ("#E69F00", "P"),
    ("#A6761D", "X"),
    ("#7570B3", "*"),
    ("#E7298A", "p"),
    ("#66A61E", "h"),
    ("#882255", "d"),
    ("#332288", "H"),
    ("#44AA99", "<"),
    ("#CC6677", ">"),
    ("#999933", "8"),
    ("#117733", "+"),
    ("#6699CC", "1"),
)


def style(name: str) -> tuple[str, str | int]:
    """Colour and marker of a method."""
    if name in STYLES:
        return STYLES[name]
    others = [other for other in METHODS if other not in STYLES]
    return SPARE[others.index(name) % len(SPARE)] if name in others else ("black", "x")


#: What the error is, unless the scene says something else.
ERROR = "root-mean-square distance an atom from the reference"

EXPLANATION = (
    "error: {error_is} at t = {horizon:g} {time}; reference: {how}{good}.",
    "|σ|: largest violation of a held value after the last step, in {length} or rad. "
    "|Av|: largest velocity off the constraints, over v_rms.",
    "slope: linear fit of the total energy, in {energy}/{long_time} a degree of freedom; "
    "in brackets where below twice its standard error.",
    "time, constraints: median wall time of a step and of its constraints. "
    "forces, wall: force evaluations and wall time for one simulated {long_time}.",
    "floor: the first step with nothing held, again and again: what a step costs before any constraint.",
)

#: Characters that all columns take, usually.
WIDTH = 128

#: Columns left out where there is no room for all.
DISPENSABLE = ("max |Av|", "slope", "constraints")


def table(comparison: Comparison, *, narrow: bool = False) -> Table:
    """One line for each method and time step; `narrow` leaves some columns out."""
    units = comparison.scene["units"]
    length, time, energy, long_time = (units[key] for key in ("length", "time", "energy", "long_time"))
    headers = {
        "step": time,
        "error": length,
        "max |σ|": f"{length}, rad",
        "max |Av|": "/v_rms",
        "slope": f"{energy}/{long_time}",
        "time": "a step",
        "constraints": "a step",
        "forces": f"a {long_time}",
        "wall": f"a {long_time}",
    }
    kept = [name for name in headers if not (narrow and name in DISPENSABLE)]
    shown = Table(title=comparison.scene["title"], title_style="bold", box=box.SIMPLE_HEAD, padding=(0, 1))
    shown.add_column("method", no_wrap=True)
    for name in kept:
        shown.add_column(f"{name}\n{headers[name]}", justify="right", no_wrap=True)
    notes = _note_numbers(comparison)
    previous = ""
    for m in comparison.measurements:
        if m.method != previous and previous:
            shown.add_section()
        cells = _cells(m, notes.get(m.note))
        shown.add_row(m.title if m.method != previous else "", *(cells[name] for name in kept))
        previous = m.method
    return shown


def fits(comparison: Comparison, width: int) -> bool:
    """Whether all columns of the table fit into `width` characters."""
    return Console(width=1000).measure(table(comparison)).maximum <= width


def _cells(m: Measurement, note: int | None) -> dict[str, str | Text]:
    slope = "" if m.energy_slope is None else f"{m.energy_slope:.1e}"
    if m.energy_slope is not None and abs(m.energy_slope) < 2 * (m.energy_slope_error or 0.0):
        slope = f"({slope})"
    setting = "" if m.setting == 0 else f"rtol {m.setting:.0e}" if m.adaptive else f"{m.setting:.4g}"
    return {
        "step": setting,
        "error": _verdict(m, note),
        "max |σ|": "" if m.constraint_residual is None else f"{m.constraint_residual:.0e}",
        "max |Av|": "" if m.velocity_residual is None else f"{m.velocity_residual:.0e}",
        "slope": slope,
        "time": "" if m.step_seconds is None else duration(m.step_seconds),
        "constraints": "" if m.constraint_seconds is None or m.status == "floor" else duration(m.constraint_seconds),
        "forces": "" if m.evaluations_per_time is None else _count(m.evaluations_per_time),
        "wall": "" if m.seconds_per_time is None else duration(m.seconds_per_time),
    }


def _verdict(m: Measurement, note: int | None) -> str | Text:
    """The error, or in a word why there is none and which note tells more."""
    if m.status == "ok":
        return "" if m.error is None else f"{m.error:.2e}"
    if m.status in ("floor", "thermostat"):
        return "-"
    word = f"{m.steps} step{'s' if m.steps > 1 else ''} only" if m.status == "partial" and m.steps else m.status
    return Text(f"{word} [{note}]" if note else word, style="red" if m.status == "failed" else "yellow")


def _count(number: float) -> str:
    return f"{number:,.0f}" if number >= 100 else f"{number:.3g}"


def _note_numbers(comparison: Comparison) -> dict[str, int]:
    """Notes in the order of their first appearance, numbered from 1."""
    return {note: k for k, note in enumerate(dict.fromkeys(m.note for m in comparison.measurements if m.note), 1)}


def explanation(comparison: Comparison) -> str:
    """What the columns mean, and the orders that were observed."""
    units = comparison.scene["units"]
    error = comparison.reference["error"]
    known = {
        "horizon": comparison.scene["horizon"],
        "how": comparison.reference["how"],
        "error_is": comparison.scene.get("error", ERROR),
        "good": f", good to {error:.0e} {units['length']}" if error else "",
        **units,
    }
    lines = [*(line.format(**known) for line in EXPLANATION), *comparison.remarks]
    lines[:0] = [f"[{number}] {note}" for note, number in _note_numbers(comparison).items()]
    orders = []
    for name, title in {m.method: m.title for m in comparison.measurements}.items():
        order = comparison.observed_order(name)
        if order is not None:
            orders.append(f"{title} {order:.2f}")
    if orders:
        lines.append("observed order (error ∝ stepᵖ at the finest steps): " + ", ".join(orders))
    return "\n".join(lines)


def plot(comparison: Comparison, path: Path) -> None:
    """`figure` as a PNG file."""
    figure(comparison).savefig(path, dpi=150)


def figure(comparison: Comparison) -> Figure:
    """Error against force evaluations and against wall time, all axes logarithmic, the fronts of each host marked."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    units = comparison.scene["units"]
    names = len({m.method for m in comparison.measurements})
    figure = Figure(figsize=(11, 5.0 + 0.22 * math.ceil(max(names, 3) / 3)), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, cost in ((left, "evaluations_per_time"), (right, "seconds_per_time")):
        for name in dict.fromkeys(m.method for m in comparison.measurements):
            colour, marker = style(name)
            done = [m for m in comparison.of(name) if m.error and math.isfinite(m.error) and getattr(m, cost)]
            if done:
                axes.plot(
                    [getattr(m, cost) for m in done],
                    [m.error for m in done],
                    color=colour,
                    marker=marker,
                    # Where two methods do the same, both stay visible.
                    markerfacecolor="none" if name != "rattle" else colour,
                    markersize=6 if name == "rattle" else 9,
                    markeredgewidth=1.6,
                    label=done[0].title,
                )
        if _reference_in_sight(comparison):
            axes.axhline(comparison.reference["error"], color="black", linewidth=0.8, linestyle=":")
    standings = verdict(comparison).standings
    _mark_fronts(left, standings, "evaluations")
    _mark_fronts(right, standings, "wall")
    _mark_costs_without_error(right, comparison)
    for axes in (left, right):
        if not standings:
            axes.text(0.5, 0.5, "no method reached the horizon", transform=axes.transAxes, ha="center")
            if not any(len(line.get_xdata()) for line in axes.lines):
                axes.set_xlim(1.0, 1000.0)
            axes.set_ylim(1e-6, 1.0)
        axes.set(xscale="log", yscale="log")
        low, high = axes.get_xlim()
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 2e3 * low else (1.0,)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    left.set_xlabel(f"force evaluations per simulated {units['long_time']}")
    right.set_xlabel(f"wall time per simulated {units['long_time']} / s")
    left.set_ylabel(f"rms error an atom at {comparison.scene['horizon']:g} {units['time']} / {units['length']}")
    for axes in (left, right):
        axes.grid(True, which="major", linewidth=0.5, alpha=0.5)
    if _reference_in_sight(comparison):
        left.text(
            0.02,
            comparison.reference["error"],
            "error of the reference",
            transform=left.get_yaxis_transform(),
            fontsize=8,
            va="bottom",
        )
    handles, labels = right.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    environment = comparison.environment
    figure.suptitle(comparison.scene["title"], fontsize=11)
    right.set_title(f"{environment['cpu']}, 1 thread; {environment['date']}", fontsize=8, loc="right")
    return figure


#: Bands behind the curves, one a host.
FRONT_STYLES = {ARRAYS: "#999999", "ASE": "#D9B38C", "OpenMM": "#B3A2C7"}


def _mark_fronts(axes: Axes, standings: Sequence[Standing], cost: Cost) -> None:
    """A broad pale band through the points that no other of the same host dominates."""
    from kcons.comparison.work_precision.fronts import cost_of

    for standing in standings:
        if standing.cost != cost or standing.host == EVERY_HOST or not standing.front:
            continue
        axes.plot(
            [cost_of(m, cost) for m in standing.front],
            [float(m.error or 0.0) for m in standing.front],
            color=FRONT_STYLES.get(standing.host, "#999999"),
            linewidth=9,
            alpha=0.45,
            zorder=0,
            solid_capstyle="round",
            marker="o",
            markersize=8,
            markeredgewidth=0,
            label=f"front, {standing.host}",
        )


def _reference_in_sight(comparison: Comparison) -> bool:
    """Whether any error comes near that of the reference; far below them a line would only squeeze the curves."""
    errors = [m.error for m in comparison.measurements if m.error and math.isfinite(m.error)]
    return bool(errors) and 0 < min(errors) < 100 * float(comparison.reference["error"])


def _mark_costs_without_error(axes: Axes, comparison: Comparison) -> None:
    """Floors: ticks along the lower edge, one a time step. Methods stopped for the budget: a vertical line.

    Runs that failed: crosses along the upper edge, at the cost they had until then.
    """
    for name in dict.fromkeys(m.method for m in comparison.measurements):
        colour, marker = style(name)
        floors = [m for m in comparison.of(name, "floor") if m.seconds_per_time]
        if floors:
            axes.plot(
                [float(m.seconds_per_time or 0.0) for m in floors],
                [0.03] * len(floors),
                transform=axes.get_xaxis_transform(),
                linestyle="none",
                marker=marker,
                color=colour,
                markersize=7,
                label=f"{floors[0].title} (cost only)",
            )
        for m in comparison.of(name, "partial")[:1]:
            if m.seconds_per_time:
                label = f"{m.title} (stopped for the budget, cost only)"
                axes.axvline(m.seconds_per_time, color=colour, linestyle="--", linewidth=1.2, label=label)
        failed = comparison.of(name, "failed")
        if failed:
            known = [float(m.seconds_per_time) for m in failed if m.seconds_per_time]
            axes.plot(
                known,
                [0.97] * len(known),
                transform=axes.get_xaxis_transform(),
                linestyle="none",
                marker="x",
                color=colour,
                markersize=8,
                markeredgewidth=2,
                label=f"{failed[0].title} (failed at {len(failed)} of its settings)",
            )


def write(comparison: Comparison, folder: Path, *, tables: Sequence[str] = ()) -> list[Path]:
    """Put compare.json, compare.png and, if given, the table as text into `folder`; the paths written."""
    folder.mkdir(parents=True, exist_ok=True)
    data, picture, text = folder / "compare.json", folder / "compare.png", folder / "compare.txt"
    json_files.write(data, comparison.to_dict())
    plot(comparison, picture)
    written = [data, picture]
    if tables:
        text.write_text("\n".join(tables) + "\n", encoding="utf-8")
        written.append(text)
    return written


def page_table(comparison: Comparison) -> PageTable:
    """All measurements as a table of a page: those on a front are good rows, those that failed bad ones."""
    units = comparison.scene["units"]
    rank = max(int(comparison.scene["rank"]), 1)
    headings = [
        *("method", f"step / {units['time']}", f"error / {units['length']}", "on the front of"),
        *("max |σ|", "max |Av|", f"slope / {units['energy']}/{units['long_time']}"),
        *("time a step", "constraints a step", "a constraint", f"forces a {units['long_time']}"),
        *(f"wall a {units['long_time']}", "what happened"),
    ]
    on_front: dict[int, list[str]] = {}
    for standing in verdict(comparison).standings:
        for m in standing.front if standing.host != EVERY_HOST else ():
            on_front.setdefault(id(m), []).append("wall" if standing.cost == "wall" else "forces")
    rows, marks = [], []
    for m in comparison.measurements:
        cells = {name: str(cell) for name, cell in _cells(m, None).items()}
        each = m.constraint_seconds / rank if m.constraint_seconds is not None and m.status != "floor" else None
        front = on_front.get(id(m), [])
        rows.append(
            [
                *(m.title, cells["step"], cells["error"], ", ".join(dict.fromkeys(front))),
                *(cells["max |σ|"], cells["max |Av|"], cells["slope"], cells["time"], cells["constraints"]),
                *("" if each is None else duration(each), cells["forces"], cells["wall"], m.note),
            ]
        )
        marks.append("good" if front else "bad" if m.status == "failed" else "")
    return PageTable(headings, rows, text_columns=(0, 3, len(headings) - 1), marks=marks)
