"""OpenMM as an MD engine of test systems: a System with the same forces and masses, and units to convert."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from ase import units

from kcons.comparison.test_systems.potential import Potential
from kcons.constraints import Constraint
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError

if TYPE_CHECKING:
    import openmm

#: OpenMM's energy is dalton nm²/ps², so that lengths and times decide about all units.
ASE_LENGTH, ASE_TIME = 0.1, 1e-3 / units.fs


@dataclass
class OpenMMEngine:
    """What OpenMM needs to run a test system."""

    #: Makes the System: masses, forces, and as its constraints those rows of the test system that are distances.
    build: Callable[[], openmm.System]
    #: One unit of length of the test system in nm, one unit of time in ps.
    length: float = ASE_LENGTH
    time: float = ASE_TIME
    #: Where it runs. 'Reference' computes forces in double, 'CPU' in single precision.
    platform: str = "Reference"
    #: Spheres and other surfaces that hold particles, in nm.
    surfaces: Sequence[Constraint] = ()
    #: Whether the test system belongs to OpenMM: its forces are OpenMM's, and its methods are the usual ones.
    home: bool = False
    #: Seconds that the set-up of OpenMM's own constraints may take before a second one is refused.
    patience: float = inf
    _waited: float = field(default=0.0, init=False, repr=False)

    @cached_property
    def system(self) -> openmm.System:
        """The System, made once; take `copy` to change it."""
        return self.build()

    def copy(self, *, constraints: bool = True) -> openmm.System:
        """A System of one's own, with or without its constraints."""
        system = deepcopy(self.system)
        if not constraints:
            for k in reversed(range(system.getNumConstraints())):
                system.removeConstraint(k)
        return system

    def context(self, system: openmm.System, integrator: openmm.Integrator) -> openmm.Context:
        """A Context on the platform of the test system, on one thread; refused where an earlier one took too long."""
        import openmm

        rows = system.getNumConstraints()
        if rows and self._waited > self.patience:
            raise UnsupportedError(
                f"OpenMM took {self._waited:.3g} s to set up its own solver for {rows} constraints, longer than the "
                f"budget of {self.patience:.3g} s"
            )
        begun = perf_counter()
        try:
            return openmm.Context(system, integrator, place(self.platform), properties(self.platform))
        finally:
            if rows:
                self._waited = max(self._waited, perf_counter() - begun)

    # -- units ----------------------------------------------------------------------------------

    @property
    def speed(self) -> float:
        """One unit of velocity of the test system in nm/ps."""
        return self.length / self.time

    def step(self, size: float) -> openmm.unit.Quantity:
        """A time step of the test system as OpenMM takes it."""
        from openmm import unit

        return size * self.time * unit.picosecond

    def potential(self) -> Potential:
        """The forces of the System as the test system's own, on the same platform."""
        import openmm
        from openmm import unit

        context = self.context(self.copy(constraints=False), openmm.VerletIntegrator(0.001))
        to_energy = self.speed**-2
        newton = unit.kilojoule_per_mole / unit.nanometer

        def evaluate(x: FloatArray) -> tuple[float, FloatArray]:
            context.setPositions(np.asarray(x) * self.length)
            state = context.getState(energy=True, forces=True)
            energy = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
            forces = state.getForces(asNumpy=True).value_in_unit(newton)
            return float(energy) * to_energy, np.asarray(forces, dtype=float) * (to_energy * self.length)

        return Potential(evaluate, f"OpenMM {openmm.__version__}, {self.platform} platform")


def place(platform: str) -> openmm.Platform:
    """The platform of this name."""
    import openmm

    try:
        return openmm.Platform.getPlatformByName(platform)
    except openmm.OpenMMException:
        known = ", ".join(openmm.Platform.getPlatform(k).getName() for k in range(openmm.Platform.getNumPlatforms()))
        raise InputError(f"OpenMM has no platform {platform!r} here; there are {known}", item="platform") from None


def properties(platform: str) -> dict[str, str]:
    """One thread and forces that repeat to the last bit; double precision on a GPU."""
    if platform == "CPU":
        return {"Threads": "1", "DeterministicForces": "true"}
    return {"Precision": "double"} if platform in ("CUDA", "OpenCL", "HIP") else {}


def system_of(masses: FloatArray, *forces: Any, pairs: Any = (), lengths: Any = ()) -> openmm.System:
    """A System of these masses (dalton), forces and distances (nm)."""
    import openmm

    system = openmm.System()
    for mass in masses:
        system.addParticle(float(mass))
    for force in forces:
        system.addForce(force)
    for (i, j), length in zip(pairs, np.broadcast_to(lengths, len(pairs)), strict=True):
        system.addConstraint(int(i), int(j), float(length))
    return system
