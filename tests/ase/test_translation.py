"""ASE's constraints as ours and back, as other programs know them; copies and files."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys

import numpy as np
import pytest
from ase import Atoms, units
from ase.build import bcc100, molecule
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from ase.constraints import (
    FixAtoms,
    FixBondLengths,
    FixCartesian,
    FixCom,
    FixInternals,
    FixLinearTriatomic,
    Hookean,
    MirrorForce,
)
from ase.db import connect
from ase.io import read, write
from ase.md.verlet import VelocityVerlet
from ase_systems import AS_ASE, rigid

from kcons.ase import (
    Constraints,
    ConstraintsWithFixedAtoms,
    attach,
    constrain,
    from_ase_constraints,
    to_ase_constraints,
)
from kcons.constraints import (
    Angle,
    CenterOfMass,
    Custom,
    Dihedral,
    Distance,
    FixedAtoms,
    LinearCombination,
    Plane,
    Sphere,
)
from kcons.errors import UnsupportedError


def test_from_ase_constraints():
    """What the way to ASE and back does not show: targets that are open, angles in degrees, the center of all atoms."""
    atoms = molecule("CH3CH2OH")
    angles = {"angles_deg": [[110.0, [0, 1, 2]]], "dihedrals_deg": [[200.0, [3, 2, 1, 0]]]}
    atoms.set_constraint([FixBondLengths([[0, 1]]), FixInternals(bonds=[[None, [2, 3]]], **angles), FixCom()])
    rows = from_ase_constraints(atoms)
    assert [c.family for c in rows] == ["Distance", "Distance", "Angle", "Dihedral", "CenterOfMass"]
    assert rows[0].target is None and rows[1].target is None
    assert np.array_equal(atoms.positions, molecule("CH3CH2OH").positions)
    atoms.set_constraint()
    held = constrain(atoms, rows, project=True)
    assert atoms.get_angle(0, 1, 2) == pytest.approx(110.0, abs=1e-10)
    assert atoms.get_dihedral(3, 2, 1, 0) == pytest.approx(200.0, abs=1e-10)
    assert held.get_removed_dof(atoms) == 1 + 1 + 1 + 1 + 3


def test_from_fix_linear_triatomic():
    atoms = molecule("CO2")  # C, O, O
    atoms.set_constraint(FixLinearTriatomic([[1, 0, 2]]))
    rows = from_ase_constraints(atoms)
    atoms.set_constraint()
    held = constrain(atoms, rows)
    assert atoms.get_number_of_degrees_of_freedom() == 5
    atoms.calc = LennardJones(epsilon=0.0)
    atoms.set_momenta(np.random.default_rng(0).normal(size=(3, 3)))
    VelocityVerlet(atoms, 1 * units.fs).run(100)
    assert atoms.get_angle(1, 0, 2) == pytest.approx(180, abs=1e-5)
    assert np.abs(held.engine(atoms).constraint_set.value(atoms.positions)).max() <= 1e-13


# -- copies, slices, files --------------------------------------------------------------------------


def targets(atoms) -> np.ndarray:
    (held,) = atoms.constraints
    assert isinstance(held, Constraints)
    return held.engine(atoms).constraint_set.target()


def sample() -> Atoms:
    """Several families with targets that are not those of the present positions to the last bit."""
    atoms = molecule("CH3CH2OH")
    rows = [
        Distance([[0, 1], [1, 2]], [1.5, 1.4]),
        Angle([0, 1, 2], 1.9),
        Dihedral([3, 2, 1, 0], 1.1),
        LinearCombination([4, 5], [[0, 0, 1], [0, 0, -1]]),
        FixedAtoms([8]),
    ]
    constrain(atoms, rows, project=True)
    atoms.positions[0] += 1e-9
    return atoms


COPIES = {
    "copy": lambda atoms, folder: atoms.copy(),
    "constructor": lambda atoms, folder: Atoms(atoms),
    "deepcopy": lambda atoms, folder: copy.deepcopy(atoms),
    "pickle": lambda atoms, folder: pickle.loads(pickle.dumps(atoms)),
    "todict": lambda atoms, folder: Atoms.fromdict(
        {**atoms.todict(), "constraints": [c.todict() for c in atoms.constraints]}
    ),
    "traj": lambda atoms, folder: _through(atoms, folder / "a.traj"),
    "json": lambda atoms, folder: _through(atoms, folder / "a.json"),
    "db": lambda atoms, folder: _through_db(atoms, folder / "a.db"),
    "whole slice": lambda atoms, folder: atoms[:],
}


def _through(atoms, path) -> Atoms:
    write(path, atoms)
    return read(path)


def _through_db(atoms, path) -> Atoms:
    atoms.calc = EMT()
    connect(path).write(atoms, fmax_before=np.linalg.norm(atoms.get_forces(), axis=1).max())
    row = connect(path).get(1)  # which asks one copy of the constraints for atoms with another
    assert row.fmax == pytest.approx(row.fmax_before, rel=1e-9)
    return row.toatoms()


@pytest.mark.parametrize("ours_first", [True, False])
@pytest.mark.parametrize("way", COPIES)
def test_round_trip_keeps_rows_and_targets(way, ours_first, tmp_path):
    """Also those that were found; beside other constraints in either order."""
    atoms = sample()
    held, spring = atoms.constraints[0], Hookean(1, 5, 1.0, 1.0)
    others = [FixAtoms([7]), FixCartesian([6], (True, False, True)), spring]
    atoms.set_constraint([held, *others] if ours_first else [*others, held])
    again = COPIES[way](atoms, tmp_path)
    assert [type(c) for c in again.constraints] == [type(c) for c in atoms.constraints]
    twin = next(c for c in again.constraints if isinstance(c, Constraints))
    assert twin is not held and [c.family for c in twin.constraints] == [c.family for c in held.constraints]
    momenta = np.random.default_rng(0).normal(size=(9, 3))
    for a in (atoms, again):
        a.set_momenta(momenta)
    assert np.array_equal(atoms.get_momenta(), again.get_momenta())
    again.positions[:] += 0.1  # the targets are those that were found, not those of the first use
    again.positions[1] += 0.01
    assert np.array_equal(twin.engine(again).constraint_set.target(), held.engine(atoms).constraint_set.target())
    assert again.get_number_of_degrees_of_freedom() == atoms.get_number_of_degrees_of_freedom() == 27 - 8 - 3 - 2


@pytest.fixture(scope="module")
def opened_by_ase(tmp_path_factory):
    """What ASE makes, in a process that never saw kcons, of files with each of `AS_ASE`."""
    folder = tmp_path_factory.mktemp("native")
    for name, rows in AS_ASE.items():
        atoms = molecule("CH3CH2OH")
        constrain(atoms, rows)
        write(folder / f"{name}.traj", atoms)
        write(folder / f"{name}.json", atoms)
    code = """
import sys
from pathlib import Path
from ase.io import read
for path in sorted(Path(sys.argv[1]).glob("*.*")):
    try:
        atoms = read(path)
        (held,) = atoms.constraints
        print(path.name, type(held).__name__, atoms.get_number_of_degrees_of_freedom(), sep=";")
    except ValueError:
        print(path.name, "refused", 0, sep=";")
assert "kcons" not in sys.modules
"""
    run = subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, text=True, check=True)
    return folder, {line.split(";")[0]: line.split(";")[1:] for line in run.stdout.splitlines()}


@pytest.mark.parametrize("name", AS_ASE)
@pytest.mark.parametrize("suffix", ["traj", "json"])
def test_files_open_without_kcons_where_ase_can_hold_the_same(opened_by_ase, name, suffix):
    folder, found = opened_by_ase
    kind, freedom = found[f"{name}.{suffix}"]
    ours = read(folder / f"{name}.{suffix}")
    if " " in name:
        assert kind == "refused" and isinstance(ours.constraints[0], Constraints)
        return
    original = molecule("CH3CH2OH")
    expected = constrain(original, AS_ASE[name]).engine(original).constraint_set
    assert kind == name and int(freedom) == original.get_number_of_degrees_of_freedom()
    assert type(ours.constraints[0]).__name__ == kind
    # The rows of ASE's object are ours again, with the same targets; those of lengths and angles are in the file.
    told = name == "FixInternals" or (name == "FixBondLengths" and suffix == "traj")
    if told:
        ours.positions *= 1.01
    held = attach(ours)
    assert ours.constraints == [held]
    rows = held.engine(ours).constraint_set
    assert np.sort(rows.target()) == pytest.approx(np.sort(expected.target()), rel=5e-16)
    if name == "FixBondLengths":
        assert np.array_equal(rows.target(), expected.target())
    assert ours.get_number_of_degrees_of_freedom() == int(freedom)


def test_rows_that_depend_on_others_are_counted_right_in_files(tmp_path):
    """ASE would count each of them."""
    atoms = molecule("CO2")
    constrain(atoms, Distance([[0, 1], [0, 2], [1, 2]]))
    again = _through(atoms, tmp_path / "a.traj")
    assert again.get_number_of_degrees_of_freedom() == atoms.get_number_of_degrees_of_freedom() == 5


def test_attach_keeps_objects_that_add_forces_and_refuses_unknown_ones():
    atoms = molecule("CH3CH2OH")
    spring = Hookean(a1=0, a2=5, rt=1.0, k=1.0)
    atoms.set_constraint([FixAtoms([8]), spring, FixBondLengths([[0, 1]])])
    with pytest.raises(UnsupportedError, match=r"Hookean.*Take it off, or"):
        from_ase_constraints(atoms)
    held = attach(atoms)
    assert atoms.constraints == [held, spring]
    assert [row.family for row in held.constraints] == ["FixedAtoms", "Distance"]
    atoms.calc = EMT()
    forces = atoms.get_forces()  # of the spring, too, without what the rows take
    atoms.set_constraint([spring, held])
    assert np.abs(atoms.get_forces() - forces).max() <= 1e-13
    before = [FixAtoms([8]), MirrorForce(0, 1)]
    atoms.set_constraint(before)
    with pytest.raises(UnsupportedError, match=r"MirrorForce.*Custom"):
        attach(atoms)
    assert atoms.constraints == before


def test_function_rows_are_left_out_of_files_with_a_warning(tmp_path):
    atoms = Atoms("H2", positions=[[1, 0, 0], [3, 0, 0]])
    surface = Custom([0], lambda r: (r**2).sum() - 1, lambda r: 2 * r, 0.0)
    constrain(atoms, [surface, Distance([0, 1])])
    with pytest.warns(UserWarning, match="left out of the file: Custom"):
        write(tmp_path / "a.traj", atoms)
    assert np.array_equal(read(tmp_path / "a.traj").positions, atoms.positions)
    with pytest.warns(UserWarning, match="left out"):
        assert not hasattr(atoms.constraints[0], "todict")
    assert len(atoms.copy().constraints[0].constraints) == 2


def test_objects_without_rows_are_left_out_of_files(tmp_path):
    atoms = Atoms("H2", positions=[[1, 0, 0], [3, 0, 0]])
    constrain(atoms, [Sphere([], [0.0, 0.0, 0.0]), Distance([0, 1])])
    write(tmp_path / "a.traj", atoms)
    assert [item.family for item in attach(read(tmp_path / "a.traj")).constraints] == ["Distance"]


def test_slicing_keeps_whole_rows_only():
    atoms, _ = rigid(3)
    part = atoms[3:8]
    assert targets(part).shape == (4,)  # one whole water, and one O-H bond of the next
    assert np.array_equal(part.constraints[0].constraints[0].atoms, [[0, 1], [0, 2], [1, 2], [3, 4]])
    assert atoms[[0, 3, 6]].constraints == []
    assert np.array_equal(targets(atoms[np.arange(9) < 3]), targets(atoms)[:3])
    assert np.array_equal(targets(atoms[[2, 1, 0]]), targets(atoms)[:3])
    with pytest.raises(IndexError):
        atoms.constraints[0].index_shuffle(atoms, [0, 3, 6])
    assert targets(atoms).shape == (9,)


@pytest.mark.parametrize("rows", [FixedAtoms([0]), Distance([0, 1])])
def test_rows_are_not_repeated(rows):
    atoms = molecule("H2O", cell=[4.0, 5.0, 6.0], pbc=True)
    constrain(atoms, rows)
    with pytest.raises(UnsupportedError, match=r"cannot be repeated.*set_constraint\(\)"):
        atoms.repeat(2)


# -- as other programs know them ----------------------------------------------------------------------


FORMATS = {"vasp": "POSCAR", "aims": "geometry.in", "turbomole": "coord", "extxyz": "a.xyz", "castep-cell": "a.cell"}
FORMATS["espresso-in"] = "pw.in"


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
    with pytest.warns(UserWarning, match="not have the other 1 rows.*to_ase_constraints"):
        assert held.index.tolist() == [0, 1, 2, 3]
    with pytest.warns(UserWarning, match="only the fixed atoms are passed on"):
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
