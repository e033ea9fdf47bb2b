"""Every file that can be wrong: what was readable is analyzed, and messages name file, item and remedy."""

import importlib
import struct
import warnings

import numpy as np
import pytest
import water_files as files
from water_files import mda

from kcons.constraints import Distance
from kcons.errors import UnreadableError
from kcons.mdanalysis import ConstraintCheck
from kcons.mdanalysis.check import constraint_check
from kcons.mdanalysis.check.endings import DAMAGED

N = 30


@pytest.fixture(scope="module")
def x():
    return files.water(N, 8)


def checked(path, **run):
    return files.checked(path, N, run=run)


def cut(path, lost):
    """The file without its last bytes."""
    new = path.with_name(f"cut{path.suffix}")
    new.write_bytes(path.read_bytes()[:-lost])
    return new


@pytest.mark.parametrize("ending", ["xtc", "trr"])
def test_garbage_in_the_middle(tmp_path, x, ending):
    path = files.write(tmp_path / f"w.{ending}", x)
    data = bytearray(path.read_bytes())
    start = int(files.loaded(path, N).trajectory._xdr.offsets[4])
    data[start : start + 40] = b"\x7f" * 40
    (tmp_path / f"bad.{ending}").write_bytes(bytes(data))
    result = checked(tmp_path / f"bad.{ending}")
    assert result.broken is not None and result.broken.frame == len(result.frames) and 3 <= len(result.frames) <= 4


@pytest.mark.parametrize("ending", ["xyz", "pdb", "mdcrd", "arc", "lammpsdump"])
@pytest.mark.parametrize("lost", ["a frame", "a line", "a part of a number", "nothing"])
def test_text_files_that_end_in_a_line(tmp_path, x, ending, lost):
    """A number that was cut off is a number still: what it belongs to does not count."""
    path = files.write(tmp_path / f"w.{ending}", files.whole(x) + 50, side=None)
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
    # Empty lines at the end are no frame.
    path.write_text("\n".join(lines) + {"a part of a number": "", "nothing": "\n\n \n"}.get(lost, "\n"))
    step = 2 if lost == "a line" else 1
    result = checked(path, step=step)
    assert result.status in (("kept", "tolerated") if whole else ("incomplete",))
    assert (result.broken is None) == whole and (whole or result.broken.frame in (6, 7))
    assert result.frames == list(range(8 if whole else result.broken.frame))[::step]


@pytest.mark.parametrize("ending", ["dcd", "xtc", "trr", "xyz"])
@pytest.mark.parametrize(
    ("run", "seen"),
    [
        *((run, True) for run in ({}, {"step": 2}, {"step": 3}, {"start": 1, "stop": 50}, {"start": -3})),
        *((run, False) for run in ({"stop": 4}, {"frames": [0, 3]})),
    ],
)
def test_a_file_that_ends_early_is_seen_whatever_frames_are_looked_at(tmp_path, x, ending, run, seen):
    """Every second frame of those that should be there: the last of them need not be the last of the file."""
    path = files.write(tmp_path / f"w.{ending}", files.whole(x))
    data, whole = path.read_bytes(), checked(path)
    assert whole.broken is None
    for lost, last in ((8, 7), (len(data) // 7, 6)):
        path.write_bytes(data[:-lost])
        result = checked(path, **run)
        assert (result.status == "incomplete") == seen == (result.broken is not None)
        assert not seen or f"ends too early, at frame {last}" in result.verdict
        if not run:
            assert result.frames == list(range(last)) and result.broken.reason
            np.testing.assert_array_equal(result.series["largest Å"], whole.series["largest Å"][:last])


def test_a_header_that_announces_more_frames(tmp_path, x):
    """Cut between two frames: nothing but the header of DCD tells."""
    path = files.write(tmp_path / "w.dcd", x)
    result = checked(cut(path, 2 * (56 + 3 * (8 + 12 * N))))
    assert result.status == "incomplete" and len(result.frames) == 6
    assert "its header announces 8 frames, and it has 6" in result.verdict
    data = bytearray(path.read_bytes())
    data[8:12] = struct.pack("=i", 0)  # not known when it was written
    path.write_bytes(bytes(data))
    assert checked(path).status == "kept"


def dcd(x, order="<", cell=(12.0, 90.0, 12.0, 90.0, 90.0, 12.0), fixed=0):
    """The bytes of a DCD file: X-PLOR's kind without a cell, CHARMM's with one or with the first atoms fixed."""
    head = struct.pack(order + "9i", len(x), 0, 1, len(x), 0, 0, 0, 0, fixed)
    if cell is not None or fixed:
        head += struct.pack(order + "f10i", 1.0, int(cell is not None), *[0] * 8, 24)
    else:
        head += struct.pack(order + "d36x", 1.0)
    records = [b"CORD" + head, struct.pack(order + "i", 1) + b" " * 80, struct.pack(order + "i", x.shape[1])]
    if fixed:
        records.append(np.arange(fixed + 1, x.shape[1] + 1).astype(order + "i4").tobytes())
    for k, frame in enumerate(x):
        if cell is not None:
            records.append(np.array(cell).astype(order + "f8").tobytes())
        records += [column[fixed if k else 0 :].astype(order + "f4").tobytes() for column in frame.T]
    return b"".join(struct.pack(order + "i", len(r)) + r + struct.pack(order + "i", len(r)) for r in records)


KINDS = {
    "CHARMM": {},
    "other order of bytes": {"order": ">"},
    "X-PLOR": {"cell": None},
    "fixed atoms": {"fixed": 3},
    "fixed atoms, no cell": {"fixed": 6, "cell": None},
}


@pytest.mark.parametrize("kind", KINDS)
def test_records_of_all_kinds_of_dcd(tmp_path, monkeypatch, x, kind):
    """Whole files have an end; a length of a record that is wrong, anywhere in a frame, ends what can be used."""
    y, options = files.whole(x), KINDS[kind]
    y[:, : options.get("fixed", 0)] = y[0, : options.get("fixed", 0)]
    path, data = tmp_path / "w.dcd", bytearray(dcd(y, **options))
    path.write_bytes(data)
    assert checked(path).status == "kept" and len(checked(path).frames) == 8
    size = 4 * 3 * (3 * N - options.get("fixed", 0)) + 8 * 3 + (56 if options.get("cell", 1) else 0)
    monkeypatch.setattr(constraint_check, "AT_ONCE", 5 * size)
    for back in (3, 2):
        path.write_bytes(data[: len(data) - back * size + 4])
        result = checked(path)
        assert result.broken.frame == 8 - back and result.status == "incomplete" and "4 bytes follow" in result.verdict
    marks, place, begin = [], 0, len(data) - 3 * size
    while place < size:
        length = struct.unpack_from(options.get("order", "<") + "i", data, begin + place)[0]
        marks += [place, place + 4 + length]
        place += length + 8
    assert place == size and len(marks) == (8 if options.get("cell", 1) else 6)
    for places in [*zip(marks, strict=True), marks[:2]]:
        wrong = data.copy()
        for mark in places:
            wrong[begin + mark : begin + mark + 4] = b"\x7f\x00\x00\x7f"
        path.write_bytes(wrong)
        result = checked(path)
        assert result.broken.frame == 5 == len(result.frames) and result.status == "incomplete", places
        assert result.broken.reason == DAMAGED


@pytest.mark.parametrize("compressed", ["gzip", "bz2"])
def test_compressed_files(tmp_path, x, compressed):
    path = files.write(tmp_path / "w.xyz", files.whole(x), side=None)
    packed = importlib.import_module(compressed).compress(path.read_bytes())
    other = tmp_path / f"w.xyz.{compressed.removesuffix('ip')}"
    other.write_bytes(packed)
    one, two = checked(path), checked(other)
    assert one.status == two.status == "kept" and one.precision == two.precision
    other.write_bytes(packed[:-100])
    with pytest.raises(UnreadableError, match=r"cannot read this trajectory \(EOFError"):
        checked(other)


def test_a_break_in_the_part_of_one_worker(tmp_path, x):
    path = cut(files.write(tmp_path / "whole.xtc", x), 300)
    with warnings.catch_warnings(action="ignore"):
        result = checked(path, backend="multiprocessing", n_workers=2)
    assert result.frames == list(range(7)) and result.broken is not None and result.broken.frame == 7


# -- formats of structures --------------------------------------------------------------------------


def gro(x):
    lines = [f"    1SOL     OW{k + 1:5d}{r[0]:8.3f}{r[1]:8.3f}{r[2]:8.3f}" for k, r in enumerate(0.1 * x)]
    return "\n".join(["water", str(len(x)), *lines, "   1.20000   1.20000   1.20000", ""])


def inpcrd_with_velocities(x):
    return (
        files.inpcrd(np.concatenate([x, x])).replace(f"\n{2 * len(x)}\n", f"\n{len(x)}\n") + 6 * "  12.0000000" + "\n"
    )


def config(x):
    return "water\n 0 0 0\n" + "".join(f"O {k}\n {r[0]:f} {r[1]:f} {r[2]:f}\n" for k, r in enumerate(x)) + "\n"


def pdbqt(x):
    lines = [f"ATOM  {k + 1:5d}  OW  SOL     1    {r[0]:8.3f}{r[1]:8.3f}{r[2]:8.3f}" for k, r in enumerate(x)]
    return "\n".join([*lines, "END", ""])


def coor(x):
    return struct.pack("=i", len(x)) + x.astype("=f8").tobytes()


def cif(x, model=1):
    pytest.importorskip("gemmi")
    names = "group_PDB id type_symbol label_atom_id label_alt_id label_comp_id label_asym_id label_entity_id "
    names += "label_seq_id Cartn_x Cartn_y Cartn_z occupancy B_iso_or_equiv auth_seq_id auth_asym_id pdbx_PDB_model_num"
    head = "data_water\nloop_\n" + "".join(f"_atom_site.{name}\n" for name in names.split()) if model == 1 else ""
    return head + "".join(
        f"ATOM {k + 1} O OW . SOL A 1 1 {r[0]:.3f} {r[1]:.3f} {r[2]:.3f} 1 0 1 A {model}\n" for k, r in enumerate(x)
    )


#: Writers of one frame in formats of which MDAnalysis reads one, and what is said of two.
STRUCTURES = {
    "gro": (gro, "93 lines"),
    "velocities.gro": (lambda x: gro(x).replace("\n   1.2", "  0.1000  0.2000  0.3000\n   1.2"), "93 lines"),
    "inpcrd": (files.inpcrd, "lines follow"),
    "velocities.inpcrd": (inpcrd_with_velocities, "lines follow"),
    "config": (config, "lines follow"),
    "pdbqt": (pdbqt, "90 atoms follow"),
    "coor": (coor, "2164 bytes"),
    "cif": (cif, "this one has 2"),
}
#: Of others: two frames are as many atoms, or there is one frame by definition.
ALL_ATOMS = {"CRD", "PQR", "FHIAIMS", "IN"}
ONE_BY_DEFINITION = {"DATA", "DMS", "MMTF", "TPR", "OPENMMAPP", "OPENMMSIMULATION", "PARMED"}
#: Other names of formats above.
SAME = {"NAMDBIN", "RESTRT", "MMCIF", "CIF.GZ", "MMCIF.GZ"}


def test_every_format_of_structures_is_known():
    """A reader that MDAnalysis gets must find its place here, and in the check."""
    from MDAnalysis.coordinates.base import SingleFrameReaderBase

    known = {name.rpartition(".")[2].upper() for name in STRUCTURES} | ALL_ATOMS | ONE_BY_DEFINITION | SAME
    readers = {name: reader for name, reader in mda._READERS.items() if isinstance(reader, type)}
    found = {name for name, reader in readers.items() if issubclass(reader, SingleFrameReaderBase)}
    assert len(found) > 10 and found <= known


@pytest.mark.parametrize("name", STRUCTURES)
def test_what_lies_behind_the_only_frame_that_is_read(tmp_path, x, name):
    """The second frame is off by 0.3 Å: not looked at, it makes the check incomplete, unless it is not asked for."""
    write, words = STRUCTURES[name]
    one, other = files.whole(x)[:2]
    other[4] += 0.3
    path = tmp_path / f"w.{name}"
    frames = [write(one), write(other, 2) if name == "cif" else write(other)]
    data = [frame if isinstance(frame, bytes) else frame.encode() for frame in frames]
    path.write_bytes(data[0])
    assert checked(path).status == "kept"
    path.write_bytes(data[0] + data[1])
    result = checked(path)
    assert result.status == "incomplete" and result.broken.frame == 1
    assert "MDAnalysis reads one frame of" in result.verdict and words in result.verdict
    assert "ends too early" not in result.verdict and "write the frames as XTC, DCD or PDB" in result.gaps[0]
    assert checked(path, stop=1).status == "kept"


# -- chains -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ["dcd", "xtc", "xyz", "gro"])
@pytest.mark.parametrize("which", [0, 1])
def test_each_file_of_a_chain_has_an_end(tmp_path, x, ending, which):
    """A part that was cut off, or has more frames than are read, is not hidden by the next."""
    y = files.whole(x)
    paths = [tmp_path / f"{k}.{ending}" for k in range(2)]
    for path in paths:
        if ending == "gro":
            path.write_text(gro(y[0]))
        else:
            files.write(path, y, side=None)

    def whole_chain():
        with warnings.catch_warnings(action="ignore"):
            made = files.universe(N).load_new([str(path) for path in paths])
            return ConstraintCheck(made, Distance(files.pairs(N), files.targets(N))).run().check

    assert whole_chain().status == "kept"
    data = paths[which].read_bytes()
    paths[which].write_bytes(2 * data if ending == "gro" else data[:-20])
    result = whole_chain()
    assert result.status == "incomplete"
    assert result.broken.frame == {"gro": 1 + which}.get(ending, 7 + 8 * which)
    # The reader of XTC says so itself where it comes to the end.
    assert f"{which}.{ending}: " in result.broken.reason or ending == "xtc"


# -- numbers of atoms -------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ["xyz", "arc", "lammpsdump"])
@pytest.mark.parametrize("wrong", ["fewer", "more", "two frames more", "says fewer", "an empty line"])
def test_a_frame_with_another_number_of_atoms(tmp_path, x, ending, wrong):
    """The reader counts lines: atoms of one frame would be taken for those of the next."""
    path = files.write(tmp_path / f"w.{ending}", files.whole(x), side=None)
    lines = path.read_text().splitlines()
    size = len(lines) // 8
    at = 3 * size + (3 if ending == "lammpsdump" else 0)  # where the fourth frame says how many atoms it has
    first = 3 * size + size - 3 * N  # its first atom
    says, more = {"fewer": (89, -1), "more": (91, 1), "two frames more": (90 + 2 * size, 2 * size)}.get(wrong, (89, 0))
    if wrong == "an empty line":
        lines.insert(3 * size, "")
    else:
        lines[at] = lines[at].replace("90", str(says))
        lines[first : first + max(-more, 0)] = max(more, 0) * [lines[first]]
    path.write_text("\n".join(lines) + "\n")
    result = checked(path)
    assert result.status == "incomplete" and result.frames == [0, 1, 2] and result.broken.frame == 3
    assert "frame 3 cannot be used, nor what follows" in result.verdict or ending == "lammpsdump"
    assert "where its number of atoms has to be, 90" in result.verdict or ending == "lammpsdump"
    # Frames beyond, which may lie where the reader looks for them, are no better, however they are counted.
    assert checked(path, step=2).frames == [0, 2] and checked(path, frames=[1, -1]).frames == [1]
