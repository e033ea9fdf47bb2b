"""An integrator's view of the Context it belongs to: checks before and during a run, and the way back."""

from __future__ import annotations

import gc
import weakref
from typing import TYPE_CHECKING, Any

import numpy as np
import openmm

from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError, NonFiniteError
from kcons.openmm.system_checks import SystemRows, check_system, removes_centre_of_mass_motion

if TYPE_CHECKING:
    from kcons.openmm.projected import ProjectedIntegrator

#: Starts that are off by less (relative) are tidied up: what a looser tolerance or single precision leaves.
TIDY = 1e-4
#: What rounding may add to a relative distance, near the origin.
_ROUNDING = 1e-12
_REMEDY = "let kcons hold these constraints: take them out of the System and hand them over as constraint objects"


def find_context(integrator: openmm.Integrator) -> openmm.Context | None:
    """The Context that was made with this integrator, alone or within a CompoundIntegrator."""
    address = int(integrator.this)
    for thing in gc.get_objects():
        if issubclass(type(thing), openmm.Context):
            owner = getattr(thing, "_integrator", None)
            if owner is integrator:
                return thing
            if isinstance(owner, openmm.CompoundIntegrator):
                parts = (owner.getIntegrator(k) for k in range(owner.getNumIntegrators()))
                if any(int(part.this) == address for part in parts):
                    return thing
    return None


# A State is in nm and ps whatever else is in use: _value spares the conversion, which takes longer than small Systems.


def positions_of(context: openmm.Context) -> FloatArray:
    return np.asarray(context.getState(positions=True).getPositions(asNumpy=True)._value)


def velocities_of(context: openmm.Context) -> FloatArray:
    return np.asarray(context.getState(velocities=True).getVelocities(asNumpy=True)._value)


def _box(context: openmm.Context) -> Any:
    return context.getState().getPeriodicBoxVectors()._value


class Guard:
    """Watches over one Context.

    Parameters
    ----------
    context : openmm.Context
    integrator : ProjectedIntegrator

    Raises
    ------
    UnsupportedError
        The System cannot be propagated, see `check_system`.
    """

    def __init__(self, context: openmm.Context, integrator: ProjectedIntegrator) -> None:
        self._context = weakref.ref(context)
        self._integrator = weakref.ref(integrator)
        self.system = context.getSystem()
        check_system(self.system, leapfrog=integrator.scheme is None)
        self.rows = SystemRows.of(self.system)
        #: Whether something in the System moves x between steps.
        self.moving = any("Barostat" in type(force).__name__ for force in self.system.getForces())
        #: Whether velocities may lack half a kick and a projection while nobody looks: a thermostat would.
        self.undisturbed = not any(isinstance(force, openmm.AndersenThermostat) for force in self.system.getForces())
        self.started = False
        self.since_check = 0
        self._surroundings: tuple[object, ...] | None = None
        self._good: openmm.State | None = None
        self._freedom: int | None = None
        self._left: tuple[int, Any] | None = None

    @property
    def alive(self) -> openmm.Context | None:
        return self._context()

    @property
    def context(self) -> openmm.Context:
        context = self._context()
        assert context is not None
        return context

    @property
    def integrator(self) -> ProjectedIntegrator:
        integrator = self._integrator()
        assert integrator is not None
        return integrator

    # -- constraints of the System --------------------------------------------------------------

    def limit(self, x: FloatArray) -> FloatArray:
        """What each relative residual may be, given the tolerance and the size of the coordinates."""
        reach = np.abs(x[self.rows.pairs]).max(axis=(1, 2), initial=0.0) / self.rows.lengths
        # The tolerance is that of the solver; OpenMM checks the squares of the distances.
        return np.asarray(2 * self.integrator.getConstraintTolerance() + _ROUNDING + 4e-16 * reach)

    def check_rows(self, x: FloatArray, step: int | None) -> None:
        """Raise if a constraint of the System is not fulfilled at positions x."""
        if not self.rows.n_rows:
            return
        miss = np.abs(self.rows.stretches(x))
        excess = miss / self.limit(x)
        row = int(np.argmax(excess))
        if not excess[row] <= 1:  # also NaN
            tolerance = self.integrator.getConstraintTolerance()
            raise ConvergenceError(
                f"{self.rows.name(row)} is off by {miss[row]:.3g} (relative), at a tolerance of {tolerance:g}: the "
                f"solvers of OpenMM did not converge and do not tell. Take a smaller time step, or {_REMEDY}",
                residual=float(miss[row]),
                tolerance=tolerance,
                row=int(self.rows.numbers[row]),
                atoms=self.rows.pairs[row],
                step=step,
            )

    def begin(self) -> None:
        """Before the first step: positions and velocities on the constraints.

        Raises
        ------
        InputError
            Positions are off the constraints by more than `TIDY`.
        NonFiniteError
            A NaN or infinity in positions or velocities.
        KconsError
            What a part finds wrong.
        """
        context, integrator = self.context, self.integrator
        x, v = positions_of(context), velocities_of(context)
        _check_finite(x, v, context.getStepCount(), False)
        if self.rows.n_rows:
            miss = np.abs(self.rows.stretches(x))
            row = int(np.argmax(miss))
            if not miss[row] <= TIDY:
                raise InputError(
                    f"{self.rows.name(row)} is off by {miss[row]:.3g} (relative) at the start; minimise the energy or "
                    "call integrator.applyConstraints(context) first",
                    item="positions",
                    atoms=self.rows.pairs[row],
                )
        try:
            if np.any(np.abs(self.rows.stretches(x)) > self.limit(x)):
                context.applyConstraints(integrator.getConstraintTolerance())
                x = positions_of(context)
                self.check_rows(x, None)
            self._make_tangent(x, v)
            for part in integrator.parts:
                part.check(context)
            integrator.ensemble.begin(integrator, context)
        except Exception:
            context.setVelocities(v)
            raise
        self.started = True
        self._remember(context.getState(positions=True, velocities=True))

    def _make_tangent(self, x: FloatArray, v: FloatArray) -> None:
        """Project velocities that were set from outside; those of a run that is continued stay bit for bit."""
        integrator = self.integrator
        if integrator.scheme is None:
            # What is taken away here the first drift would take away: the leapfrog's way is the same, but the first
            # impulse, which enters the kinetic energy, is that of a smooth motion.
            off = not np.any(np.asarray(integrator.getPerDofVariableByName("impulse")))
        elif integrator.parts:
            off = bool(integrator.getGlobalVariableByName("stale"))
        else:
            speeds = np.abs(self.rows.stretching_speeds(x, v))
            off = bool(np.any(speeds > 10 * integrator.getConstraintTolerance() + _ROUNDING))
        if off:
            integrator.applyVelocityConstraints(self.context)

    # -- between and after steps ----------------------------------------------------------------

    def surroundings_changed(self) -> bool:
        """Whether parameters or the box were changed since the last call: forces that were kept are old then."""
        context = self.context
        now = (dict(context.getParameters()), _box(context))
        before, self._surroundings = self._surroundings, now
        return before is not None and before != now

    def note_surroundings(self) -> None:
        self.surroundings_changed()

    def meet_others(self) -> None:
        """Make OpenMM compute forces anew if since the last step the box was changed, or others have made steps.

        It keeps the forces of a CustomIntegrator whatever happens to the box, and whatever the other integrators of a
        CompoundIntegrator do to x.
        """
        context = self.context
        if self._left is not None and self._left != (context.getStepCount(), _box(context)):
            context.setVelocities(velocities_of(context))

    def leave(self) -> None:
        """A call of `step` ends."""
        context = self.context
        self._left = context.getStepCount(), _box(context)

    def count(self, steps: int) -> None:
        """Count steps; check where a check is due.

        Raises
        ------
        ConvergenceError, NonFiniteError
            The Context is put back to where it was checked last.
        """
        self.since_check += steps
        if self.integrator.check_every and self.since_check >= self.integrator.check_every:
            self.check()

    def check(self) -> None:
        """Positions and velocities finite, the constraints of the System fulfilled, or back to where they were."""
        context = self.context
        step = context.getStepCount()
        try:
            self.integrator.ensemble.verify(self.integrator)
            now = context.getState(positions=True, velocities=True)
            x = np.asarray(now.getPositions(asNumpy=True)._value)
            _check_finite(x, np.asarray(now.getVelocities(asNumpy=True)._value), step, self.rows.n_rows > 0)
            self.check_rows(x, step)
        except (ConvergenceError, NonFiniteError):
            self.put_back()
            raise
        self._remember(now)

    def _remember(self, now: openmm.State) -> None:
        self.since_check = 0
        self._good = now

    def put_back(self) -> None:
        """The state that was checked last."""
        if self._good is not None:
            good, context = self._good, self.context
            context.setPeriodicBoxVectors(*good.getPeriodicBoxVectors())
            context.setPositions(good.getPositions(asNumpy=True))
            context.setVelocities(good.getVelocities(asNumpy=True))
            context.setTime(good.getTime())
            context.setStepCount(good.getStepCount())
            self.since_check = 0
            self.integrator.refresh()

    def explosion(self, words: str, step: int) -> NonFiniteError:
        """The error for a NaN that OpenMM met after `step`, once the state is put back."""
        solver = f". Where the solvers of OpenMM diverge, {_REMEDY}" if self.rows.n_rows else ""
        return NonFiniteError(
            f"{words} It appeared after step {step}; positions and velocities are those of step "
            f"{self.context.getStepCount()}. Take a smaller time step, or minimise the energy first{solver}",
            item="position",
            step=step,
        )

    # -- degrees of freedom ---------------------------------------------------------------------

    def independent_momenta(self) -> int:
        """Three for each particle with a mass, less the rank of all constraints."""
        if self._freedom is None:
            moving = 3 * int(np.sum(self.rows.masses > 0))
            held = self.rows.rank(positions_of(self.context))
            held += sum(part.rank(self.context) for part in self.integrator.parts)
            self._freedom = moving - held
        return self._freedom

    def degrees_of_freedom(self) -> int:
        """Also less three where a CMMotionRemover acts."""
        return self.independent_momenta() - (3 if removes_centre_of_mass_motion(self.system) else 0)


def _check_finite(x: FloatArray, v: FloatArray, step: int, held: bool) -> None:
    for array, item in ((x, "position"), (v, "velocity")):
        bad = ~np.isfinite(array).all(axis=1)
        if bad.any():
            atom = int(np.argmax(bad))
            solver = f". Where the solvers of OpenMM diverge, {_REMEDY}" if held else ""
            raise NonFiniteError(
                f"the {item} of particle {atom} is not finite at step {step}; take a smaller time step, or minimise "
                f"the energy first{solver}",
                item=item,
                atom=atom,
                step=step,
            )
