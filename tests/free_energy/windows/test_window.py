"""Settings of windows, and how coordinates come to where a window begins."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from ase.calculators.emt import EMT

from kcons.constraints import Dihedral, Distance, Formula
from kcons.errors import InfeasibleError
from kcons.free_energy import AseWindows
from kcons.free_energy.windows.driver import digest_of

X = np.array([[0.0, 1.0, 0.1], [0.0, 0.0, 0.0], [1.5, 0.0, 0.0], [1.6, 1.0, 0.2], [2.0, -0.6, 0.8]])
TURN = Dihedral([[0, 1, 2, 3]])
BONDS = [[0, 1], [1, 2], [2, 3], [2, 4]]


def of_atoms(x, coordinates, others, bonds):
    atoms = Atoms(f"H{len(x)}", x, info={"bonds": np.array(bonds)})
    return AseWindows(atoms, EMT, coordinates, others)


def held(coordinates=None, others=()):
    return of_atoms(X, coordinates or {"turn": TURN}, others, BONDS)


def test_groups_are_turned_and_keep_their_shape():
    rows = held(others=[Distance([[0, 1]])])
    start = float(rows.start[0])
    motion, x = rows.placed([start + 2.0])
    assert motion.constraint_set.measure(x)[-1] == pytest.approx(start + 2.0 - 2 * np.pi * (start + 2.0 > np.pi))
    for i, j in [*BONDS, [3, 4], [1, 3], [1, 4]]:
        assert np.linalg.norm(x[i] - x[j]) == pytest.approx(np.linalg.norm(X[i] - X[j]), rel=2e-3)


#: A ring of four, puckered by 16 degrees, with a neighbor on each atom.
CORNERS = np.array([[1.0, 0.0, 0.1], [0.0, 1.0, -0.1], [-1.0, 0.0, 0.1], [0.0, -1.0, -0.1]])
RING = np.concatenate([CORNERS, 2.0 * CORNERS])
AROUND = [[0, 1], [1, 2], [2, 3], [0, 3], [0, 4], [1, 5], [2, 6], [3, 7]]


def ring(bonds=AROUND, others=()):
    return of_atoms(RING, {"pucker": Dihedral([[0, 1, 2, 3]])}, others, bonds)


def test_a_ring_comes_to_its_window_by_small_steps():
    """No part of a ring can be turned; bonds change little, and those that are held not at all."""
    rows = ring(others=[Distance(AROUND[:2])])
    start = float(rows.start[0])
    assert abs(start) == pytest.approx(0.278, abs=1e-3)
    motion, x = rows.placed([-start])  # to its mirror image
    assert motion.constraint_set.measure(x)[-1] == pytest.approx(-start, abs=1e-10)
    lengths = [np.linalg.norm(y[[a for a, _ in AROUND]] - y[[b for _, b in AROUND]], axis=1) for y in (RING, x)]
    assert np.abs(lengths[1] / lengths[0] - 1).max() < 0.1
    assert lengths[1][:2] == pytest.approx(lengths[0][:2], rel=1e-12)


def test_a_ring_is_not_torn():
    with pytest.raises(InfeasibleError, match="bond 0-1 changed"):
        ring().placed([2.5])


def test_digests_tell_systems_apart():
    parts = [X, "lj", {"sigma": 1.0}, [TURN, Distance(BONDS)]]
    assert digest_of(*parts) == digest_of(X.copy(), "lj", {"sigma": 1.0}, [Dihedral([[0, 1, 2, 3]]), Distance(BONDS)])
    others = [[X + 1e-9, *parts[1:]], [X, "emt", *parts[2:]], [X, "lj", {"sigma": 1.1}, parts[3]]]
    others += [[*parts[:3], [TURN]], [*parts[:3], [TURN, Distance(BONDS[:3])]]]
    others += [[*parts[:3], [TURN, Distance(BONDS, 1.5)]], [*parts[:3], [TURN, Distance(BONDS, 1.6)]]]
    others += [[*parts[:3], [Formula(text, [[0]])]] for text in ("x1", "y1")]
    assert len({digest_of(*each) for each in (parts, *others)}) == 10
