"""The constraint objects of kcons in OpenMM: PythonForces that carry positions to the engine and corrections back.

A PythonForce gets positions and returns forces, both as exact doubles on the CPU and Reference platforms. Three of
them, each in a force group of its own, serve one set of rows:

* `remember`: the positions at the start of a drift, where gradients are taken. Returns no force.
* `land`: positions after free flight. Its 'force' is the change that brings them onto the rows, x = x + f.
* `project`: positions x + v/1024 ps. Its 'force' is the change of v that makes it tangent to the rows at x.

Each returns an 'energy' of 0, or 1 where the engine raised an error: nothing may be raised through OpenMM, so the
error is kept and the integrator told to take the step back. Outside of steps all three return nothing to speak of:
rows that are fulfilled need no correction.
"""

from __future__ import annotations

import pickle
import uuid
import weakref
from collections.abc import Callable, Iterable
from typing import Any, Literal, cast

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import unit

from kcons.constraint_set import ConstraintSet
from kcons.constraints import Constraint, FixedAtoms
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.diagnosis import Report
from kcons.errors import ConvergenceError, InputError, KconsError, UnsupportedError
from kcons.motion import Motion
from kcons.openmm.program import Program
from kcons.steppers.drifts import NonholonomicFlight
from kcons.steppers.state import START_TOLERANCE
from kcons.steppers.summation import Point

#: v is carried as x + v/1024 ps: far less than what makes OpenMM build a new neighbour list, and v is rounded to
#: 1024/ps times the spacing of numbers at x, as much as x itself is rounded in a step of 1 fs. Powers of two cost
#: no digit.
SPEED_SCALE = 1024.0
#: Corrections are carried multiplied by this: on GPUs forces are whole multiples of 2^-32.
CARRY_SCALE = 2.0**20

PHASES = ("remember", "land", "project")
_NAME = "kcons rows"
_LIVE: weakref.WeakValueDictionary[str, _Engine] = weakref.WeakValueDictionary()


class CarriedConstraints:
    """Rows of kcons on the particles of an OpenMM System, for `ProjectedIntegrator(parts=[...])`.

    Most often made by `hold`, which also moves constraints of the System that share atoms with the rows.

    Parameters
    ----------
    system : openmm.System
        Masses and periodicity are taken from it; it is not changed before `add_to`. Particles without mass stay
        where they are.
    constraints : Constraint or iterable of Constraint
        What is held: lengths in nm, times in ps, masses in dalton.
    positions : Quantity or array_like, shape (n_particles, 3)
        On or near the constraints, in nm if without unit.
    periodic : bool, optional
        Whether rows take minimum images; by default if the System is periodic. Turn it off for rows longer than
        half the box among molecules that are never cut.
    degenerate : {'convert', 'raise'}
        As for `Motion`.
    time : float
        Time of `positions` in ps, for targets that move.

    Raises
    ------
    KconsError
        What `ConstraintSet` and `Motion` raise; virtual sites; no free force groups.

    Notes
    -----
    Pickling a System, or writing it to XML, takes the rows along if all of their functions can be pickled;
    `CarriedConstraints.of` then finds them.
    """

    evaluates = True
    meets_system = False

    def __init__(
        self,
        system: openmm.System,
        constraints: Constraint | Iterable[Constraint],
        positions: unit.Quantity | ArrayLike,
        *,
        periodic: bool | None = None,
        degenerate: Literal["convert", "raise"] = "convert",
        time: float = 0.0,
    ) -> None:
        given = (constraints,) if isinstance(constraints, Constraint) else tuple(constraints)
        if sum(c.n_rows for c in given if isinstance(c, Constraint)) == 0 and all(
            isinstance(c, Constraint) for c in given
        ):
            raise InputError("there are no rows to hold", item="constraints")
        masses = masses_of(system)
        x = nanometers(positions, len(masses))
        wraps = system.usesPeriodicBoundaryConditions() if periodic is None else periodic
        cell = _cell(system.getDefaultPeriodicBoxVectors()) if wraps else None
        engine = _Engine(uuid.uuid4().hex, _with_massless_atoms(given, masses), x, masses, cell, degenerate, time)
        _refuse_virtual_sites(system, engine)
        self._bind(engine, _free_groups(system, len(PHASES)))

    def _bind(self, engine: _Engine, groups: list[int]) -> None:
        self.code = 0
        self._engine = engine
        self._groups = dict(zip(PHASES, groups, strict=True))
        self.groups = frozenset(groups)

    @classmethod
    def of(cls, system: openmm.System) -> CarriedConstraints:
        """The rows that a System brings along which was read from XML or copied.

        Raises
        ------
        InputError
            It has none.
        """
        found = {force.getName(): force for force in system.getForces() if isinstance(force, openmm.PythonForce)}
        keys = sorted({name.split()[-1] for name in found if name.startswith(_NAME)})
        keys = [key for key in keys if key in _LIVE]
        if len(keys) != 1:
            raise InputError(
                f"the System carries {len(keys) or 'no'} sets of rows of kcons; expected one", item="system"
            )
        part = object.__new__(cls)
        part._bind(_LIVE[keys[0]], [found[_name(phase, keys[0])].getForceGroup() for phase in PHASES])
        return part

    def forces(self) -> list[openmm.PythonForce]:
        """The forces that carry the rows; `add_to` puts them into the System."""
        forces = []
        engine = self._engine
        for phase in PHASES:
            force = openmm.PythonForce(_Callback(engine, phase))
            if not engine.whole:
                force.setParticles(engine.atoms.tolist())
            force.setUsesPeriodicBoundaryConditions(engine.cell is not None)
            force.setForceGroup(self._groups[phase])
            force.setName(_name(phase, engine.key))
            forces.append(force)
        return forces

    def add_to(self, system: openmm.System) -> None:
        """Put the forces into the System; before the Context is made."""
        for force in self.forces():
            system.addForce(force)

    # -- what is held ---------------------------------------------------------------------------

    @property
    def motion(self) -> Motion:
        """The engine; its `constraint_set` has all rows, with the numbers of the System's particles."""
        return self._engine.motion

    @property
    def atoms(self) -> IntArray:
        """Particles that a row touches."""
        return self._engine.atoms

    def rank(self, context: openmm.Context | None = None) -> int:
        """Degrees of freedom that the rows take; particles without mass never had any."""
        fixed = int(np.count_nonzero(self.motion.masses[self.atoms] == 0))
        return self.motion.rank - 3 * fixed

    # -- the program ----------------------------------------------------------------------------

    def declare(self, program: Program) -> None:
        self._engine.follow(program.integrator)

    def _guard(self, program: Program, phase: str, words: str) -> None:
        group = self._groups[phase]
        program.let("failed", f"select(energy{group}, {self.code}, failed)", words)

    def remember(self, program: Program) -> None:
        self._guard(program, "remember", "carried rows: positions whose gradients are taken")

    def land(self, program: Program, h: str) -> None:
        self._guard(program, "land", "carried rows: solve for positions")
        program.each("x", f"x+{1 / CARRY_SCALE!r}*f{self._groups['land']}", "onto the carried rows")

    def project(self, program: Program) -> None:
        change = f"f{self._groups['project']}"
        program.each("xu", "x", "to come back to")
        program.each("x", f"x+{1 / SPEED_SCALE!r}*v", "carries v, exactly as far as it can be told from x")
        self._guard(program, "project", "carried rows: solve for velocities")
        program.each(
            "v", f"select({change}, (x-xu)*{SPEED_SCALE!r}+{1 / CARRY_SCALE!r}*{change}, v)", "tangent to the carried rows"
        )
        program.each("x", "xu", "back")

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
        system = context.getSystem()
        self._check_system(system)
        _refuse_agents(system, self.motion.constraint_set, context.getMolecules())
        x, v, time = self._state(context)
        held, motion = self.motion.constraint_set, self.motion
        miss = np.abs(held.value(x, time))
        allowed = np.maximum(START_TOLERANCE * held.scale, 4 * held.tolerance(x, time))
        if not np.all(miss <= allowed):
            row = int(np.argmax(np.where(np.isfinite(miss), miss / allowed, np.inf)))
            raise InputError(
                f"positions are off row {held.row_name(row)} by {miss[row]:.6g}; bring them onto the rows by "
                "apply_positions(context), or correct them",
                item="positions",
                atoms=held.row_atoms(row),
            )
        tangent = motion.project_velocities(x, v, time=time)
        away = np.abs(tangent - v)
        if away.max() > START_TOLERANCE * max(np.abs(v).max(), np.abs(tangent).max()):
            atom = int(np.argmax(away.max(axis=1)))
            raise InputError(
                f"velocities violate the rows: atom {atom} moves off them with {away[atom].max():.6g} nm/ps; "
                "remove that part by apply_velocities(context)",
                item="velocities",
                atoms=[atom],
            )

    def apply_positions(self, context: openmm.Context) -> None:
        """Bring positions onto the rows: the nearest point in the mass metric. Velocities stay as they are.

        Raises
        ------
        InfeasibleError, InputError
            As `Motion.restore_positions`; nothing was changed.
        """
        x, _, time = self._state(context)
        context.setPositions(self.motion.restore_positions(x, time=time))
        context.computeVirtualSites()

    def apply_velocities(self, context: openmm.Context) -> None:
        """Make velocities tangent to the rows: the nearest ones in the mass metric.

        Raises
        ------
        ConvergenceError, InputError
            As `Motion.project_velocities`; nothing was changed.
        """
        x, v, time = self._state(context)
        context.setVelocities(self.motion.project_velocities(x, v, time=time))

    def _state(self, context: openmm.Context) -> tuple[FloatArray, FloatArray, float]:
        state = context.getState(positions=True, velocities=True)
        if self._engine.cell is not None:
            self._engine.follow_cell(state)
        x = state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
        v = state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond)
        return x, v, state.getTime().value_in_unit(unit.picosecond)

    def _check_system(self, system: openmm.System) -> None:
        engine = self._engine
        missing = {_name(phase, engine.key) for phase in PHASES} - {force.getName() for force in system.getForces()}
        if missing:
            raise InputError(
                "the System has no forces that carry the rows; call add_to(system), or hold(system, ...), before "
                "the Context is made",
                item="system",
            )
        now = masses_of(system)
        if len(now) != len(engine.masses) or np.any(now[engine.atoms] != engine.masses[engine.atoms]):
            raise InputError("masses have changed since the rows were built; build them again", item="masses")
        _refuse_virtual_sites(system, engine)
        touched = set(engine.atoms.tolist())
        for k in range(system.getNumConstraints()):
            i, j, _ = system.getConstraintParameters(k)
            if touched & {i, j}:
                raise UnsupportedError(
                    f"constraint {k} of the System, between atoms {i} and {j}, shares an atom with the rows; let "
                    "kcons hold it too: hold(system, ...) moves such constraints, or add take_constraints(system)"
                )

    # -- results --------------------------------------------------------------------------------

    def multipliers(self, context: openmm.Context) -> FloatArray:
        """Multipliers at the state of the context, shape (n_rows,): z = A^T lambda is the force that holds the rows.

        In kJ/mol over the unit of the row (kJ/mol/nm for lengths, kJ/mol for angles). Exact for the state as it is,
        at the price of a force evaluation where forces are not known.
        """
        x, v, time = self._state(context)
        groups = {g for g in range(32) if g not in self.groups}
        kept = context.getIntegrator().getIntegrationForceGroups()
        state = context.getState(forces=True, groups=kept & sum(1 << g for g in groups))
        f = state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
        return self.motion.multipliers(x, v, f, time)

    @property
    def step_multipliers(self) -> FloatArray:
        """Multipliers at the positions where the last step began, from the step itself, shape (n_rows,).

        2 Lambda/dt^2 of the position stage and -2 mu/dt of the velocity stage before are each of first order in dt;
        this is their mean, of second order. Costs nothing. For schemes with one drift a step, from the second step
        on.

        Raises
        ------
        InputError
            No two steps of such a scheme have been made.
        """
        return self._engine.step_multipliers()

    def report(self, context: openmm.Context, *, condition: bool = True) -> Report:
        """Rank, condition, residuals and solvers at the state of the context."""
        x, v, time = self._state(context)
        return self.motion.report(x, v, time, condition=condition)

    def failure(self, integrator: openmm.CustomIntegrator, step: int) -> KconsError:
        """The error that stopped the engine, with the number of the step."""
        return self._engine.explained_error(step)

    def __repr__(self) -> str:
        return f"<CarriedConstraints: {self.motion.constraint_set.n_rows} rows on {len(self.atoms)} particles>"


class _Engine:
    """What the three callbacks share: the engine, where the particles are, and how far the step is."""

    def __init__(
        self,
        key: str,
        constraints: tuple[Constraint, ...],
        positions: FloatArray,
        masses: FloatArray,
        cell: FloatArray | None,
        degenerate: Literal["convert", "raise"],
        time: float,
    ) -> None:
        self.key = key
        held = ConstraintSet(constraints, positions, masses, cell=cell, time=time)
        self.motion = Motion(held, positions, degenerate=degenerate, time=time)
        self.masses, self.cell = masses, cell
        #: What it takes to build this again; targets taken from the positions are in the set.
        self.recipe = (held.constraints, positions, masses, cell, degenerate, time)
        self.atoms: IntArray = held.touched
        self.whole = len(self.atoms) == len(masses)
        n, local = masses.shape[0], (len(self.atoms), 3)
        self._nothing = np.zeros(local)
        #: Positions where a drift starts, free positions, velocities; of all particles, as the engine takes them.
        self._start, self._there, self._v = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
        #: Where the carried particles are, in step with OpenMM's own positions to the last bit.
        self._x, self._read = np.zeros(local), np.zeros(local)
        if self.whole:
            self._x = self._start
        rows = self.motion.constraint_set.n_rows
        self._impulse, self._push, self._push_before = np.zeros(rows), np.zeros(rows), np.full(rows, np.nan)
        self._timed = self.motion.constraint_set.moving
        self._flight: NonholonomicFlight | None = None
        if not self.motion.constraint_set.holonomic.all():
            with np.errstate(divide="ignore"):
                weights = (1 / masses)[:, None]
            fixed = [c.atoms.ravel() for c in held.constraints if c.family == "FixedAtoms"]
            weights[np.concatenate([*fixed, np.zeros(0, np.int64)])] = 0.0
            self._flight = NonholonomicFlight(self.motion, weights)
            self._weights = np.repeat(weights, 3, axis=1)
            self._timed = True
        self._integrator: Callable[[], openmm.CustomIntegrator | None] = lambda: None
        self._fractions: tuple[float, ...] = (1.0,)
        self._nodes: tuple[float, ...] = (0.0, 1.0)
        self._error: BaseException | None = None
        self._between_steps, self._began, self._stage = True, (0.0, 0), 0
        _LIVE[key] = self

    def follow(self, integrator: openmm.CustomIntegrator) -> None:
        """Take times and step sizes from this integrator."""
        self._integrator = weakref.ref(integrator)
        scheme = getattr(integrator, "scheme", None)
        if scheme is not None:
            self._fractions = tuple(a * w for a in scheme.drifts for w in scheme.flight)
            sums = np.cumsum(self._fractions)[:-1].tolist()
            self._nodes = (0.0, *sums, 1.0)

    # -- callbacks ------------------------------------------------------------------------------

    def remember(self, state: openmm.State) -> FloatArray:
        began = (_time(state), state.getStepCount()) if self._timed else (0.0, 0)
        if self._between_steps or began != self._began:
            self._between_steps, self._began, self._stage, self._error = False, began, 0, None
            if self.cell is not None:
                self.follow_cell(state)
        if self.whole:
            _positions(state, self._start)
        else:
            _positions(state, self._x)
            self._start[self.atoms] = self._x
        return self._nothing

    def land(self, state: openmm.State) -> FloatArray:
        there, read = self._there, self._read
        _positions(state, read)
        there[self.atoms] = read
        then, now, h = self._times(self._stage)
        self._stage += 1
        if self._flight is None:
            self.motion.project_positions(
                there, self._start, time=now, reference_time=then, out=there, multipliers=self._impulse
            )
        else:
            point = Point(self._start.copy(), (there - self._start) / h, self._weights, exact=False)
            self._flight.move(point, there, then, now, h)
        change = (there if self.whole else there[self.atoms]) - read
        np.add(read, change, out=self._x)
        change *= CARRY_SCALE
        return change

    def project(self, state: openmm.State) -> FloatArray:
        self._between_steps = True
        read, v = self._read, self._v
        _positions(state, read)
        read -= self._x
        read *= SPEED_SCALE
        if self.whole:
            np.copyto(v, read)
            x = self._x
        else:
            v[self.atoms] = read
            x = self._start
            x[self.atoms] = self._x
        now = self._times(len(self._nodes) - 2)[1]
        self._push, self._push_before = self._push_before, self._push
        self.motion.project_velocities(x, v, time=now, out=v, multipliers=self._push)
        change = (v if self.whole else v[self.atoms]) - read
        change *= CARRY_SCALE
        return change

    def _times(self, stage: int) -> tuple[float, float, float]:
        """Beginning, end and length of a drift."""
        if not self._timed:
            return 0.0, 0.0, 0.0
        integrator = self._integrator()
        dt = 0.0 if integrator is None else _number(integrator.getStepSize())
        start = self._began[0]
        stage = min(stage, len(self._fractions) - 1)
        return start + self._nodes[stage] * dt, start + self._nodes[stage + 1] * dt, self._fractions[stage] * dt

    def follow_cell(self, state: openmm.State) -> None:
        cell = _cell(state.getPeriodicBoxVectors())
        if not np.array_equal(cell, self.cell):
            self.motion.set_cell(cell)
            self.cell = cell

    def answer(self, phase: str, state: openmm.State) -> tuple[float, FloatArray]:
        """What the PythonForce of this phase returns. Nothing is raised: OpenMM would make a string of it."""
        try:
            change = self.remember(state) if phase == "remember" else None
            if self._error is None:
                if phase == "land":
                    change = self.land(state)
                elif phase == "project":
                    change = self.project(state)
            elif phase == "project":
                self._between_steps = True
        except BaseException as error:
            self._error, change = error, None
        return (0.0 if self._error is None else 1.0), (self._nothing if change is None else change)

    # -- afterwards -----------------------------------------------------------------------------

    def step_multipliers(self) -> FloatArray:
        integrator = self._integrator()
        if integrator is None or len(self._fractions) != 1 or np.isnan(self._push_before).any():
            raise InputError(
                "multipliers of a step need two steps of a scheme with one drift; multipliers(context) gives those of "
                "any state",
                item="scheme",
            )
        dt = _number(integrator.getStepSize())
        return np.asarray(self._impulse / dt**2 - self._push_before / dt)

    def explained_error(self, step: int) -> KconsError:
        error = self._error
        self._error = None
        if error is None:
            return ConvergenceError(f"step {step}: the carried rows failed without saying why", step=step)
        cause = ""
        if isinstance(error, ConvergenceError):
            cause = f"{self._cause()}. "
        if isinstance(error, KconsError):
            error.args = (f"step {step}: {cause}{error}", *error.args[1:])
            error.step = step  # type: ignore[attr-defined]
        elif isinstance(error, Exception):
            error.add_note(f"in step {step}, from the function of a constraint; the step was taken back")
        return cast(KconsError, error)

    def _cause(self) -> str:
        held = self.motion.constraint_set
        time = self._times(max(self._stage - 1, 0))[0]
        miss = np.abs(held.value(self._start, time))
        allowed = np.maximum(1e-6 * held.scale, 4 * held.tolerance(self._start, time))
        off = np.flatnonzero(~(miss <= allowed))
        if not len(off):
            return "time step too large"
        row = int(off[np.argmax(miss[off])])
        return (
            f"the state before it was already off row {held.row_name(row)} by {miss[row]:.3g}; "
            "call apply_positions(context) first"
        )


class _Callback:
    """The function of one PythonForce; survives pickling together with its engine."""

    def __init__(self, engine: _Engine, phase: str) -> None:
        self.engine, self.phase = engine, phase

    def __call__(self, state: openmm.State) -> tuple[float, FloatArray]:
        return self.engine.answer(self.phase, state)

    def __reduce__(self) -> tuple[Callable[..., _Callback], tuple[Any, ...]]:
        # The first of the three brings the engine along; the others find it by its key.
        recipe = self.engine.recipe if self.phase == PHASES[0] else None
        return _restored, (self.engine.key, self.phase, recipe)


def _restored(key: str, phase: str, recipe: tuple[Any, ...] | None) -> _Callback:
    engine = _LIVE.get(key) if recipe is None else _Engine(key, *recipe)
    if engine is None:
        raise pickle.UnpicklingError(f"the force '{_name(PHASES[0], key)}' must be read first")
    return _Callback(engine, phase)


# -- what OpenMM gives ----------------------------------------------------------------------------


def _positions(state: openmm.State, out: FloatArray) -> None:
    # The public getPositions(asNumpy=True) makes the same call, and a Quantity: 20 times as slow.
    state._getVectorAsNumpy(openmm.State.Positions, out)


def _number(quantity: unit.Quantity) -> float:
    return float(quantity.value_in_unit(unit.picosecond))


def _time(state: openmm.State) -> float:
    return _number(state.getTime())


def _cell(vectors: Any) -> FloatArray:
    return np.array([[edge[k] for k in range(3)] for edge in vectors.value_in_unit(unit.nanometer)])


def _name(phase: str, key: str) -> str:
    return f"{_NAME}: {phase} {key}"


def nanometers(positions: unit.Quantity | ArrayLike, n: int) -> FloatArray:
    """Positions as an array of shape (n, 3), nm."""
    plain = positions.value_in_unit(unit.nanometer) if unit.is_quantity(positions) else positions
    x = np.array([[r[0], r[1], r[2]] for r in plain] if isinstance(plain, list) else plain, dtype=np.float64)
    if x.shape != (n, 3):
        raise InputError(f"positions must have shape ({n}, 3), not {x.shape}", item="positions")
    return x


def masses_of(system: openmm.System) -> FloatArray:
    """Masses in dalton, shape (n_particles,)."""
    return np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])


def _with_massless_atoms(given: tuple[Constraint, ...], masses: FloatArray) -> tuple[Constraint, ...]:
    """What OpenMM does not move is fixed."""
    if not all(isinstance(item, Constraint) for item in given):
        return given  # ConstraintSet says what is wrong
    used = [item.atoms.ravel() for item in given]
    touched = np.unique(np.concatenate(used))
    still = touched[touched < len(masses)]
    still = still[masses[still] == 0]
    fixed = [item.atoms.ravel() for item in given if item.family == "FixedAtoms"]
    still = np.setdiff1d(still, np.concatenate([*fixed, np.zeros(0, np.int64)]))
    return (*given, FixedAtoms(still)) if len(still) else given


def _free_groups(system: openmm.System, count: int) -> list[int]:
    taken = {force.getForceGroup() for force in system.getForces()}
    free = [g for g in reversed(range(32)) if g not in taken]
    if len(free) < count:
        raise UnsupportedError(f"rows need {count} force groups, and {len(free)} are free; use fewer groups for forces")
    return free[:count]


def _refuse_virtual_sites(system: openmm.System, engine: _Engine) -> None:
    for atom in engine.atoms.tolist():
        if system.isVirtualSite(atom):
            raise UnsupportedError(f"atom {atom} is a virtual site; hold the atoms that it is placed by")


def _refuse_agents(system: openmm.System, held: ConstraintSet, molecules: Any) -> None:
    """Barostats and others that move particles between steps must not move them off the rows."""
    bound = next((item for item in held.constraints if not item.translation_invariant), None)
    for force in system.getForces():
        name = type(force).__name__
        if isinstance(force, openmm.CMMotionRemover) and bound is not None:
            raise UnsupportedError(
                f"{name} shifts all velocities, but {bound!r} ties atoms to a place, and momentum is not conserved; "
                "remove that force (createSystem(..., removeCMMotion=False))"
            )
        if "Barostat" not in name:
            continue
        if bound is not None:
            raise UnsupportedError(
                f"{name} moves molecules, but {bound!r} ties atoms to a place; run at constant volume, or hold "
                "differences of positions only"
            )
        rigid = getattr(force, "getScaleMoleculesAsRigid", None)
        if rigid is not None and not rigid():
            raise UnsupportedError(f"{name} scales molecules; call setScaleMoleculesAsRigid(True)")
        row = _row_between(held, molecules)
        if row is not None:
            raise UnsupportedError(
                f"{name} moves molecules apart, but row {held.row_name(row)} holds atoms of two of them; let them count "
                "as one molecule by hold(system, ..., join=True), or run at constant volume"
            )


def _row_between(held: ConstraintSet, molecules: Any) -> int | None:
    """A row with atoms of several molecules."""
    label = np.zeros(held.n_atoms, dtype=np.int64)
    for k, atoms in enumerate(molecules):
        label[list(atoms)] = k
    for item, start in zip(held.constraints, held.starts, strict=False):
        of = label[item.atoms]
        apart = (of != of[:, :1]).any(axis=1)
        if apart.any():
            return int(start + np.argmax(apart))
    return None
