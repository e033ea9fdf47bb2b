"""What a check says of what was found."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import water_files as files

from kcons.constraints import Distance
from kcons.mdanalysis.check.atom_names import AtomNames
from kcons.mdanalysis.check.bound_rows import BoundRows
from kcons.mdanalysis.check.conclusions import Asked, concluded
from kcons.mdanalysis.check.files.file_precision import FilePrecision
from kcons.mdanalysis.check.findings import Part
from kcons.mdanalysis.check.reading import Reading
from kcons.mdanalysis.check.result import Break

X = np.array([[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]])
PRECISION = FilePrecision("DCD")


def conclusion(off, *, tolerance=0.0, broken=None, worst=1, rank=2, found_at_start=False):
    """Of two frames, in the second of which the first row is off."""
    given = [Distance([[0, 1], [0, 2]], None if found_at_start else 1.0)]
    frame = SimpleNamespace(positions=X.astype(np.float32), dimensions=None, time=0.0)
    rows = BoundRows(given, np.ones(3), frame, 0.0, PRECISION, np.zeros(3), tolerance)
    part = Part.of(np.array([3, 8]), 2)
    part.times[:], part.broken = [1.5, 4.0], broken
    x = np.stack([X, X]).astype(np.float32)
    x[1, 1, 0] += off
    table = rows.table.fresh()
    for k in range(2):
        table.look(part.found, k, x[k].ravel(), None, None, part.times[k])
    table.collect(part.found)
    asked = Asked(("run", "top"), AtomNames(files.universe(1)), "given", "as given", None, worst, ["said before"])
    return concluded(part, rows, asked, Reading(PRECISION, None, None), rank, np.ones(3), 9)


def test_kept_tolerated_and_violated():
    assert conclusion(0.0).status == "kept"
    assert conclusion(0.01, tolerance=0.02).status == "tolerated"
    result = conclusion(0.01, tolerance=0.001)
    assert (result.status, result.violated_rows, result.violated_frames, result.first_violated_frame) == (
        "violated", 1, 1, 8,
    )  # fmt: skip
    assert result.worst[0].row == 0 and result.worst[0].frame == 8
    assert result.worst[0].largest == pytest.approx(0.01, rel=1e-4)
    assert result.verdict.startswith("violated by 0.01 Å")


def test_a_break_is_no_verdict_but_a_violation_is():
    broken = Break(9, "cut off")
    assert conclusion(0.0, broken=broken).status == "incomplete"
    assert conclusion(0.5, broken=broken).status == "violated"


def test_molecules_cut_where_no_cell_is_known_are_told_of():
    """A length off by more than itself; less is a violation like any other."""
    assert any("no cell" in remark and "whole molecules" in remark for remark in conclusion(7.0).remarks)
    assert conclusion(0.9).remarks == ["said before"]


def test_what_is_told_besides():
    result = conclusion(0.01, worst=0, rank=None)
    assert result.worst == [] and result.rank is None and result.degrees_of_freedom is None
    assert result.remarks == ["said before"] and result.n_frames_in_file == 9
    assert list(result.series) == ["largest Å", "rms Å", "rounding Å"]
    assert result.series["largest Å"][1] == pytest.approx(0.01, rel=1e-4)
    assert conclusion(0.0).degrees_of_freedom == 9 - 2
