"""OpenMM's platforms and precisions: what kcons costs there, how closely it holds, and how the energy drifts.

    python openmm_platforms.py                           short runs on the CPU
    python openmm_platforms.py --platform "CUDA mixed" --full --out F   the committed results
    python openmm_platforms.py --platform "OpenCL mixed" --drift 10 --starts 3 --out F   of villin in water
    python openmm_platforms.py --show F                  the tables of an earlier run

Speeds are medians of runs that take turns, relative to openmm.VerletIntegrator at the same tolerance of the
constraints. The drift is the slope of the total energy at 2 fs, in kT a nanosecond and degree of freedom, with its
standard error from ten blocks. With --pdb, a solvated protein is measured as well; --drift takes villin, which comes
with OpenMM, where no other is given.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import study_scripts as scripts
from openmm import app, unit
from rich.console import Console

from kcons.comparison import environment, processor_of
from kcons.openmm import Isokinetic, Langevin, Precision, ProjectedIntegrator, RattleIntegrator, positions_of

DATA = Path(__file__).resolve().parents[2] / "tests" / "data"
TEMPERATURE, FRICTION, STEP = 300.0, 1.0, 0.002
#: Integrators by name; those of OpenMM are given the tolerance that kcons takes by itself.
INTEGRATORS: dict[str, Callable[[], openmm.Integrator]] = {
    "VerletIntegrator": lambda: openmm.VerletIntegrator(STEP),
    "kcons RattleIntegrator": lambda: RattleIntegrator(STEP),
    "kcons rattle": lambda: ProjectedIntegrator(STEP),
    "LangevinMiddleIntegrator": lambda: openmm.LangevinMiddleIntegrator(TEMPERATURE, FRICTION, STEP),
    "kcons Langevin": lambda: ProjectedIntegrator(STEP, ensemble=Langevin(TEMPERATURE, FRICTION)),
    "kcons Isokinetic": lambda: ProjectedIntegrator(STEP, ensemble=Isokinetic(TEMPERATURE)),
}
#: Villin in water.
VILLIN = Path(app.__file__).parent / "data" / "test.pdb"
#: Those at constant energy.
CONSERVING = ("VerletIntegrator", "kcons RattleIntegrator", "kcons rattle")


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
    minimiser = placed(system, openmm.VerletIntegrator(STEP), "CPU")
    minimiser.setPositions(positions)
    openmm.LocalEnergyMinimizer.minimize(minimiser, 50, 100)
    integrator = openmm.LangevinMiddleIntegrator(TEMPERATURE, 5.0, STEP)
    integrator.setRandomNumberSeed(seed)
    context = placed(system, integrator, place)
    context.setPositions(minimiser.getState(positions=True).getPositions())
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
    slope, error = scripts.slope(t, y)
    return {"slope": slope, "error": error, "picoseconds": samples * every * STEP}


def on_platform(title: str, system: openmm.System, positions: Any, place: str, full: bool) -> dict[str, Any]:
    """Speed, residual and drift of all integrators on one System and platform."""
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
    rows: dict[str, dict[str, Any]] = scripts.speeds(scripts.in_turn(calls, rounds, clock=time.perf_counter), steps)
    for name, row in rows.items():
        row["residual"] = residual(system, positions_of(contexts[name]))
        if name in CONSERVING:
            contexts[name].setState(start)
            row["drift"] = drift(integrators[name], contexts[name], 100.0 if full else 0.1, freedom)
    held = Precision.of(next(iter(contexts.values())))
    return {
        "title": f"{title}, {system.getNumParticles()} atoms, {held}, tolerance {held.tolerance:g}",
        "steps": steps,
        "rows": rows,
    }


def drifts(place: str, pdb: Path, picoseconds: float, starts: int) -> dict[str, Any]:
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
    rows: dict[str, dict[str, Any]] = {}
    for name, done in runs.items():
        slopes, errors = (np.array([run[key] for run in done]) for key in ("slope", "error"))
        blocks = np.sqrt(np.sum(errors**2)) / starts
        scatter = slopes.std(ddof=1) / np.sqrt(starts) if starts > 1 else 0.0
        mean = {"slope": float(slopes.mean()), "error": float(max(blocks, scatter)), "picoseconds": picoseconds}
        rows[name] = {"drift": mean, "residual": max(run["residual"] for run in done), "runs": done}
    held = Precision.of(context)
    name = "Villin" if pdb == VILLIN else pdb.stem
    title = f"{name} in water, HBonds, {system.getNumParticles()} atoms, {held}, tolerance {held.tolerance:g}"
    return {"title": f"{title}, {starts} x {picoseconds:g} ps", "rows": rows}


# -- output -----------------------------------------------------------------------------------------


def show(result: dict[str, Any]) -> None:
    console = Console(width=120)
    timed = ("µs a step", "speed, of Verlet")
    for part in result["measurements"]:
        rows = []
        for name, row in part["rows"].items():
            drifting = row.get("drift")
            slope = f"{drifting['slope']:+.1e} ± {drifting['error']:.0e}" if drifting else ""
            times = (f"{1e3 * row['ms']:.0f}", f"{row['ratio']:.2f}") if "ms" in row else ()
            rows.append((name, *times, f"{row['residual']:.0e}", slope))
        headings = ("integrator", *(timed if times else ()), "largest residual", "drift, kT/ns/dof")
        console.print(scripts.table(part["title"], headings, {"integrator"}, rows))
    machine = result["machine"]
    console.print(
        f"{result['device'] or processor_of(machine)}; OpenMM {machine['versions']['openmm']}; {machine['date']}"
    )


def measured(chosen: argparse.Namespace) -> dict[str, Any]:
    places = chosen.platform or ["CPU"]
    about = {"machine": environment(), "device": chosen.device}
    if chosen.drift:
        runs = [drifts(place, chosen.pdb or VILLIN, chosen.drift, chosen.starts) for place in places]
        return about | {"full": chosen.drift >= 10, "measurements": runs}
    systems = [("Rigid water", *water(3.0 if chosen.full else 1.9))]
    if chosen.pdb:
        systems += [
            (f"{chosen.pdb.stem}, {held}", *protein(chosen.pdb, getattr(app, held))) for held in ("HBonds", "AllBonds")
        ]
    runs = [
        on_platform(title, system, positions, place, chosen.full)
        for place in places
        for title, system, positions in systems
    ]
    return about | {"full": chosen.full, "measurements": runs}


def main() -> None:
    parser = scripts.options(__doc__, full="the sizes of the committed results")
    parser.add_argument("--platform", action="append", help="such as CPU or 'CUDA mixed'; may be given several times")
    parser.add_argument("--pdb", type=Path, help="a solvated protein to be measured as well")
    parser.add_argument("--device", default="", help="the name of the processor, where that is a GPU")
    parser.add_argument("--drift", type=float, metavar="PS", help="only the drift, over so many picoseconds")
    parser.add_argument("--starts", type=int, default=1, help="with --drift: so many runs of each integrator")
    scripts.script(parser, measured, show)


if __name__ == "__main__":
    main()
