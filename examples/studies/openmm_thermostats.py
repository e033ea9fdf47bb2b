"""Constant temperature in OpenMM with kcons: what it costs, and how the time step changes what is sampled.

    python openmm_thermostats.py                  short runs, ten seconds
    python openmm_thermostats.py --full --out F   the committed results; F receives JSON after each run
    python openmm_thermostats.py --show F         the tables of an earlier run

Times are medians, one thread, of runs that take turns; only their ratios mean something. The mean potential energy of
alanine dipeptide (bonds with hydrogen held) in rigid water is compared with that of 1 fs; errors are standard errors
from blocks. Kinetic energies of rigid water are compared with what the degrees of freedom say: their mean is g kT/2,
and their variance g (kT)^2/2.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENMM_CPU_THREADS", "1")

import numpy as np
import openmm
import study_scripts as scripts
from openmm import app, unit
from rich.console import Console

from kcons.comparison import environment, json_files, processor_of
from kcons.openmm import Isokinetic, Langevin, NoseHoover, ProjectedIntegrator, RattleIntegrator

DATA = Path(__file__).resolve().parents[2] / "tests" / "data"
TOLERANCE = 1e-8
TEMPERATURE, FRICTION, FREQUENCY = 300.0, 1.0, 20.0
Make = Callable[[float], openmm.Integrator]


def langevin(dt: float) -> openmm.Integrator:
    return ProjectedIntegrator(dt, ensemble=Langevin(TEMPERATURE, FRICTION))


def middle(dt: float) -> openmm.Integrator:
    return openmm.LangevinMiddleIntegrator(TEMPERATURE, FRICTION, dt)


def isokinetic(dt: float) -> openmm.Integrator:
    # Charges on a mesh conserve momentum roughly only; the CMMotionRemover of the System keeps it at zero.
    return ProjectedIntegrator(dt, ensemble=Isokinetic(TEMPERATURE))


def nose_hoover(dt: float) -> ProjectedIntegrator:
    return ProjectedIntegrator(dt, ensemble=NoseHoover(TEMPERATURE, FREQUENCY))


# -- systems ----------------------------------------------------------------------------------------


def water(edge: float) -> tuple[openmm.System, Any]:
    """Rigid TIP3P, PME."""
    field = app.ForceField("tip3p.xml")
    box = app.Modeller(app.Topology(), [])
    box.addSolvent(field, boxSize=openmm.Vec3(edge, edge, edge))
    system = field.createSystem(
        box.topology, nonbondedMethod=app.PME, nonbondedCutoff=min(1.0, 0.45 * edge), rigidWater=True
    )
    return system, box.positions


def peptide(edge: float) -> tuple[openmm.System, Any]:
    """Alanine dipeptide in rigid TIP3P, bonds with hydrogen held, reaction field."""
    field = app.ForceField("amber14-all.xml", "amber14/tip3p.xml")
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    box = app.Modeller(pdb.topology, pdb.positions)
    box.addSolvent(field, boxSize=openmm.Vec3(edge, edge, edge), neutralize=False)
    system = field.createSystem(
        box.topology,
        nonbondedMethod=app.CutoffPeriodic,
        nonbondedCutoff=0.45 * edge,
        constraints=app.HBonds,
        rigidWater=True,
    )
    return system, box.positions


def started(system: openmm.System, positions: Any, integrator: openmm.Integrator) -> openmm.Context:
    integrator.setConstraintTolerance(TOLERANCE)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("CPU"), {"Threads": "1"})
    context.setPositions(positions)
    return context


# -- what is measured -------------------------------------------------------------------------------


#: What is timed; the first is what others are relative to.
MAKERS: dict[str, Callable[[], openmm.Integrator]] = {
    "VerletIntegrator": partial(openmm.VerletIntegrator, 0.002),
    "LangevinMiddleIntegrator": partial(middle, 0.002),
    "kcons RattleIntegrator": partial(RattleIntegrator, 0.002),
    "kcons rattle": partial(ProjectedIntegrator, 0.002),
    "kcons Isokinetic": partial(isokinetic, 0.002),
    "kcons Isokinetic, leapfrog": partial(ProjectedIntegrator, 0.002, "leapfrog", ensemble=Isokinetic(TEMPERATURE)),
    "kcons Langevin": partial(langevin, 0.002),
    "kcons NoseHoover": partial(nose_hoover, 0.002),
}


def start_of(system: openmm.System, positions: Any) -> openmm.State:
    context = started(system, positions, openmm.VerletIntegrator(0.002))
    openmm.LocalEnergyMinimizer.minimize(context, 50, 50)
    context.applyConstraints(TOLERANCE)
    context.setVelocitiesToTemperature(TEMPERATURE, 1)
    return context.getState(positions=True, velocities=True)


def speed(full: bool) -> dict[str, Any]:
    """Steps a second relative to VerletIntegrator, by CPU time. Where arrays lie in memory matters: Contexts are new
    from build to build."""
    system, positions = water(3.0 if full else 2.0)
    state = start_of(system, positions)
    steps, rounds, builds = (20, 10, 7) if full else (5, 3, 1)
    seconds: dict[str, list[float]] = {name: [] for name in MAKERS}
    for _ in range(builds):
        integrators = {name: make() for name, make in MAKERS.items()}
        contexts = {name: started(system, positions, integrator) for name, integrator in integrators.items()}
        for name, each in contexts.items():
            each.setState(state)
            integrators[name].step(5)

        def call(name: str, integrators: Any = integrators, contexts: Any = contexts) -> None:
            integrators[name].step(steps)
            contexts[name].getState(positions=True)

        for name, found in scripts.in_turn({name: partial(call, name) for name in MAKERS}, rounds).items():
            seconds[name] += found
    rows = scripts.speeds(seconds, steps)
    return {"title": f"Rigid water, {system.getNumParticles()} atoms, PME, 2 fs", "rows": rows}


def in_simulation(full: bool) -> dict[str, Any]:
    """What `Simulation.step`, which calls `step(10)`, takes of the time of one call for as many steps: medians of
    quotients of CPU times of runs that follow one another, with the standard error of a median."""
    system, positions = water(3.0 if full else 2.0)
    state = start_of(system, positions)
    steps, rounds = (100, 60) if full else (20, 3)
    rows = {}
    for name, make in MAKERS.items():
        integrator = make()
        integrator.setConstraintTolerance(TOLERANCE)
        platform = openmm.Platform.getPlatformByName("CPU")
        simulation = app.Simulation(app.Topology(), system, integrator, platform, {"Threads": "1"})
        simulation.context.setState(state)
        simulation.step(20)
        calls = {"simulation": partial(simulation.step, steps), "one call": partial(integrator.step, steps)}
        seconds = scripts.in_turn(calls, rounds)
        quotients = np.array(seconds["simulation"]) / np.array(seconds["one call"])
        rows[name] = {
            "ms": 1e3 * float(np.median(seconds["one call"])) / steps,
            "quotient": float(np.median(quotients)),
            "error": float(1.25 * quotients.std(ddof=1) / np.sqrt(rounds)),
        }
    return {"title": f"Simulation.step beside one call, {system.getNumParticles()} atoms, 2 fs", "rows": rows}


def mean_energy(
    make: Make, fs: float, picoseconds: float, interval: float, system: openmm.System, positions: Any
) -> dict[str, float]:
    """Mean potential energy in kJ/mol, with the standard error from twenty blocks; a sample in so many fs."""
    integrator = make(fs * 1e-3)
    integrator.setRandomNumberSeed(1)  # type: ignore[attr-defined]
    context = started(system, positions, integrator)
    context.setVelocitiesToTemperature(TEMPERATURE, 2)
    every = max(1, round(interval / fs))
    samples = round(picoseconds * 1e3 / fs / every)
    integrator.step(round(min(20.0, 0.1 * picoseconds) * 1e3 / fs))
    values = []
    for _ in range(samples):
        integrator.step(every)
        values.append(context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole))
    blocks = np.array([part.mean() for part in np.array_split(np.array(values), 20)])
    return {"fs": fs, "mean": float(np.mean(values)), "error": float(blocks.std(ddof=1) / np.sqrt(len(blocks)))}


def sampling(full: bool, keep: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Mean potential energy at several time steps."""
    edge = 1.5
    system, positions = peptide(edge)
    relax = openmm.LangevinMiddleIntegrator(TEMPERATURE, 10.0, 0.001)
    context = started(system, positions, relax)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 200)
    relax.step(50_000 if full else 200)
    positions = context.getState(positions=True).getPositions(asNumpy=True)
    length, interval = (1000.0, 100.0) if full else (0.2, 8.0)
    plan: list[tuple[str, Make, float, float]] = [
        ("LangevinMiddleIntegrator", middle, 1.0, 1.0),
        *[("kcons Langevin", langevin, fs, 1.0) for fs in (1.0, 2.0, 3.0, 4.0)],
        *[("LangevinMiddleIntegrator", middle, fs, 1.0) for fs in (2.0, 3.0, 4.0)],
        *[("kcons Isokinetic", isokinetic, fs, 1.0) for fs in (2.0, 3.0)],
    ]
    plan = plan if full else plan[::4]
    rows: dict[str, list[dict[str, float]]] = {}
    result = {
        "title": f"Mean potential energy, alanine dipeptide in water, {system.getNumParticles()} atoms, {length:g} ps",
        "sampling": rows,
    }
    for name, make, fs, share in plan:
        rows.setdefault(name, []).append(mean_energy(make, fs, share * length, interval, system, positions))
        keep(result)
    reference = [row for points in rows.values() for row in points if row["fs"] == 1.0]
    weights = np.array([row["error"] ** -2 for row in reference])
    result["reference"] = {
        "mean": float(weights @ [row["mean"] for row in reference] / weights.sum()),
        "error": float(weights.sum() ** -0.5),
    }
    keep(result)
    return result


def kinetic(full: bool) -> dict[str, Any]:
    """Twice the kinetic energy of rigid water in kT: mean and variance, beside g and 2 g."""
    system, positions = water(1.0)
    picoseconds = 100.0 if full else 0.5
    rows = {}
    for dt in (0.001, 0.002) if full else (0.002,):
        integrator = nose_hoover(dt)
        context = started(system, positions, integrator)
        integrator.minimizeEnergy(context, maxIterations=100)
        integrator.setVelocitiesToTemperature(context, TEMPERATURE, 1)
        integrator.step(round(min(20.0, picoseconds) / dt))
        every = round(0.02 / dt)
        values = []
        for _ in range(round(picoseconds / 0.02)):
            integrator.step(every)
            values.append(2 * integrator.kinetic_energy() / (unit.MOLAR_GAS_CONSTANT_R * TEMPERATURE * unit.kelvin))
        found, g = np.array(values), integrator.ensemble.count(integrator)  # type: ignore[attr-defined]
        row: dict[str, float] = {"g": g}
        for name, what in (("mean", found), ("variance", (found - g) ** 2)):
            blocks = np.array([part.mean() for part in np.array_split(what, 20)])
            row[name], row[f"{name} error"] = float(what.mean()), float(blocks.std(ddof=1) / np.sqrt(20))
        rows[f"kcons NoseHoover, {1e3 * dt:g} fs"] = row
    title = f"Kinetic energy of rigid water, {system.getNumParticles()} atoms, {picoseconds:g} ps"
    return {"title": title, "rows": rows}


# -- output -----------------------------------------------------------------------------------------


def show(result: dict[str, Any], console: Console) -> None:
    last: dict[str, tuple[str, Callable[[dict[str, float]], str]]] = {
        "speed": ("steps a second, relative", lambda row: f"{row['ratio']:.2f}"),
        "simulation": ("Simulation.step, relative", lambda row: f"{row['quotient']:.3f} ± {row['error']:.3f}"),
    }
    for name, (heading, relative) in last.items():
        if timed := result["measurements"].get(name):
            table = scripts.table(timed["title"], ("integrator", "ms a step", heading), {"integrator"})
            for integrator, row in timed["rows"].items():
                table.add_row(integrator, f"{row['ms']:.2f}", relative(row))
            console.print(table)
            console.print(_made_on(timed["machine"]))
    sampled = result["measurements"].get("sampling")
    if sampled and "reference" in sampled:
        headings = ("integrator", "step/fs", "mean U, kJ/mol", "less that at 1 fs")
        table = scripts.table(sampled["title"], headings, {"integrator"})
        zero = sampled["reference"]
        for name, points in sampled["sampling"].items():
            for row in points:
                mean, error = f"{row['mean']:.1f} ± {row['error']:.1f}", np.hypot(row["error"], zero["error"])
                off = "" if row["fs"] == 1.0 else f"{row['mean'] - zero['mean']:+.1f} ± {error:.1f}"
                table.add_row(name, f"{row['fs']:g}", mean, off)
        console.print(table)
        console.print(_made_on(sampled["machine"]))
    energies = result["measurements"].get("kinetic")
    if energies:
        columns = ("integrator", "g", "mean 2K/kT", "variance", "2 g")
        table = scripts.table(energies["title"], columns, {"integrator"})
        for name, row in energies["rows"].items():
            mean, variance = (f"{row[what]:.1f} ± {row[f'{what} error']:.1f}" for what in ("mean", "variance"))
            table.add_row(name, f"{row['g']:g}", mean, variance, f"{2 * row['g']:g}")
        console.print(table)
        console.print(_made_on(energies["machine"]))


def _made_on(machine: dict[str, Any]) -> str:
    return (
        f"{processor_of(machine)}, one thread; OpenMM {machine['versions']['openmm']}; "
        f"commit {machine['commit']}, {machine['date']}"
    )


def main() -> None:
    parser = scripts.options(__doc__, full="the sizes of the committed results")
    parser.add_argument(
        "--only",
        choices=["speed", "simulation", "sampling", "kinetic"],
        help="one measurement; others in --out are kept",
    )
    options = parser.parse_args()
    console = Console(width=120)
    if options.show:
        show(json_files.read(options.show), console)
        return
    result: dict[str, Any] = {"measurements": {}}
    if options.out and options.only and options.out.exists():
        result = json_files.read(options.out)
    result["full"] = options.full

    def keep(name: str, measured: dict[str, Any]) -> None:
        result["measurements"][name] = measured | {"machine": environment()}
        if options.out:
            json_files.write(options.out, result)

    if options.only in (None, "speed"):
        keep("speed", speed(options.full))
    if options.only in (None, "simulation"):
        keep("simulation", in_simulation(options.full))
    if options.only in (None, "kinetic"):
        keep("kinetic", kinetic(options.full))
    if options.only in (None, "sampling"):
        sampling(options.full, lambda measured: keep("sampling", measured))
    show(result, console)


if __name__ == "__main__":
    main()
