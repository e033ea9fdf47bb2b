"""Deviations against computations that share nothing with kcons; verdicts, targets, backends, temperature."""

import warnings

import numpy as np
import pytest
import water_files as files
from water_files import mda

from kcons.constraints import Angle, CenterOfMass, Dihedral, Distance, DistanceDifference, LinearRelation
from kcons.errors import InputError
from kcons.mdanalysis import ConstraintCheck, constraints_of, load_trajectory

N, SIDE = 40, 12.0


def loaded(path, n=N, masses=True):
    made = files.universe(n, masses)
    load_trajectory(made, path)
    return made


def checked(path, constraints, n=N, masses=True, run=None, **options):
    return ConstraintCheck(loaded(path, n, masses), constraints, **options).run(**(run or {})).check


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
    return {
        "dcd": files.write(folder / "w.dcd", positions),
        "xtc": files.write(folder / "w.xtc", positions),
        "trr": files.write(folder / "w.trr", positions),
    }


@pytest.mark.parametrize("ending,tolerance", [("dcd", 1e-7), ("xtc", 1e-6)])
def test_deviations_equal_those_from_the_bytes_of_the_file(water, ending, tolerance):
    result = checked(water[ending], Distance(files.pairs(N), files.targets(N)), worst=3 * N)
    x = files.dcd_frames(water["dcd"]) / 10 if ending == "dcd" else files.xtc_frames(water["xtc"])
    off = files.deviations(x, files.pairs(N), files.targets(N) / 10, SIDE / 10)  # nm
    assert off.shape == (23, 3 * N)
    np.testing.assert_allclose(np.array(result.series["largest Å"]) / 10, np.abs(off).max(axis=1), atol=tolerance)
    rms = np.sqrt((off**2).mean(axis=1))
    np.testing.assert_allclose(np.array(result.series["rms Å"]) / 10, rms, atol=tolerance)
    rows = {row.row: row for row in result.worst}
    assert len(rows) == 3 * N
    for k in range(3 * N):
        assert rows[k].largest / 10 == pytest.approx(np.abs(off[:, k]).max(), abs=tolerance)
        assert rows[k].mean / 10 == pytest.approx(off[:, k].mean(), abs=tolerance)
    assert result.units[0].mean / 10 == pytest.approx(off.mean(), abs=tolerance)


def test_xtc_is_told_to_far_better_than_single_precision_would_allow(tmp_path):
    """Far from the origin MDAnalysis' coordinates are off by 1e-4; those of the file are not."""
    x = files.water(N, 4) + 1000.0
    path = files.write(tmp_path / "far.xtc", x, side=None)
    result = checked(path, Distance(files.pairs(N), files.targets(N)), worst=3 * N)
    raw = np.rint(files.xtc_frames(path) * 1000) / 100
    d = raw[:, files.pairs(N)[:, 0]] - raw[:, files.pairs(N)[:, 1]]
    off = np.sqrt((d**2).sum(axis=2)) - files.targets(N)
    np.testing.assert_allclose(result.series["largest Å"], np.abs(off).max(axis=1), atol=1e-9)


def test_minimum_images_of_a_triclinic_cell(tmp_path):
    dimensions = [14.0, 12.0, 13.0, 75.0, 80.0, 65.0]
    cell = mda.lib.mdamath.triclinic_vectors(dimensions).astype(np.float64)
    rng = np.random.default_rng(4)
    x = files.whole(files.water(N, 3)).reshape(3, N, 3, 3)
    x = x + rng.integers(-1, 2, size=(3, N, 3, 1, 3)).reshape(3, N, 3, 3) @ cell
    made = files.universe(N)
    path = tmp_path / "t.dcd"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with mda.Writer(str(path), 3 * N) as writer:
            for frame in x.reshape(3, 3 * N, 3):
                made.atoms.positions = frame
                made.dimensions = dimensions
                writer.write(made.atoms)
    result = checked(path, Distance(files.pairs(N), files.targets(N)))
    assert result.status in ("kept", "tolerated")
    assert result.units[0].largest < 2e-5


@pytest.mark.parametrize("ending", ["dcd", "trr"])
@pytest.mark.parametrize("off", [0.0, 0.02])
def test_a_body_longer_than_half_the_cell(tmp_path, ending, off):
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
    rows = Distance(np.stack([i, j], axis=1), np.linalg.norm(ring[i] - ring[j], axis=1))
    assert rows.target_at(0.0).max() > side / 2
    result = checked(path, rows, n=n, rank=False, worst=99)
    assert result.status == ("violated" if off else "kept"), result.verdict
    assert result.violated_frames == bool(off) and result.units[0].largest < 0.03
    expected = np.linalg.norm(x[:, i] - x[:, j], axis=2) - rows.target_at(0.0)
    np.testing.assert_allclose(result.series["largest Å"], np.abs(expected).max(axis=1), atol=2e-6)


def test_verdict_names_row_frame_and_amount(water):
    result = checked(water["dcd"], Distance(files.pairs(N), files.targets(N)))
    off = np.abs(files.deviations(files.dcd_frames(water["dcd"]), files.pairs(N), files.targets(N), SIDE))
    frame, row = np.unravel_index(off.argmax(), off.shape)
    assert result.status == "violated" and result.violated
    assert row in (15, 17), "of the atom that drifts"
    assert result.worst[0].row == row and result.worst[0].frame == frame
    assert result.worst[0].largest == pytest.approx(off.max(), abs=1e-9)
    allowed = result.worst[0].allowed
    assert result.violated_rows == np.count_nonzero((off > allowed).any(axis=0)) == 4
    assert result.violated_frames == np.count_nonzero((off > allowed).any(axis=1))
    assert result.first_violated_frame == np.argmax((off > allowed).any(axis=1))
    assert f"in frame {frame}; 4 of 120 rows" in result.verdict and "SOL6:" in result.verdict
    line = result.units[0].drift
    assert line is not None and line.significant and line.slope > 0


@pytest.mark.parametrize("ending", ["dcd", "xtc", "trr", "pdb", "gro"])
def test_kept_to_the_precision_of_each_format(tmp_path, ending):
    x = files.water(N, 1 if ending == "gro" else 6, seed=3)
    if ending == "pdb":
        x = files.whole(x)
    if ending == "gro":
        path = files.topology(tmp_path / "k.gro", N, x[0])
    else:
        options = {"multiframe": True, "side": None} if ending == "pdb" else {}
        path = files.write(tmp_path / f"k.{ending}", x, **options)
    result = checked(path, Distance(files.pairs(N), files.targets(N)), tolerance=0.0)
    assert result.status == "kept", result.verdict
    unit = result.units[0]
    assert 0.6 * unit.rounding_rms < unit.rms < 1.5 * unit.rounding_rms or ending in ("dcd", "trr")
    assert unit.largest <= unit.bound
    steps = {"xtc": "0.01 Å (0.001 nm)", "pdb": "0.001 Å", "gro": "0.01 Å", "dcd": "single", "trr": "single"}
    assert steps[ending] in result.precision


@pytest.mark.parametrize("ending", ["dcd", "xtc", "trr"])
def test_a_violation_beyond_the_precision_is_found(tmp_path, ending):
    x = files.water(N, 6, seed=3)
    x[3, 4] += {"dcd": 2e-3, "xtc": 0.05, "trr": 2e-3}[ending]
    path = files.write(tmp_path / f"v.{ending}", x % SIDE)
    result = checked(path, Distance(files.pairs(N), files.targets(N)))
    assert result.status == "violated" and result.worst[0].frame == 3 and 4 in result.worst[0].atoms


def test_finer_xtc_has_a_smaller_bound(tmp_path):
    x = files.water(N, 3)
    path = files.write(tmp_path / "fine.xtc", x, precision=5)
    result = checked(path, Distance(files.pairs(N), files.targets(N)), tolerance=0.0)
    assert result.status == "kept"
    assert result.units[0].bound == pytest.approx(2 * np.sqrt(3) * 0.5e-4)


def test_tolerance_of_the_engine_is_told_apart(tmp_path):
    x = files.water(N, 3)
    path = files.write(tmp_path / "t.dcd", x)
    wrong = files.targets(N) * (1 + 5e-5)
    assert checked(path, Distance(files.pairs(N), wrong)).status == "tolerated"
    assert checked(path, Distance(files.pairs(N), wrong), tolerance=1e-6).status == "violated"


def test_targets_of_the_first_frame_and_of_the_mean(water, positions):
    x = files.dcd_frames(water["dcd"])
    lengths = files.deviations(x, files.pairs(N), 0.0, SIDE)
    for targets, held in (("first", lengths[0]), ("mean", lengths.mean(axis=0))):
        result = checked(water["dcd"], Distance(files.pairs(N), files.targets(N)), targets=targets, worst=3 * N)
        np.testing.assert_allclose(result.series["largest Å"], np.abs(lengths - held).max(axis=1), atol=1e-6)
        for row in result.worst:
            assert row.target == pytest.approx(held[row.row], abs=1e-9)


def test_open_targets_come_from_the_first_frame_looked_at(water):
    x = files.dcd_frames(water["dcd"])
    lengths = files.deviations(x, files.pairs(N), 0.0, SIDE)
    result = checked(water["dcd"], Distance(files.pairs(N)), run={"start": 4, "stop": 20, "step": 3})
    assert result.frames == list(range(4, 20, 3))
    np.testing.assert_allclose(result.times, [2.0 * k for k in result.frames], rtol=1e-5)
    np.testing.assert_allclose(result.series["largest Å"], np.abs(lengths[4:20:3] - lengths[4]).max(axis=1), atol=1e-6)


def test_rows_of_all_kinds(water):
    """Angles, dihedrals, collective and linear rows, against plain formulas."""
    x = files.dcd_frames(water["dcd"])

    def near(d):
        return d - SIDE * np.rint(d / SIDE)

    u, w = near(x[:, 1::3] - x[:, ::3]), near(x[:, 2::3] - x[:, ::3])
    cosine = (u * w).sum(axis=2) / np.linalg.norm(u, axis=2) / np.linalg.norm(w, axis=2)
    angles = np.arccos(cosine)
    o = 3 * np.arange(N)
    near_by = 3 * (1 + int(np.argmin(np.linalg.norm(near(x[0, 3::3] - x[0, 0]), axis=1))))
    rows = [
        Angle(np.stack([o + 1, o, o + 2], axis=1), ANGLE := files.ANGLE),
        LinearRelation(0, [1, 2], [0.5, 0.5]),
        Distance(files.pairs(N), files.targets(N)),
        Dihedral([[1, 0, near_by, near_by + 1]]),
        CenterOfMass([0, 1, 2]),
        DistanceDifference([[0, near_by], [1, near_by + 1]]),
    ]
    result = checked(water["dcd"], rows, worst=500)
    found = {row.row: row for row in result.worst}
    for k in range(N):
        assert found[k].largest == pytest.approx(np.abs(angles[:, k] - ANGLE).max(), abs=2e-6)
        assert found[k].unit == "rad"
    middle = 0.5 * (u[:, 0] + w[:, 0])
    for axis in range(3):
        expected = np.abs(middle[:, axis]).max()
        assert found[N + axis].largest == pytest.approx(expected, abs=2e-6)
    apart = [np.linalg.norm(near(x[:, near_by + k] - x[:, k]), axis=1) for k in (0, 1)]
    expected = np.abs(apart[0] - apart[1] - (apart[0] - apart[1])[0]).max()
    assert found[4 * N + 7].largest == pytest.approx(expected, abs=2e-6) and expected > 0.01
    kinds = {unit.unit: unit.n_rows for unit in result.units}
    assert kinds == {"Å": 3 * N + 7, "rad": N + 1}
    assert set(result.series) >= {"largest Å", "largest rad", "rms Å", "rms rad"}


@pytest.mark.parametrize("n", [1, 3, 4, 6])
def test_triangles_and_single_rows_say_the_same(water, n):
    """Sides of triangles are measured together, four molecules at a time; what is left goes one by one."""
    table, held = files.pairs(N), files.targets(N)
    mixed = np.concatenate([table[: 3 * n], table[3 * n :: 3], table[3 * n + 1 :: 3]])
    wanted = np.concatenate([held[: 3 * n], held[3 * n :: 3], held[3 * n + 1 :: 3]])
    for ending in ("dcd", "xtc"):
        together = checked(water[ending], Distance(mixed, wanted), worst=999)
        apart = checked(
            water[ending], [Distance(pair, length) for pair, length in zip(mixed, wanted, strict=True)][::-1], worst=999
        )
        assert {(r.name, r.largest, r.frame) for r in together.worst} == {
            (r.name, r.largest, r.frame) for r in apart.worst
        }
        np.testing.assert_allclose(together.series["rms Å"], apart.series["rms Å"], rtol=1e-12)
        means = {r.name: r.mean for r in apart.worst}
        assert all(r.mean == pytest.approx(means[r.name], abs=1e-13) for r in together.worst)


def test_transformed_coordinates_are_taken_as_they_are(water):
    from MDAnalysis.transformations import translate

    made = files.universe(N)
    load_trajectory(made, water["xtc"])
    made.trajectory.add_transformations(translate([0.0031, 0.0, 0.0]))
    check = ConstraintCheck(made, Distance(files.pairs(N), files.targets(N))).run().check
    plain = checked(water["xtc"], Distance(files.pairs(N), files.targets(N)))
    np.testing.assert_allclose(check.series["rms Å"], plain.series["rms Å"], atol=2e-5)
    assert any("transformations" in remark for remark in check.remarks)


def test_bad_options(water):
    rows = Distance(files.pairs(N), files.targets(N))
    for options, match in (
        ({"tolerance": -1.0}, "tolerance"),
        ({"precision": 0.0}, "precision"),
        ({"targets": "nowhere.toml"}, "nowhere.toml"),
        ({"removed": -3}, "removed is -3"),
        ({"removed": 2.5}, "removed is 2.5"),
        ({"run": {"start": 30}}, "no frames"),
    ):
        with pytest.raises(InputError, match=match):
            checked(water["dcd"], rows, **options)
    with pytest.raises(InputError, match="no constraints"):
        checked(water["dcd"], [])
    with pytest.raises(InputError, match="no atom 120"):
        checked(water["dcd"], Distance([[0, 120]], 1.0))


def test_wrong_frames_names_and_order(water):
    universe = loaded(water["dcd"])
    with pytest.raises(InputError, match=r"constraints has 'hbonds', which is no kcons constraint"):
        ConstraintCheck(universe, "hbonds")
    check = ConstraintCheck(universe, Distance([[0, 1]]))
    with pytest.raises(InputError, match=r"nothing was looked at yet; call run\(\) first"):
        _ = check.check
    count = universe.trajectory.n_frames
    for frame in (count, -count - 1):
        with pytest.raises(InputError, match=f"there is no frame {frame}; it has {count}"):
            check.run(frames=[0, frame])
    for frames in (slice(0, 3), [True] * (count - 1), [0.5]):
        with pytest.raises(InputError, match=rf"give whole numbers, or True and False for each of the {count} frames"):
            check.run(frames=frames)
    with pytest.raises(InputError, match="step is 0"):
        check.run(step=0)
    assert check.run(frames=[0, count - 1]).check.status


@pytest.mark.parametrize("targets", ["given", "first"])
def test_bodies_longer_than_half_the_cell_are_seen_whole(tmp_path, targets):
    """Corners of a hexagon, 2.8 Å across, in a cell of 5 Å: nearest images of opposite corners are 2.2 Å apart."""
    rng = np.random.default_rng(3)
    corners = 1.4 * np.array([[np.cos(a), np.sin(a), 0.0] for a in np.arange(6) * np.pi / 3])
    frames = []
    for _ in range(8):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        frames.append((corners @ turn + rng.uniform(0, 5, 3)) % 5.0)
    frames[5][2] += [0.1, 0.0, 0.0]
    path = files.write(tmp_path / "ring.dcd", np.array(frames), side=5.0)
    pairs = [[i, j] for i in range(6) for j in range(i + 1, 6)]
    lengths = np.linalg.norm(corners[[i for i, _ in pairs]] - corners[[j for _, j in pairs]], axis=1)
    rows = Distance(pairs, lengths if targets == "given" else None)
    result = checked(path, rows, n=2, worst=15, targets=targets)
    largest = np.array(result.series["largest Å"])
    assert largest[[0, 1, 2, 3, 4, 6, 7]].max() < 1e-5
    assert 0.02 < largest[5] < 0.2


def test_rows_that_were_made_for_a_part_are_refused(water):
    whole = loaded(water["dcd"])
    with pytest.raises(InputError, match=rf"made for 30 atoms, and there are {3 * N} here"):
        ConstraintCheck(whole, constraints_of(whole.atoms[30:60], "none"))
    with pytest.raises(InputError, match="their atom 0 is atom 3 of the Universe, and here it is atom 0"):
        ConstraintCheck(whole, constraints_of(whole.atoms[np.r_[3:6, 0:3, 6 : 3 * N]], "none"))
    assert ConstraintCheck(whole, constraints_of(whole.atoms, "none")).run().check.n_rows == 3 * N


@pytest.mark.parametrize("ending", ["dcd", "trr"])
def test_cells_that_are_none_and_cells_that_end(tmp_path, ending):
    """Files without a cell may have lengths of 1: bonds would be folded into it."""
    x = files.whole(files.water(N, 6, side=SIDE), SIDE)
    rows = Distance(files.pairs(N), files.targets(N))
    assert checked(files.write(tmp_path / f"one.{ending}", x, side=1.0), rows).status == "kept"
    wrapped, path = x % SIDE, tmp_path / f"ends.{ending}"
    made = mda.Universe.empty(3 * N, trajectory=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with mda.Writer(str(path), 3 * N) as writer:
            for k, positions in enumerate(wrapped):
                made.atoms.positions = positions
                made.dimensions = [SIDE] * 3 + [90.0] * 3 if k < 4 else None
                writer.write(made.atoms)
    result = checked(path, rows)
    assert result.status == "violated" and result.first_violated_frame == 4
    assert any(f"2 of 6 frames of {path} have no cell" in remark for remark in result.remarks), result.remarks


@pytest.mark.parametrize("ending", ["dcd", "xtc", "trr"])
@pytest.mark.parametrize("targets", ["given", "first", "mean"])
def test_a_first_frame_that_alone_is_off_is_told_in_a_line(tmp_path, ending, targets):
    """As of LAMMPS, which writes the first frame before it holds the constraints; a verdict it is all the same."""
    x = files.whole(files.water(N, 12, seed=3))
    x[0] += np.random.default_rng(1).normal(0, 0.02 if ending == "xtc" else 2e-3, x[0].shape)
    path = files.write(tmp_path / f"a.{ending}", x, side=None)
    rows = Distance(files.pairs(N), files.targets(N))
    result = checked(path, rows, targets=targets)
    told = [remark for remark in result.remarks if remark.startswith("the first frame alone differs")]
    assert result.status == "violated"
    # The mean of all has a part of the first in it.
    assert len(told) == 1 or targets == "mean"
    assert all("begin at frame 1 (--frames 1:)" in remark for remark in told)
    assert ("agree to" in "".join(told)) == (targets == "first")
    later = checked(path, rows, targets=targets, run={"start": 1})
    assert later.status in ("kept", "tolerated") and not any("alone" in remark for remark in later.remarks)


@pytest.mark.parametrize("targets", ["given", "first"])
@pytest.mark.parametrize("wrong", [[5], [0, 5], [3, 4, 5, 6, 7, 8, 9, 10, 11], list(range(1, 12)), list(range(12))])
def test_other_frames_that_are_off_are_not_the_first_alone(tmp_path, targets, wrong):
    """Random errors of other frames, also where it is all of them."""
    x = files.whole(files.water(N, 12, seed=3))
    x[wrong] += np.random.default_rng(1).normal(0, 2e-3, x[wrong].shape)
    path = files.write(tmp_path / "a.dcd", x, side=None)
    result = checked(path, Distance(files.pairs(N), files.targets(N)), targets=targets)
    assert result.status == "violated" and not any("alone" in remark for remark in result.remarks)
