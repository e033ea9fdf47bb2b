"""Our dynamics class beside ASE's: accuracy, cost, pressure, temperature.

python ase_dynamics.py --quick --out DIR   a few seconds
python ase_dynamics.py --out DIR           what docs/evidence/ase.md shows, minutes
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import harness
import numpy as np
import pandas as pd
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.calculator import Calculator, all_changes
from ase.calculators.emt import EMT
from ase.md.andersen import Andersen
from ase.md.bussi import Bussi
from ase.md.langevin import Langevin
from ase.md.md import MolecularDynamics
from ase.md.verlet import VelocityVerlet

from kcons.ase import ConstrainedDynamics, constrain, draw_velocities, rigid_water
from kcons.constraints import Distance
from kcons.steppers import BlanesMoan4, BlanesMoan6, KahanLi6, Rattle, Stepper, Suzuki4

FS = units.fs
BAR = 1e5 * units.Pascal


class Free(Calculator):
    """No forces and no stress: what is seen is the constraints alone."""

    implemented_properties = ("energy", "forces", "stress")

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        self.results = {"energy": 0.0, "forces": np.zeros((len(atoms), 3)), "stress": np.zeros(6)}


def waters(n: int, spacing: float, *, hold: bool = True, periodic: bool = False) -> Atoms:
    """Free rigid waters in random orientations on a grid, at 300 K."""
    rng = np.random.default_rng(0)
    side = int(np.ceil(round(n ** (1 / 3), 6)))
    x = np.empty((n, 3, 3))
    for k in range(n):
        one = molecule("H2O")
        one.rotate(rng.uniform(0, 360), rng.normal(size=3))
        x[k] = one.positions + spacing * np.array(np.unravel_index(k, (side, side, side)))
    atoms = Atoms("OHH" * n, positions=x.reshape(-1, 3), calculator=Free())
    if periodic:
        atoms.set_cell([spacing * side] * 3)
        atoms.pbc = True
    if hold:
        constrain(atoms, rigid_water(atoms, "tip3p"), project=True)
    draw_velocities(atoms, 300, rng=rng)
    return atoms


def dumbbells(n: int, side: float = 60.0) -> Atoms:
    """An ideal gas of rigid CO in a periodic box."""
    rng = np.random.default_rng(0)
    axis = rng.normal(size=(n, 3))
    axis *= 1.1 / np.linalg.norm(axis, axis=1)[:, None]
    x = np.empty((2 * n, 3))
    x[0::2] = rng.uniform(0, side, size=(n, 3))
    x[1::2] = x[0::2] + axis
    atoms = Atoms("CO" * n, positions=x, cell=[side] * 3, pbc=True, calculator=Free())
    constrain(atoms, Distance(np.arange(2 * n).reshape(-1, 2)))
    draw_velocities(atoms, 300, rng=rng)
    return atoms


# -- accuracy ---------------------------------------------------------------------------------------


def far_from_the_origin(steps: int) -> list[dict]:
    """Kinetic energy lost by a free rigid CO far from the origin."""
    rows = []
    for timestep in (1.0, 0.02):
        for distance in (0.0, 1e3, 1e6, 1e9):
            change = []
            for dynamics in (VelocityVerlet, ConstrainedDynamics):
                atoms = Atoms("CO", positions=np.array([[0, 0, 0], [1.1, 0, 0]]) + distance, calculator=Free())
                constrain(atoms, Distance([0, 1]))
                draw_velocities(atoms, 300, rng=np.random.default_rng(3))
                before = atoms.get_kinetic_energy()
                dynamics(atoms, timestep * FS).run(steps)
                change.append(abs(atoms.get_kinetic_energy() / before - 1))
            rows.append(
                {"distance": distance, "timestep_fs": timestep, "steps": steps, "ase": change[0], "kcons": change[1]}
            )
    return rows


def ethanol() -> tuple[Atoms, Callable[[], Calculator], str]:
    """Ethanol whose X-H bonds are held, by GFN2-xTB where tblite is installed."""
    try:
        from tblite.ase import TBLite
    except ImportError:
        name, temperature, calculator = "EMT", 50, EMT
    else:
        name, temperature = "GFN2-xTB", 300

        def calculator() -> Calculator:
            return TBLite(method="GFN2-xTB", accuracy=0.01, verbosity=0)

    atoms = molecule("CH3CH2OH")
    hydrogen, heavy = np.flatnonzero(atoms.numbers == 1), np.flatnonzero(atoms.numbers != 1)
    nearest = heavy[np.argmin(atoms.get_all_distances()[np.ix_(hydrogen, heavy)], axis=1)]
    constrain(atoms, Distance(np.stack([nearest, hydrogen], axis=1)))
    draw_velocities(atoms, temperature, rng=np.random.default_rng(0))
    return atoms, calculator, name


def energy_at_equal_evaluations(evaluations: int, time_fs: float) -> list[dict]:
    """Largest deviation of the total energy over the same time with about as many force evaluations."""
    start, calculator, forces = ethanol()
    rows = []
    for stepper in (Rattle(), Suzuki4(), BlanesMoan4(), BlanesMoan6()):
        steps = round(evaluations / stepper.force_evaluations)
        atoms = start.copy()
        atoms.calc = calculator()
        energies: list[float] = []
        dynamics = ConstrainedDynamics(atoms, time_fs / steps * FS, stepper)
        dynamics.attach(lambda atoms=atoms, energies=energies: energies.append(atoms.get_total_energy()))
        dynamics.run(steps)
        rows.append(
            {
                "stepper": repr(stepper),
                "forces": forces,
                "timestep_fs": time_fs / steps,
                "evaluations": steps * stepper.force_evaluations,
                "deviation_ev": float(np.abs(np.array(energies) - energies[0]).max()),
            }
        )
    return rows


# -- cost -------------------------------------------------------------------------------------------


class Clock:
    """Adds up the time that this thread works in functions, without the time it waits for others."""

    def __init__(self) -> None:
        self.seconds, self.calls = 0.0, 0

    def wrap(self, call: Callable) -> Callable:
        def timed(*args, **kwargs):
            start = time.thread_time()
            result = call(*args, **kwargs)
            self.seconds += time.thread_time() - start
            self.calls += 1
            return result

        return timed


def cost_of_a_clock(calls: int = 500) -> tuple[float, float]:
    """What reading the clocks adds to a timed call, and to whatever contains it."""

    def nothing(*args, **kwargs):
        pass

    clock = Clock()
    timed = clock.wrap(nothing)
    seconds = []
    for call in (nothing, timed):
        start = time.thread_time()
        for _ in range(calls):
            call(1, 2, dt=3)
        seconds.append((time.thread_time() - start) / calls)
    return clock.seconds / calls - seconds[0], seconds[1] - seconds[0]


class Timed:
    """One dynamics object: whole steps, and the forces in them."""

    def __init__(self, dynamics: MolecularDynamics) -> None:
        self.dynamics = dynamics
        self.forces, self.projections = Clock(), Clock()
        dynamics.run(3)
        if isinstance(dynamics, ConstrainedDynamics):
            system = dynamics._systems()
            system.force = self.forces.wrap(system.force)

    def sample(self, steps: int, clock: tuple[float, float]) -> tuple[float, float, float]:
        """Seconds a step, in its forces and in its projections, without those of the clocks."""
        self.dynamics.run(2)
        for part in (self.forces, self.projections):
            part.seconds, part.calls = 0.0, 0
        start = time.thread_time()
        self.dynamics.run(steps)
        whole = time.thread_time() - start
        inside, added = clock
        whole -= added * (self.forces.calls + self.projections.calls)
        forces, projections = (part.seconds - inside * part.calls for part in (self.forces, self.projections))
        return whole / steps, forces / steps, projections / steps


class PieceByPiece(Timed):
    """The same with each projection a call of the engine, also where stages of a step are compiled into one call."""

    def __init__(self, dynamics: MolecularDynamics) -> None:
        super().__init__(dynamics)
        system = dynamics._systems()
        system.packed = None
        motion = system.motion
        motion.project_positions = self.projections.wrap(motion.project_positions)
        motion.project_velocities = self.projections.wrap(motion.project_velocities)


def cost(n: int, repeats: int) -> list[dict]:
    """Whole ASE steps of n rigid waters with a calculator that does nothing, taken in turn; CPU time, medians."""

    def ours(stepper: Stepper) -> MolecularDynamics:
        return ConstrainedDynamics(waters(n, 5.0), FS, stepper)

    runs: dict[str, tuple[Timed, ...]] = {
        "VelocityVerlet, nothing held": (Timed(VelocityVerlet(waters(n, 5.0, hold=False), FS)),),
        "VelocityVerlet": (Timed(VelocityVerlet(waters(n, 5.0), FS)),),
    }
    for stepper in (Rattle(), Suzuki4(), BlanesMoan4(), KahanLi6(), BlanesMoan6()):
        runs[f"ConstrainedDynamics, {stepper!r}"] = (Timed(ours(stepper)), PieceByPiece(ours(stepper)))
    samples: dict[str, list[list[float]]] = {name: [] for name in runs}
    for _ in range(repeats):
        clock = tuple(np.median([cost_of_a_clock() for _ in range(5)], axis=0))
        for name, pair in runs.items():
            whole, forces, _ = pair[0].sample(3, clock)
            row = [whole]
            if len(pair) > 1:
                projections = pair[1].sample(3, clock)[2]
                # Forces of the same object: they vary by more than all of the rest.
                row += [forces, projections, whole / (forces + 1.3 * projections)]
            samples[name].append(row)
    rows = []
    for name, found in samples.items():
        middle = [float(t) for t in np.median(found, axis=0)]
        rows.append({"waters": n, "dynamics": name, "step_us": 1e6 * middle[0]})
        if len(middle) > 1:
            rows[-1] |= {"forces_us": 1e6 * middle[1], "projections_us": 1e6 * middle[2], "ratio": middle[3]}
    return rows


# -- statistics -------------------------------------------------------------------------------------


def _mean_and_error(values: list[float], skip: int, blocks: int = 20) -> tuple[float, float]:
    kept = np.array(values[skip:])
    means = kept[len(kept) % blocks :].reshape(blocks, -1).mean(axis=1)
    return float(means.mean()), float(means.std(ddof=1) / np.sqrt(blocks))


def statistics(steps: int) -> list[dict]:
    """Temperature of rigid CO under ASE's thermostats, and the pressure of rigid water."""
    rows = []
    thermostats = {
        "Langevin": lambda a, rng: Langevin(a, 2 * FS, temperature_K=300, friction=0.05 / FS, fixcm=False, rng=rng),
        "Bussi": lambda a, rng: Bussi(a, 2 * FS, 300, 10 * FS, rng=rng),
        "Andersen, all drawn": lambda a, rng: Andersen(a, FS, 300, 1.0, fixcm=False, rng=rng),
    }
    for name, make in thermostats.items():
        atoms = dumbbells(60)
        seen: list[float] = []
        dynamics = make(atoms, np.random.default_rng(1))
        dynamics.attach(lambda atoms=atoms, seen=seen: seen.append(atoms.get_temperature()))
        dynamics.run(steps)
        mean, error = _mean_and_error(seen, steps // 100)
        rows.append({"what": f"{name}: temperature of 60 CO, K", "expected": 300.0, "mean": mean, "error": error})
    atoms = waters(27, 8.0, periodic=True)
    dynamics = Langevin(atoms, FS, temperature_K=300, friction=0.02 / FS, fixcm=False, rng=np.random.default_rng(5))
    pressures: list[float] = []
    dynamics.attach(lambda: pressures.append(-atoms.get_stress(include_ideal_gas=True)[:3].mean() / BAR), interval=5)
    dynamics.run(steps)
    mean, error = _mean_and_error(pressures, len(pressures) // 100)
    expected = 27 * units.kB * 300 / atoms.get_volume() / BAR
    rows.append(
        {"what": "Langevin: pressure of 27 free waters, bar", "expected": expected, "mean": mean, "error": error}
    )
    return rows


# -- all of it --------------------------------------------------------------------------------------


def part(name: str, measure: Callable[[], list[dict]]) -> Iterator[dict[str, Any]]:
    yield from ({"part": name, **row} for row in measure())


def pieces(chosen: argparse.Namespace) -> dict[str, Any]:
    full = not chosen.quick
    found = {
        f"cost, {n} waters": ("cost", partial(cost, n, 101 if full else 5))
        for n in ((10, 100, 1000) if full else (10,))
    }
    found["far"] = ("far", partial(far_from_the_origin, 1000 if full else 50))
    found["energy"] = ("energy", partial(energy_at_equal_evaluations, *((960, 480.0) if full else (48, 24.0))))
    found["statistics"] = ("statistics", partial(statistics, 40_000 if full else 200))
    return {name: partial(part, *work) for name, work in found.items()}


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    times = {"step_us": "{:.0f}", "forces_us": "{:.0f}", "projections_us": "{:.0f}", "ratio": "{:.2f}"}
    return {
        "Microseconds a step, median": harness.shown(table, "cost", waters="{:.0f}", dynamics="{}", **times),
        "Kinetic energy lost by a free rigid CO (relative)": harness.shown(
            table, "far", timestep_fs="{:.2f}", distance="{:.0e}", ase="{:.1e}", kcons="{:.1e}"
        ),
        "Ethanol, X-H bonds held: largest deviation of the total energy": harness.shown(
            table,
            "energy",
            forces="{}",
            stepper="{}",
            timestep_fs="{:.2f}",
            evaluations="{:.0f}",
            deviation_ev="{:.1e}",
        ),
        "Statistics under ASE's thermostats": harness.shown(
            table, "statistics", what="{}", expected="{:.2f}", mean="{:.2f}", error="{:.2f}"
        ),
    }


def main() -> None:
    harness.main("ase_dynamics", harness.options(__doc__, "ase-dynamics"), pieces, tables)


if __name__ == "__main__":
    main()
