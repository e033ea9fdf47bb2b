"""Parts of a check are put together, and told in a sentence."""

import numpy as np
import pytest

from kcons.mdanalysis.check.findings import Part, gaps_of, joined, rms_of, verdict_of
from kcons.mdanalysis.check.result import Break, RowResult, UnitResult


def part(frames, broken=None, n_rows=4):
    made = Part.of(np.array(frames), n_rows)
    made.times[:] = 0.5 * made.frames
    made.found.seen[0] = n_rows
    made.broken = broken
    return made


def row(frame=8):
    return RowResult(2, "Distance SOL1:OW–HW1", [0, 1], "Å", 0.96, 0.05, 0.01, 0.002, frame)


def unit():
    return UnitResult("Å", 4, 0.05, 0.01, 0.0, 0.002, 1e-4, 1e-3, 0.01, None)


def test_parts_in_order_up_to_the_first_break():
    stop = Break(5, "cut off")
    whole = joined([part([0, 1]), part([2, 3, 4], stop), part([6, 7])])
    assert whole.frames.tolist() == [0, 1, 2, 3, 4] and whole.broken is stop
    assert whole.times.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert whole.momentum.shape == (5, 3) and whole.found.seen.shape[1] == 5
    assert joined([part([3])]).frames.tolist() == [3]


def test_what_was_not_reached_is_left_out():
    made = part(range(6))
    made.cut(2)
    assert made.frames.tolist() == [0, 1] and len(made.twice_kinetic) == len(made.reach) == 2
    assert made.found.seen.shape[1] == 2


def test_root_mean_squares_of_what_was_seen():
    made = part([0, 1])
    made.found.squares[0] = [4.0, 16.0]
    made.found.seen[0] = [4, 0]
    assert rms_of(made.found)[0].tolist() == [1.0, 4.0]


@pytest.mark.parametrize(
    ("status", "begins"),
    [
        ("kept", "kept to the precision of the file: largest deviation 0.05 Å (rounding: up to 0.002)"),
        ("tolerated", "kept to the tolerance of 0.0001: largest deviation 0.05 Å"),
        ("incomplete", "incomplete: one thing; another; no violation otherwise in 9 frames: largest deviation 0.05"),
        (
            "violated",
            "violated by 0.05 Å (0.048 more than allowed): Distance SOL1:OW–HW1 in frame 8; 1 of 4 rows",
        ),
    ],
)
def test_verdicts(status, begins):
    gaps = ["one thing", "another"]
    said = verdict_of(status, 1e-4, row(), [unit()], (1, 4), np.array([3, 8]), 9, gaps)
    assert said.startswith(begins), said


def test_a_violation_that_no_frame_is_named_for():
    said = verdict_of("violated", 1e-4, row(None), [unit()], (1, 4), np.zeros(0, int), 9, [])
    assert said.endswith("Distance SOL1:OW–HW1; 1 of 4 rows")


def test_why_a_check_is_no_verdict():
    assert gaps_of(part([0, 1]), 4, 0, "the first frame") == []
    (gap,) = gaps_of(part([0, 1], Break(2, "cut off")), 0, 0, "the first frame")
    assert gap == "the file ends too early, at frame 2: cut off"
    assert "targets come from the only frame" in gaps_of(part([0]), 4, 0, "the first frame")[0]
    assert "targets of 3 of 4 rows come from the only frame" in gaps_of(part([0]), 3, 0, "the first frame")[0]
    assert "the lengths of 2 of 4 rows" in gaps_of(part([0, 1]), 4, 2, "the first frame")[0]
    blind = part([5, 6, 7])
    blind.found.seen[0] = [4, 1, 2]
    (gap,) = gaps_of(blind, 0, 0, "a file")
    assert "nothing can be told of up to 3 of 4 rows in 2 of 3 frames, from frame 6" in gap
