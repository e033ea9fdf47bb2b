"""Trial cells, and the rule by which they are accepted."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary, ref

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import check_pairs, finite_number, positive, seed_number, whole_number
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.steppers import State
from kcons.steppers.operations import Operation
from kcons.steppers.stages.compiled_operations import check_finite
from kcons.thermostats.langevin import noise_generator
from kcons.thermostats.pressure.cell_system import CellSystem
from kcons.thermostats.pressure.pieces import Held, Pieces, find_pieces, lattice_of, require_periodic
from kcons.thermostats.pressure.strains import Kind, Strains

#: In `State.barostat`: the cell, the work of accepted trials, a number for the class and kind of the barostat, then for
#: each mode trials, their summed probability of acceptance, and what the barostat adapts.
WORK = 9
OWNER = 10
MODES = 11


@dataclass(frozen=True)
class Press(Operation):
    """A trial cell, in one step of so many."""

    verb = "press"

    every: int
    what: str

    @property
    def meaning(self) -> str:  # type: ignore[override]
        """In words."""
        return f"{self.what}, every {self.every} steps"


@dataclass(frozen=True, eq=False)
class Place:
    """Where the system is before or after a trial.

    Attributes
    ----------
    cell, positions, energy
    forces, stress : ndarray or None
        Where the barostat asks for them.
    """

    cell: FloatArray
    positions: FloatArray
    energy: float
    forces: FloatArray | None = None
    stress: FloatArray | None = None

    @cached_property
    def volume(self) -> float:
        return float(abs(np.linalg.det(self.cell)))

    @property
    def area(self) -> float:
        """Of the face spanned by the first two vectors."""
        return float(np.linalg.norm(np.cross(self.cell[0], self.cell[1])))


@dataclass(frozen=True, eq=False)
class Trial:
    """A strain e, and ln of the densities by which it and its reverse are proposed."""

    e: FloatArray
    mode: int
    forward: float = 0.0


class Barostat:
    """Base of the barostats: pieces, trial cells, acceptance. Give one to `ConstantPressure`, or to dynamics of ASE.

    Pieces - clusters tied by constraints, molecules where bonds are given, free atoms - move by their centres, with
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
    seed : int
        The same as that of a thermostat does no harm.
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
        Numbers that are not finite, a pressure for each axis, an unknown kind, `every` below 1.
    """

    #: What the trial is, in words.
    what = ""
    needs_stress = False

    def __init__(
        self,
        pressure: float,
        *,
        every: int = 100,
        kind: Kind = "isotropic",
        seed: int = 0,
        tension: float = 0.0,
        molecules: ArrayLike | None = None,
        held: Held = "refuse",
        cutoff: float | None = None,
    ) -> None:
        if not isinstance(pressure, str) and np.ndim(pressure):
            raise InputError(
                f"pressure is {pressure!r}; give one number. Work against a pressure of each axis depends on the way "
                "from one cell to another, so that no distribution belongs to it; for layers give tension=, by which "
                "the pressure along them is less by tension over thickness",
                item="pressure",
            )
        self.pressure = finite_number(pressure, "pressure")
        self.tension = finite_number(tension, "tension")
        self.strains = Strains.of(kind)
        if self.tension and kind not in ("semi-isotropic", "lateral", "anisotropic"):
            raise InputError(f"kind={kind!r} has no surface tension; use 'semi-isotropic' or 'lateral'", item="tension")
        if held not in ("refuse", "stay"):
            raise InputError(f"held is {held!r}; choose 'refuse' or 'stay'", item="held")
        self.every, self.seed = whole_number(every, "every"), seed_number(seed)
        self.molecules = None if molecules is None else check_pairs(molecules)
        self.held: Held = held
        self.cutoff = None if cutoff is None else positive(cutoff, "cutoff")
        self._pieces: WeakKeyDictionary[CellSystem, Pieces] = WeakKeyDictionary()

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_pieces"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _pieces=WeakKeyDictionary())  # found anew by a copy

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.pressure!r}, every={self.every}, kind={self.strains.kind!r})"

    @property
    def operation(self) -> Press:
        return Press(self.every, f"{self.what} ({self.strains.kind})")

    def pieces(self, system: CellSystem, positions: FloatArray, time: float = 0.0) -> Pieces:
        """What moves as one.

        Raises
        ------
        UnsupportedError, InputError
            As `find_pieces`.
        """
        known = self._pieces.get(system)
        if known is None:
            require_periodic(system, self.strains.axes, self.strains.kind)
            self._check_width(system, system.cell)
            known = find_pieces(system, positions, self.strains.axes, self.molecules, self.held, time)
            if self.strains.flexible and not known.open.all():
                raise UnsupportedError("a cell that changes its angles turns what is held in space; use another kind")
            self._pieces[system] = known
        return known

    @cached_property
    def _owner(self) -> float:
        return float(zlib.crc32(f"{type(self).__name__} {self.strains.kind}".encode()))

    def variables_of(self, state: State) -> FloatArray | None:
        """Those that a state carries; None where no barostat has begun.

        Raises
        ------
        InputError
            They are those of a barostat of another class or kind.
        """
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
        """Mean probability of acceptance of each mode so far; NaN before the first trial.

        Raises
        ------
        InputError
            As `variables_of`.
        """
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
        before = self._place(system, state.cell, state.positions, state)
        if not math.isfinite(before.energy):
            raise NonFiniteError(
                f"the potential energy is {before.energy} at step {state.step}, by which no trial cell can be judged: "
                "atoms overlap, or the force field returns what is no energy"
            )
        numbers = noise_generator((self.seed, 1), state.step)
        trial, drawn = self._trial(system, pieces, before, state, thermal_energy, dt, numbers), numbers.random()
        variables = state.barostat.copy()
        tried, taken, adapted = self._modes(variables)
        kept = np.abs(trial.e) <= self.strains.most
        frame = self.strains.frame(before.cell)
        matrix = self.strains.matrix(trial.e, frame)
        chance, positions, remainder, after = 0.0, state.positions, state.remainder, before
        if kept.all():
            d = pieces.moved(state.positions, matrix - np.eye(3), lattice_of(system))
            positions, remainder = _added(state.positions, d, state.remainder)
            check_finite(positions, "position", state.step)
            try:
                self._enter(system, before.cell @ matrix, positions)
                there = replace(state, positions=positions, forces=None, barostat=None)
                after = self._place(system, system.cell, positions, there)
                log = self._log_chance(pieces, before, after, trial, thermal_energy)
                log += self._reverse(system, pieces, after, trial, state, thermal_energy, dt) - trial.forward
                chance = math.exp(min(0.0, log))
            except BaseException:
                system.set_cell(before.cell, state.positions)
                raise
        accepted = drawn < chance
        self._adapt(trial.mode, chance, tried, taken, adapted)
        if not accepted:
            if after is not before:
                system.set_cell(before.cell, state.positions)
            return replace(state, barostat=variables)
        variables[:WORK] = after.cell.ravel()
        variables[WORK] += after.energy - before.energy
        moved = replace(state, positions=positions, remainder=remainder, barostat=variables)
        return replace(moved, forces=after.forces, origin=(ref(system), positions, state.velocities, state.time))

    def _enter(self, system: CellSystem, cell: FloatArray, positions: FloatArray) -> None:
        self._check_width(system, cell)
        system.set_cell(cell, positions)

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

    def _place(self, system: CellSystem, cell: FloatArray, positions: FloatArray, state: State) -> Place:
        stress = forces = None
        if self.needs_stress:
            stress = system.stress(positions, state.time)  # first: most calculators find all else on the way
            forces = system.with_forces(state).forces
        return Place(cell, positions, system.energy(positions, state.time, state.step), forces, stress)

    def _log_chance(self, pieces: Pieces, before: Place, after: Place, trial: Trial, thermal_energy: float) -> float:
        """ln of the ratio of the distribution at the two places."""
        rise = after.energy - before.energy + self.pressure * (after.volume - before.volume)
        if self.tension:
            rise -= self.tension * (after.area - before.area)
        return -rise / thermal_energy + self.strains.log_measure(trial.e, pieces.moving)

    def _modes(self, variables: FloatArray | None) -> FloatArray:
        assert variables is not None
        return variables[MODES:].reshape(3, -1)

    # -- what the kinds of barostat differ in ---------------------------------------------------

    def _trial(
        self,
        system: CellSystem,
        pieces: Pieces,
        before: Place,
        state: State,
        thermal_energy: float,
        dt: float,
        rng: np.random.Generator,
    ) -> Trial:
        raise NotImplementedError

    def _reverse(
        self,
        system: CellSystem,
        pieces: Pieces,
        after: Place,
        trial: Trial,
        state: State,
        thermal_energy: float,
        dt: float,
    ) -> float:
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


def require_barostat(given: object) -> Barostat:
    """What is given, if it is a barostat.

    Raises
    ------
    InputError
        It is not.
    """
    if isinstance(given, Barostat):
        return given
    raise InputError(f"barostat is {given!r}; give MonteCarloBarostat(pressure) or CellRescaling(...)", item="barostat")
