"""What a check says: temperatures, drifts, plain data, pictures and files, and what these do not overwrite."""

import json

import numpy as np
import pytest
import water_files as files
from ase import Atoms
from ase.md.velocitydistribution import Stationary, ZeroRotation
from MDAnalysis.lib.formats.libmdaxdr import TRRFile

from kcons.constraints import CenterOfMass, Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError
from kcons.mdanalysis import ConstraintCheck, to_ase
from kcons.mdanalysis.check import report
from kcons.mdanalysis.check.constraint_check import check_trajectory
from kcons.mdanalysis.check.result import fitted
from kcons.motion import Motion

N, SIDE = 40, 12.0


# -- temperatures -----------------------------------------------------------------------------------


def test_temperature_counts_the_right_degrees_of_freedom(tmp_path):
    """Velocities drawn for rigid water: the mean over many molecules is the temperature, by 6 a molecule."""
    n, frames = 300, 8
    x = files.water(n, frames, side=40.0, seed=5)
    masses = np.tile([15.999, 1.008, 1.008], n)
    rng = np.random.default_rng(6)
    v = np.zeros_like(x)
    for k in range(frames):
        held = ConstraintSet(Distance(files.pairs(n), files.targets(n)), x[k], masses, cell=[40.0] * 3)
        drawn = rng.normal(size=(3 * n, 3)) * np.sqrt(0.831446 * 300 / masses)[:, None]
        v[k] = Motion(held, x[k]).project_velocities(x[k], drawn)
        v[k] -= masses @ v[k] / masses.sum()
    path = files.write(tmp_path / "t.trr", x, side=40.0, velocities=v)
    result = files.checked(path, n)
    assert result.rank == 3 * n
    assert result.degrees_of_freedom == 6 * n - 3
    expected = np.einsum("i,kij->k", masses, v**2) / (0.831446261815324 * (6 * n - 3))
    np.testing.assert_allclose(result.series["temperature K"], expected, rtol=1e-6)
    assert result.temperature is not None
    assert abs(result.temperature["mean"] - 300) < 4 * 300 * np.sqrt(2 / (6 * n * frames))
    # Tangent velocities leave A v at what rounding makes of directions; radial ones do not.
    directions = 2 * np.spacing(np.float32(40.0)) / files.OH
    assert result.units[0].rate_largest is not None and result.units[0].rate_largest < 2 * np.abs(v).max() * directions
    v[2, 1] += 0.5
    path = files.write(tmp_path / "r.trr", x, side=40.0, velocities=v)
    moved = files.checked(path, n)
    assert moved.units[0].rate_largest is not None and moved.units[0].rate_largest > 0.1


def test_a_moving_center_of_mass_counts_and_without_masses_there_is_a_rank_but_no_temperature(tmp_path):
    x = files.water(N, 3)
    v = np.random.default_rng(1).normal(size=x.shape) + 3.0
    path = files.write(tmp_path / "m.trr", x, velocities=v)
    assert files.checked(path, N).degrees_of_freedom == 6 * N
    clusters = [Atoms("OHH" * N, r, velocities=u) for r, u in zip(x, v, strict=True)]
    for atoms in clusters:
        Stationary(atoms)
        ZeroRotation(atoms)
    v = np.array([atoms.get_velocities() for atoms in clusters])
    for side, less in ((None, 6), (12.0, 3)):  # free to turn, or in a cell
        files.write(path, x, side, v)
        assert files.checked(path, N).degrees_of_freedom == 6 * N - less
    result = files.checked(path, N, masses=False)
    assert result.rank == 3 * N and result.temperature is None
    assert any("no masses" in remark and "give a topology with masses" in remark for remark in result.remarks)
    with pytest.raises(InputError, match=r"CenterOfMass.*needs masses.*give a topology with masses"):
        files.checked(path, N, CenterOfMass([0, 1, 2]), masses=False)


def test_of_a_selection_there_is_no_temperature(tmp_path):
    """What holds the other atoms is not looked for: their motions would be counted with too many degrees of freedom."""
    x = files.water(N, 3)
    v = np.random.default_rng(1).normal(size=x.shape)
    files.topology(tmp_path / "t.gro", N, x[0])
    where = files.write(tmp_path / "t.trr", x, velocities=v), tmp_path / "t.gro"
    part, whole = check_trajectory(*where, select="resid 1:10"), check_trajectory(*where)
    assert (part.rank, part.degrees_of_freedom, part.temperature) == (30, None, None)
    assert "temperature K" not in part.series and "degrees of freedom" not in report.page(part)[0]
    said = "no temperature: what holds atoms outside of the selection was not looked for"
    assert said in part.remarks and said not in whole.remarks and whole.temperature is not None
    assert report.page(whole)[0].splitlines()[2].startswith(f"rank {3 * N}, {6 * N} degrees of freedom, ")


def test_masses_that_were_guessed_are_told_of_where_there_are_velocities(tmp_path):
    x = files.water(N, 3)
    for ending, warned in (("trr", True), ("dcd", False)):
        path = files.write(tmp_path / f"t.{ending}", x, velocities=np.ones_like(x) if warned else None)
        result = check_trajectory(path, files.topology(tmp_path / "t.gro", N, x[0]))
        assert any("masses are those of the elements" in remark for remark in result.remarks) == warned
    assert not any("masses" in remark for remark in files.checked(tmp_path / "t.trr", N).remarks)


def test_atoms_that_do_not_move_are_told_of(tmp_path):
    """Their degrees of freedom are counted. A run may begin at rest as a whole."""
    x = files.water(N, 3)
    v = np.random.default_rng(1).normal(size=x.shape)
    for still, said in ((30, True), (3 * N, False)):
        v[:, :still] = 0
        result = files.checked(files.write(tmp_path / "t.trr", x, velocities=v), N)
        words = "30 atoms have no velocity: if the run fixed them, the temperature is too low"
        assert (words in result.remarks) == any("velocity" in remark for remark in result.remarks) == said
    universe = files.loaded(tmp_path / "t.trr", N)
    universe.atoms[:2].masses = 0.4
    remarks = ConstraintCheck(universe, Distance(files.pairs(N)), targets="first").run().check.remarks
    assert any("2 atoms are lighter than hydrogen: if they are Drude" in remark for remark in remarks)


def test_velocities_of_later_frames_alone_have_a_temperature(tmp_path):
    x = files.water(N, 4)
    v = np.random.default_rng(1).normal(size=x.shape)
    with TRRFile(str(tmp_path / "t.trr"), "w") as file:
        for k in range(5):
            speeds, where = np.float32(v[k % 4] / 10) if k % 2 else None, np.float32(x[k] / 10) if k < 4 else None
            file.write(where, speeds, None, 1.2 * np.eye(3, dtype="f4"), k, float(k), 0.0, 3 * N)
    result = files.checked(tmp_path / "t.trr", N)
    kelvin = np.einsum("i,kij->k", np.tile([15.999, 1.008, 1.008], N), v**2) / (0.831446261815324 * 6 * N)
    assert result.degrees_of_freedom == 6 * N
    np.testing.assert_allclose(result.series["temperature K"], [np.nan, kelvin[1], np.nan, kelvin[3]], rtol=1e-6)
    assert result.gaps == ["frame 4 cannot be used, nor what follows: This Timestep has no positions"]


def test_velocities_without_a_unit_are_no_temperature(tmp_path):
    """Those of LAMMPS are in angstrom/fs, or in anything else: files do not say."""
    text = files.write_text(tmp_path / "w.lammpsdump", files.whole(files.water(N, 2))).read_text()
    lines = [f"{line} 0.01 0 0" if line[0].isdigit() and len(line.split()) == 5 else line for line in text.splitlines()]
    path = tmp_path / "v.lammpsdump"
    path.write_text("\n".join(lines).replace("type x y z", "type x y z vx vy vz") + "\n")
    universe = files.loaded(path, N)
    assert universe.trajectory.ts.has_velocities
    result = ConstraintCheck(universe, Distance(files.pairs(N), files.targets(N))).run().check
    assert result.status == "kept" and result.temperature is None and result.units[0].rate_largest is None
    assert "no temperature: velocities of LAMMPSDUMP files have no unit" in result.remarks
    with pytest.warns(UserWarning, match="velocities of LAMMPSDUMP files have no unit: they are left out"):
        assert not to_ase(universe).has("momenta")


# -- data -------------------------------------------------------------------------------------------


def test_a_slope_is_of_numbers_alone_and_needs_three():
    t = np.linspace(3.0, 11.0, 40)
    y = 0.25 * t + np.random.default_rng(2).normal(scale=0.1, size=40)
    y[[3, 7]] = np.nan, np.inf
    assert fitted(t, y).value == pytest.approx(0.25, abs=0.05)
    assert fitted(t[:2], y[:2]) is None and fitted(np.ones(6), np.arange(6.0)) is None


def test_results_are_plain_data(tmp_path):
    x = files.whole(files.water(5, 4))
    result = files.checked(files.write(tmp_path / "run.dcd", x), 5, rank=False)
    data = result.to_dict()
    assert json.loads(json.dumps(data)) == data
    assert data["n_rows"] == 15 and data["frames"] == [0, 1, 2, 3] and data["broken"] is None
    assert result.rank is None and result.degrees_of_freedom is None
    assert list(result.series) == ["largest Å", "rms Å", "rounding Å"] and result.n_frames_in_file == 4


# -- the picture ------------------------------------------------------------------------------------


def drawn(monkeypatch, result):
    """Lines of the first panel by label, and the panel."""
    from matplotlib.figure import Figure

    kept = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: kept.append(self))
    report.plot(result, None)
    axes = kept[0].axes[0]
    return {line.get_label(): np.asarray(line.get_ydata(), dtype=float) for line in axes.lines}, axes


def test_the_picture_shows_what_was_allowed(tmp_path, monkeypatch):
    """The frame that gives targets is off by nothing, which has no place on a logarithmic scale."""
    x = files.water(20, 5)
    x[3, 7] += 0.2
    path = files.write(tmp_path / "bad.xtc", x % SIDE)
    result = files.checked(path, 20, targets="first", tolerance=0.01, worst=999)
    shown, axes = drawn(monkeypatch, result)
    rounding = 4 * np.sqrt(3) * 0.005  # of a frame and of the targets
    np.testing.assert_allclose(shown["rounding of the file, at most"], rounding, rtol=1e-9)
    shortest = min(row.target for row in result.worst)
    np.testing.assert_allclose(shown["rounding and tolerance of 0.01"], rounding + 0.01 * shortest, rtol=1e-9)
    over = shown["largest"] > shown["rounding and tolerance of 0.01"]
    assert over.tolist() == [False, False, False, True, False]
    for label in ("largest", "rms"):
        assert np.isnan(shown[label][0]) and np.isfinite(shown[label][1:]).all()
    low, high = axes.get_ylim()
    assert axes.get_yscale() == "log" and 1e-5 < low < rounding < high and np.nanmax(shown["largest"]) < high
    exact = files.checked(path, 20, targets="first", tolerance=0.0)
    assert not any("tolerance" in label for label in drawn(monkeypatch, exact)[0])
