"""What a check of a trajectory looks like: a table, a plot, a JSON file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from kcons.steppers.files import ResultFolder, write_files
from kcons.steppers.files import text as as_json

if TYPE_CHECKING:
    from kcons.mdanalysis.check.result import CheckResult

COLORS = {"kept": "green", "tolerated": "green", "violated": "red", "incomplete": "yellow"}
#: What `write` writes: data, picture, page.
FILES = ("check.json", "check.png", "check.txt")
#: Deviations that are this part of the largest, or less, are not drawn.
_NOTHING = 1e-6


def page(result: CheckResult) -> tuple[str, Table, Table, Text]:
    """What a person reads: what was looked at and what the file can show, units, worst rows, the verdict."""
    frames = f"{len(result.frames)} of {result.n_frames_in_file} frames"
    lines = [
        f"{result.trajectory}: {frames}, {result.n_atoms} atoms; {result.n_rows} rows on {result.n_constrained} atoms",
        f"{result.precision}; targets: {result.targets}; tolerance {result.tolerance:g}",
    ]
    if result.rank is not None:
        g = result.degrees_of_freedom
        lines.append(f"rank {result.rank}" + ("" if g is None else f", {g} degrees of freedom"))
    if result.temperature is not None:
        t = result.temperature
        lines[-1] += f", {t['mean']:.2f} ± {t['deviation']:.2f} K (mean and standard deviation of frames)"
        if t["slope"] == t["slope"]:
            lines[-1] += f", drift {1000 * t['slope']:.2g} ± {1000 * t['slope_error']:.1g} K/ns"
    summary = "\n".join(lines + result.remarks + result.gaps)
    return summary, _units(result), _rows(result), Text(result.verdict, style=f"bold {COLORS[result.status]}")


def _table(headers: Sequence[str], rows: Iterable[Sequence[str | Text]], **options: Any) -> Table:
    """Words to the left, numbers to the right; where there is no room, cells are folded and not cut."""
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1), collapse_padding=True, **options)
    for header in headers:
        shown.add_column(header, justify="left" if header[:4] in ("unit", "what") else "right", overflow="fold")
    for row in rows:
        shown.add_row(*row)
    return shown


def _units(result: CheckResult) -> Table:
    """One line for lengths, one for angles."""
    headers = ["unit", "rows", "largest", "rms", "rms of\nrounding", "mean", "largest mean\nof a row"]
    headers.append("drift of rms\nper ns")
    rates = any(unit.rate_rms is not None for unit in result.units)
    if rates:
        headers += ["largest |Av|\nper ps", "rms |Av|\nper ps"]
    rows = []
    for unit in result.units:
        drift = ""
        if unit.drift is not None and unit.drift_error is not None:  # in parentheses where it may be none
            drift = f"{1000 * unit.drift:.1e}"
            drift = drift if abs(unit.drift) > 3 * unit.drift_error else f"({drift})"
        cells = [unit.unit, str(unit.n_rows), f"{unit.largest:.2e}", f"{unit.rms:.2e}", f"{unit.rounding_rms:.2e}"]
        cells += [f"{unit.mean:.1e}", f"{unit.largest_mean:.1e}", drift]
        if rates:
            cells += ["" if r is None else f"{r:.1e}" for r in (unit.rate_largest, unit.rate_rms)]
        rows.append(cells)
    return _table(headers, rows)


def _rows(result: CheckResult) -> Table:
    """The worst rows."""
    rows: list[list[str | Text]] = []
    for row in result.worst:
        largest = Text(f"{row.largest:.2e}", style="red" if row.largest > row.allowed else "")
        target, means = f"{row.target:.4f} {row.unit}", (f"{row.allowed:.2e}", f"{row.mean:.1e}")
        what = f"{row.name} ({', '.join(map(str, row.atoms[:4]))})"
        rows.append([str(row.row), what, target, largest, *means, "" if row.frame is None else str(row.frame)])
    headers = ["row", "what (atoms from 0)", "target", "largest", "allowed", "mean", "frame"]
    return _table(headers, rows, title="worst rows", title_justify="left")


def plot(result: CheckResult, path: Path | IO[bytes]) -> None:
    """Deviations along the trajectory beside what rounding and the tolerance allow, and the temperature, as PNG."""
    from matplotlib.figure import Figure

    panels = len(result.units) + (result.temperature is not None)
    figure = Figure(figsize=(9, 2.4 + 2.2 * panels), layout="constrained")
    grid = figure.subplots(panels, 1, sharex=True, squeeze=False)[:, 0]
    timed = len(set(result.times)) == len(result.times)
    x = result.times if timed else [float(frame) for frame in result.frames]
    for axes, unit in zip(grid, result.units, strict=False):
        largest, rms, rounding = (np.array(result.series[f"{k} {unit.unit}"]) for k in ("largest", "rms", "rounding"))
        if (largest > 0).any():
            axes.set_yscale("log")
        # The frame that gives targets is off by 0, or by the rounding of this program: no point of such a line.
        for color, label, values in (("#D55E00", "largest", largest), ("#0072B2", "rms", rms)):
            shown = np.where(values > _NOTHING * largest.max(), values, np.nan)
            axes.plot(x, shown, color=color, linewidth=1.0, marker="." * (len(x) < 60), label=label)
        # Rounding of the targets comes to that of each frame.
        allowed = rounding + unit.bound - rounding.max()
        lines = [("black", ":", allowed, "rounding of the file, at most")]
        if unit.tolerance > 0:
            lines.append(("#555555", "--", allowed + unit.tolerance, f"rounding and tolerance of {result.tolerance:g}"))
        for color, style, level, label in lines:
            line = axes.axhline(level[0]) if len(x) < 2 else axes.plot(x, level)[0]
            line.set(color=color, linestyle=style, linewidth=1.0, label=label)
        axes.set_ylabel(f"deviation / {unit.unit}")
        axes.legend(fontsize=8, loc="best")
    if result.temperature is not None:
        grid[-1].plot(x, result.series["temperature K"], color="#009E73", linewidth=1.0)
        grid[-1].set_ylabel("temperature / K")
    for axes in grid if result.broken is not None and x else ():
        axes.axvline(x[-1], color="#999999", linestyle="--", linewidth=1.0)
    grid[-1].set_xlabel("time / ps" if timed else "frame")
    figure.suptitle(f"{Path(result.trajectory).name}: {result.n_rows} rows, {result.status}", fontsize=11)
    figure.savefig(path, dpi=150, format="png")


def results(folder: Path, trajectory: str | Path) -> ResultFolder:
    """The folder of the check of a trajectory."""
    return ResultFolder(folder, FILES[0], {"file": str(Path(trajectory).resolve())}, FILES, "a check")


def write(
    folder: Path, trajectory: str | Path, data: dict[str, Any], picture: bytes = b"", text: str = ""
) -> list[Path]:
    """Write what there is, and take away what an earlier check of the same trajectory left; the paths written."""
    place = results(folder, trajectory)
    # Names of files need not be text; in JSON the replacement is what stands for such a character.
    whole = f"{as_json({**place.owner, **data})}\n".encode(errors="backslashreplace")
    page = f"{text}\n".encode(errors="replace") if text else b""
    contents = dict(zip(FILES, (whole, picture, page), strict=True))
    with place.taken():
        for name in [name for name in FILES if not contents[name]]:
            (folder / name).unlink(missing_ok=True)
        return write_files(folder, {name: content for name, content in contents.items() if content})
