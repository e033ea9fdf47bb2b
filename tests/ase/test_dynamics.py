"""ConstrainedDynamics as one of ASE's classes: files, observers, changes by others between steps, time steps, logs."""

from __future__ import annotations

import io

import ase
import numpy as np
import pytest
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.emt import EMT
from ase.constraints import FixAtoms, FixBondLengths, FixCartesian
from ase.io import read
from ase.io.trajectory import Trajectory
from ase.md.verlet import VelocityVerlet
from ase_systems import FS, Field, Free, equal, rigid, state, water
from h5py import File

from kcons.ase import (
    ConstrainedDynamics,
    ConstrainedLangevin,
    ConstrainedMonteCarlo,
    ConstrainedNoseHoover,
    ConstraintLogger,
    IsokineticDynamics,
    PressureReporter,
    attach,
    constrain,
    draw_velocities,
)
from kcons.constraints import Angle, Dihedral, Distance, FixedAtoms
from kcons.errors import InputError, KconsError
from kcons.free_energy import AseRecorder
from kcons.mdanalysis import write_ase
from kcons.steppers import BlanesMoan6a, Rattle

# -- ASE's conventions ------------------------------------------------------------------------------


def test_trajectory_log_and_observers(tmp_path):
    atoms, _ = rigid()
    seen, log, path = [], io.StringIO(), tmp_path / "md.traj"
    with ConstrainedDynamics(atoms, FS, Rattle(), trajectory=str(path), logfile=log, loginterval=2) as dyn:
        dyn.attach(lambda: seen.append(dyn.nsteps), interval=3)
        assert [done for done in dyn.irun(6)] == [False] * 6 + [True]
        dyn.run(4)
    frames = read(path, index=":")
    assert len(frames) == 6
    assert seen == [0, 3, 6, 9]
    assert len(log.getvalue().splitlines()) == 7
    assert np.array_equal(frames[-1].positions, atoms.positions)
    assert [row.family for row in attach(frames[-1]).constraints] == ["Distance"]
    with Trajectory(path) as file:
        assert [file.description[key] for key in ("md-type", "stepper")] == ["ConstrainedDynamics", "Rattle()"]


def test_a_refused_start_leaves_the_files_of_an_older_run(tmp_path):
    atoms, _ = water()
    files = {"trajectory": str(tmp_path / "md.traj"), "logfile": str(tmp_path / "md.log")}
    with ConstrainedDynamics(atoms, FS, **files) as dyn:
        dyn.run(2)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert sorted(before) == ["md.log", "md.traj"]
    atoms.set_momenta(np.zeros((len(atoms), 3)))  # nothing that could be scaled
    with pytest.raises(InputError):
        IsokineticDynamics(atoms, FS, 300.0, **files)
    atoms.positions[0] += 0.1
    with pytest.raises(InputError, match="atoms are off row"):
        ConstrainedDynamics(atoms, FS, **files)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.skipif(ase.__version__ < "3.28", reason="ASE's own loop asked for forces in each step")
def test_forces_are_not_computed_for_nobody():
    """This stepper does not end with them."""
    atoms, _ = water()
    dyn = ConstrainedDynamics(atoms, FS, stepper := BlanesMoan6a())
    dyn.run(10)
    assert atoms.calc.calls == 10 * stepper.force_evaluations
    dyn.attach(atoms.get_potential_energy, 5)
    dyn.run(10)
    assert atoms.calc.calls == 20 * stepper.force_evaluations + 2


#: Changes of fixed atoms, fixed components, held lengths and ours, and atoms that are at rest afterwards.
CHANGES = {
    "index": (lambda a, c, d, ours: setattr(a, "index", np.array([7])), [7]),
    "index in place": (lambda a, c, d, ours: a.index.__setitem__(0, 7), [7]),
    "mask": (lambda a, c, d, ours: c.mask.__setitem__(slice(None), True), [8]),
    "lengths": (lambda a, c, d, ours: vars(d).update(pairs=np.array([[1, 2], [3, 5]]), bondlengths=None), []),
    "rows": (lambda a, c, d, ours: setattr(ours, "constraints", (*ours.constraints, Distance([3, 5]))), []),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_constraints_hold_changed_between_steps_is_taken(name):
    """The objects on the atoms are the same: dynamics go on as new ones would, which see them so from the start."""
    atoms, (change, rest) = molecule("CH3CH2OH"), CHANGES[name]
    atoms.calc = EMT()
    items = [FixAtoms([6]), FixCartesian([8], (True, False, False)), FixBondLengths([[1, 2]])]
    atoms.set_constraint(items)
    items.append(constrain(atoms, Distance([0, 4])))
    draw_velocities(atoms, 300, rng=1)
    dyn = ConstrainedDynamics(atoms, FS)
    dyn.run(2)
    engine = dyn.motion
    dyn.run(1)
    assert dyn.motion is engine
    change(*items)
    again, before = atoms.copy(), atoms.get_positions()
    again.calc = EMT()
    dyn.run(2)
    ConstrainedDynamics(again, FS).run(2)
    np.testing.assert_allclose(atoms.positions, again.positions, rtol=0, atol=1e-13)
    assert np.array_equal(atoms.positions[rest], before[rest])
    assert dyn.motion is not engine


@pytest.mark.parametrize(("name", "value"), [("masses", 30.0), ("numbers", 18)])
def test_masses_of_free_atoms_changed_between_steps_are_taken(name, value):
    """No row touches them."""
    atoms = Atoms("H4", positions=np.diag([1.0, 2.0, 3.0, 4.0])[:, :3], calculator=Field())
    if name == "masses":
        atoms.set_masses([1.0, 2.0, 3.0, 1.0])
    constrain(atoms, Distance([[0, 1]]))
    dyn = ConstrainedDynamics(atoms, FS)
    atoms.arrays[name][2] = value
    again = atoms.copy()
    again.calc = Field()
    dyn.run(3)
    ConstrainedDynamics(again, FS).run(3)
    assert equal(state(atoms), state(again))


@pytest.mark.parametrize(("kept", "size"), [(np.asfortranarray, 1.0), (lambda p: p.astype(int), 0.0)])
def test_momenta_in_arrays_of_another_order_or_kind_are_taken(kept, size):
    """As ``atoms.arrays["momenta"] = (masses * v.T).T`` leaves them: what is written to these would be lost."""
    atoms, _ = water()
    atoms.arrays["momenta"] *= size
    again = atoms.copy()
    again.calc, again.arrays["momenta"] = Field(), kept(again.arrays["momenta"])
    for each in (atoms, again):
        ConstrainedDynamics(each, FS).run(3)
    assert equal(state(atoms), state(again))


# -- time steps -------------------------------------------------------------------------------------


@pytest.mark.parametrize("long", [2.0, -2000 * FS], ids=["without units", "back"])
def test_a_step_that_looks_like_a_slip_of_units_is_asked_about(long):
    """2 is 20.4 fs; 20 fs are nobody's slip."""
    with pytest.warns(UserWarning, match=rf"is {long / FS:.4g} fs. Is that meant.*2 \* ase.units.fs"):
        dyn = ConstrainedDynamics(water()[0], long)
    dyn.set_timestep(20 * FS)


@pytest.mark.parametrize(
    ("kind", "step", "options", "said"),
    [
        (ConstrainedLangevin, -2, {"friction": 0.01 / FS}, "the time step is -2 fs; noise"),
        (ConstrainedMonteCarlo, -0.5, {"steps": 5}, "the time step is -0.5 fs; noise"),
        (ConstrainedNoseHoover, 20, {"tdamp": 1e-4 * FS, "momentum": "free"}, "period 0.000628319 fs .* step of 20 fs"),
    ],
)
def test_times_in_errors_are_in_fs(kind, step, options, said):
    atoms, _ = water()
    with pytest.raises(KconsError, match=said):
        kind(atoms, step * FS, 300, **options).run(1)


# -- logs: the temperature by all rows, and multipliers by name ---------------------------------------


TORSION = Dihedral([[3, 2, 1, 0]])
ROWS = [Distance([[0, 1], [1, 2]]), TORSION]


def moving() -> Atoms:
    atoms = molecule("CH3CH2OH")
    atoms.calc = EMT()
    draw_velocities(atoms, 300, rng=1)
    return atoms


def columns(log: io.StringIO) -> np.ndarray:
    return np.array([line.split() for line in log.getvalue().splitlines()[1:]], dtype=float)


def test_with_noise_the_log_is_of_the_middle_of_the_step():
    """As warm as the bath, to 5 standard errors, where the momenta at the ends of steps are a quarter colder.

    The frequency of each atom times the step is 1: at its ends BAOAB has 1 - 1/4 of the temperature.
    """
    atoms, step, log, ends = Atoms("Ar50"), 10 * units.fs, io.StringIO(), []
    atoms.calc = Field(float(atoms.get_masses()[0]) / step**2)
    draw_velocities(atoms, 300, rng=1)
    dynamics = ConstrainedLangevin(atoms, step, 300, 0.5 / step, rng=2)
    dynamics.run(50)
    dynamics.attach(ConstraintLogger(dynamics, atoms, log))
    dynamics.attach(lambda: ends.append(atoms.get_temperature()))
    dynamics.run(1700)
    found = columns(log)
    total, potential, kinetic, temperature = found[:, 1:].T
    error = 300 * np.sqrt(2 / 150 / (len(found) / 3))  # friction leaves a third of the samples independent
    assert error < 1.5
    assert temperature.mean() == pytest.approx(300, abs=5 * error)
    assert np.mean(ends) == pytest.approx(225, abs=5 * error)
    assert temperature == pytest.approx(2 * kinetic / (150 * units.kB), abs=0.5)
    assert total == pytest.approx(potential + kinetic, abs=2e-3)
    draw_velocities(atoms, 300, rng=3)  # these are nobody's middle of a step
    assert dynamics.get_kinetic_energy() == pytest.approx(atoms.get_kinetic_energy(), rel=1e-14)


@pytest.mark.parametrize("friction", [0.0, None])
def test_without_noise_the_log_is_of_the_end(friction):
    """Constant energy, also as a bath without friction, and isokinetic."""
    atoms = moving()
    if friction is None:
        dynamics = IsokineticDynamics(atoms, units.fs, 300, momentum="free")
    else:
        dynamics = ConstrainedLangevin(atoms, units.fs, 300, friction, rng=1)
    dynamics.run(2)
    assert dynamics.get_kinetic_energy() == atoms.get_kinetic_energy()


@pytest.mark.parametrize("ours", [True, False])
def test_multipliers_by_name(ours):
    """The same as those that `AseRecorder` keeps, which finds them in another way; in ASE's own dynamics too."""
    atoms, log = moving(), io.StringIO()
    if ours:
        dynamics = ConstrainedDynamics(atoms, units.fs, constraints=ROWS)
    else:
        constrain(atoms, ROWS)
        dynamics = VelocityVerlet(atoms, units.fs)
    named = {"torsion": TORSION, "bonds": Distance([[1, 0], [2, 1]])}
    recorder = AseRecorder(dynamics, {"torsion": TORSION})
    logger = ConstraintLogger(dynamics, atoms, log, named, peratom=True)
    with pytest.raises(InputError, match=r"angle, Angle\(0, 1, 2\), is not among the 3 rows"):
        ConstraintLogger(dynamics, atoms, io.StringIO(), {"angle": Angle([[0, 1, 2]])})
    dynamics.attach(recorder)
    dynamics.attach(logger)
    dynamics.run(3)
    head = log.getvalue().splitlines()[0].split()
    assert head[-3:] == ["lambda(torsion)", "lambda(bonds[0])", "lambda(bonds[1])"]
    assert columns(log)[:, 5] == pytest.approx(recorder.series.multiplier[:, 0], rel=1e-5)
    assert columns(log)[-1, 1] == pytest.approx(atoms.get_total_energy() / 9, abs=1e-4)


def test_a_rod_in_tension_and_atoms_that_are_fixed():
    """Two atoms that turn about each other: the multiplier is the centripetal force; 0 K where nothing is free."""
    atoms, log = Atoms("Ar2", positions=[[0, 0, 0], [2.0, 0, 0]], calculator=Free()), io.StringIO()
    rod = Distance([[0, 1]])
    constrain(atoms, rod)
    atoms.set_velocities([[0, -0.1, 0], [0, 0.1, 0]])
    ConstraintLogger(None, atoms, log, {"rod": rod})()
    mass = atoms.get_masses()[0]
    assert columns(log)[0, -1] == pytest.approx(-mass * 0.1**2 / 1.0, rel=1e-5)
    atoms.set_constraint()
    constrain(atoms, FixedAtoms([0, 1]))
    assert ConstrainedDynamics(atoms, units.fs).get_temperature() == 0.0


def test_fixed_atoms_that_move_have_velocities(tmp_path):
    """No force holds a rod that is carried along, whoever asks; momenta that atoms of ASE have there are zero."""
    atoms = Atoms("ArO", [[0, 0, 0], [0, 2.0, 0]], cell=[9.0] * 3, pbc=True, calculator=Free())
    log, path = io.StringIO(), tmp_path / "a.h5md"
    atoms.set_velocities([[0.5, 0, 0]] * 2)
    rod, carried = Distance([[0, 1]]), FixedAtoms([0], lambda t: [[0.5 * t, 0, 0]])
    dynamics = ConstrainedDynamics(atoms, units.fs, constraints=[rod, carried])
    dynamics.attach(recorder := AseRecorder(dynamics, {"rod": rod}))
    dynamics.attach(ConstraintLogger(dynamics, atoms, log, {"rod": rod}, stress=True))
    with write_ase(dynamics, path):
        dynamics.run(2)
    assert np.abs(columns(log)[:, [6, 11]]).max() <= 1e-12 >= np.abs(recorder.series.multiplier).max()
    with File(path) as file:
        assert np.ptp(file["particles/trajectory/velocity/value"], axis=1).max() <= 1e-9
        assert np.abs(file["observables/multipliers/value"]).max() <= 1e-9


@pytest.mark.parametrize("held_by", ["atoms", "dynamics", "ase"])
def test_stress_is_that_of_all_rows(held_by):
    """The same pressure wherever the rows are held, as `PressureReporter` has it by another way."""
    atoms, log, rows = Atoms("N2", [[0, 0, 0], [0, 0, 1.1]], cell=[6.0] * 3, pbc=True), io.StringIO(), [[0, 1], [2, 3]]
    atoms.rotate(33, [1, 2, 3])
    atoms *= (2, 1, 1)
    atoms.calc = EMT()
    atoms.set_momenta(np.random.default_rng(0).normal(size=(4, 3)))
    if held_by == "ase":
        atoms.set_constraint(FixBondLengths(rows))
    elif held_by == "atoms":
        constrain(atoms, Distance(rows))
    dynamics = ConstrainedDynamics(atoms, units.fs, constraints=[Distance(rows)] if held_by == "dynamics" else [])
    reporter = PressureReporter(dynamics, virial="atomic")
    ConstraintLogger(dynamics, atoms, log, stress=True)()
    reporter()
    tensor = -reporter.values[0] / units.GPa
    assert columns(log)[0, 5:11] == pytest.approx(tensor[(0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1)], abs=6e-4)
    assert abs(tensor[2, 2]) > 0.05
