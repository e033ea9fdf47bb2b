"""The stability study in words, tables and one picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcons.comparison.stability.fuzz import FAULTS
from kcons.comparison.stability.runs import METHODS
from kcons.comparison.stability.small_systems import SYSTEMS
from kcons.comparison.study import html_page, tables
from kcons.comparison.study.html_page import Section
from kcons.comparison.study.report_files import made_by
from kcons.comparison.study.tables import Table
from kcons.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _piece(result: Mapping[str, Any], *name: str) -> Mapping[str, Any] | None:
    found: Mapping[str, Any] | None = result["pieces"].get("/".join(name))
    return found


def steps_table(result: Mapping[str, Any]) -> Table:
    """Largest stable step by test system and method; what ends it."""
    return _by_method(result, "steps", _largest)


def _by_method(result: Mapping[str, Any], part: str, told: Callable[[Mapping[str, Any] | None], str]) -> Table:
    """A row a method, a column a test system; methods without any piece are left out."""
    rows = [
        [method, *(told(_piece(result, part, test_system, method)) for test_system in SYSTEMS)] for method in METHODS
    ]
    return Table(["method", *SYSTEMS], [row for row in rows if any(row[1:])])


def _largest(piece: Mapping[str, Any] | None) -> str:
    if piece is None:
        return ""
    if "cannot" in piece:
        return "–"
    return f"{piece['largest_step']:.3g} {_END.get(piece['how'], piece['how'])}"


#: What ends the steps, in a word.
_END = {
    "ConvergenceError": "error",
    "InfeasibleError": "error",
    "NonFiniteError": "error",
    "RuntimeError": "error",
    "OpenMMException": "error",
    "explosion": "energy",
    "silent": "SILENT",
}


def drift_table(result: Mapping[str, Any]) -> Table:
    """Slope of the energy per unit time, with its standard error over the seeds."""
    rows = []
    for test_system in SYSTEMS:
        piece = _piece(result, "drift", test_system)
        if piece:
            error = piece["standard_error"] or math.nan
            rows.append(
                [
                    test_system,
                    f"{piece['dt']:g}",
                    f"{piece['steps']:,}",
                    str(piece["seeds"]),
                    f"{piece['slope']:.1e} ± {error:.1e}",
                    f"{piece['rms']:.1e}",
                    f"{piece['residual']:.1e}",
                ]
            )
    return Table(["test system", "step", "steps", "seeds", "slope per unit time", "rms", "residual"], rows)


def reversal_table(result: Mapping[str, Any]) -> Table:
    """By how much the start is missed after going forth and back."""
    return _by_method(result, "reversal", _missed)


def _missed(piece: Mapping[str, Any] | None) -> str:
    if piece is None:
        return ""
    if "cannot" in piece:
        return "–"
    return f"{piece['missed_by']:.1e}" if "missed_by" in piece else "error"


def fuzz_words(result: Mapping[str, Any]) -> str:
    """Counts of the fuzz run."""
    found = result.get("fuzz")
    if not found:
        return ""
    counts = ", ".join(f"{name} {number}" for name, number in found["outcomes"].items())
    worst = found["worst"][0]
    seeds = ", ".join(str(t["seed"]) for t in found["worst"])
    return (
        f"{found['trials']:,} random molecules, {found['steps']} steps each: {counts}.\n"
        f"Largest residual {max(t['residual'] for t in found['worst']):.1e} and |A v|/|v| "
        f"{max(t['velocity_residual'] for t in found['worst']):.1e}; worst seeds: {seeds} (kind of the first: "
        f"{worst['shape']})."
    )


def markdown(result: Mapping[str, Any]) -> dict[str, str]:
    """The tables for the documentation, by part."""
    return {
        "steps": tables.markdown(steps_table(result)) + _lengths(result, "steps", "Steps in a run"),
        "drift": tables.markdown(drift_table(result)),
        "reversal": tables.markdown(reversal_table(result)) + _lengths(result, "reversal", "Steps forth"),
        "fuzz": fuzz_words(result),
    }


def _lengths(result: Mapping[str, Any], part: str, words: str) -> str:
    """How long the runs of each test system were, with Rattle."""
    found = {test_system: _piece(result, part, test_system, "Rattle") for test_system in SYSTEMS}
    told = ", ".join(
        f"{test_system} {piece['steps']}" for test_system, piece in found.items() if piece and "steps" in piece
    )
    return f"\n\n{words}: {told}." if told else ""


def text(result: Mapping[str, Any]) -> str:
    """All tables for the terminal."""
    titles = {
        "steps": "Largest stable steps, and what ends them (error, or energy that explodes while all rows hold)",
        "drift": "Drift of the energy with Rattle, relative to the kinetic energy at the start",
        "reversal": "Forth and back: the start is missed by",
        "fuzz": "Random molecules",
    }
    return "\n\n".join(f"{titles[name]}\n{words}" for name, words in markdown(result).items() if words.count("\n"))


def failures(result: Mapping[str, Any]) -> list[str]:
    """What must not be: silent residuals of kcons, NaN, changed states."""
    found = [
        f"{name}: {piece}"
        for name, piece in result["pieces"].items()
        if name.startswith("steps/")
        and name.rsplit("/", 1)[1] not in ("ASE", "OpenMM")
        and (piece.get("how") == "silent" or not _silent(piece) <= 1e-9)
    ]
    outcomes = result.get("fuzz", {}).get("outcomes", {})
    return found + [f"fuzz: {outcomes[name]} {name}" for name in FAULTS if outcomes.get(name)]


def _silent(piece: Mapping[str, Any]) -> float:
    """Largest residual of runs that no error ended; NaN, which files hold as null, counts."""
    residual = piece.get("silent_residual", 0.0)
    return math.nan if residual is None else float(residual)


def picture(result: Mapping[str, Any]) -> Figure:
    """Largest stable step a force evaluation, by test system and method."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.8), layout="constrained")
    axes = figure.subplots()
    test_systems = [s for s in SYSTEMS if any(_piece(result, "steps", s, m) for m in METHODS)]
    width = 0.8 / len(METHODS)
    for k, method in enumerate(METHODS):
        at, height = [], []
        for j, test_system in enumerate(test_systems):
            piece = _piece(result, "steps", test_system, method)
            if piece and piece.get("largest_step"):
                at.append(j - 0.4 + (k + 0.5) * width)
                height.append(piece["largest_step"] / piece.get("evaluations", 1))
        axes.bar(at, height, width, label=method, hatch="//" if method in ("ASE", "OpenMM") else None)
    axes.set_xticks(range(len(test_systems)), test_systems)
    axes.set_yscale("log")
    axes.set_ylabel("largest stable step / force evaluations")
    axes.legend(fontsize=8, ncols=2)
    return figure


def write(result: Mapping[str, Any], folder: Path) -> list[Path]:
    """Write stability.png and stability.html."""
    figure = picture(result)
    png = folder / "stability.png"
    figure.savefig(png, dpi=110)
    shown = {
        "Largest stable steps": steps_table(result),
        "Drift of the energy": drift_table(result),
        "Reversibility": reversal_table(result),
    }
    sections = [
        Section(heading, figures=[figure] if heading.startswith("Largest") else [], tables=[table])
        for heading, table in shown.items()
        if table.rows
    ]
    if result.get("fuzz"):
        sections.append(Section("Random molecules", literal=fuzz_words(result)))
    sections.append(Section("Made by", literal=made_by(result)))
    return [png, html_page.write(folder / "stability.html", "Stability of constrained dynamics", sections)]


def renew(shown: Path, before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
    """Put the tables of other results into a page that shows those from before.

    Raises
    ------
    InputError
        The page does not show them.
    """
    text, old, new = shown.read_text(encoding="utf-8"), markdown(before), markdown(after)
    for part, words in new.items():
        if words in text:
            continue
        if old[part] not in text:
            raise InputError(f"{shown} does not show the {part} of the results so far", item="page")
        text = text.replace(old[part], words)
    shown.write_text(text, encoding="utf-8")
