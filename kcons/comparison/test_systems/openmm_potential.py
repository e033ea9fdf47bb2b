"""Forces from an OpenMM System, in ASE's units. Its constraints are taken out: kcons holds them."""

from __future__ import annotations

import numpy as np
import openmm
from ase import units
from openmm import unit

from kcons.comparison.test_systems.potential import Potential
from kcons.constraints.target import FloatArray
from kcons.errors import InputError

KJ = units.kJ / units.mol
NM = units.nm


def of_system(system: openmm.System, *, platform: str = "CPU", threads: int = 1) -> Potential:
    """The potential of an OpenMM System: positions in Å, energy in eV, forces in eV/Å.

    Parameters
    ----------
    system : openmm.System
        Its constraints are removed from a copy; the System itself is left alone.
    platform : str
        'CPU' computes in single, 'Reference' in double precision.
    threads : int
        For the CPU platform; one by default, so that timings mean something.

    Raises
    ------
    InputError
        The platform is unknown, or the System has virtual sites.
    """
    bare = openmm.XmlSerializer.clone(system)
    for k in reversed(range(bare.getNumConstraints())):
        bare.removeConstraint(k)
    if any(bare.isVirtualSite(k) for k in range(bare.getNumParticles())):
        raise InputError("the System has virtual sites; ASE and kcons move every particle", item="system")
    try:
        place = openmm.Platform.getPlatformByName(platform)
    except openmm.OpenMMException as error:
        raise InputError(f"OpenMM has no platform {platform!r} here: {error}", item="platform") from None
    properties = {"Threads": str(threads), "DeterministicForces": "true"} if platform == "CPU" else {}
    context = openmm.Context(bare, openmm.VerletIntegrator(0.001), place, properties)

    def evaluate(x: FloatArray) -> tuple[float, FloatArray]:
        context.setPositions(np.asarray(x) / NM)
        state = context.getState(getEnergy=True, getForces=True)
        energy = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
        forces = state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
        return float(energy) * KJ, np.asarray(forces, dtype=float) * (KJ / NM)

    return Potential(evaluate, f"OpenMM {openmm.__version__}, {platform} platform")
