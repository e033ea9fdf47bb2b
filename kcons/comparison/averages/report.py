"""Tables, plots and files of what `kcons.comparison.averages.sampling` found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

from kcons.comparison.averages.sampling import GOAL, METHODS, Sampled, SamplingComparison
from kcons.comparison.machine import processor_of
from kcons.comparison.progress import duration
from kcons.comparison.study import report_files
from kcons.comparison.study.curves import Curve, Panel, draw, say
from kcons.comparison.study.tables import Marked, Table, footnotes, numbered, verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Colour-blind safe (Okabe and Ito), and a marker each.
STYLES: dict[str, tuple[str, str]] = {
    "isokinetic": ("#0072B2", "o"),
    "isokinetic-notes": ("#D55E00", "^"),
    "langevin": ("#009E73", "s"),
    "nose-hoover": ("#CC79A7", "D"),
}

EXPLANATION = (
    "kT off by: temperature of the configurations over the temperature asked for, less 1, with its standard error.",
    "<U> off by: mean potential energy a molecule less that of Metropolis sampling, {energy:.4g} ± {error:.1g} {unit}, "
    "with the error of both.",
    "T of shifts, turns: the same of whole molecules that move and that turn, apart.",
    "→ 0: extrapolated to step zero, off + c step², by weighted least squares; ? where that does not fit (chi²).",
    "s.e.: the larger of the two in standard errors; beyond 3, what is off is not chance.",
    "forces, wall: force evaluations and wall time until the standard error of kT is {goal:.0%}: speed, and "
    "how fast configurations are forgotten. Good to a third or so.",
    "2K = 3N kT is off by {notes:+.1%} as a matter of principle: configurations have 3N/(g - 1) T, with g = {g}.",
)


def table(comparison: SamplingComparison) -> Table:
    """One line for each thermostat and time step."""
    units, goal = comparison.scene["units"], f"to {GOAL:.0%}"
    kinds = [name for name in ("shift", "turn") if any("turn" in m.kinds for m in comparison.measurements)]
    headings = [
        "thermostat",
        f"step\n{units['time']}",
        "kT off by\n%",
        *(f"T of {name}s\n%" for name in kinds),
        f"<U> off by\n{units['energy']} a molecule",
        "off\ns.e.",
        "time\na step",
        f"forces\n{goal}",
        f"wall\n{goal}",
    ]
    notes = numbered(m.note for m in comparison.measurements)
    rows = []
    for m, after in zip_longest(comparison.measurements, comparison.measurements[1:]):
        rows.append([m.title, *_cells(m, notes, kinds)])
        if after is None or after.method != m.method:
            rows += [[m.title, *cells] for cells in _at_zero(comparison, m.method, kinds)]
    return Table(headings, rows, title=comparison.scene["title"], grouped=True)


def _cells(m: Sampled, notes: Mapping[str, int], kinds: Sequence[str]) -> list[str]:
    step = "" if m.step_seconds is None else duration(m.step_seconds)
    if m.status != "ok":
        return [
            f"{m.setting:.4g}",
            verdict(m.status, m.status, notes.get(m.note)),
            *[""] * (2 + len(kinds)),
            step,
            "",
            "",
        ]
    away = off(m)
    assert m.temperature_error is not None and m.temperature_standard_error is not None
    assert m.energy_error is not None and m.energy_standard_error is not None
    doubt = f" [{notes[m.note]}]" if m.note else ""
    return [
        f"{m.setting:.4g}",
        _percent(m.temperature_error, m.temperature_standard_error),
        *(_percent(*m.kinds[name]) for name in kinds),
        _energy(m.energy_error, m.energy_standard_error),
        Marked(f"{away:.1f}{doubt}", "yellow" if away > 3 or doubt else ""),
        step,
        f"{m.evaluations_to_goal:,.0f}",
        duration(m.seconds_to_goal or 0.0),
    ]


def _at_zero(comparison: SamplingComparison, method: str, kinds: Sequence[str]) -> list[list[str]]:
    """The line of a thermostat whose steps were extrapolated to zero, with a question mark at what does not fit."""
    found = comparison.extrapolated(method)
    if not {"temperature", "energy", *kinds} <= set(found):
        return []
    marks = {name: "" if value.fits else "?" for name, value in found.items()}
    percents = [_percent(*found[name].estimate) + marks[name] for name in ("temperature", *kinds)]
    away = max(abs(found[name].value) / found[name].error for name in ("temperature", "energy"))
    off_by = Marked(f"{away:.1f}", "yellow" if away > 3 else "")
    return [["→ 0", *percents, _energy(*found["energy"].estimate) + marks["energy"], off_by, "", "", ""]]


def _percent(value: float, error: float) -> str:
    return f"{100 * value:+.2f} ± {100 * error:.2f}"


def _energy(value: float, error: float) -> str:
    digits = _digits(error)
    return f"{value:+.{digits}f} ± {error:.{digits}f}"


def _digits(error: float) -> int:
    """Decimals that show two digits of the error."""
    digits = 0
    while error < 9.95 and digits < 8:
        error, digits = 10 * error, digits + 1
    return digits


def off(m: Sampled) -> float:
    """Distance from the right averages in standard errors, the larger of temperature and energy."""
    pairs = (
        (m.temperature_error, m.temperature_standard_error),
        (m.energy_error, m.energy_standard_error),
    )
    return max(abs(value or 0.0) / error for value, error in pairs if error)


def explanation(comparison: SamplingComparison) -> str:
    """What the columns mean."""
    known = {
        "energy": comparison.reference["energy"],
        "error": comparison.reference["standard_error"],
        "unit": comparison.scene["units"]["energy"],
        "goal": GOAL,
        "notes": comparison.scene["notes_temperature_error"],
        "g": comparison.scene["degrees_of_freedom"],
    }
    notes = footnotes(numbered(m.note for m in comparison.measurements))
    said = [comparison.settings["interrupted"]] if "interrupted" in comparison.settings else []
    return "\n".join([*said, *notes, *(line.format(**known) for line in EXPLANATION)])


def figure(comparison: SamplingComparison) -> Figure:
    """How the error of the temperature falls while runs grow, against force evaluations and wall time.

    Full symbols: twice the standard error reaches the right value. A curve that levels off has found its bias.
    """
    about = comparison.environment
    grid = {"which": "both", "linewidth": 0.4, "alpha": 0.4}
    left = Panel(
        _growth(comparison, "evaluations"),
        "force evaluations",
        "error of kT and its standard error together / %",
        notes=("open symbols: more than two standard errors off", ""),
        plain="xy",
        grid=grid,
    )
    made = f"{processor_of(about)}, 1 thread; {about['date']}"
    right = Panel(_growth(comparison, "seconds"), "wall time / s", notes=("", made), plain="xy", grid=grid)
    drawn = draw([[left, right]], (11, 5.2), title=comparison.scene["title"], same_y=True, legend=3)
    if not left.curves:
        say(drawn.axes[0], "no thermostat has enough samples")
    return drawn


def _growth(comparison: SamplingComparison, cost: str) -> list[Curve]:
    """For each run the line, its full and its open symbols, and what stands for them in the legend."""
    dashes = ("-", "--", ":", "-.")
    found = []
    for name in METHODS:
        colour, marker = STYLES[name]
        for k, m in enumerate(comparison.of(name)):
            at = [getattr(moment, cost) for moment in m.growth]
            # What is left to doubt: error and standard error together.
            errors = [
                100 * (moment.temperature_error**2 + moment.temperature_standard_error**2) ** 0.5 for moment in m.growth
            ]
            known = [abs(moment.temperature_error) <= 2 * moment.temperature_standard_error for moment in m.growth]
            line = {"color": colour, "linestyle": dashes[k % len(dashes)]}
            found.append(Curve(at, errors, style={**line, "linewidth": 1.2}))
            for good, face in ((True, colour), (False, "white")):
                chosen = [j for j, g in enumerate(known) if g is good]
                look = {"color": colour, "marker": marker, "markerfacecolor": face, "markersize": 6}
                points = [at[j] for j in chosen], [errors[j] for j in chosen]
                found.append(Curve(*points, style={**look, "linestyle": "none"}))
            label = f"{m.title}; {m.setting:.3g} {comparison.scene['units']['time']}"
            found.append(Curve([], [], label, {**line, "marker": marker}))
    return found


def write(comparison: SamplingComparison, folder: Path, *, tables: Sequence[str] = ()) -> list[Path]:
    """Put compare.json, compare.png and, if given, the table as text into `folder`; the paths written."""
    return report_files.write(folder, "compare", comparison.to_dict(), figure(comparison), tables)
