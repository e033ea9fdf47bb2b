"""Multibody systems: published problems, closed forms, the same motion in other coordinates."""

from __future__ import annotations

import runpy
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ellipj, ellipk

from kcons.errors import ConstraintError, ConvergenceError, NonFiniteError, SingularGeometryError
from kcons.models import Multibody

#: Steps of one size: no error is too large for it.
FIXED = {"rtol": 1.0, "atol": 1e9}


def steps_of(h):
    return FIXED | {"first_step": h, "max_step": h}


# -- Andrews' squeezing mechanism --------------------------------------------------------------------


#: At the start, which is at rest: beta, Theta, gamma, Phi, delta, Omega, epsilon.
START = np.array([
    -0.0617138900142764496358948458001, 0.0, 0.455279819163070380255912382449, 0.222668390165885884674473185609,
    0.487364979543842550225598953530, -0.222668390165885884674473185609, 1.23054744454982119249735015568,
])  # fmt: skip
#: As published for t = 0.03 s (Mazzia and Magherini, Test Set for Initial Value Problem Solvers, release 2.4, 2008):
#: angles, velocities, and multipliers, whose sign is that of M q'' = f - G^T lambda.
ANGLES = np.array([
    0.1581077119629904e2, -0.1575637105984298e2, 0.4082224013073101e-1, -0.5347301163226948, 0.5244099658805304,
    0.5347301163226948, 0.1048080741042263e1,
])  # fmt: skip
VELOCITIES = np.array([
    0.1139920302151208e4, -0.1424379294994111e4, 0.1103291221937134e2, 0.1929337464421385e2, 0.5735699284790808,
    -0.1929337464421385e2, 0.3231791658026955,
])  # fmt: skip
MULTIPLIERS = np.array([
    0.1991753333731910e3, -0.2975531228015052e2, 0.2306654119098399e2, 0.3145271365475927e2, 0.2264249232082739e2,
    0.1161740700019673e2,
])  # fmt: skip


@cache
def squeezer():
    """The example, and its solution to 1e-11."""
    script = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "squeezer.py"))
    return script, script["body"].solve(START, np.zeros(7), (0.0, 0.03), rtol=1e-11, atol=1e-13)


def test_squeezer_ends_where_it_is_published_to():
    _, found = squeezer()
    # The solution is published with 16 digits, of which SciPy's integrators alone confirm nine, too.
    np.testing.assert_allclose(found.q[-1], ANGLES, rtol=1e-9, atol=0)
    np.testing.assert_allclose(found.v[-1], VELOCITIES, rtol=1e-7, atol=0)
    # The example has x of all three loops, then y.
    np.testing.assert_allclose(-found.multipliers[-1].reshape(2, 3).T.ravel(), MULTIPLIERS, rtol=2e-6, atol=0)


# -- closed forms ------------------------------------------------------------------------------------


def none(q, v, t):
    return np.zeros(len(q))


LENGTH, GRAVITY, SWING = 0.5, 9.8, 2.0


def held(body, q, v):
    return np.append(body._g(q), body._G(q) @ v)


def pendulum(mass=(2.0, 2.0, 0.0)):
    """A mass at (x, y), and the angle of its rod, which has none."""
    return Multibody(
        mass,
        lambda q, v, t: np.array([0.0, -2.0 * GRAVITY, 0.0]),
        lambda q: np.array([q[0] - LENGTH * np.sin(q[2]), q[1] + LENGTH * np.cos(q[2])]),
        lambda q: np.array([[1.0, 0.0, -LENGTH * np.cos(q[2])], [0.0, 1.0, -LENGTH * np.sin(q[2])]]),
        curvature=lambda q, v: LENGTH * v[2] ** 2 * np.array([np.sin(q[2]), -np.cos(q[2])]),
    )


def swinging(t):
    """The angle of a pendulum that was let go at SWING."""
    k, rate = np.sin(SWING / 2), np.sqrt(GRAVITY / LENGTH)
    sn, cn, _, _ = ellipj(rate * np.asarray(t) + ellipk(k**2), k**2)
    return 2 * np.arcsin(k * sn), 2 * rate * k * cn


def hung(angle, rate=0.0):
    q = np.array([LENGTH * np.sin(angle), -LENGTH * np.cos(angle), angle])
    return q, rate * np.array([LENGTH * np.cos(angle), LENGTH * np.sin(angle), 1.0])


def test_coordinates_without_mass():
    """M is singular, and positive along what the constraints leave free."""
    times = np.linspace(0, 3, 7)
    found = pendulum().solve(*hung(SWING), (0, 3), times, rtol=1e-12, atol=1e-13)
    angle, rate = swinging(times)
    for k in range(7):
        q, v = hung(angle[k], rate[k])
        np.testing.assert_allclose(found.q[k], q, rtol=0, atol=1e-10)
        np.testing.assert_allclose(found.v[k], v, rtol=0, atol=1e-9)
    tension = 2.0 * (GRAVITY * np.cos(angle) + LENGTH * rate**2)
    pull = np.stack([-tension * np.sin(angle), tension * np.cos(angle)], axis=1)
    np.testing.assert_allclose(found.multipliers, pull, rtol=0, atol=1e-8)


@pytest.mark.parametrize(("method", "rtol", "close"), [("DOP853", 1e-11, 1e-8), ("BDF", 1e-10, 1e-6)])
def test_at_steps_and_between_and_backwards(method, rtol, close):
    body = pendulum()
    times = np.linspace(1, 0, 40)
    there = body.solve(*hung(SWING), (0, 1), method=method, rtol=rtol, atol=0.1 * rtol)
    back = body.solve(there.q[-1], there.v[-1], (1, 0), times, rtol=1e-11, atol=1e-12)
    np.testing.assert_array_equal(back.t, times)
    np.testing.assert_allclose(back.q[:, 2], swinging(times)[0], rtol=0, atol=close)
    for found in (there, back):
        assert max(np.abs(held(body, q, v)).max() for q, v in zip(found.q, found.v, strict=True)) < 1e-14


# -- the theory --------------------------------------------------------------------------------------


@pytest.mark.parametrize("rank", [0, 1, 3, 5])
@pytest.mark.parametrize("singular", [False, True])
def test_one_place_against_the_theory(rank, singular):
    """Accelerations, multipliers and projections, with a row too many, M full and perhaps singular."""
    rng = np.random.default_rng(10 * rank + singular)
    n = 5
    G = rng.normal(size=(rank + 1, rank)) @ rng.normal(size=(rank, n)) if rank else np.zeros((1, n))
    square = rng.normal(size=(n, n))
    M = square @ square.T
    if singular and rank:  # without mass along the first row, which cannot move alone
        e = G[0] / np.linalg.norm(G[0])
        M = (np.eye(n) - np.outer(e, e)) @ M @ (np.eye(n) - np.outer(e, e))
        M = 0.5 * (M + M.T)
    f, bend = rng.normal(size=n), G @ rng.normal(size=n)
    body = Multibody(M, lambda q, v, t: f, lambda q: G @ q - 0.5 * bend * (q @ q), lambda q: G - np.outer(bend, q))
    v = rng.normal(size=n)
    a, multipliers = body.motion(np.zeros(n), v)
    whole = np.block([[M, -G.T], [G, np.zeros((rank + 1, rank + 1))]])  # the multipliers of least norm
    literal = np.linalg.lstsq(whole, np.concatenate([f, bend * (v @ v)]), rcond=1e-12)[0]
    close = 1e-9 * (1 + np.abs(a).max())
    np.testing.assert_allclose(a, literal[:n], rtol=0, atol=close)
    np.testing.assert_allclose(G.T @ multipliers, G.T @ literal[n:], rtol=0, atol=100 * close)
    assert body.degrees_of_freedom(np.zeros(n)) == n - rank
    if not (singular and rank):
        np.testing.assert_allclose(multipliers, literal[n:], rtol=0, atol=100 * close)
        q, moved = body.project(np.zeros(n), v)
        nearest = np.linalg.lstsq(whole, np.concatenate([M @ v, np.zeros(rank + 1)]), rcond=1e-12)[0]
        np.testing.assert_array_equal(q, 0.0)
        np.testing.assert_allclose(moved, nearest[:n], rtol=0, atol=1e-10)


# -- what is refused ---------------------------------------------------------------------------------


def test_a_start_off_the_constraints_is_refused_and_can_be_mended():
    body, (q, v) = pendulum(), hung(SWING)
    off, slip = q + np.array([0.0, 0.01, 0.0]), v + np.array([0.1, 0.0, 0.0])
    with pytest.raises(ConstraintError, match=r"constraint 1 is off by 0\.009.*body\.project") as caught:
        body.solve(off, v, (0, 1))
    assert caught.value.rows == (1,)
    with pytest.raises(ConstraintError, match="constraint 0 is left by the velocities") as caught:
        body.solve(q, slip, (0, 1))
    body.solve(q, v + 1e-17, (0, 0.1))  # at rest but for rounding
    place, speed = body.project(off, slip)
    body.solve(place, speed, (0, 0.1))
    # The smallest correction in the metric of M: orthogonal to what may move.
    free = np.array([LENGTH * np.cos(place[2]), LENGTH * np.sin(place[2]), 1.0])
    assert abs(free @ np.diag([2.0, 2.0, 0.0]) @ (slip - speed)) < 1e-15


def test_a_crossing_of_two_ways_is_passed_straight_on():
    """Where the planes z = 0 and z = x y touch, rows depend: the step that ends there is made shorter."""
    body = Multibody(np.ones(3), none, lambda q: np.array([q[2], q[2] - q[0] * q[1]]))
    found = body.solve([-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], (0, 3), **steps_of(0.25))
    np.testing.assert_allclose(found.q[-1], [2.0, 0.0, 0.0], rtol=0, atol=1e-12)
    assert len(found.t) > 13
    for near in (0.0, 1e-11):  # where rounding alone decides whether something is left of the second row, and beside it
        with pytest.raises(SingularGeometryError, match="only 1 constraints are independent, and 2 at the start"):
            body._place(np.array([0.0, near, 0.0]), 0.0, 2)


def test_a_constraint_that_ends_on_the_way_is_told():
    body = Multibody(np.ones(3), none, lambda q: np.array([min(q[0], 0.0) ** 4 * q[1], q[2]]))
    with pytest.raises(SingularGeometryError, match=r"at t = 1.* only 1 constraints are independent, and 2 at the"):
        body.solve([-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], (0, 3))


def test_positions_that_cannot_be_met():
    body = Multibody([1.0, 1.0], none, lambda q: np.array([q @ q + 1.0]))
    with pytest.raises(ConvergenceError, match="constraint 0 stays off") as caught:
        body.project([1.0, 0.5], [0.0, 0.0])
    assert caught.value.row == 0 and caught.value.residual > 0.1


def test_trial_steps_may_go_too_far():
    """Past an edge of the force that the motion never reaches; where it does, that is told."""

    def wall(q, v, t):
        return 1e-3 / np.where(q > 0, q, np.nan) ** 2

    found = Multibody([1.0], wall).solve([1.0], [-1.0], (0, 2.5), first_step=1.5)
    energy = 0.5 * found.v[:, 0] ** 2 + 1e-3 / found.q[:, 0]
    np.testing.assert_allclose(energy, energy[0], rtol=1e-6)
    with pytest.raises(NonFiniteError, match="force is not finite at q"):
        Multibody([1.0], lambda q, v, t: -0.5 / np.sqrt(np.where(q > 0, q, np.nan))).solve([1.0], [-1.0], (0, 10))


def test_what_ends_a_run_is_told_not_what_was_got_over():
    """A trial step that fails once, and steps too small much later."""
    calls = []

    def force(q, v, t):
        calls.append(t)
        return v**2 if len(calls) != 12 else v * np.nan

    with pytest.raises(ConvergenceError, match="the run ended at t ="):
        Multibody([1.0], force).solve([0.0], [1.0], (0, 2))


# -- what a user gives -------------------------------------------------------------------------------


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
    body.degrees_of_freedom(Q)
    np.testing.assert_allclose(body._G(Q), gradient(Q), rtol=0, atol=1e-11 if not given else 0)
    np.testing.assert_allclose(-body._b(Q, V), bend(Q, V), rtol=0, atol=10.0**-digits)
    np.testing.assert_allclose(-body._b(Q, 1e3 * V), 1e6 * bend(Q, V), rtol=0, atol=10.0 ** (6 - digits))


def test_differences_go_with_the_length():
    """A curve a million times smaller."""
    small, q, v = 1e-6, np.array([0.3e-6]), np.array([2.5])
    body = Multibody([1.0], none, lambda q: np.sin(q / small), length=small)
    body.degrees_of_freedom(q)
    np.testing.assert_allclose(body._G(q)[0], np.cos(q / small) / small, rtol=1e-11)
    np.testing.assert_allclose(-body._b(q, v), -np.sin(q / small) * v**2 / small**2, rtol=1e-7)
