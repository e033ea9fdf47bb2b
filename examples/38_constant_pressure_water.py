"""Rigid TIP3P water at constant pressure, by OpenMM as a force engine, beside OpenMM's own barostat.

python examples/38_constant_pressure_water.py                 a short run
python examples/38_constant_pressure_water.py --full          those of docs/constant_pressure.md: half an hour
python examples/38_constant_pressure_water.py --full NAME...  some of them
python examples/38_constant_pressure_water.py --show FILE     the tables of the page from a file of results

Fluids of other molecules, a crystal and a slab: examples/34_constant_pressure.py.
"""

from __future__ import annotations

import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from ase import units

from kcons import ConstraintSet
from kcons.comparison import environment, json_files
from kcons.constraints import Distance
from kcons.motion import Motion
from kcons.steppers import run
from kcons.thermostats import (
    CellRescaling,
    CellSystem,
    ConstantPressure,
    Isokinetic,
    Langevin,
    MonteCarloBarostat,
    autocorrelation_time,
    thermal_velocities,
)

RESULTS = Path(__file__).parents[1] / "docs" / "results" / "constant_pressure.json"

# -- rigid water ----------------------------------------------------------------------------------------------------

WATERS, TEMPERATURE, BAR = 64, 300.0, units.bar


def mean_and_error(values: Any) -> tuple[float, float]:
    values = np.asarray(values)
    if len(values) < 32:  # of short runs no error is known
        return float(values.mean()), float("nan")
    return float(values.mean()), float(values.std() * np.sqrt(autocorrelation_time(values) / len(values)))


def compressed(volumes: Any) -> tuple[float, float]:
    """<dV^2>/<V>, and its error from that of the squares."""
    volumes = np.asarray(volumes)
    squares = (volumes - volumes.mean()) ** 2
    mean, error = mean_and_error(squares)
    return mean / float(volumes.mean()), error / float(volumes.mean())


def water_system(waters: int = WATERS, cutoff: float = 0.55) -> Any:
    """TIP3P with a reaction field in OpenMM; positions on a lattice, and the side of the box."""
    import openmm

    edge = round(waters ** (1 / 3))
    side = 3.13 * edge
    system, force, rng, x = openmm.System(), openmm.NonbondedForce(), np.random.default_rng(1), []
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(cutoff)
    force.setUseDispersionCorrection(False)
    half = np.radians(104.52 / 2)
    shape = 0.9572 * np.array([[0, 0, 0], [np.cos(half), np.sin(half), 0], [np.cos(half), -np.sin(half), 0]])
    for place in np.ndindex(edge, edge, edge):
        first = system.getNumParticles()
        for mass, charge, sigma, depth in (
            (15.9994, -0.834, 0.315061, 0.1521 * 4.184),
            *[(1.008, 0.417, 1.0, 0.0)] * 2,
        ):
            system.addParticle(mass)
            force.addParticle(charge, sigma, depth)
        for a, b in ((0, 1), (0, 2), (1, 2)):
            system.addConstraint(first + a, first + b, 0.1 * float(np.linalg.norm(shape[a] - shape[b])))
            force.addException(first + a, first + b, 0.0, 1.0, 0.0)
        x.extend(shape @ np.linalg.qr(rng.standard_normal((3, 3)))[0] + 3.13 * np.array(place))
    system.addForce(force)
    system.setDefaultPeriodicBoxVectors(*(0.1 * side * np.eye(3)))
    return system, np.array(x), side


def minimised(system: Any, x: np.ndarray) -> np.ndarray:
    """Positions on their constraints without overlaps."""
    import openmm

    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(0.1 * x)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
    return 10 * np.array(context.getState(positions=True).getPositions(asNumpy=True)._value)


class Engine:
    """OpenMM as a force engine: energy, forces, and the stress of a change of volume by differences."""

    def __init__(self, system: Any) -> None:
        import openmm

        platform = openmm.Platform.getPlatformByName("CPU")
        self.context = openmm.Context(
            system, openmm.VerletIntegrator(0.001), platform, {"Threads": "1", "DeterministicForces": "true"}
        )
        self._known: tuple[bytes, Any] = (b"", None)
        self.calls = 0

    def _found(self, x, h):
        key = x.tobytes() + h.tobytes()
        if key != self._known[0]:
            self.calls += 1
            self.context.setPeriodicBoxVectors(*(0.1 * h))
            self.context.setPositions(0.1 * np.asarray(x))
            state = self.context.getState(energy=True, forces=True)
            energy = state.getPotentialEnergy()._value * units.kJ / units.mol
            forces = state.getForces(asNumpy=True)._value * (0.1 * units.kJ / units.mol)
            self._known = key, (energy, forces)
        return self._known[1]

    def force(self, x, t, h):
        return self._found(x, h)[1]

    def potential(self, x, t, h):
        return self._found(x, h)[0]

    def stress(self, x, t, h):
        e = 1e-4
        up, down = (self._found(s * x, s * h)[0] for s in (1 + e, 1 - e))
        return (up - down) / (6 * e * np.linalg.det(h)) * np.eye(3)


def run_water(
    barostat: str, thermostat: str, steps: int, every: int = 25, seed: int = 1, skip: int = 200
) -> dict[str, Any]:
    """Densities in g/cm3, one in 25 steps of 2 fs, the first `skip` of them left out."""
    system, x, side = water_system()
    masses = np.array([system.getParticleMass(k)._value for k in range(system.getNumParticles())])
    density = masses.sum() / units.mol * 1e24
    thermal = units.kB * TEMPERATURE
    volumes = []
    if barostat == "OpenMM":
        import openmm

        force = openmm.MonteCarloBarostat(1.0, TEMPERATURE, every)
        force.setRandomNumberSeed(seed)
        system.addForce(force)
        integrator = openmm.LangevinMiddleIntegrator(TEMPERATURE, 1.0, 0.002)
        integrator.setRandomNumberSeed(seed)
        platform = openmm.Platform.getPlatformByName("CPU")
        context = openmm.Context(system, integrator, platform, {"Threads": "1"})
        context.setPositions(0.1 * x)
        openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
        context.setVelocitiesToTemperature(TEMPERATURE, seed)
        for _ in range(steps // 25):
            integrator.step(25)
            volumes.append(1e3 * context.getState().getPeriodicBoxVolume()._value)
        acceptance = None
    else:
        x = minimised(system, x)
        rows = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
        for k in reversed(range(len(rows))):
            system.removeConstraint(k)
        held = ConstraintSet(
            Distance([r[:2] for r in rows], [10 * r[2]._value for r in rows]), x, masses, cell=np.full(3, side)
        )
        engine = Engine(system)
        ours = CellSystem(Motion(held, x), engine.force, engine.potential, engine.stress)
        steppers = {
            "Langevin": partial(Langevin, thermal, 0.001 / units.fs, seed),
            "isokinetic": partial(Isokinetic, thermal, momentum="conserved"),
        }
        presses = {
            "Monte Carlo": partial(MonteCarloBarostat, 1.0 * BAR),
            "rescaling": partial(CellRescaling, 1.0 * BAR, 300 * units.fs, 5e-5 / BAR),
        }
        press = presses[barostat](every=every, seed=seed, cutoff=5.5)
        v = thermal_velocities(ours, x, thermal, seed, zero_momentum=True)
        stepper = ConstantPressure(steppers[thermostat](), press)
        note = lambda state: volumes.append(float(np.linalg.det(state.cell)))  # noqa: E731
        state = stepper.start(ours, ours.initial_state(x, v, project=True))
        state = run(ours, state, 2 * units.fs, steps, stepper=stepper, observers=[note], every=25)
        acceptance = float(press.acceptance(state)[0])
    volumes = np.array(volumes[skip:])
    kappa, error = compressed(volumes)
    return {
        "barostat": barostat,
        "thermostat": thermostat,
        "molecules": WATERS,
        "every": every,
        "picoseconds": steps * 0.002,
        "acceptance": acceptance,
        "density": mean_and_error(density / volumes),
        "compressibility": [kappa / thermal * BAR, error / thermal * BAR],
        "correlation_ps": autocorrelation_time(volumes) * 0.05 if len(volumes) >= 32 else None,
    }


# -- what a barostat costs --------------------------------------------------------------------------------------


def cost(molecules: int, turns: int) -> dict[str, Any]:
    """Processor time of a step with a Monte Carlo barostat over that of one without, at the default frequency."""
    box, x, side = water_system(molecules, 0.55 if molecules == WATERS else 0.9)
    x = minimised(box, x)
    rows = [box.getConstraintParameters(k) for k in range(box.getNumConstraints())]
    for k in reversed(range(len(rows))):
        box.removeConstraint(k)
    masses = np.array([box.getParticleMass(k)._value for k in range(box.getNumParticles())])
    row = Distance([r[:2] for r in rows], [10 * r[2]._value for r in rows])
    held = ConstraintSet(row, x, masses, cell=np.full(3, side))
    engine = Engine(box)
    system = CellSystem(Motion(held, x), engine.force, engine.potential, engine.stress)
    thermal, dt = units.kB * TEMPERATURE, 2 * units.fs
    alone = Langevin(thermal, 0.001 / units.fs, 1)
    both = ConstantPressure(alone, MonteCarloBarostat(BAR))
    state = system.initial_state(x, thermal_velocities(system, x, thermal, 1), project=True)
    every = both.barostat.every
    state = run(system, state, dt, 350, stepper=both)  # trials are then made in the midst of a turn
    ratios, ends = [], {}
    for _ in range(turns):
        spent = {alone: 0.0, both: 0.0}
        for k in range(6):
            for stepper in (alone, both) if k % 2 else (both, alone):
                system.set_cell(state.cell, state.positions)
                begun = time.process_time()
                ends[stepper] = run(system, state, dt, every, stepper=stepper, check_every=0)
                spent[stepper] += time.process_time() - begun
            state = ends[both]
        ratios.append(spent[both] / spent[alone])
    low, middle, high = np.quantile(ratios, [0.25, 0.5, 0.75])
    # Of a median of normal values: 1.25 standard errors, and 1.35 standard deviations from quarter to quarter.
    error = 1.25 / 1.35 * (high - low) / np.sqrt(turns)
    told = {"barostat": "Monte Carlo", "every": every, "molecules": molecules, "turns": turns}
    return told | {"ratio": float(middle), "error": float(error)}


RUNS: dict[str, Any] = {
    "water, OpenMM": partial(run_water, "OpenMM", "Langevin", 600_000, 10, seed=3),
    "water, Monte Carlo": partial(run_water, "Monte Carlo", "Langevin", 500_000, 10, seed=3),
    "water, OpenMM, again": partial(run_water, "OpenMM", "Langevin", 600_000, 10, seed=5),
    "water, Monte Carlo, again": partial(run_water, "Monte Carlo", "Langevin", 500_000, 10, seed=5),
    "water, rescaling": partial(run_water, "rescaling", "Langevin", 200_000),
    "water, isokinetic": partial(run_water, "Monte Carlo", "isokinetic", 100_000),
    "water, Monte Carlo, every 100": partial(run_water, "Monte Carlo", "Langevin", 150_000, 100, seed=7),
    **{f"cost, Monte Carlo, {n}": partial(cost, n, turns) for n, turns in ((WATERS, 60), (216, 20))},
}


def told(pair: Any, digits: int, scale: float = 1.0) -> str:
    return f"{scale * pair[0]:.{digits}f} ± {scale * pair[1]:.{digits}f}"


def weighted(pairs: list[Any]) -> tuple[float, float]:
    """One mean of several with errors."""
    value, error = np.array(pairs).T
    w = error**-2
    return float((w * value).sum() / w.sum()), float(w.sum() ** -0.5)


def show(path: str) -> None:
    """Tables for the page."""
    runs = json_files.read(path)["runs"]
    print("| 64 TIP3P waters | thermostat | ns | density, g/cm³ | κ, 10⁻⁵/bar |\n| --- | --- | --- | --- | --- |")
    water = [one for name, one in runs.items() if name.startswith("water")]
    for b in ("OpenMM", "Monte Carlo", "rescaling"):
        for t in ("Langevin", "isokinetic"):
            same = [one for one in water if (one["barostat"], one["thermostat"]) == (b, t)]
            if same:
                time_ = sum(one["picoseconds"] for one in same) / 1000
                density, kappa = (weighted([one[key] for one in same]) for key in ("density", "compressibility"))
                name = "OpenMM's own" if b == "OpenMM" else b
                print(f"| {name} | {t} | {time_:.1f} | {told(density, 4)} | {told(kappa, 2, 1e5)} |")
    seldom = runs["water, Monte Carlo, every 100"]
    often = [one["correlation_ps"] for one in water if one["barostat"] == "Monte Carlo" and one["every"] == 10]
    one, other = np.mean(often), seldom["correlation_ps"]
    print(f"\nVolumes are independent after {one:.1f} ps with a trial in 10 steps, {other:.1f} ps with one in 100.")
    print("\n| barostat | molecules | a step costs more by |\n| --- | --- | --- |")
    for name, one in runs.items():
        if name.startswith("cost, Monte Carlo"):
            cost = f"{100 * (one['ratio'] - 1):.1f} ± {100 * one['error']:.1f} %"
            print(f"| {one['barostat']} | {one['molecules']} TIP3P waters, OpenMM | {cost} |")


def main(arguments: list[str]) -> None:
    """A short run, or full ones."""
    if arguments[:1] == ["--show"]:
        show(arguments[1])
        return
    if "--full" in arguments:
        names = [name for name in arguments if name in RUNS] or list(RUNS)
        found = {}
        for name in names:
            found[name] = RUNS[name]()
            print(name, found[name], flush=True)
        if len(names) == len(RUNS):
            result = json_files.read(RESULTS)
            json_files.write(RESULTS, {**result, "environment": environment(), "runs": {**result["runs"], **found}})
        return
    one = run_water("Monte Carlo", "Langevin", 1000, skip=10)
    print(f"64 TIP3P waters after 2 ps: {one['density'][0]:.2f} g/cm3, {one['acceptance']:.0%} of trials accepted")


if __name__ == "__main__":
    main(sys.argv[1:])
