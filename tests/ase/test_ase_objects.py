"""What kcons holds, as objects that ASE, its file formats and other programs know."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from ase import Atoms
from ase.build import bcc100, molecule
from ase.calculators.emt import EMT
from ase.constraints import FixAtoms, Hookean
from ase.io import read, write
from ase_systems import AS_ASE

from kcons.ase import Constraints, ConstraintsWithFixedAtoms, constrain, from_ase_constraints, to_ase_constraints
from kcons.constraints import CenterOfMass, Distance, FixedAtoms, LinearCombination, Plane, Sphere
from kcons.errors import UnsupportedError

FORMATS = {
    "vasp": "POSCAR",
    "aims": "geometry.in",
    "turbomole": "coord",
    "extxyz": "a.xyz",
    "castep-cell": "a.cell",
    "espresso-in": "pw.in",
}


def slab() -> Atoms:
    """Four atoms of iron at the bottom, and hydrogen on top."""
    atoms = bcc100("Fe", (2, 2, 3), vacuum=5.0, periodic=True)
    atoms.info.clear()
    atoms += Atoms("H2", atoms.positions[-1] + np.array([[0, 0, 1.5], [0, 0.1, 2.24]]))
    return atoms


def fixed_in(atoms: Atoms) -> list[int]:
    """As all that reads `FixAtoms` finds them."""
    return sorted(i for c in atoms.constraints if isinstance(c, FixAtoms) for i in c.get_indices().tolist())


HELD = {
    "alone": [FixedAtoms([3, 0, 1, 2])],
    "with others": [Distance([[12, 13]]), FixedAtoms([0, 1]), FixedAtoms([2, 3])],
}


@pytest.mark.parametrize("held", HELD.values(), ids=HELD)
@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::UserWarning")
def test_files_of_other_programs_have_the_fixed_atoms(tmp_path, form, held):
    """The same file as with ASE's own FixAtoms."""
    ours, plain = slab(), slab()
    constrain(ours, held)
    plain.set_constraint(FixAtoms([0, 1, 2, 3]))
    options = {"pseudopotentials": {"Fe": "Fe.upf", "H": "H.upf"}} if form == "espresso-in" else {}
    texts = []
    for name, atoms in (("ours", ours), ("plain", plain)):
        folder = tmp_path / name
        folder.mkdir()
        write(folder / FORMATS[form], atoms, format=form, **options)
        texts.append((folder / FORMATS[form]).read_text())
    lines, expected = ([line for line in text.splitlines() if "#" not in line] for text in texts)
    assert lines == expected
    if form not in ("castep-cell", "espresso-in"):
        assert fixed_in(read(tmp_path / "ours" / FORMATS[form], format=form)) == [0, 1, 2, 3]


def test_the_object_follows_what_it_holds():
    atoms = slab()
    held = constrain(atoms, HELD["with others"])
    assert isinstance(held, ConstraintsWithFixedAtoms) and fixed_in(atoms) == [0, 1, 2, 3]
    assert held.get_indices().tolist() == [0, 1, 2, 3]  # as what asks FixAtoms expects
    assert held.touched.tolist() == [0, 1, 2, 3, 12, 13]
    assert atoms.get_number_of_degrees_of_freedom() == 3 * 14 - 12 - 1
    for twin in (atoms.copy(), copy.deepcopy(atoms), pickle.loads(pickle.dumps(atoms))):
        assert fixed_in(twin) == [0, 1, 2, 3]
        assert repr(twin.constraints) == repr(atoms.constraints)
    assert fixed_in(atoms[[2, 12, 13, 5]]) == [0]
    (molecule_alone,) = atoms[12:].constraints
    assert type(molecule_alone) is Constraints and not isinstance(molecule_alone, FixAtoms)
    held.constraints = (Distance([[12, 13]]),)
    assert type(held) is Constraints and fixed_in(atoms) == []
    held.constraints = (FixedAtoms([5]),)
    assert fixed_in(atoms) == [5]


def test_other_rows_are_told_to_what_asks_for_fixed_atoms_alone(tmp_path):
    """Such as writers of files, and Sella, which held the fixed atoms and let go of the bond."""
    atoms = slab()
    held = constrain(atoms, HELD["with others"])
    with pytest.warns(UserWarning, match="of the other 1 rows nothing: .*to_ase_constraints"):
        assert held.index.tolist() == [0, 1, 2, 3]
    with pytest.warns(UserWarning, match="a file does not have them"):
        write(tmp_path / "POSCAR", atoms, format="vasp")
    held.constraints = (FixedAtoms([5]),)
    assert held.index.tolist() == [5]  # that is all


def test_atoms_can_be_deleted_as_with_fix_atoms():
    atoms = slab()
    constrain(atoms, HELD["with others"])
    places = atoms.positions.copy()
    del atoms[[1, 4]]
    assert fixed_in(atoms) == [0, 1, 2]
    (held,) = atoms.constraints
    assert held.engine(atoms).constraint_set.n_rows == 9 + 1
    assert atoms.get_distance(10, 11) == pytest.approx(np.linalg.norm(places[12] - places[13]))
    assert held.todict()["kwargs"]["constraints"][0]["atoms"] == [[10, 11]]
    del atoms[-1]
    assert [row.family for row in held.constraints] == ["FixedAtoms", "FixedAtoms"]
    del atoms[[0, 1, 2]]
    assert not atoms.constraints
    bound = molecule("H2O")
    constrain(bound, Distance([[0, 1]]))
    with pytest.raises(RuntimeError, match="Remove constraint"):
        del bound[2]


# -- plain objects -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("names", AS_ASE)
def test_ase_objects_take_the_same_away(names):
    """Their degrees of freedom, and the forces that they leave, where they are single or share no atoms."""
    atoms = molecule("CH3CH2OH")
    atoms.calc = EMT()
    held = constrain(atoms, AS_ASE[names], project=True)
    before = held.todict()
    found = to_ase_constraints(atoms)
    assert [type(item).__name__ for item in found] == names.split()
    assert not any(isinstance(item, Constraints) for item in found)
    plain = atoms.copy()
    plain.calc = EMT()
    plain.set_constraint(found)
    assert plain.get_number_of_degrees_of_freedom() == atoms.get_number_of_degrees_of_freedom()
    if names == "FixInternals":  # which takes rotations away from forces, too
        found[0].initialize(plain)
        for each in found[0].constraints:
            each.setup_jacobian(plain.positions)
            each.adjust_positions(plain.positions, plain.positions.copy())
            assert each.sigma == pytest.approx(0.0, abs=1e-10)
    elif names != "FixSubsetCom":  # which takes the mean of accelerations away, and not of forces
        assert plain.get_forces() == pytest.approx(atoms.get_forces(), abs=1e-6)
    # And back: the same rows with the same targets.
    back = Constraints(from_ase_constraints(plain)).engine(atoms).constraint_set
    expected = held.engine(atoms).constraint_set
    rows = [each.jacobian(atoms.positions).toarray() for each in (back, expected)]
    assert np.linalg.matrix_rank(np.vstack(rows)) == len(rows[0]) == len(rows[1])
    assert np.abs(back.value(atoms.positions)).max() < 1e-12
    assert held.todict() == before and atoms.constraints == [held]


@pytest.mark.parametrize(
    ("rows", "named"),
    [
        ([FixedAtoms([0]), Sphere([1], [0.0, 0.0, 0.0])], r"<Sphere\(1\)>"),
        ([Plane([3], [0, 0, 1.0]), Plane([3], [0, 1.0, 0])], "<Plane"),
        ([CenterOfMass([0, 1], axes=(0, 2)), LinearCombination([0, 1], [[1.0, 0, 0], [1.0, 0, 0]])], "<CenterOfMass"),
    ],
)
def test_what_no_object_of_ase_holds_is_named(rows, named):
    atoms = molecule("CH3CH2OH")
    atoms.set_constraint(Hookean(a1=4, a2=5, rt=2.0, k=1.0))
    constrain(atoms, rows)
    with pytest.raises(UnsupportedError, match=f"no object of ASE holds {named}"):
        to_ase_constraints(atoms)
