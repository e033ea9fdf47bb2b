"""Velocities drawn on the constraints."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import System


def thermal_velocities(
    system: System,
    positions: ArrayLike,
    thermal_energy: float,
    rng: np.random.Generator | int,
    *,
    time: float = 0.0,
    zero_momentum: bool = False,
    kinetic_energy: float | None = None,
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
    rng : numpy.random.Generator or int
        A generator, or a seed for one.
    time : float
        For targets that move.
    zero_momentum : bool
        Take total momentum out, where no row knows a place in space.
    kinetic_energy : float, optional
        Scale to exactly this kinetic energy, for the isokinetic thermostat.

    Raises
    ------
    InputError
        Energies that are not positive; nothing can move.
    UnsupportedError
        `zero_momentum` with rows that fix atoms in space.
    """
    for item, value in (("thermal_energy", thermal_energy), ("kinetic_energy", kinetic_energy)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise InputError(f"{item} is {value}; give a positive number", item=item)
    generator = rng if isinstance(rng, np.random.Generator) else np.random.default_rng(rng)
    motion = system.motion
    x = np.ascontiguousarray(positions, dtype=np.float64)
    drive = motion.project_velocities(x, np.zeros_like(x), time=time)
    noise = generator.standard_normal(x.shape) * np.sqrt(thermal_energy * system.inverse_masses)
    if zero_momentum:
        noise -= drift_velocity(system, noise)
    v = motion.project_velocities(x, drive + noise, time=time) - drive
    if kinetic_energy is not None:
        # The drive is M-orthogonal to all that is tangent, so that energies add up.
        has, left = system.kinetic_energy(v), kinetic_energy - system.kinetic_energy(drive)
        if not (has > 0 and left > 0):
            raise InputError(
                f"no velocities have the kinetic energy {kinetic_energy}: moving targets alone take "
                f"{kinetic_energy - left:g}, and the rows leave {motion.degrees_of_freedom} degrees of freedom",
                item="kinetic_energy",
            )
        v *= math.sqrt(left / has)
    return drive + v


def drift_velocity(system: System, velocities: FloatArray) -> FloatArray:
    """Velocity of the centre of mass, shape (3,).

    Raises
    ------
    UnsupportedError
        Rows or fixed atoms know a place in space: total momentum cannot be taken out.
    """
    for item in system.motion.constraint_set.constraints:
        if not item.translation_invariant:
            raise UnsupportedError(f"total momentum is not conserved: {item.family} holds atoms in space")
    return np.asarray(system.masses @ velocities / system.masses.sum())
