"""How far methods can be pushed: largest stable steps, drift of the energy, reversibility.

    python examples/studies/stability.py --quick --out DIR                  some minutes
    python examples/studies/stability.py --quick --only steps --systems rotor --out DIR
    python examples/studies/stability.py --out DIR                          all, an hour

DIR/stability.csv has a row a measurement; 'part' says of what: steps, drift, reversal. The exit status is 1
where a method of kcons was off its rows without an error.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[1] / "tests"), str(HERE)]

import harness  # noqa: E402
from hard_cases.long_runs import secular_drift  # noqa: E402
from hard_cases.problem import Array, Problem  # noqa: E402
from hard_cases.programs import CannotExpressError, Core, Frame, NotIntactError, PlainAse, PlainOpenMM, Program  # noqa: E402

from kcons import ConstraintSet, Motion, State, System, steppers  # noqa: E402
from kcons.comparison.projected_equation import ProjectedEquation  # noqa: E402
from kcons.constraints import Constraint, Distance, FixedAtoms  # noqa: E402
from kcons.steppers import Stepper  # noqa: E402

_NAMES = ("Rattle", "Geodesic", "Suzuki4", "Yoshida4", "BlanesMoan4", "KahanLi6", "BlanesMoan6", "BlanesMoan6a")
STEPPERS: Mapping[str, Callable[[], Stepper]] = {
    **{name: getattr(steppers, name) for name in _NAMES},
    "ProjectedVerlet": partial(ProjectedEquation, 2, project=True),
    "ProjectedRungeKutta4": partial(ProjectedEquation, 4, project=True),
}
PEERS: dict[str, Callable[[], Program]] = {"ASE": PlainAse, "OpenMM": PlainOpenMM}
METHODS = (*STEPPERS, *PEERS)

# -- test systems: cheap forces, known kinds of motion, the same problem for every program --------------


def _moving(problem: Problem, speed: float, seed: int) -> Problem:
    """With tangent velocities of random direction and the total momentum of rest."""
    v = speed * np.random.default_rng(seed).standard_normal(problem.x.shape)
    if not len(problem.fixed):
        v -= problem.m @ v / problem.m.sum()
    return problem.moving(v)


def water(seed: int = 1) -> Problem:
    """Rigid water that tumbles in a field which turns its dipole, on a soft spring."""
    x = np.array([[0.0, 0, 0], [0.8, 0.6, 0], [-0.8, 0.6, 0]])
    push = 0.5 * np.array([[0, 0, -2.0], [0, 0, 1], [0, 0, 1]])
    return _moving(Problem(x, [16.0, 1, 1], [(0, 1), (0, 2), (1, 2)], push=push), 0.5, seed)


def chain(seed: int = 1) -> Problem:
    """Eight atoms, seven bonds, each atom on a spring."""
    k = np.arange(8)
    half = np.radians(55)
    x = np.stack([k * np.sin(half), (k % 2) * np.cos(half), 0.0 * k], axis=1)
    bonds = [(i, i + 1) for i in range(7)]
    return _moving(Problem(x, np.full(8, 12.0), bonds, tether=2.0, anchors=0.9 * x), 0.3, seed)


def dumbbells(seed: int = 1) -> Problem:
    """Two dumbbells joined by four springs."""
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0.1, 1.6, 0.2], [0.4, 1.4, 1.1]])
    springs = [(i, j, 3.0, 1.5) for i in (0, 1) for j in (2, 3)]
    return _moving(Problem(x, [1.0, 2, 1.5, 1], [(0, 1), (2, 3)], springs=springs), 0.4, seed)


def rotor(seed: int = 1) -> Problem:
    """One dumbbell in free flight, omega = 1 for the first seed."""
    x = np.array([[0.75, 0, 0], [-0.45, 0, 0]])
    turn = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0] if seed > 1 else np.eye(3)
    v = np.array([[0, 0.75, 0], [0, -0.45, 0]])
    return Problem(x @ turn, [1.5, 2.5], [(0, 1)], velocities=v @ turn)


def pendulum(seed: int = 1) -> Problem:
    """A spherical pendulum about a fixed atom."""
    angle = 2.0
    x = np.array([[0.0, 0, 0], [np.sin(angle), 0, -np.cos(angle)]])
    push = np.array([[0, 0, 0], [0, 0, -1.0]])
    return _moving(Problem(x, [1.0, 1], [(0, 1)], [1.0], fixed=[0], push=push), 0.3, seed)


def butane(seed: int = 1) -> Problem:
    """Four united atoms, bonds and 1-3 distances held; a spring between the ends turns the dihedral."""
    x = np.array([[1.43, 0.55, 0.2], [0, 0, 0], [0.0, 0, 1.53], [-1.2, 0.9, 2.05]])
    pairs = [(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)]
    ends = float(np.linalg.norm(x[0] - x[3]))
    return _moving(Problem(x, [15.0, 14, 14, 15], pairs, springs=[(0, 3, 4.0, 0.9 * ends)]), 0.3, seed)


SYSTEMS: dict[str, Callable[[int], Problem]] = {
    "water": water,
    "chain": chain,
    "dumbbells": dumbbells,
    "rotor": rotor,
    "pendulum": pendulum,
    "butane": butane,
}


# -- what is measured -----------------------------------------------------------------------------------

#: Relative residual above which a run that ends without an error has failed silently. (SETTLE of OpenMM keeps lengths
#: in single precision, 3e-8.)
SILENT = 1e-7
#: Change of the energy, relative to the largest kinetic energy of the test system, that is an explosion.
EXPLOSION = 1.0


def _run(method: str, problem: Problem, dt: float, steps: int, watch: Callable[[Frame], Any], every: int = 1) -> Frame:
    program = PEERS[method]() if method in PEERS else Core(STEPPERS[method]())
    return program.run(problem, dt, steps, watch, every=every)


class _Exploded(Exception):
    """The energy has left all bounds; there is no need to go on."""


def attempt(method: str, test_system: str, dt: float, steps: int) -> tuple[str, float]:
    """How a run ends, and its largest residual.

    'stable'; 'silent' where it ended without an error but off its rows; 'explosion' of the energy; the type of an
    error.
    """
    problem = SYSTEMS[test_system](1)
    residual = 0.0
    first: list[float] = []
    largest = problem.kinetic(problem.v)

    def watch(frame: Frame) -> None:
        nonlocal residual, largest
        found = problem.residual(frame.x)
        residual = max(residual, found) if math.isfinite(found) else math.nan
        if len(first) < 2:
            first.append(frame.energy)  # the first of a leapfrog is that of velocities half a step earlier
            return
        if not math.isfinite(residual):
            raise _Exploded
        # Energies that are exchanged: kinetic plus what the potential may give.
        scale = max(largest, abs(first[-1] - _lowest(test_system)))
        if not abs(frame.energy - first[-1]) <= EXPLOSION * scale:
            raise _Exploded

    try:
        _run(method, problem, dt, steps, watch)
    except _Exploded:
        return "explosion", residual
    except (CannotExpressError, NotIntactError):
        raise
    except Exception as error:
        return type(error).__name__, residual
    return ("stable" if residual <= SILENT else "silent"), residual


_LOWEST: dict[str, float] = {}


def _lowest(test_system: str) -> float:
    """About the lowest potential energy that the test system passes through."""
    if test_system not in _LOWEST:
        problem = SYSTEMS[test_system](1)
        seen: list[float] = []
        Core().run(problem, 0.02, 1000, lambda frame: seen.append(frame.potential), every=5)
        _LOWEST[test_system] = min(seen)
    return _LOWEST[test_system]


def largest_step(method: str, test_system: str, quick: bool) -> dict[str, Any]:
    """Double the step until it fails, then halve the bracket.

    A failure must be an error or an energy that explodes while all rows hold; the state before it must be intact
    (`Core.run` compares it bit for bit).
    """
    steps = (100 if quick else 2000) // (10 if method == "ASE" else 1)
    stable, failing, end, silent = 0.0, 0.0, "", 0.0

    def holds(dt: float) -> bool:
        nonlocal stable, failing, end, silent
        found, residual = attempt(method, test_system, dt, steps)
        silent = _silent(silent, found, residual)
        if found == "stable":
            stable = dt
        else:
            failing, end = dt, found
        return found == "stable"

    try:
        dt = 0.05
        while not failing and dt < 1e3:
            if holds(dt):
                dt *= 2
            elif stable == 0.0 and dt > 1e-4:
                failing, dt = 0.0, dt / 8
        if failing:
            for _ in range(3 if quick else 6):
                holds(0.5 * (stable + failing))
    except CannotExpressError as error:
        return {"words": str(error)}
    result = {
        "largest step": stable,
        "fails at": failing or None,
        "how": end,
        "silent residual": silent,
        "steps": steps,
    }
    if end == "OpenMMException" and stable == 0.0:
        return {"words": "OpenMM: a constraint cannot involve a massless particle"}
    if method in STEPPERS:
        result["evaluations"] = STEPPERS[method]().force_evaluations
    return result


def _silent(before: float, end: str, residual: float) -> float:
    """Largest residual of runs that no error ended; NaN counts."""
    if end not in ("stable", "silent", "explosion"):
        return before
    return max(before, residual) if math.isfinite(residual) and math.isfinite(before) else math.nan


#: Time step of drift and reversal for each test system.
TIME_STEPS = {"water": 0.02, "chain": 0.02, "dumbbells": 0.02, "rotor": 0.05, "pendulum": 0.02, "butane": 0.02}


def drift(test_system: str, seeds: int, steps: int, every: int = 20) -> dict[str, Any]:
    """Slope of the energy over a long run with Rattle, mean and standard error over seeds, relative to kinetic energy.

    The slope is the difference of the windowed means of both halves over the time between them. All seeds run side by
    side, as molecules of one system that do not know of each other: a step costs little more than that of one.
    """
    dt = TIME_STEPS[test_system]
    copies = Copies([SYSTEMS[test_system](seed) for seed in range(1, seeds + 1)])
    system = copies.system()
    state = system.initial_state(copies.x, copies.v)
    kinetic = copies.energies(copies.x, copies.v)[1]
    energies: list[Array] = []
    residual = 0.0

    def observe(state: State) -> None:
        nonlocal residual
        energies.append(copies.energies(state.positions, state.velocities)[0])
        residual = max(residual, copies.residual(state.positions))

    steppers.run(system, state, dt, steps, observers=[observe], every=every)
    e = np.array(energies) / kinetic
    slopes = [secular_drift(column) / (0.5 * steps * dt) for column in e.T]
    return {
        "dt": dt,
        "steps": steps,
        "seeds": seeds,
        "slope": float(np.mean(slopes)),
        "standard error": float(np.std(slopes, ddof=1) / math.sqrt(seeds)) if seeds > 1 else None,
        "rms": float(np.mean(np.std(e, axis=0))),
        "residual": residual,
    }


class Copies:
    """Several problems of one test system as one system, with forces for all of them at once."""

    def __init__(self, problems: list[Problem]) -> None:
        self.n, self.each = len(problems), problems[0].n_atoms
        first = problems[0]
        self.x = np.vstack([p.x for p in problems])
        self.v = np.vstack([p.v for p in problems])
        self.m = np.concatenate([p.m for p in problems])
        self.fixed = [a + k * self.each for k in range(self.n) for a in first.fixed]
        self.pairs = [(i + k * self.each, j + k * self.each) for k in range(self.n) for i, j in first.pairs]
        self.lengths = np.concatenate([p.held_lengths for p in problems])
        self.push = np.vstack([np.zeros_like(p.x) if p.push is None else np.asarray(p.push) for p in problems])
        self.tether, self.anchors = first.tether, np.vstack([p._anchors for p in problems])
        springs = [
            (i + q * self.each, j + q * self.each, k, r) for q, p in enumerate(problems) for i, j, k, r in p.springs
        ]
        self.k, self.rest = np.array([s[2] for s in springs]), np.array([s[3] for s in springs])
        #: Differences of positions along the springs are this matrix times the positions.
        self.along = np.zeros((len(springs), len(self.x)))
        for row, (i, j, _, _) in enumerate(springs):
            self.along[row, i], self.along[row, j] = 1.0, -1.0

    def system(self) -> System:
        rows: list[Constraint] = [FixedAtoms(self.fixed)] if self.fixed else []
        held = ConstraintSet([*rows, Distance(self.pairs, self.lengths)], self.x, self.m)
        return System(Motion(held, self.x), self.forces)

    def forces(self, x: Array, t: float) -> Array:
        f = self.push - self.tether * (x - self.anchors) if self.tether else self.push
        if len(self.k):
            d = self.along @ x
            r = np.sqrt(np.einsum("ij,ij->i", d, d))
            f = f + self.along.T @ ((self.k * (self.rest / r - 1.0))[:, None] * d)
        return f

    def energies(self, x: Array, v: Array) -> tuple[Array, Array]:
        """Total and kinetic energy of each copy."""
        moving = np.ones(len(x))
        moving[self.fixed] = 0.0
        kinetic = 0.5 * (self.m * moving * np.einsum("ij,ij->i", v, v)).reshape(self.n, -1).sum(axis=1)
        potential = (-np.einsum("ij,ij->i", self.push, x)).reshape(self.n, -1).sum(axis=1)
        if self.tether:
            away = x - self.anchors
            potential += 0.5 * self.tether * np.einsum("ij,ij->i", away, away).reshape(self.n, -1).sum(axis=1)
        if len(self.k):
            r = np.linalg.norm(self.along @ x, axis=1)
            potential += (0.5 * self.k * (r - self.rest) ** 2).reshape(self.n, -1).sum(axis=1)
        return kinetic + potential, kinetic

    def residual(self, x: Array) -> float:
        i, j = np.array(self.pairs).T
        return float(np.max(np.abs(np.linalg.norm(x[i] - x[j], axis=1) / self.lengths - 1)))


def reversal(method: str, test_system: str, steps: int) -> dict[str, Any]:
    """n steps, velocities turned round, n steps: by how much the start is missed."""
    problem = SYSTEMS[test_system](1)
    dt = TIME_STEPS[test_system]
    try:
        if method == "OpenMM":
            raise CannotExpressError("velocities of the leapfrog belong to half steps")
        end = _run(method, problem, dt, steps, lambda frame: None)
        kept: dict[str, Array] = {"lengths": problem.held_lengths, "anchors": problem._anchors}
        back = _run(method, problem.but(positions=end.x, velocities=-end.v, **kept), dt, steps, lambda frame: None)
    except CannotExpressError as error:
        return {"words": str(error)}
    except Exception as error:
        return {"words": f"{type(error).__name__}: {error}", "steps": steps}
    off = max(np.abs(back.x - problem.x).max(), np.abs(back.v + problem.v).max())
    result = {"missed by": float(off), "steps": steps, "dt": dt}
    if method in STEPPERS:
        result["reversible"] = STEPPERS[method]().reversible
    return result


PARTS = ("steps", "drift", "reversal")


def pieces(part: str, quick: bool, systems: list[str]) -> dict[str, Callable[[], Iterator[dict[str, Any]]]]:
    """The work of a part of the study."""

    def row(function: Callable[..., dict[str, Any]], *arguments: Any, **known: Any) -> Iterator[dict[str, Any]]:
        yield {"part": part, **known, **function(*arguments)}

    both = [(system, method) for system in systems for method in METHODS]
    if part == "steps":
        return {f"steps, {s}, {m}": partial(row, largest_step, m, s, quick, system=s, method=m) for s, m in both}
    if part == "drift":
        steps = 10_000 if quick else 1_000_000
        return {f"drift, {s}": partial(row, drift, s, 8, steps, system=s, method="Rattle") for s in systems}
    steps = {m: (200 if quick else 2000) // (10 if m == "ASE" else 1) for m in METHODS}
    return {f"reversal, {s}, {m}": partial(row, reversal, m, s, steps[m], system=s, method=m) for s, m in both}


def faults(table: pd.DataFrame) -> list[str]:
    """What must not be: residuals of kcons without an error."""
    found = []
    if "silent residual" in table:
        # NaN in the file where there is no number; methods of others have none that counts.
        silent = table[(table["silent residual"] > SILENT) & table.method.isin(STEPPERS)]
        for row in silent.to_dict("records"):
            found.append(f"{row['piece']}: residual {row['silent residual']:.1e} without an error")
    return found


#: What ends the steps, in a word.
ENDS = {"explosion": "energy", "silent": "SILENT"}


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Largest stable step and what ends it; drift; by how much the start is missed."""
    found = {}
    for part, told in (("steps", _largest), ("reversal", _missed)):
        rows = table[table.part == part]
        if len(rows):
            cells = rows.assign(told=[told(row) for row in rows.to_dict("records")])
            wide = cells.pivot(index="method", columns="system", values="told")
            order = [name for name in METHODS if name in wide.index]
            found[part] = wide.loc[order, [name for name in SYSTEMS if name in wide]].fillna("–").reset_index()
    drifts = table[table.part == "drift"]
    if len(drifts):
        found["drift"] = pd.DataFrame(
            {
                "test system": row["system"],
                "step": f"{row['dt']:g}",
                "steps": f"{row['steps']:,.0f}",
                "seeds": f"{row['seeds']:.0f}",
                "slope per unit time": f"{row['slope']:.1e} ± {row['standard error']:.1e}",
                "rms": f"{row['rms']:.1e}",
                "residual": f"{row['residual']:.1e}",
            }
            for _, row in drifts.iterrows()
        )
    return found


def _largest(row: Mapping[str, Any]) -> str:
    return "–" if pd.isna(row["largest step"]) else f"{row['largest step']:.3g} {ENDS.get(row['how'], 'error')}"


def _missed(row: Mapping[str, Any]) -> str:
    return "–" if pd.isna(row["missed by"]) else f"{row['missed by']:.1e}"


def main(arguments: list[str] | None = None) -> int:
    def names(words: str) -> list[str]:
        return words.split(",")

    parser = harness.options(__doc__, "stability")
    parser.add_argument("--only", type=names, default=PARTS, help=f"of {', '.join(PARTS)}")
    parser.add_argument("--systems", type=names, default=list(SYSTEMS), help=f"of {', '.join(SYSTEMS)}")
    chosen = parser.parse_args(arguments)
    for given, known in ((chosen.only, PARTS), (chosen.systems, SYSTEMS)):
        if not set(given) <= set(known):
            parser.error(f"{', '.join(given)}: there are {', '.join(known)}")
    work = {name: piece for part in chosen.only for name, piece in pieces(part, chosen.quick, chosen.systems).items()}
    table = harness.run(chosen.out / "stability.csv", work, quick=chosen.quick)
    for found in tables(table).values():
        print(found.to_string(index=False), end="\n\n")
    wrong = faults(table)
    print("\n".join(wrong))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
