"""Many constraints as one sigma, A and b.

Packs the rows of any number of constraint objects; gives values, a sparse Jacobian and the right-hand
sides of A v = c and A a = b. It reads only the atoms that a row touches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.contradictions import refuse_contradictions
from kcons.constraints.target import FloatArray, MovingTarget
from kcons.errors import InputError


class ConstraintSet:
    """All that is held in one system.

    Parameters
    ----------
    constraints : iterable of Constraint
        What is held. Targets left at None are taken from `positions`.
    positions : array_like, shape (n_atoms, 3)
        Initial positions, any consistent unit of length.
    masses : array_like, shape (n_atoms,)
        Masses; positive for every constrained atom.
    cell : array_like, shape (3, 3) or (3,), optional
        Lattice vectors as rows, or the lengths of an orthorhombic box. Rows that depend on
        differences of positions then use minimum images.
    pbc : bool or sequence of three bool
        Which lattice vectors are periodic; ignored without a cell.
    time : float
        Time at which targets are taken from the positions.

    Raises
    ------
    InputError
        Wrong shapes, NaN or infinity, unknown atoms, masses that are not positive, a degenerate cell,
        a periodic row longer than half the box.
    ConstraintError
        A row that is undefined at `positions` or cannot be fulfilled; two targets for one coordinate
        (`ContradictionError`).
    InfeasibleError
        Distances that violate the triangle inequality.

    References
    ----------
    Notes, eqs. 81-92.
    """

    def __init__(
        self,
        constraints: Iterable[Constraint] | Constraint,
        positions: ArrayLike,
        masses: ArrayLike,
        *,
        cell: ArrayLike | None = None,
        pbc: bool | Sequence[bool] = True,
        time: float = 0.0,
    ) -> None:
        given = (constraints,) if isinstance(constraints, Constraint) else tuple(constraints)
        for item in given:
            if not isinstance(item, Constraint):
                raise InputError(f"{item!r} is no kcons constraint", item="constraints")
        x = _array(positions, "positions")
        if x.ndim != 2 or x.shape[1] != 3:
            raise InputError(f"positions must have shape (n_atoms, 3), not {x.shape}", item="positions")
        m = _array(masses, "masses")
        if m.shape != (len(x),):
            raise InputError(f"masses must have shape ({len(x)},), not {m.shape}", item="masses")
        self.n_atoms = len(x)
        self.masses = m
        self._set_cell(cell, pbc)
        self._check_atoms(given, x, m)

        self.constraints: tuple[Constraint, ...] = ()
        starts = np.concatenate([[0], np.cumsum([c.n_rows for c in given], dtype=np.int64)])
        self.starts: IntArray = starts.astype(np.int64)
        bound: list[Constraint] = []
        for start, item in zip(self.starts, given, strict=False):
            r = self.gather(item, x)
            item = item.with_masses(m[item.atoms])
            item.check(r, time, int(start))
            if item.target is None:
                item = item.with_target(item.measure(r, time) if item.holonomic else np.zeros(item.n_rows))
            self._check_half_box(item, r, int(start), time)
            bound.append(item)
        self.constraints = tuple(bound)
        refuse_contradictions(self.constraints, self.starts, time)
        self._set_scale(x, time)

    # -- construction ---------------------------------------------------------------------------

    def _set_cell(self, cell: ArrayLike | None, pbc: bool | Sequence[bool]) -> None:
        self.lattice: FloatArray | None = None
        if cell is None:
            return
        matrix = _array(cell, "cell")
        if matrix.shape == (3,):
            matrix = np.diag(matrix)
        if matrix.shape != (3, 3):
            raise InputError(f"cell must have shape (3, 3) or (3,), not {matrix.shape}", item="cell")
        periodic = np.broadcast_to(np.asarray(pbc, dtype=bool), (3,))
        if not np.all(np.isfinite(matrix)):
            raise InputError("cell has a NaN or infinity", item="cell")
        if not periodic.any():
            return
        # Directions without periodicity need any independent vector for the inverse to exist.
        full = _completed(matrix, periodic)
        inverse = np.linalg.inv(full)
        inverse[:, ~periodic] = 0.0
        self.lattice = np.ascontiguousarray(np.stack([full, inverse]))

    def with_cell(self, cell: ArrayLike | None, pbc: bool | Sequence[bool] = True) -> None:
        """Change the cell in place (barostats); targets are unchanged."""
        self._set_cell(cell, pbc)

    @property
    def half_width(self) -> float:
        """Half the smallest perpendicular width of the periodic cell; infinite without one."""
        if self.lattice is None:
            return np.inf
        norms = np.linalg.norm(self.lattice[1], axis=0)
        return 0.5 / float(norms.max())

    def check_half_box(self, positions: FloatArray | None = None, time: float = 0.0) -> None:
        """Check all rows against half the box; without `positions`, distances only.

        Raises
        ------
        InputError
            A row whose minimum image is ambiguous.
        """
        if self.lattice is None:
            return
        longest, number = self._longest_distance
        if longest >= self.half_width:
            item = self.constraints[number]
            self._check_half_box(item, np.zeros((item.n_rows, item.width, 3)), int(self.starts[number]), time)
        for item, start in zip(self.constraints, self.starts, strict=False):
            if item.half_box_rows and (item.family != "Distance" or item.moving) and positions is not None:
                self._check_half_box(item, self.gather(item, positions), int(start), time)

    @cached_property
    def _longest_distance(self) -> tuple[float, int]:
        """Longest distance that is held at a constant length, and the number of its constraint."""
        lengths = [
            float(c.target_at(0.0).max(initial=0.0)) if c.family == "Distance" and not c.moving else 0.0
            for c in self.constraints
        ]
        return (max(lengths), int(np.argmax(lengths))) if lengths else (0.0, 0)

    def _check_half_box(self, item: Constraint, r: FloatArray, start: int, time: float) -> None:
        """Minimum images are unique only for vectors shorter than half the box."""
        if self.lattice is None or not item.half_box_rows:
            return
        if item.family == "Distance":
            length, what = item.target_at(time)[:, None], "target"
        else:
            length, what = np.linalg.norm(np.diff(r, axis=1), axis=2), "distance of neighbouring atoms"
        too_long = np.argwhere(length >= self.half_width)
        if len(too_long):
            k, slot = (int(i) for i in too_long[0])
            raise InputError(
                f"row {start + k}, {item.row_name(k)}: {what} {length[k, slot]:g} is not shorter than half the box "
                f"({self.half_width:g}); its minimum image is ambiguous. Use a larger cell, no cell, or list the "
                "atoms so that neighbours in the row are neighbours in space",
                item="target" if what == "target" else "positions",
                atoms=item.atoms[k, slot : slot + 2].tolist(),
            )

    def _set_scale(self, x: FloatArray, time: float) -> None:
        """Rows that hold no length take sum |dq/dx_i| |x_i|; at the origin, the size of the system; then 1."""
        scale = self._rows(lambda c: c.scale(time))
        if not np.all(scale > 0):
            size = self._rows(lambda c: self._reach(c, x, time))
            extent = float(np.ptp(x, axis=0).max()) if len(x) else 0.0
            size = np.where(size > 0, size, extent if extent > 0 else 1.0)
            scale = np.where(scale > 0, scale, size)
        self.scale: FloatArray = scale

    def _reach(self, item: Constraint, x: FloatArray, time: float) -> FloatArray:
        gradient = np.linalg.norm(item.gradient(self.gather(item, x), time), axis=2)
        return np.sum(gradient * np.linalg.norm(x[item.atoms], axis=2), axis=1)

    def _check_atoms(self, given: Sequence[Constraint], x: FloatArray, m: FloatArray) -> None:
        start = 0
        held = np.zeros(len(x), dtype=bool)
        for item in given:
            if item.family == "FixedAtoms":
                held[item.atoms[item.atoms < len(x)]] = True
        for item in given:
            atoms = item.atoms
            if atoms.size and atoms.max() >= self.n_atoms:
                row, slot = np.argwhere(atoms >= self.n_atoms)[0]
                raise InputError(
                    f"row {start + row}, {item.row_name(int(row))}: there is no atom {atoms[row, slot]}; "
                    f"the system has atoms 0 to {self.n_atoms - 1}",
                    item="atoms",
                    atoms=atoms[row],
                )
            used = atoms.ravel()
            bad = ~np.isfinite(x[used]).all(axis=1)
            if bad.any():
                atom = int(used[np.argmax(bad)])
                raise InputError(f"position of atom {atom} is not finite: {x[atom]}", item="positions", atoms=[atom])
            # Fixed atoms move with infinite mass, whatever theirs is.
            bad = ~(np.isfinite(m[used]) & ((m[used] > 0) | (held[used] & (m[used] == 0))))
            if bad.any():
                atom = int(used[np.argmax(bad)])
                raise InputError(
                    f"atom {atom} has mass {m[atom]:g}; constrained atoms need positive mass "
                    "(fix it with FixedAtoms, or make it a virtual site)",
                    item="masses",
                    atoms=[atom],
                )
            start += item.n_rows

    # -- rows -----------------------------------------------------------------------------------

    @property
    def n_rows(self) -> int:
        return int(self.starts[-1])

    @property
    def moving(self) -> bool:
        """Whether any row depends on time explicitly."""
        return any(c.moving for c in self.constraints)

    @cached_property
    def holonomic(self) -> NDArray[np.bool_]:
        """True for position rows, False for velocity rows, shape (n_rows,)."""
        return np.concatenate([np.full(c.n_rows, c.holonomic) for c in self.constraints] or [np.zeros(0, bool)])

    def locate(self, row: int) -> tuple[Constraint, int]:
        """The constraint object that holds `row`, and the row's number within it."""
        k = int(np.searchsorted(self.starts, row, side="right")) - 1
        return self.constraints[k], int(row - self.starts[k])

    def row_name(self, row: int) -> str:
        """For example '#3 Distance(4, 5)'."""
        item, k = self.locate(row)
        return f"#{row} {item.row_name(k)}"

    def row_atoms(self, row: int) -> IntArray:
        """Atoms of one row."""
        item, k = self.locate(row)
        return item.atoms[k]

    @cached_property
    def incidence(self) -> sp.csr_array:
        """Which row touches which atom, shape (n_rows, n_atoms), entries 1."""
        columns = np.concatenate([c.atoms.ravel() for c in self.constraints] or [np.zeros(0, np.int64)])
        widths = np.concatenate(
            [np.full(c.n_rows, c.width, dtype=np.int64) for c in self.constraints] or [np.zeros(0, np.int64)]
        )
        indptr = np.concatenate([[0], np.cumsum(widths)])
        return sp.csr_array((np.ones(len(columns)), columns, indptr), shape=(self.n_rows, self.n_atoms))

    @cached_property
    def touched(self) -> IntArray:
        """Atoms that some row touches, sorted."""
        return _distinct(self.incidence.indices, self.n_atoms)

    @cached_property
    def n_moving(self) -> int:
        """Atoms that count for degrees of freedom: all but virtual sites (no mass, and no row touches them)."""
        if np.all(self.masses != 0):
            return self.n_atoms
        sites = self.masses == 0
        sites[self.touched] = False
        return self.n_atoms - int(np.sum(sites))

    # -- sigma, A, b ----------------------------------------------------------------------------

    def minimum_image(self, d: FloatArray) -> FloatArray:
        """Shortest periodic images of difference vectors, shape (..., 3)."""
        if self.lattice is None:
            return d
        return d - np.round(d @ self.lattice[1]) @ self.lattice[0]

    def gather(self, item: Constraint, x: FloatArray) -> FloatArray:
        """Positions of a constraint's atoms, shape (n_rows, width, 3), made whole across the boundary."""
        r = x[item.atoms]
        if self.lattice is not None and item.translation_invariant and item.width > 1:
            steps = self.minimum_image(np.diff(r, axis=1))
            r[:, 1:] = r[:, :1] + np.cumsum(steps, axis=1)
        return r

    def target(self, time: float = 0.0) -> FloatArray:
        """What each row is held at, shape (n_rows,)."""
        return self._rows(lambda c: c.target_at(time))

    def measure(self, x: ArrayLike, time: float = 0.0) -> FloatArray:
        """Natural coordinates q(x), shape (n_rows,); 0 for velocity rows."""
        x = self._positions(x)
        return self._rows(lambda c: c.measure(self.gather(c, x), time) if c.holonomic else np.zeros(c.n_rows))

    def value(self, x: ArrayLike, time: float = 0.0) -> FloatArray:
        """sigma(x, t) = q(x, t) - target(t), shape (n_rows,); 0 for velocity rows (notes eq. 81)."""
        x = self._positions(x)

        def sigma(c: Constraint) -> FloatArray:
            if not c.holonomic:
                return np.zeros(c.n_rows)
            difference = c.measure(self.gather(c, x), time) - c.target_at(time)
            if c.period is not None:
                difference -= c.period * np.round(difference / c.period)
            return difference

        return self._rows(sigma)

    def jacobian(self, x: ArrayLike, time: float = 0.0) -> sp.csr_array:
        """A, shape (n_rows, 3 n_atoms): d sigma/dx, or the coefficients of v (notes eq. 91)."""
        x = self._positions(x)
        data, columns, widths = [], [], []
        for c in self.constraints:
            data.append(c.gradient(self.gather(c, x), time).ravel())
            columns.append((3 * c.atoms[:, :, None] + np.arange(3)).ravel())
            widths.append(np.full(c.n_rows, 3 * c.width, dtype=np.int64))
        if not data:
            return sp.csr_array((0, 3 * self.n_atoms))
        indptr = np.concatenate([[0], np.cumsum(np.concatenate(widths))])
        return sp.csr_array(
            (np.concatenate(data), np.concatenate(columns), indptr), shape=(self.n_rows, 3 * self.n_atoms)
        )

    def velocity_target(self, x: ArrayLike, time: float = 0.0) -> FloatArray:
        """c with A v = c for admissible velocities, shape (n_rows,); 0 where nothing moves by itself."""
        x = self._positions(x)

        def c_of(c: Constraint) -> FloatArray:
            if not c.holonomic:
                return c.target_at(time)
            rate = _rate_at(c, time)
            if c.moving:
                r = self.gather(c, x)
                rate = rate - c.time_terms(r, np.zeros_like(r), time)[0]
            return rate

        return self._rows(c_of)

    def acceleration_target(self, x: ArrayLike, v: ArrayLike, time: float = 0.0) -> FloatArray:
        """b with A a = b (notes eqs. 90-92, time terms included), shape (n_rows,)."""
        x = self._positions(x)
        v = self._positions(v, "velocities")

        def b_of(c: Constraint) -> FloatArray:
            r = self.gather(c, x)
            u = v[c.atoms]
            curvature = c.curvature(r, u, time)
            if not c.holonomic:
                return _rate_at(c, time) - curvature
            second = c.target.acceleration_at(time, c.n_rows) if isinstance(c.target, MovingTarget) else 0.0
            return second - curvature - (c.time_terms(r, u, time)[1] if c.moving else 0.0)

        return self._rows(b_of)

    def tolerance(self, x: ArrayLike, time: float = 0.0) -> FloatArray:
        """What |sigma| can reach in double precision: max(1e-14 scale, 2 eps sum |dq/dx_i| |x_i|), shape (n_rows,)."""
        x = self._positions(x)

        floor = 2 * np.finfo(float).eps * self._rows(lambda c: self._reach(c, x, time))
        return np.maximum(1e-14 * self.scale, floor)

    # -- pieces ---------------------------------------------------------------------------------

    def subset(self, rows: IntArray) -> tuple[ConstraintSet, IntArray]:
        """The set made of some rows over their own atoms only, and those atoms' numbers in this set.

        `rows` must be sorted. Targets and cell are kept; nothing is checked again.
        """
        rows = np.asarray(rows, dtype=np.int64)
        bounds = np.searchsorted(rows, self.starts)
        pieces = [
            item.select(rows[lo:hi] - start)
            for item, start, lo, hi in zip(self.constraints, self.starts, bounds[:-1], bounds[1:], strict=False)
            if hi > lo
        ]
        used = np.concatenate([p.atoms.ravel() for p in pieces] or [np.zeros(0, np.int64)])
        atoms = _distinct(used, self.n_atoms)
        part = object.__new__(ConstraintSet)
        part.n_atoms = len(atoms)
        part.masses = self.masses[atoms]
        part.lattice = self.lattice
        part.scale = self.scale[rows]
        part.constraints = tuple(_compact(p, atoms) for p in pieces)
        part.starts = np.concatenate([[0], np.cumsum([p.n_rows for p in pieces], dtype=np.int64)]).astype(np.int64)
        return part, atoms

    def replaced(self, constraints: Sequence[Constraint], positions: FloatArray, time: float) -> ConstraintSet:
        """The same atoms, masses and cell under other constraints; their targets must be set. Nothing is checked."""
        other = object.__new__(ConstraintSet)
        other.n_atoms, other.masses, other.lattice = self.n_atoms, self.masses, self.lattice
        other.constraints = tuple(constraints)
        ends = np.cumsum([c.n_rows for c in constraints], dtype=np.int64)
        other.starts = np.concatenate([[0], ends]).astype(np.int64)
        other._set_scale(positions, time)
        return other

    def _rows(self, function: Callable[[Constraint], FloatArray]) -> FloatArray:
        return np.concatenate([function(c) for c in self.constraints] or [np.zeros(0)])

    def _positions(self, x: ArrayLike, item: str = "positions") -> FloatArray:
        array = np.asarray(x, dtype=np.float64)
        if array.shape != (self.n_atoms, 3):
            raise InputError(f"{item} must have shape ({self.n_atoms}, 3), not {array.shape}", item=item)
        return array

    def __len__(self) -> int:
        return self.n_rows

    def __repr__(self) -> str:
        return f"<ConstraintSet: {self.n_rows} rows on {self.n_atoms} atoms>"


def _rate_at(c: Constraint, time: float) -> FloatArray:
    return c.target.rate_at(time, c.n_rows) if isinstance(c.target, MovingTarget) else np.zeros(c.n_rows)


def _array(values: ArrayLike, item: str) -> FloatArray:
    try:
        return np.ascontiguousarray(np.asarray(values, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise InputError(f"{item} is no array of numbers: {error}", item=item) from None


def _completed(matrix: FloatArray, periodic: NDArray[np.bool_]) -> FloatArray:
    """Cell whose non-periodic vectors are replaced by unit vectors normal to the periodic ones."""
    full = matrix.copy()
    basis = matrix[periodic]
    _, singular, vh = np.linalg.svd(basis)
    if singular.min() < 1e-10 * max(singular.max(), np.finfo(float).tiny):
        raise InputError("the periodic cell vectors are zero or not independent", item="cell")
    full[~periodic] = vh[len(basis) :]
    return full


def _compact(item: Constraint, atoms: IntArray) -> Constraint:
    copy = item.with_target(item.target)
    copy.atoms = np.searchsorted(atoms, item.atoms)
    return copy


def _distinct(numbers: IntArray, limit: int) -> IntArray:
    """Sorted distinct numbers below `limit`; by marks where that is cheaper than sorting."""
    if 10 * len(numbers) < limit:
        return np.unique(numbers).astype(np.int64)
    marked = np.zeros(limit, dtype=bool)
    marked[numbers] = True
    return np.flatnonzero(marked)
