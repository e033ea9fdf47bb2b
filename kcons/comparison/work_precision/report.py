"""What a comparison looks like: a table, a plot, a JSON file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from kcons.comparison.methods.methods import METHODS
from kcons.comparison.study import report_files
from kcons.comparison.study.curves import Curve, Panel, draw, say
from kcons.comparison.study.machine import processor_of
from kcons.comparison.study.tables import Table, duration, footnotes, numbered, verdict
from kcons.comparison.work_precision.chosen_curves import MOST, Chosen, chosen
from kcons.comparison.work_precision.fronts import ARRAYS, EVERY_MD_ENGINE, Cost, Standing, cost_of
from kcons.comparison.work_precision.fronts import verdict as judge
from kcons.comparison.work_precision.measurement import Comparison, Measurement

if TYPE_CHECKING:
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
    "multistep": ("#5aae61", 11),
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


#: What the error is, unless the test system says something else.
ERROR = "root-mean-square distance an atom from the reference"

EXPLANATION = (
    "error: {error_is} at t = {horizon:g} {time}; reference: {how}{good}.",
    "|σ|: largest violation of a held value after the last step, in {length} or rad. "
    "|Av|: largest velocity off the constraints, over v_rms.",
    "slope: linear fit of the total energy, in {energy}/{long_time} a degree of freedom; "
    "in brackets where below twice its standard error.",
    "time, constraints: median wall time of a step and of its constraints. "
    "forces, wall: force evaluations and wall time for one simulated {long_time}.",
    "baseline: the first step with nothing held, again and again: what a step costs before any constraint.",
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
        "error": comparison.error_unit,
        "max |σ|": f"{length}, rad",
        "max |Av|": "/v_rms",
        "slope": f"{energy}/{long_time}",
        "time": "a step",
        "constraints": "a step",
        "forces": f"a {long_time}",
        "wall": f"a {long_time}",
    }
    kept = [name for name in headers if not (narrow and name in DISPENSABLE)]
    notes = numbered(m.note for m in comparison.measurements)
    rows = []
    for m in comparison.measurements:
        cells = _cells(m, notes.get(m.note))
        rows.append([m.title, *(cells[name] for name in kept)])
    headings = ["method", *(f"{name}\n{headers[name]}" for name in kept)]
    return Table(headings, rows, title=comparison.scene["title"], grouped=True)


def fits(comparison: Comparison, width: int) -> bool:
    """Whether all columns of the table fit into `width` characters."""
    return Console(width=1000).measure(table(comparison)).maximum <= width


def _cells(m: Measurement, note: int | None) -> dict[str, str]:
    slope = "" if m.energy_slope is None else f"{m.energy_slope:.1e}"
    if m.energy_slope is not None and abs(m.energy_slope) < 2 * (m.energy_slope_error or 0.0):
        slope = f"({slope})"
    setting = "" if m.setting == 0 else f"rtol {m.setting:.0e}" if m.adaptive else f"{m.setting:.4g}"
    return {
        "step": setting,
        "error": _error(m, note),
        "max |σ|": "" if m.constraint_residual is None else f"{m.constraint_residual:.0e}",
        "max |Av|": "" if m.velocity_residual is None else f"{m.velocity_residual:.0e}",
        "slope": slope,
        "time": "" if m.step_seconds is None else duration(m.step_seconds),
        "constraints": "" if m.constraint_seconds is None or m.status == "baseline" else duration(m.constraint_seconds),
        "forces": "" if m.evaluations_per_time is None else _count(m.evaluations_per_time),
        "wall": "" if m.seconds_per_time is None else duration(m.seconds_per_time),
    }


def _error(m: Measurement, note: int | None) -> str:
    """The error, or in a word why there is none and which note tells more."""
    if m.status == "ok":
        return "" if m.error is None else f"{m.error:.2e}"
    if m.status in ("baseline", "thermostat"):
        return "-"
    word = f"{m.steps} step{'s' if m.steps > 1 else ''} only" if m.status == "partial" and m.steps else m.status
    return verdict(m.status, word, note)


def _count(number: float) -> str:
    return f"{number:,.0f}" if number >= 100 else f"{number:.3g}"


def explanation(comparison: Comparison) -> str:
    """What the columns mean, and the orders that were observed."""
    units = comparison.scene["units"]
    error = comparison.reference["error"]
    known = {
        "horizon": comparison.scene["horizon"],
        "how": comparison.reference["how"],
        "error_is": comparison.scene.get("error", ERROR),
        "good": f", good to {error:.0e} {comparison.error_unit}" if error else "",
        **units,
    }
    lines = [*(line.format(**known) for line in EXPLANATION), *comparison.remarks]
    lines[:0] = footnotes(numbered(m.note for m in comparison.measurements))
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


def figure(comparison: Comparison, most: int = MOST) -> Figure:
    """Error against force evaluations and wall time, all axes logarithmic, the fronts of each MD engine marked.

    At most so many curves are shown; methods that coincide are one.
    """
    units, environment = comparison.scene["units"], comparison.environment
    standings = judge(comparison).standings
    shown = chosen(comparison, most)
    what = comparison.scene.get("error", "rms error an atom")
    grid = {"which": "major", "linewidth": 0.5, "alpha": 0.5}
    left = Panel(
        _errors(comparison, shown, standings, "evaluations"),
        f"force evaluations per simulated {units['long_time']}",
        f"{what} at {comparison.scene['horizon']:g} {units['time']} / {comparison.error_unit}",
        plain="x",
        grid=grid,
    )
    right = Panel(
        [*_errors(comparison, shown, standings, "wall"), *_costs_without_error(comparison)],
        f"wall time per simulated {units['long_time']} / s",
        notes=("", f"{processor_of(environment)}, 1 thread; {environment['date']}"),
        plain="x",
        grid=grid,
        direct=True,
    )
    size = (12, 5.4)
    drawn = draw([[left, right]], size, title=comparison.scene["title"], same_y=True, legend=3)
    for axes in drawn.axes if not standings else ():
        say(axes, "no method reached the horizon")
        if not any(np.size(line.get_xdata()) for line in axes.lines):
            axes.set_xlim(1.0, 1000.0)
        axes.set_ylim(1e-6, 1.0)
    if _reference_in_sight(comparison):
        axes, words = drawn.axes[0], "error of the reference"
        at = comparison.reference["error"]
        axes.text(0.02, at, words, transform=axes.get_yaxis_transform(), fontsize=8, va="bottom")
    return drawn


#: Bands behind the curves, one an MD engine.
FRONT_STYLES = {ARRAYS: "#999999", "ASE": "#D9B38C", "OpenMM": "#B3A2C7"}
BAND: Mapping[str, Any] = {
    "linewidth": 9,
    "alpha": 0.45,
    "zorder": 0,
    "solid_capstyle": "round",
    "marker": "o",
    "markersize": 8,
}


def _errors(comparison: Comparison, shown: Sequence[Chosen], standings: Sequence[Standing], cost: Cost) -> list[Curve]:
    """Error against a cost: a curve for each method, and a broad pale band along the front of each MD engine."""
    found = []
    for curve in shown:
        colour, marker = style(curve.method)
        done = [m for m in curve.points if cost_of(m, cost) > 0]
        if done:
            # Where two methods do nearly the same, both stay visible.
            plain = curve.method == "rattle"
            face, size = (colour, 6) if plain else ("none", 9)
            look: dict[str, Any] = {"color": colour, "marker": marker, "markerfacecolor": face, "markersize": size}
            found.append(_curve(done, cost, curve.name, {**look, "markeredgewidth": 1.6}))
    if _reference_in_sight(comparison):
        at = comparison.reference["error"]
        found.append(Curve([0, 1], [at, at], style={"color": "black", "linewidth": 0.8, "linestyle": ":"}, along="y"))
    for standing in standings:
        if standing.cost == cost and standing.md_engine != EVERY_MD_ENGINE and standing.front:
            look = {**BAND, "color": FRONT_STYLES.get(standing.md_engine, "#999999"), "markeredgewidth": 0}
            found.append(_curve(standing.front, cost, f"front, {standing.md_engine}", look))
    return found


def _curve(done: Sequence[Measurement], cost: Cost, label: str, look: Mapping[str, Any]) -> Curve:
    return Curve([cost_of(m, cost) for m in done], [float(m.error or 0.0) for m in done], label, look)


def _reference_in_sight(comparison: Comparison) -> bool:
    """Whether any error comes near that of the reference; far below them a line would only squeeze the curves."""
    errors = [m.error for m in comparison.measurements if m.error and math.isfinite(m.error)]
    return bool(errors) and 0 < min(errors) < 100 * float(comparison.reference["error"])


def _costs_without_error(comparison: Comparison) -> list[Curve]:
    """Baselines: ticks along the lower edge, one a time step. Methods stopped for the budget: a vertical line.

    Runs that failed: crosses along the upper edge, at the cost they had until then.
    """
    found = []

    def mark(measured: Sequence[Measurement], height: float, label: str, **look: Any) -> None:
        at = [float(m.seconds_per_time) for m in measured if m.seconds_per_time]
        look = {"linestyle": "none", "color": style(measured[0].method)[0], **look}
        found.append(Curve(at, [height] * len(at), f"{measured[0].title} ({label})", look, along="x"))

    for name in dict.fromkeys(m.method for m in comparison.measurements):
        colour, marker = style(name)
        baselines = [m for m in comparison.of(name, "baseline") if m.seconds_per_time]
        if baselines:
            mark(baselines, 0.03, "cost only", marker=marker, markersize=7)
        for m in comparison.of(name, "partial")[:1]:
            if m.seconds_per_time:
                label = f"{m.title} (stopped for the budget, cost only)"
                look = {"color": colour, "linestyle": "--", "linewidth": 1.2}
                found.append(Curve([m.seconds_per_time] * 2, [0, 1], label, look, along="x"))
        failed = comparison.of(name, "failed")
        if failed:
            label = f"failed at {len(failed)} of its settings"
            mark(failed, 0.97, label, marker="x", markersize=8, markeredgewidth=2)
    return found


def write(comparison: Comparison, folder: Path, *, tables: Sequence[str] = ()) -> list[Path]:
    """Put compare.json, compare.png and, if given, the table as text into `folder`; the paths written."""
    return report_files.write(folder, "compare", comparison.to_dict(), figure(comparison), tables)


def page_table(comparison: Comparison) -> Table:
    """All measurements as a table of a page: those on a front are good rows, those that failed bad ones."""
    units = comparison.scene["units"]
    rank = max(int(comparison.scene["rank"]), 1)
    headings = [
        *("method", f"step / {units['time']}", f"error / {comparison.error_unit}", "on the front of"),
        *("max |σ|", "max |Av|", f"slope / {units['energy']}/{units['long_time']}"),
        *("time a step", "constraints a step", "a constraint", f"forces a {units['long_time']}"),
        *(f"wall a {units['long_time']}", "what happened"),
    ]
    on_front: dict[int, list[str]] = {}
    for standing in judge(comparison).standings:
        for m in standing.front if standing.md_engine != EVERY_MD_ENGINE else ():
            on_front.setdefault(id(m), []).append("wall" if standing.cost == "wall" else "forces")
    rows, marks = [], []
    for m in comparison.measurements:
        cells = _cells(m, None)
        each = m.constraint_seconds / rank if m.constraint_seconds is not None and m.status != "baseline" else None
        front = on_front.get(id(m), [])
        rows.append(
            [
                *(m.title, cells["step"], cells["error"], ", ".join(dict.fromkeys(front))),
                *(cells["max |σ|"], cells["max |Av|"], cells["slope"], cells["time"], cells["constraints"]),
                *("" if each is None else duration(each), cells["forces"], cells["wall"], m.note),
            ]
        )
        marks.append("good" if front else "bad" if m.status == "failed" else "")
    return Table(headings, rows, words=(0, 3, len(headings) - 1), marks=marks)
