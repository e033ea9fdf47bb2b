"""Work and precision of constraint solvers alone: residual against time a constraint, for positions and velocities."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from kcons.comparison.solvers_alone.bare_solvers import CANDIDATES, STAGES, Candidate
from kcons.comparison.solvers_alone.bare_systems import BareSystem, chain, methyl, protein, water
from kcons.comparison.study.curves import Curve, Panel, draw
from kcons.comparison.study.study import Watcher, work_off
from kcons.comparison.study.tables import Table
from kcons.errors import UnsupportedError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMAT = "kcons-solver-precision-1"
#: What is measured: name, how it is built, and whether in a quick run too.
SYSTEMS: Mapping[str, tuple[Callable[[], BareSystem], bool]] = {
    "water": (lambda: water(1000), False),
    "water-small": (lambda: water(64), True),
    "methyl": (lambda: methyl(1000), False),
    "methyl-small": (lambda: methyl(100), True),
    "chain": (lambda: chain(1000), False),
    "chain-small": (lambda: chain(100), True),
    "dhfr-allbonds": (lambda: protein("allbonds"), False),
    "dhfr-hangles": (lambda: protein("hangles"), False),
}
#: A solver that takes longer than this, in seconds, is not asked for a tighter tolerance.
PATIENCE, QUICK_PATIENCE = 20.0, 1.0
#: What stands for both stages where neither was done.
BOTH = "P and V"
#: Below this there is nothing but rounding.
LEAST_RESIDUAL = 1e-17
#: Colour and marker of each solver.
LOOKS: Mapping[str, Mapping[str, str]] = {
    "kcons": {"color": "#0072B2", "marker": "o"},
    "sweeps": {"color": "#a6611a", "marker": "v"},
    "ase": {"color": "#D55E00", "marker": "^"},
    "openmm": {"color": "#009E73", "marker": "s"},
    "lammps": {"color": "#6a51a3", "marker": "D"},
}


def measure(
    *,
    quick: bool = False,
    keep: Callable[[dict[str, Any]], None] | None = None,
    watcher: Watcher | None = None,
    earlier: Mapping[str, Any] | None = None,
    systems: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Time every solver at every tolerance.

    Parameters
    ----------
    quick : bool
        Small systems, and little patience.
    keep : callable, optional
        Gets the result so far after each solver.
    watcher : Watcher, optional
    earlier : mapping, optional
        An unfinished result: what is in it is not measured again.
    systems : sequence of str, optional
        Keys of `SYSTEMS`; by default those of a quick or a full run.

    Returns
    -------
    dict
        Plain data for JSON: 'points', each with system, solver, tolerance, stage ('P' or 'V'), status ('ok',
        'failed' or 'not run'), seconds, ns_per_row and residual.
    """
    names = list(systems or [name for name, (_, small) in SYSTEMS.items() if small == quick])
    before = earlier if earlier and earlier["quick"] == quick else {}
    found = {"format": FORMAT, "quick": quick, "systems": {}, "points": [], **before}
    done = {(point["system"], point["solver"]) for point in found["points"]}
    built = lru_cache(maxsize=1)(lambda name: SYSTEMS[name][0]())

    def points(name: str, candidate: Candidate) -> list[dict[str, Any]]:
        system: BareSystem = built(name)
        about = {"title": system.name, "atoms": len(system.positions), "rows": system.n_rows}
        found["systems"] = {**found["systems"], name: about}
        return _points(name, system, candidate, QUICK_PATIENCE if quick else PATIENCE)

    def put(_: tuple[str, str], new: list[dict[str, Any]]) -> None:
        found["points"] = found["points"] + new
        if keep is not None:
            keep(found)

    work = {(name, candidate.name): partial(points, name, candidate) for name in names for candidate in CANDIDATES}
    work_off("constraint solvers alone", work, put, done, watcher)
    return found


def _points(name: str, system: BareSystem, candidate: Candidate, patience: float) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for tolerance in candidate.tolerances:
        common = {"system": name, "solver": candidate.name, "tolerance": tolerance}
        begun = perf_counter()
        try:
            solver = candidate.make(system, tolerance)
        except UnsupportedError as error:
            return [*found, {**common, "stage": BOTH, "status": "not run", "note": str(error)}]
        setup = perf_counter() - begun
        begun = perf_counter()
        for stage in STAGES:
            point = {**common, "stage": stage, "setup_seconds": setup}
            try:
                timing = solver.timing(stage)
            except Exception as error:  # whatever a peer raises is a result
                note = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
                found.append({**point, "status": "failed", "note": note})
                continue
            finite = bool(np.isfinite(timing.residual))
            found.append(
                {
                    **point,
                    "status": "ok" if finite else "failed",
                    "seconds": timing.seconds,
                    "ns_per_row": timing.seconds / system.n_rows * 1e9,
                    "residual": timing.residual if finite else None,
                    **({} if finite else {"note": "positions are not finite, and nothing was raised"}),
                }
            )
        if perf_counter() - begun > patience:
            tighter = [t for t in candidate.tolerances if t < tolerance]
            if tighter:
                note = f"tolerances below {tolerance:g} would take longer than {patience:g} s each"
                found.append({**common, "stage": BOTH, "status": "not run", "note": note})
            break
    return found


def figure(result: Mapping[str, Any]) -> Figure:
    """Residual against time a constraint, one panel a system and stage."""
    panels = [[_panel(result, name, stage) for stage in STAGES] for name in result["systems"]]
    if panels:
        panels[0][0] = replace(panels[0][0], legend="small")
    return draw(panels or [[Panel([])] * 2], (10.0, 3.2 * max(len(panels), 1)))


def _panel(result: Mapping[str, Any], name: str, stage: str) -> Panel:
    curves = []
    for candidate in CANDIDATES:
        points = [p for p in _of(result, name, candidate.name, stage) if p["status"] == "ok"]
        if points:
            cost = [p["ns_per_row"] for p in points]
            left = [max(p["residual"], LEAST_RESIDUAL) for p in points]
            curves.append(Curve(cost, left, candidate.title, LOOKS[candidate.name]))
    what, residual = ("positions", "max |r/d - 1|") if stage == "P" else ("velocities", "max |Av|/v_rms")
    return Panel(curves, "time a constraint, ns", residual, f"{result['systems'][name]['title']}: {what}")


def table(result: Mapping[str, Any]) -> Table:
    """All points; marked where kcons is ('good'), and where something failed ('bad')."""
    headings = ("system", "solver", "tolerance", "P, ns", "P, left", "V, ns", "V, left", "note")
    titles = {candidate.name: candidate.title for candidate in CANDIDATES}
    rows: list[list[str]] = []
    marks: list[str] = []
    for name, system in result["systems"].items():
        for candidate in CANDIDATES:
            tolerances = dict.fromkeys(
                p["tolerance"] for p in result["points"] if p["system"] == name and p["solver"] == candidate.name
            )
            for tolerance in tolerances:
                points = [p for p in _of(result, name, candidate.name) if p["tolerance"] == tolerance]
                stages = {p["stage"]: p for p in points}
                cells = [cell for stage in STAGES for cell in _cells(stages.get(stage))]
                notes = dict.fromkeys(p["note"] for p in points if p.get("note"))
                shown = f"{tolerance:g}" if tolerance else "—"
                if not any(p["status"] != "not run" for p in points):
                    shown = "—"
                rows.append([system["title"], titles[candidate.name], shown, *cells, "; ".join(notes)])
                bad = any(p["status"] == "failed" for p in points)
                marks.append("bad" if bad else "good" if candidate.name == "kcons" else "")
    return Table(headings, rows, words=(0, 1, 7), marks=marks)


def _cells(point: Mapping[str, Any] | None) -> list[str]:
    if point is None or point["status"] == "not run":
        return ["", ""]
    if point["status"] == "failed":
        return ["failed", ""]
    return [f"{point['ns_per_row']:.3g}", f"{point['residual']:.0e}"]


def _of(result: Mapping[str, Any], system: str, solver: str, stage: str | None = None) -> list[Mapping[str, Any]]:
    return [
        p
        for p in result["points"]
        if p["system"] == system and p["solver"] == solver and (stage is None or p["stage"] == stage)
    ]
