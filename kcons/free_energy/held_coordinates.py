"""What a held coordinate tells of the free energy: its multiplier, Z, and how Z changes along it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from kcons.constraints.arguments import as_array
from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.constraint_set import ConstraintSet, rows_like
from kcons.constraints.target import FloatArray, nearest_image
from kcons.errors import InputError, NonFiniteError, SingularGeometryError, UnsupportedError
from kcons.free_energy.compiled_samples import CompiledSamples, compilable
from kcons.free_energy.rigid_turns import RigidTurn, leaves_the_rest, rigid_turn
from kcons.motion.motion import Motion

#: A coordinate of which the other constraints leave less than this share of its Z depends on them.
DEPENDENT = 1e-9


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
        The mean of `kinetic` over canonical velocities, by kT; NaN where not all that is held in the clusters of the
        coordinates are independent distances, angles and torsions at rest.
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
    """Coordinates by name, checked.

    Raises
    ------
    InputError
        No names, or what is no constraint.
    """
    if not isinstance(coordinates, Mapping) or not coordinates or not all(isinstance(k, str) for k in coordinates):
        raise InputError(
            "no coordinates are named; give a mapping of names to constraints, such as "
            '{"torsion": Dihedral([[0, 1, 2, 3]])}',
            item="coordinates",
        )
    for name, coordinate in coordinates.items():
        if not isinstance(coordinate, Constraint):
            raise InputError(f"{name!r} is {coordinate!r}, and no kcons constraint", item=name)
    return dict(coordinates)


class HeldCoordinates:
    """Coordinates that an engine holds, by name.

    Only the clusters that they belong to are looked at, so that a sample costs the same in a large box.

    Parameters
    ----------
    motion : Motion or ConstraintSet
        What is held. For a dynamics class of ASE, ``dynamics.motion``.
    coordinates : mapping of str to Constraint
        Each a constraint of the set, named by an object of the same kind on the same atoms. One with n > 1 rows gives
        n coordinates, ``name[0]`` to ``name[n - 1]``.
    positions : array_like, shape (n_atoms, 3)
        Where rank and clusters are found.
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
    motion : Motion or None
        The engine of the other constraints of these clusters; None if there are none.

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
        names: list[str] = []
        rows: list[int] = []
        for name, coordinate in named(coordinates).items():
            found = rows_like(held, coordinate, name)
            names += [name] if len(found) == 1 else [f"{name}[{k}]" for k in range(len(found))]
            rows += found
        if len(set(rows)) < len(rows):
            row = next(row for row in rows if rows.count(row) > 1)
            twice = [name for name, its in zip(names, rows, strict=True) if its == row]
            raise InputError(f"{' and '.join(twice)} are the same row {row} of the set", item=twice[0])
        if len(set(names)) < len(names):
            again = next(name for name in names if names.count(name) > 1)
            raise InputError(f"two coordinates have the name {again!r}; give each its own", item=again)
        self.names = tuple(names)
        self.rows: IntArray = np.array(rows, dtype=np.int64)
        self._source = held
        order = np.argsort(self.rows)
        self._rank_of = np.argsort(order)
        self._own, own_atoms = held.subset(self.rows[order])
        self.periods = self._named(np.concatenate([np.full(c.n_rows, c.period or 0.0) for c in self._own.constraints]))
        others = np.setdiff1d(_joined_rows(held, self.rows), self.rows)
        if not held.holonomic[others].all():
            raise UnsupportedError(
                f"{' and '.join(names)} share atoms with velocity constraints, under which configurations have no "
                "known distribution; multipliers alone are those of Motion.multipliers"
            )
        self._others, other_atoms = held.subset(others)
        self.atoms: IntArray = np.union1d(own_atoms, other_atoms).astype(np.int64)
        self._own_atoms = np.searchsorted(self.atoms, own_atoms)
        self._other_atoms = np.searchsorted(self.atoms, other_atoms)
        self._inverse_masses = 1 / held.masses[self.atoms, None]
        self.motion = Motion(self._others, x[other_atoms], time=time) if len(others) else None
        self._at(x[self.atoms], time)
        self._compiled: CompiledSamples | None = None
        if compilable(self._own) and compilable(self._others):
            places = (self._rank_of, self._own_atoms, self._other_atoms)
            masses = held.masses[self.atoms]
            self._compiled = CompiledSamples(self._own, self._others, *places, self.atoms, 1 / masses, self.periods)
        self._turns: list[RigidTurn | None] = [None] * len(self)
        if bonds is not None:
            pairs = np.array(bonds, dtype=np.int64).reshape(-1, 2)
            for k, row in enumerate(self.rows.tolist()):
                turn = rigid_turn(_row(held, row), pairs, x, held.lattice)
                if turn is not None and leaves_the_rest(turn, row, held, others, x, time):
                    self._turns[k] = turn

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        beside = 0 if self.motion is None else self.motion.rank
        return f"<HeldCoordinates: {', '.join(self.names)}, beside {beside} independent rows of their clusters>"

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
        named = ((x, "positions"), (v, "velocities"), (f, "forces"))
        whole = [as_array(array, shape, item) for array, item in named]
        turned = np.array([np.nan if turn is None else turn.force(whole[0], whole[2]) for turn in self._turns])
        found = None if self._compiled is None else self._compiled.sample(whole, time, self._source.lattice)
        if found is not None:
            value, moving, kinetic, gradient, off, log_det_z, mean = found
            return Sample(time, value, moving, kinetic, float(log_det_z[0]), gradient, max(off.tolist()), turned, mean)
        for array, (_, item) in zip(whole, named, strict=True):
            finite = np.isfinite(array[self.atoms]).all(axis=1)
            if not finite.all():
                atom = int(self.atoms[np.argmin(finite)])
                raise NonFiniteError(f"{item} of atom {atom} are not finite at time {time:g}", item=item, atom=atom)
        here, speed, force = (array[self.atoms] for array in whole)
        metric = self._at(here, time)
        pushed = np.einsum("ian,an->i", metric.kept, force)
        bent = self._curvatures(here, self._fields(speed, metric.directions), time, metric)
        if self._source.moving:
            rest, driven = (self._targets(here, u, time, metric) for u in (np.zeros_like(here), speed))
        else:
            rest, driven = np.zeros(len(self)), -bent[0]
        still, moving = metric.inverse @ (rest - pushed), metric.inverse @ (driven - pushed)
        value = self._named(self._own.measure(here[self._own_atoms], time))
        gradient = self._change_of_z(bent[1:])
        off = nearest_image(value - self._named(self._own.target(time)), self.periods)
        largest = float(np.abs(off).max())
        unknown = np.full(len(self), np.nan)
        return Sample(time, value, moving, moving - still, metric.log_det_z, gradient, largest, turned, unknown)

    def directions(self, x: ArrayLike, time: float = 0.0) -> FloatArray:
        """Displacements that change one coordinate by one, and no other nor any constraint, shape (d, n_atoms, 3).

        The rows of M^-1 A^T (A M^-1 A^T)^-1 that belong to the coordinates: the shortest ones in the metric of the
        masses.
        """
        here = as_array(x, (self._source.n_atoms, 3), "positions")
        result = np.zeros((len(self), *here.shape))
        result[:, self.atoms] = self._at(here[self.atoms], time).directions
        return result

    # -- pieces, on the atoms of the clusters ---------------------------------------------------

    def _named(self, of_rows: FloatArray) -> FloatArray:
        """From the order of rows in the set to that of the names."""
        return of_rows[self._rank_of]

    def _at(self, x: FloatArray, time: float) -> _Metric:
        """Z and all that follows from the gradients at `x`; raises where a coordinate depends on other constraints."""
        self._own.lattice = self._others.lattice = self._source.lattice
        d, near = len(self), self._other_atoms
        gradients = np.zeros((d, *x.shape))
        gradients[:, self._own_atoms] = self._named(_gradients(self._own, x[self._own_atoms], time))
        kept = gradients * self._inverse_masses
        free = np.einsum("ian,ian->i", gradients, kept)
        reactions = np.zeros((d, 0))
        if self.motion is not None:
            rest = np.zeros((len(near), 3))
            rows = self.motion.constraint_set
            b = -rows.acceleration_target(x[near], rest, time) if rows.moving else None
            answers = [self.motion.respond(x[near], rest, g[near], time, feedback=b) for g in gradients]
            kept[:, near] = [acceleration for acceleration, _ in answers]
            reactions = np.array([multipliers for _, multipliers in answers])
        z = np.einsum("ian,jan->ij", gradients, kept)
        z = (z + z.T) / 2
        with np.errstate(all="ignore"):
            share = z / np.sqrt(np.outer(free, free))
        if not np.all(np.isfinite(share)):
            raise NonFiniteError(f"the gradient of {', '.join(self.names)} is not finite", item="positions")
        left, mixture = np.linalg.eigh(share) if d > 1 else (share[0], np.ones((1, 1)))
        if left[0] < DEPENDENT:
            worst = [k for k in range(d) if abs(mixture[k, 0]) > 0.1]
            raise SingularGeometryError(
                f"{' and '.join(self.names[k] for k in worst)} depend{'s' if len(worst) == 1 else ''} on the other "
                "constraints (Z = 0): nothing is left to move along; take out the constraints that fix it, or measure "
                "another coordinate",
                rows=self.rows[worst],
                atoms=self.atoms[self._own_atoms],
            )
        inverse = np.linalg.inv(z) if d > 1 else 1 / z
        log_det_z = float(np.linalg.slogdet(z)[1] if d > 1 else np.log(z[0, 0]))
        return _Metric(log_det_z, inverse, kept, reactions, np.tensordot(inverse, kept, 1))

    def _seen(self, own: FloatArray, others: FloatArray | None, metric: _Metric) -> FloatArray:
        """What a quantity of rows means for the coordinates once the other constraints have had their share."""
        seen = self._named(own)
        return seen if others is None else seen + metric.reactions @ others

    def _targets(self, x: FloatArray, v: FloatArray, time: float, metric: _Metric) -> FloatArray:
        """b of the coordinates, less what the other constraints' b gives them."""
        own, near = self._own_atoms, self._other_atoms
        others = None if self.motion is None else self.motion.constraint_set
        return self._seen(
            self._own.acceleration_target(x[own], v[own], time),
            None if others is None else others.acceleration_target(x[near], v[near], time),
            metric,
        )

    def _curvatures(self, x: FloatArray, u: FloatArray, time: float, metric: _Metric) -> FloatArray:
        """u^T q'' u of the coordinates on the surface of the other constraints, for k fields u at once, (k, d)."""
        own, near = self._own_atoms, self._other_atoms
        seen = self._named(_curvatures(self._own, x[own], u[:, own], time).T).T
        if self.motion is not None:
            seen = seen + _curvatures(self.motion.constraint_set, x[near], u[:, near], time) @ metric.reactions.T
        return seen

    def _fields(self, v: FloatArray, along: FloatArray) -> FloatArray:
        """The velocities, the directions, and of each two directions the sum and the difference."""
        pairs = [along[s] + sign * along[j] for s in range(len(along)) for j in range(s) for sign in (1, -1)]
        return np.array([v, *along, *pairs])

    def _change_of_z(self, bent: FloatArray) -> FloatArray:
        """Half the derivative of ln det Z along each direction s: sum_j d_j^T q_j'' d_s, polarised."""
        d = len(self)
        result, pairs = np.diagonal(bent).copy(), iter(bent[d:])
        for s in range(d):
            for j in range(s):
                mixed = (next(pairs) - next(pairs)) / 4
                result[s] += mixed[j]
                result[j] += mixed[s]
        return result


class _Metric(NamedTuple):
    """At one configuration, on n atoms.

    `inverse` (d, d) of Z; `kept` (d, n, 3), M_par^+ times the gradients; `reactions` (d, rows), the multipliers with
    which the other constraints answer a gradient; `directions` (d, n, 3).
    """

    log_det_z: float
    inverse: FloatArray
    kept: FloatArray
    reactions: FloatArray
    directions: FloatArray


def _gradients(held: ConstraintSet, x: FloatArray, time: float) -> FloatArray:
    """The rows' gradients, shape (n_rows, n_atoms, 3)."""
    result = np.zeros((held.n_rows, *x.shape))
    for start, item in zip(held.starts, held.constraints, strict=False):
        rows = start + np.arange(item.n_rows)[:, None]
        np.add.at(result, (rows, item.atoms), item.gradient(held.gather(item, x), time))
    return result


def _curvatures(held: ConstraintSet, x: FloatArray, u: FloatArray, time: float) -> FloatArray:
    """u^T q'' u of all rows for k fields, shape (k, n_rows): the rows once more for each field, in one call."""
    many, parts = len(u), []
    for item in held.constraints:
        again = item.select(np.tile(np.arange(item.n_rows), many))
        r = np.tile(held.gather(item, x), (many, 1, 1))
        v = u[:, item.atoms].reshape(r.shape)
        parts.append(again.curvature(r, v, time).reshape(many, -1))
    return np.concatenate(parts, axis=1)


def _row(held: ConstraintSet, row: int) -> Constraint:
    """One row of the set."""
    item = int(np.searchsorted(held.starts, row, side="right")) - 1
    return held.constraints[item].select([row - int(held.starts[item])])


def _joined_rows(held: ConstraintSet, rows: IntArray) -> IntArray:
    """All rows of the clusters that `rows` belong to, sorted."""
    incidence = coo_array(held.incidence)
    n = held.n_rows
    links = coo_array(
        (np.ones(incidence.nnz), (incidence.row, n + incidence.col)), shape=(n + held.n_atoms, n + held.n_atoms)
    )
    label = connected_components(links, directed=False)[1][:n]
    return np.flatnonzero(np.isin(label, label[rows])).astype(np.int64)
