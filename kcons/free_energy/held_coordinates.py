"""What a held coordinate tells of the free energy: its multiplier, Z, and how Z changes along it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from kcons.constraints.arguments import as_array
from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.constraint_set import ConstraintSet, rows_like
from kcons.constraints.periodic.one_piece import minimum_image
from kcons.constraints.target import FloatArray, nearest_image
from kcons.constraints.vectors import cross, dot, norm
from kcons.errors import InputError, NonFiniteError, SingularGeometryError, UnsupportedError
from kcons.motion.motion import Motion

#: A coordinate of which the other constraints leave less than this share of its Z depends on them.
DEPENDENT = 1e-9
#: Pivots below which rows may depend on each other, and eigenvalues that count as none; of rows of length 1.
_PIVOT, _NONE = 1e-4, 1e-12
#: Share of a coordinate in a combination of rows that vanishes, above which it depends on the others.
_LOST = 1e-12
#: Rows of the clusters, and atoms of a row, up to which the mean over velocities is computed.
_MOST_ROWS, _MOST_ATOMS = 60, 12
#: Configurations that are looked at together, and what is given of each.
AT_ONCE, _ITEMS = 32, ("positions", "velocities", "forces")


class Sample(NamedTuple):
    """Held coordinates at one configuration, each shape (d,) but for the numbers `time`, `log_det_z` and `off`.

    Attributes
    ----------
    time : float
    value : ndarray
        The coordinates, as measured.
    multiplier : ndarray
        lambda of the constraint force A^T lambda: the force along the coordinate that holds it.
    kinetic : ndarray
        The part of `multiplier` that is quadratic in the velocities.
    log_det_z : float
        ln det Z; Z = A_q M_par^+ A_q^T with M_par^+ of all other constraints. det Z is det(A M^-1 A^T) of all rows by
        that of the others.
    gradient : ndarray
        Half the derivative of ln det Z along each coordinate, the others and all constraints held.
    off : float
        The largest |sigma| of the coordinates.
    turned : ndarray
        dU/dq of the rigid turn of a torsion's group; NaN where there is none.
    mean_kinetic : ndarray
        The mean of `kinetic` over canonical velocities, by kT; NaN where the clusters of the coordinates have more than
        60 rows, rows of more than 12 atoms, or targets that move.
    """

    time: float
    value: FloatArray
    multiplier: FloatArray
    kinetic: FloatArray
    log_det_z: float
    gradient: FloatArray
    off: float
    turned: FloatArray
    mean_kinetic: FloatArray


def named(coordinates: Mapping[str, Constraint]) -> dict[str, Constraint]:
    """Coordinates by name, checked."""
    if not isinstance(coordinates, Mapping) or not coordinates or not all(isinstance(k, str) for k in coordinates):
        remedy = 'give a mapping of names to constraints, such as {"torsion": Dihedral([[0, 1, 2, 3]])}'
        raise InputError(f"no coordinates are named; {remedy}", item="coordinates")
    for name, coordinate in coordinates.items():
        if not isinstance(coordinate, Constraint) or coordinate.n_rows != 1:
            raise InputError(f"{name!r} is {coordinate!r}; give a kcons constraint of one row", item=name)
    return dict(coordinates)


class HeldCoordinates:
    """Coordinates that an engine holds, by name.

    Only the clusters that they belong to are looked at, so that a sample costs the same in a large box.

    Parameters
    ----------
    motion : Motion or ConstraintSet
        What is held. For a dynamics class of ASE, ``dynamics.motion``.
    coordinates : mapping of str to Constraint
        Each a row of the set, named by a constraint of the same kind on the same atoms.
    positions : array_like, shape (n_atoms, 3)
        Where it is found out whether the coordinates depend on the other constraints.
    time : float
        Time of `positions`, for targets that move.
    bonds : array_like of int, shape (n, 2), optional
        Of the molecules. Torsions about a bond that is in no ring then have `Sample.turned` as well.

    Attributes
    ----------
    names : tuple of str
    rows : ndarray of int, shape (d,)
        Their rows in the set.
    periods : ndarray, shape (d,)
        2 pi for dihedrals; 0 for coordinates without a period.
    atoms : ndarray of int
        The atoms whose positions, velocities and forces matter.

    Raises
    ------
    InputError
        A coordinate that is not held; a velocity constraint.
    SingularGeometryError
        A coordinate that depends on the other constraints, so that Z = 0.
    UnsupportedError
        Velocity constraints in the clusters of the coordinates.

    References
    ----------
    den Otter and Briels, Mol. Phys. 98, 773 (2000); Ciccotti, Lelievre and Vanden-Eijnden, Commun. Pure Appl. Math.
    61, 371 (2008); Sprik and Ciccotti, J. Chem. Phys. 109, 7737 (1998).
    """

    def __init__(
        self,
        motion: Motion | ConstraintSet,
        coordinates: Mapping[str, Constraint],
        positions: ArrayLike,
        *,
        time: float = 0.0,
        bonds: ArrayLike | None = None,
    ) -> None:
        held = motion if isinstance(motion, ConstraintSet) else motion.sources[0]
        x = as_array(positions, (held.n_atoms, 3), "positions")
        names: dict[int, str] = {}
        for name, coordinate in named(coordinates).items():
            (row,) = rows_like(held, coordinate, name)
            if row in names:
                raise InputError(f"{names[row]} and {name} are the same row {row} of the set", item=names[row])
            names[row] = name
        self.names = tuple(names.values())
        self.rows: IntArray = np.array([*names], dtype=np.int64)
        self._source = held
        label = connected_components(held.incidence @ held.incidence.T, directed=False)[1]
        everything = np.flatnonzero(np.isin(label, label[self.rows]))  # of the clusters of the coordinates
        others = np.setdiff1d(everything, self.rows)
        if not held.holonomic[others].all():
            said = "share atoms with velocity constraints, under which configurations have no known distribution"
            raise UnsupportedError(
                f"{' and '.join(self.names)} {said}; multipliers alone are those of Motion.multipliers"
            )
        # All rows of the clusters; in results those of the coordinates, as they are named, come after the others.
        self._rows, self.atoms = held.subset(everything)
        self._order = np.searchsorted(everything, np.concatenate([others, self.rows]))
        self.periods = np.concatenate([np.full(c.n_rows, c.period or 0.0) for c in self._rows.constraints])
        self.periods = self.periods[self._order][-len(self) :]
        self._inverse_masses = np.repeat(1 / held.masses[self.atoms], 3)
        widest = max(item.width for item in self._rows.constraints)
        self._averages = len(everything) <= _MOST_ROWS and widest <= _MOST_ATOMS and not self._rows.moving
        self._copies: dict[tuple[int, int], Constraint] = {}
        # The lines of each object's rows in results.
        self._lines = np.split(np.argsort(self._order), self._rows.starts[1:-1])
        here = x[self.atoms]
        near = 1e-3 * np.random.default_rng(1).normal(size=here.shape) * np.ptp(here, axis=0).max()
        # Beside a structure so symmetric that a gradient vanishes, too.
        self._at(self._gathered(np.stack([here, here + near])), time)
        #: Of the coordinates, by number, that are torsions whose group can be turned.
        self._turns: dict[int, RigidTurn] = {}
        pairs = np.array([] if bonds is None else bonds, dtype=np.int64).reshape(-1, 2)
        for k, row in enumerate(self.rows.tolist()):
            item, own = held.locate(row)
            turn = rigid_turn(item.select([own]), pairs, x, held.lattice)
            if turn is not None and leaves_the_rest(turn, row, held, others, x, time):
                self._turns[k] = turn

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        beside = len(self._order) - len(self)
        return f"<HeldCoordinates: {', '.join(self.names)}, beside {beside} rows of their clusters>"

    @property
    def seen(self) -> IntArray:
        """All atoms that samples depend on: `atoms`, and those of the groups that torsions turn."""
        groups = [part for turn in self._turns.values() for part in (turn.axis, turn.group, turn.bonds.ravel())]
        return np.unique(np.concatenate([self.atoms, *groups])).astype(np.int64)

    def sample(self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float = 0.0) -> Sample:
        """The coordinates at one configuration.

        Parameters
        ----------
        x, v, f : array_like, shape (n_atoms, 3)
            Positions, velocities and *applied* forces, without those of constraints, thermostat or friction.
        time : float

        Raises
        ------
        InputError
            Wrong shapes.
        NonFiniteError
            NaN or infinity where the coordinates are.
        SingularGeometryError
            A coordinate has come to depend on the other constraints.
        """
        shape = (self._source.n_atoms, 3)
        whole = np.stack([as_array(array, shape, item) for array, item in zip((x, v, f), _ITEMS, strict=True)])
        return self._samples(whole[:, None], [time])[0]

    def samples(self, x: ArrayLike, v: ArrayLike, f: ArrayLike, times: Sequence[float]) -> list[Sample]:
        """As `sample`, of n configurations in one cell, shape (n, n_atoms, 3): each costs a tenth of one alone."""
        whole = np.array([x, v, f], dtype=np.float64)
        at_once = 1 if self._rows.moving else AT_ONCE
        parts = [slice(k, k + at_once) for k in range(0, len(times), at_once)]
        return [each for part in parts for each in self._samples(whole[:, part], times[part])]

    def _samples(self, whole: FloatArray, times: Sequence[float]) -> list[Sample]:
        """Of positions, velocities and forces, shape (3, n, n_atoms, 3)."""
        n, d, rows, order, time = len(times), len(self), self._rows, self._order, times[0]
        here, speed, force = packed = whole[:, :, self.atoms]
        if not np.isfinite(packed).all():
            which, k, first = np.argwhere(~np.isfinite(packed).all(axis=3))[0].tolist()
            item, atom = _ITEMS[which], int(self.atoms[first])
            raise NonFiniteError(f"{item} of atom {atom} are not finite at time {times[k]:g}", item=item, atom=atom)
        gathered = self._gathered(here)
        log_det_z, respond, shares, along, of_rows = self._at(gathered, time)
        pairs = [along[:, s] + sign * along[:, j] for s in range(d) for j in range(s) for sign in (1, -1)]
        fields = np.stack([speed.reshape(n, -1), *along.swapaxes(0, 1), *pairs], axis=1)
        if self._averages:
            fields = np.concatenate([fields, of_rows], axis=1)
        bent, traces = self._curvatures(gathered, fields, time)
        rest, driven = np.zeros((n, len(order))), -bent[:, 0]
        if rows.moving:
            rest, driven = (rows.acceleration_target(here[0], u, time)[None, order] for u in (0 * speed[0], speed[0]))
        pull = along @ force.reshape(n, -1, 1)
        still, moving = ((respond @ b[:, :, None] - pull)[:, :, 0] for b in (rest, driven))
        mean = np.full((n, d), np.nan)
        if self._averages:
            mean = (respond @ (bent[:, 1 + d * d :].sum(axis=1) - traces)[:, :, None])[:, :, 0]
        values = [
            self._copied(k, n).measure(r.reshape(-1, *r.shape[2:]), time).reshape(n, -1) for k, r in enumerate(gathered)
        ]
        value = np.concatenate(values, axis=1)[:, order[-d:]]
        off = np.abs(nearest_image(value - rows.target(time)[order[-d:]], self.periods)).max(axis=1)
        turned = np.full((n, d), np.nan)
        for k, turn in self._turns.items():
            turned[:, k] = turn.force(whole[0], whole[2])
        # Half the derivative of ln det Z along each direction s: sum_j d_j^T q_j'' d_s, polarized.
        bends = bent[:, 1 : 1 + d * d] @ shares.swapaxes(1, 2)
        gradient, crossed = np.diagonal(bends[:, :d], axis1=1, axis2=2).copy(), iter(np.moveaxis(bends[:, d:], 1, 0))
        for s in range(d):
            for j in range(s):
                mixed = (next(crossed) - next(crossed)) / 4
                gradient[:, s] += mixed[:, j]
                gradient[:, j] += mixed[:, s]
        columns = (value, moving, moving - still, log_det_z.tolist(), gradient, off.tolist(), turned, mean)
        return [Sample(*each) for each in zip(times, *columns, strict=True)]

    # -- pieces, on the atoms of the clusters ---------------------------------------------------

    def _copied(self, k: int, copies: int) -> Constraint:
        """The rows of the k-th constraint object, so many times."""
        if (k, copies) not in self._copies:
            item = self._rows.constraints[k]
            self._copies[k, copies] = item.select(np.tile(np.arange(item.n_rows), copies))
        return self._copies[k, copies]

    def _gathered(self, x: FloatArray) -> list[FloatArray]:
        """Positions of each object's rows in n configurations, shape (n, n_rows, width, 3)."""
        self._rows.lattice = self._source.lattice
        return [np.stack([self._rows.gather(item, y) for y in x]) for item in self._rows.constraints]

    def _at(self, gathered: Sequence[FloatArray], time: float) -> tuple[FloatArray, ...]:
        """Z and all that follows from the gradients; raises where a coordinate depends on other constraints.

        Of n configurations, d coordinates among r rows on a atoms: ln det Z; rows of (A M^-1 A^T)^-1, (n, d, r); the
        share of each row in a coordinate's gradient that the others have answered, (n, d, r); directions, (n, d, 3 a);
        fields, whose squares are what the rows take from M^-1, (n, r, 3 a).
        """
        d, n = len(self), len(gathered[0])
        table = np.zeros((n, len(self._order), len(self.atoms), 3))
        for k, (item, r) in enumerate(zip(self._rows.constraints, gathered, strict=True)):
            slopes = self._copied(k, n).gradient(r.reshape(-1, *r.shape[2:]), time).reshape(r.shape)
            for w in range(item.width):  # an atom may be twice in a row
                table[:, self._lines[k], item.atoms[:, w]] += slopes[:, :, w]
        gradients = table.reshape(n, len(self._order), -1)
        weighed = gradients * self._inverse_masses
        product = weighed @ gradients.swapaxes(1, 2)
        if not np.isfinite(product).all():
            raise NonFiniteError(f"the gradient of {', '.join(self.names)} is not finite", item="positions")
        sizes = np.sqrt(np.diagonal(product, axis1=1, axis2=2))
        sizes = np.where(sizes > 0, sizes, 1.0)
        root, lost = _root(product / (sizes[:, :, None] * sizes[:, None]))
        self._refuse(np.flatnonzero((lost[:, -d:] > _LOST).any(axis=0)).tolist())
        root = root / sizes[:, None]
        respond = root[:, :, -d:].swapaxes(1, 2) @ root  # of (A M^-1 A^T)^-1, of which Z^-1 is the last block
        z = np.linalg.inv(respond[:, :, -d:])
        own = sizes[:, -d:]
        left, mixture = np.linalg.eigh(z / (own[:, :, None] * own[:, None]))
        worst = int(np.argmin(left[:, 0]))
        if left[worst, 0] < DEPENDENT:
            self._refuse(np.flatnonzero(np.abs(mixture[worst, :, 0]) > 0.1).tolist())
        log_det_z = np.log(left).sum(axis=1) + 2 * np.log(own).sum(axis=1)
        return log_det_z, respond, z @ respond, respond @ weighed, root @ weighed

    def _refuse(self, dependent: list[int]) -> None:
        if dependent:
            atoms = [self._source.row_atoms(row) for row in self.rows[dependent].tolist()]
            raise SingularGeometryError(
                f"{' and '.join(self.names[k] for k in dependent)} depend{'s' if len(dependent) == 1 else ''} on the "
                "other constraints (Z = 0): nothing is left to move along; take out the constraints that fix it, or "
                "measure another coordinate",
                rows=self.rows[dependent],
                atoms=np.unique(np.concatenate(atoms)),
            )

    def _curvatures(self, gathered: Sequence[FloatArray], u: FloatArray, time: float) -> tuple[FloatArray, FloatArray]:
        """u^T q'' u of all rows for k fields u, shape (n, k, rows); the trace of M^-1 q'' of each row, or zeros."""
        n, k = u.shape[:2]
        fields, bent, traces = u.reshape(n, k, -1, 3), [], []
        for number, (item, r) in enumerate(zip(self._rows.constraints, gathered, strict=True)):
            v, w = fields[:, :, item.atoms], item.width
            if self._averages:
                unit = np.eye(3 * w).reshape(-1, 1, w, 3)
                v = np.concatenate([v, np.broadcast_to(unit, (n, 3 * w, item.n_rows, w, 3))], axis=1)
            count = v.shape[1]
            r = np.broadcast_to(r[:, None], v.shape).reshape(-1, w, 3)
            found = self._copied(number, n * count).curvature(r, v.reshape(r.shape), time).reshape(n, count, -1)
            bent.append(found[:, :k])
            each = found[:, k:].reshape(n, -1, 3, item.n_rows).sum(axis=2)
            traces.append((each * self._inverse_masses[::3][item.atoms].T[: each.shape[1]]).sum(axis=1))
        return np.concatenate(bent, axis=2)[:, :, self._order], np.concatenate(traces, axis=1)[:, self._order]


def _root(product: FloatArray) -> tuple[FloatArray, FloatArray]:
    """W with W^T W the (pseudo)inverse of matrices with a diagonal of 1; how much of each row depends on others."""
    with suppress(np.linalg.LinAlgError):
        root = np.linalg.cholesky(product)
        if np.diagonal(root, axis1=1, axis2=2).min() > _PIVOT:
            return np.linalg.inv(root), np.zeros(product.shape[:2])
    sizes, axes = np.linalg.eigh(product)
    known = sizes > _NONE * sizes[:, -1:]
    inverse = np.where(known, 1 / np.sqrt(np.where(known, sizes, 1.0)), 0.0)
    return (axes * inverse[:, None]).swapaxes(1, 2), (axes**2 * ~known[:, None]).sum(axis=2)


#: A trial turn in radian, what it may change of other rows, and by which factor a bond may change before it is broken.
_TRIAL, _SAME, _BROKEN = 0.3, 1e-8, 1.5


class RigidTurn(NamedTuple):
    """All atoms beyond the middle bond of a torsion, turned about it.

    Such a turn changes no bond and no angle, and has no divergence, so that dF/dphi is the weighted mean of the torque
    against it (Ciccotti, Lelievre and Vanden-Eijnden, Commun. Pure Appl. Math. 61, 371, 2008, for any such field).
    """

    #: Two atoms: a turn about the line from the first to the second by a positive angle makes the torsion larger.
    axis: IntArray
    #: The atoms that move.
    group: IntArray
    #: Those of the group, to the axis and of the axis, shape (b, 2), and their lengths.
    bonds: IntArray
    lengths: FloatArray

    def turned(self, x: FloatArray, angle: float) -> FloatArray:
        """Positions with the group turned, shape (n_atoms, 3)."""
        e = self._direction(x)
        r = x[self.group] - x[self.axis[1]]
        result = x.copy()
        result[self.group] += np.sin(angle) * cross(e, r) + (1 - np.cos(angle)) * (np.outer(r @ e, e) - r)
        return result

    def force(self, x: FloatArray, f: FloatArray) -> FloatArray:
        """dU/dphi of the turn, of one or several configurations; NaN where a bond of the group is broken, by a box for
        example."""
        i, j = self.bonds.T
        broken = (((x[..., i, :] - x[..., j, :]) ** 2).sum(axis=-1) > (_BROKEN * self.lengths) ** 2).any(axis=-1)
        arms = x[..., self.group, :] - x[..., self.axis[1:], :]
        torque = cross(arms, f[..., self.group, :]).sum(axis=-2)
        return np.where(broken, np.nan, -dot(self._direction(x), torque))

    def _direction(self, x: FloatArray) -> FloatArray:
        e: FloatArray = x[..., self.axis[1], :] - x[..., self.axis[0], :]
        return e / norm(e)[..., None]


def warn_of_gaps(coordinates: Mapping[str, Constraint], bonds: IntArray, stacklevel: int) -> None:
    """Warn of torsions over atoms that are not bonded: most often the atoms are in another order than the chain.

    Not of improper torsions, where one atom is bonded to the three others, nor of atoms without any bond.
    """
    joined, bonded = {frozenset(pair) for pair in bonds.tolist()}, set(bonds.ravel().tolist())
    for name, item in coordinates.items():
        for four in item.atoms.tolist() if item.family == "Dihedral" else ():
            if any(all({hub, other} in joined for other in four if other != hub) for hub in four):
                continue
            gaps = [pair for pair in pairwise(four) if {*pair} not in joined and bonded.issuperset(pair)]
            if gaps:
                said = ", ".join(f"{a}-{b}" for a, b in gaps) + (" are no bonds" if len(gaps) > 1 else " is no bond")
                warnings.warn(
                    f"{name} is a torsion over the atoms {', '.join(map(str, four))}, counted from 0, and {said}; give "
                    "the atoms in the order in which they are bonded, unless this is what you mean",
                    stacklevel=stacklevel,
                )


def rigid_turn(
    coordinate: Constraint, bonds: IntArray, x: FloatArray, lattice: FloatArray | None = None
) -> RigidTurn | None:
    """The smaller group of one torsion; None of another coordinate, or where the middle bond is missing or in a ring.

    Bonds have their lengths in the lattice, also where a box has cut them.
    """
    if coordinate.family != "Dihedral":
        return None
    i, j, k, m = coordinate.atoms[0].tolist()
    middle = ((bonds == [j, k]) | (bonds == [k, j])).all(axis=1)
    if not middle.any():
        return None
    a, b = bonds[~middle].T
    part = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(len(x), len(x))), directed=False)[1]
    if part[j] == part[k] or part[i] != part[j] or part[m] != part[k]:
        return None
    beyond = [(np.flatnonzero(part == part[near]), far, near) for near, far in ((k, j), (j, k))]
    atoms, far, near = min(beyond, key=lambda side: len(side[0]))
    own = bonds[middle | (part[bonds[:, 0]] == part[near])]
    lengths = np.linalg.norm(minimum_image(x[own[:, 0]] - x[own[:, 1]], lattice), axis=1)
    return RigidTurn(np.array([far, near]), atoms[atoms != near], own, lengths)


def leaves_the_rest(
    turn: RigidTurn, row: int, everything: ConstraintSet, others: IntArray, x: FloatArray, time: float = 0.0
) -> bool:
    """Whether a turn changes its coordinate by its angle, no other row of the set, and not det(A M^-1 A^T) of `others`.

    `row` is that of the coordinate in the set, `others` the other rows of the clusters of the coordinates.
    """
    there = turn.turned(x, _TRIAL)
    change = everything.measure(there, time) - everything.measure(x, time)
    change[row] -= _TRIAL
    periods = np.concatenate([np.full(c.n_rows, c.period or 0.0) for c in everything.constraints])
    if not np.abs(nearest_image(change, periods)).max() < _SAME:
        return False
    part, atoms = everything.subset(others)
    before, after = 0.0, 0.0
    if part.n_rows:
        root = np.sqrt(np.repeat(part.masses, 3))
        slopes = (part.jacobian(place[atoms]).toarray() / root for place in (x, there))
        before, after = (float(np.linalg.slogdet(a @ a.T)[1]) for a in slopes)  # minus infinity of dependent rows
    return abs(after - before) < _SAME
