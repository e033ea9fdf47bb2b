"""Hamiltonian Monte Carlo in OpenMM: the steps of an integrator, accepted or rejected by the change of energy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import openmm
from openmm import app, unit

from kcons.constraints.arguments import Positive, Rng, Share, checked, positive, seed_from, whole_number
from kcons.constraints.target import FloatArray
from kcons.errors import CertificateError, ConvergenceError, NonFiniteError, ReversibilityError, UnsupportedError
from kcons.openmm.integrator.guard import forces_of
from kcons.openmm.integrator.program import ConstantEnergy, Program
from kcons.openmm.integrator.projected import ProjectedIntegrator
from kcons.openmm.quantities import GAS_CONSTANT, energy_of, kelvins, masses_of, motion_of, positions_of, velocities_of
from kcons.steppers import State
from kcons.steppers.splitting import Splitting
from kcons.thermostats import Counts
from kcons.thermostats.monte_carlo import (
    ACCEPTED,
    CHANGE,
    ENERGY,
    IRREVERSIBLE,
    LAST,
    NOT_FINITE,
    POTENTIAL,
    PROPOSAL,
    SIZE,
    SQUARES,
    SUM,
    UNSOLVED,
    step_range,
)
from kcons.thermostats.noise import noise_generator

#: What acts on a state between steps and knows no way back.
OTHERS = ("Barostat", "AndersenThermostat", "CMMotionRemover")


class ReversedDrifts(ConstantEnergy):
    """Constant energy, with the way back of each drift: see `HamiltonianMonteCarlo.reversing_integrator`.

    A kick undoes itself when velocities are turned round, but for what it does across the constraints; only drifts can
    fail to, where their projection finds another solution on the way back. So it is enough to take back drifts, which
    costs projections and no force. Each drift begins with velocities made tangent, which does not change where it has
    to end: so the way back is that of the step from the end, whatever its kicks do across, to the place where solvers
    start.
    """

    def drift(self, p: Program, h: str, u: str) -> str:
        """The drift, taken back and made again."""
        if p.parts:
            raise UnsupportedError(
                "drifts are taken back in steps without parts; give HamiltonianMonteCarlo a ProjectedIntegrator with "
                "these parts, and it takes back whole trajectories"
            )
        p.each("x_begin", "x", "where the drift begins")
        if u != "v":
            p.each("v", u, "the velocities it begins with")
        p.hold_velocities("the drift begins tangent to the constraints, as its way back does")
        p.each("v", f"v+{p.flight(h, 'v')}", "the constraint forces act on v as well")
        p.each("v_land", "v", "to come back to")
        p.each("x_land", "x", "to come back to")
        p.hold_velocities("the way back begins tangent to the constraints")
        p.each("x", f"x-{h}*v", "move back freely")
        p.hold_positions("back onto the constraints of the System")
        p.sum("miss", "(x-x_begin)^2", "how far from where the drift began")
        p.let("missed", "select(step(missed-miss), missed, miss)", "the worst, and what is no number")
        p.each("x", "x_land", "where the drift ends")
        p.hold_positions("the solver of the System takes its directions from here")
        p.each("v", "v_land", "the velocities there")
        return "0"


class HamiltonianMonteCarlo:
    """Canonical sampling on the constraints without any error of the time step.

    A proposal draws velocities on the constraints, makes `steps` steps of the integrator, and is accepted by the change
    of energy over kT; otherwise positions stay, and velocities turn round. The states after the proposals are samples
    of exp(-H/kT) on the constraints, for the energy that the platform computes.

    With an integrator of `HamiltonianMonteCarlo.reversing_integrator(timestep, scheme)` every drift is taken back
    within the step, which costs no force. With a plain `ProjectedIntegrator`, also one that holds parts, the whole
    trajectory is taken back, which takes as many forces again. What cannot be taken back is rejected and counted.

    Parameters
    ----------
    simulation : openmm.app.Simulation or openmm.Context
        With a ProjectedIntegrator at constant energy. The reporters of a Simulation are called as in its own runs; a
        step is a proposal for them.
    temperature : Quantity or float
        In K if a float.
    steps : int or (int, int)
        Time steps of a proposal; with two numbers drawn between them, both included.
    rng : int, numpy.random.Generator or None
        A seed, or what one is drawn from, which `seed` then tells: random numbers are a function of it and of the
        number of the proposal.
    keep : float
        The part of the velocities that a proposal keeps, from 0 to less than 1.
    tolerance : float
        Distance in nm by which a way back may miss its start; other solutions are off by a part of a bond.

    Raises
    ------
    InputError
        Temperature not positive, fewer than one step, `keep` out of range.
    UnsupportedError
        Another integrator, one with an ensemble; parts that move; barostats, AndersenThermostat or
        CMMotionRemover in the System.

    Notes
    -----
    Energies decide, so they have to be good to a part of kT: in single precision those of large systems are not.
    """

    @checked
    def __init__(
        self,
        simulation: app.Simulation | openmm.Context,
        temperature: unit.Quantity | float,
        steps: int | tuple[int, int],
        rng: Rng,
        *,
        keep: Share = 0.0,
        tolerance: Positive = 1e-4,
    ) -> None:
        self.simulation = simulation if isinstance(simulation, app.Simulation) else None
        self.context: openmm.Context = getattr(simulation, "context", simulation)
        self.setTemperature(temperature)
        self.steps = step_range(steps)
        self.seed = seed_from(rng)
        self.keep, self.tolerance = keep, tolerance
        self._look()
        self._held = np.array([math.nan, *[0.0] * (SIZE - 1)])
        #: Proposals so far.
        self.number = 0

    @staticmethod
    def reversing_integrator(
        timestep: unit.Quantity | float, scheme: str | Splitting = "rattle", **arguments: Any
    ) -> ProjectedIntegrator:
        """A ProjectedIntegrator without parts each of whose drifts is taken back, which costs no force.

        Parameters
        ----------
        timestep, scheme, **arguments
            As for `ProjectedIntegrator`.
        """
        return ProjectedIntegrator(timestep, scheme, ensemble=ReversedDrifts(), **arguments)

    # -- what a person asks for -----------------------------------------------------------------

    def setTemperature(self, temperature: unit.Quantity | float) -> None:
        """Use another temperature (K) from now on."""
        self.thermal_energy = GAS_CONSTANT * positive(kelvins(temperature), "temperature")

    @property
    def counts(self) -> Counts:
        """What became of the proposals."""
        return Counts.of(self.state)

    @property
    def state(self) -> State:
        """Positions (nm), velocities (nm/ps), time (ps), number of proposals, and the variables of the sampler."""
        time = self.context.getTime().value_in_unit(unit.picosecond)
        return State(*motion_of(self.context), time, None, self.number, thermostat=self._held.copy())

    def step(self, proposals: int) -> None:
        """Make so many proposals.

        Raises
        ------
        NonFiniteError
            The energy of the state itself is not finite.
        InputError, UnsupportedError
            As for the first step of the integrator.
        """
        self._look()
        for number in range(whole_number(proposals, "proposals", 0)):
            due = [] if self.simulation is None else [r for r in self.simulation.reporters if self._next(r) == 1]
            self._propose(first=number == 0)
            for reporter in due:
                wraps, acting = self._wraps(reporter), self.integrator.getIntegrationForceGroups()
                options = {"groups": acting, "parameters": True, "enforcePeriodicBox": wraps}
                found = self.context.getState(positions=True, velocities=True, forces=True, energy=True, **options)
                reporter.report(self.simulation, found)

    # -- a proposal -----------------------------------------------------------------------------

    def _look(self) -> None:
        """Refuse what cannot be sampled, and read masses, as the Context has them now."""
        self.integrator = _integrator_of(self.context)
        self._masses = masses_of(self.context.getSystem())[:, None]
        self._weights = np.divide(1.0, self._masses, out=np.zeros_like(self._masses), where=self._masses > 0)

    def _propose(self, *, first: bool) -> None:
        """One proposal; before the `first` of a call others may have moved particles, or changed forces."""
        held, context, number = self._held, self.context, self.number + 1
        guard = self.integrator._watch(context)
        guard.enter()  # positions near the constraints are brought onto them
        x, time = positions_of(context), context.getTime()
        if first:
            held[POTENTIAL] = self._potential()
            if not math.isfinite(held[POTENTIAL]):
                raise NonFiniteError(f"the potential energy is {held[POTENTIAL]} at proposal {number}", item="energy")
        random = noise_generator((self.seed, 0), number, PROPOSAL)
        count, threshold = int(random.integers(self.steps[0], self.steps[1] + 1)), math.log1p(-random.random())
        v0 = velocities_of(context)
        try:
            v = self._refreshed(v0, random)
        except BaseException:
            context.setVelocities(v0)
            raise
        potential, change, reason = float(held[POTENTIAL]), math.nan, ACCEPTED
        try:
            potential, change = self._trajectory(x, v, count)
            reason = ACCEPTED if threshold < -change else ENERGY
        except ReversibilityError:
            reason = IRREVERSIBLE
        except (CertificateError, ConvergenceError):
            reason = UNSOLVED
        except NonFiniteError:
            reason = NOT_FINITE
        except BaseException:
            self._put(x, v0, time)
            raise
        held[CHANGE], held[LAST] = change, reason
        held[reason] += 1
        if reason in (ACCEPTED, ENERGY):
            held[SQUARES] += change * change
            held[SUM] += min(1.0, math.exp(-max(change, 0.0)))
        self.number = number
        if reason == ACCEPTED:
            held[POTENTIAL] = potential
            context.setStepCount(number)
            guard.leave()
        else:
            # Velocities of the way there, turned round.
            self._put(x, -v, time + count * self.integrator.getStepSize())

    def _refreshed(self, v: FloatArray, random: np.random.Generator) -> FloatArray:
        """Velocities of which a part is kept and a part drawn, on all constraints; the Context has them."""
        noise = random.standard_normal(v.shape) * np.sqrt((1 - self.keep**2) * self.thermal_energy * self._weights)
        self.context.setVelocities(self.keep * v + noise)
        self.integrator.applyVelocityConstraints(self.context)
        return velocities_of(self.context)

    def _trajectory(self, x: FloatArray, v: FloatArray, count: int) -> tuple[float, float]:
        """Make the steps from (x, v), where the Context is; potential energy at the end, and change of H over kT.

        Raises
        ------
        ReversibilityError, ConvergenceError, NonFiniteError
            There is no such trajectory, or no way back.
        """
        integrator, context = self.integrator, self.context
        reversing = isinstance(integrator.ensemble, ReversedDrifts)
        if reversing:
            integrator.program.write("missed", 0.0)
        integrator.step(count)
        integrator.check(context)
        end = velocities_of(context)
        potential = self._potential()
        kinetic = 0.5 * float((self._masses * (end * end - v * v)).sum())
        change = kinetic + (potential - float(self._held[POTENTIAL]))
        if not math.isfinite(change):
            raise NonFiniteError("the energy is not finite", item="energy")
        if reversing:
            missed = math.sqrt(integrator.getGlobalVariableByName("missed"))
        else:
            there, time = positions_of(context), context.getTime()
            context.setVelocities(-end)
            try:
                integrator.step(count)
            except (CertificateError, ConvergenceError) as error:
                raise ReversibilityError("the trajectory has no way back") from error
            missed = float(np.sqrt(((positions_of(context) - x) ** 2).sum()))
            self._put(there, end, time)
        if not missed <= self.tolerance:
            raise ReversibilityError(f"a way back misses its start by {missed:.3g} nm", residual=missed)
        return potential, change / self.thermal_energy

    def _potential(self) -> float:
        return energy_of(self.context, self.integrator.getIntegrationForceGroups())

    # -- the Context ----------------------------------------------------------------------------

    def _put(self, x: FloatArray, v: FloatArray, time: Any) -> None:
        context = self.context
        context.setPositions(x)
        context.setVelocities(v)
        context.setTime(time)
        context.setStepCount(self.number)
        self.integrator._watch().leave()

    def _next(self, reporter: Any) -> int:
        told = reporter.describeNextReport(self.simulation)
        return int(told["steps"] if isinstance(told, dict) else told[0])

    def _wraps(self, reporter: Any) -> bool:
        """Whether a reporter is given molecules in the box; one that does not say, where the System is periodic."""
        told = reporter.describeNextReport(self.simulation)
        asked = told.get("periodic") if isinstance(told, dict) else (*told, None)[5]
        return bool(self.context.getSystem().usesPeriodicBoundaryConditions() if asked is None else asked)


def _integrator_of(context: openmm.Context) -> ProjectedIntegrator:
    integrator = context.getIntegrator()
    if not isinstance(integrator, ProjectedIntegrator):
        raise UnsupportedError(
            f"{type(integrator).__name__} is no ProjectedIntegrator: make the Context or Simulation with "
            "HamiltonianMonteCarlo.reversing_integrator(0.009, 'blanes-moan4')"
        )
    if not (integrator.scheme.reversible and integrator.scheme.symplectic):
        raise UnsupportedError(f"{integrator!r} makes no reversible steps; use 'rattle' or 'blanes-moan4'")
    if not isinstance(integrator.ensemble, ConstantEnergy):
        raise UnsupportedError(f"{integrator.ensemble!r} has no energy to accept or reject by; leave out ensemble")
    for part in (part for part in integrator.parts if part.driven):
        raise UnsupportedError(f"{part!r} moves with time: there is no stationary density to sample")
    for force in forces_of(context.getSystem()):
        name = type(force).__name__
        if any(other in name for other in OTHERS):
            raise UnsupportedError(
                f"{name} changes the state between steps, with no way back; take it out of the System"
                + (" (createSystem(removeCMMotion=False))" if name == "CMMotionRemover" else "")
            )
    return integrator
