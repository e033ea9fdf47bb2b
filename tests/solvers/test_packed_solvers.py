"""Long chains, whose kernel writes at once, beside other solvers in one call; nothing changes where it fails."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ConvergenceError
from kcons.motion import Motion
from kcons.solvers.addressable_solvers import packed_positions, packed_tangents, set_lattice
from kcons.steppers.packed_system import packed_rows

TRIANGLE = np.array([[0.0, 0, 0], [1.0, 0, 0], [-0.3, 0.9, 0]])


def engine(chains=(100,), triangles: int = 0, stars: int = 0, ions: int = 0):
    """Helices of so many bonds, then molecules, then free atoms: the engine, where they are, and the packed rows."""
    rng = np.random.default_rng(5)
    shapes = []
    for number, n in enumerate(chains):
        k = np.arange(n + 1)
        helix = np.stack([np.cos(k), np.sin(k), 0.3 * k], axis=1) + 0.7 * number
        shapes.append((helix, np.stack([k[:-1], k[1:]], axis=1)))
    shapes += [(TRIANGLE + rng.normal(size=3), np.array([[0, 1], [0, 2], [1, 2]]))] * triangles
    shapes += [(rng.normal(size=(4, 3)), np.array([[0, 1], [0, 2], [0, 3]])) for _ in range(stars)]
    first = np.cumsum([0, *(len(where) for where, _ in shapes)])
    x = np.concatenate([*(where for where, _ in shapes), rng.normal(size=(ions, 3))])
    masses = [[16.0, 1.0, 1.0] if len(where) == 3 else np.linspace(1.0, 14.0, len(where)) for where, _ in shapes]
    pairs = np.concatenate([rows + begin for (_, rows), begin in zip(shapes, first, strict=False)])
    motion = Motion(ConstraintSet(Distance(pairs), x, np.concatenate([*masses, np.full(ions, 23.0)])), x)
    packed = packed_rows(motion)
    assert packed is not None and packed.called[-1].name == "Chains"
    set_lattice(packed.tables, None)
    return motion, x, packed  # tables are good as long as their solvers


def test_one_chain_is_the_engines_to_the_last_bit() -> None:
    """The kernel is the same, so that runs do not depend on who calls it."""
    motion, x, packed = engine([300])
    v = motion.project_velocities(x, np.random.default_rng(2).normal(size=x.shape))
    ends, push = x + 0.03 * v, v.copy()
    there, speed = ends.copy(), v.copy()
    motion.project_positions(ends, x, velocities=push, dt=0.03, out=ends)
    assert packed_positions(there, x, speed, 1.0 / 0.03, packed.tables) > 0
    assert np.array_equal(there, ends) and np.array_equal(speed, push)


@pytest.mark.parametrize(
    "options", [{}, {"triangles": 11}, {"triangles": 11, "stars": 3}, {"stars": 2, "ions": 300}, {"chains": [200, 7]}]
)
def test_nothing_changes_where_a_chain_has_no_solution(options) -> None:
    """Also not what was solved before it."""
    motion, x, packed = engine(**options)
    rng = np.random.default_rng(4)
    bad = 203 if "chains" in options else 50  # of the last chain
    for wrong in (40.0, np.nan):
        ends, v = x + 0.01 * rng.normal(size=x.shape), rng.normal(size=x.shape)
        ends[bad] += wrong
        there, speed = ends.copy(), v.copy()
        assert packed_positions(there, x, speed, 10.0, packed.tables) == -1
        assert np.array_equal(there, ends, equal_nan=True) and np.array_equal(speed, v)
    with pytest.raises(ConvergenceError):
        motion.project_positions(np.where(np.isnan(ends), 99.0, ends), x)
    v[bad] = np.nan
    speed = v.copy()
    assert not packed_tangents(x, speed, packed.tables)
    assert np.array_equal(speed, v, equal_nan=True)
