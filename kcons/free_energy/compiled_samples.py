"""A sample in one compiled call, where all that is held in its clusters are distances, angles and torsions.

The same formulas as in `held_coordinates`, densely: for the few rows of one molecule. Whatever is unusual (rows that
depend on each other, numbers that are not finite) is left to `held_coordinates`, which finds out what it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kcons.constraints import Angle, Dihedral, Distance, MovingTarget
from kcons.constraints.compilation import njit
from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.periodic.in_cell import joined
from kcons.constraints.target import FloatArray
from kcons.solvers.kernels.nearest_image import NO_LATTICE, nearest_image
from kcons.solvers.sparse.row_functions import dihedral
from kcons.solvers.sparse.row_values import angle

#: Rows from which on matrices that are dense cost more than they save.
MOST_ROWS = 60
#: Of a pivot and of det Z by their largest values: below, rows may depend on each other.
_DEPENDENT = 1e-6


class CompiledSamples:
    """What the kernel is given of the rows.

    Parameters
    ----------
    own, others : ConstraintSet
        The coordinates, and what is held beside them, both of rows for which `compilable` is True.
    own_order : ndarray of int, shape (d,)
        Rows of `own` in the order of the results.
    own_atoms, other_atoms : ndarray of int
        The atoms of both sets among `atoms`.
    atoms : ndarray of int, shape (n,)
        Among all atoms.
    inverse_masses : ndarray, shape (n,)
    periods : ndarray, shape (d,)
        0 for coordinates without a period.
    """

    def __init__(
        self,
        own: ConstraintSet,
        others: ConstraintSet,
        own_order: IntArray,
        own_atoms: IntArray,
        other_atoms: IntArray,
        atoms: IntArray,
        inverse_masses: FloatArray,
        periods: FloatArray,
    ) -> None:
        self._d = len(own_order)
        tables = [_table(own, own_atoms)[own_order], _table(others, other_atoms)]
        self._table = np.concatenate(tables)
        self._atoms, self._inverse_masses = atoms, inverse_masses
        self._sets, self._order = (own, others), own_order
        self._moving = own.moving or others.moving
        # Of each row the target, the period, and the second derivative of the target.
        self._numbers = np.zeros((len(self._table), 3))
        self._numbers[: self._d, 1] = periods
        if not self._moving:
            self._numbers[: self._d, 0] = own.target()[own_order]

    def sample(self, state: Sequence[FloatArray], time: float, lattice: FloatArray | None) -> FloatArray | None:
        """Value, multiplier, kinetic part, gradient, |sigma|, ln det Z and mean kinetic part, shape (7, d).

        Parameters
        ----------
        state : sequence of ndarray, shape (n_atoms, 3)
            Positions, velocities, forces.
        time : float
        lattice : ndarray, shape (2, 3, 3), optional
            Cell and inverse.

        Returns
        -------
        ndarray or None
            None where rows depend on each other, or something is not finite.
        """
        out = np.empty((7, self._d))
        if self._moving:
            self._numbers[: self._d, 0] = self._sets[0].target(time)[self._order]
            self._numbers[:, 2] = self._accelerations(time)
        rows = (self._atoms, self._inverse_masses, self._table, self._numbers)
        cell = NO_LATTICE if lattice is None else lattice
        x, v, f = state
        if not _sample(x, v, f, *rows, cell, lattice is not None, out):
            return None
        if self._moving:
            out[6] = np.nan  # velocities have a mean of their own
        return out

    def _accelerations(self, time: float) -> FloatArray:
        """Second derivatives of the targets, shape (n_rows,)."""
        own, others = (joined([_second(c, time) for c in rows.constraints]) for rows in self._sets)
        return np.concatenate([own[self._order], others])


def compilable(held: ConstraintSet) -> bool:
    """Whether the kernel knows all rows of a set."""
    known = all(isinstance(item, Distance | Angle | Dihedral) for item in held.constraints)
    return known and held.images is None and held.n_rows <= MOST_ROWS


def _second(item: Constraint, time: float) -> FloatArray:
    if isinstance(item.target, MovingTarget):
        return item.target.acceleration_at(time, item.n_rows, item.period)
    return np.zeros(item.n_rows)


def _table(held: ConstraintSet, atoms: IntArray) -> IntArray:
    """Of each row the number of atoms, and the atoms, shape (n_rows, 5)."""
    table = np.zeros((held.n_rows, 5), np.int64)
    for first, item in zip(held.starts, held.constraints, strict=False):
        rows = slice(first, first + item.n_rows)
        table[rows, 0] = item.width
        table[rows, 1 : 1 + item.width] = atoms[item.atoms]
    return table


# -- vectors ------------------------------------------------------------------------------------------------


@njit(cache=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _cross(a, b):  # type: ignore[no-untyped-def]
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@njit(cache=True)
def _mixed(p, a, q, b):  # type: ignore[no-untyped-def]
    """p a + q b."""
    return (p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2])


@njit(cache=True)
def _between(x, i, j, lattice, periodic):  # type: ignore[no-untyped-def]
    a, b, c = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
    if periodic:
        a, b, c = nearest_image(a, b, c, lattice)
    return (a, b, c)


@njit(cache=True)
def _legs(x, row, lattice, periodic):  # type: ignore[no-untyped-def]
    """The differences of atoms that a row depends on: one, two or three."""
    first = _between(x, row[1], row[2], lattice, periodic)
    if row[0] == 2:
        return first, first, first
    if row[0] == 3:
        return first, _between(x, row[3], row[2], lattice, periodic), first
    return first, _between(x, row[2], row[3], lattice, periodic), _between(x, row[4], row[3], lattice, periodic)


# -- rows ---------------------------------------------------------------------------------------------------


_torsion = njit(cache=True, error_model="numpy")(dihedral)


@njit(cache=True, error_model="numpy")
def _slopes(width, F, G, H, out):  # type: ignore[no-untyped-def]
    """The value of a row; its gradient by each atom is put into `out`, shape (4, 3)."""
    if width == 2:
        q = np.sqrt(_dot(F, F))
        a = _mixed(1.0 / q, F, 0.0, F)
        b, c, e = _mixed(-1.0, a, 0.0, a), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    elif width == 3:
        q, a, c = angle(F, G)
        b, e = _mixed(-1.0, a, -1.0, c), (0.0, 0.0, 0.0)
    else:
        r, seen = np.zeros(12), np.empty(13)
        for i in range(3):
            r[i], r[3 + i], r[9 + i] = F[i] + G[i], G[i], H[i]
        _torsion(r, r, 0.0, seen)
        q = seen[0]
        a, b = (seen[1], seen[2], seen[3]), (seen[4], seen[5], seen[6])
        c, e = (seen[7], seen[8], seen[9]), (seen[10], seen[11], seen[12])
    for i in range(3):
        out[0, i], out[1, i], out[2, i], out[3, i] = a[i], b[i], c[i], e[i]
    return q


@njit(cache=True, error_model="numpy")
def _curvature(width, F, G, H, dF, dG, dH):  # type: ignore[no-untyped-def]
    """The second derivative of a row along a motion at constant velocities, as in `kcons.constraints.internal`."""
    if width == 2:
        across = _cross(F, dF)
        return _dot(across, across) / _dot(F, F) ** 1.5
    if width == 3:
        normal, ff, gg = _cross(F, G), _dot(F, F), _dot(G, G)
        area, sizes = np.sqrt(_dot(normal, normal)), np.sqrt(ff * gg)
        n = _mixed(1.0 / area, normal, 0.0, normal)
        a, b = _dot(_cross(F, n), dF) / ff, _dot(_cross(n, G), dG) / gg
        alpha, beta = _dot(n, dF) / np.sqrt(ff), _dot(n, dG) / np.sqrt(gg)
        turned = (alpha * alpha + beta * beta) * _dot(F, G) / sizes - 2.0 * alpha * beta
        return turned * sizes / area - 2.0 * (a * _dot(F, dF) / ff + b * _dot(G, dG) / gg)
    g = np.sqrt(_dot(G, G))
    dg = _dot(G, dG) / g
    total = 0.0
    for k in range(2):
        L, dL = (F, dF) if k == 0 else (H, dH)
        P = _cross(L, G)
        dP = _mixed(1.0, _cross(dL, G), 1.0, _cross(L, dG))
        square = _dot(P, P)
        p = _mixed(1.0 / square, P, 0.0, P)
        dp = _mixed(1.0 / square, dP, -2.0 * _dot(P, dP) / square, p)
        h = _dot(L, G) / g
        dh = (_dot(dL, G) + _dot(L, dG) - h * dg) / g
        part = dh * _dot(p, dG) + h * _dot(dp, dG) - dg * _dot(p, dL) - g * _dot(dp, dL)
        total += part if k == 0 else -part
    return total


# -- matrices -----------------------------------------------------------------------------------------------


@njit(cache=True, error_model="numpy")
def _factor(a):  # type: ignore[no-untyped-def]
    """The root L of a = L L^T in its lower half; the smallest pivot by its diagonal element."""
    least = 1.0
    for i in range(len(a)):
        whole = a[i, i]
        for j in range(i + 1):
            left = a[i, j]
            for k in range(j):
                left -= a[i, k] * a[j, k]
            a[i, j] = left / a[j, j] if j < i else np.sqrt(left)
        share = a[i, i] ** 2 / whole
        if not share > _DEPENDENT:
            return 0.0
        least = min(least, share)
    return least


@njit(cache=True, error_model="numpy")
def _solve(root, b):  # type: ignore[no-untyped-def]
    """The solution of L L^T y = b, in place."""
    n = len(b)
    for i in range(n):
        for k in range(i):
            b[i] -= root[i, k] * b[k]
        b[i] /= root[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= root[k, i] * b[k]
        b[i] /= root[i, i]


@njit(cache=True, error_model="numpy")
def _products(table, slopes, inverse_masses):  # type: ignore[no-untyped-def]
    """A M^-1 A^T of all rows."""
    n = len(table)
    result, spread = np.empty((n, n)), np.zeros((len(inverse_masses), 3))
    for i in range(n):
        for k in range(table[i, 0]):
            atom = table[i, 1 + k]
            for c in range(3):
                spread[atom, c] = slopes[i, k, c] * inverse_masses[atom]
        for j in range(i + 1):
            total = 0.0
            for k in range(table[j, 0]):
                atom = table[j, 1 + k]
                for c in range(3):
                    total += slopes[j, k, c] * spread[atom, c]
            result[i, j] = result[j, i] = total
        for k in range(table[i, 0]):
            spread[table[i, 1 + k]] = 0.0
    return result


@njit(cache=True, error_model="numpy")
def _bent(table, legs, shares, u, lattice, factor, out):  # type: ignore[no-untyped-def]
    """Add a factor times u^T q'' u of the coordinates, on the surface of the other rows, to `out`, shape (d,)."""
    for row in range(len(table)):
        dF, dG, dH = _legs(u, table[row], lattice, False)
        F, G, H = legs[row, 0], legs[row, 1], legs[row, 2]
        there = _curvature(table[row, 0], (F[0], F[1], F[2]), (G[0], G[1], G[2]), (H[0], H[1], H[2]), dF, dG, dH)
        for i in range(len(out)):
            out[i] += factor * shares[i, row] * there


@njit(cache=True, error_model="numpy")
def _on_the_others(product, shares, z):  # type: ignore[no-untyped-def]
    """How all rows answer each coordinate, shape (d, rows), and Z from A M^-1 A^T; False where rows depend."""
    d, rows = shares.shape
    root = product[d:, d:].copy()
    if rows > d and not _factor(root) > 0:
        return False
    answer = np.empty(rows - d)
    for i in range(d):
        for k in range(rows - d):
            answer[k] = -product[i, d + k]
        _solve(root, answer)
        for j in range(d):
            shares[i, j] = 1.0 if i == j else 0.0
            z[i, j] = product[i, j]
            for k in range(rows - d):
                z[i, j] += answer[k] * product[j, d + k]
        for k in range(rows - d):
            shares[i, d + k] = answer[k]
    return True


@njit(cache=True, error_model="numpy")
def _changes_of_z(table, legs, shares, directions, lattice, out):  # type: ignore[no-untyped-def]
    """Half the derivative of ln det Z along each direction: sum_j d_j^T q_j'' d_s, polarised."""
    d, n = len(shares), directions.shape[1]
    there, mixed = np.zeros(d), np.empty((n, 3))
    for s in range(d):
        there[:] = 0.0
        _bent(table, legs, shares, directions[s], lattice, 1.0, there)
        out[s] = there[s]
    for s in range(d):
        for j in range(s):
            there[:] = 0.0
            for sign in (1.0, -1.0):
                for a in range(n):
                    for c in range(3):
                        mixed[a, c] = directions[s, a, c] + sign * directions[j, a, c]
                _bent(table, legs, shares, mixed, lattice, 0.25 * sign, there)
            out[s] += there[j]
            out[j] += there[s]


@njit(cache=True, error_model="numpy")
def _mean_kinetic(table, legs, slopes, shares, product, inverse_masses, lattice, out):  # type: ignore[no-untyped-def]
    """Add the mean of -v^T q'' v over velocities with <v v^T> = M_par^+ of all rows; False where these depend.

    M_par^+ is M^-1 less the squares of fields that span M^-1 A^T, orthonormal in the metric of the masses.
    """
    rows, n = len(table), len(inverse_masses)
    if not _factor(product) > 0:
        return False
    fields = np.zeros((rows, n, 3))
    for row in range(rows):
        for k in range(table[row, 0]):
            atom = table[row, 1 + k]
            for c in range(3):
                fields[row, atom, c] += slopes[row, k, c] * inverse_masses[atom]
        for j in range(row):
            for a in range(n):
                for c in range(3):
                    fields[row, a, c] -= product[row, j] * fields[j, a, c]
        for a in range(n):
            for c in range(3):
                fields[row, a, c] /= product[row, row]
        _bent(table, legs, shares, fields[row], lattice, 1.0, out)
    unit = np.zeros((n, 3))
    for a in range(n):
        for c in range(3):
            unit[a, c] = 1.0
            _bent(table, legs, shares, unit, lattice, -inverse_masses[a], out)
            unit[a, c] = 0.0
    return True


@njit(cache=True, error_model="numpy")
def _sample(x, v, f, atoms, inverse_masses, table, numbers, lattice, periodic, out):  # type: ignore[no-untyped-def]
    d, n, rows = out.shape[1], len(atoms), len(table)
    near, speed = np.empty((n, 3)), np.empty((n, 3))
    for a in range(n):
        for c in range(3):
            near[a, c], speed[a, c] = x[atoms[a], c], v[atoms[a], c]
    legs, slopes = np.empty((rows, 3, 3)), np.empty((rows, 4, 3))
    for row in range(rows):
        F, G, H = _legs(near, table[row], lattice, periodic)
        value = _slopes(table[row, 0], F, G, H, slopes[row])
        if row < d:
            off, period = value - numbers[row, 0], numbers[row, 1]
            if period > 0:
                off -= period * np.rint(off / period)
            out[0, row], out[4, row] = value, abs(off)
        for c in range(3):
            legs[row, 0, c], legs[row, 1, c], legs[row, 2, c] = F[c], G[c], H[c]
    product = _products(table, slopes, inverse_masses)
    shares, z = np.empty((d, rows)), np.empty((d, d))
    if not _on_the_others(product, shares, z):
        return False
    if not _factor(z) > 0:
        return False
    share, log_det_z = 1.0, 0.0
    for i in range(d):
        share *= z[i, i] ** 2 / product[i, i]
        log_det_z += 2.0 * np.log(z[i, i])
    if not share > _DEPENDENT:
        return False
    # M_par^+ times the gradients, and what forces, velocities and targets want of the coordinates.
    kept, still, kinetic = np.zeros((d, n, 3)), np.zeros(d), np.zeros(d)
    for i in range(d):
        for row in range(rows):
            still[i] += shares[i, row] * numbers[row, 2]
            for k in range(table[row, 0]):
                atom = table[row, 1 + k]
                for c in range(3):
                    kept[i, atom, c] += shares[i, row] * slopes[row, k, c] * inverse_masses[atom]
        for a in range(n):
            for c in range(3):
                still[i] -= kept[i, a, c] * f[atoms[a], c]
    _bent(table, legs, shares, speed, lattice, -1.0, kinetic)
    _solve(z, still)
    _solve(z, kinetic)
    directions, unit = np.zeros((d, n, 3)), np.empty(d)
    for s in range(d):
        unit[:] = 0.0
        unit[s] = 1.0
        _solve(z, unit)
        for i in range(d):
            for a in range(n):
                for c in range(3):
                    directions[s, a, c] += unit[i] * kept[i, a, c]
    _changes_of_z(table, legs, shares, directions, lattice, out[3])
    expected = np.zeros(d)
    if not _mean_kinetic(table, legs, slopes, shares, product, inverse_masses, lattice, expected):
        return False
    _solve(z, expected)
    total = log_det_z
    for i in range(d):
        out[1, i], out[2, i], out[5, i] = still[i] + kinetic[i], kinetic[i], log_det_z
        out[6, i] = expected[i]
        total += out[1, i] + out[2, i] + out[3, i] + out[6, i]
    return np.isfinite(total)
