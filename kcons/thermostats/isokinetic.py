"""The Gaussian isokinetic thermostat: constant kinetic energy as a velocity constraint.

Gauss's principle with the row v^T M (notes, eqs. 111-113) gives dv/dt = M_par^+ f - alpha v with
alpha = v.f/(2K). The row is M^-1-orthogonal to those of the holonomic constraints wherever v is tangent to them, so
that a kick at fixed positions has the closed form it has without constraints, for any strength of the force: with u the
velocities on the surface and F = M_par^+ f, du/dt = F - (u.f/2K) u has the solution u(t) = (u + s F)/s', where
c^2 = f.F/2K, a = u.f/2K and

    s = (a/c^2)(cosh ct - 1) + sinh(ct)/c,    s' = (a/c) sinh ct + cosh ct.

Everything is divided by e^{ct}, which overflows for ct > 710. Only sums over the atoms enter: u^T M u, u.f and f.F.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from kcons.constraints.arguments import Positive, checked
from kcons.constraints.compilation import njit
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, OverdeterminedError
from kcons.solvers.addressable_solvers import MORE, packed_tangents
from kcons.solvers.kernels.array_views import flat, integers, table_array
from kcons.steppers import Splitting, State, System
from kcons.steppers.compiled_operations import SUMS, all_finite, check_finite, square_sum
from kcons.steppers.interpreter import Interpreted, Interpreter
from kcons.steppers.operations import Evaluate, Kick, Operation, Program, Project, Row, Turn, mirrored, splitting
from kcons.steppers.splitting import KAHAN_LI_6, SUZUKI_4
from kcons.thermostats.freedom import (
    FEW,
    LOOK_AT,
    Momentum,
    carried,
    freedom,
    may_be,
    refuse_dissipation,
    refuse_driven,
    warn_of_bodies_apart,
    warn_of_conserved_momenta,
)

Convention = Literal["exact", "notes"]

#: Relative difference from the kinetic energy wanted at the start that is taken for rounding.
ROUNDING = 1e-12
#: The same of a state that goes on, whose velocities went through steps, or through momenta.
KEPT = 1e-9
#: Kinetic energy below which v.f/2K may overflow.
SMALLEST = 1e-290
#: Below this share of the terms, their sum has lost digits.
_CANCELS = 0.01
#: Square of a velocity across the constraints, relative to 2K, that is too much for a drift to take out exactly.
MANY = 1e4
#: What the numbers of a program begin with, as `State.thermostat`: 2K, the integral of alpha, f.M_par^+ f, and g; after
#: them the masses for each coordinate, 0 for fixed atoms, and room for accelerations.
TWICE, INTEGRAL, SQUARE, COUNT, SIZE = range(5)

_S6 = (0.0792036964311957, 0.353172906049774, -0.0420650803577195)
_S6_OTHER = (0.209515106613362, -0.143851773179818)
_S10 = (0.0502627644003922, 0.413514300428344, 0.0450798897943977, -0.188054853819569, 0.541960678450780)
_S10_OTHER = (0.148816447901042, -0.132385865767784, 0.067307604692185, 0.432666402578175)

#: Kicks, drifts, and the composition each drift is flown by, for each order. Kicks are quadratic in the velocities, so
#: that the Runge-Kutta-Nystrom splittings of `kcons.steppers` lose their order here; these hold for any two flows
#: (S_6 and S_10 of Blanes and Moan).
SCHEMES: dict[int, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    2: ((0.5, 0.5), (1.0,), (1.0,)),
    4: (mirrored(_S6), mirrored(_S6_OTHER, 2), SUZUKI_4),
    6: (mirrored(_S10), mirrored(_S10_OTHER, 2), KAHAN_LI_6),
}


class _FirstTurn(Turn):
    """The turn that a step begins with, whose forces need not be projected: the drift takes out the rest."""

    verb, meaning = "first_turn", "the same, by forces that the drift brings onto the constraints"


@njit(cache=True, nogil=True)
def weights_of(aligned, square, twice, t):  # type: ignore[no-untyped-def]
    """Keep, push and log of the growth of the kick over a time t, which may be negative: u' = keep u + push F.

    Of u.f, f.F and 2K. Last, whether digits were lost, or c^2 is too large a number, so that `turned` must find u'.
    """
    a = aligned / twice
    c2 = square / twice if square > 0 else 0.0
    if not math.isfinite(c2):
        return math.nan, math.nan, math.nan, True
    z = math.sqrt(c2) * abs(t)
    decay = math.exp(-z)
    # sinh z/z, (cosh z - 1)/z^2 and cosh z, times e^-z; expm1 is exact near 0.
    sinh = -0.5 * math.expm1(-2 * z) / z if z > 0 else 1.0
    cosh_less = 0.5 * (math.expm1(-z) / z) ** 2 if z > 0 else 0.5
    cosh = 0.5 * (1 + decay * decay)
    growth = a * t * sinh + cosh
    if not growth > _CANCELS:
        return math.nan, math.nan, math.nan, True
    return decay / growth, t * (a * t * cosh_less + sinh) / growth, z + math.log(growth), False


def turned(u: FloatArray, pace: FloatArray, masses: FloatArray, twice: float, t: float) -> tuple[FloatArray, float]:
    """The kick of velocities that run against a strong force, and log of its growth.

    There u + s F and s' are differences of numbers that are nearly equal. The part of u across F decides how fast u
    turns round; with e = F/|F|, p = u.e/|u|, and q that part:

        u(t) = (q e^{-z} + e |u| [(1 + p) - (1 - p) e^{-2z}]/2)/g,    g = [(1 + p) + (1 - p) e^{-2z}]/2.
    """
    largest = float(np.abs(pace).max())
    axis = pace / largest  # squares of the strongest forces overflow
    length = math.sqrt(float((masses * axis * axis).sum()))
    axis *= math.copysign(1.0, t) / length
    speed = math.sqrt(twice)
    along = float((masses * u * axis).sum())
    across = u - along * axis
    across -= float((masses * across * axis).sum()) * axis  # what rounding left along the force
    q2 = min(float((masses * across * across).sum()) / twice, 1.0)
    p = math.copysign(math.sqrt(1.0 - q2), along)
    one_plus = q2 / (1.0 - p) if p < 0 else 1.0 + p
    z = largest * (length / speed * abs(t))
    decay = math.exp(-z)
    growth = 0.5 * (one_plus + (1.0 - p) * decay * decay)
    if growth == 0:  # exactly against the force, for longer than any rounding
        return -speed * axis, -z
    lead = 0.5 * (one_plus - (1.0 - p) * decay * decay) * speed
    after = (decay * across + lead * axis) / growth
    after *= math.sqrt(twice / float((masses * after * after).sum()))
    return after, z + math.log(growth)


# -- sums over the atoms ----------------------------------------------------------------------------


@njit(cache=True, nogil=True, fastmath=SUMS)
def sums(u, pace, masses):  # type: ignore[no-untyped-def]
    """u^T M u, u^T M F and F^T M F, flat."""
    a, b, m = u.ravel(), pace.ravel(), masses.ravel()
    uu = up = pp = 0.0
    for i in range(a.size):
        w = m[i] * a[i]
        uu += w * a[i]
        up += w * b[i]
        pp += m[i] * b[i] * b[i]
    return uu, up, pp


@njit(cache=True, nogil=True, fastmath=SUMS)
def raw_sums(u, f, weights, masses):  # type: ignore[no-untyped-def]
    """u.f and f.M^-1 f of the atoms that move; `weights` is 1/m."""
    a, b, w, m = u.ravel(), f.ravel(), weights.ravel(), masses.ravel()
    uf = ff = 0.0
    for i in range(a.size):
        taken = m[i] * w[i]  # 1 or 0
        uf += taken * (a[i] * b[i])
        ff += taken * (w[i] * b[i] * b[i])
    return uf, ff


@njit(cache=True, nogil=True)
def after_drift(u, pace, masses, twice, t):  # type: ignore[no-untyped-def]
    """Bring u to its length, and u = keep u + push F.

    Returns f.F, the factor of u, log of the growth, and whether it was done: it is not where digits would be lost.
    """
    uu, aligned, square = sums(u, pace, masses)
    factor = math.sqrt(twice / uu) if uu > 0 else math.nan
    aligned *= factor
    keep, push, log_growth, cancels = weights_of(aligned, square, twice, t)
    if cancels:
        return square, factor, -math.log(factor), False
    # What rounding has left to correct.
    got = keep * (keep * twice + 2 * push * aligned) + push * push * square
    right = math.sqrt(twice / got) if got > 0 else math.nan
    left, more = right * factor * keep, right * push
    a, b = flat(u), flat(pace)
    for i in range(a.size):
        a[i] = left * a[i] + more * b[i]
    return square, factor, log_growth - math.log(factor), True


# -- as operations of a program -----------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def first_turn(x, v, forces, time, numbers, tables):  # type: ignore[no-untyped-def]
    """v = keep v + push M^-1 f, from velocities on the constraints, with forces that are not projected.

    It is not made (1) where digits would be lost, or where a drift would have to take out more than `MANY` times 2K.
    """
    n, twice = v.size, numbers[TWICE]
    weights, masses = table_array(tables, integers(tables), MORE), numbers[SIZE : SIZE + n]
    if not all_finite(forces):
        return 1
    aligned, raw = raw_sums(v, forces, weights, masses)
    keep, push, log_growth, cancels = weights_of(aligned, numbers[SQUARE], twice, time)
    if cancels or not push * push * raw <= MANY * twice:
        return 1
    u = flat(v)
    for i in range(n):
        u[i] = keep * u[i] + push * (weights[i] * forces[i])
    numbers[INTEGRAL] += log_growth
    return 0


@njit(cache=True, nogil=True, error_model="numpy")
def turn(x, v, forces, time, numbers, tables):  # type: ignore[no-untyped-def]
    """`after_drift`, from velocities on the constraints and forces, which are projected first."""
    n = v.size
    weights, masses = table_array(tables, integers(tables), MORE), numbers[SIZE : SIZE + n]
    if not all_finite(forces):
        return 1
    pace = numbers[SIZE + n : SIZE + 2 * n]
    for i in range(n):
        pace[i] = weights[i] * forces[i]
    if not packed_tangents(x, pace.reshape(v.shape), tables):
        return 1
    square, _, growth, done = after_drift(v, pace, masses, numbers[TWICE], time)
    if not done or not all_finite(v):
        return 1
    numbers[SQUARE] = square
    numbers[INTEGRAL] += growth
    return 0


# -- the thermostat -----------------------------------------------------------------------------------


@np.errstate(over="ignore")  # velocities are checked
def constrained_acceleration(system: System, x: FloatArray, forces: FloatArray, time: float) -> FloatArray:
    """M_par^+ f."""
    motion = system.motion
    pace = forces * system.weights
    return motion.project_velocities(x, pace, time=time, out=pace) if motion.rank else pace


def push_square(system: System, state: State) -> float:
    """f . M_par^+ f at the state."""
    assert state.forces is not None
    pace = constrained_acceleration(system, system.near_origin(state)[0], state.forces, state.time)
    return float(square_sum(pace, system.moving_masses))


class Isokinetic(Splitting):
    """Constant kinetic energy on constraints at rest: order 2, 4 or 6.

    Kicks follow the closed form at fixed forces; drifts fly along the constraints, after which the velocities are
    brought back to the length they had. Configurations are canonical at temperature T for
    2K = (g - 1) kT, g being the independent momenta: 3 n less the rank of the rows, less 1 for each direction in which
    total momentum is conserved. That is the default ('exact'). Velocities are spread over a sphere, not by Maxwell and
    Boltzmann: the kinetic temperature 2K/(g k) reads (g - 1)/g T.

    Symplectic it cannot be: the flow compresses phase space at the rate -(g - 1) alpha. It follows the exact motion
    backwards, with a negative time step, to the order of the scheme.

    Parameters
    ----------
    thermal_energy : float, optional
        k_B T in the units of energy in use; without it K stays what it is at the start.
    order : {2, 4, 6}
        1, 6 and 10 force evaluations a step.
    convention : {'exact', 'notes'}
        2K = (g - 1) k_B T, or 2K = 3 n k_B T of the notes (eq. 111), n atoms that can move; their configurations are
        hotter than T.
    momentum : {'auto', 'conserved', 'free'}
        See `kcons.thermostats.freedom`.

    Warns
    -----
    UserWarning
        At the start of a run: total momentum is conserved but for a factor exp(U/2K), and not zero; or a temperature is
        asked for and forces exert no torque, so that the same holds of angular momentum, or g is 2. None samples it.
        After 20,000 steps: a temperature is asked for, and no body, which rows tie together, feels another.

    Notes
    -----
    `State.thermostat` holds 2K, the integral of alpha over time, f.M_par^+ f and g. U + 2K int(alpha) is conserved
    (`conserved_energy`).

    References
    ----------
    Notes, eqs. 111-113; Evans, Hoover et al., Phys. Rev. A 28, 1016 (1983); closed form: Zhang, J. Chem. Phys. 106,
    6102 (1997); splittings: Blanes and Moan, J. Comput. Appl. Math. 142, 313 (2002).
    """

    reversible = False  # to the order of the scheme only: drifts are followed by a change of length
    symplectic = False

    @checked
    def __init__(
        self,
        thermal_energy: Positive | None = None,
        *,
        order: Literal[2, 4, 6] = 2,
        convention: Convention = "exact",
        momentum: Momentum = "auto",
    ) -> None:
        super().__init__(*SCHEMES[order])
        self.order, self.thermal_energy = order, thermal_energy
        self.convention: Convention = convention
        self.momentum: Momentum = momentum
        operations: list[Operation] = []
        for operation in splitting(*SCHEMES[order]):
            # Velocities are on the constraints whenever they turn.
            operations += [Turn(operation.fraction)] if isinstance(operation, Kick) else [operation]
            if isinstance(operation, Evaluate):
                operations.append(Project())
        operations.pop()
        parts, first = [_FirstTurn(operations[0].fraction), *operations[1:]], {"first_turn": first_turn}
        #: Compiled, and with the turns after drifts in Python.
        self._programs = [Program(operations, verbs, parts=parts) for verbs in ({**first, "turn": turn}, first)]

    def __repr__(self) -> str:
        given = [f"{self.thermal_energy!r}"] if self.thermal_energy is not None else []
        if self.order != 2:
            given.append(f"order={self.order}")
        if self.convention != "exact":
            given.append(f"convention={self.convention!r}")
        return f"Isokinetic({', '.join(given)})"

    operations = Interpreted.operations  # its kicks are its own

    def program(self, system: System | None) -> Program:
        return self._programs[system is not None and system.packed is None]

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` for targets that move, velocity-dependent forces, and friction besides its own."""
        refuse_dissipation(system, "closed kick; use Langevin for friction, or leave it out")
        refuse_driven(system, "and do work that no closed kick takes out; use Langevin")

    # -- steps ----------------------------------------------------------------------------------

    def start(self, system: System, state: State) -> State:
        """The state with its forces, and with the kinetic energy that the thermostat keeps.

        Velocities off the constraints are projected, then scaled; those that are right to rounding stay as they are to
        the last bit. A state with variables of another temperature or energy begins anew.

        Raises
        ------
        InputError
            All velocities are zero; the state carries variables of another thermostat.
        OverdeterminedError
            g is 1 (a temperature asked for), or 0.
        """
        self.check(system)
        if not state.is_of(system):
            state = replace(state, forces=None, thermostat=None)  # degrees of freedom are those of another system, too
        elif not state.has_forces_of(system):
            state = replace(state, forces=None)
        if carried(state, 4, "Isokinetic") and self._goes_on_from(system, state):
            if state.forces is None or self._left is None or state.positions is not self._left[3]:
                state = self._pushed(system, system.with_forces(state))
            return state
        state = system.with_forces(state)
        assert state.forces is not None
        velocities = system.motion.project_velocities(state.positions, state.velocities, time=state.time)
        found = square_sum(velocities, system.moving_masses)
        if not found > SMALLEST:
            raise InputError(
                "the isokinetic thermostat needs non-zero kinetic energy: draw velocities first "
                "(kcons.thermostats.thermal_velocities)",
                item="velocities",
            )
        free = freedom(system, state, state.forces, self.momentum)
        twice = self._twice_kinetic(system, free.count, found)
        turns, few = (self.thermal_energy is not None and each for each in (free.turns, free.count == FEW))
        warn_of_conserved_momenta(system.masses, state.velocities, free.directions, turns, stacklevel=8, few=few)
        off = float(np.abs(velocities - state.velocities).max())
        if off <= ROUNDING * float(np.abs(velocities).max()) and abs(found - twice) <= ROUNDING * twice:
            velocities = state.velocities
        else:
            velocities = velocities * math.sqrt(twice / found)
        variables = np.array([twice, 0.0, push_square(system, state), free.count])
        return replace(state, velocities=velocities, thermostat=variables)

    def _pushed(self, system: System, state: State) -> State:
        """The state with f.M_par^+ f of its forces, which is kept where it is that but for rounding."""
        assert state.thermostat is not None
        variables, square = state.thermostat.copy(), push_square(system, state)
        if abs(variables[2] - square) <= KEPT * square:
            return state
        variables[2] = square
        return replace(state, thermostat=variables)

    def _goes_on_from(self, system: System, state: State) -> bool:
        """Whether the variables of the state are those of this temperature or energy, and of these rows."""
        left = self._left
        same = left is not None and state.thermostat is left[0] and self.thermal_energy == left[1]
        if same and left is not None and state.velocities is left[2]:
            return True  # most often, and in no time
        assert state.thermostat is not None
        twice, _, _, count = state.thermostat.tolist()
        if not same:
            if abs(self._twice_kinetic(system, count, twice) - twice) > ROUNDING * twice:
                return False
            if not may_be(count, system, state, self.momentum):
                return False
        return bool(abs(square_sum(state.velocities, system.moving_masses) - twice) <= KEPT * twice)

    def _twice_kinetic(self, system: System, count: float, found: float) -> float:
        if self.thermal_energy is None:
            return found
        if self.convention == "notes":
            return int((system.inverse_masses > 0).sum()) * 3 * self.thermal_energy
        if count < 2:
            raise OverdeterminedError(
                "g - 1 = 0: isokinetic temperature undefined for a single degree of freedom; leave thermal_energy out "
                "and give velocities of the kinetic energy wanted, or use Langevin"
            )
        return (count - 1) * self.thermal_energy

    def begun(self, system: System, state: State, dt: float, steps: int) -> Interpreter:
        begin = self.start(system, state)
        if begin.step == LOOK_AT and self.thermal_energy is not None:
            warn_of_bodies_apart(system, begin, stacklevel=7)
        return IsokineticStep(system, begin, dt, self.program(system), steps)

    def at_once(self, state: State, steps: int) -> int:
        return min(steps, LOOK_AT - state.step) if state.step < LOOK_AT else steps

    def depends_on(self, system: System, state: State) -> Any:
        return self.thermal_energy, state.step == LOOK_AT

    def note(self, state: State) -> None:
        self._left = state.thermostat, self.thermal_energy, state.velocities, state.positions

    def conserved_energy(self, system: System, state: State) -> float:
        """U + 2K int(alpha dt), which the exact motion conserves.

        Needs `System.potential`.
        """
        state = self.start(system, state)
        assert state.thermostat is not None
        potential = system.total_energy(state) - system.kinetic_energy(state.velocities)
        return potential + float(state.thermostat[0] * state.thermostat[1])


class IsokineticStep(Interpreter):
    """Steps on their way."""

    def __init__(self, system: System, start: State, dt: float, program: Program, steps: int) -> None:
        assert start.thermostat is not None
        self.masses = system.moving_masses
        numbers = np.concatenate((start.thermostat, self.masses, self.masses))
        super().__init__(system, start, dt, program, steps, numbers)

    def turn(self, row: Row, begun: bool) -> None:
        """Bring v, projected, to its length, and follow the closed form."""
        t, twice = row.length * self.dt, float(self.numbers[TWICE])
        check_finite(self.v, "velocity", self.number)
        check_finite(self.forces, "force", self.number)
        pace = constrained_acceleration(self.system, self.place(row.here), self.forces, self.at(row.end))
        square, factor, growth, done = after_drift(self.v, pace, self.masses, twice, t)
        if not done:
            # The force is strong, and v runs against it.
            self.v[:], more = turned(factor * self.v, pace, self.masses.reshape(pace.shape), twice, t)
            growth += more
        self.numbers[SQUARE] = square
        self.numbers[INTEGRAL] += growth
        check_finite(self.v, "velocity", self.number)

    first_turn = turn

    def variables(self) -> FloatArray:
        return self.numbers[:SIZE].copy()
