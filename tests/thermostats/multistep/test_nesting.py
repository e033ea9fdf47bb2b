"""A step with several time steps, as a list of operations."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from kcons.steppers.operations import Evaluate, Exchange, Fly, Kick, Project, Turn
from kcons.thermostats.multistep.respa import levels_of, nested

THREE = levels_of({"fast": 12, "slow": 1, "medium": 4})


@pytest.mark.parametrize("turns", [False, True])
def test_slow_kicks_in_the_middle(turns):
    """Of the same chain of operations: between the same inner steps, with one kick in place of two halves."""
    levels = levels_of({"slow": 1, "fast": 4})
    at_ends, middle = (nested(levels, (1.0,), turns=turns, middle=where) for where in (False, True))
    push = Turn if turns else Kick
    last = len(at_ends) - (0 if turns else 1)
    inner, tail = at_ends[1 : last - 2], at_ends[last:]
    half = len(inner) // 2
    assert middle == (*inner[:half], Evaluate("slow"), push(1.0, "slow"), *inner[half:], *tail)


def test_a_step_is_its_own_mirror_image():
    """But for evaluations, which go before the kicks that use them."""
    kept = [(type(o), o.fraction, getattr(o, "group", "")) for o in nested(THREE, (1.0,), turns=True)]
    kept = [item for item in kept if item[0] in (Turn, Fly, Exchange)]
    for (a, share, group), (b, other, name) in zip(kept, reversed(kept), strict=True):
        assert (a, group) == (b, name) and share == pytest.approx(other, rel=1e-13)


def test_on_spheres_velocities_are_projected_after_each_drift():
    done = nested(THREE, (1.0,), turns=True)
    assert all(isinstance(b, Project) for a, b in pairwise(done) if isinstance(a, Fly))
    assert not any(isinstance(o, Kick) for o in done)


def spreads(angle, share, friction=0.05, count=10):
    """<x^2> over kT/k of an oscillator with one slow kick in `angle`, at the kick and after each inner step; exact.

    `share` of its stiffness is in the slow force.
    """
    step, noise, seen = np.eye(2), np.zeros((2, 2)), []
    for operation in nested(levels_of({"slow": 1, "fast": count}), (1.0,)):
        a, b, part = np.eye(2), np.zeros((2, 2)), getattr(operation, "fraction", 0.0) * angle
        if isinstance(operation, Kick):
            a[1, 0] = -part * (share if operation.group == "slow" else 1 - share)
        elif isinstance(operation, Fly):
            a[0, 1] = part
        elif isinstance(operation, Exchange):
            a[1, 1] = math.exp(-friction * part)
            b[1, 1] = 1 - a[1, 1] ** 2
        step, noise = a @ step, a @ noise @ a.T + b
        if isinstance(operation, Evaluate) and operation.group == "fast":
            seen.append((step, noise))
    if np.abs(np.linalg.eigvals(step)).max() >= 1:
        return np.full(count + 1, np.inf)
    still = np.linalg.solve(np.eye(4) - np.kron(step, step), noise.ravel()).reshape(2, 2)
    return np.array([still[0, 0], *((a @ still @ a.T + b)[0, 0] for a, b in seen)])


def test_where_averages_are_right():
    """Too wide at the kicks, too narrow halfway, right at about a fifth; near half a period both are far too wide."""
    found = spreads(1.5, 0.2) - 1
    assert found == pytest.approx(found[::-1], abs=5e-3)
    assert found[0] == pytest.approx(0.088, abs=5e-4) and found[5] == pytest.approx(-0.058, abs=5e-4)
    assert abs(found[2]) < 0.01 < -found[3]
    # Without slow forces every inner step is right at its end.
    assert spreads(1.5, 0.0, count=2) - 1 == pytest.approx([0, 0, 0], abs=1e-12)
    driven = spreads(math.pi, -0.2, friction=0.2)
    assert np.isinf(spreads(3.0, 0.2)).all() and min(driven[0], driven[5], driven.mean()) > 4
