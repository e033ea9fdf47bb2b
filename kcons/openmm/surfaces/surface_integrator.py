"""Particles on surfaces: spheres, ellipsoids, cylinders, planes, tori, and what a formula gives."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import unit

from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.openmm.integrator.projected import ProjectedIntegrator, picoseconds
from kcons.openmm.integrator.system_checks import require_context
from kcons.openmm.quantities import accepted, nanometers
from kcons.openmm.states import forces_at, motion_of
from kcons.openmm.surfaces.surface_rows import CARRIER, SurfaceRows, engine, refuse_system
from kcons.steppers import Splitting


def surface_parts(
    surfaces: Constraint | Iterable[Constraint],
    *,
    system: openmm.System,
    positions: ArrayLike | None = None,
) -> tuple[SurfaceRows, ...]:
    """The part of a `ProjectedIntegrator` that holds particles on surfaces.

    Parameters
    ----------
    surfaces : Sphere, Cylinder, Plane, Ellipsoid, Torus, Formula, or several of them
        Those of `kcons.constraints` over one particle each, also of your own: Quantities, or plain numbers of nm.
    system : openmm.System
        Gets two forces for each object.
    positions : array_like or Quantity, shape (n_particles, 3), optional
        Needed for targets that are left open: each such particle keeps the radius or plane it has there.

    Raises
    ------
    InputError
        Particles that are not in the System, open targets without positions, wrong radii.
    UnsupportedError
        Two surfaces for a particle; a particle without mass, or with a constraint of the System; a barostat;
        moving targets; other kinds of constraints.
    """
    given = listed(surfaces, positions, system.getNumParticles())
    for item in given:
        _check(item)
    refuse_system(system, np.concatenate([item.atoms[:, 0] for item in given]))
    return (SurfaceRows(given, system),)


class SurfaceIntegrator(ProjectedIntegrator):
    """Dynamics of particles on surfaces, beside free particles and the constraints of the System.

    On the device each particle is a row of the kernels. Without it, the rows are forces that OpenMM differentiates, and
    Newton's method runs in the program of a CustomIntegrator.

    Parameters
    ----------
    timestep : Quantity or float
        In ps if a float.
    surfaces, system, positions
        See `surface_parts`; the device needs neither the System nor positions.
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
        See `surface_parts` and `ProjectedIntegrator`.
    """

    def __new__(
        cls,
        timestep: unit.Quantity | float,
        scheme: str | Splitting = "rattle",
        *,
        surfaces: Constraint | Iterable[Constraint] = (),
        system: openmm.System | None = None,
        positions: ArrayLike | None = None,
        parts: Sequence[Any] = (),
        **arguments: Any,
    ) -> ProjectedIntegrator:
        """Of this class, or of the one that runs on the device."""
        together = [*(surfaces if isinstance(surfaces, Iterable) else (surfaces,)), *parts]
        return super().__new__(cls, timestep, scheme, parts=together, **arguments)

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
        held: Sequence[Any] = ()
        # Copies are made from parts alone.
        if surfaces or not any(hasattr(part, "given") for part in parts):
            held = self._surface_parts(surfaces, system, positions)
        super().__init__(picoseconds(timestep) * unit.picosecond, scheme, parts=(*held, *parts), **arguments)

    def _surface_parts(self, surfaces: Any, system: openmm.System | None, positions: Any) -> Sequence[Any]:
        """What is held of surfaces that were given."""
        if system is None:
            raise InputError("surfaces add forces to the System: give system=, or device=True", item="system")
        return surface_parts(surfaces, system=system, positions=positions)

    @property
    def surfaces(self) -> tuple[Constraint, ...]:
        rows = [item for part in self.parts for item in getattr(part, "given", ())]
        return tuple(item for item in rows if item.width == 1 and item.holonomic)

    # -- the state of a context -----------------------------------------------------------------

    @property
    def surface_atoms(self) -> IntArray:
        """Particles on surfaces, in the order of `multipliers`, shape (n_rows,)."""
        return np.concatenate([item.atoms[:, 0] for item in self.surfaces])

    def multipliers(self, context: openmm.Context) -> FloatArray:
        """lambda of each row, exact at the present state; kJ/mol/nm where the coordinate is a length in nm.

        z = lambda grad q is the force of the surface; q as documented by the kcons object, or the formula.
        """
        x, v, f = self._dynamics(context)
        return engine(context, self.surfaces, x).multipliers(x[self.surface_atoms], v, f)

    def constraint_forces(self, context: openmm.Context) -> FloatArray:
        """Force of the surfaces on each particle in kJ/mol/nm, exact at the present state, shape (n_particles, 3)."""
        x, v, f = self._dynamics(context)
        out = np.zeros_like(x)
        out[self.surface_atoms] = engine(context, self.surfaces, x).constraint_force(x[self.surface_atoms], v, f)
        return out

    def _dynamics(self, context: openmm.Context) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Positions of all particles; velocities and applied forces of those on surfaces."""
        require_context(context)
        x, v = motion_of(context)
        atoms = self.surface_atoms
        return x, v[atoms], forces_at(context, self.getIntegrationForceGroups())[atoms]


def listed(
    surfaces: Constraint | Iterable[Constraint], positions: ArrayLike | None, n_particles: int
) -> list[Constraint]:
    """Surfaces that were given, with the targets that they have in positions."""
    given = list(accepted((surfaces,) if isinstance(surfaces, Constraint) else surfaces))
    if not given:
        raise InputError("no surface was given", item="surfaces")
    for item in given:
        if not isinstance(item, Constraint) or item.width != 1 or not item.holonomic:
            raise UnsupportedError(f"{item!r} is no surface that a particle can be on; {CARRIER}")
    atoms = np.concatenate([item.atoms[:, 0] for item in given])
    if len(atoms) and not 0 <= atoms.min() <= atoms.max() < n_particles:
        raise InputError(
            f"surfaces name the particles {atoms.min()} to {atoms.max()}, but the System has {n_particles}",
            item="surfaces",
            atoms=[int(atoms.min()), int(atoms.max())],
        )
    names, counts = np.unique(atoms, return_counts=True)
    if len(names) < len(atoms):
        raise UnsupportedError(f"particle {names[np.argmax(counts)]} is on two surfaces, that is on a curve; {CARRIER}")
    if positions is None:
        return given
    x = nanometers(positions, n_particles)
    return [item.with_target(item.measure(x[item.atoms], 0.0)) if item.target is None else item for item in given]


def _check(item: Constraint) -> None:
    """Refuse a target that is open, moves, or is no length."""
    if item.moving:
        raise UnsupportedError(f"{item!r} moves with time; {CARRIER}, or device=True")
    if item.target is None:
        raise InputError(
            f"{item!r} has no radius or offset: give it, or give positions= to take it from them", item="target"
        )
    length = item.target_at(0.0)
    if item.positive and not np.all(length > 0):
        k = int(np.argmin(length))
        raise InputError(
            f"{item.row_name(k)}: {item.positive} {length[k]:g} is not positive; give a length in nm greater than zero",
            item=item.positive,
            atoms=item.atoms[k].tolist(),
        )
