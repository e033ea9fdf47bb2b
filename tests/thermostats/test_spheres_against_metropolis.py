"""Isokinetic spheres against Metropolis sampling, which knows neither forces nor velocities."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kcons import ConstraintSet, Motion, System, run
from kcons.constraints import Distance
from kcons.thermostats import ForceGroups, IsokineticSpheres, mean, thermal_velocities

#: A dumbbell, a chain of three with a free angle, and a light atom on a stiff spring to the dumbbell; k_B T = 1.
ONE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 1], [0, 0, 1], [1, 0, 1], [1.0, 0.8, 0]])
MASSES = np.array([4.0, 3.0, 5.0, 4.0, 3.0, 1.0])
BONDS = np.array([[0, 1], [2, 3], [3, 4]])
TRAP = np.array([1.5, 2.0, 2.5, 1.0, 1.5, 0.5])
SPRING, REST, ENDS, APART, PUSH = 40.0, 0.8, 6.0, 1.2, 4.0


def slow_forces(x, time=0.0):
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


def fast_forces(x, time=0.0):
    """The stiff spring."""
    y = x.reshape(-1, 6, 3)
    f = np.zeros_like(y)
    d = y[:, 5] - y[:, 1]
    r = np.sqrt((d * d).sum(axis=1))[:, None]
    f[:, 1] = SPRING * (r - REST) / r * d
    f[:, 5] = -f[:, 1]
    return f.reshape(-1, 3)


def observed(x):
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


def log_weight(seen):
    """-U + log sqrt(det Z); Z is that of the chain's bonds, for the dumbbell's is a constant."""
    _, _, first, middle, last, _ = 1 / MASSES
    return 0.5 * np.log((first + middle) * (middle + last) - (middle * seen[:, 4]) ** 2) - seen[:, :4].sum(axis=1)


def metropolis(walkers, rounds):
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


def copies_of(n):
    """n small systems that know nothing of each other."""
    x = np.tile(ONE, (n, 1))
    rows = (6 * np.arange(n)[:, None, None] + BONDS).reshape(-1, 2)
    motion = Motion(ConstraintSet([Distance(rows, np.ones(len(rows)))], x, np.tile(MASSES, n)), x)
    system = System(motion, ForceGroups({"slow": slow_forces, "fast": fast_forces}))
    return system, system.initial_state(x, thermal_velocities(system, x, 1.0, np.random.default_rng(5)))


def sampled(kind, auxiliary, copies, wrong, steps):
    """Averages of the observables."""
    system, state = copies_of(copies)
    bath = IsokineticSpheres(1.0, 1.0, 3, steps={"slow": 1, "fast": 2}, spheres=kind, auxiliary=auxiliary)
    if wrong:
        g = bath.layout(system, state.positions).freedom
        bath.radii(system, state.positions)[...] *= (g + auxiliary) / (g + auxiliary - 1)
    series = []
    state = run(system, state, 0.02, 500 + steps // 10, stepper=bath)
    look = [lambda now: series.append(observed(now.positions).mean(axis=0))]
    run(system, state, 0.02, steps, stepper=bath, observers=look, every=5)
    return [mean(values) for values in np.array(series).T]


@pytest.mark.validation
@pytest.mark.parametrize("kind", ["split", "axes", "cluster"])
def test_averages_are_those_of_metropolis_and_a_wrong_radius_is_far_off(kind):
    """Six observables; wrong: g + L in place of g + L - 1 degrees of freedom."""
    known = metropolis(1000, 2000)
    for wrong in (False, True):
        found = sampled(kind, 1, 64, wrong, 6000)
        worst = max(abs(a.value - b.value) / math.hypot(a.error, b.error) for a, b in zip(found, known, strict=True))
        assert (worst > 10) if wrong else (worst <= 3.5)
