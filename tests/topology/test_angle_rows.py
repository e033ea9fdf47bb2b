"""All angles: the rows are independent, well-conditioned, and hold every angle, also those that are no rows; rings."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from ase.build import molecule
from host_systems import VILLIN
from openmm import app
from snapshots import held_rows, snapshot

import kcons.openmm
from kcons.constraints import Angle, Dihedral, Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion
from kcons.topology.angle_rows import LARGEST, angle_rows, ring_rows, ring_systems
from kcons.topology.topology import bond_angles, guess_bonds, sorted_pairs


def singular_values(whole, x):
    """Of rows of length 1, weighted with the masses."""
    rows = whole.jacobian(x).toarray() / np.sqrt(np.repeat(whole.masses, 3))
    return np.linalg.svd(rows / np.linalg.norm(rows, axis=1, keepdims=True), compute_uv=False)


def condition(whole, x):
    """Of the independent rows, and how many these are."""
    s = singular_values(whole, x)
    rank = int((s > 1e-9 * s[0]).sum())
    return s[0] / s[rank - 1], rank


def every_angle(made):
    bonds = made.topology.bonds
    items = [Distance(bonds), Angle(bond_angles(bonds, len(made.positions)))]
    return ConstraintSet(items, made.positions, made.topology.masses)


def of_ase(name):
    atoms = molecule(name)
    made = snapshot(atoms.get_chemical_symbols(), atoms.positions, masses=atoms.get_masses())
    return replace(made, topology=made.topology.with_bonds(guess_bonds(made)))


def star(directions, elements=None):
    """An atom with neighbors in these directions."""
    e = np.array(directions, dtype=float)
    e = e / np.linalg.norm(e, axis=1, keepdims=True)
    n = len(e)
    return snapshot(elements or ["C"] * (n + 1), np.vstack([np.zeros(3), 1.2 * e]), [(0, k + 1) for k in range(n)])


#: Torsions of bonds: all that is left beside bonds and angles.
TORSIONS = {
    "C6H6": 0, "C5H5N": 0, "C4H4O": 0, "C4H4NH": 0, "C3H6_D3h": 0, "C3H4_C2v": 0, "cyclobutane": 0, "cyclobutene": 0,
    "bicyclobutane": 0, "C5H8": 0, "CH4": 0, "NH3": 0, "BF3": 0, "CH3CONH2": 2, "C2H4": 1, "CH3CH2NH2": 2,
    "trans-butane": 3, "isobutene": 3, "CH3CH2OCH3": 3, "CH3NO2": 1, "HCOOH": 1, "SiH4": 0, "butadiene": 3,
}  # fmt: skip


@pytest.mark.parametrize("name", TORSIONS)
def test_rows_are_independent_and_leave_the_torsions(name):
    made = of_ase(name)
    rows = held_rows(made, "allangles")
    s = singular_values(rows.constraint_set, made.positions)
    assert len(s) == 3 * len(made.positions) - 6 - TORSIONS[name]
    assert s[-1] > 0.02 * s[0]


@pytest.mark.parametrize("name", ["C6H6", "CH3CONH2", "C5H5N", "bicyclobutane", "trans-butane", "NH3"])
def test_every_angle_stays_also_those_that_are_no_rows(name):
    """Moved away and put back onto the rows, the molecule has the angles that it had."""
    made = of_ase(name)
    rows = held_rows(made, "allangles")
    motion = Motion(rows.constraint_set, made.positions)
    assert motion.rank == rows.constraint_set.n_rows
    every = every_angle(made)
    for seed in range(3):
        off = made.positions + 0.03 * np.random.default_rng(seed).normal(size=made.positions.shape)
        on = motion.restore_positions(off)
        assert np.abs(every.value(off)).max() > 0.01
        # At 360 degrees in all, an angle feels the square of what is left out of the plane, not more.
        assert np.abs(every.value(on)).max() < 1e-12


def test_a_piece_of_villin_with_its_rings_is_well_conditioned():
    """NLPLWKQ: proline, tryptophan, amides. All of its angles, many of them dependent, have a condition of 5,000."""
    pdb = app.PDBFile(str(VILLIN))
    some = [atom.index for atom in pdb.topology.atoms() if 18 <= atom.residue.index <= 24]
    rows = kcons.openmm.constraints_of(pdb.topology, pdb.positions, "allangles", select=some, rigid_water=False)
    assert {atom.residue.name for atom in pdb.topology.atoms() if atom.index in some} >= {"PRO", "TRP"}
    whole, x = rows.constraint_set, rows.snapshot.positions
    largest, rank = condition(whole, x)
    assert rank == whole.n_rows and largest < 100


def test_a_flat_center_has_an_improper_dihedral():
    made = star([[1, 0, 0], [-0.5, 0.9, 0.01], [-0.5, -0.8, 0]])
    rows = held_rows(made, "allangles")
    assert [item.family for item in rows] == ["Distance", "Angle", "Dihedral"]
    assert condition(rows.constraint_set, made.positions)[0] < 4
    assert condition(every_angle(made), made.positions)[0] > 100


#: Directions of neighbors, and how many rows beside the bonds are independent: 2n - 3.
STARS = {
    "tetrahedron": [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]],
    "five": [[1, 0, 0], [-0.5, 0.9, 0], [-0.5, -0.9, 0], [0, 0.1, 1], [0.1, 0, -1]],
    "four in a plane at no right angle: two impropers": [[1, 0, 0], [0.2, 1, 0], [-1, 0.3, 0], [0, -1, 0]],
    # Straight angles hold an end by a linear row, from which the length of its bond follows.
    "square": [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]],
    "T": [[1, 0, 0], [0, 1, 0], [-1, 0, 0]],
    "octahedron": [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]],
}


@pytest.mark.parametrize("name", STARS)
def test_centers_have_two_n_minus_three_rows(name):
    made = star(STARS[name])
    held, n = held_rows(made, "allangles").constraint_set, len(STARS[name])
    largest, rank = condition(held, made.positions)
    assert rank == held.n_rows == 3 * n - 3 and Motion(held, made.positions).degrees_of_freedom == 6
    assert largest < 15


@pytest.mark.parametrize(("name", "left"), {"CO2": 5, "NCCN": 5, "2-butyne": 7, "C3H4_D2d": 7, "H2CCHCN": 7}.items())
def test_rows_of_straight_molecules_are_independent_wherever_they_point(name, left):
    made = of_ase(name)
    held = held_rows(made, "allangles").constraint_set
    x = Motion(held, made.positions).restore_positions(made.positions, bonds=[])
    motion = Motion(held, x)
    assert motion.rank == held.n_rows == x.size - left
    for axes in ([0, 1, 2], [1, 2, 0], [2, 0, 1]):
        v = motion.project_velocities(x[:, axes], np.random.default_rng(0).normal(size=x.shape))
        assert np.abs(held.jacobian(x[:, axes]) @ v.ravel()).max() < 1e-13
    beside = held_rows(made, "allangles", rigid_bodies=[[0, 1]]).constraint_set
    assert condition(beside, x)[1] == beside.n_rows == x.size - left


def test_of_six_angles_the_one_between_the_lightest_is_none_of_the_rows():
    methylene = star([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], ["C", "H", "C", "H", "C"])
    triples, quads = angle_rows(methylene, methylene.topology.bonds, [])
    assert len(quads) == 0
    left = {(i, k) for i, k in combinations(range(1, 5), 2)} - {(i, k) for i, _, k in triples.tolist()}
    assert left == {(1, 3)}
    best = condition(held_rows(methylene, "allangles").constraint_set, methylene.positions)[0]
    for other in combinations(range(1, 5), 2):
        pairs = [(i, 0, k) for i, k in combinations(range(1, 5), 2) if (i, k) != other]
        whole = ConstraintSet(
            [Distance(methylene.topology.bonds), Angle(pairs)], methylene.positions, methylene.topology.masses
        )
        assert condition(whole, methylene.positions)[0] >= best - 1e-9


def test_beside_a_rigid_body_only_what_it_leaves_is_held():
    made = of_ase("C6H6")
    carbons = np.flatnonzero(made.topology.elements == "C")
    rows = held_rows(made, "allangles", rigid_bodies=[carbons])
    s = singular_values(rows.constraint_set, made.positions)
    assert len(s) == 3 * 12 - 6
    assert s[-1] > 0.02 * s[0]
    # A body of two bonds of a carbon: the first of the others has two rows, as the second.
    made = of_ase("CH4")
    rows = held_rows(made, "allangles", rigid_bodies=[[0, 3, 4]])
    assert condition(rows.constraint_set, made.positions)[1] == rows.constraint_set.n_rows == 9
    # Two bodies that share an atom: three rows turn one against the other.
    rows = held_rows(made, "allangles", rigid_bodies=[[0, 1, 2], [0, 3, 4]])
    assert condition(rows.constraint_set, made.positions)[1] == rows.constraint_set.n_rows == 9


def test_selected_atoms_and_distances():
    made = of_ase("CH3CONH2")
    some = np.ones(len(made.positions), dtype=bool)
    some[-1] = False
    rows = held_rows(made, "allangles", select=some)
    assert condition(rows.constraint_set, made.positions)[1] == rows.constraint_set.n_rows
    assert not any((item.atoms == len(some) - 1).any() for item in rows)
    apart = held_rows(made, "allangles", angles="distances")
    assert {item.family for item in apart} == {"Distance", "Dihedral"}
    assert condition(apart.constraint_set, made.positions)[1] == 3 * len(made.positions) - 6 - 2
    assert condition(apart.constraint_set, made.positions)[0] < 50


# -- rings ------------------------------------------------------------------------------------------


NO_QUADS = np.zeros((0, 4), np.int64)


def cycle(*atoms):
    return list(pairwise([*atoms, atoms[0]]))


def ring(n, height, length=1.4):
    """A regular ring in angstrom, its atoms at these heights."""
    turn = 2 * np.pi * np.arange(n) / n
    radius = length / (2 * np.sin(np.pi / n))
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.array(height, dtype=float)], axis=1)


def rows_of_ring(x, *body):
    """Of a ring of which some atoms are held rigid."""
    n = len(x)
    bonds = sorted_pairs(cycle(*range(n)))
    made = snapshot(["C"] * n, x, bonds)
    rigid = [np.array([body])] if body else []
    return ring_rows(made, bonds, bond_angles(bonds, n), NO_QUADS, [np.arange(n)], rigid)


@pytest.mark.parametrize(
    ("bonds", "n", "labels", "sizes"),
    [
        ([(0, 1), (1, 2), (1, 3)], 4, [-1, -1, -1], []),
        ([*cycle(0, 1, 2), (2, 3)], 4, [0, 0, 0, -1], [[3]]),
        # Two rings, joined by a bond, by an atom, by an edge, by a bridge.
        ([*cycle(0, 1, 2), (2, 3), *cycle(3, 4, 5)], 6, [0, 0, 0, -1, 1, 1, 1], [[3], [3]]),
        ([*cycle(0, 1, 2), *cycle(2, 3, 4, 5)], 6, [0, 0, 0, 1, 1, 1, 1], [[3], [4]]),
        ([*cycle(0, 1, 2, 3, 4), *cycle(4, 0, 5, 6, 7, 8)], 9, [0] * 10, [[5, 6]]),
        ([*cycle(0, 1, 2, 3, 4, 5), (0, 6), (6, 3)], 7, [0] * 8, [[5, 5]]),
        (cycle(*range(LARGEST)), LARGEST, [0] * LARGEST, [[LARGEST]]),
        (cycle(*range(LARGEST + 1)), LARGEST + 1, [-1] * (LARGEST + 1), []),
    ],
)
def test_rings_that_share_a_bond_are_one_system(bonds, n, labels, sizes):
    of_bond, systems = ring_systems(sorted_pairs(bonds), n)
    assert of_bond.tolist() == labels
    assert [sorted(len(ring) for ring in rings) for rings in systems] == sizes


CHAIR = 0.25 * np.array([1, -1, 1, -1, 1, -1])
ENVELOPE = [0.5, 0, 0, 0, 0]


@pytest.mark.parametrize(
    ("height", "angles", "dihedrals"),
    [
        (np.zeros(3), 0, 0),
        (np.zeros(4), 1, 1),
        (np.zeros(5), 2, 2),
        (np.zeros(6), 3, 3),
        (0.1 * CHAIR, 3, 3),
        (CHAIR, 6, 0),
        (ENVELOPE, 4, 0),
        ([0.3, -0.3, 0.3, -0.3], 2, 0),
    ],
)
def test_a_ring_is_rigid_by_as_many_rows_as_it_needs(height, angles, dihedrals):
    x = ring(len(height), height)
    triples, quads = rows_of_ring(x)
    assert (len(triples), len(quads)) == (angles, dihedrals)
    items = [Distance(sorted_pairs(cycle(*range(len(x))))), Angle(triples), Dihedral(quads)]
    s = singular_values(ConstraintSet(items, x, np.full(len(x), 12.0)), x)
    assert len(s) == 3 * len(x) - 6  # all that a rigid body has
    assert s[-1] > 0.01 * s[0]


def test_rows_within_a_body_are_held_already(monkeypatch):
    x = ring(6, np.zeros(6))
    assert list(map(len, rows_of_ring(x, *range(6)))) == [0, 0]
    # Four of the six: two more atoms of two bonds, 6 of their rows are 3 bonds, 1 angle, 2 dihedrals.
    triples, quads = rows_of_ring(x, *range(4))
    assert not np.isin(triples, range(4)).all(axis=1).any()
    assert (len(triples), len(quads)) == (1, 2)
    monkeypatch.setattr("kcons.topology.angle_rows.LARGE_SYSTEM", 5)  # larger ones keep what they have
    assert list(map(len, rows_of_ring(x))) == [6, 0]


@pytest.mark.parametrize("name", ["C6H6", "C2H4"])
def test_a_molecule_across_the_faces_of_the_cell_has_the_same_rows(name):
    made = of_ase(name)
    there = {"cell": 8.0 * np.eye(3), "pbc": np.ones(3, dtype=bool)}
    one, two = (replace(made, positions=x, **there) for x in (made.positions + 4.0, np.mod(made.positions, 8.0)))
    for rows in zip(*(angle_rows(each, made.topology.bonds, []) for each in (one, two)), strict=True):
        np.testing.assert_array_equal(*rows)
