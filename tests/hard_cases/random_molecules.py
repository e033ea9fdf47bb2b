"""Random molecules, random steps: a solution to the tolerance, or a typed error with nothing changed.

A trial is made from its number alone, so that any of them can be repeated: ``trial(4711)``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from hard_cases.motions import every
from hard_cases.problem import Array
from hard_cases.small_systems import separated
from kcons.comparison.projected_equation import ProjectedEquation
from kcons.constraints import Angle, Constraint, Dihedral, Distance, FixedAtoms, Plane, Sphere
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import KconsError
from kcons.motion.motion import Motion
from kcons.steppers import (
    BlanesMoan4,
    BlanesMoan6,
    Geodesic,
    KahanLi6,
    Rattle,
    Stepper,
    Suzuki4,
    System,
)

Outcome = Literal[
    "solved", "refused at set-up", "refused at start", "refused in a step", "NaN", "silent", "changed", "untyped error"
]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
#: What must never happen.
FAULTS: tuple[Outcome, ...] = ("NaN", "silent", "changed", "untyped error")
#: Residuals of rows (relative to their scale) and of A v (relative to the speed) that are silent faults above this.
ALLOWED = 1e-9
STEPS = 4
SHAPES = ("tree", "ring", "braced", "two bodies", "angles", "dihedrals", "surfaces", "fixed", "flat")
STEPPERS: tuple[Callable[[], Stepper], ...] = (
    Rattle,
    Rattle,
    Rattle,
    Geodesic,
    Suzuki4,
    BlanesMoan4,
    KahanLi6,
    BlanesMoan6,
    lambda: ProjectedEquation(project=True),
)


@dataclass(frozen=True)
class Trial:
    """What came of one trial.

    Attributes
    ----------
    seed : int
    shape : str
        Kind of molecule.
    outcome : str
    residual, velocity_residual : float
        Largest ones of all states that were returned, relative to the rows' scales and to the speed.
    dt : float
    stepper : str
    words : str
        Type and text of the error.
    """

    seed: int
    shape: str
    outcome: Outcome
    residual: float = 0.0
    velocity_residual: float = 0.0
    dt: float = 0.0
    stepper: str = ""
    words: str = ""


def molecule(rng: np.random.Generator) -> tuple[str, Array, Array, list[Constraint]]:
    """Kind, positions, masses from 1 to 1e4, and rows of a random molecule."""
    shape = str(rng.choice(SHAPES))
    n = int(rng.integers(2, 13)) if shape not in ("ring", "angles", "flat") else int(rng.integers(3, 11))
    n = max(n, 5) if shape in ("two bodies", "dihedrals") else n
    n = min(n, 7) if shape == "braced" else n
    x = separated(rng, n, 0.5)
    if shape == "flat":
        x[:, 2] = 0.0
        x += 1e-3 * rng.standard_normal(x.shape) * (rng.random() < 0.5)
    masses = 10 ** rng.uniform(0, 4, n)
    tree = [(int(rng.integers(0, k)), k) for k in range(1, n)]
    rows: list[Constraint] = []
    if shape in ("braced", "flat"):
        pairs = every(n)
        keep = rng.random(len(pairs)) < (1.0 if rng.random() < 0.5 else 0.7)
        pairs = [p for p, k in zip(pairs, keep, strict=True) if k] or pairs[:1]
        rows.append(Distance(pairs))
    elif shape == "two bodies":
        half = n // 2
        rows.append(Distance([*every(half), *[(half + i, half + j) for i, j in every(n - half)], (0, n - 1)]))
    else:
        pairs = [*tree, (0, n - 1)] if shape == "ring" and n > 2 and (0, n - 1) not in tree else tree
        rows.append(Distance(pairs))
    if shape == "angles":
        for _ in range(int(rng.integers(1, 3))):
            rows.append(Angle([rng.choice(n, 3, replace=False)]))
    if shape == "dihedrals":
        rows.append(Dihedral([rng.choice(n, 4, replace=False)]))
    if shape == "surfaces":
        atom = int(rng.integers(0, n))
        if rng.random() < 0.5:
            rows.append(Sphere([atom], x[atom] + rng.standard_normal(3), None))
        else:
            rows.append(Plane([atom], rng.standard_normal(3)))
    if shape == "fixed":
        rows.append(FixedAtoms([int(rng.integers(0, n))]))
    if rng.random() < 0.1:
        rows.append(Distance([tree[0][::-1]]))  # a duplicate
    return shape, x, masses, rows


def trial(seed: int) -> Trial:
    """Make a molecule, let it move for some steps, and judge every state it goes through."""
    rng = np.random.default_rng([20261121, seed])
    shape, x, masses, rows = molecule(rng)
    v = rng.standard_normal(x.shape) / np.sqrt(masses)[:, None] ** rng.choice([0.0, 1.0])
    dt = float(10 ** rng.uniform(-3, 1.0))
    stepper = STEPPERS[int(rng.integers(len(STEPPERS)))]()
    strength = float(10 ** rng.uniform(-1, 3)) if rng.random() < 0.7 else 0.0
    x = x if rng.random() < 0.8 else x + 10 ** rng.uniform(0, 6)
    anchors = x + 0.2 * rng.standard_normal(x.shape)

    def force(y: Array, t: float) -> Array:
        return -strength * (y - anchors)

    about: dict[str, Any] = {"seed": seed, "shape": shape, "dt": dt, "stepper": type(stepper).__name__}
    given = [x.copy(), masses.copy()]
    stage: Outcome = "refused at set-up"
    worst = worst_rate = excess = 0.0
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            asked = ConstraintSet(rows, x, masses)
            system = System(Motion(asked, x), force)
            stepper.check(system)
            stage = "refused at start"
            state = system.initial_state(x, v, project=True)
            stage = "refused in a step"
            for _ in range(STEPS):
                before = (state.positions.tobytes(), state.velocities.tobytes())
                held = state
                try:
                    state = stepper.step(system, state, dt)
                except KconsError:
                    if before != (held.positions.tobytes(), held.velocities.tobytes()):
                        return Trial(outcome="changed", **about)
                    raise
                y, w = state.positions, state.velocities
                if not (np.all(np.isfinite(y)) and np.all(np.isfinite(w))):
                    return Trial(outcome="NaN", **about)
                off, beyond, rate = _residuals(asked, system, y, w, state.time)
                worst, excess, worst_rate = max(worst, off), max(excess, beyond), max(worst_rate, rate)
        except KconsError as error:
            words = f"{type(error).__name__}: {' '.join(str(error).split())[:160]}"
            outcome: Outcome = stage
            if not all(np.array_equal(a, b) for a, b in zip(given, (x, masses), strict=True)):
                outcome = "changed"
            elif max(excess, worst_rate) > ALLOWED:
                outcome = "silent"
            return Trial(outcome=outcome, residual=worst, velocity_residual=worst_rate, words=words, **about)
        except Exception as error:
            return Trial(outcome="untyped error", words=f"{type(error).__name__}: {error}", **about)
    outcome = "silent" if not max(excess, worst_rate) <= ALLOWED else "solved"
    return Trial(outcome=outcome, residual=worst, velocity_residual=worst_rate, **about)


def _residuals(asked: ConstraintSet, system: System, x: Array, v: Array, time: float) -> tuple[float, float, float]:
    """Of the rows as they were asked for, whatever the engine made of them; the same less what positions can store.

    The velocities are tested on the rows that the engine holds: those it converts have no gradients of their own.
    """
    off = np.abs(asked.value(x, time))
    excess = np.maximum(off - 4 * asked.tolerance(x, time), 0.0) / asked.scale
    held = system.motion.constraint_set
    rows = held.jacobian(x, time)
    size = np.sqrt(np.asarray(rows.multiply(rows).sum(axis=1)).ravel())
    rate = np.abs(rows @ v.ravel() - held.velocity_target(x, time)) / np.where(size > 0, size, 1.0)
    speed = float(np.linalg.norm(v)) or 1.0
    return (
        float((off / asked.scale).max(initial=0.0)),
        float(excess.max(initial=0.0)),
        float(rate.max(initial=0.0)) / speed,
    )
