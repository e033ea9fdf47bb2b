"""The compiled loops over one frame, against plain arithmetic in NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.constraints.periodic.one_piece import lattice_of, minimum_image
from kcons.mdanalysis.check.frames import frame_kernels as kernels
from kcons.solvers.kernels.nearest_image import NO_LATTICE

ATOMS, SIDE = 200, 9.0
NO_CELL = (NO_LATTICE, np.inf)
PERIODIC = (lattice_of(SIDE * np.eye(3), True), (0.5 * SIDE) ** 2)
#: Half the distance of neighbouring singles, as a part of the power of two below.
HALF = 2.0**-24


def frame(seed=0, scale=6.0):
    return np.random.default_rng(seed).normal(scale=scale, size=(ATOMS, 3)).astype(np.float32)


def some_pairs(n, seed=1):
    rng = np.random.default_rng(seed)
    first = rng.integers(0, ATOMS, n)
    return np.stack([first, (first + rng.integers(1, ATOMS, n)) % ATOMS], axis=1)


def rows_of(pairs, targets, slack):
    places, held = kernels.padded(pairs, targets)
    n = len(held)
    begun = np.full(n, -np.inf, np.float32), np.zeros(n, np.float32), np.zeros((3, n))
    return kernels.Lengths(places, held, kernels.filled(slack), *begun)


def vectors(x, pairs, cell):
    d = x[pairs[:, 0]] - x[pairs[:, 1]]
    return minimum_image(d, cell[0]) if cell[1] < np.inf else d


def powers_of(x):
    powers = np.empty(len(x), np.float32)
    kernels.powers_below(x.ravel(), powers)
    return powers


# -- layout -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 4, 6])
def test_rows_are_filled_up_to_fours(n):
    pairs = np.arange(2 * n).reshape(n, 2)
    places, held = kernels.padded(pairs, np.arange(1.0, n + 1))
    assert places.shape == (2, 4 * -(-n // 4)) and len(held) == places.shape[1]
    np.testing.assert_array_equal(places[:, :n], pairs.T)
    assert np.all(places[0, n:] == places[1, n:]) and not held[n:].any()
    slack = kernels.filled(np.full(n, 0.5))
    assert np.all(slack[:n] == 0.5) and np.all(slack[n:] == np.inf) and len(slack) == len(held)


# -- coordinates ------------------------------------------------------------------------------------


def test_powers_of_two_below_the_largest_coordinate():
    x = np.array([[0.3, -5.0, 4.9], [-1.0, 0.5, 0.0], [0.0, 0.0, 0.0], [np.nan, 1.0, 1.0]], np.float32)
    assert powers_of(x).tolist() == [4.0, 1.0, 0.0, np.inf]


def test_the_farthest_coordinate_and_what_is_no_number():
    def size(x):
        return np.int32(kernels.farthest(np.asarray(x, np.float32))).view(np.float32)

    assert size([1.0, -7.5, 3.0]) == 7.5
    assert size([1.0, -np.inf, 3.0]) == np.inf
    assert np.isnan(size([1.0, np.nan, np.inf]))


@pytest.mark.parametrize("step", [0.0, 0.01])
def test_coordinates_as_the_file_holds_them(step):
    x = frame()
    exact = kernels.coordinate_grid(x, step)
    assert exact.dtype == np.float64
    if step:
        decimals = np.round(x.astype(np.float64) / step)
        np.testing.assert_allclose(exact, step * decimals, rtol=1e-15)
    else:
        np.testing.assert_array_equal(exact, x)
    singly = [kernels.coordinate(x.ravel(), k, step) for k in range(30)]
    np.testing.assert_array_equal(singly, exact.ravel()[:30])


def test_vectors_are_nearest_images_where_they_are_long():
    x, pairs = frame(), some_pairs(50)
    found = [kernels.difference(x.ravel(), 3 * i, 3 * j, PERIODIC[1], PERIODIC[0], 0.0) for i, j in pairs]
    np.testing.assert_allclose(found, vectors(x.astype(np.float64), pairs, PERIODIC), atol=1e-14)
    plain = [kernels.difference(x.ravel(), 3 * i, 3 * j, np.inf, NO_LATTICE, 0.0) for i, j in pairs]
    np.testing.assert_array_equal(plain, vectors(x.astype(np.float64), pairs, NO_CELL))
    assert np.abs(np.subtract(plain, found)).max() > SIDE / 2


# -- lengths ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", [NO_CELL, PERIODIC], ids=["no cell", "periodic"])
@pytest.mark.parametrize(
    "rounding", [(0.0, 1e-4, 0.0), (0.0, 0.0, HALF), (0.01, 0.005, 0.0)], ids=["even", "floats", "grid"]
)
def test_lengths_of_a_frame(cell, rounding):
    x, n = frame(), 3 * kernels.BLOCK + 4
    pairs, rng = some_pairs(n), np.random.default_rng(3)
    step, base, factor = rounding
    exact = kernels.coordinate_grid(x, step)
    true = np.linalg.norm(vectors(exact, pairs, cell), axis=1)
    off, slack = 0.1 * rng.normal(size=n), 0.02 * rng.random(n)
    rows = rows_of(pairs, true - off, slack)
    powers = powers_of(x) if factor else kernels.UNIFORM
    sums, squares, worst, excess, row, coarsest, seen = kernels.lengths(x.ravel(), rows, cell, rounding, powers, True)

    known = np.full(n, 2 * np.sqrt(3) * base)
    if factor:
        known = np.sqrt(3) * factor * (powers[pairs[:, 0]].astype(float) + powers[pairs[:, 1]])
    margins = np.abs(off) - known - slack
    assert sums == pytest.approx(off.sum(), abs=1e-11)
    assert squares == pytest.approx(off @ off, rel=1e-11)
    assert worst == pytest.approx(np.abs(off).max(), rel=1e-11)
    assert (excess, row) == (pytest.approx(margins.max(), rel=1e-10), np.argmax(margins))
    assert coarsest == pytest.approx(known.max(), rel=1e-12)
    assert seen == n
    np.testing.assert_allclose(rows.margins[:n], margins, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(rows.largest[:n], np.abs(off), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(rows.sums[:, :n], [off, known, np.ones(n)], rtol=1e-11, atol=1e-13)


def test_sums_by_row_are_left_out_where_they_are_not_asked_for():
    x, pairs = frame(), some_pairs(7)
    rows = rows_of(pairs, np.ones(7), np.zeros(7))
    *_, seen = kernels.lengths(x.ravel(), rows, NO_CELL, (0.0, 0.0, 0.0), kernels.UNIFORM, False)
    assert not rows.sums.any() and rows.largest[:7].all()
    assert seen == 8 and rows.largest[7] == 0.0  # what fills up is counted, and never off


def test_the_largest_excess_of_several_frames_stays():
    """With the deviation of its own frame, which need not be the largest."""
    pairs, x = np.array([[0, 1]]), np.zeros((2, 3), np.float32)
    rows = rows_of(pairs, np.ones(1), np.full(1, 0.05))
    for length in (1.1, 1.25, 0.9):
        x[0, 0] = length
        kernels.lengths(x.ravel(), rows, NO_CELL, (0.0, 0.0, 0.0), kernels.UNIFORM, False)
    assert rows.margins[0] == pytest.approx(0.2, rel=1e-6) and rows.largest[0] == pytest.approx(0.25, rel=1e-6)


def test_nothing_is_told_of_rows_coarser_than_their_length():
    x, pairs = frame(), some_pairs(8)
    targets, slack = np.full(8, 1e-3), np.zeros(8)
    targets[2], slack[5] = 10.0, 5.0
    rows = rows_of(pairs, targets, slack)
    *_, coarsest, seen = kernels.lengths(x.ravel(), rows, NO_CELL, (0.0, 0.5, 0.0), kernels.UNIFORM, True)
    assert seen == 2 and rows.sums[2].tolist() == [0, 0, 1, 0, 0, 1, 0, 0]
    assert coarsest == pytest.approx(np.sqrt(3))
    assert not rows.sums[:, [0, 1, 3, 4, 6, 7]].any()


def test_a_coordinate_that_is_no_number_shows_in_the_sums():
    x, pairs = frame(), some_pairs(40)
    x[pairs[17, 0], 2] = np.nan
    rows = rows_of(pairs, np.ones(40), np.zeros(40))
    sums, squares, *_ = kernels.lengths(x.ravel(), rows, NO_CELL, (0.0, 0.0, 0.0), kernels.UNIFORM, False)
    assert np.isnan(sums) and np.isnan(squares)


@pytest.mark.parametrize("cell", [NO_CELL, PERIODIC], ids=["no cell", "periodic"])
@pytest.mark.parametrize("rounding", [(0.0, 0.0, HALF), (0.01, 0.005, 0.0)], ids=["floats", "grid"])
def test_triangles_are_their_three_lengths(cell, rounding):
    x, n = frame(), kernels.BLOCK + 8
    corners = np.stack([some_pairs(n, 7)[:, 0], some_pairs(n, 8)[:, 0], some_pairs(n, 9)[:, 0]])
    sides = [(0, 1), (0, 2), (1, 2)]
    rng = np.random.default_rng(4)
    targets, slack = 1.0 + rng.random((3, n)), 0.1 * rng.random((3, n))
    begun = np.full((3, n), -np.inf, np.float32), np.zeros((3, n), np.float32), np.zeros((3, 3, n))
    rows = kernels.Lengths(corners.astype(np.uint32), targets, slack, *begun)
    powers = powers_of(x) if rounding[2] else kernels.UNIFORM
    *found, side, triangle, coarsest, seen = kernels.triangles(x.ravel(), rows, cell, rounding, powers, True)
    alone = [rows_of(corners[[a, b]].T, targets[s], slack[s]) for s, (a, b) in enumerate(sides)]
    singly = [kernels.lengths(x.ravel(), each, cell, rounding, powers, True) for each in alone]
    np.testing.assert_allclose(found[:2], np.sum(singly, axis=0)[:2], rtol=1e-12)
    assert found[2] == max(s[2] for s in singly) and found[3] == max(s[3] for s in singly)
    assert side == np.argmax([s[3] for s in singly]) and triangle == singly[side][4]
    assert coarsest == max(s[5] for s in singly) and seen == sum(s[6] for s in singly)
    for s in range(3):
        np.testing.assert_array_equal(rows.margins[s], alone[s].margins)
        np.testing.assert_array_equal(rows.largest[s], alone[s].largest)
        np.testing.assert_array_equal(rows.sums[:, s], alone[s].sums)


# -- velocities -------------------------------------------------------------------------------------


def test_rates_of_lengths():
    x, v, pairs = frame(), frame(5, 1.0), some_pairs(30)
    pairs[4] = 3, 3  # no direction, no rate
    places, _ = kernels.padded(pairs, 0.0)
    squares, worst, row = kernels.length_rates(x.ravel(), v.ravel(), places, 30, PERIODIC, 0.0)
    d = vectors(x.astype(np.float64), pairs, PERIODIC)
    along = np.sum(d * (v[pairs[:, 0]].astype(float) - v[pairs[:, 1]]), axis=1)
    lengths = np.linalg.norm(d, axis=1)
    rates = np.abs(np.divide(along, lengths, out=np.zeros(30), where=lengths > 0))
    assert squares == pytest.approx(rates @ rates, rel=1e-12)
    assert (worst, row) == (pytest.approx(rates.max(), rel=1e-12), np.argmax(rates))


def test_kinetic_energy_and_momentum():
    v, masses = frame(6, 1.0), np.random.default_rng(7).random(ATOMS)
    twice, *momentum = kernels.kinetic(v.ravel(), masses)
    assert twice == pytest.approx(masses @ (v.astype(float) ** 2).sum(axis=1), rel=1e-13)
    np.testing.assert_allclose(momentum, masses @ v.astype(float), rtol=1e-12, atol=1e-13)
