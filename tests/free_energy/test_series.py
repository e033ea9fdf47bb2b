"""Series and what records them in runs of the core."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import ConstraintSet, Motion, System, run
from kcons.constraints import Dihedral, Distance, MovingTarget
from kcons.errors import InputError
from kcons.free_energy import HeldCoordinates, Recorder, Sample, Series
from kcons.thermostats import CellSystem, ConstantPressure, Langevin, MonteCarloBarostat

X = np.array([[0.0, 0.1, 0.2], [1.1, 0.0, -0.1], [1.6, 1.2, 0.1], [2.7, 1.3, 0.9]])
M = np.array([1.0, 12.0, 14.0, 2.0])


def force(x, t):
    f = np.zeros_like(x)
    f[0], f[3] = (x[3] - x[0]), (x[0] - x[3])
    return f


def recorded(coordinates, others=(), dt=0.01, steps=8):
    """A series, and by how much the energy has become larger."""
    motion = Motion(ConstraintSet([*others, *coordinates.values()], X, M), X)
    system = System(motion, force, potential=lambda x, t: 0.5 * np.sum((x[3] - x[0]) ** 2))
    recorder = Recorder(system, HeldCoordinates(motion, coordinates, X))
    first = system.initial_state(X, np.zeros_like(X))
    last = run(system, first, dt, steps, observers=[recorder])
    return recorder.series, system.total_energy(last) - system.total_energy(first)


def test_states_of_a_barostat_are_measured_in_their_own_cell():
    """Also those that were kept: across a face the distance was off by what the cell had changed since."""
    x = np.array([[1.0, 5, 5], [9.0, 5, 5], [5.0, 5, 5]])
    held = {"gap": Distance([[0, 1]])}
    motion = Motion(ConstraintSet([*held.values()], x, np.ones(3), cell=[10.0] * 3), x)
    system = CellSystem(motion)
    recorder = Recorder(system, HeldCoordinates(motion, held, x))
    stepper = ConstantPressure(Langevin(1.0, 1.0, rng=1), MonteCarloBarostat(0.01, every=1, width=0.2))
    kept = run(system, system.initial_state(x), 0.01, 9, stepper=stepper, record=3)
    assert len({frame.cell[0, 0] for frame in kept.frames}) > 1
    for frame in kept.frames:
        recorder(frame)
    np.testing.assert_allclose(recorder.series.value, 2.0, atol=1e-12)


@pytest.mark.parametrize("coordinate", ["length", "torsion"])
def test_work_is_the_energy_that_moving_targets_add(coordinate):
    """To second order in the interval; energies of the run itself are of the same order."""
    if coordinate == "length":
        start = float(np.linalg.norm(X[0] - X[3]))
        held, others = Distance([[0, 3]], MovingTarget(lambda t: start + 0.8 * t * t)), [Distance([[0, 1]])]
    else:
        # Through pi, where the dihedral jumps.
        others = [Distance([[0, 1], [1, 2], [2, 3]])]
        start = float(ConstraintSet([Dihedral([[0, 1, 2, 3]])], X, M).measure(X)[0])
        held = Dihedral([[0, 1, 2, 3]], MovingTarget(lambda t: start + 2.0 * t * t))
    off = []
    for dt in (0.04, 0.02, 0.01):
        series, added = recorded({"q": held}, others, dt, round(1.2 / dt))
        off.append(abs(series.work[-1] - added))
    assert off[0] < 0.1 and series.work[-1] > 0.5
    slopes = np.log2(np.array(off[:-1]) / off[1:])
    assert np.all((slopes > 1.8) & (slopes < 2.2))


def test_files_have_all_of_it(tmp_path):
    series = recorded({"turn": Dihedral([[0, 1, 2, 3]]), "bond": Distance([[0, 1]])})[0]
    assert repr(series) == "<Series: 9 samples of turn, bond>" and series.off.max() < 1e-12
    np.testing.assert_allclose(series.time, 0.01 * np.arange(9), atol=1e-12)
    series.isokinetic_degrees_of_freedom = 7
    series.save(tmp_path / "series.npz")
    read = Series.load(tmp_path / "series.npz")
    assert read.isokinetic_degrees_of_freedom == read[1:].isokinetic_degrees_of_freedom == 7
    assert read.names == series.names and read.periods.tolist() == series.periods.tolist()
    for field in Sample._fields:
        np.testing.assert_array_equal(getattr(read, field), getattr(series, field))
    np.testing.assert_array_equal(read[3:6].multiplier, series.multiplier[3:6])
    empty = Series(["a", "b"])
    empty.save(tmp_path / "empty.npz")
    assert len(Series.load(tmp_path / "empty.npz")) == 0 and empty.work.shape == empty.weights.shape == (0,)


def test_damaged_files_are_refused(tmp_path):
    series, _ = recorded({"bond": Distance([[0, 1]])})
    file = tmp_path / "series.npz"
    series.save(file)
    content = bytearray(file.read_bytes())
    content[content.index(series.multiplier.tobytes())] ^= 255
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"series\.npz holds no series"):
        Series.load(file)
    with pytest.raises(FileNotFoundError):
        Series.load(tmp_path / "nothing.npz")
