"""Deviations against computations that share nothing with kcons; verdicts, targets, cells, frames, backends."""

import pickle
import warnings

import numpy as np
import pytest
import water_files as files
from water_files import mda

from kcons.constraints import Angle, CenterOfMass, Dihedral, Distance, DistanceDifference, LinearRelation, Plane
from kcons.errors import InputError
from kcons.mdanalysis import ConstraintCheck, constraints_of

N, SIDE = 40, 12.0
PAIRS, TARGETS = files.pairs(N), files.targets(N)
ROWS = Distance(PAIRS, TARGETS)


def checked(path, constraints=ROWS, n=N, **options):
    return files.checked(path, n, constraints, **options)


@pytest.fixture(scope="module")
def positions():
    x = files.water(N, 23)
    # One bond too long in one frame, and one that drifts.
    x[7, 3 * 11 + 2] += 0.05
    x[:, 3 * 5 + 1] += np.linspace(0, 0.2, 23)[:, None] * np.array([1.0, 0, 0])
    return x % SIDE


@pytest.fixture(scope="module")
def water(tmp_path_factory, positions):
    folder = tmp_path_factory.mktemp("water")
    return {ending: files.write(folder / f"w.{ending}", positions) for ending in ("dcd", "xtc", "trr")}


# -- numbers ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending,tolerance", [("dcd", 1e-7), ("xtc", 1e-6)])
def test_deviations_equal_those_from_the_bytes_of_the_file(water, ending, tolerance):
    result = checked(water[ending], worst=3 * N)
    x = files.dcd_frames(water["dcd"]) / 10 if ending == "dcd" else files.xtc_frames(water["xtc"])
    off = files.deviations(x, PAIRS, TARGETS / 10, SIDE / 10)  # nm
    assert off.shape == (23, 3 * N)
    np.testing.assert_allclose(np.array(result.series["largest Å"]) / 10, np.abs(off).max(axis=1), atol=tolerance)
    rms = np.sqrt((off**2).mean(axis=1))
    np.testing.assert_allclose(np.array(result.series["rms Å"]) / 10, rms, atol=tolerance)
    rows = {row.row: row for row in result.worst}
    assert len(rows) == 3 * N
    for k, row in rows.items():
        assert row.largest / 10 == pytest.approx(np.abs(off[:, k]).max(), abs=tolerance)
        assert row.mean / 10 == pytest.approx(off[:, k].mean(), abs=tolerance)
        assert ending == "xtc" or row.largest == pytest.approx(10 * abs(off[row.frame, k]), abs=10 * tolerance)
    assert result.units[0].mean / 10 == pytest.approx(off.mean(), abs=tolerance)


def test_xtc_is_told_to_far_better_than_single_precision_would_allow(tmp_path):
    """Far from the origin MDAnalysis' coordinates are off by 1e-4; those of the file are not."""
    path = files.write(tmp_path / "far.xtc", files.water(N, 4) + 1000.0, side=None)
    raw = np.rint(files.xtc_frames(path) * 1000) / 100
    off = np.linalg.norm(raw[:, PAIRS[:, 0]] - raw[:, PAIRS[:, 1]], axis=2) - TARGETS
    np.testing.assert_allclose(checked(path).series["largest Å"], np.abs(off).max(axis=1), atol=1e-9)


def near(d):
    return d - SIDE * np.rint(d / SIDE)


def test_rows_of_all_kinds(water):
    x = files.dcd_frames(water["dcd"])
    u, w = near(x[:, 1::3] - x[:, ::3]), near(x[:, 2::3] - x[:, ::3])
    angles = np.arccos((u * w).sum(axis=2) / np.linalg.norm(u, axis=2) / np.linalg.norm(w, axis=2))
    o = 3 * np.arange(N)
    near_by = 3 * (1 + int(np.argmin(np.linalg.norm(near(x[0, 3::3] - x[0, 0]), axis=1))))
    rows = [
        Angle(np.stack([o + 1, o, o + 2], axis=1), files.ANGLE),
        LinearRelation(0, [1, 2], [0.5, 0.5]),
        ROWS,
        Dihedral([[1, 0, near_by, near_by + 1]]),
        CenterOfMass([0, 1, 2]),
        DistanceDifference([[0, near_by], [1, near_by + 1]]),
    ]
    result = checked(water["dcd"], rows, worst=500)
    found = {row.row: row for row in result.worst}
    for k in range(N):
        assert found[k].largest == pytest.approx(np.abs(angles[:, k] - files.ANGLE).max(), abs=2e-6)
        assert found[k].unit == "rad"
    middle = 0.5 * (u[:, 0] + w[:, 0])
    for axis in range(3):
        assert found[N + axis].largest == pytest.approx(np.abs(middle[:, axis]).max(), abs=2e-6)
    apart = [np.linalg.norm(near(x[:, near_by + k] - x[:, k]), axis=1) for k in (0, 1)]
    expected = np.abs(apart[0] - apart[1] - (apart[0] - apart[1])[0]).max()
    assert found[4 * N + 7].largest == pytest.approx(expected, abs=2e-6) and expected > 0.01
    assert {unit.unit: unit.n_rows for unit in result.units} == {"Å": 3 * N + 7, "rad": N + 1}
    plain = checked(water["dcd"])
    middle_rows = {r.name: (r.largest, r.frame, r.mean) for r in result.worst if N + 3 <= r.row < 4 * N + 3}
    assert all(middle_rows[r.name] == (r.largest, r.frame, r.mean) for r in plain.worst)


def test_rates_are_those_of_the_rows(tmp_path):
    """A v, of lengths u (v_i - v_j), from velocities that are not tangent."""
    x = files.water(N, 4)
    v = np.random.default_rng(5).normal(size=x.shape)
    path = files.write(tmp_path / "v.trr", x, velocities=v)
    ends = np.array([ts.positions.astype(float) for ts in files.loaded(path, N).trajectory])
    d = near(ends[:, PAIRS[:, 0]] - ends[:, PAIRS[:, 1]])
    w = v[:, PAIRS[:, 0]] - v[:, PAIRS[:, 1]]
    rates = np.abs((d * w).sum(axis=2)) / np.linalg.norm(d, axis=2)
    more = np.concatenate([rates, np.abs(v[:, 7, 1:2])], axis=1)
    for rows, expected in ((ROWS, rates), ([ROWS, Plane([7], [0.0, 1.0, 0.0], 5.0)], more)):
        unit = checked(path, rows, rank=False).units[0]
        assert unit.rate_largest == pytest.approx(expected.max(), rel=1e-5)
        assert unit.rate_rms == pytest.approx(np.sqrt((expected**2).mean()), rel=1e-5)


def test_where_atoms_coincide_nothing_is_told_of_their_angle(tmp_path):
    x = files.whole(files.water(N, 4))
    x[2, 3] = x[2, 4]
    angles = Angle([[1, 0, 2], [4, 3, 5]], files.ANGLE)
    result = checked(files.write(tmp_path / "a.dcd", x, side=None), angles)
    assert result.status == "incomplete" and "up to 1 of 2 rows in 1 of 4 frames, from frame 2" in result.verdict
    assert np.isfinite(result.units[0].largest) and "or atoms coincide" in result.gaps[0]
    v = np.zeros(x.shape)
    v[2, 1] = x[2, 2] - x[2, 1]
    unit = checked(files.write(tmp_path / "a.trr", x, side=None, velocities=v), angles).units[0]
    assert unit.rate_largest > 0.1  # of the other angle in this frame


def test_dcd_of_lammps_in_other_units(tmp_path, positions):
    path = files.write(tmp_path / "nm.dcd", positions / 10, SIDE / 10)
    made = files.universe(N)
    made.load_new(str(path), format="LAMMPS", lengthunit="nm")
    result = ConstraintCheck(made, ROWS).run().check
    assert result.worst[0].largest == pytest.approx(
        checked(files.write(tmp_path / "a.dcd", positions)).worst[0].largest, 1e-4
    )


# -- cells ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angles", [(75.0, 80.0, 65.0), (90.0, 90.0, 90.0), (60.0, 60.0, 90.0)])
def test_minimum_images_of_all_cells(tmp_path, angles):
    dimensions = [14.0, 12.0, 13.0, *angles]
    cell = mda.lib.mdamath.triclinic_vectors(dimensions).astype(np.float64)
    shifts = np.random.default_rng(4).integers(-1, 2, size=(3, 3 * N, 3))
    x = files.whole(files.water(N, 3)) + shifts @ cell
    path = files.write(tmp_path / "t.dcd", x, [dimensions] * 3)
    result = checked(path)
    assert result.status in ("kept", "tolerated") and result.units[0].largest < 2e-5
    assert checked(path, [ROWS, Angle([[1, 0, 2]], files.ANGLE)]).status in ("kept", "tolerated")


@pytest.mark.parametrize("ending", ["dcd", "trr"])
@pytest.mark.parametrize("targets", ["given", "first"])
@pytest.mark.parametrize("off", [0.0, 0.02])
def test_a_body_longer_than_half_the_cell(tmp_path, ending, targets, off):
    """A rigid ring across a small cell, atoms wrapped one by one: its long rows have no nearest image."""
    side, n, frames = 5.0, 6, 8
    angles = 2 * np.pi * np.arange(n) / n
    ring = 1.4 * np.stack([np.cos(angles), np.sin(angles), np.zeros(n)], axis=1)
    rng = np.random.default_rng(8)
    x = np.zeros((frames, 3 * n, 3))
    x[:, n:] = 100.0 * rng.random((frames, 2 * n, 3))
    for k in range(frames):
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        x[k, :n] = side * rng.random(3) + ring @ turn
    x[5, 2] += off * np.array([1.0, 0, 0])
    path = files.write(tmp_path / f"r.{ending}", x % side, side=side)
    i, j = np.triu_indices(n, 1)
    lengths = np.linalg.norm(ring[i] - ring[j], axis=1)
    assert lengths.max() > side / 2
    rows = Distance(np.stack([i, j], axis=1), lengths if targets == "given" else None)
    result = checked(path, rows, n=n, rank=False, targets=targets)
    assert (result.status == "violated") == bool(off), result.verdict
    assert result.violated_frames == bool(off) and result.units[0].largest < 0.03
    expected = np.linalg.norm(x[:, i] - x[:, j], axis=2) - lengths
    np.testing.assert_allclose(result.series["largest Å"], np.abs(expected).max(axis=1), atol=3e-6)


@pytest.mark.parametrize("ending", ["dcd", "trr"])
def test_cells_that_are_none_and_cells_that_end(tmp_path, ending):
    """Files without a cell may have lengths of 1: bonds would be folded into it."""
    x = files.whole(files.water(N, 6, side=SIDE), SIDE)
    assert checked(files.write(tmp_path / f"one.{ending}", x, side=1.0)).status == "kept"
    cell = [SIDE] * 3 + [90.0] * 3
    path = files.write(tmp_path / f"ends.{ending}", x % SIDE, [cell] * 4 + [None] * 2)
    result = checked(path)
    assert result.status == "violated" and result.first_violated_frame == 4
    told = [remark for remark in result.remarks if f"2 of 6 frames of {path} have no cell" in remark]
    assert told and "whole molecules" in told[0]
    # A length that is off by less than itself is a violation like any other.
    x[3, 4] += 0.5
    assert checked(files.write(tmp_path / f"off.{ending}", x, side=None)).remarks == []


# -- verdicts ---------------------------------------------------------------------------------------


def test_verdict_names_row_frame_and_amount(water):
    result = checked(water["dcd"])
    off = np.abs(files.deviations(files.dcd_frames(water["dcd"]), PAIRS, TARGETS, SIDE))
    frame, row = np.unravel_index(off.argmax(), off.shape)
    worst = result.worst[0]
    assert result.status == "violated" and result.violated and row in (15, 17), "of the atom that drifts"
    assert (worst.row, worst.frame) == (row, frame) and worst.largest == pytest.approx(off.max(), abs=1e-9)
    assert result.violated_rows == np.count_nonzero((off > worst.allowed).any(axis=0)) == 4
    assert result.violated_frames == np.count_nonzero((off > worst.allowed).any(axis=1))
    assert result.first_violated_frame == np.argmax((off > worst.allowed).any(axis=1))
    more = f"violated by {worst.largest:.3g} Å ({worst.largest - worst.allowed:.2g} more than allowed): Distance SOL6:"
    assert result.verdict.startswith(more)
    assert f"in frame {frame}; 4 of 120 rows; {result.violated_frames} of 23 frames, from frame" in result.verdict
    assert result.units[0].drift > 3 * result.units[0].drift_error


STEPS = {"xtc": "0.01 Å (0.001 nm)", "pdb": "0.001 Å", "gro": "0.01 Å", "dcd": "single", "trr": "single"}


@pytest.mark.parametrize("ending", STEPS)
def test_kept_to_the_precision_of_each_format_and_violated_beyond(tmp_path, ending):
    x = files.whole(files.water(N, 1 if ending == "gro" else 6, seed=3))
    for off in (0.0, {"dcd": 2e-3, "xtc": 0.05, "trr": 2e-3}.get(ending, 0.1)):
        x[-1, 4] += off
        path = tmp_path / f"k{off}.{ending}"
        if ending == "gro":
            files.topology(path, N, x[0])
        else:
            files.write(path, x, side=None if ending == "pdb" else SIDE)
        result = checked(path, tolerance=0.0)
        assert STEPS[ending] in result.precision
        if off:
            assert result.status == "violated" and result.worst[0].frame == len(x) - 1 and 4 in result.worst[0].atoms
            continue
        unit = result.units[0]
        assert result.status == "kept" and unit.largest <= unit.bound
        begins = f"kept to the precision of the file: largest deviation {unit.largest:.2g} Å (rounding: up to "
        assert result.verdict.startswith(begins)
        assert 0.6 * unit.rounding_rms < unit.rms < 1.5 * unit.rounding_rms or ending in ("dcd", "trr")


@pytest.mark.parametrize("ending", ["dcd", "xtc", "trr"])
@pytest.mark.parametrize("targets", ["given", "first", "mean"])
def test_a_first_frame_that_alone_is_off_is_told_in_a_line(tmp_path, ending, targets):
    """As of LAMMPS, which writes the first frame before it holds the constraints; a verdict it is all the same."""
    x = files.whole(files.water(N, 12, seed=3))
    x[0] += np.random.default_rng(1).normal(0, 0.02 if ending == "xtc" else 2e-3, x[0].shape)
    path = files.write(tmp_path / f"a.{ending}", x, side=None)
    result = checked(path, targets=targets)
    told = [remark for remark in result.remarks if remark.startswith("the first frame alone differs")]
    assert result.status == "violated"
    # The mean of all has a part of the first in it.
    assert len(told) == 1 or targets == "mean"
    assert all("begin at frame 1 (--frames 1:)" in remark for remark in told)
    assert ("agree to" in "".join(told)) == (targets == "first")
    later = checked(path, targets=targets, run={"start": 1})
    assert later.status in ("kept", "tolerated") and not any("alone" in remark for remark in later.remarks)


@pytest.mark.parametrize("targets", ["given", "first"])
@pytest.mark.parametrize("wrong", [[5], [0, 5], [3, 4, 5, 6, 7, 8, 9, 10, 11], list(range(1, 12)), list(range(12))])
def test_other_frames_that_are_off_are_not_the_first_alone(tmp_path, targets, wrong):
    """Random errors of other frames, also where it is all of them."""
    x = files.whole(files.water(N, 12, seed=3))
    x[wrong] += np.random.default_rng(1).normal(0, 2e-3, x[wrong].shape)
    result = checked(files.write(tmp_path / "a.dcd", x, side=None), targets=targets)
    assert result.status == "violated" and not any("alone" in remark for remark in result.remarks)


# -- targets ----------------------------------------------------------------------------------------


def test_targets_of_the_first_frame_and_of_the_mean(water):
    lengths = files.deviations(files.dcd_frames(water["dcd"]), PAIRS, 0.0, SIDE)
    for rows, options, held, seen in (
        (ROWS, {"targets": "first"}, lengths[0], slice(None)),
        (ROWS, {"targets": "mean"}, lengths.mean(axis=0), slice(None)),
        # Open ones come from the first frame looked at.
        (Distance(PAIRS), {"run": {"start": 4, "stop": 20, "step": 3}}, lengths[4], slice(4, 20, 3)),
    ):
        result = checked(water["dcd"], rows, worst=3 * N, **options)
        np.testing.assert_allclose(result.series["largest Å"], np.abs(lengths - held)[seen].max(axis=1), atol=1e-6)
        assert result.frames == list(range(23))[seen]
        np.testing.assert_allclose(result.times, [2.0 * k for k in result.frames], rtol=1e-5)
        for row in result.worst:
            assert row.target == pytest.approx(held[row.row], abs=1e-9)
    angles = checked(water["dcd"], Angle([[1, 0, 2], [4, 3, 5]]), targets="mean", worst=2)
    assert all(abs(row.mean) < 1e-15 for row in angles.worst)
    assert all(row.target == pytest.approx(files.ANGLE, abs=1e-5) for row in angles.worst)


def test_transformed_coordinates_are_taken_as_they_are(water):
    from MDAnalysis.transformations import translate

    made = files.loaded(water["xtc"], N)
    made.trajectory.add_transformations(translate([0.0031, 0.0, 0.0]))
    check = ConstraintCheck(made, ROWS).run().check
    np.testing.assert_allclose(check.series["rms Å"], checked(water["xtc"]).series["rms Å"], atol=2e-5)
    assert any("transformations" in remark for remark in check.remarks)


# -- what is refused --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "options", "match"),
    [
        (ROWS, {"tolerance": -1.0}, "tolerance"),
        (ROWS, {"precision": 0.0}, "precision"),
        (ROWS, {"targets": "nowhere.toml"}, "nowhere.toml"),
        (ROWS, {"worst": -1}, "worst is -1"),
        (ROWS, {"run": {"start": 30}}, "no frames"),
        (ROWS, {"run": {"step": 0}}, "step cannot be zero"),
        (ROWS, {"run": {"frames": [0, 23]}}, "its 23 frames have no .*index 23 is out of bounds"),
        (ROWS, {"run": {"frames": [0, -24]}}, "its 23 frames have no .*index -24 is out of bounds"),
        (ROWS, {"run": {"frames": slice(0, 3)}}, "frames: whole numbers, or 23 times True or False"),
        (ROWS, {"run": {"frames": [True] * 22}}, "whole numbers, or 23 times True or False"),
        (ROWS, {"run": {"frames": [0.5]}}, "whole numbers, or 23 times True or False"),
        ([], {}, "no constraints"),
        ("hbonds", {}, "constraints has 'hbonds', which is no kcons constraint"),
        (Distance([[0, 120]], 1.0), {}, "no atom 120"),
    ],
)
def test_what_cannot_be_is_refused(water, rows, options, match):
    with pytest.raises(InputError, match=match):
        checked(water["dcd"], rows, **options)


def test_rows_that_were_made_for_a_part_are_refused(water):
    whole = files.loaded(water["dcd"], N)
    with pytest.raises(InputError, match=rf"made for 30 atoms, and there are {3 * N} here"):
        ConstraintCheck(whole, constraints_of(whole.atoms[30:60], "none"))
    with pytest.raises(InputError, match="their atom 0 is atom 3 of the Universe, and here it is atom 0"):
        ConstraintCheck(whole, constraints_of(whole.atoms[np.r_[3:6, 0:3, 6 : 3 * N]], "none"))
    check = ConstraintCheck(whole, constraints_of(whole.atoms, "none"))
    with pytest.raises(InputError, match=r"nothing was looked at yet; call run\(\) first"):
        _ = check.check
    assert check.run(frames=[0, -1, 5]).check.frames == [0, 22, 5] and check.check.n_rows == 3 * N
    assert check.run(frames=[k in (3, 8, 9) for k in range(23)]).check.frames == [3, 8, 9]
    # The reader is left at the last frame, as by any analysis.
    assert type(whole.trajectory.ts) is mda.coordinates.timestep.Timestep and whole.trajectory.ts.frame == 9
    np.testing.assert_array_equal(whole.atoms.positions, files.dcd_frames(water["dcd"])[9].astype(np.float32))
    assert whole.trajectory.next().frame == 10 and whole.atoms.positions.flags.c_contiguous


# -- backends ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("backend", "ending", "rows", "targets"),
    [
        ("multiprocessing", "xtc", [ROWS, Angle([[1, 0, 2]])], "given"),
        ("dask", "dcd", ROWS, "mean"),
        ("multiprocessing", "trr", ROWS, "first"),
    ],
)
def test_backends_agree(water, backend, ending, rows, targets):
    if backend == "dask":
        pytest.importorskip("dask")
    serial = checked(water[ending], rows, targets=targets, worst=9)
    with warnings.catch_warnings(action="ignore"):  # of the backends themselves
        run = {"backend": backend, "n_workers": 2, "n_parts": 3}
        parallel = checked(water[ending], rows, targets=targets, worst=9, run=run)
    assert serial.verdict == parallel.verdict and serial.frames == parallel.frames and serial.times == parallel.times
    np.testing.assert_allclose(serial.series["largest Å"], parallel.series["largest Å"], rtol=0, atol=1e-14)
    assert [(row.row, row.frame) for row in serial.worst] == [(row.row, row.frame) for row in parallel.worst]
    assert [row.largest for row in serial.worst] == pytest.approx([row.largest for row in parallel.worst], abs=1e-14)


def test_an_analysis_can_be_sent_to_another_process(water):
    check = ConstraintCheck(files.loaded(water["dcd"], N), ROWS)
    check.run(stop=3)
    assert pickle.loads(pickle.dumps(check)).run().check.series == checked(water["dcd"]).series
