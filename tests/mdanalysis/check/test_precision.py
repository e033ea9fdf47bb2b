"""Rounding is that of each row's own coordinates in each frame: nothing wild excuses anything else."""

import MDAnalysis as mda
import numpy as np
import pytest
import water_files as files

from kcons.constraints import Angle, Distance, LinearRelation
from kcons.errors import UnreadableError
from kcons.mdanalysis import ConstraintCheck, check_trajectory
from kcons.mdanalysis.check.precision import FilePrecision, precision_of

N = 12
BOND = Distance(files.pairs(N), files.targets(N))
ANGLES = Angle([[3 * k + 1, 3 * k, 3 * k + 2] for k in range(N)], files.ANGLE)
#: Rows of the molecule that is far away, and of the one that is broken: the first bond of each.
FAR, BROKEN = 3 * 7, 3 * 2


def whole(frames=8):
    return files.whole(files.water(N, frames, seed=2))


def checked(path, constraints=BOND, **options):
    return files.checked(path, N, constraints, **{"worst": 3 * N, **options})


def rows(result):
    return {row.row: row for row in result.worst}


def half_units(x):
    """Half the distance of neighboring singles, at the largest coordinate of each atom."""
    return 0.5 * np.spacing(np.abs(x).max(axis=-1).astype(np.float32)).astype(np.float64)


def broken_and_far(away, frames=slice(5, 6)):
    """From the fourth frame on a bond is too long by 0.01; a molecule lies far away in some frames."""
    x = whole()
    bond = x[3:, 3 * 2 + 1] - x[3:, 3 * 2]
    x[3:, 3 * 2 + 1] += 0.05 * bond / files.OH
    x[frames, 3 * 7 : 3 * 8] += away
    return x


@pytest.mark.parametrize("away", [1e3, 1e5, 1e8])
@pytest.mark.parametrize("ending", ["dcd", "trr", "xtc", "nc"])
@pytest.mark.parametrize("targets", ["given", "first", "mean"])
def test_a_wild_molecule_excuses_no_other(tmp_path, ending, away, targets):
    if ending == "xtc" and away > 1e5:
        away = 1e6  # what its integers can hold
    calm = checked(files.write(tmp_path / f"c.{ending}", broken_and_far(0.0), side=None), targets=targets)
    wild = checked(files.write(tmp_path / f"w.{ending}", broken_and_far(away), side=None), targets=targets)
    assert calm.status == wild.status == "violated"
    for result in (calm, wild):
        assert targets == "mean" or (result.worst[0].row == BROKEN and result.worst[0].frame >= 3)
    one, other = rows(calm)[BROKEN], rows(wild)[BROKEN]
    assert (one.largest, one.frame) == (other.largest, other.frame)
    assert other.allowed == one.allowed
    if targets != "mean":
        # The far one's bonds are none of those that are violated.
        assert wild.violated_rows == calm.violated_rows and wild.violated_frames == calm.violated_frames == 5
        assert wild.first_violated_frame == 3
    if ending != "xtc" and targets == "given" and away < 1e8:
        path = files.write(tmp_path / f"a.{ending}", broken_and_far(away, slice(None)), side=None)
        always = checked(path)  # of the atom that moved
        assert always.worst[0].row == BROKEN and always.worst[0].allowed < 2e-4 and always.violated_rows == 2
        assert rows(always)[FAR].largest < rows(always)[FAR].allowed


def test_what_is_allowed_is_the_rounding_of_both_atoms_and_the_tolerance(tmp_path):
    """Against half units of single precision, atom by atom."""
    x = whole(1).astype(np.float32).astype(np.float64) * 100
    path = files.write(tmp_path / "a.dcd", x, side=None)
    stored = files.dcd_frames(path)[0]
    i, j = files.pairs(N).T
    rounding = np.sqrt(3) * (half_units(stored)[i] + half_units(stored)[j])
    lengths = np.linalg.norm(stored[i] - stored[j], axis=1)
    result = checked(path, Distance(files.pairs(N), lengths), tolerance=1e-6)
    found = rows(result)
    for k in range(3 * N):
        assert found[k].allowed == pytest.approx(rounding[k] + 1e-6 * lengths[k], rel=1e-5)
    assert result.units[0].bound == pytest.approx(rounding.max(), rel=1e-9)
    assert result.units[0].tolerance == pytest.approx(1e-6 * lengths.min(), rel=1e-9)


@pytest.mark.parametrize("targets", ["first", "mean"])
def test_two_roundings_make_more_than_one(tmp_path, targets):
    """Atoms on both sides of 2048, where steps of single precision double: one length, stored in two ways."""
    step = 2.0**-13  # of numbers from 1024 to 2048
    x = np.tile(100.0 * np.arange(3 * N)[:, None] * np.ones(3), (2, 1, 1))
    x[:, 0], x[:, 1] = 2046.0, 2050.0
    x[1, 0] += 2 * step
    path = files.write(tmp_path / "a.dcd", x, side=None)
    np.testing.assert_array_equal(files.dcd_frames(path)[:, :2], x[:, :2])
    # The length that is 4 √3 minus one step in each direction: half a step of each atom is 1.5 steps together.
    row = [[0, 1]]
    assert np.sqrt(3) * 1.5 * step < np.sqrt(3) * 2 * step < 2 * np.sqrt(3) * 1.5 * step
    result = checked(path, Distance(row), targets=targets, tolerance=0.0, rank=False)
    assert result.status == "kept", result.verdict
    assert result.worst[0].allowed == pytest.approx(2 * np.sqrt(3) * 1.5 * step, rel=1e-6)
    given = checked(path, Distance(row, np.linalg.norm(x[0, 0] - x[0, 1])), tolerance=0.0, rank=False)
    assert given.status == "violated"


def test_a_wild_molecule_of_the_topology_excuses_no_other(tmp_path):
    """Targets of the topology's coordinates: rounding of each is that of its own atoms there."""
    x = whole()
    top = x[0].copy()
    top[3 * 7 : 3 * 8] += 1e6
    lines = [f"{'OHH'[a % 3]} {r[0]:.6f} {r[1]:.6f} {r[2]:.6f}" for a, r in enumerate(top)]
    (tmp_path / "t.xyz").write_text("\n".join([str(3 * N), "", *lines, ""]))
    x[3:, 3 * 2 + 1] += 0.05 * (x[3:, 3 * 2 + 1] - x[3:, 3 * 2]) / files.OH
    path = files.write(tmp_path / "w.dcd", x, side=None)
    result = check_trajectory(
        path, tmp_path / "t.xyz", "allbonds", rigid_water=False, targets="topology", rank=False, worst=99
    )
    assert result.status == "violated" and result.violated_rows == 1
    assert result.worst[0].atoms == [3 * 2, 3 * 2 + 1] and result.worst[0].allowed < 2e-4
    assert [row.allowed > 0.1 for row in result.worst].count(True) == 2


def test_the_tolerance_is_a_part_of_the_length(tmp_path):
    """Rows of 1 and 4 angstrom, off by 2e-4 each: only the short one by more than 1e-4 of its length."""
    x = np.zeros((3, 3 * N, 3))
    x[:, :, 1] = 10.0 * np.arange(3 * N)
    short, long = [0, 1], [2, 3]
    x[:, 1] = x[:, 0] + [1.0002, 0, 0]
    x[:, 3] = x[:, 2] + [4.0002, 0, 0]
    path = files.write(tmp_path / "a.dcd", x, side=None)
    tolerated = checked(path, Distance([long], 4.0))
    assert tolerated.status == "tolerated" and tolerated.verdict.startswith("kept to the tolerance of 0.0001: largest")
    assert checked(path, Distance([short], 1.0)).status == "violated"
    both = checked(path, Distance([short, long], [1.0, 4.0]))
    assert both.status == "violated" and both.violated_rows == 1 and both.worst[0].row == 0
    assert [row.allowed for row in both.worst] == pytest.approx([1e-4, 4e-4], rel=0.05)


def test_frames_count_as_violated_by_any_row(tmp_path):
    """In each frame a long row is off by more than a short one, and within what is allowed it."""
    x = np.zeros((4, 3 * N, 3))
    x[:, 1, 0] = [1.0, 1.0003, 1.0003, 1.0]
    x[:, 2, 1], x[:, 3, 1] = 5.0, 5.0
    x[:, 3, 0] = 8.0005
    result = checked(files.write(tmp_path / "a.dcd", x, side=None), Distance([[0, 1], [2, 3]], [1.0, 8.0]), rank=False)
    assert result.status == "violated" and result.violated_frames == 2 and result.first_violated_frame == 1
    assert result.worst[0].row == 0 and result.worst[0].frame in (1, 2)
    np.testing.assert_allclose(result.series["largest Å"], 5e-4, atol=1e-6)


@pytest.mark.parametrize("ending", ["dcd", "trr"])
@pytest.mark.parametrize("few", [3, 1], ids=["lengths", "angles"])
def test_rows_of_which_nothing_can_be_told_leave_a_check_incomplete(tmp_path, ending, few):
    """A molecule whose coordinates are stored in steps of 8: neither kept nor violated, and in no statistics."""
    x = whole()
    calm = files.write(tmp_path / f"c.{ending}", x, side=None)
    x[5, 3 * 7 : 3 * 8] += 1e8
    wild = files.write(tmp_path / f"w.{ending}", x, side=None)
    one, other = (checked(path, BOND if few == 3 else ANGLES) for path in (calm, wild))
    assert one.status in ("kept", "tolerated") and other.status == "incomplete"
    assert f"up to {few} of {other.n_rows} rows in 1 of 8 frames, from frame 5" in other.verdict
    assert other.units[0].largest == pytest.approx(one.units[0].largest, rel=0.5)
    assert other.units[0].rms == pytest.approx(one.units[0].rms, rel=0.2)
    assert other.units[0].bound < 1e-4
    assert abs(rows(other)[few * 7].mean) < 1e-4
    x[0, 3 * 7 : 3 * 8] += 1e8 + np.array([[0, 0, 0], [8, 0, 0], [0, 8, 0]])
    result = checked(files.write(tmp_path / f"f.{ending}", x, side=None), targets="first")
    if few == 3:
        assert "coordinates in the first frame are so large" in result.verdict and "3 of 36 rows" in result.verdict
        always = x.copy()
        always[:, 3 * 7 : 3 * 8] = x[0, 3 * 7 : 3 * 8]
        found = rows(checked(files.write(tmp_path / f"n.{ending}", always, side=None)))
        assert found[3 * 7].frame is None and found[0].frame is not None


def test_angles_and_other_rows_have_the_rounding_of_their_own_atoms(tmp_path):
    x = whole()
    halves = LinearRelation(3 * np.arange(N) + 1, (3 * np.arange(N) + 2)[:, None], np.ones((N, 1)), None)
    held = [ANGLES, Distance(files.pairs(N)[::3], files.OH)]
    x[4:, 3 * 2 + 2] += [0.0, 0.0, 0.02]
    calm = checked(files.write(tmp_path / "c.dcd", x, side=None), held)
    x[5, 3 * 7 : 3 * 8] += 1e6
    wild = checked(files.write(tmp_path / "w.dcd", x, side=None), held)
    assert calm.status == wild.status == "violated"
    assert wild.worst[0].unit == "rad" and wild.worst[0].row == 2
    assert rows(wild)[2].allowed == rows(calm)[2].allowed < 2e-4
    assert rows(wild)[7].allowed <= rows(calm)[7].allowed * 1.5  # where it is nearest to a violation
    # To first order, h Σ |∂q/∂x|: of a difference of two coordinates, both errors; as much for the targets.
    first = checked(files.write(tmp_path / "l.dcd", x[:1], side=None), halves, rank=False, tolerance=0.0)
    stored = files.dcd_frames(tmp_path / "l.dcd")[0]
    allowed = {row.name: row.allowed for row in first.worst}
    errors = half_units(stored)
    for k in range(N):
        one, two = 3 * k + 1, 3 * k + 2
        mine = [value for name, value in allowed.items() if f"SOL{k + 1}:" in name]
        expected = 2.2 * (errors[one] + errors[two])
        assert mine == pytest.approx([expected] * len(mine), rel=1e-4) and mine


def test_xtc_beyond_the_reach_of_its_grid(tmp_path):
    """Where single precision cannot give back the integers of the file, it is what counts."""
    x = whole()
    x[4, 3 * 7 : 3 * 8] += 2e5
    result = checked(files.write(tmp_path / "a.xtc", x, side=None), tolerance=0.0)
    assert result.status == "kept", result.verdict
    assert result.series["largest Å"][4] > 0.02 > max(np.delete(result.series["largest Å"], 4))
    calm = np.delete(np.array(result.series["rounding Å"]), 4)
    np.testing.assert_allclose(calm, 2 * np.sqrt(3) * 0.005, rtol=1e-9)
    assert result.series["rounding Å"][4] > 0.1
    fine = FilePrecision("XTC", 1e-5, exact=True)
    assert fine.half_step([1.0]) == pytest.approx(5e-6) and fine.half_step([50.0]) > 5e-6


def test_xtc_files_put_together_from_two_precisions(tmp_path):
    x = whole()
    x[6, 3 * 2 + 1] += 0.01 * (x[6, 3 * 2 + 1] - x[6, 3 * 2])
    coarse = files.write(tmp_path / "c.xtc", x[:4], side=None)
    fine = files.write(tmp_path / "f.xtc", x[4:], side=None, precision=5)
    path = tmp_path / "both.xtc"
    for parts, frame in (((fine, coarse), 2), ((coarse, fine), 6)):
        path.write_bytes(b"".join(part.read_bytes() for part in parts))
        result = checked(path)
        assert result.status == "violated" and result.worst[0].frame == frame and result.worst[0].row == BROKEN
        assert result.violated_frames == 1
    bound = 2 * np.sqrt(3) * 0.5
    np.testing.assert_allclose(result.series["rounding Å"], [bound * 1e-2] * 4 + [bound * 1e-4] * 4, rtol=1e-9)
    assert "0.0001 to 0.01 Å" in result.precision


def test_an_atom_that_no_row_has_may_be_anything(tmp_path):
    x = whole()
    x[:, 0], x[:, 2] = np.nan, np.inf
    result = checked(files.write(tmp_path / "a.dcd", x, side=None), BOND.select(range(3, 8)))
    assert result.status == "kept" and result.gaps == [] and len(result.frames) == 8


@pytest.mark.parametrize("words", ["position of atom 4", "velocity of atom 4", "the cell is (nan"])
def test_what_is_no_number_ends_what_can_be_read(tmp_path, words):
    x, v = whole(), np.zeros((8, 3 * N, 3))
    if "cell" in words:
        path = files.write(tmp_path / "a.dcd", x)
        data = bytearray(path.read_bytes())
        start = len(data) - 3 * (56 + 3 * (8 + 12 * N))
        data[start + 4 : start + 12] = np.array([np.nan]).tobytes()
        path.write_bytes(bytes(data))
    else:
        (x if "position" in words else v)[5, 4, 1] = np.nan
        path = files.write(tmp_path / "a.trr", x, velocities=v)
    result = checked(path)
    assert result.status == "incomplete" and result.broken is not None and result.broken.frame == 5
    assert words in result.broken.reason and "frame 5 cannot be used, nor what follows" in result.verdict


def test_targets_of_the_only_frame_are_no_verdict(tmp_path):
    x = whole(3)
    x[1, 4] += 0.5
    path, top = files.write(tmp_path / "w.dcd", x), files.topology(tmp_path / "t.gro", N, x[0])
    for targets in ("first", "mean"):
        result = check_trajectory(path, top, "none", targets=targets, frames="1:2", rank=False)
        assert result.status == "incomplete" and "the only frame" in result.verdict
        assert check_trajectory(path, top, "none", targets=targets, rank=False).status == "violated"
    assert check_trajectory(path, top, "none", targets="topology", frames="1:2", rank=False).status == "violated"
    assert check_trajectory(path, top, "none", targets="topology", frames="0:1", rank=False).status == "kept"
    # Of rows that are given, there is one.
    some = [Distance(files.pairs(N)[:3], files.targets(N)[:3]), Distance(files.pairs(N)[6:])]
    result = checked(path, some, run={"stop": 1})
    assert result.status == "incomplete" and "targets of 30 of 33 rows" in result.verdict
    assert checked(path, BOND, run={"stop": 1}).status == "kept"


@pytest.mark.parametrize("targets", ["given", "first"])
def test_nothing_can_be_told_where_the_first_frame_is_none(tmp_path, targets):
    x = whole()
    x[0, 4] = np.nan
    path = files.write(tmp_path / "w.dcd", x)
    with pytest.raises(UnreadableError, match=r"frame 0, the first to be checked, .*atom 4"):
        checked(path, targets=targets)
    assert checked(path, targets=targets, run={"start": 1}).status == "kept"
    top = files.topology(tmp_path / "t.gro", N, x[1])
    with pytest.raises(UnreadableError, match=r"not finite"):
        check_trajectory(path, top, "none")


def test_half_steps_bound_what_writers_make_of_coordinates(tmp_path):
    """Coordinates of all sizes, by each format, against what comes back."""
    rng = np.random.default_rng(5)
    x = rng.choice([-1, 1], size=(2, 3 * N, 3)) * 10 ** rng.uniform(-3, 4.5, size=(2, 3 * N, 3))
    for ending in ("dcd", "trr", "nc", "xtc"):
        path = files.write(tmp_path / f"a.{ending}", x, side=None)
        if ending == "xtc":  # which rounds what is in single precision
            x = x.astype(np.float32).astype(np.float64)
        trajectory = files.loaded(path, N).trajectory
        precision = precision_of(path, trajectory.format if ending != "nc" else "NCDF")
        for positions, ts in zip(x, trajectory, strict=True):
            back = ts.positions.astype(np.float64)
            off = np.abs(precision.stored(back) - positions)
            assert (off.max(axis=1) <= precision.half_step(positions) * (1 + 1e-6)).all(), ending
            assert (off.max(axis=1) / precision.half_step(positions)).max() > 0.3


def test_targets_that_are_means_have_the_mean_rounding_of_their_frames(tmp_path):
    x = whole()
    x[0, 3 * 7 : 3 * 8] += 1e5
    path = files.write(tmp_path / "a.dcd", x, side=None)
    result = checked(path, Distance(files.pairs(N)), targets="mean", rank=False, tolerance=0.0)
    i, j = files.pairs(N)[FAR]
    stored = files.dcd_frames(path)
    once = np.sqrt(3) * (half_units(stored)[:, i] + half_units(stored)[:, j])
    row = rows(result)[FAR]
    assert once[0] > 100 * once[1:].max()
    assert np.isclose(row.allowed, once.mean() + once, rtol=1e-4).any()


@pytest.mark.parametrize(
    ("name", "number", "options"),
    [
        *(("w.xyz", number, {}) for number in (repr, "{:.6g}".format, "{:.4f}".format)),
        *(("w.lammpsdump", "{:g}".format, options) for options in ({}, {"low": -20.0}, {"columns": "xu yu zu"})),
        *(("w.lammpsdump", number.format, {"columns": "xs ys zs"}) for number in ("{:g}", "{:.6f}")),
    ],
)
def test_numbers_of_text_bound_what_they_lost(tmp_path, name, number, options):
    """Six digits are what LAMMPS writes; what the first number of a file looks like says nothing of the others."""
    x = files.whole(files.water(N, 4, side=40.0), 40.0)
    x[0, :3] += [8.5, 7.0, 9.25] - x[0, 0]
    x = x.round(12)
    for status in ("kept", "violated"):
        path = files.write_text(tmp_path / name, x, number, side=40.0, **options)
        assert checked(path, tolerance=0.0).status == status
        x[2, 4] += 0.1
    if name == "w.xyz":
        read = mda.Universe(str(path), topology_format="XYZ")
        lost = np.abs(read.atoms.positions.astype(float) - x[0]).max(axis=1)
        assert np.all(lost <= precision_of(path, "XYZ").half_step(read.atoms.positions))


@pytest.mark.parametrize("how", ["memory", "chain"])
def test_coordinates_of_xtc_in_memory_and_of_several_files(tmp_path, how):
    """They were rounded to 0.01 angstrom, whoever gives them now."""
    x = whole()
    names = [str(files.write(tmp_path / f"{k}.xtc", x[k : k + 4])) for k in (0, 4)]
    for broken in (False, True):
        made = files.universe(N)
        if how == "chain":
            made.load_new(names)
        else:
            made.load_new(names[0])
            made.transfer_to_memory()
            made.trajectory.get_array()[2, 4, 0] += 0.1 * broken
        result = ConstraintCheck(made, BOND).run().check
        assert result.precision == "XTC stores coordinates in steps of 0.01 Å (0.001 nm)"
        assert result.status == ("violated" if broken and how == "memory" else "kept"), result.verdict


# -- grids of coordinates that were rounded before --------------------------------------------------


@pytest.mark.parametrize("ending", ["dcd", "trr", "nc"])
@pytest.mark.parametrize("decimals", [1, 2, 3, 4])
@pytest.mark.parametrize("targets", ["first", "given"])
def test_coordinates_that_were_rounded_before_they_came_into_a_file_of_floats(tmp_path, ending, decimals, targets):
    """Rigid water that was written as XTC or text first is kept; a bond that is off by more than that is not."""
    x = np.round(whole(), decimals)
    result = checked(files.write(tmp_path / f"a.{ending}", x, side=None), targets=targets)
    assert result.status in ("kept", "tolerated"), result.verdict
    step = 10.0**-decimals
    assert f"grid of {step:g} Å" in result.remarks[0] and f"steps of {step:.3g} Å" in result.precision
    assert result.units[0].bound < (4 if targets == "first" else 2) * np.sqrt(3) * 0.5 * step * 1.2
    bond = x[3, 4] - x[3, 3]
    x[3, 4] += np.round(10 * step * bond / np.linalg.norm(bond), decimals)
    wrong = checked(files.write(tmp_path / f"b.{ending}", x, side=None), targets=targets)
    assert wrong.status == "violated" and wrong.worst[0].frame == 3


def test_a_converted_xtc_says_what_the_xtc_says(tmp_path):
    """Through MDAnalysis' reader, in a cell, far from the origin."""
    path = files.write(tmp_path / "a.xtc", files.water(N, 8, seed=2) + 150.0)
    frames = np.array([ts.positions.copy() for ts in files.loaded(path, N).trajectory])
    one, other = checked(path), checked(files.write(tmp_path / "a.dcd", frames))
    assert one.status == other.status == "kept"
    assert other.units[0].largest == pytest.approx(one.units[0].largest, abs=5e-5)
    assert other.units[0].bound == pytest.approx(one.units[0].bound, rel=0.01)


@pytest.mark.parametrize("kind", ["floats", "one frame of them", "by hand", "few", "the precision is given"])
def test_what_is_no_grid(tmp_path, kind):
    """A frame that lies on one among others; numbers that a person wrote; numbers that are too few to tell."""
    x, options, row = np.round(whole(), 3), {}, BOND
    if kind == "floats":
        x = whole()
    elif kind == "one frame of them":
        x[1:] = whole()[1:]
    elif kind == "by hand":
        corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        x = np.tile((3.0 * np.arange(N)[:, None, None] + corners).reshape(-1, 3), (8, 1, 1))
        x[4, 4] += [0.01, 0.0, 0.0]
        row = Distance(files.pairs(N))
    elif kind == "few":
        x, row = x[:1], Distance([[0, 1]], files.OH)
        x[0, :2] = [[1.25, 0.0, 0.0], [1.25, 0.957, 0.0]]
    else:
        options = {"precision": 1e-5}
    result = checked(files.write(tmp_path / "a.dcd", x, side=None), row, **options)
    assert not any("grid" in remark for remark in result.remarks)
    assert kind == "the precision is given" or "single precision" in result.precision
    assert (result.status == "violated") == (kind != "floats")


def test_frames_that_are_looked_at_have_the_grid(tmp_path):
    """Frames on a grid behind others that are not: whether they are looked at decides."""
    x = whole(12)
    x[6:] = np.round(x[6:], 2)
    path = files.write(tmp_path / "a.dcd", x, side=None)
    for run, status in (({}, "violated"), ({"start": 6}, "kept"), ({"frames": [7, 9]}, "kept")):
        assert checked(path, run=run).status == status
    assert "single precision" in checked(path, run={"stop": 6}).precision
