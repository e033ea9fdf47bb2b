"""The constraint objects of kcons as a part of an integrator of OpenMM (see `callback_rows.callbacks`)."""

from __future__ import annotations

import uuid
from collections.abc import Iterable
from typing import Self

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import unit

from kcons.constraints import Constraint
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.motion.report import Report
from kcons.openmm.callback_rows.callbacks import (
    CARRY_SCALE,
    LOW_SCALE,
    PHASES,
    SPEED_SCALE,
    Callback,
    Engine,
    cell_of,
)
from kcons.openmm.collective.coordinates import free_groups
from kcons.openmm.integrator.part import NEAR, Part, Solver, Violation
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.system_checks import (
    ROW_NAME,
    forces_of,
    groups_in,
    refuse_agents,
    require_context,
    virtual_sites,
)
from kcons.openmm.quantities import accepted, masses_of, nanometers, with_massless_atoms
from kcons.openmm.states import forces_at, positions_of
from kcons.openmm.topology import bonds_of


class CarriedConstraints(Part):
    """Rows of kcons on the particles of an OpenMM System, for `ProjectedIntegrator(parts=[...])`.

    Most often made by `hold`, which also moves constraints of the System that share atoms with the rows.

    Parameters
    ----------
    system : openmm.System
        Masses and periodicity are taken from it; it is not changed before `add_to`. Particles without mass stay
        where they are.
    constraints : Constraint or iterable of Constraint
        What is held: Quantities, or numbers of nm, ps, dalton, radian. Functions get numbers and may return either.
    positions : Quantity or array_like, shape (n_particles, 3)
        On or near the constraints, in nm if without unit.
    periodic : bool, optional
        Whether rows take minimum images; by default if the System is periodic. Turn it off for rows longer than
        half the box among molecules that are never cut.
    time : float
        Time of `positions` in ps, for targets that move.

    Raises
    ------
    KconsError
        What `ConstraintSet` and `Motion` raise; virtual sites; no free force groups.

    Notes
    -----
    The rows belong to this System: it can be neither copied nor written to XML afterwards.
    """

    evaluates = lands_last = True
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
        given = tuple(accepted((constraints,) if isinstance(constraints, Constraint) else constraints))
        if not any(getattr(each, "n_rows", 1) for each in given):  # ConstraintSet says what is none
            raise InputError("there are no rows to hold", item="constraints")
        masses = masses_of(system)
        x = nanometers(positions, len(masses))
        wraps = system.usesPeriodicBoundaryConditions() if periodic is None else periodic
        cell = cell_of(system.getDefaultPeriodicBoxVectors()) if wraps else None
        self._engine = Engine(with_massless_atoms(given, masses), x, masses, cell, time)
        refuse_virtual_sites(system, self.atoms, masses)
        groups = free_groups(system, len(PHASES), "rows")[-len(PHASES) :][::-1]
        self._groups, self.groups = dict(zip(PHASES, groups, strict=True)), frozenset(groups)
        #: How the names of its forces begin.
        self._name = f"{ROW_NAME}s {uuid.uuid4().hex}"

    def add_to(self, system: openmm.System) -> None:
        """Put the forces that carry the rows into the System; before the Context is made."""
        for phase, group in self._groups.items():
            force = openmm.PythonForce(Callback(self._engine, phase))
            if self._engine.passage.some:
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
        return Solver(self.motion, time=self._state(context)[2])

    @property
    def atoms(self) -> IntArray:
        """Particles that a row touches."""
        return self._engine.atoms

    def rank(self, context: openmm.Context | None = None) -> int:
        """Degrees of freedom that the rows take; particles without mass never had any."""
        fixed = int(np.count_nonzero(self.motion.masses[self.atoms] == 0))
        return self.motion.rank - 3 * fixed

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
        self._check_system(system, Precision.of(context))
        held = self.motion.constraint_set
        bound = next((repr(item) for item in held.constraints if not item.translation_invariant), None)
        starts = zip(held.constraints, held.starts, strict=False)
        rows = [(item.atoms, lambda k, start=start: held.row_name(start + k)) for item, start in starts]
        refuse_agents(system, bound, rows, context.getMolecules)
        miss = self.worst_violation(context)
        if miss is not None:
            raise InputError(
                f"{miss}; bring them onto the rows by apply_{miss.what}(context), or correct them",
                item=miss.what,
                atoms=miss.atoms,
            )

    def _check_system(self, system: openmm.System, precision: Precision) -> None:
        """Raise where the System is not the one that the rows were built for."""
        engine = self._engine
        if not any(force.getName().startswith(self._name) for force in forces_of(system)):
            raise InputError(
                "the System has no forces that carry these rows; call hold(system, ...) before the Context is made",
                item="system",
            )
        now = masses_of(system)
        if len(now) != len(engine.masses) or np.any(now[engine.atoms] != engine.masses[engine.atoms]):
            raise InputError("masses have changed since the rows were built; build them again", item="masses")
        refuse_virtual_sites(system, engine.atoms, now)
        if self.alone and system.getNumConstraints():
            raise InputError(
                "the System got constraints after the rows were added to it; add the rows, by hold, last",
                item="system",
            )
        touched = set(engine.atoms.tolist())
        for k in range(system.getNumConstraints()):
            i, j, _ = system.getConstraintParameters(k)
            if touched & {i, j}:
                raise UnsupportedError(
                    f"constraint {k} of the System, between atoms {i} and {j}, shares an atom with the rows; let "
                    "kcons hold it too: hold(system, ...) moves such constraints, or add move_constraints(system)"
                )

    def attach(self, program: Program, context: openmm.Context) -> None:
        """A State or checkpoint that was loaded is where its own steps ended, the engine is not."""
        self._engine.stand_at(self._state(context)[0])

    def worst_violation(self, context: openmm.Context, velocities: bool = True) -> Violation | None:
        """sigma and A v of the constraints that were given, from the positions and velocities of the context."""
        x, v, time = self._state(context)
        held = self.motion.sources[0]
        found = held.residuals(x, v if velocities else None, time)
        near, slow = self._engine.passage.limits
        allowed = np.maximum(near * held.scale, found.allowed)
        reach = np.abs(x[held.touched]).max(initial=0.0)
        if self._slopes is None:
            self._slopes = found.norms
        if self._engine.passage.precision.name != "double" and context.getSystem().usesPeriodicBoundaryConditions():
            # OpenMM rounds molecules to single numbers where it moves them back into the box.
            allowed += 2.0**-22 * reach * self._slopes
        miss = Violation.worst("positions", found.sigma, allowed, held.row_name, held.row_atoms, NEAR * held.scale)
        if miss is not None or found.rates is None or found.speeds is None:
            return miss
        size = found.speeds + 0.1 * np.max(found.speeds, initial=0.0)
        # What is taken from v where it is carried together with x: all there is of a body at rest.
        lost = 4 * SPEED_SCALE * self._engine.passage.grain(reach) * self._slopes
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

    # -- the program ----------------------------------------------------------------------------

    def declare(self, program: Program) -> None:
        self._engine.follow(program.integrator, self.lean)

    def take_precision(self, program: Program, precision: Precision) -> None:
        """Refuse single precision; what passes through OpenMM is known now."""
        refuse_single_precision(precision)
        self._engine.take_precision(precision)
        if f"rest{self.code}" in program.settings:
            program.set(f"rest{self.code}", float(self._engine.carries_rest))

    def begin(self, program: Program) -> None:
        """Where x is not where the last step ended, and velocities are projected before the first drift."""
        if program.integrator.ensemble.stays_tangent:
            self.remember(program)

    def _guard(self, program: Program, phase: str, words: str) -> None:
        group = self._groups[phase]
        program.let("failed", f"select(energy{group}, {self.code}, failed)", words)

    def begin_run(self) -> None:
        self._engine.begin_run()

    def remember(self, program: Program) -> None:
        words = "carried rows: positions whose gradients are taken"
        if not self.lean or self._engine.timed:
            self._guard(program, "remember", words)
            return
        with program.when("looked+moving != 0", "x need not be where the last drift ended"):
            self._guard(program, "remember", words)

    def land(self, program: Program, h: str) -> None:
        change = f"f{self._groups['land']}"
        if self.lean:  # where a step may end without a projection, this solve must tell of failures itself
            self._guard(program, "land", "carried rows: solve for positions")
            force, change = change, program.vector(f"change{self.code}", "what brings carried particles onto the rows")
            program.each(change, force, "from the evaluation that tells of failures")
        program.each("x", f"x+{1 / CARRY_SCALE!r}*{change}", "carried rows: onto them")

    def land_alone(self, program: Program, u: str, h: str) -> None:
        """The drift with velocity u and its impulse, where nothing else acts on x: x and v change."""
        group = self._groups["land"]
        program.each("x", f"x+{h}*{u}", "move freely (drift)")
        self._guard(program, "land", "carried rows: solve for positions")
        # Force and energy come from one evaluation, for this moves no x.
        program.each("v", f"{u}+{1 / CARRY_SCALE!r}*f{group}/{h}", "the constraint forces act on v as well")
        program.each("x", f"x+{1 / CARRY_SCALE!r}*f{group}", "carried rows: onto them")

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
            program.vector("v_low", "what of v was too small to be carried together with x")
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


def refuse_single_precision(precision: Precision) -> None:
    """Refuse positions in single precision."""
    if precision.name == "single":
        raise UnsupportedError(
            f"{precision} hands positions to rows of kcons' constraint objects that are too coarse for them; make the "
            "Context with {'Precision': 'mixed'}, or hold the rows by CollectiveRows, which the platform computes"
        )
