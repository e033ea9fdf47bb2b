"""Files that cannot be opened, or are not of the same atoms."""

import gzip
import tomllib
from pathlib import Path

import pytest
import water_files as files

from kcons.errors import InputError, UnreadableError
from kcons.mdanalysis import check_trajectory, load_trajectory, open_universe

N = 30
WATER = (("OW", 15.999), ("HW1", 1.008), ("HW2", 1.008))


@pytest.fixture(scope="module")
def x():
    return files.water(N, 8)


def checked(path):
    return files.checked(path, N)


@pytest.mark.parametrize("ending", ["dcd", "xtc", "trr", "nc"])
def test_files_that_cannot_be_opened(tmp_path, ending):
    made = files.universe(N)
    path = tmp_path / f"a.{ending}"
    with pytest.raises(InputError, match=rf"there is no file .*a\.{ending}"):
        load_trajectory(made, path)
    for data, said in (
        (b"", " is empty"),
        (b"\x07nothing that anyone knows" * 50, ".*cannot read .*(complete|cut off)"),
    ):
        path.write_bytes(data)
        with pytest.raises(UnreadableError, match=rf"a\.{ending}{said}"):
            load_trajectory(made, path)
    path = tmp_path / "b.traj"  # of ASE, which is told from broken ones
    path.write_bytes(b"- of UlmASE-Trajectory" * 50)
    with pytest.raises(
        InputError, match=r"ASE's own format: .*write_ase, or .* run\.traj run\.pdb \(run\.xyz .* no cell"
    ):
        load_trajectory(made, path)


def test_a_cell_in_an_xyz_file_is_not_read_which_is_said(tmp_path):
    (path := tmp_path / "a.xyz").write_text('1\nLattice="9 0 0 0 9 0 0 0 9" pbc="T T T"\nO 0 0 0\n')
    for trajectory in (None, path):
        with pytest.warns(UserWarning, match=r"a\.xyz: its cell is not read"):
            open_universe(path, trajectory)


@pytest.mark.parametrize(
    "ending,error,package",
    [
        ("cif", ImportError("MMCIF: please install gemmi"), "gemmi"),
        ("h5md", RuntimeError("Please install h5py"), "h5py"),
        ("gsd", ImportError("To read GSD files, please install gsd"), "gsd"),
        ("h5md", ImportError("try installing it with 'pip install chemfiles'"), "chemfiles"),
    ],
)
def test_a_format_whose_package_is_missing(tmp_path, monkeypatch, ending, error, package):
    """The file is not to blame, however it begins; the message says what to install."""

    def missing(*args, **options):
        raise error

    path = tmp_path / f"a.{ending}"
    path.write_bytes(b"\x89HDF\r\n" + bytes(2000))
    made = files.universe(N)
    monkeypatch.setattr(made, "load_new", missing)
    with pytest.raises(InputError, match=rf"a\.{ending}.*; python -m pip install {package}, or give") as found:
        load_trajectory(made, path)
    assert not isinstance(found.value, UnreadableError) and "cut off" not in str(found.value)
    monkeypatch.setattr("MDAnalysis.Universe", missing)
    with pytest.raises(InputError, match=rf"a\.{ending}.*; python -m pip install {package}, or give"):
        open_universe(path)


def test_the_extra_brings_h5py():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert any(name.startswith("h5py") for name in project["optional-dependencies"]["mdanalysis"])


# -- formats ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["run.lammpstrj", "run.dump", "run.lammpstrj.gz", "run.LAMMPSTRJ"])
def test_endings_of_lammps(tmp_path, x, name):
    text = files.write_text(tmp_path / "w.lammpsdump", files.whole(x)).read_bytes()
    (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith("gz") else text)
    result = checked(tmp_path / name)
    assert result.status == "kept" and len(result.frames) == 8 and "LAMMPSDUMP" in result.precision


@pytest.mark.parametrize("name", ["w.rst7", "w.rst", "inpcrd", "w.crd7"])
def test_restarts_of_amber(tmp_path, x, name):
    """In text; those in NetCDF MDAnalysis does not read, which is said."""
    path = tmp_path / name
    path.write_text(files.inpcrd(files.whole(x)[0]))
    if name == "w.crd7":
        with pytest.raises(InputError, match=r"w\.crd7: its name tells no format of a trajectory .*--format NAME") as e:
            checked(path)
        assert e.value.item == "format" and "INPCRD" in str(e.value)
        load_trajectory(files.universe(N), path, format="inpcrd")
        with pytest.raises(InputError, match=r"no format 'INPCRT' \(did you mean 'INPCRD'\?\); there are .*XTC"):
            load_trajectory(files.universe(N), path, format="INPCRT")
        return
    assert checked(path).status == "kept"
    path.write_bytes(b"CDF\x02" + bytes(500))
    if name != "inpcrd":
        with pytest.raises(InputError, match="cannot read this trajectory"):
            checked(path)


def test_topologies_of_gromacs_and_amber_have_one_ending(tmp_path):
    atoms = "".join(f"{k + 1} {name} 1 SOL {name} 1 0.0 {mass}\n" for k, (name, mass) in enumerate(WATER))
    molecule = f"[ moleculetype ]\nSOL 2\n[ atoms ]\n{atoms}[ bonds ]\n1 2 1\n1 3 1\n"
    path = tmp_path / "w.top"
    with pytest.raises(InputError, match=r"there is no file .*w\.top"):
        open_universe(path)
    path.write_text(f"; water\n{molecule}[ system ]\nwater\n[ molecules ]\nSOL {N}\n")
    made = open_universe(path)
    assert len(made.atoms) == 3 * N and len(made.bonds) == 2 * N
    for text, said in (
        ('#include "amber03.ff/forcefield.itp"', r"w\.top.*Could not find amber03\.ff/forcefield\.itp"),
        ("%VERSION  VERSION_STAMP = V0001.000\n%FLAG TITLE", r"w\.top: MDAnalysis cannot read this topology"),
    ):
        path.write_text(f"{text}\n")
        with pytest.raises(InputError, match=said) as error:
            open_universe(path)
    assert "ITP" not in str(error.value)


def test_a_format_of_the_topology_can_be_named_and_a_trajectory_is_none(tmp_path, x):
    path = files.topology(tmp_path / "w.gro", N, x[0]).rename(tmp_path / "confout")
    with pytest.raises(InputError, match=r"confout: its name tells no format of a topology .*--topology-format") as e:
        open_universe(path)
    assert e.value.item == "topology_format"
    trajectory = files.write(tmp_path / "w.trr", x)
    with pytest.raises(InputError, match=r"w\.trr says nothing of its atoms, .* takes the trajectory first"):
        check_trajectory(path, trajectory)
    assert check_trajectory(trajectory, path, "none", topology_format="GRO", rank=False).status == "kept"
    found = check_trajectory(path, path, "none", format="GRO", topology_format="gro", targets="topology", rank=False)
    assert found.status == "kept"


@pytest.mark.parametrize("ending", ["dcd", "xtc", "trr", "nc"])
def test_atom_counts_that_differ(tmp_path, x, ending):
    path = files.write(tmp_path / f"w.{ending}", x)
    top = files.topology(tmp_path / "t.pdb", N - 1, x[0, :-3])
    with pytest.raises(InputError, match=rf"w\.{ending} has 90 atoms, .*t\.pdb has 87; give the topology of the atoms"):
        open_universe(top, path)
    if ending == "nc":
        path.write_bytes(path.read_bytes()[:-900])
        with pytest.raises(UnreadableError, match=r"w\.nc.*cut off"):
            files.loaded(path, N)


# -- headers that are not so ------------------------------------------------------------------------


@pytest.mark.parametrize("n", [99_999_999_999, -5])
def test_numbers_of_atoms_that_cannot_be(tmp_path, x, n):
    """As topology and as trajectory: one sentence, and not the error of whoever wanted the memory."""
    top = files.topology(tmp_path / "t.gro", N, x[0])
    lines = top.read_text().splitlines()
    lines[1] = str(n)
    path = tmp_path / "w.gro"
    path.write_text("\n".join(lines))
    for run in (lambda: open_universe(path), lambda: open_universe(top, path)):
        with pytest.raises(InputError, match=r"w\.gro"):
            run()
    # A reader that takes the number from the topology. Data of LAMMPS: the header says 90 atoms, there is one.
    path = tmp_path / "w.data"
    box = "".join(f"0 12 {a}lo {a}hi\n" for a in "xyz")
    path.write_text(f"x\n\n90 atoms\n1 atom types\n\n{box}\nMasses\n\n1 16\n\nAtoms # full\n\n1 1 1 0 1 1 1\n")
    with pytest.raises(InputError, match=r"w\.data has 1 atoms, .*t\.gro has 90"):
        open_universe(top, path)
