"""The solver table: every line is picked for the shape it is made for, with its rank."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ContradictionError, UnsupportedError
from kcons.motion import Motion
from kcons.plan import make_plan

WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])
TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
METHANE = np.vstack([np.zeros(3), 0.629 * TETRAHEDRON])
ZIGZAG = np.cumsum(np.tile([[0.8, 0.9, 0.1], [0.9, -0.8, 0.2]], (10, 1)), axis=0)


def all_pairs(n: int) -> list[tuple[int, int]]:
    return list(combinations(range(n), 2))


def many(shape: np.ndarray, pairs, times: int) -> tuple[held.Distance, np.ndarray]:
    shift = np.random.default_rng(0).uniform(-20, 20, (times, 1, 3))
    rows = np.concatenate([np.array(pairs) + len(shape) * k for k in range(times)])
    return held.Distance(rows), (shape + shift).reshape(-1, 3)


def planned(rows, x, masses=None):
    constraint_set = ConstraintSet(rows, x, np.ones(len(x)) if masses is None else masses)
    return make_plan(constraint_set, np.asarray(x), 0.0)


def test_dependent_rows_are_listed_cluster_by_cluster() -> None:
    rows, x = many(METHANE, all_pairs(5), 3)
    plan = planned(rows, x)
    assert sorted(part.tolist() for part in plan.dependent) == [list(range(10 * k, 10 * k + 10)) for k in range(3)]


# -- rows between fixed atoms -----------------------------------------------------------------------


def test_fulfilled_rows_between_fixed_atoms_are_dropped() -> None:
    plan = planned([held.FixedAtoms([0, 1]), held.Distance([[0, 1], [1, 2]])], WATER)
    assert plan.labels.tolist() == [-1] * 7 + [0]
    assert plan.rank == 7 and plan.loose is None


@pytest.mark.parametrize(
    "row",
    [held.Distance([0, 1], 1.1), held.LinearVelocity([[0, 1]], np.eye(3)[:2], 0.5), held.Plane(0, [1.0, 0, 0], 2)],
)
def test_rows_between_fixed_atoms_that_contradict_are_refused(row) -> None:
    far = np.vstack([np.full((20, 3), 9.0) + np.arange(20)[:, None], WATER])
    shifted = row.renumbered(np.arange(3) + 20)
    with pytest.raises(ContradictionError, match=r"between fixed atoms.*(free|remove)") as caught:
        Motion(ConstraintSet([held.FixedAtoms([20, 21]), shifted], far, np.ones(23)), far)
    assert caught.value.rows == (6,)
    assert set(caught.value.atoms) <= {20, 21} and str(20) in str(caught.value)


def test_atoms_fixed_on_a_path_that_breaks_a_row_between_them() -> None:
    """Dropped rows are watched as long as something moves; nothing changes on failure."""
    rows = [
        held.FixedAtoms([0], lambda t: WATER[0]),
        held.FixedAtoms([1], lambda t: WATER[1] + [0, 0, t]),
        held.Distance([[0, 1], [1, 2]]),
    ]
    motion = Motion(ConstraintSet(rows, WATER, np.ones(3)), WATER)
    assert motion.plan.loose is not None
    motion.project_positions(WATER, WATER, time=0.0)
    x, v = WATER + 0.01, np.zeros((3, 3))
    kept = x.copy()
    with pytest.raises(ContradictionError, match=r"#6 Distance\(0, 1\)"):
        motion.project_positions(x, WATER, time=0.3, out=x, velocities=v, dt=0.1)
    np.testing.assert_array_equal(x, kept)
    assert not v.any()


def test_velocity_row_between_fixed_atoms_that_agrees() -> None:
    moving = held.FixedAtoms([0], held.MovingTarget(lambda t: [t, 0.0, 0.0], lambda t: [1.0, 0, 0], lambda t: 0.0))
    plan = planned([moving, held.LinearVelocity([[0]], [[1.0, 0, 0]], 1.0)], WATER)
    assert plan.rank == 3
    with pytest.raises(ContradictionError):
        planned([moving, held.LinearVelocity([[0]], [[1.0, 0, 0]], 1.1)], WATER)


def test_too_large_for_the_dense_rescue() -> None:
    plan = planned(held.Distance([(k, k + 1) for k in range(19)]), ZIGZAG)
    with pytest.raises(UnsupportedError, match="cluster of 19 rows around #0 Distance"):
        plan.general_for_all(18)
    assert len(plan.general_for_all(19).rows) == 19


# -- rows that are named twice ----------------------------------------------------------------------


def test_atoms_that_are_fixed_twice_count_once() -> None:
    held_twice = [held.FixedAtoms([0, 1]), held.FixedAtoms([1, 0]), held.Distance([1, 2])]
    motion = Motion(ConstraintSet(held_twice, WATER, np.ones(3)), WATER)
    assert (motion.rank, motion.degrees_of_freedom) == (7, 2)
    f = np.arange(9.0).reshape(3, 3)
    force = motion.constraint_force(WATER, 0 * WATER, f)
    assert force == pytest.approx(motion.acceleration(WATER, 0 * WATER, f) - f, abs=1e-13)


def test_atoms_that_are_fixed_at_two_places_are_refused() -> None:
    rows = [held.FixedAtoms(0), held.FixedAtoms(0, [9.0, 9.0, 9.0])]
    with pytest.raises(ContradictionError, match=r"row #3 FixedAtoms\(0\) .* is off by .*; remove it"):
        planned(rows, WATER)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_multipliers_of_dependent_rows_in_very_different_units(unit: float) -> None:
    x, rng = unit * np.array([[0.0, 0, 0], [1.0, 0.2, 0], [0.3, 1.1, 0.4]]), np.random.default_rng(0)
    volume = held.Custom([0, 1], lambda r: float(np.sum((r[0] - r[1]) ** 2) ** 2), length=unit)
    motion = Motion(ConstraintSet([held.Distance([1, 2]), volume, volume, held.Angle([0, 1, 2])], x, np.ones(3)), x)
    f = rng.normal(size=x.shape)
    motion_force = motion.acceleration(x, 0 * x, f) - f
    assert motion.constraint_force(x, 0 * x, f) == pytest.approx(motion_force, abs=1e-9)
    twice = motion.multipliers(x, 0 * x, f)[1:3]
    assert twice[0] == pytest.approx(twice[1], rel=1e-6)
