"""What share of the stiffness slow forces carry, by which a splitting is judged before any run with long steps."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import Rng, as_float_array, generator_of, refuse_other
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import System
from kcons.steppers.stages.compiled_operations import check_finite
from kcons.thermostats.configurational_temperature import configuration, flight_of
from kcons.thermostats.isokinetic.isokinetic import constrained_acceleration
from kcons.thermostats.multistep import ForceGroups
from kcons.thermostats.thermal_velocities import thermal_velocities

#: Typical move for a difference, as a share of the distance to the next atom.
REACH = 0.03


def slow_share(
    system: System, frames: ArrayLike, group: str = "slow", *, rng: Rng = 0, displacement: float | None = None
) -> float:
    """Share of the stiffness that one group of forces carries along the constraints, root mean square.

    With the second derivatives H of an energy along the constraints in the metric of the masses, the square root of
    <tr H_slow^2>/<tr H^2>: fast motions count most, and no signs cancel. Heating of fast motions grows with this share;
    of two splittings the one with the smaller share allows longer steps.

    Parameters
    ----------
    system : System
        Its forces are `ForceGroups`.
    frames : array_like, shape (n_frames, n_atoms, 3)
        Configurations on the constraints: ten of a short run for large systems, more for small ones.
    group : str
        The slow forces.
    rng : int, numpy.random.Generator or None
        Of the random moves, one a frame, which costs two evaluations of every group.
    displacement : float, optional
        Typical move of an atom for differences of forces; 0.03 of the distance to the next atom by default, as in a
        small step, so that jumps of forces at a cutoff count little.

    Raises
    ------
    UnsupportedError
        Targets move, rows hold velocities, or forces come in no groups.
    InputError
        No such group; frames off the constraints; forces that do not change with the positions; all atoms fixed.
    """
    refuse_other(system, System, "system", "a kcons.steppers.System")
    if system.motion.plan.driven or not system.motion.constraint_set.holonomic.all():
        raise UnsupportedError("slow_share needs targets that rest and rows that hold positions; leave the others out")
    force = system.force
    if not isinstance(force, ForceGroups):
        raise UnsupportedError("the System has no groups of forces; make it with System(motion, ForceGroups({...}))")
    if group not in force.groups:
        raise InputError(f"there is no group {group!r} of forces; there are {', '.join(force.groups)}", item="group")
    x = as_float_array(frames, "frames")
    if x.ndim != 3 or not len(x):
        raise InputError(f"frames have shape {x.shape}; give (n_frames, n_atoms, 3)", item="frames")
    generator = generator_of(rng)
    slow, whole, flight = 0.0, 0.0, 0.0
    for number, frame in enumerate(x):
        here = configuration(system, frame)
        flight = flight or flight_of(system, here, displacement, REACH)
        v = thermal_velocities(system, here, 1.0, generator)
        changes = np.zeros((2, *here.shape))
        for way in (flight, -flight):
            there, _ = system.flown(here, v, way)
            for name in force.groups:
                f = system.accepted(force.of(name, there, 0.0), number, True)
                check_finite(f, "force", number)
                pace = math.copysign(1.0, way) * constrained_acceleration(system, there, f, 0.0)
                changes += np.array([name == group, True])[:, None, None] * pace
        squares = [system.motion.project_velocities(here, c) ** 2 * system.masses[:, None] for c in changes]
        slow, whole = slow + float(squares[0].sum()), whole + float(squares[1].sum())
    if not whole > 0:
        raise InputError("the forces do not change with the positions: nothing is stiff", item="forces")
    return math.sqrt(slow / whole)
