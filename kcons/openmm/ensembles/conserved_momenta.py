"""g, the momenta that a thermostat acts on: all that are independent, less those that the System conserves."""

from __future__ import annotations

import copy
from typing import Literal, NamedTuple, cast

import numpy as np
import openmm

from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import extent
from kcons.errors import OverdeterminedError, UnsupportedError
from kcons.openmm.integrator.guard import (
    forces_alone,
    forces_of,
    groups_in,
    groups_of,
    knows_a_place,
    removes_center_of_mass_motion,
    virtual_sites,
)
from kcons.openmm.integrator.program import Ensemble, Integrator
from kcons.openmm.quantities import box_of, forces_at, masses_of, positions_of, velocities_of
from kcons.thermostats.freedom import BALANCED, SHIFT, RigidMotions, open_directions, shaking, warn_of_conserved_momenta

Momentum = Literal["auto", "conserved", "free"]

#: How many shifted places are looked at, and how far atoms are moved where nothing acts there, as `SHIFT`.
_PLACES, FAR = 3, 100.0


class Momenta(NamedTuple):
    """Conserved momenta."""

    #: Orthonormal directions in which total momentum is conserved, shape (k, 3).
    directions: FloatArray
    #: Whether neither forces nor rows exert a torque about some axis, about which angular momentum is conserved too.
    turns: bool


class CountsMomenta(Ensemble):
    """An ensemble that gives a temperature to g independent momenta, by scaling velocities.

    g is three for each particle with a mass, less the rank of all constraints, less one for each direction in which
    total momentum is conserved; it is found once for a Context. `ready` is called at the first step, and is what an
    ensemble of this kind has to write besides its program.
    """

    momentum: Momentum
    temperature: float | None
    few = 0  # momenta that are too few for averages

    def momenta(self, integrator: Integrator) -> Momenta:
        """Which momenta are conserved."""
        guard = integrator._watch()
        if guard.momenta is None:
            guard.momenta = conserved_momenta(integrator, guard.context, self.momentum)
        return cast(Momenta, guard.momenta)

    def count(self, integrator: Integrator) -> int:
        """g: the momenta that are independent, less those that are conserved; `OverdeterminedError` for none."""
        guard = integrator._watch()
        if guard.thermal is None:
            count = integrator.independent_momenta() - len(self.momenta(integrator).directions)
            if count < 1:
                raise OverdeterminedError("no degree of freedom is left for the thermostat: hold fewer rows", rows=())
            guard.thermal = count
        return int(guard.thermal)

    def warmth(self, integrator: Integrator) -> float:
        return integrator.degrees_of_freedom() / self.count(integrator)

    def begin(self, integrator: Integrator, context: openmm.Context) -> None:
        """Find g, and tell of momenta that are conserved; `UnsupportedError` where targets move."""
        moving = [part for part in integrator.parts if part.driven]
        if moving:
            raise UnsupportedError(
                f"{type(self).__name__} needs constant targets, and those of {moving[0]!r} move: scaled velocities "
                "would not follow; use Langevin, or a thermostat of kcons.ase"
            )
        masses, v = integrator._watch().rows.masses, velocities_of(context)
        if removes_center_of_mass_motion(context.getSystem()):
            v = np.where(masses[:, None] > 0, v - masses @ v / masses.sum(), v)  # what the remover will do
        self.ready(integrator, context, masses, v)
        directions, turns = self.momenta(integrator)
        asked, few = self.temperature is not None, self.count(integrator) <= self.few
        warn_of_conserved_momenta(masses, v, directions, turns and asked, stacklevel=7, few=few and asked)

    def ready(self, integrator: Integrator, context: openmm.Context, masses: FloatArray, v: FloatArray) -> None:
        """Before the first step: settings that depend on g, and on the velocities v of particles with these masses."""
        raise NotImplementedError


def conserved_momenta(integrator: Integrator, context: openmm.Context, momentum: Momentum) -> Momenta:
    """Conserved momenta, from the forces and the constraints.

    `momentum` is 'auto', 'conserved' (in all directions that the rows allow; `UnsupportedError` where rows or particles
    without mass hold all), or 'free' (in none).
    """
    if momentum == "free":
        return Momenta(np.zeros((0, 3)), False)
    system, x = context.getSystem(), positions_of(context)
    masses, removed = masses_of(system), removes_center_of_mass_motion(system)
    turns = RigidMotions(x, turn=not system.usesPeriodicBoundaryConditions())
    broken = [np.zeros((1, 3))]
    fixed = integrator._watch().bound()
    if fixed:
        if not removed:  # what a remover takes is not there, whatever holds the others
            broken.append(_left_behind(context, x, fixed) if virtual_sites(system) else np.eye(3))
        turns.keep(turns.fields(x[fixed]))
    for part in integrator.parts:
        solver = part.solver_at(context)
        if solver is not None:
            motion, atoms, time = solver
            open_ones = open_directions(motion, x[atoms], time)
            broken.append(np.eye(3) - open_ones.T @ open_ones)
            turns.keep_rows(motion, x[atoms], time)
    acting = groups_in(integrator)
    for force in forces_of(system):
        if momentum == "auto" and groups_of(force) & acting and knows_a_place(force):
            if not removed:
                broken.append(_totals(context, force, x, fixed, turns))
            elif turns.found and not isinstance(force, openmm.PythonForce):  # taken for forces between particles
                _totals(context, force, x, fixed, turns)
    if removed:  # the center of mass rests
        turns.keep(np.tensordot(masses, turns.fields(x).reshape(-1, 3, 6), 1) / masses.sum())
    _, sizes, axes = np.linalg.svd(np.vstack(broken))
    directions = axes[int(np.sum(sizes > 1e-6)) :]
    if momentum == "conserved" and not len(directions):
        raise UnsupportedError("total momentum is not conserved: rows, massless particles or images hold a place")
    return Momenta(directions, turns.found)


def _left_behind(given: openmm.Context, x: FloatArray, atoms: list[int]) -> FloatArray:
    """How some particles do not follow shifts of all that has mass, shape (3 n, 3): images may follow along an axis."""
    system, places = copy.deepcopy(given.getSystem()), []
    for _ in range(system.getNumForces()):
        system.removeForce(0)
    system.setDefaultPeriodicBoxVectors(*box_of(given))
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
    for shift in np.eye(4, 3, -1):  # none, then along each axis
        context.setPositions(x + shift * (masses_of(system) > 0)[:, None])
        context.computeVirtualSites()
        places.append(positions_of(context)[atoms])
    return (np.array(places[1:]) - places[0] - np.eye(3)[:, None]).reshape(3, -1).T


def _totals(
    given: openmm.Context, force: openmm.Force, x: FloatArray, fixed: list[int], turns: RigidMotions
) -> FloatArray:
    """Sum of one force, as shares of its size, nearby: in place it may be rounding alone; `turns` sees them, too."""
    context = forces_alone(given.getSystem(), [force], box_of(given), given.getParameters())
    rng = np.random.default_rng(0)
    size = extent(x) or 1.0
    found: list[FloatArray] = []
    while len(found) < _PLACES or turns.open:
        for away in (SHIFT * rng.standard_normal(3), FAR * rng.standard_normal(x.shape)):  # walls act far away only
            there = x + size * away + shaking(x, rng)
            there[fixed] = x[fixed]
            context.setPositions(there)
            f = np.nan_to_num(forces_at(context, -1), posinf=0.0, neginf=0.0)  # a place may lie behind a wall
            if f.any():
                break
        total, whole = f.sum(axis=0), float(np.abs(f).sum())
        found.append(total / whole if whole > 0 and np.abs(total).max() > BALANCED * whole else np.zeros(3))
        turns.see(there, f)
    return np.array(found)
