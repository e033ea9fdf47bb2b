"""The engine's public calls: what they change, leave alone, refuse, say and report."""

from __future__ import annotations

import tracemalloc
from itertools import combinations

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints import MovingTarget, Sphere
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ContradictionError, ConvergenceError, InputError, NonFiniteError, SingularGeometryError
from kcons.motion import Motion, minimize
from kcons.motion import report as reports
from kcons.motion.report import worst_condition
from kcons.motion.solver_sequence import Failures
from kcons.solvers.cluster_solver import Outcome, Request

WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])
TRIANGLE = list(combinations(range(3), 2))
ZIGZAG = np.cumsum(np.tile([[0.8, 0.9, 0.1], [0.9, -0.8, 0.2]], (10, 1)), axis=0)
ATOMS = 26


def system(extra: int, seed: int = 0, moving: bool = False):
    """Rows of every kind on scattered atoms among `extra` free ones; the constraint set, positions, and which atoms.

    Water, lanes, a chain, an anchored bond, dependent, mixed and general rows.
    """
    rng = np.random.default_rng(seed)
    x = rng.uniform(-4, 4, (ATOMS, 3))
    x[:3] = WATER
    x[5:14] = ZIGZAG[:9]
    masses = rng.choice([1.0, 12.0, 16.0], ATOMS)
    rows: list[held.Constraint] = [
        held.Distance([(0, 1), (0, 2), (1, 2)]),
        held.Distance([(3, 4)]),
        held.Distance([(k, k + 1) for k in range(5, 13)]),
        held.FixedAtoms([14]),
        held.Distance([(14, 15)]),
        held.Distance([(16, 17), (17, 18), (16, 17)]),
        held.Angle([(16, 17, 18)]),
        held.RadiusOfGyration([[19, 20, 21]]),
        held.Sphere(22, [9.0, 9, 9]),
    ]
    if moving:
        rows.append(held.Distance([(23, 24)], lambda t: 3.0 + 0.3 * np.sin(t)))
        rows.append(held.VelocityFormula("vx1 + 0.5*vy1", [25], None, np.cos))
    n = ATOMS + extra
    numbers = rng.permutation(n)[:ATOMS]
    whole = rng.uniform(-4, 4, (n, 3))
    whole[numbers] = x
    all_masses = np.full(n, 7.0)
    all_masses[numbers] = masses
    renumbered = [item.renumbered(numbers) for item in rows]
    return ConstraintSet(renumbered, whole, all_masses), whole, numbers


def steps(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return 0.03 * rng.normal(size=(n, 3)), rng.normal(size=(n, 3))


# -- in place, pure, wrong arguments ----------------------------------------------------------------


@pytest.fixture(params=[0, 400], ids=["direct", "compact"])
def sample(request):
    whole, x, _ = system(request.param)
    return Motion(whole, x), x


def frozen(*arrays: np.ndarray) -> None:
    for array in arrays:
        array.flags.writeable = False


def test_inputs_are_left_alone(sample) -> None:
    motion, x = sample
    move, v = steps(len(x), 2)
    new, f = x + move, v[::-1].copy()
    frozen(x, new, v, f)
    a = motion.project_positions(new, x)
    b = motion.project_velocities(x, v)
    c = motion.restore_positions(new)
    d = motion.project_forces(x, f)
    motion.acceleration(x, v, f), motion.multipliers(x, v, f), motion.constraint_force(x, v, f), motion.report(x, v)
    for result in (a, b, c, d):
        assert result.flags.writeable and not any(np.shares_memory(result, array) for array in (x, new, v, f))


def test_out_gets_the_result_of_a_new_array(sample) -> None:
    """It may be what is given, the reference, or another array."""
    motion, x = sample
    move, v = steps(len(x), 3)
    for call, given in (
        (lambda y, r, **kw: motion.project_positions(y, r, **kw), x + move),
        (lambda y, r, **kw: motion.project_velocities(r, y, **kw), v),
        (lambda y, r, **kw: motion.project_forces(r, y, **kw), v),
        (lambda y, r, **kw: motion.restore_positions(y, **kw), x + move),
    ):
        expected, kept = call(given, x), given.copy()
        here, reference, other = given.copy(), x.copy(), np.full_like(given, 7.0)
        for out, arguments in ((here, (here, x)), (reference, (given, reference)), (other, (given, x))):
            assert call(*arguments, out=out) is out
            np.testing.assert_array_equal(out, expected)
        np.testing.assert_array_equal(given, kept)


def test_failure_changes_nothing(sample) -> None:
    motion, x = sample
    far = x.copy()
    fixed = motion.constraint_set.constraints[3].atoms[0, 0]
    pair = motion.constraint_set.constraints[1].atoms[0]
    far[pair[0]] += 30.0
    far[fixed] += 0.1
    v, lam, out = np.ones_like(x), np.full(motion.constraint_set.n_rows, 5.0), np.full_like(x, 3.0)
    kept = far.copy()
    for target in (far, out):
        with pytest.raises(ConvergenceError):
            motion.project_positions(far, x, velocities=v, dt=0.1, multipliers=lam, out=target)
        np.testing.assert_array_equal(far, kept)
        assert (v == 1).all() and (lam == 5).all() and (out == 3).all()
    singular = x.copy()
    singular[pair[0]] = singular[pair[1]]
    u = np.random.default_rng(0).normal(size=x.shape)
    kept = u.copy()
    for target in (u, out):
        with pytest.raises(SingularGeometryError):
            motion.project_velocities(singular, u, out=target, multipliers=lam)
        with pytest.raises(SingularGeometryError):
            motion.project_forces(singular, u, out=target)
        np.testing.assert_array_equal(u, kept)
        assert (lam == 5).all() and (out == 3).all()


# -- corrections and multipliers --------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.5, -0.5, 1e-3])
def test_multipliers_are_natural_and_those_of_fixed_atoms_zero(sample, dt) -> None:
    """x - x_new = M^-1 A(x_ref)^T Lambda and v - v' = M^-1 A^T mu with gradients of lengths, angles, ...

    Velocities get the correction over dt.
    """
    motion, x = sample
    whole = motion.constraint_set
    move, v = steps(len(x), 7)
    lam = np.full(whole.n_rows, np.nan)
    u = v.copy()
    y = motion.project_positions(x + move, x, multipliers=lam, velocities=u, dt=dt)
    fixed = whole.constraints[3].atoms[0, 0]
    np.testing.assert_allclose(np.delete(u - v - (y - x - move) / dt, fixed, axis=0), 0, atol=1e-14 / abs(dt))
    np.testing.assert_array_equal(u[fixed], v[fixed])
    pinned = slice(int(whole.starts[3]), int(whole.starts[4]))
    assert (lam[pinned] == 0).all()
    from_lam = (whole.jacobian(x).T @ lam).reshape(-1, 3) / whole.masses[:, None]
    np.testing.assert_allclose(np.delete(y - x - move - from_lam, fixed, axis=0), 0, atol=1e-13)
    mu = np.full(whole.n_rows, np.nan)
    u = motion.project_velocities(x, v, multipliers=mu)
    assert (mu[pinned] == 0).all()
    from_mu = (whole.jacobian(x).T @ mu).reshape(-1, 3) / whole.masses[:, None]
    np.testing.assert_allclose(np.delete(v - u - from_mu, fixed, axis=0), 0, atol=1e-13)
    assert (u[fixed] == 0).all()


#: Steps on which the plain Newton iteration of the fast solver fails and damped Newton does not.
RESCUED = {
    "RigidTriangles": (
        np.array([[0.0, 0, 0], [1.0, 0, 0], [-0.25, 0.97, 0]]),
        TRIANGLE,
        [4.2, 1.65, 3.2],
        [[0.38, 0.36, -0.25], [1.55, 0.25, 0.1], [-0.69, 0.74, 0.0]],
    ),
    "SmallClusters": (
        np.array([[0.0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]),
        [(0, k) for k in range(1, 5)],
        [9.5, 1.35, 2.29, 1.14, 1.04],
        [[-0.72, 0.11, 0.15], [0.73, 0.56, 1.15], [1.43, -1.42, -0.91], [-0.78, 1.42, -0.88], [-0.69, -0.47, 0.83]],
    ),
}


@pytest.mark.parametrize("name", RESCUED)
@pytest.mark.parametrize("crowd", [0, 12])
def test_rescue_by_damped_newton(name: str, crowd: int) -> None:
    """One cluster (of several alike) on which the fast solver fails; multipliers and velocities sum up."""
    shape, pairs, mass, step = RESCUED[name]
    shift = 6.0 * np.arange(crowd + 1)[:, None, None]
    x = (shape + shift).reshape(-1, 3)
    new = x + 0.01
    rescued = crowd // 2
    new[rescued * len(shape) : (rescued + 1) * len(shape)] = np.array(step) + 6.0 * rescued
    masses = np.tile(mass, crowd + 1)
    rows = np.concatenate([np.array(pairs) + len(shape) * k for k in range(crowd + 1)])
    whole = ConstraintSet(held.Distance(rows), x, masses)
    motion = Motion(whole, x)
    (solver,) = motion.plan.solvers
    assert solver.name == name
    kept = new.copy()
    outcome = solver.positions(Request(kept, x))
    assert not outcome.converged
    np.testing.assert_array_equal(kept, new)
    assert solver.rows[outcome.worst_row] // len(pairs) == rescued
    v, lam = np.zeros_like(x), np.empty(len(rows))
    y = motion.project_positions(new, x, velocities=v, dt=0.5, multipliers=lam)
    assert np.all(np.abs(whole.value(y)) <= whole.tolerance(y))
    from_lam = (whole.jacobian(x).T @ lam).reshape(-1, 3) / masses[:, None]
    np.testing.assert_allclose(y - new, from_lam, rtol=0, atol=1e-13)
    np.testing.assert_allclose(v, (y - new) / 0.5, rtol=0, atol=1e-12)
    assert motion.report(y).iterations > 0


# -- what has no solution ---------------------------------------------------------------------------


def test_rows_of_velocities_that_contradict_each_other() -> None:
    rows = [held.VelocityFormula("vx1", 0, None, 1.0), held.VelocityFormula("vx1 + vy2", [0, 1])]
    rows += [held.VelocityFormula("vy1", 1, None, 1.0)]
    motion = Motion(ConstraintSet(rows, WATER, np.ones(3)), WATER)
    with pytest.raises(ConvergenceError, match=r"contradict.*Remove or change"):
        motion.project_velocities(WATER, 0 * WATER)


def test_nothing_held() -> None:
    for rows in ([], [held.Distance(np.zeros((0, 2), int))]):
        motion = Motion(ConstraintSet(rows, WATER, np.ones(3)), WATER)
        assert motion.rank == 0 and motion.degrees_of_freedom == 9
        f = np.arange(9.0).reshape(3, 3)
        np.testing.assert_array_equal(motion.project_positions(f, WATER), f)
        np.testing.assert_array_equal(motion.project_velocities(WATER, f), f)
        np.testing.assert_array_equal(motion.restore_positions(f), f)
        np.testing.assert_array_equal(motion.project_forces(WATER, f), f)
        np.testing.assert_array_equal(motion.acceleration(WATER, f, f), f)
        np.testing.assert_array_equal(motion.constraint_force(WATER, f, f), 0)
        assert len(motion.multipliers(WATER, f, f)) == 0
        report = motion.report(WATER, f)
        assert report.condition == 1.0 and report.iterations == 0 and "rows 0" in str(report)


@pytest.mark.parametrize("seed", range(4))
def test_accelerations_of_a_light_atom_are_on_the_rows_to_their_own_rounding(seed: int) -> None:
    # Its force over its mass is a hundred thousand times what the rows leave of it.
    rng = np.random.default_rng(seed)
    x, masses = rng.standard_normal((4, 3)), np.array([800.0, 400.0, 1e-4, 150.0])
    rows = ConstraintSet(held.Distance(list(combinations(range(4), 2))), x, masses)
    a = Motion(rows, x).acceleration(x, np.zeros((4, 3)), rng.standard_normal((4, 3)))
    off = rows.jacobian(x) @ a.ravel()
    assert np.abs(off).max() < 50 * np.finfo(float).eps * np.abs(a).max()


@pytest.mark.parametrize("fixed", [False, True], ids=["solvers", "fixed atoms"])
def test_velocities_are_put_back_when_a_later_solver_fails(fixed):
    """One cluster has been solved, the next has no solution: positions, velocities and all are as they were."""
    x = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0], [6, 0, 0], [6, 1, 0], [9, 9, 9]], dtype=float)
    rows = [held.Distance([0, 1]), held.Distance([2, 3]), held.Angle([2, 3, 4])]
    motion = Motion(ConstraintSet([*rows, held.FixedAtoms([5])] if fixed else rows, x, np.ones(6)), x)
    assert len(motion.plan.solvers) > 1
    for far in ([0, 1], [2, 3]):
        new = x + 0.01 * np.random.default_rng(0).normal(size=x.shape)
        new[far] += [[0.0, 40.0, 0.0], [0.0, -40.0, 0.0]]
        v = np.random.default_rng(1).normal(size=x.shape)
        before = new.copy(), v.copy()
        with pytest.raises(ConvergenceError):
            motion.project_positions(new, x, velocities=v, dt=0.1, out=new)
        np.testing.assert_array_equal(new, before[0])
        np.testing.assert_array_equal(v, before[1])


@pytest.mark.parametrize("free", [0, 20], ids=["all atoms", "few among many"])
@pytest.mark.parametrize("of_the_set", [False, True])
def test_a_cell_that_moves_the_image_of_a_fixed_atom_is_refused(free, of_the_set):
    """No solver sees a row between fixed atoms: it was off by the change of the cell, and nothing was said."""
    x = np.concatenate([[[0.5, 0, 0], [9.5, 0, 0], [8.5, 0, 0]], np.full((free, 3), 5.0)])
    rows = [held.FixedAtoms([0, 1]), held.Distance([[0, 1], [1, 2]])]
    whole = ConstraintSet(rows, x, np.ones(len(x)), cell=[10.0] * 3)
    motion = Motion(whole, x)
    for _ in range(2):
        with pytest.raises(ContradictionError, match=r"#6 Distance\(0, 1\) lies between fixed atoms and is off"):
            if of_the_set:
                whole.with_cell([11.0, 10, 10])
                motion.project_velocities(x, x)
            else:
                motion.set_cell([11.0, 10, 10])
        assert np.array_equal(motion.lattice[0], 10 * np.eye(3))
        motion.certify(x)
    motion.set_cell([10.0, 12, 11])
    motion.certify(motion.project_positions(x + 0.01, x))


# -- what is said where a solve fails ---------------------------------------------------------------


def test_curvature_that_is_undefined() -> None:
    x = np.array([[1.0, 0, 0], [0.0, 0, 0], [0.0, 1.0, 0]])
    motion = Motion(ConstraintSet(held.Angle([0, 1, 2]), x, np.ones(3)), x)
    straight = np.array([[1.0, 0, 0], [0.0, 0, 0], [-1.0, 0.0, 0]])
    with pytest.raises(SingularGeometryError) as caught:
        motion.acceleration(straight, x, x)
    assert caught.value.rows == (0,) and caught.value.atoms == (0, 1, 2)


def chain(x: np.ndarray) -> Motion:
    rows = [held.Distance([[0, 1], [1, 2], [2, 3]]), held.Dihedral([[0, 1, 2, 3]])]
    return Motion(ConstraintSet(rows, x, np.ones(len(x))), x)


def folded(degrees: float) -> np.ndarray:
    """Four atoms whose last three are so far from one line, to the one side or to the other, and one elsewhere."""
    bend = np.radians(degrees)
    return np.array([[0, 1.0, 0], [0, 0, 0], [1.0, 0, 0], [1.0 + np.cos(bend), 0, np.sin(bend)], [5.0, 5, 5]])


@pytest.mark.parametrize("numbers", [None, np.array([10, 11, 12, 13, 14])])
@pytest.mark.parametrize(("before", "after", "named"), [(2.0, -2.0, True), (20.0, -20.0, True), (2.0, 20.0, False)])
def test_a_dihedral_that_becomes_straight_is_named(numbers, before, after, named) -> None:
    x = folded(before)
    motion, request = chain(x), Request(folded(after), x)
    told = Failures(motion.constraint_set, motion.plan, numbers)
    error = told.positions(request, Outcome(False, 0.25, 7, 0), motion.plan.solvers[0])
    assert isinstance(error, ConvergenceError) and "smaller time step" in str(error)
    names = "1, 2, 3" if numbers is None else "11, 12, 13"
    assert (f"Atoms {names} of row #3 Dihedral" in str(error)) == named
    assert np.array_equal(request.changed, folded(after)) and np.array_equal(x, folded(before))


# -- few constrained atoms among many free ones: the compact copy -----------------------------------


@pytest.mark.parametrize("moving", [False, True])
def test_few_atoms_among_many_get_what_they_get_alone(moving: bool) -> None:
    """The compact copy gives the numbers of the direct way, on the global atoms; all others stay."""
    many, x, numbers = system(400, moving=moving)
    alone = ConstraintSet(
        [c.renumbered(np.argsort(numbers)[np.searchsorted(np.sort(numbers), np.arange(len(x))).clip(0, ATOMS - 1)])
         for c in many.constraints],
        x[numbers], many.masses[numbers],
    )  # fmt: skip
    big, small = Motion(many, x), Motion(alone, x[numbers])
    assert big._atoms is not None and small._atoms is None
    assert big.rank == small.rank
    assert big.degrees_of_freedom - small.degrees_of_freedom == 3 * 400
    move, v = steps(len(x), 1)
    f = np.random.default_rng(5).normal(size=x.shape)
    free = np.setdiff1d(np.arange(len(x)), numbers)
    n = many.n_rows

    def alike(found, expected, tolerance, plain) -> None:
        np.testing.assert_allclose(found[numbers], expected, rtol=0, atol=tolerance)
        np.testing.assert_array_equal(found[free], plain[free])

    for time in (0.0, 0.4) if moving else (0.0,):
        vb, vs, lb, ls = v.copy(), v[numbers], np.empty(n), np.empty(n)
        kw = {"time": time, "reference_time": 0.0, "dt": 0.1}
        y = big.project_positions(x + move, x, velocities=vb, multipliers=lb, **kw)
        ys = small.project_positions((x + move)[numbers], x[numbers], velocities=vs, multipliers=ls, **kw)
        alike(y, ys, 1e-14, x + move)
        alike(vb, vs, 1e-12, v)
        np.testing.assert_allclose(lb, ls, rtol=0, atol=1e-12)
        found = big.project_velocities(y, v, time=time, multipliers=lb)
        alike(found, small.project_velocities(ys, v[numbers], time=time, multipliers=ls), 1e-13, v)
        np.testing.assert_allclose(lb, ls, rtol=0, atol=1e-12)
        for name, plain in (("acceleration", f / many.masses[:, None]), ("constraint_force", np.zeros_like(f))):
            expected = getattr(small, name)(ys, v[numbers], f[numbers], time)
            alike(getattr(big, name)(y, v, f, time), expected, 1e-11, plain)
        lam = big.multipliers(y, v, f, time)
        np.testing.assert_allclose(lam, small.multipliers(ys, v[numbers], f[numbers], time), rtol=0, atol=1e-11)
        alike(big.project_forces(y, f, time=time), small.project_forces(ys, f[numbers], time=time), 1e-12, f)
        off = x + 3 * move
        found = big.restore_positions(off, time=time)
        alike(found, small.restore_positions(off[numbers], time=time), 1e-10, off)


def test_memory_of_one_bond_does_not_depend_on_the_number_of_atoms() -> None:
    """After set-up: neither a step's peak nor what is kept between steps."""

    def used(n: int, traced: bool = True) -> tuple[int, int]:
        x = np.zeros((n, 3))
        x[n // 2] = [1.0, 0, 0]
        whole = ConstraintSet(held.Distance([0, n // 2]), x, np.ones(n))
        if traced:
            tracemalloc.start()
        motion = Motion(whole, x)
        kept = tracemalloc.get_traced_memory()[0]
        new, v = x + 0.0, np.zeros_like(x)
        new[0] += [0.01, 0.02, 0.03]
        motion.project_positions(new, x, velocities=v, dt=0.1, out=new)
        motion.project_velocities(new, v, out=v)
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        motion.project_positions(new, x, velocities=v, dt=0.1, out=new)
        motion.project_velocities(new, v, out=v)
        peak = tracemalloc.get_traced_memory()[1] - before
        tracemalloc.stop()
        return kept, peak

    used(1000, traced=False)  # kernels are compiled, which takes four times as long where memory is watched
    (kept_small, peak_small), (kept_large, peak_large) = used(1000), used(300_000)
    assert peak_large <= peak_small + 2000
    # The incidence of the set and the atoms it touches, but nothing by atom: 300,000 doubles are 2.4 MB.
    assert kept_large <= kept_small + 20_000


def test_errors_name_global_rows_and_atoms() -> None:
    many, x, numbers = system(400)
    motion = Motion(many, x)
    bond = numbers[[3, 4]].tolist()
    far = x.copy()
    far[bond[0]] += [40.0, 0, 0]
    with pytest.raises(ConvergenceError, match="smaller time step") as caught:
        motion.project_positions(far, x)
    assert list(caught.value.atoms) == bond
    assert many.row_name(caught.value.row) in str(caught.value)
    assert caught.value.cluster == motion.plan.labels[caught.value.row] >= 0
    assert caught.value.residual > caught.value.tolerance
    broken = x.copy()
    broken[numbers[9]] = np.nan
    for call in (
        lambda: motion.project_positions(broken, x),
        lambda: motion.project_positions(x, broken),
        lambda: motion.project_velocities(x, broken),
        lambda: motion.project_velocities(broken, x),
        lambda: motion.project_forces(x, broken),
        lambda: motion.restore_positions(broken),
    ):
        with pytest.raises(InputError, match=f"atom {numbers[9]} is not finite") as wrong:
            call()
        assert wrong.value.atoms == (numbers[9],)
    same = x.copy()
    same[bond[0]] = same[bond[1]]
    with pytest.raises(SingularGeometryError, match=f"atoms {bond[0]} and {bond[1]} coincide.*move them") as single:
        motion.project_velocities(same, x)
    assert single.value.atoms == tuple(bond)
    assert str(bond[0]) in str(motion.report(x))


# -- the report, and condition numbers against singular values of the whole matrix ------------------


TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
METHANE = np.vstack([np.zeros(3), 0.629 * TETRAHEDRON])


def mixed_system(extra: int = 0) -> tuple[Motion, np.ndarray]:
    """Water, methane by ten distances, an angle with its bonds, a radius of gyration; atoms from `extra` on."""
    x = np.vstack([WATER, METHANE + 5, 1.1 * WATER - 5, WATER[:, ::-1] + 9])
    rows = [
        held.Distance(TRIANGLE),
        held.Distance([(3 + i, 3 + j) for i, j in combinations(range(5), 2)]),
        held.Distance([(8, 9), (8, 10)]),
        held.Angle([(9, 8, 10)]),
        held.RadiusOfGyration([[11, 12, 13]]),
    ]
    numbers = np.arange(len(x)) + extra
    rows = [c.renumbered(numbers) for c in rows]
    whole = np.vstack([np.arange(3.0 * extra).reshape(extra, 3) + 50, x])
    masses = np.concatenate([np.ones(extra), [16.0, 1, 1], [12.0, 1, 1, 1, 1], [16.0, 1, 1], [3.0, 4, 5]])
    return Motion(ConstraintSet(rows, whole, masses), whole), whole


@pytest.mark.parametrize("extra", [0, 100])
def test_report_says_it_all(extra: int) -> None:
    motion, x = mixed_system(extra)
    whole = motion.constraint_set
    v = np.random.default_rng(0).normal(size=x.shape)
    report = motion.report(x, v)
    assert (report.rows, report.rank, report.degrees_of_freedom) == (17, 16, 3 * len(x) - 16)
    assert [(k.solver, k.clusters, k.rows, k.rank) for k in report.kinds] == [
        ("RigidTriangles", 1, 3, 3),
        ("SparseDistances", 1, 10, 9),
        ("SingleRows", 1, 1, 1),
        ("SparseRows", 1, 3, 3),
    ]
    A = whole.jacobian(x).toarray()
    for kind, rows in zip(report.kinds, (range(3), range(3, 13), [16], range(13, 16)), strict=True):
        assert kind.condition == pytest.approx(dense(whole, x, 1 / whole.masses, list(rows)), rel=1e-9)
        assert whole.row_name(rows[0]) == kind.example
    assert report.condition == max(k.condition for k in report.kinds)
    unit = A / np.linalg.norm(A, axis=1)[:, None]
    assert report.velocity_residual == pytest.approx(np.abs(unit @ v.ravel()).max(), rel=1e-12)
    assert report.iterations == 0 and all(k.iterations == 0 for k in report.kinds)
    text = str(report)
    for kind in report.kinds:
        assert kind.solver in text and kind.example in text and f"{kind.condition:.3g}" in text
    assert "rows 17, rank 16" in text and "condition" in text and "iterations" in text
    assert f"degrees of freedom {report.degrees_of_freedom}" in text


def test_the_worst_row_is_named_and_the_condition_is_found_where_it_is_asked_for() -> None:
    motion, x = mixed_system()
    off = x.copy()
    off[9] += 0.3
    report = motion.report(off, condition=False)
    assert report.worst_row in ("#13 Distance(8, 9)", "#15 Angle(9, 8, 10)")
    assert report.residual == np.abs(motion.constraint_set.value(off)).max()
    assert np.isnan([report.condition, report.velocity_residual, *(k.condition for k in report.kinds)]).all()
    assert report.worst_row in str(report) and " - " in str(report) and "nan" not in str(report)


# -- condition ------------------------------------------------------------------------------------------


def dense(whole: ConstraintSet, x: np.ndarray, inverse_masses: np.ndarray, rows: np.ndarray) -> float:
    B = whole.jacobian(x).toarray()[rows] * np.repeat(np.sqrt(inverse_masses), 3)
    s = np.linalg.svd(B / np.linalg.norm(B, axis=1)[:, None], compute_uv=False)
    return float(s[0] / s[s > 1e-9 * s[0]][-1])


def straight_chain(n: int) -> tuple[ConstraintSet, np.ndarray]:
    rng = np.random.default_rng(n)
    k = np.arange(n)
    x = np.stack([0.99 * k, 0.01 * (k % 2), 0.005 * rng.normal(size=n)], axis=1)
    return ConstraintSet(held.Distance(np.stack([k[:-1], k[1:]], axis=1)), x, np.full(n, 7.0)), x


@pytest.mark.parametrize("n", [2, 30, reports.DENSE_ROWS + 1, reports.DENSE_ROWS + 2, 900])
def test_one_cluster(n: int) -> None:
    """Straight-ish chains, whose condition grows with their length: the dense and the sparse way."""
    whole, x = straight_chain(n)
    w, rows = 1 / whole.masses, np.arange(n - 1)
    found = worst_condition(whole.jacobian(x), w, rows, np.zeros(n - 1, int), deficiency=0)
    assert found == pytest.approx(dense(whole, x, w, rows), rel=1e-6 if n - 1 <= reports.DENSE_ROWS else 1e-3)
    assert found > min(0.2 * n, 50)


# -- minima of potentials on constraints ------------------------------------------------------------


def repulsion(x, t):
    d = x[:, None] - x[None]
    r = np.linalg.norm(d, axis=-1) + np.eye(len(x))
    return np.sum(d / r[..., None] ** 3, axis=1)


@pytest.mark.parametrize("masses", [np.ones(12), np.geomspace(1, 200, 12)], ids=["equal", "unequal"])
def test_twelve_charges_on_a_sphere_make_an_icosahedron(masses):
    """Thomson's problem; its energy from Wales and Ulker, Phys. Rev. B 74, 212101 (2006)."""
    x = np.random.default_rng(1).normal(size=(12, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    motion = Motion(ConstraintSet(Sphere(range(12), [0, 0, 0], 1.0), x, masses), x)
    found = minimize(motion, repulsion, x, tolerance=1e-9, longest=0.2)
    assert found.largest < 1e-9
    np.testing.assert_allclose(np.linalg.norm(found.positions, axis=1), 1, rtol=1e-14)
    r = np.linalg.norm(found.positions[:, None] - found.positions[None], axis=-1)
    assert np.sum(1 / r[np.triu_indices(12, 1)]) == pytest.approx(49.165253058, abs=1e-8)
    assert found.evaluations < 150


def test_moving_targets_hold_still_at_their_time():
    x = np.array([[1.0, 0.2, 0.0]])
    motion = Motion(
        ConstraintSet(Sphere([0], [0, 0, 0], MovingTarget(lambda t: 1 + t, lambda t: 1.0, lambda t: 0.0)), x, [1.0]), x
    )
    found = minimize(motion, lambda x, t: np.array([[0.0, t, 0.0]]), x, tolerance=1e-10, longest=0.3, time=2.0)
    np.testing.assert_allclose(found.positions, [[0, 3, 0]], atol=1e-9)


def test_what_stops_it():
    x = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    motion = Motion(ConstraintSet(Sphere([0, 1], [0, 0, 0], 1.0), x, [1.0, 1.0]), x)
    with pytest.raises(NonFiniteError, match="force on atom 1 is not finite"):
        minimize(motion, lambda x, t: np.array([[0, 0, 0], [0, np.nan, 0]]), x, tolerance=1e-6, longest=0.1)
    with pytest.raises(ConvergenceError, match=r"after 3 steps, and not 1e-12; give more steps") as stopped:
        minimize(motion, repulsion, x, tolerance=1e-12, longest=0.01, steps=3)
    assert np.abs(stopped.value.positions - x).max() > 0.01
    back = np.array([[0, 1.0, 0], [0, 0, 0]])  # where it has gone it is told to go back
    with pytest.raises(ConvergenceError, match="no gradient, or not so exact") as stopped:
        minimize(
            motion,
            lambda y, t: back if np.allclose(y, x, rtol=0, atol=1e-12) else -3 * back,
            x,
            tolerance=1e-12,
            longest=0.1,
        )
    np.testing.assert_allclose(stopped.value.positions, x, atol=1e-12)
    for wrong in ({"tolerance": 0.0, "longest": 0.1}, {"tolerance": 1e-6, "longest": np.nan}):
        with pytest.raises(InputError, match="give a positive number"):
            minimize(motion, repulsion, x, **wrong)
    with pytest.raises(InputError, match="force"):
        minimize(motion, lambda x, t: np.zeros(3), x, tolerance=1e-6, longest=0.1)
