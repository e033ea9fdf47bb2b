"""Who is on the front: no other method with the same forces is both cheaper and more accurate.

Methods are judged among those of one MD engine, which share forces and overhead. Costs are wall time and evaluations,
both a simulated unit of time. Where forces take less than `NO_FORCE`, wall time is that of the interpreter, and
evaluations decide. Evaluations can be compared across MD engines as well.

Wall times that differ by less than the margin are the same: that by which nine tenths of the medians over odd and over
even rounds of timing differ (`kcons.comparison.work_precision.timing_rounds.margin`), and `LEAST_MARGIN` at least.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

from kcons.comparison.methods.methods import METHODS
from kcons.comparison.work_precision.measurement import Comparison, Measurement

Cost = Literal["wall", "evaluations"]

#: Attribute of a measurement, and what it is called.
COSTS: dict[Cost, tuple[str, str]] = {
    "wall": ("seconds_per_time", "wall time"),
    "evaluations": ("evaluations_per_time", "force evaluations"),
}

#: MD engines with forces or overhead of their own; all others call the forces of the test system on plain arrays.
MD_ENGINES = {"openmm": "OpenMM", "ase": "ASE"}
ARRAYS = "arrays"
EVERY_MD_ENGINE = "all MD engines"

#: Forces that take less, beyond the call itself, do not count in a step: evaluations decide, in seconds.
NO_FORCE = 1e-6
#: Errors this many times that of the reference cannot be told from smaller ones, nor those of rounding.
RESOLVED = 3.0
ROUNDING = 1e-13
#: Errors that differ by this fraction are the same.
SAME_ERROR = 0.05
#: Evaluations that differ by this fraction are the same: a first evaluation more or less.
SAME_EVALUATIONS = 0.02
#: Wall times that differ by this fraction are the same, unless rounds of timing say more.
LEAST_MARGIN = 0.05


@dataclass(frozen=True)
class Loss:
    """A method that is not of kcons and, over a range of errors, cheaper than every method of kcons.

    Attributes
    ----------
    md_engine, method, title : str
    cost : {'wall', 'evaluations'}
    errors : tuple of float
        Smallest and largest error at which it is.
    factor : float
        How many times cheaper at most; inf where no method of kcons was measured at so small an error.
    """

    md_engine: str
    cost: Cost
    method: str
    title: str
    errors: tuple[float, float]
    factor: float


@dataclass(frozen=True)
class Standing:
    """Who is on the front of one MD engine, for one cost.

    Attributes
    ----------
    md_engine : str
    cost : {'wall', 'evaluations'}
    front : list of Measurement
        Cheapest first.
    rivals : bool
        Whether any method that is not of kcons, and any of kcons, has a point at all.
    losses : list of Loss
    gain : float or None
        The most by which kcons is cheaper at the error of a point of another method, that with the cheapest at this
        error; None without rivals.
    gain_error : float or None
        That error.
    rival : str or None
        Title of that other method.
    ours : str or None
        Title of the method of kcons that is.
    """

    md_engine: str
    cost: Cost
    front: Sequence[Measurement]
    rivals: bool
    losses: Sequence[Loss]
    gain: float | None = None
    gain_error: float | None = None
    rival: str | None = None
    ours: str | None = None


@dataclass(frozen=True)
class Verdict:
    """What a comparison says.

    Attributes
    ----------
    decides : {'wall', 'evaluations'}
        What decides in this test system, where its forces are those of the test system.
    margin : float
        Wall times that differ by less are the same.
    standings : list of Standing
    without_forces : frozenset of str
        MD engines that compute the forces themselves, and in less than `NO_FORCE`: evaluations decide there.
    """

    decides: Cost
    margin: float
    standings: Sequence[Standing]
    without_forces: frozenset[str] = frozenset()

    def decides_on(self, md_engine: str) -> Cost:
        """What decides among the methods of one MD engine."""
        return "evaluations" if md_engine == EVERY_MD_ENGINE or md_engine in self.without_forces else self.decides

    @property
    def losses(self) -> list[Loss]:
        """All losses in what decides, and in evaluations."""
        return [
            loss
            for standing in self.standings
            if standing.cost in (self.decides_on(standing.md_engine), "evaluations")
            for loss in standing.losses
        ]


def is_ours(m: Measurement) -> bool:
    """Whether constraints are held by kcons."""
    return "kcons" in m.title


def md_engine_of(method: str) -> str:
    """Whose loop and forces a method runs on."""
    return MD_ENGINES.get(METHODS[method].md_engine, ARRAYS) if method in METHODS else ARRAYS


def cost_of(m: Measurement, cost: Cost) -> float:
    """Wall time or force evaluations a simulated unit of time; NaN where it is not known."""
    value = getattr(m, COSTS[cost][0])
    return math.nan if value is None else float(value)


def resolution_of(comparison: Comparison) -> float:
    """The error below which methods cannot be told apart."""
    return max(RESOLVED * float(comparison.reference["error"]), ROUNDING)


def points(comparison: Comparison, cost: Cost, md_engine: str | None = None) -> list[Measurement]:
    """Measurements with an error and a cost, of one MD engine or of all."""
    return [
        m
        for m in comparison.measurements
        if m.status == "ok"
        and m.error is not None
        and math.isfinite(m.error)
        and cost_of(m, cost) > 0
        and (md_engine is None or md_engine_of(m.method) == md_engine)
    ]


def by_method(measurements: Iterable[Measurement]) -> dict[str, list[Measurement]]:
    """Curves: measurements of each method, in their order."""
    found: dict[str, list[Measurement]] = {}
    for m in measurements:
        found.setdefault(m.method, []).append(m)
    return found


def front(measurements: Iterable[Measurement], cost: Cost, resolution: float = 0.0) -> list[Measurement]:
    """Those that no other dominates, cheapest first: none costs as little and errs less, beyond `SAME_ERROR`.

    Parameters
    ----------
    measurements : iterable of Measurement
    cost : {'wall', 'evaluations'}
    resolution : float
        Errors below it are taken as equal to it.
    """
    kept: list[Measurement] = []
    for m in sorted(measurements, key=lambda m: (cost_of(m, cost), float(m.error or 0.0))):
        last = max(float(kept[-1].error or 0.0), resolution) if kept else math.inf
        if max(float(m.error or 0.0), resolution) < last * (1 - SAME_ERROR):
            kept.append(m)
    return kept


def needed(curve: Sequence[Measurement], cost: Cost, error: float) -> float:
    """What one method costs at an error: of its measured points, and between two neighbours on the straight line of
    the logarithms; inf below its smallest error.

    Parameters
    ----------
    curve : sequence of Measurement
        Of one method, in the order of its settings.
    cost : {'wall', 'evaluations'}
    error : float
    """
    known = [(math.log(max(float(m.error or 0.0), 1e-300)), math.log(cost_of(m, cost))) for m in curve]
    wanted = math.log(max(error, 1e-300))
    found = [c for e, c in known if e <= wanted]
    for (e0, c0), (e1, c1) in pairwise(known):
        if min(e0, e1) <= wanted <= max(e0, e1) and e0 != e1:
            found.append(c0 + (c1 - c0) * (wanted - e0) / (e1 - e0))
    return math.exp(min(found)) if found else math.inf


def cheapest(curves: Iterable[Sequence[Measurement]], cost: Cost, error: float) -> tuple[float, str]:
    """The least of what these methods need, and the title of the one; (inf, '') if none gets there."""
    least = min(((needed(curve, cost, error), curve[0].title) for curve in curves if curve), default=(math.inf, ""))
    return least if math.isfinite(least[0]) else (math.inf, "")


def verdict(comparison: Comparison) -> Verdict:
    """Fronts of each MD engine, and of evaluations across them, and where another method beats every one of kcons."""
    timing = comparison.timing
    no_force = timing.get("force_seconds") is not None and timing["force_seconds"] < NO_FORCE
    margin = max(LEAST_MARGIN, float(timing.get("margin") or 0.0))
    standings: list[Standing] = []
    md_engines = list(dict.fromkeys(md_engine_of(m.method) for m in points(comparison, "evaluations")))
    for md_engine in md_engines:
        for cost in COSTS:
            standings.append(_standing(comparison, md_engine, cost, margin))
    if len(md_engines) > 1:
        standings.append(_standing(comparison, EVERY_MD_ENGINE, "evaluations", margin))
    return Verdict("evaluations" if no_force else "wall", margin, standings, _md_engines_without_forces(comparison))


def _md_engines_without_forces(comparison: Comparison) -> frozenset[str]:
    """MD engines whose steps with nothing held take less than `NO_FORCE`, forces and all."""
    baselines = [
        (md_engine_of(m.method), m.step_seconds)
        for m in comparison.measurements
        if m.status == "baseline" and m.step_seconds is not None and md_engine_of(m.method) == MD_ENGINES["openmm"]
    ]
    return frozenset(md_engine for md_engine, seconds in baselines if seconds < NO_FORCE)


def _standing(comparison: Comparison, md_engine: str, cost: Cost, margin: float) -> Standing:
    resolution = resolution_of(comparison)
    here = points(comparison, cost, None if md_engine == EVERY_MD_ENGINE else md_engine)
    curves = by_method(here).values()
    ours = [curve for curve in curves if is_ours(curve[0])]
    theirs = [curve for curve in curves if not is_ours(curve[0])]
    on_front = front(here, cost, resolution)
    if not ours or not theirs:
        return Standing(md_engine, cost, on_front, False, [])
    allowed = 1 + (margin if cost == "wall" else SAME_EVALUATIONS)
    losses: list[Loss] = []
    gain: tuple[float, float, str, str] | None = None
    for curve in theirs:
        lost: list[tuple[float, float]] = []
        for m in curve:
            error = max(float(m.error or 0.0), resolution)
            price, winner = cheapest(ours, cost, error * (1 + SAME_ERROR))
            factor = price / cost_of(m, cost)
            if factor > allowed:
                lost.append((error, factor))
            # A peer that is itself beaten by another peer says nothing about kcons.
            if cost_of(m, cost) <= cheapest(theirs, cost, error)[0] * (1 + 1e-9) and math.isfinite(price):
                better = (1 / factor, error, m.title, winner)
                gain = better if gain is None else max(gain, better)
        if lost:
            errors = [error for error, _ in lost]
            worst = max(factor for _, factor in lost)
            losses.append(Loss(md_engine, cost, curve[0].method, curve[0].title, (min(errors), max(errors)), worst))
    return Standing(md_engine, cost, on_front, True, losses, *(gain or (None, None, None, None)))


def overtaken(comparison: Comparison) -> dict[str, list[tuple[Measurement, Measurement]]]:
    """Points on kcons' own front, each with one of another method that is both cheaper and more accurate.

    Cheaper by more than `LEAST_MARGIN` (evaluations: `SAME_EVALUATIONS`), more accurate by more than `SAME_ERROR`; by
    MD engine, in what decides there. MD engines without rivals are left out.
    """
    judged, least = verdict(comparison), resolution_of(comparison)
    found: dict[str, list[tuple[Measurement, Measurement]]] = {}
    for standing in judged.standings:
        md_engine, cost = standing.md_engine, standing.cost
        if not standing.rivals or cost != judged.decides_on(md_engine):
            continue
        here = points(comparison, cost, None if md_engine == EVERY_MD_ENGINE else md_engine)
        cheaper = 1 + (LEAST_MARGIN if cost == "wall" else SAME_EVALUATIONS)
        found[md_engine] = [
            (mine, other)
            for mine in front([m for m in here if is_ours(m)], cost, least)
            for other in here
            if not is_ours(other)
            and cost_of(other, cost) * cheaper < cost_of(mine, cost)
            and max(float(other.error or 0.0), least) < max(float(mine.error or 0.0), least) * (1 - SAME_ERROR)
        ]
    return found


# -- in words ---------------------------------------------------------------------------------------


def sentence(loss: Loss, unit: str) -> str:
    """One loss in words."""
    low, high = loss.errors
    where = f"at an error of {low:.0e}" if low == high else f"at errors from {low:.0e} to {high:.0e}"
    if math.isinf(loss.factor):
        much = "where nothing of kcons was measured"
    elif loss.factor < 2:
        much = f"up to {100 * (1 - 1 / loss.factor):.0f} % cheaper"
    else:
        much = f"up to {loss.factor:.2g} times cheaper"
    return f"{loss.title} {where} {unit}: {much} ({COSTS[loss.cost][1]}, {loss.md_engine})"


def together(losses: Sequence[Loss], unit: str) -> str:
    """All losses in one sentence: the worst by name, the others by number; '' without any."""
    if not losses:
        return ""
    worst = max(losses, key=lambda loss: loss.factor)
    errors = (min(loss.errors[0] for loss in losses), max(loss.errors[1] for loss in losses))
    others = len(losses) - 1
    more = "" if not others else f" and {others} other{'s' if others > 1 else ''}"
    return sentence(replace(worst, title=worst.title + more, errors=errors), unit)


def summary(comparison: Comparison) -> list[dict[str, Any]]:
    """One row an MD engine: who is on the front of what decides, what kcons gains, and what it loses."""
    found = verdict(comparison)
    unit = comparison.error_unit
    rows = []
    for standing in found.standings:
        if standing.cost != found.decides_on(standing.md_engine):
            continue
        beside = next(
            (s for s in found.standings if s.md_engine == standing.md_engine and s.cost != standing.cost), None
        )
        rows.append(
            {
                "md_engine": standing.md_engine,
                "cost": COSTS[standing.cost][1],
                "front": list(dict.fromkeys(m.title for m in standing.front)),
                "rivals": standing.rivals,
                "gain": standing.gain,
                "gain_error": standing.gain_error,
                "ours": standing.ours,
                "rival": standing.rival,
                "lost": together(standing.losses, unit),
                "lost_beside": "" if beside is None else together(beside.losses, unit),
                "losses": [sentence(loss, unit) for loss in standing.losses],
                "beside": [] if beside is None else [sentence(loss, unit) for loss in beside.losses],
            }
        )
    return rows
