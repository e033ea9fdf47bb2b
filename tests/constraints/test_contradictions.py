"""Targets that contradict each other."""

from __future__ import annotations

import itertools
from unittest import mock

import numpy as np
import pytest
from constraint_cases import MASSES, scattered
from hypothesis import given
from hypothesis import strategies as st

from kcons.constraints import Angle, Dihedral, Distance, contradictions
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ContradictionError, InfeasibleError


def test_one_pair_at_two_lengths():
    x = scattered(0)
    with pytest.raises(
        ContradictionError, match=r"constraints #0 and #1 on atoms \(0, 1\) have different targets 1.0, 1.001"
    ) as caught:
        ConstraintSet([Distance([[0, 1], [1, 0]], [1.0, 1.001])], x, MASSES)
    assert isinstance(caught.value, ValueError)
    assert (caught.value.rows, caught.value.atoms) == ((0, 1), (0, 1))


def test_across_objects_and_against_an_initial_length():
    x = np.array([[0.0, 0, 0], [1.5, 0, 0], [0, 2.0, 0]])
    with pytest.raises(ContradictionError, match=r"#1 and #2 on atoms \(0, 1\) have different targets 1.5, 1.2"):
        ConstraintSet([Distance([[1, 2], [0, 1]]), Distance([[1, 0]], 1.2)], x, np.ones(3))


def test_the_same_length_twice_is_accepted():
    x = scattered(0)
    held = ConstraintSet([Distance([[0, 1], [1, 0], [0, 1]])], x, MASSES)
    assert held.n_rows == 3
    ConstraintSet([Distance([[0, 1], [1, 0]], [1.0, 1.0 + 1e-12])], x, MASSES)


def test_angles_and_dihedrals_at_two_values():
    x = scattered(0)
    with pytest.raises(ContradictionError, match=r"atoms \(0, 1, 2\) have different targets 1.0, 1.1"):
        ConstraintSet([Angle([[0, 1, 2], [2, 1, 0]], [1.0, 1.1])], x, MASSES)
    with pytest.raises(ContradictionError, match=r"atoms \(0, 1, 2, 3\) have different targets 1.0, 1.1"):
        ConstraintSet([Dihedral([[0, 1, 2, 3], [3, 2, 1, 0]], [1.0, 1.1])], x, MASSES)
    # Other vertices, other axes and other images are no contradiction.
    ConstraintSet([Angle([[0, 1, 2], [0, 2, 1]], [1.0, 1.1])], x, MASSES)
    ConstraintSet([Dihedral([[0, 1, 2, 3], [3, 2, 1, 0], [0, 2, 1, 3]], [1.0, 1.0 + 2 * np.pi, 1.1])], x, MASSES)


def test_triangle_inequality():
    x = scattered(0)
    with pytest.raises(
        InfeasibleError, match=r"infeasible: residual cannot go below 0.333333 \(sum of squares\).*\(0, 1, 2\)"
    ) as caught:
        ConstraintSet([Distance([[5, 6], [0, 1], [1, 2], [0, 2]], [9.0, 1.0, 1.0, 3.0])], x, MASSES)
    assert isinstance(caught.value, RuntimeError)
    assert caught.value.residual == pytest.approx(1 / 3, rel=1e-14)
    assert (caught.value.row, caught.value.atoms) == (3, (0, 1, 2))


def test_flat_triangles_pass():
    ConstraintSet([Distance([[0, 1], [1, 2], [0, 2]], [0.1, 0.2, 0.1 + 0.2])], scattered(0), MASSES)
    x = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [1.6, 1.7, 1.8]])
    ConstraintSet([Distance([[0, 1], [1, 2], [0, 2]])], x, np.ones(3))


@given(
    lengths=st.dictionaries(st.sampled_from(list(itertools.combinations(range(8), 2))), st.floats(0.3, 3), min_size=3),
    chunk=st.sampled_from([20, 2_000_000]),
)
def test_what_cannot_close_is_refused_in_any_graph(lengths, chunk):
    """Also where few triangles are looked at together."""
    triangles = [
        sorted(lengths[pair] for pair in itertools.combinations(three, 2))
        for three in itertools.combinations(range(8), 3)
        if set(itertools.combinations(three, 2)) <= set(lengths)
    ]
    infeasible = any(a + b < c * (1 - 1e-10) for a, b, c in triangles)
    with mock.patch.object(contradictions, "_CHUNK", chunk):
        try:
            ConstraintSet([Distance(list(lengths), list(lengths.values()))], scattered(0), MASSES)
        except InfeasibleError:
            assert infeasible
        else:
            assert not infeasible
