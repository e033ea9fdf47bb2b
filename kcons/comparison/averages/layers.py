"""Systems with expensive and cheap forces: fluids of which near molecules are cheap, molecules with two calculators."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from ase.units import kB

from kcons.comparison.test_systems.fluid import Fluid
from kcons.comparison.test_systems.near_molecules import NearMolecules
from kcons.comparison.test_systems.potential import Potential
from kcons.comparison.test_systems.system import ASE_UNITS, TestSystem, Units
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.motion.motion import Motion
from kcons.thermostats import Estimate, mean

#: Metropolis moves of each molecule for the reference, between two records, and in one go.
_EVERY, _BATCH, _WARM = 10, 500, 4000


@dataclass(frozen=True)
class Layers:
    """A system with expensive and cheap forces.

    Attributes
    ----------
    title : str
    motion : Motion
    positions : ndarray, shape (n_atoms, 3)
        On the constraints; near equilibrium.
    slow, fast : Potential
        The expensive forces, all of them, and the cheap ones.
    thermal_energy : float
    inner : float
        Longest step of the cheap forces.
    steps : sequence of float
        Default steps.
    interval : float
        Least time between two samples.
    flight : float
        Length of a trajectory of Hamiltonian Monte Carlo.
    units : Units
    molecules : int
        That energies are divided by.
    reference : Estimate, optional
        The mean energy, where it is known.
    observables : mapping of str to callable
        What else to average: positions, shape (n_atoms, 3), to a number.
    """

    title: str
    motion: Motion
    positions: FloatArray
    slow: Potential
    fast: Potential
    thermal_energy: float
    inner: float
    steps: Sequence[float]
    interval: float
    flight: float
    units: Units = ASE_UNITS
    molecules: int = 1
    reference: Estimate | None = None
    observables: Mapping[str, Callable[[FloatArray], float]] = field(default_factory=dict)

    def inner_steps(self, step: float) -> int:
        """How many steps of the cheap forces go into one of `step`."""
        return max(1, math.ceil(step / self.inner - 1e-9))


def of_fluid(
    fluid: Fluid,
    fast: float,
    slow: float | None = None,
    *,
    sweeps: int = 20_000,
    seed: int = 1,
    inner: float | None = None,
) -> Layers:
    """A fluid whose molecules are switched off as wholes, far off in the expensive forces and near in the cheap ones.

    It starts at equilibrium, by Metropolis sampling.

    Parameters
    ----------
    fluid : Fluid
    fast, slow : float
        How far molecules reach in the cheap and in the expensive forces (half the box by default); see
        `NearMolecules`.
    sweeps : int
        Moves of each molecule for the reference.
    seed : int
    inner : float, optional
        Longest step of the cheap forces; the coarsest default step of the fluid.

    Raises
    ------
    InputError
        Cheap forces that reach as far as the expensive ones, or expensive ones beyond half the box.
    """
    far = NearMolecules(fluid.forces, 0.5 * fluid.forces.box if slow is None else slow)
    near = NearMolecules(fluid.forces, fast)
    if not near.reach < far.reach:
        raise InputError(
            f"the cheap forces reach {near.reach:g}; give less than {far.reach:.4g}, the reach of the expensive ones",
            item="fast",
        )
    needed = _contact(fluid)
    if far.reach < needed:
        raise InputError(
            f"the expensive forces reach {far.reach:.4g}, and molecules touch up to {needed:.4g} apart: take more of "
            "them (--size), in a larger box",
            item="size",
        )
    kt, moved = fluid.thermal_energy, (fluid.shift, fluid.turn)
    _, x, _ = far.metropolis(fluid.positions, kt, _WARM, _EVERY, seed, *moved)
    energies = []
    for k in range(max(1, sweeps // _BATCH)):
        part, x, _ = far.metropolis(x, kt, _BATCH, _EVERY, (seed, k), *moved)
        energies.append(part)
    coarsest = inner or max(fluid.time_steps)
    return Layers(
        title=f"{fluid.title}; molecules switched off at {far.reach:.3g}, and at {near.reach:.3g} in the cheap forces",
        motion=fluid.motion,
        positions=x,
        slow=Potential(far.evaluate, f"molecules within {far.reach:.3g}"),
        fast=Potential(near.evaluate, f"molecules within {near.reach:.3g}"),
        thermal_energy=kt,
        inner=coarsest,
        steps=tuple(k * coarsest for k in (1, 2, 4, 6)),
        interval=fluid.interval,
        flight=30 * coarsest,
        units=fluid.units,
        molecules=fluid.n_molecules,
        reference=mean(np.concatenate(energies)),
    )


def _contact(fluid: Fluid) -> float:
    """Largest distance of the first atoms of two molecules that touch."""
    forces = fluid.forces
    firm = forces.sites[:, 0] > 0
    whole = fluid.positions - fluid.positions[forces.first[:-1]][forces.molecule]
    extent = float(np.sqrt((whole[firm] ** 2).sum(axis=1)).max(initial=0.0))
    return 2 * extent + 2 * float(forces.sites[firm, 1].max(initial=0.0))


def of_test_systems(
    expensive: TestSystem, cheap: TestSystem, kelvin: float = 300.0, *, inner: float | None = None
) -> Layers:
    """Two test systems of the same atoms, with expensive and with cheap forces.

    Raises
    ------
    InputError
        They are not of the same atoms and constraints.
    """
    heavy, light = expensive.constraint_set.masses, cheap.constraint_set.masses
    if len(heavy) != len(light) or not np.allclose(heavy, light, rtol=1e-2):
        raise InputError("expensive and cheap forces are of different atoms; give two of the same file", item="fast")
    if expensive.motion.rank != cheap.motion.rank:
        raise InputError("expensive and cheap forces come with different constraints", item="fast")
    coarsest = inner or 2.0 * expensive.units.time_unit
    return Layers(
        title=f"{expensive.title}; cheap forces: {cheap.potential.name}",
        motion=expensive.motion,
        positions=expensive.positions,
        slow=expensive.potential,
        fast=cheap.potential,
        thermal_energy=kB * kelvin,
        inner=coarsest,
        steps=tuple(k * coarsest for k in (1, 2, 4)),
        interval=8 * coarsest,
        flight=30 * coarsest,
        units=expensive.units,
    )
