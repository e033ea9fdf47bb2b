"""The share of slow forces in the stiffness: closed forms, and what must not count."""

from __future__ import annotations

import numpy as np
import pytest
from thermostat_systems import system

from kcons.constraints import Distance, FixedAtoms
from kcons.errors import InputError
from kcons.steppers import System
from kcons.thermostats import ForceGroups, slow_share

K = 3.0


def grouped(rows, x, masses, **forces) -> System:
    return system(rows, x, masses, ForceGroups(forces))


def test_springs_of_free_atoms():
    """k/m of each: 9 and 1 in the squares of H, whose traces are 3 (81 + 1) and 3; normal moves of many frames."""
    x = np.array([[0.0, 0, 0], [5.0, 0, 0]])
    fast, slow = np.array([[9.0], [0.0]]), np.array([[0.0], [4.0]])
    held = grouped([], x, [1.0, 4.0], fast=lambda x, t: -fast * x, slow=lambda x, t: -slow * x)
    share = slow_share(held, np.tile(x, (4000, 1, 1)))
    assert share == pytest.approx(np.sqrt(1 / 82), rel=0.05)
    other = slow_share(held, np.tile(x, (4000, 1, 1)), "fast")
    assert share**2 + other**2 == pytest.approx(1, rel=1e-6)


def test_signs_do_not_cancel():
    """A saddle without a trace, beside a trap of the same size."""
    saddle = np.diag([1.0, 1.0, -2.0])
    held = grouped([], [[1.0, 2, 3]], [1.0], fast=lambda x, t: -x - x @ saddle, slow=lambda x, t: x @ saddle)
    frames = np.tile([[1.0, 2, 3]], (4000, 1, 1))
    assert slow_share(held, frames, displacement=0.01) == pytest.approx(np.sqrt(2), rel=0.05)


def test_a_rigid_pair_turns_freely_in_a_trap():
    """All of the stiffness is that of its center; what pulls along the pair does nothing, wherever it has turned to."""
    x = np.array([[0.3, -0.2, 0.1], [0.3, -0.2, 1.5]])

    def along(x, t):
        d = x[1] - x[0]
        return 50 * np.array([d, -d])

    def held(**more):
        return grouped([Distance([[0, 1]])], x, [2.0, 2.0], fast=lambda x, t: -K * x, **more)

    frames = np.tile(x, (20, 1, 1))
    assert slow_share(held(slow=along), frames, displacement=1e-3) < 1e-6
    assert slow_share(held(slow=lambda x, t: -2 * K * x), frames) == pytest.approx(2 / 3, rel=1e-6)


def test_fixed_atoms_make_no_longer_moves():
    """A pair that repels steeply, alone and beside a slab."""
    slab = [[i, j, -20.0] for i in range(10) for j in range(10)]

    def fast(x, t):
        d = x[1] - x[0]
        push = 12 * d / np.linalg.norm(d) ** 14
        return np.vstack([-push - x[0], push - x[1], np.zeros((len(x) - 2, 3))])

    def slow(x, t):
        return np.vstack([-0.5 * x[:2], np.zeros((len(x) - 2, 3))])

    shares = []
    for fixed in ([], slab):
        x = np.array([[0.0, 0, 0], [1.0, 0, 0], *fixed])
        rows = [FixedAtoms(np.arange(2, len(x)))] if fixed else []
        shares.append(slow_share(grouped(rows, x, np.ones(len(x)), fast=fast, slow=slow), np.tile(x, (200, 1, 1))))
    assert shares[1] == pytest.approx(shares[0], rel=0.3)
    held = grouped([FixedAtoms([0])], [[0.0, 0, 0]], [1.0], fast=lambda x, t: -x, slow=lambda x, t: -x)
    with pytest.raises(InputError, match="all atoms are fixed"):
        slow_share(held, [[[0.0, 0, 0]]], displacement=0.1)
