"""What a scan looks like: a table, a plot, and files."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ase.io
import numpy as np
from ase import units
from rich import box
from rich.console import Console
from rich.table import Table

from kcons import __version__
from kcons.free_energy.scans.grid import Point
from kcons.free_energy.scans.relaxed_scan import Scan
from kcons.steppers.files import in_one_piece, text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: One eV in kJ/mol.
KJ = units.mol / units.kJ


def _rows(scan: Scan) -> list[tuple[Point, list[float], float, float, int, float]]:
    """Of each point its values, energy and hysteresis in kJ/mol, calls, and the force left in eV/angstrom."""
    energy = (scan.energies - _lowest(scan)) * KJ
    spread = scan.hysteresis * KJ
    calls = dict.fromkeys(scan.grid.points, 0)
    for attempt in scan.attempts:
        calls[attempt.point] += attempt.evaluations
    left = {point: attempt.largest for point, attempt in scan.best.items()}
    return [
        (p, scan.grid.shown(p), float(energy[p]), float(spread[p]), calls[p], left.get(p, float("nan")))
        for p in scan.grid.points
    ]


def _lowest(scan: Scan) -> float:
    return float(np.nanmin(scan.energies)) if scan.best else float("nan")


def summary(scan: Scan) -> str:
    """What was done, and what failed."""
    lines = [
        f"{len(scan.best)} of {len(scan.grid.points)} points, {len(scan.attempts)} relaxations, "
        f"{scan.evaluations} calls of energy and forces; lowest energy {_lowest(scan):.6f} eV"
    ]
    spread = scan.hysteresis
    if scan.best and np.nanmax(spread) * KJ >= 0.1:
        worst = tuple(int(n) for n in np.unravel_index(np.nanargmax(spread), spread.shape))
        lines.append(
            f"from different neighbours the energy differs by up to {spread[worst] * KJ:.2f} kJ/mol, at "
            f"{scan.grid.said(worst)}; the lower one is kept"
        )
    lines += [f"failed: {why}" for why in scan.failed.values()]
    return "\n".join(lines)


class _Shown(Table):
    """A table that `print` shows as a terminal does."""

    def __str__(self) -> str:
        page = io.StringIO()
        Console(file=page, width=200, color_system=None).print(self)
        return page.getvalue().rstrip()


def table(scan: Scan) -> Table:
    """A row a point; energies above the lowest one. Print it."""
    shown = _Shown(box=box.SIMPLE_HEAD, padding=(0, 1))
    for name, unit in zip(scan.grid.names, scan.grid.units, strict=True):
        shown.add_column(f"{name}\n{unit}", justify="right")
    for heading in ("energy\nkJ/mol", "hysteresis\nkJ/mol", "calls\n", "force left\neV/angstrom"):
        shown.add_column(heading, justify="right")
    for point, values, energy, spread, calls, left in _rows(scan):
        cells = [f"{v:.2f}" if turn else f"{v:.4f}" for v, turn in zip(values, scan.grid.in_degrees, strict=True)]
        cells += [f"{energy:.3f}", f"{spread:.3f}"] if point in scan.best else ["failed", ""]
        shown.add_row(*cells, str(calls), f"{left:.4f}" if point in scan.best else "")
    return shown


def plot(scan: Scan) -> Figure:
    """Energy along one coordinate, or over two; points that failed are crosses."""
    from matplotlib.figure import Figure

    grid, rows = scan.grid, _rows(scan)
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    labels = [f"{name} / {unit}" for name, unit in zip(grid.names, grid.units, strict=True)]
    axes.set_xlabel(labels[0])
    failed = np.array([row[1] for row in rows if row[0] not in scan.best])
    if len(grid.coordinates) == 1:
        x, energy, spread = (np.array(column) for column in zip(*((r[1][0], r[2], r[3]) for r in rows), strict=True))
        axes.plot(x, energy, marker="o", markersize=4, color="#0072B2", label="lowest")
        if np.nanmax(spread, initial=0.0) >= 0.1:
            axes.plot(x, energy + spread, linestyle="--", color="#D55E00", label="highest from another neighbour")
            axes.legend(fontsize=8)
        axes.set_ylabel("energy / (kJ/mol)")
        if len(failed):
            axes.plot(failed[:, 0], np.zeros(len(failed)), "x", color="black")
    else:
        x, y = (np.degrees(v) if turn else v for v, turn in zip(grid.values, grid.in_degrees, strict=True))
        energy = np.array([row[2] for row in rows]).reshape(grid.shape)
        drawn = axes.pcolormesh(x, y, np.ma.masked_invalid(energy.T), shading="nearest", cmap="viridis")
        figure.colorbar(drawn, ax=axes, label="energy / (kJ/mol)")
        axes.set_ylabel(labels[1])
        if len(failed):
            axes.plot(failed[:, 0], failed[:, 1], "x", color="black")
    return figure


def _numbers(scan: Scan) -> dict[str, Any]:
    points = [
        {
            **dict(zip(scan.grid.keys, values, strict=True)),
            "energy_eV": scan.best[point].energy if point in scan.best else None,
            "energy_kJ_mol": energy,
            "hysteresis_kJ_mol": spread,
            "calls": calls,
            "force_left_eV_A": left,
            "error": scan.failed.get(point),
        }
        for point, values, energy, spread, calls, left in _rows(scan)
    ]
    return {
        "kcons": __version__,
        "coordinates": dict(zip(scan.grid.keys, scan.grid.units, strict=True)),
        "points": points,
        "relaxations": len(scan.attempts),
        "calls": scan.evaluations,
    }


def write(scan: Scan, folder: Path | str) -> list[Path]:
    """Put scan.json, .csv, .png and .extxyz (the minima, in the order of the grid) into a folder; the paths written."""
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    written = [place / f"scan.{kind}" for kind in ("json", "csv", "png", "extxyz")]
    numbers = _numbers(scan)
    lines = io.StringIO(newline="")
    writer = csv.DictWriter(lines, list(numbers["points"][0]))
    writer.writeheader()
    writer.writerows(numbers["points"])
    frames = io.StringIO()
    for point in scan.grid.points:
        if point in scan.best:
            ase.io.write(frames, scan.structure(point), format="extxyz")
    picture = io.BytesIO()
    plot(scan).savefig(picture, dpi=150, format="png")
    contents = [text(numbers).encode(), lines.getvalue().encode(), picture.getvalue(), frames.getvalue().encode()]
    for path, content in zip(written, contents, strict=True):
        with in_one_piece(path) as file:
            file.write(content)
    return written
