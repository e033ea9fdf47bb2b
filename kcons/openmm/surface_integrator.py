"""Particles on surfaces: spheres, ellipsoids, cylinders, planes, tori, and what a formula gives."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import unit

from kcons.constraints.constraint import Constraint
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.openmm.callback_rows import CarriedConstraints, constraints_about, hold
from kcons.openmm.integrator.projected import ProjectedIntegrator, picoseconds
from kcons.openmm.quantities import positions_of
from kcons.steppers import Splitting


class SurfaceIntegrator(ProjectedIntegrator):
    """Dynamics of particles on surfaces, beside free particles and the constraints of the System.

    As `ProjectedIntegrator` with rows of `hold`, or on the device with the surfaces themselves as `parts`.

    Parameters
    ----------
    timestep : Quantity or float
        In ps if a float.
    surfaces : Constraint or iterable of Constraint
        Those of `kcons.constraints` over one particle each, also of your own, in plain numbers of nm.
    system : openmm.System, optional
        Gets the forces that carry the rows, see `hold`; the device does not need it.
    positions : array_like or Quantity, shape (n_particles, 3), optional
        Needed for targets that are left open, each such particle keeps the radius or plane it has there, and where the
        System constrains particles on surfaces.
    parts : sequence of Part
        What else to hold, on other particles.
    scheme, **arguments
        See `ProjectedIntegrator`.

    Attributes
    ----------
    surfaces : tuple of Constraint
        What its particles are on.

    Raises
    ------
    InputError, UnsupportedError
        No surface, an open target without positions, rows over several particles; see `hold`.
    """

    def __init__(
        self,
        timestep: unit.Quantity | float,
        scheme: str | Splitting = "rattle",
        *,
        surfaces: Constraint | Iterable[Constraint] = (),
        system: openmm.System | None = None,
        positions: ArrayLike | None = None,
        parts: Sequence[Any] = (),
        **arguments: Any,
    ) -> None:
        # Copies are made from parts alone.
        if surfaces or not any(hasattr(part, "given") for part in parts):
            parts = (*self._surface_parts(_listed(surfaces), system, positions), *parts)
        super().__init__(picoseconds(timestep) * unit.picosecond, scheme, parts=parts, **arguments)

    def _surface_parts(
        self, surfaces: list[Constraint], system: openmm.System | None, positions: ArrayLike | None
    ) -> Sequence[Any]:
        """What is held of surfaces that were given."""
        if system is None:
            raise InputError("surfaces add forces to the System: give system=, or device=True", item="system")
        if positions is None:
            for item in surfaces:
                if item.target is None or constraints_about(system, item.atoms.ravel()):
                    raise InputError(
                        f"{item!r} has no radius or offset, or the System constrains its particles: give positions=",
                        item="positions",
                    )
            # Ranks are those of a place that is nothing special.
            positions = np.random.default_rng(0).normal(size=(system.getNumParticles(), 3))
        return (hold(system, surfaces, positions),)

    @property
    def surfaces(self) -> tuple[Constraint, ...]:
        return tuple(item for part in self.parts for item in getattr(part, "given", ()) if _is_surface(item))

    # -- the state of a context -----------------------------------------------------------------

    def multipliers(self, context: openmm.Context) -> FloatArray:
        """lambda of each row, exact at the present state; kJ/mol/nm where the coordinate is a length in nm.

        z = lambda grad q is the force of the surface; q as documented by the kcons object, or the formula.
        """
        return np.concatenate([found for _, found in self._multipliers(context)])

    def constraint_forces(self, context: openmm.Context) -> FloatArray:
        """Force of the surfaces on each particle in kJ/mol/nm, exact at the present state, shape (n_particles, 3)."""
        found, x, time = list(self._multipliers(context)), positions_of(context), context.getTime()._value
        out = np.zeros_like(x)
        for item, multipliers in found:
            np.add.at(out, item.atoms[:, 0], multipliers[:, None] * item.gradient(x[item.atoms], time)[:, 0])
        return out

    def _multipliers(self, context: openmm.Context) -> Iterator[tuple[Constraint, FloatArray]]:
        for part in self.parts:
            if isinstance(part, CarriedConstraints):
                found, held = part.multipliers(context), part.motion.constraint_set
                for item, start in zip(held.constraints, held.starts, strict=False):
                    if _is_surface(item):
                        yield item, found[start : start + item.n_rows]


def _is_surface(item: Constraint) -> bool:
    return item.width == 1 and item.holonomic and not item.fixes_atoms


def _listed(surfaces: Constraint | Iterable[Constraint]) -> list[Constraint]:
    given = [surfaces] if isinstance(surfaces, Constraint) else list(surfaces)
    if not given:
        raise InputError("no surface was given", item="surfaces")
    for item in given:
        if not isinstance(item, Constraint) or not _is_surface(item):
            raise UnsupportedError(f"{item!r} is no surface that a particle can be on; hold it by kcons.openmm.hold")
    return given
