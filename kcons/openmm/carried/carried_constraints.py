"""The constraint objects of kcons in OpenMM, carried to the engine by PythonForces (see `carried.callbacks`)."""

from __future__ import annotations

import uuid
import weakref
from collections.abc import Iterable
from typing import Literal

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import unit

from kcons.constraints import Constraint
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InfeasibleError, InputError, KconsError
from kcons.motion.motion import Motion
from kcons.motion.report import Report
from kcons.openmm.carried.callbacks import (
    LIVE,
    PHASES,
    PREFIX,
    SPEED_SCALE,
    Callback,
    Engine,
    cell_of,
    force_name,
)
from kcons.openmm.carried.carried_program import CarriedProgram
from kcons.openmm.carried.passage import hands_over_all
from kcons.openmm.carried.requirements import (
    free_groups,
    refuse_agents,
    refuse_shared_atoms,
    refuse_single_precision,
    refuse_some_particles,
    refuse_virtual_sites,
    warned_of_rounding,
    with_massless_atoms,
)
from kcons.openmm.integrator.part import NEAR, Miss
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.system_checks import require_context, virtual_sites
from kcons.openmm.quantities import accepted, masses_of, nanometers
from kcons.openmm.topology import bonds_of


class CarriedConstraints(CarriedProgram):
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

    _told = False
    #: Sizes of the gradients, where velocities were looked at first.
    _slopes: FloatArray | None = None

    def __init__(
        self,
        system: openmm.System,
        constraints: Constraint | Iterable[Constraint],
        positions: unit.Quantity | ArrayLike,
        *,
        periodic: bool | None = None,
        degenerate: Literal["convert", "raise"] = "convert",
        time: unit.Quantity | float = 0.0,
    ) -> None:
        given = tuple(accepted((constraints,) if isinstance(constraints, Constraint) else constraints))
        if sum(c.n_rows for c in given if isinstance(c, Constraint)) == 0 and all(
            isinstance(c, Constraint) for c in given
        ):
            raise InputError("there are no rows to hold", item="constraints")
        masses = masses_of(system)
        x = nanometers(positions, len(masses))
        wraps = system.usesPeriodicBoundaryConditions() if periodic is None else periodic
        cell = cell_of(system.getDefaultPeriodicBoxVectors()) if wraps else None
        engine = Engine(uuid.uuid4().hex, with_massless_atoms(given, masses), x, masses, cell, degenerate, time)
        refuse_virtual_sites(system, engine.atoms, masses)
        self._bind(engine, free_groups(system, len(PHASES)))

    def _bind(self, engine: Engine, groups: list[int]) -> None:
        self.code = 0
        self._engine = engine
        self._groups = dict(zip(PHASES, groups, strict=True))
        self.groups = frozenset(groups)
        engine.part = weakref.ref(self)

    @classmethod
    def of(cls, system: openmm.System) -> CarriedConstraints:
        """The rows that a System brings along which was read from XML or copied; those of copies are one.

        Raises
        ------
        InputError
            It has none.
        """
        found = {force.getName(): force for force in system.getForces() if isinstance(force, openmm.PythonForce)}
        keys = sorted({name.split()[-1] for name in found if name.startswith(PREFIX)})
        keys = [key for key in keys if key in LIVE]
        if len(keys) != 1:
            raise InputError(
                f"the System carries {len(keys) or 'no'} sets of rows of kcons; expected one", item="system"
            )
        part = LIVE[keys[0]].part() or object.__new__(cls)
        mine = [found[force_name(phase, keys[0])] for phase in PHASES]
        if hands_over_all():
            for force in mine:
                force.setParticles([])
        part._bind(LIVE[keys[0]], [force.getForceGroup() for force in mine])
        part._look_at(system)
        return part

    def forces(self) -> list[openmm.PythonForce]:
        """The forces that carry the rows; `add_to` puts them into the System."""
        forces = []
        engine = self._engine
        for phase in PHASES:
            force = openmm.PythonForce(Callback(engine, phase))
            if not (engine.whole or hands_over_all()):
                force.setParticles(engine.atoms.tolist())
            force.setUsesPeriodicBoundaryConditions(engine.cell is not None)
            force.setForceGroup(self._groups[phase])
            force.setName(force_name(phase, engine.key))
            forces.append(force)
        return forces

    def add_to(self, system: openmm.System) -> None:
        """Put the forces into the System; before the Context is made."""
        for force in self.forces():
            system.addForce(force)
        self._look_at(system)

    def _look_at(self, system: openmm.System) -> None:
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

    def engine_at(self, context: openmm.Context) -> tuple[Motion, FloatArray]:
        """The engine, and the positions it takes."""
        return self.motion, self._state(context)[0]

    @property
    def atoms(self) -> IntArray:
        """Particles that a row touches."""
        return self._engine.atoms

    def rank(self, context: openmm.Context | None = None) -> int:
        """Degrees of freedom that the rows take; particles without mass never had any."""
        fixed = int(np.count_nonzero(self.motion.masses[self.atoms] == 0))
        return self.motion.rank - 3 * fixed

    # -- in a context ---------------------------------------------------------------------------

    def check(self, context: openmm.Context, velocities: bool = True) -> None:
        """Raise unless the state of the context is on the rows; also whatever is wrong with the set-up.

        Raises
        ------
        InputError
            Positions or velocities off the rows; forces that were not added; masses that have changed.
        UnsupportedError
            Constraints left in the System, virtual sites or a barostat that do not go together with the rows.
        """
        require_context(context)
        system, precision = context.getSystem(), Precision.of(context)
        refuse_single_precision(precision)
        _check_system(system, self._engine, precision, alone=self.alone)
        refuse_agents(system, self.motion.constraint_set, context.getMolecules)
        x, v, time = self._state(context)
        self._tell_of_rounding(x)
        miss = self._worst(x, None, time)
        if miss is not None:
            raise InputError(
                f"{miss}; bring them onto the rows by apply_positions(context), or correct them",
                item="positions",
                atoms=miss.atoms,
            )
        if not velocities:
            return
        tangent = self.motion.project_velocities(x, v, time=time)
        away = np.abs(tangent - v)
        if away.max() > self._engine.passage.limits[1] * max(np.abs(v).max(), np.abs(tangent).max()):
            atom = int(np.argmax(away.max(axis=1)))
            raise InputError(
                f"velocities violate the rows: atom {atom} moves off them with {away[atom].max():.6g} nm/ps; "
                "remove that part by apply_velocities(context)",
                item="velocities",
                atoms=[atom],
            )

    def take_place(self, program: Program, context: openmm.Context) -> None:
        """A State or checkpoint that was loaded is where its own steps ended, the engine is not."""
        self._engine.stand_at(self._state(context)[0])

    def worst_miss(self, context: openmm.Context, velocities: bool = True) -> Miss | None:
        """sigma and A v of the constraints that were given, from the positions and velocities of the context."""
        x, v, time = self._state(context)
        return self._worst(x, v if velocities else None, time)

    def _worst(self, x: FloatArray, v: FloatArray | None, time: float) -> Miss | None:
        held = self.motion.sources[0]
        found = held.residuals(x, v, time)
        near, slow = self._engine.passage.limits
        allowed = np.maximum(near * held.scale, found.allowed)
        reach = np.abs(x[held.touched]).max(initial=0.0)
        if self._slopes is None:
            gradients = held.jacobian(x, time)
            self._slopes = np.sqrt(gradients.multiply(gradients).sum(axis=1))
        if self._engine.rounded(x):
            allowed += 2.0**-22 * reach * self._slopes
        miss = Miss.worst("positions", found.sigma, allowed, held.row_name, held.row_atoms, NEAR * held.scale)
        if miss is not None or found.rates is None or found.speeds is None:
            return miss
        size = found.speeds + 0.1 * np.max(found.speeds, initial=0.0)
        # What is taken from v where it is carried together with x: all there is of a body at rest.
        lost = 4 * SPEED_SCALE * self._engine.passage.grain(reach) * self._slopes
        return Miss.worst("velocities", found.rates, slow * size + lost, held.row_name, held.row_atoms)

    def _tell_of_rounding(self, x: FloatArray) -> None:
        """Once."""
        held = self.motion.constraint_set
        if not self._told and held.n_rows:
            reach = float(np.abs(x[held.touched]).max())
            self._told = warned_of_rounding(reach, self._engine.passage.grain(reach), float(held.scale.min()))

    def apply_positions(self, context: openmm.Context) -> None:
        """Bring positions onto the rows, with other bonds and angles as they are. Velocities stay as they are.

        Bonds are those of the System's forces and constraints; see `Motion.restore_positions`.

        Raises
        ------
        InfeasibleError, InputError
            As `Motion.restore_positions`; nothing was changed.
        """
        x, _, time = self._state(context)
        bonds = bonds_of(context.getSystem(), x)
        brought = self.motion.restore_positions(x, time=time, bonds=bonds if len(bonds) else None)
        miss = self._worst(brought, None, time)
        if miss is not None:
            raise InfeasibleError(
                f"the rows cannot be reached from here: {miss}; nothing was changed. Start nearer to the targets",
                residual=abs(miss.off),
                row=miss.row,
                atoms=miss.atoms,
            )
        context.setPositions(brought)
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
        require_context(context)
        state = context.getState(positions=True, velocities=True)
        if self._engine.cell is not None:
            self._engine.follow_cell(state)
        x = state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
        v = state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond)
        return x, v, state.getTime().value_in_unit(unit.picosecond)

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


def _check_system(system: openmm.System, engine: Engine, precision: Precision, *, alone: bool) -> None:
    """Raise where the System is not the one that the rows were built for; `alone` if it had no constraints."""
    forces = {force.getName(): force for force in system.getForces()}
    missing = {force_name(phase, engine.key) for phase in PHASES} - set(forces)
    if missing:
        raise InputError(
            "the System has no forces that carry these rows; call add_to(system), or hold(system, ...), before "
            "the Context is made; those of a copy of a System are CarriedConstraints.of(copy)",
            item="system",
        )
    refuse_some_particles(forces[force_name(PHASES[0], engine.key)], precision)
    now = masses_of(system)
    if len(now) != len(engine.masses) or np.any(now[engine.atoms] != engine.masses[engine.atoms]):
        raise InputError("masses have changed since the rows were built; build them again", item="masses")
    refuse_virtual_sites(system, engine.atoms, now)
    if alone and system.getNumConstraints():
        raise InputError(
            "the System got constraints after the rows were added to it; add the rows, by hold or add_to, last",
            item="system",
        )
    refuse_shared_atoms(system, set(engine.atoms.tolist()))
