"""Geodesic Langevin dynamics in OpenMM: friction and noise in the tangent plane, in the middle of the drift."""

from __future__ import annotations

from openmm import unit

from kcons.errors import InputError
from kcons.openmm.integrator.ensemble import BetweenHalves, Step
from kcons.openmm.integrator.program import Program
from kcons.openmm.quantities import GAS_CONSTANT, kelvins, number


class Langevin(BetweenHalves):
    """Canonical ensemble, for `ProjectedIntegrator(ensemble=...)`: half a kick, half a drift along the constraints,

        v = P (exp(-gamma h) v + sqrt((1 - exp(-2 gamma h)) kT/m) noise),    P = M_par^+ M,

    half a drift, half a kick (g-BAOAB). One force evaluation a step. `setRandomNumberSeed` of the integrator, before
    its Context is made, makes a run reproducible, as far as the platform's forces are. A value: to change temperature
    or friction of a run, call `setTemperature` and `setFriction` of its integrator. The kinetic energy of a State is
    that of the middle of the step, after friction and noise.

    Parameters
    ----------
    temperature : Quantity or float
        In K if a float; 0 for friction without noise.
    friction : Quantity or float
        gamma in 1/ps if a float; 0 for none.

    Raises
    ------
    InputError
        A temperature or a friction below zero.

    Warns
    -----
    UserWarning
        At the first step: a barostat has another temperature. So do the other ensembles, and `setTemperature`.

    Notes
    -----
    Scheme: 'rattle'.

    References
    ----------
    Leimkuhler and Matthews, Proc. R. Soc. A 472, 20160138 (2016).
    """

    noisy = True
    temperature: float
    friction: float

    def __init__(self, temperature: unit.Quantity | float, friction: unit.Quantity | float) -> None:
        gamma = number(friction, unit.picosecond**-1, "friction")
        if not 0 <= gamma < float("inf"):
            raise InputError(f"friction is {friction}; give a number in 1/ps, not below zero", item="friction")
        self._keep(temperature=kelvins(temperature), friction=gamma)

    def __repr__(self) -> str:
        return f"Langevin({self.temperature:g} K, {self.friction:g}/ps)"

    def declare(self, program: Program) -> None:
        kT, friction = self.settings().values()
        program.setting("kT", "Boltzmann's constant times the temperature, kJ/mol", kT)
        program.setting("friction", "1/ps", friction)
        program.number("kept_share", "what friction leaves of v in a step")
        program.number("spread", "size of the noise")

    def middle(self, step: Step, u: str) -> None:
        friction_and_noise(step.program, u, "dt")
        if step.parts:
            # Multipliers are those of the drifts: what noise has across the constraints is none of theirs.
            step.project()

    def settings(self) -> dict[str, float]:
        return {"kT": GAS_CONSTANT * self.temperature, "friction": self.friction}


def friction_and_noise(program: Program, u: str, h: str) -> None:
    """From velocities u to v, through a bath for a time h."""
    program.let("kept_share", f"exp(-friction*{h})", "friction")
    # 1 - exp(-2y) = 2 exp(-y) sinh(y) loses no digits for small y.
    program.let("spread", f"sqrt(2*kT*kept_share*sinh(friction*{h}))", "noise")
    program.each("v", f"kept_share*({u})+spread*gaussian/sqrt(m)", "constraint forces, friction and noise act")
