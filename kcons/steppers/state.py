"""Where a system is (`State`), and what acts on it (`System`)."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias
from weakref import ReferenceType, ref

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import (
    as_array,
    as_float_array,
    check_call,
    finite_array,
    finite_number,
    read_only_view,
    refuse_other,
)
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import extent
from kcons.errors import CertificateError, InputError, OverdeterminedError
from kcons.motion.certificate import Schedule, off_row
from kcons.motion.motion import Motion
from kcons.solvers.addressable_solvers import pack_solver_tables
from kcons.steppers.compiled_operations import beyond, check_finite
from kcons.steppers.files import in_one_piece, refuse_clock, stored_arrays, write_arrays
from kcons.steppers.packed_system import PackedSystem, packed_system, spheres_of

#: Positions farther from the origin than this many times the size of what is held carry their remainder.
FAR = 8.0

#: Residual of initial positions (by the row's scale) and velocities (by the speed) that is taken for rounding.
START_TOLERANCE = 1e-9

#: Rounding of velocities in all stages of a step, relative to its kick.
KICK_ROUNDING = 64 * float(np.finfo(float).eps)

_FLOAT = np.dtype(np.float64)
Origin: TypeAlias = tuple[ReferenceType[Any] | None, FloatArray, FloatArray, float]


@dataclass(frozen=True, eq=False, init=False)
class State:
    """Where a system is.

    Attributes
    ----------
    positions, velocities : ndarray, shape (n_atoms, 3)
        In the caller's units. Arrays of states that kcons makes cannot be written to: states share them where nothing
        changed, and forces belong to them. `dataclasses.replace` makes another state.
    time : float
    forces : ndarray, shape (n_atoms, 3), or None
        Applied forces at this state, None before they are known. With them in hand a step evaluates the
        forces once, and a run that is continued from a saved state continues bit for bit.
    step : int
        Steps done since the start.
    remainder : ndarray, shape (n_atoms, 3), or None
        What rounding took from the positions, kept where they are far from the origin (see `System.initial_state`).
    time_remainder : float
        What rounding took from the time, so that a million steps of dt are a million dt.
    thermostat, barostat : ndarray or None
        Their variables, if there are such; those of a barostat begin with the cell, alone before its first step.
    origin : tuple of a weak reference to System, or None, of positions, velocities and time; or None
        Whose forces these are, and where: those of another System, other positions, times, or velocities (if forces
        depend on these) are evaluated anew. Without a System (loaded, or made by hand) they are taken by any.
    """

    positions: FloatArray
    velocities: FloatArray
    time: float
    forces: FloatArray | None
    step: int
    remainder: FloatArray | None
    time_remainder: float
    thermostat: FloatArray | None
    barostat: FloatArray | None
    origin: Origin | None

    def __init__(
        self,
        positions: FloatArray,
        velocities: FloatArray,
        time: float = 0.0,
        forces: FloatArray | None = None,
        step: int = 0,
        remainder: FloatArray | None = None,
        time_remainder: float = 0.0,
        thermostat: FloatArray | None = None,
        barostat: FloatArray | None = None,
        origin: Origin | None = None,
    ) -> None:
        # Written out, since a step makes one: what dataclass writes takes three times as long.
        origin = (None, positions, velocities, time) if origin is None and forces is not None else origin
        own = vars(self)
        own["positions"], own["velocities"], own["time"], own["forces"] = positions, velocities, time, forces
        own["step"], own["remainder"], own["time_remainder"] = step, remainder, time_remainder
        own["thermostat"], own["barostat"], own["origin"] = thermostat, barostat, origin

    def __getstate__(self) -> dict[str, Any]:
        """All that means something to another process."""
        return {name: value for name, value in vars(self).items() if name != "origin"}

    def __setstate__(self, own: dict[str, Any]) -> None:
        vars(self).update(vars(State(**own)))

    @property
    def cell(self) -> FloatArray | None:
        """Where it is not always the same, vectors as rows, shape (3, 3); otherwise None."""
        return None if self.barostat is None else self.barostat[:9].reshape(3, 3)

    def later(self, dt: float) -> tuple[float, float]:
        """Time after `dt`, and what its rounding leaves over (Knuth's exact sum)."""
        step = dt + self.time_remainder
        time = self.time + step
        part = time - self.time
        return time, (self.time - (time - part)) + (step - part)

    def is_of(self, system: object) -> bool:
        """Whether the state is of this System, as far as one can tell."""
        return self.origin is None or self.origin[0] is None or self.origin[0]() is system

    def has_forces_of(self, system: System) -> bool:
        """Whether it carries forces of this System, of its positions, velocities and time, as far as one can tell."""
        if self.origin is None or self.forces is None:
            return self.forces is not None
        if system.force is None and np.any(self.forces):
            return False
        (_, there, v, time), here = self.origin, self.positions
        if time != self.time or (system.velocity_dependent and not np.array_equal(v, self.velocities)):
            return False
        return self.is_of(system) and (there is here or np.array_equal(there, here))

    def save(self, file: str | PathLike[str] | BinaryIO) -> None:
        """Write everything the state holds in NumPy's .npz format: a run continued from it is the same to the last bit.

        Parameters
        ----------
        file : path or binary file
            A path is replaced in one piece, so that an interrupted write leaves the older file.
        """
        present = {name: value for name, value in self.__getstate__().items() if value is not None}
        with in_one_piece(file) if isinstance(file, str | PathLike) else nullcontext(file) as opened:
            write_arrays(opened, present)

    @classmethod
    def load(cls, file: str | PathLike[str] | BinaryIO) -> State:
        """Read what `save` wrote.

        Raises
        ------
        InputError
            The file holds no state, or not all of it is as it was written.
        """
        if isinstance(file, str | PathLike):
            with Path(file).open("rb") as opened:
                return cls.load(opened)
        try:
            return cls(**stored_arrays(file))
        except Exception as error:  # a damaged archive raises whatever its bytes lead to
            name = getattr(file, "name", "the file")
            raise InputError(f"{name} holds no state written by State.save: {error}", item="file") from error

    def read_only(self) -> State:
        """The same state for a function of the user, who can read its arrays and not change them."""
        if any(isinstance(a, np.ndarray) and a.flags.writeable for a in vars(self).values()):
            return self._with_arrays(read_only_view)
        return self

    def copied(self) -> State:
        """The same state with arrays of its own."""
        return self._with_arrays(np.ndarray.copy)

    def _with_arrays(self, change: Callable[[FloatArray], FloatArray]) -> State:
        own: dict[str, Any] = {n: change(a) if isinstance(a, np.ndarray) else a for n, a in vars(self).items()}
        return State(**own)


class System:
    """Constraints, masses and applied forces; for one thread at a time. Threads can share steppers.

    Parameters
    ----------
    motion : Motion
        The engine of the constraint set, and the masses. A set without rows gives unconstrained dynamics.
    force : callable, optional
        Applied forces, shape (n_atoms, 3), ``force(x, t)``, or ``force(x, v, t)`` if `velocity_dependent`.
    potential : callable, optional
        Potential energy ``potential(x, t)``, for `total_energy`.
    velocity_dependent : bool
        Whether `force` takes the velocities too (magnetic fields, drag that is not linear).
    far : float
        From this many times the size of what is held away from the origin, states carry the remainder of
        their positions. Infinite: never, so that positions and velocities alone are the whole state.

    Raises
    ------
    InputError
        A mass that is not positive, of an atom not held by FixedAtoms; functions of other arguments.
    """

    #: What messages call the unit in which they show time steps, and its size; no name for the unit of the system.
    time_unit: tuple[str, float] = ("", 1.0)

    def __init__(
        self,
        motion: Motion,
        force: Callable[..., ArrayLike] | None = None,
        *,
        potential: Callable[[FloatArray, float], float] | None = None,
        velocity_dependent: bool = False,
        far: float = FAR,
    ) -> None:
        refuse_other(motion, Motion, "motion", "a kcons.Motion")
        taken = ("x", "v", "t") if velocity_dependent else ("x", "t")
        check_call("force", force, taken, "; velocity_dependent says whether it gets velocities v")
        check_call("potential", potential, ("x", "t"))
        self.motion, self.far = motion, far if far == math.inf else finite_number(far, "far")
        if not self.far >= 1:
            raise InputError(f"far is {far}; give a number of 1 or more", item="far")
        self.force, self.potential = force, potential
        self.velocity_dependent = bool(velocity_dependent) and force is not None
        self.n_atoms, self._shape = motion.n_atoms, (motion.n_atoms, 3)
        self.masses: FloatArray = motion.masses
        bad = ~(np.isfinite(self.masses) & (self.masses > 0))
        bad[motion.fixed_atoms] = False
        if bad.any():
            atom = int(np.argmax(bad))
            raise InputError(
                f"atom {atom} has mass {self.masses[atom]:g}; atoms that move need positive mass "
                "(hold it with FixedAtoms, or leave it out)",
                item="masses",
                atoms=[atom],
            )
        with np.errstate(divide="ignore"):
            #: 1/m, shape (n_atoms, 1); 0 for fixed atoms.
            self.inverse_masses: FloatArray = (1.0 / self.masses)[:, None]
        self.inverse_masses[motion.fixed_atoms] = 0.0
        #: The same for each coordinate, shape (n_atoms, 3). Neither can be written to: kernels have them already.
        self.weights: FloatArray = np.repeat(self.inverse_masses, 3, axis=1)
        self.weights.setflags(write=False)
        self.inverse_masses.setflags(write=False)
        #: The state that the last step ended in, whose arrays need not be looked at.
        self.last: State | None = None
        #: Steps on their way that have ended in a state, whose they are, what they depend on, and they themselves.
        self.going: tuple[State, Any, Any, Any] | None = None

    def follow(self, after: State, state: State) -> None:
        """Let steps of kicks and drifts go on from `state`: what the last one ended in, velocities in other digits."""
        going = self.going
        if going is not None and going[0] is after and going[3].simple and not len(going[3].numbers):
            self.going = (state, *going[1:])

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "going": None}  # those steps are of this System

    @cached_property
    def schedule(self) -> Schedule:
        """When states of this system are certified."""
        return Schedule(self._certify)

    def shown_time(self, time: float) -> str:
        """A time in `time_unit`, for messages."""
        name, size = self.time_unit
        return f"{time / size:g} {name}".rstrip()

    def _certify(self, x: FloatArray, v: FloatArray, time: float, dt: float) -> None:
        try:
            self.motion.certify(x, v, time)
        except CertificateError:
            # By its speed alone nothing at rest could be certified, nor what is left of a kick along the constraints.
            self.motion.certify(x, v, time, still=self.rest(x, v, time, dt))

    # -- states ---------------------------------------------------------------------------------

    def require_on_rows(self, x: FloatArray, time: float) -> None:
        """Refuse positions that are off the constraints: the first step would turn the correction into velocity."""
        held = self.motion.constraint_set
        miss = np.abs(held.value(x, time))
        allowed = START_TOLERANCE * held.scale
        if not (miss <= allowed).all():  # gradients take as long as many a step
            allowed = np.maximum(allowed, 4 * held.tolerance(x, time))
        row = off_row(miss, allowed)
        if row >= 0:
            raise InputError(
                f"initial positions are off row {held.row_name(row)} by {miss[row]:.6g}; "
                "pass project=True to System.initial_state to bring them onto the constraints, or correct them",
                item="positions",
                atoms=held.row_atoms(row),
            )

    def initial_state(
        self,
        positions: ArrayLike,
        velocities: ArrayLike | None = None,
        *,
        time: float = 0.0,
        project: bool = False,
    ) -> State:
        """Checked state to start from.

        Parameters
        ----------
        positions, velocities : array_like, shape (n_atoms, 3)
            Copied and cast to float64. Without velocities the slowest admissible ones: zero where constraints rest.
        time : float
        project : bool
            Whether to bring positions and velocities onto the constraints (nearest in the mass metric), not to raise.

        Notes
        -----
        At 1e6 from the origin a position is rounded to 1e-10; a step that puts this right again turns it into
        velocity, 2e-9 of the energy in 1000 steps. Where all rows are independent of the origin, such states
        therefore carry the remainder of their positions, and steps are made relative to one of the atoms.

        Raises
        ------
        InputError
            Wrong shapes, NaN or infinity; positions or velocities off the constraints without `project`.
        InfeasibleError
            With `project`, if no solution can be reached.
        OverdeterminedError
            The rows leave no degree of freedom, and the velocities are not what they prescribe.
        """
        time = finite_number(time, "time")
        x = finite_array(positions, self.n_atoms, "positions")
        given = velocities is not None
        v = finite_array(velocities, self.n_atoms, "velocities") if given else np.zeros_like(x)
        motion, held = self.motion, self.motion.constraint_set
        if held.n_rows == 0:
            return State(x, v, time).read_only()
        try:
            self.require_on_rows(x, time)
        except InputError:
            if not project:
                raise
            x = motion.restore_positions(x, time=time)
        remainder, local, free = None, x, self._free_of_origin
        if free is not None and beyond(x, free, self.anchor, self.far):
            shift = x[self.anchor].copy()
            local = motion.restore_positions(x - shift, time=time)
            remainder = local - (x - shift)
        tangent = motion.project_velocities(local, v, time=time)
        away = np.abs(tangent - v)
        if (
            given
            and away.max() > START_TOLERANCE * max(np.abs(v).max(), np.abs(tangent).max())
            and (project or away.max() > self.rest(x, v, time))
        ):
            if motion.degrees_of_freedom == 0:
                raise OverdeterminedError(
                    f"rank {motion.rank} leaves no degree of freedom, yet atoms move: hold fewer rows, "
                    "or start without velocities",
                    rows=range(held.n_rows),
                )
            if not project:
                atom = int(np.argmax(away.max(axis=1)))
                raise InputError(
                    f"initial velocities violate the constraints: atom {atom} moves off them with "
                    f"{away[atom].max():.6g}; pass project=True to remove that part (the nearest admissible "
                    "velocities in the mass metric)",
                    item="velocities",
                    atoms=[atom],
                )
            given = False
        return State(x, v if given else tangent, time, remainder=remainder).read_only()

    def rest(self, x: FloatArray, v: FloatArray, time: float, dt: float = 0.0) -> float:
        """Speed below which velocities are rounding: of a kick by which atoms cross the system, or of one for `dt`."""
        kick = float(np.abs(self.forces(x, v, time, 0) * self.inverse_masses).max(initial=0.0))
        size = extent(x)
        # Or, in a run, one by which no atom has moved by more than its rounding since time 0.
        still = float(np.finfo(float).eps) * size / max(abs(time), abs(dt)) if time and dt else 0.0
        return max(KICK_ROUNDING * math.sqrt(kick * size), KICK_ROUNDING * kick * abs(dt), still)

    def forces(
        self, x: FloatArray, v: FloatArray, time: float, step: int, *, copy: bool = True, finite: bool = True
    ) -> FloatArray:
        """Applied forces, checked, shape (n_atoms, 3); `step` is named if they are not finite.

        Without `copy` they are good until the next evaluation only: calculators like to reuse their array. Without
        `finite` the caller looks for NaN and infinity.
        """
        if self.force is None:
            return np.zeros((self.n_atoms, 3))
        raw = (
            self.force(read_only_view(x), read_only_view(v), time)
            if self.velocity_dependent
            else self.force(read_only_view(x), time)
        )
        f = self.accepted(raw, step, copy)
        if finite:
            check_finite(f, "force", step)
        return f

    def accepted(self, raw: ArrayLike, step: int, copy: bool) -> FloatArray:
        """What the force function returned, as an array of doubles."""
        # Most often it is one already; each question costs a part of a percent of a step of few atoms.
        if type(raw) is np.ndarray and raw.dtype is _FLOAT and raw.shape == self._shape and raw.flags.carray:
            return raw.copy() if copy else raw
        try:
            f = np.array(as_float_array(raw, "forces"), order="C")
        except InputError as error:
            raise InputError(f"the force function, at step {step}: {error}", item="forces") from None
        if f.shape != self._shape:
            raise InputError(
                f"the force function returned shape {f.shape} at step {step}; it must return ({self.n_atoms}, 3)",
                item="forces",
            )
        return f

    def kernel_arrays(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Positions, velocities and forces of a state, as the kernels can take them.

        Raises
        ------
        InputError
            Wrong shapes, complex numbers, masked arrays, a time that is no finite number, a step that is no count: a
            state may have been made by hand.
        """
        x, v, f = state.positions, state.velocities, state.forces
        if state is self.last:
            return x, v, f
        refuse_clock(state.time, state.step, state.time_remainder)
        x, v = as_array(x, self._shape, "positions"), as_array(v, self._shape, "velocities")
        return x, v, None if f is None or not state.has_forces_of(self) else as_array(f, self._shape, "forces")

    def with_forces(self, state: State) -> State:
        """The state with its forces filled in."""
        if state.has_forces_of(self):
            return state
        x, v, _ = self.kernel_arrays(state)
        origin = ref(self), state.positions, state.velocities, state.time
        return replace(state, forces=self.forces(x, v, state.time, state.step), origin=origin)

    # -- energies -------------------------------------------------------------------------------

    def kinetic_energy(self, velocities: FloatArray) -> float:
        """sum m v^2/2; fixed atoms do not count."""
        moving = self.inverse_masses[:, 0] > 0
        return 0.5 * float(np.dot(self.masses[moving], np.einsum("ij,ij->i", velocities, velocities)[moving]))

    def total_energy(self, state: State) -> float:
        """Kinetic plus potential energy; needs `potential` unless there are no forces."""
        if self.potential is None and self.force is not None:
            raise InputError("this System has no potential; pass potential=... to follow the energy", item="potential")
        return self.kinetic_energy(state.velocities) + self.potential_energy(state.positions, state.time)

    def potential_energy(self, x: FloatArray, time: float) -> float:
        """What `potential` gives, 0 without it; `InputError` if that is not one real number."""
        if self.potential is None:
            return 0.0
        found = self.potential(read_only_view(x), time)
        if np.ndim(found) or not np.issubdtype(np.asarray(found).dtype, np.number) or np.iscomplexobj(found):
            raise InputError(
                f"the potential returned {found!r}; it must return one real number, the energy of all atoms",
                item="potential",
            )
        return float(found)

    # -- inner ----------------------------------------------------------------------------------

    @cached_property
    def moving_masses(self) -> FloatArray:
        """Masses for each coordinate, shape (3 n_atoms,); 0 for fixed atoms."""
        return np.repeat(np.where(self.inverse_masses[:, 0] > 0, self.masses, 0.0), 3)

    @cached_property
    def root_weights(self) -> FloatArray:
        """1/sqrt(m) for each coordinate, shape (n_atoms, 3); 0 for fixed atoms."""
        return np.sqrt(self.weights)

    def flown(self, x: FloatArray, v: FloatArray, h: float, time: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities after one flight along the constraints as they are at a time."""
        v = v.copy()
        out = x + h * v
        self.motion.project_positions(out, x, time=time, velocities=v, dt=h, flight=h, out=out)
        return out, v

    @cached_property
    def _more_tables(self) -> tuple[NDArray[Any], ...]:
        """What is behind the rows in the tables of kernels.

        1/m; atoms none of which is far from the first where the system is near the origin (none: it always is); how
        many times farther from the origin than from any other the first has to be then; great circles.
        """
        held, spheres = self._free_of_origin, self.great_circles
        atoms = np.zeros(0, dtype=np.int64) if held is None else np.append(self.anchor, held)
        return self.weights.ravel(), atoms, np.array([self.far]), np.zeros(0) if spheres is None else spheres.ravel()

    @cached_property
    def packed(self) -> PackedSystem | None:
        """What compiled steps know of the system; None where its rows are left to the engine."""
        return packed_system(self.motion, *self._more_tables)

    @cached_property
    def tables_without_rows(self) -> FloatArray:
        """What they know then."""
        return pack_solver_tables((), np.zeros(0, dtype=np.int64), np.zeros((0, 3)), *self._more_tables)

    @cached_property
    def great_circles(self) -> FloatArray | None:
        """Center and radius of each atom, see `spheres_of`; None unless all rows keep one on a resting sphere."""
        return spheres_of(self.motion)

    @cached_property
    def anchor(self) -> int:
        """The atom that positions are taken relative to where they are far away."""
        return int(self.motion.constraint_set.incidence.indices[0])

    @cached_property
    def _free_of_origin(self) -> IntArray | None:
        """The atoms that are held, if no row depends on where the origin is; otherwise None."""
        held = self.motion.constraint_set
        if held.n_rows == 0 or not all(c.translation_invariant for c in held.constraints):
            return None
        return np.unique(held.incidence.indices).astype(np.int64)

    def near_origin(self, state: State) -> tuple[FloatArray, FloatArray | None]:
        """Positions of a state as steps are made from them, and what was taken from them where they are far.

        Where rows know a place in space, they take all positions as they are.
        """
        x, _, _ = self.kernel_arrays(state)
        if state.remainder is None or self._free_of_origin is None:
            return x, None
        shift = x[self.anchor]
        return (x - shift) + state.remainder, shift
