"""One engine for masses, cell and company: what is noticed, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.emt import EMT
from ase.constraints import (
    ExternalForce,
    FixAtoms,
    FixBondLengths,
    FixCartesian,
    FixCom,
    FixedMode,
    FixedPlane,
    Hookean,
)
from ase.md.velocitydistribution import thermalize_momenta
from ase.md.verlet import VelocityVerlet
from ase.optimize import FIRE
from ase_systems import FS, Field, Free, equal, loose_waters, off, rigid, state, water

from kcons.ase import ConstrainedDynamics, Constraints, MultipleTimeSteps, attach, constrain, rigid_water
from kcons.constraints import Angle, CenterDistance, Distance, Sphere
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import BlanesMoan4


@pytest.mark.parametrize(
    "other",
    [
        *(FixAtoms([0]), FixBondLengths([[0, 4]]), FixedPlane([1], (0, 0, 1)), FixCartesian([2])),
        Constraints(Distance([2, 4])),
        FixedMode(np.eye(6)[:, :3]),  # of atoms 0, 1 and 2; it says itself that it acts on none
    ],
    ids=lambda v: type(v).__name__,
)
@pytest.mark.parametrize("first", [True, False])
def test_company_on_the_same_atoms_is_refused(other, first):
    atoms, held = rigid(2)
    held.restore(atoms)
    atoms.set_constraint([held, other] if first else [other, held])
    before = atoms.positions.copy()
    with pytest.raises(UnsupportedError, match=f"{type(other).__name__} acts on atom.*one Constraints object"):
        atoms.set_positions(before + np.random.default_rng(0).normal(scale=0.01, size=(6, 3)))
    assert np.array_equal(atoms.positions, before)
    with pytest.raises(UnsupportedError):
        atoms.get_forces()
    if not isinstance(other, FixedMode):
        attach(atoms)  # as it is told
        atoms.get_forces()


def test_fix_com_is_welcome_but_beside_a_surface():
    atoms, held = rigid(2)
    atoms.set_constraint([held, FixCom()])
    atoms.set_momenta(atoms.get_momenta())
    VelocityVerlet(atoms, 1 * units.fs).run(10)
    assert off(atoms, held) <= 1e-13
    assert atoms.get_number_of_degrees_of_freedom() == 12 - 3
    atoms = Atoms("H2", positions=[[1, 0, 0], [3, 0, 0]])
    held = constrain(atoms, Sphere([0], [0, 0, 0]))
    atoms.set_constraint([FixCom(), held])
    with pytest.raises(UnsupportedError, match=r"FixCom acts on atom 0"):
        atoms.set_momenta(np.ones((2, 3)))


def test_copies_in_cells_of_their_own():
    """Centers that nothing ties together, whose images are followed over a tenth of a cell vector and no more."""
    atoms = loose_waters(2)
    atoms.cell, atoms.pbc = np.full(3, 12.0), True
    constrain(atoms, [rigid_water(atoms), CenterDistance([0, 1, 2], [3, 4, 5])])
    images = [atoms.copy() for _ in range(3)]
    for image, factor in zip(images, (0.92, 1.0, 1.08), strict=True):
        image.set_cell(factor * atoms.cell)
    for seed in range(2):
        for image in images:
            image.set_positions(image.positions + np.random.default_rng(seed).normal(scale=0.01, size=(6, 3)))
            assert off(image, image.constraints[0]) <= 1e-14
    assert len({id(image.constraints[0].engine(image)) for image in images}) == 3
    assert np.array_equal(atoms.constraints[0].engine(atoms).cell()[0], atoms.cell.array)


def test_cells_that_are_set():
    """The engine goes on in a new one; one that is too small is refused before it is set."""
    atoms = molecule("H2O")
    atoms.set_cell([6, 6, 6])
    atoms.pbc = True
    held = constrain(atoms, rigid_water(atoms))
    engine, x = held.engine(atoms), atoms.get_positions()
    with pytest.raises(InputError, match=r"Distance.*half the box"):
        atoms.set_cell([6, 3, 6], scale_atoms=True)
    assert atoms.cell.lengths().tolist() == [6, 6, 6]
    assert np.array_equal(atoms.positions, x)
    assert held.engine(atoms).constraint_set.half_width == pytest.approx(3)
    atoms.set_cell([6.1, 6, 5.9], scale_atoms=True)
    assert held.engine(atoms) is engine and engine.constraint_set.half_width == pytest.approx(2.95)


# -- company ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "run",
    [
        lambda atoms: VelocityVerlet(atoms, 0.5 * FS),
        lambda atoms: ConstrainedDynamics(atoms, 0.5 * FS, BlanesMoan4()),
        lambda atoms: FIRE(atoms, logfile=None),
    ],
    ids=["VelocityVerlet", "ConstrainedDynamics", "FIRE"],
)
def test_fixed_atoms_and_components_alongside(run):
    atoms = molecule("CH3CH2OH")
    atoms.calc = EMT()
    atoms.set_constraint([FixAtoms([8]), FixCartesian([7], (True, False, True)), Hookean(a1=5, a2=6, rt=1.0, k=0.5)])
    held = constrain(atoms, [Distance([[0, 1], [1, 2]]), Angle([0, 1, 2])])
    before = atoms.get_positions()
    thermalize_momenta(atoms, 100, rng=np.random.default_rng(0))
    run(atoms).run(steps=10)
    moved = atoms.positions - before
    assert np.array_equal(moved[8], [0, 0, 0])
    assert np.abs(moved[7, [0, 2]]).max() <= 1e-14 and abs(moved[7, 1]) > 1e-5
    assert off(atoms, held) <= 1e-13
    assert atoms.get_number_of_degrees_of_freedom() == 27 - 3 - 2 - 3


# -- forces that are known --------------------------------------------------------------------------


class Settings(Field):
    """A field whose stiffness `set` changes."""

    discard_results_on_any_change = True

    def __init__(self, **settings):
        super().__init__()
        self.set(**settings)

    def calculate(self, *args, **kwargs):
        self.stiffness = self.parameters["stiffness"]
        super().calculate(*args, **kwargs)


@pytest.mark.parametrize(
    "change",
    [
        lambda atoms: atoms.calc.set(stiffness=3.0),
        lambda atoms: (atoms.calc.set(stiffness=3.0), atoms.get_potential_energy()),
        lambda atoms: setattr(atoms.constraints[-1], "external_force", 4.0),
        lambda atoms: atoms.set_initial_charges([2.0, 0.0, 0.0]),
        lambda atoms: setattr(atoms, "calc", type(atoms.calc)(stiffness=3.0)),
    ],
    ids=["settings", "settings, and asked", "force of ase", "charges", "another"],
)
def test_forces_of_the_same_calculator_that_changed(change):
    """A step begins with the forces that there are now."""

    class Charged(Settings):
        def calculate(self, *args, **kwargs):
            super().calculate(*args, **kwargs)
            self.results["forces"] += self.atoms.get_initial_charges()[:, None]

    atoms, _ = water(Charged(stiffness=0.05))
    atoms.set_constraint([*atoms.constraints, ExternalForce(0, 1, 0.2)])
    dyn = ConstrainedDynamics(atoms, FS)
    dyn.run(2)
    change(atoms)
    again = atoms.copy()
    again.calc = Charged(**atoms.calc.parameters)
    dyn.run(1)
    ConstrainedDynamics(again, FS).run(1)
    assert equal(state(atoms), state(again))


def test_what_was_given_by_numbers_of_atoms_is_no_longer_of_these():
    """All these lengths are 1, so that the rows that are meant cannot be told from their neighbors by length."""
    line = Atoms("H5", positions=np.arange(5)[:, None] * [1.0, 0.0, 0.0], calculator=Free())
    atoms = line.copy()
    atoms.calc = Free()
    dyn = ConstrainedDynamics(atoms, FS, constraints=[Distance([[2, 3]])])
    dyn.run(1)
    del atoms[0]
    with pytest.raises(InputError, match=r"1 of 5 atoms were removed.*make a new one"):
        dyn.run(1)
    dyn = ConstrainedDynamics(line, FS)
    dyn.run(1)
    del line[0]
    dyn.run(1)
    assert dyn.degrees_of_freedom == 12


@pytest.mark.parametrize("changed", ["fast", "slow"])
def test_each_calculator_of_several_time_steps(changed):
    atoms, _ = water()
    given = {"fast": Settings(stiffness=0.05), "slow": Settings(stiffness=0.02)}
    options = {"temperature_K": 300, "friction": 0.01 / FS, "fast_steps": 2, "rng": 1}
    dyn = MultipleTimeSteps(atoms, FS, **given, **options)
    dyn.run(2)
    given[changed].set(stiffness=3.0)
    again = atoms.copy()
    dyn.run(1)
    other = MultipleTimeSteps(again, FS, **{k: Settings(**each.parameters) for k, each in given.items()}, **options)
    other.nsteps = 2
    other.run(1)
    np.testing.assert_allclose(state(atoms), state(again), rtol=1e-12, atol=1e-13)


def test_company_that_is_changed_is_looked_at_again():
    """The same object, which acts on other atoms than before."""
    atoms = loose_waters(2)
    atoms.calc = Free()
    beside = FixAtoms([4])
    atoms.set_constraint(beside)
    constrain(atoms, Distance([0, 1]))
    dynamics = VelocityVerlet(atoms, FS)
    dynamics.run(2)
    beside.index[0] = 1
    with pytest.raises(UnsupportedError, match="FixAtoms acts on atom 1"):
        dynamics.run(1)
