"""Geodesic Langevin dynamics in OpenMM: friction and noise in the tangent plane, in the middle of the drift."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import openmm
from openmm import unit

from kcons.errors import InputError, UnsupportedError
from kcons.openmm.ensemble import ConstantEnergy
from kcons.openmm.isokinetic import GAS_CONSTANT, kelvins
from kcons.openmm.program import Program
from kcons.steppers.splitting import Splitting

if TYPE_CHECKING:
    from kcons.openmm.projected import ProjectedIntegrator


class Langevin(ConstantEnergy):
    """Canonical ensemble, for `ProjectedIntegrator(ensemble=...)`: half a kick, half a drift along the constraints,

        v = P (exp(-gamma h) v + sqrt((1 - exp(-2 gamma h)) kT/m) noise),    P = M_par^+ M,

    half a drift, half a kick (g-BAOAB). One force evaluation a step. `setRandomNumberSeed` of the integrator makes
    a run reproducible, as far as the platform's forces are.

    Parameters
    ----------
    temperature : Quantity or float
        In K if a float.
    friction : Quantity or float
        gamma in 1/ps if a float; 0 for none.

    Raises
    ------
    InputError
        A temperature that is not above zero, a friction below.

    Notes
    -----
    Scheme: 'rattle'. For virtual sites use openmm.LangevinMiddleIntegrator.

    References
    ----------
    Leimkuhler and Matthews, Proc. R. Soc. A 472, 20160138 (2016).
    """

    halves = True
    adds_up = False

    def __init__(self, temperature: unit.Quantity | float, friction: unit.Quantity | float) -> None:
        self.temperature = kelvins(temperature)
        if unit.is_quantity(friction):
            friction = friction.value_in_unit(unit.picosecond**-1)  # type: ignore[union-attr]
        self.friction = float(friction)  # type: ignore[arg-type]
        if not 0 <= self.friction < float("inf"):
            raise InputError(f"friction is {friction}; give a number in 1/ps, not below zero", item="friction")

    def __repr__(self) -> str:
        return f"Langevin({self.temperature:g} K, {self.friction:g}/ps)"

    def check(self, scheme: Splitting | None) -> None:
        """Raise `UnsupportedError` for all schemes but 'rattle'."""
        if scheme is None:
            raise UnsupportedError(
                "Langevin needs velocities at the time of the positions, and those of the leapfrog are half a step "
                "behind; for virtual sites use openmm.LangevinMiddleIntegrator"
            )
        if scheme.kicks != (0.5, 0.5) or scheme.drifts != (1.0,) or scheme.flight != (1.0,):
            raise UnsupportedError(f"Langevin splits the drift of scheme='rattle' in two; {scheme!r} has another form")

    def declare(self, program: Program) -> None:
        program.number("kT", "Boltzmann's constant times the temperature, kJ/mol", GAS_CONSTANT * self.temperature)
        program.number("friction", "1/ps", self.friction)
        program.number("kept_share", "what friction leaves of v in a step")
        program.number("spread", "size of the noise")

    def middle(self, program: Program, impulse: str, project: Callable[[], None]) -> None:
        p = program
        p.let("kept_share", "exp(-friction*dt)", "friction")
        # 1 - exp(-2y) = 2 exp(-y) sinh(y) loses no digits for small y.
        p.let("spread", "sqrt(2*kT*kept_share*sinh(friction*dt))", "noise")
        p.each("v", f"kept_share*(v+{impulse})+spread*gaussian/sqrt(m)", "constraint forces, friction and noise act")
        project()

    def set_temperature(self, integrator: ProjectedIntegrator, temperature: float) -> None:
        self.temperature = temperature
        integrator.setGlobalVariableByName("kT", GAS_CONSTANT * temperature)

    def begin(self, integrator: ProjectedIntegrator, context: openmm.Context) -> None:
        self.set_temperature(integrator, self.temperature)
