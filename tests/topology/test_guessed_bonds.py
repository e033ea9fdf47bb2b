"""Bonds by distance: what is bonded, under which images, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from snapshots import WATER, rotations, snapshot

from kcons.errors import InputError
from kcons.topology.guessed_bonds import guess_bonds

SHORT = [[0, 0, 0], [1.05, 0, 0], [2.2, 0, 0]]  # a hydrogen bond: 1.05 and 1.15 angstrom to two oxygens
FAR = [[0, 0, 0], [2.0, 0, 0], [0, 1.95, 0]]


@pytest.mark.parametrize(
    ("elements", "x", "expected"),
    [
        ("O H H", WATER, [[0, 1], [0, 2]]),
        ("O H O", SHORT, [[0, 1]]),  # a hydrogen keeps its nearest neighbor
        ("H H", [[0, 0, 0], [0.74, 0, 0]], [[0, 1]]),
        ("H H", [[0, 0, 0], [1.0, 0, 0]], []),
        ("C Zn C", FAR, []),  # a metal, and 1.95 angstrom
        ("C Zn C", [*FAR[:2], [0, 1.85, 0]], [[0, 2]]),
    ],
)
def test_what_is_bonded(elements, x, expected):
    x = np.array(x, dtype=float)
    assert guess_bonds(snapshot(elements.split(), x)).tolist() == expected
    assert guess_bonds(snapshot(elements.split(), x / 10, angstrom=0.1)).tolist() == expected


def test_only_bonds_of_marked_atoms():
    x = np.concatenate([WATER, WATER + 5.0])
    marked = np.array([False] * 4 + [True, False])
    assert guess_bonds(snapshot(["O", "H", "H"] * 2, x), marked).tolist() == [[3, 4]]
    # The nearest neighbor of the hydrogen, which is not marked, may have its bonds already.
    assert guess_bonds(snapshot(["O", "H", "O"], SHORT), np.array([False, False, True])).tolist() == []


@pytest.mark.parametrize(
    "cell",
    [np.diag([9.0, 8.0, 10.0]), np.array([[9.0, 0, 0], [3.0, 8.0, 0], [-2.0, 2.5, 7.0]]), np.diag([3.2, 3.4, 3.3])],
    ids=["right-angled", "triclinic", "narrow"],
)
def test_bonds_across_the_cell_are_those_of_whole_molecules(cell):
    volume = abs(np.linalg.det(cell))
    count = max(1, int(volume / 60))
    rng = np.random.default_rng(4)
    grid = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(-1, 3)[:count] / 3
    x = ((grid + 0.05) @ cell)[:, None] + WATER @ rotations(count, 3)
    wrapped = x.reshape(-1, 3) @ np.linalg.inv(cell)
    wrapped = (wrapped - np.floor(wrapped)) @ cell
    # Any image will do, also those outside of the cell.
    wrapped += rng.integers(-2, 3, size=(3 * count, 3)) @ cell
    bonds = guess_bonds(snapshot(["O", "H", "H"] * count, wrapped, cell=cell))
    first = 3 * np.arange(count)
    expected = np.concatenate([np.stack([first, first + k], 1) for k in (1, 2)])
    assert sorted(map(tuple, bonds.tolist())) == sorted(map(tuple, expected.tolist()))


def test_what_cannot_be_guessed_is_refused():
    with pytest.raises(InputError, match="no elements"):
        guess_bonds(snapshot(["", ""], [[0, 0, 0], [1, 0, 0]]))
    with pytest.raises(InputError, match=r"C of MOL 1 \(atom 0\) and C of MOL 1 \(atom 1\) are 0.1 angstrom apart"):
        guess_bonds(snapshot(["C", "C"], [[0, 0, 0], [0.1, 0, 0]]))
    with pytest.raises(InputError, match="not finite"):
        guess_bonds(snapshot(["C", "C"], [[0, 0, 0], [np.nan, 0, 0]]))
