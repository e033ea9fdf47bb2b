"""Steppers: maps from one state on the constraints to the next.

A stepper is a pure function of the state. It never changes its input, and where it raises, nothing
has happened: the state that was passed in is still the last good one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError, NonFiniteError, OverdeterminedError
from kcons.motion import Motion

__all__ = ["Observer", "Rattle", "State", "Stepper", "System", "run"]

#: Positions farther from the origin than this many times the size of the system carry their remainder.
FAR = 128.0

#: Residual of initial positions (relative to the row's scale) and of initial velocities (relative to the
#: speed) that is still taken for rounding; the first step removes it.
START_TOLERANCE = 1e-9

_MAX_ITERATIONS = 50
_EPS = float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False)
class State:
    """Where a system is.

    Attributes
    ----------
    positions, velocities : ndarray, shape (n_atoms, 3)
        In the caller's units. Treat them as read-only: states share arrays where nothing changed.
    time : float
    forces : ndarray, shape (n_atoms, 3), or None
        Applied forces at this state, None before they are known. With them in hand a step evaluates the
        forces once, and a run that is continued from a saved state continues bit for bit.
    step : int
        Steps done since the start.
    remainder : ndarray, shape (n_atoms, 3), or None
        What rounding took from the positions, kept where they are far from the origin compared with the
        size of what is held (see `System.initial_state`).
    """

    positions: FloatArray
    velocities: FloatArray
    time: float = 0.0
    forces: FloatArray | None = None
    step: int = 0
    remainder: FloatArray | None = None

    def reversed(self) -> State:
        """The same point with opposite velocities."""
        # Forces are dropped since they may depend on the velocities.
        return replace(self, velocities=-self.velocities, forces=None)


class System:
    """Constraints, masses and applied forces.

    Parameters
    ----------
    motion : Motion
        The engine of the constraint set; also the source of the masses. A set without rows gives plain
        unconstrained dynamics.
    force : callable, optional
        Applied forces, shape (n_atoms, 3): ``force(x, t)``, or ``force(x, v, t)`` if `velocity_dependent`.
        None means no forces.
    potential : callable, optional
        Potential energy ``potential(x, t)``, for `total_energy`.
    velocity_dependent : bool
        Whether `force` takes the velocities too (friction, magnetic fields).

    Raises
    ------
    InputError
        An atom that is not held by FixedAtoms has a mass that is not positive.
    """

    def __init__(
        self,
        motion: Motion,
        force: Callable[..., ArrayLike] | None = None,
        *,
        potential: Callable[[FloatArray, float], float] | None = None,
        velocity_dependent: bool = False,
    ) -> None:
        self.motion = motion
        self.force = force
        self.potential = potential
        self.velocity_dependent = velocity_dependent and force is not None
        self.n_atoms = motion.n_atoms
        self.masses: FloatArray = motion.masses
        fixed = _fixed_atoms(motion)
        bad = ~(np.isfinite(self.masses) & (self.masses > 0))
        bad[fixed] = False
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
        self.inverse_masses[fixed] = 0.0

    # -- states ---------------------------------------------------------------------------------

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
            Copied and cast to float64. Without velocities the slowest admissible ones are taken: zero
            unless a constraint moves by itself.
        time : float
        project : bool
            Whether to bring positions and velocities that violate the constraints onto them (nearest point
            in the mass metric) instead of raising.

        Notes
        -----
        At 1e6 from the origin a position is rounded to 1e-10; a step that puts this right again turns it into
        velocity, 2e-9 of the energy in 1000 steps. Where all rows are independent of the origin, such states
        therefore carry the remainder of their positions, and steps are made relative to one of the atoms.

        Raises
        ------
        InputError
            Wrong shapes, NaN or infinity; positions or velocities off the constraints while `project` is
            False.
        InfeasibleError
            With `project`, if no solution can be reached.
        OverdeterminedError
            The rows leave no degree of freedom, and the velocities are not what they prescribe.
        """
        if not math.isfinite(time):
            raise InputError(f"time is {time}", item="time")
        x = self._array(positions, "positions")
        given = velocities is not None
        v = self._array(velocities, "velocities") if given else np.zeros_like(x)
        motion, held = self.motion, self.motion.constraint_set
        if held.n_rows == 0:
            return State(x, v, time)
        miss = np.abs(held.value(x, time))
        allowed = np.maximum(START_TOLERANCE * held.scale, 4 * held.tolerance(x, time))
        if not np.all(miss <= allowed):
            if not project:
                row = int(np.argmax(miss / allowed))
                raise InputError(
                    f"initial positions are off row {held.row_name(row)} by {miss[row]:.6g}; "
                    "pass project=True to bring them onto the constraints, or correct them",
                    item="positions",
                    atoms=held.row_atoms(row),
                )
            x = motion.restore_positions(x, time=time)
        remainder = None
        local = x
        if self._is_far(x):
            shift = x[self._anchor].copy()
            local = motion.restore_positions(x - shift, time=time)
            remainder = local - (x - shift)
        tangent = motion.project_velocities(local, v, time=time)
        away = np.abs(tangent - v)
        if given and away.max() > START_TOLERANCE * max(np.abs(v).max(), np.abs(tangent).max()):
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
            v = tangent
        elif not given:
            v = tangent
        return State(x, v, time, remainder=remainder)

    def forces(self, x: FloatArray, v: FloatArray, time: float, step: int) -> FloatArray:
        """Applied forces, checked, shape (n_atoms, 3); `step` is named if they are not finite."""
        if self.force is None:
            return np.zeros((self.n_atoms, 3))
        raw = self.force(x, v, time) if self.velocity_dependent else self.force(x, time)
        f = np.array(raw, dtype=np.float64, order="C")  # a copy: calculators like to reuse their array
        if f.shape != (self.n_atoms, 3):
            raise InputError(
                f"the force function returned shape {f.shape} at step {step}; it must return ({self.n_atoms}, 3)",
                item="forces",
            )
        _check_finite(f, "force", step)
        return f

    def with_forces(self, state: State) -> State:
        """The state with its forces filled in."""
        if state.forces is not None:
            return state
        return replace(state, forces=self.forces(state.positions, state.velocities, state.time, state.step))

    # -- energies -------------------------------------------------------------------------------

    def kinetic_energy(self, velocities: FloatArray) -> float:
        """sum m v^2/2; fixed atoms do not count."""
        moving = self.inverse_masses[:, 0] > 0
        return 0.5 * float(np.dot(self.masses[moving], np.einsum("ij,ij->i", velocities, velocities)[moving]))

    def total_energy(self, state: State) -> float:
        """Kinetic plus potential energy; needs `potential` unless there are no forces."""
        if self.potential is None and self.force is not None:
            raise InputError("this System has no potential; pass potential=... to follow the energy", item="potential")
        energy = self.kinetic_energy(state.velocities)
        if self.potential is not None:
            energy += float(self.potential(state.positions, state.time))
        return energy

    # -- inner ----------------------------------------------------------------------------------

    @cached_property
    def _anchor(self) -> int:
        """The atom that positions are taken relative to where they are far away."""
        return int(self.motion.constraint_set.incidence.indices[0])

    def _is_far(self, x: FloatArray) -> bool:
        held = self.motion.constraint_set
        if held.n_rows == 0 or not all(c.translation_invariant for c in held.constraints):
            return False
        near = x[np.unique(held.incidence.indices)]
        return bool(np.abs(near).max() > FAR * np.abs(near - x[self._anchor]).max())

    def _array(self, values: ArrayLike | None, item: str) -> FloatArray:
        try:
            array = np.array(values, dtype=np.float64, order="C")
        except (TypeError, ValueError) as error:
            raise InputError(f"{item} is no array of numbers: {error}", item=item) from None
        if array.shape != (self.n_atoms, 3):
            raise InputError(f"{item} must have shape ({self.n_atoms}, 3), not {array.shape}", item=item)
        bad = ~np.isfinite(array).all(axis=1)
        if bad.any():
            atom = int(np.argmax(bad))
            raise InputError(f"{item} of atom {atom} is not finite: {array[atom]}", item=item, atoms=[atom])
        return array

    @cached_property
    def _velocity_rows(self) -> _VelocityRows | None:
        return None if self.motion.constraint_set.holonomic.all() else _VelocityRows(self)


class Stepper(Protocol):
    """A scheme that advances states.

    Attributes
    ----------
    order : int
        Global order of the error in positions and velocities.
    reversible : bool
        Whether a step with -dt undoes a step with dt (to the tolerance of the solves).
    force_evaluations : int
        Evaluations of the force a step, for forces that depend on positions and time only.
    """

    @property
    def order(self) -> int: ...
    @property
    def reversible(self) -> bool: ...
    @property
    def force_evaluations(self) -> int: ...

    def step(self, system: System, state: State, dt: float) -> State:
        """The state after `dt`; pure."""
        ...


class Rattle:
    """Velocity Verlet with exactly solved constraints: order 2, reversible, symplectic for holonomic rows.

    One step from (x0, v0) at t0 to (x1, v1) at t1 = t0 + dt::

        u  = v0 + dt/2 M^-1 (f(x0) + A(x0)^T l0)       l0 such that sigma(x1, t1) = 0
        x1 = x0 + dt u
        v1 = u + dt/2 M^-1 (f(x1) + A(x1)^T l1)        l1 such that A(x1) v1 = c(t1)

    Velocities take the multipliers themselves, never (x1 - x0)/dt, so that their accuracy does not depend
    on the distance from the origin. For targets that move with time, c is their rate.

    * **Velocity (nonholonomic) rows** a(x) . v = c have no position to fix l0. It is chosen such that the
      row holds at the middle of the drift, a((x0 + x1)/2) . u = c(t0 + dt/2): the symmetric choice, which
      keeps order 2 and reversibility. (Projecting u with the rows at x0 instead has order 1.)
    * **Velocity-dependent forces**: f(x0, v0) in the first half, f(x1, v1), solved for v1 by iteration, in
      the second; also symmetric. Each iteration evaluates the forces once.

    A rigid rotor in free flight turns by exactly asin(omega dt) a step; for omega dt >= 1 there is no
    solution and the step raises.

    References
    ----------
    Andersen, J. Comput. Phys. 52, 24 (1983); notes, section 4.1. Midpoint condition for velocity rows:
    McLachlan and Perlmutter, J. Nonlinear Sci. 16, 283 (2006).
    """

    order = 2
    reversible = True
    force_evaluations = 1

    def __repr__(self) -> str:
        return "Rattle()"

    def step(self, system: System, state: State, dt: float) -> State:
        """Advance by `dt`; negative steps go back, 0 changes nothing.

        Raises
        ------
        ConvergenceError
            No solution (the step is too large); carries `step`.
        NonFiniteError
            A force, position or velocity became NaN or infinite; carries `step`.
        InputError
            `dt` is not finite; the force function returned a wrong shape.
        """
        if not math.isfinite(dt):
            raise InputError(f"the time step is {dt}", item="dt")
        if dt == 0:
            return replace(state, step=state.step + 1)
        number = state.step + 1
        time = state.time + dt
        start = system.with_forces(state)
        first_forces = start.forces
        assert first_forces is not None
        shift: FloatArray | None = None
        if start.remainder is not None:
            shift = start.positions[system._anchor]
            start = replace(start, positions=(start.positions - shift) + start.remainder)
        with np.errstate(over="ignore", invalid="ignore"):  # checked below, with the step's number
            half_kick = (0.5 * dt) * system.inverse_masses
            u = half_kick * first_forces
            u += start.velocities
            try:
                if system._velocity_rows is None:
                    x, u = _drift(system, start, u, dt)
                else:
                    x, u = system._velocity_rows.drift(start, u, dt)
                positions = x if shift is None else x + shift
                v, forces = _second_kick(system, positions, x, u, half_kick, time, number)
            except ConvergenceError as error:
                raise _explained(error, system, start, dt, number) from error
            _check_finite(v, "velocity", number)
        remainder = None if shift is None else x - (positions - shift)
        return State(positions, v, time, forces, number, remainder)


def _drift(system: System, start: State, u: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """x1 = x0 + dt u with sigma(x1, t1) = 0; changes `u` in place by the multipliers."""
    x = dt * u
    x += start.positions
    _check_finite(x, "position", start.step + 1)
    time = start.time + dt
    system.motion.project_positions(
        x, start.positions, time=time, reference_time=start.time, velocities=u, dt=dt, out=x
    )
    return x, u


def _second_kick(
    system: System,
    positions: FloatArray,
    x: FloatArray,
    u: FloatArray,
    half_kick: FloatArray,
    time: float,
    number: int,
) -> tuple[FloatArray, FloatArray]:
    """Half a kick with the forces at the new positions, and A v = c; `u` may be changed.

    `x` are the positions that the constraints see: the same, or relative to an atom.
    """
    motion = system.motion
    if not system.velocity_dependent:
        forces = system.forces(positions, u, time, number)
        u += half_kick * forces
        return motion.project_velocities(x, u, time=time, out=u), forces
    v = motion.project_velocities(x, u + half_kick * system.forces(positions, u, time, number), time=time)
    change = math.inf
    for _ in range(_MAX_ITERATIONS):
        forces = system.forces(positions, v, time, number)
        following = motion.project_velocities(x, u + half_kick * forces, time=time)
        last, change = change, float(np.abs(following - v).max(initial=0.0))
        speed = float(np.abs(following).max(initial=0.0))
        v = following
        if change <= 2 * _EPS * speed or (change >= last and change <= 1e-13 * speed):
            return v, system.forces(positions, v, time, number)
    raise ConvergenceError(
        f"velocity-dependent forces do not settle: the velocities still change by {change:.3g} "
        f"after {_MAX_ITERATIONS} iterations; time step too large",
        residual=change / max(speed, np.finfo(float).tiny),
        tolerance=2 * _EPS,
        iterations=_MAX_ITERATIONS,
    )


class _VelocityRows:
    """The drift where some rows constrain velocities only.

    Their impulses mu act along A(x0); they are found by Newton's method with the matrix of the start,
    the position rows being solved exactly by the engine at each iteration.
    """

    def __init__(self, system: System) -> None:
        from scipy.sparse.csgraph import connected_components  # slow to import, rarely needed

        self.system = system
        whole = system.motion.constraint_set
        links = whole.incidence @ whole.incidence.T
        labels = connected_components(links, directed=False)[1]
        velocity = ~whole.holonomic
        self.rows: IntArray = np.flatnonzero(np.isin(labels, labels[velocity])).astype(np.int64)
        self.held, self.atoms = whole.subset(self.rows)
        self.is_velocity: NDArray[np.bool_] = ~self.held.holonomic
        self.weights: FloatArray = np.repeat(system.inverse_masses[self.atoms, 0], 3)

    def drift(self, start: State, kicked: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
        """As `_drift`, with a(x_mid, t_mid) . u = c(t_mid) for the velocity rows."""
        x0, middle = start.positions, start.time + 0.5 * dt
        coefficients = self.held.jacobian(x0[self.atoms], start.time).toarray()
        spread = coefficients * self.weights
        size = np.sqrt(np.einsum("ij,ij->i", coefficients, coefficients))
        size[size == 0] = 1.0
        gram = (spread @ coefficients.T) / size[:, None] / size
        respond = np.linalg.pinv(gram, rcond=1e-12, hermitian=True)[np.ix_(self.is_velocity, self.is_velocity)]
        push = (spread / size[:, None])[self.is_velocity]
        impulses = np.zeros(len(push))
        error = math.inf
        for _ in range(_MAX_ITERATIONS):
            u = kicked.copy()
            u[self.atoms] += (impulses @ push).reshape(-1, 3)
            x, u = _drift(self.system, start, u, dt)
            between = 0.5 * (x0[self.atoms] + x[self.atoms])
            rows = self.held.jacobian(between, middle).toarray()[self.is_velocity]
            wanted = self.held.velocity_target(between, middle)[self.is_velocity]
            local = u[self.atoms].ravel()
            miss = (rows @ local - wanted) / size[self.is_velocity]
            speed = max(float(np.abs(local).max()), float(np.abs(wanted / size[self.is_velocity]).max()))
            last, error = error, float(np.abs(miss).max())
            if error <= 4 * _EPS * speed or (error >= last and error <= 1e-13 * speed):
                return x, u
            impulses -= respond @ miss
        worst = int(self.rows[self.is_velocity][np.argmax(np.abs(miss))])
        whole = self.system.motion.constraint_set
        raise ConvergenceError(
            f"velocity row {whole.row_name(worst)} is not fulfilled at the middle of the step: relative residual "
            f"{error / speed:.3g} after {_MAX_ITERATIONS} iterations",
            residual=error / speed,
            tolerance=4 * _EPS,
            iterations=_MAX_ITERATIONS,
            row=worst,
            atoms=whole.row_atoms(worst),
        )


Observer: TypeAlias = Callable[[State], Any]


def run(
    system: System,
    state: State,
    dt: float,
    steps: int,
    *,
    stepper: Stepper | None = None,
    observers: Iterable[Observer] = (),
    every: int = 1,
) -> State:
    """Make `steps` steps of `dt` and return the last state.

    Parameters
    ----------
    system : System
    state : State
        Where to start, for example from `System.initial_state`.
    dt : float
        Time step; negative to go back.
    steps : int
    stepper : Stepper, optional
        `Rattle` by default.
    observers : iterable of callable
        Each is called with the state at the start and after every `every` steps.
    every : int

    Raises
    ------
    InputError
        Negative `steps`, or `every` below 1.
    KconsError
        Whatever a step raises; `error.step` is its number. Observers have then seen the last good state.
    """
    if steps < 0 or every < 1:
        raise InputError(f"steps is {steps} and every {every}; give steps >= 0 and every >= 1", item="steps")
    scheme: Stepper = Rattle() if stepper is None else stepper
    watching = tuple(observers)
    for observer in watching:
        observer(state)
    for k in range(1, steps + 1):
        state = scheme.step(system, state, dt)
        if k % every == 0:
            for observer in watching:
                observer(state)
    return state


def _fixed_atoms(motion: Motion) -> IntArray:
    held = [c.atoms.ravel() for c in motion.constraint_set.constraints if c.family == "FixedAtoms"]
    return np.unique(np.concatenate(held)) if held else np.zeros(0, dtype=np.int64)


def _check_finite(values: FloatArray, item: str, step: int) -> None:
    flat = values.ravel()
    # The sum of squares is finite unless something is wrong or enormous; only then look at each number.
    with np.errstate(over="ignore", invalid="ignore"):
        if math.isfinite(np.dot(flat, flat)):
            return
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any():
        atom = int(np.argmax(bad))
        raise NonFiniteError(
            f"non-finite {item} at step {step} on atom {atom}: {values[atom]}. The state before this step is intact; "
            "check the geometry and the force function there, or use a smaller time step",
            item=item,
            atom=atom,
            step=step,
        )


def _explained(error: ConvergenceError, system: System, state: State, dt: float, number: int) -> ConvergenceError:
    """The engine's error with the step's number and its likely cause."""
    held = system.motion.constraint_set
    miss = np.abs(held.value(state.positions, state.time))
    allowed = np.maximum(1e-6 * held.scale, 4 * held.tolerance(state.positions, state.time))
    off = np.flatnonzero(~(miss <= allowed))
    if len(off):
        row = int(off[np.argmax(miss[off])])
        cause = (
            f"the state before it was already off row {held.row_name(row)} by {miss[row]:.3g}; "
            "start from System.initial_state(..., project=True)"
        )
    else:
        cause = f"time step too large (dt = {dt:g})"
    return type(error)(
        f"step {number}: {cause}. {error}",
        residual=error.residual,
        tolerance=error.tolerance,
        iterations=error.iterations,
        row=error.row,
        atoms=error.atoms,
        cluster=error.cluster,
        step=number,
    )
