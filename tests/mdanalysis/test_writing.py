"""Files that runs write: read back by MDAnalysis alone, units, extras, runs that are killed."""

import os
import signal
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import ase.constraints
import ase.units
import h5py
import numpy as np
import openmm
import pytest
import water_files as files
from ase import Atoms
from ase.build import molecule
from ase.calculators.emt import EMT
from ase.calculators.tip3p import TIP3P
from ase.md.verlet import VelocityVerlet
from openmm import app, unit
from water_files import mda

from kcons.ase import ConstrainedDynamics, Constraints, constrain
from kcons.ase.binding import applied_forces
from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.mdanalysis import ASE_UNITS, ConstraintCheck, OpenMMReporter, TrajectoryWriter, to_openmm, write_ase
from kcons.motion import Motion
from kcons.steppers import System, run

N = 8
MASSES = np.tile([15.999, 1.008, 1.008], N)


def system():
    x = files.whole(files.water(N, 1))[0]
    motion = Motion(ConstraintSet(Distance(files.pairs(N), files.targets(N)), x, MASSES, cell=[12.0] * 3), x)

    def force(positions, time):
        return -20.0 * (positions - x) + 3.0

    made = System(motion, force)
    v = np.random.default_rng(2).normal(size=x.shape) * 5
    return made, made.initial_state(x, motion.project_velocities(x, v)), motion


@pytest.mark.parametrize("ending", ["dcd", "xtc", "trr", "nc", "scipy.nc", "h5md"])
def test_core_runs(tmp_path, ending, monkeypatch):
    if ending == "scipy.nc":  # written by SciPy where netCDF4 is not installed
        monkeypatch.setattr("MDAnalysis.coordinates.TRJ.netCDF4", None)
        ending = "nc"
    universe, states, _ = ran(tmp_path / f"r.{ending}", 50, 10, interval=0.02)
    assert universe.trajectory.n_frames == len(states) == 6
    accuracy = 6e-3 if ending == "xtc" else 2e-6
    for ts, s in zip(universe.trajectory, states, strict=True):
        np.testing.assert_allclose(ts.positions, s.positions, atol=accuracy)
        assert ts.time == pytest.approx(s.time, abs=1e-5)
        np.testing.assert_allclose(ts.dimensions, [12, 12, 12, 90, 90, 90], rtol=1e-6)
        assert ts.has_velocities == (ending in ("trr", "nc", "h5md"))
        if ts.has_velocities:
            np.testing.assert_allclose(ts.velocities, s.velocities, atol=1e-4)
    check = ConstraintCheck(universe, Distance(files.pairs(N), files.targets(N)), tolerance=0.0).run().check
    assert check.status == "kept", check.verdict


def test_a_state_goes_with_its_own_cell(tmp_path):
    """States that were kept were written with the last cell of the run."""
    _, state, motion = system()
    there = replace(state, barostat=1.1 * motion.lattice[0].ravel())
    with TrajectoryWriter(tmp_path / "run.xtc", 3 * N, motion=motion) as writer:
        writer(state)
        with pytest.raises(InputError, match="another cell than its System"):
            writer(there)
        motion.set_cell(there.cell)
        writer(there)
    with TrajectoryWriter(tmp_path / "alone.xtc", 3 * N) as writer:
        writer(there)
    for name, sides in (("run.xtc", [12.0, 13.2]), ("alone.xtc", [13.2])):
        found = [float(ts.dimensions[0]) for ts in files.loaded(tmp_path / name, N).trajectory]
        np.testing.assert_allclose(found, sides, rtol=1e-5)


def ran(path, steps, every=1, **options):
    """What a run writes, its states, and its motion."""
    made, state, motion = system()
    states = []
    with TrajectoryWriter(path, 3 * N, motion=motion, **options) as writer:
        run(made, state, 0.002, steps, observers=[writer, states.append], every=every)
    return files.loaded(path, N), states, motion


def test_observables_of_h5md(tmp_path):
    path = tmp_path / "r.h5md"
    universe, states, motion = ran(path, 10, 5, forces=True)
    last, s = universe.trajectory[-1], states[-1]
    expected = motion.multipliers(s.positions, s.velocities, s.forces, s.time)
    np.testing.assert_allclose(last.data["multipliers"], expected, rtol=1e-6, atol=1e-6)
    assert np.abs(expected).max() > 1.0
    assert np.abs(last.data["residuals"]).max() < 1e-12
    with h5py.File(path) as file:
        assert file["observables/multipliers"].attrs["run_units"] == "Å, ps, kJ/mol"


@pytest.mark.parametrize("ending", ["trr", "h5md", "nc"])
def test_forces_that_a_state_does_not_know_are_not_zero(ending, tmp_path):
    universe, states, _ = ran(tmp_path / f"f.{ending}", 2, forces=True)
    frames = [ts.forces.copy() for ts in universe.trajectory]
    assert states[0].forces is None
    assert np.isnan(frames[0]).all()
    np.testing.assert_allclose(frames[-1], states[-1].forces, rtol=1e-5, atol=1e-4)


KILLED = """
import os, sys
sys.path[:0] = {paths!r}
import test_writing as t
from kcons.steppers import run
made, state, motion = t.system()
options = dict(motion=motion, interval=0.002)
writers = [t.TrajectoryWriter("{folder}/k" + e + "." + e, 3 * t.N, **options) for e in {endings!r}]
run(made, state, 0.002, 4, observers=writers)
print("written", flush=True)
os.kill(os.getpid(), 9)
"""


def test_a_run_that_is_killed_keeps_its_frames(tmp_path):
    """All formats in one process: those that buffer differently."""
    endings = ["dcd", "xtc", "trr", "nc", "h5md"]
    paths = [os.path.dirname(__file__), str(Path(__file__).parents[1] / "systems")]
    code = KILLED.format(paths=paths, folder=tmp_path, endings=endings)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "written" in done.stdout and done.returncode == -signal.SIGKILL, done.stderr
    for ending in endings:
        check = files.checked(tmp_path / f"k{ending}.{ending}", N, tolerance=0.0, rank=False)
        assert check.status == "kept" and check.broken is None and len(check.frames) == 5, (ending, check.broken)


def test_ase_dynamics(tmp_path):
    x = files.whole(files.water(2, 1, side=12.0, seed=3))[0]
    rows = Distance(files.pairs(2), files.targets(2))
    for ours in (True, False):
        atoms = ase.Atoms("OHHOHH", positions=x, cell=[12.0] * 3, pbc=True)
        # Forces of ASE's constraints count among those that are applied.
        atoms.set_constraint([Constraints(rows), ase.constraints.Hookean(0, 3, k=5.0, rt=1.0)])
        atoms.calc = TIP3P(rc=4.5)
        dynamics = (ConstrainedDynamics if ours else VelocityVerlet)(atoms, 1.0 * ase.units.fs)
        path = tmp_path / f"a{ours}.h5md"
        with write_ase(dynamics, path, interval=4, forces=True) as writer:
            dynamics.run(8)
        assert writer.n_frames == 3 and writer.motion is not None
        last = files.loaded(path, 2).trajectory[-1]
        assert last.time == pytest.approx(8e-3, rel=1e-5)
        np.testing.assert_allclose(last.positions, atoms.positions, atol=1e-5)
        np.testing.assert_allclose(last.velocities, atoms.get_velocities() * 1000 * ase.units.fs, rtol=1e-5, atol=1e-6)
        applied, per_mole = applied_forces(atoms), ase.units.kJ / ase.units.mol
        assert np.abs(applied - atoms.get_forces(apply_constraint=False)).max() > 1.0
        np.testing.assert_allclose(last.forces, applied / per_mole, rtol=1e-5, atol=1e-4)
        motion = atoms.constraints[0].engine(atoms)
        expected = motion.multipliers(atoms.positions, atoms.get_velocities(), applied, dynamics.get_time())
        np.testing.assert_allclose(last.data["multipliers"], expected, rtol=1e-6)
    assert pytest.approx(1 / (1000 * ase.units.fs), rel=1e-8) == ASE_UNITS.time


def test_openmm_simulations(tmp_path):
    universe = files.universe(2)
    universe.atoms.positions = files.whole(files.water(2, 1, seed=3))[0]
    held = to_openmm(universe, [Distance(files.pairs(2), files.targets(2))])
    x = universe.atoms.positions.astype(float) / 10
    integrator = openmm.VerletIntegrator(0.001)
    integrator.setConstraintTolerance(1e-8)
    simulation = app.Simulation(held.topology, held.system, integrator, openmm.Platform.getPlatformByName("Reference"))
    simulation.context.setPositions(x)
    simulation.context.setVelocitiesToTemperature(300, 1)
    motion = Motion(ConstraintSet(Distance(files.pairs(2), files.targets(2) / 10), x, MASSES[:6]), x)
    path = tmp_path / "o.h5md"
    reporter = OpenMMReporter(path, 5, motion=motion)
    simulation.reporters.append(reporter)
    simulation.step(20)
    reporter.close()
    made = files.loaded(path, 2)
    assert [round(ts.time, 6) for ts in made.trajectory] == [0.005, 0.01, 0.015, 0.02]
    state = simulation.context.getState(positions=True, velocities=True)
    last = made.trajectory[-1]
    np.testing.assert_allclose(last.positions / 10, state.getPositions(asNumpy=True)._value, atol=1e-6)
    speeds = state.getVelocities(asNumpy=True).value_in_unit(unit.angstrom / unit.picosecond)
    np.testing.assert_allclose(last.velocities, speeds, rtol=1e-5, atol=1e-5)
    assert np.abs(last.data["residuals"]).max() < 1e-8


@pytest.mark.parametrize("ending", ["xtc", "h5md"])
def test_a_file_has_one_writer(tmp_path, ending):
    path = tmp_path / f"run.{ending}"
    with TrajectoryWriter(path, 3) as writer:
        with pytest.raises(InputError, match="open in another TrajectoryWriter"):
            TrajectoryWriter(tmp_path / "." / path.name, 3)
        if ending == "h5md":
            with pytest.raises(InputError, match=r"has velocities, and none are given.*velocities=False"):
                writer.write(np.zeros((3, 3)))
            assert writer.n_frames == 0
        writer.write(np.zeros((3, 3)), np.zeros((3, 3)))
    with TrajectoryWriter(path, 3, velocities=False) as again:
        again.write(np.ones((3, 3)))


def test_bad_input(tmp_path):
    x = np.zeros((3 * N, 3))
    for path, match in ((tmp_path / "r.psf", r"r\.psf.*use \.dcd"), (tmp_path / "no" / "r.dcd", "no folder")):
        with pytest.raises(InputError, match=match):
            TrajectoryWriter(path, 3 * N)
    with pytest.raises(InputError, match="interval") as caught:
        TrajectoryWriter(tmp_path / "r.trr", 3 * N, interval=np.nan)
    assert caught.value.item == "interval" and not list(tmp_path.iterdir())
    with pytest.raises(UnsupportedError, match="XTC has no velocities; write TRR"):
        TrajectoryWriter(tmp_path / "r.xtc", 3 * N, velocities=True)
    with pytest.raises(InputError, match=r"r\.dcd has no times but the interval; give interval="):
        TrajectoryWriter(tmp_path / "r.dcd", 3 * N)
    writer = TrajectoryWriter(tmp_path / "r.dcd", 3 * N, interval=0.002)
    with pytest.raises(InputError, match="positions must have shape"):
        writer.write(x[:-1])
    bad = x.copy()
    bad[4, 2] = np.inf
    with pytest.raises(NonFiniteError, match=r"positions of atom 4.*nothing was written"):
        writer.write(bad)
    with warnings.catch_warnings(action="ignore"):
        writer.write(x)
    assert writer.n_frames == 1
    writer.close()
    writer.close()
    with pytest.raises(InputError, match="is closed"):
        writer.write(x)


@pytest.mark.parametrize("ours", [True, False])
def test_constraints_that_change_in_a_run(tmp_path, ours):
    atoms = molecule("CH3CH2OH")
    atoms.calc = EMT()
    constrain(atoms, Distance([[0, 1]]))
    dynamics = (ConstrainedDynamics if ours else VelocityVerlet)(atoms, 0.1)
    with write_ase(dynamics, tmp_path / "a.h5md") as writer:
        dynamics.run(1)
        # The same row at another length: the file goes on, with residuals from the new one.
        atoms.set_constraint()
        constrain(atoms, Distance([[0, 1]], [1.6]), project=True)
        dynamics.run(1)
        assert abs(atoms.get_distance(0, 1) - 1.6) < 1e-10
        # Another row is no longer what the columns say.
        written = writer.n_frames
        atoms.set_constraint()
        constrain(atoms, Distance([[1, 2]]))
        with pytest.raises(InputError, match=r"no longer those that a\.h5md was begun with; write a new file"):
            dynamics.run(1)
        assert writer.n_frames == written
        atoms.set_constraint()
        with pytest.raises(InputError, match="no longer those"):
            dynamics.run(1)
    with h5py.File(tmp_path / "a.h5md") as file:
        residuals = file["observables/residuals/value"][:]
    assert len(residuals) == written and np.abs(residuals).max() < 1e-10


def test_cells_that_boxes_of_mdanalysis_are_not(tmp_path):
    x = [[0.0, 0.0, 0.0], [1.1, 0.0, 0.0]]
    turned = Atoms("N2", x, cell=[[9, 3, 0], [-1, 9, 0], [0, 0, 9]], pbc=True, calculator=EMT())
    constrain(turned, Distance([[0, 1]]))
    with pytest.raises(InputError, match=r"MDAnalysis wants the first cell vector along x.*standard_form\(\)"):
        write_ase(ConstrainedDynamics(turned, 0.1), tmp_path / "a.trr")
    assert not list(tmp_path.iterdir())
    with TrajectoryWriter(tmp_path / "b.trr", 2, velocities=False) as writer:
        for cell, kind, what in (
            (turned.cell.array, InputError, "standard_form"),
            (np.diag([9.0, np.nan, 9.0]), NonFiniteError, "not finite"),
            (np.diag([9.0, 9.0, 0.0]), InputError, "no volume"),
            ([9.0, 9.0, 9.0, 90.0, 90.0, 90.0], InputError, "three vectors"),
        ):
            with pytest.raises(kind, match=what) as caught:
                writer.write(turned.positions, cell=cell)
            assert caught.value.item == "cell" and writer.n_frames == 0
    slab = Atoms("N2", x, cell=[[9, 0, 0], [3, 9, 0], [0, 0, 9]], pbc=[True, True, False], calculator=EMT())
    dynamics = ConstrainedDynamics(slab, 0.1)
    with pytest.warns(UserWarning, match="periodic in all directions; this cell is not"):
        writer = write_ase(dynamics, tmp_path / "c.trr")
    with writer:
        dynamics.run(1)
    box = mda.Universe.empty(2, trajectory=True).load_new(str(tmp_path / "c.trr")).trajectory[-1].triclinic_dimensions
    np.testing.assert_allclose(box, slab.cell.array, atol=1e-5)


@pytest.mark.parametrize("away", [3e7, -3e7])
def test_what_a_file_cannot_hold_is_not_written(tmp_path, away):
    """XTC counts 2^31 steps; the library that packs them writes something else beyond, and goes on."""
    x = np.linspace(0.0, 12.0, 30).reshape(10, 3)
    with TrajectoryWriter(tmp_path / "a.xtc", 10) as writer:
        writer.write(x)
        for far in (x + away, np.where(np.arange(10)[:, None] < 5, x + 0.5 * away, x - 0.5 * away)):
            with pytest.raises(InputError, match=r"cannot hold coordinates up to .* nothing was written"):
                writer.write(far)
        writer.write(x + 150.0)
    universe = mda.Universe.empty(10, trajectory=True).load_new(str(tmp_path / "a.xtc"))
    assert len(universe.trajectory) == 2
    np.testing.assert_allclose(universe.trajectory[1].positions, x + 150.0, atol=0.006)
    with TrajectoryWriter(tmp_path / "9.xtc", 9) as writer:
        writer.write(np.full((9, 3), 10 * away))  # so few atoms have no grid
    with (
        TrajectoryWriter(tmp_path / "b.trr", 10, velocities=False) as writer,
        pytest.raises(InputError, match="beyond single precision"),
    ):
        writer.write(x * 1e38)
    # Of wide frames: beyond 2^23 steps it depends on the distances of neighbors whether the packing is right.
    x = np.random.default_rng(1).uniform(0, 60, size=(200, 3))
    with TrajectoryWriter(tmp_path / "c.xtc", 200, precision=7) as writer:
        with pytest.raises(InputError, match="in steps of 1e-06: nothing was written; give a smaller precision"):
            writer.write(x)
        writer.write(x / 100)
    universe = mda.Universe.empty(200, trajectory=True).load_new(str(tmp_path / "c.xtc"))
    np.testing.assert_allclose(universe.atoms.positions, x / 100, atol=2e-6)
