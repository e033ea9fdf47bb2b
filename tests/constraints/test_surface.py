"""Surfaces and lines: closed values, points where the gradient is undefined, moving radii."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.constraints import Cylinder, Ellipsoid, Line, Plane, RowKind, Sphere, Torus
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError, SingularGeometryError

ONE = np.ones(1)


def value(item, point, time=0.0):
    return ConstraintSet([item], [point], ONE, time=time).value([point], time)


def test_sphere_is_the_distance_from_its_centre():
    assert value(Sphere(0, [1.0, 0.0, 0.0], 2.0), [1.0, 3.0, 4.0]) == pytest.approx([3.0])


def test_cylinder_is_the_distance_from_its_axis():
    item = Cylinder(0, [0.0, 0.0, 7.0], [0.0, 0.0, 5.0], 1.0)
    assert value(item, [3.0, 4.0, -100.0]) == pytest.approx([4.0])


def test_torus_is_the_distance_from_its_circle():
    item = Torus(0, [0.0, 0.0, 1.0], [0.0, 0.0, 2.0], 3.0, 0.5)
    assert value(item, [0.0, 5.0, 2.5]) == pytest.approx([2.0])
    assert value(item, [0.0, 2.5, 1.0]) == pytest.approx([0.0], abs=1e-15)


def test_plane_by_offset_and_by_point():
    assert value(Plane(0, [0.0, 3.0, 4.0], 2.0), [9.0, 5.0, 5.0]) == pytest.approx([5.0])
    assert value(Plane(0, [0.0, 3.0, 4.0], point=[0.0, 5.0, 5.0]), [1.0, 5.0, 5.0]) == pytest.approx([0.0], abs=1e-14)
    with pytest.raises(InputError, match="either offset or point"):
        Plane(0, [0.0, 0.0, 1.0], 1.0, point=[0.0, 0.0, 0.0])


@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.0, 0.0, -2.0], [1.0, 2.0, 3.0]])
def test_line_is_two_orthonormal_rows_normal_to_it(direction):
    point, d = np.array([0.3, 0.1, -0.2]), np.array(direction)
    item = Line([0], point, direction)
    rows = item.coefficients[:, 0]
    assert np.allclose(rows @ rows.T, np.eye(2), atol=1e-15)
    assert np.allclose(rows @ d, 0, atol=1e-15)
    assert value(item, point + 2.7 * d) == pytest.approx([0.0, 0.0], abs=1e-15)
    off = np.cross(d, [0.2, 0.5, 0.1])
    assert np.linalg.norm(value(item, point + off)) == pytest.approx(np.linalg.norm(off))


def test_line_without_a_point_takes_the_initial_ones():
    x = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]])
    held = ConstraintSet([Line([0, 1], None, [1.0, 0.0, 0.0])], x, np.ones(2))
    assert np.array_equal(held.value(x + np.array([[7.0, 0, 0], [-3.0, 0, 0]])), np.zeros(4))


def test_ellipsoid_vanishes_on_its_surface_and_has_gradients_of_order_one():
    axes = np.array([1.0, 2.0, 4.0])
    rotation, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    y = np.random.default_rng(1).normal(size=(20, 3))
    y /= np.linalg.norm(y, axis=1)[:, None]
    x = [0.5, 0.1, 0.2] + (y * axes) @ rotation.T
    item = Ellipsoid(np.arange(20), [0.5, 0.1, 0.2], axes, rotation)
    held = ConstraintSet([item], x, np.ones(20))
    assert np.abs(held.value(x)).max() < 1e-14
    norms = np.linalg.norm(item.gradient(x[:, None], 0.0), axis=2)
    assert norms.min() >= 2.0 / 4.0 - 1e-12
    assert norms.max() <= 2.0 / 1.0 + 1e-12
    assert np.allclose(held.scale, 2.0)


def test_ellipsoid_of_equal_axes_is_the_sphere():
    x = np.random.default_rng(1).normal(size=(5, 1, 3))
    v = np.random.default_rng(2).normal(size=(5, 1, 3))
    ball, sphere = Ellipsoid(np.arange(5), [0.1, 0.2, 0.3], [2.0] * 3), Sphere(np.arange(5), [0.1, 0.2, 0.3], 2.0)
    assert np.allclose(ball.measure(x, 0.0) + 2.0, sphere.measure(x, 0.0), rtol=1e-14)
    assert np.allclose(ball.gradient(x, 0.0), sphere.gradient(x, 0.0), rtol=1e-13)
    assert np.allclose(ball.curvature(x, v, 0.0), sphere.curvature(x, v, 0.0), rtol=1e-12)


def test_infinite_semi_axis_makes_an_elliptic_cylinder():
    item = Ellipsoid(0, [0.0, 0.0, 0.0], [2.0, np.inf, 0.5])
    assert value(item, [2.0 * np.cos(0.3), 17.0, 0.5 * np.sin(0.3)]) == pytest.approx([0.0], abs=1e-15)
    assert item.gradient(np.array([[[1.0, 5.0, 0.3]]]), 0.0)[0, 0, 1] == 0.0
    with pytest.raises(InputError, match="no finite positive semi-axis"):
        Ellipsoid(0, [0.0, 0.0, 0.0], [np.inf] * 3)


def test_torus_of_zero_height_off_the_axis_gradient_points_from_the_circle():
    item = Torus(0, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 2.0)
    assert np.allclose(item.gradient(np.array([[[1.5, 0.0, 0.0]]]), 0.0), [[[-1.0, 0.0, 0.0]]], atol=1e-15)


def test_moving_radius_enters_the_right_hand_sides():
    item = Sphere(0, [0.0, 0.0, 0.0], lambda t: 1 + 0.2 * np.sin(3 * t))
    x = [[1.0, 0.0, 0.0]]
    held = ConstraintSet([item], x, ONE)
    assert held.moving
    assert held.velocity_target(x, 0.4)[0] == pytest.approx(0.6 * np.cos(1.2), rel=1e-12)
    assert held.acceleration_target(x, [[0.0, 2.0, 0.0]], 0.4)[0] == pytest.approx(-1.8 * np.sin(1.2) - 4.0, rel=1e-10)


@pytest.mark.parametrize(
    ("item", "point", "message"),
    [
        (Sphere(0, [1.0, 2.0, 3.0]), [1.0, 2.0, 3.0], "atom 0 lies at the center of the sphere.*row 0"),
        (Cylinder(0, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]), [0.0, 0.0, 3.0], "atom 0 lies on the axis of the cylinder"),
        (Torus(0, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 2.0), [0.0, 0.0, 1.0], "atom 0 lies on the axis or on the core"),
        (Torus(0, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 2.0), [2.0, 0.0, 0.0], "atom 0 lies on the axis or on the core"),
        (Ellipsoid(0, [0.0, 0.0, 0.0], [1.0, 2.0, 3.0]), [0.0, 0.0, 0.0], "atom 0 lies at the center of the ellipsoid"),
    ],
)
def test_points_without_a_gradient_are_refused(item, point, message):
    with pytest.raises(SingularGeometryError, match=message) as caught:
        ConstraintSet([item], [point], ONE)
    assert caught.value.atoms == (0,)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Cylinder(0, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]), "axis has a vector that is zero"),
        (lambda: Plane(0, [0.0, np.nan, 0.0], 0.0), "normal has a vector that is zero or not finite"),
        (lambda: Plane(0, [0.0, 1.0], 0.0), "normal must be vectors of three numbers"),
        (lambda: Sphere([0, 1], [[0.0, 0.0, 0.0]] * 3), r"center has shape \(3, 3\)"),
        (lambda: Sphere(0, [np.inf, 0.0, 0.0]), "center of row 0 is not finite"),
        (lambda: Torus(0, [0.0] * 3, [0.0, 0.0, 1.0], -2.0), "major_radius -2 is not positive"),
        (lambda: Ellipsoid(0, [0.0] * 3, [1.0, -1.0, 1.0]), "semi_axes -1 is not positive"),
        (lambda: Ellipsoid(0, [0.0] * 3, [1.0] * 3, 2 * np.eye(3)), "columns of rotation are not orthonormal"),
        (lambda: Line([0, 1], [[0.0] * 3] * 3, [0.0, 0.0, 1.0]), r"point has shape \(3, 3\); give \(3,\) or \(2, 3\)"),
        (lambda: Line(0, [0.0, np.nan, 0.0], [0.0, 0.0, 1.0]), "point is not finite"),
    ],
)
def test_bad_shapes_and_numbers_are_named(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_radius_must_be_positive():
    with pytest.raises(InputError, match=r"row 1, Sphere\(1\): radius -1 is not positive"):
        ConstraintSet([Sphere([0, 1], [9.0, 9.0, 9.0], [1.0, -1.0])], np.eye(3)[:2], np.ones(2))


def test_parameters_of_the_compiled_rows():
    assert Sphere(0, [1.0, 2.0, 3.0]).parameters().tolist() == [[1.0, 2.0, 3.0]]
    assert Cylinder(0, [1.0, 2.0, 3.0], [0.0, 0.0, 2.0]).parameters().tolist() == [[1.0, 2.0, 3.0, 0.0, 0.0, 1.0]]
    assert Plane(0, [0.0, 2.0, 0.0]).parameters().tolist() == [[0.0, 1.0, 0.0]]
    kinds = [Sphere(0, [0.0] * 3).kind, Plane(0, [0, 0, 1.0]).kind, Torus(0, [0.0] * 3, [0, 0, 1.0], 1.0).kind]
    assert kinds == [RowKind.FUNCTION] * 3
