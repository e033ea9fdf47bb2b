"""What a user gives for a multibody system: derivatives by differences, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.errors import InputError, NonFiniteError
from kcons.models import Multibody


def none(q, v, t):
    return np.zeros(len(q))


def curve(q):
    return np.array([np.sin(q[0]) * q[1], np.exp(q[0] * q[1])])


def gradient(q):
    e = np.exp(q[0] * q[1])
    return np.array([[np.cos(q[0]) * q[1], np.sin(q[0])], [q[1] * e, q[0] * e]])


def bend(q, v):
    e = np.exp(q[0] * q[1])
    return np.array(
        [
            -np.sin(q[0]) * q[1] * v[0] ** 2 + 2 * np.cos(q[0]) * v[0] * v[1],
            e * ((q[1] * v[0] + q[0] * v[1]) ** 2 + 2 * v[0] * v[1]),
        ]
    )


Q, V = np.array([0.4, 0.7]), np.array([-1.2, 0.8])


@pytest.mark.parametrize(
    ("given", "digits"),
    [({}, 9), ({"jacobian": gradient}, 11), ({"jacobian": gradient, "curvature": bend}, 15)],
    ids=["g", "g and G", "all"],
)
def test_derivatives_by_differences(given, digits):
    body = Multibody(np.eye(2), none, curve, **given)
    body.residuals(Q, V)
    np.testing.assert_allclose(body._G(Q, 0.0), gradient(Q), rtol=0, atol=1e-11 if not given else 0)
    np.testing.assert_allclose(-body._b(Q, V, 0.0), bend(Q, V), rtol=0, atol=10.0**-digits)
    np.testing.assert_allclose(-body._b(Q, 1e3 * V, 0.0), 1e6 * bend(Q, V), rtol=0, atol=10.0 ** (6 - digits))


def test_differences_go_with_the_length_and_the_time():
    """A curve a million times smaller, traversed in a microsecond."""
    small = 1e-6
    body = Multibody(
        [1.0],
        none,
        lambda q, t: np.sin(q / small - t / small),
        time_dependent=True,
        length=small,
        time_step=0.02 * small,
    )
    q, v, t = np.array([0.3e-6]), np.array([2.5]), 0.1e-6
    body.residuals(q, v, t)
    angle = (q - t) / small
    np.testing.assert_allclose(body._G(q, t)[0], np.cos(angle) / small, rtol=1e-11)
    np.testing.assert_allclose(body._c(q, t), np.cos(angle) / small, rtol=1e-11)
    np.testing.assert_allclose(-body._b(q, v, t), -np.sin(angle) * (v - 1) ** 2 / small**2, rtol=1e-7)


@pytest.mark.parametrize(
    ("name", "wrong", "said"),
    [
        ("jacobian", lambda q: gradient(q) * [[1, 1], [1, -1]], r"jacobian gives -0\.529.* for entry \[1, 1\]"),
        ("curvature", lambda q, v: bend(q, v) * [1, -1], r"curvature gives .* for entry \[1\]"),
    ],
)
def test_wrong_derivatives_are_refused(name, wrong, said):
    given = {"jacobian": gradient, "curvature": bend} | {name: wrong}
    with pytest.raises(InputError, match=said) as caught:
        Multibody(np.eye(2), none, curve, **given).project(Q, V)
    assert caught.value.item == name


@pytest.mark.parametrize(
    ("given", "item"),
    [
        ({"mass": lambda q: np.eye(3)}, "mass"),
        ({"mass": lambda q: np.array([[1.0, 0.2], [0.1, 1.0]])}, "mass"),
        ({"force": lambda q, v, t: np.zeros(3)}, "force"),
        ({"constraints": lambda q: np.zeros((2, 2))}, "constraints"),
        ({"jacobian": lambda q: gradient(q).T[:1]}, "jacobian"),
        ({"jacobian": lambda q: gradient(q)[:1]}, "jacobian"),
        ({"curvature": lambda q, v: bend(q, v)[:1]}, "curvature"),
        ({"constraints": lambda q: ["a", "b"]}, "constraints"),
    ],
)
def test_wrong_shapes_are_named(given, item):
    arguments = {"mass": np.eye(2), "force": none, "constraints": curve} | given
    with pytest.raises(InputError) as caught:
        Multibody(**arguments).motion(Q, V)
    assert caught.value.item == item


@pytest.mark.parametrize(
    ("given", "item"),
    [
        ({"mass": [[1.0, 0.2], [0.1, 1.0]]}, "mass"),
        ({"mass": np.ones((2, 3))}, "mass"),
        ({"mass": [1.0, np.nan]}, "mass"),
        ({"mass": []}, "mass"),
        ({"mass": [1.0, 2.0j]}, "mass"),
        ({"force": None}, "force"),
        ({"constraints": 3.0}, "constraints"),
        ({"jacobian": gradient}, "jacobian"),
        ({"force": lambda q, v: q}, "force"),
        ({"mass": lambda q, t: q}, "mass"),
        ({"constraints": lambda q, t: q}, "constraints"),
        ({"constraints": curve, "time_dependent": True}, "constraints"),
        ({"constraints": curve, "curvature": curve}, "curvature"),
        ({"length": 0.0}, "length"),
        ({"time_step": np.nan}, "time_step"),
        ({"time_step": "x"}, "time_step"),
    ],
)
def test_what_cannot_be_meant_is_refused_at_once(given, item):
    with pytest.raises(InputError) as caught:
        Multibody(**({"mass": np.eye(2), "force": none} | given))
    assert caught.value.item == item


@pytest.mark.parametrize("name", ["mass", "force", "constraints", "jacobian", "curvature"])
def test_functions_that_are_not_finite_are_named(name):
    given = {"mass": lambda q: np.eye(2), "force": none, "constraints": curve, "jacobian": gradient, "curvature": bend}
    right = given[name]
    given[name] = lambda *arguments: right(*arguments) * np.nan
    with pytest.raises(NonFiniteError, match=f"{name} is not finite at q") as caught:
        Multibody(**given).motion(Q, V)
    assert caught.value.item == name


def test_what_functions_get_cannot_be_changed_and_what_they_return_may_be_used_again():
    kept = np.empty((2, 2))

    def reused(q):
        kept[:] = gradient(q)
        return kept

    def greedy(q, v, t):
        with pytest.raises(ValueError, match="read-only"):
            q[0] = 1.0
        return np.array([0.1, 0.2])

    again = Multibody(np.eye(2), greedy, curve, reused).motion(Q, V)
    fresh = Multibody(np.eye(2), greedy, curve, gradient).motion(Q, V)
    np.testing.assert_array_equal(again[0], fresh[0])


def test_large_numbers_are_finite():
    """Whose squares are not."""
    body = Multibody([1e200], lambda q, v, t: np.array([3e200]))
    assert body.motion([0.0], [0.0])[0] == 3.0
