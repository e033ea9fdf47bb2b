"""What is shown of a comparison: one CSV file, one text of at most 30 lines, one figure."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from kcons.comparison.machine import processor_of
from kcons.comparison.progress import duration
from kcons.comparison.ranking import COSTS, Ranking, cost_that_decides, pareto, rank, shown_setting, with_errors
from kcons.errors import InputError
from kcons.steppers.files import in_one_piece

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Methods that a ranking shows, and curves of a figure.
PLACES, CURVES = 5, 9
#: Steps of a run below which the sentence says how few they were: a step that is too long may fail later.
FEW_STEPS = 10
#: Bands behind the curves, one an engine.
BANDS = {"arrays": "#bdbdbd", "ASE": "#e0c39a", "OpenMM": "#c6b8d9"}
#: Color-blind safe; of a few methods always the same.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#332288", "#882255", "#117733", "#555555")
MARKERS = "os^Dv<>Ph*"


# -- files ------------------------------------------------------------------------------------------


def write_csv(path: Path, table: pd.DataFrame) -> None:
    """The table, all of it or nothing; lines that begin with '#' say of what it is."""
    head = "".join(f"# {name}: {json.dumps(value, ensure_ascii=False)}\n" for name, value in table.attrs.items())
    with in_one_piece(path) as file:
        file.write((head + table.to_csv(index=False)).encode())


def read_csv(path: Path | str) -> pd.DataFrame:
    """What `write_csv` wrote.

    Raises
    ------
    InputError
        The file holds something else.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
        count = next(k for k, line in enumerate(lines) if not line.startswith("# "))
        head = dict(line[2:].split(": ", 1) for line in lines[:count])
        attrs = {name: json.loads(value) for name, value in head.items()}
        table = pd.read_csv(path, skiprows=count)
        table["note"] = table["note"].astype(object).fillna("")
        table["adaptive"] = table["adaptive"].astype(bool)
        assert {"title", "reference_error", "force_seconds"} <= set(attrs)
    except (AssertionError, KeyError, OSError, ValueError, StopIteration) as error:
        raise InputError(f"{path} holds no comparison of kcons: {error!r}", item="file") from None
    table.attrs = attrs
    return table


# -- words ------------------------------------------------------------------------------------------


def text(table: pd.DataFrame, found: Ranking | None, code: str = "", more: str = "") -> str:
    """The recommendation in a sentence, the ranking, and lines of Python that run the first one.

    Parameters
    ----------
    table : DataFrame
    found : Ranking or None
    code : str
        Python for the first method.
    more : str
        What else to say, after the sentence.
    """
    about = table.attrs
    places = _places(found, about) if found is not None and (len(found.table) or "what" in about) else ""
    lines = f"In Python:\n{code.rstrip()}" if code else ""
    return "\n\n".join(filter(None, [sentence(table, found), more, places, lines]))


def sentence(table: pd.DataFrame, found: Ranking | None) -> str:
    """Which method, at which step."""
    about = table.attrs
    if found is None:
        bad = table[table.status.isin(["failed", "partial", "not run"])].drop_duplicates("title")
        left = ", ".join(f"{title} ({note})" for title, note in zip(bad.title, bad.note, strict=True))
        if "what" in about:
            return f"No run can tell the {about['what']}: {left}. Give a larger --budget."
        return f"No method reached the horizon of {about['horizon']:g} {about['time']}: {left}."
    limit = f"an {found.what} " if found.what[0] in "aeiou" else f"a {found.what} "
    limit += f"of at most {f'{found.limit:.2g} {found.unit}'.strip()} ({found.limit_is})"
    if not len(found.table):
        best = found.beyond.iloc[0]
        at = shown_setting(best, about)
        if best.error <= found.limit:
            return f"No method makes {limit}, which cannot be told from none: the reference is no better."
        remedy = " Longer runs (--budget) make errors smaller." if "what" in about else ""
        return f"No method makes {limit}; the least is {best.error:.2g}, by {best.title} at {at}.{remedy}"
    first = found.table.iloc[0]
    least = "the least" if first.cost <= found.table.cost.min() else "nearly the least"
    spent = f"{least} {COSTS[found.cost]} {_per(about)}, {_spent(first.cost, found.cost)}"
    words = f"Use {first.title} at {shown_setting(first, about)}: {spent}, for {limit}"
    if first.steps < FEW_STEPS and not first.adaptive:
        words += f" (it made {first.steps:.0f} steps only: see how a longer run goes before you rely on it)"
    ties = found.table[found.table.place == 1].iloc[1:]
    if len(ties):
        named = ", ".join(ties.title[:3]) + (f" and {len(ties) - 3} more" if len(ties) > 3 else "")
        words += f"; equally cheap within {100 * found.scatter:.0f} %: {named}"
    return words + "."


def _places(found: Ranking, about: dict[str, Any]) -> str:
    ranked = found.table if len(found.table) else found.beyond.assign(place="", times=np.nan)
    shown = ranked.head(PLACES)
    tied = found.table.place.duplicated(keep=False)
    titles = [str(title)[:40] for title in shown.title]
    width = max(map(len, titles))
    cells = {
        "": [f"{p}{'=' if tie else ' '}" for p, tie in zip(shown.place, tied, strict=False)] or [""] * len(shown),
        "method".ljust(width): [title.ljust(width) for title in titles],
        "at": [shown_setting(row, about) for row in shown.itertuples()],
        found.what.split()[0]: [f"{error:.1e}" for error in shown.error],
        "cost": [_spent(cost, found.cost) for cost in shown.cost],
        "times": ["" if np.isnan(t) else f"{t:.2f}" if t < 10 else f"{t:,.0f}" for t in shown.times],
        "timed": ["once" if not rounds else f"{rounds:.0f} rounds" for rounds in shown.rounds],
    }
    if found.cost == "evaluations" or "what" in about:
        del cells["timed"]
    padded = {f" {name}": [f" {c}" for c in column] for name, column in cells.items()}
    lines = [pd.DataFrame(padded).to_string(index=False)]
    if len(ranked) > PLACES:
        lines.append(f"... and {len(ranked) - PLACES} more")
    run = "" if "what" in about else f"; a run of {about['horizon']:g} {about['time']}"
    lines += [f"Measured on {about['title']}{run}.", f"cost: {COSTS[found.cost]} {_per(about)}. Costs that differ"]
    lines[-1] += f" by less than {100 * found.scatter:.0f} % are equal (=)."
    return "\n".join(lines)


def _per(about: dict[str, Any]) -> str:
    return str(about.get("per") or f"per {about['long_time']}")


def _spent(cost: float, kind: str) -> str:
    return duration(cost) if kind == "seconds" else f"{cost:,.0f}" if cost >= 100 else f"{cost:.3g}"


# -- the figure -------------------------------------------------------------------------------------


def figure(table: pd.DataFrame, width: float = 9.0) -> Figure:
    """Error against cost, axes logarithmic: curves with their names at their ends, a pale band along each front.

    Of several rows of a method with one setting, such as two frictions, the one with the least error is shown.

    Parameters
    ----------
    table : DataFrame
    width : float
        Inches, from 5 on.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    about, cost = table.attrs, cost_that_decides(table)
    table = table.loc[sorted(table.sort_values("error").drop_duplicates(["method", "setting"]).index)]
    drawn = Figure(figsize=(width, 5.0))
    FigureCanvasAgg(drawn)
    axes = drawn.subplots()
    done = with_errors(table)
    done = done[done.error > 0]
    axes.set(xscale="log", yscale="log")
    axes.set_xlabel(f"{COSTS[cost]} {_per(about)}{' / s' if cost == 'seconds' else ''}")
    error = f"error at {about['horizon']:g} {about['time']} / {about['error_unit']}"
    axes.set_ylabel(about.get("what", error).replace(" of the conf", "\nof the conf"))
    axes.grid(True, which="major", linewidth=0.5, alpha=0.5)
    # Those within a decade are named where few decades are shown.
    axes.tick_params(axis="x", which="minor", labelsize=7)
    axes.set_title(about["title"], fontsize=10, loc="left", wrap=True)
    if "environment" in about:
        where = f"{processor_of(about['environment'])}; {about['environment']['date']}"
        drawn.text(0.995, 0.005, where, fontsize=6, ha="right", va="bottom")
    if not len(done):
        axes.text(0.5, 0.5, "no method reached the horizon", transform=axes.transAxes, ha="center")
        return drawn
    for engine, rows in done.groupby("engine", sort=False):
        best = pareto(rows, cost)
        look: dict[str, Any] = {"linewidth": 9, "alpha": 0.5, "solid_capstyle": "round", "marker": "o", "markersize": 8}
        look |= {"color": BANDS[str(engine)], "markeredgewidth": 0, "zorder": 0, "label": f"front, {engine}"}
        axes.plot(best[cost], best.error, **look)
    curves = chosen_curves(table)
    for k, name in enumerate(curves):
        rows = done[done.method == name]
        look = {"color": COLORS[k % len(COLORS)], "marker": MARKERS[k % len(MARKERS)], "markerfacecolor": "none"}
        axes.plot(rows[cost], rows.error, **look)
    baselines = table[(table.status == "baseline") & (table[cost] > 0)]
    if len(baselines):
        at, up = baselines[cost], np.full(len(baselines), 0.02)
        axes.plot(at, up, "|k", markersize=9, transform=axes.get_xaxis_transform(), label="nothing held")
    axes.legend(loc="best", fontsize=7, framealpha=0.9)
    # Names stand to the right: so much room do they need.
    names = {name: str(done[done.method == name].title.iloc[0]) for name in curves}
    room = min(0.48, 0.066 * max(len(t) for t in names.values()) / width + 0.04)
    drawn.subplots_adjust(left=(1.1 if "what" in about else 0.75) / width, right=1 - room, bottom=0.12, top=0.92)
    ends = {name: done[done.method == name].iloc[-1] for name in curves}
    _name_curves(
        axes, [(names[n], (ends[n][cost], ends[n].error), COLORS[k % len(COLORS)]) for k, n in enumerate(curves)]
    )
    return drawn


def chosen_curves(table: pd.DataFrame, most: int = CURVES) -> list[str]:
    """Methods that a figure shows: RATTLE, then half of kcons and half of others, those on the fronts first."""
    cost, done = cost_that_decides(table), with_errors(table)
    done = done[done.error > 0]
    fronts = pd.concat([pareto(rows, cost) for _, rows in done.groupby("engine")]).method.value_counts()
    ranked = rank(table)
    places = {} if ranked is None else {name: k for k, name in enumerate(ranked.table.method)}
    order = sorted(
        dict.fromkeys(done.method),
        key=lambda name: (name != "rattle", -int(fronts.get(name, 0)), places.get(name, len(places))),
    )
    ours = [name for name in order if "kcons" in str(done[done.method == name].title.iloc[0])]
    others = [name for name in order if name not in ours]
    kept = [*ours[: most - min(len(others), most // 2)], *others][:most]
    return [name for name in dict.fromkeys(done.method) if name in kept]


def _name_curves(axes: Axes, curves: list[tuple[str, tuple[float, float], str]]) -> None:
    """Names to the right of the panel, as near to the heights of the last points as they do not cover each other."""
    least = 0.052
    axes.autoscale_view()
    to_panel = axes.transData + axes.transAxes.inverted()
    order = sorted(range(len(curves)), key=lambda k: to_panel.transform(curves[k][1])[1])
    height, heights = -least / 2, {}
    for k in order:
        height = max(height + least, float(to_panel.transform(curves[k][1])[1]))
        heights[k] = height
    beyond = max(0.0, height - 1.0)
    for place, k in enumerate(order):
        name, end, color = curves[k]
        at = max(heights[k] - beyond, place * least)
        look = {"arrowstyle": "-", "color": color, "linewidth": 0.5, "alpha": 0.5, "shrinkB": 3, "relpos": (0, 0.5)}
        axes.annotate(
            name, end, (1.02, at), "data", "axes fraction", color=color, fontsize=8, va="center", arrowprops=look
        )
