"""Blocks of a DCD file against MDAnalysis' own reader, frame by frame."""

import struct
import warnings
from dataclasses import asdict

import numpy as np
import pytest
import water_files as files
from water_files import mda

from kcons.constraints import Distance
from kcons.mdanalysis import ConstraintCheck
from kcons.mdanalysis.check.files import plain_dcd as dcd
from kcons.mdanalysis.check.files.plain_dcd import plain_dcd

N = 25


def made(path):
    universe = files.universe(N)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        universe.load_new(str(path))
    return universe


def gathered(block):
    n = 3 * N
    values = block.words.view(np.float32)
    starts = [block.x + k * (n + 2) + 1 for k in range(3)]
    return np.stack([values[:, a : a + n] for a in starts], axis=2)


CELLS = {
    "none": None,
    "orthogonal": [[12.0 + 0.1 * k, 13.0, 14.0, 90, 90, 90] for k in range(7)],
    "the same": [[12.0, 13.0, 14.0, 90, 90, 90]] * 7,
    "triclinic": [[12.0 + 0.1 * k, 13.0, 14.0, 75.0, 80.0 + k, 65.0] for k in range(7)],
    "now and then": [[12.0, 12.0, 12.0, 90, 90, 90]] * 3 + [[0.0] * 6] * 2 + [[12.0, 12.0, 12.0, 60, 90, 90]] * 2,
}


@pytest.mark.parametrize("cells", CELLS)
@pytest.mark.parametrize("frames", [range(7), [2, 3, 6], [5, 4, 0, 1], [6]])
@pytest.mark.parametrize("size", [1, 3000, 1 << 20])
def test_positions_cells_and_times_are_those_of_the_reader(tmp_path, monkeypatch, cells, frames, size):
    monkeypatch.setattr(dcd, "BLOCK", size)
    path = tmp_path / "a.dcd"
    x = files.water(N, 7)
    blank = mda.Universe.empty(3 * N, trajectory=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with mda.Writer(str(path), 3 * N, dt=0.5, istart=3) as writer:
            for k, positions in enumerate(x):
                blank.atoms.positions = positions
                blank.dimensions = CELLS[cells] and CELLS[cells][k]
                writer.write(blank.atoms)
    reader = made(path).trajectory
    file = plain_dcd(reader)
    frames = np.array(frames)
    found = [(gathered(block).copy(), block.dimensions.copy()) for block in file.blocks(frames)]
    positions, dimensions = (np.concatenate(parts) for parts in zip(*found, strict=True))
    wanted = [(ts.positions.copy(), ts.dimensions, ts.time) for ts in reader[frames]]
    np.testing.assert_array_equal(positions, [w[0] for w in wanted])
    np.testing.assert_array_equal(dimensions, [np.zeros(6) if w[1] is None else w[1] for w in wanted])
    np.testing.assert_array_equal(file.times(frames), [w[2] for w in wanted])


def test_the_check_says_what_it_says_frame_by_frame(tmp_path, monkeypatch):
    path = files.write(tmp_path / "a.dcd", files.water(N, 40))
    # Rigid water and single rows, of which both have to be found the worst somewhere.
    rows = Distance(
        np.concatenate([files.pairs(N), [[0, 3], [3, 6], [6, 9]]]), np.concatenate([files.targets(N), [3.0, 3.0, 3.0]])
    )
    blocks = ConstraintCheck(made(path), rows).run().check
    monkeypatch.setattr("kcons.mdanalysis.check.files.plain_dcd", lambda reader: None)
    frames = ConstraintCheck(made(path), rows).run().check
    assert asdict(blocks) == asdict(frames)


@pytest.mark.parametrize("what", ["order", "fixed", "fourth", "transformed", "lammps", "cut"])
def test_files_that_are_not_plain_are_left_to_the_reader(tmp_path, what):
    path = files.write(tmp_path / "a.dcd", files.water(N, 3))
    universe = made(path)
    assert plain_dcd(universe.trajectory) is not None
    data = bytearray(path.read_bytes())
    if what == "order":
        data[:4] = struct.pack(">i", 84)
    elif what == "fixed":
        data[40:44] = struct.pack("=i", 4)
    elif what == "fourth":
        data[52:56] = struct.pack("=i", 1)
        data[84:88] = struct.pack("=i", 24)
    elif what == "cut":
        data = data[:200]
    elif what == "transformed":
        universe.trajectory.add_transformations(lambda ts: ts)
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            universe.load_new(str(path), format="LAMMPS", lengthunit="A", timeunit="fs")
    if what not in ("transformed", "lammps"):
        path.write_bytes(bytes(data))
    assert plain_dcd(universe.trajectory) is None


def test_files_without_cell_and_charmm_flags(tmp_path):
    """X-PLOR's kind: no flags, no unit cells, a step of eight bytes."""
    x = files.water(N, 4).astype(np.float32)
    head = bytearray(80)
    head[0:4], head[4:8], head[12:16] = struct.pack("=i", 4), struct.pack("=i", 1), struct.pack("=i", 0)
    head[36:44] = struct.pack("=d", 2.0)
    head[8:12] = struct.pack("=i", 1)

    def record(content):
        return struct.pack("=i", len(content)) + content + struct.pack("=i", len(content))

    data = record(b"CORD" + bytes(head)) + record(struct.pack("=i", 1) + b" " * 80) + record(struct.pack("=i", 3 * N))
    for frame in x:
        data += b"".join(record(np.ascontiguousarray(frame[:, axis]).tobytes()) for axis in range(3))
    path = tmp_path / "plain.dcd"
    path.write_bytes(data)
    reader = made(path).trajectory
    file = plain_dcd(reader)
    blocks = list(file.blocks(np.arange(4)))
    np.testing.assert_array_equal(np.concatenate([gathered(block) for block in blocks]), x)
    assert not any(block.dimensions.any() for block in blocks)
    np.testing.assert_array_equal(file.times(np.arange(4)), [ts.time for ts in reader])
