"""Batches against the engine on arrays: all families, cells, small and large clusters, rows that depend on others."""

import numpy as np
import pytest
import torch

from kcons import ConstraintSet, Motion
from kcons.batched import Batch, clusters
from kcons.constraints import Angle, Custom, CustomVelocity, Dihedral, Distance, FixedAtoms, ImplicitSurface, Sphere
from kcons.errors import ConvergenceError, InputError, UnsupportedError
from tests.systems.constraint_cases import CASES, MASSES, TIME, scattered
from tests.systems.rows_in_cells import CHAIN, ROWS
from tests.systems.rows_in_cells import MASSES as CHAIN_MASSES

STEP = 0.01
#: What the engine itself takes from differences, and how well it knows its multipliers then: its differences have that many digits.
DIFFERENCED = {name: 1e-9 for name in CASES if "differenced" in name or "without a gradient" in name}


@pytest.fixture(params=["written out", "by levels"], autouse=True)
def elimination(request, monkeypatch):
    if request.param == "by levels":
        monkeypatch.setattr(clusters, "LANES_ROWS", 0)


def engine(items, x, masses, cell=None, time=TIME):
    return Motion(ConstraintSet(items, x, masses, cell=cell, time=time), x, time=time)


def as_tensors(*arrays):
    return tuple(torch.as_tensor(np.concatenate(each)) for each in arrays)


def compare(motions, starts, size, *, time=TIME, bound=1e-13, cell=None, rng=None):
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
        batch.multipliers(x, v, f, time=time),
    ]
    wanted = [[], [], [], []]
    for motion, x, (d, v, f) in zip(motions, starts, parts, strict=True):
        wanted[0].append(motion.project_positions(x + d, x, flight=STEP, **later))
        wanted[1].append(motion.project_positions(x + d, x, **later))
        wanted[2].append(motion.project_velocities(x, v, time=time))
        wanted[3].append(motion.multipliers(x, v, f, time))
    for one, other in zip(found, map(np.concatenate, wanted), strict=True):
        assert np.abs(one.numpy() - other).max() <= bound * np.abs(other).max()


@pytest.mark.parametrize("name", CASES)
def test_families_are_held_as_the_engine_holds_them(name):
    motions = [engine([CASES[name]()], scattered(seed), MASSES) for seed in (6, 7, 6)]
    starts = [m.restore_positions(scattered(s), time=TIME) for m, s in zip(motions, (6, 7, 6), strict=True)]
    compare(motions, starts, 0.002, bound=DIFFERENCED.get(name, 1e-13))


@pytest.mark.parametrize("cell", [np.diag([7.0, 8.0, 9.0]), np.array([[7.0, 0, 0], [1.5, 8.0, 0], [-2.0, 1.3, 9.0]])])
@pytest.mark.parametrize("name", ROWS)
def test_rows_take_the_images_that_the_engine_takes(name, cell):
    """Each atom stored in any cell; a second system has none."""
    x = CHAIN + np.random.default_rng(1).integers(-2, 3, size=CHAIN.shape) @ cell
    motions = [engine(ROWS[name], x, CHAIN_MASSES, cell), engine(ROWS[name], CHAIN, CHAIN_MASSES)]
    starts = [m.restore_positions(y, time=TIME) for m, y in zip(motions, (x, CHAIN), strict=True)]
    compare(motions, starts, 0.02)
