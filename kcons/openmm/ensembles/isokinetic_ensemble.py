"""The Gaussian isokinetic thermostat in OpenMM: kicks in closed form that keep the kinetic energy."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import openmm
from openmm import unit

from kcons.constraints.arguments import checked, positive
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError, OverdeterminedError, UnsupportedError
from kcons.openmm.ensembles.conserved_momenta import CountsMomenta, Momentum
from kcons.openmm.integrator.part import Precision
from kcons.openmm.integrator.program import Integrator, Program
from kcons.openmm.quantities import GAS_CONSTANT, energy_of, kelvins
from kcons.steppers.operations import Kick, Operation, Project, Turn
from kcons.steppers.splitting import Composition, RungeKuttaNystrom, Splitting
from kcons.thermostats.freedom import FEW

#: Relative difference from the kinetic energy wanted at the start that is taken for rounding, by precision: a run that
#: is continued stays as it is, bit for bit.
ROUNDING = {"double": 1e-12, "mixed": 1e-7, "single": 1e-6}
#: Where velocities run against a strong force, s' is a small difference; below this, digits are lost.
_CANCELS = 1e-4


class Isokinetic(CountsMomenta):
    """Constant kinetic energy, for `ProjectedIntegrator(ensemble=...)`.

    Configurations are canonical at T for 2K = (g - 1) kT, g being the independent momenta: three for each particle
    with a mass, less the rank of all constraints, less three where total momentum is conserved. A kick at fixed
    positions has the closed form of `kcons.thermostats.isokinetic` with F = M_par^+ f.

    Parameters
    ----------
    temperature : Quantity or float, optional
        In K if a float. Without, K stays what it is at the first step.
    convention : {'exact', 'notes'}
        2K = (g - 1) kT, or 2K = 3 n kT of the notes (eq. 111) for n particles with a mass.
    momentum : {'auto', 'conserved', 'free'}
        Whether total momentum is conserved. 'auto' looks at the kinds of forces, and computes those that may know a
        place in space.

    Raises
    ------
    InputError
        Temperature not positive, unknown words.

    Warns
    -----
    UserWarning
        At the first step: total momentum is conserved and not zero, the System is a free cluster, on which no torque
        acts, or g is 2. None of these samples a temperature.

    Notes
    -----
    Schemes: 'rattle', 'geodesic' (order 2), 'isokinetic4' and 'isokinetic6'. Targets must rest.

    References
    ----------
    See `kcons.thermostats.Isokinetic`.
    """

    stays_tangent = True
    adds_up = True
    few = FEW
    temperature: float | None
    convention: Literal["exact", "notes"]
    momentum: Momentum

    @checked
    def __init__(
        self,
        temperature: unit.Quantity | float | None = None,
        *,
        convention: Literal["exact", "notes"] = "exact",
        momentum: Momentum = "auto",
    ) -> None:
        self._keep(
            temperature=None if temperature is None else positive(kelvins(temperature), "temperature"),
            convention=convention,
            momentum=momentum,
        )

    def __repr__(self) -> str:
        given = [f"{self.temperature:g} K"] if self.temperature is not None else []
        if self.convention != "exact":
            given.append(f"convention={self.convention!r}")
        return f"Isokinetic({', '.join(given)})"

    def check(self, scheme: Splitting) -> None:
        """Raise `UnsupportedError` for schemes whose order is lost with kicks that are quadratic in v."""
        if isinstance(scheme, RungeKuttaNystrom) or (isinstance(scheme, Composition) and scheme.order > 2):
            raise UnsupportedError(
                f"{scheme!r} loses its order with the isokinetic thermostat, whose kicks are not linear; use "
                "'isokinetic4' or 'isokinetic6'"
            )

    def operations(self, scheme: Splitting) -> tuple[Operation, ...]:
        """The kicks of the scheme turn velocities, which are tangent before and stay so."""
        done: list[Operation] = []
        for operation in scheme.operations():
            if isinstance(operation, Kick):
                done += [Project(), Turn(operation.fraction)]
            elif not (isinstance(operation, Project) and isinstance(done[-1], Turn)):
                done.append(operation)
        return tuple(done[isinstance(done[0], Project) :])

    # -- program --------------------------------------------------------------------------------

    def declare(self, p: Program) -> None:
        p.setting("two_k", "2K, kept; 0 until the first step", 0.0)
        p.setting("exact", "whether v is made tangent before unseen kicks, and 2K summed", 0.0)
        p.remember("growth", "integral of alpha over time")
        p.number("lost", "kicks that turned velocities round and lost digits")

    def kick(self, p: Program, h: str, impulse: str = "", tangent: bool = False, unseen: bool = False) -> str:
        """v = (v + s F)/s' of the closed form, everything divided by exp(z); see `kcons.thermostats.isokinetic`.

        F = M_par^+ f only enters as q = h F, which is of the size of velocities.
        """
        q = f"{h}*{p.force}/m"
        if unseen:
            _add_up(p, q, f"{h}*{p.force}*v")
        else:
            if impulse:
                p.each("v", f"v+{impulse}", "the constraint forces act on v as well")
            if impulse or not tangent:
                p.project()
            p.each("w", "v", "velocities before the kick")
            p.each("v", q, "kick by the applied forces alone")
            p.project()
            p.sum("wq", "m*w*v", "along the kick")
            p.sum("ww", "m*w*w", "2K before")
            p.sum("qq", "m*v*v", "size of the kick")
        p.let("z", "max(sqrt(qq/two_k), 1e-300)", "strength of the kick; 1e-300 keeps 0/0 away")
        p.let("aim", "min(max(wq/sqrt(max(ww*qq, 1e-300)), -1), 1)", "direction of the kick")
        p.let("decay", "exp(-z)", "all is divided by exp(z)")
        # sinh is exact near 0, where 1 - exp(-2z) is not.
        p.let("sinhc", "select(step(z-1), 0.5*(1-decay^2), decay*sinh(min(z, 1)))/z", "closed form")
        p.let("coshc", "0.5*(select(step(z-1), 1-decay, 2*exp(-0.5*z)*sinh(0.5*min(z, 1)))/z)^2", "closed form")
        p.let("scale", "max(aim*z*sinhc+0.5*(1+decay^2), 1e-300)", "closed form")
        p.let("lost", f"lost+step({_CANCELS!r}-scale)", "count what cannot be trusted")
        p.let("growth", "growth+z+log(scale)", "alpha over time")
        # Drifts change the length of velocities at their order; sqrt(two_k/ww) brings it back.
        p.let("keep", "sqrt(two_k/ww)*decay/scale", "share of the velocities")
        p.let("push", "(aim*z*coshc+sinhc)/scale", "share of the kick")
        return f"keep*v+(push-keep)*{q}" if unseen else "keep*w+push*v"

    # -- a run ----------------------------------------------------------------------------------

    def ready(self, integrator: Integrator, context: openmm.Context, masses: FloatArray, v: FloatArray) -> None:
        """Find K; scale the velocities, unless they are right to rounding.

        `InputError` for a start at rest, `OverdeterminedError` for g of 1 where a temperature is asked for, or 0.
        """
        found = float(masses @ np.einsum("ij,ij->i", v, v))
        if not found > 0:
            raise InputError(
                "the isokinetic thermostat needs non-zero kinetic energy: call "
                "integrator.setVelocitiesToTemperature(context, T) first",
                item="velocities",
            )
        twice = self._twice_kinetic(integrator, masses, found)
        precision = Precision.of(context).name
        integrator.program.set("two_k", twice)
        # Drifts keep the 2K of rigid bodies, and rounding is larger than what they change where it is not double.
        rigid = integrator._watch().rows.rigid
        integrator.program.set("exact", float(precision == "double" and not rigid))
        if abs(found / twice - 1) > ROUNDING[precision]:
            context.setVelocities(np.where(masses[:, None] > 0, v * math.sqrt(twice / found), v))

    def verify(self, integrator: Integrator) -> None:
        """Raise `ConvergenceError` if kicks have lost digits."""
        if integrator.getGlobalVariableByName("lost"):
            integrator.program.write("lost", 0.0)
            raise ConvergenceError(
                "a kick turned all velocities round against a force that stops them many times over within the "
                "step, and lost digits; take a smaller time step"
            )

    def _twice_kinetic(self, integrator: Integrator, masses: FloatArray, found: float) -> float:
        count = self.count(integrator)
        if self.temperature is None:
            return found
        if self.convention == "notes":
            return 3 * int(np.sum(masses > 0)) * GAS_CONSTANT * self.temperature
        if count < 2:
            raise OverdeterminedError(
                "g - 1 = 0: isokinetic temperature undefined for a single degree of freedom; leave out the "
                "temperature, or use Langevin",
                rows=(),
            )
        return (count - 1) * GAS_CONSTANT * self.temperature

    # -- what can be read -----------------------------------------------------------------------

    def warmth(self, integrator: Integrator) -> float:
        """2 K/(g k) times this is the temperature of the configurations."""
        count = self.count(integrator)
        return 1.0 if count < 2 else integrator.degrees_of_freedom() / (count - 1)

    def follow(self, integrator: Integrator) -> None:
        """Kicks scale the velocities from the next step on."""
        guard = integrator._guard
        if guard is not None and guard.alive is not None and guard.started:
            twice = self._twice_kinetic(integrator, guard.rows.masses, 0.0)
            integrator.program.set("two_k", twice)

    def conserved_energy(self, integrator: Integrator) -> float:
        """U + 2K int(alpha dt), conserved; kJ/mol."""
        heat = integrator.getGlobalVariableByName("two_k") * integrator.getGlobalVariableByName("growth")
        return energy_of(integrator.context, integrator.getIntegrationForceGroups()) + heat


def _add_up(p: Program, q: str, along: str) -> None:
    """Make v w + q, and find the lengths of a kick that is not seen, without telling w and q apart.

    w + q is v + h f/m made tangent; what v has across the constraints the next drift absorbs. Unless `exact`, v is not
    made tangent between such kicks, and w.M.w is taken to be 2K, which drifts keep to third order (rigid bodies: to
    rounding); the length of w + q shows what it is off by, and the kick takes that back.
    """
    p.let("ww", "two_k", "2K before, as drifts keep it")
    with p.when("select(behind, exact, 1) != 0", "to rounding; v may have been changed by whom ever"):
        p.sum("ww", "m*v*v", "2K before")
    p.each("v", f"v+{q}", "the applied forces act")
    p.project()
    p.sum("wq", "m*v*v", "(w+q).M.(w+q)")
    p.sum("qq", along, "q.M.(w+q)")
    p.let("wq", "wq-qq-ww", "along the kick")
    p.let("qq", "max(qq-wq, wq^2/ww)", "size of the kick")
