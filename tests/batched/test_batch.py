"""What a batch is given and tells: shapes, failures, refusals, precision, other batches, steps."""

import numpy as np
import pytest
import torch

from kcons import ConstraintSet, Motion
from kcons.batched import Batch, gbaoab, rattle
from kcons.constraints import Angle, CenterDistance, Custom, Distance, FixedAtoms
from kcons.errors import ConvergenceError, InputError, UnsupportedError
from tests.systems.constraint_cases import blade

WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.9266272, 0]])
MASSES = np.array([15.999, 1.008, 1.008])
PAIRS = [[0, 1], [0, 2], [1, 2]]


def water(shift=0.0, **options):
    x = WATER + shift
    return Motion(ConstraintSet(Distance(PAIRS), x, MASSES, **options), x)


def moved(batch, x, size=0.05, seed=0):
    return x + size * torch.randn(x.shape, generator=torch.Generator().manual_seed(seed), dtype=batch.dtype)


def test_shapes_follow_what_is_given():
    batch = Batch(water(), copies=4)
    x = torch.as_tensor(WATER).repeat(4, 1)
    flat, cube = moved(batch, x), moved(batch, x).reshape(4, 3, 3)
    found, push = batch.solve_positions(cube, x.reshape(4, 3, 3))
    assert found.shape == push.shape == (4, 3, 3)
    assert torch.equal(found.reshape(-1, 3), batch.project_positions(flat, x))
    assert torch.equal(cube, moved(batch, x).reshape(4, 3, 3)), "what is given stays"
    assert batch.multipliers(x, flat, flat).shape == (12,) and batch.multipliers(cube, cube, cube).shape == (4, 3)
    other = Batch([water(), Motion(ConstraintSet(Distance([[0, 1]]), WATER, MASSES), WATER)])
    assert other.multipliers(cube[:2], cube[:2], cube[:2]).shape == (4,)
    lengths = torch.tensor([1.0, 1.0, 1.6] * 4, dtype=torch.float64)
    other = batch.project_positions(flat, x, targets=lengths)
    assert ((other[1::3] - other[::3]).norm(dim=1) - 1).abs().max() < 1e-14


@pytest.mark.parametrize("cell", [None, 9.0 * np.eye(3)])
def test_constraints_of_no_rows_hold_nothing(cell):
    items = [Distance(np.zeros((0, 2), int)), Distance(PAIRS), Angle(np.zeros((0, 3), int))]
    batch = Batch(Motion(ConstraintSet(items, WATER, MASSES, cell=cell), WATER))
    x = torch.as_tensor(WATER)
    there = moved(batch, x)
    assert torch.equal(batch.project_positions(there, x), Batch(water(cell=cell)).project_positions(there, x))


def test_a_failure_names_copy_and_row_when_it_is_looked_for():
    batch = Batch([water(), water(0.1)], copies=2, check_every=3)
    x = torch.as_tensor(np.concatenate([WATER, WATER + 0.1] * 2))
    far = moved(batch, x)
    far[9:12] += torch.tensor([[0.0], [40.0], [-40.0]], dtype=torch.float64)
    wrong = batch.project_positions(far, x)
    assert (batch.project_positions(x, x) - x).abs().max() < 1e-14
    with pytest.raises(
        ConvergenceError, match=r"copy 3, row #\d Distance.*last 3 projections.*smaller time step"
    ) as told:
        batch.project_positions(x, x)
    assert told.value.copy == 3 and told.value.row in (0, 1, 2) and len(told.value.atoms) == 2
    batch.check()
    assert not torch.equal(wrong[:9], far[:9]) and ((wrong[:3] - wrong[0]).norm(dim=1)[1] - 0.9572).abs() < 1e-13
    x[4, 1] = torch.nan
    found = Batch([water(), water(0.1)], copies=2, check_every=9).project_positions(moved(batch, x), x)
    assert ((found[1] - found[0]).norm() - 0.9572).abs() < 1e-13
    batch = Batch([water(), water(0.1)], copies=2)
    with pytest.raises(ConvergenceError, match="copy 1, row"):
        batch.project_positions(x, x)


def test_a_bond_that_has_turned_is_no_solution():
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    batch = Batch(Motion(ConstraintSet(Distance([[0, 1]]), x, np.ones(2)), x))
    with pytest.raises(ConvergenceError, match="copy 0, row #0"):
        batch.project_positions(torch.tensor([[1.5, 0, 0], [0.0, 0, 0]], dtype=torch.float64), torch.as_tensor(x))


def test_single_precision_is_two_units_in_the_last_place():
    """At coordinates of 67, whose last place is 7.6e-6."""
    batch = Batch(water(67.0), copies=50, dtype=torch.float32)
    x = (torch.as_tensor(WATER).repeat(50, 1) + 67.0).float()
    y = moved(batch, batch.project_positions(x, x))
    found = batch.project_positions(y, x).double().reshape(50, 3, 3)
    lengths = torch.stack([(found[:, i] - found[:, j]).norm(dim=1) for i, j in PAIRS])
    wanted = batch.targets[:3, None].double()
    assert (lengths - wanted).abs().max() <= 2 * 2.0**-17
    v = batch.project_velocities(x, y)
    assert batch.report(x, v)[0].velocity_residual < 1e-5 * float(y.abs().max())


def test_what_is_refused():
    with torch.inference_mode():  # in which nothing is refused
        batch, x = Batch(water(), copies=2), torch.as_tensor(np.concatenate([WATER, WATER]))
    with pytest.raises(InputError, match=r"x_new must be a tensor of shape \(6, 3\)"):
        batch.project_positions(x[:3], x)
    with pytest.raises(InputError, match=r"x_new must be a tensor"):
        batch.project_positions(x.numpy(), x)
    v = torch.zeros_like(x)
    with pytest.raises(InputError, match=r"forces must have shape \(6, 3\), not \(1, 3\)"):
        rattle(batch, lambda x: x[:1], x, v, v, 0.1)
    hot = torch.tensor([1.0, np.inf])
    for settings, item in (((-0.1, 1.0, 1.0), "dt"), ((0.1, hot, 1.0), "kT"), ((0.1, 1.0, -1.0), "friction")):
        with pytest.raises(InputError, match=rf"{item} is (-\d\.\d|inf); give"):
            gbaoab(batch, lambda x: -x, x, v, v, *settings)
    for masses in (0.0 * batch.masses, -batch.masses, torch.nan * batch.masses):
        with pytest.raises(InputError, match=r"masses\[0\] is .* above 0"):
            batch.project_velocities(x, v, masses=masses)
    with pytest.raises(InputError, match=r"v must be a tensor of shape \(6, 3\) or \(2, 3, 3\)"):
        batch.project_velocities(x, v.reshape(3, 2, 3))
    assert all(torch.equal(rattle(batch, lambda x: -x, x, v, v, zero)[1], v) for zero in (0.0, 0 * x.sum()))
    with pytest.raises(InputError, match=r"x_reference must be .*torch.float64 on cpu; convert it"):
        batch.project_positions(x, x.float())
    for item in ("masses", "targets"):
        written, replaced = Batch(water(), copies=2), Batch(water(), copies=2)
        getattr(written, item)[0] = 1.1
        setattr(replaced, item, 1.1 * getattr(replaced, item))
        for other in (written, replaced):
            with pytest.raises(InputError, match=rf"{item} of a Batch were written to; give other ones as {item}="):
                other.project_positions(x, x)
    with pytest.raises(InputError, match=r"targets must be a tensor of shape \(6,\)"):
        batch.project_positions(x, x, targets=torch.ones(4, dtype=torch.float64))
    for wrong in ([], None):
        with pytest.raises(InputError, match=r"a kcons.Motion and the number of copies"):
            Batch(wrong)
    with pytest.raises(InputError, match=r"float64 or torch\.float32"):
        Batch(water(), dtype=torch.float16)
    for wrong in (0, "often"):
        with pytest.raises(InputError, match="check_every"):
            Batch(water(), check_every=wrong)
    centers = [CenterDistance([0], [1, 2])]
    groups = Batch(Motion(ConstraintSet(centers, WATER, MASSES), WATER))
    with pytest.raises(UnsupportedError, match="defined by the masses"):
        groups.project_positions(x[:3], x[:3], masses=torch.ones(3, dtype=torch.float64))
    with pytest.raises(UnsupportedError, match="moves with time; hold it at rest, and give each step its targets="):
        Batch(Motion(ConstraintSet(FixedAtoms(0, lambda t: [[t, 0, 0]]), WATER, MASSES), WATER))
    branch = Custom([0, 1], lambda r: float(r[0, 0] + r[1, 1]) if r[0, 0] > -9 else 1.0)
    with pytest.raises(UnsupportedError, match=r"cannot be run on tensors.*the function greater.*as a Formula"):
        Batch(Motion(ConstraintSet(branch, WATER + 0.3, MASSES), WATER + 0.3))


def test_rattle_is_that_of_the_engine_and_reversible():
    """Waters that attract each other by springs, beside a fixed atom and a blade."""
    copies = 3
    x0 = np.concatenate([WATER, WATER + 3, [[8.0, 0, 0], [9.0, 0.1, 0], [0.0, 8, 0]]])
    masses = np.concatenate([MASSES, MASSES, [2.0, 3.0, 5.0]])
    pairs = np.concatenate([PAIRS, np.array(PAIRS) + 3, [[6, 7]]])
    items = [Distance(pairs), blade([6, 7]), FixedAtoms([8])]
    motion = Motion(ConstraintSet(items, x0, masses), x0)
    batch = Batch(motion, copies=copies)
    x = torch.as_tensor(x0).repeat(copies, 1, 1)
    force = lambda x: -0.5 * x  # noqa: E731
    v = torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    v[:, 8] = 0
    v = batch.project_velocities(x, v)
    here = x, v, force(x)
    for _ in range(20):
        here = rattle(batch, force, *here, 0.01)
    y, u = motion_steps(motion, x0, v[1].numpy(), 0.01, 20)
    assert np.abs(here[0][1].numpy() - y).max() < 1e-12 and np.abs(here[1][1].numpy() - u).max() < 1e-12
    back = here[0], -here[1], here[2]
    for _ in range(20):
        back = rattle(batch, force, *back, 0.01)
    assert (back[0] - x).abs().max() < 1e-11 and (back[1] + v).abs().max() < 1e-10
    reports = batch.report(*here[:2])
    assert len(reports) == copies and all(r.residual < 1e-13 and r.velocity_residual < 1e-13 for r in reports)


def motion_steps(motion, x, v, dt, steps):
    """The same steps by the engine alone."""
    w = np.where(np.arange(len(x)) == 8, 0, 1 / motion.masses)[:, None]
    f = -0.5 * x
    for _ in range(steps):
        v = v + 0.5 * dt * w * f
        y = x + dt * v
        x = motion.project_positions(y, x, time=dt, reference_time=0.0, velocities=v, dt=dt, flight=dt)
        f = -0.5 * x
        v = motion.project_velocities(x, v + 0.5 * dt * w * f)
    return x, v


def test_langevin_keeps_the_temperature_of_the_degrees_of_freedom():
    """512 waters on springs: kinetic energy within four standard errors, and positions of half of it."""
    batch = Batch(water(), copies=512)
    x = torch.as_tensor(WATER).repeat(512, 1)
    force = lambda x: -4.0 * batch.masses[:, None] * x  # noqa: E731
    here, rng = (x, torch.zeros_like(x), force(x)), torch.Generator().manual_seed(5)
    kinetic = []
    for step in range(60):
        here = gbaoab(batch, force, *here, 0.1, 2.0, 3.0, generator=rng)
        if step >= 20:
            kinetic.append(float(0.5 * (batch.masses[:, None] * here[1] ** 2).sum()) / 512)
    # Six degrees of freedom of kT/2; samples forget each other within some steps.
    assert abs(np.mean(kinetic) - 6.0) < 4 * 6.0 * np.sqrt(2 / (6 * 512)) / np.sqrt(10)
    assert max(report.residual for report in batch.report(here[0])) < 1e-13


def test_compiled_steps_give_the_same():
    batch, fast = (Batch(water(), copies=5, compiled=compiled) for compiled in (False, True))
    x = torch.as_tensor(WATER).repeat(5, 1)
    y = moved(batch, x).requires_grad_()
    breaks = torch._dynamo.utils.counters["graph_break"]
    breaks.clear()
    one, two = batch.project_positions(y, x), fast.project_positions(y, x)
    assert (one - two).abs().max() < 1e-14
    assert not breaks  # which would leave a step to the interpreter
    first, second = (torch.autograd.grad((found**3).sum(), y)[0] for found in (one, two))
    assert (first - second).abs().max() < 1e-12
