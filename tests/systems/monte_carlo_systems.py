"""Small systems for the tests of Monte Carlo, and Metropolis on them as judge."""

from __future__ import annotations

import math

import numpy as np
from thermostat_systems import system

from kcons.constraints import Distance
from kcons.steppers import State, System

KT = 0.6


def no_force(x, t=0.0):
    return np.zeros_like(x)


def no_energy(x, t=0.0):
    return 0.0


def trimer(force=no_force, potential=no_energy, masses=(1.0, 1.0, 1.0)) -> tuple[System, State]:
    """Three masses, two bonds of length 1, a free angle."""
    x = np.array([[1.0, 0, 0], [0, 0, 0], [0, 1.0, 0]])
    held = system([Distance([[0, 1], [1, 2]])], x, np.array(masses), force, potential)
    return held, State(x, np.zeros_like(x))


def trap(x, t=0.0):
    """Each mass in a well of its own, the last drawn to one side."""
    f = -np.array([[1.0], [0.5], [2.0]]) * x
    f[2, 0] += 1.5
    return f


def trap_potential(x, t=0.0):
    return float(0.5 * (np.array([1.0, 0.5, 2.0]) * (x * x).sum(axis=1)).sum() - 1.5 * x[2, 0])


def metropolis(samples: int, kt: float, masses=(1.0, 1.0, 1.0), seed: int = 5, apart: int = 40) -> np.ndarray:
    """The trimer in its trap, by Metropolis in internal coordinates: positions, shape (samples, 3, 3).

    Coordinates are the place of the middle mass and two unit vectors, and the density of the surface in the mass metric
    is sqrt(det G) for their mass matrix G: that of the vectors is sqrt(det Z), Z = A M^-1 A^T the 2 x 2 matrix of the
    bonds, beside constants.
    """
    rng = np.random.default_rng(seed)
    m = np.array(masses)

    def weight(x):
        u, w = x[0] - x[1], x[2] - x[1]
        z = (1 / m[0] + 1 / m[1]) * (1 / m[2] + 1 / m[1]) - ((u @ w) / m[1]) ** 2
        return 0.5 * math.log(z) - trap_potential(x) / kt

    def turned(u):
        u = u + 0.8 * rng.standard_normal(3) / math.sqrt(3)
        return u / np.linalg.norm(u)

    x = np.array([[1.0, 0, 0], [0, 0, 0], [0, 1.0, 0]])
    now, kept = weight(x), np.empty((samples, 3, 3))
    for k in range(samples * apart):
        new = x + 0.7 * (rng.random(3) - 0.5)
        arm = 2 * (k % 2)
        new[arm] = new[1] + turned(x[arm] - x[1])
        there = weight(new)
        if math.log(1 - rng.random()) < there - now:
            x, now = new, there
        if k % apart == apart - 1:
            kept[k // apart] = x
    return kept
