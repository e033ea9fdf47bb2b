"""Every file that can be wrong: what was readable is analysed, and messages name file, item and remedy."""

import struct
import warnings

import numpy as np
import pytest
import water_files as files
from water_files import mda

from kcons.constraints import Distance
from kcons.errors import UnreadableError
from kcons.mdanalysis import ConstraintCheck, load_trajectory

N = 30


@pytest.fixture(scope="module")
def x():
    return files.water(N, 8)


def checked(path, **run):
    made = files.universe(N)
    load_trajectory(made, path)
    return ConstraintCheck(made, Distance(files.pairs(N), files.targets(N))).run(**run).check


def cut(path, new, bytes_left):
    data = path.read_bytes()
    new.write_bytes(data[:bytes_left] if bytes_left > 0 else data[: len(data) + bytes_left])
    return new


@pytest.mark.parametrize("ending,lost", [("dcd", 7), ("dcd", 700), ("xtc", 7), ("xtc", 90), ("trr", 700), ("xyz", 700)])
def test_a_truncated_file_is_analysed_up_to_the_break(tmp_path, x, ending, lost):
    whole = files.write(tmp_path / f"whole.{ending}", files.whole(x))
    assert checked(whole).broken is None
    path = cut(whole, tmp_path / f"cut.{ending}", -lost)
    result = checked(path)
    assert result.frames == list(range(7))
    assert result.broken is not None and result.broken.frame == 7 and result.broken.reason
    assert result.status == "incomplete" and "ends too early, at frame 7" in result.verdict
    np.testing.assert_array_equal(result.series["largest Å"], checked(whole).series["largest Å"][:7])


@pytest.mark.parametrize("ending", ["dcd", "xtc", "trr"])
def test_garbage_in_the_middle(tmp_path, x, ending):
    whole = files.write(tmp_path / f"whole.{ending}", x)
    data = bytearray(whole.read_bytes())
    # Over the beginning of the fifth frame.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reader = mda.coordinates.core.reader(str(whole))
    start = int(reader._xdr.offsets[4]) if ending != "dcd" else len(data) - 4 * (56 + 3 * (8 + 12 * N))
    reader.close()
    data[start : start + 40] = b"\x7f" * 40
    path = tmp_path / f"bad.{ending}"
    path.write_bytes(bytes(data))
    result = checked(path)
    assert result.broken is not None and result.broken.frame == len(result.frames) <= 4
    assert len(result.frames) >= 3


TEXTS = ["mdcrd", "arc", "lammpsdump"]


@pytest.mark.parametrize("ending", ["xyz", "pdb", *TEXTS])
@pytest.mark.parametrize("lost", ["a frame", "a line", "a part of a number", "nothing"])
def test_text_files_that_end_in_a_line(tmp_path, x, ending, lost):
    """A number that was cut off is a number still: what it belongs to does not count."""
    if ending in TEXTS:
        path = files.write_text(tmp_path / f"w.{ending}", files.whole(x) + 50)
    else:
        options = {"multiframe": True} if ending == "pdb" else {}
        path = files.write(tmp_path / f"w.{ending}", files.whole(x), side=None, **options)
    text = path.read_text().rstrip().removesuffix("END").rstrip().removesuffix("ENDMDL").rstrip()
    lines = text.split("\n")
    if lost == "a frame":
        lines = lines[: -len(lines) // 8 - 5]
    elif lost == "a line":
        lines = lines[:-1]
    elif lost == "a part of a number":
        at = {"pdb": 52, "xyz": -3, "mdcrd": -2, "arc": -6, "lammpsdump": -3}[ending]
        lines[-1] = lines[-1].rstrip()[:at]
    whole = lost == "nothing"
    path.write_text("\n".join(lines) + ("" if lost == "a part of a number" else "\n"))
    result = checked(path, step=2) if lost == "a line" else checked(path)
    assert result.status == ("incomplete" if not whole else result.status) and result.status != "violated"
    if whole:
        assert result.broken is None and len(result.frames) == 8
    else:
        assert result.broken is not None and result.broken.frame in (6, 7)
        assert result.frames == list(range(result.broken.frame))[:: 2 if lost == "a line" else 1]


@pytest.mark.parametrize("ending", ["dcd", "xtc", "trr", "xyz"])
@pytest.mark.parametrize(
    "run,seen",
    [
        ({"step": 2}, True),
        ({"step": 3}, True),
        ({"start": 1, "stop": 50}, True),
        ({"start": -3}, True),
        ({"stop": 4}, False),
        ({"frames": [0, 3]}, False),
    ],
)
def test_a_file_that_ends_early_is_seen_whatever_frames_are_looked_at(tmp_path, x, ending, run, seen):
    """Every second frame of those that should be there: the last of them need not be the last of the file."""
    path = files.write(tmp_path / f"w.{ending}", files.whole(x))
    data = path.read_bytes()
    for lost in (8, len(data) // 7):
        path.write_bytes(data[:-lost])
        result = checked(path, **run)
        assert (result.status == "incomplete") == seen == (result.broken is not None)
        assert not seen or "ends too early" in result.verdict


def test_a_header_that_announces_more_frames(tmp_path, x):
    """Cut between two frames: nothing but the header of DCD tells."""
    path = files.write(tmp_path / "w.dcd", x)
    size = 56 + 3 * (8 + 12 * N)
    result = checked(cut(path, tmp_path / "c.dcd", -2 * size))
    assert result.status == "incomplete" and len(result.frames) == 6
    assert "its header announces 8 frames, and it has 6" in result.verdict
    data = bytearray(path.read_bytes())
    data[8:12] = struct.pack("=i", 0)  # not known when it was written
    path.write_bytes(bytes(data))
    assert checked(path).status == "kept"


@pytest.mark.parametrize("compressed", ["gz", "bz2"])
def test_compressed_files(tmp_path, x, compressed):
    import bz2
    import gzip

    path = files.write(tmp_path / "w.xyz", files.whole(x), side=None)
    packed = {"gz": gzip, "bz2": bz2}[compressed].compress(path.read_bytes())
    other = tmp_path / f"w.xyz.{compressed}"
    other.write_bytes(packed)
    one, two = checked(path), checked(other)
    assert one.status == two.status == "kept" and one.precision == two.precision
    other.write_bytes(packed[:-100])
    with pytest.raises(UnreadableError, match=r"cannot read this trajectory \(EOFError"):
        checked(other)


def test_a_break_in_the_part_of_one_worker(tmp_path, x):
    path = cut(files.write(tmp_path / "whole.xtc", x), tmp_path / "cut.xtc", -300)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = checked(path, backend="multiprocessing", n_workers=2)
    assert result.frames == list(range(7)) and result.broken is not None and result.broken.frame == 7


def test_nan_coordinates_end_what_can_be_read(tmp_path, x):
    y = x.copy()
    y[5, 4, 1] = np.nan
    result = checked(files.write(tmp_path / "nan.dcd", y))
    assert result.broken is not None and result.broken.frame == 5 and "atom 4" in result.broken.reason
    assert result.status == "incomplete" and "frame 5 cannot be used, nor what follows: position" in result.verdict


# -- parameter files --------------------------------------------------------------------------------
