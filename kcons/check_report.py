"""What a check of a trajectory looks like: a table, a plot, a JSON file."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from kcons.mdanalysis.result import CheckResult

COLOURS = {"kept": "green", "tolerated": "green", "violated": "red"}
#: Ticks on the axis of frames are numbers of frames where times say nothing.
_NO_TIMES = "frame"


def summary(result: CheckResult) -> str:
    """What was looked at, and what the file can show."""
    frames = f"{len(result.frames)} of {result.n_frames_in_file} frames"
    lines = [
        f"{result.trajectory}: {frames}, {result.n_atoms} atoms; {result.n_rows} rows on {result.n_constrained} atoms",
        f"{result.precision}; targets: {result.targets}; tolerance {result.tolerance:g}",
    ]
    if result.rank is not None:
        lines.append(f"rank {result.rank}, {result.degrees_of_freedom} degrees of freedom")
    if result.temperature is not None:
        t = result.temperature
        lines[-1] += f", {t['mean']:.2f} ± {t['deviation']:.2f} K (mean and standard deviation of frames)"
        if t["slope"] == t["slope"]:
            lines[-1] += f", drift {1000 * t['slope']:.2g} ± {1000 * t['slope_error']:.1g} K/ns"
    lines += result.remarks
    if result.broken is not None:
        lines.append(f"the file ends too early, at frame {result.broken.frame}: {result.broken.reason}")
    return "\n".join(lines)


def verdict(result: CheckResult) -> Text:
    """The verdict, in colour."""
    return Text(result.verdict, style=f"bold {COLOURS[result.status]}")


def unit_table(result: CheckResult) -> Table:
    """One line for lengths, one for angles."""
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1))
    headers = ("rows", "largest", "rms", "rms of rounding", "mean", "largest mean\nof a row", "drift of rms\na ns")
    rates = any(unit.rate_rms is not None for unit in result.units)
    shown.add_column("unit")
    for header in (*headers, *(("largest |Av|\na ps", "rms |Av|\na ps") if rates else ())):
        shown.add_column(header, justify="right")
    for unit in result.units:
        drift = ""
        if unit.drift is not None:
            drift = f"{1000 * unit.drift.slope:.1e}"
            drift = drift if unit.drift.significant else f"({drift})"
        cells = [
            unit.unit,
            str(unit.n_rows),
            f"{unit.largest:.2e}",
            f"{unit.rms:.2e}",
            f"{unit.rounding_rms:.2e}",
            f"{unit.mean:.1e}",
            f"{unit.largest_mean:.1e}",
            drift,
        ]
        if rates:
            cells += ["" if r is None else f"{r:.1e}" for r in (unit.rate_largest, unit.rate_rms)]
        shown.add_row(*cells)
    return shown


def row_table(result: CheckResult) -> Table:
    """The worst rows."""
    shown = Table(title="worst rows", title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1))
    shown.add_column("row", justify="right")
    shown.add_column("what")
    for header in ("target", "largest", "allowed", "mean", "frame"):
        shown.add_column(header, justify="right")
    for row in result.worst:
        shown.add_row(
            str(row.row),
            row.name,
            f"{row.target:.4f} {row.unit}",
            Text(f"{row.largest:.2e}", style="red" if row.largest > row.allowed else ""),
            f"{row.allowed:.2e}",
            f"{row.mean:.1e}",
            "" if row.frame is None else str(row.frame),
        )
    return shown


def plot(result: CheckResult, path: Path) -> None:
    """Largest and root mean square deviation along the trajectory, and the temperature, as a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = len(result.units) + (result.temperature is not None)
    figure = Figure(figsize=(9, 2.4 + 2.2 * panels), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(panels, 1, sharex=True, squeeze=False)[:, 0]
    timed = len(set(result.times)) == len(result.times)
    x = result.times if timed else [float(frame) for frame in result.frames]
    for axes, unit in zip(grid, result.units, strict=False):
        largest, rms = (result.series[f"{name} {unit.unit}"] for name in ("largest", "rms"))
        axes.plot(x, largest, color="#D55E00", linewidth=1.0, marker="." if len(x) < 60 else "", label="largest")
        axes.plot(x, rms, color="#0072B2", linewidth=1.0, marker="." if len(x) < 60 else "", label="rms")
        axes.axhline(unit.bound, color="black", linestyle=":", linewidth=1.0, label="rounding of the file, at most")
        if min((value for value in (*largest, *rms) if value > 0), default=1.0) > 0:
            axes.set_yscale("log" if any(value > 0 for value in largest) else "linear")
        axes.set_ylabel(f"deviation / {unit.unit}")
        axes.legend(fontsize=8, loc="best")
    if result.temperature is not None:
        grid[-1].plot(x, result.series["temperature K"], color="#009E73", linewidth=1.0)
        grid[-1].set_ylabel("temperature / K")
    if result.broken is not None and x:
        for axes in grid:
            axes.axvline(x[-1], color="#999999", linestyle="--", linewidth=1.0)
    grid[-1].set_xlabel("time / ps" if timed else _NO_TIMES)
    figure.suptitle(f"{Path(result.trajectory).name}: {result.n_rows} rows, {result.status}", fontsize=11)
    figure.savefig(path, dpi=150)


def write(result: CheckResult, folder: Path, *, tables: Sequence[str] = ()) -> list[Path]:
    """Put check.json, check.png and, if given, the tables as text into `folder`; the paths written."""
    folder.mkdir(parents=True, exist_ok=True)
    data, picture, text = folder / "check.json", folder / "check.png", folder / "check.txt"
    data.write_text(
        json.dumps(_finite(result.to_dict()), indent=1, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8"
    )
    plot(result, picture)
    written = [data, picture]
    if tables:
        text.write_text("\n".join(tables) + "\n", encoding="utf-8")
        written.append(text)
    return written


def _finite(value: Any) -> Any:
    """JSON has no NaN: it becomes null."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
