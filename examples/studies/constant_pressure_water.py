"""Rigid TIP3P water at constant pressure, by OpenMM as a force engine, beside OpenMM's own barostat.

python examples/studies/constant_pressure_water.py                 a short run
python examples/studies/constant_pressure_water.py --full          those of docs/constant_pressure.md: hours
python examples/studies/constant_pressure_water.py --full NAME...  some of them
python examples/studies/constant_pressure_water.py --show FILE     the tables of the page from a file of results

Fluids of other molecules, a crystal and a slab: examples/studies/constant_pressure.py.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import study_scripts as scripts
from ase import units

from kcons import ConstraintSet
from kcons.comparison import volumes
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

RESULTS = Path(__file__).parents[2] / "docs" / "results" / "constant_pressure.json"

# -- rigid water ----------------------------------------------------------------------------------------------------

WATERS, TEMPERATURE, BAR = 64, 300.0, units.bar


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


def held_water(box: Any, x: np.ndarray, side: float) -> tuple[CellSystem, np.ndarray]:
    """Constraints of the core instead of those of OpenMM, which gives the forces; positions that fulfil them."""
    x = minimised(box, x)
    rows = [box.getConstraintParameters(k) for k in range(box.getNumConstraints())]
    for k in reversed(range(len(rows))):
        box.removeConstraint(k)
    masses = np.array([box.getParticleMass(k)._value for k in range(box.getNumParticles())])
    row = Distance([r[:2] for r in rows], [10 * r[2]._value for r in rows])
    held = ConstraintSet(row, x, masses, cell=np.full(3, side))
    engine = Engine(box)
    return CellSystem(Motion(held, x), engine.force, engine.potential, engine.stress), x


def run_water(
    barostat: str, thermostat: str, steps: int, every: int = 25, seed: int = 1, skip: int = 200
) -> dict[str, Any]:
    """Densities in g/cm3, one in 25 steps of 2 fs, the first `skip` of them left out."""
    system, x, side = water_system()
    mass = sum(system.getParticleMass(k)._value for k in range(system.getNumParticles()))
    density = mass / units.mol * 1e24
    thermal = units.kB * TEMPERATURE
    seen = []
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
            seen.append(1e3 * context.getState().getPeriodicBoxVolume()._value)
        acceptance = None
    else:
        ours, x = held_water(system, x, side)
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
        note = lambda state: seen.append(float(np.linalg.det(state.cell)))  # noqa: E731
        state = stepper.start(ours, ours.initial_state(x, v, project=True))
        state = run(ours, state, 2 * units.fs, steps, stepper=stepper, observers=[note], every=25)
        acceptance = float(press.acceptance(state)[0])
    kept = np.array(seen[skip:])
    kappa, error = volumes.compressed(kept)
    return {
        "barostat": barostat,
        "thermostat": thermostat,
        "molecules": WATERS,
        "every": every,
        "picoseconds": steps * 0.002,
        "acceptance": acceptance,
        "density": volumes.mean_and_error(density / kept),
        "compressibility": [kappa / thermal * BAR, error / thermal * BAR],
        "correlation_ps": autocorrelation_time(kept) * 0.05 if len(kept) >= 32 else None,
    }


# -- what a barostat costs --------------------------------------------------------------------------------------


def cost(molecules: int, turns: int) -> dict[str, Any]:
    """Processor time of a step with a Monte Carlo barostat over that of one without, at the default frequency."""
    box, x, side = water_system(molecules, 0.55 if molecules == WATERS else 0.9)
    system, x = held_water(box, x, side)
    thermal, dt = units.kB * TEMPERATURE, 2 * units.fs
    both = ConstantPressure(Langevin(thermal, 0.001 / units.fs, 1), MonteCarloBarostat(BAR))
    state = system.initial_state(x, thermal_velocities(system, x, thermal, 1), project=True)
    told = {"barostat": "Monte Carlo", "molecules": molecules}
    return told | volumes.added_cost(system, state, dt, both, turns)


#: The same length each, so that none weighs more than others.
SEEDS = (3, 5, 11, 13)
RUNS: dict[str, Any] = {
    **{
        f"water, {b}, seed {seed}": partial(run_water, b, "Langevin", steps, 10, seed=seed)
        for seed in SEEDS
        for b, steps in (("OpenMM", 600_000), ("Monte Carlo", 500_000))
    },
    "water, rescaling": partial(run_water, "rescaling", "Langevin", 200_000),
    "water, isokinetic": partial(run_water, "Monte Carlo", "isokinetic", 400_000),
    "water, Monte Carlo, every 100": partial(run_water, "Monte Carlo", "Langevin", 150_000, 100, seed=7),
    **{f"cost, Monte Carlo, {n}": partial(cost, n, turns) for n, turns in ((WATERS, 60), (216, 20))},
}


def told(pair: Any, digits: int, scale: float = 1.0) -> str:
    return f"{scale * pair[0]:.{digits}f} ± {scale * pair[1]:.{digits}f}"


def show(result: dict[str, Any]) -> None:
    """Tables for the page."""
    runs = result["runs"]
    print("| 64 TIP3P waters | thermostat | runs | ns | density, g/cm³ | scatter | κ, 10⁻⁵/bar |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    water = [one for name, one in runs.items() if name.startswith("water")]
    found = {}
    for b in ("OpenMM", "Monte Carlo", "rescaling"):
        for t in ("Langevin", "isokinetic"):
            same = [one for one in water if (one["barostat"], one["thermostat"]) == (b, t)]
            if same:
                time = sum(one["picoseconds"] for one in same) / 1000
                density, kappa = (volumes.pooled([one[k] for one in same]) for k in ("density", "compressibility"))
                found[b, t] = density
                name = "OpenMM's own" if b == "OpenMM" else b
                scatter = f"{density[2]:.2f}" if len(same) > 1 else ""
                row = f"{len(same)} | {time:.1f} | {told(density, 4)} | {scatter} | {told(kappa, 2, 1e5)}"
                print(f"| {name} | {t} | {row} |")
    ours, theirs = found["Monte Carlo", "Langevin"], found["OpenMM", "Langevin"]
    # Errors are made larger by the scatter of runs where it is more than they tell.
    error = np.hypot(*(one[1] * max(1.0, one[2]) for one in (ours, theirs))) / theirs[0]
    print(f"\nDensity of ours over OpenMM's, less one: {100 * (ours[0] / theirs[0] - 1):.2f} ± {100 * error:.2f} %.")
    seldom = runs["water, Monte Carlo, every 100"]
    often = [one["correlation_ps"] for one in water if one["barostat"] == "Monte Carlo" and one["every"] == 10]
    one, other = np.mean(often), seldom["correlation_ps"]
    print(f"\nVolumes are independent after {one:.1f} ps with a trial in 10 steps, {other:.1f} ps with one in 100.")
    print("\n| barostat | molecules | a step costs more by |\n| --- | --- | --- |")
    for name, one in runs.items():
        if name.startswith("cost, Monte Carlo"):
            cost = f"{100 * (one['ratio'] - 1):.1f} ± {100 * one['error']:.1f} %"
            print(f"| {one['barostat']} | {one['molecules']} TIP3P waters, OpenMM | {cost} |")


def short() -> None:
    one = run_water("Monte Carlo", "Langevin", 1000, skip=10)
    print(f"64 TIP3P waters after 2 ps: {one['density'][0]:.2f} g/cm3, {one['acceptance']:.0%} of trials accepted")


if __name__ == "__main__":
    scripts.script_of_runs(__doc__, RUNS, short, show, RESULTS)
