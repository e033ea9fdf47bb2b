"""Velocities drawn on the constraints."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import Rng, as_array, generator_of, positive
from kcons.constraints.target import FloatArray
from kcons.steppers import System
from kcons.thermostats.freedom import drift_velocity, open_directions


def thermal_velocities(
    system: System,
    positions: ArrayLike,
    thermal_energy: float,
    rng: Rng,
    *,
    time: float = 0.0,
    zero_momentum: bool = False,
) -> FloatArray:
    """Velocities of the canonical distribution on the surface A v = c, shape (n_atoms, 3).

    Maxwell-Boltzmann velocities, projected by M_par^+ M: their covariance is k_B T M_par^+, that of momenta which
    know of the constraints. Where targets move, the slowest velocities that follow them are added.

    Parameters
    ----------
    system : System
    positions : array_like, shape (n_atoms, 3)
        On the constraints.
    thermal_energy : float
        k_B T.
    rng : int, numpy.random.Generator or None
    time : float
        For targets that move.
    zero_momentum : bool
        Take total momentum out, in the directions in which no row knows a place in space.

    Raises
    ------
    UnsupportedError
        `zero_momentum` with rows that hold atoms in space in every direction.
    """
    positive(thermal_energy, "thermal_energy")
    generator = generator_of(rng)
    motion = system.motion
    x = as_array(positions, (system.n_atoms, 3), "positions")
    drive = motion.project_velocities(x, np.zeros_like(x), time=time)
    noise = generator.standard_normal(x.shape) * np.sqrt(thermal_energy * system.inverse_masses)
    if zero_momentum:
        noise -= drift_velocity(noise, system.masses, open_directions(motion, x, time))
    return motion.project_velocities(x, drive + noise, time=time)
