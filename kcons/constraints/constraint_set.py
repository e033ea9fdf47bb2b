"""Many constraints as one sigma, A and b.

Packs the rows of any number of constraint objects; gives values, a sparse Jacobian and the right-hand
sides of A v = c and A a = b. It reads only the atoms that a row touches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import as_array, as_float_array, finite_number, read_only
from kcons.constraints.constraint import Constraint, IntArray, constraints_in
from kcons.constraints.periodic.images import Images, find_images
from kcons.constraints.periodic.one_piece import lattice_of, lined_up, make_whole, spanning_tree
from kcons.constraints.target import FloatArray, MovingTarget, nearest_image
from kcons.constraints.vectors import extent, norm
from kcons.errors import ContradictionError, ImageError, InfeasibleError, InputError, KconsError

#: Parts of the cell at which a link that nothing holds is taken to have reached half of it.
_HALF = 0.5 - 1e-9
#: Change of a cell vector, in parts of its length, over which images of atoms that nothing ties together are followed.
MOST_STRAIN = 0.1
#: What is taken for rounding of a sum of gradients, relative to their sizes, and of values, to gradients times lengths.
CANCELS = 1e-7
#: Relative difference of two targets (radian for angles) that counts as rounding.
_SAME = 1e-10


class Residuals(NamedTuple):
    """How far positions and velocities are off the rows, and what counts as held, each shape (n_rows,).

    `allowed` is for |sigma|: 1e-10 of the scale, or what rounding leaves of far atoms. `rates` is A v - c, `speeds`
    the sum of what it is made of; both None without velocities. `norms` are those of the rows of A, and `sizes` the
    sums of the gradients' norms over the atoms.
    """

    sigma: FloatArray
    allowed: FloatArray
    rates: FloatArray | None
    speeds: FloatArray | None
    norms: FloatArray
    sizes: FloatArray


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
        Unknown atoms, masses that are not positive, a degenerate cell, a periodic row longer than half the box.
    ConstraintError
        A row that is undefined at `positions` or cannot be fulfilled; two targets for one coordinate
        (`ContradictionError`).
    InfeasibleError
        Distances that violate the triangle inequality.

    Attributes
    ----------
    masses : ndarray, shape (n_atoms,)
        They cannot be changed: make a new set for others.
    lattice : ndarray, shape (2, 3, 3), or None
        Cell vectors as rows, and the inverse with zeros for directions without periodicity.

    References
    ----------
    Notes, eqs. 81-92.
    """

    lattice: FloatArray | None
    #: The tree along which atoms of whole rows are made whole; see `kcons.constraints.periodic.images`.
    images: Images | None
    #: Whole cells by which the positions that the set is given were moved from where they are stored, in solvers,
    #: shape (n_atoms, 3): rows with a place in space take them off.
    moved: FloatArray | None = None
    #: What an engine converted to make this set from another one; see `Motion.conversions`.
    conversions: tuple[Any, ...] = ()

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
        given = constraints_in(constraints, "constraints")
        time = finite_number(time, "time")
        x = as_float_array(positions, "positions")
        if x.ndim != 2 or x.shape[1] != 3:
            raise InputError(f"positions must have shape (n_atoms, 3), not {x.shape}", item="positions")
        self.n_atoms = len(x)
        m = as_array(masses, (self.n_atoms,), "masses").copy()
        self.masses = read_only(m)  # engines know their inverse
        self._set_cell(cell, pbc)
        self.starts = _starts(given)
        _check_atoms(given, self.starts, x, m)
        weighted = [item.with_masses(m[item.atoms]) for item in given]
        marked, self.images = find_images(weighted, self.starts, x, self.lattice, self.half_width, time)
        y = self.whole(x)
        together = whole_bodies(marked, y, self.lattice)
        if self.images is not None:
            together[self.images.atoms] = y[self.images.atoms]
        bound: list[Constraint] = []
        for start, item in zip(self.starts, marked, strict=False):
            r = self.gather(item, x, y)
            item.check(r, time, int(start))
            self._refuse_cut(item, r, time, int(start))
            if isinstance(item.target, MovingTarget):
                item.target.check(repr(item), time, item.n_rows, item.period)
            if item.target is None:
                r = r if together is y else self.gather(item, x, together)
                found = item.measure(r, time) if item.holonomic else np.zeros(item.n_rows)
                item = item.with_target(found)
            bound.append(item)
        open_ = [item.target is None for item in marked]
        self.constraints: tuple[Constraint, ...] = tuple(agreed_targets(bound, open_, self.starts, time))
        self._set_scale(x, time)

    def _set_scale(self, x: FloatArray, time: float) -> None:
        """Rows that hold no length take sum |dq/dx_i| |x_i|; at the origin, the size of the system; then 1."""
        self.scale: FloatArray = self._rows(lambda c: c.scale(time))
        if not np.all(self.scale > 0):
            size = self._reach(x, time)
            size = np.where(size > 0, size, extent(x[np.isfinite(x).all(axis=1)]) or 1.0)
            self.scale = np.where(self.scale > 0, self.scale, size)

    def _reach(self, x: FloatArray, time: float) -> FloatArray:
        """sum |dq/dx_i| |x_i| of each row."""
        return self._of_rows(x, time, lambda c, r, t: np.sum(norm(c.gradient(r, t)) * norm(x[c.atoms]), axis=1))

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
        return self._rows(lambda c: np.full(c.n_rows, c.holonomic)).astype(bool)

    @cached_property
    def incidence(self) -> sp.csr_array:
        """Which row touches which atom, shape (n_rows, n_atoms), entries 1."""
        columns = _atoms_of(self.constraints)
        indptr = np.concatenate([[0], np.cumsum(self._rows(lambda c: np.full(c.n_rows, c.width)))]).astype(np.int64)
        return sp.csr_array((np.ones(len(columns)), columns, indptr), shape=(self.n_rows, self.n_atoms))

    @cached_property
    def touched(self) -> IntArray:
        """Atoms that some row touches, sorted."""
        return np.flatnonzero(np.bincount(self.incidence.indices, minlength=self.n_atoms))

    @cached_property
    def n_moving(self) -> int:
        """Atoms that count for degrees of freedom: all but virtual sites (no mass, and no row touches them)."""
        sites = self.masses == 0
        sites[self.touched] = False
        return self.n_atoms - int(np.sum(sites))

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

    # -- sigma, A, b ----------------------------------------------------------------------------

    def target(self, time: float = 0.0) -> FloatArray:
        """What each row is held at, shape (n_rows,)."""
        time = finite_number(time, "time")
        return self._rows(lambda c: c.target_at(time))

    def measure(self, x: ArrayLike, time: float = 0.0) -> FloatArray:
        """Natural coordinates q(x), shape (n_rows,); 0 for velocity rows."""
        return self._of_rows(x, time, lambda c, r, t: c.measure(r, t) if c.holonomic else np.zeros(c.n_rows))

    def value(self, x: ArrayLike, time: float = 0.0) -> FloatArray:
        """sigma(x, t) = q(x, t) - target(t), shape (n_rows,); 0 for velocity rows (notes eq. 81)."""
        return self._of_rows(x, time, lambda c, r, t: c.sigma(r, t))

    def jacobian(self, x: ArrayLike, time: float = 0.0) -> sp.csr_array:
        """A, shape (n_rows, 3 n_atoms): d sigma/dx, or the coefficients of v (notes eq. 91)."""
        data, pattern = self._of_rows(x, time, lambda c, r, t: c.gradient(r, t).ravel()), self.incidence
        columns = (3 * pattern.indices[:, None] + np.arange(3)).ravel()
        return sp.csr_array((data, columns, 3 * pattern.indptr), shape=(self.n_rows, 3 * self.n_atoms))

    def velocity_target(self, x: ArrayLike, time: float = 0.0) -> FloatArray:
        """c with A v = c for admissible velocities, shape (n_rows,); 0 where nothing moves by itself."""
        time, x = finite_number(time, "time"), self._positions(x)
        y = self.whole(x)
        return self._rows(lambda c: _speed_of(c, self.gather(c, x, y), time) if c.moving else _rate_of(c, time))

    def acceleration_target(self, x: ArrayLike, v: ArrayLike, time: float = 0.0) -> FloatArray:
        """b with A a = b (notes eqs. 90-92, time terms included), shape (n_rows,)."""
        velocities = self._positions(v, "velocities")

        def wanted(c: Constraint, r: FloatArray, t: float) -> FloatArray:
            v = velocities[c.atoms]
            bent = c.curvature(r, v, t)
            return _rate_of(c, t, 2) - (bent + c.time_terms(r, v, t)[1] if c.moving else bent)

        return self._of_rows(x, time, wanted)

    def tolerance(self, x: ArrayLike, time: float = 0.0) -> FloatArray:
        """What |sigma| can reach in double precision: max(1e-14 scale, 2 eps sum |dq/dx_i| |x_i|), shape (n_rows,)."""
        return np.maximum(1e-14 * self.scale, 2 * np.finfo(float).eps * self._reach(self._positions(x), time))

    def residuals(self, x: FloatArray, v: FloatArray | None = None, time: float = 0.0) -> Residuals:
        """sigma, and A v - c, with what counts as held, in one pass over the constraint objects."""
        x, v = self._positions(x), v if v is None else self._positions(v, "velocities")

        def rows(c: Constraint, r: FloatArray, t: float) -> FloatArray:
            value, gradient = c.value_and_gradient(r, t)
            square = np.einsum("kai,kai->ka", gradient, gradient)
            size, found = np.sqrt(square), np.zeros((6, c.n_rows))
            if c.holonomic:
                found[0] = nearest_image(value - c.target_at(t), c.period)
            found[1] = np.sum(size * norm(x[c.atoms]), axis=1)
            found[4], found[5] = np.sqrt(square.sum(axis=1)), size.sum(axis=1)
            if v is not None:
                u, wanted = v[c.atoms], _speed_of(c, r, t)
                found[2] = np.einsum("kai,kai->k", gradient, u) - wanted
                found[3] = np.abs(wanted) + np.sum(size * norm(u), axis=1)
            return found

        found = self._of_rows(x, time, rows) if self.constraints else np.zeros((6, 0))
        allowed = np.maximum(1e-10 * self.scale, 8 * np.finfo(float).eps * found[1])
        rates, speeds = (None, None) if v is None else found[2:4]
        return Residuals(found[0], allowed, rates, speeds, found[4], found[5])

    # -- pieces ---------------------------------------------------------------------------------

    def subset(self, rows: IntArray) -> tuple[ConstraintSet, IntArray]:
        """The set made of some rows over their own atoms only, and those atoms' numbers in this set.

        So do atoms along which whole rows are made whole. `rows` must be sorted; nothing is checked again.
        """
        rows = np.asarray(rows, dtype=np.int64)
        bounds = np.searchsorted(rows, self.starts)
        pieces = [
            item.select(rows[lo:hi] - start)
            for item, start, lo, hi in zip(self.constraints, self.starts, bounds[:-1], bounds[1:], strict=False)
            if hi > lo
        ]
        atoms, images = np.unique(_atoms_of(pieces)), self.images
        if images is not None:
            wholes = _atoms_of([piece for piece in pieces if piece.whole is not None])
            atoms = np.union1d(atoms, images.ancestors(wholes, self.n_atoms))
            images = images.among(atoms, rows)
        renumbered = [p.changed(atoms=read_only(np.searchsorted(atoms, p.atoms))) for p in pieces]
        part = self._other(len(atoms), self.masses[atoms], renumbered)
        part.images, part.scale = images, self.scale[rows]
        return part, atoms

    def __setstate__(self, own: dict[str, Any]) -> None:
        vars(self).update(own)
        read_only(self.masses)  # a copy can be written to

    def _other(self, n_atoms: int, masses: FloatArray, constraints: Sequence[Constraint]) -> ConstraintSet:
        """A set of other constraints in the same cell, of which nothing is checked."""
        other = object.__new__(ConstraintSet)
        other.n_atoms, other.masses, other.lattice = n_atoms, masses, self.lattice
        other.constraints, other.starts = tuple(constraints), _starts(constraints)
        return other

    def replaced(self, constraints: Sequence[Constraint], positions: FloatArray, time: float) -> ConstraintSet:
        """The same atoms, masses and cell under other constraints; their targets must be set. Nothing is checked."""
        other = self._other(self.n_atoms, self.masses, constraints)
        marked, other.images = find_images(
            constraints, other.starts, positions, self.lattice, self.half_width, time, self.constraints
        )
        other.constraints = tuple(marked)
        other._set_scale(positions, time)
        return other

    def _rows(self, function: Callable[[Constraint], FloatArray]) -> FloatArray:
        return joined([function(c) for c in self.constraints])

    def _of_rows(
        self, x: ArrayLike, time: float, function: Callable[[Constraint, FloatArray, float], FloatArray]
    ) -> FloatArray:
        """A function of each constraint, the positions of its atoms and the time, for all rows."""
        time, positions = finite_number(time, "time"), self._positions(x)
        whole = self.whole(positions)
        return self._rows(lambda c: function(c, self.gather(c, positions, whole), time))

    def _positions(self, x: ArrayLike, item: str = "positions") -> FloatArray:
        array = as_float_array(x, item)  # not `as_array`, which copies the read-only positions of a State
        if array.shape != (self.n_atoms, 3):
            raise InputError(f"{item} must have shape ({self.n_atoms}, 3), not {array.shape}", item=item)
        return array

    # -- the cell -------------------------------------------------------------------------------

    def _set_cell(self, cell: ArrayLike | None, pbc: bool | Sequence[bool]) -> None:
        self.lattice: FloatArray | None = None
        if cell is None:
            return
        matrix = as_float_array(cell, "cell")
        if matrix.shape == (3,):
            matrix = np.diag(matrix)
        if matrix.shape != (3, 3) or not np.all(np.isfinite(matrix)):
            raise InputError(f"cell must be finite, of shape (3, 3) or (3,); it has {matrix.shape}", item="cell")
        if np.shape(pbc) not in ((), (3,)):
            raise InputError(f"pbc is {pbc!r:.60}; give True, False, or one for each lattice vector", item="pbc")
        self.lattice = lattice_of(matrix, pbc)

    def with_cell(
        self, cell: ArrayLike | None, pbc: bool | Sequence[bool] = True, positions: FloatArray | None = None
    ) -> None:
        """Change the cell in place (barostats); targets are unchanged, and so is everything where this is refused.

        Raises
        ------
        InputError
            A degenerate cell; a first cell, or a new periodic direction, for rows that have to be sorted by their
            images, which needs positions; a change by more than a tenth for atoms that nothing ties together; a
            constant distance that was shorter than half the box and is so no longer.
        ImageError
            Atoms that nothing ties together are half the box apart at `positions`, or have other images than before.
        """
        before = self.lattice
        self._set_cell(cell, pbc)
        try:
            self._check_cell(before)
            if positions is not None and self.lattice is not None:
                self.refuse_unheld_links(self.whole(positions))
                if before is not None:
                    self.refuse_other_images(positions, before)
        except KconsError:
            self.lattice = before
            raise

    def _check_cell(self, before: FloatArray | None) -> None:
        if self.lattice is None:
            return
        if any(c.relative and (c.moving or not c.holds_length) for c in self.constraints):
            periodic = self.lattice[1].any(axis=0)
            if before is None or np.any(periodic & ~before[1].any(axis=0)):
                raise InputError(
                    "this set was made without this periodic direction, and which images its rows mean has to be found "
                    "anew; make a new ConstraintSet with the cell",
                    item="cell",
                )
            if self.images is not None and np.any(self.images.unheld >= 0):
                change = norm(self.lattice[0] - before[0]) / norm(before[0])
                change = change[periodic]  # the vector of a direction without periodicity is arbitrary
                if np.any(change > MOST_STRAIN):
                    raise InputError(
                        f"the cell changes by {change.max():.0%} at once, more than a tenth: which images rows mean "
                        "among atoms that nothing ties together cannot be followed; make a new ConstraintSet with the "
                        "cell",
                        item="cell",
                    )
        (longest, row), half = self._longest_plain, self.half_width
        tied = 0.0 if self.images is None else self.images.longest
        if max(longest, tied) >= half:
            what, item = f"a distance of {tied:g} that ties atoms", "cell"
            if longest >= half:
                what, item = f"row {self.row_name(row)}: target {longest:g}", "target"
            raise InputError(
                f"{what} is not shorter than half the box ({half:g}), and its minimum image is ambiguous; use a larger "
                "cell, or make a new ConstraintSet in this one",
                item=item,
            )

    @property
    def half_width(self) -> float:
        """Half the smallest perpendicular width of the periodic cell; infinite without one."""
        return np.inf if self.lattice is None else 0.5 / float(np.linalg.norm(self.lattice[1], axis=0).max())

    def refuse_unheld_links(self, whole: FloatArray, numbers: IntArray | None = None) -> None:
        """Raise `ImageError` where atoms of a row, made whole, are half the cell apart and nothing ties them.

        `numbers` are the names of the atoms in messages, if not their own numbers.
        """
        if self.images is None or self.lattice is None:
            return
        links = np.flatnonzero(self.images.unheld >= 0)
        if not len(links):
            return
        pairs = np.stack([self.images.parents[links], self.images.atoms[links]])
        reached = np.abs((whole[pairs[1]] - whole[pairs[0]]) @ self.lattice[1]).max(axis=1)
        worst = int(np.argmax(reached))
        if reached[worst] >= _HALF:
            raise self._image_error(int(self.images.unheld[links[worst]]), pairs[:, worst], numbers)

    def _image_error(self, row: int, pair: IntArray, numbers: IntArray | None) -> ImageError:
        """The error for two atoms of a row that have drifted half the cell apart."""
        atoms = pair if numbers is None else numbers[pair]
        return ImageError(
            f"row {self.row_name(row)}: atoms {atoms[0]} and {atoms[1]}, which nothing ties together, are half the "
            f"cell apart ({self.half_width:g} in its narrowest direction); further on the row would mean other "
            "periodic images. Use a larger cell, make the ConstraintSet without a cell and keep positions unwrapped, "
            "or hold what ties these atoms together",
            atoms=atoms,
        )

    def refuse_other_images(self, x: FloatArray, before: FloatArray, numbers: IntArray | None = None) -> None:
        """Raise `ImageError` where a changed cell gives atoms that nothing ties together other images than before.

        Positions may have been moved along with the cell, and molecules as a whole: other images are right if with them
        the rows are fulfilled, or much nearer to that. At which time is not known: moving rows are not.
        """
        if self.images is None or self.lattice is None:
            return
        y, then = self.whole(x), np.round((self.images.make_whole(x, before) - x) @ before[1])
        changes = then - np.round((y - x) @ self.lattice[1])
        if not changes.any():
            return
        for item, start in zip(self.constraints, self.starts, strict=False):
            others = (changes[item.atoms] != changes[item.atoms[:, :1]]).any(axis=2)
            bad = others.any(axis=1) & item.relative
            if bad.any() and not item.moving:
                as_before, size = x + then @ self.lattice[0], self.scale[start : start + item.n_rows]
                here, there = (np.abs(item.sigma(self.gather(item, x, z), 0.0)) / size for z in (y, as_before))
                bad &= here > np.maximum(1e-9, 0.5 * there)
            if bad.any():
                k = int(np.argmax(bad))
                raise self._image_error(int(start) + k, item.atoms[k, [0, int(np.argmax(others[k]))]], numbers)

    @cached_property
    def _longest_plain(self) -> tuple[float, int]:
        """Longest constant distance that was shorter than half the box at set-up, and its row."""

        def lengths(c: Constraint) -> FloatArray:
            if not c.holds_length or c.moving:
                return np.zeros(c.n_rows)
            return c.target_at(0.0) if c.whole is None else np.where(c.whole, 0.0, c.target_at(0.0))

        length = self._rows(lengths)
        return float(length.max(initial=0.0)), int(np.argmax(length)) if len(length) else 0

    def whole(self, x: FloatArray) -> FloatArray:
        """Positions in which atoms of whole rows stand in the images that these rows mean; see `periodic.images`.

        `x` itself where all rows are plain.
        """
        return x if self.lattice is None or self.images is None else self.images.make_whole(x, self.lattice)

    @cached_property
    def placed(self) -> IntArray | None:
        """Atoms of `images` at which rows with a place in space look, but for `FixedAtoms`; None if there are none."""
        rows = [c for c in self.constraints if not c.relative and not c.fixes_atoms]
        found = np.intersect1d(_atoms_of(()) if self.images is None else self.images.atoms, _atoms_of(rows))
        return found if len(found) else None

    def moved_places(self, stored: FloatArray, x: FloatArray) -> FloatArray | None:
        """`moved` for positions `x`, where those of the atoms `placed` were `stored`; None if these did not move."""
        cells = x[self.placed] - stored
        if not cells.any():
            return None
        moved = np.zeros(x.shape)
        moved[self.placed] = cells
        return moved

    def gather(self, item: Constraint, x: FloatArray, whole: FloatArray | None = None) -> FloatArray:
        """Positions of a constraint's atoms, shape (n_rows, width, 3), in the images that its rows mean.

        `whole` are those of `x` by the method of this name, where they are known.
        """
        if not item.relative:
            # A place in space is that of the positions as they are stored.
            return x[item.atoms] if self.moved is None else x[item.atoms] - self.moved[item.atoms]
        r = (self.whole(x) if whole is None else whole)[item.atoms]
        if self.lattice is None:
            return r
        if item.whole is None:
            return lined_up(r, self.lattice)
        plain = ~item.whole
        if plain.any():
            r[plain] = lined_up(r[plain], self.lattice)
        if item.cell_offsets is not None:
            r[item.whole] += item.cell_offsets[item.whole] @ self.lattice[0]
        return r

    def _refuse_cut(self, item: Constraint, r: FloatArray, time: float, start: int) -> None:
        """Refuse rows whose atoms lie in other images than the nearest, and nobody has said that images do not count.

        Such rows depend on differences of positions only, as their gradients tell here and in the nearest images, and
        have another value there.
        """
        if self.lattice is None or item.relative or item.width == 1 or not item.holonomic:
            return
        cut = np.round(np.diff(r, axis=1) @ self.lattice[1]).any(axis=(1, 2))
        if not cut.any():
            return
        near = lined_up(r.copy(), self.lattice)
        for place in (r, near):
            slope = item.gradient(place, time)
            cut &= norm(slope.sum(axis=1)) <= CANCELS * norm(slope).sum(axis=1)
        apart = nearest_image(item.measure(near, time) - item.measure(r, time), item.period)
        reach = norm(slope).sum(axis=1) * norm(near - near[:, :1]).max(axis=1)
        item.refuse(
            cut & (np.abs(apart) > CANCELS * reach),
            start,
            lambda k: (
                f"its atoms are cut by a face of the cell, and where they lie the value differs by {apart[k]:.3g} from "
                "that of the nearest images; pass translation_invariant=True, or put the atoms next to each other"
            ),
            "translation_invariant",
        )

    def __len__(self) -> int:
        return self.n_rows

    def __repr__(self) -> str:
        return f"<ConstraintSet: {self.n_rows} rows on {self.n_atoms} atoms>"


def _starts(constraints: Sequence[Constraint]) -> IntArray:
    return np.cumsum([0, *(c.n_rows for c in constraints)], dtype=np.int64)


def joined(pieces: Sequence[FloatArray]) -> FloatArray:
    """Rows of all pieces, which are the last axis."""
    return np.concatenate(pieces, axis=-1) if pieces else np.zeros(0)


def whole_bodies(constraints: Sequence[Constraint], x: FloatArray, lattice: FloatArray | None) -> FloatArray:
    """Positions in which what open plain rows tie together is not cut by the boundary; `x` itself where nothing is.

    `x` has the atoms of whole rows in the images that these mean. Each atom is rounded once, so that lengths and angles
    of one body fit each other to rounding wherever its atoms are stored.
    """
    pairs = [
        np.stack([atoms[:, :-1], atoms[:, 1:]], axis=-1).reshape(-1, 2)
        for c in constraints
        for atoms in [c.atoms if c.whole is None else c.atoms[~c.whole]]
        if c.relative and c.target is None
    ]
    if lattice is None or not pairs:
        return x
    links = np.concatenate(pairs)
    if not np.round((x[links[:, 1]] - x[links[:, 0]]) @ lattice[1]).any():
        return x
    return make_whole(x, *spanning_tree(links, len(x)), lattice)


def _atoms_of(constraints: Iterable[Constraint]) -> IntArray:
    """Atoms of all rows, one row after the other."""
    return np.concatenate([np.zeros(0, np.int64), *(c.atoms.ravel() for c in constraints)])


def _check_atoms(given: Sequence[Constraint], starts: IntArray, x: FloatArray, m: FloatArray) -> None:
    """Raise `InputError` where rows name atoms that do not exist, have no place, or no mass."""
    held = np.zeros(len(x), dtype=bool)
    for item, start in zip(given, starts, strict=False):

        def unknown(k: int, item: Constraint = item) -> str:
            return f"there is no atom {item.atoms[k].max()}; the system has atoms 0 to {len(x) - 1}"

        item.refuse(np.asarray((item.atoms >= len(x)).any(axis=1)), int(start), unknown, "atoms")
        if item.fixes_atoms:
            held[item.atoms] = True
    used = _atoms_of(given)
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


def _rate_of(c: Constraint, time: float, order: int = 1) -> FloatArray:
    """Rate of what rows are held at, or its acceleration; of velocity rows what they are held at, or its rate."""
    if not c.holonomic and order == 1:
        return c.target_at(time)
    if not isinstance(c.target, MovingTarget):
        return np.zeros(c.n_rows)
    rate = c.target.acceleration_at if c.holonomic and order == 2 else c.target.rate_at
    return rate(time, c.n_rows, c.period)


def _speed_of(c: Constraint, r: FloatArray, time: float) -> FloatArray:
    """A v of admissible velocities."""
    rate = _rate_of(c, time)
    return rate - c.time_terms(r, np.zeros_like(r), time)[0] if c.moving and c.holonomic else rate


def rows_like(held: ConstraintSet, wanted: Constraint, name: str) -> list[int]:
    """The rows of the set that `wanted` names, whatever they are held at; `name` is what errors call it."""
    if not wanted.holonomic:
        raise InputError(
            f"{name} is the velocity constraint {wanted!r}, which holds no coordinate; name a position constraint",
            item=name,
        )
    found = []
    for k in range(wanted.n_rows):
        same = [same_rows(item, wanted, k) for item in held.constraints]
        rows = np.flatnonzero(np.concatenate([np.zeros(0, bool), *same]))
        found.extend(rows[:1].tolist())
        if not len(rows):
            raise InputError(
                f"{name}, {wanted.row_name(k)}, is not among the {held.n_rows} rows that are held; hold it, or name a "
                "constraint that is",
                item=name,
                atoms=wanted.atoms[k],
            )
    return found


def same_rows(item: Constraint, wanted: Constraint, k: int) -> NDArray[np.bool_]:
    """Which rows of `item` are row k of `wanted`, whatever they are held at, shape (n_rows,)."""
    if (
        (item.family, item.width) != (wanted.family, wanted.width)
        or any(getattr(item, f, None) is not getattr(wanted, f, None) for f in wanted.functions)
        or any(getattr(item, name) != getattr(wanted, name) for name in wanted.shared)
    ):
        return np.zeros(item.n_rows, dtype=bool)
    same = np.all(item.atoms == wanted.atoms[k], axis=1)
    if wanted.reversible:
        same |= np.all(item.atoms == wanted.atoms[k, ::-1], axis=1)
    for data in item.per_row:
        ours, theirs = getattr(item, data), getattr(wanted, data)[k]
        same &= np.all(ours == theirs, axis=tuple(range(1, ours.ndim)))
    return same


# -- targets that exclude each other ----------------------------------------------------------------


def agreed_targets(
    items: Sequence[Constraint], found: Sequence[bool], starts: IntArray, time: float
) -> list[Constraint]:
    """The items, which have targets, where one found from positions is the one given of the same row.

    They differ by the rounding of positions, by which both could not be held. `found` says it of each item, `starts`
    are their first rows. Refused are the same distance, angle or dihedral held at two values, and distances that
    violate the triangle inequality (0.1 s for 10^5 of them).
    """
    result = list(items)
    for family in {type(item): None for item in items if item.reversible and item.n_rows}:
        numbers = [n for n, item in enumerate(items) if type(item) is family]
        chosen = [items[n] for n in numbers]
        # A row and its reverse (j, i), (k, j, i), (l, k, j, i) name the same coordinate.
        atoms = np.concatenate([item.atoms for item in chosen])
        atoms = np.where((atoms[:, :1] > atoms[:, -1:]), atoms[:, ::-1], atoms)
        rows = np.concatenate([starts[n] + np.arange(items[n].n_rows) for n in numbers])
        target = np.concatenate([item.target_at(time) for item in chosen])
        open_ = np.repeat([found[n] for n in numbers], [item.n_rows for item in chosen])
        order = np.lexsort((open_, *atoms.T[::-1]))
        atoms, rows, target, open_ = atoms[order], rows[order], target[order], open_[order]
        _refuse_two_targets(atoms, rows, target, chosen[0].period)
        first = np.flatnonzero(np.concatenate([[True], (atoms[1:] != atoms[:-1]).any(axis=1)]))
        if chosen[0].holds_length:
            _refuse_impossible_triangles(atoms[first], rows[first], target[first])
        if open_.any() and not open_.all():
            agreed = np.where(open_, np.repeat(target[first], np.diff(np.append(first, len(atoms)))), target)
            back = np.empty_like(agreed)
            back[order] = agreed
            for n, part in zip(numbers, np.split(back, np.cumsum([item.n_rows for item in chosen])), strict=False):
                result[n] = items[n].with_target(part) if found[n] else items[n]
    return result


def _refuse_two_targets(atoms: IntArray, rows: IntArray, target: FloatArray, period: float | None) -> None:
    repeated = np.flatnonzero((atoms[1:] == atoms[:-1]).all(axis=1))
    difference = nearest_image(target[repeated + 1] - target[repeated], period)
    bad = np.abs(difference) > _SAME * np.maximum(np.abs(target[repeated]), np.abs(target[repeated + 1]))
    if bad.any():
        k = int(repeated[np.argmax(bad)])
        (one, first), (other, second) = sorted((int(rows[n]), float(target[n])) for n in (k, k + 1))
        raise ContradictionError(
            f"constraints #{one} and #{other} on atoms {tuple(atoms[k].tolist())} have different targets {first!r}, "
            f"{second!r}; remove one of them",
            rows=[one, other],
            atoms=atoms[k].tolist(),
        )


def _refuse_impossible_triangles(pairs: IntArray, rows: IntArray, length: FloatArray) -> None:
    """Triangle inequality over all triangles of held distances; `pairs` sorted, each once, smaller atom first.

    The least sum of squared deviations of a triangle with the excess e = d_3 - d_1 - d_2 is e^2/3: each
    side takes a third of the excess.
    """
    if len(pairs) < 3:
        return
    atoms, ends = np.unique(pairs, return_inverse=True)
    i, j = ends.reshape(pairs.shape).T
    side = np.arange(1.0, len(pairs) + 1)
    sides = sp.coo_array((side, (i, j)), shape=(len(atoms), len(atoms))).tocsr()
    sides = sides + sides.T
    linked = sides.astype(bool).astype(np.float64)
    # Where both ends of a distance are linked to a third atom: the two other sides.
    one, two = sides[i].multiply(linked[j]).tocoo(), linked[i].multiply(sides[j]).tocoo()
    members = np.stack([one.row, one.data.astype(int) - 1, two.data.astype(int) - 1], axis=1)
    d = length[members]
    excess = d[:, 0] - d[:, 1] - d[:, 2]
    bad = excess > _SAME * d[:, 0]
    if bad.any():
        t = int(np.argmax(bad))
        best = float(excess[t]) ** 2 / 3
        named = np.unique(pairs[members[t]]).tolist()
        held = ", ".join(f"#{row} = {value:g}" for row, value in sorted(zip(rows[members[t]], d[t], strict=True)))
        raise InfeasibleError(
            f"infeasible: residual cannot go below {best:.6g} (sum of squares); the distances of atoms "
            f"{tuple(named)} ({held}) violate the triangle inequality by {excess[t]:.6g}. "
            "Correct the longest or remove it",
            residual=best,
            row=int(rows[members[t, 0]]),
            atoms=named,
        )
