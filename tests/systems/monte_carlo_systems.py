"""Small systems for the tests of Monte Carlo, and Metropolis on them as judge."""

from __future__ import annotations

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
