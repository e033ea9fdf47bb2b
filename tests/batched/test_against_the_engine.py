"""Batches against the engine on arrays: all families, cells, small and large clusters, rows that depend on others."""

import numpy as np
import pytest
import torch

from kcons import ConstraintSet, Motion
from kcons.batched import Batch, clusters
from kcons.constraints import Angle, Distance
from kcons.errors import ConvergenceError
from tests.systems.constraint_cases import CASES, MASSES, TIME, scattered
from tests.systems.rows_in_cells import CHAIN, ROWS
from tests.systems.rows_in_cells import MASSES as CHAIN_MASSES

STEP = 0.01
#: Functions of Python, of which the engine takes differences of eleven digits.
DIFFERENCED = {name for name in CASES if name.startswith("Custom")}


@pytest.fixture(params=["lanes", "levels"])
def elimination(request, monkeypatch):
    if request.param == "levels":
        monkeypatch.setattr(clusters, "LANES_ROWS", 0)


def engine(items, x, masses, cell=None, time=TIME):
    return Motion(ConstraintSet(items, x, masses, cell=cell, time=time), x, time=time)


def as_tensors(*arrays):
    return tuple(torch.as_tensor(np.concatenate(each)) for each in arrays)


def compare(motions, starts, size, *, time=TIME, bound=1e-13, rng=None):
    """Positions, velocities, multipliers and forces of several systems, by a batch and by their engines."""
    rng = rng or np.random.default_rng(1)
    batch = Batch(motions)
    parts = [[size * rng.normal(size=x.shape), *rng.normal(size=(2, *x.shape))] for x in starts]
    for motion, part in zip(motions, parts, strict=True):
        for each in part:
            each[motion.fixed_atoms] = 0
    x, d, v, f = as_tensors(starts, *zip(*parts, strict=True))
    later = {"time": time + STEP, "reference_time": time}
    found = [
        batch.project_positions(x + d, x, flight=STEP, **later),
        batch.project_positions(x + d, x, **later),
        batch.project_velocities(x, v, time=time),
    ]
    found.append(batch.multipliers(x, found[2], f, time=time))
    wanted = [[], [], [], []]
    for motion, x, (d, v, f) in zip(motions, starts, parts, strict=True):
        wanted[0].append(motion.project_positions(x + d, x, flight=STEP, **later))
        wanted[1].append(motion.project_positions(x + d, x, **later))
        wanted[2].append(motion.project_velocities(x, v, time=time))
        wanted[3].append(motion.multipliers(x, wanted[2][-1], f, time))
    for one, other in zip(found, map(np.concatenate, wanted), strict=True):
        assert np.abs(one.numpy() - other).max() <= bound * np.abs(other).max()


@pytest.mark.parametrize("name", CASES)
def test_families_are_held_as_the_engine_holds_them(name, elimination):
    motions = [engine([CASES[name]()], scattered(seed), MASSES) for seed in (6, 7, 6)]
    starts = [m.restore_positions(scattered(s), time=TIME) for m, s in zip(motions, (6, 7, 6), strict=True)]
    compare(motions, starts, 0.002, bound=1e-10 if name in DIFFERENCED else 1e-13)


@pytest.mark.parametrize("cell", [np.diag([7.0, 8.0, 9.0]), np.array([[7.0, 0, 0], [1.5, 8.0, 0], [-2.0, 1.3, 9.0]])])
@pytest.mark.parametrize("name", ROWS)
def test_rows_take_the_images_that_the_engine_takes(name, cell, elimination):
    """Each atom stored in any cell; a second system has none."""
    x = CHAIN + np.random.default_rng(1).integers(-2, 3, size=CHAIN.shape) @ cell
    motions = [engine(ROWS[name], x, CHAIN_MASSES, cell), engine(ROWS[name], CHAIN, CHAIN_MASSES)]
    starts = [m.restore_positions(y, time=TIME) for m, y in zip(motions, (x, CHAIN), strict=True)]
    compare(motions, starts, 0.02)


# -- many batches ------------------------------------------------------------------------------------


def random_system(rng):
    """One to three cases of rows of declared families, each on atoms of its own, with random masses."""
    names = sorted(set(CASES) - DIFFERENCED)
    n = len(MASSES)
    while True:
        cases = [CASES[name]() for name in rng.choice(names, size=rng.integers(1, 4))]
        items = [item.renumbered(np.arange(n) + n * k) for k, item in enumerate(cases)]
        x = np.concatenate([scattered(int(seed)) for seed in rng.integers(0, 40, size=len(cases))])
        motion = engine(items, x, rng.uniform(1, 30, size=len(x)))
        try:
            return motion, motion.restore_positions(x, time=TIME)
        except ConvergenceError:  # a target that is given is far from this place
            continue


@pytest.mark.parametrize("block", range(10))
def test_two_hundred_random_batches(block, elimination):
    """Of one to three systems each, any of which may be there several times."""
    rng = np.random.default_rng(block)
    systems = [random_system(rng) for _ in range(12)]
    for _ in range(10):  # by each of the two eliminations
        some = rng.choice(len(systems), size=rng.integers(1, 4))
        motions, starts = zip(*(systems[k] for k in some), strict=True)
        compare(motions, starts, 0.002, rng=rng)


def test_chains_and_rows_that_depend_on_others(elimination):
    """A chain of 40 bonds with angles; a tetrahedron and a planar ring with all their distances, one of them twice."""
    rng = np.random.default_rng(3)
    n = 41
    chain = np.stack([1.2 * np.arange(n), 0.9 * (np.arange(n) % 2), 0.3 * rng.normal(size=n)], axis=1)
    links = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
    long = [Distance(links), Angle(np.stack([links[:-1, 0], links[:-1, 1], links[1:, 1]], axis=1)[::3])]
    body = rng.normal(size=(5, 3)) * 1.5
    pairs = np.stack(np.triu_indices(5, 1), axis=1)  # ten distances, nine degrees of freedom
    some = engine(long, chain, rng.uniform(1, 16, n)), engine(Distance(pairs), body, rng.uniform(1, 16, 5))
    assert some[1].rank == 9
    compare([some[0], some[1], some[1]], [chain, body, body], 0.01)


def test_converted_rows_are_held_as_the_engine_holds_them(elimination):
    """Carbon dioxide by three distances: singular at second order, so held by a relation."""
    x = np.array([[0.0, 0, 0], [1.16, 0, 0], [-1.16, 0, 0]])
    motion = engine(Distance([[0, 1], [0, 2], [1, 2]]), x, np.array([12.0, 16.0, 16.0]))
    assert motion.conversions
    compare([motion] * 3, [x] * 3, 0.01)
    assert Batch(motion, copies=3).degrees_of_freedom.tolist() == [motion.degrees_of_freedom] * 3
