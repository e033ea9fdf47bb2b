"""How long may a step be? A peptide in rigid water with PME, its bonds to hydrogen held.

    python peptide_steps.py                  two short runs, seconds: large errors
    python peptide_steps.py --full --out F   the committed results, an hour; goes on where it was stopped
    python peptide_steps.py --show F         the tables of an earlier result
    python peptide_steps.py --show F --draw P   and its curves, into the picture P

Alanine dipeptide with amber14 in TIP3P. Expensive: PME with 9 A in space, as it is usually run. Cheap: all bonds,
angles and torsions, and the same charges and Lennard-Jones terms up to 6 A, with a reaction field. Temperatures of
shifts and turns are those of water, nearly all of them; internal motion is the peptide's alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import study_scripts as scripts
from ase import units
from openmm import app
from rich.console import Console
from rich.table import Table
from study_scripts import work_off

from kcons import ConstraintSet, Motion
from kcons.cli.progress import Bars
from kcons.comparison import Potential, environment, layers, long_steps, long_steps_report, processor_of
from kcons.constraints import Distance

PDB = Path(__file__).resolve().parents[2] / "tests" / "data" / "alanine-dipeptide-implicit.pdb"
KT, FS = 300 * units.kB, units.fs
ENERGY, LENGTH = units.kJ / units.mol, units.nm
#: Edge of the box, and how far expensive and cheap forces reach in space, in nm.
EDGE, SLOW, FAST = 2.2, 0.9, 0.6
#: Edge of a quick run, of 500 atoms.
SMALL = 1.85
#: Longest step of the cheap forces in fs: bonds to hydrogen are held, angles are not.
INNER = 2.0


def potential(system: openmm.System, positions: np.ndarray, name: str) -> Potential:
    """Energies and forces of a System on one thread of OpenMM's CPU platform."""
    platform = openmm.Platform.getPlatformByName("CPU")
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), platform, {"Threads": "1"})

    def evaluate(x: np.ndarray) -> tuple[float, np.ndarray]:
        context.setPositions(x / LENGTH)
        state = context.getState(energy=True, forces=True)
        forces = state.getForces(asNumpy=True)._value
        return state.getPotentialEnergy()._value * ENERGY, np.asarray(forces) * (ENERGY / LENGTH)

    return Potential(evaluate, name)


def equilibrated(system: openmm.System, positions: Any, picoseconds: float) -> np.ndarray:
    """Positions in nm after a minimisation and Langevin dynamics; the same in every run."""
    integrator = openmm.LangevinMiddleIntegrator(300, 5, 0.002)
    integrator.setRandomNumberSeed(1)
    platform = openmm.Platform.getPlatformByName("CPU")
    context = openmm.Context(system, integrator, platform, {"Threads": "1"})
    context.setPositions(positions)
    openmm.LocalEnergyMinimizer.minimize(context, 50, 100)
    context.setVelocitiesToTemperature(300, 1)
    integrator.step(round(picoseconds / 0.002))
    return np.asarray(context.getState(positions=True).getPositions(asNumpy=True)._value)


@cache
def peptide(full: bool) -> layers.Layers:
    """Alanine dipeptide in water with both forces."""
    field = app.ForceField("amber14-all.xml", "amber14/tip3p.xml")
    pdb = app.PDBFile(str(PDB))
    box = app.Modeller(pdb.topology, pdb.positions)
    box.addSolvent(field, boxSize=openmm.Vec3(1, 1, 1) * (EDGE if full else SMALL), neutralize=False)
    make = partial(field.createSystem, box.topology, constraints=app.HBonds, rigidWater=True, removeCMMotion=False)
    slow = make(nonbondedMethod=app.PME, nonbondedCutoff=SLOW, switchDistance=0.9 * SLOW)
    fast = make(nonbondedMethod=app.CutoffPeriodic, nonbondedCutoff=FAST, switchDistance=0.8 * FAST)
    x = equilibrated(slow, box.positions, 40.0 if full else 0.02) * LENGTH
    held = [slow.getConstraintParameters(k) for k in range(slow.getNumConstraints())]
    pairs, lengths = [(i, j) for i, j, _ in held], np.array([d._value for *_, d in held]) * LENGTH
    masses = np.array([slow.getParticleMass(k)._value for k in range(slow.getNumParticles())])
    motion = Motion(ConstraintSet(Distance(pairs, lengths), x, masses), x)
    peptide_atoms = [atom.index for atom in box.topology.atoms() if atom.residue.name != "HOH"]
    ends = [next(k for k in peptide_atoms if masses[k] > 2), [k for k in peptide_atoms if masses[k] > 2][-1]]
    return layers.Layers(
        title=f"alanine dipeptide in water, {len(x)} atoms",
        motion=motion,
        positions=motion.restore_positions(x),
        slow=potential(slow, x, "PME"),
        fast=potential(fast, x, f"within {10 * FAST:g} A"),
        thermal_energy=KT,
        inner=INNER * FS,
        steps=(),
        interval=48 * FS,
        flight=60 * FS,
        observables={"ends": lambda x: float(np.linalg.norm(x[ends[0]] - x[ends[1]]))},
    )


# -- runs ---------------------------------------------------------------------------------------------

#: Steps in fs and frictions a ps of each method.
RUNS: dict[str, dict[float, tuple[float, ...]]] = {
    "langevin": {2.0: (5.0,), 4.0: (5.0,)},
    "langevin-respa": {8.0: (5.0,), 12.0: (20.0,), 16.0: (20.0,)},
    "langevin-halfway": {8.0: (5.0,), 12.0: (20.0,), 16.0: (20.0,)},
    "spheres": {8.0: (5.0,), 16.0: (5.0, 20.0), 24.0: (20.0,), 32.0: (20.0,)},
    "hmc": {6.0: (1.0,)},
}
#: Picoseconds of each run.
SAMPLED = 48.0


def stepped(method: str, step: float, friction: float, full: bool) -> dict[str, Any]:
    """One method at one step and friction."""
    made, begun = peptide(full), time.process_time()
    length = SAMPLED if full else 0.02
    found = long_steps.measure(
        made, long_steps.METHODS[method], step * FS, friction / (1000 * FS), length=1000 * length * FS
    )
    return {"cpu_seconds": time.process_time() - begun, **found.to_dict()}


def cost() -> dict[str, Any]:
    """Processor time of one evaluation of cheap forces over that of expensive ones, in paired turns."""
    made = peptide(True)
    x, moved = made.positions, iter(range(10**6))

    def evaluate(which: Potential) -> None:
        for _ in range(10):
            which.forces(x + 1e-6 * next(moved))

    spent = scripts.in_turn({"slow": partial(evaluate, made.slow), "fast": partial(evaluate, made.fast)}, 11)
    return {"cheap over expensive": scripts.ratio(spent["fast"], spent["slow"])}


def jobs(full: bool) -> dict[str, Callable[[], dict[str, Any]]]:
    """What there is to run, by name."""
    if not full:
        return {name: partial(stepped, name, step, 5.0, False) for name, step in (("langevin", 2.0), ("spheres", 8.0))}
    found: dict[str, Callable[[], dict[str, Any]]] = {
        f"{method}, {step:g} fs, {friction:g}/ps": partial(stepped, method, step, friction, True)
        for method, steps in RUNS.items()
        for step, frictions in steps.items()
        for friction in frictions
    }
    return {**found, "cost": cost}


def measure(*, quick: bool, keep: Callable[[dict[str, Any]], None], earlier: dict[str, Any] | None) -> dict[str, Any]:
    """All runs but those that an earlier measurement has made, kept one by one."""
    result = {"machine": environment(), "full": not quick, "parts": {}, **(earlier or {})}

    def put(name: str, found: dict[str, Any]) -> None:
        result["parts"][name] = found
        keep(result)

    with Bars() as watcher:
        work_off("peptide", jobs(not quick), put, result["parts"], watcher)
    return result


# -- what it says -------------------------------------------------------------------------------------


def runs_of(result: dict[str, Any]) -> list[long_steps.Stepped]:
    """Runs as they were measured, each method and step with its best friction; the reference first."""
    fields = long_steps.Stepped.__dataclass_fields__
    parts = [part for part in result["parts"].values() if "method" in part]
    return long_steps.best(long_steps.Stepped(**{key: part[key] for key in fields if key in part}) for part in parts)


def show(result: dict[str, Any], console: Console) -> None:
    runs = runs_of(result)
    first = runs[0]
    title = (
        f"Alanine dipeptide in rigid TIP3P; PME beyond {10 * SLOW:g} Å, in cheap forces nothing beyond {10 * FAST:g} Å"
    )
    table = Table(box=None, title=title)
    headings = ("method", "step\nfs", "friction\n1/ps", "calls\na ps", "T of shifts\n%", "T of turns\n%", "T inside\n%")
    for k, heading in enumerate((*headings, "<U> off by\nkT", "calls for a\nsample of U")):
        table.add_column(heading, justify="right" if k else "left")
    for run in runs:
        cells = [long_steps.METHODS[run.method].title, f"{run.step:g}"]
        cells.append(f"{1000 * run.friction:g}" if run.friction else "")
        if run.status != "ok":
            table.add_row(*cells, "", run.status)
            continue
        cells.append(f"{1000 * run.per_time:.0f}")
        for kind in ("shift", "turn", "internal"):
            value, error = run.kinds[kind]
            cells.append(f"{100 * value:+.1f} ± {100 * error:.1f}")
        off, error = (run.energy[0] - first.energy[0]) / KT, float(np.hypot(run.energy[1], first.energy[1])) / KT
        cells += [f"{off:+.1f} ± {error if run is not first else first.energy[1] / KT:.1f}", f"{run.correlation:.0f}"]
        table.add_row(*cells)
    console.print(table)
    console.print(
        "calls: evaluations with PME. T: temperatures of configurations off the one asked for; inside: of the"
    )
    console.print("peptide. <U> off by: less the first run.", highlight=False)
    if "cost" in result["parts"]:
        ratio = result["parts"]["cost"]["cheap over expensive"]
        console.print(f"An evaluation of the cheap forces takes {ratio:.2f} of the time of an expensive one.")
    machine = result["machine"]
    spent = sum(part.get("cpu_seconds", 0.0) for part in result["parts"].values())
    console.print(
        f"{spent / 60:.0f} min of {processor_of(machine)}; commit {machine['commit'][:10]}, {machine['date']}"
    )


def draw(result: dict[str, Any], path: str) -> None:
    """What turns are off by, and what an independent sample of the energy costs."""
    from matplotlib.figure import Figure

    picture = Figure((9, 3.6), layout="constrained")
    turns, cost = picture.subplots(1, 2)
    for method, (colour, marker) in long_steps_report.STYLES.items():
        seen = sorted((run for run in runs_of(result) if run.method == method), key=lambda run: run.step)
        title, steps = long_steps.METHODS[method].title.replace("the same", "Langevin"), [run.step for run in seen]
        style = {"marker": marker, "color": colour, "label": title}
        off, error = 100 * np.transpose([run.kinds["turn"] for run in seen])
        turns.errorbar(steps, off, error, capsize=2, **style)
        cost.loglog(steps, [run.correlation for run in seen], **style)
    turns.axhline(0, color="grey", linewidth=0.8)
    turns.set(xscale="log", xlabel="step / fs", ylabel="T of turns off by / %")
    cost.set(xlabel="step / fs", ylabel="evaluations with PME for a sample of U")
    for panel in (turns, cost):
        panel.set_xticks((2, 4, 8, 16, 32), ("2", "4", "8", "16", "32"))
        panel.set_xticks((), minor=True)
    turns.legend(frameon=False, fontsize="small")
    picture.savefig(path, dpi=150)


if __name__ == "__main__":
    scripts.script_of_parts(__doc__, measure, show, draw, width=160)
