"""Rows of the device as plain C++ against the engine on arrays: every family, cells, small and large clusters."""

import numpy as np
import pytest

from kcons.constraints import Angle, CenterDistance, Distance, Formula, Plane, Sphere
from kcons.constraints.functions.straight_line import Function
from kcons.constraints.target import MovingTarget
from kcons.errors import UnsupportedError
from kcons.openmm.device.clusters import c_functions
from kcons.openmm.device.device_integrator import refusal
from kcons.openmm.device.rows import DeviceRows
from kcons.openmm.integrator.program import ConstantEnergy, to_scheme
from kcons.plan.clusters import elimination
from tests.systems.constraint_cases import CASES, MASSES, TIME, scattered
from tests.systems.device_rows import PlainRows
from tests.systems.rows_in_cells import CHAIN, ROWS
from tests.systems.rows_in_cells import MASSES as CHAIN_MASSES

NONE = np.zeros((0, 2), dtype=np.int64), np.zeros(0)
STEP = 0.01
#: Families that only Python computes, and atoms that move by themselves.
PYTHON = {name for name in CASES if name.startswith("Custom")}
MOVED = {"FixedAtoms moving"}


def held(items, x, masses, cell=None, time=TIME, precision="double"):
    """Rows of the device at positions on the rows, and inverse masses."""
    rows = DeviceRows(masses, NONE, items, positions=x, cell=cell, time=time)
    plain = PlainRows(rows, precision)
    w = 1 / masses
    w[rows.fixed] = 0
    start = rows.motion.restore_positions(x, time=time)
    plain.write(rows.renew(time, STEP, 1, start, cell))
    return plain, start, w


def compare(plain, x, w, cell, time, size, tolerance=1e-14, bound=1e-13):
    """Projections of random displacements and velocities, by the device and by the engine."""
    motion, rng = plain.rows.motion, np.random.default_rng(1)
    d, v = size * rng.normal(size=x.shape), rng.normal(size=x.shape)
    d[plain.rows.fixed] = v[plain.rows.fixed] = 0
    flown = plain.positions(x, d, w, STEP, time + STEP, tolerance, cell)
    wanted = motion.project_positions(x + d, x, time=time + STEP, reference_time=time, flight=STEP)
    assert not plain.failed
    assert np.abs(x + flown - wanted).max() <= bound
    tangent = plain.velocities(x, v, w, 1.0, time, cell)
    assert np.abs(tangent - motion.project_velocities(x, v, time=time)).max() <= bound
    assert np.abs(v - tangent).max() > 1e-3 or len(plain.rows.fixed)


def refused(parts):
    return refusal(to_scheme("rattle"), parts, ConstantEnergy())


def side_by_side(cases, x, masses):
    """Each case on particles of its own: constraints, positions and masses."""
    n, count = len(x), sum(len(items) for items in cases)
    items = [item.renumbered(np.arange(n) + n * k) for k, each in enumerate(cases) for item in each]
    assert len(items) == count
    return items, np.concatenate([x] * len(cases)), np.concatenate([masses] * len(cases))


def test_families_are_held_as_the_engine_holds_them():
    names = sorted(set(CASES) - PYTHON - MOVED)
    items, x, masses = side_by_side([[CASES[name]()] for name in names], scattered(6), MASSES)
    plain, start, w = held(items, x, masses)
    assert sum(len(shape.atoms) for shape in plain.rows.shapes) > 35
    assert {shape.together for shape in plain.rows.shapes} == {False, True}
    compare(plain, start, w, None, TIME, 0.002)


@pytest.mark.parametrize("name", sorted(PYTHON))
def test_functions_of_python_are_refused_with_the_remedy(name):
    item = CASES[name]()
    assert "device=False" in refused([item]) and "Formula" in refused([item])
    with pytest.raises(UnsupportedError, match="function of Python"):
        DeviceRows(MASSES, NONE, [item], positions=scattered(7), time=TIME)
    assert refused([Formula("(x1-x2)**2 + (y1-y2)**2 + (z1-z2)**2", [[0, 1]])]) == ""  # what the remedy names


def test_constraints_of_no_rows_hold_nothing():
    x, masses, items = chain_of(5, True)
    d = 1e-3 * np.random.default_rng(0).normal(size=x.shape)
    found = []
    for some in (items, [Distance(np.zeros((0, 2), int)), *items, Plane([], [0, 0, 1.0])]):
        plain, start, w = held(some, x, masses)
        found.append(plain.positions(start, d, w, STEP, TIME))
    np.testing.assert_array_equal(*found)
    assert not DeviceRows(masses, NONE, [Distance(np.zeros((0, 2), int))], positions=x).shapes


def test_what_else_is_refused():
    assert refused([Distance([[0, 1]]), CenterDistance([0, 1], [2, 3])]) == ""
    assert "not held on the device" in refused([object()])
    with pytest.raises(UnsupportedError, match="moves, which the device does not"):
        DeviceRows(MASSES, NONE, [CASES["FixedAtoms moving"]()], positions=scattered(7), time=TIME)


@pytest.mark.parametrize("cell", [np.diag([7.0, 8.0, 9.0]), np.array([[7.0, 0, 0], [1.5, 8.0, 0], [-2.0, 1.3, 9.0]])])
def test_rows_take_the_images_that_the_engine_takes(cell):
    """Each particle stored in any cell."""
    items, x, masses = side_by_side(list(ROWS.values()), CHAIN, CHAIN_MASSES)
    x = x + np.random.default_rng(1).integers(-2, 3, size=x.shape) @ cell
    plain, start, w = held(items, x, masses, cell)
    compare(plain, start, w, cell, TIME, 0.02, tolerance=3e-14)


def test_targets_move_between_their_knots():
    """Over the steps of a block, and its rate in velocities."""
    swings = MovingTarget(
        lambda t: 1.5 + 0.1 * np.sin(7 * t), lambda t: 0.7 * np.cos(7 * t), lambda t: -4.9 * np.sin(7 * t)
    )
    bond = Distance([[0, 1]], swings)
    x = np.array([[0.0, 0, 0], [1.5 + 0.1 * np.sin(7.0), 0, 0]])
    rows = DeviceRows(np.ones(2), NONE, [bond], positions=x, time=1.0)
    plain = PlainRows(rows)
    plain.write(rows.renew(1.0, STEP, rows.block))
    for time in (1.0, 1.0037, 2.5, 1.0 + STEP * rows.block):
        d = plain.positions(x, np.zeros((2, 3)), np.ones(2), STEP, time)
        assert np.linalg.norm(x[1] + d[1] - x[0] - d[0]) == pytest.approx(1.5 + 0.1 * np.sin(7 * time), abs=2e-13)
        v = plain.velocities(x, np.zeros((2, 3)), np.ones(2), 1.0, time)
        # Knots are 0.005 apart: what rounds is the difference of two values, times the largest of the coefficients.
        assert v[1, 0] - v[0, 0] == pytest.approx(0.7 * np.cos(7 * time), abs=30 * 1.6 * 2.2e-16 / 0.005)
        assert not plain.velocities(x, np.zeros((2, 3)), np.ones(2), 0.0, time).any()
    plain.positions(x, np.zeros((2, 3)), np.ones(2), STEP, 1.2 + STEP * rows.block)
    assert plain.failed  # nothing is known there


def test_a_function_is_asked_once_for_a_time():
    """Its rates and accelerations are differences of the same values."""
    asked = []
    bond = Distance([[0, 1]], lambda t: asked.append(t) or 1.5 + 0.1 * np.sin(t))
    rows = DeviceRows(np.ones(2), NONE, [bond], positions=np.array([[0.0, 0, 0], [1.5, 0, 0]]), time=0.0)
    asked.clear()
    rows.renew(0.0, STEP, 10)
    assert len(asked) == len(set(asked)) > 25


# -- clusters ---------------------------------------------------------------------------------------


def chain_of(n, angles):
    """A zigzag chain, its bonds, and its angles."""
    rng = np.random.default_rng(3)
    x = 0.1 * np.stack([np.arange(n) * 1.2, np.arange(n) % 2 * 0.9, np.zeros(n)], axis=1)
    x += 0.005 * rng.normal(size=x.shape)
    items = [Distance(np.stack([np.arange(n - 1), np.arange(1, n)], axis=1))]
    if angles:
        items.append(Angle(np.stack([np.arange(n - 2), np.arange(1, n - 1), np.arange(2, n)], axis=1)))
    return x, rng.uniform(1, 16, n), items


@pytest.mark.parametrize(("n", "angles"), [(3, True), (5, True), (7, False), (8, False), (30, True), (200, True)])
def test_clusters_of_all_sizes(n, angles):
    x, masses, items = chain_of(n, angles)
    plain, start, w = held(items, x, masses)
    shapes = plain.rows.shapes
    assert [shape.together for shape in shapes] == [n - 1 + angles * (n - 2) > 6]
    assert plain.rows.work_group == (64 if not shapes[0].together else 32 if n < 40 else 256)
    compare(plain, start, w, None, TIME, 2e-4)


@pytest.mark.parametrize(("precision", "tolerance"), [("mixed", 1e-10), ("single", 1e-6)])
@pytest.mark.parametrize("n", [4, 5, 60])
def test_residuals_are_the_tolerance_that_was_asked_for(precision, tolerance, n):
    x, masses, items = chain_of(n, n < 60)
    plain, start, w = held(items, x, masses, precision=precision)
    rng = np.random.default_rng(0)
    d = 5e-4 * rng.normal(size=x.shape)
    flown = plain.positions(start, d, w, STEP, TIME, tolerance)
    assert not plain.failed
    rounding = 4e-7 if precision == "single" else 0.0  # of positions that are single numbers
    off = plain.rows.set.value(start + flown) / plain.rows.set.scale
    assert np.abs(off).max() <= tolerance + rounding / 0.1
    v = rng.normal(size=x.shape)
    across = plain.rows.set.jacobian(start) @ plain.velocities(start, v, w).ravel()
    # Small clusters of four rows and more have a matrix of single numbers, which is used twice.
    assert np.abs(across).max() <= (3e-5 if precision == "single" else 1e-13 if n == 60 else 1e-11)


@pytest.mark.parametrize("n", [4, 9])
def test_rows_that_depend_on_others_are_left_to_them(n):
    """All distances between n atoms: for nine of them 15 of 36 depend on the others."""
    rng = np.random.default_rng(2)
    x = rng.normal(size=(n, 3))
    every = Distance(np.array([[i, j] for i in range(n) for j in range(i)]))
    plain, start, w = held([every], x, rng.uniform(1, 9, n))
    assert [sum(not row.depends for row in shape.rows) for shape in plain.rows.shapes] == [3 * n - 6]
    compare(plain, start, w, None, TIME, 1e-3, tolerance=1e-13, bound=3e-13)


def test_clusters_that_look_alike_share_their_code():
    """Waters of two masses, and rows of the System beside rows of parts."""
    rng = np.random.default_rng(0)
    water = np.array([[0, 0, 0], [0.09572, 0, 0], [-0.0239987, 0.0926627, 0]])
    x = np.concatenate([water + 0.5 * rng.normal(size=3) for _ in range(20)])
    pairs = np.array([[3 * k + i, 3 * k + j] for k in range(20) for i, j in ((0, 1), (0, 2), (1, 2))])
    lengths = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    masses = np.tile([16.0, 1.0, 1.0], 20)
    rows = DeviceRows(masses, (pairs, lengths), [Distance([[0, 3]])], positions=x)
    assert sorted((s.together, s.atoms.shape, len(s.rows)) for s in rows.shapes) == [
        (False, (18, 3), 3),
        (True, (1, 6), 7),
    ]
    plain = PlainRows(rows)
    d = 0.002 * rng.normal(size=x.shape)
    flown = plain.positions(x, d, 1 / masses, tolerance=1e-14)
    assert np.abs(x + flown - rows.motion.project_positions(x + d, x)).max() < 1e-14


def test_levels_have_rows_that_share_no_entry():
    """A path of 1,023 rows halves from level to level, a sheet by lines across it; all pairs have no cut."""
    assert len(elimination([(i, i + 1) for i in range(1023)], set()).levels) - 1 == 10
    sheet = [(i, j) for i in range(400) for j in (i + 1, i + 20) if j < 400 and (j - i == 20 or j % 20)]
    assert len(elimination(sheet, set()).levels) - 1 <= 130
    order = elimination([(i, j) for i in range(5) for j in range(i)], {2, 7})
    assert set(order.rows[-2:]) == {2, 7}  # rows that depend on others come last
    order = elimination([*sheet, (400, 401), (401, 402)], set())
    level = np.repeat(np.arange(len(order.levels) - 1), np.diff(order.levels))
    assert all(level[later] > level[k] for k, others in enumerate(order.later) for later in others)


# -- what is told -----------------------------------------------------------------------------------


def test_impulses_are_those_of_the_engine():
    """Of a small and a large cluster, positions and velocities; rows of the System are not summed."""
    x, masses, items = chain_of(12, True)
    x = np.concatenate([x, [[0, 0.8, 0], [0.1, 0.8, 0], [0, 1.8, 0], [0.1, 1.8, 0]]])
    masses = np.concatenate([masses, [2.0, 3.0, 4.0, 5.0]])
    rows = DeviceRows(masses, (np.array([[12, 13]]), np.array([0.1])), [*items, Distance([[14, 15]])], positions=x)
    plain, rng = PlainRows(rows), np.random.default_rng(4)
    d, v, h = 2e-4 * rng.normal(size=x.shape), rng.normal(size=x.shape), 0.002
    plain.positions(x, d, 1 / masses, h, tolerance=1e-14)
    plain.velocities(x, v, 1 / masses)
    plain.velocities(x, v, 1 / masses, rate=0.0)  # of a force: not summed
    landed, pushed = np.zeros(rows.set.n_rows), np.zeros(rows.set.n_rows)
    rows.motion.project_positions(x + d, x, multipliers=landed)
    rows.motion.project_velocities(x, v, multipliers=pushed)
    found = rows.multipliers(plain.arrays["rows_sums"], 0.5)
    assert np.isnan(found[0])
    np.testing.assert_allclose(
        found[1:], ((landed / h - pushed) / 0.5)[1:], rtol=0, atol=1e-9 * np.abs(found[1:]).max()
    )


@pytest.mark.parametrize("n", [3, 40])
@pytest.mark.parametrize("what", ["far", "nan"])
def test_rows_without_a_solution_are_told(n, what):
    """Bonds stretched to ten times their length in one step, and NaN: which row, by how much, in which step."""
    x, masses, items = chain_of(n, False)
    plain, start, w = held(items, x, masses)
    d = np.zeros_like(x)
    d[1] = np.nan if what == "nan" else [0.0, 0.0, 30.0]
    found = start + plain.positions(start, d, w)
    launch, step, row = plain.arrays["failure"]
    assert (launch, step) == (8, 4)
    error = plain.rows.failure(int(row), float(plain.arrays["looked"][5]), int(step))
    assert error.step == 4 and 0 <= error.row < n and error.row in error.atoms
    assert error.row in (0, 1) or (what, n) == ("far", 40)
    assert ("not finite" in str(error)) == (what == "nan") and "smaller time step" in str(error)
    if (what, n) == ("far", 3):  # distances are held by their squares, and told as lengths
        length, held_at = np.linalg.norm(np.subtract(*found[list(error.atoms)])), plain.rows.target[error.row]
        assert error.residual == pytest.approx(abs(length**2 - held_at**2) / (2 * held_at), rel=1e-9)


def test_a_bond_that_has_turned_over_is_no_solution():
    """The solution on the far side has the right length, and a gradient that has turned by 180 degrees."""
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    plain, start, w = held([Distance([[0, 1]])], x, np.ones(2))
    plain.positions(start, np.array([[1.0, 0, 0], [-1.0, 0, 0]]), w)
    assert plain.failed


def test_places_in_space_are_named():
    rows = DeviceRows(MASSES, NONE, [Plane(2, [0, 0, 1.0]), Distance([[4, 5]]), Sphere(3, [0, 0, 0.0])], scattered(7))
    assert rows.placed.tolist() == [2, 3]


# -- C ----------------------------------------------------------------------------------------------


def _with_a_branch(r, p, t, out):
    out[0] = r[0] if t > 0 else r[1]


def _divides(r, p, t, out):
    n = int(p[0])
    total = 0.0
    for k in range(n):
        total += r[k] ** 2 * (1 / 2) + r[k] ** -2
    out[0], out[1] = total / n, abs(-total) ** 0.5


def test_what_is_not_straight_is_refused():
    with pytest.raises(UnsupportedError, match=r"_with_a_branch is.*the function greater.*not written in C"):
        c_functions("f", Function(_with_a_branch))
    with pytest.raises(UnsupportedError, match="the function floor"):
        c_functions("f", Function(lambda r, p, t, out: out.update({0: np.floor(r[0])})))


def test_whole_numbers_are_not_divided_as_such():
    text = c_functions("f", Function(_divides, (2.0,)), "GLOBAL ")
    assert "1/2" not in text and "((mixed) 0.5)" in text and "GLOBAL mixed* out" in text
    assert text.count("r[") == 6
