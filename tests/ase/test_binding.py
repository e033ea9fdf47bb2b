"""One engine for masses, cell and company: what is noticed, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms, units
from ase.build import molecule
from ase.constraints import (
    FixAtoms,
    FixBondLengths,
    FixCartesian,
    FixCom,
    FixedPlane,
    Hookean,
)
from ase.md.verlet import VelocityVerlet
from ase_systems import (
    loose_waters,
    off,
    rigid,
    slip,
)

from kcons.ase import Constraints, constrain, rigid_water
from kcons.constraints import (
    Distance,
    Sphere,
)
from kcons.errors import (
    InputError,
    UnsupportedError,
)


@pytest.mark.parametrize(
    ("other", "hint"),
    [
        (FixAtoms([0]), "FixedAtoms"),
        (FixBondLengths([[0, 4]]), "Distance"),
        (FixedPlane([1], (0, 0, 1)), "Plane"),
        (FixCartesian([2]), "LinearCombination"),
        (Constraints(Distance([2, 4])), ""),
    ],
    ids=lambda v: type(v).__name__,
)
@pytest.mark.parametrize("first", [True, False])
def test_company_on_the_same_atoms_is_refused(other, hint, first):
    atoms, held = rigid(2)
    held.restore(atoms)
    atoms.set_constraint([held, other] if first else [other, held])
    before = atoms.positions.copy()
    with pytest.raises(UnsupportedError, match=f"{type(other).__name__} acts on atom.*one Constraints object.*{hint}"):
        atoms.set_positions(before + np.random.default_rng(0).normal(scale=0.01, size=(6, 3)))
    assert np.array_equal(atoms.positions, before)
    with pytest.raises(UnsupportedError):
        atoms.get_forces()


def test_constrain_beside_something_else():
    atoms = loose_waters(2)
    atoms.set_constraint(FixAtoms([4]))
    held = constrain(atoms, Distance([0, 1]))
    assert [type(c).__name__ for c in atoms.constraints] == ["FixAtoms", "Constraints"]
    assert atoms.get_number_of_degrees_of_freedom() == 18 - 3 - 1
    new = atoms.positions + np.random.default_rng(0).normal(scale=0.01, size=(6, 3))
    fixed = atoms.positions[4].copy()
    atoms.set_positions(new)
    assert np.array_equal(atoms.positions[4], fixed) and off(atoms, held) <= 1e-14
    with pytest.raises(UnsupportedError, match="FixAtoms acts on atom 4"):
        constrain(atoms, Distance([4, 5]))
    assert len(atoms.constraints) == 2


def test_forces_only_company_is_welcome():
    atoms, held = rigid(2)
    atoms.set_constraint([held, Hookean(a1=0, a2=3, rt=2.5, k=1.0), FixCom()])
    atoms.set_momenta(atoms.get_momenta())
    VelocityVerlet(atoms, 1 * units.fs).run(10)
    assert off(atoms, held) <= 1e-13
    assert atoms.get_number_of_degrees_of_freedom() == 12 - 3


def test_fix_com_beside_a_surface_is_refused():
    atoms = Atoms("H2", positions=[[1, 0, 0], [3, 0, 0]])
    held = constrain(atoms, Sphere([0], [0, 0, 0]))
    atoms.set_constraint([FixCom(), held])
    with pytest.raises(UnsupportedError, match=r"FixCom acts on atom 0.*CenterOfMass"):
        atoms.set_momenta(np.ones((2, 3)))


def test_new_masses_are_noticed():
    atoms, held = rigid(1, temperature=None)
    raw = np.random.default_rng(2).normal(size=(3, 3))
    atoms.set_masses([16.0, 2.0, 1.0])
    atoms.set_momenta(raw)
    assert slip(atoms, held) <= 1e-14
    atoms.set_masses([16.0, 1.0, 7.0])  # ASE writes into the same array
    atoms.set_momenta(raw)
    assert slip(atoms, held) <= 1e-14
    atoms.numbers[1] = 8
    assert np.array_equal(held.engine(atoms).masses, atoms.get_masses())


def test_masses_of_other_atoms_do_not_rebuild_the_engine():
    atoms = loose_waters(2)
    held = constrain(atoms, Distance([0, 1]))
    engine = held.engine(atoms)
    masses = atoms.get_masses()
    atoms.set_masses(masses)
    engine = held.engine(atoms)
    masses[5] = 3.0
    atoms.set_masses(masses)
    assert held.engine(atoms) is engine
    masses[0] = 3.0
    atoms.set_masses(masses)
    assert held.engine(atoms) is not engine


def test_new_cell_is_noticed_and_targets_stay():
    atoms = molecule("H2O")
    atoms.set_cell([6, 6, 6])
    atoms.pbc = True
    held = constrain(atoms, rigid_water(atoms))
    lengths = held.engine(atoms).constraint_set.target()
    atoms.set_cell([5, 5, 5])
    atoms.positions[1] += [5, 0, 0]
    assert held.engine(atoms).constraint_set.half_width == pytest.approx(2.5)
    assert np.array_equal(held.engine(atoms).constraint_set.target(), lengths)
    assert off(atoms, held) <= 1e-14
    atoms.pbc = False
    assert off(atoms, held) > 1


def test_a_new_cell_does_not_rebuild_the_engine():
    atoms = molecule("H2O")
    atoms.set_cell([6, 6, 6])
    atoms.pbc = True
    held = constrain(atoms, rigid_water(atoms))
    engine = held.engine(atoms)
    peer = atoms.copy()
    atoms.set_cell([6.1, 6, 5.9], scale_atoms=True)
    assert held.engine(atoms) is engine
    # A copy with another cell gets the engine with its own.
    assert peer.constraints[0].engine(peer).constraint_set.half_width == pytest.approx(3)
    assert held.engine(atoms).constraint_set.half_width == pytest.approx(2.95)


def test_a_cell_too_small_is_refused_before_it_is_set():
    atoms = molecule("H2O")
    atoms.set_cell([6, 6, 6])
    atoms.pbc = True
    held = constrain(atoms, rigid_water(atoms))
    x = atoms.get_positions()
    with pytest.raises(InputError, match=r"Distance.*half the box"):
        atoms.set_cell([6, 3, 6], scale_atoms=True)
    assert atoms.cell.lengths().tolist() == [6, 6, 6]
    assert np.array_equal(atoms.positions, x)
    assert held.engine(atoms).constraint_set.half_width == pytest.approx(3)
