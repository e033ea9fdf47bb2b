"""Temperatures of configurations of a file: Metropolis samples are as hot as they were drawn, whole or wrapped."""

from __future__ import annotations

import dataclasses

import fluids
import numpy as np
import pytest
import water_files as files
from ase import units
from ase.build import molecule
from ase.io import write

from kcons.comparison import Potential, test_systems, trajectory_temperatures
from kcons.errors import InputError, UnsupportedError
from kcons.thermostats import Estimate, SplitTemperatures

N, FRAMES = 27, 48


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Water at 400 K by Metropolis moves, each atom wrapped by itself."""
    folder, chosen = tmp_path_factory.mktemp("water"), fluids.water(N)
    moved = chosen.shift, chosen.turn
    x = chosen.forces.metropolis(chosen.positions, chosen.thermal_energy, 1500, 10, 1, *moved)[1]
    frames = []
    for k in range(FRAMES):
        x = chosen.forces.metropolis(x, chosen.thermal_energy, 40, 40, (2, k), *moved)[1]
        frames.append(x)
    side = chosen.forces.box
    files.topology(folder / "t.gro", N, frames[0], side)
    files.write(folder / "good.trr", np.array(frames) % side, side)
    return folder


@pytest.fixture
def named(monkeypatch):
    """The forces that the file was drawn with, by the name of others."""
    made = test_systems.from_file

    def from_file(*where, **options):
        forces = fluids.water(N).forces
        return dataclasses.replace(made(*where, **options), potential=Potential(forces.evaluate, "the fluid's"))

    monkeypatch.setattr(test_systems, "from_file", from_file)


def test_samples_are_as_hot_as_they_were_drawn(folder, named):
    found = trajectory_temperatures.along(folder / "good.trr", folder / "t.gro", "lj", range(FRAMES), constrain="none")
    assert (found.shifts, found.turns, found.samples) == (3 * N, 3 * N, FRAMES) and found.internal is None
    for estimate in (found.shift, found.turn):
        assert abs(estimate.off(400 * units.kB)) <= 3.5 and estimate.error < 0.1 * estimate.value
    first, *others = trajectory_temperatures.sentences(found)
    assert first.startswith(f"temperatures of the configurations, of {FRAMES} frames: shifts of whole clusters ")
    assert f"{found.turn.value / units.kB:.1f} ± " in first
    (worst,) = (line for line in others if line.startswith("errors of 1% take some "))
    assert others == [worst]
    assert "none can be told from 400 K: all are within 3" in trajectory_temperatures.sentences(found, 400.0)[1]


def test_what_is_said_beside_the_temperature_of_the_thermostat():
    kelvin = units.kB * np.array([300.6, 1.2, 312.0, 2.0])
    found = SplitTemperatures(Estimate(*kelvin[:2]), Estimate(*kelvin[2:]), None, 60, 60, 0.1, 0.2, 50, ())
    assert trajectory_temperatures.sentences(found, 300.0)[1:] == [
        "not 300 K: turns of whole clusters 4.0% too warm (6.0 standard errors); the step is too long, the run is not "
        "yet in equilibrium, or the thermostat keeps another temperature"
    ]
    rough = SplitTemperatures(Estimate(units.kB * 300, units.kB * 30), None, None, 60, 0, 0.1, 0.0, 50, ())
    assert trajectory_temperatures.sentences(rough)[1:] == ["errors of 1% take some 5,000 frames as far apart as these"]


def test_bad_input(folder):
    for forces, n, words in (("lj", 31, "31 frames are too few"), ("nothing at all", 40, "nothing at all")):
        with pytest.raises(InputError, match=words):
            trajectory_temperatures.along(folder / "good.trr", folder / "t.gro", forces, range(n))


def test_a_box_that_changes(folder, named, tmp_path):
    frames = [ts.copy() for ts in files.mda.Universe(folder / "t.gro", folder / "good.trr").trajectory]
    cells = [[*(ts.dimensions[:3] * (1.0 if k < 30 else 1.01)), 90, 90, 90] for k, ts in enumerate(frames)]
    files.write(tmp_path / "other.trr", np.array([ts.positions for ts in frames]), cells)
    with pytest.raises(UnsupportedError, match="the box of frame 30 is another one"):
        trajectory_temperatures.along(tmp_path / "other.trr", folder / "t.gro", "lj", range(FRAMES), constrain="none")


def test_lengths_and_box_are_those_of_the_first_frame_that_is_looked_at(folder, named, tmp_path):
    """As after an equilibration at constant pressure, or in a file whose first frame was not on the constraints yet."""
    frames = [ts.copy() for ts in files.mda.Universe(folder / "t.gro", folder / "good.trr").trajectory]
    x, (side, *_) = np.array([ts.positions for ts in frames]), frames[0].dimensions.tolist()
    cells = [[factor * side] * 3 + [90, 90, 90] for factor in [1.1, *[1.0] * FRAMES]]
    files.write(tmp_path / "t.trr", np.concatenate([1.1 * x[:1], x]), cells)
    how = folder / "t.gro", "lj"
    expected = trajectory_temperatures.along(folder / "good.trr", *how, range(FRAMES), constrain="none")
    found = trajectory_temperatures.along(tmp_path / "t.trr", *how, range(1, FRAMES + 1), constrain="none")
    np.testing.assert_allclose([found.shift, found.turn], [expected.shift, expected.turn], rtol=1e-4)


def test_bonds_that_the_run_held_are_to_be_named(tmp_path, recwarn):
    """Ethanol with stiff bonds: those to hydrogen are held and named, C-C and C-O are held and not named."""
    ethanol, rng = molecule("CH3CH2OH"), np.random.default_rng(1)
    frames = []
    for _ in range(40):
        frame = ethanol.copy()
        frame.rotate(rng.uniform(0, 360), rng.standard_normal(3))
        frames.append(frame)
    write(tmp_path / "e.xyz", frames)
    where = tmp_path / "e.xyz", tmp_path / "e.xyz", "emt", range(40)
    found = trajectory_temperatures.along(*where, constrain="hbonds")
    assert "2 bonds that nothing was said to hold keep their length" in found.left_out[-1]
    assert "name all that it held (--constrain)" in found.left_out[-1]
    found = trajectory_temperatures.along(*where, constrain="allbonds")
    assert not any("keep their length" in words for words in found.left_out) and not recwarn.list
