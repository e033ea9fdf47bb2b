"""Few constrained atoms among many free ones: the compact copy, what it costs and how its errors name."""

import tracemalloc

import numpy as np
import pytest
from motion_systems import ATOMS, steps, system

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ConvergenceError, InputError, SingularGeometryError
from kcons.motion import Motion


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
