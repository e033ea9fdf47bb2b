"""Other ASE constraints beside ours, and input that is refused before anything is changed."""

from __future__ import annotations

import numpy as np
import pytest
from ase import units
from ase.build import molecule
from ase.calculators.emt import EMT
from ase.constraints import (
    FixAtoms,
    FixCartesian,
    Hookean,
)
from ase.md.langevin import Langevin
from ase.md.velocitydistribution import thermalize_momenta
from ase.md.verlet import VelocityVerlet
from ase.optimize import FIRE
from ase_systems import (
    Free,
    off,
    rigid,
)

from kcons.ase import ConstrainedDynamics, Constraints, constrain, rigid_water
from kcons.constraints import (
    Angle,
    Distance,
    LinearVelocity,
)
from kcons.errors import (
    ContradictionError,
    ConvergenceError,
    InputError,
    KconsError,
    SingularGeometryError,
    UnsupportedError,
)
from kcons.steppers import BlanesMoan4

# -- company ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("run", ["VelocityVerlet", "Langevin", "ConstrainedDynamics", "FIRE"])
def test_fixed_atoms_and_components_alongside(run):
    atoms = molecule("CH3CH2OH")
    atoms.calc = EMT()
    atoms.set_constraint([FixAtoms([8]), FixCartesian([7], (True, False, True)), Hookean(a1=5, a2=6, rt=1.0, k=0.5)])
    held = constrain(atoms, [Distance([[0, 1], [1, 2]]), Angle([0, 1, 2])])
    before = atoms.get_positions()
    rng = np.random.default_rng(0)
    thermalize_momenta(atoms, 100, rng=rng)
    {
        "VelocityVerlet": lambda: VelocityVerlet(atoms, 0.5 * units.fs),
        "Langevin": lambda: Langevin(
            atoms, 0.5 * units.fs, temperature_K=100, friction=0.01 / units.fs, fixcm=False, rng=rng
        ),
        "ConstrainedDynamics": lambda: ConstrainedDynamics(atoms, 0.5 * units.fs, BlanesMoan4()),
        "FIRE": lambda: FIRE(atoms, logfile=None),
    }[run]().run(steps=10)
    moved = atoms.positions - before
    assert np.array_equal(moved[8], [0, 0, 0])
    assert np.abs(moved[7, [0, 2]]).max() <= 1e-14 and abs(moved[7, 1]) > 1e-5
    assert off(atoms, held) <= 1e-13
    assert atoms.get_number_of_degrees_of_freedom() == 27 - 3 - 2 - 3


@pytest.mark.parametrize(
    ("row", "what"),
    [
        (Distance([0, 1], lambda t: 1.0 + t), "moves with time"),
        (LinearVelocity(0, [[1, 0, 0]]), "constrains velocities"),
    ],
)
def test_rows_that_need_the_time_are_refused(row, what):
    with pytest.raises(UnsupportedError, match=what):
        constrain(molecule("H2O"), row)


# -- bad input --------------------------------------------------------------------------------------


def nan_at(atom):
    atoms = molecule("H2O")
    atoms.positions[atom, 1] = np.nan
    return atoms


def with_masses(masses):
    atoms = molecule("H2O")
    atoms.set_masses(masses)
    return atoms


def boxed(length):
    atoms = molecule("H2O")
    atoms.set_cell([length] * 3)
    atoms.pbc = True
    return atoms


def coincident():
    atoms = molecule("H2O")
    atoms.positions[1] = atoms.positions[0]
    return atoms


BAD = {
    "nan position": (nan_at(1), Distance([0, 1]), InputError, "position of atom 1 is not finite"),
    "unknown atom": (molecule("H2O"), Distance([0, 7]), InputError, "no atom 7"),
    "zero mass": (with_masses([16, 0, 1]), Distance([0, 1]), InputError, "atom 1 has mass 0"),
    "negative mass": (with_masses([-16, 1, 1]), Distance([0, 1]), InputError, "atom 0 has mass -16"),
    "nan mass": (with_masses([16, np.nan, 1]), Distance([0, 1]), InputError, "atom 1 has mass nan"),
    "coincident": (coincident(), Distance([0, 1]), SingularGeometryError, "atoms 0 and 1 coincide"),
    "two lengths": (
        molecule("H2O"),
        [Distance([0, 1], 0.9), Distance([1, 0], 1.0)],
        ContradictionError,
        "different targets",
    ),
    "half the box": (boxed(2.5), Distance([1, 2], 1.5264), InputError, "half the box"),
    "zero cell": (boxed(0.0), Distance([0, 1]), InputError, "cell"),
    "not ours": (molecule("H2O"), [FixAtoms([0])], InputError, "from_ase_constraints"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    atoms, rows, error, message = BAD[case]
    with pytest.raises(error, match=message):
        constrain(atoms, rows)
    assert atoms.constraints == []


@pytest.mark.parametrize("rows", [[[0, 0]], [[-1, 0]], [[0.5, 1.5]], [[0, 1, 2]]])
def test_bad_rows_are_refused_at_once(rows):
    with pytest.raises(InputError):
        Distance(rows)


def test_bad_degenerate_option():
    with pytest.raises(InputError, match="'convert' or 'raise'"):
        Constraints(Distance([0, 1]), degenerate="ignore")


def failing_positions():
    turned = molecule("H2O")
    turned.rotate(90, "x")
    turned.rotate(90, "y")
    nan = molecule("H2O").positions
    nan[2, 0] = np.nan
    inf = molecule("H2O").positions
    inf[0, 0] = np.inf
    apart = turned.positions + np.array([[0, 0, 3], [0, 0, -3], [0, 0, 0]])
    return {"a step too large": apart, "nan": nan, "inf": inf}


@pytest.mark.parametrize("case", failing_positions())
def test_failing_position_hook_changes_nothing(case):
    atoms = molecule("H2O")
    held = constrain(atoms, rigid_water(atoms))
    new = failing_positions()[case]
    asked, before = new.copy(), atoms.positions.copy()
    with pytest.raises(KconsError) as caught:
        held.adjust_positions(atoms, new)
    assert np.array_equal(new, asked, equal_nan=True)
    with pytest.raises(KconsError):
        atoms.set_positions(new)
    assert np.array_equal(atoms.positions, before)
    if case == "a step too large":
        assert isinstance(caught.value, ConvergenceError)
        assert any("smaller timestep" in note for note in caught.value.__notes__)
    # and the object still works
    atoms.set_positions(before + 0.01)


@pytest.mark.parametrize("hook", ["adjust_momenta", "adjust_forces"])
def test_failing_covector_hooks_change_nothing(hook):
    atoms = molecule("H2O")
    held = constrain(atoms, rigid_water(atoms))
    values = np.ones((3, 3))
    values[1, 1] = np.nan
    asked = values.copy()
    with pytest.raises(KconsError):
        getattr(held, hook)(atoms, values)
    assert np.array_equal(values, asked, equal_nan=True)


@pytest.mark.parametrize("hook", ["adjust_positions", "adjust_momenta", "adjust_forces"])
def test_wrong_shapes(hook):
    atoms = molecule("H2O")
    held = constrain(atoms, rigid_water(atoms))
    with pytest.raises(InputError, match=r"shape \(3, 3\)"):
        getattr(held, hook)(atoms, np.zeros((4, 3)))


def test_time_step_too_large_in_dynamics():
    atoms, held = rigid(2, temperature=3000)
    atoms.calc = Free()
    with pytest.raises(ConvergenceError, match="smaller"):
        VelocityVerlet(atoms, 60 * units.fs).run(50)
    assert off(atoms, held) <= 1e-13
    assert np.isfinite(atoms.get_momenta()).all()


def test_nan_force_in_dynamics_is_an_error():
    class Bad(Free):
        def calculate(self, *args, **kwargs):
            super().calculate(*args, **kwargs)
            self.results["forces"][0, 0] = np.nan

    atoms, _ = rigid(1)
    atoms.calc = Bad()
    before = atoms.positions.copy()
    with pytest.raises(KconsError, match="not finite"):
        VelocityVerlet(atoms, 1 * units.fs).run(1)
    assert np.array_equal(atoms.positions, before)
