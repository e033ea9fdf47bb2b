"""Hard cases of the core (docs/hard-cases.md): forces, habits of engines, symmetries, H25 to H42; the global rule."""

from __future__ import annotations

import io

import numpy as np
import pytest
from reference import cases

from hard_cases.core_systems import (
    TRIANGLE,
    WATER,
    WATER_MASSES,
    Array,
    chain,
    motion_of,
    pendulum,
    refused,
    rotated,
    system_of,
    worst_residual,
)
from kcons.constraints import Angle, Constraint, Distance, FixedAtoms, LinearRelation
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ContradictionError, ConvergenceError, InputError, KconsError
from kcons.steppers import Rattle, State, System, run

# -- forces, habits of MD engines ----------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1e6, 1e9, 1e12])
def test_H25_huge_force_along_a_bond(size: float) -> None:
    masses = np.array([1.5, 2.5])
    x = rotated([[0.75, 0, 0], [-0.45, 0, 0]])

    def along(x: Array) -> Array:
        return (x[0] - x[1]) / np.linalg.norm(x[0] - x[1])

    u = along(x)
    pull = np.stack([size * u, -size * u])
    system = system_of(Distance([0, 1]), x, masses, lambda x, t: np.stack([size * along(x), -size * along(x)]))
    side = np.cross(u, [0.3, 0.5, -0.7])
    v = np.stack([masses[1] * side, -masses[0] * side]) / masses.sum()
    a = system.motion.acceleration(x, v, pull)
    centripetal = -np.dot(side, side) / 1.2
    assert abs(u @ (a[0] - a[1]) - centripetal) <= 1e-15 * size / masses.min() + 1e-14
    state = system.initial_state(x, v)
    for _ in range(3):
        state = Rattle().step(system, state, 1e-3)
        assert worst_residual(system, state) <= 1e-10


@pytest.mark.parametrize(("name", "constant"), [("10deg", 0.00403), ("90deg", 0.0338), ("150deg", 0.0024)])
def test_H26_fixed_atom_and_bond_are_a_pendulum(name: str, constant: float) -> None:
    known = cases.load(f"A03_planar_pendulum_{name}").solution[0]
    system, state = pendulum(np.radians(float(name.removesuffix("deg"))))
    assert system.motion.rank == 4 and system.motion.degrees_of_freedom == 2
    steps = round(known.time / 0.002)
    dt = known.time / steps
    state = run(system, state, dt, steps)
    assert np.abs(state.positions[1] - known.positions[0]).max() <= 10 * constant * dt**2
    assert np.array_equal(state.positions[0], np.zeros(3))


def test_H26_bond_between_fixed_atoms() -> None:
    x = np.array([[0.0, 0, 0], [1, 0, 0], [1.5, 0.9, 0]])
    motion = motion_of([FixedAtoms([0, 1]), Distance([(0, 1), (1, 2)])], x, np.ones(3))
    assert motion.rank == 7 and motion.degrees_of_freedom == 2
    with refused(ContradictionError, r"#6 Distance\(0, 1\) lies between fixed atoms and is off", x):
        motion_of([FixedAtoms([0, 1]), Distance([(0, 1), (1, 2)], [1.01, 1.03])], x, np.ones(3))


def test_H27_float32_input() -> None:
    rng = np.random.default_rng(5)
    x32 = rotated(WATER).astype(np.float32)
    v32 = rng.standard_normal((3, 3)).astype(np.float32)
    m32 = WATER_MASSES.astype(np.float32)
    f32 = rng.standard_normal((3, 3)).astype(np.float32)
    results = []
    for kind in (np.float32, np.float64):
        x, v, m, f = (a.astype(kind) for a in (x32, v32, m32, f32))
        motion = motion_of(Distance(TRIANGLE), x, m)
        system = System(motion, lambda x, t, f=f: f)
        end = run(system, system.initial_state(x, v, project=True), 0.01, 100)
        results.append(
            [
                motion.project_positions(x + kind(0.01) * v, x),
                motion.project_velocities(x, v),
                motion.acceleration(x, motion.project_velocities(x, v), f),
                motion.constraint_force(x, motion.project_velocities(x, v), f),
                motion.project_forces(x, f),
                end.positions,
                end.velocities,
            ]
        )
    for a, b in zip(*results, strict=True):
        assert a.dtype == b.dtype == np.float64
    # x + 0.01 v is itself float32 arithmetic of this test: compare from the second on.
    for a, b in zip(results[0][1:], results[1][1:], strict=True):
        assert np.abs(a - b).max() <= 1e-12 * np.abs(b).max()


@pytest.mark.parametrize("atoms", [0, 1, 5])
@pytest.mark.parametrize("rows", [[], [Distance(np.zeros((0, 2), int))]], ids=["no objects", "an empty object"])
def test_H28_no_constraints(atoms: int, rows: list[Constraint]) -> None:
    rng = np.random.default_rng(3)
    x, v, masses = rng.standard_normal((atoms, 3)), rng.standard_normal((atoms, 3)), rng.uniform(1, 2, atoms)
    system = system_of(rows, x, masses, lambda x, t: -x)
    motion = system.motion
    assert motion.rank == 0 and motion.degrees_of_freedom == 3 * atoms
    assert np.array_equal(motion.project_positions(x, x), x)
    assert np.array_equal(motion.project_velocities(x, v), v)
    assert np.array_equal(motion.project_forces(x, v), v)
    assert np.array_equal(motion.constraint_force(x, v, x), np.zeros_like(x))
    assert motion.multipliers(x, v, x).shape == (0,)
    assert "rows 0" in str(motion.report(x, v))
    state = run(system, system.initial_state(x, v), 0.02, 1000)
    y, w, m = x.copy(), v.copy(), masses[:, None]
    for _ in range(1000):
        w = w + 0.01 * -y / m
        y = y + 0.02 * w
        w = w + 0.01 * -y / m
    scale = max(1.0, np.abs(y).max(initial=0.0))
    assert np.abs(state.positions - y).max(initial=0.0) <= 1e-14 * scale * 1
    assert np.abs(state.velocities - w).max(initial=0.0) <= 1e-14 * scale * 1


def test_H29_bad_indices() -> None:
    x = chain(4)
    masses = np.ones(4)
    with refused(InputError, r"row 1 names an atom twice: \(2, 2\)"):
        Distance([(0, 1), (2, 2)])
    with refused(InputError, "row 0 has the negative atom index -1"):
        Distance([(0, -1)])
    with refused(InputError, r"row 1, Distance\(2, 7\): there is no atom 7; the system has atoms 0 to 3", x):
        ConstraintSet(Distance([(0, 1), (2, 7)]), x, masses)
    for target in (0.0, -1.0):
        with refused(InputError, r"row 1, Distance\(1, 2\): target -?\d is not positive", x):
            ConstraintSet(Distance([(0, 1), (1, 2)], [1.0, target]), x, masses)
    with refused(InputError, "integers"):
        Distance([(0.0, 1.5)])
    for shape in ((4,), (4, 2), (3, 3)):
        with refused(InputError, "shape"):
            motion_of(Distance([(0, 1)]), x, masses).project_positions(np.zeros(shape), x)
    with refused(InputError, "positions must have shape"):
        ConstraintSet(Distance([(0, 1)]), x.ravel(), masses)
    with refused(InputError, "masses must have shape"):
        ConstraintSet(Distance([(0, 1)]), x, np.ones(3))


# -- symmetries ---------------------------------------------------------------------------------------


def test_H30_time_reversal() -> None:
    x = np.array([[0.0, 0.0, 0.0], [np.sin(1.2), 0.0, -np.cos(1.2)]])
    down = np.array([[0, 0, 0], [0, 0, -1.0]])
    system = system_of([FixedAtoms([0]), Distance([0, 1], 1.0)], x, [1, 1], lambda x, t: down)
    start = system.initial_state(x, [[0, 0, 0], [0, 0.8, 0]])
    end = run(system, start, 0.01, 10_000)
    back = run(system, end.reversed(), 0.01, 10_000)
    assert np.abs(end.positions - start.positions).max() > 0.1
    assert np.abs(back.positions - start.positions).max() <= 1e-10
    assert np.abs(back.velocities + start.velocities).max() <= 1e-10


def springs(links: Array, lengths: Array, k: float = 0.5):
    """Harmonic forces between atoms, the same in every frame."""
    i, j = links.T

    def force(x: Array, t: float) -> Array:
        d = x[i] - x[j]
        r = np.linalg.norm(d, axis=1)
        pull = (k * (lengths - r) / r)[:, None] * d
        f = np.zeros_like(x)
        np.add.at(f, i, pull)
        np.add.at(f, j, -pull)
        return f

    return force


def test_H31_order_and_orientation() -> None:
    rng = np.random.default_rng(8)
    x = np.vstack([rotated(WATER), rotated(chain(6), 1) + np.array([2.5, 1.0, 0.0])])
    masses = np.concatenate([WATER_MASSES, rng.uniform(1, 16, 6)])
    pairs = np.array([*TRIANGLE, *[(k, k + 1) for k in range(3, 8)]])
    angles = np.array([(3, 4, 5), (5, 6, 7)])
    links = np.array([(0, 4), (1, 6), (2, 8), (3, 7)])
    lengths = 0.9 * np.linalg.norm(x[links[:, 0]] - x[links[:, 1]], axis=1)
    system = system_of([Distance(pairs), Angle(angles)], x, masses, springs(links, lengths))
    v = system.motion.project_velocities(x, 0.1 * rng.standard_normal((9, 3)))
    end = run(system, system.initial_state(x, v), 0.01, 1000).positions
    assert np.abs(end - x).max() > 0.3

    order = rng.permutation(9)  # new atom k is old atom order[k]
    new = np.argsort(order)
    flipped = new[pairs[rng.permutation(len(pairs))]][:, ::-1]
    rows = [Angle(new[angles[::-1]]), Distance(flipped[:4]), Distance(flipped[4:])]
    other = system_of(rows, x[order], masses[order], springs(new[links], lengths))
    permuted = run(other, other.initial_state(x[order], v[order]), 0.01, 1000).positions
    assert np.abs(permuted[new] - end).max() <= 1e-11

    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    shift = np.array([3.0, -2.0, 1.0])
    moved = x @ turn + shift
    other = system_of([Distance(pairs), Angle(angles)], moved, masses, springs(links, lengths))
    turned = run(other, other.initial_state(moved, v @ turn), 0.01, 1000).positions
    assert np.abs((turned - shift) @ turn.T - end).max() <= 1e-11


def test_H32_restart_is_bit_identical() -> None:
    x = rotated(chain(8))
    masses = np.linspace(1, 12, 8)
    rows = [Distance([(k, k + 1) for k in range(7)], 1.0), Angle([(0, 1, 2), (4, 5, 6)], np.radians(110.0))]
    force = lambda x, t: -0.3 * x + np.sin(t)  # noqa: E731

    def fresh(x: Array) -> System:
        return system_of(rows, x, masses, force)

    system = fresh(x)
    start = system.initial_state(x, 0.1 * np.random.default_rng(0).standard_normal((8, 3)), project=True)
    whole = run(system, start, 0.01, 1000)
    half = run(system, start, 0.01, 500)
    file = io.BytesIO()
    half.save(file)
    file.seek(0)
    state = State.load(file)
    assert state.step == 500
    resumed = run(fresh(state.positions), state, 0.01, 500)
    assert resumed.positions.tobytes() == whole.positions.tobytes()
    assert resumed.velocities.tobytes() == whole.velocities.tobytes()


def stiff_and_rigid() -> tuple[System, State, float]:
    """A rigid bond next to a spring with k = 1e6; also the largest frequency on the surface."""
    k = 1e6
    x = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.4, 0.9, 0]])
    masses = np.array([3.0, 1.0, 2.0])
    rest = np.linalg.norm(x[2] - x[1])
    system = system_of(
        Distance([0, 1]),
        x,
        masses,
        springs(np.array([(1, 2)]), np.array([rest]), k),
        potential=lambda x, t: 0.5 * k * (np.linalg.norm(x[2] - x[1]) - rest) ** 2,
    )
    u = np.zeros((3, 3))
    u[2] = (x[2] - x[1]) / rest
    u[1] = -u[2]
    # omega^2 = k u . M_par^+ u; the bonds may straighten, where less of the spring is held back.
    along = np.zeros((3, 3))
    along[1, 0], along[2, 0] = -1.0, 1.0
    free = max(float(np.sum(d * system.motion.acceleration(x, 0 * x, d))) for d in (u, along))
    free = max(free, 1 / masses[1] + 1 / masses[2])
    return (
        system,
        system.initial_state(x, [[0, 0.4, 0.1], [0, -0.3, 0.2], [0, 0.5, -0.4]], project=True),
        np.sqrt(k * free),
    )


def test_H41_stiff_next_to_rigid() -> None:
    system, state, omega = stiff_and_rigid()
    energy, worst = system.total_energy(state), 0.0
    dt = 0.5 * 2 / omega
    for _ in range(10_000):
        state = Rattle().step(system, state, dt)
        worst = max(worst, abs(system.total_energy(state) - energy))
    assert worst <= 0.5 * energy
    assert worst_residual(system, state) <= 1e-14
    # Above the limit it fails, and says so.
    system, state, omega = stiff_and_rigid()
    with refused(KconsError, "step", state.positions, state.velocities):
        run(system, state, 1.6 * 2 / omega, 20_000)


def test_H42_zero_and_negative_steps() -> None:
    x = rotated(chain(6))
    rows = [Distance([(k, k + 1) for k in range(5)]), Angle([(0, 1, 2)])]
    system = system_of(rows, x, np.linspace(1, 6, 6), lambda x, t: -0.5 * x)
    start = system.initial_state(x, 0.3 * np.random.default_rng(2).standard_normal((6, 3)), project=True)
    still = Rattle().step(system, start, 0.0)
    assert still.positions.tobytes() == start.positions.tobytes()
    assert still.velocities.tobytes() == start.velocities.tobytes()
    for dt in (0.001, 0.01, 0.05):
        back = Rattle().step(system, Rattle().step(system, start, dt), -dt)
        assert np.abs(back.positions - start.positions).max() <= 1e-12
        assert np.abs(back.velocities - start.velocities).max() <= 1e-12
    state = start
    changes = (0.01, 0.02, -0.005, 0.03)
    for dt in changes:
        state = Rattle().step(system, state, dt)
    for dt in reversed(changes):
        state = Rattle().step(system, state, -dt)
    assert np.abs(state.positions - start.positions).max() <= 1e-12


# -- the global rule ----------------------------------------------------------------------------------

BATHS: dict[str, tuple[Array, list[Constraint]]] = {
    "one bond": (np.array([[0.0, 0, 0], [1, 0, 0]]), [Distance([0, 1])]),
    "waters": (
        np.vstack([WATER + 4.0 * k for k in range(5)]),
        [Distance([(3 * k + i, 3 * k + j) for k in range(5) for i, j in TRIANGLE])],
    ),
    "CH2 groups": (
        np.vstack([np.array([[0.0, 0, 0], [1, 0.2, 0], [-0.3, 1, 0]]) + 4.0 * k for k in range(5)]),
        [Distance([(3 * k, 3 * k + j) for k in range(5) for j in (1, 2)])],
    ),
    "chain": (chain(12), [Distance([(k, k + 1) for k in range(11)])]),
    "chain with angles": (chain(7), [Distance([(k, k + 1) for k in range(6)]), Angle([(1, 2, 3), (3, 4, 5)])]),
    "pendulum": (chain(3), [FixedAtoms([0]), Distance([(0, 1), (1, 2)])]),
    "linear molecule": (np.array([[-1.0, 0, 0], [0, 0, 0], [1.2, 0, 0]]), [Distance(TRIANGLE)]),
    "few among many": (
        np.vstack([chain(3), 5 + chain(20)]),
        [Distance([(0, 1)]), LinearRelation(2, [0, 1], [-1.0, 2.0], None)],
    ),
}


@pytest.mark.parametrize("bath", BATHS)
@pytest.mark.parametrize("trial", range(6))
def test_global_rule_no_nan_and_no_change_on_failure(bath: str, trial: int) -> None:
    """Whatever displacement comes in: a solution to the tolerance, or a typed error and untouched arrays."""
    x, rows = BATHS[bath]
    rng = np.random.default_rng(100 + trial)
    motion = motion_of(rows, x, rng.uniform(1, 16, len(x)))
    held = motion.constraint_set
    new = x + 10.0 ** (trial - 3) * rng.standard_normal(x.shape)
    v = rng.standard_normal(x.shape)
    arrays = (new, v, x)
    before = [a.tobytes() for a in arrays]
    try:
        motion.project_positions(new, x, velocities=v, dt=0.1, out=new)
    except ConvergenceError:
        assert [a.tobytes() for a in arrays] == before
    else:
        assert np.all(np.isfinite(new)) and np.all(np.isfinite(v))
        assert np.all(np.abs(held.value(new)) <= 2 * held.tolerance(new))
    spoiled = new.copy()
    spoiled[held.row_atoms(held.n_rows - 1)[-1], 0] = np.nan
    with refused(InputError, "not finite", spoiled, v):
        motion.project_positions(spoiled, x, velocities=v, dt=0.1, out=spoiled)
    with refused(InputError, "not finite", spoiled, v):
        motion.project_velocities(x, spoiled, out=spoiled)
