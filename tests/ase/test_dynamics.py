"""ConstrainedDynamics as one of ASE's classes: files, observers, changes by others between steps, time steps."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.emt import EMT
from ase.constraints import FixAtoms, FixBondLengths, FixCartesian
from ase.io import read
from ase.io.trajectory import Trajectory
from ase_systems import FS, Field, equal, rigid, state, water

from kcons.ase import (
    ConstrainedDynamics,
    ConstrainedLangevin,
    ConstrainedMonteCarlo,
    ConstrainedNoseHoover,
    IsokineticDynamics,
    attach,
    constrain,
    draw_velocities,
)
from kcons.constraints import Distance
from kcons.errors import InputError, KconsError
from kcons.steppers import Rattle

# -- ASE's conventions ------------------------------------------------------------------------------


def test_trajectory_log_and_observers(tmp_path):
    atoms, _ = rigid()
    seen = []
    log = io.StringIO()
    path = tmp_path / "md.traj"
    with ConstrainedDynamics(atoms, FS, Rattle(), trajectory=str(path), logfile=log, loginterval=2) as dyn:
        dyn.attach(lambda: seen.append(dyn.nsteps), interval=3)
        assert [done for done in dyn.irun(6)] == [False] * 6 + [True]
        assert dyn.run(4) is True
    frames = read(path, index=":")
    assert len(frames) == 6
    assert seen == [0, 3, 6, 9]
    assert len(log.getvalue().splitlines()) == 7
    assert np.array_equal(frames[-1].positions, atoms.positions)
    assert [row.family for row in attach(frames[-1]).constraints] == ["Distance"]
    with Trajectory(path) as file:
        description = file.description
    assert description["md-type"] == "ConstrainedDynamics"
    assert description["stepper"] == "Rattle()"


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


def test_forces_are_not_computed_for_nobody():
    class Lazy:
        """Ends without forces, as some compositions do."""

        order, reversible, symplectic, force_evaluations = 1, False, False, 0

        def check(self, system):
            pass

        def step(self, system, state, dt):
            return replace(state, positions=state.positions + dt * state.velocities, forces=None, step=state.step + 1)

    atoms, _ = water()
    atoms.set_constraint()
    ConstrainedDynamics(atoms, FS, Lazy()).run(10)
    assert atoms.calc.calls == 0
    dyn = ConstrainedDynamics(atoms, FS, Lazy())
    dyn.attach(atoms.get_potential_energy, 5)
    dyn.run(10)
    assert atoms.calc.calls == 3


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


# -- time steps -------------------------------------------------------------------------------------


@pytest.mark.parametrize("long", [2.0, -2000 * FS, 20.1 * FS], ids=["without units", "back", "a bit"])
def test_a_step_that_looks_like_a_slip_of_units_is_asked_about(long):
    """2 is 20.4 fs; 20 fs are nobody's slip, nor are small parts of a long step (see `MultipleTimeSteps`)."""
    atoms, _ = water()
    with pytest.warns(UserWarning, match=rf"steps of {abs(long) / FS:.4g} fs. Is that meant.*2 \* ase.units.fs"):
        dyn = ConstrainedDynamics(atoms, long)
    with pytest.warns(UserWarning, match="Is that meant"):
        dyn.set_timestep(long)
    dyn.set_timestep(20 * FS)
    dyn.set_timestep(-0.5 * FS)


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


def test_the_step_and_the_temperature_are_named():
    def tired(forces):
        raise RuntimeError("SCF not converged")

    atoms, _ = water(Field(bad=3, how=tired))
    draw_velocities(atoms, 300, rng=1)
    dynamics = ConstrainedDynamics(atoms, 1 * units.fs)
    dynamics.run(2)
    before, temperature = atoms.positions.copy(), atoms.get_temperature()
    with pytest.raises(RuntimeError, match="SCF not converged") as caught:
        dynamics.run(2)
    assert np.array_equal(atoms.positions, before)
    said = " ".join(caught.value.__notes__)
    assert "in step 3" in said and f"the kinetic temperature was {temperature:.0f} K there" in said
