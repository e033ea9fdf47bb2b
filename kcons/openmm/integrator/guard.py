"""What an integrator looks at in its Context: before steps, at checks, where a call ends; and the way back."""

from __future__ import annotations

import gc
import logging
import warnings
import weakref
from collections.abc import Iterable
from time import perf_counter
from typing import Any

import numpy as np
import openmm

from kcons.constraints.target import FloatArray
from kcons.errors import CertificateError, ConvergenceError, InputError, KconsError, NonFiniteError, UnsupportedError
from kcons.motion.certificate import MOST, SHARE
from kcons.openmm.integrator.ensemble import Integrator
from kcons.openmm.integrator.part import NEAR, Part, Violation
from kcons.openmm.integrator.precision import SINGLE, Precision
from kcons.openmm.integrator.program import forces_at_old_positions
from kcons.openmm.integrator.system_checks import (
    SystemRows,
    check_system,
    forces_of,
    knows_a_place,
    parts_of_steps,
    refuse_forgotten_parts,
    removes_center_of_mass_motion,
    warn_of_barostat,
)
from kcons.openmm.quantities import held_without_mass
from kcons.openmm.states import box_of, motion_of, positions_of, velocities_of, width_of

logger = logging.getLogger("kcons.openmm")

#: With a note in the log, unless it is what a looser tolerance or single precision leaves.
TIDY = 1e-4
#: Spacing of coordinates, of the length of a row, beyond which a warning is given.
COARSE = 1e-11
#: Speed of light, nm/ps: a System whose particles are faster on average has exploded.
_LIGHT = 299792.458
#: How often OpenMM's solver is asked for positions: that of OpenCL may need a second call from starts that are off.
_CALLS = 4
_REMEDY = "let kcons hold these constraints: take them out of the System and hand them over as constraint objects"


def find_context(integrator: openmm.Integrator) -> openmm.Context | None:
    """The Context that was made with this integrator: the one that refers to it. Asked once for each Context.

    OpenMM tells an integrator nothing of its Context, which has the integrator as an attribute.
    """
    for holder in gc.get_referrers(integrator):
        # Attributes are a dictionary of their own where somebody has asked for it.
        for owner in gc.get_referrers(holder) if type(holder) is dict else [holder]:
            if issubclass(type(owner), openmm.Context) and owner.getIntegrator() is integrator:
                return owner
    return None


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

    def __init__(self, context: openmm.Context, integrator: Integrator) -> None:
        self._context, self._integrator = weakref.ref(context), weakref.ref(integrator)
        self.system = context.getSystem()
        self._size = _size(self.system)
        check_system(self.system)
        self.in_parts = parts_of_steps(context, integrator)  # whether steps are made in parts
        refuse_forgotten_parts(self.system, integrator.row_groups)
        self.precision = precision = Precision.of(context)
        #: The constraints of the System.
        self.rows = SystemRows.of(self.system, rounded=precision.rounds_lengths)
        integrator.take_precision(precision)
        self._refuse_old_positions()
        #: Whether something in the System moves x between steps.
        self.moving = any("Barostat" in type(force).__name__ for force in forces_of(self.system))
        for name, value in (("coarse", precision.name == "single"), ("moving", self.moving)):
            if name in integrator.program.settings:
                integrator.program.set(name, float(value))
        #: Whether velocities may lack half a kick and a projection until they are read: a thermostat reads them, and
        #: a CMMotionRemover, to which half a kick matters where forces add up to something, on what has mass.
        applied = [force for force in forces_of(self.system) if force.getForceGroup() not in integrator.row_groups]
        self.undisturbed = not (
            any(isinstance(force, openmm.AndersenThermostat) for force in applied)
            or (
                removes_center_of_mass_motion(self.system)
                and (any(map(knows_a_place, applied)) or held_without_mass(self.system))
            )
        )
        #: Whether the start was looked at.
        self.started = False
        #: g of the thermostat, and the momenta that are conserved, once they are known.
        self.thermal: int | None = None
        self.momenta: Any = None
        self.since_check = 0
        self._explosive = len(self.rows.masses) * _LIGHT**2
        #: Whether the program sums squares of velocities where a call ends. Reference and CPU would make other noise,
        #: since they draw random numbers with each sum.
        self.sums = precision.rounds_lengths or not integrator.ensemble.noisy
        self._good: openmm.State | None = None
        #: When the last check ended, what it took, and how many were put off since.
        self._checked, self._cost, self._put_off = perf_counter(), 0.0, 0
        self._freedom: int | None = None
        self._left: tuple[Any, ...] | None = None
        self._parameters: dict[str, float] | None = None

    @property
    def alive(self) -> openmm.Context | None:
        return self._context()

    @property
    def context(self) -> openmm.Context:
        context = self._context()
        assert context is not None
        return context

    @property
    def integrator(self) -> Integrator:
        integrator = self._integrator()
        assert integrator is not None
        return integrator

    def _refuse_old_positions(self) -> None:
        """Raise where rows would be computed at old positions."""
        integrator, precision = self.integrator, self.precision
        concerned = integrator.parts and precision.rounds_lengths and self.system.getNumConstraints()
        if concerned and forces_at_old_positions(integrator.program.lines):
            raise UnsupportedError(
                f"{precision} computes these rows at old positions where the System has constraints as well; give "
                "CollectiveRows meets_system=True; with constraint objects take scheme 'rattle' at constant energy or "
                "let kcons hold all constraints (hold(system, ..., take='all', keep_water=False)); or run on the CPU "
                "platform"
            )

    # -- constraints of the System ---------------------------------------------------------------

    def limit(self, x: FloatArray) -> FloatArray:
        """What each relative residual may be, given the tolerance and the size of the coordinates.

        In mixed precision OpenMM rounds positions of molecules that it moves back into the box to single numbers, until
        the next step.
        """
        coarse = self.precision.name == "mixed" and self.system.usesPeriodicBoundaryConditions()
        place = SINGLE if coarse else self.precision.place
        inside = width_of(self.context) if coarse else 0.0
        reach = np.maximum(np.abs(x[self.rows.pairs]).max(axis=(1, 2), initial=0.0), inside) / self.rows.lengths
        # The tolerance is that of the solver; OpenMM checks the squares of the distances. The coordinates of two
        # particles are rounded.
        rounding = self.precision.solvers + 2 * np.sqrt(3) * place * reach
        return np.asarray(2 * self.integrator.getConstraintTolerance() + rounding + self.rows.slack)

    def check_lengths(self, x: FloatArray, step: int | None) -> None:
        """Raise if a constraint of the System is not fulfilled at positions x."""
        if not self.rows.n_rows:
            return
        miss = np.abs(self.rows.stretches(x))
        limit = self.limit(x)
        excess = miss / limit
        row = int(np.argmax(excess))
        if not excess[row] <= 1:  # also NaN
            tolerance = self.integrator.getConstraintTolerance()
            raise ConvergenceError(
                f"{self.rows.name(row)} is off by {miss[row]:.3g} (relative), at a tolerance of {tolerance:g} "
                f"({self.precision}, which holds {limit[row]:.2g}): the solvers of OpenMM did not converge and "
                f"do not tell. Take a smaller time step, or {_REMEDY}",
                residual=float(miss[row]),
                tolerance=tolerance,
                row=int(self.rows.numbers[row]),
                atoms=self.rows.pairs[row],
                step=step,
            )

    def hold_positions(self, tolerance: float) -> None:
        """Bring the positions of the Context onto the constraints of the System."""
        for _ in range(_CALLS):
            self.context.applyConstraints(tolerance)
            x = positions_of(self.context)
            if not self.rows.n_rows or np.all(np.abs(self.rows.stretches(x)) <= self.limit(x)):
                return

    def speed_violation(self, x: FloatArray, v: FloatArray) -> Violation | None:
        """A constraint of the System along which particles move."""
        rows, tolerance = self.rows, self.integrator.getConstraintTolerance()
        if not rows.n_rows:
            return None
        allowed = (10 * tolerance + self.precision.solvers) * rows.speeds_of_one(v)
        allowed += (self.limit(x) + self.precision.speeds) * np.sqrt(np.mean(v * v))
        return Violation.worst("velocities", rows.speeds(x, v), allowed, rows.name, lambda k: rows.pairs[k].tolist())

    # -- calls ----------------------------------------------------------------------------------

    @property
    def knows(self) -> bool:
        """Whether the Context is where the last call left it, as far as clock, box and size of its System tell."""
        context = self._context()
        if context is None or self._size != _size(self.system):
            return False
        return self._left is None or self._left == self._place(context)

    def _place(self, context: openmm.Context) -> tuple[Any, ...]:
        """Where a call ends: step count, box, and the time, where targets depend on it."""
        driven = any(part.driven for part in self.integrator.parts)
        return context.getStepCount(), box_of(context), context.getTime()._value if driven else 0.0

    @property
    def in_run(self) -> bool:
        """Whether a call of `step` has ended, or failed, before this one."""
        return self._left is not None

    def enter(self) -> None:
        """A call of `step` begins."""
        if not self.started:
            self.begin()
        elif self.integrator.parts and self._parameters != dict(self.context.getParameters()):
            self.integrator.refresh()

    def leave(self) -> None:
        """A call of `step` ends."""
        context = self.context
        self._left = self._place(context)
        if self.integrator.parts:
            self._parameters = dict(context.getParameters())

    def begin(self) -> None:
        """Before the first step, and where others have moved x: x and v on the constraints, or refused.

        Raises
        ------
        InputError
            Positions are off the constraints by more than `NEAR`.
        NonFiniteError
            A NaN or infinity in positions or velocities.
        KconsError
            What a part finds wrong.
        """
        context, integrator = self.context, self.integrator
        x, v = motion_of(context)
        check_finite(x, v, context.getStepCount(), False)
        if self.started:
            integrator.refresh()
        else:
            # OpenMM keeps the forces of a CustomIntegrator whatever has happened to the box.
            context.setVelocities(v)
        try:
            for part in integrator.parts:
                part.attach(integrator.program, context)
            self._put_right(x)
            self._make_tangent(velocities_of(context))
            for part in integrator.parts:
                if self.started:
                    self._refuse(part.worst_violation(context))
                else:
                    part.check(context)
            if not self.started:
                self._tell_of_rounding(positions_of(context))
                warn_of_barostat(context, getattr(integrator.ensemble, "temperature", None), stacklevel=5)
                integrator.ensemble.begin(integrator, context)
        except Exception:
            context.setPositions(x)
            context.setVelocities(v)
            raise
        self.started = True
        self._remember(context.getState(positions=True, velocities=True))

    def _tell_of_rounding(self, x: FloatArray) -> None:
        """Warn of coordinates so large that their rounding adds noise to the velocities."""
        for motion in (part.motion for part in self.integrator.parts if hasattr(part, "motion")):
            held = motion.constraint_set
            reach = float(np.abs(x[held.touched]).max(initial=0.0))
            grain = 2 * self.precision.place * reach
            if self.precision.name != "single" and held.n_rows and grain > COARSE * held.scale.min():
                warnings.warn(
                    f"held particles are {reach:.3g} nm from the origin, where OpenMM rounds positions to {grain:.1g} "
                    "nm; each step turns this into velocity, and the energy wanders. Move the origin nearer",
                    stacklevel=5,
                )

    def _put_right(self, x: FloatArray) -> None:
        """Bring positions that are near the constraints onto them."""
        integrator, context = self.integrator, self.context
        miss = np.abs(self.rows.stretches(x))
        row = int(np.argmax(miss)) if len(miss) else 0
        if len(miss) and not miss[row] <= NEAR:
            remedy = "minimize the energy or call integrator.applyConstraints(context)" if x.any() else "set positions"
            raise InputError(
                f"{self.rows.name(row)} is off by {miss[row]:.3g} (relative) at the start; {remedy} first",
                item="positions",
                atoms=self.rows.pairs[row],
            )
        misses = _misses(integrator.parts, context)
        near = bool(misses) and all(found.near for found in misses)  # those that are far are refused later
        if not near and not np.any(miss > self.limit(x)):
            return
        if not near:
            self.hold_positions(integrator.getConstraintTolerance())
            near = not misses and bool(_misses(integrator.parts, context))  # the System pulled them off
        if near:
            integrator.applyConstraints(context)
        now = positions_of(context)
        self.check_lengths(now, None)
        if near or miss[row] > TIDY:
            moved = float(np.sqrt(np.max(np.sum((now - x) ** 2, axis=1))))
            worst = f"{self.rows.name(row)} was off by {miss[row]:.2g} of its length" if len(miss) else ""
            worst = f"the {misses[0]}" if misses else worst
            logger.warning("the start was put right: %s; particles were moved by up to %.3g nm", worst, moved)

    def _refuse(self, miss: Violation | None) -> None:
        if miss is not None:
            raise InputError(
                f"the {miss}. What moved them does not know the rows that are held (OpenMM's minimizer is one: take "
                "integrator.minimizeEnergy); call integrator.applyConstraints(context) and "
                "integrator.applyVelocityConstraints(context)",
                item=miss.what,
                atoms=miss.atoms,
            )

    def _make_tangent(self, v: FloatArray) -> None:
        """Project velocities that were set from outside; those of a run that is continued stay bit for bit."""
        integrator, context = self.integrator, self.context
        off = self.speed_violation(positions_of(context), v) is not None
        if off or any(part.worst_violation(context) is not None for part in integrator.parts):
            integrator.applyVelocityConstraints(context)

    # -- after steps ----------------------------------------------------------------------------

    def look(self) -> None:
        """The end of a call: whether velocities are finite and slower than light, root mean square.

        That is what can be seen at next to no cost.

        Raises
        ------
        ConvergenceError, NonFiniteError
            The Context is put back to where it was checked last.
        """
        v = None if self.sums else velocities_of(self.context)
        squares = self.integrator.getGlobalVariableByName("motion") if v is None else float(np.vdot(v, v))
        if squares <= self._explosive:
            return
        context, held = self.context, self.rows.n_rows > 0
        step, v = context.getStepCount(), velocities_of(context)
        try:
            self.integrator.ensemble.verify(self.integrator)
            check_finite(positions_of(context), v, step, held)
            speeds = np.sqrt(np.einsum("ij,ij->i", v, v))
            atom = int(np.argmax(speeds))
            raise NonFiniteError(
                f"particle {atom} has a velocity of {speeds[atom]:.3g} nm/ps at step {step}: the System has exploded; "
                f"{_smaller_step(held)}",
                item="velocity",
                atom=atom,
                step=step,
            )
        except (ConvergenceError, NonFiniteError) as error:
            self._go_back(error)
            raise

    def count(self, steps: int) -> None:
        """Count steps that were made; check where a check is due.

        Where the integrator may spare them, checks wait while they would take more than `SHARE` of the time.

        Raises
        ------
        CertificateError, ConvergenceError, NonFiniteError
            The Context is put back to where it was checked last.
        """
        self.since_check += steps
        if not 0 < self.integrator.check_every <= self.since_check:
            return
        spare = self.integrator.spare and self._put_off < MOST
        if spare and self._cost > SHARE * (perf_counter() - self._checked):
            self._put_off += 1
            self.since_check = 0
            return
        begun = perf_counter()
        try:
            self.check()
        except (CertificateError, ConvergenceError, InputError, NonFiniteError) as error:
            if isinstance(error, CertificateError):
                error.state = self._good
            self._go_back(error)
            raise
        self._cost = self._checked - begun

    def check(self) -> None:
        """Whether positions and velocities are finite and on all that is held: the state to come back to.

        What is held is asked itself: the constraints of the System and the rows of the parts at the positions and
        velocities of the Context, whatever the solvers have found.

        Raises
        ------
        CertificateError, ConvergenceError, NonFiniteError
        InputError
            Masses were changed after the rows of a part were built.
        """
        context, integrator = self.context, self.integrator
        step = context.getStepCount()
        try:
            integrator.ensemble.verify(integrator)
            now = context.getState(positions=True, velocities=True)
            x = np.asarray(now.getPositions(asNumpy=True)._value)
            v = np.asarray(now.getVelocities(asNumpy=True)._value)
            check_finite(x, v, step, self.rows.n_rows > 0)
            for part in integrator.parts:
                part.check_masses(self.system)
            self.check_lengths(x, step)
            for miss in (self.speed_violation(x, v), *(part.worst_violation(context) for part in integrator.parts)):
                self.certify(miss, f"at step {step} ")
        except (CertificateError, ConvergenceError, NonFiniteError) as error:
            error.step = step
            raise
        self._remember(now)

    def _go_back(self, error: KconsError) -> None:
        """The state that was checked last, and the error says so."""
        if self._good is not None:
            self.put_back()
            good = self.context.getStepCount()
            error.args = (f"{error}. The Context is back at step {good}, the last that was checked", *error.args[1:])

    def certify(self, miss: Violation | None, where: str = "") -> None:
        """Raise `CertificateError` for a miss that the solvers have not told of."""
        if miss is not None:
            raise CertificateError(
                f"{where}the {miss}, allowed {miss.allowed:.3g}. The solvers reported success; take a smaller time "
                "step, or find what else changed the state or the constraints",
                row=miss.row,
                residual=abs(miss.off),
                atoms=miss.atoms,
            )

    def _remember(self, now: openmm.State) -> None:
        self.since_check = self._put_off = 0
        self._good, self._memory = now, self.integrator.program.remembered()
        self._checked = perf_counter()

    def put_back(self) -> None:
        """The state that was checked last."""
        if self._good is not None:
            good, context = self._good, self.context
            context.setPeriodicBoxVectors(*good.getPeriodicBoxVectors())
            context.setPositions(good.getPositions(asNumpy=True))
            context.setVelocities(good.getVelocities(asNumpy=True))
            context.setTime(good.getTime())
            context.setStepCount(good.getStepCount())
            self.integrator.program.recall(self._memory)
            self.integrator.refresh()
            self.since_check = 0
            self.leave()

    def explosion(self, words: str, step: int) -> NonFiniteError:
        """The error for a NaN that OpenMM met after `step`, once the state is put back."""
        remedy = _smaller_step(self.rows.n_rows > 0)
        return NonFiniteError(
            f"{words} It appeared after step {step}; positions and velocities are those of step "
            f"{self.context.getStepCount()}. {remedy[0].upper()}{remedy[1:]}",
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
        return self.independent_momenta() - (3 if removes_center_of_mass_motion(self.system) else 0)


def _size(system: openmm.System) -> tuple[int, int, int]:
    return system.getNumParticles(), system.getNumConstraints(), system.getNumForces()


def _misses(parts: Iterable[Part], context: openmm.Context) -> list[Violation]:
    """Rows whose positions are off, the worst of each part."""
    return [found for part in parts if (found := part.worst_violation(context, velocities=False)) is not None]


def _smaller_step(held: bool) -> str:
    """The remedy for what explodes; `held` where the System has constraints."""
    solver = f". Where the solvers of OpenMM diverge, {_REMEDY}" if held else ""
    return f"take a smaller time step, or minimize the energy first{solver}"


def check_finite(x: FloatArray, v: FloatArray, step: int, held: bool) -> None:
    """Raise `NonFiniteError` for a NaN or infinity; `held` where the System has constraints."""
    for array, item in ((x, "position"), (v, "velocity")):
        finite = np.isfinite(array)
        if not finite.all():
            atom = int(np.argmin(finite.all(axis=1)))
            raise NonFiniteError(
                f"the {item} of particle {atom} is not finite at step {step}; {_smaller_step(held)}",
                item=item,
                atom=atom,
                step=step,
            )
