"""Cheap forces fitted to expensive ones: slopes of their energy, the same for what may be exchanged, and right."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from fitted_forces import FittedForces, along_constraints

from kcons import ConstraintSet, Motion
from kcons.constraints import Distance
from kcons.errors import InputError

#: A tetrahedron of which one edge is held; the two ends of that may be exchanged.
X = np.array([[0.0, 0, 0], [1.2, 0, 0], [0.4, 1.1, 0], [0.3, 0.5, 1.3]])
PAIRS = np.array([[0, 2], [1, 2], [0, 3], [1, 3], [2, 3]])
SAME = np.array([[0, 1, 2, 3], [1, 0, 2, 3]])


@pytest.fixture(scope="module")
def motion():
    return Motion(ConstraintSet(Distance([[0, 1]]), X, np.array([2.0, 2, 3, 5])), X)


def truth(x):
    """Energy and forces: terms of pairs and a product of two distances, the same under the exchange."""
    r = [np.linalg.norm(x[i] - x[j]) for i, j in PAIRS]
    a, b, c, d, e = (2.0 / r_ for r_ in r)
    energy = a**2 + b**2 + 3 * c + 3 * d - 0.5 * e + 0.7 * (a * c + b * d) + 0.2 * e**2
    slopes = [2 * a + 0.7 * c, 2 * b + 0.7 * d, 3 + 0.7 * a, 3 + 0.7 * b, -0.5 + 0.4 * e]
    f = np.zeros_like(x)
    for (i, j), slope, q, r_ in zip(PAIRS, slopes, (a, b, c, d, e), r, strict=True):
        pull = slope * q / r_**2 * (x[i] - x[j])
        f[i] += pull
        f[j] -= pull
    return energy, f


@pytest.fixture(scope="module")
def frames():
    places = X + 0.2 * np.random.default_rng(3).normal(size=(60, *X.shape))
    held = places[:, 1] - places[:, 0]
    places[:, 1] = places[:, 0] + 1.2 * held / np.linalg.norm(held, axis=1)[:, None]
    return [(x, truth(x)[1]) for x in places]


def test_the_truth_is_found(motion, frames):
    """Where it is such a polynomial; its energy up to a constant, for constraints hide nothing of that."""
    found = FittedForces(PAIRS, SAME, (1,))
    assert found.error(motion, frames) == pytest.approx(1)  # no forces before the fit
    found.fit(motion, frames[:40], ridge=1e-14)
    assert found.error(motion, frames[40:]) < 1e-6
    energies = np.array([[found.evaluate(x)[0], truth(x)[0]] for x, _ in frames[40:]])
    assert np.ptp(energies[:, 0] - energies[:, 1]) < 1e-5 * np.ptp(energies[:, 1])


def test_forces_are_the_slope_of_the_energy_and_atoms_may_be_exchanged(motion, frames):
    found = FittedForces(PAIRS, SAME, (1, 3))
    found.fit(motion, frames)
    x, v, h = frames[0][0], np.random.default_rng(5).normal(size=X.shape), 1e-5
    energy, forces = found.evaluate(x)
    slope = (found.evaluate(x + h * v)[0] - found.evaluate(x - h * v)[0]) / (2 * h)
    assert slope == pytest.approx(-(forces * v).sum(), rel=1e-7)
    assert np.abs(forces.sum(axis=0)).max() < 1e-12
    other = found.evaluate(x[SAME[1]])
    assert other[0] == pytest.approx(energy, abs=1e-12) and np.allclose(other[1], forces[SAME[1]], atol=1e-12)


def test_as_many_coefficients_as_there_are_kinds():
    """Of pairs, and of pairs of pairs: with all four atoms alike, one and the three ways in which two pairs can lie."""
    pairs = np.array(list(itertools.combinations(range(4), 2)))
    orders = list(itertools.permutations(range(4)))
    assert FittedForces(pairs, orders, (1,)).coefficients == 1 + 3
    assert FittedForces(pairs, orders[:1], (1,)).coefficients == 6 + 21
    assert FittedForces(pairs, orders, (1, 2)).coefficients == 2 + 3 * 3


def test_along_the_constraints(motion):
    """The mass metric: a projector, which takes what rows push to nothing."""
    p = along_constraints(motion, X) * np.sqrt(np.repeat(motion.constraint_set.masses, 3))
    assert np.allclose(p @ p, p) and np.allclose(p, p.T) and round(np.trace(p)) == 11
    assert np.abs(along_constraints(motion, X) @ np.array([1.0, 0, 0, -1, 0, 0, *[0] * 6])).max() < 1e-12


def test_bad_input(motion):
    with pytest.raises(InputError, match=r"takes a pair to atoms \(1, 2\), which are no pair"):
        FittedForces([[0, 2]], SAME)
    with pytest.raises(InputError, match=r"powers are \(0,\); give numbers of 1 and more"):
        FittedForces(PAIRS, SAME, (0,))
    with pytest.raises(InputError, match="no frames to fit to"):
        FittedForces(PAIRS, SAME).fit(motion, [])


@pytest.mark.parametrize("part", [0, 1])
def test_a_frame_that_is_not_finite_changes_nothing(motion, frames, part):
    found = FittedForces(PAIRS, SAME, (1,))
    found.fit(motion, frames)
    before = found.evaluate(X)[1]
    spoiled = [tuple(array.copy() for array in frame) for frame in frames]
    spoiled[7][part][2, 1] = np.nan
    with pytest.raises(InputError, match="frame 7 has positions or forces that are not finite"):
        found.fit(motion, spoiled)
    assert np.array_equal(found.evaluate(X)[1], before)


def test_pairs_are_whole_numbers():
    with pytest.raises(InputError, match="pairs of atoms"):
        FittedForces(PAIRS + 0.5, SAME)
