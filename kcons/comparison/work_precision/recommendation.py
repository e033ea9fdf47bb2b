"""Which method, and which step, for an error that is asked for? Found by measurement on the system itself.

From the measured points, the step at which each method makes that error is predicted by its observed order. Those that
promise to be the cheapest are run there, and again with shorter or longer steps, until the cheapest one that was seen
to reach the error is known. The default of its MD engine is asked for the same error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from kcons.comparison.methods.method import Method
from kcons.comparison.methods.methods import METHODS
from kcons.comparison.methods.snippets import code
from kcons.comparison.study.study import Watcher
from kcons.comparison.study.tables import duration
from kcons.comparison.test_systems import Reference, TestSystem
from kcons.comparison.work_precision.fronts import (
    COSTS,
    EVERY_MD_ENGINE,
    Cost,
    by_method,
    cost_of,
    is_ours,
    md_engine_of,
    points,
    resolution_of,
    verdict,
)
from kcons.comparison.work_precision.measure import Bench, warm_up
from kcons.comparison.work_precision.measurement import Comparison, Measurement
from kcons.comparison.work_precision.timing_rounds import Rounds
from kcons.errors import InputError

#: Steps are predicted for this part of the error, since the prediction may be off.
SAFETY = 0.85
#: A step that makes less than this part of the error was too short.
WASTE = 0.5
#: Runs of one method, and methods that are run.
TRIES = 5
FINALISTS = 4
#: Orders between which a prediction is believed.
ORDERS = (0.5, 10.0)
#: A prediction reaches this far beyond what was measured, as a ratio of steps.
REACH = 30.0
#: Defaults: OpenMM's and ASE's users take 2 fs with bonds held; SciPy's own tolerance.
DEFAULT_STEP, DEFAULT_RTOL = 2.0, 1e-3


@dataclass(frozen=True)
class Prediction:
    """Where one method is expected to make an error, and what that costs a simulated unit of time.

    Attributes
    ----------
    method : str
    setting : float
        Time step in the test system's shown unit, or tolerance.
    order : float
        Slope of the logarithms, error against setting.
    wall, evaluations : float
    """

    method: str
    setting: float
    order: float
    wall: float
    evaluations: float

    def cost(self, cost: Cost) -> float:
        return self.wall if cost == "wall" else self.evaluations


def predicted(curve: Sequence[Measurement], error: float, resolution: float = 0.0) -> Prediction | None:
    """Predict the setting of one method for `error` from its measured points, by the slope next to it.

    Parameters
    ----------
    curve : sequence of Measurement
        Of one method, in the order of its settings, all with errors.
    error : float
    resolution : float
        Points with smaller errors say nothing about the slope.

    Returns
    -------
    prediction : Prediction or None
        None where fewer than two points are above the resolution, or the error does not fall with the setting.
    """
    used = sorted((m for m in curve if m.error), key=lambda m: -m.setting)
    above = [m for m in used if float(m.error or 0.0) > resolution]
    if len(above) < 2:
        return None
    # The pair around the error, else the two nearest to it.
    after = next((k for k, m in enumerate(above) if float(m.error or 0.0) <= error), len(above) - 1)
    first, second = above[max(after, 1) - 1], above[max(after, 1)]
    step = math.log(first.setting / second.setting)
    order = math.log(float(first.error or 0.0) / float(second.error or 0.0)) / step
    if not ORDERS[0] <= order <= ORDERS[1]:
        return None
    near = first if float(first.error or 0.0) <= error else second
    log_ratio = math.log(error / float(near.error or 0.0)) / order
    if abs(log_ratio) > math.log(REACH):
        return None

    def at(cost: Cost) -> float:
        slope = -1.0
        if near.adaptive:
            slope = math.log(cost_of(first, cost) / cost_of(second, cost)) / step
        return cost_of(near, cost) * math.exp(slope * log_ratio)

    return Prediction(near.method, near.setting * math.exp(log_ratio), order, at("wall"), at("evaluations"))


def recommend(
    test_system: TestSystem,
    comparison: Comparison,
    target: float,
    *,
    reference: Reference,
    made_by: str,
    budget: float = 30.0,
    watcher: Watcher | None = None,
    rounds: Rounds | None = None,
) -> Comparison:
    """Find the cheapest method and step that make at most the error `target` at the horizon.

    Parameters
    ----------
    test_system : TestSystem
    comparison : Comparison
        Of this test system.
    target : float
        Root-mean-square distance an atom from the reference, in the test system's unit of length.
    reference : Reference
        The one of the comparison.
    made_by : str
        The expression that makes the test system, for the lines of code.
    budget : float
        Seconds for a run.
    watcher : Watcher, optional
    rounds : Rounds, optional
        Those in which the comparison timed short runs.

    Returns
    -------
    comparison : Comparison
        With the new measurements and `recommendation`.

    Raises
    ------
    InputError
        A target that is not positive.
    """
    if not (math.isfinite(target) and target > 0):
        raise InputError(f"the target error is {target}; give a positive number", item="target_error")
    bench = Bench(test_system, reference, budget, watcher or Watcher(), rounds)
    decides = verdict(comparison).decides
    resolution = resolution_of(comparison)
    curves = by_method(points(comparison, "wall"))
    found: list[Measurement] = []
    if target >= resolution:
        warm_up(test_system, [METHODS[name] for name in curves])
        promising = sorted(
            (p for curve in curves.values() if (p := predicted(curve, SAFETY * target, resolution)) is not None),
            key=lambda p: p.cost(decides),
        )
        for prediction in promising[:FINALISTS]:
            limit = min((cost_of(m, decides) for m in found if _reaches(m, target)), default=math.inf)
            if prediction.cost(decides) < 1.5 * limit:
                found += reach(bench, prediction, target)
    found, _ = bench.timed_again(found)
    everything = _sorted([*(m for curve in curves.values() for m in curve), *found])
    able = [m for m in everything if target >= resolution and _reaches(m, target)]
    entry: dict[str, Any] = {"target": target, "decides": COSTS[decides][1], "reached": bool(able)}
    if able:
        best = _cheapest(able, decides)
        default, more = _default(bench, comparison, METHODS[best.method].md_engine, target)
        found += more
        # It may be the default itself.
        best = _cheapest([best, *(m for m in more if _reaches(m, target))], decides)
        entry |= {**_facts(best), "code": code(test_system, best.method, best.setting, made_by), "default": default}
        if default is not None and "needs" in default:
            default["gain"] = {cost: default["needs"][COSTS[cost][0]] / cost_of(best, cost) for cost in COSTS}
    else:
        entry["why"] = _why_not(comparison, target, resolution)
        usable = [m for m in everything if m.error]
        if usable:
            entry["best"] = _facts(min(usable, key=lambda m: max(float(m.error or 0.0), resolution)))
    measurements = [*comparison.measurements, *found]
    return replace(comparison, measurements=_sorted(measurements), recommendation=entry)


def sharpen(bench: Bench, comparison: Comparison) -> Comparison:
    """Where another method seems to be ahead of kcons: the step of kcons that makes the same error is tried.

    Steps of a test system are the same for all. Where a method needs far fewer of them, or gets farther, its points lie
    beyond those of the others, and nothing could be said of who is cheaper there.

    Parameters
    ----------
    bench : Bench
        That of the comparison.
    comparison : Comparison
    """
    resolution = resolution_of(comparison)
    curves = by_method(points(comparison, "wall"))
    judged = verdict(comparison)
    found: list[Measurement] = []
    tried: set[tuple[str, float]] = set()
    for standing in judged.standings:
        ours = [
            c
            for c in curves.values()
            if is_ours(c[0]) and standing.md_engine in (md_engine_of(c[0].method), EVERY_MD_ENGINE)
        ]
        if standing.cost not in (judged.decides_on(standing.md_engine), "evaluations") or not ours:
            continue
        for target in sorted({max(error, resolution) for loss in standing.losses for error in loss.errors}):
            predictions = [p for c in ours if (p := predicted(c, SAFETY * target, resolution)) is not None]
            best = min(predictions, key=lambda p: p.cost(standing.cost), default=None)
            if best is not None and (best.method, target) not in tried:
                tried.add((best.method, target))
                warm_up(bench.test_system, [METHODS[best.method]])
                found += reach(bench, best, target)
    found, _ = bench.timed_again(found)
    return replace(comparison, measurements=_sorted([*comparison.measurements, *found]))


def reach(bench: Bench, prediction: Prediction, target: float) -> list[Measurement]:
    """Run one method at the predicted step, and near it, until its longest step that makes the error is known.

    Parameters
    ----------
    bench : Bench
        A run that would take longer than its budget is not made.
    prediction : Prediction
    target : float

    Returns
    -------
    found : list of Measurement
        All runs that were made.
    """
    test_system, method = bench.test_system, METHODS[prediction.method]
    seconds = prediction.wall * test_system.horizon / test_system.units.long_time_unit
    found: list[Measurement] = []
    if seconds > bench.budget:
        return found
    setting = prediction.setting
    good, bad = 0.0, math.inf  # the longest step that reaches the error, the shortest that does not
    least = math.inf
    for _ in range(TRIES):
        setting = _divided(test_system, method, setting, bad)
        if setting <= good or setting >= bad:
            break
        internal = setting if method.adaptive else setting * test_system.units.time_unit
        m = bench.measure(method, internal)
        found.append(m)
        if m.status not in ("ok", "failed"):
            break
        error = m.error if m.error is not None and math.isfinite(m.error) else math.inf
        if error <= target:
            good = setting
            if error >= WASTE * target or error == 0:
                break
        else:
            if bad < math.inf and error > 0.9 * least:
                break  # shorter steps do not help: something else than the step decides
            bad, least = setting, min(error, least)
        ratio = 0.7 if math.isinf(error) else (SAFETY * target / error) ** (1 / prediction.order)
        setting *= min(max(ratio, 0.3), 3.0)
    return found


def _divided(test_system: TestSystem, method: Method, setting: float, bad: float) -> float:
    """The longest step that divides the horizon and is not longer than `setting`, shorter than one known to be bad."""
    if method.adaptive:
        return setting
    horizon = test_system.horizon / test_system.units.time_unit
    count = max(1, math.ceil(horizon / setting * (1 - 1e-9)))
    if horizon / count >= bad * (1 - 1e-9):
        count += 1
    return horizon / count


def _reaches(m: Measurement, target: float) -> bool:
    return m.status == "ok" and m.error is not None and m.error <= target and cost_of(m, "wall") > 0


def _cheapest(measurements: Sequence[Measurement], decides: Cost) -> Measurement:
    return min(measurements, key=lambda m: (cost_of(m, decides), cost_of(m, "wall")))


def _facts(m: Measurement) -> dict[str, Any]:
    names = ("method", "title", "setting", "adaptive", "error", "evaluations_per_time", "seconds_per_time", "steps")
    return {name: getattr(m, name) for name in names}


def _default(
    bench: Bench, comparison: Comparison, md_engine: str, target: float
) -> tuple[dict[str, Any] | None, list[Measurement]]:
    """What an MD engine does unless told otherwise: at its usual step, and at this error."""
    test_system = bench.test_system
    name = default_method(test_system, md_engine)
    if name is None:
        return None, []
    method = METHODS[name]
    horizon = test_system.horizon / test_system.units.time_unit
    molecular = test_system.units.energy == "eV"
    usual = DEFAULT_STEP if molecular else comparison.scene["horizon"] / 20
    setting = DEFAULT_RTOL if method.adaptive else horizon / max(1, round(horizon / usual))
    curve = by_method(points(comparison, "wall")).get(name, [])
    found: list[Measurement] = []
    first = next((m for m in curve if abs(m.setting - setting) < 1e-9 * setting), None)
    if first is None:
        warm_up(test_system, [method])
        unit = 1.0 if method.adaptive else test_system.units.time_unit
        (first,), _ = bench.timed_again([bench.measure(method, setting * unit)])
        found.append(first)
        if not curve and first.error:  # one point has no order
            another = setting / 10 if method.adaptive else horizon / max(1, first.steps // 2)
            found += bench.timed_again([bench.measure(method, another * unit)])[0]
    entry: dict[str, Any] = {**_facts(first), "status": first.status, "note": first.note}
    known = _sorted([*curve, *(m for m in found if m.status == "ok" and m.error)])
    reached = [m for m in known if _reaches(m, target)]
    prediction = predicted(known, SAFETY * target, resolution_of(comparison))
    if prediction is not None:
        more, _ = bench.timed_again(reach(bench, prediction, target))
        found += more
        reached += [m for m in more if _reaches(m, target)]
    if reached:
        entry["needs"] = {**_facts(_cheapest(reached, "wall")), "measured": True}
    elif (far := predicted(known, target, resolution_of(comparison))) is not None:
        entry["needs"] = {
            "setting": far.setting,
            "seconds_per_time": far.wall,
            "evaluations_per_time": far.evaluations,
            "measured": False,
        }
    return entry, found


def default_method(test_system: TestSystem, md_engine: str) -> str | None:
    """What a user of this MD engine takes who has not thought about it; None if it cannot run the test system."""
    names = ("openmm-verlet",) if md_engine == "openmm" else ("ase-bonds", "dop853")
    return next((name for name in names if METHODS[name].refuses(test_system) is None), None)


def _why_not(comparison: Comparison, target: float, resolution: float) -> str:
    unit = comparison.error_unit
    good = float(comparison.reference["error"])
    if target < resolution:
        return (
            f"the reference itself ({comparison.reference['how']}) is good to {good:.1g} {unit}, so that errors "
            f"below {resolution:.1g} {unit} cannot be told from none; the forces are {comparison.scene['forces']}"
        )
    late = [m for m in comparison.measurements if m.status in ("partial", "not run") and "budget" in m.note]
    more = f"; {len(late)} runs were stopped for the budget, which --budget raises" if late else ""
    return f"no method made so small an error within the steps that were tried{more}"


def _sorted(measurements: Sequence[Measurement]) -> list[Measurement]:
    """Methods in the order of their first appearance, steps from long to short; a setting counts once."""
    order = {name: k for k, name in enumerate(dict.fromkeys(m.method for m in measurements))}
    seen: dict[tuple[str, float, str], Measurement] = {}
    for m in measurements:
        seen.setdefault((m.method, m.setting, m.status), m)
    return sorted(seen.values(), key=lambda m: (order[m.method], -m.setting))


# -- in words ---------------------------------------------------------------------------------------


def sentences(comparison: Comparison) -> str:
    """What was found, for the terminal."""
    entry = comparison.recommendation
    if entry is None:
        return ""
    units = {**comparison.scene["units"], "error": comparison.error_unit}
    wanted = f"{entry['target']:.3g} {units['error']} at {comparison.scene['horizon']:g} {units['time']}"
    if not entry["reached"]:
        lines = [f"No method reaches an error of {wanted}: {entry['why']}."]
        if "best" in entry:
            lines.append(f"Best: {_row(entry['best'], units)}.")
        return "\n".join(lines)
    lines = [f"For an error of at most {wanted}, the cheapest in {entry['decides']}: {_row(entry, units)}."]
    default = entry.get("default")
    if default is not None:
        lines.append(_about_default(entry, default, units))
    return "\n".join([*lines, "", entry["code"].rstrip()])


def _row(m: Mapping[str, Any], units: Mapping[str, str]) -> str:
    return (
        f"{m['title']} {_at(m, units)}, error {m['error']:.2e} {units['error']}, "
        f"{m['evaluations_per_time']:,.0f} force evaluations and {duration(m['seconds_per_time'])} "
        f"a simulated {units['long_time']}"
    )


def _at(m: Mapping[str, Any], units: Mapping[str, str]) -> str:
    return f"at rtol {m['setting']:.2g}" if m["adaptive"] else f"at {m['setting']:.4g} {units['time']}"


def _about_default(entry: Mapping[str, Any], default: Mapping[str, Any], units: Mapping[str, str]) -> str:
    start = f"To compare: {default['title']} {_at(default, units)}, the default of its MD engine, "
    if default["error"] is None:
        why = ": ".join(word for word in (default["status"], default["note"]) if word)
        return f"{start}has no error to compare with ({why})."
    start += f"makes {default['error']:.2e} {units['error']}"
    if "needs" not in default:
        return f"{start}; from its points it cannot be said what it needs for this error."
    needs, gain = default["needs"], default["gain"]
    if default["method"] == entry["method"]:
        return f"{start}; it is the same method at another setting."
    at = _at({**needs, "adaptive": default["adaptive"]}, units)
    how = "measured" if needs["measured"] else "extrapolated"
    return (
        f"{start}; it needs {at.removeprefix('at ')} for this error ({how}): {_times(gain['wall'])} times the wall "
        f"time and {_times(gain['evaluations'])} times the force evaluations."
    )


def _times(ratio: float) -> str:
    """Two digits, and no exponent."""
    return f"{float(f'{ratio:.2g}'):,.12g}"
