"""Constraint solvers without an integrator: kcons' engine, Gauss-Seidel sweeps, ASE, OpenMM and LAMMPS.

    python examples/studies/solvers_alone.py --quick --out DIR   small systems, a minute
    python examples/studies/solvers_alone.py --out DIR           water, CH3, chains to 10^6 bonds, DHFR; ten minutes

P brings positions back onto the constraints after a step of 2 fs at 300 K, V takes out of thermal velocities what
leaves them. Each solver does both, warm, on one thread. DIR/precision.csv: residual and time a constraint at every
tolerance that a solver has (kcons has none but rounding). DIR/scaling.csv: time against size, at a tolerance
of 1e-8, each point in a process of its own.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parent))

import harness
from bare_solvers import CANDIDATES, STAGES, Candidate
from bare_systems import BareSystem, chain, methyl, protein, water

from kcons.errors import UnsupportedError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SYSTEMS: Mapping[str, Callable[[], BareSystem]] = {
    "water": lambda: water(1000),
    "methyl": lambda: methyl(1000),
    "chain": lambda: chain(1000),
    "dhfr-allbonds": lambda: protein("allbonds"),
    "dhfr-hangles": lambda: protein("hangles"),
}
SMALL: Mapping[str, Callable[[], BareSystem]] = {
    "water-small": lambda: water(64),
    "methyl-small": lambda: methyl(100),
    "chain-small": lambda: chain(100),
}
#: A solver that takes longer than this, in seconds, is not asked for a tighter tolerance.
PATIENCE, QUICK_PATIENCE = 20.0, 1.0
#: Of scaling: how systems are built from a size, and the sizes of a full and of a quick run.
KINDS: Mapping[str, tuple[Callable[[int], BareSystem], tuple[int, ...], tuple[int, ...]]] = {
    "water": (water, (100, 1000, 10_000, 100_000), (100, 1000)),
    "chain": (chain, (100, 1000, 10_000, 100_000, 1_000_000), (100, 1000)),
}
TOLERANCE = 1e-8
#: Seconds that one size may take, set-up and imports included, before larger ones are left out.
LONGEST, QUICK_LONGEST = 120.0, 30.0
#: Exponents are fitted to sizes from here on: below, the call costs more than the work.
FIT_FROM = 1000
#: Columns that grow with the size, and what figures call them.
GROWING = {"P seconds": "positions, s", "V seconds": "velocities, s", "set-up": "set-up, s"}
COLORS = {"kcons": "#0072B2", "sweeps": "#a6611a", "ase": "#D55E00", "openmm": "#009E73", "lammps": "#6a51a3"}
TITLES = {candidate.name: candidate.title for candidate in CANDIDATES}


def precision(
    name: str, build: Callable[[], BareSystem], candidate: Candidate, patience: float
) -> Iterator[dict[str, Any]]:
    """Time and residual of a solver at all of its tolerances, from the loosest on."""
    system = build()
    about = {"system": name, "title": system.name, "rows": system.n_rows, "solver": candidate.name}
    for tolerance in candidate.tolerances:
        begun = perf_counter()
        for stage, found in timed(system, candidate, tolerance).items():
            yield {**about, "tolerance": tolerance, "stage": stage, **found}
        if perf_counter() - begun > patience:
            return


def timed(system: BareSystem, candidate: Candidate, tolerance: float) -> dict[str, dict[str, Any]]:
    """For each stage: seconds, nanoseconds a row, residual; or why there are none."""
    found: dict[str, dict[str, Any]] = {}
    begun = perf_counter()
    try:
        solver = candidate.make(system, tolerance)
        setup = perf_counter() - begun
        for stage in STAGES:
            timing = solver.timing(stage)
            if not np.isfinite(timing.residual):
                raise ArithmeticError("positions are not finite, and nothing was raised")
            each = {"seconds": timing.seconds, "ns a row": timing.seconds / system.n_rows * 1e9}
            found[stage] = {"status": "ok", **each, "residual": timing.residual, "set-up": setup}
    except UnsupportedError as error:
        found["P and V"] = {"status": "not run", "words": str(error)}
    except Exception as error:  # whatever a solver of others raises is a result
        stage = next(stage for stage in STAGES if stage not in found)
        found[stage] = {"status": "failed", "words": f"{type(error).__name__}: {error}"}
    return found


def scaling(kind: str, solver: str, sizes: tuple[int, ...], longest: float) -> Iterator[dict[str, Any]]:
    """Time and set-up at growing sizes, until one takes longer than `longest` or fails."""
    for size in sizes:
        row: dict[str, Any] = {"kind": kind, "size": size, "solver": solver}
        command = [sys.executable, __file__, "--one", kind, str(size), solver]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=longest)
            ended = done.returncode == 0
            failed = {"status": "failed", "words": done.stderr[-200:]}
            row |= json.loads(done.stdout.splitlines()[-1]) if ended else failed
        except subprocess.TimeoutExpired:
            row |= {"status": "stopped", "words": f"longer than {longest:g} s"}
        yield row
        if row["status"] != "ok":
            return


def one(kind: str, size: int, solver: str) -> dict[str, Any]:
    """A point of the scaling, in this process."""
    candidate = next(c for c in CANDIDATES if c.name == solver)
    tolerance = 0.0 if solver == "kcons" else TOLERANCE
    build = KINDS[kind][0]
    timed(build(8), candidate, tolerance)  # imports and kernels
    system = build(size)
    stages = timed(system, candidate, tolerance)
    found: dict[str, Any] = {"rows": system.n_rows, "status": "ok"}
    for stage, values in stages.items():
        if values["status"] != "ok":
            return {**found, "status": values["status"], "words": values["words"]}
        found |= {f"{stage} seconds": values["seconds"], f"{stage} residual": values["residual"]}
        found["set-up"] = values["set-up"]
    return found


def exponents(table: pd.DataFrame) -> dict[tuple[str, str, str], float]:
    """(kind, solver, column) -> fitted power of the size, from `FIT_FROM` on, where there are two sizes at least."""
    found = {}
    for (kind, solver), part in table[(table.status == "ok") & (table["size"] >= FIT_FROM)].groupby(["kind", "solver"]):
        for column in GROWING:
            points = part.dropna(subset=column)
            if len(points) > 1:
                found[kind, solver, column] = float(np.polyfit(np.log(points["size"]), np.log(points[column]), 1)[0])
    return found


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Of scaling: seconds and memory at each size, with the exponents below. Of precision: nanoseconds and residual."""
    if "kind" not in table:
        shown = table[table.status == "ok"]
        columns = {"title": "system", "solver": "solver", "tolerance": "tolerance", "stage": "stage"}
        return {"precision": shown[[*columns, "ns a row", "residual"]].rename(columns=columns)}
    shown = table[["kind", "size", "solver", "P seconds", "V seconds", "set-up", "status"]]
    fitted = pd.DataFrame((*which, f"{power:.2f}") for which, power in exponents(table).items())
    return {"scaling": shown, "exponents": fitted.set_axis(["kind", "solver", "column", "power of the size"], axis=1)}


def figures(table: pd.DataFrame) -> dict[str, Figure]:
    """Residual against time a constraint; or time against size."""
    from matplotlib.figure import Figure

    ok = table[table.status == "ok"]
    if "kind" in table:
        fitted, kinds = exponents(table), list(dict.fromkeys(ok.kind))
        figure = Figure(figsize=(13.0, 3.6 * len(kinds)), layout="constrained")
        grid = figure.subplots(len(kinds), len(GROWING), squeeze=False)
        for axes, (kind, column) in zip(grid.flat, ((k, c) for k in kinds for c in GROWING), strict=True):
            for solver, part in ok[ok.kind == kind].dropna(subset=column).groupby("solver", sort=False):
                power = fitted.get((kind, solver, column))
                label = TITLES[solver] + ("" if power is None else f", $N^{{{power:.2f}}}$")
                axes.plot(part["size"], part[column], marker="o", color=COLORS[solver], label=label)
            axes.set(xscale="log", yscale="log", xlabel=f"{kind}: number", ylabel=GROWING[column])
            axes.legend(fontsize="x-small")
            axes.grid(alpha=0.3)
        return {"report-scaling": figure}
    systems = list(dict.fromkeys(ok.system))
    figure = Figure(figsize=(10.0, 3.2 * len(systems)), layout="constrained")
    grid = figure.subplots(len(systems), len(STAGES), squeeze=False)
    for axes, (system, stage) in zip(grid.flat, ((s, t) for s in systems for t in STAGES), strict=True):
        rows = ok[(ok.system == system) & (ok.stage == stage)]
        for solver, part in rows.groupby("solver", sort=False):
            look = {"marker": "o", "color": COLORS[solver], "label": TITLES[solver]}
            axes.plot(part["ns a row"], part.residual.clip(lower=1e-17), **look)
        what, left = ("positions", "max |r/d - 1|") if stage == "P" else ("velocities", "max |Av|/v_rms")
        axes.set(xscale="log", yscale="log", xlabel="time a constraint, ns", ylabel=left)
        axes.set_title(f"{rows.title.iloc[0] if len(rows) else system}: {what}", fontsize=9)
        axes.grid(alpha=0.3)
    grid.flat[0].legend(fontsize="small")
    return {"report-solver-precision": figure}


def main(arguments: list[str] | None = None) -> None:
    def names(words: str) -> list[str]:
        return words.split(",")

    parser = harness.options(__doc__, "solvers-alone")
    parser.add_argument("--one", nargs=3, metavar=("KIND", "SIZE", "SOLVER"), help="a point of the scaling, as JSON")
    parser.add_argument("--solvers", type=names, default=list(TITLES), help=f"of {', '.join(TITLES)}")
    parser.add_argument("--systems", type=names, help="of those that the tables name")
    chosen = parser.parse_args(arguments)
    if chosen.one:
        kind, size, solver = chosen.one
        print(json.dumps(one(kind, int(size), solver)))
        return
    candidates = [candidate for candidate in CANDIDATES if candidate.name in chosen.solvers]
    systems = SMALL if chosen.quick else SYSTEMS
    asked = chosen.systems or [*systems, *KINDS]
    built = {name: cache(build) for name, build in systems.items() if name in asked}
    patience, longest = (QUICK_PATIENCE, QUICK_LONGEST) if chosen.quick else (PATIENCE, LONGEST)
    precise = {
        f"{name}, {c.name}": partial(precision, name, build, c, patience)
        for name, build in built.items()
        for c in candidates
    }
    grown = {
        f"{kind}, {c.name}": partial(scaling, kind, c.name, small if chosen.quick else large, longest)
        for kind, (_, large, small) in KINDS.items()
        for c in candidates
        if kind in asked
    }
    for name, pieces in (("precision", precise), ("scaling", grown)):
        if pieces:
            table = harness.run(chosen.out / f"{name}.csv", pieces, quick=chosen.quick)
            for found in tables(table).values():
                print(found.to_string(index=False), end="\n\n")


if __name__ == "__main__":
    main()
