"""Isokinetic spheres and Langevin dynamics with several time steps on a small system, and what baths cost.

    python long_steps.py                   some seconds: a small system, a step in words
    python long_steps.py --small           the same against Metropolis, into docs/results, ten minutes
    python long_steps.py --cost            processor time of baths and bookkeeping, into docs/results
    python long_steps.py --show FILE       the tables of a file of results

Water under slow forces that are evaluated rarely: examples/studies/long_steps_water.py.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from ase import units

from kcons import ConstraintSet, Motion, State, System, run
from kcons.comparison import environment, json_files, test_systems
from kcons.constraints import Distance
from kcons.steppers import Geodesic
from kcons.thermostats import (
    Estimate,
    ForceGroups,
    IsokineticSpheres,
    LangevinRespa,
    evaluations_per_sample,
    mean,
    thermal_velocities,
)

RESULT = Path(__file__).parents[2] / "docs" / "results" / "long_steps.json"


# -- a small system, against Metropolis -----------------------------------------------------------------

#: A dumbbell, a chain of three with a free angle, and a light atom on a stiff spring to the dumbbell; k_B T = 1.
ONE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 1], [0, 0, 1], [1, 0, 1], [1.0, 0.8, 0]])
MASSES = np.array([4.0, 3.0, 5.0, 4.0, 3.0, 1.0])
BONDS = np.array([[0, 1], [2, 3], [3, 4]])
TRAP = np.array([1.5, 2.0, 2.5, 1.0, 1.5, 0.5])
SPRING, REST, ENDS, APART, PUSH = 40.0, 0.8, 6.0, 1.2, 4.0
OBSERVABLES = ("trap", "spring", "ends", "pushes", "cos angle", "r^2 light")


def slow_forces(x: np.ndarray, time: float = 0.0) -> np.ndarray:
    """Trap, spring between the ends of the chain, and soft pushes of dumbbell and chain; six atoms a copy."""
    y = x.reshape(-1, 6, 3)
    f = -TRAP[:, None] * y
    d = y[:, 2] - y[:, 4]
    r = np.sqrt((d * d).sum(axis=1))[:, None]
    f[:, 2] -= ENDS * (r - APART) / r * d
    f[:, 4] += ENDS * (r - APART) / r * d
    d = y[:, :2, None] - y[:, None, 2:5]
    push = PUSH * np.exp(-0.5 * (d * d).sum(axis=-1))[..., None] * d
    f[:, :2] += push.sum(axis=2)
    f[:, 2:5] -= push.sum(axis=1)
    return f.reshape(-1, 3)


def fast_forces(x: np.ndarray, time: float = 0.0) -> np.ndarray:
    """The stiff spring."""
    y = x.reshape(-1, 6, 3)
    f = np.zeros_like(y)
    d = y[:, 5] - y[:, 1]
    r = np.sqrt((d * d).sum(axis=1))[:, None]
    f[:, 1] = SPRING * (r - REST) / r * d
    f[:, 5] = -f[:, 1]
    return f.reshape(-1, 3)


def observed(x: np.ndarray) -> np.ndarray:
    """The observables of each copy, energies first, shape (copies, 6)."""
    y = x.reshape(-1, 6, 3)
    spring, ends = (np.linalg.norm(y[:, i] - y[:, j], axis=1) for i, j in ((5, 1), (2, 4)))
    d = y[:, :2, None] - y[:, None, 2:5]
    return np.stack(
        [
            0.5 * ((y * y).sum(axis=2) @ TRAP),
            0.5 * SPRING * (spring - REST) ** 2,
            0.5 * ENDS * (ends - APART) ** 2,
            PUSH * np.exp(-0.5 * (d * d).sum(axis=-1)).sum(axis=(1, 2)),
            ((y[:, 2] - y[:, 3]) * (y[:, 4] - y[:, 3])).sum(axis=1),
            (y[:, 5] ** 2).sum(axis=1),
        ],
        axis=1,
    )


def log_weight(seen: np.ndarray) -> np.ndarray:
    """-U + log sqrt(det Z); Z is that of the chain's bonds, for the dumbbell's is a constant."""
    _, _, first, middle, last, _ = 1 / MASSES
    return 0.5 * np.log((first + middle) * (middle + last) - (middle * seen[:, 4]) ** 2) - seen[:, :4].sum(axis=1)


def metropolis(walkers: int, rounds: int) -> list[Estimate]:
    """Averages over random walks over places and directions."""
    rng = np.random.default_rng(11)
    x = np.tile(ONE, (walkers, 1, 1))
    seen = observed(x)
    weight = log_weight(seen)
    means = []
    for turn in range(rounds):
        for atoms, base in (([5], None), ([0, 1], None), ([2, 3, 4], None), ([1], 0), ([2], 3), ([4], 3)):
            y = x.copy()
            y[:, atoms] += 0.5 * rng.normal(size=(walkers, 1, 3))
            if base is not None:
                d = y[:, atoms[0]] - y[:, base]
                y[:, atoms[0]] = y[:, base] + d / np.linalg.norm(d, axis=1)[:, None]
            new = observed(y)
            weighed = log_weight(new)
            taken = np.log(rng.random(walkers)) < weighed - weight
            x[taken], seen[taken], weight[taken] = y[taken], new[taken], weighed[taken]
        if turn >= rounds // 20:
            means.append(seen.mean(axis=0))
    return [mean(values) for values in np.array(means).T]


def copies_of(n: int) -> tuple[System, State]:
    """n small systems that know nothing of each other."""
    x = np.tile(ONE, (n, 1))
    rows = (6 * np.arange(n)[:, None, None] + BONDS).reshape(-1, 2)
    motion = Motion(ConstraintSet([Distance(rows, np.ones(len(rows)))], x, np.tile(MASSES, n)), x)
    system = System(motion, ForceGroups({"slow": slow_forces, "fast": fast_forces}))
    return system, system.initial_state(x, thermal_velocities(system, x, 1.0, np.random.default_rng(5)))


#: Spheres, auxiliary variables, copies in one system, and whether the radius is wrong: g + L instead of g + L - 1.
SMALL: tuple[tuple[Any, int, int, bool], ...] = (
    ("split", 1, 64, False),
    ("split", 0, 64, False),
    ("split", 2, 64, False),
    ("split", 4, 64, False),
    ("axes", 1, 64, False),
    ("cluster", 1, 64, False),
    ("cluster", 4, 64, False),
    ("global", 1, 8, False),
    ("split", 1, 64, True),
    ("cluster", 1, 64, True),
)


def small_run(kind: Any, auxiliary: int, copies: int, wrong: bool, steps: int) -> list[Estimate]:
    """Averages of the observables."""
    system, state = copies_of(copies)
    bath = IsokineticSpheres(1.0, 1.0, 3, steps={"slow": 1, "fast": 2}, spheres=kind, auxiliary=auxiliary)
    if wrong:
        g = bath.layout(system, state.positions).freedom
        bath.radii(system, state.positions)[...] *= (g + auxiliary) / (g + auxiliary - 1)
    series: list[np.ndarray] = []
    state = run(system, state, 0.02, 500 + steps // 10, stepper=bath)
    look = [lambda now: series.append(observed(now.positions).mean(axis=0))]
    run(system, state, 0.02, steps, stepper=bath, observers=look, every=5)
    return [mean(values) for values in np.array(series).T]


def small(steps: int, rounds: int, choices: tuple[tuple[Any, int, int, bool], ...] = SMALL) -> dict[str, Any]:
    """Choices of spheres beside Metropolis."""
    known = metropolis(1000, rounds)
    runs = []
    for kind, auxiliary, copies, wrong in choices:
        # Fewer copies take more steps.
        count = steps if copies == 64 else 4 * steps
        found = small_run(kind, auxiliary, copies, wrong, count)
        off = [e.off(*k) for e, k in zip(found, known, strict=True)]
        runs.append({"spheres": kind, "auxiliary": auxiliary, "copies": copies, "wrong": wrong, "steps": count})
        runs[-1] |= {"averages": [list(e) for e in found], "off": off}
    return {"observables": OBSERVABLES, "rounds": rounds, "metropolis": [list(e) for e in known], "runs": runs}


def show_small(result: dict[str, Any]) -> str:
    """Averages, with their distance from Metropolis in standard errors."""
    lines = ["averages (distance from Metropolis in standard errors)"]
    lines.append(f"{'':26s}" + "".join(f"{name:>15s}" for name in result["observables"]))
    lines.append(f"{'Metropolis':26s}" + "".join(f"{value:9.4f}({error:.4f})" for value, error in result["metropolis"]))
    for run_ in result["runs"]:
        name = f"{run_['spheres']}, L = {run_['auxiliary']}" + (", wrong radius" if run_["wrong"] else "")
        cells = zip(run_["averages"], run_["off"], strict=True)
        lines.append(f"{name:26s}" + "".join(f"{value:8.4f}({off:+5.1f})" for (value, _), off in cells))
    return "\n".join(lines)


# -- what baths cost ------------------------------------------------------------------------------------


class Stepwise:
    """Geodesic flights with as many drifts as a small step of the baths has, made one step at a time as these are."""

    def __init__(self, substeps: int) -> None:
        self.inner = Geodesic(2 * substeps)

    def check(self, system: System) -> None:
        self.inner.check(system)

    def step(self, system: System, state: State, dt: float) -> State:
        return self.inner.step(system, state, dt)


def cost(repeats: int = 15, steps: int = 200) -> dict[str, Any]:
    """Processor time of a small step in microseconds, in paired turns, with forces that take none."""
    scene, kt = test_systems.build("water", size=64), 300 * units.kB
    zero = np.zeros_like(scene.positions)
    plain = System(scene.motion, lambda x, t: zero)
    groups = System(scene.motion, ForceGroups({"slow": lambda x, t: zero, "fast": lambda x, t: 1.0 * zero}))
    start = plain.initial_state(
        scene.positions, thermal_velocities(plain, scene.positions, kt, np.random.default_rng(7))
    )
    four = {"slow": 1, "fast": 4}
    cases: dict[str, tuple[System, Any, int]] = {
        "constant energy": (plain, Stepwise(3), 1),
        "Langevin, 4 small steps": (groups, LangevinRespa(kt, 0.05, 1, steps=four), 4),
        "split spheres, 4 small steps": (groups, IsokineticSpheres(kt, 0.05, 1, steps=four), 4),
    }
    spent: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(repeats):
        for name, (system, stepper, small_steps) in cases.items():
            begun = time.process_time()
            run(system, start, small_steps * units.fs, steps // small_steps, stepper=stepper, check_every=0)
            spent[name].append(1e6 * (time.process_time() - begun) / steps)
    found = {name: float(np.median(times)) for name, times in spent.items()}
    # Differences within each turn: the machine may be busy.
    base = np.array(spent["constant energy"])
    over = {name: float(np.median(np.array(times) - base)) for name, times in spent.items()}
    return {"molecules": 64, "repeats": repeats, "small_step_us": found, "over_constant_energy_us": over}


def show_cost(result: dict[str, Any]) -> str:
    """Of a small step with forces of 1 ms."""
    lines = [f"{result['molecules']} waters, processor time of a small step without forces"]
    for name, value in result["small_step_us"].items():
        over = result["over_constant_energy_us"][name]
        lines.append(f"{name:30s}{value:7.0f} us, {over / 10:5.1f} % of 1 ms over constant energy")
    return "\n".join(lines)


# -- the command ----------------------------------------------------------------------------------------


def quick() -> None:
    """A step in words, and a short run of each kind."""
    print(IsokineticSpheres(1.0, 1.0, 3, steps={"slow": 1, "fast": 2}).listing())
    result = small(600, 150, (("split", 1, 64, False),))
    print(show_small(result))
    system, state = copies_of(64)
    energies: list[float] = []
    stepper = LangevinRespa(1.0, 1.0, 3, steps={"slow": 1, "fast": 2})
    look = [lambda now: energies.append(observed(now.positions)[:, :4].sum(axis=1).mean())]
    run(system, state, 0.04, 400, stepper=stepper, observers=look, every=4)
    evaluations = system.force.evaluations  # type: ignore[union-attr]
    print(f"{stepper!r}: {evaluations}, {evaluations_per_sample(energies, 4):.0f} slow evaluations for one sample of U")


def keep(part: str, found: Any) -> dict[str, Any]:
    """Put a part into the file of results."""
    result = json_files.read(RESULT) if RESULT.exists() else {}
    result |= {part: found, "environment": environment()}
    json_files.write(RESULT, result)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--cost", action="store_true")
    parser.add_argument("--show", type=Path, metavar="FILE")
    given = parser.parse_args()
    if given.show:
        result = json_files.read(given.show)
        print(show_small(result["small"]), show_cost(result["cost"]), sep="\n\n")
    elif given.small:
        print(show_small(keep("small", small(20_000, 8_000))["small"]))
    elif given.cost:
        print(show_cost(keep("cost", cost())["cost"]))
    else:
        quick()


if __name__ == "__main__":
    main()
