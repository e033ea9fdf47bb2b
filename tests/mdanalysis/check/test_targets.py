"""Targets from a file."""

import pytest
import water_files as files

from kcons.errors import InputError
from kcons.mdanalysis import check_trajectory
from kcons.mdanalysis.check.targets import TargetFile

N = 30


@pytest.fixture(scope="module")
def x():
    return files.water(N, 8)


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
        (f"[[length]]\nelements=['O','H']\nvalue=1{'0' * 400}", "positive length"),
        (f"a={'[' * 5000}{']' * 5000}", "no readable TOML"),
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
