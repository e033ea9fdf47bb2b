"""Degrees of freedom a thermostat acts on: rank, conserved momenta, what rows tie together; thermal velocities."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import Rng, as_array, checked, generator_of, positive
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.periodic.one_piece import BoolArray, follow_parents
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import extent, row_norms
from kcons.errors import InputError, NonFiniteError, OverdeterminedError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.steppers import State, System

#: How far each atom is moved to see whether a row changes elsewhere, relative to the size of the system.
NEARBY = 1e-3
#: Change of a row, relative to its gradient, that is taken for rounding.
UNCHANGED = 1e-9


@dataclass(eq=False)
class Bodies:
    """What moves as one."""

    label: IntArray  # the body of each atom; -1 for atoms of none
    weight: FloatArray  # share of each atom in the mass of its body
    mass: FloatArray  # of each body
    tree: tuple[IntArray, IntArray]  # atoms and the parents next to which they are, for bodies cut by faces of the cell

    def __len__(self) -> int:
        return len(self.mass)

    def whole(self, x: FloatArray, lattice: FloatArray | None) -> FloatArray:
        """Positions with each body in one piece."""
        y = x.copy()
        if lattice is not None:
            follow_parents(y, *self.tree, lattice)
        return y

    def sums(self, values: FloatArray) -> FloatArray:
        """Of an array over atoms, shape (n_atoms,) or (n_atoms, k), for each body."""
        if values.ndim == 1:
            return np.asarray(np.bincount(self.label + 1, values, len(self) + 1)[1:], dtype=np.float64)
        return np.stack([self.sums(column) for column in values.T], axis=1)

    def centers(self, y: FloatArray) -> FloatArray:
        """Centers of mass of positions in one piece (or their velocities), shape (n_bodies, 3)."""
        return self.sums(self.weight[:, None] * y)

    def spread(self, values: FloatArray) -> FloatArray:
        """Values of the bodies given to their atoms, 0 for those of none, shape (n_atoms, k)."""
        return np.where((self.label >= 0)[:, None], values[self.label], 0.0)


def bodies(motion: Motion, moving: BoolArray) -> IntArray:
    """What rows tie together, a number for each atom, shape (n_atoms,); -1 for atoms that do not move."""
    from scipy.sparse import diags
    from scipy.sparse.csgraph import connected_components  # slow to import

    joins = motion.constraint_set.incidence.astype(np.float64) @ diags(moving.astype(np.float64))
    found = connected_components(joins.T @ joins, directed=False)[1]
    label = np.full(len(moving), -1, dtype=np.int64)
    label[moving] = np.unique(found[moving], return_inverse=True)[1]
    return label


def rows_where(held: ConstraintSet, wanted: list[bool]) -> BoolArray:
    """Marks for all rows of the constraints that are wanted, shape (n_rows,)."""
    return np.repeat(np.array(wanted, dtype=bool), [item.n_rows for item in held.constraints])


def placed_rows(held: ConstraintSet) -> BoolArray:
    """Rows that know a place in space, shape (n_rows,)."""
    return rows_where(held, [not item.translation_invariant for item in held.constraints])


def row_changes(
    motion: Motion,
    positions: FloatArray,
    fields: Callable[[FloatArray], FloatArray],
    time: float = 0.0,
    size: float | None = None,
) -> Iterator[FloatArray]:
    """Changes of all rows by motions, relative to their gradients, here and at two places nearby, shape (n_rows, k).

    At a single place they may cancel by symmetry; both are along the rows. Not finite where a surface is not defined.
    `fields` gets positions and gives velocities of k motions as columns, shape (3 n_atoms, k); `size`: of the system.
    """
    held, rng = motion.constraint_set, np.random.default_rng(0)
    size = size or extent(positions) or 1.0
    for spread in (0.0, NEARBY * size, NEARBY * size):
        shake = spread * rng.standard_normal(positions.shape)
        ways = [motion.project_velocities(positions, way, time=time) for way in (shake, np.zeros_like(shake))]
        x = positions + ways[0] - ways[1]  # off the rows, turns about a center that is held change it
        with np.errstate(all="ignore"):
            rows = held.jacobian(x, time)
            lengths = row_norms(rows)
            yield np.asarray(rows @ fields(x)) / np.where(lengths == 0, 1.0, lengths)[:, None]


def shifts(x: FloatArray) -> FloatArray:
    """All atoms along x, y and z, as `row_changes` asks for them."""
    return np.tile(np.eye(3), (len(x), 1))


Momentum = Literal["auto", "conserved", "free"]

#: What no energy, heat or link of a chain is.
MARK = -(2.0**61 + 2.0**31)

#: Sum of all forces (or torques) over the sum of their sizes that is taken for rounding, single precision included.
BALANCED = 1e-6
#: The same where it holds in some directions only: near a symmetric place, forces that have no axis almost have one.
EXACT = 1e-12
#: Share of the kinetic energy above which total momentum is not zero.
AT_REST = 1e-16
#: Degrees of freedom of which constant kinetic energy does not visit all configurations, whatever the forces.
FEW = 2
#: How far the system is shifted, relative to its size, to see whether forces depend on its place.
SHIFT = 1e-2
#: How far each atom is moved besides, of the way to the nearest: nothing cancels by symmetry, and forces are far above
#: rounding, also those of a calculator in single precision on a perfect crystal.
SHAKE = 0.01
#: Steps after which it is looked whether bodies feel each other; shorter runs have no averages.
LOOK_AT = 20_000
#: How often bodies that do not feel each other are brought to half their distance, to see whether they do so there.
NEARER = 10


@dataclass(frozen=True, eq=False)
class Freedom:
    """What is thermostatted in one system.

    Attributes
    ----------
    count : int
        Independent momenta g: 3 n less the rank of the rows, less one for each direction in which total momentum is
        conserved.
    directions : ndarray, shape (k, 3)
        Orthonormal directions in which total momentum is conserved, k <= 3.
    turns : bool
        Whether neither forces nor rows exert a torque about some axis, about which angular momentum is conserved too.
    """

    count: int
    directions: FloatArray
    turns: bool = False


@checked
def freedom(system: System, state: State, forces: FloatArray, momentum: Momentum = "auto") -> Freedom:
    """Count the degrees of freedom.

    Parameters
    ----------
    system : System
    state : State
    forces : ndarray, shape (n_atoms, 3)
        Applied forces at the state.
    momentum : {'auto', 'conserved', 'free'}
        In which directions total momentum is conserved. 'auto' finds them: directions along which all rows may be
        shifted, and in which the forces add up to nothing, here and after a shift of the whole system (one force
        evaluation more, at most three; at most six where nothing is periodic, and rows leave some turn of the whole
        system). 'conserved': in all directions that the rows allow. 'free': in none.

    Raises
    ------
    UnsupportedError
        'conserved' with rows that hold atoms in space.
    OverdeterminedError
        No degree of freedom is left.
    """
    directions = np.zeros((0, 3))
    turns = False
    if momentum == "conserved":
        directions = open_directions(system.motion, state.positions, state.time)
        if not len(directions):
            raise UnsupportedError(_HELD)
    elif momentum == "auto" and system.n_atoms > 1:
        directions, turns = _conserved(system, state, forces)
    count = system.motion.degrees_of_freedom - len(directions)
    if count <= 0:
        raise OverdeterminedError(
            "no degree of freedom is left for the thermostat: hold fewer rows"
            + (f" (total momentum, conserved, takes {len(directions)})" if len(directions) else ""),
            rows=range(system.motion.constraint_set.n_rows),
        )
    return Freedom(count, directions, turns)


def may_be(count: float, system: System, state: State, momentum: Momentum) -> bool:
    """Whether `freedom` could find this count: states that were loaded may be of other rows, or of other `momentum`."""
    most = system.motion.degrees_of_freedom
    if momentum == "free":
        return count == most
    least = most - len(open_directions(system.motion, state.positions, state.time))
    return count == least if momentum == "conserved" else least <= count <= most


# -- total momentum ---------------------------------------------------------------------------------

_HELD = "total momentum is not conserved: the rows hold atoms in space in every direction"


def open_directions(motion: Motion, positions: FloatArray, time: float = 0.0) -> FloatArray:
    """Directions along which everything may be shifted at once without a change of any row, shape (k, 3).

    All three unless a row knows a place in space. A plane leaves two, a cylinder its axis, fixed atoms none.
    """
    placed = placed_rows(motion.constraint_set)
    if not placed.any():
        return np.eye(3)
    # A shift d changes a row by its gradient summed over the atoms, times d; for all places if for a few at random.
    sums = np.vstack([change[placed] for change in row_changes(motion, positions, shifts, time)])
    if not np.isfinite(sums).all():
        return np.zeros((0, 3))  # a surface that is not defined nearby has a place in space
    _, values, axes = np.linalg.svd(sums, full_matrices=True)
    rank = int((values > UNCHANGED * max(float(values[0]), 1e-300)).sum()) if values[0] > 1e-12 else 0
    return np.ascontiguousarray(axes[rank:])


def _conserved(system: System, state: State, forces: FloatArray) -> tuple[FloatArray, bool]:
    """Directions in which the forces add up to nothing, and whether they exert no torque, wherever the atoms are."""
    directions = open_directions(system.motion, state.positions, state.time)
    if system.force is None:
        return directions, False
    places, turns = _places(system, state, forces), RigidMotions(state.positions, bool(forces.any()))
    turns.keep_rows(system.motion, state.positions, state.time)
    for attempt, (x, f) in enumerate(places):
        turns.see(x, f)
        if not attempt and len(directions):
            continue  # where the atoms are, all may cancel by symmetry but for rounding
        total = directions @ f.sum(axis=0)
        if np.abs(total).max(initial=0.0) <= BALANCED * np.abs(f).sum():
            break
        elif len(directions) == 1:
            directions = np.zeros((0, 3))
            break
        else:
            directions = np.linalg.svd(total[None, :])[2][1:] @ directions
    while turns.open:
        turns.see(*next(places))
    return directions, turns.found


def _places(system: System, state: State, forces: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """The state, then places nearby, with their forces; fixed atoms stay."""
    rng = np.random.default_rng(0)
    size = extent(state.positions) or 1.0
    moving = system.inverse_masses > 0
    yield state.positions, forces
    while True:
        x = state.positions + moving * (SHIFT * size * rng.standard_normal(3) + shaking(state.positions, rng))
        yield x, system.forces(x, state.velocities, state.time, state.step)


def shaking(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Random displacements, small beside the distances between atoms, shape (n_atoms, 3)."""
    from scipy.spatial import cKDTree

    near = cKDTree(x).query(x, k=2)[0][:, 1]  # infinite for one atom alone; 0 where two are at one place
    known = np.where(np.isfinite(near) & (near > 0), near, SHIFT * (extent(x) or 1.0))
    return SHAKE * known[:, None] * rng.standard_normal(x.shape)


class RigidMotions:
    """Motions of everything at once, shifts and turns about the middle, that change no row and meet no force.

    Each place takes one of six away, unless forces do no work in any that is left. With `turn` False there are none: in
    a cell, whose turn changes what is meant.
    """

    def __init__(self, positions: FloatArray, turn: bool = True) -> None:
        self._middle = positions.mean(axis=0)
        self._size = extent(positions) or 1.0
        self._seen, self._idle = 0, False
        self._motions = np.eye(6) if turn else np.zeros((0, 6))

    def fields(self, x: FloatArray) -> FloatArray:
        """How atoms move in each of three shifts and three turns, shape (3 n, 6)."""
        arms = (x - self._middle) / self._size
        turns = np.stack([np.cross(axis, arms).ravel() for axis in np.eye(3)], axis=1)
        return np.hstack([np.tile(np.eye(3), (len(x), 1)), turns])

    def keep_rows(self, motion: Motion, x: FloatArray, time: float = 0.0) -> None:
        """Leave out motions that change rows, where their atoms are and nearby; all in a cell, and if rows move."""
        if motion.lattice is not None or motion.plan.driven:
            self._motions = np.zeros((0, 6))
        for change in row_changes(motion, x, self.fields, time):
            if self.found:
                self.keep(change if np.isfinite(change).all() else np.eye(6))  # a surface that is not defined nearby

    def keep(self, change: FloatArray) -> None:
        """Leave out motions in which anything changes, by a change in each of the six, shape (k, 6)."""
        _, values, axes = np.linalg.svd(np.linalg.qr(change @ self._motions.T, mode="r"), full_matrices=True)
        self._motions = axes[int((values > UNCHANGED).sum()) :] @ self._motions

    def see(self, x: FloatArray, forces: FloatArray) -> None:
        """Leave out a motion in which the forces of this place do work."""
        work = self._motions @ (self.fields(x).T @ forces.ravel())
        self._seen += 1
        share = BALANCED if len(self._motions) == 6 else EXACT
        self._idle = bool(np.abs(work).max(initial=0.0) <= share * np.abs(forces).sum())
        if not self._idle:
            self._motions = np.linalg.svd(work[None, :])[2][1:] @ self._motions

    @property
    def found(self) -> bool:
        """Whether there is a turn among those that are left."""
        return bool(np.abs(self._motions[:, 3:]).max(initial=0.0) > BALANCED)

    @property
    def open(self) -> bool:
        """Whether another place has to tell: at one, forces may cancel by symmetry."""
        return self.found and not (self._idle and self._seen > 1)


def warn_of_conserved_momenta(
    masses: FloatArray, velocities: FloatArray, directions: FloatArray, turns: bool, stacklevel: int, few: bool = False
) -> None:
    """Say so where conserved momenta, see `Freedom`, or `few` of them, keep a thermostat from sampling."""
    share = momentum_share(masses, velocities, directions)
    reasons = {
        "total momentum is not zero, and a thermostat that scales velocities scales it too instead of forgetting it: "
        "no temperature is sampled. Take it out of the velocities first, or use Langevin": share > AT_REST,
        "the forces exert no torque about an axis that the rows leave (a free cluster, particles on a sphere): angular "
        "momentum is only scaled, never forgotten, and configurations are not canonical. Use Langevin": turns,
        "isokinetic dynamics of two degrees of freedom does not visit all configurations. Use Langevin": few,
    }
    if told := [words for words, holds in reasons.items() if holds]:
        warnings.warn(told[0], stacklevel=stacklevel)


def momentum_share(masses: FloatArray, velocities: FloatArray, directions: FloatArray) -> float:
    """|P|^2/(M 2K) along `directions`: the share of total momentum in the kinetic energy."""
    twice = float(masses @ np.einsum("ij,ij->i", velocities, velocities))
    if not len(directions) or not twice > 0:
        return 0.0
    momentum = directions @ (masses @ velocities)
    return float(momentum @ momentum / (masses.sum() * twice))


def thermal_velocities(
    system: System,
    positions: ArrayLike,
    thermal_energy: float,
    rng: Rng,
    *,
    time: float = 0.0,
    zero_momentum: bool = False,
) -> FloatArray:
    """Velocities of the canonical distribution on the surface A v = c, shape (n_atoms, 3).

    Maxwell-Boltzmann velocities, projected by M_par^+ M: their covariance is k_B T M_par^+, that of momenta which
    know of the constraints. Where targets move, the slowest velocities that follow them are added.

    Parameters
    ----------
    system : System
    positions : array_like, shape (n_atoms, 3)
        On the constraints.
    thermal_energy : float
        k_B T.
    rng : int, numpy.random.Generator or None
    time : float
        For targets that move.
    zero_momentum : bool
        Take total momentum out, in the directions in which no row knows a place in space.

    Raises
    ------
    UnsupportedError
        `zero_momentum` with rows that hold atoms in space in every direction.
    """
    positive(thermal_energy, "thermal_energy")
    generator = generator_of(rng)
    motion = system.motion
    x = as_array(positions, (system.n_atoms, 3), "positions")
    drive = motion.project_velocities(x, np.zeros_like(x), time=time)
    noise = generator.standard_normal(x.shape) * np.sqrt(thermal_energy * system.inverse_masses)
    if zero_momentum:
        directions = open_directions(motion, x, time)
        if not len(directions):
            raise UnsupportedError(_HELD)
        noise -= directions.T @ (directions @ (system.masses @ noise / system.masses.sum()))
    return motion.project_velocities(x, drive + noise, time=time)


# -- bodies apart -----------------------------------------------------------------------------------


def warn_of_bodies_apart(system: System, state: State, stacklevel: int) -> None:
    """Say so where a deterministic thermostat is all that couples the parts of a system, at a state with its forces.

    Thermostats ask once, after `LOOK_AT` steps: one evaluation of the forces, and up to 20 more where bodies seem not
    to feel each other.
    """
    if _apart(system, state):
        warnings.warn(
            "no atom or body, which rows tie together, feels another: a thermostat that scales all velocities alike "
            "exchanges no energy between them, and averages may be far from canonical. Use Langevin",
            stacklevel=stacklevel,
        )


def _apart(system: System, state: State) -> bool:
    """Whether there are several bodies and none feels another, here and wherever they come nearer.

    Every second one is moved a little, and the forces on the others are looked at. Where nothing changes, bodies may be
    out of reach: pairs are brought to half their distance again and again.
    """
    x, forces = state.positions, state.forces
    label = bodies(system.motion, system.inverse_masses[:, 0] > 0)
    assert forces is not None
    count = int(label.max(initial=-1)) + 1
    if count < 2:
        return False
    body, half = np.arange(count), count // 2
    sums = np.stack([np.bincount(label + 1, column, count + 1)[1:] for column in x.T], axis=1)
    centers = np.asarray(sums / np.bincount(label + 1, minlength=count + 1)[1:, None], dtype=np.float64)
    least = BALANCED * float(np.abs(forces).max())

    def felt(move: FloatArray, moved: NDArray[np.bool_]) -> bool:
        goes = (label >= 0) & moved[label]
        try:
            f = system.forces(x + np.where(goes[:, None], move[label], 0.0), state.velocities, state.time, state.step)
        except NonFiniteError:  # they do where they meet
            return True
        return not np.abs(f - forces)[~goes].max(initial=0.0) <= least

    small = NEARBY * (extent(x) or 1.0) * np.random.default_rng(0).standard_normal((count, 3))
    if felt(small, body % 2 == 1):
        return False
    for moved, towards in ((body % 2 == 1, body - 1), (body >= count - half, body - (count - half))):
        way: FloatArray = centers[towards] - centers
        if any(felt(np.asarray((1.0 - 0.5**k) * way), moved) for k in range(1, NEARER + 1)):
            return False
    return True


def refuse_dissipation(system: System, why: str) -> None:
    """Raise `UnsupportedError` for velocity-dependent forces; `why` says what a thermostat lacks for these."""
    if system.velocity_dependent:
        raise UnsupportedError(f"forces that depend on the velocities have no {why}")


def refuse_driven(system: System, why: str) -> None:
    """Raise `UnsupportedError` for targets that move and rows that hold velocities; `why` says what they cannot do."""
    if system.motion.plan.driven:
        raise UnsupportedError(f"targets move with time, or rows hold velocities, {why}")


def carried(state: State, size: int, name: str, *, marked: bool = False) -> bool:
    """Whether the state carries the `size` variables of the thermostat of this name; `InputError` for those of another.

    They are `marked` if they begin with `MARK`, since there may be as many of another thermostat.
    """
    if state.thermostat is None:
        return False
    shape = getattr(state.thermostat, "shape", None)  # np.shape takes a microsecond
    if shape != (size,) or (state.thermostat.item(0) == MARK) != marked:
        raise InputError(
            f"the state carries variables of another thermostat, not of {name}; start with "
            "dataclasses.replace(state, thermostat=None)",
            item="thermostat",
        )
    return True
