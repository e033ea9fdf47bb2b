"""The temperature that configurations have, whatever the velocities do.

On a surface with the density e^{-U/kT} of its volume, any field X that preserves volume gives kT = <(X U)^2>/<X X U>;
summed over all directions, kT = <|grad U|^2>/<laplacian of U> (Rugh, Phys. Rev. Lett. 78, 772 (1997); Butler et al.,
J. Chem. Phys. 109, 6519 (1998)). Constrained canonical configurations have the volume that belongs to the metric M, so
that |grad U|^2 = f.M_par^+ f, and the laplacian is the mean second derivative of U along geodesics, which are the free
flights of the constrained atoms.

By kind of motion: clusters that shift, that turn, and what is left.
A cluster is what constraints tie together; a free atom is one of its own. For any field X along the surface

    kT <div X> = <X . grad U>.

Shifts S_a of a cluster along fixed axes and its turns R_a about fixed axes through its center of mass are isometries of
M and keep all rows, if no row knows a place or a direction in space. So they have no divergence, and the fields
S_a(U) S_a / m and J_ab R_a(U) R_b, where J is the inverse of the tensor of inertia, give

    kT = <|F|^2/m> / <sum S_a S_a U / m>,    kT = <t . J t> / <sum J_ab R_a R_b U>

with the force F and the torque t on the cluster (derivatives of J cancel: it turns with the cluster). Both are shares
of <|grad U|^2>/<laplacian of U>, and what remains above and below the line is the temperature of everything else.

Second derivatives are differences of forces along random moves of all clusters at once, of which cross terms have the
mean zero (Hutchinson): the cost does not depend on the number of clusters.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import Rng, as_array, as_float_array, generator_of, positive, refuse_other
from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import spanning_tree
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import cross, extent
from kcons.errors import InputError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.steppers import System
from kcons.steppers.compiled_operations import check_finite
from kcons.thermostats.correlated_series import MIN_SAMPLES, Estimate, few, spread
from kcons.thermostats.force_groups import ForceGroups
from kcons.thermostats.freedom import UNCHANGED, Bodies, bodies, refuse_driven, row_changes, thermal_velocities
from kcons.thermostats.isokinetic import constrained_acceleration

#: Standard errors by which the mean curvature must differ from 0 for a ratio to have an error.
_CERTAIN = 3.0


def temperature(squares: FloatArray, curvatures: FloatArray) -> tuple[Estimate, str | None]:
    """The ratio of both means, and what is to be said of its error.

    To first order the ratio r fluctuates by (squares - r curvatures)/<curvatures>. Where <curvatures> is 0 within its
    own error, the ratio has neither a variance nor a bounded interval: its error is infinite.
    """
    n, scale = len(squares), float(curvatures.mean())
    found = float(squares.mean()) / scale if scale else math.inf
    if abs(scale) <= _CERTAIN * spread(curvatures).error:
        said = (
            f"the mean curvature of {n} samples is 0 within {_CERTAIN:g} standard errors: their temperature may be "
            "anything, and its error is given as infinite. Sample longer"
        )
        return Estimate(found, math.inf), said
    error, independent = spread((squares - found * curvatures) / scale)
    return Estimate(found, error), few(n, independent)


#: Typical moves for differences, as a share of the distance to the next atom; the second for `slow_share`.
MOVE, REACH = 1e-3, 0.03
#: Moment of inertia about an axis, relative to the largest, below which there is no turn.
THIN = 1e-9
#: Share of its thermal energy below which a cluster has no motion of its own.
RIGID = 1e-9
#: Sum of the forces in a cluster, relative to the sum of their sizes, that is their rounding; the same of torques.
BALANCED = 1e-7
#: Violation of a row, relative to its scale, that no temperature shows; OpenMM's own integrators leave 1e-5.
OFF = 1e-4


@dataclass(frozen=True)
class SplitTemperatures:
    """Temperatures of configurations, k_B T in the units of the System; None for motions that do not exist.

    Attributes
    ----------
    shift, turn : Estimate or None
        Of whole clusters that move, and that turn about their centers of mass.
    internal : Estimate or None
        Of all other motions that the constraints allow: within clusters, and of clusters tied to space.
    shifts, turns : int
        Degrees of freedom of the first two.
    shift_frequency, turn_frequency : float
        Root mean square angular frequency of shifts and of turns, as of oscillators, in inverse units of time.
        Velocities at the positions, as velocity Verlet has them, are colder than configurations by about
        (frequency dt/2)^2.
    samples : int
    left_out : tuple of str
        What does not count, and why.
    """

    shift: Estimate | None
    turn: Estimate | None
    internal: Estimate | None
    shifts: int
    turns: int
    shift_frequency: float
    turn_frequency: float
    samples: int
    left_out: tuple[str, ...]


class Clusters(Bodies):
    """What constraints tie together, free atoms by themselves, and which of it may shift and turn as a whole."""

    def __init__(self, motion: Motion, positions: FloatArray, moving: NDArray[np.bool_]) -> None:
        held = motion.constraint_set
        label, masses = bodies(motion, moving), np.where(moving, held.masses, 0.0)
        mass = np.asarray(np.bincount(label + 1, masses)[1:], dtype=np.float64)
        rows, touched = held.incidence.nonzero()
        rows, touched = rows[moving[touched]], touched[moving[touched]]
        pairs = np.stack([touched[np.searchsorted(rows, rows)], touched], axis=1).astype(np.int64)
        super().__init__(label, np.where(moving, masses / mass[label], 0.0), mass, spanning_tree(pairs, len(moving)))
        self._held, self._masses = held, masses
        #: Whether a cluster has several atoms, shape (n_bodies,); may shift in every direction, and turn about every
        #: axis, without a change of any row.
        self.several = np.bincount(label + 1)[1:] > 1
        self.shifts, self.turns = self._open(motion, positions)

    def arms(self, x: FloatArray) -> FloatArray:
        """Places relative to the centers of mass, shape (n_atoms, 3), in pieces put together across the box."""
        y = self.whole(x, self._held.lattice)
        return np.where((self.label >= 0)[:, None], y - self.spread(self.centers(y)), 0.0)

    def unit_turns(self, arms: FloatArray) -> FloatArray:
        """Turns g of unit energy as columns, shape (n_bodies, 3, 3): g g^T is the (pseudo-)inverse tensor of inertia.

        0 about axes without inertia, and for clusters that do not turn.
        """
        products = self.sums((self._masses[:, None, None] * arms[:, :, None] * arms[:, None]).reshape(-1, 9))
        products = products.reshape(-1, 3, 3)
        tensor = np.trace(products, axis1=1, axis2=2)[:, None, None] * np.eye(3) - products
        moments, axes = np.linalg.eigh(tensor)
        has = (moments > THIN * moments[:, -1:]) & self.turns[:, None]
        return np.asarray(axes * np.where(has, 1.0 / np.sqrt(np.where(has, moments, 1.0)), 0.0)[:, None, :])

    def _open(self, motion: Motion, positions: FloatArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """By the change of each row, here and at two places nearby, where nothing cancels by symmetry."""
        held, shifts, turns = self._held, np.ones(len(self), dtype=bool), self.several.copy()
        if not held.n_rows:
            return shifts, turns
        rows, touched = held.incidence.nonzero()
        whole = self.whole(positions, held.lattice)
        size = min(extent(whole) or 1.0, float(held.scale.min()))
        inside = (self.label >= 0)[:, None]

        def fields(x: FloatArray) -> FloatArray:
            p = self.arms(x)
            reach = math.sqrt(float((p * p).sum(axis=1).max(initial=0.0))) or 1.0
            moves = [np.where(inside, axis, 0.0) for axis in np.eye(3)]
            return np.stack([m.ravel() for m in (*moves, *(cross(axis, p) / reach for axis in np.eye(3)))], axis=1)

        for change in row_changes(motion, whole, fields, 0.0, size):
            kept: NDArray[np.bool_] = np.asarray(np.abs(change) <= UNCHANGED)  # not NaN: a surface that ends there
            for may, some in ((shifts, kept[:, :3]), (turns, kept[:, 3:])):
                hit = self.label[touched[~np.asarray(some.all(axis=1))[rows]]]
                may[hit[hit >= 0]] = False
        return shifts, turns


class TemperatureSplit:
    """Samples configurations of any run, and tells the temperatures of shifts, turns and all other motions.

    Whatever the velocities do: a thermostat that fixes the kinetic energy, or a step that is too long, shows here.

    Parameters
    ----------
    system : System
        Constraints, and forces of any provider; in any consistent units.
    rng : int, numpy.random.Generator or None
        Of the random moves.
    displacement : float, optional
        Typical move of an atom for a difference; a thousandth of the distance to the next atom by default. Forces in
        single precision want three to ten times as much.

    Raises
    ------
    UnsupportedError
        Targets move, rows hold velocities, or forces depend on velocities.

    Notes
    -----
    A sample costs 2 evaluations of the forces for shifts, 2 for turns and 2 for what is left, where there is such a
    motion, and one at the configuration itself if its forces are not given. The same configuration may be added again.
    """

    def __init__(
        self,
        system: System,
        *,
        rng: Rng = 0,
        displacement: float | None = None,
    ) -> None:
        refuse_other(system, System, "system", "a kcons.steppers.System")
        refuse_driven(system, "and configurations have no temperature")
        if system.velocity_dependent:
            raise UnsupportedError("configurations have a temperature where forces know no velocities")
        if displacement is not None:
            positive(displacement, "displacement")
        self._system, self._displacement = system, displacement
        self._rng = generator_of(rng)
        self._flight = 0.0  # until the first configuration
        self._series: list[FloatArray] = []

    def __len__(self) -> int:
        return len(self._series)

    def add(self, positions: ArrayLike, forces: ArrayLike | None = None) -> None:
        """Take one configuration, on the constraints, and its forces if they are known; shape (n_atoms, 3) each.

        Raises
        ------
        InputError
            Positions off the constraints.
        """
        system = self._system
        x = configuration(system, positions)
        f = self._forces(x) if forces is None else as_array(forces, x.shape, "forces")
        check_finite(f, "force", len(self._series))
        if not self._flight:
            self._begin(x)
        arms = self._clusters.arms(x)
        turns = self._clusters.unit_turns(arms)
        above = self._squares(x, f, arms, turns)
        below = self._curvatures(x, arms, turns)
        for kinds in (above, below):  # what is left: all less shifts and turns
            kinds[2] = np.where(self._rest, kinds[2] - kinds[0] - kinds[1], 0.0)
        self._series.append(np.stack([above, below]).sum(axis=2))

    def result(self) -> SplitTemperatures:
        """Temperatures so far.

        Raises
        ------
        InputError
            Fewer than 32 samples.

        Warns
        -----
        UserWarning
            Fewer than 15 independent samples; a temperature that has no error, which is given as infinite.
        """
        if len(self._series) < MIN_SAMPLES:
            said = f"{len(self._series)} samples are too few for an error; add {MIN_SAMPLES} or more"
            raise InputError(said, item="samples")
        series, notes = np.array(self._series), self._left_out()
        found: list[Estimate | None] = [None, None, None]
        exists = self._clusters.shifts, self._axes, self._rest
        for kind, (name, there) in enumerate(zip(("shifts", "turns", "internal motions"), exists, strict=True)):
            if there.any() and series[:, 0, kind].any():
                found[kind], doubt = temperature(series[:, 0, kind], series[:, 1, kind])
                if doubt:
                    warnings.warn(f"temperature of {name}: {doubt}", UserWarning, stacklevel=2)
            elif there.any() and kind < 2:
                notes.append(f"no force {name} clusters as a whole: that has no temperature")
        counts = 3 * int(exists[0].sum()), int(exists[1].sum())
        squares = [max(float(series[:, 1, kind].mean()), 0.0) / max(counts[kind], 1) for kind in (0, 1)]
        frequencies = math.sqrt(squares[0]), math.sqrt(squares[1])
        shift, turn, internal = found
        return SplitTemperatures(shift, turn, internal, *counts, *frequencies, len(series), tuple(notes))

    # -- inner ----------------------------------------------------------------------------------

    def _begin(self, x: FloatArray) -> None:
        system = self._system
        moving = system.inverse_masses[:, 0] > 0
        flight = flight_of(system, x, self._displacement, MOVE)
        self._clusters = clusters = Clusters(system.motion, x, moving)
        arms = clusters.arms(x)
        turns = clusters.unit_turns(arms)
        #: Axes about which each cluster turns, and clusters with motions besides shifts and turns.
        self._axes: IntArray = turns.any(axis=1).sum(axis=1)
        rest = system.masses[:, None] * self._rest_of(x, arms, turns) ** 2
        self._rest: NDArray[np.bool_] = clusters.sums(rest.sum(axis=1)) > RIGID
        self._flight = flight

    def _forces(self, x: FloatArray) -> FloatArray:
        return self._system.forces(x, np.zeros_like(x), 0.0, len(self._series))

    def _rest_of(self, x: FloatArray, arms: FloatArray, turns: FloatArray) -> FloatArray:
        """Thermal velocities of unit energy, less shifts and turns."""
        clusters, masses = self._clusters, self._system.masses[:, None]
        v = thermal_velocities(self._system, x, 1.0, self._rng)
        pace = clusters.centers(v) * clusters.shifts[:, None]
        spins = np.einsum("cik,cjk,cj->ci", turns, turns, clusters.sums(masses * cross(arms, v)))
        return np.asarray(v - clusters.spread(pace) - cross(clusters.spread(spins), arms))

    def _squares(self, x: FloatArray, f: FloatArray, arms: FloatArray, turns: FloatArray) -> FloatArray:
        """Squares of the slopes by shifts, by turns, and of all, of each cluster; shape (3, clusters)."""
        clusters = self._clusters
        sizes = np.sqrt((f * f).sum(axis=1))
        force = _unbalanced(clusters.sums(f), clusters.sums(sizes))
        reach = np.sqrt((arms * arms).sum(axis=1))
        torque = _unbalanced(clusters.sums(cross(arms, f)), clusters.sums(reach * sizes))
        shift = np.where(clusters.shifts, (force * force).sum(axis=1) / clusters.mass, 0.0)
        turn = (np.einsum("cik,ci->ck", turns, torque) ** 2).sum(axis=1)
        whole = np.zeros_like(shift)
        if self._rest.any():
            whole = clusters.sums((f * constrained_acceleration(self._system, x, f, 0.0)).sum(axis=1))
        return np.stack([shift, turn, whole])

    def _curvatures(self, x: FloatArray, arms: FloatArray, turns: FloatArray) -> FloatArray:
        """Samples of the second derivatives of U in the same order, along moves of unit energy.

        Shifts and turns have random signs along their axes, which is less noise than normal numbers make. One draw
        serves all three, so that it cancels in what is left.
        """
        clusters, h = self._clusters, self._flight
        signs = self._rng.choice((-1.0, 1.0), size=(2, len(clusters), 3))
        pushed = clusters.spread(signs[0] * (clusters.shifts / np.sqrt(clusters.mass))[:, None])
        spin = clusters.spread(np.einsum("cik,ck->ci", turns, signs[1]))
        v = self._rest_of(x, arms, turns) + pushed + cross(spin, arms) if self._rest.any() else pushed
        found = np.zeros((3, len(clusters)))
        for way in (h, -h):
            if clusters.shifts.any():
                found[0] -= self._slopes(x + way * pushed, pushed) / (2 * way)
            if self._axes.any():
                turned = _turned(arms, spin, way)
                found[1] -= self._slopes(x + (turned - arms), cross(spin, turned)) / (2 * way)
            if self._rest.any():
                there, speed = self._system.flown(x, v, way)
                end = self._system.motion.project_velocities(there, speed)
                found[2] -= self._slopes(there, end) / (2 * way)
        return found

    def _slopes(self, x: FloatArray, v: FloatArray) -> FloatArray:
        """What the forces of each cluster do at x along v."""
        return self._clusters.sums((self._forces(x) * v).sum(axis=1))

    def _left_out(self) -> list[str]:
        clusters = self._clusters
        notes = []
        tied = int((~clusters.shifts).sum())
        if tied:
            notes.append(f"{tied} clusters are tied to a place in space and do not shift: they count as internal")
        bound = int((clusters.shifts & clusters.several & ~clusters.turns).sum())
        if bound:
            notes.append(f"{bound} clusters are tied to a direction in space and do not turn: they count as internal")
        if not clusters.several.any():
            notes.append("single atoms only: nothing turns")
        fixed = int((clusters.label < 0).sum())
        if fixed:
            notes.append(f"{fixed} fixed atoms have no temperature")
        return notes


def configuration(system: System, positions: ArrayLike) -> FloatArray:
    """Positions, shape (n_atoms, 3), that are finite and on the constraints; `InputError` otherwise."""
    x = as_array(positions, (system.n_atoms, 3), "positions")
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if len(bad):
        raise InputError(f"positions of atom {bad[0]} are not finite; leave this frame out", atoms=[int(bad[0])])
    held = system.motion.constraint_set
    miss = np.abs(held.value(x, 0.0)) / held.scale
    if not np.all(miss <= OFF):
        row = int(np.argmax(np.where(np.isnan(miss), np.inf, miss)))
        raise InputError(
            f"positions are off row {held.row_name(row)} by {miss[row]:.3g} of its size; bring them onto the "
            "constraints with Motion.restore_positions",
            item="positions",
            atoms=held.row_atoms(row),
        )
    return x


def _unbalanced(sums: FloatArray, sizes: FloatArray) -> FloatArray:
    """Sums of vectors by cluster; 0 where they are the rounding of what was added."""
    return np.where((np.abs(sums).max(axis=1) > BALANCED * sizes)[:, None], sums, 0.0)


def _turned(arms: FloatArray, spin: FloatArray, h: float) -> FloatArray:
    """Arms after a turn by h spin (Rodrigues)."""
    angle = h * np.sqrt((spin * spin).sum(axis=1))[:, None]
    sine = h * np.sinc(angle / np.pi)
    versed = 0.5 * (h * np.sinc(0.5 * angle / np.pi)) ** 2
    across = cross(spin, arms)
    return np.asarray(arms + sine * across + versed * cross(spin, across))


def flight_of(system: System, x: FloatArray, displacement: float | None, share: float) -> float:
    """How long atoms that move fly at unit thermal energy until they have typically moved so far.

    By default that is a share of the distance to the next atom, which a single atom has not.
    """
    moving = system.inverse_masses > 0
    if not moving.any():
        raise InputError("all atoms are fixed: nothing has a temperature, or a stiffness", item="atoms")
    move = share * spacing(x) if displacement is None else positive(displacement, "displacement")
    return move / math.sqrt(3.0 * float(system.inverse_masses[moving].mean()))


def spacing(x: FloatArray) -> float:
    """Distance from an atom to the next, the median."""
    from scipy.spatial import cKDTree

    near = cKDTree(x).query(x, k=2)[0][:, 1] if len(x) > 1 else np.zeros(1)
    near = near[np.isfinite(near) & (near > 0)]
    if not len(near):
        raise InputError("there is one atom only, and no length to go by; give a displacement", item="displacement")
    return float(np.median(near))


def slow_share(
    system: System, frames: ArrayLike, group: str = "slow", *, rng: Rng = 0, displacement: float | None = None
) -> float:
    """Share of the stiffness that one group of forces carries along the constraints, root mean square.

    With the second derivatives H of an energy along the constraints in the metric of the masses, the square root of
    <tr H_slow^2>/<tr H^2>: fast motions count most, and no signs cancel. Heating of fast motions grows with this share;
    of two splittings the one with the smaller share allows longer steps.

    Parameters
    ----------
    system : System
        Its forces are `ForceGroups`.
    frames : array_like, shape (n_frames, n_atoms, 3)
        Configurations on the constraints: ten of a short run for large systems, more for small ones.
    group : str
        The slow forces.
    rng : int, numpy.random.Generator or None
        Of the random moves, one a frame, which costs two evaluations of every group.
    displacement : float, optional
        Typical move of an atom for differences of forces; 0.03 of the distance to the next atom by default, as in a
        small step, so that jumps of forces at a cutoff count little.

    Raises
    ------
    UnsupportedError
        Targets move, rows hold velocities, or forces come in no groups.
    InputError
        No such group; frames off the constraints; forces that do not change with the positions; all atoms fixed.
    """
    refuse_other(system, System, "system", "a kcons.steppers.System")
    refuse_driven(system, "whose stiffness slow_share does not know; leave them out")
    force = system.force
    if not isinstance(force, ForceGroups):
        raise UnsupportedError("the System has no groups of forces; make it with System(motion, ForceGroups({...}))")
    if group not in force.groups:
        raise InputError(f"there is no group {group!r} of forces; there are {', '.join(force.groups)}", item="group")
    x = as_float_array(frames, "frames")
    if x.ndim != 3 or not len(x):
        raise InputError(f"frames have shape {x.shape}; give (n_frames, n_atoms, 3)", item="frames")
    generator = generator_of(rng)
    slow, whole, flight = 0.0, 0.0, 0.0
    for number, frame in enumerate(x):
        here = configuration(system, frame)
        flight = flight or flight_of(system, here, displacement, REACH)
        v = thermal_velocities(system, here, 1.0, generator)
        changes = np.zeros((2, *here.shape))
        for way in (flight, -flight):
            there, _ = system.flown(here, v, way)
            for name in force.groups:
                f = system.accepted(force.of(name, there, 0.0), number, True)
                check_finite(f, "force", number)
                pace = math.copysign(1.0, way) * constrained_acceleration(system, there, f, 0.0)
                changes += np.array([name == group, True])[:, None, None] * pace
        squares = [system.motion.project_velocities(here, c) ** 2 * system.masses[:, None] for c in changes]
        slow, whole = slow + float(squares[0].sum()), whole + float(squares[1].sum())
    if not whole > 0:
        raise InputError("the forces do not change with the positions: nothing is stiff", item="forces")
    return math.sqrt(slow / whole)
