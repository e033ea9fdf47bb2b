"""Momenta that a System conserves, and that its thermostat must not count."""

from __future__ import annotations

import copy
import warnings
from dataclasses import dataclass
from typing import Literal

import numpy as np
import openmm
from openmm import unit

from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.openmm.integrator.guard import positions_of
from kcons.openmm.integrator.interface import Integrator
from kcons.openmm.integrator.system_checks import BAROSTATS, forces_of, removes_centre_of_mass_motion
from kcons.thermostats.freedom import AT_REST, BALANCED, SHAKE, SHIFT, open_directions

Momentum = Literal["auto", "conserved", "free"]

#: Forces that know no place in space. Others are computed, to see whether they add up to nothing.
_INVARIANT = frozenset(
    {
        "HarmonicBondForce",
        "HarmonicAngleForce",
        "PeriodicTorsionForce",
        "RBTorsionForce",
        "CMAPTorsionForce",
        "NonbondedForce",
        "CustomNonbondedForce",
        "CustomBondForce",
        "CustomAngleForce",
        "CustomTorsionForce",
        "GBSAOBCForce",
        "GayBerneForce",
        "CMMotionRemover",
        "AndersenThermostat",
        *BAROSTATS,
    }
)
_PLACES = 3


@dataclass(frozen=True, eq=False)
class Momenta:
    """Conserved momenta.

    Attributes
    ----------
    directions : ndarray, shape (k, 3)
        Orthonormal directions in which total momentum is conserved.
    angular : bool
        Whether angular momentum is conserved.
    """

    directions: FloatArray
    angular: bool


NONE = Momenta(np.zeros((0, 3)), False)


def check_momentum(momentum: str) -> None:
    """Raise `InputError` for a word that is none of `Momentum`."""
    if momentum not in ("auto", "conserved", "free"):
        raise InputError(f"momentum is {momentum!r}; choose 'auto', 'conserved' or 'free'", item="momentum")


def warn_of_conserved_momenta(momenta: Momenta, masses: FloatArray, v: FloatArray, turns: bool) -> None:
    """Say so, at the first step, where conserved momenta keep a deterministic thermostat from sampling a temperature.

    Parameters
    ----------
    momenta : Momenta
    masses : ndarray, shape (n,)
        Of the particles that are thermostatted; 0 for others.
    v : ndarray, shape (n, 3)
    turns : bool
        Whether to speak of angular momentum.
    """
    p = momenta.directions @ (masses @ v)
    twice = float(masses @ np.einsum("ij,ij->i", v, v))
    if float(p @ p) > AT_REST * masses.sum() * twice:
        warnings.warn(
            "total momentum is not zero, and a thermostat that scales velocities scales it too instead of "
            "forgetting it: no temperature is sampled. Take it out of the velocities first, or use Langevin",
            stacklevel=6,
        )
    elif turns:
        warnings.warn(
            "the forces exert no torque (a free cluster), so that angular momentum is only scaled by the "
            "thermostat and never forgotten: configurations are not canonical. Use Langevin",
            stacklevel=6,
        )


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
    broken: list[FloatArray] = []
    for k in range(system.getNumParticles()):
        if system.getParticleMass(k).value_in_unit(unit.dalton) == 0 and not system.isVirtualSite(k):
            broken.append(np.eye(3))
            break
    for part in integrator.parts:
        engine = part.engine_at(context)
        if engine is not None:
            motion, places = engine
            open_ones = open_directions(motion, places)
            broken.append(np.eye(3) - open_ones.T @ open_ones)
    rows = [force for force in forces_of(system) if force.getForceGroup() in integrator.row_groups]
    broken += [_totals(system, force, x)[0] for force in rows if not _carries(force)]
    turns = not system.usesPeriodicBoundaryConditions()
    if momentum == "auto" and not removes_centre_of_mass_motion(system):
        for force in forces_of(system):
            if force.getForceGroup() in integrator.row_groups or type(force).__name__ in _INVARIANT:
                continue
            totals, torque = _totals(system, force, x)
            broken.append(totals)
            turns = turns and not torque
    directions = np.eye(3)
    if broken:
        _, sizes, axes = np.linalg.svd(np.vstack(broken))
        directions = axes[int(np.sum(sizes > 1e-6)) :]
    if momentum == "conserved" and not len(directions):
        raise UnsupportedError("total momentum is not conserved: rows or particles without mass are held in space")
    return Momenta(directions, turns and len(directions) == 3 and not integrator.parts)


def _carries(force: openmm.Force) -> bool:
    """Whether a force is a messenger to the engine of kcons, no row itself."""
    return isinstance(force, openmm.PythonForce)


def _totals(system: openmm.System, force: openmm.Force, x: FloatArray) -> tuple[FloatArray, bool]:
    """Sum of one force over the particles, at a few places and as shares of its size, and whether it has a torque."""
    alone = openmm.System()
    for k in range(system.getNumParticles()):
        alone.addParticle(1.0 if system.isVirtualSite(k) else system.getParticleMass(k))
    alone.setDefaultPeriodicBoxVectors(*system.getDefaultPeriodicBoxVectors())
    alone.addForce(copy.deepcopy(force))
    clock = openmm.VerletIntegrator(1e-3)
    context = openmm.Context(alone, clock, openmm.Platform.getPlatformByName("Reference"))
    rng = np.random.default_rng(0)
    size = float(np.ptp(x, axis=0).max(initial=0.0)) or 1.0
    found, torque = [], False
    for place in range(_PLACES):
        there = x + (SHIFT * size * rng.standard_normal(3) + SHAKE * size * rng.standard_normal(x.shape)) * (place > 0)
        context.setPositions(there)
        state = context.getState(forces=True)
        f = np.asarray(state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer))
        total, whole = f.sum(axis=0), float(np.abs(f).sum())
        found.append(total / whole if whole > 0 and np.abs(total).max() > BALANCED * whole else np.zeros(3))
        arms = there - there.mean(axis=0)
        turn = float(np.abs(np.cross(arms, f).sum(axis=0)).max())
        torque = torque or turn > BALANCED * float((np.linalg.norm(arms, axis=1) * np.linalg.norm(f, axis=1)).sum())
    return np.array(found), torque
