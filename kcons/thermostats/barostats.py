"""Barostats: the ways in which a cell may change, trial cells, the rule by which they are accepted, and a stepper.

A cell h (vectors as rows) becomes h S, S = exp(sum of e_k E_k), with generators E_k of unit trace where the volume
changes: e_k is then the change of ln V. In orthogonal kinds S is diagonal. 'flexible' keeps a lower triangular cell
triangular: the generators are those of lower triangular matrices, taken in the frame in which the cell is one.

The measure of the states is V dV for the volume times the invariant measure of shapes, so that volumes are spread alike
in all kinds. In the coordinates e_k this is V^(N+1) d e for orthogonal kinds. Lower triangular matrices have two
invariant measures, which differ by (S_11/S_33)^2 in a trial: see docs/constant_pressure.md.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal
from weakref import ref

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import (
    Count,
    Finite,
    Positive,
    Rng,
    check_pairs,
    checked,
    finite_number,
    refuse_other,
    seed_from,
)
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.steppers import State, Stepper, System
from kcons.steppers.compiled_operations import check_finite
from kcons.steppers.operations import Operation
from kcons.steppers.stepper import DropsSystemCaches, Listed, require_stepper
from kcons.thermostats.cells import BarostatBodies, CellSystem, Held, energy_by_strain, find_pieces, require_periodic
from kcons.thermostats.isokinetic import Isokinetic
from kcons.thermostats.langevin import Langevin
from kcons.thermostats.noise import noise_generator
from kcons.thermostats.nose_hoover import NoseHooverChain

Kind = Literal["isotropic", "semi-isotropic", "anisotropic", "flexible", "lateral", "normal"]

_UNIT = np.eye(9).reshape(3, 3, 3, 3)  # _UNIT[i, j] has a one at i, j
_X, _Y, _Z = (_UNIT[k, k] for k in range(3))
#: The kinds of a barostat: the generators E_k of each.
GENERATORS: dict[str, FloatArray] = {
    "isotropic": np.array([(_X + _Y + _Z) / 3]),
    "semi-isotropic": np.array([(_X + _Y) / 2, _Z]),
    "anisotropic": np.array([_X, _Y, _Z]),
    "flexible": np.array([_X, _Y, _Z, _UNIT[1, 0], _UNIT[2, 0], _UNIT[2, 1]]),
    "lateral": np.array([(_X + _Y) / 2]),
    "normal": np.array([_Z]),
}
#: Largest change of a length in one trial: from one cell to another within a tenth, the images that rows mean can be
#: followed. Barostats propose no more, and the acceptance knows that.
MOST = 0.09
#: In `State.barostat`: the cell, the work of accepted trials, a number for the class and kind of the barostat, then for
#: each mode trials, their summed probability of acceptance, and what the barostat adapts.
WORK = 9
OWNER = 10
MODES = 11


class Strains:
    """One of the kinds in which a cell changes, by k generators, shape (k, 3, 3)."""

    @checked
    def __init__(self, kind: Kind) -> None:
        self.kind, self.generators, self.flexible = kind, GENERATORS[kind], kind == "flexible"
        self.diagonals: FloatArray = np.ascontiguousarray(np.diagonal(self.generators, axis1=1, axis2=2))
        self.traces: FloatArray = self.diagonals.sum(axis=1)
        #: Sums of squares of their entries; axes along which lengths change; the largest |e_k| of a trial.
        self.sizes: FloatArray = (self.generators**2).sum(axis=(1, 2))
        self.axes: NDArray[np.bool_] = np.asarray(self.diagonals.sum(axis=0) > 0)
        self.most: FloatArray = MOST / np.abs(self.generators).max(axis=(1, 2))

    def __len__(self) -> int:
        return len(self.generators)

    def frame(self, cell: FloatArray) -> FloatArray | None:
        """Rotation Q with cell = L Q, L lower triangular; None for the unit matrix."""
        if not self.flexible or not np.triu(cell, 1).any():
            return None
        q, r = np.linalg.qr(cell.T)
        return (q * np.sign(np.diag(r))).T

    def generators_in(self, frame: FloatArray | None) -> FloatArray:
        return self.generators if frame is None else np.einsum("ji,kjl,lm->kim", frame, self.generators, frame)

    def matrix(self, e: FloatArray, frame: FloatArray | None) -> FloatArray:
        """S."""
        if not self.flexible:
            return np.diag(np.exp(e @ self.diagonals))
        inner = _exponential(np.tensordot(e, self.generators, 1))
        return inner if frame is None else frame.T @ inner @ frame

    def log_measure(self, e: FloatArray, moving: IntArray) -> float:
        """ln of the factor by which the measure of states grows; `moving` pieces follow the cell along each axis."""
        logs = e @ self.diagonals  # ln S_ii
        return float(logs @ moving + logs.sum() + (2 * (logs[0] - logs[2]) if self.flexible else 0.0))


def _exponential(a: FloatArray) -> FloatArray:
    """exp(a) for entries below 1 by its series, which leaves triangular matrices triangular to the last bit."""
    term = total = np.eye(3)
    for k in range(1, 20):
        term = term @ a / k
        total = total + term
    return total


#: Probability of acceptance that widths are adapted to, and how fast that fades: the mean change of ln(width) in trial
#: n is n^-FADING.
WANTED, FADING = 0.5, 0.6
#: Standard deviations of the noise of a trial that fit into the largest change of a length, beside its mean of one.
_WITHIN = 2.0


@dataclass(frozen=True)
class Press(Operation):
    """A trial cell, in one step of so many."""

    verb = "press"
    meaning: str = ""  # type: ignore[misc]


class Place:
    """Where a system is before or after a trial."""

    def __init__(
        self, system: CellSystem, pieces: BarostatBodies, state: State, thermal_energy: float, dt: float, rises: bool
    ) -> None:
        #: dU/d strain, see `energy_by_strain`, where the barostat asks for it, and the forces that are known by then.
        self.rise: FloatArray | None = None
        self.forces: FloatArray | None = None
        if rises:
            self.rise, self.forces = energy_by_strain(system, pieces, state)
        self.pieces, self.cell, self.thermal_energy, self.dt = pieces, system.cell, thermal_energy, dt
        self.energy = system.energy(state.positions, state.time, state.step)
        self.volume = system.volume
        self.area = float(np.linalg.norm(np.cross(self.cell[0], self.cell[1])))


class Barostat(DropsSystemCaches):
    """Base of the barostats: pieces, trial cells, acceptance. Give one to `ConstantPressure`, or to dynamics of ASE.

    Pieces - clusters tied by constraints, molecules where bonds are given, free atoms - move by their centers, with
    shape, orientation and velocities kept, so that all stays held. A trial is accepted with the probability
    min(1, exp(-(dU + P dV - gamma dA)/kT) (V'/V)^(N+1) w), N being the number of pieces and w what the proposals ask
    for: the isothermal-isobaric distribution is sampled without error of a step, whatever the thermostat does between.

    Parameters
    ----------
    pressure : float
        In the units of energy over volume in use.
    every : int
        Steps from one trial to the next.
    kind : {'isotropic', 'semi-isotropic', 'anisotropic', 'flexible', 'lateral', 'normal'}
        How the cell changes: as a whole; x and y together and z for itself (slabs, membranes); x, y and z; all lengths
        and angles, for crystals; x and y only; z only, at constant area.
    rng : int, numpy.random.Generator or None
        As for `Langevin`; the same number as for the thermostat does no harm.
    tension : float
        Surface tension gamma, energy over area, of the face spanned by the first two cell vectors.
    molecules : array_like of int, shape (n, 2), optional
        Bonds: what they join moves as one, besides what constraints tie.
    held : {'refuse', 'stay'}
        What to do with pieces that are held in space (planes, fixed atoms) along an axis that changes.
    cutoff : float, optional
        Of the forces: a cell less than twice as wide is refused.

    Raises
    ------
    InputError
        A pressure for each axis; a tension of a kind that has none.
    """

    #: What the trial is, in words.
    what = ""
    needs_stress = False

    @checked
    def __init__(
        self,
        pressure: float,
        *,
        every: Count = 100,
        kind: Kind = "isotropic",
        rng: Rng = 0,
        tension: Finite = 0.0,
        molecules: ArrayLike | None = None,
        held: Held = "refuse",
        cutoff: Positive | None = None,
    ) -> None:
        if not isinstance(pressure, str) and np.ndim(pressure):
            raise InputError(
                f"pressure is {pressure!r}; give one number. Work against a pressure of each axis depends on the way "
                "from one cell to another, so that no distribution belongs to it; for layers give tension=, by which "
                "the pressure along them is less by tension over thickness",
                item="pressure",
            )
        self.pressure, self.tension, self.strains = finite_number(pressure, "pressure"), tension, Strains(kind)
        if self.tension and kind not in ("semi-isotropic", "lateral", "anisotropic"):
            raise InputError(f"kind={kind!r} has no surface tension; use 'semi-isotropic' or 'lateral'", item="tension")
        self.every, self.seed = every, seed_from(rng)
        self.molecules = None if molecules is None else check_pairs(molecules, item="molecules")
        self.held: Held = held
        self.cutoff = cutoff
        self._known: tuple[CellSystem, BarostatBodies] | None = None

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.pressure!r}, every={self.every}, kind={self.strains.kind!r})"

    def pieces(self, system: CellSystem, positions: FloatArray, time: float = 0.0) -> BarostatBodies:
        """What moves as one; errors as of `find_pieces`."""
        known = self._known
        if known is None or known[0] is not system:
            require_periodic(system, self.strains.axes, self.strains.kind)
            self._check_width(system, system.cell)
            found = find_pieces(system, positions, self.strains.axes, self.molecules, self.held, time)
            if self.strains.flexible and not found.open.all():
                raise UnsupportedError("a cell that changes its angles turns what is held in space; use another kind")
            known = self._known = system, found
        return known[1]

    @cached_property
    def _owner(self) -> float:
        return float(zlib.crc32(f"{type(self).__name__} {self.strains.kind}".encode()))

    def variables_of(self, state: State) -> FloatArray | None:
        """Those that a state carries, None where no barostat has begun; `InputError` for those of another one."""
        known = state.barostat
        if known is None or len(known) <= WORK:
            return None
        if known.shape != (MODES + 3 * len(self.strains),) or known[OWNER] != self._owner:
            raise InputError(
                f"the state carries variables of another barostat, not of {self!r}; start with "
                f"dataclasses.replace(state, barostat=state.barostat[:{WORK}]), which is its cell",
                item="barostat",
            )
        return known

    def begin(self, system: CellSystem) -> FloatArray:
        """Variables of a run that begins in the system's present cell."""
        variables = np.zeros(MODES + 3 * len(self.strains))
        variables[:WORK] = system.cell.ravel()
        variables[OWNER] = self._owner
        return variables

    def acceptance(self, state: State) -> FloatArray:
        """Mean probability of acceptance of each mode so far; NaN before the first trial."""
        known = self.variables_of(state)
        if known is None:
            return np.full(len(self.strains), np.nan)
        tried, taken = self._modes(known)[:2]
        with np.errstate(invalid="ignore"):
            return np.asarray(taken / tried)

    # -- trials ---------------------------------------------------------------------------------

    def move(self, system: CellSystem, state: State, thermal_energy: float, dt: float) -> State:
        """The state after one trial; on any error the system is as it was.

        Raises
        ------
        InputError
            The trial cell is too small, for a constraint or the cutoff; `ImageError` where rows would mean others.
        NonFiniteError
            An energy is NaN, or that of the present cell infinite.
        """
        assert state.barostat is not None and state.cell is not None
        pieces = self.pieces(system, state.positions, state.time)
        before = Place(system, pieces, state, thermal_energy, dt, self.needs_stress)
        if not math.isfinite(before.energy):
            raise NonFiniteError(
                f"the potential energy is {before.energy} at step {state.step}, by which no trial cell can be judged: "
                "atoms overlap, or the force field returns what is no energy"
            )
        numbers = noise_generator((self.seed, 1), state.step)
        variables = state.barostat.copy()
        tried, taken, adapted = self._modes(variables)
        e, mode, forward = self._trial(before, adapted, numbers)
        drawn, kept = numbers.random(), np.abs(e) <= self.strains.most
        matrix = self.strains.matrix(e, self.strains.frame(before.cell))
        chance, positions, remainder, after = 0.0, state.positions, state.remainder, before
        if kept.all():
            d = pieces.moved(state.positions, matrix - np.eye(3), system.lattice)
            positions, remainder = _added(state.positions, d, state.remainder)
            check_finite(positions, "position", state.step)
            try:
                self._check_width(system, before.cell @ matrix)
                system.set_cell(before.cell @ matrix, positions)
                there = replace(state, positions=positions, forces=None, barostat=None)
                after = Place(system, pieces, there, thermal_energy, dt, self.needs_stress)
                log = self._log_chance(before, after, e) + self._reverse(after, e) - forward
                chance = math.exp(min(0.0, log))
            except BaseException:
                system.set_cell(before.cell, state.positions)
                raise
        accepted = drawn < chance
        self._adapt(mode, chance, tried, taken, adapted)
        if not accepted:
            if after is not before:
                system.set_cell(before.cell, state.positions)
            return replace(state, barostat=variables)
        variables[:WORK] = after.cell.ravel()
        variables[WORK] += after.energy - before.energy
        moved = replace(state, positions=positions, remainder=remainder, barostat=variables)
        return replace(moved, forces=after.forces, origin=(ref(system), positions, state.velocities, state.time))

    def _check_width(self, system: CellSystem, cell: FloatArray) -> None:
        if self.cutoff is not None:
            inverse = np.linalg.inv(cell)[:, system.periodic]
            width = 1 / float(np.linalg.norm(inverse, axis=0).max())
            if width < 2 * self.cutoff:
                raise InputError(
                    f"the cell has a width of {width:g}, less than twice the cutoff ({self.cutoff:g}): use a larger "
                    "system, a smaller cutoff, or look whether the pressure is meant, by which it may have shrunk",
                    item="cell",
                )

    def _log_chance(self, before: Place, after: Place, e: FloatArray) -> float:
        """ln of the ratio of the distribution at the two places."""
        rise = after.energy - before.energy + self.pressure * (after.volume - before.volume)
        if self.tension:
            rise -= self.tension * (after.area - before.area)
        return -rise / before.thermal_energy + self.strains.log_measure(e, before.pieces.moving)

    def _modes(self, variables: FloatArray) -> FloatArray:
        return variables[MODES:].reshape(3, -1)

    # -- what the kinds of barostat differ in ---------------------------------------------------

    def _trial(self, before: Place, adapted: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, int, float]:
        """A strain e, the mode that it counts for, and ln of the density by which it is proposed."""
        raise NotImplementedError

    def _reverse(self, after: Place, e: FloatArray) -> float:
        """ln of the density by which the trial back is proposed."""
        return 0.0

    def _adapt(self, mode: int, chance: float, tried: FloatArray, taken: FloatArray, adapted: FloatArray) -> None:
        """Count a trial, in place."""
        tried[mode] += 1
        taken[mode] += chance


def _added(x: FloatArray, d: FloatArray, remainder: FloatArray | None) -> tuple[FloatArray, FloatArray | None]:
    """x + d, and what rounding takes from it where that is kept (Knuth's exact sum)."""
    y = x + d
    if remainder is None:
        return y, None
    part = y - x
    return y, remainder + ((x - (y - part)) + (d - part))


class MonteCarloBarostat(Barostat):
    """Trial volumes (and shapes) at random; for any energy, no stress needed.

    One mode of the kind is drawn for each trial, and changed by e^u, u uniform within a width. Widths go to an
    acceptance of one half by steps that fade as n^-0.6, so that in the long run nothing is adapted any more.

    Parameters
    ----------
    pressure, **kwargs
        As for `Barostat`.
    width : float
        Of ln V at the start. A trial changes no length by more than 9 % (ln V by 0.27), whatever is asked for: where an
        acceptance of one half would take more, as of a few pieces, widths end there, and `acceptance` stays above one
        half. The distribution is right, and the volume takes longer to change.

    Notes
    -----
    A trial takes two energies, and one evaluation of the forces where it is accepted. Calculators that find energy and
    forces together know the first already, and the last one from the energy of the trial: one evaluation in all.

    References
    ----------
    Chow and Ferguson, Comput. Phys. Commun. 91, 283 (1995); Aqvist et al., Chem. Phys. Lett. 384, 288 (2004).
    """

    what = "scale cell and centers of pieces at random, accept by energy"

    @checked
    def __init__(self, pressure: float, *, width: Positive = 0.01, **kwargs: Any) -> None:
        super().__init__(pressure, **kwargs)
        self.width = width

    def begin(self, system: CellSystem) -> FloatArray:
        variables = super().begin(system)
        self._modes(variables)[2] = np.log(np.minimum(self.width, self.strains.most))
        return variables

    def _trial(self, before: Place, adapted: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, int, float]:
        mode, e = int(rng.integers(len(self.strains))), np.zeros(len(self.strains))
        e[mode] = math.exp(adapted[mode]) * (2 * rng.random() - 1)
        return e, mode, 0.0

    def _adapt(self, mode: int, chance: float, tried: FloatArray, taken: FloatArray, adapted: FloatArray) -> None:
        super()._adapt(mode, chance, tried, taken, adapted)
        grown = float(adapted[mode]) + 2 * (chance - WANTED) / float(tried[mode]) ** FADING
        adapted[mode] = min(grown, math.log(self.strains.most[mode]))


class CellRescaling(Barostat):
    """Stochastic cell rescaling; needs the stress of the forces.

    d e = (beta_T/tau)(P_int - P) dt + sqrt(2 kT beta_T/(V tau)) dW for e = ln V, and alike for the other modes of the
    cell, from one trial to the next, P_int being the pressure of pieces as points, N kT/V + virial/(3 V). The step is a
    proposal that is accepted by the energy as those of `MonteCarloBarostat` are: the distribution has no error of the
    step, and velocities stay as they are. Trials go in the direction of the pressure: from far away the cell
    relaxes in `tau`, and the noise is the one that belongs to the compressibility.

    Parameters
    ----------
    pressure, **kwargs
        As for `Barostat`.
    tau : float
        Time in which the volume relaxes. Where `every` steps are no longer short against it, fewer trials are accepted.
        A trial changes no length by more than 9 %: where noise alone would do so, as of a few pieces, it relaxes
        more slowly.
    compressibility : float
        beta_T; of water 4.5e-5/bar. A guess will do, it goes into the time of relaxation only.

    References
    ----------
    Bernetti and Bussi, J. Chem. Phys. 153, 114107 (2020); anisotropic: Del Tatto, Raiteri, Bernetti and Bussi, Appl.
    Sci. 12, 1139 (2022); acceptance: Roberts and Tweedie, Bernoulli 2, 341 (1996).
    """

    what = "scale cell and centers of pieces by the stress and by noise, accept by energy"
    needs_stress = True

    @checked
    def __init__(self, pressure: float, tau: Positive, compressibility: Positive, **kwargs: Any) -> None:
        super().__init__(pressure, **kwargs)
        self.tau, self.compressibility = tau, compressibility

    def _drift(self, place: Place) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation of each mode's change until the next trial."""
        assert place.rise is not None
        strains, volume, thermal_energy = self.strains, place.volume, place.thermal_energy
        generators = strains.generators_in(strains.frame(place.cell))
        enthalpy = generators.reshape(-1, 9) @ place.rise.ravel() + self.pressure * volume * strains.traces
        if self.tension:
            enthalpy -= self.tension * place.area * strains.diagonals[:, :2].sum(axis=1)
        # What the measure of the states and the changing width of the noise ask for leaves N, not N + 1.
        slope = strains.diagonals @ place.pieces.moving - enthalpy / thermal_energy
        spread = (
            self.compressibility * thermal_energy / (3 * strains.sizes * volume * self.tau) * self.every * abs(place.dt)
        )
        spread = np.minimum(spread, 0.5 * (strains.most / _WITHIN) ** 2)
        wide = np.sqrt(2 * spread)
        # Bounded, so that from far away trials can still be taken back, and be accepted.
        return np.clip(spread * slope, -wide, wide), wide

    def _trial(self, before: Place, adapted: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, int, float]:
        mean, wide = self._drift(before)
        e = mean + wide * rng.standard_normal(len(mean))
        return e, 0, _log_normal(e, mean, wide)

    def _reverse(self, after: Place, e: FloatArray) -> float:
        return _log_normal(-e, *self._drift(after))

    def acceptance(self, state: State) -> FloatArray:
        """Mean probability of acceptance so far, the same for all modes, which change together; NaN without trials."""
        return np.full(len(self.strains), super().acceptance(state)[0])


def _log_normal(e: FloatArray, mean: FloatArray, wide: FloatArray) -> float:
    return float(-0.5 * (((e - mean) / wide) ** 2).sum() - np.log(wide).sum())


def require_barostat(given: object) -> None:
    """Raise `InputError` for what is no barostat."""
    refuse_other(given, Barostat, "barostat", "MonteCarloBarostat(pressure) or CellRescaling(...)")


class ConstantPressure(Listed):
    """Steps of a thermostat, and a trial of the barostat after every so many.

    Parameters
    ----------
    stepper : Langevin, NoseHooverChain or Isokinetic
        Others keep no temperature, or remember energies and forces of the cell that was.
    barostat : Barostat

    Raises
    ------
    InputError
        What is given is no barostat.

    Notes
    -----
    `State.barostat` holds the cell (`State.cell`), the energy that trials have brought, and what the barostat has
    learned. Trials are a function of the seed and of the number of the step: a run that is continued from a saved state
    is the same to the last bit. The cell of the `System` follows the state that a step begins with.
    """

    reversible = False
    symplectic = False

    def __init__(self, stepper: Stepper, barostat: Barostat) -> None:
        require_stepper(stepper)
        require_barostat(barostat)
        self.stepper, self.barostat = stepper, barostat

    def __repr__(self) -> str:
        return f"ConstantPressure({self.stepper!r}, {self.barostat!r})"

    @property
    def order(self) -> int:
        return self.stepper.order

    @property
    def force_evaluations(self) -> int:
        """Of the stepper; a trial takes one more, and two energies."""
        return self.stepper.force_evaluations

    def operations(self, system: System | None = None) -> tuple[Operation, ...]:
        inner = self.stepper.operations(system) if isinstance(self.stepper, Listed) else ()
        return *inner, self._press

    def parts(self, system: System | None = None) -> tuple[Operation, ...]:
        inner = self.stepper.parts(system) if isinstance(self.stepper, Listed) else ()
        return *inner, self._press

    @property
    def _press(self) -> Press:
        barostat = self.barostat
        return Press(f"{barostat.what} ({barostat.strains.kind}), every {barostat.every} steps")

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` without a thermostat, and where the stepper may not be used."""
        if not isinstance(system, CellSystem):
            raise UnsupportedError("a barostat needs a system whose cell can change: make a CellSystem")
        # Not what derives from them, with several time steps, which remembers forces.
        if type(self.stepper) not in (Langevin, NoseHooverChain, Isokinetic):
            raise UnsupportedError(
                f"{self.stepper!r} keeps no temperature, by which a barostat judges its trials, or does not know that "
                "the cell has changed; use Langevin, NoseHooverChain or Isokinetic"
            )
        self.stepper.check(system)

    def start(self, system: System, state: State) -> State:
        """The state in its cell, with variables of the barostat."""
        self.check(system)
        assert isinstance(system, CellSystem)
        known = self.barostat.variables_of(state)
        system.enter(state)
        if known is None:
            self.barostat.pieces(system, state.positions, state.time)
            state = replace(state, barostat=self.barostat.begin(system))
            if self.barostat.needs_stress:
                system.stress(state.positions, state.time)
        return state

    def step(self, system: System, state: State, dt: float) -> State:
        """Advance by `dt`.

        Raises
        ------
        KconsError
            As the stepper and the barostat; the state is as it was, also the cell of the system.
        """
        return self.march(system, state, dt, 1)

    def march(self, system: System, state: State, dt: float, steps: int) -> State:
        """The state after so many steps, the same to the last bit as by `step`."""
        while steps > 0:
            n = min(steps, self.barostat.every - state.step % self.barostat.every)
            state = self._advanced(system, state, dt, n)
            steps -= n
        return state

    def _advanced(self, system: System, state: State, dt: float, steps: int) -> State:
        if dt < 0:
            raise InputError(
                f"the time step is {system.shown_time(dt)}; trials of a barostat cannot be taken back", item="dt"
            )
        state = self.start(system, state)
        assert isinstance(system, CellSystem)
        after = self.stepper.march(system, state, dt, steps)  # type: ignore[attr-defined]  # see `check`
        if dt and after.step % self.barostat.every == 0:
            after = self._pressed(system, after, dt)
        return after

    def _pressed(self, system: CellSystem, state: State, dt: float) -> State:
        try:
            after = self.barostat.move(system, state, self.thermal_energy(state), dt)
        except Exception as error:
            if getattr(error, "step", None) is None:
                error.step = state.step  # type: ignore[attr-defined]
            raise
        if isinstance(self.stepper, Isokinetic) and after.positions is not state.positions:
            # Its variables know of the forces: it finds both anew.
            return replace(after, forces=None)
        return after

    def thermal_energy(self, state: State) -> float:
        """kT of the configurations that the stepper samples."""
        if isinstance(self.stepper, Isokinetic):
            assert state.thermostat is not None
            return float(state.thermostat[0] / (state.thermostat[3] - 1))
        return float(self.stepper.thermal_energy)  # type: ignore[attr-defined]  # see `check`

    def conserved_energy(self, system: System, state: State) -> float:
        """What the thermostat conserves, less the energy that trials have brought."""
        state = self.start(system, state)
        assert state.barostat is not None
        return float(self.stepper.conserved_energy(system, state)) - float(state.barostat[WORK])  # type: ignore[attr-defined]


def in_cell(variables: FloatArray | None, cell: FloatArray) -> FloatArray | None:
    """Variables of a barostat that goes on in a cell that somebody else has changed."""
    if variables is None:
        return None
    own = variables.copy()
    own[:WORK] = cell.ravel()
    return own
