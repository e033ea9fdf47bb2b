"""Files that cannot be opened, or are not of the same atoms."""

import numpy as np
import pytest
import water_files as files

from kcons.constraints import Distance
from kcons.errors import InputError, UnreadableError
from kcons.mdanalysis import ConstraintCheck, check_trajectory, load_trajectory, open_universe

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


def test_files_of_ase_are_told_from_broken_ones(tmp_path):
    path = tmp_path / "run.traj"
    path.write_bytes(b"- of UlmASE-Trajectory" * 50)
    with pytest.raises(
        InputError, match=r"ASE's own format: .*write_ase, or .* run\.traj run\.pdb \(run\.xyz .* no cell"
    ):
        load_trajectory(files.universe(N), path)


def test_a_format_whose_package_is_missing(tmp_path, monkeypatch):
    """As mmCIF without gemmi."""

    def missing(*args, **options):
        raise ImportError("MMCIF: please install gemmi")

    path = tmp_path / "a.pdb"
    path.write_text("END\n")
    made = files.universe(N)
    monkeypatch.setattr(made, "load_new", missing)
    with pytest.raises(InputError, match=r"a\.pdb.*please install gemmi\); python -m pip install gemmi, or give"):
        load_trajectory(made, path)
    monkeypatch.setattr("MDAnalysis.Universe", missing)
    with pytest.raises(InputError, match=r"a\.pdb.*please install gemmi\); python -m pip install gemmi, or give"):
        open_universe(path)


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


def test_a_trajectory_is_no_topology(tmp_path, x):
    path, top = files.write(tmp_path / "w.dcd", x), files.topology(tmp_path / "t.pdb", N, x[0])
    with pytest.raises(InputError, match=r"w\.dcd says nothing of its atoms, .* takes the trajectory first"):
        check_trajectory(top, path)
    assert check_trajectory(path, top).n_atoms == 3 * N
