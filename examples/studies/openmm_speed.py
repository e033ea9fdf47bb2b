"""OpenMM with kcons' integrators: what they cost, and what they reach for it.

    python openmm_speed.py --quick --out DIR   short runs, a minute
    python openmm_speed.py --out DIR           what docs/evidence/openmm.md shows

Times are medians of processor times, one thread, of runs that take turns, so that a busy machine slows all of them
alike: only their ratios mean something. Errors are those of positions against a converged trajectory.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENMM_CPU_THREADS", "1")

import harness
import numpy as np
import openmm
import pandas as pd
from openmm import app, unit

from kcons.openmm import SCHEMES, ProjectedIntegrator

DATA = Path(__file__).resolve().parents[2] / "tests" / "data"
TOLERANCE = 1e-10


# -- systems ----------------------------------------------------------------------------------------


def water(edge: float) -> tuple[openmm.System, Any]:
    """Rigid TIP3P in a box, PME."""
    field = app.ForceField("tip3p.xml")
    box = app.Modeller(app.Topology(), [])
    box.addSolvent(field, boxSize=openmm.Vec3(edge, edge, edge))
    system = field.createSystem(
        box.topology, nonbondedMethod=app.PME, nonbondedCutoff=min(1.0, 0.45 * edge), rigidWater=True
    )
    return system, box.positions


def alanine() -> tuple[openmm.System, Any]:
    """Alanine dipeptide in vacuum, all bonds held."""
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    system = app.ForceField("amber14-all.xml").createSystem(pdb.topology, constraints=app.AllBonds)
    return system, pdb.positions


# -- what is measured -------------------------------------------------------------------------------


def context_of(system: openmm.System, integrator: openmm.Integrator, platform: str) -> openmm.Context:
    integrator.setConstraintTolerance(TOLERANCE)
    properties = {"Threads": "1"} if platform == "CPU" else {}
    return openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform), properties)


def race(
    system: openmm.System,
    positions: Any,
    integrators: dict[str, openmm.Integrator],
    steps: int,
    repeats: int,
    platform: str = "CPU",
) -> dict[str, dict[str, float]]:
    """Milliseconds of a step, and steps a second relative to the first integrator: the median of each round's ratio."""
    contexts = {name: context_of(system, integrator, platform) for name, integrator in integrators.items()}
    first = next(iter(contexts.values()))
    first.setPositions(positions)
    openmm.LocalEnergyMinimizer.minimize(first, 50, 50)
    first.applyConstraints(TOLERANCE)
    start = first.getState(positions=True).getPositions(asNumpy=True)
    for name, context in contexts.items():
        context.setPositions(start)
        context.setVelocitiesToTemperature(300, 1)
        integrators[name].step(steps)
    calls = {name: partial(integrator.step, steps) for name, integrator in integrators.items()}
    return harness.speeds(harness.in_turn(calls, repeats), steps)


def plain_water(full: bool) -> Iterator[dict[str, Any]]:
    """The RATTLE form against VerletIntegrator."""
    system, positions = water(3.0 if full else 1.6)
    integrators = {
        "VerletIntegrator": openmm.VerletIntegrator(0.002),
        "LangevinMiddleIntegrator": openmm.LangevinMiddleIntegrator(300, 1, 0.002),
        "kcons rattle": ProjectedIntegrator(0.002),
        "kcons geodesic": ProjectedIntegrator(0.002, "geodesic"),
    }
    rows = race(system, positions, integrators, *((10, 50) if full else (2, 2)))
    for name, row in rows.items():
        yield {"part": "water", "integrator": name, "atoms": system.getNumParticles(), **row}


def work_and_precision(full: bool) -> Iterator[dict[str, Any]]:
    """Error after 48 fs against force evaluations per ps."""
    system, positions = alanine()
    duration = 0.048

    def run(scheme: str, dt: float, start: tuple[Any, Any] | None, steps: int) -> tuple[Any, Any]:
        integrator = ProjectedIntegrator(dt, scheme)
        context = context_of(system, integrator, "Reference")
        integrator.setConstraintTolerance(1e-13)
        if start is None:
            context.setPositions(positions)
            integrator.minimizeEnergy(context, maxIterations=50)
            integrator.setVelocitiesToTemperature(context, 300, 1)
        else:
            context.setPositions(start[0])
            context.setVelocities(start[1])
        integrator.step(steps)
        state = context.getState(positions=True, velocities=True)
        return state.getPositions(asNumpy=True) / unit.nanometer, state.getVelocities(asNumpy=True)

    start = run("rattle", 1e-3, None, 200 if full else 20)
    truth = run("blanes-moan6a", 1e-3, start, 48)[0]
    steps_of = {
        "rattle": (1.0, 0.5, 0.25, 0.125, 0.0625, 0.03125),
        "suzuki4": (2.0, 1.5, 1.0, 0.75),
        "blanes-moan4": (6.0, 4.0, 3.0, 2.0),
        "kahan-li6": (3.0, 2.0, 1.5, 1.0),
        "blanes-moan6": (8.0, 6.0, 4.0, 3.0),
        "blanes-moan6a": (8.0, 6.0, 4.0, 3.0),
    }
    rows: dict[str, list[dict[str, float]]] = {}
    for scheme in steps_of if full else ("rattle", "blanes-moan4"):
        for dt in steps_of[scheme][: None if full else 2]:
            error = float(np.abs(run(scheme, dt * 1e-3, start, round(duration / dt * 1e3))[0] - truth).max())
            evaluations = SCHEMES[scheme]().force_evaluations / dt * 1e3
            rows.setdefault(scheme, []).append({"fs": dt, "error_nm": error, "evaluations_per_ps": evaluations})
    needed = {scheme: evaluations_at(points, 5e-7) for scheme, points in rows.items()}
    for scheme, points in rows.items():
        for point in points:
            yield {"part": "precision", "scheme": scheme, **point, "fewer": needed["rattle"] / needed[scheme]}


def evaluations_at(points: list[dict[str, float]], error: float) -> float:
    """Force evaluations per ps for an error, on the straight line through the points in a log-log plot."""
    slope, offset = np.polyfit(
        np.log([p["error_nm"] for p in points]), np.log([p["evaluations_per_ps"] for p in points]), 1
    )
    return float(np.exp(offset + slope * np.log(error)))


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    points = {"fs": "{:g}", "error_nm": "{:.1e}", "evaluations_per_ps": "{:.0f}", "fewer": "{:.1f} ×"}
    return {
        "Rigid water, PME, 2 fs: ms a step, steps a second relative to the first": harness.shown(
            table, "water", integrator="{}", atoms="{:.0f}", ms="{:.3f}", ratio="{:.2f}"
        ),
        "Alanine dipeptide, all bonds: error after 48 fs; fewer: evaluations than RATTLE at 5e-7 nm": harness.shown(
            table, "precision", scheme="{}", **points
        ),
    }


def main() -> None:
    harness.main(
        "openmm_speed",
        harness.options(__doc__, "openmm-speed"),
        lambda chosen: {
            "plain water": partial(plain_water, not chosen.quick),
            "work and precision": partial(work_and_precision, not chosen.quick),
        },
        tables,
    )


if __name__ == "__main__":
    main()
