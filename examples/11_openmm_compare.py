"""OpenMM's own integrators and those of kcons in it: error against cost on molecules, and steps a second in turn.

    python examples/11_openmm_compare.py                  alanine dipeptide, half a minute
    python examples/11_openmm_compare.py --full --out F   and two proteins, seven minutes; F receives JSON
    python examples/11_openmm_compare.py --show F         the tables of an earlier result
    python examples/11_openmm_compare.py --summary F      what it comes to

The same from the command line, for one of them: kcons compare villin; for your own: kcons compare my.pdb
One thread. Errors and force evaluations do not depend on the machine. Wall times in the tables do; for the steps a
second the integrators take turns, their processor times are compared turn by turn, and ratios are medians.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENMM_CPU_THREADS", "1")

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import openmm
from rich.console import Console

from kcons.cli.progress import Bars
from kcons.comparison import Comparison, Measurement, TestSystem, json_files, measure, report, scripts, test_systems
from kcons.openmm import ProjectedIntegrator, hold

#: Test systems, the errors in Å that they are asked for, and steps a turn.
FULL = {"alanine": (1e-3, 1e-5, 1e-7), "dhfr": (1e-3, 1e-4, 1e-5), "villin": (1e-3, 1e-4, 2e-5)}
TURN = {"alanine": 500, "dhfr": 5, "villin": 5}
QUICK_METHODS = ("openmm-verlet", "openmm-middle-bath", "openmm-kcons-rattle", "openmm-kcons-blanes-moan6")
TIME_STEP = 1e-3  # ps


def steps_in_turn(test_system: TestSystem, steps: int, turns: int) -> dict[str, dict[str, float]]:
    """Milliseconds of processor time a step, and steps a second relative to VerletIntegrator at its own tolerance."""
    md_engine = test_system.openmm
    assert md_engine is not None
    held = md_engine.copy()
    part = hold(held, [], test_system.positions * md_engine.length, take="all")
    tight = openmm.VerletIntegrator(TIME_STEP)
    tight.setConstraintTolerance(1e-12)
    racers = {
        "VerletIntegrator, 1e-5": (md_engine.system, openmm.VerletIntegrator(TIME_STEP)),
        "VerletIntegrator, 1e-12": (md_engine.system, tight),
        "LangevinMiddleIntegrator, 1e-5": (md_engine.system, openmm.LangevinMiddleIntegrator(300, 1, TIME_STEP)),
        "NoseHooverIntegrator, 1e-5": (md_engine.system, openmm.NoseHooverIntegrator(300, 1, TIME_STEP)),
        "kcons rattle, 1e-12": (md_engine.system, ProjectedIntegrator(TIME_STEP, tolerance=1e-12)),
        "kcons rattle, own solver": (held, ProjectedIntegrator(TIME_STEP, parts=[part], tolerance=1e-12)),
    }
    contexts = {}
    for name, (system, integrator) in racers.items():
        contexts[name] = md_engine.context(system, integrator)
        contexts[name].setPositions(test_system.positions * md_engine.length)
        contexts[name].setVelocities(test_system.velocities * md_engine.speed)
        integrator.step(2)
    calls = {name: partial(integrator.step, steps) for name, (_, integrator) in racers.items()}
    return scripts.speeds(scripts.in_turn(calls, turns), steps)


def cheapest(result: Comparison, target: float) -> dict[str, Any]:
    """What reaches an error with the fewest force evaluations, of OpenMM's own methods and of all."""

    def best(own: bool) -> Measurement | None:
        found = [
            m
            for m in result.measurements
            if m.status == "ok" and m.error is not None and m.error <= target and ("kcons" not in m.title) >= own
        ]
        return min(found, key=lambda m: float(m.evaluations_per_time or 0.0), default=None)

    own, any_ = best(True), best(False)
    # OpenMM's own are of order 2: from the finest step, evaluations grow as the root of the error.
    finest = min((m for m in result.of("openmm-verlet-1e-12")), key=lambda m: m.setting)
    needed = float(finest.evaluations_per_time or 0.0) * max(1.0, float(finest.error or 0.0) / target) ** 0.5
    evaluations = own.evaluations_per_time if own is not None else needed
    return {
        "target": target,
        "own": float(evaluations or 0.0),
        "extrapolated": own is None,
        "best": None if any_ is None else any_.title,
        "step": None if any_ is None else any_.setting,
        "evaluations": None if any_ is None else any_.evaluations_per_time,
    }


def run(full: bool) -> dict[str, Any]:
    found: dict[str, Any] = {}
    with Bars() as watcher:
        for name, targets in FULL.items():
            if not full and name != "alanine":
                continue
            test_system = test_systems.build(name, quick=not full)
            methods = None if full else QUICK_METHODS
            result = measure.compare(test_system, methods=methods, budget=60 if full else 2, watcher=watcher)
            found[name] = result.to_dict()
            if full:
                found[name]["targets"] = [cheapest(result, target) for target in targets]
            found[name]["steps in turn"] = steps_in_turn(test_system, TURN[name], 25 if full else 3)
    return found


def show(results: dict[str, Any], console: Console) -> None:
    """Table and explanation of each scene."""
    for found in results.values():
        result = Comparison.from_dict(found)
        console.print(report.table(result))
        console.print(report.explanation(result), highlight=False, markup=False)


def summary(results: dict[str, Any]) -> str:
    """What reaches an error, and how fast the steps are."""
    lines = []
    for found in results.values():
        units = found["scene"]["units"]
        lines += [found["scene"]["title"], f"  error after {found['scene']['horizon']:g} {units['time']}"]
        for row in found.get("targets", []):
            start = f"  ≤ {row['target']:.0e} {units['length']}:"
            own = f"OpenMM's own {'about ' if row['extrapolated'] else ''}{row['own']:,.0f} force evaluations a ps"
            if "best" in row:
                gain = f"{row['own'] / row['evaluations']:.1f} times as many as the {row['evaluations']:,.0f} of"
                lines.append(f"{start} {own}, {gain} {row['best']} at {row['step']:.3g} fs")
            else:
                lines.append(f"{start} {own}")
        lines.append("  steps of 1 fs, in turn")
        for name, row in found["steps in turn"].items():
            lines.append(f"  {name:<32}{row['ms']:>9.4g} ms, {row['ratio']:.2f} of the steps a second")
    return "\n".join(lines)


def slim(value: Any) -> Any:
    """Four digits, and nothing where nothing is known."""
    if isinstance(value, dict):
        return {key: slim(item) for key, item in value.items() if item is not None and item != ""}
    if isinstance(value, list):
        return [slim(item) for item in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--show", type=Path)
    parser.add_argument("--summary", type=Path)
    chosen = parser.parse_args()
    console = Console(width=160)
    if chosen.show is not None:
        show(json_files.read(chosen.show), console)
        return
    if chosen.summary is not None:
        print(summary(json_files.read(chosen.summary)))
        return
    results = slim(run(chosen.full))
    show(results, console)
    print(summary(results))
    if chosen.out is not None:
        json_files.write(chosen.out, results, indent=0)


if __name__ == "__main__":
    main()
