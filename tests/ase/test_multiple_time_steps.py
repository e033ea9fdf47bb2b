"""Several time steps in ASE: the core's steps, both ways to give forces, counts, restarts, and every refusal."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.calculator import Calculator, all_changes
from ase.constraints import ExternalForce
from ase.io import read

from kcons import State, System, run
from kcons.ase import ConstrainedLangevin, MultipleTimeSteps, constrain, draw_velocities, rigid_water
from kcons.constraints import Distance
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.thermostats import ForceGroups, IsokineticSpheres, LangevinRespa

FS = units.fs
K = np.array([1.0, 1.3, 0.7])
TWO = {"temperature_K": 300, "friction": 0.01 / FS, "fast_steps": 4, "seed": 3}


class Waves(Calculator):
    """A field that is the same nowhere, of some strength; from call `bad` on NaN."""

    implemented_properties = ("energy", "forces")

    def __init__(self, size=0.2, bad=None):
        super().__init__()
        self.size, self.bad, self.calls = size, bad, 0

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        self.calls += 1
        phase = K * atoms.positions + [0.1, 0.5, 0.9]
        forces = self.size * np.sin(phase)
        if self.bad is not None and self.calls >= self.bad:
            forces[1, 1] = np.nan
        self.results = {"energy": float((self.size * np.cos(phase) / K).sum()), "forces": forces}


def waters(n=2) -> Atoms:
    atoms = Atoms()
    for k in range(n):
        one = molecule("H2O")
        one.rotate(40 * k, [1.0, k, 2.0])
        one.translate([3.1 * k, 0.3 * k, 0])
        atoms += one
    constrain(atoms, rigid_water(atoms, "tip3p"), project=True)
    draw_velocities(atoms, 300, 1)
    return atoms


def same(a, b):
    np.testing.assert_array_equal(a.positions, b.positions)
    np.testing.assert_array_equal(a.get_momenta(), b.get_momenta())


@pytest.mark.parametrize("bath", ["langevin", "spheres"])
def test_it_makes_the_steps_of_the_core(bath):
    atoms = waters()
    moving = MultipleTimeSteps(atoms, 4 * FS, fast=Waves(), slow=Waves(0.05), bath=bath, **TWO)
    groups = ForceGroups({"fast": lambda x, t: 0.2 * wave(x), "slow": lambda x, t: 0.05 * wave(x)})
    system = System(moving.motion, groups)
    state = State(atoms.positions.copy(), atoms.get_velocities())
    kind = LangevinRespa if bath == "langevin" else IsokineticSpheres
    stepper = kind(300 * units.kB, 0.01 / FS, 3, steps={"slow": 1, "fast": 4})
    end = run(system, state, 4 * FS, 5, stepper=stepper)
    moving.run(5)
    np.testing.assert_allclose(atoms.positions, end.positions, rtol=0, atol=1e-12)
    assert moving.listing() == stepper.listing(system)
    assert moving.evaluations == {"fast": 21, "slow": 6}


def wave(x):
    return np.sin(K * x + [0.1, 0.5, 0.9])


def test_expensive_less_fast_is_the_same_as_the_rest():
    """As fast .2 and slow .05 waves: expensive .25 and fast .2."""
    one, two = waters(), waters()
    expensive = Waves(0.25)
    MultipleTimeSteps(one, 4 * FS, fast=Waves(), slow=Waves(0.05), **TWO).run(5)
    moving = MultipleTimeSteps(two, 4 * FS, fast=Waves(), slow=expensive, difference=True, **TWO)
    moving.run(5)
    np.testing.assert_allclose(one.positions, two.positions, rtol=0, atol=1e-12)
    assert two.calc is expensive and expensive.calls == 6
    assert one.get_potential_energy() == pytest.approx(two.get_potential_energy(), rel=1e-12)
    assert moving.evaluations["slow"] == 6


@pytest.mark.parametrize("bath", ["langevin", "spheres"])
def test_a_restart_is_the_same_to_the_last_bit(tmp_path, bath):
    options = {**TWO, "bath": bath}
    whole, half = waters(), waters()
    MultipleTimeSteps(whole, 4 * FS, fast=Waves(), slow=Waves(0.05), **options).run(6)
    first = MultipleTimeSteps(half, 4 * FS, fast=Waves(), slow=Waves(0.05), **options)
    first.run(3)
    first.save(tmp_path / "state.npz")
    other = waters()
    again = MultipleTimeSteps(other, 4 * FS, fast=Waves(), slow=Waves(0.05), restart=tmp_path / "state.npz", **options)
    again.run(3)
    first.run(3)
    same(whole, other)
    same(whole, half)
    assert again.evaluations == {"fast": 13, "slow": 4}  # those of the file may be of other calculators


def test_logs_and_trajectories_cost_no_call(tmp_path):
    atoms, slow = waters(), Waves(0.05)
    files = {"trajectory": str(tmp_path / "run.traj"), "logfile": str(tmp_path / "run.log")}
    MultipleTimeSteps(atoms, 4 * FS, fast=Waves(), slow=slow, **TWO, **files).run(4)
    assert slow.calls == 5
    frames = read(files["trajectory"], ":")
    assert len(frames) == 5
    both = Waves().get_potential_energy(atoms) + Waves(0.05).get_potential_energy(atoms)
    assert frames[-1].get_potential_energy() == pytest.approx(both, rel=1e-12)
    assert len((tmp_path / "run.log").read_text().splitlines()) == 6


def test_slow_kicks_in_the_middle_of_a_step():
    atoms, slow = waters(), Waves(0.05)
    options = {**TWO, "slow_kicks": "middle"}
    moving = MultipleTimeSteps(atoms, 4 * FS, fast=Waves(), slow=slow, bath="spheres", **options)
    moving.run(5)
    assert slow.calls == 6 and moving.evaluations == {"fast": 25, "slow": 5}  # one call looked whether it fits
    assert moving.state.forces is None
    assert "slow_kicks='middle'" in repr(moving.stepper)


def test_forces_that_ase_objects_add():
    one, two = waters(), waters()
    for atoms in (one, two):
        atoms.constraints = [*atoms.constraints, ExternalForce(0, 5, 0.3)]
    two.calc = Waves(0.25)
    options = {"temperature_K": 300, "friction": 0.0}
    MultipleTimeSteps(one, FS, fast=Waves(), slow=Waves(0.05), fast_steps=2, **options).run(3)
    ConstrainedLangevin(two, FS / 8, rng=1, **options).run(24)
    np.testing.assert_allclose(one.positions, two.positions, rtol=0, atol=2e-5)


def test_temperatures():
    atoms = waters(3)
    moving = MultipleTimeSteps(atoms, FS, fast=Waves(), slow=Waves(0.05), bath="spheres", **TWO)
    moving.run(1)
    g, whole = np.array([3, 3] * 3), np.array([4, 4] * 3)
    expected = 0.5 * 300 * units.kB * (g * (whole - 1) / whole).sum()
    assert moving.get_temperature() == pytest.approx(300 * atoms.get_kinetic_energy() / expected, rel=1e-12)
    with pytest.raises(UnsupportedError, match="conserved on spheres"):
        moving.get_conserved_energy()
    moving.set_temperature(600)
    moving.run(1)
    assert moving.stepper.thermal_energy == pytest.approx(600 * units.kB)
    langevin = MultipleTimeSteps(waters(), FS, fast=Waves(), slow=Waves(0.05), **TWO)
    assert langevin.thermostat_degrees_of_freedom == 12
    start = langevin.get_conserved_energy()
    langevin.run(40)
    assert langevin.get_conserved_energy() == pytest.approx(start, abs=5e-4)
    assert langevin.get_temperature() > 0
    drifting = MultipleTimeSteps(waters(), FS, fast=Waves(), slow=Waves(0.05), conserve_momentum=True, **TWO)
    assert drifting.thermostat_degrees_of_freedom == 9
    assert drifting.get_temperature() == pytest.approx(2 * drifting.atoms.get_kinetic_energy() / (9 * units.kB))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"fast_steps": 0}, "group 'fast' takes 0 steps"),
        ({"fast_steps": 1}, "both take 1 steps"),
        ({"fast_steps": 2.5}, "takes 2.5 steps"),
        ({"friction": 0.0, "bath": "spheres"}, "spheres need a bath"),
        ({"friction": -1.0}, "friction is -1.0"),
        ({"temperature_K": 0}, "temperature_K is 0"),
        ({"bath": "hot"}, "bath is 'hot'"),
        ({"bath": "spheres", "spheres": "axes", "auxiliary": 0}, "radius 0"),
        ({"slow": 3}, "slow is 3; give an ASE calculator"),
        ({"auxiliary": 2}, "auxiliary is no option with bath='langevin'"),
        ({"conserve_momentum": True, "bath": "spheres"}, "conserve_momentum is no option with bath='spheres'"),
    ],
)
def test_bad_input_changes_nothing(options, words):
    atoms = waters()
    before, momenta, calc = atoms.positions.copy(), atoms.get_momenta(), Waves()
    atoms.calc = calc
    given = {"fast": Waves(), "slow": Waves(0.05), **TWO, **options}
    with pytest.raises(InputError, match=words):
        MultipleTimeSteps(atoms, 4 * FS, **given).run(1)
    np.testing.assert_array_equal(atoms.positions, before)
    np.testing.assert_array_equal(atoms.get_momenta(), momenta)
    assert atoms.calc is calc


def test_one_calculator_twice_and_calculators_of_other_atoms():
    class Stubborn(Waves):
        """Of atoms of its own, whatever it is asked for."""

        def get_forces(self, atoms):
            return super().get_forces(waters(3))

    calc = Waves()
    with pytest.raises(InputError, match="the same calculator"):
        MultipleTimeSteps(waters(), FS, fast=calc, slow=calc, **TWO)
    with pytest.raises(InputError, match=r"slow computes forces of shape \(9, 3\) of 9 atoms \(H6O3\), not of these 6"):
        MultipleTimeSteps(waters(), FS, fast=calc, slow=Stubborn(), difference=True, **TWO)


def test_targets_that_move_have_no_spheres():
    options = {**TWO, "constraints": Distance([[0, 3]], lambda t: 3.0 + 0.0 * t), "degenerate": "convert"}
    atoms = waters()
    atoms.constraints = []
    atoms.positions[3] = atoms.positions[0] + [3.0, 0, 0]
    with pytest.raises(UnsupportedError, match="target that moves"):
        MultipleTimeSteps(atoms, FS, fast=Waves(), slow=Waves(0.05), bath="spheres", **options)
    assert atoms.calc is None


def test_a_step_that_fails_leaves_the_atoms_as_they_were():
    atoms = waters()
    moving = MultipleTimeSteps(atoms, 4 * FS, fast=Waves(), slow=Waves(0.05, bad=4), **TWO)
    moving.run(2)
    before, momenta = atoms.positions.copy(), atoms.get_momenta()
    with pytest.raises(NonFiniteError) as caught:
        moving.run(1)
    assert caught.value.step == 3
    np.testing.assert_array_equal(atoms.positions, before)
    np.testing.assert_array_equal(atoms.get_momenta(), momenta)


def test_another_calculator_on_the_atoms():
    """Its energies would be logged, and its forces not used."""
    atoms = waters()
    moving = MultipleTimeSteps(atoms, 4 * FS, fast=Waves(), slow=Waves(0.05), **TWO)
    moving.run(2)
    whole, before, momenta = atoms.calc, atoms.positions.copy(), atoms.get_momenta()
    atoms.calc = Waves()
    with pytest.raises(InputError, match=r"another calculator, .* make another MultipleTimeSteps"):
        moving.run(1)
    np.testing.assert_array_equal(atoms.positions, before)
    np.testing.assert_array_equal(atoms.get_momenta(), momenta)
    atoms.calc = whole
    moving.run(1)
    assert moving.evaluations == {"fast": 13, "slow": 4}
