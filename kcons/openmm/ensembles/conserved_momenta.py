"""Momenta that a System conserves, and that its thermostat must not count."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Literal

import numpy as np
import openmm
from openmm import unit

from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import extent
from kcons.errors import InputError, UnsupportedError
from kcons.openmm.integrator.guard import positions_of
from kcons.openmm.integrator.steps import Integrator
from kcons.openmm.integrator.system_checks import (
    forces_of,
    groups_in,
    groups_of,
    knows_a_place,
    removes_centre_of_mass_motion,
)
from kcons.openmm.quantities import held_without_mass, masses_of
from kcons.thermostats.freedom import BALANCED, SHAKE, SHIFT, RigidMotions, open_directions

Momentum = Literal["auto", "conserved", "free"]

_PLACES = 3


@dataclass(frozen=True, eq=False)
class Momenta:
    """Conserved momenta.

    Attributes
    ----------
    directions : ndarray, shape (k, 3)
        Orthonormal directions in which total momentum is conserved.
    turns : bool
        Whether neither forces nor rows exert a torque about some axis, about which angular momentum is conserved too.
    """

    directions: FloatArray
    turns: bool


NONE = Momenta(np.zeros((0, 3)), False)


def check_momentum(momentum: str) -> None:
    """Raise `InputError` for a word that is none of `Momentum`."""
    if momentum not in ("auto", "conserved", "free"):
        raise InputError(f"momentum is {momentum!r}; choose 'auto', 'conserved' or 'free'", item="momentum")


def conserved_momenta(integrator: Integrator, context: openmm.Context, momentum: Momentum) -> Momenta:
    """Find conserved momenta from the forces and the constraints.

    Parameters
    ----------
    integrator : ProjectedIntegrator
    context : openmm.Context
    momentum : {'auto', 'conserved', 'free'}
        'conserved': in all directions that the rows allow; 'free': in none.

    Raises
    ------
    UnsupportedError
        'conserved', and rows or particles without mass hold all directions.
    """
    if momentum == "free":
        return NONE
    system, x = context.getSystem(), positions_of(context)
    masses, removed = masses_of(system), removes_centre_of_mass_motion(system)
    turns = RigidMotions(x, turn=not system.usesPeriodicBoundaryConditions())
    broken: list[FloatArray] = []
    fixed = held_without_mass(system)
    if fixed:
        if not removed:  # what a remover takes is not there, whatever holds the others
            broken.append(np.eye(3))
        turns.keep(turns.fields(x[fixed]))
    for part in integrator.parts:
        engine = part.engine_at(context)
        if engine is not None:
            motion, places = engine
            open_ones = open_directions(motion, places)
            broken.append(np.eye(3) - open_ones.T @ open_ones)
            turns.keep_rows(motion, places)
    acting = groups_in(integrator)
    for force in forces_of(system):
        if force.getForceGroup() in integrator.row_groups:
            if not _carries(force):
                broken.append(_totals(context, force, x, fixed, turns))
        elif momentum == "auto" and groups_of(force) & acting and knows_a_place(force):
            if not removed:
                broken.append(_totals(context, force, x, fixed, turns))
            elif turns.found and not _carries(force):  # what Python computes is taken for forces between particles
                _totals(context, force, x, fixed, turns)
    if removed:  # the centre of mass rests
        turns.keep(np.tensordot(masses, turns.fields(x).reshape(-1, 3, 6), 1) / masses.sum())
    directions = np.eye(3)
    if broken:
        _, sizes, axes = np.linalg.svd(np.vstack(broken))
        directions = axes[int(np.sum(sizes > 1e-6)) :]
    if momentum == "conserved" and not len(directions):
        raise UnsupportedError("total momentum is not conserved: rows or particles without mass are held in space")
    return Momenta(directions, turns.found)


def _carries(force: openmm.Force) -> bool:
    """Whether a force is a messenger to the engine of kcons, no row itself."""
    return isinstance(force, openmm.PythonForce)


def _totals(
    given: openmm.Context, force: openmm.Force, x: FloatArray, fixed: list[int], turns: RigidMotions
) -> FloatArray:
    """Sum of one force over the particles, at a few places and as shares of its size; `turns` sees them, too."""
    system, alone = given.getSystem(), openmm.System()
    for k in range(system.getNumParticles()):
        alone.addParticle(1.0 if system.isVirtualSite(k) else system.getParticleMass(k))
    alone.setDefaultPeriodicBoxVectors(*given.getState().getPeriodicBoxVectors())
    alone.addForce(copy.deepcopy(force))
    clock = openmm.VerletIntegrator(1e-3)
    context = openmm.Context(alone, clock, openmm.Platform.getPlatformByName("Reference"))
    for name in context.getParameters():
        context.setParameter(name, given.getParameter(name))
    rng = np.random.default_rng(0)
    size = extent(x) or 1.0
    found: list[FloatArray] = []
    while len(found) < _PLACES or turns.open:
        there = x + (SHIFT * size * rng.standard_normal(3) + SHAKE * size * rng.standard_normal(x.shape)) * bool(found)
        there[fixed] = x[fixed]
        context.setPositions(there)
        state = context.getState(forces=True)
        f = np.asarray(state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer))
        total, whole = f.sum(axis=0), float(np.abs(f).sum())
        found.append(total / whole if whole > 0 and np.abs(total).max() > BALANCED * whole else np.zeros(3))
        turns.see(there, f)
    return np.array(found)
