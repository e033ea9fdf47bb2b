"""Rigid water in long steps: slow forces evaluated rarely, under Langevin dynamics and on isokinetic spheres.

    python long_steps_water.py                   seconds: one method, some steps of 8 waters
    python long_steps_water.py --full FOLDER     64 rigid TIP3P waters, hours; goes on where it was stopped
    python long_steps_water.py --collect FOLDER  what its runs have shown so far, into docs/results
    python long_steps_water.py --fresh           energies on spheres with other seeds, into docs/results
    python long_steps_water.py --show FILE       the table of a file of results

The fast forces are those between molecules whose oxygens are near, switched off from 4 to 6 angstrom; the slow ones are
what particle-mesh Ewald is more. Inner steps are 4 fs.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numba
import numpy as np
from ase import units

from kcons import State, System, run
from kcons.comparison import environment, json_files, test_systems
from kcons.errors import KconsError
from kcons.steppers import Stepper
from kcons.thermostats import (
    ForceGroups,
    IsokineticSpheres,
    Langevin,
    LangevinRespa,
    TemperatureSplit,
    evaluations_per_sample,
    mean,
    thermal_velocities,
)

RESULT = Path(__file__).parents[2] / "docs" / "results" / "long_steps.json"


# -- water ----------------------------------------------------------------------------------------------

KT = 300 * units.kB
KJ = units.kJ / units.mol
COULOMB, SIGMA, EPSILON = 1389.35456 * KJ, 3.15061, 0.1521 * units.kcal / units.mol
CHARGES = np.array([-0.834, 0.417, 0.417])
#: Waters of the short run.
QUICK = 27
#: How long each turn of a method is, what is thrown away at the start, and the time between two frames, in ps.
TURN, SKIPPED, FRAME = 60.096, 12.0, 0.192


@numba.njit(nogil=True)
def near_forces(x, box, inner, outer, screen, damp, coulomb, charges, sigma, epsilon):  # type: ignore[no-untyped-def]
    """Forces of molecule pairs, switched off while oxygens part from `inner` to `outer`.

    With `screen` their charges feel the reaction field of a conductor beyond `outer`; with `damp`, in 1/angstrom, they
    act as in the direct part of an Ewald sum.
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
                    if damp > 0:
                        e *= math.erfc(damp * distance)
                        push = e + strength * 2 * damp / math.sqrt(math.pi) * math.exp(-((damp * distance) ** 2))
                        push /= square
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
    damp: float = 0.0
    seed: int = 1
    waters: int = 64
    #: What the name tells where it is unusual.
    NAMED: ClassVar = ("inner", "order", "auxiliary", "substeps", "switch", "screen", "damp", "middle", "seed")

    @property
    def name(self) -> str:
        text = f"{self.bath} {self.friction:g}/ps, {self.outer:g} fs"
        usual = type(self)(self.bath, self.friction, self.outer)
        for key in self.NAMED:
            if getattr(self, key) != getattr(usual, key):
                text += f", {key} {getattr(self, key)}"
        return text + (", halfway" if self.halfway else "")

    @property
    def file(self) -> str:
        return "".join(c if c.isalnum() or c in ".-" else "_" for c in self.name)

    def near(self, box: float) -> Callable[[np.ndarray, float], np.ndarray]:
        """The fast forces."""
        given = (box, *self.switch, self.screen, self.damp, COULOMB, CHARGES, SIGMA, EPSILON)
        return lambda x, time: near_forces(np.array(x), *given)

    def stepper(self) -> Stepper:
        friction = self.friction / (1000 * units.fs)
        if self.bath == "plain":
            return Langevin(KT, friction, self.seed)
        steps = {"slow": 1, "fast": round(self.outer / self.inner)}
        own = {"steps": steps, "order": self.order, "substeps": self.substeps}
        own["slow_kicks"] = "middle" if self.halfway else "ends"
        if self.bath == "langevin":
            return LangevinRespa(KT, friction, self.seed, **own)  # type: ignore[arg-type]
        kind = BathInTheMiddle if self.middle else IsokineticSpheres
        return kind(KT, friction, self.seed, spheres=self.bath, auxiliary=self.auxiliary, **own)  # type: ignore[arg-type]


class Water:
    """Rigid TIP3P waters, their forces by groups, and their energy."""

    def __init__(self, method: Method) -> None:
        scene = test_systems.build("water", size=method.waters)
        self.box = float(scene.cell[0])
        self.potential = scene.potential
        self.motion = scene.motion

        force: Any = self.potential.forces
        if method.bath != "plain":
            force = ForceGroups.difference(method.near(self.box), self.potential.forces)
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
            energies.append(water.potential.watched_energy(now.positions) / KJ / method.waters)

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
        **asdict(method),
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


def collect(folder: Path, samples: int, methods: tuple[Method, ...] = (*METHODS, *TRIED)) -> list[dict[str, Any]]:
    """All methods, their energies beside that of the first."""
    rows = [row for method in methods if (row := summary(method, folder, samples)) is not None]
    known = rows[0]["energy"]
    for row in rows:
        value, error = row["energy"]
        row["bias"] = [100 * (value - known[0]) / abs(known[0]), 100 * math.hypot(error, known[1]) / abs(known[0])]
    return rows


#: Seeds that no setting was chosen by, settings, and ps of each run after 10 ps.
SEEDS, LATER = (11, 12), (Method("split", 20, 24), Method("split", 20, 32), Method("split", 20, 32, auxiliary=0))
FRESH = 60.0


def fresh() -> list[dict[str, Any]]:
    """Energies of split spheres with other seeds; those of the reference are in the table."""
    found = []
    for method in LATER:
        for seed in SEEDS:
            water, stepper = Water(method), replace(method, seed=seed).stepper()
            energies: list[float] = []
            dt = method.outer * units.fs
            state = run(water.system, water.start, dt, round(10_000 / method.outer), stepper=stepper)
            steps = round(1000 * FRESH / method.outer)
            look = [lambda now, w=water, u=energies: u.append(w.potential.watched_energy(now.positions) / KJ / 64)]
            run(water.system, state, dt, steps, stepper=stepper, observers=look, every=8)
            found.append({"name": method.name, "seed": seed, "ps": FRESH, "energy": list(mean(energies[1:]))})
            print(found[-1], flush=True)
    return found


def show_fresh(result: dict[str, Any]) -> str:
    """Energies beside that of the reference, with its error."""
    known, lines = result["water"][0]["energy"], []
    for row in result["fresh"]:
        value, error = row["energy"]
        off = [100 * x / abs(known[0]) for x in (value - known[0], math.hypot(error, known[1]))]
        lines.append(f"{row['name']:32s} seed {row['seed']:3d}{value:8.2f}({error:.2f}){off[0]:+7.2f}({off[1]:.2f}) %")
    return "\n".join(lines)


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


# -- the command ----------------------------------------------------------------------------------------


def quick() -> None:
    """Some steps, looked at halfway between slow kicks."""
    method = Method("langevin", 5, 16, halfway=True, waters=QUICK)
    water = Water(method)
    print(method.stepper().listing())  # type: ignore[attr-defined]
    end = run(water.system, water.start, method.outer * units.fs, 25, stepper=method.stepper())
    energy = water.potential.watched_energy(end.positions) / KJ / QUICK
    print(f"{QUICK} waters after {end.step} steps of {method.outer:g} fs: {energy:.1f} kJ/mol a molecule, ", end="")
    print(f"evaluations {water.system.force.evaluations}")  # type: ignore[union-attr]


def keep(part: str, found: Any) -> dict[str, Any]:
    """Put a part into the file of results."""
    result = json_files.read(RESULT) if RESULT.exists() else {}
    result |= {part: found, "environment": environment()}
    json_files.write(RESULT, result)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", type=Path, metavar="FOLDER")
    parser.add_argument("--collect", type=Path, metavar="FOLDER")
    parser.add_argument("--fresh", action="store_true")
    parser.add_argument("--show", type=Path, metavar="FILE")
    parser.add_argument("--tried", action="store_true", help="with --full: also what was tried besides")
    parser.add_argument("--hours", type=float, default=8.0, help="with --full: when to stop")
    parser.add_argument("--samples", type=int, default=300, help="with --collect: frames for temperatures")
    given = parser.parse_args()
    if given.show:
        result = json_files.read(given.show)
        print(show_water(result), show_fresh(result), sep="\n\n")
    elif given.fresh:
        print(show_fresh(keep("fresh", fresh())))
    elif given.full:
        full(given.full, (*METHODS, *TRIED) if given.tried else METHODS, given.hours)
    elif given.collect:
        print(show_water(keep("water", collect(given.collect, given.samples))))
    else:
        quick()


if __name__ == "__main__":
    main()
