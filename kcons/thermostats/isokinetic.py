"""The Gaussian isokinetic thermostat: constant kinetic energy as a velocity constraint.

Gauss's principle with the row v^T M (notes, eqs. 111-113) gives dv/dt = M_par^+ f - alpha v with
alpha = v.f/(2K). The row is M^-1-orthogonal to those of the holonomic constraints wherever v is tangent to them, so
that a kick at fixed positions has the closed form it has without constraints.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError, OverdeterminedError, UnsupportedError
from kcons.steppers import Splitting, State, System
from kcons.steppers.compositions import KAHAN_LI_6, SUZUKI_4
from kcons.steppers.splitting import Stage
from kcons.steppers.state import check_finite
from kcons.steppers.stepper import explained, stays
from kcons.steppers.summation import Point
from kcons.thermostats import kick as closed_form
from kcons.thermostats.freedom import (
    Freedom,
    Momentum,
    atom_numbers,
    carried,
    freedom,
    positive,
    warn_of_conserved_momenta,
)

Convention = Literal["exact", "notes"]

#: Kinetic energy below which v.f/2K may overflow.
SMALLEST = 1e-290
#: Relative difference from the kinetic energy wanted at the start that is taken for rounding.
ROUNDING = 1e-12
#: Square of a velocity across the constraints, relative to 2K, that is too much for a drift to take out exactly.
MANY = 1e4
_MAX_ITERATIONS = 50

_S6 = (0.0792036964311957, 0.353172906049774, -0.0420650803577195)
_S6_OTHER = (0.209515106613362, -0.143851773179818)
_S10 = (0.0502627644003922, 0.413514300428344, 0.0450798897943977, -0.188054853819569, 0.541960678450780)
_S10_OTHER = (0.148816447901042, -0.132385865767784, 0.067307604692185, 0.432666402578175)


def _around(half: tuple[float, ...]) -> tuple[float, ...]:
    """The first fractions, one in the middle, and their mirror image."""
    return (*half, math.fsum([1.0, *(-2.0 * a for a in half)]), *reversed(half))


def _doubled(half: tuple[float, ...]) -> tuple[float, ...]:
    """The first fractions, two equal ones in the middle, and their mirror image."""
    middle = math.fsum([0.5, *(-b for b in half)])
    return (*half, middle, middle, *reversed(half))


#: Kicks, drifts, and the composition each drift is flown by, for each order. Kicks are quadratic in the velocities, so
#: that the Runge-Kutta-Nystrom splittings of `kcons.steppers` lose their order here; these hold for any two flows
#: (S_6 and S_10 of Blanes and Moan).
SCHEMES: dict[int, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    2: ((0.5, 0.5), (1.0,), (1.0,)),
    4: (_around(_S6), _doubled(_S6_OTHER), SUZUKI_4),
    6: (_around(_S10), _doubled(_S10_OTHER), KAHAN_LI_6),
}


class Isokinetic(Splitting):
    """Constant kinetic energy, with all that is held at rest or moving: order 2, 4 or 6.

    Kicks follow the closed form at fixed forces; drifts fly along the constraints, after which the velocities are
    brought back to the length they had. Configurations are canonical at temperature T for
    2K = (g - 1) kT, g being the independent momenta: 3 n less the rank of the rows, less 1 for each direction in which
    total momentum is conserved. That is the default ('exact'). Velocities are spread over a sphere, not by Maxwell and
    Boltzmann: the kinetic temperature 2K/(g k) reads (g - 1)/g T.

    Symplectic it cannot be: the flow compresses phase space at the rate -(g - 1) alpha. It follows the exact motion
    backwards, with a negative time step, to the order of the scheme.

    Where targets move, they and K are kept together: v is what the targets demand at least, plus the rest, which has
    the length that is left.

    Parameters
    ----------
    thermal_energy : float, optional
        k_B T in the units of energy in use.
    kinetic_energy : float, optional
        K itself, instead of a temperature. With neither, K stays what it is at the start.
    order : {2, 4, 6}
        1, 6 and 10 force evaluations a step.
    convention : {'exact', 'notes'}
        2K = (g - 1) k_B T, or 2K = 3 n k_B T of the notes (eq. 112), n atoms that can move; their configurations are
        hotter than T.
    atoms : array_like of int or bool, optional
        Thermostat these only. No row may couple them to others.
    momentum : {'auto', 'conserved', 'free'}
        See `kcons.thermostats.freedom`.

    Raises
    ------
    InputError
        Temperature or energy not positive; an unknown order or convention.

    Warns
    -----
    UserWarning
        At the start of a run: total momentum is conserved but for a factor exp(U/2K), and not zero; or a temperature is
        asked for and forces exert no torque, so that the same holds of angular momentum. Neither samples a temperature.

    Notes
    -----
    `State.thermostat` holds 2K, the integral of alpha over time, f.M_par^+ f and g. U + 2K int(alpha) is conserved
    where targets rest (`conserved_energy`).

    References
    ----------
    Notes, eqs. 111-113; Evans, Hoover et al., Phys. Rev. A 28, 1016 (1983); closed form: Zhang, J. Chem. Phys. 106,
    6102 (1997); splittings: Blanes and Moan, J. Comput. Appl. Math. 142, 313 (2002).
    """

    reversible = False  # to the order of the scheme only: drifts are followed by a change of length
    symplectic = False

    def __init__(
        self,
        thermal_energy: float | None = None,
        *,
        kinetic_energy: float | None = None,
        order: int = 2,
        convention: Convention = "exact",
        atoms: ArrayLike | None = None,
        momentum: Momentum = "auto",
    ) -> None:
        if order not in SCHEMES:
            raise InputError(f"order is {order}; choose 2, 4 or 6", item="order")
        if convention not in ("exact", "notes"):
            raise InputError(f"convention is {convention!r}; choose 'exact' or 'notes'", item="convention")
        if thermal_energy is not None and kinetic_energy is not None:
            raise InputError("give thermal_energy or kinetic_energy, not both", item="thermal_energy")
        super().__init__(*SCHEMES[order])
        self.order = order
        self.thermal_energy = None if thermal_energy is None else positive(thermal_energy, "thermal_energy")
        self.kinetic_energy = None if kinetic_energy is None else positive(kinetic_energy, "kinetic_energy")
        self.convention: Convention = convention
        self.atoms = None if atoms is None else np.asarray(atoms)
        self.momentum: Momentum = momentum
        self._shares: tuple[System, _Share] | None = None

    def __repr__(self) -> str:
        given = [f"{self.thermal_energy!r}"] if self.thermal_energy is not None else []
        if self.kinetic_energy is not None:
            given.append(f"kinetic_energy={self.kinetic_energy!r}")
        if self.order != 2:
            given.append(f"order={self.order}")
        if self.convention != "exact":
            given.append(f"convention={self.convention!r}")
        if self.atoms is not None:
            given.append(f"atoms=<{len(self.atoms)} atoms>")
        return f"Isokinetic({', '.join(given)})"

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` for velocity-dependent forces."""
        if system.velocity_dependent:
            raise UnsupportedError(
                "forces that depend on the velocities have no closed kick; use Langevin for friction, or leave it out"
            )

    # -- steps ----------------------------------------------------------------------------------

    def start(self, system: System, state: State) -> State:
        """The state with its forces, and with the kinetic energy that the thermostat keeps.

        Velocities off the constraints are projected, then scaled; those that are right to rounding stay as they are to
        the last bit.

        Raises
        ------
        InputError
            All velocities are zero; the state carries variables of another thermostat; bad atom numbers.
        OverdeterminedError
            g is 1 (a temperature asked for), or 0.
        UnsupportedError
            A row couples the thermostatted atoms to others.
        """
        self.check(system)
        share = self._share(system)
        if carried(state, 4, "Isokinetic"):
            if state.forces is None and state.thermostat is not None:
                state = system.with_forces(state)
                variables = np.array(state.thermostat)
                variables[2] = share.push_square(system, state)
                state = replace(state, thermostat=variables)
            return state
        state = system.with_forces(state)
        assert state.forces is not None
        drive, rest = _split(system, state.positions, state.velocities, state.time)
        driven = 0.0 if drive is None else share.square(drive)
        found = share.square(rest) + driven
        if not found > SMALLEST:
            raise InputError(
                "the isokinetic thermostat needs non-zero kinetic energy: draw velocities first "
                "(kcons.thermostats.thermal_velocities)",
                item="velocities",
            )
        free = freedom(system, state, state.forces, self.atoms, self.momentum)
        twice = self._twice_kinetic(share, free, found)
        if self.thermal_energy is None:
            free = replace(free, turns=False)
        warn_of_conserved_momenta(system, state.velocities, free, stacklevel=5)
        velocities = rest if drive is None else drive + rest
        off = float(np.abs(velocities - state.velocities).max())
        if off <= ROUNDING * float(np.abs(velocities).max()) and abs(found - twice) <= ROUNDING * twice:
            velocities = state.velocities
        else:
            rest = share.scaled(rest, _left(twice, driven, state.step))
            velocities = rest if drive is None else drive + rest
        variables = np.array([twice, 0.0, share.push_square(system, state), free.count])
        return replace(state, velocities=velocities, thermostat=variables)

    def _twice_kinetic(self, share: _Share, free: Freedom, found: float) -> float:
        if self.kinetic_energy is not None:
            return 2 * self.kinetic_energy
        if self.thermal_energy is None:
            return found
        if self.convention == "notes":
            return 3 * share.n_moving * self.thermal_energy
        if free.count < 2:
            raise OverdeterminedError(
                "g - 1 = 0: isokinetic temperature undefined for a single degree of freedom; give kinetic_energy, or "
                "use Langevin"
            )
        return (free.count - 1) * self.thermal_energy

    def _share(self, system: System) -> _Share:
        known = self._shares
        if known is None or known[0] is not system:
            known = self._shares = (system, _Share(system, self.atoms))
        return known[1]

    def step(self, system: System, state: State, dt: float) -> State:
        """Advance by `dt`.

        Raises
        ------
        ConvergenceError, NonFiniteError, InputError, UnsupportedError
            As for all splittings, and at the start of a run as for `start`.
        """
        still = stays(state, dt)
        if still is not None:
            return still
        begin = self.start(system, state)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # checked, with the step's number
            run = _Step(system, self._share(system), begin, dt)
            try:
                return run.through(self.kicks, self._stages)
            except ConvergenceError as error:
                raise explained(error, system, state, dt, run.number) from error

    # -- what can be read -----------------------------------------------------------------------

    def friction(self, system: System, state: State) -> float:
        """alpha = v.f/(2K) at the state (notes, eq. 113); where targets move, without the part that they demand."""
        state = self.start(system, state)
        assert state.forces is not None
        share = self._share(system)
        rest = _split(system, state.positions, state.velocities, state.time)[1]
        return float(closed_form.raw_sums(rest, state.forces, system.weights, share.masses)[0]) / share.square(rest)

    def compression_rate(self, system: System, state: State) -> float:
        """Divergence of the flow in phase space, -(g - 1) alpha."""
        state = self.start(system, state)
        assert state.thermostat is not None
        return -(float(state.thermostat[3]) - 1) * self.friction(system, state)

    def conserved_energy(self, system: System, state: State) -> float:
        """U + 2K int(alpha dt), which the exact motion conserves where targets rest and all atoms are thermostatted.

        Needs `System.potential`.
        """
        state = self.start(system, state)
        assert state.thermostat is not None
        potential = system.total_energy(state) - system.kinetic_energy(state.velocities)
        return potential + float(state.thermostat[0] * state.thermostat[1])


def _split(system: System, x: FloatArray, v: FloatArray, time: float) -> tuple[FloatArray | None, FloatArray]:
    """v, projected, as the slowest velocities that the targets demand (None where they rest) and the rest."""
    motion = system.motion
    whole = motion.project_velocities(x, v, time=time)
    if not motion.plan.driven:
        return None, whole
    drive = motion.project_velocities(x, np.zeros_like(v), time=time)
    return drive, whole - drive


def _left(twice: float, driven: float, step: int) -> float:
    """What moving targets leave of 2K."""
    left = twice - driven
    if not left > SMALLEST:
        raise InputError(
            f"moving targets alone have more kinetic energy than the thermostat allows at step {step}: raise the "
            "temperature, or move them slower",
            item="kinetic_energy",
        )
    return left


class _Share:
    """The thermostatted atoms."""

    def __init__(self, system: System, atoms: ArrayLike | None) -> None:
        inside = system.inverse_masses[:, 0] > 0
        if atoms is not None:
            chosen = np.zeros(system.n_atoms, dtype=bool)
            chosen[atom_numbers(atoms, system.n_atoms)] = True
            inside = inside & chosen
        self.n_moving = int(inside.sum())
        #: Masses of the thermostatted atoms for each coordinate; 0 for the others.
        self.masses: FloatArray = np.repeat(np.where(inside, system.masses, 0.0)[:, None], 3, axis=1)
        #: Coordinates of other atoms that move, None if there are none.
        others = (self.masses == 0) & (system.weights > 0)
        self.others = others if others.any() else None

    def square(self, v: FloatArray) -> float:
        """v^T M v."""
        return float(closed_form.square_sum(v, self.masses))

    def scaled(self, v: FloatArray, square: float) -> FloatArray:
        """v with the length that v^T M v = `square` demands, other atoms as they are."""
        has = self.square(v)
        factor = math.sqrt(square / has) if has > 0 else math.nan
        return np.where(self.masses > 0, v * factor, v)

    def push_square(self, system: System, state: State) -> float:
        """f . M_par^+ f at the state."""
        assert state.forces is not None
        x = state.positions
        if state.remainder is not None:
            x = (x - x[system.anchor]) + state.remainder
        pace = paced(system, x, state.forces, state.time)
        return float(closed_form.square_sum(pace, self.masses))


def paced(system: System, x: FloatArray, forces: FloatArray, time: float) -> FloatArray:
    """M_par^+ f."""
    with np.errstate(over="ignore"):  # velocities are checked
        return _paced(system, x, forces, time)


def _paced(system: System, x: FloatArray, forces: FloatArray, time: float) -> FloatArray:
    motion = system.motion
    if motion.plan.driven:
        return np.asarray(motion.project_forces(x, forces, time=time) * system.inverse_masses)
    pace = forces * system.weights
    return motion.project_velocities(x, pace, time=time, out=pace) if motion.rank else pace


class _Step:
    """The arrays of one step on its way: velocities v = drive + u, the drive None where targets rest."""

    def __init__(self, system: System, share: _Share, start: State, dt: float) -> None:
        assert start.thermostat is not None and start.forces is not None
        self.system, self.share, self.dt = system, share, dt
        self.begin = start
        self.number = start.step + 1
        self.time, self.time_remainder = start.later(dt)
        self.now = start.time
        self.shift = None
        x = start.positions
        if start.remainder is not None:
            self.shift = x[system.anchor]
            x = (x - self.shift) + start.remainder
        self.twice, self.integral, self.push_square, self.count = start.thermostat.tolist()
        self.x = x
        self.forces = start.forces
        self.drive: FloatArray | None = None
        self.u = start.velocities
        self.left = self.twice
        if system.motion.plan.driven:
            self.drive, self.u = _split(system, x, start.velocities, self.now)
            self._settle()

    def through(self, kicks: tuple[float, ...], stages: list[Stage]) -> State:
        self.first_kick(kicks[0] * self.dt)
        for fraction, stage in zip(kicks[1:], stages, strict=True):
            if self.drive is None:
                self.drift(stage)
            else:
                for piece in zip(stage.fractions, stage.ends, strict=True):
                    self.driven_drift(piece)
            if self.system.force is not None:
                self.forces = self.system.forces(self.positions, self.velocities, self.now, self.number)
            self.kick(fraction * self.dt)
        v = self.velocities
        check_finite(v, "velocity", self.number)
        positions, remainder = self.positions, None
        if self.shift is not None:
            remainder = self.x - (positions - self.shift)
        thermostat = np.array([self.twice, self.integral, self.push_square, self.count])
        return State(positions, v, self.time, self.forces, self.number, remainder, self.time_remainder, thermostat)

    @property
    def positions(self) -> FloatArray:
        return self.x if self.shift is None else self.x + self.shift

    @property
    def velocities(self) -> FloatArray:
        return self.u if self.drive is None else self.drive + self.u

    def _settle(self) -> None:
        """How long u must be."""
        assert self.drive is not None
        self.left = _left(self.twice, self.share.square(self.drive), self.number)

    # -- kicks ----------------------------------------------------------------------------------

    def first_kick(self, t: float) -> None:
        """The kick before the first drift, which takes out what the forces would do across the constraints."""
        system, share = self.system, self.share
        if system.force is None:
            return
        u = np.empty_like(self.u)
        log_growth, done = closed_form.before_drift(
            self.u, self.forces, system.weights, share.masses, self.push_square, self.left, t, MANY, u
        )
        if not done:
            self.kick(t)
            return
        if share.others is not None:
            u = np.where(share.others, self.u + t * system.weights * self.forces, u)
        self.u = u
        self.integral += log_growth

    def kick(self, t: float) -> None:
        """Bring u, projected, to its length, and follow the closed form."""
        system, share = self.system, self.share
        if system.force is None:
            factor = math.sqrt(self.left / share.square(self.u))
            self.u = self.u * factor if share.others is None else np.where(share.others, self.u, self.u * factor)
            self.integral -= math.log(factor)
            return
        pace = _paced(system, self.x, self.forces, self.now)
        u = np.empty_like(pace)
        self.push_square, factor, log_growth, done = closed_form.after_drift(
            self.u, pace, share.masses, self.left, t, u
        )
        self.integral += log_growth
        if not done:
            self._turn(pace, factor, t)
            return
        if share.others is not None:
            u = np.where(share.others, self.u + t * pace, u)
        self.u = u

    def _turn(self, pace: FloatArray, factor: float, t: float) -> None:
        share = self.share
        u, growth = closed_form.turned(factor * self.u, pace, share.masses, self.left, t)
        if share.others is not None:
            u = np.where(share.others, self.u + t * pace, u)
        self.u = u
        self.integral += growth

    # -- drifts ---------------------------------------------------------------------------------

    def drift(self, stage: Stage) -> None:
        system = self.system
        point = Point(self.x, self.u, system.weights, exact=len(stage.ends) > 1)
        for fraction, end in zip(stage.fractions, stage.ends, strict=True):
            then, self.now = self.now, self._time_at(end)
            system.drift.move(point, np.empty_like(self.x), then, self.now, fraction * self.dt)
        point.land()
        check_finite(point.x, "position", self.number)
        self.x = point.x
        self.u = system.motion.project_velocities(self.x, point.v, time=self.now, out=point.v)

    def driven_drift(self, piece: tuple[float, float]) -> None:
        """Moving targets do work: u is scaled by one factor before and after the flight, that which keeps K.

        So it is symmetric, of order 2 (Hairer, BIT 40, 726 (2000)).
        """
        system, share = self.system, self.share
        assert self.drive is not None
        fraction, end = piece
        then, now = self.now, self._time_at(end)
        log_factor, last = 0.0, math.inf
        for _ in range(_MAX_ITERATIONS):
            point = Point(self.x, self.drive + self._times(math.exp(log_factor), self.u), system.weights, exact=False)
            system.drift.move(point, np.empty_like(self.x), then, now, fraction * self.dt)
            check_finite(point.x, "position", self.number)
            drive, u = _split(system, point.x, point.v, now)
            assert drive is not None
            left = _left(self.twice, share.square(drive), self.number)
            u = self._times(math.exp(log_factor), u)
            miss = 0.5 * math.log(left / share.square(u))
            if abs(miss) <= 1e-15 or (abs(miss) < 1e-12 and abs(miss) >= last):
                break
            last = abs(miss)
            log_factor += 0.5 * miss
        else:
            raise ConvergenceError(
                "kinetic energy and moving targets cannot be kept together; time step too large",
                residual=last,
                tolerance=1e-12,
                iterations=_MAX_ITERATIONS,
            )
        self.x, self.now, self.drive, self.u, self.left = point.x, now, drive, u, left
        self.integral -= 2 * log_factor

    def _times(self, factor: float, u: FloatArray) -> FloatArray:
        return u * factor if self.share.others is None else np.where(self.share.others, u, u * factor)

    def _time_at(self, end: float) -> float:
        start = self.begin
        return self.time if end == 1.0 else start.time + (end * self.dt + start.time_remainder)
