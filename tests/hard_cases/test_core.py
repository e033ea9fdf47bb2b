"""What the cases do not ask of the core: every call that takes numbers, in every precision, and what a failure leaves.

No NaN is ever returned, and no array that was given is changed by a call that fails.
"""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from hard_cases.bodies import TRIANGLE, WATER, WATER_MASSES
from hard_cases.chains import bonds, zigzag
from hard_cases.motions import every
from hard_cases.problem import Array, Problem
from hard_cases.programs import Core
from hard_cases.truths import rotated
from kcons.constraints import Angle, Distance, LinearCombination, LinearRelation, Plane
from kcons.errors import ConvergenceError, InfeasibleError, InputError, KconsError, NonFiniteError
from kcons.errors import SingularGeometryError as Singular
from kcons.motion import Motion
from kcons.steppers import State, System, run


def motion_of(problem: Problem) -> Motion:
    return Core().system(problem).motion


@contextlib.contextmanager
def refused(error: type[KconsError], match: str, *arrays: Array):
    """The call raises a typed error with this message and leaves the arrays as they were, bit for bit."""
    before = [a.tobytes() for a in arrays]
    with pytest.raises(error, match=match) as caught:
        yield caught
    assert [a.tobytes() for a in arrays] == before


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_H19_every_call_names_the_atom_that_is_not_finite(bad: float) -> None:
    problem = Problem(zigzag(4), np.ones(4), bonds(4))
    x, motion, good = problem.x, motion_of(problem), np.zeros((4, 3))
    spoiled = x.copy()
    spoiled[2, 1] = bad
    system = System(motion, lambda x, t: -x * np.where((t > 0.95) & (np.arange(4) == 1), bad, 1.0)[:, None])
    for call in (
        lambda: motion.project_positions(spoiled, x, velocities=good, dt=0.1, out=spoiled),
        lambda: motion.project_positions(x, spoiled),
        lambda: motion.project_velocities(x, spoiled, out=spoiled),
        lambda: motion.project_velocities(spoiled, good),
        lambda: motion.acceleration(x, good, spoiled),
        lambda: motion.acceleration(x, spoiled, good),
        lambda: motion.project_forces(x, spoiled, out=spoiled),
        lambda: motion.restore_positions(spoiled),
        lambda: system.initial_state(spoiled),
        lambda: system.initial_state(x, spoiled),
    ):
        with refused(InputError, "atom 2", spoiled, x, good):
            call()
    last: list[State] = []
    with refused(NonFiniteError, "non-finite force at step 10", x), np.errstate(all="raise"):
        run(system, system.initial_state(x), 0.1, 20, observers=[last.append])
    assert last[-1].step == 9 and np.isfinite(last[-1].positions).all() and np.isfinite(last[-1].velocities).all()


def test_H18_every_call_names_the_atoms_that_coincide() -> None:
    motion = motion_of(Problem([[0.0, 0, 0], [1, 0, 0]], np.ones(2), [(0, 1)]))
    x, v = np.zeros((2, 3)), np.ones((2, 3))
    for call in (
        lambda: motion.project_positions(v.copy(), x),
        lambda: motion.project_velocities(x, v),
        lambda: motion.acceleration(x, v, v),
        lambda: motion.project_forces(x, v),
    ):
        with refused(Singular, "atoms 0 and 1 coincide: distance gradient undefined", x, v):
            call()


def test_H20_more_rows_than_coordinates_that_agree() -> None:
    """Fourteen rows on twelve coordinates: rank 12, no freedom, no error at rest."""
    others = [
        Plane([0, 1, 2, 3], normal=[0, 0, 1]),
        LinearCombination([[0], [1], [2], [3]], [[[0, 1.0, 0]], [[1.0, 0, 0]], [[1.0, 0, 0]], [[0.5, 1.0, 0]]]),
    ]
    shape = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.3]])
    motion = motion_of(Problem(shape, np.ones(4), every(4), others=others))
    assert (motion.constraint_set.n_rows, motion.rank, motion.degrees_of_freedom) == (14, 12, 0)
    assert np.abs(motion.project_velocities(shape, np.ones((4, 3)))).max() <= 1e-12


def test_H21_polygon_that_cannot_close() -> None:
    """Sides 1, 1, 1, 4: each takes a quarter of the excess, sum of squares 4 (1/4)^2."""
    x = np.array([[0.0, 0, 0], [1, 0.2, 0], [2, -0.1, 0.3], [3, 0, 0]])
    motion = motion_of(Problem(x, np.ones(4), [(0, 1), (1, 2), (2, 3), (3, 0)], [1.0, 1.0, 1.0, 4.0]))
    with refused(InfeasibleError, r"infeasible: residual cannot go below 0\.25", x) as caught:
        motion.restore_positions(x, out=x)
    assert caught.value.iterations <= 200


def test_H09_a_step_without_a_solution_names_its_number_its_row_and_its_atoms() -> None:
    system = Core().system(Problem([[0.75, 0, 0], [-0.45, 0, 0]], [1.5, 2.5], [(0, 1)], [1.2]))
    state = State(np.array([[0.75, 0, 0], [-0.45, 0, 0]]), np.array([[0, 0.75, 0], [0, -0.45, 0]]), step=6)
    for dt in (1.0 + 1e-9, 1.5):
        with refused(ConvergenceError, "step 7.*time step too large", state.positions, state.velocities) as caught:
            run(system, state, dt, 1)
        assert (caught.value.step, caught.value.row, caught.value.atoms) == (7, 0, (0, 1))


@pytest.mark.parametrize("offset", [1e6, 1e9])
def test_H12_velocities_far_from_the_origin_come_from_the_multipliers(offset: float) -> None:
    x = np.array([[0.75, 0, 0], [-0.45, 0, 0]]) + offset
    motion, v = motion_of(Problem(x, [1.5, 2.5], [(0, 1)])), np.zeros((2, 3))
    step = np.array([[0.01, 0.03, -0.02], [0.02, -0.03, 0.01]])
    y = motion.project_positions(x + step, x, velocities=v, dt=0.01)
    assert abs(np.linalg.norm(y[0] - y[1]) - np.linalg.norm(x[0] - x[1])) <= 4 * np.spacing(offset) * 1.2
    assert np.abs([1.5, 2.5] @ v).max() <= 1e-14 * np.abs(v).max()


def test_H27_numbers_of_single_precision_in_every_call() -> None:
    rng = np.random.default_rng(5)
    given = [a.astype(np.float32) for a in (rotated(WATER), *rng.standard_normal((2, 3, 3)), WATER_MASSES)]
    results = []
    for kind in (np.float32, np.float64):
        x, v, f, m = (a.astype(kind) for a in given)
        system = Core().system(Problem(x, m, TRIANGLE))
        motion = system.motion
        u = motion.project_velocities(x, v)
        calls = [motion.project_forces(x, f), motion.acceleration(x, u, f), motion.constraint_force(x, u, f)]
        end = run(system, system.initial_state(x, u, project=True), 0.01, 100)
        results.append([u, motion.project_positions(x, x), *calls, end.positions, end.velocities])
    for a, b in zip(*results, strict=True):
        assert a.dtype == b.dtype == np.float64
        assert np.abs(a - b).max() <= 1e-12 * np.abs(b).max()


@pytest.mark.parametrize("atoms", [0, 1, 5])
@pytest.mark.parametrize("pairs", [(), np.zeros((0, 2), int)], ids=["no objects", "an empty object"])
def test_H28_nothing_held_in_every_call(atoms: int, pairs) -> None:
    x, v = np.random.default_rng(3).standard_normal((2, atoms, 3))
    rows = () if isinstance(pairs, tuple) else [Distance(pairs)]
    motion = motion_of(Problem(x, np.ones(atoms), others=rows))
    assert motion.rank == 0 and motion.degrees_of_freedom == 3 * atoms
    for found, given in (
        (motion.project_positions(x, x), x),
        (motion.project_velocities(x, v), v),
        (motion.project_forces(x, v), v),
        (motion.constraint_force(x, v, x), 0 * x),
    ):
        np.testing.assert_array_equal(found, given)
    assert motion.multipliers(x, v, x).shape == (0,) and "rows 0" in str(motion.report(x, v))


MOLECULES = {
    "one bond": Problem(np.eye(2, 3), np.ones(2), [(0, 1)]),
    "waters": Problem(
        np.vstack([WATER + 4.0 * k for k in range(5)]),
        np.ones(15),
        [(3 * k + i, 3 * k + j) for k in range(5) for i, j in TRIANGLE],
    ),
    "CH2 groups": Problem(
        np.vstack([np.array([[0.0, 0, 0], [1, 0.2, 0], [-0.3, 1, 0]]) + 4.0 * k for k in range(5)]),
        np.ones(15),
        [(3 * k, 3 * k + j) for k in range(5) for j in (1, 2)],
    ),
    "chain": Problem(zigzag(12), np.ones(12), bonds(12)),
    "chain with angles": Problem(zigzag(7), np.ones(7), bonds(7), triples=[(1, 2, 3), (3, 4, 5)]),
    "pendulum": Problem(zigzag(3), np.ones(3), bonds(3), fixed=[0]),
    "linear molecule": Problem([[-1.0, 0, 0], [0, 0, 0], [1.2, 0, 0]], np.ones(3), TRIANGLE),
    "few among many": Problem(
        np.vstack([zigzag(3), 5 + zigzag(20)]),
        np.ones(23),
        [(0, 1)],
        others=[LinearRelation(2, [0, 1], [-1.0, 2.0], None)],
    ),
}


@pytest.mark.parametrize("name", MOLECULES)
@pytest.mark.parametrize("trial", range(6))
def test_whatever_displacement_comes_in(name: str, trial: int) -> None:
    """A solution to the tolerance, or a typed error and untouched arrays."""
    rng = np.random.default_rng(100 + trial)
    problem = MOLECULES[name]
    problem = problem.but(masses=rng.uniform(1, 16, problem.n_atoms))
    x, motion = problem.x, motion_of(problem)
    held = motion.constraint_set
    new = x + 10.0 ** (trial - 3) * rng.standard_normal(x.shape)
    v = rng.standard_normal(x.shape)
    before = [a.tobytes() for a in (new, v, x)]
    try:
        motion.project_positions(new, x, velocities=v, dt=0.1, out=new)
    except ConvergenceError:
        assert [a.tobytes() for a in (new, v, x)] == before
    else:
        assert np.all(np.isfinite(new)) and np.all(np.isfinite(v))
        assert np.all(np.abs(held.value(new)) <= 2 * held.tolerance(new))
    spoiled = new.copy()
    spoiled[held.row_atoms(held.n_rows - 1)[-1], 0] = np.nan
    for call in (
        lambda: motion.project_positions(spoiled, x, velocities=v, dt=0.1, out=spoiled),
        lambda: motion.project_velocities(x, spoiled, out=spoiled),
    ):
        with refused(InputError, "not finite", spoiled, v):
            call()


def test_H07_rows_of_angles_keep_their_size_towards_180_degrees() -> None:
    for degrees in (170.0, 179.0, 179.9, 179.9999):
        bend = np.radians(degrees)
        x = np.array([[1, 0, 0], [0, 0, 0], [np.cos(bend), np.sin(bend), 0]])
        row = motion_of(Problem(x, np.ones(3), others=[Angle([0, 1, 2])])).constraint_set.jacobian(x).toarray()
        assert np.linalg.norm(row) == pytest.approx(np.sqrt(4 - 2 * np.cos(bend)), rel=1e-12)


@pytest.mark.parametrize(("n", "linearised"), [(3, 7), (4, 7), (6, 9)])
def test_H04_H05_degrees_of_freedom_of_what_is_singular_are_counted(n: int, linearised: int) -> None:
    """A straight molecule and planar rings, held by all of their distances."""
    turn = 2 * np.pi * np.arange(n) / n
    x = (
        np.array([[-1.16, 0, 0], [0, 0, 0], [1.16, 0, 0]])
        if n == 3
        else np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    )
    body = 5 if n == 3 else 6
    with refused(Singular, f"{linearised} linearised degrees of freedom but the rigid body has {body}", x):
        Core().system(Problem(x, np.ones(n), every(n)), degenerate="raise")
    assert motion_of(Problem(x, np.ones(n), every(n))).degrees_of_freedom == body
