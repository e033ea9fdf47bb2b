"""OpenMM's platforms and precisions: what kcons costs there, how closely it holds, and how the energy drifts.

    python openmm_platforms.py --quick --out DIR         short runs on the CPU
    python openmm_platforms.py --platform "CUDA mixed" --out DIR   what docs/evidence/openmm.md shows
    python openmm_platforms.py --platform "OpenCL mixed" --drift 10 --starts 3 --out DIR   of villin in water

Speeds are medians of runs that take turns, relative to openmm.VerletIntegrator at the same tolerance of the
constraints. The drift is the slope of the total energy at 2 fs, in kT a nanosecond and degree of freedom, with its
standard error from ten blocks. With --pdb, a solvated protein is measured as well; --drift takes villin, which comes
with OpenMM, where no other is given.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import harness
import numpy as np
import openmm
import pandas as pd
from openmm import app, unit

from kcons.openmm import Isokinetic, Langevin, Precision, ProjectedIntegrator, positions_of
from kcons.thermostats.correlated_series import slope

DATA = Path(__file__).resolve().parents[2] / "tests" / "data"
TEMPERATURE, FRICTION, STEP = 300.0, 1.0, 0.002
#: Integrators by name; those of OpenMM are given the tolerance that kcons takes by itself.
INTEGRATORS: dict[str, Callable[[], openmm.Integrator]] = {
    "VerletIntegrator": lambda: openmm.VerletIntegrator(STEP),
    "kcons rattle": lambda: ProjectedIntegrator(STEP),
    "LangevinMiddleIntegrator": lambda: openmm.LangevinMiddleIntegrator(TEMPERATURE, FRICTION, STEP),
    "kcons Langevin": lambda: ProjectedIntegrator(STEP, ensemble=Langevin(TEMPERATURE, FRICTION)),
    "kcons Isokinetic": lambda: ProjectedIntegrator(STEP, ensemble=Isokinetic(TEMPERATURE)),
}
#: Villin in water.
VILLIN = Path(app.__file__).parent / "data" / "test.pdb"
#: Those at constant energy.
CONSERVING = ("VerletIntegrator", "kcons rattle")


# -- systems ----------------------------------------------------------------------------------------


def water(edge: float) -> tuple[openmm.System, Any]:
    """Rigid TIP3P, PME."""
    field = app.ForceField("tip3p.xml")
    box = app.Modeller(app.Topology(), [])
    box.addSolvent(field, boxSize=openmm.Vec3(edge, edge, edge))
    system = field.createSystem(
        box.topology, nonbondedMethod=app.PME, nonbondedCutoff=min(0.9, 0.45 * edge), rigidWater=True
    )
    return system, box.positions


def protein(path: Path, constraints: object) -> tuple[openmm.System, Any]:
    """A solvated structure with the force field amber14, PME."""
    pdb = app.PDBFile(str(path))
    field = app.ForceField("amber14-all.xml", "amber14/tip3pfb.xml")
    system = field.createSystem(
        pdb.topology, nonbondedMethod=app.PME, nonbondedCutoff=0.9 * unit.nanometer, constraints=constraints
    )
    return system, pdb.positions


# -- what is measured -------------------------------------------------------------------------------


def placed(system: openmm.System, integrator: openmm.Integrator, place: str) -> openmm.Context:
    name, _, precision = place.partition(" ")
    properties = {"Precision": precision} if precision else {}
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(name), properties)
    integrator.setConstraintTolerance(Precision.of(context).tolerance)
    return context


def start_of(system: openmm.System, positions: Any, place: str, steps: int, seed: int = 1) -> openmm.State:
    """After some steps of a thermostat, from a minimum that the CPU finds: OpenMM's own crashes there with pocl."""
    minimizer = placed(system, openmm.VerletIntegrator(STEP), "CPU")
    minimizer.setPositions(positions)
    openmm.LocalEnergyMinimizer.minimize(minimizer, 50, 100)
    integrator = openmm.LangevinMiddleIntegrator(TEMPERATURE, 5.0, STEP)
    integrator.setRandomNumberSeed(seed)
    context = placed(system, integrator, place)
    context.setPositions(minimizer.getState(positions=True).getPositions())
    context.setVelocitiesToTemperature(TEMPERATURE, seed)
    integrator.step(steps)
    context.applyVelocityConstraints(integrator.getConstraintTolerance())
    return context.getState(positions=True, velocities=True)


def residual(system: openmm.System, x: np.ndarray) -> float:
    """The largest relative error of a distance that the System holds."""
    rows = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    pairs = np.array([row[:2] for row in rows])
    lengths = np.array([row[2].value_in_unit(unit.nanometer) for row in rows])
    d = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    return float(np.abs(d / lengths - 1).max())


def total_energy(context: openmm.Context) -> float:
    state = context.getState(energy=True)
    return (state.getKineticEnergy() + state.getPotentialEnergy()).value_in_unit(unit.kilojoule_per_mole)


def drift(integrator: openmm.Integrator, context: openmm.Context, picoseconds: float, freedom: int) -> dict[str, float]:
    """Slope of the total energy, and its standard error from blocks."""
    every = min(50, max(1, round(picoseconds / STEP / 20)))
    samples = max(20, round(picoseconds / STEP / every))
    energies = []
    for _ in range(samples):
        integrator.step(every)
        energies.append(total_energy(context))
    t = np.arange(samples) * every * STEP * 1e-3
    y = np.array(energies) / (0.00831446261815324 * TEMPERATURE * freedom)
    found = slope(t, y)
    return {"slope": found.value, "error": found.error, "picoseconds": samples * every * STEP}


def on_platform(title: str, make: Callable[[], Any], place: str, full: bool) -> Iterator[dict[str, Any]]:
    """Speed, residual and drift of all integrators on one System and platform."""
    system, positions = make()
    start = start_of(system, positions, place, 2000 if full else 20)
    freedom = 3 * system.getNumParticles() - system.getNumConstraints() - 3
    integrators = {name: make() for name, make in INTEGRATORS.items()}
    contexts = {name: placed(system, integrator, place) for name, integrator in integrators.items()}
    steps, rounds = (400, 15) if full else (3, 3)
    for name, context in contexts.items():
        context.setState(start)
        integrators[name].step(2 * steps)
        context.getState(energy=True)

    def call(name: str) -> None:
        integrators[name].step(steps)
        contexts[name].getState(energy=True)

    calls = {name: partial(call, name) for name in integrators}
    held = Precision.of(next(iter(contexts.values())))
    about = {"part": "speed", "system": title, "atoms": system.getNumParticles(), "precision": str(held)}
    for name, row in harness.speeds(harness.in_turn(calls, rounds, clock=time.perf_counter), steps).items():
        off = residual(system, positions_of(contexts[name]))
        moved: dict[str, float] = {}
        if name in CONSERVING:
            contexts[name].setState(start)
            moved = drift(integrators[name], contexts[name], 100.0 if full else 0.1, freedom)
        yield {**about, "tolerance": held.tolerance, "integrator": name, **row, "residual": off, **moved}


def drifts(place: str, pdb: Path, picoseconds: float, starts: int) -> Iterator[dict[str, Any]]:
    """Drift and residual of those at constant energy, from the same starts.

    The error of a mean over starts is the larger of what blocks within the runs say and what the scatter says.
    """
    system, positions = protein(pdb, app.HBonds)
    freedom = 3 * system.getNumParticles() - system.getNumConstraints() - 3
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in CONSERVING}
    for seed in range(1, starts + 1):
        start = start_of(system, positions, place, 2000 if picoseconds >= 1 else 20, seed)
        for name, done in runs.items():
            integrator = INTEGRATORS[name]()
            context = placed(system, integrator, place)
            context.setState(start)
            slope = drift(integrator, context, picoseconds, freedom)
            done.append(slope | {"residual": residual(system, positions_of(context))})
    held = Precision.of(context)
    system_name = "Villin" if pdb == VILLIN else pdb.stem
    about = {"part": "drift", "system": system_name, "atoms": system.getNumParticles(), "precision": str(held)}
    for name, done in runs.items():
        slopes, errors = (np.array([run[key] for run in done]) for key in ("slope", "error"))
        blocks = np.sqrt(np.sum(errors**2)) / starts
        scatter = slopes.std(ddof=1) / np.sqrt(starts) if starts > 1 else 0.0
        mean = {"slope": float(slopes.mean()), "error": float(max(blocks, scatter)), "picoseconds": picoseconds}
        off = max(run["residual"] for run in done)
        yield {**about, "integrator": name, "starts": starts, "residual": off, **mean}


# -- the study --------------------------------------------------------------------------------------


def pieces(chosen: argparse.Namespace) -> dict[str, Any]:
    full, found = not chosen.quick, {}
    systems: dict[str, Callable[[], Any]] = {"Rigid water": partial(water, 3.0 if full else 1.9)}
    if chosen.pdb:
        for held in ("HBonds", "AllBonds"):
            systems[f"{chosen.pdb.stem}, {held}"] = partial(protein, chosen.pdb, getattr(app, held))
    for place in chosen.platform or ["CPU"]:
        if chosen.drift:
            found[place] = partial(drifts, place, chosen.pdb or VILLIN, chosen.drift, chosen.starts)
        else:
            found |= {
                f"{place}, {name}": partial(on_platform, name, make, place, full) for name, make in systems.items()
            }
    return found


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    about = {"system": "{}", "precision": "{}", "integrator": "{}"}
    moved = {"residual": "{:.0e}", "slope": "{:+.1e}", "error": "{:.0e}"}
    return {
        "ms a step, speed of Verlet's, largest residual, drift in kT/ns/dof": harness.shown(
            table, "speed", **about, ms="{:.3f}", ratio="{:.2f}", **moved
        ),
        "Largest residual, drift in kT/ns/dof": harness.shown(table, "drift", **about, **moved),
    }


def main() -> None:
    parser = harness.options(__doc__, "openmm-platforms")
    parser.add_argument("--platform", action="append", help="such as CPU or 'CUDA mixed'; may be given several times")
    parser.add_argument("--pdb", type=Path, help="a solvated protein to be measured as well")
    parser.add_argument("--device", default="", help="the name of the processor, where that is a GPU")
    parser.add_argument("--drift", type=float, metavar="PS", help="only the drift, over so many picoseconds")
    parser.add_argument("--starts", type=int, default=1, help="with --drift: so many runs of each integrator")
    harness.main("openmm_platforms", parser, pieces, tables)


if __name__ == "__main__":
    main()
