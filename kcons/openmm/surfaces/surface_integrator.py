"""Particles on surfaces: spheres, ellipsoids, cylinders, planes, tori, and what a formula gives.

In its own step, each particle is a problem of its own, so that the landing is known before anything moves: with the
impulse that it takes, v changes first and x += h v ends on the surface. No velocity is a difference of positions, whose
rounding grows as 1/h.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import unit

from kcons.constraints import MovingTarget, Torus
from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.openmm.integrator.ensemble import ConstantEnergy, Step, use
from kcons.openmm.integrator.guard import Guard
from kcons.openmm.integrator.part import Part
from kcons.openmm.integrator.projected import ProjectedIntegrator, picoseconds
from kcons.openmm.integrator.steps import see_who_moved
from kcons.openmm.integrator.system_checks import require_context
from kcons.openmm.quantities import accepted, nanometers
from kcons.openmm.states import forces_at, motion_of
from kcons.openmm.surfaces.landings import (
    QUADRICS,
    CompiledQuadricRows,
    ExpressionSurface,
    ImplicitRows,
    QuadricRows,
    TorusRows,
)
from kcons.openmm.surfaces.surface_rows import CARRIER, SurfaceRows, engine, refuse_system
from kcons.steppers import Splitting
from kcons.steppers.splitting import Rattle

AnySurface: TypeAlias = Constraint | ExpressionSurface


def surface_parts(
    surfaces: AnySurface | Iterable[AnySurface],
    *,
    system: openmm.System | None = None,
    n_particles: int | None = None,
    positions: ArrayLike | None = None,
    compiled: bool = False,
) -> tuple[SurfaceRows, ...]:
    """Parts of a `ProjectedIntegrator` that hold particles on surfaces, one for each kind of arithmetic.

    Parameters
    ----------
    surfaces : Sphere, Cylinder, Plane, Ellipsoid, Torus, ExpressionSurface, or several of them
        Those of `kcons.constraints`: Quantities, or plain numbers of nm.
    system : openmm.System, optional
        Checked; formulas add their forces to it, so that it is needed for them before the Context is made.
    n_particles : int, optional
        Particles of the System, where it is not given.
    positions : array_like or Quantity, shape (n_particles, 3), optional
        Needed for targets that are left open: each such particle keeps the radius or plane it has there.
    compiled : bool
        Whether the landing on quadrics is computed by compiled code, through PythonForces that are added to
        `system`: faster on the CPU and Reference platforms, and only for quadrics alone.

    Raises
    ------
    InputError
        Particles that are not in the System, open targets without positions, wrong radii.
    UnsupportedError
        Two surfaces for a particle; a particle without mass, or with a constraint of the System; a barostat;
        moving targets; other kinds of constraints.
    """
    given = tuple(accepted((surfaces,) if isinstance(surfaces, Constraint | ExpressionSurface) else surfaces))
    if not given:
        raise InputError("no surface was given", item="surfaces")
    if system is None and n_particles is None:
        raise InputError("give the System, or the number of its particles", item="n_particles")
    n = system.getNumParticles() if system is not None else int(n_particles or 0)
    formulas = [item for item in given if isinstance(item, ExpressionSurface)]
    known = [item for item in given if not isinstance(item, ExpressionSurface)]
    atoms = _all_atoms(given, n)
    x = None if positions is None else nanometers(positions, n)
    rows = [_settled(item, x) for item in known]
    if system is not None:
        refuse_system(system, atoms)
    elif formulas:
        raise InputError("surfaces given by formulas add forces to the System: give system=", item="system")
    parts: list[SurfaceRows] = []
    quadrics = [item for item in rows if isinstance(item, QUADRICS)]
    tori = [item for item in rows if isinstance(item, Torus)]
    if compiled:
        if tori or formulas:
            raise UnsupportedError("compiled=True is for spheres, cylinders, planes and ellipsoids alone")
        if system is None:
            raise InputError("compiled=True adds forces to the System: give system=", item="system")
        parts.append(CompiledQuadricRows(quadrics, system))
    elif quadrics:
        parts.append(QuadricRows(quadrics, n))
    if tori:
        parts.append(TorusRows(tori, n))
    if formulas:
        assert system is not None
        parts.append(ImplicitRows(formulas, system))
    for part in parts:
        part.bonded = system is None or system.getNumConstraints() > 0
    return tuple(parts)


# -- the step ---------------------------------------------------------------------------------------


def surface_step(step: Step) -> bool:
    """Write a step at constant energy where all parts are surfaces; False, and nothing, for others.

    Within a call the program leaves out the projection of velocities: only who looks needs it.
    """
    surfaces = [part for part in step.parts if isinstance(part, SurfaceRows)]
    constant = step.scheme is not None and type(step.ensemble) is ConstantEnergy
    if not constant or len(surfaces) < len(step.parts):
        return False
    p = step.program
    step.lean, step.lazy, step.observed = False, True, 1
    step.kept = any(part.evaluates for part in surfaces)
    bonded = any(part.bonded for part in surfaces)
    circles = _circles(step, bonded)
    if circles is not None and step.scheme is not None:
        circles.circles = True
        step.drifts, step.kicks = _without_flight(step.drifts, step.kicks, len(step.scheme.flight))
    # x and v stay as they are until the only landing of the step is known: nothing to come back to.
    untouched = isinstance(step.scheme, Rattle) and not step.kept and circles is None
    use(p, "between")
    use(p, "failed", "good_steps", "stale", *["call", "moved"] * step.kept, *["xu"] * bonded)
    if untouched:
        use(p, "behind", "kick")
    else:
        use(p, "stage", "h", "x_last", "v_last")
        p.table("drift_share", step.drifts, "length of drift k as a fraction of the step")
        p.table("kick_share", step.kicks, "length of the kick before drift k as a fraction of the step")
    if step.kept:
        step.force = use(p, "force")
    for part in surfaces:
        part.declare(p)
    # Blocks are few: OpenMM follows every way through them when a Context is made.
    with p.when("failed = 0", "nothing failed before"):
        p.let_others_act()
    if step.kept:
        see_who_moved(step)
    with p.when("failed = 0", "after a failure nothing moves"):
        if step.kept:
            with p.when("moved+stale+abs(call-2) != 0", "others did, or a call begins"):
                p.each("force", "f", "applied forces")
            p.let("call", "select(call, 2, 0)", "forces are known in this call")
        p.let("stale", "0", "what is kept belongs to x")
        if untouched:
            _one_drift(step, surfaces, bonded)
        else:
            p.each("x_last", "x", "to come back to")
            p.each("v_last", "v", "to come back to")
            _drifts(step, surfaces, bonded, circles)
            with p.when("failed != 0", "a solve failed"):
                p.each("x", "x_last", "back to where the step began")
                p.each("v", "v_last", "back to where the step began")
                p.let("stale", "1", "what is kept belongs to elsewhere")
        p.let("good_steps", "good_steps+select(failed, 0, 1)", "count good steps")
        with p.when("select(failed, 0, between) = 0", "somebody looks at the velocities"):
            # Otherwise the next drift absorbs what they have across the surfaces.
            if untouched:
                p.let("kick", "select(failed, 0.5*behind, 0.5)", "what they lack")
                p.each("v", "select(kick, v+kick*dt*f/m, v)", "the rest of the kick")
            step.project()
        if untouched:
            p.let("behind", "select(failed, 0, between)", "the next step makes up for it")
        if step.kept:
            p.each("x_last", "x", "where forces were computed")
    return True


def _circles(step: Step, bonded: bool) -> QuadricRows | None:
    """The spheres, if drifts can follow great circles."""
    part = step.parts[0]
    exact = step.scheme is not None and step.scheme.exact_flight and not bonded
    if exact and len(step.parts) == 1 and isinstance(part, QuadricRows) and part.spheres:
        return part
    return None


def _one_drift(step: Step, surfaces: list[SurfaceRows], bonded: bool) -> None:
    p = step.program
    p.let("kick", "0.5+0.5*behind", "with the half kick that is missing")
    u = "v+kick*dt*f/m"  # x and v stay until the landing is known
    if any(part.moves for part in surfaces):
        p.each(use(p, "u"), u, "kick")
        u = "u"
    _fly(step, surfaces, bonded, u if u == "u" else f"({u})", "dt")


def _drifts(step: Step, surfaces: list[SurfaceRows], bonded: bool, circles: QuadricRows | None) -> None:
    p = step.program
    if step.kicks[0]:
        p.each("v", f"v+dt*kick_share(0)*{step.force}/m", "kick")
    p.let("stage", "0", "first drift")
    with p.loop(f"stage < {len(step.drifts)}*step(0.5-failed)", "all drifts and kicks of the scheme"):
        p.let("h", "dt*drift_share(stage)", "length of this drift")
        if circles is not None:
            circles.circle(p, "h")
        else:
            _fly(step, surfaces, bonded, "v", "h")
        p.let("stage", "stage+1", "what follows")
        with p.when("kick_share(stage)*step(0.5-failed) != 0", "a kick follows"):
            if step.kept:
                p.each("force", "f", "applied forces")
            p.each("v", f"v+dt*kick_share(stage)*{step.force}/m", "kick")


def _fly(step: Step, surfaces: list[SurfaceRows], bonded: bool, u: str, h: str) -> None:
    """From x with velocity `u` along the surfaces; where there is no landing, x and v stay."""
    p = step.program
    if len(surfaces) == 1:
        surfaces[0].fly_alone(p, u, h)
    else:
        for part in surfaces:
            part.fly(p, u, h)
        impulses = "".join(f"+{part.impulse(h)}" for part in surfaces)
        p.each("v", f"select(failed, v, {u}{impulses})", "impulse of the surfaces")
        p.each("x", f"select(failed, x, x+{h}*v)", "fly onto the surfaces")
    if bonded:
        p.each("xu", "x", "before the constraints of the System act")
        p.hold_positions("onto the constraints of the System")
        p.each("v", f"v+(x-xu)/{h}", "impulse of the constraints")


def _without_flight(drifts: list[float], kicks: list[float], pieces: int) -> tuple[list[float], list[float]]:
    """Stages with each drift in one piece."""
    whole = [sum(drifts[k : k + pieces]) for k in range(0, len(drifts), pieces)]
    return whole, kicks[::pieces]


# -- the integrator ---------------------------------------------------------------------------------


class SurfaceIntegrator(ProjectedIntegrator):
    """Dynamics of particles on surfaces, beside free particles and the constraints of the System.

    Each particle on a surface is a problem of its own: quadrics (spheres, cylinders, planes, ellipsoids) have the
    landing in closed form, tori by Newton's method for one number, formulas by Newton's method on forces that
    OpenMM differentiates. Everything is computed by OpenMM, on any platform. With the scheme 'geodesic' and all
    surfaces spheres, the free flight follows exact great circles.

    Parameters
    ----------
    timestep : Quantity or float
        In ps if a float.
    surfaces, system, n_particles, positions, compiled
        See `surface_parts`.
    parts : sequence of Part
        What else to hold, on other particles.
    scheme, **arguments
        See `ProjectedIntegrator`.

    Attributes
    ----------
    surfaces : tuple of SurfaceRows
        Its parts that are surfaces.

    Raises
    ------
    InputError, UnsupportedError
        See `surface_parts` and `ProjectedIntegrator`.
    """

    _own_step = staticmethod(surface_step)

    def __init__(
        self,
        timestep: unit.Quantity | float,
        scheme: str | Splitting = "rattle",
        *,
        surfaces: AnySurface | Iterable[AnySurface] = (),
        system: openmm.System | None = None,
        n_particles: int | None = None,
        positions: ArrayLike | None = None,
        compiled: bool = False,
        parts: Sequence[Part] = (),
        **arguments: Any,
    ) -> None:
        given = (surfaces,) if isinstance(surfaces, Constraint | ExpressionSurface) else tuple(surfaces)
        held: tuple[SurfaceRows, ...] = ()
        if given or not any(isinstance(part, SurfaceRows) for part in parts):  # copies are made from parts alone
            held = surface_parts(given, system=system, n_particles=n_particles, positions=positions, compiled=compiled)
        together: tuple[Part, ...] = (*held, *parts)
        self.surfaces = tuple(part for part in together if isinstance(part, SurfaceRows))
        super().__init__(picoseconds(timestep) * unit.picosecond, scheme, parts=together, **arguments)

    def _run(self, guard: Guard, steps: int, ends: bool) -> None:
        try:
            super()._run(guard, steps, ends)
        except NonFiniteError:
            # A force that is not finite is seen in the step after the one whose velocities it has spoilt.
            if not all(np.isfinite(array).all() for array in motion_of(guard.context)):
                guard.put_back()
            raise

    # -- the state of a context -----------------------------------------------------------------

    @property
    def surface_atoms(self) -> IntArray:
        """Particles on surfaces, in the order of `multipliers`, shape (n_rows,)."""
        return np.concatenate([part.atoms for part in self.surfaces])

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


def _all_atoms(given: Sequence[AnySurface], n: int) -> IntArray:
    for item in given:
        if not isinstance(item, (*QUADRICS, Torus, ExpressionSurface)):
            raise UnsupportedError(
                f"{item!r} is no sphere, cylinder, plane, ellipsoid, torus or ExpressionSurface; {CARRIER}"
            )
    atoms = np.concatenate([np.asarray(item.atoms, dtype=np.int64).reshape(-1) for item in given])
    if len(atoms) and not 0 <= atoms.min() <= atoms.max() < n:
        raise InputError(
            f"surfaces name the particles {atoms.min()} to {atoms.max()}, but the System has {n}",
            item="surfaces",
            atoms=[int(atoms.min()), int(atoms.max())],
        )
    names, counts = np.unique(atoms, return_counts=True)
    if len(names) < len(atoms):
        raise UnsupportedError(f"particle {names[np.argmax(counts)]} is on two surfaces, that is on a curve; {CARRIER}")
    return atoms


def _settled(item: Constraint, x: FloatArray | None) -> Constraint:
    """With a target that rests, and that was checked."""
    if isinstance(item.target, MovingTarget):
        raise UnsupportedError(f"{item!r} has a target that moves with time; {CARRIER}")
    if item.target is None:
        if x is None:
            raise InputError(
                f"{item!r} has no radius or offset: give it, or give positions= to take it from them", item="target"
            )
        item = item.with_target(item.measure(x[item.atoms], 0.0))
    target = item.target_at(0.0)
    length = item.scale() + target if item.family == "Ellipsoid" else target
    if item.family != "Plane" and not np.all(length > 0):
        k = int(np.argmin(length))
        raise InputError(
            f"{item.row_name(k)}: radius {length[k]:g} is not positive; give a length in nm greater than zero",
            item="radius",
            atoms=item.atoms[k].tolist(),
        )
    return item
