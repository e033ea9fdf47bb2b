"""What is shown of windows: a table, columns of text, a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.free_energy.profiles.profile import Profile
from kcons.free_energy.profiles.pulls import Pulled
from kcons.free_energy.windows.window_results import UNLIKELY, FreeEnergy, WindowResult
from kcons.steppers.files import in_one_piece, text
from kcons.thermostats.correlated_series import FEW_INDEPENDENT

if TYPE_CHECKING:
    from rich.table import Table

#: Of angles, of lengths, and of formulas and functions: as places are shown, and what mean forces are by.
_SHOWN = {True: "degrees", False: "angstrom", None: "own unit"}
_PER = {**_SHOWN, True: "radian"}


def table(found: FreeEnergy, degrees: Sequence[bool | None]) -> Table:
    """The windows, one in a line.

    Parameters
    ----------
    degrees : sequence of bool or None
        Which coordinates are angles; None where the unit is that of a formula or a function.
    """
    from rich.table import Table

    made = Table(title=f"mean force (kJ/mol by {' or '.join(dict.fromkeys(_PER[angle] for angle in degrees))})")
    for name, angle in zip(found.names, degrees, strict=True):
        made.add_column(f"{name} ({_SHOWN[angle]})", justify="right")
    for name in found.names:
        made.add_column(f"dF/d {name}" if len(found.names) > 1 else "dF/dq", justify="right")
    made.add_column("raw multiplier", justify="right")
    made.add_column("independent samples", justify="right")
    made.add_column("hysteresis p", justify="right")
    for window in found.windows:
        shown = [np.degrees(q) if angle else q for q, angle in zip(window.value, degrees, strict=True)]
        mark = "!" if window.hysteresis < UNLIKELY else ""
        made.add_row(
            *(f"{q:.4g}" for q in shown),
            *(f"{f:.2f} ± {e:.2f}" for f, e in zip(window.force, window.error, strict=True)),
            ", ".join(f"{raw:.2f}" for raw in window.raw),
            f"{_independent(window):.0f}",
            "" if np.isnan(window.hysteresis) else f"{window.hysteresis:.2g}{mark}",
        )
    return made


def _independent(window: WindowResult) -> float:
    return sum(side.n_effective for side in window.sides.values())


def summary(found: FreeEnergy) -> str:
    """A sentence or two."""
    lines = [f"{len(found.windows)} windows"]
    doubtful = [w.number for w in found.windows if w.hysteresis < UNLIKELY]
    if doubtful:
        lines.append(
            f"runs from below and from above differ by more than chance in window {', '.join(map(str, doubtful))} "
            "(marked !): something slow is not equilibrated there; sample longer, or look for the other coordinate"
        )
    poor = [w.number for w in found.windows if _independent(w) < FEW_INDEPENDENT]
    if poor:
        lines.append(
            f"fewer than {FEW_INDEPENDENT} independent samples in window {', '.join(map(str, poor))}: errors there are "
            "not to be relied on; sample longer"
        )
    profile, why = _profile(found)
    if why:
        lines.append(why)
    if profile is not None:
        low, high = int(np.argmin(profile.F)), int(np.argmax(profile.F))
        gap = profile.difference(float(profile.x[low]), float(profile.x[high]))
        lines.append(f"from the lowest to the highest point {gap.value:.2f} ± {gap.error:.2f} kJ/mol")
    lines += [f"{name} failed: {why}" for name, why in found.failed.items()]
    return "\n".join(lines)


def write(found: FreeEnergy, folder: Path, degrees: Sequence[bool | None]) -> list[Path]:
    """free_energy.json, and for one coordinate profile.csv and profile.png; returns their paths."""
    written = [folder / "free_energy.json"]
    with in_one_piece(written[0]) as opened:
        opened.write(text(found.numbers()).encode())
    profile, _ = _profile(found)
    if profile is not None:
        written.append(folder / "profile.csv")
        with in_one_piece(written[-1]) as opened:
            opened.write(f"{found.names[0]} ({_PER[degrees[0]]}),F (kJ/mol),error (kJ/mol)\n".encode())
            np.savetxt(opened, np.column_stack([profile.x, profile.F, profile.error]), fmt="%.8g", delimiter=",")
        written.append(folder / "profile.png")
        with in_one_piece(written[-1]) as opened:
            _draw(profile, found.names[0], opened, degrees[0])
    return written


def _profile(found: FreeEnergy) -> tuple[Profile | None, str]:
    """The profile of windows along one coordinate; otherwise None, and where there could be one, why there is none."""
    if len(found.names) != 1:
        return None, ""
    try:
        return found.profile, ""
    except InputError as error:
        return None, f"no profile: {error}"


def of_pulls(found: FreeEnergy, pulled: Pulled, start: FloatArray, end: FloatArray) -> tuple[dict[str, Any], str]:
    """What pulls gave, as plain data and in a sentence; of one coordinate beside the windows between the same ends."""
    best, name = pulled.best, "Jarzynski" if pulled.bar is None else "BAR"
    numbers: dict[str, Any] = {"from": start.tolist(), "to": end.tolist()}
    for key in ("bar", "jarzynski", "jarzynski_backward"):
        each = getattr(pulled, key)
        if each is not None:
            numbers[key] = [each.value, each.error]
    numbers |= {"dissipated": pulled.dissipated, "overlap": pulled.overlap}
    said = f"pulls give {best.value:.2f} ± {best.error:.2f} kJ/mol ({name}; {pulled.dissipated:.2g} kJ/mol are lost)"
    if _profile(found)[0] is not None:
        windows = found.between(float(start[0]), float(end[0]))
        if windows is None:
            return numbers, f"{said}; the windows do not reach both ends"
        numbers["windows"] = [windows.value, windows.error]
        away = (best.value - windows.value) / math.hypot(best.error, windows.error)
        said += f", windows {windows.value:.2f} ± {windows.error:.2f}: {away:+.1f} standard errors"
    return numbers, said


def _draw(profile: Profile, name: str, file: BinaryIO, degrees: bool | None) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True)
    turn = 180 / np.pi if degrees else 1.0
    above.plot(turn * profile.x, profile.F, color="tab:blue")
    above.fill_between(
        turn * profile.x, profile.F - 2 * profile.error, profile.F + 2 * profile.error, color="tab:blue", alpha=0.25
    )
    above.set_ylabel("F (kJ/mol), band 2 standard errors")
    windows = (turn * profile.windows, profile.mean_forces, 2 * profile.mean_force_errors)
    below.errorbar(*windows, fmt="o", ms=4, capsize=2)
    below.axhline(0, color="0.6", lw=0.8)
    below.set_ylabel(f"dF/dq (kJ/mol by {_PER[degrees]})")
    below.set_xlabel(f"{name} ({_SHOWN[degrees]})")
    figure.savefig(file, dpi=150, format="png")
