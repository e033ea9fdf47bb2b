"""Which temperature does a thermostat sample? Small fluids, measured by their configurations alone.

    python thermostats.py                  short runs, half a minute: large errors
    python thermostats.py --full --out F   twenty minutes on one core; F receives JSON, run by run; a
                                                       run that is interrupted is continued
    python thermostats.py --show F         the tables of an earlier result

The isokinetic thermostat with 2K = (g - 1) kT and, for comparison, 2K = g kT, and Langevin; the energy also by plain
Metropolis sampling, which knows no forces. Reduced units. Then Langevin and Nose-Hoover on rigid water and on chains,
in ASE, judged by the package physical_validation (full runs only, and if it is installed); not isokinetic runs, whose
kinetic energy has no distribution.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import study_scripts as scripts
from ase import Atoms, units
from rich.console import Console
from rich.table import Table
from study_scripts import work_off

from kcons import ConstraintSet
from kcons.ase import ConstrainedLangevin, ConstrainedNoseHoover, constrain, draw_velocities
from kcons.cli.progress import Bars
from kcons.comparison import LennardJones, Potential, PotentialCalculator, environment, fluid, json_files, processor_of
from kcons.constraints import Distance
from kcons.motion import Motion
from kcons.steppers import State, Stepper, System, run
from kcons.thermostats import Isokinetic, Langevin, configurational_temperature, mean, thermal_velocities

#: Small, so that one degree of freedom counts.
FLUIDS = (fluid.atoms(16), fluid.dumbbells(8), fluid.triatomics(8))
NAMES = ("Lennard-Jones, 16 atoms", "8 dumbbells", "8 rigid triatomics")
#: Errors that come from the step are a tenth of a percent then.
STEP = 0.003
#: Steps of full isokinetic runs: standard errors of the temperature are 0.2 %.
STEPS = (2_500_000, 3_500_000, 6_000_000)


def sampled(which: int, thermostat: str, steps: int) -> dict[str, Any]:
    """One run: temperature of the configurations and mean energy."""
    chosen = FLUIDS[which]
    held, kt, forces = chosen.system(), chosen.thermal_energy, chosen.forces
    state = State(chosen.positions, thermal_velocities(held, chosen.positions, kt, 1, zero_momentum=True))
    stepper: Stepper
    start = Isokinetic(kt).start(held, state)
    assert start.thermostat is not None
    g = int(start.thermostat[3])
    if thermostat == "Langevin":
        stepper = Langevin(kt, 1.0, seed=2, substeps=1)
    elif thermostat == "g - 1":
        stepper = Isokinetic(kt)
    else:
        stepper = Isokinetic(kinetic_energy=0.5 * g * kt)
    state = run(held, state, STEP, steps // 20, stepper=stepper)
    samples: list[tuple[float, float, float]] = []
    run(
        held,
        state,
        STEP,
        steps,
        stepper=stepper,
        observers=[lambda s: samples.append((*forces.rigid_sample(s.positions), forces.potential(s.positions)))],
        every=8,
    )
    squares, curvatures, energies = np.transpose(samples)
    return {
        "fluid": NAMES[which],
        "thermostat": thermostat,
        "g": g,
        "thermal_energy": kt,
        "steps": steps,
        "temperature": list(configurational_temperature(squares, curvatures)),
        "energy": list(mean(energies)),
    }


def metropolis(which: int, sweeps: int) -> dict[str, Any]:
    """The energy by moves of whole molecules."""
    chosen, every = FLUIDS[which], 10
    forces, kt, shift, turn = chosen.forces, chosen.thermal_energy, chosen.shift, chosen.turn
    _, x, _ = forces.metropolis(chosen.positions, kt, sweeps // 20, every, 3, shift, turn)
    energies, _, accepted = forces.metropolis(x, kt, sweeps, every, 4, shift, turn)
    return {"fluid": NAMES[which], "sweeps": sweeps, "accepted": accepted, "energy": list(mean(energies))}


def trap(convention: str, steps: int) -> dict[str, Any]:
    """Two atoms in the trap x^4/4, coupled: kT = 4<U>/6 without any estimator, as U is homogeneous."""
    x = np.array([[0.3, -0.2, 0.5], [-0.4, 0.6, 0.1]])

    def force(x: np.ndarray, t: float) -> np.ndarray:
        d = x[0] - x[1]
        push = 0.5 * (d @ d) * d
        return -(x**3) - np.array([push, -push])

    def potential(x: np.ndarray, t: float) -> float:
        d = x[0] - x[1]
        return float((x**4).sum() / 4 + (d @ d) ** 2 / 8)

    held = System(Motion(ConstraintSet([], x, [1.0, 1.0]), x), force, potential=potential)
    kt = 1.0
    stepper = Isokinetic(kt) if convention == "g - 1" else Isokinetic(kinetic_energy=0.5 * 6 * kt)
    state = run(held, State(x, thermal_velocities(held, x, kt, 1)), 0.02, 1000, stepper=stepper)
    energies: list[float] = []
    run(held, state, 0.02, steps, stepper=stepper, observers=[lambda s: energies.append(potential(s.positions, 0))])
    found = mean(4 * np.array(energies) / 6)
    return {"thermostat": convention, "g": 6, "thermal_energy": kt, "steps": steps, "temperature": list(found)}


# -- rigid water and chains, judged by physical_validation ------------------------------------------

KB = units.kB


def water() -> tuple[Atoms, int, int]:
    """27 TIP3P molecules at 0.9 g/cm3, smooth cutoff at half the box; 3 atoms a molecule, 3 rows."""
    chosen = fluid.water(27, seed=5)
    atoms = Atoms(chosen.symbols, positions=chosen.positions, masses=chosen.forces.masses)
    return _ready(atoms, chosen.forces, 3), 3, 3


def chains() -> tuple[Atoms, int, int]:
    """Six freely jointed chains of six argon-like beads; 5 rows each."""
    n, box = 6, 13.0
    rng = np.random.default_rng(6)
    x = []
    for k in range(n):
        bend = np.cumsum(np.c_[np.full(6, 1.3), 0.75 * (-1.0) ** np.arange(6), 0.1 * rng.normal(size=6)], axis=0)
        x.append(bend + np.array([0, (k % 3) * box / 3, (k // 3) * box / 2]))
    atoms = Atoms("C" * 6 * n, positions=np.concatenate(x))
    forces = LennardJones(np.repeat(range(n), 6), box, masses=atoms.get_masses(), epsilon=0.006, sigma=3.6)
    return _ready(atoms, forces, 6), 6, 5


def _ready(atoms: Atoms, forces: LennardJones, size: int) -> Atoms:
    atoms.calc = PotentialCalculator(Potential(forces.evaluate, "Lennard-Jones"))
    first = np.arange(0, len(atoms), size)
    along = [np.c_[first + k, first + k + 1] for k in range(size - 1)]
    constrain(atoms, Distance(fluid.triangles(len(first)) if size == 3 else np.concatenate(along)))
    return atoms


MOLECULES = {"rigid water": water, "chains": chains}
TEMPERATURES = {"rigid water": (400.0, 425.0), "chains": (300.0, 370.0)}


def dynamics(kind: str, atoms: Atoms, step: float, temperature: float) -> Any:
    if kind == "Langevin":
        return ConstrainedLangevin(atoms, step, temperature, 5e-3 / units.fs, rng=9, substeps=1)
    return ConstrainedNoseHoover(atoms, step, temperature, 50 * units.fs, momentum="conserved")


def thermal_run(name: str, kind: str, temperature: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Kinetic and potential energies in eV, every 100 fs."""
    atoms, _, _ = MOLECULES[name]()
    draw_velocities(atoms, temperature, 8, zero_momentum=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        moving = dynamics(kind, atoms, 2 * units.fs, temperature)
    moving.run(10_000)
    series = []
    moving.attach(lambda: series.append((atoms.get_kinetic_energy(), atoms.get_potential_energy())), interval=50)
    moving.run(steps)
    kinetic, potential = np.transpose(series)
    return kinetic, potential


#: Steps in fs, starts, and length in fs of the flights by which the order is measured.
CONVERGENCE, STARTS, FLIGHT = (4.0, 2.0, 1.0), 40, 480


def without_noise(kind: str, atoms: Atoms, step: float, temperature: float) -> Any:
    """Langevin without friction: its noise has no order."""
    if kind == "Langevin":
        return ConstrainedLangevin(atoms, step * units.fs, temperature, 0.0, rng=1)
    return dynamics(kind, atoms, step * units.fs, temperature)


def conserved(kind: str, atoms: Atoms, step: float, temperature: float, length: float) -> np.ndarray:
    """The conserved energy in eV every 8 fs."""
    moving = without_noise(kind, atoms, step, temperature)
    values: list[float] = []
    moving.attach(lambda: values.append(moving.get_conserved_energy()), interval=round(8 / step))
    moving.run(round(length / step))
    return np.array(values)


def warmed(name: str) -> tuple[Atoms, Any]:
    atoms, _, _ = MOLECULES[name]()
    temperature = TEMPERATURES[name][0]
    draw_velocities(atoms, temperature, 8)
    warm = ConstrainedLangevin(atoms, 1 * units.fs, temperature, 0.02 / units.fs, rng=1)
    warm.run(2000)
    return atoms, warm


def flights(name: str, kind: str) -> list[np.ndarray]:
    """Deviations of the conserved energy from its mean over short flights, for each time step from the same starts.

    Long runs are chaotic: with each step they meet other collisions, and a few of these decide the deviation.
    """
    atoms, warm = warmed(name)
    found: list[list[np.ndarray]] = [[] for _ in CONVERGENCE]
    for k in range(STARTS):
        warm.run(250)
        for step, series in zip(CONVERGENCE, found, strict=True):
            flying = atoms.copy()
            flying.calc = atoms.calc
            draw_velocities(flying, TEMPERATURES[name][0], k, zero_momentum=True)
            values = conserved(kind, flying, step, TEMPERATURES[name][0], FLIGHT)
            series.append(values - values.mean())
    return [np.concatenate(series) for series in found]


def slope(name: str, kind: str, step: float) -> float:
    """Drift of the conserved energy over 16 ps, in eV/ps."""
    atoms, _ = warmed(name)
    draw_velocities(atoms, TEMPERATURES[name][0], 8, zero_momentum=True)
    values = conserved(kind, atoms, step, TEMPERATURES[name][0], 16_000)
    return float(np.polyfit(np.arange(len(values)) * 8e-3, values, 1)[0])


def ase_units() -> Any:
    import physical_validation as pv

    return pv.data.UnitData(
        kb=KB,
        energy_str="eV",
        energy_conversion=96.48533,
        length_str="A",
        length_conversion=0.1,
        volume_str="A^3",
        volume_conversion=1e-3,
        temperature_str="K",
        temperature_conversion=1,
        pressure_str="eV/A^3",
        pressure_conversion=1.602177e6,
        time_str="fs",
        time_conversion=1e-3,
    )


def judged(name: str, kind: str, steps: int) -> dict[str, Any]:
    """p of the kinetic energy, standard errors of the ensembles at two temperatures, and convergence."""
    import physical_validation as pv

    atoms, size, rows = MOLECULES[name]()
    n = len(atoms) // size
    unit = ase_units()
    momentum = 0 if kind == "Langevin" else 3
    system = pv.data.SystemData(
        natoms=len(atoms),
        nconstraints=rows * n,
        ndof_reduction_tra=momentum,
        ndof_reduction_rot=0,
        mass=atoms.get_masses(),
        molecule_idx=size * np.arange(n),
        nconstraints_per_molecule=np.full(n, rows),
    )

    def data(temperature: float) -> Any:
        kinetic, potential = thermal_run(name, kind, temperature, steps)
        ensemble = pv.data.EnsembleData("NVT", natoms=len(atoms), volume=1000.0, temperature=temperature)
        seen = pv.data.ObservableData(kinetic_energy=kinetic, potential_energy=potential)
        return pv.data.SimulationData(units=unit, system=system, ensemble=ensemble, observables=seen)

    cold, warm = (data(temperature) for temperature in TEMPERATURES[name])
    results: dict[str, Any] = {"system": name, "thermostat": kind, "temperatures": TEMPERATURES[name]}
    results["suggested_interval"] = float(pv.ensemble.estimate_interval(cold, verbosity=0)["dT"])
    results["samples"] = len(cold.observables.kinetic_energy)
    results["kinetic_p"] = [float(pv.kinetic_energy.distribution(d, strict=True, verbosity=0)) for d in (cold, warm)]
    results["ensemble_sigma"] = [float(s) for s in pv.ensemble.check(cold, warm, verbosity=0)]
    results["slope_eV_per_ps"] = [slope(name, kind, step) for step in CONVERGENCE]
    return {**results, **order(name, kind, unit)}


def order(name: str, kind: str, unit: Any) -> dict[str, Any]:
    """How far from quadratic in the time step the deviation of the conserved energy is."""
    import physical_validation as pv

    fine = [
        pv.data.SimulationData(units=unit, dt=step, observables=pv.data.ObservableData(constant_of_motion=values))
        for step, values in zip(CONVERGENCE, flights(name, kind), strict=True)
    ]
    spread = [float(np.std(f.observables.constant_of_motion)) for f in fine]
    return {"convergence": float(pv.integrator.convergence(fine, verbose=False)), "spread_eV": spread}


# -- all of it --------------------------------------------------------------------------------------


def timed(group: str, job: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What a run found, for this list of the result, with what it took."""
    begun = time.process_time()
    found = job()
    return {"group": group, "cpu_seconds": time.process_time() - begun, **found}


def jobs(full: bool) -> dict[str, Callable[[], dict[str, Any]]]:
    """What there is to run, by name."""
    found: dict[str, Callable[[], dict[str, Any]]] = {}
    for which in range(len(FLUIDS)) if full else (1,):
        name, steps = NAMES[which], STEPS[which] if full else 1000
        moves = partial(metropolis, which, 600_000 if full else 3_000)
        found[f"Metropolis, {name}"] = partial(timed, "metropolis", moves)
        for thermostat in ("g - 1", "g", "Langevin"):
            taken = steps // 3 if thermostat == "Langevin" else steps
            found[f"{thermostat}, {name}"] = partial(timed, "runs", partial(sampled, which, thermostat, taken))
    for convention in ("g - 1", "g"):
        found[f"{convention}, trap"] = partial(timed, "trap", partial(trap, convention, 800_000 if full else 1500))
    if full:
        for name in MOLECULES:
            for kind in ("Nose-Hoover", "Langevin"):
                judgement = partial(judged, name, kind, 100_000)
                found[f"{kind}, {name}"] = partial(timed, "physical_validation", judgement)
    return found


def measure(*, quick: bool, keep: Callable[[dict[str, Any]], None], earlier: dict[str, Any] | None) -> dict[str, Any]:
    """All runs but those that an earlier measurement has made, kept one by one."""
    result = {"machine": environment(), "full": not quick, "parts": {}, **(earlier or {})}

    def put(name: str, found: dict[str, Any]) -> None:
        result["parts"][name] = found
        keep(result)

    with Bars() as watcher:
        work_off("thermostats", jobs(not quick), put, result["parts"], watcher)
    return result


def of_group(result: dict[str, Any], group: str) -> list[dict[str, Any]]:
    return [part for part in result["parts"].values() if part["group"] == group]


def show(result: dict[str, Any], console: Console) -> None:
    table = Table(box=None, title="kT of the configurations over the kT asked for, and mean potential energy")
    for heading in ("system", "thermostat", "g", "kT found/asked", "off by", "<U>", "from Metropolis"):
        table.add_column(heading, justify="left" if heading in ("system", "thermostat") else "right")
    plain = {m["fluid"]: m["energy"] for m in of_group(result, "metropolis")}
    rows = [{**t, "fluid": "two atoms in a trap", "energy": None} for t in of_group(result, "trap")]
    rows += of_group(result, "runs")
    for r in rows:
        kt, (found, error) = r["thermal_energy"], r["temperature"]
        name = r["thermostat"] if r["thermostat"] == "Langevin" else f"2K = ({r['thermostat']}) kT"
        energy, distance = "", ""
        if r["energy"] is not None:
            other = plain[r["fluid"]]
            energy = f"{r['energy'][0]:.3f} ± {r['energy'][1]:.3f}"
            distance = f"{(r['energy'][0] - other[0]) / math.hypot(r['energy'][1], other[1]):+.1f} s.e."
        ratio = f"{found / kt:.4f} ± {error / kt:.4f}"
        table.add_row(r["fluid"], name, str(r["g"]), ratio, f"{(found - kt) / error:+.1f} s.e.", energy, distance)
    console.print(table)
    for m in of_group(result, "metropolis"):
        console.print(f"Metropolis, {m['fluid']}: <U> = {m['energy'][0]:.3f} ± {m['energy'][1]:.3f}")
    if of_group(result, "physical_validation"):
        table = Table(box=None, title="\nphysical_validation: rigid TIP3P water (27) and chains (6 of 6 beads) in ASE")
        for heading in ("system", "thermostat", "samples", "temperatures/K", "p(K)", "ensemble", "convergence"):
            table.add_column(heading, justify="left" if heading in ("system", "thermostat") else "right")
        for r in of_group(result, "physical_validation"):
            p = ", ".join(f"{p:.2f}" for p in r["kinetic_p"])
            sigma = ", ".join(f"{s:.2f} s.e." for s in r["ensemble_sigma"])
            temperatures = ", ".join(f"{t:.0f}" for t in r["temperatures"])
            table.add_row(
                r["system"], r["thermostat"], str(r["samples"]), temperatures, p, sigma, f"{r['convergence']:.3f}"
            )
        console.print(table)
    taken = sum(part["cpu_seconds"] for part in result["parts"].values())
    machine = result["machine"]
    console.print(
        f"\n{taken / 60:.0f} min of {processor_of(machine)}; commit {machine['commit'][:10]}, {machine['date']}"
    )


def main() -> None:
    parser = scripts.options(__doc__, full="long runs, and physical_validation")
    options, console = parser.parse_args(), Console(width=120)
    if options.show:
        show(json_files.read(options.show), console)
        return
    show(scripts.continued(options.out, measure, quick=not options.full), console)


if __name__ == "__main__":
    main()
