"""How long may a step be? Configurations and velocities of rigid water at several time steps.

    python step_length.py                  short runs, seconds: large errors
    python step_length.py --full --out F   the committed results; F receives JSON, run by run; a run that is
                                                       interrupted is continued
    python step_length.py --show F         the tables of an earlier result
    python step_length.py --show F --draw P   and its curves, into the picture P

Is equipartition of rigid water broken at 2 fs, or only its estimator? Kinetic temperatures of translation and rotation,
from velocities at the positions and in the middle of the step, beside the temperatures that configurations have
(`kcons.thermostats.TemperatureSplit`; here with the compiled second derivatives of the fluid). Then bias against
evaluations of expensive forces, for methods with one and with several time steps (`kcons.comparison.long_steps`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import study_scripts as scripts
from ase import units
from rich.console import Console
from rich.table import Table
from study_scripts import work_off

from kcons.cli.progress import Bars
from kcons.comparison import ASE_UNITS, environment, fluid, layers, long_steps, long_steps_report, processor_of
from kcons.steppers import State
from kcons.thermostats import (
    Langevin,
    NoseHooverChain,
    TemperatureSplit,
    configurational_temperature,
    mean,
    thermal_velocities,
)

KELVIN = 300.0
#: Time steps in fs with the times in ps of each of their runs, and time between samples in fs.
STEPS, INTERVAL = {4.0: 4 * (600.0,), 2.0: 4 * (600.0,), 1.0: (80.0,), 0.5: (40.0,)}, 8.0
THERMOSTATS = ("Nose-Hoover", "Langevin")


def rotating(velocities: np.ndarray, masses: np.ndarray) -> tuple[float, float]:
    """m v^2 of the centres of mass of triatomic molecules, and of the motion about them."""
    v, m = velocities.reshape(-1, 3, 3), masses.reshape(-1, 3)
    centre = np.einsum("na,nak->nk", m, v) / m.sum(axis=1)[:, None]
    about = v - centre[:, None]
    return float((m.sum(axis=1) * (centre**2).sum(axis=1)).sum()), float((m[..., None] * about**2).sum())


def equipartition(kind: str, step: float, picoseconds: float, seed: int = 1) -> dict[str, Any]:
    """Temperatures over the one asked for, of translation and rotation, by velocities and by configurations."""
    chosen = fluid.water(27)
    forces, kt, dt = chosen.forces, units.kB * KELVIN, step * units.fs
    system, n, masses = chosen.system(), chosen.n_molecules, chosen.forces.masses
    x = forces.metropolis(chosen.positions, kt, 4000, 10, seed, chosen.shift, chosen.turn)[1]
    state = State(x, thermal_velocities(system, x, kt, seed, zero_momentum=True))
    stepper: Any = NoseHooverChain(kt, chosen.period, momentum="conserved")
    if kind == "Langevin":
        stepper = Langevin(kt, chosen.friction, seed + 1, substeps=1, conserve_momentum=True)
    freedom = np.array([3 * n - 3, 3 * n])  # total momentum is zero
    kinetic, halfway, configurations = [], [], []
    every, split = round(INTERVAL / step), TemperatureSplit(system)
    for sample in range(-round(2000 / INTERVAL), round(1000 * picoseconds / INTERVAL)):
        for _ in range(every):
            before, state = state, stepper.step(system, state, dt)
        if sample >= 0:
            kinetic.append(np.array(rotating(state.velocities, masses)) / freedom / kt)
            moved = (state.positions - before.positions) / dt
            halfway.append(np.array(rotating(moved, masses)) / freedom / kt)
            configurations.append(forces.split_sample(state.positions))
            if sample % 8 == 0:
                split.add(state.positions)
    found: dict[str, Any] = {"thermostat": kind, "step": step, "picoseconds": picoseconds}
    for name, series in (("at the positions", kinetic), ("in the middle", halfway)):
        found[name] = [list(mean(column)) for column in np.transpose(series)]
    # Both from the same frames: their difference is known far better than each of them.
    found["missing"] = [list(mean(column)) for column in np.transpose(np.array(halfway) - np.array(kinetic))]
    shift, bend, turn, twist = np.transpose(configurations)
    temperatures = [configurational_temperature(shift, bend), configurational_temperature(turn, twist)]
    found["configurations"] = [[t.value / kt, t.error / kt] for t in temperatures]
    told = split.result()
    found["frequencies"] = [told.shift_frequency * units.fs, told.turn_frequency * units.fs]
    found["with signs"] = [[t.value / kt, t.error / kt] for t in (told.shift, told.turn) if t is not None]
    return found


# -- bias against evaluations of the expensive forces -----------------------------------------------

#: Molecules, and how far they reach in the expensive and in the cheap forces, in angstrom.
WATERS, SLOW, FAST = 125, 8.0, 6.0
#: Steps in fs, and frictions a ps.
WATER_RUNS: dict[str, dict[float, tuple[float, ...]]] = {
    "langevin": {2.0: (5.0,), 4.0: (1.0, 5.0)},
    "langevin-respa": {8.0: (5.0,), 12.0: (5.0, 20.0), 16.0: (5.0, 20.0), 24.0: (20.0,)},
    "langevin-halfway": {8.0: (5.0,), 16.0: (5.0, 20.0), 24.0: (20.0,)},
    "spheres": {16.0: (5.0,), 24.0: (5.0, 20.0), 32.0: (5.0, 20.0), 48.0: (20.0,)},
    "hmc": {9.0: (1.0,)},
}


@cache
def water(sweeps: int) -> layers.Layers:
    """At 300 K, with cheap forces that are switched off over 4 to 6 angstrom."""
    chosen = replace(fluid.water(WATERS), thermal_energy=units.kB * KELVIN, interval=32 * units.fs)
    return layers.of_fluid(chosen, FAST, SLOW, sweeps=sweeps)


def stepped(method: str, step: float, friction: float, picoseconds: float, sweeps: int) -> dict[str, Any]:
    """One method at one step and friction."""
    made, chosen, rate = water(sweeps), long_steps.METHODS[method], friction * 1e-3 / units.fs
    found = long_steps.measure(made, chosen, step * units.fs, rate, length=picoseconds * 1000 * units.fs)
    assert made.reference is not None
    reference = [made.reference.value / made.molecules, made.reference.error / made.molecules]
    return {**found.to_dict(), "thermal_energy": made.thermal_energy, "reference": reference}


# -- all of it --------------------------------------------------------------------------------------


def timed(group: str, job: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What a run found, for this list of the result, with what it took."""
    begun = time.process_time()
    found = job()
    return {"group": group, "cpu_seconds": time.process_time() - begun, **found}


def jobs(full: bool) -> dict[str, Callable[[], dict[str, Any]]]:
    """What there is to run, by name."""
    found: dict[str, Callable[[], dict[str, Any]]] = {}
    for step in STEPS if full else (4.0,):
        run = partial(equipartition, "Nose-Hoover", step, 20.0 if full else 2.0)
        found[f"velocities, {step:g} fs"] = partial(timed, "velocities", run)
    for method, steps in WATER_RUNS.items() if full else ():
        for step, frictions in steps.items():
            for friction in frictions:
                run = partial(stepped, method, step, friction, 30.0, 8000)
                found[f"{method}, {step:g} fs, {friction:g}/ps"] = partial(timed, "rigid water", run)
    for step, lengths in STEPS.items() if full else ():
        for kind in THERMOSTATS if step >= 2 else THERMOSTATS[:1]:
            for seed, picoseconds in enumerate(lengths, 1):
                run = partial(equipartition, kind, step, picoseconds, seed)
                found[f"{kind}, {step:g} fs, run {seed}"] = partial(timed, "equipartition", run)
    return found


def measure(*, quick: bool, keep: Callable[[dict[str, Any]], None], earlier: dict[str, Any] | None) -> dict[str, Any]:
    """All runs but those that an earlier measurement has made, kept one by one."""
    result = {"machine": environment(), "full": not quick, "parts": {}, **(earlier or {})}

    def put(name: str, found: dict[str, Any]) -> None:
        result["parts"][name] = found
        keep(result)

    with Bars() as watcher:
        work_off("step lengths", jobs(not quick), put, result["parts"], watcher)
    return result


def of_group(result: dict[str, Any], group: str) -> list[dict[str, Any]]:
    return [part for part in result["parts"].values() if part["group"] == group]


def over_runs(pairs: list[list[float]]) -> list[float]:
    """Value and standard error of runs of one length together."""
    values, errors = np.transpose(pairs)
    return [float(values.mean()), float(np.sqrt((errors**2).sum()) / len(errors))]


def percent(found: list[float], less: float = 1.0) -> str:
    return f"{100 * (found[0] - less):+.2f} ± {100 * found[1]:.2f}"


def show_equipartition(runs: list[dict[str, Any]], console: Console) -> None:
    title = f"27 rigid TIP3P waters at {KELVIN:g} K: temperatures off the one asked for, in percent"
    table = Table(box=None, title=title)
    for heading in ("thermostat", "step/fs", "", "at the positions", "in the middle", "configurations"):
        table.add_column(heading, justify="left" if heading in ("thermostat", "") else "right")
    places = ("at the positions", "in the middle", "configurations")
    kinds: dict[tuple[str, float], list[dict[str, Any]]] = {}
    for run in sorted(runs, key=lambda r: (THERMOSTATS.index(r["thermostat"]), -r["step"])):
        kinds.setdefault((run["thermostat"], run["step"]), []).append(run)
    for same in kinds.values():
        run = same[0]
        for k, kind in enumerate(("moving", "turning")):
            cells = [percent(over_runs([run[place][k] for run in same])) for place in places]
            table.add_row("" if k else run["thermostat"], "" if k else f"{run['step']:g}", kind, *cells)
    console.print(table)


def show_velocities(runs: list[dict[str, Any]], console: Console) -> None:
    title = "\nWhat velocities at the positions miss of those in the middle of the step, in percent of kT (Nose-Hoover)"
    table = Table(box=None, title=title)
    for heading in ("step/fs", "", "missing", "(frequency dt/2)^2"):
        table.add_column(heading, justify="left" if heading == "" else "right")
    for run in sorted(runs, key=lambda r: -r["step"]):
        for k, kind in enumerate(("moving", "turning")):
            expected = (0.5 * run["frequencies"][k] * run["step"]) ** 2
            missing = f"{100 * run['missing'][k][0]:.3f} ± {100 * run['missing'][k][1]:.3f}"
            table.add_row("" if k else f"{run['step']:g}", kind, missing, f"{100 * expected:.3f}")
    console.print(table)


def found_runs(parts: list[dict[str, Any]]) -> list[long_steps.Stepped]:
    """Runs of the comparison as they were measured."""
    names = long_steps.Stepped.__dataclass_fields__
    return [long_steps.Stepped(**{name: part[name] for name in names if name in part}) for part in parts]


def show_steps(parts: list[dict[str, Any]], console: Console) -> None:
    kt, (energy, error) = parts[0]["thermal_energy"], parts[0]["reference"]
    runs = sorted(found_runs(parts), key=lambda run: (list(long_steps.METHODS).index(run.method), run.step))
    title = (
        f"{WATERS} rigid TIP3P waters at {KELVIN:g} K, switched off at {SLOW:g} Å, and in cheap forces at {FAST:g} Å"
    )
    console.print(f"\n{title}", highlight=False)
    made = long_steps_report.table(runs, ASE_UNITS)
    table = Table(box=None)
    for k, heading in enumerate(made.headings):
        table.add_column(heading, justify="left" if k == 0 else "right")
    for row in made.rows:
        table.add_row(*map(str, row))
    console.print(table)
    console.print(long_steps_report.explanation(runs))
    console.print(f"kT is {kt:.4f} eV; Metropolis: <U> = {energy:.4f} ± {error:.4f} eV a molecule")


def draw(result: dict[str, Any], path: str) -> None:
    """The curves of the page."""
    runs = found_runs(of_group(result, "rigid water"))
    long_steps_report.figure(runs, ASE_UNITS, f"{WATERS} rigid waters: bias against calls").savefig(path, dpi=150)


def show(result: dict[str, Any], console: Console) -> None:
    if of_group(result, "equipartition"):
        show_equipartition(of_group(result, "equipartition"), console)
    show_velocities(of_group(result, "velocities"), console)
    if of_group(result, "rigid water"):
        show_steps(of_group(result, "rigid water"), console)
    taken = sum(part["cpu_seconds"] for part in result["parts"].values())
    machine = result["machine"]
    console.print(
        f"\n{taken / 60:.0f} min of {processor_of(machine)}; commit {machine['commit'][:10]}, {machine['date']}"
    )


if __name__ == "__main__":
    scripts.script_of_parts(__doc__, measure, show, draw, width=120)
