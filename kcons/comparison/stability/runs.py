"""Largest stable steps, drift of the energy, and reversibility."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from kcons import steppers
from kcons.comparison.hard_cases.contract import CannotExpressError, Frame, NotIntactError, Program
from kcons.comparison.hard_cases.long_runs import secular_drift
from kcons.comparison.hard_cases.problem import Array, Problem
from kcons.comparison.hard_cases.programs import Core, PlainAse, PlainOpenMM
from kcons.comparison.stability.small_systems import SYSTEMS
from kcons.constraints import Constraint, Distance, FixedAtoms
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion.motion import Motion
from kcons.steppers import State, Stepper, System

_NAMES = (
    *("Rattle", "Geodesic", "Suzuki4", "Yoshida4", "BlanesMoan4", "KahanLi6", "BlanesMoan6", "BlanesMoan6a"),
    *("ProjectedVerlet", "ProjectedRungeKutta4"),
)
STEPPERS: Mapping[str, Callable[[], Stepper]] = {
    name: partial(getattr(steppers, name), **({"project": True} if name.startswith("Projected") else {}))
    for name in _NAMES
}
PEERS: dict[str, Callable[[], Program]] = {"ASE": PlainAse, "OpenMM": PlainOpenMM}
METHODS = (*STEPPERS, *PEERS)

#: Relative residual above which a run that ends without an error has failed silently. (SETTLE of OpenMM keeps lengths
#: in single precision, 3e-8.)
SILENT = 1e-7
#: Change of the energy, relative to the largest kinetic energy of the test system, that is an explosion.
EXPLOSION = 1.0


def _run(method: str, problem: Problem, dt: float, steps: int, watch: Callable[[Frame], Any], every: int = 1) -> Frame:
    if method in PEERS:
        return PEERS[method]().run(problem, dt, steps, watch, every=every)
    return Core().run(problem, dt, steps, watch, every=every, stepper=STEPPERS[method]())


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
        return {"cannot": str(error)}
    result = {
        "largest_step": stable,
        "fails_at": failing or None,
        "how": end,
        "silent_residual": silent,
        "steps": steps,
    }
    if end == "OpenMMException" and stable == 0.0:
        return {"cannot": "OpenMM: a constraint cannot involve a massless particle"}
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
        "standard_error": float(np.std(slopes, ddof=1) / math.sqrt(seeds)) if seeds > 1 else None,
        "slopes": slopes,
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
        return {"cannot": str(error)}
    except Exception as error:
        return {"error": f"{type(error).__name__}: {error}", "steps": steps}
    off = max(np.abs(back.x - problem.x).max(), np.abs(back.v + problem.v).max())
    result = {"missed_by": float(off), "steps": steps, "dt": dt}
    if method in STEPPERS:
        result["reversible"] = STEPPERS[method]().reversible
    return result
