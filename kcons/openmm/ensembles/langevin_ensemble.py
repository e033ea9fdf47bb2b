"""Geodesic Langevin dynamics in OpenMM: friction and noise in the tangent plane, in the middle of the drift."""

from __future__ import annotations

import openmm
from openmm import unit

from kcons.errors import InputError, UnsupportedError
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.steps import Ensemble, Integrator, Step
from kcons.openmm.integrator.system_checks import warn_of_barostat
from kcons.openmm.quantities import GAS_CONSTANT, kelvins, number
from kcons.steppers.operations import Evaluate, Exchange, Kick, Operation, Project, drifts_of
from kcons.steppers.splitting import Splitting


class Langevin(Ensemble):
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

    adds_up = True
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

    def check(self, scheme: Splitting | None) -> None:
        """Raise `UnsupportedError` for all schemes but 'rattle'."""
        if scheme is None:
            raise UnsupportedError(
                "Langevin needs velocities at the time of the positions, and those of the leapfrog are half a step "
                "behind; use scheme='rattle'"
            )
        if scheme.kicks != (0.5, 0.5) or scheme.drifts != (1.0,) or scheme.flight != (1.0,):
            raise UnsupportedError(f"Langevin splits the drift of scheme='rattle' in two; {scheme!r} has another form")

    def operations(self, scheme: Splitting | None) -> tuple[Operation, ...]:
        """Friction and noise act between two halves of the drift."""
        first, second = drifts_of((0.5, 0.5))
        return (Kick(0.5), first, Exchange(1.0), second, Evaluate(), Kick(0.5), Project())

    def declare(self, program: Program) -> None:
        kT, friction = self.settings().values()
        program.setting("kT", "Boltzmann's constant times the temperature, kJ/mol", kT)
        program.setting("friction", "1/ps", friction)
        program.number("kept_share", "what friction leaves of v in a step")
        program.number("spread", "size of the noise")

    def middle(self, step: Step, u: str) -> None:
        p = step.program
        p.let("kept_share", "exp(-friction*dt)", "friction")
        # 1 - exp(-2y) = 2 exp(-y) sinh(y) loses no digits for small y.
        p.let("spread", "sqrt(2*kT*kept_share*sinh(friction*dt))", "noise")
        p.each("v", f"kept_share*({u})+spread*gaussian/sqrt(m)", "constraint forces, friction and noise act")
        if step.parts:
            # Multipliers are those of the drifts: what noise has across the constraints is none of theirs.
            step.project()

    def begin(self, integrator: Integrator, context: openmm.Context) -> None:
        """Compare with a barostat."""
        warn_of_barostat(context, self.temperature, stacklevel=6)

    def settings(self) -> dict[str, float]:
        return {"kT": GAS_CONSTANT * self.temperature, "friction": self.friction}

    def at(self, temperature: float) -> Langevin:
        return Langevin(temperature, self.friction)

    def with_friction(self, friction: unit.Quantity | float) -> Langevin:
        """The same with another friction."""
        return Langevin(self.temperature, friction)
