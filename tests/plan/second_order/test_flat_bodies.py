"""Groups that are flat or straight: what their converted rows do."""

from __future__ import annotations

import numpy as np
import pytest
from flat_groups import CO2, CONVERTED, Array, converted, counts, pairs_of, rank_of, ring, turned

from kcons.constraints import Distance, FixedAtoms
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion

# -- what the converted rows do ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "case", ["CO2 by 3", "OCS by 3", "hexagon by 15", "formate by 6", "benzene by 66", "two squares with a common edge"]
)
def test_all_distances_hold_over_2000_steps(case: str) -> None:
    """RATTLE steps by hand with forces in all directions; every original distance to 1e-14."""
    shape, pairs, _, _ = CONVERTED[case]
    x = turned(shape) * 1.0
    x -= x.mean(axis=0)
    masses = np.random.default_rng(5).uniform(1.0, 16.0, len(x))
    given = ConstraintSet(Distance(pairs), x, masses)
    motion = Motion(given, x)
    rng = np.random.default_rng(6)
    pull = rng.standard_normal((len(x), 3))
    m = masses[:, None]
    dt, worst = 0.02, 0.0
    v = motion.project_velocities(x, 0.3 * rng.standard_normal(x.shape))
    lengths = given.target()

    def force(x: Array) -> Array:
        return pull - 0.5 * x

    for _ in range(2000):
        v += 0.5 * dt * force(x) / m
        x = motion.project_positions(x + dt * v, x, velocities=v, dt=dt)
        v += 0.5 * dt * force(x) / m
        v = motion.project_velocities(x, v)
        worst = max(worst, float(np.max(np.abs(given.value(x)) / lengths)))
    assert worst <= 1e-14


def test_out_of_plane_force_turns_the_ring_as_a_rigid_body() -> None:
    """Accelerations of the converted hexagon are those of Euler's rigid body, to rounding."""
    rng = np.random.default_rng(2)
    x = turned(ring(6))
    masses = rng.uniform(1, 20, 6)
    motion = Motion(ConstraintSet(Distance(pairs_of(6)), x, masses), x)
    f = rng.standard_normal((6, 3))
    f[2] += 3.0
    a = motion.acceleration(x, np.zeros_like(x), f)
    m = masses[:, None]
    center = (m * x).sum(axis=0) / masses.sum()
    d = x - center
    inertia = np.sum(
        masses[:, None, None]
        * (np.einsum("ij,ij->i", d, d)[:, None, None] * np.eye(3) - d[:, :, None] * d[:, None, :]),
        axis=0,
    )
    expected = f.sum(axis=0) / masses.sum() + np.cross(np.linalg.solve(inertia, np.cross(d, f).sum(axis=0)), d)
    np.testing.assert_allclose(a, expected, atol=1e-13 * np.abs(expected).max())


def test_targets_of_base_distances_are_kept_to_the_last_bit() -> None:
    lengths = np.array([1.1600000000000001, 2.3299999999999996, 1.17])
    held = converted(Distance(pairs_of(3), lengths), turned([[0, 0, 0], [1.16, 0, 0], [2.33, 0, 0]]))
    assert held.target()[0] == lengths[1]


def test_weights_follow_the_targets_and_not_a_stretched_start() -> None:
    bent = CO2 + np.array([[0, 0, 0], [0, 0.02, 0], [0, 0, 0]])
    for shape, proper in ((1.2 * CO2, CO2), (bent, CO2), (1.2 * ring(6), ring(6))):
        x, pairs = turned(shape), pairs_of(len(shape))
        lengths = ConstraintSet(Distance(pairs), proper, np.ones(len(x))).target()
        given = ConstraintSet(Distance(pairs, lengths), x, np.ones(len(x)))
        motion = Motion(given, x)
        restored = motion.restore_positions(x)
        assert motion.rank == 3 * len(x) - (5 if len(x) == 3 else 6)
        assert np.max(np.abs(given.value(restored)) / lengths) < 1e-14


@pytest.mark.parametrize("noise", [1e-7, 1e-4, 1e-3])
def test_puckered_start_with_planar_targets_is_held_as_planar(noise: float) -> None:
    x0 = turned(ring(6))
    lengths = ConstraintSet(Distance(pairs_of(6)), x0, np.ones(6)).target()
    x = x0 + noise * np.random.default_rng(4).standard_normal(x0.shape)
    given = ConstraintSet(Distance(pairs_of(6), lengths), x, np.ones(6))
    motion = Motion(given, x)
    assert motion.rank == motion.constraint_set.n_rows == 12
    restored = motion.restore_positions(x)
    assert np.max(np.abs(given.value(restored)) / lengths) < 1e-14


def test_many_puckered_rings_are_all_found() -> None:
    """More of them than regular blocks are sampled; noise of 1e-3 on planar targets."""
    rng = np.random.default_rng(0)
    flat = np.vstack([turned(ring(4), seed=k) + 20 * rng.standard_normal(3) for k in range(150)])
    pairs = np.vstack([np.array(pairs_of(4)) + 4 * k for k in range(150)])
    lengths = ConstraintSet(Distance(pairs), flat, np.ones(600)).target()
    held = converted(Distance(pairs, lengths), flat + 1e-3 * rng.standard_normal(flat.shape))
    assert counts(held) == (450, 450)


def test_group_across_a_periodic_boundary() -> None:
    x = np.mod(ring(6) + np.array([3.0, 0.2, 9.9]), 10.0)
    held = converted(Distance(pairs_of(6)), x, cell=[10.0, 10.0, 10.0])
    assert counts(held) == (3, 9)
    assert np.abs(held.value(x)).max() < 1e-14


def test_only_the_rows_of_the_flat_group_change() -> None:
    """A rigid water and a flexible tail beside and on the ring stay as they were."""
    water = np.array([[5.0, 5, 5], [5.96, 5, 5], [4.76, 5.93, 5]])
    x = np.vstack([ring(6), [[2.9, 0, 0.3], [3.3, 1.4, 0.1]], water])
    rows = [Distance([(0, 6), (6, 7), *pairs_of(6)]), Distance([(8, 9), (8, 10), (9, 10)])]
    held = converted(rows, x)
    assert [(c.family, c.n_rows) for c in held.constraints] == [
        ("Distance", 2),
        ("Distance", 3),
        ("Distance", 3),
        ("LinearRelation", 9),
    ]
    assert held.constraints[0].atoms.tolist() == [[0, 6], [6, 7]]
    assert rank_of(held, x) == held.n_rows == 17


def test_fixed_atoms_become_bases() -> None:
    x = ring(6)
    held = converted([Distance(pairs_of(6)), FixedAtoms([2])], x)
    motion = Motion(held, x)
    assert motion.degrees_of_freedom == 3
    relation = held.constraints[-1]
    assert relation.family == "LinearRelation" and (relation.atoms[:, 1:] == 2).any(axis=1).all()
