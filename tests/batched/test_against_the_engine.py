"""Batches against the engine on arrays: all families, cells, small and large clusters, rows that depend on others."""

import numpy as np
import pytest
import torch

from kcons import ConstraintSet, Motion
from kcons.batched import Batch, clusters
from kcons.constraints import Angle, Custom, Distance, VelocityFormula
from kcons.errors import ConvergenceError
from tests.systems.constraint_cases import CASES, MASSES, scattered
from tests.systems.rows_in_cells import CHAIN, ROWS
from tests.systems.rows_in_cells import MASSES as CHAIN_MASSES

STEP = 0.01
#: Families at rest.
STILL = {name: make for name, make in CASES.items() if not make().moving}
STILL["VelocityFormula-driven"] = lambda: VelocityFormula("vz1 + x1*vy1", [0, 3], target=[0.3, -0.2])
STILL["Custom-array"] = lambda: Custom([[0, 1], [3, 5]], lambda r: np.asarray(r[0, 0] * r[1, 1] + r[0, 2]))
#: Functions of Python, of which the engine takes differences of eleven digits.
DIFFERENCED = {name for name in STILL if name.startswith("Custom")}


@pytest.fixture(params=["lanes", "levels"])
def elimination(request, monkeypatch):
    if request.param == "levels":
        monkeypatch.setattr(clusters, "LANES_ROWS", 0)


def engine(items, x, masses, cell=None):
    return Motion(ConstraintSet(items, x, masses, cell=cell), x)


def as_tensors(*arrays):
    return tuple(torch.as_tensor(np.concatenate(each)) for each in arrays)


def compare(motions, starts, size, *, bound=1e-13, rng=None):
    """Positions, velocities, multipliers and forces of several systems, by a batch and by their engines."""
    rng = rng or np.random.default_rng(1)
    batch = Batch(motions)
    parts = [[size * rng.normal(size=x.shape), *rng.normal(size=(2, *x.shape))] for x in starts]
    for motion, part in zip(motions, parts, strict=True):
        for each in part:
            each[motion.fixed_atoms] = 0
    x, d, v, f = as_tensors(starts, *zip(*parts, strict=True))
    found = [
        batch.project_positions(x + d, x, flight=STEP),
        batch.project_positions(x + d, x),
        batch.project_velocities(x, v),
    ]
    found.append(batch.multipliers(x, found[2], f))
    wanted = [[], [], [], []]
    for motion, x, (d, v, f) in zip(motions, starts, parts, strict=True):
        wanted[0].append(motion.project_positions(x + d, x, flight=STEP))
        wanted[1].append(motion.project_positions(x + d, x))
        wanted[2].append(motion.project_velocities(x, v))
        wanted[3].append(motion.multipliers(x, wanted[2][-1], f))
    for one, other in zip(found, map(np.concatenate, wanted), strict=True):
        assert np.abs(one.numpy() - other).max() <= bound * np.abs(other).max()


@pytest.mark.parametrize("name", STILL)
def test_families_are_held_as_the_engine_holds_them(name, elimination):
    motions = [engine([STILL[name]()], scattered(seed), MASSES) for seed in (6, 7, 6)]
    starts = [m.restore_positions(scattered(s)) for m, s in zip(motions, (6, 7, 6), strict=True)]
    compare(motions, starts, 0.002, bound=1e-10 if name in DIFFERENCED else 1e-13)


@pytest.mark.parametrize("cell", [np.diag([7.0, 8.0, 9.0]), np.array([[7.0, 0, 0], [1.5, 8.0, 0], [-2.0, 1.3, 9.0]])])
@pytest.mark.parametrize("name", [name for name in ROWS if not name.startswith("moving")])
def test_rows_take_the_images_that_the_engine_takes(name, cell, elimination):
    """Each atom stored in any cell; a second system has none."""
    x = CHAIN + np.random.default_rng(1).integers(-2, 3, size=CHAIN.shape) @ cell
    motions = [engine(ROWS[name], x, CHAIN_MASSES, cell), engine(ROWS[name], CHAIN, CHAIN_MASSES)]
    starts = [m.restore_positions(y) for m, y in zip(motions, (x, CHAIN), strict=True)]
    compare(motions, starts, 0.02)


# -- many batches ------------------------------------------------------------------------------------


def random_system(rng):
    """One to three cases of rows of declared families, each on atoms of its own, with random masses."""
    names = sorted(set(STILL) - DIFFERENCED)
    n = len(MASSES)
    while True:
        cases = [STILL[name]() for name in rng.choice(names, size=rng.integers(1, 4))]
        items = [item.renumbered(np.arange(n) + n * k) for k, item in enumerate(cases)]
        x = np.concatenate([scattered(int(seed)) for seed in rng.integers(0, 40, size=len(cases))])
        motion = engine(items, x, rng.uniform(1, 30, size=len(x)))
        try:
            return motion, motion.restore_positions(x)
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
    """A chain of 40 bonds with angles; a body with all its distances; one singular at second order: converted."""
    rng = np.random.default_rng(3)
    n = 41
    chain = np.stack([1.2 * np.arange(n), 0.9 * (np.arange(n) % 2), 0.3 * rng.normal(size=n)], axis=1)
    links = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
    long = [Distance(links), Angle(np.stack([links[:-1, 0], links[:-1, 1], links[1:, 1]], axis=1)[::3])]
    body = rng.normal(size=(5, 3)) * 1.5
    pairs = np.stack(np.triu_indices(5, 1), axis=1)  # ten distances, nine degrees of freedom
    some = engine(long, chain, rng.uniform(1, 16, n)), engine(Distance(pairs), body, rng.uniform(1, 16, 5))
    assert some[1].rank == 9
    line = np.array([[0.0, 0, 0], [1.16, 0, 0], [-1.16, 0, 0]])
    straight = engine(Distance([[0, 1], [0, 2], [1, 2]]), line, np.array([12.0, 16.0, 16.0]))
    assert straight.conversions
    compare([*some, some[1], straight], [chain, body, body, line], 0.01)
