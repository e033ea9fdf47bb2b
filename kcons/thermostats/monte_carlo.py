"""Hamiltonian Monte Carlo on constraints: averages without any error of the time step.

Proposals by dynamics, each step of which is seen to be reversible, are accepted or rejected by the change of energy.
The time step for a wanted share of accepted proposals is found before a run, and configurations are exchanged between
neighboring temperatures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import is_
from typing import Annotated
from weakref import ref

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import Positive, Rng, Share, checked, positive, seed_from, share, whole_number
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import extent
from kcons.errors import (
    ConvergenceError,
    InputError,
    NonFiniteError,
    ReversibilityError,
    SingularGeometryError,
    UnsupportedError,
)
from kcons.steppers import Rattle, ReversibilityCheck, State, Stepper, System
from kcons.steppers.stepper import DropsSystemCaches, require_stepper, stays
from kcons.thermostats.freedom import carried, refuse_dissipation, refuse_driven
from kcons.thermostats.noise import noise_generator

#: What `State.thermostat` holds, in this order; the last is what became of the last proposal, 0 before the first.
POTENTIAL, ACCEPTED, ENERGY, IRREVERSIBLE, UNSOLVED, NOT_FINITE, CHANGE, SUM, SQUARES, LAST = range(10)
SIZE = 10
#: Uses of random numbers, told apart in the counter of the generator; 0 is Langevin's.
PROPOSAL, EXCHANGE = 1, 2


@dataclass(frozen=True)
class Counts:
    """What became of the proposals of a run.

    Attributes
    ----------
    accepted : int
    energy : int
        Rejected since the energy had changed too much.
    irreversible : int
        Rejected since a step, taken back, did not end where it began.
    unsolved : int
        Rejected since a projection had no solution.
    not_finite : int
        Rejected since a force or the energy was not finite.
    change : float
        Change of the energy over kT in the last proposal; NaN if it had none.
    mean_square : float
        Mean of the square of that change, over the proposals that had one.
    """

    accepted: int
    energy: int
    irreversible: int
    unsolved: int
    not_finite: int
    change: float
    mean_square: float

    @property
    def proposals(self) -> int:
        return self.accepted + self.energy + self.irreversible + self.unsolved + self.not_finite

    @property
    def acceptance(self) -> float:
        """Share of the proposals that were accepted; NaN before the first."""
        return self.accepted / self.proposals if self.proposals else math.nan

    @classmethod
    def of(cls, state: State) -> Counts:
        """Those of a state; all 0 before the first proposal."""
        held = variables_of(state)
        told = held[ACCEPTED] + held[ENERGY]
        change = float(held[CHANGE]) if held[LAST] else math.nan
        square = float(held[SQUARES] / told) if told else math.nan
        accepted, energy, irreversible, unsolved, not_finite = held[ACCEPTED : NOT_FINITE + 1].astype(int).tolist()
        return cls(accepted, energy, irreversible, unsolved, not_finite, change, square)


def variables_of(state: State) -> FloatArray:
    """A copy of the variables that a state carries, those of a run that begins where it carries none."""
    if carried(state, SIZE, "HamiltonianMonteCarlo"):
        assert state.thermostat is not None
        return state.thermostat.copy()
    return np.array([math.nan, *[0.0] * (SIZE - 1)])


class ReversedSteps(ReversibilityCheck):
    """A check of reversibility that costs projections and no force.

    A step and the step back ask for forces at the same places. Those of the step are remembered for the way back; only
    where the way back leads elsewhere are forces asked for again. So the whole map is checked, whatever it consists of,
    and one step at a time, so that chaos does not hide what is wrong and a bad proposal ends early.
    """

    def __init__(self, system: System, stepper: Stepper, tolerance: float) -> None:
        super().__init__(stepper, tolerance)
        self.system = system
        force = None if system.force is None else self._force
        #: The same system, which remembers.
        self.watched = System(system.motion, force, potential=system.potential, far=system.far)
        self._known: list[tuple[FloatArray, FloatArray]] = []
        #: How near a place of the way back is to one that is known; negative on the way there.
        self._near = -1.0

    def step(self, system: System, state: State, dt: float) -> State:
        """Advance by `dt`, and see that the step back ends at `state`; errors as of `ReversibilityCheck`."""
        state, x = replace(state, origin=None), state.positions  # forces of the system are those of the watched one
        self._known, self._near = [] if state.forces is None else [(x, state.forces)], -1.0
        after = self.stepper.step(self.watched, state, dt)
        self._near = self.tolerance * extent(x) + 8 * float(np.spacing(np.abs(x).max(initial=0.0)))
        self.take_back(self.watched, state, after, dt, lambda: [forces for _, forces in self._known])
        return after

    def _force(self, x: FloatArray, time: float) -> ArrayLike:
        if self._near >= 0:
            for place, forces in reversed(self._known):
                if float(np.abs(x - place).max(initial=0.0)) <= self._near:
                    return forces
        force = self.system.force
        assert force is not None
        forces = self.system.accepted(force(x, time), 0, True)
        if self._near < 0:
            self._known.append((x.copy(), forces))
        return forces


class HamiltonianMonteCarlo(DropsSystemCaches):
    """Canonical sampling on constraints without any error of the time step.

    A step draws velocities in the tangent plane, makes a trajectory with a reversible stepper, and accepts its end
    with probability min(1, exp(-dH/kT)); otherwise the state stays, with opposite velocities. The stationary density
    is exp(-H/kT) on positions and velocities that fulfil the constraints: positions have the density exp(-U/kT) on the
    surface of the constraints in the mass metric, as in exact constrained dynamics at this temperature.

    Every step of a trajectory is taken back and compared with its start; without that, a projection that finds another
    solution on the way back would spoil the average without any sign. The way back uses the forces of the way there,
    and costs projections only. A proposal that cannot be taken back, or has no solution, is rejected and counted.

    All of a step is a function of the state and the seed (and the number of the step), so that a run continued from
    a saved state is the same to the last bit. The clock goes on by the length of the trajectory in every step.

    Parameters
    ----------
    thermal_energy : float
        k_B T in the units of energy in use.
    steps : int or (int, int)
        Time steps of a proposal; with two numbers drawn between them, both included, which keeps trajectories from
        coming back to where they began.
    rng : int, numpy.random.Generator or None
        As for `Langevin`.
    stepper : Stepper, optional
        A reversible and symplectic one: `Rattle` by default, `Geodesic`, a `Composition`, `BlanesMoan4`, ...
    keep : float
        The part a of the velocities that is kept, v = a v + sqrt(1 - a^2) noise. 0: all are drawn anew. Near 1, with
        few steps of a proposal: generalised Hamiltonian Monte Carlo, which is near to Langevin dynamics.
    tolerance : float
        Largest difference of a step taken back, relative as for `kcons.steppers.ReversibilityCheck`.

    Raises
    ------
    UnsupportedError
        A stepper that is not reversible and symplectic, such as a thermostat.

    Notes
    -----
    `State.thermostat` holds the potential energy and the counts, which `Counts.of(state)` reads.

    References
    ----------
    Duane, Kennedy, Pendleton and Roweth, Phys. Lett. B 195, 216 (1987); Horowitz, Phys. Lett. B 268, 247 (1991); on
    constraints with the check of the way back: Zappa, Holmes-Cerfon and Goodman, Commun. Pure Appl. Math. 71, 2609
    (2018); Lelievre, Rousset and Stoltz, Numer. Math. 143, 379 (2019).
    """

    reversible = False
    symplectic = False

    @checked
    def __init__(
        self,
        thermal_energy: Positive,
        steps: int | tuple[int, int],
        rng: Rng,
        *,
        stepper: Stepper | None = None,
        keep: Share = 0.0,
        tolerance: Positive = 1e-9,
    ) -> None:
        self.thermal_energy, self.keep, self.tolerance = thermal_energy, keep, tolerance
        self.steps, self.seed = step_range(steps), seed_from(rng)
        self.stepper: Stepper = Rattle() if stepper is None else stepper
        require_stepper(self.stepper)
        if not (getattr(self.stepper, "reversible", False) and getattr(self.stepper, "symplectic", False)):
            raise UnsupportedError(
                f"{self.stepper!r} is not reversible and symplectic, and its proposals could not be corrected; use "
                "Rattle, Geodesic, a Composition or a RungeKuttaNystrom stepper"
            )
        self._known: tuple[System, ReversedSteps] | None = None

    def __repr__(self) -> str:
        steps = self.steps if self.steps[0] < self.steps[1] else self.steps[0]
        return f"HamiltonianMonteCarlo({self.thermal_energy!r}, {steps!r}, rng={self.seed}, stepper={self.stepper!r})"

    @property
    def order(self) -> int:
        return self.stepper.order

    @property
    def force_evaluations(self) -> int:
        """Of a proposal; the mean, where the number of its steps is drawn."""
        return round(self.stepper.force_evaluations * sum(self.steps) / 2)

    def check(self, system: System) -> None:
        """Raise where there is no such density: for forces without a potential, rows that move or hold velocities."""
        refuse_dissipation(system, "energy to accept or reject by")
        refuse_driven(system, "which leaves no stationary density: hold positions that rest, or use Langevin")
        if system.force is not None and system.potential is None:
            raise InputError(
                "this System has no potential; pass potential=..., by which proposals are accepted", item="potential"
            )
        self.stepper.check(system)

    @np.errstate(over="ignore", invalid="ignore")
    def step(self, system: System, state: State, dt: float) -> State:
        """Make one proposal with time steps of `dt`, and accept or reject it.

        Raises
        ------
        NonFiniteError
            The energy of the state itself is not finite.
        InputError, UnsupportedError
            As `check`; a negative time step; the state carries variables of another thermostat.
        """
        self.check(system)
        still = stays(state, dt)
        if still is not None:
            return still
        if dt < 0:
            raise InputError(f"the time step is {system.shown_time(dt)}; noise cannot be taken back", item="dt")
        held = variables_of(state)
        # Positions without forces may be new ones, and what a state carries, or a file, that of other forces or places.
        goes_on = self._left is not None and all(map(is_, self._left, (state.thermostat, state.positions)))
        strange = not goes_on and (state.origin is None or state.origin[0] is None)
        if strange or not state.has_forces_of(system) or math.isnan(held[POTENTIAL]):
            known, held[POTENTIAL] = held[POTENTIAL], system.potential_energy(state.positions, state.time)
            if not math.isnan(known) and known != held[POTENTIAL]:
                state = replace(state, forces=None)
            if not math.isfinite(held[POTENTIAL]):
                raise NonFiniteError(
                    f"the potential energy is {held[POTENTIAL]} before step {state.step + 1}",
                    item="energy",
                    step=state.step + 1,
                )
        random = noise_generator((self.seed, 0), state.step + 1, PROPOSAL)
        count, threshold = int(random.integers(self.steps[0], self.steps[1] + 1)), math.log1p(-random.random())
        begin = replace(system.with_forces(state), velocities=self._refreshed(system, state, random))
        end, reason, change, potential = self._judged(system, begin, dt, count, threshold, held[POTENTIAL])
        held[CHANGE], held[LAST] = change, reason
        held[reason] += 1
        if reason in (ACCEPTED, ENERGY):
            held[SQUARES] += change * change
            held[SUM] += min(1.0, math.exp(-max(change, 0.0)))
        if reason != ACCEPTED:
            end = replace(begin, velocities=-begin.velocities)
        else:
            held[POTENTIAL] = potential
        time, left_over = state.later(count * dt)
        number, origin = state.step + 1, (ref(system), end.positions, end.velocities, time)
        self._left = held, end.positions
        return replace(end, time=time, time_remainder=left_over, step=number, thermostat=held, origin=origin)

    # -- inner ----------------------------------------------------------------------------------

    def _judged(
        self, system: System, begin: State, dt: float, count: int, threshold: float, potential: float
    ) -> tuple[State, int, float, float]:
        """The end of a proposal, what became of it, the change of energy over kT, and the potential energy there."""
        kinetic, end = system.kinetic_energy(begin.velocities), begin
        if self._known is None or self._known[0] is not system:
            self._known = system, ReversedSteps(system, self.stepper, self.tolerance)
        steps = self._known[1]
        try:
            for _ in range(count):
                end = steps.step(system, end, dt)
        except (ConvergenceError, SingularGeometryError, NonFiniteError) as error:
            reason = IRREVERSIBLE if isinstance(error, ReversibilityError) else UNSOLVED
            return begin, NOT_FINITE if isinstance(error, NonFiniteError) else reason, math.nan, potential
        there = system.potential_energy(end.positions, end.time)
        change = (system.kinetic_energy(end.velocities) - kinetic + (there - potential)) / self.thermal_energy
        if not math.isfinite(change):
            return begin, NOT_FINITE, math.nan, potential
        return end, ACCEPTED if threshold < -change else ENERGY, change, there

    def _refreshed(self, system: System, state: State, random: np.random.Generator) -> FloatArray:
        """Velocities of which a part is kept and a part drawn, in the tangent plane."""
        x, v = system.near_origin(state)[0], state.velocities
        noise = random.standard_normal(v.shape)
        noise *= np.sqrt((1 - self.keep**2) * self.thermal_energy * system.inverse_masses)
        return system.motion.project_velocities(x, self.keep * v + noise, time=state.time)


def step_range(steps: int | tuple[int, int]) -> tuple[int, int]:
    """Fewest and most steps of a proposal."""
    given = np.asarray(steps)
    both = np.broadcast_to(given, 2) if given.shape in ((), (2,)) else np.zeros(2)
    if given.dtype.kind not in "iu" or not 1 <= both[0] <= both[1]:
        raise InputError(
            f"steps is {steps!r}; give a whole number, 1 or more, or the fewest and the most", item="steps"
        )
    return int(both[0]), int(both[1])


#: Of dual averaging: how strongly proposals move the step, how many count as made already, how fast old ones are
#: forgotten.
PULL, BEFORE, FORGET = 0.2, 10, 0.75


@dataclass(frozen=True)
class Tuned:
    """What `tune` found.

    Attributes
    ----------
    dt : float
        The time step.
    acceptance : float
        Mean probability of the second half of the proposals, whose steps differed still.
    state : State
        To go on from, with counts that begin anew.
    """

    dt: float
    acceptance: float
    state: State


@checked
def tune(
    system: System,
    state: State,
    dt: Positive,
    sampler: HamiltonianMonteCarlo,
    *,
    wanted: Annotated[float, positive, share] | None = None,
    proposals: Annotated[int, partial(whole_number, least=20)] = 80,
) -> Tuned:
    """Find the time step for a share of accepted proposals, by proposals with steps that differ.

    They bring the state towards equilibrium too, but are no sample: a step that looks at what it did has no stationary
    density. Run with the step that was found, which stays.

    Parameters
    ----------
    system : System
    state : State
    dt : float
        To begin with.
    sampler : HamiltonianMonteCarlo
        Its number of steps stays, so that trajectories become longer or shorter with the step.
    wanted : float, optional
        Between 0 and 1; by default p/(p + 1) for order p, which costs least: for many degrees of freedom dH is normal,
        its deviation s is proportional to dt^p and its mean s^2/2, and dt erfc(s/sqrt(8)) is largest where 0.651 of the
        proposals are accepted at order 2, 0.796 at order 4, 0.856 at order 6.
    proposals : int
        20 or more.

    Raises
    ------
    ConvergenceError
        No proposal of the second half could be made, however small the step became.
    KconsError
        As `HamiltonianMonteCarlo.step`.

    References
    ----------
    Dual averaging: Hoffman and Gelman, J. Mach. Learn. Res. 15, 1593 (2014), Algorithm 5.
    """
    sampler.check(system)
    held = variables_of(state)
    wanted = sampler.order / (sampler.order + 1) if wanted is None else wanted
    begin = log = math.log(dt)
    missing = mean = 0.0
    chances: list[float] = []
    for made in range(1, proposals + 1):
        before = held[SUM]
        state = sampler.step(system, state, math.exp(log))
        held = np.asarray(state.thermostat)
        chances.append(float(held[SUM] - before))
        missing += wanted - chances[-1]
        log = begin - math.sqrt(made) / PULL * missing / (made + BEFORE)
        mean += made**-FORGET * (log - mean)
    acceptance = float(np.mean(chances[(proposals + 1) // 2 :]))
    if not acceptance > 0:
        raise ConvergenceError(
            f"no proposal succeeded with time steps down to {system.shown_time(math.exp(log))}; is the start sound?"
        )
    begun = np.array([held[POTENTIAL], *[0.0] * (SIZE - 1)])
    return Tuned(math.exp(mean), acceptance, replace(state, thermostat=begun))


def exchange(
    states: Sequence[State], thermal_energies: Sequence[float], rng: Rng, number: int
) -> tuple[list[State], list[bool | None]]:
    """Offer neighbors an exchange: with probability min(1, exp((1/kT_i - 1/kT_j) (U_i - U_j))) it is made.

    Configurations change places and velocities are scaled with sqrt(T), which leaves the product of all densities as it
    is. Pairs (0, 1), (2, 3), ... take turns with (1, 2), (3, 4), ... Numbers, clocks and counts stay with their
    temperatures. Each run needs a seed of its own: with the same one all draw the same numbers, and runs that are not
    independent do not have the product of the densities.

    Parameters
    ----------
    states : sequence of State
        One for each temperature, of the same system, after at least one step of `HamiltonianMonteCarlo` each: they know
        their potential energies.
    thermal_energies : sequence of float
        k_B T of each.
    rng : int, numpy.random.Generator or None
    number : int
        Of the round: random numbers are a function of it and of the integer given as `rng`.

    Returns
    -------
    states : list of State
    made : list of bool or None, one less than states
        Whether each pair was exchanged; None where it had no turn.

    Raises
    ------
    InputError
        A state without a potential energy; states of other numbers of atoms.
    """
    if not all(isinstance(given, Sequence | np.ndarray) for given in (states, thermal_energies)):
        raise InputError("give a sequence of states, and of as many temperatures", item="states")
    kt = np.array([positive(value, "thermal_energies") for value in thermal_energies])
    if len(states) < 2 or len(states) != len(kt):
        raise InputError(
            f"{len(states)} states and {len(kt)} temperatures; give one for each, two or more", item="states"
        )
    number = whole_number(number, "number", 0, 2**64 - 1)
    for k, state in enumerate(states):
        carries = isinstance(state, State) and state.thermostat is not None and state.thermostat.shape == (SIZE,)
        if not carries or math.isnan(potential_of(state)):
            raise InputError(
                f"state {k} does not know its potential energy; make a step of HamiltonianMonteCarlo with it first",
                item="states",
            )
        if state.positions.shape != states[0].positions.shape:
            raise InputError(f"state {k} has another number of atoms than state 0", item="states")
    chances = np.log1p(-noise_generator((seed_from(rng), 0), number, EXCHANGE).random(len(states)))
    after = list(states)
    told: list[bool | None] = [None] * (len(states) - 1)
    for k in range(int(number) % 2, len(states) - 1, 2):
        a, b = states[k], states[k + 1]
        told[k] = bool(chances[k] < (1 / kt[k] - 1 / kt[k + 1]) * (potential_of(a) - potential_of(b)))
        if told[k]:
            scale = math.sqrt(float(kt[k] / kt[k + 1]))
            after[k], after[k + 1] = _moved(b, a, scale), _moved(a, b, 1 / scale)
    return after, told


def potential_of(state: State) -> float:
    """The potential energy that a state of `HamiltonianMonteCarlo` knows; NaN if it does not."""
    return math.nan if state.thermostat is None else float(state.thermostat[POTENTIAL])


def _moved(there: State, here: State, scale: float) -> State:
    """The configuration of `there`, with velocities scaled, in the run of `here`."""
    assert there.thermostat is not None and here.thermostat is not None
    held = here.thermostat.copy()
    held[POTENTIAL] = there.thermostat[POTENTIAL]
    clock = {name: getattr(here, name) for name in ("time", "time_remainder", "step", "barostat")}
    return replace(there, velocities=scale * there.velocities, thermostat=held, **clock)
