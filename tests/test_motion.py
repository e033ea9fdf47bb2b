"""The engine's public calls: what they change, what they leave alone, and what they refuse."""

from __future__ import annotations

import tracemalloc
from itertools import combinations

import numpy as np
import pytest

from kcons import constraints as held
from kcons import projection
from kcons.constraint_set import ConstraintSet
from kcons.errors import (
    ContradictionError,
    ConvergenceError,
    InfeasibleError,
    InputError,
    KconsError,
    SingularGeometryError,
)
from kcons.motion import Motion

WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])
TRIANGLE = list(combinations(range(3), 2))
ZIGZAG = np.cumsum(np.tile([[0.8, 0.9, 0.1], [0.9, -0.8, 0.2]], (10, 1)), axis=0)
ATOMS = 26


def rows_of_every_kind() -> list[held.Constraint]:
    """Water, lanes, a chain, an anchored bond, mixed and general rows, and a dependent one."""
    return [
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


def system(extra: int, seed: int = 0, moving: bool = False):
    """The rows of every kind on scattered atoms among `extra` free ones; the constraint set and positions."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-4, 4, (ATOMS, 3))
    x[:3] = WATER
    x[5:14] = ZIGZAG[:9]
    masses = rng.choice([1.0, 12.0, 16.0], ATOMS)
    rows = rows_of_every_kind()
    if moving:
        rows.append(held.Distance([(23, 24)], lambda t: 3.0 + 0.3 * np.sin(t)))
        rows.append(held.LinearVelocity([[25]], [[1.0, 0.5, 0]], lambda t: np.cos(t)))
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


# -- few constrained atoms among many ---------------------------------------------------------------


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
    for time in (0.0, 0.4) if moving else (0.0,):
        vb, vs, lb, ls = v.copy(), v[numbers], np.empty(n), np.empty(n)
        kw = {"time": time, "reference_time": 0.0, "dt": 0.1}
        found = big.project_positions(x + move, x, velocities=vb, multipliers=lb, **kw)
        expected = small.project_positions((x + move)[numbers], x[numbers], velocities=vs, multipliers=ls, **kw)
        np.testing.assert_allclose(found[numbers], expected, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(found[free], (x + move)[free])
        np.testing.assert_allclose(vb[numbers], vs, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(vb[free], v[free])
        np.testing.assert_allclose(lb, ls, rtol=0, atol=1e-12)
        y, ys = found, expected
        found = big.project_velocities(y, v, time=time, multipliers=lb)
        expected = small.project_velocities(ys, v[numbers], time=time, multipliers=ls)
        np.testing.assert_allclose(found[numbers], expected, rtol=0, atol=1e-13)
        np.testing.assert_array_equal(found[free], v[free])
        np.testing.assert_allclose(lb, ls, rtol=0, atol=1e-12)
        for name in ("acceleration", "constraint_force"):
            found = getattr(big, name)(y, v, f, time)
            expected = getattr(small, name)(ys, v[numbers], f[numbers], time)
            np.testing.assert_allclose(found[numbers], expected, rtol=0, atol=1e-11)
            plain = f / many.masses[:, None] if name == "acceleration" else np.zeros_like(f)
            np.testing.assert_array_equal(found[free], plain[free])
        lam = big.multipliers(y, v, f, time)
        np.testing.assert_allclose(lam, small.multipliers(ys, v[numbers], f[numbers], time), rtol=0, atol=1e-11)
        found = big.project_forces(y, f, time=time)
        np.testing.assert_allclose(found[numbers], small.project_forces(ys, f[numbers], time=time), rtol=0, atol=1e-12)
        np.testing.assert_array_equal(found[free], f[free])
        off = x + 3 * move
        found = big.restore_positions(off, time=time)
        np.testing.assert_allclose(found[numbers], small.restore_positions(off[numbers], time=time), rtol=0, atol=1e-10)
        np.testing.assert_array_equal(found[free], off[free])


def test_free_atoms_may_hold_anything() -> None:
    many, x, numbers = system(400)
    motion = Motion(many, x)
    free = np.setdiff1d(np.arange(len(x)), numbers)
    step, v = x + steps(len(x), 1)[0], np.zeros_like(x)
    step[free], v[free] = np.nan, np.inf
    assert np.isfinite(motion.project_positions(step, x, velocities=v, dt=1.0)[numbers]).all()
    assert np.isfinite(motion.project_velocities(x, v)[numbers]).all()
    assert np.isfinite(motion.project_forces(x, v)[numbers]).all()


def test_memory_of_one_bond_does_not_depend_on_the_number_of_atoms() -> None:
    """After set-up: neither a step's peak nor what is kept between steps."""

    def used(n: int) -> tuple[int, int]:
        x = np.zeros((n, 3))
        x[n // 2] = [1.0, 0, 0]
        whole = ConstraintSet(held.Distance([0, n // 2]), x, np.ones(n))
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

    used(1000)  # kernels are loaded
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
    motion, x = sample
    move, v = steps(len(x), 3)
    new = x + move
    calls = {
        "positions": (lambda y, **kw: motion.project_positions(y, x, **kw), new),
        "velocities": (lambda y, **kw: motion.project_velocities(x, y, **kw), v),
        "restore": (lambda y, **kw: motion.restore_positions(y, **kw), new),
        "forces": (lambda y, **kw: motion.project_forces(x, y, **kw), v),
    }
    for name, (call, given) in calls.items():
        expected = call(given)
        here = given.copy()
        assert call(here, out=here) is here, name
        np.testing.assert_array_equal(here, expected, err_msg=name)
        other = np.full_like(given, 7.0)
        kept = given.copy()
        assert call(given, out=other) is other, name
        np.testing.assert_array_equal(other, expected, err_msg=name)
        np.testing.assert_array_equal(given, kept, err_msg=name)
        # The array of the reference may take the result.
        reference = x.copy()
        second = {
            "positions": lambda given=given, r=reference: motion.project_positions(given, r, out=r),
            "velocities": lambda given=given, r=reference: motion.project_velocities(r, given, out=r),
            "forces": lambda given=given, r=reference: motion.project_forces(r, given, out=r),
        }
        if name in second:
            np.testing.assert_array_equal(second[name](), expected, err_msg=name)


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


@pytest.mark.parametrize("layout", ["float32", "list", "Fortran", "strided", "big-endian", "integers"])
def test_arrays_of_any_kind_are_read(sample, layout: str) -> None:
    motion, x = sample
    move, v = steps(len(x), 4)
    new = x + move

    def made(y: np.ndarray):
        wide = np.zeros((2 * len(y), 6))
        wide[::2, ::2] = y
        table = {
            "float32": y.astype(np.float32),
            "list": y.tolist(),
            "Fortran": np.asfortranarray(y),
            "strided": wide[::2, ::2],
            "big-endian": y.astype(">f8"),
            "integers": np.rint(y).astype(int),
        }
        return table[layout]

    if layout == "integers":
        u = made(10 * v)
        np.testing.assert_array_equal(motion.project_velocities(x, u), motion.project_velocities(x, u.astype(float)))
        return
    exact = np.asarray(made(new), dtype=np.float64)
    reference = np.asarray(made(x), dtype=np.float64)
    result = motion.project_positions(made(new), made(x))
    np.testing.assert_array_equal(result, motion.project_positions(exact, reference))
    assert result.dtype == np.float64
    speeds = np.asarray(made(v), dtype=np.float64)
    np.testing.assert_array_equal(
        motion.acceleration(made(x), made(v), made(v)), motion.acceleration(reference, speeds, speeds)
    )


@pytest.mark.parametrize(
    "bad", [np.zeros((3, 3)), np.zeros(9), np.zeros((26, 2)), [[1.0, 2], [3]], "positions", [[{}] * 3] * 26]
)
def test_wrong_shapes_are_refused_by_name(bad) -> None:
    whole, x, _ = system(0)
    motion = Motion(whole, x)
    v = np.zeros_like(x)
    calls = {
        "x_new": lambda: motion.project_positions(bad, x),
        "x_ref": lambda: motion.project_positions(x, bad),
        "velocities": lambda: motion.project_velocities(x, bad),
        "positions": lambda: motion.project_velocities(bad, v),
        "forces": lambda: motion.project_forces(x, bad),
    }
    for item, call in calls.items():
        with pytest.raises(InputError, match=item) as caught:
            call()
        assert caught.value.item == item
    for call in (motion.acceleration, motion.multipliers, motion.constraint_force):
        with pytest.raises(InputError, match="forces"):
            call(x, v, bad)
    with pytest.raises(InputError, match="positions"):
        motion.restore_positions(bad)
    with pytest.raises(InputError, match="positions"):
        motion.report(bad)
    with pytest.raises(InputError):
        Motion(whole, bad)


def test_arrays_that_cannot_take_a_result_are_refused(sample) -> None:
    motion, x = sample
    n = motion.constraint_set.n_rows
    read_only = x.copy()
    frozen(read_only)
    for out in (x.astype(np.float32), np.asfortranarray(x), x[:-1].copy(), read_only, x.tolist()):
        for call in (
            lambda out=out: motion.project_positions(x, x, out=out),
            lambda out=out: motion.project_velocities(x, x, out=out),
            lambda out=out: motion.project_forces(x, x, out=out),
            lambda out=out: motion.restore_positions(x, out=out),
            lambda out=out: motion.project_positions(x, x, velocities=out, dt=1.0),
        ):
            with pytest.raises(InputError, match="contiguous float64"):
                call()
    with pytest.raises(InputError, match="out"):
        motion.project_positions(read_only, x, out=read_only)
    with pytest.raises(InputError, match="out"):
        motion.project_velocities(x, read_only, out=read_only)
    for lam in (np.zeros(n + 1), np.zeros(n, dtype=np.float32), [0.0] * n, np.zeros((n, 1))):
        with pytest.raises(InputError, match="multipliers"):
            motion.project_positions(x, x, multipliers=lam)
        with pytest.raises(InputError, match="multipliers"):
            motion.project_velocities(x, x, multipliers=lam)


@pytest.mark.parametrize("dt", [None, 0.0, np.nan, np.inf])
def test_velocities_need_a_time_step(dt) -> None:
    whole, x, _ = system(0)
    with pytest.raises(InputError, match="dt is"):
        Motion(whole, x).project_positions(x, x, velocities=np.zeros_like(x), dt=dt)


def test_unknown_way_with_degenerate_rows() -> None:
    with pytest.raises(InputError, match="degenerate must be"):
        Motion(ConstraintSet([], WATER, np.ones(3)), WATER, degenerate="ignore")


# -- corrections and multipliers --------------------------------------------------------------------


def test_velocities_get_the_correction_over_dt(sample) -> None:
    motion, x = sample
    move, v = steps(len(x), 6)
    for dt in (0.5, -0.5, 1e-3):
        u = v.copy()
        y = motion.project_positions(x + move, x, velocities=u, dt=dt)
        fixed = motion.constraint_set.constraints[3].atoms[0, 0]
        change = (y - x - move) / dt
        np.testing.assert_allclose(np.delete(u - v - change, fixed, axis=0), 0, atol=1e-14 / abs(dt))
        np.testing.assert_array_equal(u[fixed], v[fixed])


def test_multipliers_are_natural_and_those_of_fixed_atoms_zero(sample) -> None:
    """x - x_new = M^-1 A(x_ref)^T Lambda and v - v' = M^-1 A^T mu with gradients of lengths, angles, ..."""
    motion, x = sample
    whole = motion.constraint_set
    move, v = steps(len(x), 7)
    lam = np.full(whole.n_rows, np.nan)
    y = motion.project_positions(x + move, x, multipliers=lam)
    fixed = whole.constraints[3].atoms[0, 0]
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
    "water": (
        np.array([[0.0, 0, 0], [1.0, 0, 0], [-0.25, 0.97, 0]]),
        TRIANGLE,
        [4.2, 1.65, 3.2],
        [[0.38, 0.36, -0.25], [1.55, 0.25, 0.1], [-0.69, 0.74, 0.0]],
    ),
    "lanes": (
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
    outcome = solver.positions(kept, x, None, None, None, 0.0, None, 0.0, 0.0)
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


# -- targets that move, fixed atoms, cells ----------------------------------------------------------


def test_a_distance_that_grows() -> None:
    """The position projection meets the target at `time` along the gradients at `x_ref`."""
    target = held.MovingTarget(lambda t: 1.0 + 0.5 * t, lambda t: 0.5, lambda t: 0.0)
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    masses = np.array([1.0, 3.0])
    motion = Motion(ConstraintSet(held.Distance([0, 1], target), x, masses), x)
    lam = np.empty(1)
    y = motion.project_positions(x, x, time=0.4, reference_time=0.0, multipliers=lam)
    np.testing.assert_allclose(y, [[-0.15, 0, 0], [1.05, 0, 0]], rtol=0, atol=1e-15)
    np.testing.assert_allclose(lam, 0.2 / (1 + 1 / 3), rtol=1e-14)
    v = motion.project_velocities(x, np.zeros((2, 3)), time=0.0)
    np.testing.assert_allclose(v, [[-0.375, 0, 0], [0.125, 0, 0]], rtol=0, atol=1e-16)
    np.testing.assert_allclose(motion.restore_positions(x, time=1.0), [[-0.375, 0, 0], [1.125, 0, 0]], atol=1e-15)


def test_reference_time_is_that_of_the_gradients() -> None:
    """A plane that turns: corrections along its normal at `reference_time`, onto where it is at `time`."""

    def normal(t: float) -> np.ndarray:
        return np.array([-np.sin(t), np.cos(t), 0.0])

    plane = held.ImplicitSurface(
        [0], lambda r, t: r @ normal(t), lambda r, t: np.tile(normal(t), (len(r), 1)), time_dependent=True
    )
    x = np.array([[1.0, 0.0, 0.0]])
    motion = Motion(ConstraintSet(plane, x, [2.0]), x)
    for reference in (0.0, 0.2, None):
        along = normal(0.3 if reference is None else reference)
        expected = x[0] - along * (x[0] @ normal(0.3)) / (along @ normal(0.3))
        y = motion.project_positions(x, x, time=0.3, reference_time=reference)
        np.testing.assert_allclose(y[0], expected, rtol=0, atol=1e-14)
    f = np.array([[1.0, 2.0, 3.0]])
    for time in (0.0, 0.3):
        expected = f[0] - normal(time) * (normal(time) @ f[0])
        np.testing.assert_allclose(motion.project_forces(x, f, time=time)[0], expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("mass", [0.0, 5.0])
def test_fixed_atoms_have_infinite_mass(mass: float) -> None:
    x = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 1.0, 0]])
    rows = [held.FixedAtoms([0]), held.Distance([[0, 1], [1, 2]])]
    masses = np.array([mass, 2.0, 3.0])
    whole = ConstraintSet(rows, x, masses)
    motion = Motion(whole, x)
    assert motion.rank == 5 and motion.degrees_of_freedom == 4
    y = motion.project_positions(x + 0.1, x)
    np.testing.assert_array_equal(y[0], x[0])
    assert np.abs(whole.value(y)).max() < 1e-15
    v = motion.project_velocities(x, np.ones((3, 3)))
    np.testing.assert_array_equal(v[0], 0)
    # With a very heavy first atom, the oracle says the same of the others.
    heavy = np.array([1e14, 2.0, 3.0])
    A = whole.jacobian(x).toarray()
    f, b = np.random.default_rng(0).normal(size=(3, 3)), np.zeros(len(A))
    a = projection.acceleration(A[3:], heavy, f, b[3:])
    found = motion.acceleration(x, np.zeros((3, 3)), f)
    np.testing.assert_allclose(found[1:], a[1:], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found[0], 0)
    z = motion.constraint_force(x, np.zeros((3, 3)), f)
    np.testing.assert_allclose(f + z, masses[:, None] * found, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(motion.project_forces(x, f)[0], 0)
    lam = motion.multipliers(x, np.zeros((3, 3)), f)
    np.testing.assert_allclose(A.T @ lam, z.ravel(), rtol=0, atol=1e-14)


def test_fixed_atoms_that_move_as_prescribed() -> None:
    """A pendulum whose support shakes: Newton's second law in the frame of the support."""
    omega, swing = 1.7, 0.3
    support = held.MovingTarget(
        lambda t: [0.0, swing * np.sin(omega * t), 0.0],
        lambda t: [0.0, swing * omega * np.cos(omega * t), 0.0],
        lambda t: [0.0, -swing * omega**2 * np.sin(omega * t), 0.0],
    )
    x = np.array([[0.0, 0, 0], [0.6, -0.8, 0]])
    motion = Motion(ConstraintSet([held.FixedAtoms([0], support), held.Distance([0, 1], 1.0)], x, [0.0, 2.0]), x)
    time = 0.9
    place = np.array([0.0, swing * np.sin(omega * time), 0.0])
    here = np.vstack([place, place + x[1]])
    np.testing.assert_allclose(motion.project_positions(here - 0.01, here, time=time)[0], place, rtol=0, atol=0)
    v = motion.project_velocities(here, np.zeros((2, 3)), time=time)
    rate = np.array([0.0, swing * omega * np.cos(omega * time), 0.0])
    np.testing.assert_allclose(v[0], rate, rtol=1e-15)
    np.testing.assert_allclose(v[1], x[1] * (x[1] @ rate), rtol=0, atol=1e-15)
    f = np.array([[0.0, 0, 0], [0.3, -9.0, 0.2]])
    a = motion.acceleration(here, v, f, time)
    lift = np.array([0.0, -swing * omega**2 * np.sin(omega * time), 0.0])
    relative = v[1] - v[0]
    along = x[1] @ (f[1] / 2.0 - lift) + relative @ relative
    np.testing.assert_allclose(a[0], lift, rtol=1e-14)
    np.testing.assert_allclose(a[1], f[1] / 2.0 - x[1] * along, rtol=0, atol=1e-14)


def test_dependent_rows_on_fixed_atoms_share_their_multiplier() -> None:
    """Two rods in line that hold one atom: of all solutions the one of least norm."""
    x = np.array([[-1.0, 0, 0], [0, 0, 0], [1.0, 0, 0]])
    rows = [
        held.FixedAtoms([0, 2]),
        held.LinearCombination([1, 0], [[1.0, 0, 0], [-1.0, 0, 0]]),
        held.LinearCombination([1, 2], [[1.0, 0, 0], [-1.0, 0, 0]]),
    ]
    motion = Motion(ConstraintSet(rows, x, np.ones(3)), x)
    f = np.array([[0.0, 0, 0], [4.0, 1, 0], [0, 0, 0]])
    lam = motion.multipliers(x, np.zeros((3, 3)), f)
    np.testing.assert_allclose(lam[6:], [-2.0, -2.0], rtol=1e-14)
    np.testing.assert_allclose(motion.constraint_force(x, np.zeros((3, 3)), f).sum(axis=0), [-4.0, 0, 0], atol=1e-14)


CELL = np.array([[9.0, 0, 0], [2.0, 8.5, 0], [-1.5, 1.0, 9.5]])


@pytest.mark.parametrize("extra", [0, 400])
def test_triclinic_cell(extra: int) -> None:
    """Wrapped atoms, one by one: same corrections as in the open, for compiled and interpreted rows."""
    rng = np.random.default_rng(2)
    x = np.vstack([WATER, WATER[:2] + 2, ZIGZAG[:9], rng.uniform(0, 2, (3, 3)), rng.uniform(-4, 4, (extra, 3))])
    rows = [
        held.Distance([*TRIANGLE, (3, 4), *((k, k + 1) for k in range(5, 13)), (14, 15)]),
        held.Angle([(14, 15, 16)]),
        held.CenterDistance([[0, 1, 2]], [[3, 4]]),
    ]
    masses = rng.uniform(1, 20, len(x))
    open_motion = Motion(ConstraintSet(rows, x, masses), x)
    shift = rng.integers(-2, 3, x.shape) @ CELL
    periodic = Motion(ConstraintSet(rows, x + shift, masses, cell=CELL), x + shift)
    assert periodic.rank == open_motion.rank
    move, v = steps(len(x), 8)
    again = rng.integers(-1, 2, x.shape) @ CELL
    found = periodic.project_positions(x + move + again, x + shift)
    np.testing.assert_allclose(found - again, open_motion.project_positions(x + move, x), rtol=0, atol=1e-12)
    expected = open_motion.project_velocities(x, v)
    np.testing.assert_allclose(periodic.project_velocities(x + shift, v), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("extra", [0, 400])
@pytest.mark.parametrize("row", [held.Distance([0, 1]), held.CenterDistance([[0]], [[1]])])
def test_a_cell_that_changes(extra: int, row: held.Constraint) -> None:
    """A barostat sets the cell of the set it gave; every solver sees it, on a compact copy as well."""
    x = np.vstack([[[0.5, 0, 0], [9.5, 0, 0]], np.random.default_rng(0).uniform(0, 9, (extra, 3))])
    whole = ConstraintSet(row, x, np.ones(len(x)), cell=[10.0, 10, 10])
    motion = Motion(whole, x)
    motion.project_positions(x, x)
    whole.with_cell([10.5, 10, 10])
    y = motion.project_positions(x, x)
    np.testing.assert_allclose(y[1, 0] - y[0, 0], 9.5, rtol=0, atol=1e-14)
    assert motion.report(y).residual < 1e-14
    v = np.zeros_like(x)
    v[0, 1] = 1.0
    np.testing.assert_allclose(motion.project_velocities(y, v), v, rtol=0, atol=1e-15)


# -- every failure has a remedy ---------------------------------------------------------------------


def raised(call) -> KconsError:
    with pytest.raises(KconsError) as caught:
        call()
    return caught.value


def test_messages_say_what_to_do() -> None:
    far = WATER + np.array([[0, 0, 0], [7.0, 0, 0], [0, 0, 0]])
    motion = Motion(ConstraintSet(held.Distance(TRIANGLE), WATER, np.ones(3)), WATER)
    error = raised(lambda: motion.project_positions(far, WATER))
    assert isinstance(error, ConvergenceError) and "use a smaller time step" in str(error)
    rows = [held.Distance([0, 1]), held.Plane([0, 1], [1.0, 0, 0], [0.0, 3.0])]
    bent = WATER[1:]
    twice = Motion(ConstraintSet(rows, bent, np.ones(2)), bent)
    error = raised(lambda: twice.restore_positions(bent))
    assert isinstance(error, InfeasibleError) and "Check its target" in str(error)
    contrary = [held.LinearVelocity([[0]], [[1.0, 0, 0]], 1.0), held.LinearVelocity([[0, 1]], np.eye(3)[[0, 1]], 0.0)]
    contrary += [held.LinearVelocity([[1]], [[0, 1.0, 0]], 1.0)]
    error = raised(
        lambda: Motion(ConstraintSet(contrary, WATER, np.ones(3)), WATER).project_velocities(WATER, 0 * WATER)
    )
    assert isinstance(error, ConvergenceError) and "contradict" in str(error) and "Remove or change" in str(error)
    between = [held.FixedAtoms([0, 1]), held.Distance([0, 1], 2.0)]
    error = raised(lambda: Motion(ConstraintSet(between, WATER, np.ones(3)), WATER))
    assert isinstance(error, ContradictionError) and "free one of its atoms" in str(error)


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
