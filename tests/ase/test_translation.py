"""ASE's constraints as ours, and the search for water."""

from __future__ import annotations

import numpy as np
import pytest
from ase import units
from ase.build import molecule
from ase.calculators.lj import LennardJones
from ase.constraints import (
    FixAtoms,
    FixBondLengths,
    FixCartesian,
    FixCom,
    FixedLine,
    FixedPlane,
    FixInternals,
    FixLinearTriatomic,
    FixSubsetCom,
    Hookean,
)
from ase.md.verlet import VelocityVerlet

from kcons.ase import constrain, from_ase_constraints, rigid_water
from kcons.errors import UnsupportedError


def test_from_ase_constraints():
    atoms = molecule("CH3CH2OH")
    atoms.set_constraint(
        [
            FixAtoms([8]),
            FixBondLengths([[0, 1]]),
            FixBondLengths([[1, 2]], bondlengths=[1.43]),
            FixInternals(
                bonds=[[None, [2, 3]]], angles_deg=[[110.0, [0, 1, 2]]], dihedrals_deg=[[200.0, [3, 2, 1, 0]]]
            ),
            FixedPlane([4], (0, 0, 2)),
            FixedLine([5], (0, 1, 0)),
            FixCartesian([6], (True, False, True)),
            FixCom(),
        ]
    )
    rows = from_ase_constraints(atoms)
    assert [c.family for c in rows] == [
        "FixedAtoms",
        "Distance",
        "Distance",
        "Distance",
        "Angle",
        "Dihedral",
        "Plane",
        "Line",
        "LinearCombination",
        "LinearCombination",
        "CenterOfMass",
    ]
    assert rows[2].target == pytest.approx([1.43])
    assert rows[4].target == pytest.approx([np.radians(110)])
    assert rows[5].target == pytest.approx([np.radians(200)])
    assert rows[1].target is None
    assert np.array_equal(atoms.positions, molecule("CH3CH2OH").positions)
    atoms.set_constraint()
    held = constrain(atoms, rows, project=True)
    assert atoms.get_angle(0, 1, 2) == pytest.approx(110.0, abs=1e-10)
    assert atoms.get_dihedral(3, 2, 1, 0) == pytest.approx(200.0, abs=1e-10)
    assert held.get_removed_dof(atoms) == 3 + 1 + 1 + 1 + 1 + 1 + 1 + 2 + 2 + 3


def test_from_fix_linear_triatomic():
    atoms = molecule("CO2")  # C, O, O
    atoms.set_constraint(FixLinearTriatomic([[1, 0, 2]]))
    rows = from_ase_constraints(atoms)
    atoms.set_constraint()
    held = constrain(atoms, rows)
    assert atoms.get_number_of_degrees_of_freedom() == 5
    atoms.calc = LennardJones(epsilon=0.0)
    atoms.set_momenta(np.random.default_rng(0).normal(size=(3, 3)))
    kinetic = atoms.get_kinetic_energy()
    VelocityVerlet(atoms, 1 * units.fs).run(100)
    assert atoms.get_angle(1, 0, 2) == pytest.approx(180, abs=1e-5)
    assert np.abs(held.engine(atoms).constraint_set.value(atoms.positions)).max() <= 1e-13
    assert atoms.get_kinetic_energy() == pytest.approx(kinetic, rel=1e-10)


def test_from_fix_subset_com():
    atoms = molecule("H2O")
    atoms.set_constraint(FixSubsetCom([0, 2]))
    (rows,) = from_ase_constraints(atoms)
    assert np.array_equal(rows.atoms, [[0, 2]] * 3)


def test_own_object_is_translated_to_its_rows():
    atoms = molecule("H2O")
    held = constrain(atoms, rigid_water(atoms))
    assert from_ase_constraints(atoms) == list(held.constraints)


@pytest.mark.parametrize(
    "other",
    [Hookean(a1=0, a2=1, rt=1.0, k=1.0), FixInternals(bondcombos=[[None, [[0, 1, 1.0], [0, 2, -1.0]]]])],
    ids=lambda v: type(v).__name__,
)
def test_unknown_ase_constraints_are_named(other):
    atoms = molecule("H2O")
    atoms.set_constraint(other)
    with pytest.raises(UnsupportedError, match=f"{type(other).__name__}.*Custom"):
        from_ase_constraints(atoms)
