"""Molecules cut at a bond, and the motions of the pieces."""

from __future__ import annotations

import numpy as np

from kcons.motion.restoring.rigid_pieces import MoleculeGraph


def test_pieces_of_a_ring_with_tails() -> None:
    """0-1-2-3 is a ring, 3-4-5 a tail, 6-7 another molecule, 8 alone and not asked for."""
    bonds = np.array([(0, 1), (1, 2), (2, 3), (3, 0), (3, 4), (4, 5), (6, 7)])
    pieces = MoleculeGraph(9, bonds, np.array([0, 6]))
    for j, k, beyond in [(3, 4, {4, 5}), (4, 3, {0, 1, 2, 3}), (4, 5, {5}), (5, 4, {0, 1, 2, 3, 4}), (7, 6, {6})]:
        found = pieces.beyond(j, k)
        assert found is not None and set(found.tolist()) == beyond
    assert pieces.beyond(0, 1) is None and pieces.beyond(0, 5) is None
    assert set(pieces.molecule(5).tolist()) == {0, 1, 2, 3, 4, 5}
    assert set(pieces.atoms.tolist()) == set(range(8))
