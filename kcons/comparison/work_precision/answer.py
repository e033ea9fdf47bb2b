"""Which method and which step, in one sentence, and the ranking behind it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from kcons.comparison.study.tables import Table, duration, plain_text
from kcons.comparison.work_precision.fronts import (
    COSTS,
    SAME_ERROR,
    SAME_EVALUATIONS,
    cost_of,
    resolution_of,
    verdict,
)
from kcons.comparison.work_precision.measurement import Comparison, Measurement

if TYPE_CHECKING:
    from kcons.comparison.averages.sampling import SamplingComparison

Criterion = Literal["error", "drift", "temperature"]

#: Methods whose error is what is usually accepted, and the step of it where time is in fs.
USUAL_METHODS = ("rattle", "openmm-kcons-rattle", "ase-kcons", "openmm-rattle", "openmm-verlet")
USUAL_STEP = 2.0
#: Of a temperature that is right enough, as a fraction.
USUAL_TEMPERATURE = 0.01
#: What thermostats are judged by, and what they cost.
DEVIATION = "a deviation of the temperature of the configurations"
UNTIL_KNOWN = "wall time until that temperature is known to 1 %"
#: Columns of a terminal that the ranking fits into, and of these the most that a title takes.
WIDTH, TITLE = 80, 33


@dataclass(frozen=True)
class Point:
    """One method at one setting: what it is judged by, and what it costs.

    Attributes
    ----------
    method, title : str
    setting : str
        Step or tolerance, as it is shown.
    value : float
        Error, drift, or deviation of a temperature.
    cost : float
    number : float
        The setting, of a comparison of trajectories.
    """

    method: str
    title: str
    setting: str
    value: float
    cost: float
    number: float = math.nan


@dataclass(frozen=True)
class Ranked:
    """A point with its place. Points within the margin of the first of a place share it."""

    place: int
    point: Point
    ratio: float


@dataclass(frozen=True)
class Answer:
    """The cheapest point of each method that is good enough, cheapest first.

    Attributes
    ----------
    what : str
        What points are judged by, in words.
    unit : str
    limit : float
        The largest value that is good enough.
    limit_is : str
        Where it comes from.
    cost : str
        What is spent, in words.
    seconds : bool
        Whether that is a time.
    margin : float
        Costs that differ by this fraction are the same.
    ranked : list of Ranked
    beyond : list of Point
        The best point of each method that is not good enough.
    """

    what: str
    unit: str
    limit: float
    limit_is: str
    cost: str
    seconds: bool
    margin: float
    ranked: Sequence[Ranked]
    beyond: Sequence[Point]


def answer(comparison: Comparison, criterion: Criterion = "error", limit: float | None = None) -> Answer | None:
    """Rank the methods of a comparison of trajectories; None where nothing can be ranked.

    Parameters
    ----------
    comparison : Comparison
    criterion : {'error', 'drift'}
        The error of the trajectory, or the drift of its energy: its slope and twice the standard error of it.
    limit : float, optional
        The largest value that is good enough; by default what the usual method makes at its usual step, and what
        cannot be told from it.
    """
    judged = verdict(comparison)
    least = resolution_of(comparison) if criterion == "error" else 0.0
    units = comparison.scene["units"]
    pairs = []
    for m in comparison.measurements:
        value = _value(m, criterion)
        if m.status == "ok" and value is not None and math.isfinite(value) and cost_of(m, judged.decides) > 0:
            setting = f"rtol {m.setting:.0e}" if m.adaptive else f"{m.setting:.4g} {units['time']}"
            pairs.append((m, Point(m.method, m.title, setting, value, cost_of(m, judged.decides), m.setting)))
    if not pairs:
        return None
    limit_is, slack = "asked for", 0.0
    if limit is None:
        limit, limit_is = _usual(pairs, units["time"])
        if limit < least:
            limit, limit_is = least, "the least that the reference can tell apart"
        slack = SAME_ERROR
    by_time = judged.decides == "wall"
    margin = judged.margin if by_time else SAME_EVALUATIONS
    found = _ranked([point for _, point in pairs], limit, margin, slack=slack, least=least)
    drift = criterion == "drift"
    return replace(
        found,
        what="a drift of the energy" if drift else "an error",
        unit=f"{units['energy']}/{units['long_time']} a degree of freedom" if drift else comparison.error_unit,
        limit_is=limit_is,
        cost=f"{COSTS[judged.decides][1]} a {units['long_time']}",
        seconds=by_time,
    )


def answer_of_averages(comparison: SamplingComparison, limit: float | None = None) -> Answer | None:
    """Rank thermostats: who is soonest at a known temperature, where the configurations have the right one.

    A deviation counts with twice its standard error. Where all ran at one step, they are ranked by it instead, and
    share a place where these intervals overlap.

    Parameters
    ----------
    comparison : SamplingComparison
    limit : float, optional
        The largest deviation of the temperature of the configurations that is good enough, as a fraction.
    """
    unit = comparison.scene["units"]["time"]
    pointed = [
        Point(
            m.method,
            m.title,
            f"{m.setting:.4g} {unit}",
            abs(m.temperature_error) + 2 * (m.temperature_standard_error or 0.0),
            m.seconds_to_goal,
        )
        for m in comparison.measurements
        if m.status == "ok" and m.temperature_error is not None and m.seconds_to_goal
    ]
    if not pointed:
        return None
    if limit is None and len({point.setting for point in pointed}) == 1 < len(pointed):
        errors = {m.method: m.temperature_standard_error or 0.0 for m in comparison.measurements}
        return _at_one_step(pointed, errors)
    is_usual = "usual" if limit is None else "asked for"
    # Times to a goal follow from correlation times, which are known to a third.
    found = _ranked(pointed, USUAL_TEMPERATURE if limit is None else limit, 1 / 3)
    return replace(
        found,
        what=DEVIATION,
        unit="of it",
        limit_is=is_usual,
        cost=UNTIL_KNOWN,
        seconds=True,
    )


def _at_one_step(points: Sequence[Point], errors: Mapping[str, float]) -> Answer:
    """Thermostats by the deviation of the temperature: between the value of a point and four standard errors less."""
    ranked = _placed(points, lambda p: p.value, lambda p, leader: p.value - 4 * errors[p.method] <= leader)
    return Answer(DEVIATION, "of it", math.inf, "", UNTIL_KNOWN, True, 0.0, ranked, [])


def _placed(
    points: Iterable[Point], worth: Callable[[Point], float], ties: Callable[[Point, float], bool]
) -> list[Ranked]:
    """In the order of what they are worth; those that tie with the first of a place share it."""
    ranked: list[Ranked] = []
    leader = 0.0
    for number, point in enumerate(sorted(points, key=worth), 1):
        tied = bool(ranked) and ties(point, leader)
        leader = leader if tied else worth(point)
        place = ranked[-1].place if tied else number
        ranked.append(Ranked(place, point, worth(point) / worth(ranked[0].point if ranked else point)))
    return ranked


def _value(m: Measurement, criterion: Criterion) -> float | None:
    if criterion == "error":
        return m.error
    if m.energy_slope is None:
        return None
    return abs(m.energy_slope) + 2 * (m.energy_slope_error or 0.0)


def _usual(pairs: Sequence[tuple[Measurement, Point]], time: str) -> tuple[float, str]:
    """What is usually accepted: that of the plainest method that ran, at 2 fs or at its second longest step."""
    for name in USUAL_METHODS:
        curve = sorted((pair for pair in pairs if pair[0].method == name), key=lambda pair: -pair[0].setting)
        if curve:
            usual = curve[min(1, len(curve) - 1)][1]
            if time == "fs":
                usual = min(curve, key=lambda pair: abs(math.log(pair[0].setting / USUAL_STEP)))[1]
            return usual.value, f"what {usual.title} makes at {usual.setting}"
    values = sorted(point.value for _, point in pairs)
    return values[len(values) // 2], "what half of the points make"


def _ranked(
    points: Sequence[Point], limit: float, margin: float, *, slack: float = SAME_ERROR, least: float = 0.0
) -> Answer:
    """Those of at most `limit`, and a fraction `slack` more; values below `least` are taken as equal to it."""
    good: dict[str, Point] = {}
    other: dict[str, Point] = {}
    for point in points:
        if max(point.value, least) <= limit * (1 + slack):
            if point.method not in good or point.cost < good[point.method].cost:
                good[point.method] = point
        elif point.method not in other or point.value < other[point.method].value:
            other[point.method] = point
    margin = max(margin, SAME_EVALUATIONS)
    ranked = _placed(good.values(), lambda p: p.cost, lambda p, leader: p.cost <= leader * (1 + margin))
    beyond = sorted((point for name, point in other.items() if name not in good), key=lambda p: p.value)
    return Answer("", "", limit, "", "", True, margin, ranked, beyond)


# -- in words ---------------------------------------------------------------------------------------


def sentence(found: Answer) -> str:
    """The answer in one sentence."""
    if math.isinf(found.limit):
        first, *others = [r.point for r in found.ranked if r.place == 1]
        near = f"; within the errors as good: {', '.join(point.title for point in others)}" if others else ""
        off = f"the temperature of its configurations is off by {first.value:.2g} of it at most"
        return f"At {first.setting} use {first.title}: {off}{near}."
    limit = f"{found.what} of at most {found.limit:.2g} {found.unit} ({found.limit_is})"
    if not found.ranked:
        best = found.beyond[0]
        if best.value <= found.limit:
            return f"No method makes {limit}, which cannot be told from none: the reference is no better."
        return f"No method makes {limit}; the least is {best.value:.2g}, by {best.title} at {best.setting}."
    first = found.ranked[0].point
    text = f"Use {first.title} at {first.setting}: the least {found.cost}, {_spent(first.cost, found)}, for {limit}"
    ties = [r.point for r in found.ranked[1:] if r.place == 1]
    if ties:
        near = ", ".join(f"{point.title} at {point.setting}" for point in ties[:3])
        more = f" and {len(ties) - 3} more" if len(ties) > 3 else ""
        text += f"; as good within the margin of {100 * found.margin:.0f} %: {near}{more}"
    return f"{text}."


def ranking(found: Answer) -> Table:
    """The methods in their order, at most 80 columns wide; ties share their place."""
    tied = {r.place for r, after in zip(found.ranked, found.ranked[1:], strict=False) if r.place == after.place}
    rows = [
        [
            f"{r.place}{'=' if r.place in tied else ''}",
            _short(r.point.title),
            r.point.setting,
            f"{r.point.value:.1e}",
            _spent(r.point.cost, found),
            f"{r.ratio:.2f}" if r.ratio < 10 else f"{r.ratio:,.0f}",
        ]
        for r in found.ranked
    ]
    return Table(["", "method", "at", found.what.split()[1], "cost", "times"], rows, words=(0, 1))


def text(found: Answer) -> str:
    """Sentence, ranking, and who is not in it."""
    return "\n\n".join(filter(None, (sentence(found), places(found))))


def places(found: Answer) -> str:
    """The ranking, what it means, and who is not in it."""
    lines: list[str] = []
    if math.isinf(found.limit):
        lines += [plain_text(ranking(found)), ""]
        lines += [
            "deviation: with twice its standard error, which longer runs (--budget) make smaller; times: of the least."
        ]
        lines += [f"=: the intervals overlap. cost: {found.cost}."]
    elif found.ranked:
        lines += [plain_text(ranking(found)), ""]
        lines += [f"cost: {found.cost}; =: equal within {100 * found.margin:.0f} %, which is how well costs repeat."]
    if found.beyond and found.beyond[0].value > found.limit:
        lines += [f"Above {found.limit:.2g}: " + ", ".join(f"{p.title} {p.value:.1e}" for p in found.beyond) + "."]
    return "\n".join(lines)


def _short(title: str) -> str:
    """At most `TITLE` letters; what is left out is not the tolerance, by which methods differ that are called alike."""
    if len(title) <= TITLE:
        return title
    head, comma, tail = title.rpartition(", ")
    return f"{head[: TITLE - 1 - len(comma + tail)]}…{comma}{tail}"


def _spent(cost: float, found: Answer) -> str:
    return duration(cost) if found.seconds else f"{cost:,.0f}" if cost >= 100 else f"{cost:.3g}"
