"""The temperature that configurations have, whatever the velocities do.

On a surface with the density e^{-U/kT} of its volume, any field X that preserves volume gives kT = <(X U)^2>/<X X U>;
summed over all directions, kT = <|grad U|^2>/<laplacian of U> (Rugh, Phys. Rev. Lett. 78, 772 (1997); Butler et al.,
J. Chem. Phys. 109, 6519 (1998)). Constrained canonical configurations have the volume that belongs to the metric M, so
that |grad U|^2 = f.M_par^+ f, and the laplacian is the mean second derivative of U along geodesics, which are the free
flights of the constrained atoms.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import numbers, whole_number
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import State, System
from kcons.steppers.stages.compensated_steps import Point
from kcons.thermostats.isokinetic.step import paced
from kcons.thermostats.thermal_velocities import thermal_velocities

#: Fewest blocks that errors are taken from.
BLOCKS = 16


class Estimate(NamedTuple):
    """A mean and its standard error."""

    value: float
    error: float

    def off(self, expected: float, error: float = 0.0) -> float:
        """Distance from `expected` (known to `error`) in standard errors; infinite where both are known exactly."""
        away, doubt = self.value - expected, math.hypot(self.error, error)
        if not doubt:
            return math.copysign(math.inf, away) if away else 0.0
        return away / doubt


def mean(values: ArrayLike) -> Estimate:
    """Mean of correlated values; the error by averages over blocks.

    Of 16, 32, 64 and 128 blocks the largest error counts: short blocks depend on each other, few are noisy.

    Raises
    ------
    InputError
        Fewer than 32 values.
    """
    series = numbers(values, "values")
    if series.ndim != 1 or len(series) < 2 * BLOCKS:
        raise InputError(f"{series.shape} values are too few for an error; give {2 * BLOCKS} or more", item="values")
    errors = []
    for count in (BLOCKS, 2 * BLOCKS, 4 * BLOCKS, 8 * BLOCKS):
        size = len(series) // count
        if size:
            blocks = series[: size * count].reshape(count, size).mean(axis=1)
            errors.append(float(blocks.std(ddof=1)) / math.sqrt(count))
    return Estimate(float(series.mean()), max(errors))


def configurational_temperature(squares: ArrayLike, curvatures: ArrayLike) -> Estimate:
    """k_B T = <|grad U|^2>/<laplacian of U> from samples of both along a run.

    Raises
    ------
    InputError
        Fewer than 32 samples, or not as many of one as of the other; curvatures that are all 0.
    """
    above, below = numbers(squares, "squares"), numbers(curvatures, "curvatures")
    if above.shape != below.shape:
        raise InputError(f"{above.shape} squares and {below.shape} curvatures do not go together", item="curvatures")
    if not below.any():
        raise InputError("the forces do not change with the positions: they tell no temperature", item="curvatures")
    scale = float(below.mean())
    ratio = float(above.mean()) / scale
    return Estimate(ratio, mean((above - ratio * below) / scale).error)


def configurational_sample(
    system: System, state: State, rng: np.random.Generator, *, flight: float = 1e-4, directions: int = 1
) -> tuple[float, float]:
    """|grad U|^2 and an unbiased sample of the laplacian of U on the surface, in the metric M.

    Two force evaluations for each direction.

    Parameters
    ----------
    system : System
    state : State
    rng : numpy.random.Generator
    flight : float
        How long to fly along a geodesic at unit thermal energy, for a difference of the slopes of U at its ends.
    directions : int
        How many random directions to average over.

    Raises
    ------
    UnsupportedError
        Targets move, or forces depend on the velocities.
    InputError
        Fewer than one direction.
    """
    if system.motion.plan.driven or system.velocity_dependent:
        raise UnsupportedError("configurations have a temperature where targets rest and forces know no velocities")
    x, time = state.positions, state.time
    forces = system.with_forces(state).forces
    assert forces is not None
    square = float((forces * paced(system, x, forces, time)).sum())
    total = 0.0
    for _ in range(whole_number(directions, "directions")):
        v = thermal_velocities(system, x, 1.0, rng, time=time)
        ends = [_slope(system, x, v, time, h) for h in (flight, -flight)]
        total += (ends[0] - ends[1]) / (2 * flight)
    return square, total / directions


def _slope(system: System, x: FloatArray, v: FloatArray, time: float, h: float) -> float:
    """dU/ds at the end of the geodesic that starts with v."""
    point = Point(x, v, system.weights, exact=False)
    system.drift.move(point, np.empty_like(x), time, time, h)
    end = system.motion.project_velocities(point.x, point.v, time=time)
    return -float((system.forces(point.x, end, time, 0) * end).sum())
