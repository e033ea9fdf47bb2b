"""Thermostats in ASE: what they hold, restarts to the last bit, noise, Monte Carlo, several time steps, failures."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms, units
from ase.calculators.calculator import all_changes
from ase.constraints import ExternalForce, FixAtoms
from ase.io import read
from ase_systems import FS, Field, equal, rigid, state

from kcons.ase import (
    ConstrainedLangevin,
    ConstrainedMonteCarlo,
    ConstrainedNoseHoover,
    Constraints,
    IsokineticDynamics,
    MultipleTimeSteps,
    draw_velocities,
)
from kcons.constraints import Distance, FixedAtoms
from kcons.errors import InputError, UnsupportedError
from kcons.motion import Motion
from kcons.steppers import BlanesMoan4, State, System, run
from kcons.thermostats import ForceGroups, HamiltonianMonteCarlo, IsokineticSpheres, LangevinRespa

KT = 300 * units.kB
K = np.array([1.0, 1.3, 0.7])
TWO = {"temperature_K": 300, "friction": 0.01 / FS, "fast_steps": 4, "rng": 3}


class Waves(Field):
    """A field that is the same nowhere, of some strength."""

    def __init__(self, size=0.2):
        super().__init__(size)

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        phase = K * atoms.positions + [0.1, 0.5, 0.9]
        energy = float((self.stiffness * np.cos(phase) / K).sum())
        self.results = {"energy": energy, "forces": self.stiffness * np.sin(phase)}


class Pairs(Field):
    """Pairs with a twist: forces add up to nothing and know no place."""

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        x = atoms.positions - atoms.positions.mean(axis=0)
        self.results["forces"] = -0.1 * x + 0.05 * np.cross([0.2, 0.1, 1.0], x)


def waters(n=3, calc=None, momenta=True, zero_momentum=False) -> Atoms:
    atoms, _ = rigid(n, temperature=None)
    atoms.calc = Waves() if calc is None else calc
    if momenta:
        draw_velocities(atoms, 300.0, 1, zero_momentum=zero_momentum)
    return atoms


def made(kind, atoms, step=FS, **options):
    if kind == "isokinetic":
        return IsokineticDynamics(atoms, step, **{"temperature_K": 300, **options})
    if kind == "langevin":
        return ConstrainedLangevin(atoms, step, **{"temperature_K": 300, "friction": 0.02 / FS, "rng": 5, **options})
    if kind == "nose-hoover":
        return ConstrainedNoseHoover(atoms, step, **{"temperature_K": 300, "tdamp": 50 * FS, **options})
    if kind == "monte carlo":
        return ConstrainedMonteCarlo(atoms, step, **{"temperature_K": 300, "steps": (2, 5), "rng": 7, **options})
    bath = "spheres" if kind == "spheres" else "langevin"
    return MultipleTimeSteps(atoms, step, **{"fast": Waves(), "slow": Waves(0.05), "bath": bath, **TWO, **options})


THREE = pytest.mark.parametrize("kind", ["isokinetic", "langevin", "nose-hoover"])
ALL = pytest.mark.parametrize("kind", ["isokinetic", "langevin", "nose-hoover", "monte carlo", "two steps", "spheres"])

# -- what is held -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("calc", "fixed", "g"), [(Waves, [], 18), (Pairs, [], 15), (Pairs, [0], 15), (Waves, [0, 1, 2], 12)]
)
def test_isokinetic_holds_the_right_kinetic_energy(calc, fixed, g):
    """2K = (g - 1) kT with g by hand: 27 coordinates less 9 rows, less conserved momenta, less fixed atoms."""
    atoms = waters(calc=calc())
    if fixed:
        # three components each; a whole molecule makes its three rows redundant
        assert g == 27 - 9 - (3 * len(fixed) - 3 * (len(fixed) == 3))
        atoms.set_constraint(Constraints([*atoms.constraints[0].constraints, FixedAtoms(fixed)]))
    draw_velocities(atoms, 100, 3, zero_momentum=calc is Pairs and not fixed)
    moving = IsokineticDynamics(atoms, FS, temperature_K=320)
    for _ in range(3):
        assert 2 * atoms.get_kinetic_energy() == pytest.approx((g - 1) * units.kB * 320, rel=1e-12)
        assert moving.thermostat_degrees_of_freedom == g
        assert moving.get_temperature() == pytest.approx(320, rel=1e-12)
        moving.run(20)
    moving.set_temperature(200)
    for _ in range(2):
        assert 2 * atoms.get_kinetic_energy() == pytest.approx((g - 1) * units.kB * 200, rel=1e-12)
        moving.run(20)
    IsokineticDynamics(atoms, FS).run(5)  # what the atoms have
    assert 2 * atoms.get_kinetic_energy() == pytest.approx((g - 1) * units.kB * 200, rel=1e-12)


@ALL
def test_the_conserved_energies(kind):
    atoms = waters()
    moving = made(kind, atoms)
    if kind in ("monte carlo", "spheres"):
        with pytest.raises(UnsupportedError, match="conserves nothing like an energy"):
            moving.get_conserved_energy()
        return
    values, energies = [], []
    moving.attach(lambda: values.append(moving.get_conserved_energy()), interval=10)
    moving.attach(lambda: energies.append(atoms.get_total_energy()), interval=10)
    moving.run(400)
    assert np.ptp(values) <= 1e-3
    assert np.ptp(energies) >= 50 * np.ptp(values)


def test_two_degrees_of_freedom_at_constant_kinetic_energy_are_said():
    held = Constraints([Distance([0, 1]), FixedAtoms([0])])
    atoms = Atoms("HCl", [[0, 0, 0], [1.3, 0.2, 0]], constraint=held, calculator=Waves())
    draw_velocities(atoms, 300.0, 1)
    with pytest.warns(UserWarning, match="two degrees of freedom.*Use Langevin"):
        made("isokinetic", atoms).run(1)


def test_the_chain_has_the_constants_of_ase():
    moving = made("nose-hoover", waters(), tchain=4)
    np.testing.assert_allclose(moving.stepper._masses(18)[:2], [18 * KT * (50 * FS) ** 2, KT * (50 * FS) ** 2])
    moving.run(3)
    assert moving.state.thermostat.shape == (9,) and moving.thermostat_degrees_of_freedom == 18


def test_targets_that_move_and_input_that_is_refused_before_anything_changes():
    first, rate = waters(2).get_distance(0, 3), 0.003 / FS
    pulled = {"constraints": Distance([[0, 3]], lambda t: first + rate * t)}
    atoms = waters(2)
    made("langevin", atoms, **pulled).run(50)
    assert atoms.get_distance(0, 3) == pytest.approx(first + rate * 50 * FS, abs=1e-12)
    refused = [(kind, pulled, "targets move") for kind in ("nose-hoover", "isokinetic", "monte carlo", "spheres")]
    for kind, options, said in [*refused, ("spheres", {"spheres": "axes", "auxiliary": 0}, "radius 0")]:
        atoms = waters(2)
        before, calculator = state(atoms), atoms.calc
        with pytest.raises((InputError, UnsupportedError), match=said):
            made(kind, atoms, **options)
        assert equal(state(atoms), before) and atoms.calc is calculator


# -- restarts ---------------------------------------------------------------------------------------


@ALL
@pytest.mark.parametrize("at", [0.0, 1e5])
def test_a_saved_run_goes_on_to_the_last_bit(kind, at, tmp_path):
    atoms = waters()
    atoms.positions += at
    moving = made(kind, atoms)
    moving.run(15)
    moving.state.save(tmp_path / "state.npz")
    given, time = moving.state.copied(), moving.get_time()
    moving.run(15)
    for start in (State.load(tmp_path / "state.npz"), given):
        again = waters(momenta=False)
        resumed = made(kind, again, state=start)
        assert resumed.nsteps == 15 and resumed.get_time() == time
        resumed.run(15)
        assert equal(state(atoms), state(again))
        np.testing.assert_array_equal(moving.state.thermostat, resumed.state.thermostat)
        assert resumed.nsteps == 30


@THREE
def test_a_restart_asks_the_calculator_for_forces(kind):
    """Those of a file may be of another calculator: the run goes on as one from positions and velocities alone."""
    moving = made(kind, waters())
    moving.run(3)
    saved = moving.state
    assert saved.forces is not None
    bare = State(saved.positions, saved.velocities, saved.time, step=saved.step, thermostat=saved.thermostat)
    ends = []
    for given in (saved, bare):
        atoms = waters(calc=Pairs(), momenta=False)
        made(kind, atoms, state=given, **({} if kind == "langevin" else {"momentum": "free"})).run(2)
        ends.append(state(atoms))
    assert equal(*ends)


# -- changes by others ------------------------------------------------------------------------------


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


@THREE
def test_momenta_set_in_between_are_used(kind):
    atoms = waters()
    moving = made(kind, atoms)
    moving.run(5)
    chain = moving.state.thermostat.copy()
    draw_velocities(atoms, 900, 3)
    moving.run(1)
    if kind == "isokinetic":
        assert 2 * atoms.get_kinetic_energy() == pytest.approx(17 * KT, rel=1e-12)
    else:
        assert 2 * atoms.get_kinetic_energy() / 18 > 1.5 * KT
        assert np.abs(moving.state.thermostat - chain).max() <= 0.5  # the chain and the heat go on


def test_another_calculator_on_the_atoms():
    """Its energies would be logged, and its forces not used."""
    atoms = waters()
    moving = made("two steps", atoms, 4 * FS)
    moving.run(2)
    whole, before = atoms.calc, state(atoms)
    atoms.calc = Waves()
    with pytest.raises(InputError, match=r"another calculator, .* make another MultipleTimeSteps"):
        moving.run(1)
    assert equal(state(atoms), before)
    atoms.calc = whole
    moving.run(1)
    assert moving.evaluations == {"fast": 13, "slow": 4}
    with pytest.raises(TypeError, match="steps"):  # and not one of both without a word
        made("two steps", atoms, steps={"slow": 1, "fast": 2})


# -- Monte Carlo ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("stepper", "step"), [(None, 5), (BlanesMoan4(), 13)], ids=repr)
def test_monte_carlo_is_what_arrays_give(stepper, step):
    atoms = waters(2, Field(0.4))
    dyn = made("monte carlo", atoms, step * FS, temperature_K=400, keep=0.4, stepper=stepper)
    x = atoms.positions.copy()
    alone = Atoms(atoms.symbols, x, calculator=Field(0.4))

    def asked(question):
        def answer(x, t):
            alone.positions[:] = x
            return question()

        return answer

    motion = Motion(dyn.motion.constraint_set, x)
    system = System(motion, asked(alone.get_forces), potential=asked(alone.get_potential_energy))
    core = HamiltonianMonteCarlo(units.kB * 400, (2, 5), 7, stepper=stepper, keep=0.4)
    there = run(system, State(x, atoms.get_velocities()), step * FS, 12, stepper=core)
    dyn.run(12)
    np.testing.assert_allclose(atoms.positions, there.positions, atol=1e-9)
    np.testing.assert_allclose(atoms.get_velocities(), there.velocities, atol=1e-9)
    assert 0 < dyn.counts.accepted <= 12 == dyn.counts.proposals
    assert dyn.get_time() == pytest.approx(there.time)


# -- several time steps -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["two steps", "spheres"])
def test_several_time_steps_are_those_of_the_core(kind):
    atoms = waters(2)
    moving = made(kind, atoms, 4 * FS)

    def wave(x):
        return np.sin(K * x + [0.1, 0.5, 0.9])

    groups = ForceGroups({"fast": lambda x, t: 0.2 * wave(x), "slow": lambda x, t: 0.05 * wave(x)})
    system = System(moving.motion, groups)
    core = IsokineticSpheres if kind == "spheres" else LangevinRespa
    stepper = core(KT, 0.01 / FS, 3, steps={"slow": 1, "fast": 4})
    end = run(system, State(atoms.positions.copy(), atoms.get_velocities()), 4 * FS, 5, stepper=stepper)
    moving.run(5)
    np.testing.assert_allclose(atoms.positions, end.positions, rtol=0, atol=1e-12)
    assert moving.listing() == stepper.listing(system)
    assert moving.evaluations == {"fast": 21, "slow": 6}


def test_expensive_less_fast_is_the_same_as_the_rest():
    """As fast .2 and slow .05 waves: expensive .25 and fast .2."""
    one, two, expensive = waters(2), waters(2), Waves(0.25)
    made("two steps", one, 4 * FS).run(5)
    moving = made("two steps", two, 4 * FS, slow=expensive, difference=True)
    moving.run(5)
    np.testing.assert_allclose(one.positions, two.positions, rtol=0, atol=1e-12)
    assert two.calc is expensive and expensive.calls == 6
    assert one.get_potential_energy() == pytest.approx(two.get_potential_energy(), rel=1e-12)
    assert moving.evaluations["slow"] == 6


def test_logs_and_trajectories_cost_no_call(tmp_path):
    atoms, slow = waters(2), Waves(0.05)
    files = {"trajectory": str(tmp_path / "run.traj"), "logfile": str(tmp_path / "run.log")}
    made("two steps", atoms, 4 * FS, slow=slow, **files).run(4)
    assert slow.calls == 5
    frames = read(files["trajectory"], ":")
    assert len(frames) == 5
    both = Waves().get_potential_energy(atoms) + Waves(0.05).get_potential_energy(atoms)
    assert frames[-1].get_potential_energy() == pytest.approx(both, rel=1e-12)
    assert len((tmp_path / "run.log").read_text().splitlines()) == 6


def test_forces_that_ase_objects_add():
    one, two, without = waters(2), waters(2, Waves(0.25)), waters(2, Waves(0.25))
    for atoms in (one, two):
        atoms.constraints = [*atoms.constraints, ExternalForce(0, 5, 0.3)]
    made("two steps", one, fast_steps=2, friction=0.0).run(3)
    for atoms in (two, without):
        made("langevin", atoms, FS / 8, friction=0.0).run(24)
    np.testing.assert_allclose(one.positions, two.positions, rtol=0, atol=2e-5)
    assert np.abs(two.positions - without.positions).max() > 1e-3


# -- velocities -------------------------------------------------------------------------------------


def test_drawn_velocities():
    atoms = waters()
    a = atoms.get_momenta()
    draw_velocities(atoms, 300, np.random.default_rng(1))
    assert np.array_equal(a, atoms.get_momenta())
    rows = atoms.constraints[0].engine(atoms).constraint_set.jacobian(atoms.positions)
    assert np.abs(rows @ atoms.get_velocities().ravel()).max() <= 1e-15
    draw_velocities(atoms, 300, 2, zero_momentum=True)
    assert np.abs(atoms.get_momenta().sum(axis=0)).max() <= 1e-13
    before, held = state(atoms), waters()
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
