"""Velocity rows: a sleigh that does not skid, a wheel that does not slip, driven speeds."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.constraints import CustomVelocity, Distance, KnifeEdge, LinearVelocity, Rolling
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError, SingularGeometryError


def rate(held, x, v, time=0.0):
    """A v - target, shape (n_rows,)."""
    return held.jacobian(x, time) @ np.ravel(v) - held.velocity_target(x, time)


def test_a_blade_glides_along_itself_and_turns_about_its_contact():
    x = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 1.0]])
    held = ConstraintSet([KnifeEdge(0, 1, [0.0, 0.0, 2.0])], x, np.ones(2))
    along, sideways = np.array([0.6, 0.8, 0.0]), np.array([-0.8, 0.6, 0.0])
    assert rate(held, x, [along, along]) == pytest.approx([0.0], abs=1e-15)
    assert rate(held, x, [0 * along, sideways]) == pytest.approx([0.0], abs=1e-15)
    assert rate(held, x, [sideways, sideways]) == pytest.approx([1.0])
    # The blade's height does not count.
    assert rate(held, x, [[0, 0, 1.0], [0, 0, -2.0]]) == pytest.approx([0.0], abs=1e-15)


def test_contact_between_the_atoms():
    x = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    held = ConstraintSet([KnifeEdge(0, 1, [0.0, 0.0, 1.0], contact=0.25)], x, np.ones(2))
    assert rate(held, x, [[0, -1.0, 0], [0, 3.0, 0]]) == pytest.approx([0.0], abs=1e-15)


def test_a_blade_on_a_circle_needs_the_centripetal_acceleration():
    """Contact on a circle of radius R at speed u, blade tangent: sideways acceleration u^2/R."""
    radius, speed, length = 2.0, 3.0, 0.5
    x = np.array([[radius, 0.0, 0.0], [radius, length, 0.0]])
    omega = speed / radius
    v = omega * np.stack([-x[:, 1], x[:, 0], [0.0, 0.0]], axis=1)
    held = ConstraintSet([KnifeEdge(0, 1, [0.0, 0.0, 1.0])], x, np.ones(2))
    a = -(omega**2) * x
    assert rate(held, x, v) == pytest.approx([0.0], abs=1e-14)
    assert held.jacobian(x) @ a.ravel() == pytest.approx(held.acceleration_target(x, v), rel=1e-13)
    assert held.acceleration_target(x, v)[0] == pytest.approx(speed**2 / radius)


@pytest.mark.parametrize("marker", [0.3, 1.5])
def test_a_wheel_rolls_one_circumference_a_turn(marker):
    """Hub at speed R psi' along x; the marker at `marker` from the hub turns from z to x."""
    radius, spin, psi = 1.5, 0.7, 0.9
    hub = np.array([4.0, 0.0, radius])
    x = np.array([hub, hub + marker * np.array([np.sin(psi), 0, np.cos(psi)])])
    turn = marker * spin * np.array([np.cos(psi), 0, -np.sin(psi)])
    v = np.array([[radius * spin, 0, 0], np.array([radius * spin, 0, 0]) + turn])
    a = np.array([[0, 0, 0], -(spin**2) * (x[1] - hub)])
    held = ConstraintSet([Rolling(0, 1, radius, [2.0, 0.0, 0.3]), Distance([0, 1])], x, np.ones(2))
    assert rate(held, x, v)[0] == pytest.approx(0.0, abs=1e-14)
    assert (held.jacobian(x) @ a.ravel())[0] == pytest.approx(held.acceleration_target(x, v)[0], abs=1e-14)
    # If the marker is on the rim and at the ground, it is at rest.
    low = np.array([hub, hub - [0, 0, radius]])
    assert rate(held, low, [[1.0, 0, 0], [0.0, 0, 0]])[0] == pytest.approx(0.0, abs=1e-14)
    assert rate(held, low, [[1.0, 0, 0], [1.0, 0, 0]])[0] == pytest.approx(1.0)


def test_a_driven_speed():
    item = LinearVelocity([0, 1], [[1, 0, 0], [-1, 0, 0]], target=lambda t: np.sin(2 * t))
    x = np.eye(3)[:2]
    held = ConstraintSet([item], x, np.ones(2))
    assert not held.holonomic.any()
    assert held.moving
    assert held.velocity_target(x, 0.3) == pytest.approx([np.sin(0.6)])
    assert held.acceleration_target(x, x, 0.3) == pytest.approx([2 * np.cos(0.6)], rel=1e-11)


def test_coefficients_are_differenced_at_late_times_as_well():
    """a = (cos t, sin t, 0): b = -v . da/dt."""

    def turning(r, t):
        return [[np.cos(t), np.sin(t), 0.0]]

    x, v = np.zeros((1, 3)), np.array([[0.6, 0.8, 0.0]])
    held = ConstraintSet(CustomVelocity(0, turning, time_dependent=True), x, [1.0])
    for time in (1.0, 1e6, 1e9):
        expected = 0.6 * np.sin(time) - 0.8 * np.cos(time)
        np.testing.assert_allclose(held.acceleration_target(x, v, time), [expected], rtol=0, atol=1e-11)


def test_velocity_rows_fix_no_position():
    x = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 1.0]])
    held = ConstraintSet([KnifeEdge(0, 1, [0.0, 0.0, 1.0])], x, np.ones(2))
    assert held.value(2 * x).tolist() == [0.0]
    assert held.target().tolist() == [0.0]


def test_blade_across_the_boundary():
    x = np.array([[9.9, 0.0, 0.0], [0.4, 0.0, 0.0]])
    item = KnifeEdge(0, 1, [0.0, 0.0, 1.0])
    wrapped = ConstraintSet([item], x, np.ones(2), cell=[10.0] * 3)
    y = x - np.array([[10.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    whole = ConstraintSet([item], y, np.ones(2))
    assert np.allclose(wrapped.jacobian(x).toarray(), whole.jacobian(y).toarray())


def test_directions_that_do_not_exist():
    x = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    with pytest.raises(SingularGeometryError, match=r"row 0, KnifeEdge\(0, 1\): the blade is normal to its plane"):
        ConstraintSet([KnifeEdge(0, 1, [0.0, 0.0, 1.0])], x, np.ones(2))
    with pytest.raises(SingularGeometryError, match="the rim atom lies on the axle"):
        ConstraintSet([Rolling(0, 1, 1.0, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])], x, np.ones(2))
    with pytest.raises(SingularGeometryError, match="the coefficients are zero or not finite"):
        ConstraintSet([CustomVelocity([0], lambda r: r)], x, np.ones(2))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LinearVelocity([0], [[0.0, 0.0, 0.0]]), "all coefficients of row 0 are zero"),
        (lambda: KnifeEdge([0, 1], [2], [0.0, 0.0, 1.0]), "give one pair a row"),
        (lambda: Rolling(0, 1, 0.0, [1.0, 0.0, 0.0]), "radius 0 is not positive"),
        (lambda: Rolling(0, 1, 1.0, [0.0, 0.0, 1.0]), "heading is normal to the ground"),
        (lambda: CustomVelocity([0], [[1.0, 0.0, 0.0]]), "coefficients is .*; give a function of r"),
        (lambda: CustomVelocity([0], lambda r: r, time_step=0.0), "time_step is 0.0; give a positive number"),
        (
            lambda: CustomVelocity([0], lambda r: r[0]).gradient(np.ones((1, 1, 3)), 0.0),
            r"returned shape \(3,\) for row 0",
        ),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(InputError, match=message):
        make()


@pytest.mark.parametrize("explicit", [0.0, 1.0])
def test_a_wrong_derivative_of_coefficients_is_found_before_it_moves_anything(explicit):
    """Wrong in the part that motion makes, or in the one of time itself."""

    def coefficients(r, t):
        return np.array([[r[0, 1] * np.cos(t), 1.0, 0.0]])

    def derivative(r, v, t):
        motion = v[0, 1] * np.cos(t)
        return np.array([[(motion if explicit else 2 * motion) - (1 + explicit) * r[0, 1] * np.sin(t), 0.0, 0.0]])

    x = np.array([[0.3, 0.7, 0.1]])
    item = CustomVelocity(0, coefficients, derivative, time_dependent=True)
    with pytest.raises(InputError, match=r"derivative gives .* for x of its atom 0, but differences .* give"):
        ConstraintSet(item, x, np.ones(1), time=0.5)
