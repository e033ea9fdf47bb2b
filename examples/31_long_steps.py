"""Long time steps: slow forces evaluated rarely, under Langevin dynamics with several time steps and on spheres.

    python examples/31_long_steps.py                   some seconds: a small system, a step in words
    python examples/31_long_steps.py --small           the same against Metropolis, into docs/results, ten minutes
    python examples/31_long_steps.py --full FOLDER     64 rigid TIP3P waters, hours; goes on where it was stopped
    python examples/31_long_steps.py --collect FOLDER  what its runs have shown so far, into docs/results
    python examples/31_long_steps.py --cost            processor time of baths and bookkeeping, into docs/results
    python examples/31_long_steps.py --show FILE       the tables of a file of results

In water the fast forces are those between molecules whose oxygens are near, switched off from 4 to 6 angstrom; the slow
ones are what particle-mesh Ewald is more. Inner steps are 4 fs.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
from ase import units

from kcons import ConstraintSet, Motion, State, System, run
from kcons.comparison import environment, json_files, test_systems
from kcons.constraints import Distance
from kcons.errors import KconsError
from kcons.steppers import Geodesic, Stepper
from kcons.thermostats import (
    Estimate,
    ForceGroups,
    IsokineticSpheres,
    Langevin,
    LangevinRespa,
    TemperatureSplit,
    evaluations_per_sample,
    mean,
    thermal_velocities,
)

RESULT = Path(__file__).parents[1] / "docs" / "results" / "long_steps.json"


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


# -- water ----------------------------------------------------------------------------------------------

KT = 300 * units.kB
KJ = units.kJ / units.mol
COULOMB, SIGMA, EPSILON = 1389.35456 * KJ, 3.15061, 0.1521 * units.kcal / units.mol
CHARGES = np.array([-0.834, 0.417, 0.417])
#: How long each turn of a method is, what is thrown away at the start, and the time between two frames, in ps.
TURN, SKIPPED, FRAME = 60.096, 12.0, 0.192


@numba.njit(nogil=True)
def near_forces(x, box, inner, outer, screen, coulomb, charges, sigma, epsilon):  # type: ignore[no-untyped-def]
    """Forces of molecule pairs, switched off while oxygens part from `inner` to `outer`.

    With `screen` their charges feel the reaction field of a conductor beyond `outer`.
    """
    n = len(x) // 3
    f = np.zeros_like(x)
    shift = np.empty(3)
    r = np.empty(3)
    for a in range(n):
        for b in range(a + 1, n):
            far = 0.0
            for k in range(3):
                d = x[3 * a, k] - x[3 * b, k]
                shift[k] = box * np.rint(d / box)
                d -= shift[k]
                far += d * d
            if far >= outer * outer:
                continue
            far = math.sqrt(far)
            t = min(max((far - inner) / (outer - inner), 0.0), 1.0)
            keep = 1.0 + t * t * t * (-10.0 + t * (15.0 - 6.0 * t))
            slope = -30.0 * t * t * (1.0 - t) * (1.0 - t) / (outer - inner)
            energy = 0.0
            for i in range(3):
                for j in range(3):
                    square = 0.0
                    for k in range(3):
                        r[k] = x[3 * a + i, k] - x[3 * b + j, k] - shift[k]
                        square += r[k] * r[k]
                    distance = math.sqrt(square)
                    strength = coulomb * charges[i] * charges[j]
                    e = strength / distance
                    push = e / square
                    if screen:
                        e += strength * (0.5 * square / outer**3 - 1.5 / outer)
                        push -= strength / outer**3
                    if i == 0 and j == 0:
                        six = (sigma * sigma / square) ** 3
                        e += 4 * epsilon * six * (six - 1.0)
                        push += 24 * epsilon * six * (2 * six - 1.0) / square
                    energy += e
                    for k in range(3):
                        f[3 * a + i, k] += keep * push * r[k]
                        f[3 * b + j, k] -= keep * push * r[k]
            for k in range(3):
                d = x[3 * a, k] - x[3 * b, k] - shift[k]
                f[3 * a, k] -= energy * slope * d / far
                f[3 * b, k] += energy * slope * d / far
    return f


class BathInTheMiddle(IsokineticSpheres):
    """The bath acts once, in the middle of the large step, for all of it."""

    def operations(self, system: System | None = None) -> tuple[Any, ...]:
        done = super().operations(system)
        places = [k for k, operation in enumerate(done) if operation.verb == "exchange"]
        n = len(places)
        # Between two inner steps, after the evaluation and the kick that end the first of them.
        at = places[n // 2] if n % 2 else places[n // 2 - 1] + 5
        before, after = ([o for o in part if o.verb != "exchange"] for part in (done[:at], done[at:]))
        return (*before, replace(done[places[0]], fraction=1.0), *after)


@dataclass(frozen=True)
class Method:
    """One way to run water: a bath, its friction in 1/ps, steps in fs; `halfway`: looked at between slow kicks."""

    bath: str
    friction: float
    outer: float
    inner: float = 4.0
    order: int = 2
    auxiliary: int = 1
    substeps: int = 3
    switch: tuple[float, float] = (4.0, 6.0)
    screen: bool = False
    middle: bool = False
    halfway: bool = False

    @property
    def name(self) -> str:
        text = f"{self.bath} {self.friction:g}/ps, {self.outer:g} fs"
        usual = Method(self.bath, self.friction, self.outer)
        for key in ("inner", "order", "auxiliary", "substeps", "switch", "screen", "middle"):
            if getattr(self, key) != getattr(usual, key):
                text += f", {key} {getattr(self, key)}"
        return text + (", halfway" if self.halfway else "")

    @property
    def file(self) -> str:
        return "".join(c if c.isalnum() or c in ".-" else "_" for c in self.name)

    def stepper(self) -> Stepper:
        friction = self.friction / (1000 * units.fs)
        if self.bath == "plain":
            return Langevin(KT, friction, 1)
        steps = {"slow": 1, "fast": round(self.outer / self.inner)}
        own = {"steps": steps, "order": self.order, "substeps": self.substeps}
        own["slow_kicks"] = "middle" if self.halfway else "ends"
        if self.bath == "langevin":
            return LangevinRespa(KT, friction, 1, **own)  # type: ignore[arg-type]
        kind = BathInTheMiddle if self.middle else IsokineticSpheres
        return kind(KT, friction, 1, spheres=self.bath, auxiliary=self.auxiliary, **own)  # type: ignore[arg-type]


class Water:
    """64 rigid TIP3P waters, their forces by groups, and their energy."""

    def __init__(self, method: Method, size: int = 64) -> None:
        scene = test_systems.build("water", size=size)
        self.box = float(scene.cell[0])
        self.potential = scene.potential
        self.motion = scene.motion

        def near(x: np.ndarray, time: float) -> np.ndarray:
            given = (self.box, *method.switch, method.screen, COULOMB, CHARGES, SIGMA, EPSILON)
            return near_forces(np.array(x), *given)

        force: Any = self.potential.forces
        if method.bath != "plain":
            force = ForceGroups.difference(near, self.potential.forces)
        self.system = System(self.motion, force)
        self.start = self.system.initial_state(
            scene.positions, thermal_velocities(self.system, scene.positions, KT, np.random.default_rng(7))
        )


#: What is run; the first is the reference.
METHODS = (
    Method("plain", 5, 2),
    Method("langevin", 5, 12),
    Method("langevin", 5, 16),
    Method("langevin", 20, 16),
    Method("langevin", 5, 24),
    Method("langevin", 20, 24),
    Method("langevin", 2, 16, halfway=True),
    Method("langevin", 5, 16, halfway=True),
    Method("langevin", 20, 16, halfway=True),
    Method("langevin", 5, 20, inner=5, halfway=True),
    Method("langevin", 20, 20, inner=5, halfway=True),
    Method("langevin", 20, 24, halfway=True),
    Method("cluster", 5, 32),
    Method("split", 5, 16),
    Method("split", 5, 24),
    Method("split", 5, 32),
    Method("split", 5, 48),
    Method("split", 10, 64),
    Method("split", 20, 24),
    Method("split", 20, 32),
    Method("split", 20, 64),
    Method("split", 20, 32, auxiliary=0),
    Method("split", 20, 48, auxiliary=0),
    Method("split", 20, 64, auxiliary=0),
    Method("split", 5, 16, halfway=True),
    Method("split", 5, 24, halfway=True),
    Method("split", 5, 32, halfway=True),
    Method("split", 5, 48, halfway=True),
    Method("split", 20, 24, halfway=True),
    Method("split", 20, 32, halfway=True),
    Method("split", 20, 48, halfway=True),
    Method("split", 20, 64, halfway=True),
    Method("split", 20, 32, auxiliary=0, halfway=True),
    Method("split", 20, 64, auxiliary=0, halfway=True),
)
#: What was tried besides to lower the bias at long steps.
TRIED = (
    Method("split", 5, 24, auxiliary=0),
    Method("split", 5, 32, auxiliary=0),
    Method("split", 5, 32, auxiliary=4),
    Method("split", 5, 32, inner=2),
    Method("split", 5, 32, order=4),
    Method("split", 5, 32, substeps=1),
    Method("axes", 5, 32),
    Method("split", 5, 32, screen=True),
    Method("split", 5, 32, switch=(3.5, 6.2), screen=True),
    Method("langevin", 5, 16, screen=True),
    Method("split", 10, 64, screen=True),
    Method("split", 20, 32, middle=True),
    Method("split", 20, 64, middle=True),
    Method("split", 20, 64, auxiliary=0, middle=True),
)


def advance(method: Method, folder: Path, turn: float = TURN) -> float:
    """Run a method for one more turn; the time it has reached in ps."""
    water = Water(method)
    at, kept = folder / f"{method.file}.state.npz", folder / f"{method.file}.frames.npz"
    state = State.load(at) if at.exists() else water.start
    old = dict(np.load(kept)) if kept.exists() else {"x": np.zeros((0, *state.positions.shape), np.float32), "u": []}
    frames, energies = [], []

    def look(now: State) -> None:
        if now.step != state.step:
            frames.append(now.positions.astype(np.float32))
            energies.append(water.potential.watched_energy(now.positions) / KJ / 64)

    dt = method.outer * units.fs
    steps = round(turn * 1000 / method.outer)
    every = max(1, round(FRAME * 1000 / method.outer))
    steps -= steps % every
    spent = time.process_time()
    try:
        end = run(water.system, state, dt, steps, stepper=method.stepper(), observers=[look], every=every)
    except KconsError as error:  # a method that fails is a result, and the others go on
        np.savez(kept, **{**old, "failed": np.array(str(error)[:200])})
        return -1.0
    spent = time.process_time() - spent
    seconds = np.append(old.get("seconds", []), spent)
    x, u = np.concatenate([old["x"], frames]), np.append(old["u"], energies)
    np.savez(kept, x=x.astype(np.float32), u=u, seconds=seconds, every=np.array(every))
    end.save(at)
    return end.step * method.outer / 1000


def full(folder: Path, methods: tuple[Method, ...], hours: float) -> None:
    """All methods in turns, until the time is up."""
    folder.mkdir(parents=True, exist_ok=True)
    begun, failed = time.monotonic(), set()
    while time.monotonic() - begun < 3600 * hours:
        for method in methods:
            if method in failed or time.monotonic() - begun > 3600 * hours:
                continue
            reached = advance(method, folder)
            if reached < 0:
                failed.add(method)
            print(f"{time.monotonic() - begun:6.0f} s  {method.name}: {reached:.0f} ps", flush=True)


# -- what is measured of water --------------------------------------------------------------------------


def first_peak(frames: np.ndarray, box: float) -> float:
    """Height of the first peak of the pair distribution of oxygens."""
    edges = np.linspace(2.4, 3.3, 31)
    counts = np.zeros(30)
    pairs = np.triu_indices(frames.shape[1] // 3, 1)
    for x in frames[:: max(1, len(frames) // 1000)].astype(float):
        o = x[::3]
        d = o[pairs[0]] - o[pairs[1]]
        d -= box * np.rint(d / box)
        counts += np.histogram(np.sqrt((d * d).sum(axis=1)), edges)[0]
    shells = 4 / 3 * np.pi * np.diff(edges**3)
    used = len(frames[:: max(1, len(frames) // 1000)])
    g = counts / used / (len(pairs[0]) * shells / box**3)
    return float(np.convolve(g, np.ones(3) / 3, "valid").max())


def dipole_time(frames: np.ndarray, gap: float) -> float:
    """How long a molecule's dipole remembers its direction (to 1/e), in units of `gap`."""
    x = frames.reshape(len(frames), -1, 3, 3).astype(float)
    u = x[:, :, 1] + x[:, :, 2] - 2 * x[:, :, 0]
    u /= np.linalg.norm(u, axis=2)[..., None]
    last = 1.0
    for lag in range(1, len(u) // 3):
        now = float((u[:-lag] * u[lag:]).sum(axis=2).mean())
        if now < 1 / math.e:
            return gap * (lag - (1 / math.e - now) / (last - now))
        last = now
    return math.nan


def summary(method: Method, folder: Path, samples: int) -> dict[str, Any] | None:
    """What the frames of one method say, None where there are too few."""
    file = folder / f"{method.file}.frames.npz"
    if not file.exists():
        return None
    kept = dict(np.load(file))
    gap = method.outer * float(kept["every"]) / 1000
    skip = round(SKIPPED / gap)
    frames, u = kept["x"][skip:], kept["u"][skip:]
    if len(u) < 64:
        return None
    water = Water(method)
    forces = System(water.motion, water.potential.forces)
    split = TemperatureSplit(forces, seed=1, displacement=0.005)
    every = max(1, len(frames) // samples)
    for x in frames[::every]:
        split.add(water.motion.restore_positions(x.astype(float)))
    found = split.result()
    assert found.shift is not None and found.turn is not None
    slow = 1000 / method.outer
    turning = dipole_time(frames, gap)
    row = {
        **{name: getattr(method, name) for name in ("bath", "friction", "outer", "inner", "order", "auxiliary")},
        **{name: getattr(method, name) for name in ("substeps", "switch", "screen", "middle", "halfway")},
        "name": method.name,
        "ps": len(u) * gap,
        "energy": list(mean(u)),
        "shift": [t / KT for t in found.shift],
        "turn": [t / KT for t in found.turn],
        "peak": first_peak(frames, water.box),
        "dipole_ps": turning,
        "slow_per_ps": slow,
        "slow_per_sample": evaluations_per_sample(u, slow * gap),
        "slow_per_turning": slow * turning,
    }
    return row


def collect(folder: Path, samples: int) -> list[dict[str, Any]]:
    """All methods, their energies beside that of the first."""
    rows = [row for method in (*METHODS, *TRIED) if (row := summary(method, folder, samples)) is not None]
    known = rows[0]["energy"]
    for row in rows:
        value, error = row["energy"]
        row["bias"] = [100 * (value - known[0]) / abs(known[0]), 100 * math.hypot(error, known[1]) / abs(known[0])]
    return rows


def show_water(result: dict[str, Any]) -> str:
    """Averages beside the reference, and what they cost."""
    head = f"{'bath, friction, step':52s}{'slow/ps':>8s}{'ps':>6s}{'U, kJ/mol':>13s}{'off, %':>12s}{'T shift':>12s}"
    head += f"{'T turn':>12s}{'g max':>7s}{'tau/ps':>7s}{'slow/tau':>9s}{'slow/U':>7s}"
    lines = [head]
    for row in result["water"]:
        cells = f"{row['name']:52s}{row['slow_per_ps']:8.0f}{row['ps']:6.0f}"
        cells += f"{row['energy'][0]:8.2f}({row['energy'][1]:.2f}){row['bias'][0]:+7.2f}({row['bias'][1]:.2f})"
        for kind in ("shift", "turn"):
            cells += f"{300 * row[kind][0]:7.1f}({300 * row[kind][1]:.1f})"
        cells += f"{row['peak']:7.2f}{row['dipole_ps']:7.1f}{row['slow_per_turning']:9.0f}{row['slow_per_sample']:7.0f}"
        lines.append(cells)
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
    scene = test_systems.build("water", size=64)
    zero = np.zeros_like(scene.positions)
    plain = System(scene.motion, lambda x, t: zero)
    groups = System(scene.motion, ForceGroups({"slow": lambda x, t: zero, "fast": lambda x, t: 1.0 * zero}))
    start = plain.initial_state(
        scene.positions, thermal_velocities(plain, scene.positions, KT, np.random.default_rng(7))
    )
    four = {"slow": 1, "fast": 4}
    cases: dict[str, tuple[System, Any, int]] = {
        "constant energy": (plain, Stepwise(3), 1),
        "Langevin, 4 small steps": (groups, LangevinRespa(KT, 0.05, 1, steps=four), 4),
        "split spheres, 4 small steps": (groups, IsokineticSpheres(KT, 0.05, 1, steps=four), 4),
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
    result = small(1500, 300, (("split", 1, 64, False),))
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
    parser.add_argument("--full", type=Path, metavar="FOLDER")
    parser.add_argument("--collect", type=Path, metavar="FOLDER")
    parser.add_argument("--show", type=Path, metavar="FILE")
    parser.add_argument("--tried", action="store_true", help="with --full: also what was tried besides")
    parser.add_argument("--hours", type=float, default=8.0, help="with --full: when to stop")
    parser.add_argument("--samples", type=int, default=300, help="with --collect: frames for temperatures")
    given = parser.parse_args()
    if given.show:
        result = json_files.read(given.show)
        print(show_small(result["small"]), show_water(result), show_cost(result["cost"]), sep="\n\n")
    elif given.full:
        full(given.full, (*METHODS, *TRIED) if given.tried else METHODS, given.hours)
    elif given.collect:
        print(show_water(keep("water", collect(given.collect, given.samples))))
    elif given.small:
        print(show_small(keep("small", small(20_000, 8_000))["small"]))
    elif given.cost:
        print(show_cost(keep("cost", cost())["cost"]))
    else:
        quick()


if __name__ == "__main__":
    main()
