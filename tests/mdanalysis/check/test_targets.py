"""Checks of files by their names: targets from a frame, the topology or a parameter file; what atoms are called."""

import numpy as np
import pytest
import water_files as files
from water_files import mda

from kcons.constraints import Distance
from kcons.errors import InputError, UnreadableError
from kcons.mdanalysis import ConstraintCheck, check_trajectory
from kcons.mdanalysis.check.targets import read_targets

N = 30


@pytest.fixture(scope="module")
def x():
    return files.water(N, 8)


@pytest.fixture
def run(tmp_path, x):
    """A trajectory and its topology."""
    return files.write(tmp_path / "w.xtc", x), files.topology(tmp_path / "t.gro", N, x[0])


def test_check_from_files(run):
    for targets in ("first", "mean", "topology"):
        result = check_trajectory(*run, "none", targets=targets)
        assert result.n_rows == result.rank == 3 * N and result.status == "kept", result.verdict
    assert check_trajectory(*run, "none", frames="2:7:2", workers=2, rank=False).frames == [2, 4, 6]
    for options, match in (
        ({"frames": "a:b"}, "frames are"),
        ({"frames": "3"}, "frames are"),
        ({"frames": 3}, "frames are 3; give them as A:B"),
        ({"frames": "1:5:0"}, "frames are"),
        ({"workers": 0}, "workers is 0"),
        ({"select": "resname NOPE"}, r"(?i)matches no|no atoms"),
        ({"constrain": "hbond"}, r"(?i)hbond"),
    ):
        with pytest.raises(InputError, match=match):
            check_trajectory(*run, **{"constrain": "none", **options})


def test_targets_of_the_topology_need_coordinates(run, tmp_path):
    lines = ["PSF", "", "       1 !NTITLE", " REMARKS none", "", f"{3 * N:8d} !NATOM"]
    for a in range(3 * N):
        name, mass = (("OW", 15.999), ("HW1", 1.008), ("HW2", 1.008))[a % 3]
        lines.append(f"{a + 1:8d} W    {a // 3 + 1:<4d} SOL  {name:<4s} {name:<4s} {0.0:10.6f} {mass:13.4f} {0:11d}")
    (tmp_path / "t.psf").write_text("\n".join([*lines, "", "       0 !NBOND: bonds", "", ""]))
    with pytest.raises(InputError, match=r"t\.psf has no coordinates.*--targets first"):
        check_trajectory(run[0], tmp_path / "t.psf", "none", targets="topology")


def test_bonds_are_looked_for_in_the_first_frame_that_is_looked_at(tmp_path, x):
    y = x.copy()
    y[0, 4] = np.nan
    path, top = files.write(tmp_path / "w.dcd", y), files.topology(tmp_path / "t.pdb", N, x[0])
    with pytest.raises(UnreadableError, match=r"in frame 0, the first to be looked at; begin at a later one"):
        check_trajectory(path, top)
    assert check_trajectory(path, top, frames="1:").status == "kept"


@pytest.mark.parametrize(
    ("name", "said", "options"),
    [
        ("w.dcd", None, {}),
        ("w.xyz", "frames are taken to be 1 ps apart", {}),
        ("w.lammpsdump", "steps are taken to be 1 ps", {}),
        ("w.dcd", "DCD says frames are 1 ps apart", {"dt": 1.0}),  # the default of MDAnalysis, 1 AKMA that of VMD
        ("w.dcd", "DCD says frames are 0.0489 ps apart", {"dt": 0.04888821}),
        ("w.dcd", None, {"dt": 1.0, "nsavc": 500}),
    ],
)
@pytest.mark.filterwarnings("ignore:DCDReader currently")
def test_times_that_files_do_not_have_are_said(tmp_path, x, name, said, options):
    """A drift a ns means nothing without them."""
    path = files.write(tmp_path / name, files.whole(x)[:3], **options)
    remarks = files.checked(path, N).remarks
    assert [said in remark for remark in remarks] == [True] if said else remarks == []
    made = files.loaded(path, N)
    made.load_new(str(path), dt=0.5)
    assert ConstraintCheck(made, Distance(files.pairs(N))).run().check.remarks == []


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


def test_targets_from_a_file(run, tmp_path):
    parameters = tmp_path / "p.toml"
    parameters.write_text(GOOD)
    result = check_trajectory(*run, "none", targets=parameters, worst=3 * N)
    assert result.status == "kept" and str(parameters) == result.targets
    assert sorted({round(float(row.target), 6) for row in result.worst}) == [files.OH, round(float(files.HH), 6)]
    parameters.write_text(GOOD.replace(str(files.OH / 10), str(files.OH / 10 + 1e-2)))
    assert check_trajectory(*run, "none", targets=parameters).status == "violated"
    parameters.write_text("[[length]]\nelements=['O','H']\nvalue=0.9572\n")
    with pytest.raises(InputError, match=r"no length for SOL1:HW1–HW2 \(H-H; 30 rows in all\); add a"):
        check_trajectory(*run, "none", targets=parameters)


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
        (f"[[length]]\nelements=['O','H']\nvalue=1{'0' * 400}", "positive length"),
        (f"a={'[' * 5000}{']' * 5000}", "no readable TOML"),
    ],
)
def test_parameter_files_that_are_wrong(tmp_path, text, match):
    path = tmp_path / "p.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=match) as caught:
        read_targets(path)
    assert "p.toml" in str(caught.value)


# -- names ------------------------------------------------------------------------------------------


HEAVY = [12.011, 35.45, 28.085, 79.904, 12.011, 15.999, 1.008]


def seven(**attributes):
    made = mda.Universe.empty(7, n_residues=2, atom_resindex=[0, 0, 0, 1, 1, 1, 1], trajectory=True)
    for name, values in attributes.items():
        made.add_TopologyAttr(name, values)
    made.atoms.positions = np.random.default_rng(0).normal(size=(7, 3))
    return made


@pytest.mark.parametrize("named", [True, False])
def test_names_of_rows(named):
    given = {"names": ["OW", "HW1", "HW2", "CA", "1HB", "'X", ""], "resnames": ["SOL", "ALA"], "resids": [12, 3]}
    pairs = [[0, 1], [2, 3], [3, 4], [6, 5]]
    found = ConstraintCheck(seven(**given if named else {}), Distance(pairs)).run().check.worst
    names = ["SOL12:OW–HW1", "SOL12:HW2–ALA3:CA", "ALA3:CA–1HB", "atom 6–ALA3:'X"]
    wanted = names if named else [f"atom {i}–atom {j}" for i, j in pairs]
    assert [row.name for row in sorted(found, key=lambda row: row.row)] == [f"Distance {name}" for name in wanted]


@pytest.mark.parametrize(
    ("given", "elements"),
    [
        ({"names": ["OW", "HW1", "HW2", "CA", "1HB", "N", "C"]}, "O H H C H N C"),
        ({"names": ["CA"] * 7, "elements": ["Ca", "", *"CCCCC"]}, "Ca C C C C C C"),
        # As everywhere: a rule for C-C is none for C-Cl.
        ({"names": ["C1", "CL1", "7", "BR", "CA", "OW", "HW1"], "masses": HEAVY}, "C Cl Si Br C O H"),
    ],
)
def test_rules_by_element_fit_what_names_and_masses_tell(tmp_path, given, elements):
    path, elements = tmp_path / "p.toml", elements.split()
    rules = [f"[[length]]\nelements=['{elements[k]}', '{elements[k + 1]}']\nvalue={k + 1}\n" for k in range(6)]
    path.write_text("".join(rules))
    rows = Distance([[k, k + 1] for k in range(6)])
    found = ConstraintCheck(seven(**given), rows, targets=path, rank=False).run().check.worst
    first = {frozenset(elements[k : k + 2]): k + 1 for k in reversed(range(6))}
    assert {row.row: row.target for row in found} == {k: first[frozenset(elements[k : k + 2])] for k in range(6)}
