"""Constant pressure on constraints: fluids of rigid molecules, a molecular crystal and a slab.

python examples/studies/constant_pressure.py                 short runs
python examples/studies/constant_pressure.py --full          those of docs/constant_pressure.md: an hour and a half
python examples/studies/constant_pressure.py --full NAME...  some of them
python examples/studies/constant_pressure.py --show FILE     the tables of the page from a file of results

Fluids are in reduced units, of molecules with Lennard-Jones sites: dumbbells, and methane held by all its ten
distances, of which nine are independent. Water is in constant_pressure_water.py, whose results are in the same
file.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numba
import numpy as np
import study_scripts as scripts
from ase import units
from ase.build import fcc100
from ase.calculators.emt import EMT

from kcons import ConstraintSet
from kcons.ase import ConstrainedLangevin, constrain, draw_velocities
from kcons.comparison import volumes
from kcons.constraints import Distance, Plane
from kcons.motion import Motion
from kcons.steppers import run
from kcons.thermostats import (
    CellRescaling,
    CellSystem,
    ConstantPressure,
    Isokinetic,
    Langevin,
    MonteCarloBarostat,
    NoseHooverChain,
    autocorrelation_time,
    instantaneous_pressure,
    thermal_velocities,
)

RESULTS = Path(__file__).parents[2] / "docs" / "results" / "constant_pressure.json"

# -- fluids of rigid molecules --------------------------------------------------------------------------------------

CUTOFF = 2.0
TEMPERATURE, BAR = 300.0, units.bar
#: What keeps the shape of a box that changes more than its volume.
STIFF = 800
#: What is not kept of a run.
SERIES = ("volumes", "energies", "shapes")
DUMBBELL = np.array([[0.0, 0, 0], [1.0, 0, 0]])
METHANE, METHANES = (
    0.63 * np.array([[0.0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]),
    "methane, 10 distances of rank 9",
)
#: Shape, molecules, first side of the box, depth of the potential, temperature, pressure.
FLUIDS = {
    "dumbbells": (DUMBBELL, 32, 8.6, 1.0, 2.0, 1.0),
    METHANES: (METHANE, 20, 9.6, 0.3, 2.0, 0.5),
}


@numba.njit
def sites(x, h, size, depth, cutoff):  # type: ignore[no-untyped-def]
    """Energy, forces and virial of sites of different molecules, cut off smoothly, in a lower triangular cell h."""
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
            for k in range(2, -1, -1):
                whole = np.rint(d[k] / h[k, k])
                for m in range(k + 1):
                    d[m] -= whole * h[k, m]
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
    """Energy, forces and stress of `sites`, as functions of positions, time and cell.

    `stiff` is for a liquid in a cell that changes more than its volume: it keeps the shape, and knows nothing of the
    volume.
    """

    def __init__(self, size: int, depth: float, stiff: float = 0.0) -> None:
        self.size, self.depth, self.stiff = size, depth, stiff
        self._known: tuple[bytes, Any] = (b"", None)

    def _found(self, x, h):
        # An energy and forces at one place are one evaluation.
        key = x.tobytes() + h.tobytes()
        if key != self._known[0]:
            self._known = key, sites(np.ascontiguousarray(x), np.ascontiguousarray(h), self.size, self.depth, CUTOFF)
        return self._known[1]

    def force(self, x, t, h):
        return self._found(x, h)[1]

    def potential(self, x, t, h):
        return self._found(x, h)[0] + self.shape(h)

    def stress(self, x, t, h):
        volume = np.linalg.det(h)
        squares = h.T @ h
        shape = 2 * self.stiff * (squares - np.trace(squares) / 3 * np.eye(3)) / volume ** (2 / 3)
        return (shape - self._found(x, h)[2]) / volume

    def shape(self, h):
        return self.stiff * ((h**2).sum() / np.linalg.det(h) ** (2 / 3) - 3)


def fluid(name: str, seed: int, stiff: float = 0.0) -> tuple[CellSystem, np.ndarray, Sites]:
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
    forces = Sites(m, depth, stiff)
    return CellSystem(Motion(held, x), forces.force, forces.potential, forces.stress), x, forces


def run_fluid(
    name: str,
    barostat: str,
    thermostat: str,
    steps: int,
    kind: str = "isotropic",
    *,
    hotter: float = 1.0,
    denser: float = 1.0,
    seed: int = 1,
) -> dict[str, Any]:
    """Volumes and energies, one in ten steps, the first tenth left out."""
    _, n, _, _, temperature, pressure = FLUIDS[name]
    temperature, pressure = temperature * hotter, pressure * denser
    system, x, forces = fluid(name, seed, 0.0 if kind == "isotropic" else STIFF)
    steppers = {
        "Langevin": partial(Langevin, temperature, 1.0, seed),
        "Nose-Hoover": partial(NoseHooverChain, temperature, period=1.0, momentum="conserved"),
        "isokinetic": partial(Isokinetic, temperature, momentum="conserved"),
    }
    presses = {
        "Monte Carlo": partial(MonteCarloBarostat, pressure),
        "rescaling": partial(CellRescaling, pressure, 0.5, 1.0),
    }
    every = 10 if kind == "isotropic" else 5
    press = presses[barostat](every=every, seed=seed, cutoff=CUTOFF, kind=kind)
    stepper = ConstantPressure(steppers[thermostat](), press)
    zero = thermostat != "Langevin"
    state = system.initial_state(x, thermal_velocities(system, x, temperature, seed, zero_momentum=zero))
    # Sites may overlap at first.
    state = run(system, state, 0.0005, 2000, stepper=ConstantPressure(Langevin(temperature, 5.0, seed), press))
    v = thermal_velocities(system, state.positions, temperature, seed, zero_momentum=zero)
    state = stepper.start(system, system.initial_state(state.positions, v))
    seen = []

    def note(state):
        shape = forces.shape(state.cell)
        seen.append((np.linalg.det(state.cell), system.potential(state.positions, 0.0), shape))

    state = run(system, state, 0.004, steps, stepper=stepper, observers=[note], every=10)
    named = barostat if kind == "isotropic" else f"{barostat}, {kind}"
    about = name, named, thermostat, temperature, pressure, steps, n
    return told_of(seen[len(seen) // 10 :], *about) | {"acceptance": float(press.acceptance(state)[0])}


def told_of(seen: list[Any], *about: Any) -> dict[str, Any]:
    """A run with its series of volumes, energies, and of these those of the shape of the box."""
    names = "fluid", "barostat", "thermostat", "temperature", "pressure", "steps", "molecules"
    return dict(zip(names, about, strict=True)) | dict(zip(SERIES, np.array(seen, dtype=float).T, strict=True))


# -- the same dumbbells in OpenMM -----------------------------------------------------------------------------------

#: kJ/mol/K, and bar in kJ/mol/nm^3.
GAS, PER_BAR = 0.00831446261815324, 16.6053906717
SHAPE = f"{STIFF}*((ax^2+bx^2+by^2+cx^2+cy^2+cz^2)/v^(2/3)-3)"


def run_in_openmm(
    ensemble: str, barostat: str, steps: int, *, hotter: float = 1.0, denser: float = 1.0, seed: int = 1
) -> dict[str, Any]:
    """Volumes and energies beside a barostat of OpenMM, one in ten steps, the first fifth left out."""
    import openmm

    from kcons import openmm as ours

    shape, n, side, depth, temperature, pressure = FLUIDS["dumbbells"]
    temperature, pressure = temperature * hotter, pressure * denser
    _, x, _ = fluid("dumbbells", seed)
    system = openmm.System()
    energy = f"4*{depth}*(r^-12-r^-6)-4*{depth}*(s^2-s)+24*{depth}*(2*s^2-s)/{CUTOFF}*(r-{CUTOFF}); s={CUTOFF**-6}"
    force = openmm.CustomNonbondedForce(energy)
    force.setNonbondedMethod(openmm.CustomNonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(CUTOFF)
    for k in range(len(x)):
        system.addParticle(1.0 + k % 2)
        force.addParticle([])
    for k in range(0, len(x), 2):
        system.addConstraint(k, k + 1, float(np.linalg.norm(shape[1] - shape[0])))
        force.addExclusion(k, k + 1)
    kelvin, bar = temperature / GAS, pressure * PER_BAR
    membrane = openmm.MonteCarloMembraneBarostat
    press = {
        "flexible": lambda: openmm.MonteCarloFlexibleBarostat(bar, kelvin, 10),
        "anisotropic": lambda: openmm.MonteCarloAnisotropicBarostat(openmm.Vec3(bar, bar, bar), kelvin),
        "membrane": lambda: membrane(bar, 0.0, kelvin, membrane.XYIsotropic, membrane.ZFree, 10),
    }[barostat]()
    press.setFrequency(1 if barostat == "flexible" else 10)  # it changes six lengths at once, by little
    press.setRandomNumberSeed(seed)
    for part in (force, press, openmm.CustomVolumeForce(SHAPE)):
        system.addForce(part)
    system.setDefaultPeriodicBoxVectors(*(side * np.eye(3)))
    baths = {
        "Langevin": lambda: ours.Langevin(kelvin, 1.0),
        "Nose-Hoover": lambda: ours.NoseHoover(kelvin, 1.0),
        "isokinetic": lambda: ours.Isokinetic(kelvin, momentum="conserved"),
    }
    integrator = ours.ProjectedIntegrator(0.004, ensemble=baths[ensemble]())
    integrator.setRandomNumberSeed(seed)
    cpu = openmm.Platform.getPlatformByName("CPU")
    context = openmm.Context(system, integrator, cpu, {"Threads": "1", "DeterministicForces": "true"})
    context.setPositions(x)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 200)
    integrator.setVelocitiesToTemperature(context, kelvin, seed)
    v, masses = context.getState(velocities=True).getVelocities(asNumpy=True)._value, 1.0 + np.arange(len(x)) % 2
    context.setVelocities(v - masses @ v / masses.sum())
    seen = []
    for _ in range(steps // 10):
        integrator.step(10)
        state = context.getState(energy=True)
        volume, box = state.getPeriodicBoxVolume()._value, state.getPeriodicBoxVectors(asNumpy=True)._value
        seen.append((volume, state.getPotentialEnergy()._value, STIFF * ((box**2).sum() / volume ** (2 / 3) - 3)))
    integrator.check()
    kept = seen[len(seen) // 5 :]  # the start is far too wide
    return told_of(kept, "dumbbells in OpenMM", barostat, ensemble, temperature, pressure, steps, n)


# -- from one pressure or temperature to another --------------------------------------------------------------------


def judged(one: dict[str, Any], two: dict[str, Any]) -> float | None:
    """Standard errors by which the package physical_validation finds two ensembles off; None of too few values."""
    import physical_validation as pv

    names = ("energy", "length", "volume", "temperature", "pressure", "time")
    factors = {f"{name}_conversion": 1.0 for name in names} | {f"{name}_str": "reduced" for name in names}
    factors["pressure_conversion"] = 16.6053906717  # its own are kJ/mol, nm and bar
    unit = pv.data.UnitData(kb=1.0, **factors)
    data = []
    for run_ in (one, two):
        n, u = 2 * run_["molecules"], np.array(run_["energies"])
        ensemble = pv.data.EnsembleData("NPT", natoms=n, pressure=run_["pressure"], temperature=run_["temperature"])
        seen = pv.data.ObservableData(
            potential_energy=u, total_energy=u, kinetic_energy=0 * u, volume=np.array(run_["volumes"])
        )
        system = pv.data.SystemData(natoms=n, nconstraints=n // 2, ndof_reduction_tra=0, ndof_reduction_rot=0)
        data.append(pv.data.SimulationData(units=unit, ensemble=ensemble, observables=seen, system=system, dt=0.04))
    try:
        return float(pv.ensemble.check(*data, total_energy=False, verbosity=0, bootstrap_seed=1)[0])
    except pv.util.error.InputError as error:
        if "Less than 3 bins" not in str(error):
            raise
        return None


def means(run_: dict[str, Any]) -> dict[str, Any]:
    """Of a run, instead of its series."""
    rest = {key: value for key, value in run_.items() if key not in SERIES}
    kappa = [value / run_["temperature"] for value in volumes.compressed(run_["volumes"])]
    volume, energy = (volumes.mean_and_error(v) for v in (run_["volumes"], run_["energies"] - run_["shapes"]))
    return rest | {"volume": volume, "energy": energy, "compressibility": kappa}


def repeated(run_: Any, times: int, *, seed: int = 1, **more: float) -> dict[str, Any]:
    """Several runs as one; OpenMM's flexible barostat makes its trials smaller and smaller in a long one."""
    each = [run_(seed=10 * seed + k, **more) for k in range(times)]
    series = {key: np.concatenate([one[key] for one in each]) for key in SERIES}
    return each[0] | series | {"steps": times * each[0]["steps"]}


def compared(run_: Any, others: Any = (("denser", {"denser": 1.3}), ("hotter", {"hotter": 1.1}))) -> dict[str, Any]:
    """A run, and the slopes to one at 1.3 times its pressure and one at 1.1 times its temperature."""
    first = run_()
    told = means(first) | {"slopes": {}}
    for name, more in others:
        other = run_(**more, seed=2)
        found, error, exact = volumes.slope_between(first, other)
        line = {"found": found, "error": error, "exact": exact, "physical_validation": judged(first, other)}
        told["slopes"][name] = line
    return told


# -- a molecular crystal, a slab ------------------------------------------------------------------------------------


def diatomics(cells: int) -> tuple[CellSystem, np.ndarray]:
    """Rigid diatomics as in alpha nitrogen, four in each of so many cells cubed."""
    basis = np.array([[0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]])
    axes = np.array([[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]]) / np.sqrt(3)
    side, bond = 1.75, 0.33
    places = (np.array(list(np.ndindex(cells, cells, cells)))[:, None] + basis).reshape(-1, 3) * side
    turned = np.tile(axes, (cells**3, 1)) * bond / 2
    x = np.stack([places - turned, places + turned], axis=1).reshape(-1, 3)
    rows = Distance(np.arange(len(x)).reshape(-1, 2))
    held = ConstraintSet(rows, x, np.ones(len(x)), cell=np.full(3, cells * side))
    forces = Sites(2, 1.0)
    return CellSystem(Motion(held, x), forces.force, forces.potential, forces.stress), x


def crystal(steps: int, seed: int) -> dict[str, Any]:
    """108 of them, whose places keep their order while they turn; three lengths of the cell that change by themselves.

    All three sides must then be the same, and the mean stress along each the pressure.
    """
    system, x = diatomics(3)
    thermal, pressure = 0.7, 1.0
    barostat = CellRescaling(pressure, 0.5, 0.4, kind="anisotropic", every=10, seed=seed, cutoff=CUTOFF)
    stepper = ConstantPressure(Langevin(thermal, 1.0, seed), barostat)
    seen: list[np.ndarray] = []

    def note(state):
        side = np.diag(state.cell) / 3
        own = replace(state.copied(), barostat=None)
        stress = np.diag(instantaneous_pressure(system, own, thermal_energy=thermal))
        waves = np.exp(4j * np.pi * own.positions.reshape(-1, 2, 3).mean(axis=1) / side)
        seen.append(np.concatenate([side, stress, np.abs(waves.mean(axis=0))]))

    state = system.initial_state(x, thermal_velocities(system, x, thermal, seed))
    state = run(system, state, 0.004, steps, stepper=stepper, observers=[note], every=10)
    kept = np.array(seen)[len(seen) // 5 :]
    side, stress = ([volumes.mean_and_error(column) for column in part.T] for part in (kept[:, :3], kept[:, 3:6]))
    return {
        "steps": steps,
        "acceptance": float(barostat.acceptance(state)[0]),
        "pressure": pressure,
        "sides": side,
        "stress": stress,
        "order of places": float(kept[:, 6:].mean()),
        "correlation": max(autocorrelation_time(column) * 10 for column in kept.T[:6]) if len(kept) >= 32 else None,
    }


def slab(steps: int) -> dict[str, Any]:
    """Copper (100) by EMT, four layers in a cell without a third direction; the lowest layer slides in its plane."""
    atoms = fcc100("Cu", (3, 3, 4), vacuum=None, orthogonal=True)
    atoms.pbc = [True, True, False]
    atoms.cell[2, 2] = 1.0
    atoms.calc = EMT()
    lowest = np.flatnonzero(atoms.positions[:, 2] < 0.1)
    constrain(atoms, Plane(lowest, [0, 0, 1]))
    draw_velocities(atoms, TEMPERATURE, 1)
    flat = atoms.cell.lengths()[0] / 3
    barostat = MonteCarloBarostat(0.0, kind="lateral", every=5, seed=1)
    dynamics = ConstrainedLangevin(atoms, 3 * units.fs, TEMPERATURE, 0.01 / units.fs, rng=1, barostat=barostat)
    sides: list[float] = []
    dynamics.attach(lambda: sides.append(atoms.cell.lengths()[0] / 3), interval=5)
    dynamics.run(steps)
    heights = float(np.ptp(atoms.positions[lowest, 2]))
    return {
        "steps": steps,
        "perfect": flat,
        "side": volumes.mean_and_error(sides[len(sides) // 5 :]),
        "spread of heights": heights,
    }


# -- what a barostat costs --------------------------------------------------------------------------------------


def cost(molecules: int, turns: int) -> dict[str, Any]:
    """Processor time of a step with cell rescaling over that of one without, at the default frequency, in turns.

    Of rigid diatomics, whose stress is known.
    """
    system, x = diatomics(round((molecules / 4) ** (1 / 3)))
    thermal, dt = 0.3, 0.004
    both = ConstantPressure(Langevin(thermal, 1.0, 1), CellRescaling(0.5, 0.5, 0.01))
    state = system.initial_state(x, thermal_velocities(system, x, thermal, 1), project=True)
    told = {"barostat": "rescaling", "molecules": molecules}
    return told | volumes.added_cost(system, state, dt, both, turns)


RUNS: dict[str, Any] = {
    **{
        f"dumbbells, {b}, Langevin": partial(compared, partial(run_fluid, "dumbbells", b, "Langevin", 120_000))
        for b in ("Monte Carlo", "rescaling")
    },
    **{
        f"{name}, {b}, {t}": partial(compared, partial(run_fluid, name, b, t, 60_000), ())
        for name, b, t in (
            ("dumbbells", "rescaling", "isokinetic"),
            *((METHANES, b, "Langevin") for b in ("Monte Carlo", "rescaling")),
            (METHANES, "rescaling", "isokinetic"),
            ("dumbbells", "Monte Carlo", "Nose-Hoover"),
        )
    },
    **{
        f"dumbbells, {b}, {kind}, Langevin": partial(compared, partial(run_fluid, "dumbbells", b, "Langevin", n, kind))
        for b, kind, n in (
            ("Monte Carlo", "flexible", 240_000),
            *(("rescaling", kind, 120_000) for kind in ("flexible", "anisotropic")),
        )
    },
    **{
        f"OpenMM, {b}, {e}": partial(compared, partial(run_in_openmm, e, b, 60_000))
        for b, e in (("anisotropic", "Nose-Hoover"), ("membrane", "isokinetic"))
    },
    "OpenMM, flexible, Langevin": partial(
        compared, partial(repeated, partial(run_in_openmm, "Langevin", "flexible", 60_000), 4)
    ),
    **{f"cost, rescaling, {n}": partial(cost, n, turns) for n, turns in ((108, 60), (500, 20))},
    **{f"crystal {seed}": partial(crystal, 120_000, seed) for seed in (1, 2)},
    "slab": partial(slab, 20_000),
}


def told(pair: Any, digits: int, scale: float = 1.0) -> str:
    return f"{scale * pair[0]:.{digits}f} ± {scale * pair[1]:.{digits}f}"


def show(result: dict[str, Any]) -> None:
    """Tables for the page."""
    runs = {name: result["runs"][name] for name in RUNS if name in result["runs"]}
    print("| fluid | barostat | thermostat | V/N | U/N | κ |\n| --- | --- | --- | --- | --- | --- |")
    for one in runs.values():
        if "volume" in one:
            n = one["molecules"]
            row = told(one["volume"], 3, 1 / n), told(one["energy"], 3, 1 / n), told(one["compressibility"], 2)
            print(f"| {one['fluid']} | {one['barostat']} | {one['thermostat']} | {' | '.join(row)} |")
    print("\n| run | to | slope found | exact | physical_validation |\n| --- | --- | --- | --- | --- |")
    for name, one in runs.items():
        for to, line in one.get("slopes", {}).items():
            what = "1.3 P, along V" if to == "denser" else "1.1 T, along U + P V"
            off, found = line["physical_validation"], told((line["found"], line["error"]), 4)
            said = "too few values" if off is None else f"{off:.1f} σ"
            print(f"| {name} | {what} | {found} | {line['exact']:.4f} | {said} |")
    print("\n| barostat | molecules | a step costs more by |\n| --- | --- | --- |")
    for name, one in runs.items():
        if name.startswith("cost, rescaling"):
            cost = told((one["ratio"] - 1, one["error"]), 1, 100)
            print(f"| {one['barostat']} | {one['molecules']} rigid diatomics | {cost} % |")
    for seed in (1, 2):
        sides, stress = (
            ", ".join(told(pair, digits) for pair in runs[f"crystal {seed}"][key])
            for key, digits in (("sides", 4), ("stress", 3))
        )
        print(f"\nCrystal {seed}: sides {sides}; stress {stress}.")
    print(f"Slab: {told(runs['slab']['side'], 4)} beside {runs['slab']['perfect']:.4f}.")


def short_runs() -> None:
    print("A fluid of 32 rigid dumbbells at kT = 2, P = 1 (reduced units):")
    for barostat in ("Monte Carlo", "rescaling"):
        one = run_fluid("dumbbells", barostat, "Langevin", 600)
        volume, error = volumes.mean_and_error(one["volumes"])
        accepted = f"{one['acceptance']:.0%} of trials accepted"
        print(f"  {barostat:<12} V/N = {volume / 32:.2f} +- {error / 32:.2f}, {accepted}")
    short = crystal(100, 1)
    print("A crystal of rigid diatomics: sides", ", ".join(f"{side:.4f}" for side, _ in short["sides"]))
    short = slab(60)
    print(f"A copper slab at 300 K: {short['side'][0]:.4f} A from row to row, {short['perfect']:.4f} A at rest")
    print("A step of water at constant pressure:")
    lines = ConstantPressure(Langevin(0.026, 0.001, 1), MonteCarloBarostat(BAR)).listing().splitlines()
    print("\n".join(f"  {line}" for line in lines))


if __name__ == "__main__":
    scripts.script_of_runs(__doc__, RUNS, short_runs, show, RESULTS)
