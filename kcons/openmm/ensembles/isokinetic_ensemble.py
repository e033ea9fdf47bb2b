"""The Gaussian isokinetic thermostat in OpenMM: kicks in closed form that keep the kinetic energy."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import unit

from kcons.constraints.arguments import checked, positive
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError, OverdeterminedError, UnsupportedError
from kcons.openmm.ensembles.conserved_momenta import CountsMomenta, Momentum
from kcons.openmm.integrator.ensemble import Integrator, Step
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program
from kcons.openmm.quantities import GAS_CONSTANT, kelvins, number
from kcons.openmm.states import energy_of, positions_of
from kcons.steppers.operations import Kick, Operation, Project, Turn
from kcons.steppers.splitting import Composition, RungeKuttaNystrom, Splitting
from kcons.thermostats.freedom import atom_numbers

#: Relative difference from the kinetic energy wanted at the start that is taken for rounding, by precision: a run that
#: is continued stays as it is, bit for bit.
ROUNDING = {"double": 1e-12, "mixed": 1e-7, "single": 1e-6}
#: Where velocities run against a strong force, s' is a small difference; below this, digits are lost.
_CANCELS = 1e-4
#: Particles by number, or True and False for each; None for all.
Atoms: TypeAlias = tuple[int, ...] | tuple[bool, ...] | None


class Isokinetic(CountsMomenta):
    """Constant kinetic energy, for `ProjectedIntegrator(ensemble=...)`.

    Configurations are canonical at T for 2K = (g - 1) kT, g being the independent momenta: three for each particle
    with a mass, less the rank of all constraints, less three where total momentum is conserved. A kick at fixed
    positions has the closed form of `kcons.thermostats.isokinetic.kick` with F = M_par^+ f.

    Parameters
    ----------
    temperature : Quantity or float, optional
        In K if a float.
    kinetic_energy : Quantity or float, optional
        K itself, in kJ/mol if a float. With neither, K stays what it is at the first step.
    convention : {'exact', 'notes'}
        2K = (g - 1) kT, or 2K = 3 n kT of the notes (eq. 111) for n particles with a mass.
    atoms : array_like of int or bool, optional
        Thermostat these only. No constraint may couple them to others.
    momentum : {'auto', 'conserved', 'free'}
        Whether total momentum is conserved. 'auto' looks at the kinds of forces, and computes those that may know a
        place in space.

    Raises
    ------
    InputError
        Temperature or energy not positive, both of them, unknown words.

    Warns
    -----
    UserWarning
        At the first step: total momentum is conserved and not zero, or the System is a free cluster, on which no
        torque acts. Neither samples a temperature.

    Notes
    -----
    Schemes: 'rattle', 'geodesic' (order 2), 'isokinetic4' and 'isokinetic6'. Targets must rest.

    References
    ----------
    See `kcons.thermostats.Isokinetic`.
    """

    stays_tangent = True
    adds_up = True
    temperature: float | None
    kinetic_energy: float | None
    convention: Literal["exact", "notes"]
    atoms: Atoms
    momentum: Momentum

    @checked
    def __init__(
        self,
        temperature: unit.Quantity | float | None = None,
        *,
        kinetic_energy: unit.Quantity | float | None = None,
        convention: Literal["exact", "notes"] = "exact",
        atoms: ArrayLike | None = None,
        momentum: Momentum = "auto",
    ) -> None:
        if temperature is not None and kinetic_energy is not None:
            raise InputError("give temperature or kinetic_energy, not both", item="temperature")
        plain = 0.0 if kinetic_energy is None else number(kinetic_energy, unit.kilojoule_per_mole, "kinetic_energy")
        self._keep(
            temperature=None if temperature is None else positive(kelvins(temperature), "temperature"),
            kinetic_energy=None if kinetic_energy is None else positive(plain, "kinetic_energy"),
            convention=convention,
            atoms=None if atoms is None else tuple(np.asarray(atoms).tolist()),
            momentum=momentum,
        )

    def __repr__(self) -> str:
        given = [f"{self.temperature:g} K"] if self.temperature is not None else []
        if self.kinetic_energy is not None:
            given.append(f"K = {self.kinetic_energy:g} kJ/mol")
        if self.convention != "exact":
            given.append(f"convention={self.convention!r}")
        if self.atoms is not None:
            given.append(f"atoms=<{len(self.atoms)} atoms>")
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

    def declare(self, program: Program) -> None:
        p = program
        p.setting("two_k", "2K, kept; 0 until the first step", 0.0)
        p.setting("exact", "whether v is made tangent before unseen kicks, and 2K summed", 0.0)
        p.remember("growth", "integral of alpha over time")
        p.number("lost", "kicks that turned velocities round and lost digits")
        p.vector("w", "velocities before a kick")
        for name, words in (
            ("ww", "w.M.w"),
            ("wq", "w.M.q, q = h M_par^+ f"),
            ("qq", "q.M.q"),
            ("z", "sqrt(q.M.q/2K)"),
            ("aim", "cosine between w and q"),
            ("decay", "exp(-z)"),
            ("sinhc", "exp(-z) sinh(z)/z"),
            ("coshc", "exp(-z) (cosh(z)-1)/z^2"),
            ("scale", "exp(-z) s', by which velocities are divided"),
            ("keep", "share of w"),
            ("push", "share of q"),
        ):
            p.number(name, words)
        if self.atoms is not None:
            p.vector("share", "1 for thermostatted particles, 0 for others")

    def kick(self, step: Step, h: str, impulse: str = "", tangent: bool = False, unseen: bool = False) -> str:
        """v = (v + s F)/s' of the closed form, everything divided by exp(z); see `kcons.thermostats.isokinetic.kick`.

        F = M_par^+ f only enters as q = h F, which is of the size of velocities.
        """
        p, of, q = step.program, "" if self.atoms is None else "share*", f"{h}*{step.force}/m"
        if unseen:
            _add_up(step, of, q, f"{of}{h}*{step.force}*v")
        else:
            if impulse:
                p.each("v", f"v+{impulse}", "the constraint forces act on v as well")
            if impulse or not tangent:
                step.project()
            p.each("w", "v", "velocities before the kick")
            p.each("v", q, "kick by the applied forces alone")
            step.project()
            p.sum("wq", f"{of}m*w*v", "along the kick")
            p.sum("ww", f"{of}m*w*w", "2K before")
            p.sum("qq", f"{of}m*v*v", "size of the kick")
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
        turned, plain = (f"keep*v+(push-keep)*{q}", "v") if unseen else ("keep*w+push*v", "w+v")
        return turned if self.atoms is None else f"select(share, {turned}, {plain})"

    # -- a run ----------------------------------------------------------------------------------

    def ready(self, integrator: Integrator, context: openmm.Context, masses: FloatArray, v: FloatArray) -> None:
        """Find K; scale the velocities, unless they are right to rounding.

        Raises
        ------
        InputError
            All velocities are zero; bad particle numbers.
        OverdeterminedError
            g is 1 where a temperature is asked for, or 0.
        UnsupportedError
            A constraint couples thermostatted particles to others.
        """
        found = float(masses @ np.einsum("ij,ij->i", v, v))
        if not found > 0:
            raise InputError(
                "the isokinetic thermostat needs non-zero kinetic energy: call "
                "integrator.setVelocitiesToTemperature(context, T) first",
                item="velocities",
            )
        twice = self._twice_kinetic(integrator, masses, found)
        if self.atoms is not None:
            share = np.repeat((masses > 0).astype(float)[:, None], 3, axis=1)
            integrator.setPerDofVariableByName("share", share.tolist())
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
        if self.kinetic_energy is not None:
            return 2 * self.kinetic_energy
        if self.temperature is None:
            return found
        if self.convention == "notes":
            return 3 * int(np.sum(masses > 0)) * GAS_CONSTANT * self.temperature
        if count < 2:
            raise OverdeterminedError(
                "g - 1 = 0: isokinetic temperature undefined for a single degree of freedom; give kinetic_energy, or "
                "use Langevin",
                rows=(),
            )
        return (count - 1) * GAS_CONSTANT * self.temperature

    def masses(self, integrator: Integrator) -> FloatArray:
        """Masses of thermostatted particles; 0 for others."""
        masses = super().masses(integrator)
        if self.atoms is None:
            return masses
        inside = np.zeros(len(masses), dtype=bool)
        inside[atom_numbers(np.asarray(self.atoms), len(masses))] = True
        if integrator.parts:
            raise UnsupportedError(
                "a thermostat on some of the particles works with constraints of the System only; leave out parts=, "
                "or thermostat all particles"
            )
        rows = integrator._watch().rows
        first, second = inside[rows.pairs].T
        if np.any(first != second):
            row = int(np.argmax(first != second))
            within, other = sorted(rows.pairs[row].tolist(), key=lambda atom: not inside[atom])
            raise UnsupportedError(
                f"constraint {rows.numbers[row]} of the System couples the thermostatted particle {within} to {other}, "
                "which is not; choose particles such that every constraint is wholly inside or outside"
            )
        return np.where(inside, masses, 0.0)

    def independent(self, integrator: Integrator) -> int:
        if self.atoms is None:
            return super().independent(integrator)
        masses, rows = self.masses(integrator), integrator._watch().rows
        inside = masses[rows.pairs].any(axis=1)
        some = replace(rows, pairs=rows.pairs[inside], lengths=rows.lengths[inside], settled=rows.settled[inside])
        return 3 * int(np.sum(masses > 0)) - some.rank(positions_of(integrator.context))

    # -- what can be read -----------------------------------------------------------------------

    def warmth(self, integrator: Integrator) -> float:
        """2 K/(g k) times this is the temperature of the configurations."""
        count = self.count(integrator)
        if count < 2 or not self.everyone(integrator):
            return 1.0
        return integrator.degrees_of_freedom() / (count - 1)

    def at(self, temperature: float) -> Isokinetic:
        return self.replaced(temperature=temperature, kinetic_energy=None)

    def follow(self, integrator: Integrator) -> None:
        """Kicks scale the velocities from the next step on."""
        guard = integrator._guard
        if guard is not None and guard.alive is not None and guard.started:
            twice = self._twice_kinetic(integrator, self.masses(integrator), 0.0)
            integrator.program.set("two_k", twice)

    def conserved_energy(self, integrator: Integrator) -> float:
        """U + 2K int(alpha dt) in kJ/mol, conserved where all particles are thermostatted."""
        heat = integrator.getGlobalVariableByName("two_k") * integrator.getGlobalVariableByName("growth")
        return energy_of(integrator.context, integrator.getIntegrationForceGroups()) + heat


def _add_up(step: Step, of: str, q: str, along: str) -> None:
    """Make v w + q, and find the lengths of a kick that is not seen, without telling w and q apart.

    w + q is v + h f/m made tangent; what v has across the constraints the next drift absorbs. Unless `exact`, v is not
    made tangent between such kicks, and w.M.w is taken to be 2K, which drifts keep to third order (rigid bodies: to
    rounding); the length of w + q shows what it is off by, and the kick takes that back.
    """
    p = step.program
    p.let("ww", "two_k", "2K before, as drifts keep it")
    with p.when("select(behind, exact, 1) != 0", "to rounding; v may have been changed by whom ever"):
        p.sum("ww", f"{of}m*v*v", "2K before")
    p.each("v", f"v+{q}", "the applied forces act")
    step.project()
    p.sum("wq", f"{of}m*v*v", "(w+q).M.(w+q)")
    p.sum("qq", along, "q.M.(w+q)")
    p.let("wq", "wq-qq-ww", "along the kick")
    p.let("qq", "max(qq-wq, wq^2/ww)", "size of the kick")
