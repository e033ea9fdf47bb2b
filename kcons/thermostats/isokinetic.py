"""The Gaussian isokinetic thermostat: constant kinetic energy as a velocity constraint.

Gauss's principle with the row v^T M (notes, eqs. 111-113) gives dv/dt = M_par^+ f - alpha v with
alpha = v.f/(2K). The row is M^-1-orthogonal to those of the holonomic constraints wherever v is tangent to them, so
that a kick at fixed positions has the closed form it has without constraints.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError, OverdeterminedError, UnsupportedError
from kcons.steppers import Splitting, State, System
from kcons.steppers.compositions import KAHAN_LI_6, SUZUKI_4
from kcons.steppers.splitting import Piece
from kcons.steppers.state import check_finite
from kcons.steppers.stepper import explained, stays
from kcons.steppers.summation import Point
from kcons.thermostats.freedom import AT_REST, Freedom, Momentum, freedom, total_momentum_share

Convention = Literal["exact", "notes"]

#: Kinetic energy below which v.f/2K may overflow.
SMALLEST = 1e-290

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
    2K = (g - 1) kT, g being the independent momenta: 3 n less the rank of the rows, less 3 where total momentum is
    conserved and zero. That is the default ('exact'). Velocities are spread over a sphere, not by Maxwell and
    Boltzmann: the kinetic temperature 2K/(g k) reads (g - 1)/g T.

    Symplectic it cannot be: the flow compresses phase space at the rate -(g - 1) alpha.

    Parameters
    ----------
    thermal_energy : float, optional
        k_B T in the units of energy in use.
    kinetic_energy : float, optional
        K itself, instead of a temperature. With neither, K stays what it is at the start.
    order : {2, 4, 6}
        1, 6 and 10 force evaluations a step.
    convention : {'exact', 'notes'}
        2K = (g - 1) k_B T, or 2K = 3 n k_B T of the notes (eq. 112), whose configurations are hotter than T.
    atoms : array_like of int, optional
        Thermostat these only. No row may couple them to others.
    momentum : {'auto', 'conserved', 'free'}
        See `kcons.thermostats.freedom`.

    Raises
    ------
    InputError
        Temperature or energy not positive; an unknown order or convention.

    Notes
    -----
    `State.thermostat` holds 2K and the integral of alpha over time; U + 2K int(alpha) is conserved
    (`conserved_energy`).

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
        for item, value in (("thermal_energy", thermal_energy), ("kinetic_energy", kinetic_energy)):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InputError(f"{item} is {value}; give a positive number", item=item)
        super().__init__(*SCHEMES[order])
        self.order = order
        self.thermal_energy = thermal_energy
        self.kinetic_energy = kinetic_energy
        self.convention: Convention = convention
        self.atoms = None if atoms is None else np.asarray(atoms, dtype=np.int64)
        self.momentum: Momentum = momentum

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

        Raises
        ------
        InputError
            All velocities are zero; velocities off the constraints.
        OverdeterminedError
            g is 1 (a temperature asked for), or 0.
        """
        self.check(system)
        state = system.with_forces(state)
        if state.thermostat is not None:
            return state
        assert state.forces is not None
        free = freedom(system, state, state.forces, self.atoms, self.momentum)
        drive, tangent = _split(system, state.positions, state.velocities, state.time)
        speeds = Speeds(system, self.atoms)
        twice = speeds.square(tangent) + speeds.square(drive)
        if not twice > SMALLEST:
            raise InputError(
                "the isokinetic thermostat needs non-zero kinetic energy: draw velocities first "
                "(kcons.thermostats.thermal_velocities)",
                item="velocities",
            )
        wanted = self._twice_kinetic(system, free, twice)
        if free.momentum_conserved and total_momentum_share(system, state.velocities) > AT_REST**2:
            warnings.warn(
                "total momentum is not zero and is scaled by exp(U/2K) instead of being conserved: no temperature "
                "is sampled; remove it from the velocities first",
                stacklevel=3,
            )
        velocities = drive + speeds.scaled(tangent, wanted - speeds.square(drive), state.step)
        return replace(state, velocities=velocities, thermostat=np.array([wanted, 0.0]))

    def _twice_kinetic(self, system: System, free: Freedom, found: float) -> float:
        if self.kinetic_energy is not None:
            return 2 * self.kinetic_energy
        if self.thermal_energy is None:
            return found
        if self.convention == "notes":
            return 3 * (system.n_atoms if free.atoms is None else len(free.atoms)) * self.thermal_energy
        if free.count < 2:
            raise OverdeterminedError(
                "g - 1 = 0: isokinetic temperature undefined for a single degree of freedom; give kinetic_energy, or "
                "use Langevin"
            )
        return (free.count - 1) * self.thermal_energy

    def step(self, system: System, state: State, dt: float) -> State:
        """Advance by `dt`.

        Raises
        ------
        ConvergenceError, NonFiniteError, InputError, UnsupportedError
            As for all splittings.
        """
        still = stays(state, dt)
        if still is not None:
            return still
        begin = self.start(system, state)
        with np.errstate(over="ignore", invalid="ignore"):  # checked, with the step's number
            run = _Step(self, system, begin, dt)
            try:
                return run.through(self.kicks, self._pieces)
            except ConvergenceError as error:
                raise explained(error, system, state, dt, run.number) from error

    # -- what can be read -----------------------------------------------------------------------

    def friction(self, system: System, state: State) -> float:
        """alpha = v.f/(2K) at the state (notes, eq. 113)."""
        state = self.start(system, state)
        assert state.forces is not None
        tangent = _split(system, state.positions, state.velocities, state.time)[1]
        speeds = Speeds(system, self.atoms)
        return speeds.product(tangent, state.forces) / speeds.square(tangent)

    def compression_rate(self, system: System, state: State) -> float:
        """Divergence of the flow in phase space, -(g - 1) alpha."""
        state = self.start(system, state)
        assert state.forces is not None
        count = freedom(system, state, state.forces, self.atoms, self.momentum).count
        return -(count - 1) * self.friction(system, state)

    def conserved_energy(self, system: System, state: State) -> float:
        """U + 2K int(alpha dt), which the exact motion conserves; needs `System.potential`."""
        state = self.start(system, state)
        assert state.thermostat is not None
        potential = system.total_energy(state) - system.kinetic_energy(state.velocities)
        return potential + float(state.thermostat[0] * state.thermostat[1])


def _split(system: System, x: FloatArray, v: FloatArray, time: float) -> tuple[FloatArray, FloatArray]:
    """v as the slowest velocities that the targets demand (zero unless they move) and the rest, projected."""
    motion = system.motion
    whole = motion.project_velocities(x, v, time=time)
    if not motion.plan.driven:
        return np.zeros_like(v), whole
    drive = motion.project_velocities(x, np.zeros_like(v), time=time)
    return drive, whole - drive


class Speeds:
    """Kinetic energy of the thermostatted atoms."""

    def __init__(self, system: System, atoms: IntArray | None) -> None:
        self.inside = system.inverse_masses[:, 0] > 0
        if atoms is not None:
            chosen = np.zeros(system.n_atoms, dtype=bool)
            chosen[atoms] = True
            self.inside = self.inside & chosen
        #: Masses of the thermostatted atoms, shape (n_atoms, 1); 0 for the others.
        self.masses = np.where(self.inside, system.masses, 0.0)[:, None]
        self.everywhere = bool(self.inside.all())

    def square(self, v: FloatArray) -> float:
        """v^T M v."""
        return float(np.vdot(self.masses * v, v))

    def product(self, v: FloatArray, f: FloatArray) -> float:
        """v . f."""
        return float(np.vdot(v, f)) if self.everywhere else float(np.vdot(v[self.inside], f[self.inside]))

    def scaled(self, v: FloatArray, square: float, step: int) -> FloatArray:
        """v with the length that v^T M v = `square` demands, other atoms as they are."""
        has = self.square(v)
        if not square > SMALLEST:
            raise InputError(
                f"moving targets alone have more kinetic energy than the thermostat allows at step {step}: raise "
                "the temperature, or move them slower",
                item="kinetic_energy",
            )
        factor = math.sqrt(square / has) if has > 0 else math.nan
        return v * factor if self.everywhere else np.where(self.inside[:, None], v * factor, v)


class _Step:
    """The arrays of one step on its way."""

    def __init__(self, method: Isokinetic, system: System, start: State, dt: float) -> None:
        assert start.thermostat is not None and start.forces is not None
        self.method, self.system, self.dt = method, system, dt
        self.begin = start
        self.number = start.step + 1
        self.time, self.time_remainder = start.later(dt)
        self.now = start.time
        self.shift = None
        x = start.positions
        if start.remainder is not None:
            self.shift = x[system.anchor]
            x = (x - self.shift) + start.remainder
        self.speeds = Speeds(system, method.atoms)
        self.twice, self.integral = (float(value) for value in start.thermostat)
        self.x = x
        self.forces = start.forces
        self.drive, self.tangent = _split(system, x, start.velocities, self.now)
        self.drive_square = self.speeds.square(self.drive)

    def through(self, kicks: tuple[float, ...], pieces: list[list[Piece]]) -> State:
        self.kick(kicks[0])
        for fraction, stage in zip(kicks[1:], pieces, strict=True):
            self.drift(stage)
            self.forces = self.system.forces(self.positions, self.drive + self.tangent, self.now, self.number)
            self.kick(fraction)
        v = self.drive + self.tangent
        check_finite(v, "velocity", self.number)
        positions, remainder = self.positions, None
        if self.shift is not None:
            remainder = self.x - (positions - self.shift)
        thermostat = np.array([self.twice, self.integral])
        return State(positions, v, self.time, self.forces, self.number, remainder, self.time_remainder, thermostat)

    @property
    def positions(self) -> FloatArray:
        return self.x if self.shift is None else self.x + self.shift

    def kick(self, fraction: float) -> None:
        """dv/dt = M_par^+ f - alpha v for a time at fixed forces, in closed form.

        v becomes (v + s F)/s' with F = M_par^+ f, a = v.f/2K, c^2 = F.f/2K and
        s = (a/c^2)(cosh ct - 1) + sinh(ct)/c; all divided by e^{ct}, which overflows for ct > 710.
        """
        system, speeds = self.system, self.speeds
        if system.force is None:
            return
        t = fraction * self.dt
        push = system.motion.project_forces(self.x, self.forces, time=self.now)
        pace = push * system.inverse_masses
        square = self.twice - self.drive_square
        a = speeds.product(self.tangent, push) / square
        c = math.sqrt(max(speeds.product(pace, push) / square, 0.0))
        z = abs(c * t)
        decay = math.exp(-z)
        # sinh z/z, (cosh z - 1)/z^2 and cosh z, times e^-z.
        sinh = -0.5 * math.expm1(-2 * z) / z if z > 0 else 1.0
        cosh_less = 0.5 * (math.expm1(-z) / z) ** 2 if z > 0 else 0.5
        cosh = 0.5 * (1 + decay * decay)
        growth = a * t * sinh + cosh
        s = t * (a * t * cosh_less + sinh)
        after = (decay * self.tangent + s * pace) / growth
        if not speeds.everywhere:
            after = np.where(speeds.inside[:, None], after, self.tangent + t * pace)
        self.tangent = speeds.scaled(after, square, self.number)
        self.integral += z + math.log(growth)

    def drift(self, stage: list[Piece]) -> None:
        system, start = self.system, self.begin
        point = Point(self.x, self.drive + self.tangent, system.weights, exact=len(stage) > 1)
        for fraction, end in stage:
            then = self.now
            self.now = self.time if end == 1.0 else start.time + (end * self.dt + start.time_remainder)
            system.drift.move(point, np.empty_like(self.x), then, self.now, fraction * self.dt)
        point.land()
        check_finite(point.x, "position", self.number)
        self.x = point.x
        drive, tangent = _split(system, self.x, point.v, self.now)
        drive_square = self.speeds.square(drive)
        has = self.speeds.square(tangent)
        wanted = self.twice - drive_square
        self.tangent = self.speeds.scaled(tangent, wanted, self.number)
        self.integral -= 0.5 * math.log(wanted / has) if has > 0 else math.nan
        self.drive, self.drive_square = drive, drive_square
