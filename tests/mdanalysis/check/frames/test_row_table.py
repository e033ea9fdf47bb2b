"""Rows of all kinds in a frame: lengths by compiled loops, the rest by their objects, and what a frame must be like."""

from __future__ import annotations

import numpy as np
import pytest
from MDAnalysis.lib.mdamath import triclinic_vectors

from kcons import ConstraintSet
from kcons.constraints import Angle, Dihedral, Distance, Plane
from kcons.errors import NonFiniteError
from kcons.mdanalysis.check.files.file_precision import FilePrecision
from kcons.mdanalysis.check.files.plain_dcd import Block
from kcons.mdanalysis.check.frames.deviations import Deviations
from kcons.mdanalysis.check.frames.row_table import RowTable, cell_matrix, unit_of

ATOMS = 8
DCD, GRID = FilePrecision("DCD"), FilePrecision("XTC", step=0.01, exact=True)
CUBE = np.array([30.0, 30.0, 30.0, 90.0, 90.0, 90.0], np.float32)
SKEWED = np.array([20.0, 22.0, 24.0, 80.0, 95.0, 70.0], np.float32)


@pytest.fixture
def x():
    rng = np.random.default_rng(3)
    return (np.arange(ATOMS)[:, None] * [1.4, 0.3, 0.0] + rng.normal(scale=0.3, size=(ATOMS, 3))).astype(np.float32)


def mixed(x):
    """Lengths, an angle, a dihedral and a plane, in this order, all a little off."""
    return ConstraintSet(
        [
            Distance([[0, 1], [1, 2], [4, 5]], [1.4, 1.5, 1.6]),
            Angle([[0, 1, 2]], 1.9),
            Dihedral([[2, 3, 4, 5]], 0.4),
            Plane([6], [0.0, 1.0, 0.0], 0.3),
        ],
        x.astype(np.float64),
        np.ones(ATOMS),
    )


def look(held, x, v=None, cell=None, precision=DCD, summed=True):
    table, found = RowTable(held, precision).fresh(), Deviations(held.n_rows, 1)
    table.look(found, 0, x.ravel(), None if v is None else v.ravel(), cell, 0.0, summed)
    table.collect(found)
    return table, found


# -- one frame --------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", [DCD, GRID], ids=["floats", "grid"])
def test_deviations_are_those_of_the_constraints(x, precision):
    held = mixed(x)
    table, found = look(held, x, precision=precision)
    exact = x.astype(float) if precision is DCD else np.rint(x.astype(float) * 100) / 100
    off = held.value(exact)
    assert table.length_rows.tolist() == [0, 1, 2] and table.other_rows.tolist() == [3, 4, 5]
    assert not table.only_lengths
    np.testing.assert_allclose(found.total, off, atol=1e-13)
    np.testing.assert_allclose(found.largest, np.abs(off), rtol=1e-6)
    assert found.counted.tolist() == [1] * 6
    for unit, rows in enumerate(([0, 1, 2, 5], [3, 4])):
        assert table.units[rows].tolist() == [unit] * len(rows)
        assert found.sums[unit, 0] == pytest.approx(off[rows].sum(), abs=1e-12)
        assert found.squares[unit, 0] == pytest.approx(off[rows] @ off[rows], rel=1e-11)
        assert found.worst[unit, 0] == pytest.approx(np.abs(off[rows]).max(), rel=1e-11)
        assert found.worst_row[unit, 0] == rows[int(np.argmax(found.margins[rows]))]
        assert found.seen[unit, 0] == len(rows)


def test_what_is_allowed_is_taken_from_the_excess(x):
    held = mixed(x)
    slack = np.array([0.0, 10.0, 0.0, 0.0, 10.0, 10.0])
    table, found = RowTable(held, DCD), Deviations(held.n_rows, 1)
    table.allow(slack)
    own = table.fresh()
    own.look(found, 0, x.ravel(), None, None, 0.0)
    own.collect(found)
    _, strict = look(held, x)
    np.testing.assert_allclose(found.margins, strict.margins - slack, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(found.total, strict.total)
    assert found.worst_row[1, 0] == 3


def test_nearest_images_for_rows_of_all_kinds(x):
    held = mixed(x)
    away = (x + 30.0 * np.random.default_rng(0).integers(-1, 2, size=x.shape)).astype(np.float32)
    away[6] = x[6]  # a plane stands where it is
    _, here = look(held, x, cell=CUBE)
    _, there = look(held, away, cell=CUBE)
    np.testing.assert_allclose(there.total, here.total, atol=3e-5)
    _, wrong = look(held, away)
    assert np.abs(wrong.total - here.total).max() > 1.0


def test_rates_of_rows_of_all_kinds(x):
    held = mixed(x)
    v = np.random.default_rng(5).normal(size=x.shape).astype(np.float32)
    _, found = look(held, x, v)
    rates = np.abs(held.jacobian(x.astype(float)) @ v.astype(float).ravel())
    for unit, rows in enumerate(([0, 1, 2, 5], [3, 4])):
        assert found.rate_worst[unit, 0] == pytest.approx(rates[rows].max(), rel=1e-11)
        assert found.rate_row[unit, 0] == rows[int(np.argmax(rates[rows]))]
        assert found.rate_squares[unit, 0] == pytest.approx(rates[rows] @ rates[rows], rel=1e-11)


def test_where_atoms_coincide_nothing_is_told_of_their_angle(x):
    x[0] = x[1]
    start = np.random.default_rng(1).normal(size=x.shape)
    held = ConstraintSet([Angle([[0, 1, 2], [3, 4, 5]], 1.9)], start, np.ones(ATOMS))
    _, found = look(held, x)
    assert found.counted.tolist() == [0, 1] and found.total[0] == 0.0 and np.isfinite(found.by_row).all()


def test_rows_longer_than_half_the_cell_are_left_to_their_objects():
    """Shorter rows tie their atoms together; compiled loops would take their images."""
    x = np.arange(ATOMS, dtype=np.float32)[:, None] * np.float32([2.5, 0.0, 0.0])
    bonds = Distance([[0, 1], [1, 2], [2, 3], [3, 4], [4, 5], [5, 6], [6, 7], [0, 7]], [2.5] * 7 + [17.0])
    held = ConstraintSet([bonds], x.astype(np.float64), np.ones(ATOMS), cell=30.0 * np.eye(3))
    table, found = look(held, x, cell=CUBE)
    assert (table.length_rows.tolist(), table.other_rows.tolist()) == (list(range(7)), [7])
    np.testing.assert_allclose(found.total, [0.0] * 7 + [0.5], atol=1e-6)


def test_copies_look_by_themselves(x):
    held = mixed(x)
    table = RowTable(held, DCD)
    one, other, found = table.fresh(), table.fresh(), Deviations(held.n_rows, 1)
    one.look(Deviations(held.n_rows, 1), 0, x.ravel(), None, CUBE, 0.0)
    other.collect(found)
    assert not found.total.any()
    assert one.cell_of(CUBE)[0] is not other.cell_of(CUBE)[0]


def test_a_block_of_frames(x):
    held = ConstraintSet([Distance([[0, 1], [1, 2], [4, 5]], [1.4, 1.5, 1.6])], x.astype(float), np.ones(ATOMS))
    frames = np.stack([x, x + np.float32(0.25), x[::-1]])
    cells = np.array([CUBE, CUBE, SKEWED])
    words = np.zeros((3, 3 * (ATOMS + 2)), dtype=np.int32)
    words.view(np.float32).reshape(3, 3, -1)[:, :, 1:-1] = frames.transpose(0, 2, 1)
    together, alone = Deviations(3, 3), Deviations(3, 3)
    table, singly = RowTable(held, DCD).fresh(), RowTable(held, DCD).fresh()
    room = np.empty((ATOMS, 3), np.float32)
    done, far = table.look_at_block(together, 0, Block(words, 0, cells), room, (1, 1))
    for k in range(3):
        singly.look(alone, k, frames[k].ravel(), None, cells[k], 0.0)
    table.collect(together)
    singly.collect(alone)
    assert done == 3
    np.testing.assert_array_equal(far, np.abs(frames).max(axis=(1, 2)))
    np.testing.assert_array_equal(together.by_frame, alone.by_frame)
    np.testing.assert_array_equal(together.by_row, alone.by_row)


# -- rounding ---------------------------------------------------------------------------------------


def test_errors_of_coordinates_bound_what_they_make_of_rows(x):
    held = mixed(x)
    table, errors = RowTable(held, DCD), np.linspace(1e-4, 3e-4, ATOMS)
    start = x.astype(np.float64)
    bounds = table.errors_of(errors, start, None, 0.0)
    rng = np.random.default_rng(8)
    moved = [start + errors[:, None] * rng.choice([-1.0, 1.0], size=x.shape) for _ in range(400)]
    made = np.max([np.abs(held.value(y) - held.value(start)) for y in moved], axis=0)
    assert np.all(made <= bounds) and np.all(made > 0.3 * bounds)


# -- cells ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dimensions", [CUBE, SKEWED, np.array([9, 9, 9, 60, 60, 90], np.float32)])
def test_cells_from_lengths_and_angles(dimensions):
    matrix = cell_matrix(dimensions)
    np.testing.assert_allclose(matrix, triclinic_vectors(dimensions), atol=1e-5)
    lengths = np.linalg.norm(matrix, axis=1)
    np.testing.assert_allclose(lengths, dimensions[:3], rtol=1e-12)
    cosines = [matrix[i] @ matrix[j] / lengths[i] / lengths[j] for i, j in ((1, 2), (0, 2), (0, 1))]
    np.testing.assert_allclose(cosines, np.cos(np.radians(dimensions[3:].astype(float))), atol=1e-12)


@pytest.mark.parametrize("dimensions", [None, [0, 0, 0, 90, 90, 90], [9, 9, 9, 30, 30, 90], [9, 9, 9, 90, 90, 0]])
def test_what_is_no_cell(dimensions):
    assert cell_matrix(dimensions) is None


@pytest.mark.parametrize("dimensions", [CUBE, SKEWED])
def test_half_of_the_smallest_width(x, dimensions):
    """Vectors that are shorter are their own nearest images."""
    (matrix, inverse), limit = RowTable(mixed(x), DCD).cell_of(dimensions)
    np.testing.assert_allclose(matrix @ inverse, np.eye(3), atol=1e-14)
    faces = np.cross(np.roll(matrix, -1, axis=0), np.roll(matrix, -2, axis=0))
    widths = abs(np.linalg.det(matrix)) / np.linalg.norm(faces, axis=1)
    assert np.sqrt(limit) == pytest.approx(0.5 * widths.min(), rel=1e-12)


def test_without_a_cell_nothing_is_far(x):
    table = RowTable(mixed(x), DCD)
    assert table.cell_of(None)[1] == np.inf
    assert table.cell_of(np.zeros(6, np.float32))[1] == np.inf
    assert np.isnan(table.cell_of(np.full(6, np.nan, np.float32))[1])


# -- refusals ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("atom", [1, 3, 6])
def test_positions_that_are_no_numbers_are_refused(x, atom):
    held = mixed(x)
    x[atom, 1] = np.nan
    with pytest.raises(NonFiniteError, match=f"position of atom {atom} is"):
        look(held, x)


def test_positions_of_atoms_that_nothing_holds_are_not_looked_at(x):
    held = mixed(x)
    x[7] = np.nan
    _, found = look(held, x)
    assert np.isfinite(found.total).all()


def test_velocities_and_cells_that_are_no_numbers_are_refused(x):
    v = np.zeros_like(x)
    v[5, 2] = np.inf
    with pytest.raises(NonFiniteError, match="velocity of atom 5 is"):
        look(mixed(x), x, v)
    with pytest.raises(NonFiniteError, match=r"the cell is \(30, nan,"):
        look(mixed(x), x, cell=np.array([30, np.nan, 30, 90, 90, 90], np.float32))


def test_units_of_rows():
    assert [unit_of(c) for c in (Distance([[0, 1]]), Plane([0], [0.0, 0.0, 1.0]), Angle([[0, 1, 2]]))] == [0, 0, 1]
