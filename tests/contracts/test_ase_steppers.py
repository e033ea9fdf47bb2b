"""ConstrainedDynamics with every stepper: orders, boxes, restarts, reversal, far from the origin, bad calculators."""

from __future__ import annotations

import pickle
from functools import cache

import numpy as np
import pytest
from ase import Atoms
from ase.build import molecule
from ase.calculators.emt import EMT
from ase.io import read
from ase.md.velocitydistribution import thermalize_momenta
from ase.md.verlet import VelocityVerlet
from ase.optimize import BFGS
from ase_systems import FS, Field, Free, equal, off, random, state, unavoidable, water

from kcons.ase import ConstrainedDynamics, constrain, rigid_water
from kcons.constraints import Angle, Distance, KnifeEdge, Sphere
from kcons.constraints.target import MovingTarget
from kcons.errors import InputError, KconsError, NonFiniteError, UnsupportedError
from kcons.steppers import (
    Baumgarte,
    BlanesMoan4,
    BlanesMoan6,
    BlanesMoan6a,
    Geodesic,
    KahanLi6,
    ProjectedRungeKutta4,
    ProjectedVerlet,
    Rattle,
    ReversibilityCheck,
    State,
    Suzuki4,
    Yoshida4,
)

SYMMETRIC = [
    Rattle(), Geodesic(), Suzuki4(), Yoshida4(), KahanLi6(), BlanesMoan4(), BlanesMoan6(), BlanesMoan6a(),
    ReversibilityCheck(Rattle()),
]  # fmt: skip
PROJECTED = [ProjectedVerlet(project=True), ProjectedRungeKutta4(project=True), Baumgarte(0.1 / FS)]
every = pytest.mark.parametrize("stepper", SYMMETRIC + PROJECTED, ids=repr)
#: Baumgarte's steps leave the constraints; atoms that were moved or read from a file are brought back onto them.
that_stay = pytest.mark.parametrize("stepper", SYMMETRIC + PROJECTED[:2], ids=repr)
symmetric = pytest.mark.parametrize("stepper", SYMMETRIC, ids=repr)


def driven(temperature=600.0, at=0.0, calc=None) -> tuple[Atoms, list[Distance]]:
    """Water with one O-H length that swings, and the other held."""
    atoms = molecule("H2O")
    atoms.positions += at
    atoms.calc = Field() if calc is None else calc
    thermalize_momenta(atoms, temperature, rng=random(3))
    length, w = atoms.get_distance(0, 1), 0.3 / FS
    swing = MovingTarget(
        lambda t: length + 0.1 * np.sin(w * t),
        lambda t: 0.1 * w * np.cos(w * t),
        lambda t: -0.1 * w**2 * np.sin(w * t),
    )
    return atoms, [Distance([0, 1], swing), Distance([0, 2])]


# -- orders -----------------------------------------------------------------------------------------


def ethanol_case():
    atoms = molecule("CH3CH2OH")
    atoms.calc = EMT()
    BFGS(atoms, logfile=None).run(fmax=0.01)
    constrain(atoms, [Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2]])])
    thermalize_momenta(atoms, 50, rng=random())
    return atoms, EMT, {}, 12 * FS


def rotating_case():
    """Fast rotation: b depends on the velocities."""
    return water(temperature=1000)[0], Field, {}, 24 * FS


def driven_case():
    atoms, rows = driven()
    return atoms, Field, {"constraints": rows}, 24 * FS


def skate_case():
    atoms = Atoms("CO", positions=[[0.5, 0, 0], [1.6, 0, 0]])
    atoms.set_momenta([[9.0, 3.0, 0], [3.0, -6.0, 0]])
    constrain(atoms, Distance([0, 1]))
    return atoms, Field, {"constraints": KnifeEdge(0, 1, [0, 0, 1])}, 24 * FS


def final(case, by, n) -> np.ndarray:
    """Positions and velocities at the end, reached in n steps."""
    atoms, calculator, options, time = case()
    atoms.calc = calculator()
    ConstrainedDynamics(atoms, time / n, by, **options).run(n)
    return np.concatenate([atoms.positions, atoms.get_velocities() * FS])


@cache
def exact(case) -> np.ndarray:
    return final(case, KahanLi6(), 24) if case is skate_case else final(case, BlanesMoan6(), 48)


def errors(case, stepper, numbers) -> np.ndarray:
    """Errors of positions and velocities after the same time by different numbers of steps."""
    return np.array([np.abs(final(case, stepper, n) - exact(case)).max() for n in numbers])


@pytest.mark.parametrize("case", [ethanol_case, rotating_case, driven_case], ids=lambda c: c.__name__)
@pytest.mark.parametrize("stepper", SYMMETRIC[:-1], ids=repr)
def test_order(stepper, case):
    numbers = np.array([6, 12] if stepper.order == 6 else [12, 24])
    seen = errors(case, stepper, numbers)
    assert seen.min() > 30 * 4e-14  # well above rounding
    assert np.log2(seen[0] / seen[1]) == pytest.approx(stepper.order, abs=0.15)


@pytest.mark.parametrize("stepper", [Rattle(), Suzuki4(), KahanLi6()], ids=repr)
def test_order_with_a_velocity_row(stepper):
    seen = errors(skate_case, stepper, np.array([3, 6]) * (2 if stepper.order < 6 else 1))
    assert seen.min() > 30 * 1e-14
    assert np.log2(seen[0] / seen[1]) == pytest.approx(stepper.order, abs=0.15)


def test_higher_order_needs_fewer_evaluations():
    # At about the same number of evaluations, 144 of them.
    seen = {}
    for stepper, steps in ((Rattle(), 144), (BlanesMoan4(), 24), (BlanesMoan6(), 13)):
        seen[stepper.order] = errors(rotating_case, stepper, np.array([steps]))[0]
    assert seen[4] < seen[2] / 500
    assert seen[6] < seen[4] / 500


# -- ASE's conventions ------------------------------------------------------------------------------


@that_stay
def test_molecule_across_the_boundary(stepper):
    found = []
    for wrapped in (False, True):
        atoms, held = water(Free())
        atoms.set_cell([[6.0, 0, 0], [1.0, 6.5, 0], [0, 0.5, 7.0]])
        atoms.pbc = True
        atoms.positions -= atoms.positions[0]  # on the corner
        dyn = ConstrainedDynamics(atoms, FS, stepper)
        if wrapped:
            dyn.attach(atoms.wrap)
        dyn.run(20)
        found.append(atoms)
    whole, cut = found
    turns = (cut.positions - whole.positions) @ np.linalg.inv(cut.cell.array)
    assert np.abs(turns - np.round(turns)).max() <= 1e-12
    assert np.ptp(np.round(turns), axis=0).max() > 0
    assert off(cut, held) <= 1e-13


@every
def test_observers_log_and_frames(stepper, tmp_path):
    atoms, _ = water()
    path = tmp_path / "md.traj"
    with ConstrainedDynamics(atoms, FS, stepper, trajectory=str(path), loginterval=2) as dyn:
        assert [dyn.nsteps for _ in dyn.irun(4)] == [0, 1, 2, 3, 4]
    frames = read(path, index=":")
    assert len(frames) == 3
    for frame in frames:
        x = frame.positions
        assert frame.get_potential_energy() == pytest.approx(0.025 * (x**2).sum(), rel=1e-13)
        assert frame.get_forces(apply_constraint=False) == pytest.approx(-0.05 * x, rel=1e-13)


@that_stay
def test_runs_in_pieces_and_restarts_are_identical_to_the_last_bit(stepper, tmp_path):
    whole, _ = water()
    path = tmp_path / "md.traj"
    with ConstrainedDynamics(whole, FS, stepper, trajectory=str(path)) as dyn:
        dyn.run(8)
    pieces, _ = water()
    dyn = ConstrainedDynamics(pieces, FS, stepper)
    dyn.run(3)
    dyn.run(5)
    assert equal(state(pieces), state(whole))
    again = read(path, index=3)
    again.calc = Field()
    ConstrainedDynamics(again, FS, stepper).run(5)
    assert equal(state(again), state(whole))


@pytest.mark.parametrize("way", ["file", "pickle"])
@pytest.mark.parametrize("at", [0.0, 1e6])
@every
def test_restart_from_a_state(stepper, at, way, tmp_path):
    # A target that moves, and far from the origin: time and positions are known better than their last digit.
    whole, rows = driven(at=at, calc=Free())
    dyn = ConstrainedDynamics(whole, 0.3 * FS, stepper, constraints=rows)
    dyn.run(5)
    if way == "file":
        dyn.state.save(tmp_path / "state.npz")
        saved = State.load(tmp_path / "state.npz")
    else:
        saved = pickle.loads(pickle.dumps(dyn.state))
    dyn.run(7)
    again, rows = driven(at=at, calc=Free())
    other = ConstrainedDynamics(again, 0.3 * FS, stepper, constraints=rows, state=saved)
    seen = []
    other.attach(lambda: seen.append(other.nsteps), interval=4)
    other.run(7)
    assert equal(state(again), state(whole))
    assert other.get_time() == dyn.get_time()
    assert seen == [8, 12]  # as if there had been no break


def test_state_of_other_atoms_is_refused():
    atoms, _ = water()
    saved = ConstrainedDynamics(atoms, FS).state
    before = state(atoms)
    with pytest.raises(InputError, match="positions must have shape"):
        ConstrainedDynamics(molecule("CH3CH2OH"), FS, state=saved)
    other = molecule("H2O")
    other.positions[1] *= 1.1
    constrain(other, rigid_water(other))
    x = other.get_positions()
    with pytest.raises(InputError, match="off row"):
        ConstrainedDynamics(other, FS, state=saved)
    assert np.array_equal(other.positions, x)
    moving = State(saved.positions, np.ones((3, 3)) * [[1], [2], [3]])
    with pytest.raises(InputError, match="velocities of the state leave the constraints"):
        ConstrainedDynamics(atoms, FS, state=moving)
    assert equal(state(atoms), before)


# -- time steps -------------------------------------------------------------------------------------


@every
def test_zero_step_changes_nothing(stepper):
    atoms, _ = water()
    before = state(atoms)
    ConstrainedDynamics(atoms, 0.0, stepper).run(3)
    assert equal(before, state(atoms))


@symmetric
def test_step_changed_on_the_fly_and_taken_back(stepper):
    atoms, held = water()
    before = state(atoms)
    dyn = ConstrainedDynamics(atoms, FS, stepper)
    dyn.run(10)
    dyn.set_timestep(0.4 * FS)
    dyn.run(5)
    assert dyn.get_time() == pytest.approx(12 * FS)
    dyn.set_timestep(-0.4 * FS)
    dyn.run(5)
    dyn.set_timestep(-FS)
    dyn.run(10)
    assert all(np.abs(a - b).max() <= 1e-12 for a, b in zip(before, state(atoms), strict=True))
    assert dyn.get_time() == pytest.approx(0, abs=1e-13)
    assert off(atoms, held) <= 1e-14


def test_steppers_refuse_what_they_cannot_do():
    atoms, _ = water()
    with pytest.raises(UnsupportedError, match="great circles need rows"):
        ConstrainedDynamics(atoms, FS, Geodesic(great_circles=True))
    ball = Atoms("Ar", positions=[[2.0, 0, 0]], calculator=Free())
    ball.set_momenta([[0, 5.0, 0]])
    constrain(ball, Sphere([0], [0, 0, 0]))
    dyn = ConstrainedDynamics(ball, 20 * FS, Geodesic(great_circles=True))
    dyn.run(100)
    angle = np.linalg.norm(ball.get_velocities()) * dyn.get_time() / 2.0
    assert ball.positions[0] == pytest.approx([2 * np.cos(angle), 2 * np.sin(angle), 0], abs=1e-11)


# -- far from the origin ----------------------------------------------------------------------------


def free_dumbbell(at):
    atoms = Atoms("CO", positions=np.array([[0, 0, 0], [1.1, 0, 0]]) + at, calculator=Free())
    held = constrain(atoms, Distance([0, 1]))
    thermalize_momenta(atoms, 300, rng=random(3))
    return atoms, held


@symmetric
def test_energy_far_from_the_origin(stepper):
    atoms, held = free_dumbbell(1e6)
    kinetic = atoms.get_kinetic_energy()
    ConstrainedDynamics(atoms, 0.02 * FS, stepper).run(1000 if stepper.force_evaluations < 3 else 200)
    assert abs(atoms.get_kinetic_energy() / kinetic - 1) <= 1e-10
    assert off(atoms, held) <= unavoidable(atoms, 1.1)


def test_the_velocity_rule_of_ase_far_from_the_origin():
    atoms, _ = free_dumbbell(1e6)
    kinetic = atoms.get_kinetic_energy()
    VelocityVerlet(atoms, 0.02 * FS).run(1000)
    assert 1e-6 < abs(atoms.get_kinetic_energy() / kinetic - 1) < 1e-3


# -- calculators that fail --------------------------------------------------------------------------


def no_numbers(forces):
    forces[1, 2] = np.nan
    return forces


def no_result(forces):
    raise RuntimeError("no convergence")


FAILURES = {
    "nan": (no_numbers, NonFiniteError, "non-finite force at step 4 on atom 1"),
    "shape": (lambda f: f[:2], InputError, r"shape \(2, 3\) at step 4"),
    "raises": (no_result, RuntimeError, "no convergence"),
}


@pytest.mark.parametrize("case", FAILURES)
@every
def test_bad_calculator_at_a_step(stepper, case, tmp_path):
    how, error, message = FAILURES[case]
    good, _ = water()
    undisturbed = ConstrainedDynamics(good, FS, stepper)
    undisturbed.run(3)
    path = tmp_path / "md.traj"
    atoms, _ = water(Field(how=how))
    with ConstrainedDynamics(atoms, FS, stepper, trajectory=str(path)) as dyn:

        def spoil():
            if dyn.nsteps == 3:
                atoms.calc.bad = 0

        dyn.attach(spoil)
        with pytest.raises(error, match=message) as caught:
            dyn.run(20)
        assert dyn.nsteps == 3
    assert caught.value.step == 4
    assert case == "raises" or isinstance(caught.value, KconsError)
    if case == "raises":
        assert any("in step 4" in note for note in caught.value.__notes__)
    assert equal(state(atoms), state(good))
    frames = read(path, index=":")
    assert len(frames) == 4
    assert equal(state(frames[-1]), state(good))
    # With a calculator that works, the run goes on as if nothing had happened.
    atoms.calc = Field()
    dyn.observers.clear()
    dyn.run(2)
    undisturbed.run(2)
    assert equal(state(atoms), state(good))


@pytest.mark.parametrize("stepper", [BlanesMoan6a(), ProjectedRungeKutta4()], ids=repr)
def test_bad_forces_for_an_observer(stepper):
    # These do not end with the forces at the last positions, which are computed for observers only.
    atoms, _ = water(Field(how=no_numbers))
    dyn = ConstrainedDynamics(atoms, FS, stepper)
    dyn.attach(atoms.get_potential_energy, interval=2)
    dyn.run(1)
    atoms.calc.bad = atoms.calc.calls + stepper.force_evaluations
    with pytest.raises(NonFiniteError, match="at step 2"):
        dyn.run(1)
