"""Which curves a diagram shows: few, and those that coincide as one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from kcons.comparison.work_precision.answer import answer
from kcons.comparison.work_precision.fronts import (
    EVERY_MD_ENGINE,
    SAME_ERROR,
    SAME_EVALUATIONS,
    Verdict,
    by_method,
    is_ours,
    points,
    verdict,
)
from kcons.comparison.work_precision.measurement import Comparison, Measurement

#: Curves of a diagram, unless more are asked for.
MOST = 8


@dataclass(frozen=True)
class Chosen:
    """One curve: a method, and others that make the same errors for the same costs.

    Attributes
    ----------
    method, label : str
        Of the first of them.
    points : list of Measurement
    alike : list of str
        Titles of the others.
    """

    method: str
    label: str
    points: Sequence[Measurement]
    alike: Sequence[str] = ()

    @property
    def name(self) -> str:
        """The label, and how many others are meant."""
        more = len(self.alike)
        return self.label + (f" = {self.alike[0]}" if more == 1 else f" = {more} others" if more else "")


def chosen(comparison: Comparison, most: int = MOST) -> list[Chosen]:
    """Curves of a comparison, at most so many, in the order of its measurements.

    Kept are, in turn, the best of kcons and the best of others: those with most points on a front of their MD engine,
    then those that are first in the ranking.
    """
    judged = verdict(comparison)
    merged: list[Chosen] = []
    for name, curve in by_method(m for m in points(comparison, "evaluations") if m.error).items():
        like = next((k for k, other in enumerate(merged) if _alike(other.points, curve, judged)), None)
        if like is None:
            merged.append(Chosen(name, curve[0].title, curve))
        else:
            merged[like] = replace(merged[like], alike=[*merged[like].alike, curve[0].title])
    if len(merged) <= most:
        return merged
    on_fronts = [
        m.method
        for s in judged.standings
        if s.md_engine != EVERY_MD_ENGINE
        for m in {id(m): m for m in s.front}.values()
    ]
    found = answer(comparison)
    places = {} if found is None else {r.point.method: k for k, r in enumerate(found.ranked)}
    order = sorted(merged, key=lambda c: (-on_fronts.count(c.method), places.get(c.method, len(places))))
    ours = [c for c in order if is_ours(c.points[0])]
    others = [c for c in order if not is_ours(c.points[0])]
    # RATTLE is what everybody knows.
    ours.sort(key=lambda c: c.method != "rattle")
    kept = [*ours[: most - min(len(others), most // 2)], *others][:most]
    return [c for c in merged if c in kept]


def _alike(one: Sequence[Measurement], two: Sequence[Measurement], judged: Verdict) -> bool:
    """Whether two methods have the same settings, errors and costs."""
    return len(one) == len(two) and all(
        a.setting == b.setting
        and abs(math.log(float(a.error or 1.0) / float(b.error or 1.0))) <= SAME_ERROR
        and _same(a.evaluations_per_time, b.evaluations_per_time, SAME_EVALUATIONS)
        and _same(a.seconds_per_time, b.seconds_per_time, judged.margin)
        for a, b in zip(one, two, strict=True)
    )


def _same(one: float | None, two: float | None, margin: float) -> bool:
    return (not one and not two) or (
        bool(one and two) and max(one or 0, two or 0) <= (1 + margin) * min(one or 0, two or 0)
    )
