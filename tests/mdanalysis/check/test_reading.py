"""Frames read in order, up to the first that cannot be."""

from __future__ import annotations

import numpy as np
import pytest
import water_files as files
from MDAnalysis.lib.log import ProgressBar
from water_files import mda

from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import NonFiniteError
from kcons.mdanalysis import load_trajectory
from kcons.mdanalysis.check.files.file_precision import FilePrecision
from kcons.mdanalysis.check.frames.row_table import RowTable
from kcons.mdanalysis.check.reading import Reading, blocks_of, broken_by, remarks_on
from kcons.mdanalysis.check.result import Break

N, FRAMES = 6, 7
PRECISION = FilePrecision("DCD")


def opened(path, x):
    files.write(path, x, side=None)
    made = mda.Universe.empty(3 * N, trajectory=True)
    with np.errstate(all="ignore"):
        made.load_new(str(path))
    return made.trajectory


def table(x):
    held = ConstraintSet([Distance(files.pairs(N), files.targets(N))], x, np.ones(3 * N))
    return RowTable(held, PRECISION).fresh()


def read(trajectory, numbers, x, **options):
    reading = Reading(PRECISION, None, None, **options)
    with ProgressBar(total=len(numbers), verbose=False) as bar:
        return reading.read(trajectory, np.array(numbers), table(x), True, bar)


def test_blocks_and_frames_find_the_same(tmp_path, recwarn):
    x = files.whole(files.water(N, FRAMES))
    dcd, trr = opened(tmp_path / "a.dcd", x), opened(tmp_path / "a.trr", x)
    assert blocks_of(dcd, table(x[0])) is not None and blocks_of(trr, table(x[0])) is None
    for numbers in ([0, 1, 2, 3], [5, 2, 6], [-1]):
        one, other = read(dcd, numbers, x[0]), read(trr, numbers, x[0])
        assert one.frames.tolist() == other.frames.tolist() == numbers
        assert one.broken is None and other.broken is None
        # Nanometres are rounded once more.
        np.testing.assert_allclose(one.found.by_frame, other.found.by_frame, atol=1e-5)
        np.testing.assert_allclose(one.times, 2.0 * (np.array(numbers) % FRAMES), atol=1e-4)


def test_reading_stops_at_a_break(tmp_path, recwarn):
    x = files.whole(files.water(N, FRAMES))
    wrong = x.copy()
    wrong[4, 5] = np.nan
    for name in ("a.dcd", "a.trr"):
        part = read(opened(tmp_path / name, wrong), range(FRAMES), x[0])
        assert part.frames.tolist() == [0, 1, 2, 3] and len(part.times) == part.found.by_frame.shape[2] == 4
        assert part.broken.frame == 4 and not part.broken.ends
        assert "position of atom 5" in part.broken.reason
    part = read(opened(tmp_path / "b.trr", x), range(FRAMES), x[0], damage=Break(2, "a line is missing"))
    assert part.frames.tolist() == [0, 1] and part.broken.ends


def test_precision_of_frames():
    other = FilePrecision("XTC", 0.01, exact=True)
    assert Reading(PRECISION, None, None).precision_at(1) is PRECISION
    assert Reading(PRECISION, [PRECISION, other], None).precision_at(1) is other


def test_reasons_of_a_break():
    class Ended:
        def __getitem__(self, frame):
            raise OSError(f"frame {frame} is short\nand more")

    assert broken_by(StopIteration(), Ended(), 3).reason == "frame 3 is short"
    assert broken_by(OSError(), Ended(), 3).reason == "the file ends"
    assert not broken_by(NonFiniteError("a length is no number"), Ended(), 3).ends


@pytest.mark.filterwarnings("ignore:DCDReader currently")
@pytest.mark.parametrize(
    ("name", "said"),
    [("w.dcd", None), ("w.xyz", "frames are taken to be 1 ps apart"), ("w.lammpsdump", "steps are taken to be 1 ps")],
)
def test_times_that_files_do_not_have_are_said(tmp_path, name, said):
    """A drift a ns means nothing without them."""
    made, x = files.universe(4), files.water(4, 3)
    path = (files.write_text if name == "w.lammpsdump" else files.write)(tmp_path / name, x)
    load_trajectory(made, path)
    found = remarks_on(made.trajectory)
    assert [said in remark for remark in found] == [True] if said else found == []
    made.load_new(str(path), dt=0.5)
    assert remarks_on(made.trajectory) == []
