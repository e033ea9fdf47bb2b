"""What a table of measurements says: which method and which step, for which error.

Methods are compared by processor time; where there are forces that take less than a microsecond, which is less than a
call from Python, by force evaluations. Costs that differ by less than the scatter of the times are the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd

from kcons.comparison.measure import measure
from kcons.comparison.methods import METHODS
from kcons.comparison.progress import Watcher
from kcons.comparison.test_systems import Reference, TestSystem
from kcons.comparison.test_systems.potential import NO_FORCES
from kcons.constraints.arguments import Positive, checked
from kcons.errors import InputError

Criterion = Literal["error", "temperature"]

#: Columns of costs, and what they are called.
COSTS = {"seconds": "processor time", "evaluations": "force evaluations"}
#: Forces that take less, beyond the call itself, do not count in a step: evaluations decide, in seconds.
NO_FORCE = 1e-6
#: Errors this many times that of the reference cannot be told from smaller ones, nor those of rounding.
RESOLVED, ROUNDING = 3.0, 1e-13
#: Errors, times and evaluations that differ by these fractions are the same, unless rounds of timing say more.
SAME_ERROR, SAME_TIME, SAME_EVALUATIONS = 0.05, 0.05, 0.02
#: Methods whose error is what is usually accepted, and the step of it where time is in fs.
USUAL_METHODS = ("rattle", "openmm-kcons-rattle", "ase-kcons", "openmm-verlet")
USUAL_STEP = 2.0
#: Steps are predicted for this part of the error, since the prediction may be off; one that makes less than `WASTE` of
#: it was too short. So many runs of one method, and so many methods, are tried.
SAFETY, WASTE, TRIES, FINALISTS = 0.85, 0.5, 5, 4
#: Deviation of a temperature that is right enough.
RIGHT = 0.01
#: Orders between which a prediction is believed, and how far it reaches beyond what was measured, as a ratio of steps.
ORDERS, REACH = (0.5, 10.0), 30.0


def cost_that_decides(table: pd.DataFrame) -> str:
    """'seconds', or 'evaluations' where there are forces that take no time."""
    if "force_seconds" not in table.attrs:
        raise InputError("the table does not say of what it is; read it by kcons.comparison.read_csv", item="table")
    forced = table.attrs.get("forces") != NO_FORCES
    return "evaluations" if forced and table.attrs["force_seconds"] < NO_FORCE else "seconds"


def resolution(table: pd.DataFrame) -> float:
    """The error below which methods cannot be told apart."""
    return max(RESOLVED * float(table.attrs["reference_error"]), ROUNDING)


def scatter(table: pd.DataFrame, cost: str) -> float:
    """The fraction by which costs may differ and still be the same."""
    return SAME_EVALUATIONS if cost == "evaluations" else max(SAME_TIME, float(table.attrs.get("margin") or 0.0))


def with_errors(table: pd.DataFrame) -> pd.DataFrame:
    """Rows that have an error and a cost."""
    return table[(table.status == "ok") & np.isfinite(table.error.astype(float)) & (table.evaluations > 0)]


def observed_orders(table: pd.DataFrame) -> dict[str, float]:
    """Title -> slope of log(error) against log(time step), at the two finest steps above the error of the reference.

    Methods with fewer than two such steps are left out.
    """
    done = with_errors(table)
    done = done[~done.adaptive.astype(bool) & (done.error > max(5 * table.attrs["reference_error"], 1e-12))]
    found = {}
    for title, rows in done.groupby("title", sort=False):
        last = rows.sort_values("setting", ascending=False).tail(2)
        if len(last) == 2:
            (h0, h1), (e0, e1) = last.setting, last.error
            found[str(title)] = math.log(e0 / e1) / math.log(h0 / h1)
    return found


def pareto(rows: pd.DataFrame, cost: str, least: float = 0.0) -> pd.DataFrame:
    """Rows that no other one dominates, cheapest first; errors below `least` are taken as equal to it."""
    ordered = rows.sort_values([cost, "error"])
    kept, last = [], math.inf
    for index, error in zip(ordered.index, ordered.error.clip(lower=least), strict=True):
        if error < last * (1 - SAME_ERROR):
            kept.append(index)
            last = error
    return ordered.loc[kept]


# -- the ranking ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ranking:
    """The cheapest setting of each method that is good enough, by place."""

    #: Rows of the comparison with 'place', 'cost' and 'times' (of the first). Methods whose costs differ by less than
    #: the scatter share a place, the one with the shortest step first, and of equal steps a usual method.
    table: pd.DataFrame
    #: The best row of each method that is not good enough.
    beyond: pd.DataFrame
    #: The largest error that is good enough, and where it comes from.
    limit: float
    limit_is: str
    #: What methods are judged by.
    what: str
    unit: str
    #: A key of `COSTS`.
    cost: str
    #: Costs that differ by this fraction are the same.
    scatter: float


@checked
def rank(table: pd.DataFrame, criterion: Criterion = "error", limit: Positive | None = None) -> Ranking | None:
    """Rank methods; None where nothing can be ranked.

    Parameters
    ----------
    table : DataFrame
        From `kcons.comparison.compare`.
    criterion : {'error', 'temperature'}
        The error of the trajectory, or, for a table of averages, how far the temperature of the configurations is off.
    limit : float, optional
        The largest error that is good enough; by default what the usual method makes at its usual step, and 1 % of the
        temperature.
    """
    about, cost = table.attrs, cost_that_decides(table)
    done = with_errors(table)
    least = resolution(table) if criterion == "error" else 0.0
    if not len(done):
        return None
    done = done.assign(cost=done[cost])
    limit_is, slack = "asked for", 0.0
    if limit is None and criterion == "temperature":
        limit, limit_is = RIGHT, "two standard errors included"
    elif limit is None:
        limit, limit_is = _usual(done, about)
        if limit < least:
            limit, limit_is = least, "the least that the reference can tell apart"
        slack = SAME_ERROR
    good = done[done.error.clip(lower=least) <= limit * (1 + slack)]
    best = good.sort_values("cost").drop_duplicates("method")
    beyond = done[~done.method.isin(good.method)].sort_values("error").drop_duplicates("method")
    same = scatter(table, cost)
    best = best.assign(place=_places(list(best.cost), same), times=best.cost / best.cost.min())
    best = best.loc[best.method.isin(USUAL_METHODS).sort_values(ascending=False, kind="stable").index]
    return Ranking(
        table=best.sort_values(["place", "adaptive", "setting"], kind="stable"),
        beyond=beyond,
        limit=limit,
        limit_is=limit_is,
        what=about.get("what", "error"),
        unit=about["error_unit"],
        cost=cost,
        scatter=same,
    )


def _places(costs: Sequence[float], same: float) -> list[int]:
    """Of costs in their order; those within the scatter of the first of a place share it."""
    places: list[int] = []
    place, leader = 1, -math.inf
    for number, cost in enumerate(costs, 1):
        if cost > leader * (1 + same):
            place, leader = number, cost
        places.append(place)
    return places


def _usual(done: pd.DataFrame, about: Mapping[str, Any]) -> tuple[float, str]:
    """What is usually accepted: that of the plainest method that ran, at 2 fs or at its second longest step."""
    for name in USUAL_METHODS:
        rows = done[done.method == name].sort_values("setting", ascending=False)
        if len(rows):
            row = rows.iloc[min(1, len(rows) - 1)]
            if about["time"] == "fs":
                row = rows.loc[(np.log(rows.setting.astype(float) / USUAL_STEP)).abs().idxmin()]
            return float(row.error), f"that of {row.title} at {shown_setting(row, about)}"
    return float(done.error.median()), "the median of all runs"


def shown_setting(row: Any, about: Mapping[str, Any]) -> str:
    """'2 fs', 'rtol 1e-6', or '2 fs, 5/ps' with a friction."""
    friction = getattr(row, "friction", 0.0)
    rate = f", {friction:.2g}/{about['long_time']}" if friction and friction > 0 else ""
    return f"rtol {row.setting:.0e}" if row.adaptive else f"{row.setting:.4g} {about['time']}{rate}"


# -- a wanted error ---------------------------------------------------------------------------------


def predict(rows: pd.DataFrame, error: float, least: float = 0.0) -> dict[str, Any] | None:
    """The setting of one method for an error, from its rows, by the slope next to it; with the order and the costs.

    None where fewer than two errors are above `least`, or the error does not fall with the setting.
    """
    above = rows[rows.error > least].sort_values("setting", ascending=False)
    if len(above) < 2:
        return None
    # The pair around the error, else the two nearest to it.
    after = next((k for k, e in enumerate(above.error) if e <= error), len(above) - 1)
    first, second = above.iloc[max(after, 1) - 1], above.iloc[max(after, 1)]
    step = math.log(first.setting / second.setting)
    order = math.log(first.error / second.error) / step
    if not ORDERS[0] <= order <= ORDERS[1]:
        return None
    near = first if first.error <= error else second
    ratio = math.log(error / near.error) / order
    if abs(ratio) > math.log(REACH):
        return None
    found = {"method": near.method, "setting": near.setting * math.exp(ratio), "order": order}
    for cost in COSTS:
        slope = math.log(first[cost] / second[cost]) / step if near.adaptive else -1.0
        found[cost] = float(near[cost] * math.exp(slope * ratio))
    return found


@checked
def find_steps(
    system: TestSystem,
    table: pd.DataFrame,
    target: Positive,
    reference: Reference,
    *,
    budget: float = 20.0,
    watcher: Watcher | None = None,
) -> list[dict[str, Any]]:
    """Run the methods that promise to make an error at the least cost, at the longest steps that do.

    Parameters
    ----------
    system : TestSystem
    table : DataFrame
        Of this test system.
    target : float
        Root-mean-square distance of the atoms from the reference.
    reference : Reference
        The one of the comparison.
    budget : float
        Seconds for a run.
    watcher : Watcher, optional

    Returns
    -------
    list of dict
        New rows for the table.
    """
    cost, least = cost_that_decides(table), resolution(table)
    if target < least:
        return []
    predicted = (predict(rows, SAFETY * target, least) for _, rows in with_errors(table).groupby("method"))
    promising = sorted((p for p in predicted if p is not None), key=lambda p: float(p[cost]))
    found: list[dict[str, Any]] = []
    before = with_errors(table).to_dict("records")
    for promise in promising[:FINALISTS]:
        reached = (row[cost] for row in [*before, *found] if row.get("error", math.inf) <= target)
        best = min(reached, default=math.inf)
        seconds = promise["seconds"] * system.horizon / system.units.long_time_unit
        if promise[cost] < 1.5 * best and seconds <= budget:
            found += _search(system, promise, table, target, reference, budget, watcher)
    return found


def _search(
    system: TestSystem,
    promise: dict[str, Any],
    table: pd.DataFrame,
    target: float,
    reference: Reference,
    budget: float,
    watcher: Watcher | None,
) -> list[dict[str, Any]]:
    """Runs of one method at the predicted step and near it, until its longest step that makes the error is known."""
    method, found = METHODS[promise["method"]], list[dict[str, Any]]()
    unit = 1.0 if method.adaptive else system.units.time_unit
    tried = table[(table.method == method.name) & table.status.isin(["ok", "failed"])]
    settings, reached = unit * tried.setting, tried.error <= target
    # The shortest step that does not reach the error, the longest of shorter ones that does.
    setting, bad = promise["setting"] * unit, min(settings[~reached], default=math.inf)
    good = max(settings[reached & (settings < bad)], default=0.0)
    for _ in range(TRIES):
        if not method.adaptive:  # the longest step that divides the horizon and is not longer, shorter than a bad one
            count = max(1, math.ceil(system.horizon / setting * (1 - 1e-9)))
            setting = system.horizon / (count + (system.horizon / count >= bad * (1 - 1e-9)))
        if not good * (1 + 1e-9) < setting < bad:
            break
        found.append(measure(system, method, setting, reference, budget, watcher=watcher))
        error = found[-1].get("error", math.inf)
        if found[-1]["status"] not in ("ok", "failed"):
            break
        if error <= target:
            good = setting
            if error >= WASTE * target or error == 0:
                break
        else:
            bad = setting
        ratio = 0.7 if not math.isfinite(error) else (SAFETY * target / error) ** (1 / promise["order"])
        setting *= min(max(ratio, 0.3), 3.0)
    return found
