"""What a check found: drift, breaks, and plain data."""

import json

import numpy as np
import pytest

from kcons.mdanalysis.check.result import Break, fitted


def test_a_straight_line_and_its_error():
    t = np.linspace(3.0, 11.0, 40)
    y = 0.25 * t + np.random.default_rng(2).normal(scale=0.1, size=40)
    (slope, _), covariance = np.polyfit(t, y, 1, cov=True)
    found = fitted(t, y)
    assert found.slope == pytest.approx(slope, rel=1e-10)
    assert found.error == pytest.approx(np.sqrt(covariance[0, 0]), rel=0.5)  # neighbors might depend on each other
    assert found.change == pytest.approx(8.0 * slope) and found.significant
    assert not fitted(t, y - 0.25 * t).significant


def test_frames_without_a_number_do_not_count():
    t, y = np.arange(6.0), np.array([0.0, np.nan, 2.0, 3.0, np.inf, 5.0])
    found = fitted(t, y)
    assert found.slope == pytest.approx(1.0) and found.error == pytest.approx(0.0, abs=1e-12)
    assert fitted(t[:3], y[:3]) is None
    assert fitted(np.ones(6), np.arange(6.0)) is None


def test_a_break_says_what_is_wrong():
    assert Break(7, "12 bytes follow").text == "the file ends too early, at frame 7: 12 bytes follow"
    told = Break(7, "atom 3 is NaN", ends=False).text
    assert told == "frame 7 cannot be used, nor what follows: atom 3 is NaN"


def test_results_are_plain_data(tmp_path):
    import water_files as files

    from kcons.constraints import Distance
    from kcons.mdanalysis import ConstraintCheck, load_trajectory

    made = files.universe(5)
    load_trajectory(made, files.write(tmp_path / "run.dcd", files.whole(files.water(5, 4))))
    result = ConstraintCheck(made, Distance(files.pairs(5), files.targets(5))).run().check
    data = result.to_dict()
    assert json.loads(json.dumps(data)) == data
    assert data["n_rows"] == 15 and data["frames"] == [0, 1, 2, 3] and data["broken"] is None
    assert result.violated is (result.status == "violated")
