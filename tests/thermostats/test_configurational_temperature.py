"""The temperature of configurations, whole and by kind of motion; the share of slow forces in the stiffness."""

from __future__ import annotations

import itertools
import math

import fluids as fluid
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from thermostat_systems import dumbbells, grouped, system, waves

from kcons import ConstraintSet, Motion
from kcons.constraints import Distance, FixedAtoms, Formula, Plane, Sphere
from kcons.errors import InputError
from kcons.steppers import System
from kcons.thermostats import Estimate, TemperatureSplit, mean, slow_share


def test_estimates():
    still = mean(np.ones(40))
    assert (still.off(1.0), still.off(2.0), still.off(0.5)) == (0.0, -math.inf, math.inf)
    assert Estimate(1.1, 0.05).off(1.0) == pytest.approx(2.0)
    assert Estimate(1.1, 0.03).off(1.0, 0.04) == pytest.approx(2.0)


# -- statistics -------------------------------------------------------------------------------------


KT = 0.6
#: Free molecules of a kind, which do not act on each other: that many independent samples at once.
COPIES = 250


def repeated(held: System, x, times: int, **options) -> TemperatureSplit:
    """The same configuration so many times."""
    split = TemperatureSplit(held, **options)
    for _ in range(times):
        split.add(x)
    return split


def curvatures(split: TemperatureSplit) -> list[tuple[float, float]]:
    """Means and errors of the second derivatives of all clusters, by kind."""
    return [mean(column) for column in np.array(split._series)[:, 1].T]


# -- exactly ----------------------------------------------------------------------------------------


def test_a_dumbbell_on_springs():
    """U = k x^2/2 of both atoms: m_a + m_b on 2k; the turn has no slope with equal masses, and a curvature of 0."""
    k, m, d = 3.0, 2.0, 1.4
    x = np.array([[0.3, -0.2, 0.1], [0.3, -0.2, 0.1 + d]])
    split = repeated(system([Distance([[0, 1]])], x, [m, m], lambda x, t: -k * x), x, 40)
    above, below = (np.array(split._series)[:, row] for row in (0, 1))
    center = x.mean(axis=0)
    assert above[:, 0] == pytest.approx((2 * k) ** 2 * (center @ center) / (2 * m), rel=1e-12)
    assert below[:, 0] == pytest.approx(3 * 2 * k / (2 * m), rel=1e-6)  # signs along the axes: no noise
    assert np.abs(above[:, 1:]).max() < 1e-20 and np.abs(below[:, 1:]).max() < 1e-5
    found = split.result()
    assert (found.shifts, found.turns, found.samples) == (3, 2, 40)
    assert found.shift_frequency == pytest.approx(math.sqrt(k / m), rel=1e-6) and found.turn_frequency < 0.01
    assert found.turn is None and found.internal is None
    assert found.left_out == ("no force turns clusters as a whole: that has no temperature",)


def test_a_cluster_alone_has_no_temperature_of_shifts_and_turns():
    """What is left of its forces when they are added up is rounding: 0 K before."""
    x = np.array([[0.0, 0.1, 0.0], [1.0, 0.0, 0.2], [1.3, 0.9, 0.0]])

    def spring(x, t):
        pull = (np.linalg.norm(x[2] - x[0]) - 1.5) * (x[2] - x[0])
        return np.array([pull, 0 * pull, -pull]) + 1e-16 * np.random.default_rng(0).standard_normal((3, 3))

    found = repeated(system([Distance([[0, 1], [1, 2]])], x, [1.0, 2.0, 3.0], spring), x, 40).result()
    assert found.shift is None and found.turn is None and found.internal is not None
    assert [words.split()[2] for words in found.left_out] == ["shifts", "turns"]


def test_curvatures_of_a_fluid():
    """Against differences of forces and torques of whole molecules: one configuration, many draws."""
    chosen = fluid.dumbbells(8)
    forces, kt = chosen.forces, chosen.thermal_energy
    x = forces.metropolis(chosen.positions, kt, 500, 10, 1, chosen.shift, chosen.turn)[1]
    split = repeated(chosen.system(), x, 1000, rng=3)
    centers = x.reshape(8, 2, 3).mean(axis=1, keepdims=True)

    def loads(arms, moved=0.0):
        """Force and torque on each molecule."""
        f = forces.force((centers + arms + moved).reshape(-1, 3)).reshape(8, 2, 3)
        return f.sum(axis=1), np.cross(arms, f).sum(axis=1)

    arms, h, bend, twist = x.reshape(8, 2, 3) - centers, 1e-5, 0.0, 0.0
    for k, axis, sign in itertools.product(range(8), np.eye(3), (-1, 1)):
        this = (np.arange(8) == k)[:, None, None]
        turned = np.where(this, Rotation.from_rotvec(sign * h * axis).apply(arms[k]), arms)
        bend -= sign * loads(arms, this * sign * h * axis)[0][k] @ axis / (2 * h)
        twist -= sign * loads(turned)[1][k] @ axis / (2 * h)
    mass, inertia = 2.0, 2 * (0.5 * fluid.BOND) ** 2
    above = np.array(split._series)[0, 0]
    for found, each, size in zip(above[:2], loads(arms), (mass, inertia), strict=True):
        assert found == pytest.approx((each**2).sum() / size, rel=1e-9)
    shift, turn, rest = curvatures(split)
    assert abs(shift.off(bend / mass)) <= 3.5 and shift.error < 0.04 * shift.value
    assert abs(turn.off(twist / inertia)) <= 3.5 and turn.error < 0.04 * turn.value
    assert rest.value == 0


def _density(angle: np.ndarray | float, masses: np.ndarray) -> np.ndarray | float:
    """Volume of the constraint surface, of an angle: with det Z of the two bonds."""
    w = 1.0 / masses
    return np.sin(angle) * np.sqrt((w[0] + w[1]) * (w[0] + w[2]) - (w[0] * np.cos(angle)) ** 2)


# -- against a sampler without forces ---------------------------------------------------------------


def bent(centers: np.ndarray, turns: np.ndarray, angle: np.ndarray, masses: np.ndarray) -> np.ndarray:
    """Two arms of length 1 about a hub, shape (copies, 3, 3)."""
    shape = np.zeros((len(angle), 3, 3))
    shape[:, 1, 0], shape[:, 2, 0], shape[:, 2, 1] = 1.0, np.cos(angle), np.sin(angle)
    shape -= np.einsum("a,nak->nk", masses / masses.sum(), shape)[:, None]
    return centers[:, None] + np.einsum("nij,naj->nai", turns, shape)


def rotations(vectors: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(vectors).as_matrix()


def sampled(kt: float, samples: int, rng: np.random.Generator, *, flexible: bool) -> tuple[np.ndarray, np.ndarray]:
    """Configurations by Metropolis moves of place, orientation and angle, with the volume sqrt(det Z)."""
    masses = np.array([3.0, 1.0, 2.0])
    k = np.array([1.0, 1.3, 0.7])

    def energy(x: np.ndarray) -> np.ndarray:
        return (np.cos(k * x + np.array([0.1, 0.5, 0.9])) / k).sum(axis=(1, 2))

    at, turn, angle = rng.uniform(0, 9, (COPIES, 3)), rotations(rng.normal(size=(COPIES, 3))), np.full(COPIES, 1.8)
    x = bent(at, turn, angle, masses)
    has = energy(x) - kt * np.log(_density(angle, masses))
    kept = []
    for sweep in range(60 + 6 * samples):
        new = (
            at + rng.normal(size=at.shape),
            rotations(0.8 * rng.normal(size=at.shape)) @ turn,
            angle + flexible * rng.normal(size=COPIES),
        )
        good = (new[2] > 0) & (new[2] < math.pi)
        y = bent(*new, masses)
        wants = energy(y) - kt * np.log(_density(np.where(good, new[2], 1.0), masses))
        take = good & (rng.random(COPIES) < np.exp(np.minimum(0, (has - wants) / kt)))
        at, angle = np.where(take[:, None], new[0], at), np.where(take, new[2], angle)
        turn = np.where(take[:, None, None], new[1], turn)
        x, has = np.where(take[:, None, None], y, x), np.where(take, wants, has)
        if sweep >= 60 and sweep % 6 == 0:
            kept.append(x.reshape(-1, 3).copy())
    return np.array(kept), np.tile(masses, COPIES)


@pytest.mark.parametrize("flexible", [False, True])
def test_against_metropolis(flexible):
    """Molecules that are rigid, or bend freely: all temperatures are those of the sampler; 20 % more is seen."""
    configurations, masses = sampled(KT, 200, np.random.default_rng(5), flexible=flexible)
    k = 3 * np.arange(COPIES)
    pairs = [np.c_[k, k + 1], np.c_[k, k + 2], *([] if flexible else [np.c_[k + 1, k + 2]])]
    split = TemperatureSplit(system([Distance(np.concatenate(pairs))], configurations[0], masses, waves), rng=1)
    for x in configurations:
        split.add(x)
    found = split.result()
    kinds = [found.shift, found.turn, *([found.internal] if flexible else [])]
    assert (found.internal is not None) is flexible
    assert (found.shifts, found.turns) == (3 * COPIES, 3 * COPIES)
    for estimate in kinds:
        assert estimate is not None and abs(estimate.off(KT)) <= 3
    assert all(abs(e.off(1.2 * KT)) > 5 for e in (found.shift, found.turn))


# -- what has no shifts or turns --------------------------------------------------------------------


#: Two dumbbells, the first of which has an end held; a pair at one height; atoms.
BONDS, ENDS = Distance([[0, 1], [2, 3]]), np.array([[1.0, 0, 0], [1.3, 0.9, 0.2], [4.0, 0, 0], [4.5, 0.8, -0.1]])
PLACE = "tied to a place"
#: Rows, positions, degrees of freedom of shifts and turns, whether other motions are left, and what is said.
NOT_FREE = {
    "sphere": ([Sphere([0], [0, 0, 0], 1.0), BONDS], ENDS, (3, 2), True, [PLACE]),
    "plane": ([Plane([0], [0, 0, 1.0]), BONDS], ENDS, (3, 2), True, [PLACE]),
    "fixed": ([FixedAtoms([0]), BONDS], ENDS, (3, 2), True, [PLACE, "1 fixed atoms have no temperature"]),
    "height": (
        [Formula("z1 - z2", [0, 1])],
        np.array([[0.0, 0, 0], [1.0, 0.3, 0]]),
        (3, 0),
        True,
        ["tied to a direct"],
    ),
    "atoms": ([], 0.1 * np.arange(12.0).reshape(4, 3), (12, 0), False, ["single atoms only: nothing turns"]),
}


@pytest.mark.parametrize("name", NOT_FREE)
def test_what_does_not_shift_or_turn_is_said(name):
    """Its motion is internal."""
    rows, x, counts, internal, notes = NOT_FREE[name]
    found = repeated(system(rows, x, np.resize([1.0, 2.0], len(x)), waves), x, 128).result()
    assert (found.shifts, found.turns) == counts
    assert (found.internal is not None) is internal and (found.turn is None) is (counts[1] == 0)
    assert len(found.left_out) == len(notes)
    assert all(note in told for note, told in zip(notes, found.left_out, strict=True))


def test_molecules_across_the_border_of_a_box():
    """A molecule in two pieces is the same molecule."""
    box = 6.0
    whole = np.array([[5.8, 1.0, 1.0], [6.5, 1.5, 1.0], [3.0, 3.0, 3.0], [3.6, 3.6, 3.1]])
    broken = np.mod(whole, box)

    def force(x: np.ndarray, t: float) -> np.ndarray:
        return np.sin(2 * np.pi / box * (x + np.array([0.1, 0.3, 0.7])))

    found = []
    for x in (whole, broken):
        held = ConstraintSet([Distance([[0, 1], [2, 3]])], x, np.array([1.0, 2, 1, 2]), cell=[box] * 3)
        found.append(np.array(repeated(System(Motion(held, x), force), x, 1, displacement=1e-3)._series))
    assert found[1] == pytest.approx(found[0], rel=1e-6)


# -- bad input --------------------------------------------------------------------------------------


def test_frames_off_the_constraints():
    """As of files in few digits, or of another cell."""
    held, x = dumbbells(2)
    split = TemperatureSplit(held)
    split.add(x.astype(np.float32))
    off = x.copy()
    off[3] += 0.01 * (x[3] - x[2])
    with pytest.raises(InputError, match=r"off row #1 .* by 0\.01 of its size; .* Motion\.restore_positions") as caught:
        split.add(off)
    assert len(split) == 1 and tuple(caught.value.atoms) == (2, 3)
    split.add(held.motion.restore_positions(off))


K = 3.0


def made(rows, x, masses, **forces) -> System:
    return grouped(system(rows, x, masses).motion, **forces)


def test_springs_of_free_atoms():
    """k/m of each: 9 and 1 in the squares of H, whose traces are 3 (81 + 1) and 3; normal moves of many frames."""
    x = np.array([[0.0, 0, 0], [5.0, 0, 0]])
    fast, slow = np.array([[9.0], [0.0]]), np.array([[0.0], [4.0]])
    held = made([], x, [1.0, 4.0], fast=lambda x, t: -fast * x, slow=lambda x, t: -slow * x)
    share = slow_share(held, np.tile(x, (4000, 1, 1)))
    assert share == pytest.approx(np.sqrt(1 / 82), rel=0.05)
    other = slow_share(held, np.tile(x, (4000, 1, 1)), "fast")
    assert share**2 + other**2 == pytest.approx(1, rel=1e-6)


def test_signs_do_not_cancel():
    """A saddle without a trace, beside a trap of the same size."""
    saddle = np.diag([1.0, 1.0, -2.0])
    held = made([], [[1.0, 2, 3]], [1.0], fast=lambda x, t: -x - x @ saddle, slow=lambda x, t: x @ saddle)
    frames = np.tile([[1.0, 2, 3]], (4000, 1, 1))
    assert slow_share(held, frames, displacement=0.01) == pytest.approx(np.sqrt(2), rel=0.05)


def test_a_rigid_pair_turns_freely_in_a_trap():
    """All of the stiffness is that of its center; what pulls along the pair does nothing, wherever it has turned to."""
    x = np.array([[0.3, -0.2, 0.1], [0.3, -0.2, 1.5]])

    def along(x, t):
        d = x[1] - x[0]
        return 50 * np.array([d, -d])

    def held(**more):
        return made([Distance([[0, 1]])], x, [2.0, 2.0], fast=lambda x, t: -K * x, **more)

    frames = np.tile(x, (20, 1, 1))
    assert slow_share(held(slow=along), frames, displacement=1e-3) < 1e-6
    assert slow_share(held(slow=lambda x, t: -2 * K * x), frames) == pytest.approx(2 / 3, rel=1e-6)


def test_fixed_atoms_make_no_longer_moves():
    """A pair that repels steeply, alone and beside a slab."""
    slab = [[i, j, -20.0] for i in range(10) for j in range(10)]

    def fast(x, t):
        d = x[1] - x[0]
        push = 12 * d / np.linalg.norm(d) ** 14
        return np.vstack([-push - x[0], push - x[1], np.zeros((len(x) - 2, 3))])

    def slow(x, t):
        return np.vstack([-0.5 * x[:2], np.zeros((len(x) - 2, 3))])

    shares = []
    for fixed in ([], slab):
        x = np.array([[0.0, 0, 0], [1.0, 0, 0], *fixed])
        rows = [FixedAtoms(np.arange(2, len(x)))] if fixed else []
        shares.append(slow_share(made(rows, x, np.ones(len(x)), fast=fast, slow=slow), np.tile(x, (200, 1, 1))))
    assert shares[1] == pytest.approx(shares[0], rel=0.3)
    held = made([FixedAtoms([0])], [[0.0, 0, 0]], [1.0], fast=lambda x, t: -x, slow=lambda x, t: -x)
    with pytest.raises(InputError, match="all atoms are fixed"):
        slow_share(held, [[[0.0, 0, 0]]], displacement=0.1)
