"""Constraint objects of kcons in a System of OpenMM: PythonForces carry positions to the engine, corrections back.

A PythonForce gets positions and returns forces, both as exact doubles on the CPU and Reference platforms. Three or
four of them, each in a force group of its own, serve one set of rows:

* `remember`: the positions at the start of a drift, where gradients are taken. Returns no force. Left out where the
  last drift has ended there for sure.
* `land`: positions after free flight. Its 'force' is the change that brings them onto the rows, x = x + f.
* `project`: positions x + v/1024 ps. Its 'force' is the change of v that makes it tangent to the rows at x. What
  rounding takes from v on this way follows in a second call, except for thermostats.
* `turn`: where all rows are spheres, drifts may be great circles. `land` computes them, and this tells what they do to
  v, times their length.

Each returns an 'energy' of 0, or 1 where the engine raised an error: nothing may be raised through OpenMM, so the
error is kept and the integrator told to take the step back. Outside of steps they return nothing to speak of: rows
that are fulfilled need no correction.

GPUs keep forces as multiples of 2^-32, and CustomIntegrator reads them divided by 2^32 - 1. In mixed precision
positions are pairs of single numbers, 48 bits: a PythonForce of all particles gets both, one of some particles only the
first. What it returns becomes single numbers: corrections have relative errors up to 6e-8. From the rounded correction
the engine knows the positions in OpenMM, to rounding.

What stays in the System is solved by OpenMM and must not share atoms with rows of kcons. Constraints that share
atoms with each other are solved as one, so that whole clusters of them change hands.
"""

from __future__ import annotations

import uuid
import weakref
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from threading import get_ident
from typing import Any, Literal, Self, cast

import numpy as np
import openmm
from numpy.typing import ArrayLike, NDArray
from openmm import unit

from kcons.constraints import Constraint, Distance
from kcons.constraints.constraint import IntArray, constraints_in
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError, KconsError, NonFiniteError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.motion.report import Report
from kcons.openmm.collective.coordinates import free_groups
from kcons.openmm.integrator.guard import (
    ROW_NAME,
    components,
    forces_of,
    groups_in,
    refuse_agents,
    require_context,
    virtual_sites,
)
from kcons.openmm.integrator.part import NEAR, Part, Precision, Solver, Violation
from kcons.openmm.integrator.program import Integrator, Program
from kcons.openmm.quantities import (
    cell_of,
    forces_at,
    held_pairs,
    masses_of,
    nanometers,
    number,
    positions_of,
    with_massless_atoms,
)
from kcons.openmm.topology import bonds_of
from kcons.steppers.packed_system import spheres_of

#: v is carried as x + v/1024 ps: far less than what makes OpenMM build a new neighbor list, and v is rounded to
#: 1024/ps times the spacing of numbers at x, as much as x itself is rounded in a step of 1 fs. Powers of two cost
#: no digit.
SPEED_SCALE = 1024.0
#: What that takes from v is carried after it, multiplied by this: less than a thousandth of a nanometer at 100 nm from
#: the origin.
LOW_SCALE = 2.0**27

#: Corrections are carried multiplied by this: on GPUs forces are whole multiples of 2^-32.
CARRY_SCALE = 2.0**20
#: What GPUs multiply forces with, and what CustomIntegrator divides them by.
_TO_WHOLE, _FROM_WHOLE = 2.0**32, 2.0**32 - 1

PHASES = ("remember", "land", "project", "turn")
#: Name of the force whose bonds of no strength keep molecules together.
TIES = "kcons molecules"


def move_constraints(system: openmm.System, *, keep_water: bool = True) -> list[Constraint]:
    """Take the constraints out of a System and return them as constraints of kcons.

    Bonds of no strength are added between their atoms, so that the molecules of a Context, which barostats and the
    wrapping of positions go by, stay what they were.

    Parameters
    ----------
    system : openmm.System
        Changed in place, before a Context is made of it.
    keep_water : bool
        Whether rigid water stays with OpenMM, whose SETTLE is fastest there.

    Returns
    -------
    list of Constraint
        A Distance in nm, without those between two particles without mass; empty if there is nothing to take.

    Raises
    ------
    InputError
        No System.
    """
    table = _Table(system)
    return table.release(table.all(keep_water))


def hold(
    system: openmm.System,
    constraints: Constraint | Iterable[Constraint],
    positions: unit.Quantity | ArrayLike,
    *,
    take: Literal["touched", "all"] = "touched",
    keep_water: bool = True,
    periodic: bool | None = None,
    join: bool = False,
    time: unit.Quantity | float = 0.0,
) -> CarriedConstraints:
    """Hold rows of kcons in a System: all that has to be done before its Context is made.

    Constraints of the System that share atoms with the rows move over to kcons, and the forces that carry the rows
    are added.

    Parameters
    ----------
    system : openmm.System
        Changed in place.
    constraints : Constraint or iterable of Constraint
        What is held, in plain numbers of nm, ps, dalton, radian. Empty if only constraints of the System are to move
        over.
    positions : Quantity or array_like, shape (n_particles, 3)
        On or near the constraints, in nm if without unit; targets left at None are taken from them.
    take : {'touched', 'all'}
        Which of the System's constraints move over: those that share atoms with the rows, directly or through others,
        or all.
    keep_water
        As for `move_constraints`; water that a row touches moves over.
    periodic : bool, optional
        Whether rows take minimum images; by default if the System is periodic. Turn it off for rows longer than
        half the box among molecules that are never cut.
    time : Quantity or float
        Time of `positions` in ps, for targets that move.
    join : bool
        Whether molecules that a row connects count as one from now on, for barostats and wrapping. Needed where
        a barostat would move them apart.

    Returns
    -------
    CarriedConstraints
        For ``ProjectedIntegrator(..., parts=[...])``.

    Raises
    ------
    KconsError
        As `CarriedConstraints`. The System was not changed.
    """
    given = constraints_in(constraints, "constraints")
    table = _Table(system)
    if take not in ("touched", "all"):
        raise InputError(f"take is {take!r}; give 'touched' or 'all'", item="take")
    chosen = table.sharing(np.concatenate([*(item.atoms.ravel() for item in given), np.zeros(0, np.int64)]))
    if take == "all":
        chosen |= table.all(keep_water)
    part = CarriedConstraints(system, [*table.rows(chosen), *given], positions, periodic=periodic, time=time)
    # Nothing can fail from here on.
    table.release(chosen)
    for item in given if join else ():
        for before, after in zip(item.atoms.T[:-1], item.atoms.T[1:], strict=True):
            _tie(system, np.stack([before, after], axis=1))
    part.add_to(system)
    return part


# -- what the System holds ------------------------------------------------------------------------


def constraints_about(system: openmm.System, atoms: IntArray) -> list[Constraint]:
    """The constraints of a System in the clusters of some atoms, as a `Distance` in nm; the System keeps them."""
    table = _Table(system)
    return table.rows(table.sharing(atoms))


class _Table:
    """The constraints of a System: pairs (n, 2), lengths in nm (n,); clusters of particles and of constraints."""

    def __init__(self, system: openmm.System) -> None:
        if not isinstance(system, openmm.System):
            raise InputError(
                f"system is a {type(system).__name__}; give the openmm.System, as createSystem makes it", item="system"
            )
        self.system = system
        self.pairs, self.lengths = held_pairs(system)
        self.moving = (masses_of(system)[self.pairs] != 0).any(axis=1)
        self.clusters = components(system.getNumParticles(), self.pairs)
        self.cluster = self.clusters[self.pairs[:, 0]]

    def all(self, keep_water: bool) -> NDArray[np.bool_]:
        """All, or all but those of molecules that are a triangle of constraints and nothing else."""
        rows = np.bincount(self.cluster, minlength=len(self.clusters))[self.cluster]
        return (rows != 3) | (np.bincount(self.clusters)[self.cluster] != 3) | (not keep_water)

    def sharing(self, atoms: IntArray) -> NDArray[np.bool_]:
        """Constraints of the clusters that these atoms belong to; what is no particle is told later."""
        return np.asarray(np.isin(self.cluster, self.clusters[atoms[atoms < len(self.clusters)]]))

    def rows(self, chosen: NDArray[np.bool_]) -> list[Constraint]:
        """Without those between two particles without mass, which OpenMM ignores."""
        chosen = chosen & self.moving
        return [Distance(self.pairs[chosen], self.lengths[chosen])] if chosen.any() else []

    def release(self, chosen: NDArray[np.bool_]) -> list[Constraint]:
        """Remove constraints, which are returned, and keep their atoms together by bonds of no strength."""
        for k in np.flatnonzero(chosen)[::-1].tolist():
            self.system.removeConstraint(k)
        _tie(self.system, self.pairs[chosen])
        return self.rows(chosen)


def _tie(system: openmm.System, pairs: IntArray) -> None:
    """Make the pairs count as bonded."""
    if not len(pairs):
        return
    force = next((f for f in system.getForces() if f.getName() == TIES), None)
    if force is None:
        force = openmm.HarmonicBondForce()
        force.setName(TIES)
        system.addForce(force)
        force = system.getForce(system.getNumForces() - 1)
    for i, j in pairs.tolist():
        force.addBond(i, j, 0.0, 0.0)


# -- the engine -----------------------------------------------------------------------------------


def hands_over_all() -> bool:
    """Whether callbacks are to be given the positions of all particles: a platform here may have mixed precision."""
    platforms = map(openmm.Platform.getPlatform, range(openmm.Platform.getNumPlatforms()))
    return any("Precision" in platform.getPropertyNames() for platform in platforms)


class Engine:
    """The engine of rows in a System, the cell that it knows, and the precision of the Context."""

    def __init__(self, motion: Motion, masses: FloatArray, cell: FloatArray | None) -> None:
        self.motion, self.masses, self.cell = motion, masses, cell
        self.atoms: IntArray = motion.sources[0].touched
        self.precision = Precision("", "double")

    def follow_cell(self, state: openmm.State) -> None:
        cell = np.asarray(state.getPeriodicBoxVectors(asNumpy=True)._value)
        if self.cell is None or not np.array_equal(cell, self.cell):
            self.motion.set_cell(cell)
            self.cell = cell


class CallbackEngine(Engine):
    """What the callbacks share: the engine, where the particles are, and how far the step is."""

    def __init__(
        self,
        constraints: tuple[Constraint, ...],
        positions: FloatArray,
        masses: FloatArray,
        cell: FloatArray | None,
        time: unit.Quantity | float,
    ) -> None:
        time = number(time, unit.picosecond, "time")
        held = ConstraintSet(constraints, positions, masses, cell=cell, time=time)
        super().__init__(Motion(held, positions, time=time), masses, cell)
        n, local = masses.shape[0], (len(self.atoms), 3)
        every = len(self.atoms) == n
        #: Where the carried particles are in arrays of all.
        self._held: slice | IntArray = slice(None) if every else self.atoms
        #: Whether OpenMM hands over these particles only; if not, positions and corrections of all.
        self.some = not every and not hands_over_all()
        self._all = None if self.some or every else np.zeros((2, n, 3))
        #: Positions where a drift starts, free positions, velocities; of all particles, as the engine takes them.
        self._start, self._there, self._v, self._moved = np.zeros((4, n, 3))
        #: Where the carried particles are, in step with OpenMM's own positions to the last bit.
        self._x, self._read, self._nothing = np.zeros(local), np.zeros(local), np.zeros(local)
        #: Whether the times of a drift matter, or its length.
        self.timed = self.motion.constraint_set.moving or not self.motion.constraint_set.holonomic.all()
        resting = [c.atoms.ravel() for c in held.constraints if c.fixes_atoms]
        fixed = np.unique(np.concatenate([*resting, np.zeros(0, np.int64)]))
        #: Which of the carried particles do not move.
        self._fixed = np.searchsorted(self.atoms, fixed)
        #: Center and radius of each carried particle, where all of them are on resting spheres.
        spheres = spheres_of(self.motion)
        self.spheres = None if spheres is None or len(fixed) else spheres[self.atoms]
        #: Whether drifts are great circles on these, and what the last one has done to v times its length.
        self.exact, self._turned = False, np.zeros(local)
        self._integrator: Callable[[], Integrator | None] = lambda: None
        #: Whether an integrator of kcons knows of the rows; where none does, the step count at the last evaluation.
        self.served, self._count = False, -1
        self._fractions: Sequence[float] = (1.0,)
        #: The thread that is making steps; 0 for none.
        self._thread = 0
        #: Whether velocities are projected between the drifts of a step, too.
        self._within = False
        self._error: BaseException | None = None
        self._between_steps, self._began, self._stage = True, (0.0, 0), 0
        #: Time and step count where the present run of steps began.
        self._ran: tuple[float, int] | None = None
        #: Whether what is lost in carrying v is carried after it, and whether that comes next.
        self.carries_rest, self._rest_to_come = False, False
        #: Whether it is known where the drift begins.
        self._begun = False
        #: Free positions of the drift and what brings them onto the rows.
        self._landing: tuple[FloatArray, FloatArray] | None = None

    def follow(self, p: Program) -> None:
        """Take times and step sizes from the integrator of this program."""
        self.refuse_other_threads()
        self.exact, self.served = p.exact, True
        self._integrator = weakref.ref(p.integrator)
        self.carries_rest = not p.integrator.thermostatted
        self._within, self._fractions = p.halves, p.drifts

    def take_precision(self, precision: Precision) -> None:
        """The Context is known. Where positions have 48 bits, what v loses on its way is less than forces know."""
        self.precision = precision
        if precision.name != "double":
            self.carries_rest = False

    def refuse_other_threads(self) -> None:
        """Raise while another thread makes steps: nothing may change what they go by."""
        if self._thread not in (0, get_ident()):
            raise UnsupportedError(
                "a Context in another thread is making steps with these rows; call hold for a System of each thread"
            )

    def begin_run(self) -> None:
        """Whatever was asked between steps, the next call belongs to the beginning of one."""
        self.refuse_other_threads()
        self._thread = get_ident()
        self._between_steps, self._rest_to_come, self._ran = True, False, None

    def end_run(self) -> None:
        if self._thread == get_ident():
            self._thread = 0

    # -- what passes ----------------------------------------------------------------------------

    def take(self, state: openmm.State, out: FloatArray) -> None:
        """Positions of the carried particles, shape (n_atoms, 3), nm."""
        # The public getPositions(asNumpy=True) makes the same call, and a Quantity: 20 times as slow.
        if self._all is None:
            state._getVectorAsNumpy(openmm.State.Positions, out)
        else:
            state._getVectorAsNumpy(openmm.State.Positions, self._all[0])
            np.take(self._all[0], self.atoms, axis=0, out=out)

    def give(self, force: FloatArray | None) -> FloatArray:
        """What is returned to OpenMM for a force on the carried particles; None for no force."""
        force = self._nothing if force is None else force
        if self._all is None:
            return force
        self._all[1][self.atoms] = force
        return self._all[1]

    def carried(self, change: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The force that carries a change, and the change that arrives."""
        if not self.precision.rounds_lengths:
            return change * CARRY_SCALE, change
        force = change * (CARRY_SCALE * _FROM_WHOLE / _TO_WHOLE)
        if self.precision.name != "double":
            force = force.astype(np.float32).astype(np.float64)
        return force, np.trunc(force * _TO_WHOLE) / (_FROM_WHOLE * CARRY_SCALE)

    def same(self, x: FloatArray, y: FloatArray) -> bool:
        """Whether positions of a Context, and those it should have, are the same to its rounding."""
        if not self.precision.rounds_lengths:
            return np.array_equal(x, y)
        return bool(np.abs(x - y).max(initial=0.0) <= 4 * self.precision.place * np.abs(y).max(initial=0.0))

    # -- callbacks ------------------------------------------------------------------------------

    def refuse_strangers(self, state: openmm.State) -> None:
        """Raise where steps are made by what does not hold the rows, or cannot be asked for its time step."""
        if not self.served:
            count, self._count = self._count, state.getStepCount()
            if self._count == count + 1 > 0:
                raise UnsupportedError(
                    "the integrator of this Context does not hold the rows of hold, nor the constraints that moved to "
                    "them; make it with ProjectedIntegrator(..., parts=[rows])"
                )
        elif self.timed and self._integrator() is None:
            raise UnsupportedError("the integrator of rows that need the time is gone from Python; keep a reference")

    def remember(self, state: openmm.State) -> None:
        began = self._time(state), state.getStepCount()
        if self._between_steps or began != self._began:
            self._between_steps, self._began, self._stage, self._error = False, began, -1, None
            if self.cell is not None:
                self.follow_cell(state)
        self._stage += 1
        self.take(state, self._x)
        self._begin_drift()

    def stand_at(self, x: FloatArray) -> None:
        """Particles are here, where others may have moved them: positions of all, shape (n_particles, 3)."""
        np.copyto(self._x, x[self.atoms])
        self._begin_drift()

    def _begin_drift(self) -> None:
        self._landing, self._begun = None, True
        self._start[self._held] = self._x
        self._turned.fill(0.0)

    def land(self, state: openmm.State) -> FloatArray | None:
        there, read = self._there, self._read
        self.take(state, read)
        if self._landing is not None and np.array_equal(read, self._landing[0]):
            return self._landing[1]  # force and energy are asked for one by one
        if not self.timed and self.same(read, self._x):
            return None  # at rest, or forces are asked for between steps
        if not self._begun:
            self._begin_drift()  # where the last drift ended: nobody has moved x since
        self._begun = False
        if self.exact:
            change, self._turned = great_circles(self._x, read, cast(FloatArray, self.spheres))
        else:
            there[self._held] = read
            then, now, h = self._times(self._stage)
            # Velocities take the change as well: from the multipliers, not from positions, whose rounding would add up.
            moved = self._moved
            moved.fill(0.0)
            self.motion.project_positions(
                there, self._start, time=now, reference_time=then, velocities=moved, dt=1.0, flight=h, out=there
            )
            change = np.array(moved[self._held])
            fixed = self._fixed
            change[fixed] = there[self.atoms[fixed]] - read[fixed]
        change, arriving = self.carried(change)
        np.add(read, arriving, out=self._x)
        self._landing = (read.copy(), change)
        return change

    def project(self, state: openmm.State) -> FloatArray | None:
        read = self._read
        self.take(state, read)
        read -= self._x
        if self._rest_to_come:
            self._rest_to_come = False
            return self._project_rest(read) if read.any() else None
        # Thermostats project within a step, too.
        self._between_steps = not self._within or self._stage >= len(self._fractions) - 1
        if not self.timed and not read.any():
            return None
        self._rest_to_come = self.carries_rest
        read *= SPEED_SCALE
        return self.carried(self._tangent(read) - read)[0]

    def turn(self, state: openmm.State) -> FloatArray | None:
        return None if self._between_steps else self.carried(self._turned)[0]

    def _project_rest(self, read: FloatArray) -> FloatArray:
        """The same for what was too small to be carried with v, as large as it comes: any factor will do."""
        read *= SPEED_SCALE
        change = self._tangent(read) - read
        if self.motion.plan.driven:
            # The rate that the rows demand is in v already.
            change -= self._tangent(np.zeros_like(read))
        return self.carried(change)[0]

    def _tangent(self, read: FloatArray) -> FloatArray:
        """Velocities of the carried particles, projected."""
        v, x = self._v, self._start
        v[self._held], x[self._held] = read, self._x
        now = self._times(self._stage if self._within else len(self._fractions) - 1)[1]
        self.motion.project_velocities(x, v, time=now, out=v)
        return np.array(v[self._held])

    def _time(self, state: openmm.State) -> float:
        """Where a step begins. After setStepSize the clock of Reference and CPU goes on with the first step size."""
        time, count = float(state.getTime()._value), state.getStepCount()
        self._ran = self._ran or (time, count)
        dt = self._dt
        expected = self._ran[0] + (count - self._ran[1]) * dt
        return expected if abs(time - expected) > 1e-6 * dt else time

    @property
    def _dt(self) -> float:
        integrator = self._integrator()
        return 0.0 if integrator is None else float(integrator.getStepSize()._value)

    def _times(self, stage: int) -> tuple[float, float, float]:
        """Beginning, end and length of a drift."""
        if not self.timed:
            return 0.0, 0.0, 0.0
        shares, dt, start = self._fractions, self._dt, self._began[0]
        stage = min(max(stage, 0), len(shares) - 1)
        then = sum(shares[:stage])
        now = 1.0 if stage == len(shares) - 1 else then + shares[stage]
        return start + then * dt, start + now * dt, shares[stage] * dt

    def answer(self, phase: str, state: openmm.State) -> tuple[float, FloatArray]:
        """What the PythonForce of this phase returns.

        In steps of an integrator that holds the rows nothing is raised: OpenMM would make a string of it.
        """
        self.refuse_strangers(state)
        change = None
        try:
            if phase == "remember":
                self.remember(state)
            elif self._error is None:
                change = getattr(self, phase)(state)
            elif phase == "project":
                self._between_steps, self._rest_to_come = True, False
        except BaseException as error:
            self._error, change = error, None
        return (0.0 if self._error is None else 1.0), self.give(change)

    def __reduce__(self) -> tuple[Any, ...]:
        raise UnsupportedError(
            "rows of hold belong to their System: copy the System, or write it to XML, before the call of hold"
        )

    # -- afterwards -----------------------------------------------------------------------------

    def explained_error(self, step: int) -> KconsError:
        error, self._error = self._error, None
        if error is None:
            return ConvergenceError(f"step {step}: the carried rows failed without saying why", step=step)
        finite = np.isfinite(self._read).all(axis=1)
        if isinstance(error, InputError) and not finite.all():
            atom = int(self.atoms[np.argmin(finite)])
            error = NonFiniteError(
                f"forces or velocities of atom {atom} are not finite; the time step is too large",
                item="velocity",
                atom=atom,
            )
        cause = "time step too large, or a state off the rows. " if isinstance(error, ConvergenceError) else ""
        if isinstance(error, KconsError):
            error.args = (f"step {step}: {cause}{error}", *error.args[1:])
            error.step = step  # type: ignore[attr-defined]
        elif isinstance(error, Exception):
            error.add_note(f"in step {step}, from the function of a constraint; the step was taken back")
        return cast(KconsError, error)


def great_circles(x: FloatArray, there: FloatArray, spheres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What takes particles from where they flew freely to the ends of great circles, and changes v, times the time.

    d = x - c turns in the plane of d and u, the way that is tangent, by w = |u|/R: it becomes d cos(w) + u sin(w)/w,
    and u becomes u cos(w) - d w sin(w). d is brought to the length R on the way, so that rounding does not add up.
    Centers and radii are the rows of `spheres`, shape (n, 4).
    """
    radius, d, way = spheres[:, 3:], x - spheres[:, :3], there - x
    d *= radius / np.sqrt(np.einsum("ij,ij->i", d, d))[:, None]
    u = way - d * (np.einsum("ij,ij->i", d, way)[:, None] / radius**2)
    w = np.sqrt(np.einsum("ij,ij->i", u, u))[:, None] / radius
    end = spheres[:, :3] + d * np.cos(w) + u * np.sinc(w / np.pi)
    return end - there, u * np.cos(w) - d * (w * np.sin(w)) - way


# -- the part -------------------------------------------------------------------------------------


class CarriedConstraints(Part):
    """Rows of kcons on the particles of an OpenMM System, for `ProjectedIntegrator(parts=[...])`; `hold` makes them.

    The arguments are those of `hold`. The System is not changed before `add_to`.

    Raises
    ------
    KconsError
        What `ConstraintSet` and `Motion` raise; virtual sites; no free force groups.

    Notes
    -----
    The rows belong to this System: it can be neither copied nor written to XML afterwards.
    """

    lands_last = True
    #: Sizes of the gradients, where velocities were looked at first.
    _slopes: FloatArray | None = None

    def __init__(
        self,
        system: openmm.System,
        constraints: Constraint | Iterable[Constraint],
        positions: unit.Quantity | ArrayLike,
        *,
        periodic: bool | None = None,
        time: unit.Quantity | float = 0.0,
    ) -> None:
        given = (constraints,) if isinstance(constraints, Constraint) else tuple(constraints)
        if not any(getattr(each, "n_rows", 1) for each in given):  # ConstraintSet says what is none
            raise InputError("there are no rows to hold", item="constraints")
        masses = masses_of(system)
        x = nanometers(positions, len(masses))
        wraps = system.usesPeriodicBoundaryConditions() if periodic is None else periodic
        cell = cell_of(system.getDefaultPeriodicBoxVectors()) if wraps else None
        self._engine = CallbackEngine(with_massless_atoms(given, masses), x, masses, cell, time)
        refuse_virtual_sites(system, self.atoms, masses)
        #: The constraints as they were given, with targets that were found.
        self.given: Sequence[Constraint] = self.motion.sources[0].constraints
        self.flies_exactly = self._engine.spheres is not None
        phases = PHASES if self.flies_exactly else PHASES[:3]
        groups = free_groups(system, len(phases), "rows")[-len(phases) :][::-1]
        self._groups, self.groups = dict(zip(phases, groups, strict=True)), frozenset(groups)
        #: How the names of its forces begin.
        self._name = f"{ROW_NAME}s {uuid.uuid4().hex}"

    def add_to(self, system: openmm.System) -> None:
        """Put the forces that carry the rows into the System; before the Context is made."""
        for phase, group in self._groups.items():
            force = openmm.PythonForce(partial(self._engine.answer, phase))
            if self._engine.some:
                force.setParticles(self.atoms.tolist())
            force.setUsesPeriodicBoundaryConditions(self._engine.cell is not None)
            force.setForceGroup(group)
            force.setName(f"{self._name}: {phase}")
            system.addForce(force)
        self.alone = system.getNumConstraints() == 0
        self.sited = bool(virtual_sites(system))

    # -- what is held ---------------------------------------------------------------------------

    @property
    def motion(self) -> Motion:
        """The engine; its `constraint_set` has all rows, with the numbers of the System's particles."""
        return self._engine.motion

    @property
    def driven(self) -> bool:
        """Whether rows demand velocities that are not zero."""
        return self.motion.plan.driven

    def solver_at(self, context: openmm.Context) -> Solver:
        """The engine at the time of the context."""
        time = self._state(context)[2]
        return Solver(self.motion, time=time)

    @property
    def atoms(self) -> IntArray:
        """Particles that a row touches."""
        return self._engine.atoms

    def rank(self, context: openmm.Context | None = None) -> int:
        """Degrees of freedom that the rows take; particles without mass never had any."""
        return self.motion.rank - 3 * int(np.count_nonzero(self.motion.masses[self.atoms] == 0))

    # -- in a context ---------------------------------------------------------------------------

    def check(self, context: openmm.Context) -> None:
        """Raise unless the state of the context is on the rows; also whatever is wrong with the set-up.

        Raises
        ------
        InputError
            Positions or velocities off the rows; forces that were not added; masses that have changed.
        UnsupportedError
            Constraints left in the System, virtual sites or a barostat that do not go together with the rows.
        """
        require_context(context)
        system = context.getSystem()
        self._check_system(system)
        held = self.motion.constraint_set
        bound = next((repr(item) for item in held.constraints if not item.translation_invariant), None)
        x, rows = self._state(context)[0], []
        for item, start in zip(held.constraints, held.starts, strict=False):
            cut = (np.ptp(held.gather(item, x) - x[item.atoms], axis=1) > NEAR).any(axis=1)
            rows.append((item.atoms, lambda k, start=start: held.row_name(start + k), cut))
        refuse_agents(system, bound, rows, context.getMolecules)
        if (miss := self.worst_violation(context)) is not None:
            raise InputError(
                f"{miss}; bring them onto the rows by apply_{miss.what}(context), or correct them. OpenMM's minimizer "
                "does not know the rows: take integrator.minimizeEnergy()",
                item=miss.what,
                atoms=miss.atoms,
            )

    def _check_system(self, system: openmm.System) -> None:
        """Raise where the System is not the one that the rows were built for."""
        engine = self._engine
        if not any(force.getName().startswith(self._name) for force in forces_of(system)):
            raise InputError(
                "the System has no forces that carry these rows; call hold(system, ...) before the Context is made",
                item="system",
            )
        self.check_masses(system)
        refuse_virtual_sites(system, engine.atoms, masses_of(system))
        if self.alone and system.getNumConstraints():
            raise InputError(
                "the System got constraints after the rows were added to it; add the rows, by hold, last",
                item="system",
            )
        pairs = held_pairs(system)[0]
        for k in np.flatnonzero(np.isin(pairs, engine.atoms).any(axis=1))[:1]:
            raise UnsupportedError(
                f"constraint {k} of the System, between atoms {pairs[k, 0]} and {pairs[k, 1]}, shares an atom with the "
                "rows; let kcons hold it too: hold(system, ...) moves such constraints, or add move_constraints(system)"
            )

    def check_masses(self, system: openmm.System) -> None:
        """Raise where masses are not those that the rows were built for."""
        engine, n = self._engine, system.getNumParticles()
        now = [system.getParticleMass(k)._value for k in engine.atoms.tolist()] if n == len(engine.masses) else []
        if not np.array_equal(now, engine.masses[engine.atoms]):
            raise InputError("masses have changed since the rows were built; build them again", item="masses")

    def attach(self, program: Program, context: openmm.Context) -> None:
        """A State or checkpoint that was loaded is where its own steps ended, the engine is not."""
        self._engine.stand_at(self._state(context)[0])

    def worst_violation(self, context: openmm.Context, velocities: bool = True) -> Violation | None:
        """sigma and A v of the constraints that were given, from the positions and velocities of the context."""
        x, v, time = self._state(context)
        held = self.motion.sources[0]
        with np.errstate(all="ignore"):
            found = held.residuals(x, v if velocities else None, time)
        if not np.isfinite(found.norms).all():  # rows that have no gradient here have a name
            for item, start in zip(held.constraints, held.starts, strict=False):
                item.check(held.gather(item, x), time, int(start))
        near, slow = self._engine.precision.limits
        allowed = np.maximum(near * held.scale, found.allowed)
        reach = np.abs(x[held.touched]).max(initial=0.0)
        if self._slopes is None:
            self._slopes = found.norms
        if self._engine.precision.name != "double" and context.getSystem().usesPeriodicBoundaryConditions():
            # OpenMM rounds molecules to single numbers where it moves them back into the box.
            allowed += 2.0**-22 * reach * self._slopes
        miss = Violation.worst("positions", found.sigma, allowed, held.row_name, held.row_atoms, NEAR * held.scale)
        if miss is not None or found.rates is None or found.speeds is None:
            return miss
        size = found.speeds + 0.1 * np.max(found.speeds, initial=0.0)
        # What is taken from v where it is carried together with x: all there is of a body at rest.
        lost = 4 * SPEED_SCALE * self._engine.precision.grain(reach) * self._slopes
        return Violation.worst("velocities", found.rates, slow * size + lost, held.row_name, held.row_atoms)

    def apply_positions(self, context: openmm.Context) -> None:
        """Bring positions onto the rows, with other bonds and angles as they are. Velocities stay as they are.

        Bonds are those of the System's forces and constraints; see `Motion.restore_positions`.

        Raises
        ------
        InfeasibleError, InputError
            As `Motion.restore_positions`; nothing was changed.
        """
        solver = self.solver_at(context)
        bonds = bonds_of(context.getSystem(), positions_of(context))
        self.restore_by(solver, context, bonds if len(bonds) else None)

    def _state(self, context: openmm.Context) -> tuple[FloatArray, FloatArray, float]:
        require_context(context)
        state = context.getState(positions=True, velocities=True)
        if self._engine.cell is not None:
            self._engine.follow_cell(state)
        x, v = np.asarray(state.getPositions(asNumpy=True)._value), np.asarray(state.getVelocities(asNumpy=True)._value)
        return x, v, float(state.getTime()._value)

    # -- results --------------------------------------------------------------------------------

    def multipliers(self, context: openmm.Context) -> FloatArray:
        """Multipliers at the state of the context, shape (n_rows,): z = A^T lambda is the force that holds the rows.

        In kJ/mol over the unit of the row (kJ/mol/nm for lengths, kJ/mol for angles). Exact for the state as it is,
        at the price of a force evaluation where forces are not known.
        """
        x, v, time = self._state(context)
        f = forces_at(context, groups_in(context.getIntegrator()) - self.groups)
        return self.motion.multipliers(x, v, f, time)

    def report(self, context: openmm.Context, *, condition: bool = True) -> Report:
        """Rank, condition, residuals and solvers at the state of the context."""
        x, v, time = self._state(context)
        return self.motion.report(x, v, time, condition=condition)

    def failure(self, integrator: openmm.CustomIntegrator, step: int) -> KconsError:
        """The error that stopped the engine, with the number of the step."""
        return self._engine.explained_error(step)

    # -- the program ----------------------------------------------------------------------------

    def declare(self, program: Program) -> None:
        self._engine.follow(program)

    def take_precision(self, program: Program, precision: Precision) -> None:
        """Refuse single precision; what passes through OpenMM is known now."""
        if precision.name == "single":
            raise UnsupportedError(
                f"{precision} hands positions to rows of kcons' constraint objects that are too coarse for them; make "
                "the Context with {'Precision': 'mixed'}, or hold the rows by CollectiveRows, which the platform "
                "computes"
            )
        self._engine.take_precision(precision)
        if f"rest{self.code}" in program.settings:
            program.set(f"rest{self.code}", float(self._engine.carries_rest))

    def begin(self, program: Program) -> None:
        """Where x is not where the last step ended, and velocities are projected before the first drift."""
        if program.ensemble.stays_tangent:
            self.remember(program)

    def _guard(self, program: Program, phase: str, words: str) -> None:
        group = self._groups[phase]
        program.let("failed", f"select(energy{group}, {self.code}, failed)", words)

    def begin_run(self) -> None:
        self._engine.begin_run()

    def end_run(self) -> None:
        self._engine.end_run()

    def remember(self, program: Program) -> None:
        words = "carried rows: positions whose gradients are taken"
        if not program.lean or self._engine.timed:
            self._guard(program, "remember", words)
            return
        with program.when("looked+moving != 0", "x need not be where the last drift ended"):
            self._guard(program, "remember", words)

    def land(self, program: Program, h: str) -> None:
        change = f"f{self._groups['land']}"
        if program.lean:  # where a step may end without a projection, this solve must tell of failures itself
            self._guard(program, "land", "carried rows: solve for positions")
            force, change = change, f"change{self.code}"
            program.each(change, force, "from the evaluation that tells of failures")
        program.each("x", f"x+{1 / CARRY_SCALE!r}*{change}", "carried rows: onto them")

    def land_alone(self, program: Program, u: str, h: str) -> None:
        """The drift with velocity u and its impulse, where nothing else acts on x: x and v change."""
        self.remember(program)
        group = self._groups["land"]
        program.each("x", f"x+{h}*{u}", "move freely (drift)")
        self._guard(program, "land", "carried rows: solve for positions")
        onto = f"x+{1 / CARRY_SCALE!r}*f{group}", "carried rows: onto them"
        if program.exact:
            program.each("x", *onto)
            group = self._groups["turn"]
        # Force and energy come from one evaluation, for this moves no x.
        program.each("v", f"{u}+{1 / CARRY_SCALE!r}*f{group}/{h}", "the constraint forces act on v as well")
        if not program.exact:
            program.each("x", *onto)

    def project(self, program: Program) -> None:
        change = f"f{self._groups['project']}"
        # Thermostats stir more than rounding does.
        rest = self._engine.carries_rest
        program.each("xu", "x", "to come back to")
        program.each("x", f"x+{1 / SPEED_SCALE!r}*v", "carries v, exactly as far as it can be told from x")
        self._guard(program, "project", "carried rows: solve for velocities")
        carried = f"(x-xu)*{SPEED_SCALE!r}"
        if rest:
            program.setting(f"rest{self.code}", "1 where the rest of v matters: forces are double", 1.0)
            program.each("v_low", f"select({change}, v-{carried}, 0)", "the rest of v")
        program.each("v", f"select({change}, {carried}+{1 / CARRY_SCALE!r}*{change}, v)", "tangent to the carried rows")
        if rest:
            with program.when(f"rest{self.code} != 0", "all digits"):
                program.each("x", f"xu+{LOW_SCALE!r}*v_low", "carries the rest")
                self._guard(program, "project", "carried rows: the same for the rest")
                back = 1 / (CARRY_SCALE * SPEED_SCALE * LOW_SCALE)
                program.each("v", f"v+v_low+{back!r}*{change}", "tangent, all of it")
        program.each("x", "xu", "back")

    def __deepcopy__(self, memo: dict[int, object]) -> Self:
        """The same: the forces of the System call this engine, whichever integrator makes steps."""
        return self

    def __reduce__(self) -> tuple[object, ...]:
        raise UnsupportedError(
            "rows of hold belong to their System and cannot be pickled with an integrator; call hold and make another "
            "integrator where it is needed"
        )

    def __repr__(self) -> str:
        return f"<CarriedConstraints: {self.motion.constraint_set.n_rows} rows on {len(self.atoms)} particles>"


# -- what a System must be like -------------------------------------------------------------------


def refuse_virtual_sites(system: openmm.System, atoms: IntArray, masses: FloatArray) -> None:
    """Refuse virtual sites among `atoms`, and what is no particle of the System."""
    if atoms.max(initial=0) >= len(masses):
        raise InputError(f"there is no atom {atoms.max()}; the System has {len(masses)} particles", item="atoms")
    for atom in atoms[masses[atoms] == 0].tolist():
        if system.isVirtualSite(atom):
            raise UnsupportedError(f"atom {atom} is a virtual site; hold the atoms that it is placed by")
