"""Molecular dynamics of constrained atoms by the steppers of kcons, and its log."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from operator import is_
from typing import IO, Any

import numpy as np
from ase import Atoms, units
from ase.md.logger import MDLogger
from ase.md.md import MolecularDynamics

from kcons.ase.binding import (
    FORCES_ONLY,
    START_TOLERANCE,
    Binding,
    applied_forces,
    bind,
    company,
    differ,
    read_by_engine,
    require_on_surface,
    stress_of_rows,
    unchanged_on_failure,
)
from kcons.ase.constraints_object import Constraints, listed
from kcons.ase.topology import require_atoms, velocities_of
from kcons.ase.translation import translated
from kcons.constraints import Constraint
from kcons.constraints.arguments import finite_array, finite_number, refuse_other
from kcons.constraints.compilation import njit
from kcons.constraints.constraint_set import rows_like
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.motion.certificate import checked_every
from kcons.motion.motion import Motion
from kcons.steppers import Rattle, State, Stepper, System
from kcons.steppers.stepper import Listed, require_stepper
from kcons.thermostats import Isokinetic
from kcons.thermostats.barostats import Barostat, ConstantPressure, in_cell

#: See `System`: nearer than this, the positions of a trajectory are the whole state.
FAR = 128.0

#: Arrays of atoms that calculators read.
_READ = ("numbers", "initial_charges", "initial_magmoms")


class ConstrainedDynamics(MolecularDynamics):
    """Dynamics at constant energy on the constraints, by any stepper of `kcons.steppers`.

    Used as ASE's own classes are (`run`, `irun`, `attach`, trajectories, logs). Holds what the constraints on the atoms
    hold - those of kcons, and those of ASE that `from_ase_constraints` knows - all as one set, and what `constraints`
    adds. Velocities come from the multipliers: the distance from the origin costs no accuracy.

    Parameters
    ----------
    atoms : ase.Atoms
        With a calculator. Forces of Hookean and ExternalForce count as applied forces.
    timestep : float
        In ASE's unit of time; negative to go back, 0 to stand still. `set_timestep` changes it between steps.
    stepper : Stepper, optional
        `Rattle` by default; of order 4 or 6 where accuracy counts.
    constraints : sequence of Constraint, optional
        More than what is on the atoms; here also targets that move with time and velocity (nonholonomic) rows, for
        which ASE has no place. ASE's temperature does not know of these: use `get_temperature` of this object.
    time : float
        Time at the start, for targets that move.
    state : State, optional
        Go on from here: what `state` of another run gave, or `kcons.State.load` read. Positions, momenta, time and the
        number of steps are taken from it, `time` is not looked at. Forces are asked of the calculator.
    check_every : int, optional
        As for `kcons.run`: steps from one certificate of the state to the next.
    trajectory, logfile, loginterval, **kwargs
        As for all dynamics of ASE; the log is a `ConstraintLogger`, with the temperature of `get_temperature`.

    Raises
    ------
    InputError
        Time step not finite; atoms off their constraints (see `Constraints.restore`); a state of other atoms.
    UnsupportedError
        An ASE constraint on the atoms that kcons cannot hold; a stepper that cannot do what is asked of it.

    Notes
    -----
    Where a step fails, atoms keep positions and momenta of the last good step, and the error names the step; an
    exception of the calculator itself passes through, with the number of the step in its attribute `step`.

    A run that is continued is the same to the last bit, if the calculator gives the same forces: from a trajectory; or,
    where targets move or the system is far from the origin (more than 128 times its size), from `state`.
    """

    #: Besides that of the atoms.
    _calculators: tuple[Any, ...] = ()
    _longest = 20.1 * units.fs  # others look like a slip of units: 2 is 20.4 fs
    #: What changes the cell, beside a stepper that keeps a temperature.
    barostat: Barostat | None = None

    def __init__(
        self,
        atoms: Atoms,
        timestep: float,
        stepper: Stepper | None = None,
        *,
        constraints: Constraint | Iterable[Constraint] = (),
        time: float = 0.0,
        state: State | None = None,
        check_every: int | None = None,
        **kwargs: Any,
    ) -> None:
        require_atoms(atoms)
        self._check_every, self._spare = checked_every(check_every)
        self.time = finite_number(time, "time")
        self.stepper: Stepper = Rattle() if stepper is None else stepper
        require_stepper(self.stepper)
        self._more = listed(constraints)
        self._present: tuple[Any, ...] | None = None
        self._bound: Binding | None = None
        self._system: System | None = None
        self._state: State | None = None
        self._cell: tuple[bytes, ...] = ()
        self._asked: tuple[Any, ...] = ()  # calculators, and where each keeps what it found
        self._momenta = self._masses = np.zeros((0, 3))  # momenta as written last; masses, 0 for fixed atoms
        self.atoms, self.nsteps = atoms, 0
        self.set_timestep(timestep)
        with unchanged_on_failure(atoms):
            if not atoms.has("momenta"):
                atoms.set_momenta(np.zeros((len(atoms), 3)), apply_constraint=False)
            if state is not None:
                refuse_other(state, State, "state", "a kcons.State, such as State.load(file) or that of another run")
                self._resume(state)
            self._asked = self._calculators_now()
            self._start(self._systems())
            self._begin()
            # Files last: to open one for writing ends what an older run left there.
            steps, logfile = self.nsteps, kwargs.pop("logfile", None)
            super().__init__(atoms, self.dt, **kwargs)
            self.nsteps = steps
            if logfile:
                log = self.closelater(ConstraintLogger(self, atoms, logfile, comm=self.comm))
                self.attach(log, kwargs.get("loginterval", 1))

    def _begin(self) -> None:
        """What else a class does before the first step is logged."""

    # -- what a person asks for -----------------------------------------------------------------

    def set_timestep(self, timestep: float) -> None:
        """Use another time step from now on."""
        self.dt = finite_number(timestep, "timestep")
        if abs(timestep) > self._longest:
            said = f"the step is {timestep / units.fs:.4g} fs. Is that meant? Give 2 fs as 2 * ase.units.fs"
            warnings.warn(said, UserWarning, stacklevel=3)

    def get_time(self) -> float:
        """The time reached, in ASE's unit; right also if the time step was changed."""
        return self.time

    @property
    def state(self) -> State:
        """All that the next step depends on, to be saved (`State.save`) and given to another run as `state`.

        Its arrays cannot be changed; the atoms' own can.
        """
        return self._start(self._systems()).read_only()

    @property
    def motion(self) -> Motion:
        """The engine of everything that is held."""
        return self._systems().motion

    @property
    def degrees_of_freedom(self) -> int:
        """3 N less the rank of everything that is held."""
        return self._systems().motion.degrees_of_freedom

    def get_kinetic_energy(self) -> float:
        """Kinetic energy in eV; of a bath with noise that of the middle of the last step, see `ConstrainedLangevin`."""
        step, energy = getattr(self.stepper, "exchanged", None) or (-1, 0.0)
        if step == self.nsteps and np.array_equal(self.atoms.arrays["momenta"], self._momenta):
            return float(energy)
        return float(self.atoms.get_kinetic_energy())

    def get_temperature(self) -> float:
        """Kinetic temperature in K by `degrees_of_freedom`, which counts all rows; 0 if there are none."""
        freedom = self.degrees_of_freedom
        return 2 * self.get_kinetic_energy() / (freedom * units.kB) if freedom else 0.0

    def todict(self) -> dict[str, Any]:
        """As ASE stores it in trajectories."""
        return {**super().todict(), "stepper": repr(self.stepper)}

    def listing(self) -> str:
        """What a step consists of, a line for each operation; the name alone for steppers that have no list."""
        return self._mover.listing(self._systems()) if isinstance(self._mover, Listed) else repr(self._mover)

    @property
    def _mover(self) -> Stepper:
        """What makes the steps."""
        return self.stepper if self.barostat is None else ConstantPressure(self.stepper, self.barostat)

    # -- steps ----------------------------------------------------------------------------------

    def step(self) -> None:
        """One step; on any error the atoms are as they were before it.

        Raises
        ------
        NonFiniteError, InputError
            The calculator returned NaN, or an array of the wrong shape; the step is named.
        ConvergenceError
            No solution: the time step is too large; carries `step`.
        """
        system = self._systems()
        state = self._start(system)
        try:
            with in_step(self.nsteps + 1):
                after = self._mover.step(system, state, self.dt)
                if self._check_every and self.dt and getattr(self.stepper, "holds", True):
                    system.schedule.made(1, self._check_every, after, self.dt, spare=self._spare)
        except BaseException:
            atoms = self.atoms.arrays
            atoms["positions"][...], atoms["momenta"][...] = state.positions, self._momenta
            self.atoms.cell[...] = np.frombuffer(self._cell[0]).reshape(3, 3)  # which barostats change
            self._bound.cell = b""  # type: ignore[union-attr]  # the engine takes it again
            raise
        v = self._put(after.positions, after.velocities)
        self.time = after.time
        carried = after.remainder, after.time_remainder, after.thermostat, after.barostat
        self._state = State(after.positions, v, after.time, after.forces, after.step, *carried)
        system.follow(after, self._state)
        self._asked = self._calculators_now()
        if after.barostat is not None:
            self._cell = surroundings(self.atoms)

    def _refresh_properties(self) -> None:
        """Have forces for someone who looks."""
        if any(self.nsteps % every == 0 if every > 0 else self.nsteps == -every for _, every, *_ in self.observers):
            with in_step(self.nsteps):
                self.atoms.get_forces(apply_constraint=False)  # with which some steppers do not end
            self._asked = self._calculators_now()

    def _start(self, system: System) -> State:
        """The state that the atoms are in; what it carries besides is kept as long as nobody moved them."""
        atoms = self.atoms
        x, p = atoms.arrays["positions"], atoms.arrays["momenta"]
        last = self._state
        asked = self._calculators_now()
        if last is not None and not all(map(is_, asked, self._asked)):
            # Another calculator, or one that was reset or asked elsewhere since: it is asked again.
            last = replace(last, forces=None)
            if asked[0] is not self._asked[0]:
                last = replace(last, thermostat=self._thermostat_after_change(last))
            self._state, self._asked = last, asked
        cell = surroundings(atoms)
        same = last is not None and cell == self._cell and not differ(x, last.positions)
        if last is not None and same and not differ(p, self._momenta):
            if last.time != self.time:
                require_on_surface(system.motion.constraint_set, x, self.time)
                last = replace(last, time=self.time, time_remainder=0.0)
            return last if last.step == self.nsteps else replace(last, step=self.nsteps)
        v = np.divide(p, self._masses, out=np.zeros_like(p), where=self._masses != 0.0)
        require_on_surface(system.motion.constraint_set, x, self.time)
        state = system.initial_state(x, v, time=self.time, project=True)
        forces = last.forces if last is not None and same and np.array_equal(state.positions, x) else None
        thermostat = self._thermostat_after_change(last)
        if np.array_equal(state.velocities, v):
            self._momenta = p.copy()
            x[...] = state.positions
        else:
            v = self._put(state.positions, state.velocities)
        carried = state.remainder, 0.0, thermostat, None if last is None else in_cell(last.barostat, atoms.cell.array)
        self._state = State(state.positions, v, self.time, forces, self.nsteps, *carried)
        self._cell = cell
        return self._state

    def _put(self, positions: FloatArray, velocities: FloatArray) -> FloatArray:
        """Give the atoms positions and momenta; the velocities that belong to these, as after a restart from a file."""
        arrays = self.atoms.arrays
        self._momenta, v = np.empty_like(velocities), np.empty_like(velocities)
        write_back(positions, velocities, self._masses, arrays["positions"], arrays["momenta"], self._momenta, v)
        return v

    def _resume(self, state: State) -> None:
        """Go on from `state` exactly, in the cell that a barostat left."""
        if state.cell is not None:
            self.atoms.cell[...] = state.cell
        system, n = self._systems(), len(self.atoms)
        x, v = finite_array(state.positions, n, "positions"), finite_array(state.velocities, n, "velocities")
        require_on_surface(system.motion.constraint_set, x, state.time)
        away = np.abs(system.motion.project_velocities(x, v, time=state.time) - v).max(initial=0.0)
        if away > START_TOLERANCE * np.abs(v).max(initial=0.0) and away > system.rest(x, v, state.time):
            message = f"velocities of the state leave the constraints by {away:.3g}; was it saved with others?"
            raise InputError(message, item="state")
        self.time, self.nsteps = float(state.time), int(state.step)
        self._put(x, v)
        # Forces are asked for anew: nobody knows which calculator those of a file are of.
        known: dict[str, Any] = {"positions": x, "velocities": v, "time": self.time, "step": self.nsteps}
        self._state = replace(state.copied(), **known, forces=None, origin=None)
        self._cell = surroundings(self.atoms)

    def _thermostat_after_change(self, last: State | None) -> FloatArray | None:
        """What a thermostat goes on with where somebody moved the atoms: the isokinetic one begins anew."""
        if last is None or last.thermostat is None or isinstance(self.stepper, Isokinetic):
            return None
        # A copy shows a chain that momenta may be new, and Monte Carlo that the energy may be.
        return last.thermostat.copy()

    def _calculators_now(self) -> tuple[Any, ...]:
        """The calculators, and where each keeps what it found last: another object after other questions."""
        calculators = (self.atoms.calc, *self._calculators)
        return (*calculators, *(getattr(each, "results", None) for each in calculators))

    # -- the system -----------------------------------------------------------------------------

    def _systems(self) -> System:
        """The system for the atoms as they are; built anew if masses, constraints or periodicity changed."""
        atoms = self.atoms
        for name in ("positions", "momenta"):  # kernels write to them
            atoms.arrays[name] = np.ascontiguousarray(atoms.arrays[name], np.float64)
        present, bound = company(atoms.constraints), self._bound
        if bound is None or present != self._present or bound.made_for != read_by_engine(atoms):
            gone = 0 if bound is None else bound.motion.n_atoms - len(atoms)
            if gone > 0 and self._more:
                raise InputError(
                    f"{gone} of {len(atoms) + gone} atoms were removed, and constraints that the dynamics was given "
                    "name atoms by their numbers, which are others now; make a new one",
                    item="atoms",
                )
            holding = [item for item in atoms.constraints if not isinstance(item, FORCES_ONLY)]
            for item in holding:
                if isinstance(item, Constraints):
                    item.engine(atoms)  # settles targets that are open
            rows = [*translated(atoms, holding), *self._more]
            bound = bind(rows, atoms, self.time)
            # Targets that were left open stay as found, also when the engine is built again.
            self._more = bound.given[len(rows) - len(self._more) :]
            self._bound, self._present, self._state = bound, company(atoms.constraints), None
            self._only_forces = len(holding) < len(atoms.constraints)
            self._system = self._made(bound.motion)
            self._system.time_unit = ("fs", units.fs)
            self._mover.check(self._system)
            moving = self._system.inverse_masses > 0
            self._masses = np.where(moving, self._system.masses[:, None], np.zeros(3))
        else:
            bound.follow_cell(atoms, atoms.cell.array)
        assert self._system is not None
        return self._system

    def _made(self, motion: Motion) -> System:
        return System(motion, self._force, potential=self._energy, far=FAR)

    def _energy(self, x: FloatArray, time: float) -> float:
        """Of the calculator, and of Hookean and ExternalForce."""
        self.atoms.arrays["positions"][...] = x
        return applied_energy(self.atoms, self._only_forces)

    def _force(self, x: FloatArray, time: float) -> Any:
        self.atoms.arrays["positions"][...] = x
        return applied_forces(self.atoms) if self._only_forces else self.atoms.get_forces(apply_constraint=False)


@njit(cache=True, nogil=True, error_model="numpy")
def write_back(positions, velocities, masses, x, p, momenta, v):  # type: ignore[no-untyped-def]
    """Put positions and momenta into `x` and `p`, the momenta also into `momenta`, and p/m into `v`.

    Of fixed atoms, which have no momenta, the velocities stay: those of targets that move.
    """
    a, b, m = positions.ravel(), velocities.ravel(), masses.ravel()
    c, e, f, g = x.ravel(), p.ravel(), momenta.ravel(), v.ravel()
    for i in range(a.size):
        momentum = m[i] * b[i]
        c[i] = a[i]
        e[i] = momentum
        f[i] = momentum
        g[i] = momentum / m[i] if m[i] != 0.0 else b[i]


def applied_energy(atoms: Atoms, only_forces: bool) -> float:
    """The energy of which forces and stress are derivatives; with that of ASE objects where these add forces."""
    energy = float(atoms.get_potential_energy(apply_constraint=only_forces))
    found = getattr(atoms.calc, "results", {})
    free = found.get("free_energy")
    # Where electrons have a temperature, "energy" is extrapolated to zero; both may be infinite.
    if free is not None and "energy" in found and free != found["energy"]:
        energy += float(free - found["energy"])
    return energy


@contextmanager
def in_step(number: int) -> Iterator[None]:
    """Note in an error which step it belongs to."""
    try:
        yield
    except BaseException as error:
        if getattr(error, "step", None) is None:
            with suppress(AttributeError):
                error.step = number  # type: ignore[attr-defined]
            error.add_note(f"in step {number}; the atoms are as they were at the end of the last good step")
        raise


def surroundings(atoms: Atoms) -> tuple[bytes, ...]:
    """The cell, first, what calculators read of atoms beside their positions, and what ASE objects add to forces."""
    parts = [atoms.cell.array.tobytes(), atoms.pbc.tobytes()]
    parts += [atoms.arrays[name].tobytes() for name in _READ if name in atoms.arrays]
    parts += [repr(item.todict()).encode() for item in atoms.constraints if isinstance(item, FORCES_ONLY)]
    return tuple(parts)


# -- the log ----------------------------------------------------------------------------------------


class ConstraintLogger(MDLogger):
    """`ase.md.MDLogger` with temperature and stress of all that the dynamics holds, and multipliers by name.

    ASE's own logger counts what the objects on the atoms remove. Rows that only the dynamics holds, and total momentum
    that a thermostat leaves alone, are missing there, and constraint forces of such rows in the stress. ``logfile=`` of
    the dynamics of kcons is such a log. With a bath that has noise, kinetic energy and temperature are of the middle of
    the step; see `ConstrainedLangevin`.

    Parameters
    ----------
    dyn : MolecularDynamics
        Of kcons, or another of ASE whose atoms carry `Constraints`.
    atoms : ase.Atoms
    logfile : path, text file or '-'
    coordinates : mapping of str to Constraint
        What is held, each named by an object of the same kind on the same atoms, whatever its target. Each row of it is
        a column: its multiplier, in eV by angstrom or by radian, the force along the coordinate that holds it.
    **kwargs
        As for `ase.md.MDLogger`: header, stress, peratom, mode.
    """

    def __init__(
        self,
        dyn: Any,
        atoms: Atoms,
        logfile: IO[str] | str,
        coordinates: Mapping[str, Constraint] | None = None,
        *,
        header: bool = True,
        **kwargs: Any,
    ) -> None:
        if coordinates is not None:
            refuse_other(coordinates, Mapping, "coordinates", "each a name: {'torsion': torsion}")
            for name, item in coordinates.items():
                refuse_other(item, Constraint, f"coordinates[{name!r}]", "a constraint that is held")
        self.coordinates = dict(coordinates or {})
        self._known: tuple[Motion, list[int]] | None = None
        if self.coordinates:
            self._rows(engine_of(dyn, atoms))
        super().__init__(dyn, atoms, logfile, header=False, **kwargs)
        for name, item in self.coordinates.items():
            for column in [name] if item.n_rows == 1 else [f"{name}[{k}]" for k in range(item.n_rows)]:
                title = f"lambda({column})"
                self.hdr += f" {title:>14s}"
                self.fmt = f"{self.fmt.rstrip()} %{max(14, len(title))}.6g\n"
        if header:
            self.logfile.write(f"{self.hdr}\n")

    def __call__(self) -> None:
        """Write a line."""
        atoms: Atoms = self.atoms
        dyn: Any = self.dyn
        ours = hasattr(dyn, "degrees_of_freedom")
        seen, time = dyn if ours else atoms, 0.0 if dyn is None else dyn.get_time()
        v = velocities_of(atoms, dyn)
        count = len(atoms) if self.peratom else 1
        potential, kinetic = atoms.get_potential_energy() / count, seen.get_kinetic_energy() / count
        row = [] if dyn is None else [time / (1000 * units.fs)]
        row += [potential + kinetic, potential, kinetic, seen.get_temperature()]
        if self.stress:
            stress = atoms.get_stress(apply_constraint=not ours, include_ideal_gas=True)
            if ours:  # that of all rows that the dynamics holds
                stress = stress + stress_of_rows(dyn.motion, atoms, v, time)
            row += (stress / units.GPa).tolist()
        if self.coordinates:
            motion = engine_of(dyn, atoms)
            multipliers = motion.multipliers(atoms.positions, v, applied_forces(atoms), time)
            row += multipliers[self._rows(motion)].tolist()
        self.logfile.write(self.fmt % tuple(row))
        self.logfile.flush()

    def _rows(self, motion: Motion) -> list[int]:
        """Rows of the coordinates among those that the engine holds."""
        if self._known is None or self._known[0] is not motion:
            held = motion.constraint_set
            rows = [row for name, item in self.coordinates.items() for row in rows_like(held, item, name)]
            self._known = motion, rows
        return self._known[1]


def engine_of(dyn: Any, atoms: Atoms) -> Motion:
    """The engine of a dynamics class of kcons, or that of the object on the atoms."""
    if hasattr(dyn, "motion"):
        return dyn.motion  # type: ignore[no-any-return]
    found = [item for item in atoms.constraints if isinstance(item, Constraints)]
    if len(found) != 1:
        raise InputError(
            f"the atoms carry {len(found) or 'no'} Constraints objects of kcons, and a coordinate is held by one; see "
            "kcons.ase.constrain, and kcons.ase.attach, which makes one of several and of those from a file",
            item="coordinates",
        )
    return found[0].engine(atoms)
