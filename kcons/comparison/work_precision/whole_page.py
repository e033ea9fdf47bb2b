"""The page of the whole comparison, and the picture and the table of each of its parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcons.comparison.study import html_page
from kcons.comparison.study.html_page import Section
from kcons.comparison.study.machine import processor_of
from kcons.comparison.study.tables import Table, duration, markdown, plain_text
from kcons.comparison.work_precision import interactive, report
from kcons.comparison.work_precision.fronts import (
    COSTS,
    EVERY_MD_ENGINE,
    LEAST_MARGIN,
    NO_FORCE,
    overtaken,
    summary,
    verdict,
)
from kcons.comparison.work_precision.measurement import Comparison
from kcons.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE = "Constraints in molecular dynamics: error against cost"

INTRODUCTION = (
    "Every method runs every test system that it can run: the same start, the same forces, the same reference "
    "solution at the same moment, so early that chaos has not begun to decide. Each point is one method at one time "
    "step or tolerance, after kernels were compiled, on one thread; times are medians over steps. Every method has its "
    "own best settings: steps of high-order methods are longer, tolerances of MD engines are varied.",
    "Fronts are drawn for each MD engine, whose methods share forces and overhead: plain arrays, ASE, OpenMM. A "
    "point is on the front if no other one of its MD engine is both cheaper and more accurate. Across MD engines, "
    f"force evaluations can be compared. Where forces take less than {1e6 * NO_FORCE:g} µs beyond the call from "
    "Python, evaluations decide and wall time stands beside.",
)

WINNERS_NOTE = (
    "gain: how many times cheaper the best method of kcons is than the cheapest other one, at the error of a point of "
    "that one, where the ratio is largest. Between points of one method, logarithms are interpolated. A method "
    f"is ahead beyond the margin of the timings, to which times repeat, and by {100 * LEAST_MARGIN:g} % at least."
)


@dataclass(frozen=True)
class Part:
    """One part and what was measured of it, as read from its file."""

    key: str
    heading: str
    data: Mapping[str, Any]

    @cached_property
    def comparison(self) -> Comparison | None:
        """None where no methods were compared."""
        return Comparison.from_dict(self.data["comparison"]) if "comparison" in self.data else None


def write(path: Path, parts: Sequence[Part]) -> Path:
    """The page of all parts."""
    sentences, close = _lost_and_won(parts)
    compared = {part.key: part.comparison for part in parts if part.comparison is not None}
    drawn = interactive.diagrams(compared)
    gains = [picture] if (picture := gain_picture(parts)) is not None else []
    sections = [
        Section("Who wins where", sentences[:1], gains, [winners(parts).of(SHORT)]),
        Section("What these words mean, and close calls", [WINNERS_NOTE, *sentences[1:], *close]),
        *(_section(part, drawn.get(part.key, "")) for part in parts),
        Section("Where and with what", tables=[_machines(parts)]),
    ]
    return html_page.write(path, TITLE, sections, introduction=INTRODUCTION, head=interactive.head())


#: Of the picture of gains: colour and marker of each MD engine.
ENGINES = {"arrays": ("#0072B2", "o"), "ASE": ("#D55E00", "^"), "OpenMM": ("#009E73", "s")}


def gain_picture(parts: Sequence[Part]) -> Figure | None:
    """Gains by test system and MD engine; None where nothing was compared."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = [
        (part.heading, [row for row in summary(part.comparison) if row["rivals"] and row["gain"]])
        for part in parts
        if part.comparison is not None
    ]
    rows = [(heading, found) for heading, found in rows if found]
    if not rows:
        return None
    drawn = Figure(figsize=(8.5, 1.3 + 0.27 * len(rows)), layout="constrained")
    FigureCanvasAgg(drawn)
    axes = drawn.subplots()
    for engine, (colour, marker) in ENGINES.items():
        at = [(row["gain"], k) for k, (_, found) in enumerate(rows) for row in found if row["md_engine"] == engine]
        if at:
            axes.plot(*zip(*at, strict=True), linestyle="none", color=colour, marker=marker, label=engine, markersize=7)
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set(xscale="log", xlabel="how many times cheaper kcons is, at the same error")
    axes.set_yticks(range(len(rows)), [heading for heading, _ in rows], fontsize=9)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.grid(True, axis="both", linewidth=0.4, alpha=0.5)
    axes.legend(title="MD engine", loc="best")
    return drawn


def write_part(folder: Path, part: Part) -> list[Path]:
    """Picture and table of one part, if there is something to show; the paths written."""
    figure, table, text = shown(part)
    if figure is None or table is None:
        return []
    picture, words = folder / f"{part.key}.png", folder / f"{part.key}.txt"
    figure.savefig(picture, dpi=150)
    words.write_text(f"{part.heading}\n\n{plain_text(table)}\n{text}\n", encoding="utf-8")
    return [picture, words]


def shown(part: Part) -> tuple[Figure | None, Table | None, str]:
    """Figure, table and explanation of a part; nothing where nothing was measured."""
    found = part.comparison
    if found is not None:
        return report.figure(found), report.page_table(found), report.explanation(found)
    return None, None, ""


def _section(part: Part, diagram: str = "") -> Section:
    for word in ("not run", "failed"):
        if word in part.data:
            return Section(part.heading, [f"{word}: {part.data[word]}"])
    if diagram and part.comparison is not None:
        found = part.comparison
        measured = report.page_table(found)
        return Section(part.heading, _notes(found), [], [measured], report.explanation(found), diagram, folded=True)
    figure, table, text = shown(part)
    if figure is None or table is None:
        return Section(part.heading, ["this version of kcons cannot show it"])
    notes = [] if part.comparison is None else _notes(part.comparison)
    return Section(part.heading, notes, [figure], [table], text, folded=True)


def _notes(found: Comparison) -> list[str]:
    judged = verdict(found)
    scene, timing = found.scene, found.timing
    forces = timing.get("force_seconds")
    margin = timing.get("margin")
    lines = [
        f"{scene['title']}. {scene['atoms']} atoms, {scene['rows']} rows of rank {scene['rank']}, "
        f"{scene['degrees_of_freedom']} degrees of freedom; horizon {scene['horizon']:g} {scene['units']['time']}.",
        f"Decided by {COSTS[judged.decides][1]}"
        + (f": forces take {duration(forces)} beyond the call" if forces is not None else "")
        + (f"; times of short runs repeat to within {100 * margin:.0f} %" if margin is not None else "")
        + ".",
        *(
            f"{md_engine} has forces of its own, and takes less than a microsecond for a step with nothing held: there "
            "force evaluations decide."
            for md_engine in sorted(judged.without_forces)
        ),
    ]
    for row in summary(found):
        if not row["rivals"]:
            continue
        lost = "; ".join(row["losses"])
        beside = "; ".join(row["beside"])
        text = f"{row['md_engine'].capitalize() if row['md_engine'] == 'arrays' else row['md_engine']}, {row['cost']}: "
        text += f"ahead of kcons: {lost}." if lost else "no other method is ahead of kcons at any error."
        lines.append(text + (f" Beside, in the other cost: {beside}." if beside else ""))
    return lines


def _machines(parts: Sequence[Part]) -> Table:
    """Every machine with its versions that measured a part, as a rule one; all commits of one machine in one row."""
    rows: dict[tuple[str, ...], tuple[list[str], list[str]]] = {}
    for part in parts:
        environment = part.data.get("environment")
        if environment is None:
            continue
        versions = ", ".join(f"{name} {value}" for name, value in environment["versions"].items() if value)
        processor = f"{processor_of(environment)}, {environment['cores']} cores, {environment['threads']} thread used"
        what = "quick" if part.data["key"]["quick"] else "full"
        commit = environment["commit"] or "not from a repository"
        row = (processor, f"{environment['system']}, Python {environment['python']}", versions, what)
        commits, dates = rows.setdefault(row, ([], []))
        commits.append(commit)
        dates.append(environment["date"])
    headings = ["processor", "system", "versions", "commit", "run", "parts", "from", "to"]
    cells = [
        [*row[:3], ", ".join(dict.fromkeys(commits)), row[3], str(len(dates)), min(dates), max(dates)]
        for row, (commits, dates) in rows.items()
    ]
    return Table(headings, cells, words=(0, 1, 2, 3, 4, 6, 7))


def winners(parts: Sequence[Part]) -> Table:
    """Who wins where: a line for each test system and MD engine with a method of kcons and another one."""
    headings = [
        "test system",
        "MD engine",
        "decided by",
        "times repeat to",
        "gain",
        "at an error of",
        "ahead of kcons",
        "of",
        "over",
    ]
    headings += ["ahead in the other cost", "on the front"]
    rows: list[list[str]] = []
    marks: list[str] = []
    for part in parts:
        found = part.comparison
        if found is None:
            continue
        margin = found.timing.get("margin")
        for row in summary(found):
            if not row["rivals"]:
                continue
            gain = row["gain"]
            by_time = row["cost"] == COSTS["wall"][1]
            rows.append(
                [
                    *(part.heading, row["md_engine"], row["cost"]),
                    f"{100 * margin:.0f} %" if by_time and margin is not None else "",
                    "" if gain is None else factor(gain),
                    "" if gain is None else f"{row['gain_error']:.0e} {found.error_unit}",
                    row["lost"] or "none",
                    *(row["ours"] or "", row["rival"] or ""),
                    row["lost_beside"] or ("" if row["md_engine"] == EVERY_MD_ENGINE else "none"),
                    ", ".join(row["front"]),
                ]
            )
            marks.append("bad" if row["losses"] else "good")
    return Table(headings, rows, words=(0, 1, 2, 6, 7, 8, 9, 10), marks=marks)


#: The picture of gains there.
WINNERS_PICTURE = "who-wins-where.png"
#: Where `fill` writes in a page of the documentation, and the parts whose figures it shows.
BEGIN, END = "<!-- results: begin -->", "<!-- results: end -->"
PICTURES = ("dumbbells", "rotor", "water-216", "chain-1e3", "alanine-allbonds", "dhfr-allbonds", "ethanol")
#: Columns of the table of winners that go there.
SHORT = (0, 1, 2, 3, 4, 5, 6)


def fill(path: Path, parts: Sequence[Part]) -> list[Path]:
    """Put the table of winners and some figures between the marks of a page in Markdown; the paths written.

    Raises
    ------
    InputError
        The page has no marks.
    """
    text = path.read_text(encoding="utf-8")
    if BEGIN not in text or END not in text:
        raise InputError(f"{path} has no place for results, {BEGIN} and {END}", item="into")
    before, after = text.split(BEGIN)[0], text.split(END)[1]
    (path.parent / "figures").mkdir(exist_ok=True)
    written, answer, pictures = [path], "", []
    gains = gain_picture(parts)
    if gains is not None:
        target = path.parent / "figures" / WINNERS_PICTURE
        gains.savefig(target, dpi=100)
        answer = f"![Who wins where](figures/{target.name})\n\n"
        written.append(target)
    for part in parts:
        figure = shown(part)[0] if part.key in PICTURES else None
        if figure is not None:
            target = path.parent / "figures" / f"report-{part.key}.png"
            figure.savefig(target, dpi=75)
            pictures.append(f"![{part.heading}](figures/{target.name})")
            written.append(target)
    text = f"{before}{BEGIN}\n{answer}{results(parts)}\n" + "\n".join(pictures) + f"\n{END}{after}"
    path.write_text(text, encoding="utf-8")
    return written


def results(parts: Sequence[Part]) -> str:
    """The table of winners in Markdown, with where and with what it was measured."""
    machines = _machines(parts)
    where = [f"{row[0]}; {row[2]}; commit {row[3]}; {row[4]} run, {row[6]} to {row[7]}." for row in machines.rows]
    sentences, close = _lost_and_won(parts)
    listed = ["\n".join(f"- {line}" for line in close)] if close else []
    return "\n\n".join([*where, *sentences, *listed, markdown(winners(parts).of(SHORT)), ""])


def factor(ratio: float) -> str:
    """'12 ×', two digits."""
    return f"{ratio:.2g} ×" if ratio < 100 else f"{ratio:,.0f} ×" if ratio < 1e5 else f"{ratio:.0e} ×"


def _lost_and_won(parts: Sequence[Part]) -> tuple[list[str], list[str]]:
    """Sentences on all lines of the table, and those lines in which others are close."""
    compared = [(part.heading, part.comparison) for part in parts if part.comparison is not None]
    judged = [row for _, found in compared for row in summary(found) if row["rivals"]]
    if not judged:
        return ["No test system has both a method of kcons and another one yet."], []
    won = sum(not row["losses"] for row in judged)
    both = sum(bool(pairs) for _, found in compared for pairs in overtaken(found).values())
    close = [
        f"{heading}: {row['lost']}"
        for heading, found in compared
        for known, row in zip(summary(found), summary(_at_least_margin(found)), strict=True)
        if row["rivals"] and row["losses"] and not known["losses"]
    ]
    percent = f"{100 * LEAST_MARGIN:g} %"
    return [
        f"In {len(judged) - both} of {len(judged)} lines of this table no other method is both cheaper and more "
        f"accurate, by more than {percent} each, than a point on kcons' own front. At the same error, and beyond the "
        f"margin to which times repeat, no other method is cheaper than kcons in {won} of them.",
        f"Within that margin, another method was more than {percent} cheaper at the same error in "
        + (f"{len(close)} of the lines. These are ties:" if close else "no line."),
    ], close


def _at_least_margin(found: Comparison) -> Comparison:
    """The same, as if times repeated to within `LEAST_MARGIN`."""
    return replace(found, timing={**found.timing, "margin": None})
