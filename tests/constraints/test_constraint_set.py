"""The packed sigma, A and b of many objects: consistency, order of rows, cells, bad input."""

from __future__ import annotations

import itertools
import pickle
from contextlib import nullcontext
from copy import copy, deepcopy

import numpy as np
import pytest
from constraint_cases import CASES, MASSES, N_ATOMS, TIME, scattered
from hypothesis import given
from hypothesis import strategies as st

from kcons.constraints import Angle, Dihedral, Distance, FixedAtoms, LinearCombination, Plane, Sphere
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ContradictionError, InfeasibleError, InputError
from kcons.motion import Motion
from kcons.steppers import System


def everything(x):
    return ConstraintSet([make() for make in CASES.values()], x, MASSES, time=TIME)


def test_acceleration_target_is_the_second_derivative_along_any_curve():
    """d2 sigma/dt2 = A a - b and d sigma/dt = A v - c; for velocity rows d(A v - c)/dt = A a - b."""
    x0 = scattered(0)
    rng = np.random.default_rng(1)
    v, a = rng.normal(size=(2, N_ATOMS, 3))
    held = everything(x0)

    def position(s):
        return x0 + s * v + s**2 / 2 * a

    def residual(s):
        x, t = position(s), TIME + s
        speed = held.jacobian(x, t) @ (v + s * a).ravel() - held.velocity_target(x, t)
        return held.value(x, t), speed

    h = 0.01
    weights = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
    value_rate, speed_rate = (
        sum(c * (residual(k * h)[i] - residual(-k * h)[i]) for k, c in weights) / h for i in (0, 1)
    )
    speed = residual(0.0)[1]
    beyond = held.jacobian(x0, TIME) @ a.ravel() - held.acceleration_target(x0, v, TIME)
    rows = held.holonomic
    assert 0 < rows.sum() < len(rows)
    assert np.abs(value_rate - speed)[rows].max() < 1e-9
    assert np.abs(speed_rate - beyond).max() < 1e-8


def test_rows_come_in_the_order_given():
    x = scattered(0)
    held = ConstraintSet([Distance([[0, 1], [2, 3]]), FixedAtoms([5]), Angle([[0, 1, 2]])], x, MASSES)
    assert held.starts.tolist() == [0, 2, 5, 6]
    names = ["#0 Distance(0, 1)", "#1 Distance(2, 3)", *(f"#{k} FixedAtoms(5)" for k in (2, 3, 4)), "#5 Angle(0, 1, 2)"]
    assert [held.row_name(k) for k in range(held.n_rows)] == names
    assert held.row_atoms(1).tolist() == [2, 3]
    assert held.locate(4)[1] == 2
    assert len(held) == 6
    assert held.incidence.toarray().sum(axis=1).tolist() == [2, 2, 1, 1, 1, 3]


def test_subset_is_the_rows_of_the_whole():
    x, v = scattered(0), scattered(1)
    held = everything(x)
    rows = np.arange(1, held.n_rows, 3)
    part, atoms = held.subset(rows)
    assert np.array_equal(part.value(x[atoms], TIME), held.value(x, TIME)[rows])
    assert np.array_equal(part.scale, held.scale[rows])
    full = held.jacobian(x, TIME).toarray().reshape(held.n_rows, N_ATOMS, 3)[rows][:, atoms]
    assert np.allclose(part.jacobian(x[atoms], TIME).toarray(), full.reshape(len(rows), -1), rtol=1e-14, atol=1e-15)
    assert np.allclose(
        part.acceleration_target(x[atoms], v[atoms], TIME), held.acceleration_target(x, v, TIME)[rows], rtol=1e-9
    )


def test_scale_is_the_length_held_or_one_radian_or_the_size_of_the_positions():
    x = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [0.0, 0.0, 2.0]])
    items = [
        Distance([[0, 1]], 5.0),
        Angle([[1, 0, 2]]),
        Sphere(1, [0.0, 0.0, 1.0], lambda t: 2.0 + t),
        Plane(1, [0.0, 0.0, 1.0], 0.0),
        Plane(0, [0.0, 0.0, 1.0], 0.0),
    ]
    assert ConstraintSet(items, x, np.ones(3)).scale.tolist() == [5.0, 1.0, 2.0, 5.0, 4.0]
    assert ConstraintSet([Plane(0, [0.0, 0.0, 1.0], 0.0)], x[:1], np.ones(1)).scale.tolist() == [1.0]
    x[2, 0] = np.nan  # of an atom that no row touches
    assert ConstraintSet([Plane(0, [0.0, 0.0, 1.0], 0.0)], x, np.ones(3)).scale.tolist() == [4.0]


def test_tolerance_knows_what_double_precision_can_reach():
    x = scattered(0)
    near = ConstraintSet([Distance([[0, 1]], 1.0)], x, MASSES)
    assert near.tolerance(x)[0] == 1e-14
    far = x + np.array([1e6, 0.0, 0.0])
    reach = 2 * np.finfo(float).eps * np.linalg.norm(far[:2], axis=1).sum()
    assert near.tolerance(far)[0] == pytest.approx(reach, rel=1e-12)


# -- bad input --------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_positions_and_masses_of_constrained_atoms(bad):
    x, m = scattered(0), MASSES.copy()
    m[3], x[3, 1] = bad, bad
    with pytest.raises(InputError, match=f"atom 3 has mass {bad:g}; constrained atoms need positive mass") as caught:
        ConstraintSet([Distance([[0, 1], [2, 3]])], scattered(0), m)
    assert caught.value.atoms == (3,)
    if not np.isfinite(bad):
        with pytest.raises(InputError, match="position of atom 3 is not finite") as caught:
            ConstraintSet([Distance([[0, 1], [2, 3]])], x, MASSES)
        assert caught.value.atoms == (3,)
    ConstraintSet([Distance([[0, 1]])], x, m)  # other atoms are not looked at


def test_what_was_given_may_be_changed_afterwards():
    target, center, coefficients = np.array([1.0]), np.array([[0.0, 0.0, 3.0]]), np.ones((1, 2, 3))
    x, masses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.array([1.0, 2.0])
    rows = [Distance([0, 1], target), Sphere(0, center, 3.0), LinearCombination([0, 1], coefficients)]
    held = ConstraintSet(rows, x, masses)
    before = held.value(x), held.jacobian(x).toarray()
    for array in (target, center, coefficients, masses):
        array += 7.0
    assert np.array_equal(held.value(x), before[0])
    assert np.array_equal(held.jacobian(x).toarray(), before[1])
    assert held.masses.tolist() == [1.0, 2.0]


@pytest.mark.parametrize("made", [lambda m: m, copy, deepcopy, lambda m: pickle.loads(pickle.dumps(m))])
def test_masses_cannot_be_changed(made):
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    motion = made(Motion(ConstraintSet(Distance([0, 1]), x, [1.0, 2.0]), x))
    for masses in (motion.masses, motion.constraint_set.masses, System(motion).masses):
        with pytest.raises(ValueError, match="read-only"):
            masses[0] = 5.0


# -- targets that exclude each other ------------------------------------------------------------------


#: Rows of which two exclude each other, and what is said of them.
EXCLUDING = [
    ([Distance([[0, 1], [1, 0]], [1.0, 1.001])], r"#0 and #1 on atoms \(0, 1\) have different targets 1.0, 1.001"),
    ([Distance([[1, 2], [0, 1]]), Distance([[1, 0]], 1.2)], r"#1 and #2 on atoms \(0, 1\) have .* targets 1.5, 1.2"),
    ([Angle([[0, 1, 2], [2, 1, 0]], [1.0, 1.1])], r"atoms \(0, 1, 2\) have different targets 1.0, 1.1"),
    ([Dihedral([[0, 1, 2, 3], [3, 2, 1, 0]], [1.0, 1.1])], r"atoms \(0, 1, 2, 3\) have different targets 1.0, 1.1"),
]


@pytest.mark.parametrize(("rows", "words"), EXCLUDING)
def test_one_coordinate_at_two_values(rows, words):
    """Also across objects, and against the length that is found."""
    x = np.array([[0.0, 0, 0], [1.5, 0, 0], [0, 2.0, 0], [0.3, 1.0, 1.0]])
    with pytest.raises(ContradictionError, match=words) as caught:
        ConstraintSet(rows, x, np.ones(4))
    assert isinstance(caught.value, ValueError)
    assert caught.value.rows == ((1, 2) if len(rows) > 1 else (0, 1))
    assert set(caught.value.atoms) == set(rows[0].atoms[-1])


def test_the_same_value_twice_and_other_vertices_axes_and_images_are_accepted():
    x = scattered(0)
    assert ConstraintSet([Distance([[0, 1], [1, 0], [0, 1]])], x, MASSES).n_rows == 3
    ConstraintSet([Distance([[0, 1], [1, 0]], [1.0, 1.0 + 1e-12])], x, MASSES)
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
    ConstraintSet([Distance([[0, 1], [1, 2], [0, 2]], [0.1, 0.2, 0.1 + 0.2])], x, MASSES)  # flat ones pass
    x = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [1.6, 1.7, 1.8]])
    ConstraintSet([Distance([[0, 1], [1, 2], [0, 2]])], x, np.ones(3))


@given(st.dictionaries(st.sampled_from(list(itertools.combinations(range(8), 2))), st.floats(0.3, 3), min_size=3))
def test_what_cannot_close_is_refused_in_any_graph(lengths):
    triangles = [
        sorted(lengths[pair] for pair in itertools.combinations(three, 2))
        for three in itertools.combinations(range(8), 3)
        if set(itertools.combinations(three, 2)) <= set(lengths)
    ]
    infeasible = any(a + b < c * (1 - 1e-10) for a, b, c in triangles)
    with pytest.raises(InfeasibleError) if infeasible else nullcontext():
        ConstraintSet([Distance(list(lengths), list(lengths.values()))], scattered(0), MASSES)
