"""Rows at the first frame: where targets come from, and what rounding makes of them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from kcons.constraints import Angle, Distance
from kcons.mdanalysis.check.bound_rows import BoundRows
from kcons.mdanalysis.check.files.file_precision import FilePrecision
from kcons.mdanalysis.check.findings import Part

X = np.array([[0.0, 0, 0], [1.004, 0, 0], [0, 1.006, 0]])
TENTHS = FilePrecision("XTC", 0.01, exact=True)


def bound(given, tolerance=0.0, errors=0.0, precision=TENTHS):
    frame = SimpleNamespace(positions=X.astype(np.float32), dimensions=None, time=0.0)
    return BoundRows(given, np.ones(3), frame, 0.0, precision, np.full(3, errors), tolerance)


def test_targets_left_out_are_those_of_the_frame_as_the_file_holds_it():
    rows = bound([Distance([[0, 1]], 1.0), Distance([[0, 2]])])
    assert rows.measured.tolist() == [False, True]
    np.testing.assert_allclose(rows.table.set.target(), [1.0, 1.01], rtol=1e-12)
    np.testing.assert_allclose(rows.positions, np.round(X, 2), atol=1e-12)


def test_what_rounding_makes_of_targets():
    rows = bound([Distance([[0, 1]], 1.0), Distance([[0, 2]])], errors=1e-3)
    # Each coordinate of both atoms: by half a step where it was measured, by what is told where it was given.
    np.testing.assert_allclose(rows.of_targets, 2 * np.sqrt(3) * np.array([1e-3, 5e-3]), rtol=1e-6)
    # Coordinates that are off independently: a length is off by the square root of the sum, at most by the sum.
    np.testing.assert_allclose(rows.spread_of_rounding, np.sqrt(2 / 3) / (2 * np.sqrt(3)), rtol=1e-12)


def test_the_tolerance_comes_besides_in_parts_of_the_size():
    rows = bound([Distance([[0, 1]], 2.0), Angle([[1, 0, 2]], 1.5)], tolerance=0.01, errors=0.0)
    np.testing.assert_allclose(rows.table._slack, rows.of_targets + 0.01 * np.array([2.0, 1.0]), rtol=1e-12)


def test_means_take_the_place_of_measured_targets():
    rows = bound([Distance([[0, 1]], 1.0), Distance([[0, 2]])])
    part = Part.of(np.arange(4), 2)
    part.found.by_row[:] = [[0.4, 0.2], [0.08, 0.04], [4, 4]]
    before = rows.of_targets.copy()
    rows.hold_means(part, SimpleNamespace(positions=X.astype(np.float32), time=0.0))
    np.testing.assert_allclose(rows.table.set.target(), [1.1, 1.06], rtol=1e-12)
    assert rows.of_targets.tolist() == [before[0], pytest.approx(0.01)]
