"""`ag.convert_to("ASE")`: the same atoms as by `to_ase`, with constraints or without."""

from __future__ import annotations

import warnings

import MDAnalysis
import numpy as np
import pytest

from kcons.constraints import Distance
from kcons.errors import InputError
from kcons.mdanalysis import constraints_of, to_ase


@pytest.fixture
def ethane():
    from ase.build import molecule

    from kcons.mdanalysis import from_ase

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        universe, _ = from_ase(molecule("C2H6"))
        universe.add_TopologyAttr("bonds", [(0, 1), (0, 2), (0, 3), (0, 4), (1, 5), (1, 6), (1, 7)])
    assert isinstance(universe, MDAnalysis.Universe)
    return universe


def test_atoms_are_those_of_to_ase(ethane):
    atoms = ethane.atoms.convert_to("ASE")
    assert np.array_equal(atoms.positions, to_ase(ethane).positions) and list(atoms.symbols) == ["C"] * 2 + ["H"] * 6
    assert not atoms.constraints
    assert np.array_equal(ethane.atoms.convert_to.ase().positions, atoms.positions)


def test_constraints_are_carried(ethane):
    by_name = ethane.atoms.convert_to("ASE", constrain="hbonds")
    (held,) = by_name.constraints
    assert held.get_removed_dof(by_name) == 6
    rows = constraints_of(ethane, "hbonds")
    (same,) = ethane.atoms.convert_to("ASE", constraints=rows).constraints
    assert same.get_removed_dof(by_name) == 6
    one = ethane.select_atoms("element C").convert_to("ASE", constraints=[Distance([[0, 1]])])
    assert len(one) == 2 and one.constraints[0].get_removed_dof(one) == 1
    alone = ethane.atoms.convert_to("ASE", constraints=Distance([[0, 1]]))
    assert alone.constraints[0].get_removed_dof(alone) == 1
    with pytest.raises(InputError, match="constraints has 3"):
        ethane.atoms.convert_to("ASE", constraints=3)


def test_bad_input(ethane):
    with pytest.raises(InputError, match="not both"):
        ethane.atoms.convert_to("ASE", constrain="hbonds", constraints=[Distance([[0, 1]])])
    with pytest.raises(InputError, match="rigid_water is an option of constrain"):
        ethane.atoms.convert_to("ASE", rigid_water=False)
