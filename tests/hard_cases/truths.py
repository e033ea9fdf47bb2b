"""What is right, by means that share nothing with the solvers: closed forms, Euler's equations, the dense theory."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.special import ellipj, ellipk

from hard_cases.problem import Array, Numbers, Problem
from kcons.comparison.test_systems.rotor import flight
from kcons.constraints import projection


def cross_matrix(w: ArrayLike) -> Array:
    """The matrix of w x."""
    a, b, c = np.asarray(w, dtype=float)
    return np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])


def rotated(x: Numbers, seed: int = 0) -> Array:
    """Turned into no particular orientation."""
    q = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
    return np.asarray(np.asarray(x, dtype=float) @ (q * np.linalg.det(q)))


def spinning(x: Array, masses: Array, omega: Numbers, drift: ArrayLike = (0, 0, 0)) -> Array:
    """Velocities of a rotation about the center of mass, and of the center itself."""
    return np.asarray(np.cross(omega, x - masses @ x / masses.sum()) + np.asarray(drift, dtype=float))


def rigid_flight(x: Array, masses: Array, omega: Array, time: float) -> Array:
    """Positions of a free rigid body after `time`, by Euler's equations; its center rests."""
    return flight(x, spinning(x, masses, omega), masses, time).positions


def rigid_rattle(x: Array, masses: Array, omega: Array, dt: float, steps: int) -> Array:
    """What RATTLE must give for that body, whatever rows hold it: the map of Moser and Veselov.

    With P the rotation of one step in the body's frame, P J - J P^T = dt hat(L), J = sum m y y^T and L the angular
    momentum in the body's frame (McLachlan and Zanna, Found. Comput. Math. 5, 87 (2005)).
    """
    center = masses @ x / masses.sum()
    y = x - center
    J = np.einsum("i,ij,ik->jk", masses, y, y)
    inertia = np.trace(J) * np.eye(3) - J
    momentum = inertia @ omega
    turn = np.eye(3)
    for _ in range(steps):
        body = turn.T @ momentum
        w = dt * np.linalg.solve(inertia, body)
        for _ in range(100):
            P = _turn(w)
            S = P @ J - J @ P.T - dt * cross_matrix(body)
            # To first order in w, S is the cross matrix of inertia w - dt L.
            change = np.linalg.solve(inertia, [S[2, 1], S[0, 2], S[1, 0]])
            w = w - change
            if np.abs(change).max() < 1e-16:
                break
        turn = turn @ _turn(w)
    return np.asarray(center + y @ turn.T)


def _turn(w: Array) -> Array:
    """Rotation by the vector w (Rodrigues)."""
    size = float(np.linalg.norm(w))
    W = cross_matrix(w)
    return np.asarray(np.eye(3) + np.sinc(size / np.pi) * W + 0.5 * np.sinc(size / 2 / np.pi) ** 2 * W @ W)


def linear_flight(x: Array, v: Array, masses: Array, time: float) -> Array:
    """Positions of a free straight rigid body: each atom on a circle about the center of mass."""
    center, drift = masses @ x / masses.sum(), masses @ v / masses.sum()
    d, u = x - center, v - drift
    k = int(np.argmax(np.sum(d * d, axis=1)))
    omega = np.linalg.norm(u[k]) / np.linalg.norm(d[k])
    return np.asarray(center + drift * time + d * np.cos(omega * time) + u / omega * np.sin(omega * time))


def true_motion(problem: Problem, time: float) -> Array:
    """Positions after `time` by the accelerations of the dense theory, integrated to 1e-11 (small problems)."""
    n = 3 * problem.n_atoms

    def rate(t: float, y: Array) -> Array:
        x, v = y[:n].reshape(-1, 3), y[n:].reshape(-1, 3)
        return np.concatenate([y[n:], problem.acceleration(x, v).ravel()])

    start = np.concatenate([problem.x.ravel(), problem.v.ravel()])
    end = solve_ivp(rate, (0, time), start, method="DOP853", rtol=1e-11, atol=1e-12)
    return np.asarray(end.y[:n, -1].reshape(-1, 3))


def dense_rattle(problem: Problem, dt: float, steps: int) -> Array:
    """RATTLE written down literally, with dense pseudo-inverses: what error the scheme itself has."""
    held, m = problem.oracle, problem.m
    x, v = problem.x, problem.v
    for _ in range(steps):
        rows = held.jacobian(x).toarray()
        v = v + 0.5 * dt * problem.forces(x) / m[:, None]
        direction = (rows / np.repeat(m, 3)).T
        y = x + dt * v
        for _ in range(50):
            sigma = held.value(y)
            if np.abs(sigma).max(initial=0.0) < 1e-13:
                break
            change = np.linalg.lstsq(held.jacobian(y).toarray() @ direction, sigma, rcond=1e-10)[0]
            y = y - (direction @ change).reshape(-1, 3)
        v = v + (y - x - dt * v) / dt
        x = y
        v = projection.project_velocities(held.jacobian(x).toarray(), m, v + 0.5 * dt * problem.forces(x) / m[:, None])
    return x


def pendulum(angle: float, time: float) -> Array:
    """Place of a planar pendulum (mass, length and gravity 1) released at rest at `angle` from below.

    sin(theta/2) = k sn(K(k) - t) with k = sin(angle/2).
    """
    k = np.sin(angle / 2)
    sn = ellipj(ellipk(k * k) - time, k * k)[0]
    theta = 2 * np.arcsin(k * sn)
    return np.array([np.sin(theta), 0.0, -np.cos(theta)])
