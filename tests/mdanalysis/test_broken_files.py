"""Every file that can be wrong: what was readable is analysed, and messages name file, item and remedy."""

import struct
import warnings

import numpy as np
import pytest
import water_files as files
from water_files import mda

from kcons.constraints import Distance
from kcons.errors import InputError, UnreadableError
from kcons.mdanalysis import ConstraintCheck, check_trajectory, load_trajectory, open_universe
from kcons.mdanalysis.check.files.file_precision import precision_of
from kcons.mdanalysis.check.files.target_file import TargetFile

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


def test_nothing_readable_is_an_error(tmp_path, x):
    y = x.copy()
    y[0] = np.nan
    with pytest.raises(UnreadableError, match=r"cannot be read \(position of atom 0"):
        checked(files.write(tmp_path / "nan.dcd", y))


@pytest.mark.parametrize("ending", ["dcd", "xtc", "trr", "nc"])
def test_files_that_cannot_be_opened(tmp_path, ending):
    made = files.universe(N)
    path = tmp_path / f"a.{ending}"
    with pytest.raises(InputError, match=rf"there is no file .*a\.{ending}"):
        load_trajectory(made, path)
    path.write_bytes(b"")
    with pytest.raises(UnreadableError, match=rf"a\.{ending} is empty"):
        load_trajectory(made, path)
    path.write_bytes(b"\x07nothing that anyone knows" * 50)
    with pytest.raises(InputError, match=rf"a\.{ending}.*cannot read this trajectory.*(complete|cut off)") as error:
        load_trajectory(made, path)
    # Neither that nor a missing file is one that ended too early.
    assert not isinstance(error.value, UnreadableError)


def test_netcdf_that_was_cut_off_says_so(tmp_path, x):
    path = cut(files.write(tmp_path / "whole.nc", x), tmp_path / "cut.nc", -900)
    with pytest.raises(UnreadableError, match=r"cut\.nc.*cut off"):
        load_trajectory(files.universe(N), path)


@pytest.mark.parametrize("ending", ["dcd", "xtc", "trr", "nc"])
def test_atom_counts_that_differ(tmp_path, x, ending):
    path = files.write(tmp_path / f"w.{ending}", x)
    top = files.topology(tmp_path / "t.pdb", N - 1, x[0, :-3])
    with pytest.raises(InputError, match=rf"w\.{ending} has 90 atoms, .*t\.pdb has 87; give the topology of the atoms"):
        open_universe(top, path)


def test_topologies_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"there is no file .*no\.psf"):
        open_universe(tmp_path / "no.psf")
    path = tmp_path / "t.psf"
    path.write_text("nothing\n")
    with pytest.raises(InputError, match=r"t\.psf: MDAnalysis cannot read this topology"):
        open_universe(path)


def test_check_from_files(tmp_path, x):
    path = files.write(tmp_path / "w.xtc", x)
    top = files.topology(tmp_path / "t.gro", N, x[0])
    for targets in ("first", "mean", "topology"):
        result = check_trajectory(path, top, "none", targets=targets)
        assert result.n_rows == 3 * N and result.status == "kept", result.verdict
        assert result.rank == 3 * N
    assert check_trajectory(path, top, "none", frames="2:7:2").frames == [2, 4, 6]
    for frames in ("a:b", "3", "1:5:0"):
        with pytest.raises(InputError, match="frames are"):
            check_trajectory(path, top, "none", frames=frames)
    with pytest.raises(InputError, match="0 workers"):
        check_trajectory(path, top, "none", workers=0)
    with pytest.raises(InputError, match=r"(?i)matches no|no atoms"):
        check_trajectory(path, top, "none", select="resname NOPE")
    with pytest.raises(InputError, match=r"(?i)hbond"):
        check_trajectory(path, top, "hbond")


def test_targets_of_the_topology_need_coordinates(tmp_path, x):
    path = files.write(tmp_path / "w.xtc", x)
    top = tmp_path / "t.psf"
    lines = ["PSF", "", "       1 !NTITLE", " REMARKS none", "", f"{3 * N:8d} !NATOM"]
    for a in range(3 * N):
        name, mass = (("OW", 15.999), ("HW1", 1.008), ("HW2", 1.008))[a % 3]
        lines.append(f"{a + 1:8d} W    {a // 3 + 1:<4d} SOL  {name:<4s} {name:<4s} {0.0:10.6f} {mass:13.4f} {0:11d}")
    top.write_text("\n".join([*lines, "", "       0 !NBOND: bonds", "", ""]))
    with pytest.raises(InputError, match=r"t\.psf has no coordinates.*--targets first"):
        check_trajectory(path, top, "none", targets="topology")


# -- parameter files --------------------------------------------------------------------------------

GOOD = f"""
unit = "nm"
[[length]]
atoms = ["OW", "HW?"]
residue = "SOL"
value = {files.OH / 10}
[[length]]
elements = ["h", "H"]
value = {files.HH / 10}
"""


def test_targets_from_a_file(tmp_path, x):
    path, top = files.write(tmp_path / "w.dcd", x), files.topology(tmp_path / "t.gro", N, x[0])
    parameters = tmp_path / "p.toml"
    parameters.write_text(GOOD)
    result = check_trajectory(path, top, "none", targets=parameters, worst=3 * N)
    assert result.status == "kept" and str(parameters) == result.targets
    assert sorted({round(float(row.target), 6) for row in result.worst}) == [files.OH, round(float(files.HH), 6)]
    parameters.write_text(GOOD.replace(str(files.OH / 10), str(files.OH / 10 + 1e-3)))
    assert check_trajectory(path, top, "none", targets=parameters).status == "violated"


@pytest.mark.parametrize(
    "text,match",
    [
        ("[[length", "no readable TOML"),
        ("unit = 'nm'", "no .*length"),
        ("unit = 'mile'\n[[length]]\nelements=['O','H']\nvalue=1", "unit 'mile'"),
        ("[[bond]]\nvalue=1", "'bond' is unknown"),
        ("[[length]]\nelements=['O']\nvalue=1", "2 names"),
        ("[[length]]\nelements=['O','H']\natoms=['O','H']\nvalue=1", "either atoms or elements"),
        ("[[length]]\nelements=['O','H']\nvalue=-1", "positive length"),
        ("[[angle]]\nelements=['H','O','H']\nvalue=190", "between 0 and 180"),
        ("[[length]]\nelements=['O','H']\nvalue=1\nforce=2", "residue is optional"),
    ],
)
def test_parameter_files_that_are_wrong(tmp_path, text, match):
    path = tmp_path / "p.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=match) as caught:
        TargetFile(path)
    assert "p.toml" in str(caught.value)


def test_a_row_without_a_parameter_is_named(tmp_path, x):
    path, top = files.write(tmp_path / "w.dcd", x), files.topology(tmp_path / "t.gro", N, x[0])
    parameters = tmp_path / "p.toml"
    parameters.write_text("[[length]]\nelements=['O','H']\nvalue=0.9572\n")
    with pytest.raises(InputError, match=r"no length for SOL1:HW1–HW2 \(H-H; 30 rows in all\); add a"):
        check_trajectory(path, top, "none", targets=parameters)


def test_precision_is_read_from_the_file(tmp_path, x):
    assert precision_of(files.write(tmp_path / "a.xtc", x, precision=4), "XTC").step == pytest.approx(1e-3)
    assert precision_of(files.write(tmp_path / "b.xtc", x[:, :9]), "XTC").step == 0.0
    assert precision_of(files.topology(tmp_path / "c.gro", N, x[0]), "GRO").step == pytest.approx(0.01)
    single = precision_of("none.dcd", "DCD")
    assert single.half_step([100.0]) == pytest.approx(2.0**-18)
    assert precision_of("none.trr", "TRR").half_step([100.0]) > single.half_step([100.0])
    assert precision_of("none.dcd", "DCD", 0.02).half_step([1.0]) == pytest.approx(0.01, rel=1e-4)


def test_big_endian_dcd_and_fixed_layout(tmp_path, x):
    """The end of a DCD file is found by its records, whatever the order of bytes."""
    from kcons.mdanalysis.check.files.endings import leftover

    path = files.write(tmp_path / "w.dcd", x)
    data = path.read_bytes()
    place, turned = 0, b""
    while place < len(data):
        (length,) = struct.unpack_from("<i", data, place)
        turned += struct.pack(">i", length) + data[place + 4 : place + 4 + length] + struct.pack(">i", length)
        place += length + 8
    other = tmp_path / "b.dcd"
    turned = turned[:8] + turned[8:12][::-1] + turned[12:]  # the number of frames
    other.write_bytes(turned)
    assert leftover(other, "DCD", 8, 3 * N, None) is leftover(path, "DCD", 8, 3 * N, None) is None
    other.write_bytes(turned[:-4])
    rest = leftover(other, "DCD", 7, 3 * N, None)
    assert rest is not None and rest.frame == 7 and "bytes follow" in rest.reason
