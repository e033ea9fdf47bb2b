"""Differences and sums of distances, against numbers that were worked out by hand and by other means."""

from __future__ import annotations

import math

import numpy as np
import pytest
from ase import Atoms
from ase.calculators.lj import LennardJones
from ase.constraints import FixInternals

from kcons import ConstraintSet, Motion
from kcons.ase import constrain, from_ase_constraints
from kcons.constraints import Distance, DistanceDifference
from kcons.errors import ImageError, InputError

#: Chlorine, hydrogen, bromine.
TRANSFER = [[0, 1], [1, 2]]
X = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [3.0, 4.0, 12.0]])  # 5 apart, then 12
M = np.array([35.0, 1.0, 80.0])


# -- periodic cells ----------------------------------------------------------------------------------------


def lengths_in(cell: np.ndarray, x: np.ndarray, pairs: list[list[int]]) -> np.ndarray:
    """By looking at all 27 images."""
    shifts = np.stack(np.meshgrid(*3 * [[-1, 0, 1]]), axis=-1).reshape(-1, 3) @ cell
    inside = np.linalg.solve(cell.T, x.T).T % 1.0 @ cell
    return np.array([np.linalg.norm(inside[i] - inside[j] + shifts, axis=1).min() for i, j in pairs])


#: A chain, a star, two pairs that lie anywhere, a star and a pair.
PATTERNS = {
    "chain": [[0, 1], [1, 2]],
    "star": [[1, 0], [1, 2], [1, 3]],
    "apart": [[0, 1], [2, 3]],
    "star and pair": [[0, 1], [1, 2], [3, 1], [4, 5]],
}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_each_pair_takes_its_shortest_image(pattern):
    """In random cells, atoms stored in any image, and none, one or all of the distances held: value and a motion."""
    pairs = PATTERNS[pattern]
    far = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        cell = 5.0 * np.eye(3) + 0.5 * rng.normal(size=(3, 3))
        n = 1 + max(max(pair) for pair in pairs)
        x = rng.uniform(-4, 4, size=(n, 3))
        for i, j in pairs:  # along the tree of the pattern
            step = rng.normal(size=3)
            x[max(i, j)] = x[min(i, j)] + rng.uniform(0.6, 1.8) * step / np.linalg.norm(step)
        x += rng.integers(-2, 3, size=(n, 3)) @ cell
        weights = rng.choice([-1.0, 1.0], len(pairs)) * rng.uniform(0.5, 2.0, len(pairs))
        rows = [DistanceDifference(pairs, weights=weights)]
        if seed % 3:
            rows.append(Distance(pairs[: None if seed % 3 == 2 else 1]))  # all, or one of them
        masses = rng.uniform(1, 20, n)
        held = ConstraintSet(rows, x, masses, cell=cell)
        assert held.target()[0] == pytest.approx(weights @ lengths_in(cell, x, pairs), abs=1e-12)
        motion = Motion(held, x)
        y = x + 0.02 * rng.normal(size=x.shape)
        found = motion.project_positions(y, x)
        assert weights @ lengths_in(cell, found, pairs) == pytest.approx(held.target()[0], abs=1e-11)
        far += bool(np.linalg.norm(x[0] - x[-1]) > held.half_width)
    assert far > 20


def test_pairs_of_a_row_need_not_be_near_each_other():
    """Two bonds at the two ends of a long cell: nothing says how far one may be from the other."""
    cell = np.diag([20.0, 6.0, 6.0])
    x = np.array([[0.5, 0, 0], [1.5, 0, 0], [10.4, 3.0, 3.0], [11.6, 3.0, 3.0]])
    held = ConstraintSet(DistanceDifference([[0, 1], [2, 3]]), x, np.ones(4), cell=cell)
    assert held.target() == pytest.approx([-0.2], abs=1e-14)
    motion = Motion(held, x)
    for shift in range(12):  # the second bond goes around the first
        there = x + np.array([[0, 0, 0], [0, 0, 0], [shift, 0, 0], [shift, 0, 0]])
        there[3, 0] += 0.1
        found = motion.project_positions(there, x + (there - x).round())
        assert math.dist(*found[:2]) - math.dist(*found[2:]) == pytest.approx(-0.2, abs=1e-12)


def test_a_pair_that_reaches_half_the_cell_is_refused():
    cell = 6.0 * np.eye(3)
    x = np.array([[0.0, 0, 0], [2.6, 0, 0], [2.6, 1.0, 0]])
    motion = Motion(ConstraintSet(DistanceDifference(TRANSFER), x, np.ones(3), cell=cell), x)
    with pytest.raises(ImageError, match="atoms 0 and 1"):
        motion.project_positions(x + np.array([[0, 0, 0], [0.7, 0, 0], [0.7, 0.7, 0]]), x)
    x[0, 1] = 2.6
    with pytest.raises(InputError, match="half the box"):
        ConstraintSet(DistanceDifference(TRANSFER), x, np.ones(3), cell=cell)


# -- with ASE ----------------------------------------------------------------------------------------------


def proton() -> Atoms:
    atoms = Atoms("ClHBr", [[0, 0, 0], [1.45, 0.1, 0], [3.05, 0, 0.2]])
    atoms.calc = LennardJones(sigma=1.3, epsilon=0.05)
    return atoms


def test_bondcombos_become_this_row_and_go_back():
    atoms = proton()
    combos = [[None, [[0, 1, 1.0], [1, 2, -1.0]]], [3.0, [[0, 2, 1.0], [0, 1, 0.5], [1, 2, -0.25]]]]
    atoms.set_constraint(FixInternals(bondcombos=combos[:1]))
    (row,) = from_ase_constraints(atoms)
    assert row == row and row.family == "DistanceDifference" and row.target is None
    value = FixInternals.get_bondcombo(atoms, combos[0][1])
    atoms.set_constraint()
    held = constrain(atoms, row)
    assert held.constraints[0].target_at(0.0) == pytest.approx([value], abs=1e-14)
    data = held.todict()
    assert data["name"] == "FixInternals"
    ((target, pairs),) = data["kwargs"]["bondcombos"]
    assert target == pytest.approx(value, abs=1e-14) and pairs == combos[0][1]
    atoms.set_constraint(FixInternals(bondcombos=combos))
    _, other = from_ase_constraints(atoms)
    wanted = FixInternals.get_bondcombo(atoms, combos[1][1])
    assert other.target.tolist() == [3.0]
    assert other.measure(atoms.positions[other.atoms], 0.0) == pytest.approx([wanted], abs=1e-14)


def test_a_proton_goes_over_within_a_molecule_that_stays_as_it_is():
    """Malonaldehyde, halfway between its two enols: no atom but the proton moves by more than 0.03."""
    places = [[-1.29, 0.55, 0], [-0.60, 1.27, 0], [1.27, 0.75, 0], [-1.16, -0.74, 0], [0.05, -1.40, 0]]
    atoms = Atoms("OHOCCCHHH", [*places, [1.20, -0.48, 0], [-2.12, -1.26, 0], [0.10, -2.48, 0], [2.17, -1.02, 0]])
    atoms.info["bonds"] = [[0, 1], [0, 3], [3, 4], [4, 5], [5, 2], [3, 6], [4, 7], [5, 8]]
    before = atoms.positions.copy()
    constrain(atoms, DistanceDifference(TRANSFER, 0.0), project=True)
    assert atoms.get_distance(0, 1) == pytest.approx(atoms.get_distance(1, 2), abs=1e-12)
    moved = np.linalg.norm(atoms.positions - before, axis=1)
    assert moved[1] > 0.3 and np.delete(moved, 1).max() < 0.03
