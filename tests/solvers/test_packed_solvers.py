"""Long chains in the kernels for all shapes: the engine's results, and nothing changed where there are none."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.constraints import Distance, FixedAtoms
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ConvergenceError
from kcons.motion import Motion
from kcons.solvers.addressable_solvers import packed_positions, packed_tangents, set_lattice
from kcons.steppers.packed_system import packed_rows

TRIANGLE = np.array([[0.0, 0, 0], [1.0, 0, 0], [-0.3, 0.9, 0]])


def chain(n: int, number: int) -> np.ndarray:
    """A helix of n bonds."""
    k = np.arange(n + 1)
    return np.stack([np.cos(k), np.sin(k), 0.3 * k], axis=1) + 0.7 * number


def engine(
    chains=(), triangles: int = 0, stars: int = 0, ions: int = 0, fixed=(), cell=None, at=0.0
) -> tuple[Motion, np.ndarray, np.ndarray, bool]:
    """Chains, then molecules, then free atoms: the engine, where they are, the tables, and whether chains are apart."""
    rng = np.random.default_rng(5)
    x, pairs, masses = [], [], []
    shapes = [(chain(n, c), np.stack([np.arange(n), np.arange(1, n + 1)], axis=1)) for c, n in enumerate(chains)]
    shapes += [(TRIANGLE + rng.normal(size=3), np.array([[0, 1], [0, 2], [1, 2]]))] * triangles
    shapes += [(rng.normal(size=(4, 3)), np.array([[0, 1], [0, 2], [0, 3]])) for _ in range(stars)]
    for where, rows in shapes:
        pairs.append(rows + sum(map(len, x)))
        x.append(where)
        masses.append([16.0, 1.0, 1.0] if len(where) == 3 else np.linspace(1.0, 14.0, len(where)))
    x = np.concatenate([*x, rng.normal(size=(ions, 3))]) + at
    m = np.concatenate([*masses, np.full(ions, 23.0)])
    rows = [Distance(np.concatenate(pairs))]
    if len(fixed):
        rows.append(FixedAtoms(list(fixed)))
    options = {} if cell is None else {"cell": cell, "pbc": True}
    motion = Motion(ConstraintSet(rows, x, m, **options), x)
    given = packed_rows(motion)
    assert given is not None, "too many rows"
    KEPT.append(given)
    found = given.tables
    set_lattice(found, motion.lattice)
    if cell is not None:
        # Bonds through the walls of the cell.
        x = x + rng.integers(-1, 2, size=x.shape) @ cell
    return motion, x, found, any(each.kernels.apply is None and not each.kernels.undo for each in given.called)


#: Tables are good as long as their solvers.
KEPT: list[object] = []
SKEWED = np.array([[19.0, 0, 0], [2.0, 18.0, 0], [1.0, -3.0, 17.0]])
CASES = {
    **{f"{n} bonds": ({"chains": [n]}, n > 31) for n in (7, 31, 32, 33, 40, 64, 100, 255, 1000)},
    "several": ({"chains": [100, 7, 40, 33, 8]}, True),
    "many short": ({"chains": [7] * 20}, True),
    "among free atoms": ({"chains": [60, 50], "ions": 200}, True),
    "triangles": ({"chains": [100], "triangles": 11}, True),
    "other clusters": ({"chains": [100], "stars": 3}, True),
    "all": ({"chains": [100, 12], "triangles": 9, "stars": 3, "ions": 2}, True),
    "other fixed atoms": ({"chains": [100], "stars": 2, "ions": 2, "fixed": (101, 109)}, True),
    "a fixed end": ({"chains": [100, 60], "fixed": (101,)}, True),
    "cell": ({"chains": [100, 9], "triangles": 9, "cell": np.diag([19.0, 18.0, 17.0])}, True),
    "skewed cell": ({"chains": [100], "stars": 2, "cell": SKEWED}, True),
    "far away": ({"chains": [100], "at": 1e5}, True),
}


@pytest.mark.parametrize("name", CASES)
def test_results_are_the_engines(name) -> None:
    options, special = CASES[name]
    motion, x, found, apart = engine(**options)
    assert apart == special
    rng = np.random.default_rng(1)
    size = np.abs(x).max()
    for dt in (0.01, -0.05):
        v = rng.normal(size=x.shape)
        expected = motion.project_velocities(x, v)
        here = v.copy()
        assert packed_tangents(x, here, found)
        assert np.abs(here - expected).max() <= 2e-15 * np.abs(v).max()
        assert np.abs(here - v).max() > 0.1
        ends, push = x + dt * expected, expected.copy()
        there, speed = ends.copy(), expected.copy()
        motion.project_positions(ends, x, velocities=push, dt=dt, out=ends)
        speed[motion.plan.pinned if len(motion.plan.inverse_masses) == len(x) else []] = 0.0
        assert 0 <= packed_positions(there, x, speed, 1.0 / dt, found) <= 6
        assert np.abs(there - ends).max() <= 1e-15 * size
        assert np.abs(speed - push).max() <= 2e-15 * size / abs(dt)
        held = motion.constraint_set
        assert np.all(np.abs(held.value(there)) <= np.maximum(1e-14 * held.scale, 1e-15 * size))


def test_one_chain_is_the_engines_to_the_last_bit() -> None:
    """The kernel is the same, so that runs do not depend on who calls it."""
    motion, x, found, _ = engine([300])
    v = motion.project_velocities(x, np.random.default_rng(2).normal(size=x.shape))
    ends, push = x + 0.03 * v, v.copy()
    there, speed = ends.copy(), v.copy()
    motion.project_positions(ends, x, velocities=push, dt=0.03, out=ends)
    assert packed_positions(there, x, speed, 1.0 / 0.03, found) > 0
    assert np.array_equal(there, ends) and np.array_equal(speed, push)


@pytest.mark.parametrize(
    "options", [{}, {"triangles": 11}, {"triangles": 11, "stars": 3}, {"stars": 2, "ions": 300}, {"chains": [200, 7]}]
)
def test_nothing_changes_where_a_chain_has_no_solution(options) -> None:
    """Also not what was solved before it."""
    motion, x, found, apart = engine(**{"chains": [100], **options})
    assert apart
    rng = np.random.default_rng(4)
    bad = 203 if "chains" in options else 50  # of the last chain
    for wrong in (40.0, np.nan):
        ends, v = x + 0.01 * rng.normal(size=x.shape), rng.normal(size=x.shape)
        ends[bad] += wrong
        there, speed = ends.copy(), v.copy()
        assert packed_positions(there, x, speed, 10.0, found) == -1
        assert np.array_equal(there, ends, equal_nan=True) and np.array_equal(speed, v)
    with pytest.raises(ConvergenceError):
        motion.project_positions(np.where(np.isnan(ends), 99.0, ends), x)
    v[bad] = np.nan
    speed = v.copy()
    assert not packed_tangents(x, speed, found)
    assert np.array_equal(speed, v, equal_nan=True)
