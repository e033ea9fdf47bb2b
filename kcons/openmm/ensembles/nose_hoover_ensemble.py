"""Nose-Hoover chains in OpenMM: canonical dynamics without noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import openmm
from openmm import unit

from kcons.constraints.arguments import Count, checked, positive
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.openmm.ensembles.conserved_momenta import CountsMomenta, Momentum
from kcons.openmm.integrator.program import BetweenHalves, Integrator, Program
from kcons.openmm.quantities import GAS_CONSTANT, energy_of, kelvins, number
from kcons.steppers.operations import Operation
from kcons.steppers.splitting import Splitting
from kcons.thermostats.nose_hoover import FRACTIONS, HALF

#: Time steps times frequency beyond which a chain is unstable: K oscillates at sqrt(2) of it, and 2 is the limit.
_FASTEST = 1.4


class NoseHoover(CountsMomenta):
    """Canonical ensemble without noise, for `ProjectedIntegrator(ensemble=...)`: a chain that scales velocities.

    Half a step of the chain, a step on the constraints, half a step of the chain: the trajectory is that of
    `kcons.thermostats.NoseHooverChain` with period 2 pi/frequency. g, the independent momenta, is three for each
    particle with a mass, less the rank of all constraints, less one for each direction in which total momentum is
    conserved. The masses of the chain are kT/frequency^2, times g for the first link.

    Parameters
    ----------
    temperature : Quantity or float
        In K if a float.
    frequency : Quantity or float
        As the collision frequency of openmm.NoseHooverIntegrator, in 1/ps if a float. A Quantity of time is the
        relaxation time, 1/frequency. At most a tenth of a step's inverse.
    length : int
        Links of the chain.
    momentum : {'auto', 'conserved', 'free'}
        As for `Isokinetic`.

    Raises
    ------
    InputError
        Temperature or frequency not positive, no links.

    Warns
    -----
    UserWarning
        At the first step: total momentum is conserved and not zero, or no torque acts (a free cluster).

    Notes
    -----
    Schemes of order 2. Targets must rest. Single oscillators and other small systems without
    collisions need not visit all states, whatever the length of the chain: use Langevin there.

    References
    ----------
    Martyna, Tuckerman, Tobias and Klein, Mol. Phys. 87, 1117 (1996).
    """

    owes = True
    temperature: float
    frequency: float
    length: int
    momentum: Momentum

    @checked
    def __init__(
        self,
        temperature: unit.Quantity | float,
        frequency: unit.Quantity | float,
        *,
        length: Count = 3,
        momentum: Momentum = "auto",
    ) -> None:
        self._keep(
            temperature=positive(kelvins(temperature), "temperature"),
            frequency=positive(_per_picosecond(frequency), "frequency"),
            length=length,
            momentum=momentum,
        )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.temperature:g} K, {self.frequency:g}/ps, length={self.length})"

    def check(self, scheme: Splitting) -> None:
        """Raise `UnsupportedError` for schemes of another order than 2."""
        if scheme.order != 2:
            raise UnsupportedError(f"{scheme!r} has order {scheme.order}, the chain 2; use scheme='rattle'")

    def check_timestep(self, dt: float) -> None:
        """Raise `InputError` for a time step that the chain cannot follow."""
        if dt * self.frequency > _FASTEST:
            raise InputError(
                f"a chain of frequency {self.frequency:g}/ps cannot follow a time step of {dt:g} ps; take a frequency "
                f"of at most {0.1 / dt:.3g}/ps, or a time step of at most {0.1 / self.frequency:.3g} ps",
                item="frequency",
            )

    def operations(self, scheme: Splitting) -> tuple[Operation, ...]:
        """The chain moves before the scheme's own operations and after them."""
        return HALF, *scheme.operations(), HALF

    # -- program --------------------------------------------------------------------------------

    def declare(self, p: Program) -> None:
        p.setting("kT", "Boltzmann's constant times the temperature, kJ/mol", self.settings()["kT"])
        p.setting("frequency", "of the chain, 1/ps", self.frequency)
        p.setting("momenta", "g, independent momenta; 0 until the first step", 0.0)
        for name in self._links():
            p.remember(name, "velocity of a link of the chain, 1/ps")
        p.remember("chain_place", "g times the place of the first link, and those of the others")
        p.table("chain_share", (*FRACTIONS, *FRACTIONS), "length of part k as a fraction of the time, twice")
        if "between" in p.numbers:
            p.use("behind")

    def open(self, p: Program) -> None:
        self._remember(p)
        self._advance(p, "1+behind" if "behind" in p.numbers else "1")

    def close(self, p: Program) -> None:
        if "between" not in p.numbers:
            self._advance(p, "1")
            return
        with p.when("between = 0", "somebody looks at the velocities"):
            self._advance(p, "1")
        p.let("behind", "between", "the next step makes up for it")

    def _remember(self, p: Program) -> None:
        if p.parts:
            for name in self._state():
                p.let(f"{name}_last", name, "to come back to")

    def take_back(self, p: Program) -> None:
        for name in self._state():
            p.let(name, f"{name}_last", "the chain is back where the step began")

    def _advance(self, p: Program, halves: str) -> None:
        """Move the chain on for half a step, or two halves one after the other; see `kcons.thermostats.nose_hoover`."""
        links = self._links()
        parts = len(p.tables["chain_share"]) // 2
        time = f"{HALF.fraction!r}*dt"
        p.sum("twice", "m*v*v", "2K, the only sum")
        p.let("chain_inertia", "kT/frequency^2", "mass of a link")
        p.let("scale", "1", "nothing done yet")
        p.let("chain_part", "0", "first part")
        with p.loop(f"chain_part < {parts}*({halves})" if halves != "1" else f"chain_part < {parts}", "all parts"):
            p.let("chain_h", f"{time}*chain_share(chain_part)", "length of this part")
            for k in reversed(range(len(links))):
                p.let(links[k], self._pushed(k), "half a push")
            p.let("scale", "scale*exp(-chain_h*link1)", "the first link scales velocities")
            moved = "+".join(["momenta*link1", *links[1:]])
            p.let("chain_place", f"chain_place+chain_h*({moved})", "links move")
            for k in range(len(links)):
                p.let(links[k], self._pushed(k), "half a push")
            p.let("chain_part", "chain_part+1", "what follows")
        p.each("v", "scale*v", "the chain scales velocities")

    def _pushed(self, k: int) -> str:
        """The velocity of a link after half of the time, pushed by the one before and damped by the next."""
        link = f"link{k + 1}"
        if k == 0:
            push = "0.5*chain_h*(twice*scale^2-momenta*kT)/(momenta*chain_inertia)"
        else:
            mass = "momenta*chain_inertia" if k == 1 else "chain_inertia"
            push = f"0.5*chain_h*({mass}*link{k}^2-kT)/chain_inertia"
        if k + 1 == self.length:
            return f"{link}+{push}"
        damp = f"exp(-0.25*chain_h*link{k + 2})"
        return f"({link}*{damp}+{push})*{damp}"

    def _links(self) -> list[str]:
        return [f"link{k + 1}" for k in range(self.length)]

    def _state(self) -> list[str]:
        return [*self._links(), "chain_place"]

    # -- a run ----------------------------------------------------------------------------------

    def ready(self, integrator: Integrator, context: openmm.Context, masses: FloatArray, v: FloatArray) -> None:
        self.check_timestep(float(integrator.getStepSize()._value))
        integrator.program.set("momenta", self.count(integrator))

    # -- what can be read -----------------------------------------------------------------------

    def settings(self) -> dict[str, float]:
        return {"kT": GAS_CONSTANT * self.temperature, "frequency": self.frequency}

    def conserved_energy(self, integrator: Integrator) -> float:
        """Energy of the System and of the chain in kJ/mol; its fluctuation is of order dt^2."""
        energy = energy_of(integrator.context, integrator.getIntegrationForceGroups())
        energy += integrator.kinetic_energy().value_in_unit(unit.kilojoule_per_mole)
        kT, read = self.settings()["kT"], integrator.getGlobalVariableByName
        speeds = np.array([read(name) for name in self._links()])
        weights = np.ones(self.length)
        weights[0] = self.count(integrator)
        inertia = kT / self.frequency**2
        return float(energy + 0.5 * inertia * (weights @ speeds**2) + kT * read("chain_place"))


class NoseHooverMiddle(BetweenHalves, NoseHoover):
    """The same chain in the middle of the drift, for `ProjectedIntegrator(ensemble=...)`: take it for large time steps.

    Half a kick, half a drift along the constraints, a step of the chain, half a drift, half a kick. At the ends of
    steps of length h, K of a harmonic vibration of frequency omega is too low by a part (omega h)^2/4 beside that of
    its configurations, with any integrator of this kind. `NoseHoover` acts there: it makes K right and configurations
    too warm. In the middle both are right. The reported temperature is that of the ends of steps, and too low.

    Parameters
    ----------
    temperature, frequency, length, momentum
        As for `NoseHoover`.

    Notes
    -----
    Scheme: 'rattle'. Velocities are made tangent to the constraints once more a step than with `NoseHoover`.

    References
    ----------
    Zhang, Liu, Yan, Tuckerman and Liu, J. Phys. Chem. A 123, 6056 (2019).
    """

    adds_up = owes = False

    def open(self, p: Program) -> None:
        self._remember(p)

    def close(self, p: Program) -> None:
        pass

    def middle(self, p: Program, u: str) -> None:
        p.each("v", u, "the constraint forces act on v as well")
        p.project()
        self._advance(p, "2")


def _per_picosecond(frequency: unit.Quantity | float) -> float:
    value: Any = frequency
    if unit.is_quantity(value) and value.unit.is_compatible(unit.picosecond):
        value = 1 / value
    return number(value, unit.picosecond**-1, "frequency")
