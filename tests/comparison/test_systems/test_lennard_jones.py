"""The small periodic fluids: forces and curvatures by differences, sampling without forces."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from kcons.comparison.test_systems.lennard_jones import LennardJones
from kcons.comparison.test_systems.near_molecules import NearMolecules
from scipy.spatial.transform import Rotation

from kcons.comparison.test_systems import fluid, lennard_jones, near_molecules
from kcons.errors import InputError


def triatomics() -> tuple[LennardJones, np.ndarray]:
    rng = np.random.default_rng(0)
    shape = np.array([[0, 0, 0], [0.7, 0, 0], [-0.2, 0.6, 0]])
    places = 1.91 * np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1) + 0.05 * rng.normal(size=(8, 3))
    x = np.concatenate([p + shape @ np.linalg.qr(rng.normal(size=(3, 3)))[0].T for p in places])
    fluid = LennardJones(
        np.repeat(range(8), 3),
        3.9,
        masses=np.tile([3.0, 1, 1], 8),
        sigma=np.tile([1.0, 0.7, 0.7], 8),
        charges=np.tile([-0.8, 0.4, 0.4], 8),
    )
    return fluid, x


def test_forces_are_the_slope_of_the_potential():
    fluid, x = triatomics()
    f, h = fluid.force(x), 1e-6
    for k in range(x.size):
        up, down = x.copy(), x.copy()
        up.flat[k] += h
        down.flat[k] -= h
        assert -(fluid.potential(up) - fluid.potential(down)) / (2 * h) == pytest.approx(f.flat[k], abs=1e-7)
    assert np.abs(f.sum(axis=0)).max() <= 1e-12


def test_images_do_not_matter():
    fluid, x = triatomics()
    y = x.copy()
    y[3:6] += [3.9, 0, -7.8]
    assert fluid.potential(y) == pytest.approx(fluid.potential(x), rel=1e-13)
    np.testing.assert_allclose(fluid.force(y), fluid.force(x), atol=1e-11)


def test_the_potential_is_smooth_at_the_cutoff():
    fluid = LennardJones([0, 1], 8.0, cutoff=2.5, charges=[1.0, -1.0])

    def u(r):
        return fluid.potential(np.array([[0.0, 0, 0], [r, 0, 0]]))

    assert u(2.5) == 0 == u(3.9)
    for r in (0.7 * 2.5, 2.5):
        h = 1e-4
        left, right = (u(r - 2 * h) - 2 * u(r - h) + u(r)), (u(r) - 2 * u(r + h) + u(r + 2 * h))
        assert left / h**2 == pytest.approx(right / h**2, abs=0.02)


def test_shifts_and_turns_of_molecules():
    fluid, x = triatomics()
    m = fluid.masses

    def moved(k, shift, turn):
        y, s = x.copy(), slice(3 * k, 3 * k + 3)
        centre = (m[s, None] * x[s]).sum(axis=0) / m[s].sum()
        y[s] = centre + shift + (x[s] - centre) @ Rotation.from_rotvec(turn).as_matrix().T
        return fluid.potential(y)

    none, h, middle = np.zeros(3), 1e-4, fluid.potential(x)
    sums = np.zeros(4)
    for k in range(8):
        for e in h * np.eye(3):
            ends = [(moved(k, e, none), moved(k, -e, none)), (moved(k, none, e), moved(k, none, -e))]
            for n, (up, down) in enumerate(ends):
                sums[2 * n] += ((up - down) / (2 * h)) ** 2
                sums[2 * n + 1] += (up + down - 2 * middle) / h**2
    for arm in (1.0, 0.5):
        square, curvature = fluid.rigid_sample(x, arm)
        assert square == pytest.approx(sums[0] + sums[2] / arm**2, rel=1e-5)
        assert curvature == pytest.approx(sums[1] + sums[3] / arm**2, rel=1e-5)


def test_metropolis_keeps_molecules_whole_and_counts_the_energy():
    fluid, x = triatomics()
    energies, y, accepted = fluid.metropolis(x, 1.5, 500, 10, 1, 0.2, 0.4)
    assert len(energies) == 50 and 0.1 < accepted < 0.9
    assert energies[-1] == pytest.approx(fluid.potential(y), rel=1e-10)
    for k in range(0, 24, 3):
        for i, j in ((0, 1), (0, 2), (1, 2)):
            assert np.linalg.norm(y[k + i] - y[k + j]) == pytest.approx(np.linalg.norm(x[k + i] - x[k + j]), rel=1e-11)
    again = fluid.metropolis(x, 1.5, 500, 10, 1, 0.2, 0.4)[0]
    assert np.array_equal(energies, again)


def test_metropolis_samples_two_atoms():
    """The mean energy of one pair is an integral over the box."""
    fluid = LennardJones([0, 1], 3.0)
    rng = np.random.default_rng(0)
    r = np.linalg.norm(3.0 * (rng.random((200_000, 3)) - 0.5), axis=1)
    u = np.array([fluid.potential(np.array([[0.0, 0, 0], [d, 0, 0]])) if d < 1.5 else 0.0 for d in r[:40_000]])
    weights = np.exp(-u / 1.5)
    expected = (u * weights)[weights > 0].sum() / weights.sum()
    energies, _, _ = fluid.metropolis(np.array([[0.0, 0, 0], [1.2, 0, 0]]), 1.5, 400_000, 4, 1, 0.6, 0.0)
    assert energies.mean() == pytest.approx(expected, abs=0.006)


def test_bad_input():
    """H40: with a cutoff above half the box a fluid of four atoms is 55 % too hot, and silent."""
    with pytest.raises(InputError, match=r"the cutoff 1 must be above 0 and at most half the box, 0\.79"):
        LennardJones(range(4), 1.58, cutoff=1.0)
    with pytest.raises(InputError, match="at most half the box"):
        LennardJones(range(4), 1.58, cutoff=-1.0)
    with pytest.raises(InputError, match="in the order of the atoms"):
        LennardJones([0, 1, 0], 3.0)


@pytest.mark.parametrize("kernel", [lennard_jones._metropolis, near_molecules._near_metropolis])
def test_moves_are_compiled_once_on_a_machine(kernel):
    """Functions as arguments are others in each process, for which no cache has anything."""
    chosen = fluid.dumbbells(8)
    forces = NearMolecules(chosen.forces, 0.4 * chosen.forces.box) if "near" in kernel.__name__ else chosen.forces
    forces.metropolis(chosen.positions, 1.0, 2, 1, 1, 0.1, 0.1)
    assert kernel.signatures
    assert not [kind for kinds in kernel.signatures for kind in kinds if isinstance(kind, numba.types.Dispatcher)]
