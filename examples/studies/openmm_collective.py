"""Collective variables held in OpenMM: what a row costs in water, and what it reaches on a peptide.

    python openmm_collective.py --quick --out DIR   a short run
    python openmm_collective.py --out DIR           2700 atoms, as in docs/openmm_constraints.md

Times are processor times of one thread, in runs that take turns; only their ratios mean something.
"""

from __future__ import annotations

import copy
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

from kcons.openmm import CollectiveRows, ProjectedIntegrator

DATA = Path(__file__).resolve().parents[2] / "tests" / "data"


def in_water(full: bool) -> Iterator[dict[str, Any]]:
    """Steps with rows between oxygens of rigid water: time, speed of VerletIntegrator's, largest |sigma| in nm."""
    edge, cutoff = (3.0, 0.9) if full else (1.9, 0.8)
    field = app.ForceField("tip3p.xml")
    box = app.Modeller(app.Topology(), [])
    box.addSolvent(field, boxSize=openmm.Vec3(edge, edge, edge))
    plain = field.createSystem(
        box.topology, nonbondedMethod=app.PME, nonbondedCutoff=cutoff, rigidWater=True, removeCMMotion=False
    )
    platform = openmm.Platform.getPlatformByName("CPU")

    start = openmm.Context(plain, openmm.LangevinMiddleIntegrator(300, 5, 0.002), platform, {"Threads": "1"})
    start.setPositions(box.positions)
    openmm.LocalEnergyMinimizer.minimize(start, 50, 50)
    start.setVelocitiesToTemperature(300, 1)
    start.getIntegrator().step(500 if full else 50)
    x = np.array(start.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer))

    runs: dict[str, tuple[openmm.Integrator, openmm.System, CollectiveRows | None]] = {
        "VerletIntegrator": (openmm.VerletIntegrator(0.002), plain, None),
        "rattle": (ProjectedIntegrator(0.002), plain, None),
    }
    for count in (1, 2, 4) if full else (1,):
        system = copy.deepcopy(plain)
        distances = []
        for k in range(count):
            first = 60 * k
            apart = x[::3] - x[first]
            apart -= edge * np.round(apart / edge)
            partner = 3 * int(np.argmin(np.abs(np.linalg.norm(apart, axis=1) - 0.5)))
            force = openmm.CustomBondForce("r")
            force.setUsesPeriodicBoundaryConditions(True)
            force.addBond(first, partner)
            distances.append(force)
        rows = CollectiveRows(system, distances, positions=x)
        name = f"rattle, {count} row{'s' if count > 1 else ''}"
        runs[name] = (ProjectedIntegrator(0.002, parts=[rows]), system, rows)

    contexts = {}
    for name, (integrator, system, part) in runs.items():
        context = openmm.Context(system, integrator, platform, {"Threads": "1"})
        context.setPositions(x)
        context.setVelocitiesToTemperature(300, 1)
        if part is not None:
            part.restore(context)
        integrator.step(2)
        contexts[name] = context
    steps, rounds = (50, 9) if full else (5, 2)
    calls = {name: partial(integrator.step, steps) for name, (integrator, _, _) in runs.items()}
    found = harness.speeds(harness.in_turn(calls, rounds), steps)
    for name, (_, _, part) in runs.items():
        off = None if part is None else float(np.abs(part.residuals(contexts[name])).max())
        yield {"part": "water", "integrator": name, "atoms": len(x), **found[name], "residual": off}


def accuracy() -> Iterator[dict[str, Any]]:
    """Alanine dipeptide with all bonds, phi and psi held: errors after 8 fs in nm, by scheme."""
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    x = np.array(pdb.positions.value_in_unit(unit.nanometer))

    def end(scheme: str, steps: int) -> tuple[np.ndarray, float, float]:
        system = app.ForceField("amber14-all.xml").createSystem(pdb.topology, constraints=app.AllBonds)
        dihedrals = []
        for atoms in ((4, 6, 8, 14), (6, 8, 14, 16)):
            force = openmm.CustomTorsionForce("theta")
            force.addTorsion(*atoms)
            dihedrals.append(force)
        rows = CollectiveRows(system, dihedrals, positions=x)
        integrator = ProjectedIntegrator(0.008 / steps, scheme, parts=[rows], tolerance=1e-14)
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
        context.setPositions(x)
        context.applyConstraints(1e-14)
        context.setVelocitiesToTemperature(300, 1)
        rows.restore(context)
        integrator.step(steps)
        positions = np.array(context.getState(positions=True).getPositions(asNumpy=True)._value)
        return positions, float(np.abs(rows.residuals(context)).max()), float(np.abs(rows.rates(context)).max())

    exact, _, _ = end("kahan-li6", 32)
    for scheme, steps in (("rattle", (16, 32)), ("suzuki4", (8, 16)), ("kahan-li6", (4, 8))):
        coarse, fine = (end(scheme, n) for n in steps)
        errors = [float(np.abs(state[0] - exact).max()) for state in (coarse, fine)]
        yield {
            "part": "accuracy",
            "scheme": scheme,
            "error": errors[1],
            "order": float(np.log2(errors[0] / errors[1])),
            "sigma": fine[1],
            "slope": fine[2],
        }


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    speed = {"ms": "{:.2f}", "ratio": "{:.2f}", "residual": "{:.1e}"}
    reached = {"error": "{:.1e}", "order": "{:.2f}", "sigma": "{:.1e}", "slope": "{:.1e}"}
    return {
        "Distances held in rigid water, PME, 2 fs: ms a step, relative speed, |sigma| in nm": harness.shown(
            table, "water", integrator="{}", atoms="{:.0f}", **speed
        ),
        "Alanine dipeptide, all bonds, phi, psi: error in nm, |sigma| in rad, |A v| in rad/ps": harness.shown(
            table, "accuracy", scheme="{}", **reached
        ),
    }


def main() -> None:
    harness.main(
        "openmm_collective",
        harness.options(__doc__, "openmm-collective"),
        lambda chosen: {"water": partial(in_water, not chosen.quick), "accuracy": accuracy},
        tables,
    )


if __name__ == "__main__":
    main()
