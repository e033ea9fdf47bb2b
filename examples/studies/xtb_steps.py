"""GFN2-xTB seldom, a cheap force that is fitted to it often: bias and cost of averages against calls of GFN2-xTB.

    python xtb_steps.py                  a short run of each kind, seconds: large errors
    python xtb_steps.py --full --out F   the committed results, half an hour; goes on
    python xtb_steps.py --show F         the tables of an earlier result
    python xtb_steps.py --show F --draw P   and its curves, into the picture P

Four rigid waters in a weak trap, and ethanol with its bonds to hydrogen held. The cheap force is a polynomial of second
order in powers of inverse distances, the same for atoms that are of one kind; it is linear in what is fitted, to forces
of GFN2-xTB along the constraints from one short run.
"""

from __future__ import annotations

import itertools
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from ase import Atoms, units
from ase.build import molecule
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parent))

import study_scripts as scripts
from fitted_forces import FittedForces
from study_scripts import work_off

from kcons import ConstraintSet, Motion, State, System, run
from kcons.cli.progress import Bars
from kcons.comparison import Potential, environment, layers, long_steps, long_steps_report, processor_of
from kcons.constraints import Distance
from kcons.thermostats import ForceGroups, Langevin, thermal_velocities

os.environ.setdefault("OMP_NUM_THREADS", "1")

KT, FS = 300 * units.kB, units.fs
#: Pull of the trap in eV/A^2, which keeps the waters together.
TRAP = 0.02


# -- two systems --------------------------------------------------------------------------------------


def four_waters() -> tuple[Atoms, np.ndarray, np.ndarray, list[np.ndarray]]:
    """Atoms, held pairs, pairs of the cheap force, and exchanges of molecules and of their hydrogens."""
    atoms, rng = Atoms(), np.random.default_rng(1)
    for place in itertools.product((0, 2.9), (0, 2.9), (0,)):
        one = molecule("H2O")
        one.rotate(rng.uniform(0, 360), rng.normal(size=3))
        one.translate(np.array(place) - one.get_center_of_mass())
        atoms += one
    atoms.positions -= atoms.get_center_of_mass()
    first = 3 * np.arange(4)
    held = np.concatenate([first[:, None] + pair for pair in ((0, 1), (0, 2), (1, 2))]).reshape(-1, 2)
    i, j = np.triu_indices(12, 1)
    pairs = np.stack([i, j], axis=1)[i // 3 != j // 3]
    turned = [[(0, 2, 1) if swap else (0, 1, 2) for swap in swaps] for swaps in itertools.product((0, 1), repeat=4)]
    orders = [
        np.concatenate([3 * m + np.array(hydrogens[m]) for m in molecules])
        for molecules in itertools.permutations(range(4))
        for hydrogens in turned
    ]
    return atoms, held, pairs, orders


def ethanol() -> tuple[Atoms, np.ndarray, np.ndarray, list[np.ndarray]]:
    """The same for ethanol, whose hydrogens of one carbon may be exchanged."""
    atoms = molecule("CH3CH2OH")
    distances = atoms.get_all_distances()
    i, j = np.triu_indices(len(atoms), 1)
    bonded = (distances[i, j] < 1.2) & ((atoms.numbers[i] == 1) | (atoms.numbers[j] == 1))
    near = [
        [k for k in range(len(atoms)) if atoms.numbers[k] == 1 and distances[k, c] < 1.2] for c in range(len(atoms))
    ]
    groups = [found for c, found in enumerate(near) if atoms.numbers[c] > 1 and len(found) > 1]
    orders = []
    for chosen in itertools.product(*(itertools.permutations(group) for group in groups)):
        orders.append(np.arange(len(atoms)))
        for group, order in zip(groups, chosen, strict=True):
            orders[-1][group] = order
    pairs = np.stack([i, j], axis=1)
    return atoms, pairs[bonded], pairs[~bonded], orders


def torsion(x: np.ndarray) -> float:
    """Cosine of C-C-O-H of ethanol."""
    one, two, three = np.diff(x[:4], axis=0)
    a, b = np.cross(one, two), np.cross(two, three)
    return float(a @ b / np.sqrt((a @ a) * (b @ b)))


def apart(i: Sequence[int]) -> Callable[[np.ndarray], float]:
    """The mean distance of these atoms."""
    pairs = np.array(list(itertools.combinations(i, 2))).T
    return lambda x: float(np.linalg.norm(x[pairs[0]] - x[pairs[1]], axis=1).mean())


#: How it is made, powers of inverse distances, what is averaged, inner step in fs, pull of the trap.
CHOSEN: dict[str, tuple[Any, ...]] = {
    "four waters": (four_waters, (1, 3), {"O-O distance": apart((0, 3, 6, 9))}, 4.0, TRAP),
    "ethanol": (ethanol, (1, 2, 3), {"cos torsion": torsion, "C..O distance": apart((0, 2))}, 2.0, 0.0),
}


def xtb(atoms: Atoms, trap: float) -> Potential:
    """GFN2-xTB, and the trap."""
    from tblite.ase import TBLite

    own = Atoms(atoms.numbers, atoms.positions)
    own.calc = TBLite(method="GFN2-xTB", verbosity=0)

    def evaluate(x: np.ndarray) -> tuple[float, np.ndarray]:
        own.positions[:] = x
        return float(own.get_potential_energy()) + 0.5 * trap * float((x * x).sum()), own.get_forces() - trap * x

    return Potential(evaluate, "GFN2-xTB")


@cache
def built(name: str, quick: bool) -> tuple[layers.Layers, dict[str, Any]]:
    """The system with both forces, and how good the cheap ones are."""
    make, powers, observables, inner, trap = CHOSEN[name]
    samples = SAMPLES[quick]
    atoms, held, pairs, exchanges = make()
    motion = Motion(ConstraintSet(Distance(held), atoms.positions, atoms.get_masses()), atoms.positions)
    slow = xtb(atoms, trap)
    # One run at 400 K, each twentieth of its steps of 2 fs.
    system, thermal = System(motion, slow.forces), 400 * units.kB
    state = State(atoms.positions, thermal_velocities(system, atoms.positions, thermal, 1))
    stepper, frames = Langevin(thermal, 0.01 / FS, 1, substeps=1), []
    for step in range(1, 20 * (samples + samples // 4 + 10) + 1):
        state = stepper.step(system, state, 2 * FS)
        if step % 20 == 0:
            frames.append((state.positions, slow.forces(state.positions) + trap * state.positions))
    calls, (train, test) = slow.evaluations, (frames[10 : 10 + samples], frames[10 + samples :])
    cheap = FittedForces(pairs, exchanges, powers[:1] if quick else powers)
    cheap.fit(motion, train)

    def evaluate(x: np.ndarray) -> tuple[float, np.ndarray]:
        energy, forces = cheap.evaluate(x)
        return energy + 0.5 * trap * float((x * x).sum()), forces - trap * x

    made = layers.Layers(
        title=f"{name}, GFN2-xTB and a fitted polynomial",
        motion=motion,
        positions=state.positions,
        slow=slow,
        fast=Potential(evaluate, "polynomial"),
        thermal_energy=KT,
        inner=inner * FS,
        steps=(),
        interval=96 * FS,
        flight=0.0,
        observables=observables,
    )
    return made, {"calls": calls, "coefficients": cheap.coefficients, "error": cheap.error(motion, test)}


# -- runs ---------------------------------------------------------------------------------------------

#: Method, step in fs and friction a ps; the first is the reference.
RUNS: tuple[tuple[str, float, float], ...] = (
    ("langevin", 2.0, 5.0),
    *(("spheres", step, friction) for step in (16.0, 32.0) for friction in (5.0, 20.0)),
    ("langevin-halfway", 16.0, 20.0),
    ("langevin-halfway", 8.0, 5.0),
    ("langevin", 4.0, 5.0),
)
#: Frames of the fit, and ps of each run; the reference is longer.
SAMPLES, LENGTH = {True: 12, False: 400}, {True: 0.6, False: 24.0}
LONGER = {"four waters": 5, "ethanol": 3}


def stepped(name: str, method: str, step: float, friction: float, quick: bool) -> dict[str, Any]:
    """One method at one step and friction, with what it saw."""
    made, fitted = built(name, quick)
    length = LENGTH[quick] * (LONGER[name] if (method, step) == RUNS[0][:2] and not quick else 1)
    if quick:
        made = replace(made, interval=8 * FS)
    begun = time.process_time()
    found = long_steps.measure(
        made, long_steps.METHODS[method], step * FS, friction / (1000 * FS), length=1000 * length * FS
    )
    return {"system": name, "fit": fitted, "cpu_seconds": time.process_time() - begun, **found.to_dict()}


def jobs(quick: bool) -> dict[str, Callable[[], dict[str, Any]]]:
    """What there is to run, by name."""
    chosen = (("ethanol", RUNS[0]), ("ethanol", ("spheres", 8.0, 5.0))) if quick else itertools.product(CHOSEN, RUNS)
    found = {
        f"{name}, {method}, {step:g} fs, {friction:g}/ps": partial(stepped, name, method, step, friction, quick)
        for name, (method, step, friction) in chosen
    }
    return found if quick else {**found, **{f"{name}, cost": partial(cost, name) for name in CHOSEN}}


def cost(name: str) -> dict[str, Any]:
    """Processor time of 0.192 ps over that of steps of 2 fs, in paired turns."""
    made, _ = built(name, False)
    calls: dict[str, Callable[[], Any]] = {}
    for method, step in dict.fromkeys((method, step) for method, step, _ in RUNS):
        stepper = long_steps.METHODS[method].make(made, step * FS, 5e-3 / FS, 1)
        force: Any = made.slow.forces
        if long_steps.METHODS[method].several:
            force = ForceGroups.difference(made.fast.forces, made.slow.forces)
        system = System(made.motion, force)
        start = system.initial_state(made.positions, thermal_velocities(system, made.positions, KT, 1))
        calls[f"{method}, {step:g} fs"] = partial(run, system, start, step * FS, round(192 / step), stepper=stepper)
    spent = scripts.in_turn(calls, 11)
    first = next(iter(spent.values()))
    return {"system": name, "over_two_fs": {key: scripts.ratio(found, first) for key, found in spent.items()}}


def measure(*, quick: bool, keep: Callable[[dict[str, Any]], None], earlier: dict[str, Any] | None) -> dict[str, Any]:
    """All runs but those that an earlier measurement has made, kept one by one."""
    result = {"machine": environment(), "full": not quick, "parts": {}, **(earlier or {})}

    def put(name: str, found: dict[str, Any]) -> None:
        result["parts"][name] = found
        keep(result)

    with Bars() as watcher:
        work_off("GFN2-xTB", jobs(quick), put, result["parts"], watcher)
    return result


# -- what it says -------------------------------------------------------------------------------------


def runs_of(result: dict[str, Any], name: str) -> list[long_steps.Stepped]:
    """Runs of a system as they were measured, each method and step with its best friction; the reference first."""
    fields = long_steps.Stepped.__dataclass_fields__
    parts = [part for part in result["parts"].values() if part["system"] == name and "method" in part]
    return long_steps.best(long_steps.Stepped(**{key: part[key] for key in fields if key in part}) for part in parts)


def averages(one: long_steps.Stepped) -> dict[str, tuple[float, float, float]]:
    """Mean, standard error, and calls for an independent sample."""
    return {"U/kT": (one.energy[0] / KT, one.energy[1] / KT, one.correlation), **one.observed}


def compared(result: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """Each run beside single steps of 2 fs: how far averages are off, and how many times less a sample costs.

    Costs beside single steps of 4 fs, too, whose run is as long as the others.
    """
    runs = runs_of(result, name)
    known, over = averages(runs[0]), result["parts"].get(f"{name}, cost", {}).get("over_two_fs", {})
    usual = next((one for one in runs if (one.method, one.step) == ("langevin", 4.0)), runs[0])
    rows = []
    for one in runs:
        rows.append({"method": one.method, "step": one.step, "friction": 1000 * one.friction, "status": one.status})
        if one.status != "ok":
            continue
        found = averages(one)
        fewer = [{key: was[key][2] / found[key][2] for key in known} for was in (known, averages(usual))]
        spent = over.get(f"{one.method}, {one.step:g} fs", 0.0) * one.step / runs[0].step
        rows[-1] |= {
            "kinds": one.kinds,
            "off": {k: (found[k][0] - known[k][0], float(np.hypot(found[k][1], known[k][1]))) for k in known},
            "calls": {key: found[key][2] for key in known},
            "fewer than 2 fs": fewer[0],
            "fewer than 4 fs": fewer[1],
            "less time": {key: value / spent for key, value in fewer[0].items()} if spent else {},
        }
    return rows


def show(result: dict[str, Any], console: Console) -> None:
    systems = [name for name in CHOSEN if any(part["system"] == name for part in result["parts"].values())]
    for name in systems:
        fit = next(part["fit"] for part in result["parts"].values() if part["system"] == name and "fit" in part)
        rows = compared(result, name)
        kinds, seen = list(rows[0]["kinds"]), list(rows[0]["off"])
        console.print(f"{name}: {fit['coefficients']} coefficients fitted to one run of {fit['calls']} calls; forces")
        console.print(f"along the constraints are off by {100 * fit['error']:.1f} % of their size", highlight=False)
        table = Table(box=None)
        headings = ["method", "fs", "1/ps", *(f"T {kind}\n%" for kind in kinds), *(f"{key}\noff by" for key in seen)]
        for k, heading in enumerate(
            [*headings, "calls", "fewer than\n2 fs", "fewer than\n4 fs", "less time\nthan 2 fs"]
        ):
            table.add_column(heading, justify="right" if k else "left")
        for row in rows:
            cells = [long_steps.METHODS[row["method"]].title, f"{row['step']:g}", f"{row['friction']:g}"]
            if row["status"] != "ok":
                table.add_row(*cells, row["status"])
                continue
            cells += [f"{100 * value:+.0f} ± {100 * error:.0f}" for value, error in row["kinds"].values()]
            cells += [f"{value:+.2f} ± {error:.2f}" for value, error in row["off"].values()]
            cells.append(", ".join(f"{value:.0f}" for value in row["calls"].values()))
            for key in ("fewer than 2 fs", "fewer than 4 fs", "less time"):
                cells.append(", ".join(f"{value:.1f}" if value < 10 else f"{value:.0f}" for value in row[key].values()))
            table.add_row(*cells)
        console.print(table)
    console.print("off by: less the first run. calls: for an independent sample of each of these averages.")
    machine = result["machine"]
    spent = sum(part.get("cpu_seconds", 0.0) for part in result["parts"].values())
    console.print(
        f"{spent / 60:.0f} min of {processor_of(machine)}; commit {machine['commit'][:10]}, {machine['date']}"
    )


def draw(result: dict[str, Any], path: str) -> None:
    """Calls of GFN2-xTB for an independent sample of the energy."""
    from matplotlib.figure import Figure

    picture = Figure((9, 3.6), layout="constrained")
    for panel, name in zip(picture.subplots(1, len(CHOSEN)), CHOSEN, strict=True):
        for method, (colour, marker) in long_steps_report.STYLES.items():
            seen = sorted((one.step, averages(one)["U/kT"][2]) for one in runs_of(result, name) if one.method == method)
            if seen:
                title = long_steps.METHODS[method].title.replace("the same", "Langevin")
                panel.loglog(*np.transpose(seen), marker=marker, color=colour, label=title)
        panel.set(title=name, xlabel="step / fs", ylabel="calls of GFN2-xTB for a sample of U")
        panel.set_xticks((2, 4, 8, 16, 32), ("2", "4", "8", "16", "32"))
        panel.set_xticks((), minor=True)
    picture.axes[0].legend(frameon=False)
    picture.savefig(path, dpi=150)


if __name__ == "__main__":
    scripts.script_of_parts(__doc__, measure, show, draw, width=200)
