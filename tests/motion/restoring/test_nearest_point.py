"""Starts far off the constraints: the nearest point in the mass metric, or a plain refusal."""

from __future__ import annotations

import warnings
from itertools import combinations

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints import projection
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InfeasibleError
from kcons.motion import Motion, solver_sequence
from kcons.motion.restoring import nearest_point

WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])
TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
METHANE = np.vstack([np.zeros(3), 0.629 * TETRAHEDRON])
ZIGZAG = np.cumsum(np.tile([[0.8, 0.9, 0.1], [0.9, -0.8, 0.2]], (10, 1)), axis=0)


def all_pairs(n: int) -> list[tuple[int, int]]:
    return list(combinations(range(n), 2))


SETS = {
    "water": ([held.Distance(all_pairs(3))], WATER),
    "star": ([held.Distance([(0, k) for k in range(1, 5)])], METHANE),
    "methane, dependent": ([held.Distance(all_pairs(5))], METHANE),
    "chain": ([held.Distance([(k, k + 1) for k in range(19)])], ZIGZAG),
    "chain with angles": (
        [held.Distance([(k, k + 1) for k in range(19)]), held.Angle([(k, k + 1, k + 2) for k in range(18)])],
        ZIGZAG,
    ),
    "anchored": ([held.FixedAtoms([0]), held.Distance([(k, k + 1) for k in range(4)])], ZIGZAG[:5]),
    "collective": ([held.Distance([(0, 1)]), held.RadiusOfGyration([[0, 1, 2, 3]])], METHANE[:4]),
    "surface": ([held.Torus([0, 1, 2], [0, 0, 3.0], [0, 0.2, 1], 2.5, None)], WATER),
}


def engine(name: str, seed: int = 0) -> tuple[Motion, ConstraintSet, np.ndarray]:
    rows, x = SETS[name]
    whole = ConstraintSet(rows, x, 10 ** np.random.default_rng(seed).uniform(0, 1.5, len(x)))
    return Motion(whole, x), whole, x


def fulfilled(whole: ConstraintSet, x: np.ndarray, time: float = 0.0) -> None:
    assert np.all(np.abs(whole.value(x, time)) <= whole.tolerance(x, time))


def off_the_perpendicular(whole: ConstraintSet, motion: Motion, start: np.ndarray, x: np.ndarray) -> float:
    """Part of sqrt(M) (x - start) outside the mass-weighted rows at x, relative to its size; fixed atoms apart."""
    movable = motion.plan.inverse_masses > 0
    root_m = np.sqrt(whole.masses[movable])[:, None]
    A = whole.jacobian(x).toarray().reshape(whole.n_rows, -1, 3)[motion.plan.labels >= 0][:, movable]
    V = projection.row_space((A / root_m).reshape(len(A), -1))
    y = (root_m * (x - start)[movable]).ravel()
    return float(np.linalg.norm(y - V @ (V.T @ y)) / np.linalg.norm(y))


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("seed", range(3))
def test_nearest_point(name: str, seed: int) -> None:
    motion, whole, x = engine(name, seed)
    start = x + 0.05 * np.random.default_rng(seed).normal(size=x.shape)
    kept = start.copy()
    found = motion.restore_positions(start)
    np.testing.assert_array_equal(start, kept)
    fulfilled(whole, found)
    assert off_the_perpendicular(whole, motion, start, found) < 1e-9
    # No point nearby on the constraints is nearer.
    movable = (motion.plan.inverse_masses > 0)[:, None]

    def distance(y: np.ndarray) -> float:
        return float(np.sum(whole.masses[:, None] * movable * (y - start) ** 2))

    for k in range(5):
        direction = motion.project_velocities(found, np.random.default_rng(k).normal(size=x.shape))
        aside = motion.project_positions(found + 1e-3 * direction, found)
        assert distance(aside) >= distance(found) * (1 - 1e-12)


@pytest.mark.parametrize("unit", [2.0**-33, 2.0**30])
def test_the_nearest_point_is_the_same_in_any_unit(unit: float) -> None:
    rng = np.random.default_rng(9)  # a search that takes many rounds
    x, masses = rng.normal(size=(4, 3)), rng.uniform(1, 16, 4)
    start = x + 0.25 * rng.normal(size=x.shape)

    def nearest(length: float) -> np.ndarray:
        motion = Motion(ConstraintSet(held.Angle([(0, 1, 2), (1, 2, 3)]), length * x, masses), length * x)
        return motion.restore_positions(length * start, bonds=[]) / length

    np.testing.assert_allclose(nearest(unit), nearest(1.0), rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("factor", [0.8, 1.2, 0.5, 2.0])
def test_scaled_starts(name: str, factor: float) -> None:
    """All lengths 20 % or a factor of two off."""
    motion, whole, x = engine(name)
    start = x.mean(axis=0) + factor * (x - x.mean(axis=0)) + 0.02 * np.random.default_rng(1).normal(size=x.shape)
    fulfilled(whole, motion.restore_positions(start))


@pytest.mark.parametrize("seed", range(5))
def test_folded_starts(seed: int) -> None:
    """Random positions, nothing near what is held."""
    motion, whole, x = engine("chain with angles")
    fulfilled(whole, motion.restore_positions(x + 0.4 * np.random.default_rng(seed).normal(size=x.shape)))


@pytest.mark.parametrize("free", [0, 10])
def test_infeasible_rows_quote_the_least_squares_optimum(free: int) -> None:
    """Two atoms held one apart, and in planes three apart, alone or after others.

    min (d - 1)^2 + a^2 + (b - 3)^2 with d = b - a along x: each is 2/3, the sum of squares 4/3.
    """
    x = np.vstack([np.arange(3.0 * free).reshape(free, 3) + 20, [[0.2, 0, 0], [0.9, 0.7, 0.1]]])
    ends = [free, free + 1]
    rows = [held.Distance(ends, 1.0), held.Plane(ends, [1.0, 0, 0], [0.0, 3.0])]
    whole = ConstraintSet(rows, x, np.ones(len(x)))
    kept = x.copy()
    out = np.full_like(x, 5.0)
    with pytest.raises(InfeasibleError, match=r"cannot go below 1\.33333 \(sum of squares\)") as caught:
        Motion(whole, x).restore_positions(x, out=out)
    np.testing.assert_array_equal(x, kept)
    assert (out == 5.0).all()
    assert caught.value.row in (0, 1, 2) and set(caught.value.atoms) <= set(ends)
    assert "Check its target" in str(caught.value)


def test_one_bad_cluster_among_good_ones() -> None:
    """A cluster of many that is far off does not disturb the others."""
    times = 40
    x = (WATER + 5.0 * np.arange(times)[:, None, None]).reshape(-1, 3)
    pairs = np.concatenate([np.array(all_pairs(3)) + 3 * k for k in range(times)])
    whole = ConstraintSet(held.Distance(pairs), x, np.tile([16.0, 1, 1], times))
    start = x.copy()
    start[30:33] = 2.2 * (x[30:33] - x[30]) + x[30] + [[0, 0, 0], [0.1, 0.3, 0], [0.2, 0, -0.2]]
    found = Motion(whole, x).restore_positions(start)
    fulfilled(whole, found)
    others = np.r_[0:30, 33 : 3 * times]
    np.testing.assert_allclose(found[others], x[others], rtol=0, atol=1e-13)


def test_long_chain_off_by_a_fifth() -> None:
    """More rows than dense algebra takes: by sparse Gauss-Newton."""
    n = 3000
    k = np.arange(n)
    x = np.stack([0.8 * k, 0.6 * (k % 2), 0.05 * np.sin(k)], axis=1)
    whole = ConstraintSet(held.Distance(np.stack([k[:-1], k[1:]], axis=1), 1.0), x, np.ones(n))
    start = 1.2 * x + 0.05 * np.random.default_rng(0).normal(size=x.shape)
    fulfilled(whole, Motion(whole, x).restore_positions(start))


#: Bonds and next neighbors of a chain are held: it bends, and the surface of its rows with it.
BRACED = np.array([[1.25 * k, 0.45 * (-1) ** k, 0.1 * np.sin(k)] for k in range(9)])
BRACES = [(k, k + 1) for k in range(8)] + [(k, k + 2) for k in range(7)]


def _braced() -> tuple[Motion, ConstraintSet, np.ndarray]:
    whole = ConstraintSet(held.Distance(BRACES), BRACED, np.random.default_rng(13).uniform(1, 14, 9))
    return Motion(whole, BRACED), whole, BRACED


def _displaced(rng: np.random.Generator, share: float) -> np.ndarray:
    d = rng.normal(size=BRACED.shape)
    return d / np.sqrt((d**2).sum(axis=1).mean()) * share * np.linalg.norm(BRACED[1] - BRACED[0])


def test_the_nearest_point_is_found_where_the_surface_is_much_bent() -> None:
    """Curved by nearly as much as the start is away, so that plain rounds hardly gain."""
    motion, whole, x = _braced()
    rng = np.random.default_rng(13)
    rng.uniform(1, 14, 9)
    for share in np.repeat([0.05, 0.1, 0.15, 0.2, 0.25, 0.3], 14):
        start = x + _displaced(rng, share)
        found = motion.restore_positions(start, bonds=[])
        fulfilled(whole, found)
        assert off_the_perpendicular(whole, motion, start, found) < 1e-9


def test_a_search_that_ends_before_the_nearest_point_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    motion, whole, x = _braced()
    start = x + _displaced(np.random.default_rng(0), 0.15)
    monkeypatch.setattr(solver_sequence, "MOST_ITERATIONS", 2)
    for module in (solver_sequence, nearest_point):
        monkeypatch.setattr(module, "FAILED", 5)
    with pytest.warns(UserWarning, match=r"fulfil all rows, but are not the nearest.* Start nearer"):
        found = motion.restore_positions(start, bonds=[])
    fulfilled(whole, found)
    assert off_the_perpendicular(whole, motion, start, found) > 1e-6
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        monkeypatch.undo()
        motion.restore_positions(start, bonds=[])
