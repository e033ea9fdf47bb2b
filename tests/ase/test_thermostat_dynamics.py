"""Thermostats in ASE: what they hold, restarts to the last bit, reproducible noise, and every failure rolled back."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.calculator import Calculator, all_changes
from ase.constraints import FixAtoms, Hookean
from ase.io import read

from kcons.ase import (
    ConstrainedDynamics,
    ConstrainedLangevin,
    ConstrainedNoseHoover,
    Constraints,
    IsokineticDynamics,
    constrain,
    draw_velocities,
    rigid_water,
)
from kcons.constraints import Distance, FixedAtoms, Plane
from kcons.errors import InputError, KconsError, NonFiniteError, OverdeterminedError, UnsupportedError
from kcons.steppers import State

FS = units.fs


class Waves(Calculator):
    """A field that is the same nowhere; from call `bad` on NaN."""

    implemented_properties = ("energy", "forces")

    def __init__(self, bad=None):
        super().__init__()
        self.bad, self.calls = bad, 0

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        k = np.array([1.0, 1.3, 0.7])
        forces = 0.2 * np.sin(k * atoms.positions + [0.1, 0.5, 0.9])
        if self.bad is not None and self.calls >= self.bad:
            forces[1, 1] = np.nan
        self.calls += 1
        self.results = {
            "energy": float((0.2 * np.cos(k * atoms.positions + [0.1, 0.5, 0.9]) / k).sum()),
            "forces": forces,
        }


class Pairs(Calculator):
    """Pairs with a twist: adds up to nothing, exerts a torque, knows no place."""

    implemented_properties = ("energy", "forces")

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        x = atoms.positions - atoms.positions.mean(axis=0)
        self.results = {"energy": 0.0, "forces": -0.1 * x + 0.05 * np.cross([0.2, 0.1, 1.0], x)}


def waters(n=3, calc=None, temperature=300.0, momenta=True, zero_momentum=False) -> Atoms:
    atoms = Atoms()
    for k in range(n):
        one = molecule("H2O")
        one.rotate(40 * k, [1.0, k, 2.0])
        one.translate([3.1 * k, 0.3 * k, 0])
        atoms += one
    atoms.calc = Waves() if calc is None else calc
    constrain(atoms, rigid_water(atoms, "tip3p"), project=True)
    if momenta:
        draw_velocities(atoms, temperature, 1, zero_momentum=zero_momentum)
    return atoms


def made(kind, atoms, **options):
    if kind == "isokinetic":
        return IsokineticDynamics(atoms, FS, temperature_K=300, **options)
    if kind == "langevin":
        return ConstrainedLangevin(atoms, FS, 300, 0.02 / FS, **{"rng": 5, **options})
    return ConstrainedNoseHoover(atoms, FS, 300, 50 * FS, **options)


KINDS = pytest.mark.parametrize("kind", ["isokinetic", "langevin", "nose-hoover"])


def state(atoms):
    return atoms.get_positions(), atoms.get_momenta()


def equal(a, b) -> bool:
    return all(np.array_equal(p, q) for p, q in zip(a, b, strict=True))


# -- what is held -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("calc", "fixed", "g"),
    [(Waves, [], 18), (Pairs, [], 15), (Pairs, [0], 15), (Waves, [0, 1, 2], 12)],
)
def test_isokinetic_holds_the_right_kinetic_energy(calc, fixed, g):
    """2K = (g - 1) kT with g by hand: 27 coordinates less 9 rows, less conserved momenta, less fixed atoms."""
    atoms = waters(calc=calc())
    if fixed:
        rows = list(atoms.constraints[0].constraints)
        atoms.set_constraint()
        atoms.set_constraint(Constraints([*rows, FixedAtoms(fixed)]))
        # three components each; a whole molecule makes its three rows redundant
        assert g == 27 - 9 - (3 * len(fixed) - 3 * (len(fixed) == 3))
    draw_velocities(atoms, 100, 3, zero_momentum=calc is Pairs and not fixed)
    moving = IsokineticDynamics(atoms, FS, temperature_K=320)
    for _ in range(3):
        assert 2 * atoms.get_kinetic_energy() == pytest.approx((g - 1) * units.kB * 320, rel=1e-12)
        assert moving.thermostat_degrees_of_freedom == g
        assert moving.get_temperature() == pytest.approx(320, rel=1e-12)
        moving.run(20)
    moving.set_temperature(200)
    assert 2 * atoms.get_kinetic_energy() == pytest.approx((g - 1) * units.kB * 200, rel=1e-12)
    moving.run(20)
    assert 2 * atoms.get_kinetic_energy() == pytest.approx((g - 1) * units.kB * 200, rel=1e-12)


def test_kinetic_energy_is_constant():
    atoms = waters()
    moving = IsokineticDynamics(atoms, FS, temperature_K=300)
    wanted = atoms.get_kinetic_energy()
    worst = []
    moving.attach(lambda: worst.append(abs(atoms.get_kinetic_energy() / wanted - 1)), interval=10)
    moving.run(2000)
    assert max(worst) <= 1e-14


@pytest.mark.validation
@pytest.mark.filterwarnings("ignore:no atom or body")
def test_kinetic_energy_is_constant_over_a_million_steps():
    atoms = waters()
    moving = IsokineticDynamics(atoms, FS, temperature_K=300)
    wanted = 17 * units.kB * 150
    worst = []
    moving.attach(lambda: worst.append(abs(atoms.get_kinetic_energy() / wanted - 1)), interval=1000)
    moving.run(1_000_000)
    assert len(worst) == 1001 and max(worst) <= 1e-13


def test_options_of_the_isokinetic_thermostat():
    atoms = waters()
    IsokineticDynamics(atoms, FS, 300, convention="notes")
    assert 2 * atoms.get_kinetic_energy() == pytest.approx(27 * units.kB * 300, rel=1e-12)
    IsokineticDynamics(atoms, FS, 300, indices=range(3), order=4).run(3)
    inside = (atoms.get_momenta()[:3] ** 2 / atoms.get_masses()[:3, None]).sum()
    assert inside == pytest.approx(5 * units.kB * 300, rel=1e-12)
    kept = atoms.get_kinetic_energy()
    IsokineticDynamics(atoms, FS).run(5)
    assert atoms.get_kinetic_energy() == pytest.approx(kept, rel=1e-12)
    with pytest.raises(UnsupportedError, match="couples thermostatted atoms to others"):
        IsokineticDynamics(atoms, FS, 300, indices=[0])


@KINDS
def test_the_conserved_energies(kind):
    atoms = waters()
    moving = made(kind, atoms)
    values, energies = [], []
    moving.attach(lambda: values.append(moving.get_conserved_energy()), interval=10)
    moving.attach(lambda: energies.append(atoms.get_total_energy()), interval=10)
    moving.run(400)
    assert np.ptp(values) <= 1e-3
    assert np.ptp(energies) >= 50 * np.ptp(values)


def test_the_chain_has_the_constants_of_ase():
    atoms = waters()
    moving = ConstrainedNoseHoover(atoms, FS, 300, 50 * FS, tchain=4)
    kt = 300 * units.kB
    np.testing.assert_allclose(moving.stepper._masses(18)[:2], [18 * kt * (50 * FS) ** 2, kt * (50 * FS) ** 2])
    moving.run(3)
    assert moving._state.thermostat.shape == (9,)
    assert moving.thermostat_degrees_of_freedom == 18


def test_langevin_with_momentum_left_alone():
    atoms = waters(calc=Pairs(), zero_momentum=True)
    moving = made("langevin", atoms, fixcm=True)
    assert moving.thermostat_degrees_of_freedom == 15
    moving.run(100)
    assert np.abs(atoms.get_momenta().sum(axis=0)).max() <= 1e-12
    assert made("langevin", atoms).thermostat_degrees_of_freedom == 18


def test_targets_that_move():
    rate = 0.003 / FS
    first = waters(2).get_distance(0, 3)
    pulled = Distance([[0, 3]], lambda t: first + rate * t)
    for kind in ("isokinetic", "langevin"):
        atoms = waters(2)
        moving = made(kind, atoms, constraints=[pulled])
        moving.run(50)
        assert atoms.get_distance(0, 3) == pytest.approx(first + rate * 50 * FS, abs=1e-12)
    atoms = waters(2)
    with pytest.raises(UnsupportedError, match="targets move"):
        made("nose-hoover", atoms, constraints=[pulled])


# -- restarts ---------------------------------------------------------------------------------------


@KINDS
@pytest.mark.parametrize("at", [0.0, 1e5])
def test_a_saved_run_goes_on_to_the_last_bit(kind, at, tmp_path):
    atoms = waters()
    atoms.positions += at
    moving = made(kind, atoms)
    moving.run(15)
    moving.save(tmp_path / "restart.npz")
    moving.run(15)
    again = waters(momenta=False)
    resumed = made(kind, again, restart=tmp_path / "restart.npz")
    assert resumed.nsteps == 15 and resumed.get_time() == 15 * FS
    resumed.run(15)
    assert equal(state(atoms), state(again))
    assert np.array_equal(moving._state.thermostat, resumed._state.thermostat)
    assert resumed.nsteps == 30
    assert not list(tmp_path.glob("*.unfinished"))


@KINDS
def test_a_restart_asks_the_calculator_for_forces(kind, tmp_path):
    """Those of a file may be of another calculator: the run goes on as one from positions and velocities alone."""
    moving = made(kind, waters())
    moving.run(3)
    moving.save(tmp_path / "restart.npz")
    saved = moving.state
    assert saved.forces is not None
    bare = State(saved.positions, saved.velocities, saved.time, step=saved.step, thermostat=saved.thermostat)
    ends = []
    for given in ({"restart": tmp_path / "restart.npz"}, {"state": saved}, {"state": bare}):
        atoms = waters(calc=Pairs(), momenta=False)
        made(kind, atoms, **given, **({} if kind == "langevin" else {"momentum": "free"})).run(2)
        ends.append(state(atoms))
    assert equal(ends[0], ends[2]) and equal(ends[1], ends[2])


def test_a_run_goes_on_from_a_state_of_another_dynamics():
    """Velocities of the state, scaled to K; the number of the step and the time go on."""
    atoms = waters()
    moving = ConstrainedDynamics(atoms, FS)
    moving.run(10)
    given = moving.state
    again = waters(momenta=False)
    resumed = made("isokinetic", again, state=given)
    assert resumed.nsteps == 10 and resumed.get_time() == 10 * FS
    wanted = 17 * units.kB * 300
    assert 2 * again.get_kinetic_energy() == pytest.approx(wanted, rel=1e-12)
    scale = again.get_velocities() / given.velocities
    np.testing.assert_allclose(scale, scale[0, 0], rtol=1e-12)
    resumed.run(5)
    assert 2 * again.get_kinetic_energy() == pytest.approx(wanted, rel=1e-12)
    with pytest.raises(InputError, match="not both"):
        made("isokinetic", again, state=given, restart="a.npz")


def test_isokinetic_goes_on_from_a_trajectory(tmp_path):
    atoms = waters()
    moving = made("isokinetic", atoms, trajectory=str(tmp_path / "md.traj"))
    moving.run(10)
    moving.close()
    again = read(tmp_path / "md.traj")
    again.calc = Waves()
    made("isokinetic", again).run(10)
    moving = made("isokinetic", atoms)
    moving.run(10)
    assert equal(state(atoms), state(again))


def test_isokinetic_goes_on_at_another_temperature(tmp_path):
    moving, again = made("isokinetic", waters()), waters(momenta=False)
    moving.run(3)
    moving.save(tmp_path / "restart.npz")
    hotter = IsokineticDynamics(again, FS, 600, restart=tmp_path / "restart.npz")
    for _ in range(2):
        assert again.get_kinetic_energy() == pytest.approx(2 * moving.atoms.get_kinetic_energy(), rel=1e-12)
        hotter.run(3)
    assert hotter.get_temperature() == pytest.approx(600) and hotter.nsteps == 9


@pytest.mark.parametrize("kind", ["isokinetic", "nose-hoover"])
def test_degrees_of_freedom_follow_masses_and_constraints_before_the_next_step(kind):
    atoms = waters(2, Pairs(), zero_momentum=True)
    moving = made(kind, atoms)
    moving.run(2)
    count = moving.thermostat_degrees_of_freedom
    assert count == moving.degrees_of_freedom - 3
    atoms.set_masses(2 * atoms.get_masses())
    assert moving.degrees_of_freedom == count + 3
    assert moving.thermostat_degrees_of_freedom == count
    atoms.set_constraint()
    assert moving.thermostat_degrees_of_freedom == 18 - 3
    moving.run(1)
    assert moving.thermostat_degrees_of_freedom == 18 - 3


def test_files_that_hold_no_restart(tmp_path):
    atoms = waters()
    before = state(atoms)
    (tmp_path / "other.npz").write_bytes(b"nothing")
    np.savez(tmp_path / "third.npz", a=np.zeros(3))
    for name in ("other.npz", "third.npz"):
        with pytest.raises(InputError, match="was not written by save"):
            made("langevin", atoms, restart=tmp_path / name)
    with pytest.raises(FileNotFoundError):
        made("langevin", atoms, restart=tmp_path / "none.npz")
    made("langevin", atoms).save(tmp_path / "nine.npz")
    with pytest.raises(InputError, match="holds 9 atoms, not 6"):
        made("langevin", waters(2), restart=tmp_path / "nine.npz")
    with pytest.raises(InputError, match="variables of another thermostat"):
        chain = made("nose-hoover", atoms)
        chain.save(tmp_path / "chain.npz")
        made("isokinetic", atoms, restart=tmp_path / "chain.npz")
    assert equal(before, state(atoms))


def test_noise_is_reproducible():
    runs = []
    for rng in (5, 5, 6, np.random.default_rng(5), np.random.default_rng(5), None, None):
        atoms = waters()
        moving = made("langevin", atoms, rng=rng)
        moving.run(10)
        runs.append((moving.seed, atoms.get_positions()))
    a, b, c, d, e, f, g = (x for _, x in runs)
    assert np.array_equal(a, b) and np.array_equal(d, e)
    assert not np.array_equal(a, c) and not np.array_equal(f, g)
    atoms = waters()
    made("langevin", atoms, rng=runs[5][0]).run(10)
    assert np.array_equal(atoms.positions, f)


# -- changes by others ------------------------------------------------------------------------------


@KINDS
def test_momenta_set_in_between_are_used(kind):
    atoms = waters()
    moving = made(kind, atoms)
    moving.run(5)
    chain = moving._state.thermostat.copy()
    draw_velocities(atoms, 900, 3)
    moving.run(1)
    kt = 2 * atoms.get_kinetic_energy() / 18
    if kind == "isokinetic":
        assert 2 * atoms.get_kinetic_energy() == pytest.approx(17 * units.kB * 300, rel=1e-12)
    else:
        assert kt > 450 * units.kB
        assert np.abs(moving._state.thermostat - chain).max() <= 0.5  # the chain and the heat go on


def test_set_temperature():
    atoms = waters()
    for kind in ("langevin", "nose-hoover"):
        moving = made(kind, atoms)
        moving.run(2)
        moving.set_temperature(50)
        assert moving.stepper.thermal_energy == 50 * units.kB
        moving.run(400)
    made("langevin", atoms)
    cold = ConstrainedLangevin(atoms, FS, 1.0, 0.1 / FS, rng=1)
    cold.run(300)
    assert cold.get_temperature() < 15
    with pytest.raises(InputError, match="temperature_K is 0"):
        cold.set_temperature(0)


# -- failures ---------------------------------------------------------------------------------------


@KINDS
@pytest.mark.parametrize("temperature", [0, -300.0, math.nan, math.inf, "hot"])
def test_temperatures_must_be_positive(kind, temperature):
    atoms = waters()
    before = state(atoms)
    classes = {
        "isokinetic": lambda: IsokineticDynamics(atoms, FS, temperature),
        "langevin": lambda: ConstrainedLangevin(atoms, FS, temperature, 0.02 / FS),
        "nose-hoover": lambda: ConstrainedNoseHoover(atoms, FS, temperature, 50 * FS),
    }
    with pytest.raises(InputError, match=r"temperature_K is .*give a positive number"):
        classes[kind]()
    assert equal(before, state(atoms))


def test_bad_parameters():
    atoms = waters()
    with pytest.raises(InputError, match="tdamp is 0"):
        ConstrainedNoseHoover(atoms, FS, 300, 0)
    with pytest.raises(InputError, match="length is 0"):
        ConstrainedNoseHoover(atoms, FS, 300, 50, tchain=0)
    with pytest.raises(InputError, match="friction is -1"):
        ConstrainedLangevin(atoms, FS, 300, -1)
    with pytest.raises(InputError, match="the time step is"):
        ConstrainedLangevin(atoms, math.nan, 300, 1)
    with pytest.raises(InputError, match="noise cannot be taken back"):
        ConstrainedLangevin(atoms, -FS, 300, 1).run(1)
    with pytest.raises(InputError, match="choose 2, 4 or 6"):
        IsokineticDynamics(atoms, FS, 300, order=5)


def test_isokinetic_without_momenta():
    atoms = waters(momenta=False)
    with pytest.raises(InputError, match="needs non-zero kinetic energy"):
        IsokineticDynamics(atoms, FS, 300)
    assert (atoms.get_momenta() == 0).all()


def test_isokinetic_with_one_degree_of_freedom():
    atoms = Atoms("OH", [[0, 0, 0], [0, 0, 1.0]])
    atoms.calc = Waves()
    held = [FixedAtoms([0]), Distance([[0, 1]])]
    atoms.set_constraint(Constraints([*held, Plane([1], [1.0, 0, 0])]))
    draw_velocities(atoms, 300, 1)
    with pytest.raises(OverdeterminedError, match="g - 1 = 0"):
        IsokineticDynamics(atoms, FS, 300)


def test_total_momentum_is_said():
    atoms = waters(calc=Pairs())
    for kind in ("isokinetic", "nose-hoover"):
        with pytest.warns(UserWarning, match="total momentum is not zero"):
            made(kind, atoms)
    draw_velocities(atoms, 300, 1, zero_momentum=True)
    for kind in ("isokinetic", "nose-hoover"):
        moving = made(kind, atoms)
        moving.run(3)
        draw_velocities(atoms, 300, 2)
        with pytest.warns(UserWarning, match="total momentum is not zero"):
            moving.run(1)
        draw_velocities(atoms, 300, 1, zero_momentum=True)
        moving.run(3)


@KINDS
@pytest.mark.parametrize("bad", [0, 1, 6])
def test_forces_that_are_not_numbers(kind, bad):
    atoms = waters()
    before = state(atoms)
    atoms.calc = Waves(bad=bad)
    with pytest.raises(NonFiniteError, match="non-finite force at step"):
        moving = made(kind, atoms)
        last = before = state(atoms)
        for _ in moving.irun(20):
            before, last = last, state(atoms)
    now = state(atoms)
    assert equal(now, before) or equal(now, last)
    assert np.isfinite(now[0]).all() and np.isfinite(now[1]).all()


@KINDS
@pytest.mark.filterwarnings("ignore:the atoms move in steps")
def test_a_time_step_that_is_too_large_leaves_the_atoms_alone(kind):
    atoms = waters()
    moving = made(kind, atoms)
    moving.run(3)
    before = state(atoms)
    moving.set_timestep(60 * FS if kind != "nose-hoover" else 1e3 * FS)
    with pytest.raises(KconsError, match="time step"):
        moving.run(50)
    assert moving.nsteps >= 3
    if moving.nsteps == 3:
        assert equal(before, state(atoms))
    moving.set_timestep(FS)
    moving.run(2)


# -- velocities -------------------------------------------------------------------------------------


def test_drawn_velocities():
    atoms = waters()
    a = atoms.get_momenta()
    draw_velocities(atoms, 300, np.random.default_rng(1))
    assert np.array_equal(a, atoms.get_momenta())
    held = atoms.constraints[0].engine(atoms)
    rows = held.constraint_set.jacobian(atoms.positions)
    assert np.abs(rows @ atoms.get_velocities().ravel()).max() <= 1e-15
    draw_velocities(atoms, 300, 2, exact=True)
    assert 2 * atoms.get_kinetic_energy() == pytest.approx(18 * units.kB * 300, rel=1e-13)
    assert atoms.get_temperature() == pytest.approx(300, rel=1e-12)
    draw_velocities(atoms, 300, 2, exact=True, zero_momentum=True)
    assert 2 * atoms.get_kinetic_energy() == pytest.approx(15 * units.kB * 300, rel=1e-13)
    assert np.abs(atoms.get_momenta().sum(axis=0)).max() <= 1e-13
    temperatures = []
    rng = np.random.default_rng(0)
    for _ in range(300):
        draw_velocities(atoms, 300, rng)
        temperatures.append(atoms.get_temperature())
    assert np.mean(temperatures) == pytest.approx(300, abs=4 * 300 * math.sqrt(2 / 18 / 300))


def test_velocities_that_cannot_be_drawn():
    atoms = waters()
    before = state(atoms)
    with pytest.raises(InputError, match="temperature_K is -1"):
        draw_velocities(atoms, -1)
    held = waters()
    held.set_constraint()
    held.set_constraint([FixAtoms([0])])
    momenta = held.get_momenta()
    with pytest.raises(UnsupportedError, match="hold atoms in space"):
        draw_velocities(held, 300, zero_momentum=True)
    assert np.array_equal(held.get_momenta(), momenta)
    draw_velocities(held, 300)
    assert (held.get_momenta()[0] == 0).all()
    atoms.positions[1, 0] += 0.1
    with pytest.raises(InputError, match="atoms are off row"):
        draw_velocities(atoms, 300)
    assert np.array_equal(atoms.get_momenta(), before[1])


def test_a_restart_keeps_asked_constraints_of_the_dynamics(tmp_path):
    atoms = waters(2)
    more = {"constraints": [Distance([[0, 3]])]}
    moving = made("langevin", atoms, **more)
    length = atoms.get_distance(0, 3)
    moving.run(5)
    moving.save(tmp_path / "a.npz")
    moving.run(5)
    again = waters(2, momenta=False)
    made("langevin", again, restart=tmp_path / "a.npz", **more).run(5)
    assert equal(state(atoms), state(again))
    assert again.get_distance(0, 3) == pytest.approx(length, abs=1e-12)


def test_what_a_trajectory_says_of_the_run(tmp_path):
    moving = made("langevin", waters())
    assert "seed=5" in moving.todict()["stepper"]
    assert moving.todict()["md-type"] == "ConstrainedLangevin"


def test_springs_of_ase_count_in_the_conserved_energy():
    atoms = waters(2)
    atoms.set_constraint([*atoms.constraints, Hookean(0, 3, 5.0, rt=0.5)])
    dyn = ConstrainedLangevin(atoms, 0.5 * FS, 300, 0.0, rng=1)
    before = dyn.get_conserved_energy()
    dyn.run(20)
    assert dyn.get_conserved_energy() == pytest.approx(before, abs=0.02)
    assert before > 10


@pytest.mark.parametrize(
    "made", [IsokineticDynamics, partial(ConstrainedNoseHoover, tdamp=50 * FS)], ids=["K", "chain"]
)
def test_bodies_that_feel_no_other_are_said_in_long_runs(made, monkeypatch):
    """Waters in a field that is the same for each."""
    for module in ("isokinetic.isokinetic", "nose_hoover"):
        monkeypatch.setattr(f"kcons.thermostats.{module}.LOOK_AT", 3)
    moving = made(waters(), FS, temperature_K=300, momentum="free")
    moving.run(3)
    with pytest.warns(UserWarning, match="feels another"):
        moving.run(1)
    moving.run(2)
