"""Small rings: which there are, and which of their angles and dihedrals hold them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from snapshots import snapshot

from kcons.constraints import Angle, Dihedral, Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.topology import angle_rows
from kcons.topology.angle_rows import LARGEST, ring_rows, ring_systems
from kcons.topology.topology import bond_angles, sorted_pairs

NO_QUADS = np.zeros((0, 4), np.int64)


def cycle(*atoms):
    return list(pairwise([*atoms, atoms[0]]))


def found(bonds, n):
    """Labels of the bonds, and the sizes of the rings of each system."""
    of_bond, systems = ring_systems(sorted_pairs(bonds), n)
    return of_bond.tolist(), [sorted(len(ring) for ring in rings) for rings in systems]


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


def singular_values(x, triples, quads):
    items = [Distance(sorted_pairs(cycle(*range(len(x))))), Angle(triples), Dihedral(quads)]
    rows = ConstraintSet(items, x, np.full(len(x), 12.0)).jacobian(x).toarray()
    return np.linalg.svd(rows / np.linalg.norm(rows, axis=1, keepdims=True), compute_uv=False)


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
    assert found(bonds, n) == (labels, sizes)


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
    s = singular_values(x, triples, quads)
    assert len(s) == 3 * len(x) - 6  # all that a rigid body has
    assert s[-1] > 0.01 * s[0]


def test_rows_within_a_body_are_held_already():
    x = ring(6, np.zeros(6))
    triples, quads = rows_of_ring(x, *range(6))
    assert len(triples) == len(quads) == 0
    # Four of the six: two more atoms of two bonds, 6 of their rows are 3 bonds, 1 angle, 2 dihedrals.
    triples, quads = rows_of_ring(x, *range(4))
    assert not np.isin(triples, range(4)).all(axis=1).any()
    assert (len(triples), len(quads)) == (1, 2)


def test_a_large_system_keeps_what_it_has(monkeypatch):
    monkeypatch.setattr(angle_rows, "LARGE_SYSTEM", 5)
    triples, quads = rows_of_ring(ring(6, np.zeros(6)))
    assert (len(triples), len(quads)) == (6, 0)


def test_a_ring_across_the_faces_of_the_cell_is_the_same_ring():
    x = ring(6, np.zeros(6))
    bonds = sorted_pairs(cycle(*range(6)))
    cell = 8.0 * np.eye(3)
    rows = [
        ring_rows(snapshot(["C"] * 6, y, bonds, cell=cell), bonds, bond_angles(bonds, 6), NO_QUADS, [np.arange(6)], [])
        for y in (x + 4.0, np.mod(x, 8.0))
    ]
    for one, two in zip(*rows, strict=True):
        np.testing.assert_array_equal(one, two)
