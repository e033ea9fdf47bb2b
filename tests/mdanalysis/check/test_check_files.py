"""Checks of files, by their names."""

import numpy as np
import pytest
import water_files as files

from kcons.errors import InputError, UnreadableError
from kcons.mdanalysis import check_trajectory

N = 30


@pytest.fixture(scope="module")
def x():
    return files.water(N, 8)


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


def test_bonds_are_looked_for_in_the_first_frame_that_is_looked_at(tmp_path, x):
    y = x.copy()
    y[0, 4] = np.nan
    path, top = files.write(tmp_path / "w.dcd", y), files.topology(tmp_path / "t.pdb", N, x[0])
    with pytest.raises(UnreadableError, match=r"in frame 0, the first to be looked at; begin at a later one"):
        check_trajectory(path, top)
    assert check_trajectory(path, top, frames="1:").status == "kept"
