"""The temperature that configurations have, whatever the velocities do.

On a surface with the density e^{-U/kT} of its volume, any field X that preserves volume gives kT = <(X U)^2>/<X X U>;
summed over all directions, kT = <|grad U|^2>/<laplacian of U> (Rugh, Phys. Rev. Lett. 78, 772 (1997); Butler et al.,
J. Chem. Phys. 109, 6519 (1998)). Constrained canonical configurations have the volume that belongs to the metric M, so
that |grad U|^2 = f.M_par^+ f, and the laplacian is the mean second derivative of U along geodesics, which are the free
flights of the constrained atoms.
"""

from __future__ import annotations

import math
import warnings

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import as_float_array, whole_number
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import State, System
from kcons.thermostats.correlated_series import Estimate, checked, few, spread
from kcons.thermostats.isokinetic.isokinetic import constrained_acceleration
from kcons.thermostats.thermal_velocities import thermal_velocities

#: Standard errors by which the mean curvature must differ from 0 for a ratio to have an error.
_CERTAIN = 3.0


def temperature(squares: FloatArray, curvatures: FloatArray) -> tuple[Estimate, str | None]:
    """The ratio of both means, and what is to be said of its error.

    To first order the ratio r fluctuates by (squares - r curvatures)/<curvatures>. Where <curvatures> is 0 within its
    own error, the ratio has neither a variance nor a bounded interval: its error is infinite.
    """
    n, scale = len(squares), float(curvatures.mean())
    found = float(squares.mean()) / scale if scale else math.inf
    if abs(scale) <= _CERTAIN * spread(curvatures).error:
        said = (
            f"the mean curvature of {n} samples is 0 within {_CERTAIN:g} standard errors: their temperature may be "
            "anything, and its error is given as infinite. Sample longer"
        )
        return Estimate(found, math.inf), said
    error, independent = spread((squares - found * curvatures) / scale)
    return Estimate(found, error), few(n, independent)


def configurational_temperature(squares: ArrayLike, curvatures: ArrayLike) -> Estimate:
    """k_B T = <|grad U|^2>/<laplacian of U> from samples of both along a run.

    Raises
    ------
    InputError
        Fewer than 32 samples; curvatures that are all 0.

    Warns
    -----
    UserWarning
        Fewer than 10 independent samples; a mean curvature that is 0 within three standard errors, so that the ratio
        has no error: it is given as infinite.
    """
    above, below = as_float_array(squares, "squares"), as_float_array(curvatures, "curvatures")
    if above.shape != below.shape:
        raise InputError(f"{above.shape} squares and {below.shape} curvatures do not go together", item="curvatures")
    for series, name in ((above, "squares"), (below, "curvatures")):
        checked(series, name)
    if not below.any():
        raise InputError("the forces do not change with the positions: they tell no temperature", item="curvatures")
    found, doubt = temperature(above, below)
    if doubt:
        warnings.warn(doubt, UserWarning, stacklevel=2)
    return found


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
    """
    if system.motion.plan.driven or system.velocity_dependent:
        raise UnsupportedError("configurations have a temperature where targets rest and forces know no velocities")
    x, time = state.positions, state.time
    forces = system.with_forces(state).forces
    assert forces is not None
    square = float((forces * constrained_acceleration(system, x, forces, time)).sum())
    total = 0.0
    for _ in range(whole_number(directions, "directions")):
        v = thermal_velocities(system, x, 1.0, rng, time=time)
        ends = [_slope(system, x, v, time, h) for h in (flight, -flight)]
        total += (ends[0] - ends[1]) / (2 * flight)
    return square, total / directions


def _slope(system: System, x: FloatArray, v: FloatArray, time: float, h: float) -> float:
    """dU/ds at the end of the geodesic that starts with v."""
    there, v = system.flown(x, v, h, time)
    end = system.motion.project_velocities(there, v, time=time)
    return -float((system.forces(there, end, time, 0) * end).sum())
