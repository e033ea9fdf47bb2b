"""Cost and memory of constraint solvers against the size of the system, with fitted exponents.

Each solver runs in a process of its own, from small to large sizes, so that its memory can be told from that of others
and that it can be stopped where it takes too long.
"""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from kcons.comparison.solvers_alone.bare_solvers import CANDIDATES, STAGES
from kcons.comparison.solvers_alone.bare_systems import BareSystem, chain, water
from kcons.comparison.solvers_alone.solver_precision import LOOKS
from kcons.comparison.study.curves import Curve, Panel, draw
from kcons.comparison.study.study import Watcher, work_off
from kcons.comparison.study.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMAT = "kcons-scaling-1"
#: Kinds of systems: how they are built from a size, and the sizes of a full and of a quick run.
KINDS: Mapping[str, tuple[Callable[[int], BareSystem], str, tuple[int, ...], tuple[int, ...]]] = {
    "water": (water, "rigid water, molecules", (100, 1000, 10_000, 100_000), (100, 1000)),
    "chain": (chain, "zigzag chain, bonds", (100, 1000, 10_000, 100_000, 1_000_000), (100, 1000)),
}
#: Tolerances of those that have one: what a careful user would ask for.
TOLERANCES = {"kcons": 0.0, "sweeps": 1e-8, "ase": 1e-8, "openmm": 1e-8, "lammps": 1e-8}
QUICK_SOLVERS = ("kcons", "sweeps")
#: Seconds that one size may take, set-up included, before a solver is stopped.
PATIENCE, QUICK_PATIENCE = 90.0, 15.0
#: Exponents are fitted to sizes from here on: below, the call costs more than the work.
FIT_FROM = 1000
#: Fields of a point that grow with the size, with headings.
GROWING = {"p_seconds": "positions, s", "v_seconds": "velocities, s", "setup_seconds": "set-up, s"}
MEMORY = "memory_bytes"
#: Bytes below which it is not seen: freed memory is used again.
LEAST_MEMORY = 2**18


def measure(
    *,
    quick: bool = False,
    keep: Callable[[dict[str, Any]], None] | None = None,
    watcher: Watcher | None = None,
    earlier: Mapping[str, Any] | None = None,
    sizes: Mapping[str, Sequence[int]] | None = None,
    solvers: Sequence[str] | None = None,
    patience: float | None = None,
) -> dict[str, Any]:
    """Time P, V and set-up and see how much memory grows, for every solver and size.

    Parameters
    ----------
    quick : bool
        Two sizes of the two compiled solvers.
    keep : callable, optional
        Gets the result so far after each solver.
    watcher : Watcher, optional
    earlier : mapping, optional
        An unfinished result: what is in it is not measured again.
    sizes : mapping, optional
        Sizes for each of `KINDS`.
    solvers : sequence of str, optional
        Names of `kcons.comparison.solvers_alone.bare_solvers.CANDIDATES`.
    patience : float, optional
        Seconds for one size.

    Returns
    -------
    dict
        Plain data for JSON: 'points', each with kind, size, rows, solver, status ('ok', 'stopped', 'failed', 'not
        run') and the fields of `GROWING` and `MEMORY`.
    """
    wanted = dict(sizes or {kind: small if quick else large for kind, (_, _, large, small) in KINDS.items()})
    names = list(solvers or (QUICK_SOLVERS if quick else [candidate.name for candidate in CANDIDATES]))
    patience = patience or (QUICK_PATIENCE if quick else PATIENCE)
    before = earlier if earlier and earlier["quick"] == quick else {}
    found = {"format": FORMAT, "quick": quick, "patience": patience, "points": [], **before}
    done = {(point["kind"], point["solver"]) for point in found["points"]}

    def put(_: tuple[str, str], new: Iterable[dict[str, Any]]) -> None:
        found["points"] = [*found["points"], *new]
        if keep is not None:
            keep(found)

    work = {(kind, name): partial(_grown, kind, name, wanted[kind], patience) for kind in wanted for name in names}
    work_off("scaling", work, put, done, watcher)
    return found


def _grown(kind: str, solver: str, sizes: Sequence[int], patience: float) -> Iterator[dict[str, Any]]:
    """Points of one solver, out of a process of its own, until one size takes longer than `patience`."""
    command = [sys.executable, "-c", "from kcons.comparison.solvers_alone.scaling import child; child()"]
    task = json.dumps({"kind": kind, "solver": solver, "sizes": list(sizes)})
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert process.stdin is not None and process.stdout is not None
    try:
        process.stdin.write(task + "\n")
        process.stdin.flush()
        waiting = selectors.DefaultSelector()
        waiting.register(process.stdout, selectors.EVENT_READ)
        for count, size in enumerate(sizes):
            # The first one waits for imports and kernels, too.
            if not waiting.select(patience + (60.0 if count == 0 else 0.0)):
                note = f"stopped after {patience:g} s"
                yield {"kind": kind, "size": size, "solver": solver, "status": "stopped", "note": note}
                return
            line = process.stdout.readline()
            if not line:
                note = "the process ended: most likely there was too little memory"
                yield {"kind": kind, "size": size, "solver": solver, "status": "failed", "note": note}
                return
            point = json.loads(line)
            yield point
            if point["status"] != "ok":
                return
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()


def child() -> None:
    """Measure one solver at growing sizes: a line of JSON in, a line out for each size."""
    task = json.loads(sys.stdin.readline())
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no answer
    kind, name = task["kind"], task["solver"]
    candidate = next(c for c in CANDIDATES if c.name == name)
    build = KINDS[kind][0]
    with suppress(Exception):  # imports; what goes wrong is said below
        candidate.make(build(8), TOLERANCES[name])
    for size in task["sizes"]:
        point: dict[str, Any] = {"kind": kind, "size": size, "solver": name, "tolerance": TOLERANCES[name]}
        try:
            system = build(size)
            point["rows"] = system.n_rows
            _ = system.moved  # before memory is looked at
            before = _resident()
            begun = perf_counter()
            solver = candidate.make(system, TOLERANCES[name])
            point["setup_seconds"] = perf_counter() - begun
            for stage in STAGES:
                timing = solver.timing(stage)
                point[f"{stage.lower()}_seconds"] = timing.seconds
                point[f"{stage.lower()}_residual"] = timing.residual if np.isfinite(timing.residual) else None
            grown = _peak() - before
            point[MEMORY] = grown if grown > LEAST_MEMORY else None
            point["status"] = "ok"
        except Exception as error:  # whatever a peer raises is a result
            first = (str(error).splitlines() or [""])[0]
            status = "not run" if type(error).__name__ == "UnsupportedError" else "failed"
            point |= {"status": status, "note": f"{type(error).__name__}: {first}"}
        out.write(json.dumps(point) + "\n")
        out.flush()


def _resident() -> int:
    """Bytes in use now (Linux), or at most so far."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return _peak()


def _peak() -> int:
    """Bytes in use at most so far."""
    import resource  # not on Windows

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(most) * (1 if sys.platform == "darwin" else 1024)


def exponents(result: Mapping[str, Any]) -> dict[tuple[str, str, str], float]:
    """(kind, solver, field) -> fitted power of the size, from `FIT_FROM` on, where there are two sizes at least."""
    found: dict[tuple[str, str, str], float] = {}
    for kind in KINDS:
        for candidate in CANDIDATES:
            for field in (*GROWING, MEMORY):
                points = [p for p in _of(result, kind, candidate.name) if p["size"] >= FIT_FROM and p.get(field)]
                if len(points) > 1:
                    n, cost = np.log([(p["size"], p[field]) for p in points]).T
                    found[kind, candidate.name, field] = float(np.polyfit(n, cost, 1)[0])
    return found


def figure(result: Mapping[str, Any]) -> Figure:
    """Seconds of P and V, and memory, against size; exponents in the legends."""
    kinds = [kind for kind in KINDS if any(p["kind"] == kind for p in result["points"])]
    fields = {"p_seconds": "positions, s", "v_seconds": "velocities, s", MEMORY: "memory, bytes"}
    fitted = exponents(result)

    def panel(kind: str, field: str, label: str) -> Panel:
        curves = []
        for candidate in CANDIDATES:
            points = [p for p in _of(result, kind, candidate.name) if p.get(field)]
            if points:
                power = fitted.get((kind, candidate.name, field))
                text = candidate.title + ("" if power is None else f", $N^{{{power:.2f}}}$")
                sizes, costs = [p["size"] for p in points], [p[field] for p in points]
                curves.append(Curve(sizes, costs, text, LOOKS[candidate.name]))
        return Panel(curves, KINDS[kind][1], label, legend="x-small")

    panels = [[panel(kind, field, label) for field, label in fields.items()] for kind in kinds]
    return draw(panels or [[Panel([])] * len(fields)], (13.0, 3.6 * max(len(kinds), 1)))


def table(result: Mapping[str, Any]) -> Table:
    """All points, and under each solver its exponents."""
    titles = {candidate.name: candidate.title for candidate in CANDIDATES}
    headings = ("system", "size", "solver", "P, s", "V, s", "set-up, s", "memory, MB", "note")
    fitted = exponents(result)
    rows: list[list[str]] = []
    marks: list[str] = []
    for kind, (_, what, _, _) in KINDS.items():
        for candidate in CANDIDATES:
            points = [p for p in result["points"] if p["kind"] == kind and p["solver"] == candidate.name]
            for p in points:
                cells = [f"{p[field]:.3g}" if p.get(field) is not None else "" for field in GROWING]
                memory = f"{p[MEMORY] / 1e6:.3g}" if p.get(MEMORY) is not None else ""
                rows.append([what, f"{p['size']:,}", titles[candidate.name], *cells, memory, p.get("note", "")])
                marks.append("bad" if p["status"] == "failed" else "good" if candidate.name == "kcons" else "")
            powers = [fitted.get((kind, candidate.name, field)) for field in (*GROWING, MEMORY)]
            if any(power is not None for power in powers):
                shown = ["" if power is None else f"N^{power:.2f}" for power in powers]
                rows.append([what, "exponent", titles[candidate.name], *shown, f"from {FIT_FROM:,} on"])
                marks.append("")
    return Table(headings, rows, words=(0, 2, 7), marks=marks)


def _of(result: Mapping[str, Any], kind: str, solver: str) -> list[Mapping[str, Any]]:
    found = [p for p in result["points"] if p["kind"] == kind and p["solver"] == solver and p["status"] == "ok"]
    return sorted(found, key=lambda p: p["size"])
