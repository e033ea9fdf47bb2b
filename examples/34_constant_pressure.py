"""Constant pressure on constraints: fluids of rigid molecules, rigid water, a molecular crystal and a slab.

python examples/34_constant_pressure.py                 short runs
python examples/34_constant_pressure.py --full          those of docs/constant_pressure.md: an hour
python examples/34_constant_pressure.py --full NAME...  some of them

Fluids are in reduced units, of molecules with Lennard-Jones sites: dumbbells, and methane held by all its ten
distances, of which nine are independent. Water is TIP3P with a reaction field, by OpenMM as a force engine.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numba
import numpy as np
from ase import units

from kcons import ConstraintSet
from kcons.constraints import Distance
from kcons.motion import Motion
from kcons.steppers import run
from kcons.thermostats import Isokinetic, Langevin, NoseHooverChain, thermal_velocities
from kcons.thermostats.pressure import CellRescaling, CellSystem, ConstantPressure, MonteCarloBarostat

RESULTS = Path(__file__).parents[1] / "docs" / "results" / "constant_pressure.json"

# -- fluids of rigid molecules --------------------------------------------------------------------------------------

CUTOFF = 2.0
DUMBBELL = np.array([[0.0, 0, 0], [1.0, 0, 0]])
METHANE = 0.63 * np.array([[0.0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
#: Shape, molecules, first side of the box, depth of the potential, temperature, pressure.
FLUIDS = {
    "dumbbells": (DUMBBELL, 32, 8.6, 1.0, 2.0, 1.0),
    "methane, 10 distances of rank 9": (METHANE, 20, 9.6, 0.3, 2.0, 0.5),
}


@numba.njit
def sites(x, h, size, depth, cutoff):  # type: ignore[no-untyped-def]
    """Energy, forces and virial of sites of different molecules, cut off smoothly, in a box of side lengths h."""
    n = len(x)
    forces, virial, energy = np.zeros((n, 3)), np.zeros((3, 3)), 0.0
    s6 = cutoff**-6
    last, slope = 4 * depth * (s6 * s6 - s6), -24 * depth * (2 * s6 * s6 - s6) / cutoff
    d = np.empty(3)
    for i in range(n):
        for j in range((i // size + 1) * size, n):
            r2 = 0.0
            for k in range(3):
                d[k] = x[i, k] - x[j, k]
                d[k] -= h[k] * np.rint(d[k] / h[k])
                r2 += d[k] * d[k]
            if r2 >= cutoff * cutoff:
                continue
            r = np.sqrt(r2)
            s6 = r2**-3
            energy += 4 * depth * (s6 * s6 - s6) - last - slope * (r - cutoff)
            push = (24 * depth * (2 * s6 * s6 - s6) / r + slope) / r
            for k in range(3):
                forces[i, k] += push * d[k]
                forces[j, k] -= push * d[k]
                for m in range(3):
                    virial[k, m] += push * d[k] * d[m]
    return energy, forces, virial


class Sites:
    """Energy, forces and stress of `sites`, as functions of positions, time and cell."""

    def __init__(self, size: int, depth: float) -> None:
        self.size, self.depth = size, depth
        self._known: tuple[bytes, Any] = (b"", None)

    def _found(self, x, h):
        # An energy and forces at one place are one evaluation.
        key = x.tobytes() + h.tobytes()
        if key != self._known[0]:
            self._known = key, sites(np.ascontiguousarray(x), np.diag(h).copy(), self.size, self.depth, CUTOFF)
        return self._known[1]

    def force(self, x, t, h):
        return self._found(x, h)[1]

    def potential(self, x, t, h):
        return self._found(x, h)[0]

    def stress(self, x, t, h):
        return -self._found(x, h)[2] / np.linalg.det(h)


def fluid(name: str, seed: int) -> tuple[CellSystem, np.ndarray]:
    """Molecules on a simple lattice, turned at random."""
    shape, n, side, depth, _, _ = FLUIDS[name]
    rng, m = np.random.default_rng(seed), len(shape)
    k = int(np.ceil(n ** (1 / 3)))
    places = np.stack(np.meshgrid(*[np.arange(k)] * 3, indexing="ij"), -1).reshape(-1, 3)[:n] * (side / k)
    turned = (shape - shape.mean(0)) @ np.linalg.qr(rng.standard_normal((n, 3, 3)))[0]
    x = (places[:, None] + turned).reshape(-1, 3)
    pairs = np.array([(i, j) for i in range(m) for j in range(i + 1, m)])
    lengths = np.linalg.norm(shape[pairs[:, 0]] - shape[pairs[:, 1]], axis=1)
    rows = Distance((pairs + m * np.arange(n)[:, None, None]).reshape(-1, 2), np.tile(lengths, n))
    masses = np.tile(1.0 + np.arange(m) % 2, n)
    held = ConstraintSet(rows, x, masses, cell=np.full(3, side))
    forces = Sites(m, depth)
    return CellSystem(Motion(held, x), forces.force, forces.potential, forces.stress), x


def run_fluid(
    name: str, barostat: str, thermostat: str, steps: int, *, hotter: float = 1.0, denser: float = 1.0, seed: int = 1
) -> dict[str, Any]:
    """Volumes and energies, one in ten steps, the first tenth left out."""
    _, n, _, _, temperature, pressure = FLUIDS[name]
    temperature, pressure = temperature * hotter, pressure * denser
    system, x = fluid(name, seed)
    steppers = {
        "Langevin": partial(Langevin, temperature, 1.0, seed),
        "Nose-Hoover": partial(NoseHooverChain, temperature, period=1.0, momentum="conserved"),
        "isokinetic": partial(Isokinetic, temperature, momentum="conserved"),
    }
    presses = {
        "Monte Carlo": partial(MonteCarloBarostat, pressure),
        "rescaling": partial(CellRescaling, pressure, 0.5, 1.0),
    }
    press = presses[barostat](every=10, seed=seed, cutoff=CUTOFF)
    stepper = ConstantPressure(steppers[thermostat](), press)
    zero = thermostat != "Langevin"
    state = system.initial_state(x, thermal_velocities(system, x, temperature, seed, zero_momentum=zero))
    # Sites may overlap at first.
    state = run(system, state, 0.0005, 2000, stepper=ConstantPressure(Langevin(temperature, 5.0, seed), press))
    v = thermal_velocities(system, state.positions, temperature, seed, zero_momentum=zero)
    state = stepper.start(system, system.initial_state(state.positions, v))
    volumes, energies = [], []

    def note(seen):
        volumes.append(float(np.linalg.det(seen.cell)))
        energies.append(float(system.potential(seen.positions, 0.0)))

    state = run(system, state, 0.004, steps, stepper=stepper, observers=[note], every=10)
    first = len(volumes) // 10
    return {
        "fluid": name,
        "barostat": barostat,
        "thermostat": thermostat,
        "temperature": temperature,
        "pressure": pressure,
        "steps": steps,
        "molecules": n,
        "acceptance": float(press.acceptance(state)[0]),
        "volumes": volumes[first:],
        "energies": energies[first:],
    }


# -- statistics -----------------------------------------------------------------------------------------------------


def correlation_time(values: np.ndarray) -> float:
    """Integrated, in samples."""
    d = values - values.mean()
    n = len(d)
    rho = np.fft.irfft(np.abs(np.fft.rfft(d, 2 * n)) ** 2)[:n] / np.arange(n, 0, -1)
    rho /= rho[0]
    total = 1.0
    for k in range(1, n):
        total += 2 * rho[k]
        if k > 6 * total:
            break
    return max(total, 1.0)


def mean_and_error(values: Any) -> tuple[float, float]:
    values = np.asarray(values)
    return float(values.mean()), float(values.std() * np.sqrt(correlation_time(values) / len(values)))


def compressed(volumes: Any) -> tuple[float, float]:
    """<dV^2>/<V>, and its error from that of the squares."""
    volumes = np.asarray(volumes)
    squares = (volumes - volumes.mean()) ** 2
    mean, error = mean_and_error(squares)
    return mean / float(volumes.mean()), error / float(volumes.mean())


def slope(one: dict[str, Any], two: dict[str, Any]) -> tuple[float, float, float]:
    """ln of the ratio of two distributions along H = U + P V or V: the slope found, its error, and the exact one.

    The estimate of greatest likelihood (Shirts, J. Chem. Theory Comput. 9, 909 (2013)); for two pressures along V, for
    two temperatures along the enthalpy. Samples are thinned to independent ones.
    """
    if one["temperature"] == two["temperature"]:
        values = [np.array(found["volumes"]) for found in (one, two)]
        exact = -(two["pressure"] - one["pressure"]) / one["temperature"]
    else:
        values = [np.array(f["energies"]) + f["pressure"] * np.array(f["volumes"]) for f in (one, two)]
        exact = 1 / one["temperature"] - 1 / two["temperature"]
    values = [v[:: int(np.ceil(correlation_time(v)))] for v in values]
    x = np.concatenate(values)
    side = np.repeat([0.0, 1.0], [len(v) for v in values])
    design = np.stack([np.ones_like(x), x - x.mean()], axis=1)
    beta = np.zeros(2)
    for _ in range(50):
        p = 1 / (1 + np.exp(-design @ beta))
        hessian = design.T @ (design * (p * (1 - p))[:, None])
        beta += np.linalg.solve(hessian, design.T @ (side - p))
    return float(beta[1]), float(np.sqrt(np.linalg.inv(hessian)[1, 1])), exact


# -- rigid water ----------------------------------------------------------------------------------------------------

WATERS, TEMPERATURE, BAR = 64, 300.0, units.bar


def water_system() -> Any:
    """TIP3P with a reaction field of 5.5 angstrom, in OpenMM."""
    import openmm

    from kcons.comparison.test_systems import water

    built = water.build(WATERS)
    system = built.openmm.copy()
    force = next(f for f in system.getForces() if isinstance(f, openmm.NonbondedForce))
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.55)
    force.setUseSwitchingFunction(False)
    return system, built.positions, float(built.cell[0])


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


def run_water(barostat: str, thermostat: str, steps: int, every: int = 25, seed: int = 1) -> dict[str, Any]:
    """Densities in g/cm3, one in 25 steps of 2 fs, the first 10 ps left out."""
    system, x, side = water_system()
    masses = np.array([system.getParticleMass(k)._value for k in range(system.getNumParticles())])
    density = masses.sum() / units.mol * 1e24
    thermal, skip = units.kB * TEMPERATURE, 200
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
        context.setVelocitiesToTemperature(TEMPERATURE, seed)
        for _ in range(steps // 25):
            integrator.step(25)
            volumes.append(1e3 * context.getState().getPeriodicBoxVolume()._value)
        acceptance = None
    else:
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
        "correlation_ps": correlation_time(volumes) * 0.05,
    }


FULL = {
    "water, OpenMM": partial(run_water, "OpenMM", "Langevin", 800_000),
    "water, Monte Carlo": partial(run_water, "Monte Carlo", "Langevin", 400_000),
    "water, rescaling": partial(run_water, "rescaling", "Langevin", 400_000),
    "water, isokinetic": partial(run_water, "Monte Carlo", "isokinetic", 200_000),
    **{
        f"{fluid_}, {b}, {t}": partial(run_fluid, fluid_, b, t, 120_000)
        for fluid_ in FLUIDS
        for b, t in (("Monte Carlo", "Langevin"), ("rescaling", "Langevin"), ("rescaling", "isokinetic"))
    },
    "dumbbells, Monte Carlo, Nose-Hoover": partial(run_fluid, "dumbbells", "Monte Carlo", "Nose-Hoover", 120_000),
    **{
        f"dumbbells, {b}, Langevin, {what}": partial(run_fluid, "dumbbells", b, "Langevin", 120_000, **more, seed=2)
        for b in ("Monte Carlo", "rescaling")
        for what, more in (("denser", {"denser": 1.3}), ("hotter", {"hotter": 1.1}))
    },
}
