"""Small test systems for long runs: cheap forces, known kinds of motion, the same problem for every program."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hard_cases.problem import Array, Problem


def _moving(problem: Problem, speed: float, seed: int) -> Problem:
    """With tangent velocities of random direction and the total momentum of rest."""
    v = speed * np.random.default_rng(seed).standard_normal(problem.x.shape)
    if not len(problem.fixed):
        v -= problem.m @ v / problem.m.sum()
    return problem.but(velocities=problem.tangent(v))


def water(seed: int = 1) -> Problem:
    """Rigid water that tumbles in a field which turns its dipole, on a soft spring."""
    x = np.array([[0.0, 0, 0], [0.8, 0.6, 0], [-0.8, 0.6, 0]])
    push = 0.5 * np.array([[0, 0, -2.0], [0, 0, 1], [0, 0, 1]])
    return _moving(Problem(x, [16.0, 1, 1], [(0, 1), (0, 2), (1, 2)], push=push), 0.5, seed)


def chain(seed: int = 1) -> Problem:
    """Eight atoms, seven bonds, each atom on a spring."""
    k = np.arange(8)
    half = np.radians(55)
    x = np.stack([k * np.sin(half), (k % 2) * np.cos(half), 0.0 * k], axis=1)
    bonds = [(i, i + 1) for i in range(7)]
    return _moving(Problem(x, np.full(8, 12.0), bonds, tether=2.0, anchors=0.9 * x), 0.3, seed)


def dumbbells(seed: int = 1) -> Problem:
    """Two dumbbells joined by four springs."""
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0.1, 1.6, 0.2], [0.4, 1.4, 1.1]])
    springs = [(i, j, 3.0, 1.5) for i in (0, 1) for j in (2, 3)]
    return _moving(Problem(x, [1.0, 2, 1.5, 1], [(0, 1), (2, 3)], springs=springs), 0.4, seed)


def rotor(seed: int = 1) -> Problem:
    """One dumbbell in free flight, omega = 1 for the first seed."""
    x = np.array([[0.75, 0, 0], [-0.45, 0, 0]])
    turn = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0] if seed > 1 else np.eye(3)
    v = np.array([[0, 0.75, 0], [0, -0.45, 0]])
    return Problem(x @ turn, [1.5, 2.5], [(0, 1)], velocities=v @ turn)


def pendulum(seed: int = 1) -> Problem:
    """A spherical pendulum about a fixed atom."""
    angle = 2.0
    x = np.array([[0.0, 0, 0], [np.sin(angle), 0, -np.cos(angle)]])
    push = np.array([[0, 0, 0], [0, 0, -1.0]])
    return _moving(Problem(x, [1.0, 1], [(0, 1)], [1.0], fixed=[0], push=push), 0.3, seed)


def butane(seed: int = 1) -> Problem:
    """Four united atoms, bonds and 1-3 distances held; a spring between the ends turns the dihedral."""
    x = np.array([[1.43, 0.55, 0.2], [0, 0, 0], [0.0, 0, 1.53], [-1.2, 0.9, 2.05]])
    pairs = [(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)]
    ends = float(np.linalg.norm(x[0] - x[3]))
    return _moving(Problem(x, [15.0, 14, 14, 15], pairs, springs=[(0, 3, 4.0, 0.9 * ends)]), 0.3, seed)


SYSTEMS: dict[str, Callable[[int], Problem]] = {
    "water": water,
    "chain": chain,
    "dumbbells": dumbbells,
    "rotor": rotor,
    "pendulum": pendulum,
    "butane": butane,
}


def separated(rng: np.random.Generator, n: int, nearest: float) -> Array:
    """Random points, no two nearer than `nearest`, within a ball that grows with their number."""
    points: list[Array] = []
    size = 1.2 * n ** (1 / 3)
    while len(points) < n:
        p = size * rng.standard_normal(3)
        if all(np.linalg.norm(p - q) >= nearest for q in points):
            points.append(p)
    return np.array(points)
