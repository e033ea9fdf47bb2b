"""Lengths of a frame, by triangles and one by one, against plain arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
import water_files as files

from kcons.constraints.periodic.one_piece import lattice_of, minimum_image
from kcons.mdanalysis.check.files.file_precision import FilePrecision
from kcons.mdanalysis.check.files.plain_dcd import Block
from kcons.mdanalysis.check.frames.deviations import Deviations
from kcons.mdanalysis.check.frames.length_table import LengthTable, size_of
from kcons.solvers.kernels.nearest_image import NO_LATTICE

N, SIDE = 11, 12.0
PRECISION = FilePrecision("DCD")


def table(pairs, targets, slack=0.0):
    made = LengthTable(np.arange(len(pairs)), pairs, targets, 3 * N)
    made.allow(np.full(len(pairs), slack))
    return made.fresh()


def cell(periodic):
    lattice = lattice_of(SIDE * np.eye(3), True) if periodic else NO_LATTICE
    return lattice, (0.5 * SIDE) ** 2 if periodic else np.inf


@pytest.fixture
def frames():
    """Water that is wrapped atom by atom, off its lengths."""
    x = files.water(N, 5, SIDE) + 1e-3 * np.random.default_rng(2).normal(size=(5, 3 * N, 3))
    return x.astype(np.float32)


@pytest.mark.parametrize("periodic", [True, False])
@pytest.mark.parametrize("kind", ["triangles and some left", "one by one"])
def test_one_frame(frames, kind, periodic):
    pairs, targets = files.pairs(N), files.targets(N)
    if kind == "one by one":
        pairs, targets = pairs[::-1].copy(), targets[::-1].copy()
    made = table(pairs, targets)
    # Triangles come by fours; three of eleven are left.
    assert made._triangle_rows.size == (24 if kind != "one by one" else 0)
    found = Deviations(len(pairs), 1)
    assert made.look(found, 0, frames[0].ravel(), cell(periodic), PRECISION, True)
    d = frames[0].astype(np.float64)[pairs[:, 0]] - frames[0].astype(np.float64)[pairs[:, 1]]
    off = np.linalg.norm(minimum_image(d, cell(periodic)[0]) if periodic else d, axis=1) - targets
    assert found.worst[0, 0] == pytest.approx(np.abs(off).max(), rel=1e-12)
    assert found.sums[0, 0] == pytest.approx(off.sum(), abs=1e-12)
    assert found.squares[0, 0] == pytest.approx(off @ off, rel=1e-12)
    assert found.seen[0, 0] == len(pairs)
    made.collect(found)
    np.testing.assert_allclose(found.total, off, atol=1e-12)
    np.testing.assert_allclose(found.largest, np.abs(off), rtol=1e-6)
    assert found.worst_row[0, 0] == np.argmax(found.margins)


def test_a_block_finds_what_its_frames_find(frames):
    made, one_by_one = table(files.pairs(N), files.targets(N)), table(files.pairs(N), files.targets(N))
    alone, together = Deviations(3 * N, len(frames)), Deviations(3 * N, len(frames))
    for k, x in enumerate(frames):
        assert one_by_one.look(alone, k, x.ravel(), cell(True), PRECISION, True)
    words = np.zeros((len(frames), 3 * (3 * N + 2)), dtype=np.int32)
    words.view(np.float32).reshape(len(frames), 3, -1)[:, :, 1:-1] = frames.transpose(0, 2, 1)
    lattices, limits = np.tile(cell(True)[0], (len(frames), 1, 1, 1)), np.full(len(frames), cell(True)[1])
    block = Block(words, 0, np.zeros((len(frames), 6), np.float32))
    room = np.empty((3 * N, 3), np.float32)
    done, far = made.look_at_block(together, 0, block, room, (1, 1), (lattices, limits), PRECISION.coefficients(0.0))
    assert done == len(frames)
    np.testing.assert_array_equal(far, np.abs(frames).max(axis=(1, 2)))
    np.testing.assert_array_equal(together.by_frame, alone.by_frame)
    np.testing.assert_array_equal(together.worst_row, alone.worst_row)
    for each, into in ((made, together), (one_by_one, alone)):
        each.collect(into)
    np.testing.assert_array_equal(together.by_row, alone.by_row)
    limits[2] = np.nan
    found = Deviations(3 * N, len(frames))
    coefficients = PRECISION.coefficients(0.0)
    assert made.look_at_block(found, 0, block, room, (1, 1), (lattices, limits), coefficients)[0] == 2


def test_a_coordinate_that_is_no_number(frames):
    x = frames[0].copy()
    x[4, 1] = np.nan
    made = table(files.pairs(N), files.targets(N))
    assert not made.look(Deviations(3 * N, 1), 0, x.ravel(), cell(True), PRECISION, False)


def test_fresh_tables_have_seen_nothing(frames):
    made = table(files.pairs(N), files.targets(N))
    made.look(Deviations(3 * N, 1), 0, frames[0].ravel(), cell(True), PRECISION, True)
    found = Deviations(3 * N, 1)
    made.fresh().collect(found)
    assert not found.total.any() and np.all(found.margins == -np.inf)


def test_rates(frames):
    pairs = files.pairs(N)
    v = np.random.default_rng(5).normal(size=(3 * N, 3)).astype(np.float32)
    found = Deviations(3 * N, 1)
    table(pairs, files.targets(N)).look_at_rates(found, 0, frames[0].ravel(), v.ravel(), cell(True), 0.0)
    x = frames[0].astype(np.float64)
    d = minimum_image(x[pairs[:, 0]] - x[pairs[:, 1]], cell(True)[0])
    rates = np.abs(np.sum(d * (v[pairs[:, 0]].astype(np.float64) - v[pairs[:, 1]]), axis=1)) / np.linalg.norm(d, axis=1)
    assert found.rate_worst[0, 0] == pytest.approx(rates.max(), rel=1e-12)
    assert found.rate_row[0, 0] == np.argmax(rates)
    assert found.rate_squares[0, 0] == pytest.approx(rates @ rates, rel=1e-12)


def test_bits_of_the_largest_coordinate_are_a_number():
    assert size_of(np.float32(1.5).view(np.int32)) == 1.5
    assert size_of(np.array([2.0, 4.0], np.float32).view(np.int32)).tolist() == [2.0, 4.0]
