"""Nose-Hoover chains on constraints."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from kcons.constraints.arguments import Count, Positive, checked
from kcons.constraints.compilation import njit
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.solvers.kernels.array_views import flat
from kcons.steppers import Rattle, State, System
from kcons.steppers.compiled_operations import check_finite, square_sum
from kcons.steppers.interpreter import Interpreted, Interpreter
from kcons.steppers.operations import Chain, Program, Row
from kcons.steppers.splitting import SUZUKI_4
from kcons.thermostats.freedom import (
    AT_REST,
    LOOK_AT,
    Momentum,
    carried,
    freedom,
    may_be,
    momentum_share,
    open_directions,
    refuse_dissipation,
    refuse_driven,
    warn_of_bodies_apart,
    warn_of_conserved_momenta,
)

#: Fractions of its time in which the chain moves on at fixed velocities, of order 4.
FRACTIONS = SUZUKI_4
#: What comes before a step on the constraints, and after it.
HALF = Chain(0.5)
#: What the numbers of a program begin with: k_B T, the links, the fractions in which they move, and how often they do;
#: after them as many masses of the links, positions and velocities of these with g, and masses for each coordinate.
KT, LINKS, PARTS, SIZE = range(4)


class NoseHooverChain(Interpreted):
    """Canonical dynamics without noise: half a step of the chain, a step on the constraints, half a step of the chain.

    The chain scales velocities, which stay tangent to rows that rest. Degrees of freedom are counted by rank, less
    one for each direction in which total momentum is conserved.

    Parameters
    ----------
    thermal_energy : float
        k_B T in the units of energy in use.
    period : float
        Time in which the temperature oscillates; a few times the slowest vibration, at least 20 time steps.
    length : int
        Links of the chain.
    momentum : {'auto', 'conserved', 'free'}
        See `kcons.thermostats.freedom`.

    Warns
    -----
    UserWarning
        At the start of a run, or where it goes on with other velocities: total momentum is conserved but for a factor,
        and not zero. At the start: the forces exert no torque, so that the same holds of angular momentum. After 20,000
        steps: no body, which rows tie together, feels another.

    Notes
    -----
    `State.thermostat` holds positions and velocities of the links, and g.

    References
    ----------
    Martyna, Tuckerman, Tobias and Klein, Mol. Phys. 87, 1117 (1996).
    """

    order = 2
    reversible = True
    symplectic = False
    force_evaluations = 1

    @checked
    def __init__(
        self,
        thermal_energy: Positive,
        period: Positive,
        *,
        length: Count = 3,
        momentum: Momentum = "auto",
    ) -> None:
        self.thermal_energy, self.period, self.length = thermal_energy, period, length
        self.momentum: Momentum = momentum
        self._program = Program((HALF, *Rattle().operations(), HALF), {"chain": _chain})

    def __repr__(self) -> str:
        return f"NoseHooverChain({self.thermal_energy!r}, {self.period!r}, length={self.length})"

    def program(self, system: System | None) -> Program:
        return self._program

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` for rows whose targets demand velocities, velocity-dependent forces, or friction."""
        refuse_dissipation(system, "place in this scheme; use Langevin")
        refuse_driven(system, "and scaled velocities would not follow them; use Langevin")

    def start(self, system: System, state: State) -> State:
        """The state with its forces, and a chain at rest if it carries none, or one of other degrees of freedom."""
        if not state.is_of(system):
            state = replace(state, thermostat=None)  # degrees of freedom are those of another system
        known = carried(state, 2 * self.length + 1, "this NoseHooverChain")
        state = system.with_forces(state)
        if known and state.thermostat is self._left:
            return state
        g = state.thermostat[-1] if known and state.thermostat is not None else math.nan
        goes_on = known and may_be(float(g), system, state, self.momentum)
        if goes_on and not self._moves_on(system, state):
            return state
        assert state.forces is not None
        free = freedom(system, state, state.forces, self.momentum)
        turns = free.turns and not goes_on
        warn_of_conserved_momenta(system.masses, state.velocities, free.directions, turns, stacklevel=8)
        if goes_on:
            return state
        return replace(state, thermostat=np.concatenate([np.zeros(2 * self.length), [free.count]]))

    def _moves_on(self, system: System, state: State) -> bool:
        """Whether velocities, which may be new ones, have total momentum, and g is less for what is conserved of it."""
        assert state.thermostat is not None
        if not state.thermostat[-1] < system.motion.degrees_of_freedom:
            return False
        directions = open_directions(system.motion, state.positions, state.time)
        return momentum_share(system.masses, state.velocities, directions) > AT_REST

    def begun(self, system: System, state: State, dt: float, steps: int) -> Interpreter:
        begin = self.start(system, state)
        if begin.step == LOOK_AT:
            warn_of_bodies_apart(system, begin, stacklevel=7)
        return ChainStep(system, begin, dt, self, self._program, steps)

    def at_once(self, state: State, steps: int) -> int:
        return min(steps, LOOK_AT - state.step) if state.step < LOOK_AT else steps

    def depends_on(self, system: System, state: State) -> Any:
        return self.thermal_energy, self.period, self.length, state.step == LOOK_AT

    def note(self, state: State) -> None:
        self._left = state.thermostat

    def _masses(self, count: float) -> FloatArray:
        """Q = k_B T (period/2 pi)^2, times g for the first link."""
        q = np.full(self.length, self.thermal_energy * (self.period / (2 * math.pi)) ** 2)
        q[0] *= count
        return q

    def conserved_energy(self, system: System, state: State) -> float:
        """Total energy of system and chain; needs `System.potential`."""
        state = self.start(system, state)
        assert state.thermostat is not None
        n, kt = self.length, self.thermal_energy
        place, speed, count = state.thermostat[:n], state.thermostat[n : 2 * n], float(state.thermostat[2 * n])
        chain = 0.5 * float(self._masses(count) @ speed**2) + kt * (count * float(place[0]) + float(place[1:].sum()))
        return system.total_energy(state) + chain


class ChainStep(Interpreter):
    """Steps on their way, with a chain."""

    def __init__(
        self, system: System, start: State, dt: float, thermostat: NoseHooverChain, program: Program, steps: int
    ) -> None:
        assert start.thermostat is not None
        chain = start.thermostat
        head = thermostat.thermal_energy, len(chain) // 2, len(FRACTIONS)
        links = thermostat._masses(float(chain[-1]))
        first = SIZE + len(FRACTIONS) + len(links)
        self.chain_at = slice(first, first + len(chain))
        numbers = np.concatenate((head, FRACTIONS, links, chain, system.moving_masses))
        super().__init__(system, start, dt, program, steps, numbers)
        self.thermostat = thermostat

    def chain(self, row: Row, begun: bool) -> None:
        """The chain could not move."""
        check_finite(self.v, "velocity", self.number)
        raise InputError(
            f"step {self.number}: a chain of period {self.system.shown_time(self.thermostat.period)} cannot follow a "
            f"time step of {self.system.shown_time(self.dt)}; take at most a twentieth of the period",
            item="dt",
        )

    def variables(self) -> FloatArray:
        return self.numbers[self.chain_at].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def _chain(x, v, forces, time, numbers, tables):  # type: ignore[no-untyped-def]
    """Move the chain on, and scale the velocities; 1 if these are no numbers then."""
    n, parts = int(numbers[LINKS]), int(numbers[PARTS])
    q = SIZE + parts
    end = q + 3 * n + 1
    u, masses = flat(v), numbers[end:]
    twice = square_sum(u, masses)
    scale = _advance(numbers[q + n : end], numbers[q : q + n], twice, numbers[KT], time, numbers[SIZE:q])
    if not math.isfinite(scale):
        return 1
    for i in range(u.size):
        u[i] *= scale
    return 0


@njit(cache=True, nogil=True)
def _advance(chain, q, twice, kt, time, fractions):  # type: ignore[no-untyped-def]
    """Move the chain on, in place; returns the factor of the velocities."""
    n, scale = len(q), 1.0
    count = chain[2 * n]
    place, speed = chain[:n], chain[n : 2 * n]
    for fraction in fractions:
        h = time * fraction
        for k in range(n - 1, -1, -1):
            speed[k] = _pushed(k, speed, q, twice * scale**2 - count * kt, kt, h)
        scale *= math.exp(-h * speed[0])
        for k in range(n):
            place[k] += h * speed[k]
        for k in range(n):
            speed[k] = _pushed(k, speed, q, twice * scale**2 - count * kt, kt, h)
    return scale


@njit(cache=True, nogil=True)
def _pushed(k, speed, q, excess, kt, h):  # type: ignore[no-untyped-def]
    damp = math.exp(-0.25 * h * speed[k + 1]) if k + 1 < len(q) else 1.0
    driving = excess if k == 0 else q[k - 1] * speed[k - 1] ** 2 - kt
    return (speed[k] * damp + 0.5 * h * driving / q[k]) * damp
