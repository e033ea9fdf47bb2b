"""Tables, plots and files of what `kcons.comparison.averages.sampling` found."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich import box
from rich.table import Table
from rich.text import Text

from kcons.comparison.averages.sampling import GOAL, METHODS, Sampled, SamplingComparison
from kcons.comparison.study import json_files
from kcons.comparison.work_precision.measure import duration

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
    "s.e.: the larger of the two in standard errors; beyond 3, what is off is not chance.",
    "forces, wall: force evaluations and wall time until the standard error of kT is {goal:.0%}: speed, and "
    "how fast configurations are forgotten. Good to a third or so.",
    "2K = 3N kT is off by {notes:+.1%} as a matter of principle: configurations have 3N/(g - 1) T, with g = {g}.",
)


def table(comparison: SamplingComparison) -> Table:
    """One line for each thermostat and time step."""
    units = comparison.scene["units"]
    shown = Table(title=comparison.scene["title"], title_style="bold", box=box.SIMPLE_HEAD, padding=(0, 1))
    shown.add_column("thermostat", no_wrap=True)
    goal = f"to {GOAL:.0%}"
    for heading in (
        f"step\n{units['time']}",
        "kT off by\n%",
        f"<U> off by\n{units['energy']} a molecule",
        "off\ns.e.",
        "time\na step",
        f"forces\n{goal}",
        f"wall\n{goal}",
    ):
        shown.add_column(heading, justify="right", no_wrap=True)
    numbers = _note_numbers(comparison)
    previous = ""
    for m in comparison.measurements:
        if m.method != previous and previous:
            shown.add_section()
        shown.add_row(m.title if m.method != previous else "", *_cells(m, numbers))
        previous = m.method
    return shown


def _cells(m: Sampled, notes: dict[str, int]) -> list[str | Text]:
    step = "" if m.step_seconds is None else duration(m.step_seconds)
    if m.status != "ok":
        word = Text(f"{m.status} [{notes[m.note]}]", style="red" if m.status == "failed" else "yellow")
        return [f"{m.setting:.4g}", word, "", "", step, "", ""]
    away = off(m)
    assert m.temperature_error is not None and m.temperature_standard_error is not None
    assert m.energy_error is not None and m.energy_standard_error is not None
    digits = _digits(m.energy_standard_error)
    return [
        f"{m.setting:.4g}",
        f"{100 * m.temperature_error:+.2f} ± {100 * m.temperature_standard_error:.2f}",
        f"{m.energy_error:+.{digits}f} ± {m.energy_standard_error:.{digits}f}",
        Text(f"{away:.1f}", style="yellow" if away > 3 else ""),
        step,
        f"{m.evaluations_to_goal:,.0f}",
        duration(m.seconds_to_goal or 0.0),
    ]


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


def _note_numbers(comparison: SamplingComparison) -> dict[str, int]:
    return {note: k for k, note in enumerate(dict.fromkeys(m.note for m in comparison.measurements if m.note), 1)}


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
    lines = [f"[{number}] {note}" for note, number in _note_numbers(comparison).items()]
    return "\n".join([*lines, *(line.format(**known) for line in EXPLANATION)])


def plot(comparison: SamplingComparison, path: Path) -> None:
    """How the error of the temperature falls while runs grow, against force evaluations and wall time; a PNG file.

    Full symbols: twice the standard error reaches the right value. A curve that levels off has found its bias.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure = Figure(figsize=(11, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, sharey=True)
    dashes = ("-", "--", ":", "-.")
    for axes, cost in ((left, "evaluations"), (right, "seconds")):
        for name in METHODS:
            colour, marker = STYLES[name]
            for k, m in enumerate(comparison.of(name)):
                at = [getattr(moment, cost) for moment in m.growth]
                # What is left to doubt: error and standard error together.
                errors = [
                    100 * (moment.temperature_error**2 + moment.temperature_standard_error**2) ** 0.5
                    for moment in m.growth
                ]
                known = [abs(moment.temperature_error) <= 2 * moment.temperature_standard_error for moment in m.growth]
                label = f"{m.title}; {m.setting:.3g} {comparison.scene['units']['time']}"
                axes.plot(at, errors, color=colour, linestyle=dashes[k % len(dashes)], linewidth=1.2)
                for good, face in ((True, colour), (False, "white")):
                    chosen = [j for j, g in enumerate(known) if g is good]
                    axes.plot(
                        [at[j] for j in chosen],
                        [errors[j] for j in chosen],
                        color=colour,
                        marker=marker,
                        markerfacecolor=face,
                        markersize=6,
                        linestyle="none",
                    )
                axes.plot([], [], color=colour, marker=marker, linestyle=dashes[k % len(dashes)], label=label)
        axes.set(xscale="log", yscale="log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())
        axes.grid(True, which="both", linewidth=0.4, alpha=0.4)
    left.set_xlabel("force evaluations")
    right.set_xlabel("wall time / s")
    left.set_ylabel("error of kT and its standard error together / %")
    handles, labels = right.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    else:
        left.text(0.5, 0.5, "no thermostat has enough samples", transform=left.transAxes, ha="center")
    environment = comparison.environment
    figure.suptitle(comparison.scene["title"], fontsize=11)
    right.set_title(f"{environment['cpu']}, 1 thread; {environment['date']}", fontsize=8, loc="right")
    left.set_title("open symbols: more than two standard errors off", fontsize=8, loc="left")
    figure.savefig(path, dpi=150)


def write(comparison: SamplingComparison, folder: Path, *, tables: Sequence[str] = ()) -> list[Path]:
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
