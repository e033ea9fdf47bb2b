"""Dense mechanics of rows on whole molecules: what the engine is judged by in periodic cells.

Nothing here comes from the package but the fractions of a step, and nothing knows of minimum images: positions are
those of whole molecules, and a row that leads through the boundary says by which lattice vectors. Every row is a
function of a few vectors that are linear in the positions. Projections are least squares on the singular vectors of
B = A M^-1/2, so that rows may depend on each other; fixed atoms have infinite mass.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from kcons import steppers
from kcons.comparison.projected_equation import ProjectedEquation

Array = np.ndarray
EPS = float(np.finfo(float).eps)
#: Singular values of the row-normalized B below this many times the largest are zero; `World` leaves a gap around it.
RANK = 1e-8
#: A correction longer than this, in units of the molecules' bonds, is no solution near the start.
FAR = 20.0
#: Which vectors a kind of row is made of, and whether it turns through a full circle.
VECTORS = {"norm": 1, "angle": 2, "dihedral": 3, "linear": 0, "gyration": 1}


class NoSolution(Exception):
    """Newton's method found nothing."""


@dataclass
class Row:
    """One row: q(x) = target + amplitude (sin(rate t + phase) - sin(phase)).

    Kinds: 'norm' |d|, 'angle' between d_1 and d_2, 'dihedral' of d_1, d_2, d_3, 'linear' sum c . x, 'gyration'. Each
    vector is {atom: weight}, with `images` lattice vectors besides; of a 'norm', `place` is subtracted.
    """

    kind: str
    vectors: list[dict[int, float]] = field(default_factory=list)
    images: list[tuple[int, int, int]] = field(default_factory=list)
    coefficients: dict[int, Array] = field(default_factory=dict)
    place: Array | None = None
    target: float = 0.0
    amplitude: float = 0.0
    omega: float = 0.0
    phase: float = 0.0

    def renumbered(self, new: Array) -> Row:
        """The same row where atom a is called new[a]."""
        vectors = [{int(new[a]): w for a, w in v.items()} for v in self.vectors]
        return replace(self, vectors=vectors, coefficients={int(new[a]): c for a, c in self.coefficients.items()})


def wave(amplitude: Array, omega: Array, phase: Array, time: float, derivative: int = 0) -> Array:
    """amplitude (sin(omega t + phase) - sin(phase)), or a derivative with respect to t."""
    argument = omega * time + phase
    if derivative == 0:
        return amplitude * (np.sin(argument) - np.sin(phase))
    return amplitude * omega * np.cos(argument) if derivative == 1 else -amplitude * omega**2 * np.sin(argument)


class Dense:
    """All rows on all atoms.

    Where the `pinned` atoms are, `places` and their waves (amplitude, omega, phase; shape (3, n_pinned, 3)) say.
    """

    def __init__(self, rows: list[Row], masses: Array, cell: Array, pinned: Array, places: Array, waves: Array) -> None:
        self.n, self.masses, self.pinned, self.places, self.waves = len(masses), masses, pinned, places, waves
        order = list(VECTORS)
        self.rows = sorted(rows, key=lambda r: order.index(r.kind))
        self.weights = 1.0 / masses
        self.weights[pinned] = 0.0
        self.root = np.sqrt(np.repeat(self.weights, 3))
        #: By kind: weights of atoms in vectors, places, coefficients, images.
        self.blocks = {}
        for kind, count in VECTORS.items():
            mine = [r for r in self.rows if r.kind == kind]
            table, extra = np.zeros((count, len(mine), self.n)), np.zeros((count, len(mine), 3))
            linear, images = np.zeros((len(mine), self.n, 3)), np.zeros((count, len(mine), 3))
            for k, row in enumerate(mine):
                for slot, vector in enumerate(row.vectors):
                    table[slot, k, list(vector)] = list(vector.values())
                if row.images:
                    images[:, k] = row.images
                if row.place is not None:
                    extra[0, k] -= row.place
                for atom, c in row.coefficients.items():
                    linear[k, atom] = c
            if mine:
                self.blocks[kind] = (table, extra, linear, images)
        self.set_cell(cell)
        self.waving = np.array([[r.amplitude, r.omega, r.phase] for r in self.rows]).reshape(-1, 3).T
        self.targets = np.array([r.target for r in self.rows])
        self.turns = np.array([r.kind == "dihedral" for r in self.rows], dtype=bool)
        #: Of each solution: the positions it was sought from, and whether a gradient has turned by a right angle.
        self.ways: list[tuple[Array, bool]] = []
        #: See `rounded`.
        self.slip = 0.0

    @contextmanager
    def rounded(self, noise: Array, slip: float) -> Iterator[None]:
        """Meanwhile targets are off by `noise`, and centers of gyration, in gradients, by `slip` times the extent.

        The engine subtracts the center once, in double precision and from positions about an atom of the row: each
        x - c of a gradient w (x - c)/q is off by the same eps times the extent D. So is the part w . v of A v that the
        common speed V of the atoms has, by eps D V/q, and the speed of an atom at d from c by eps D V d/q^2. Where a
        heavy atom makes q small, this is more than what rounding the positions does, as these shift c with that atom.
        """
        targets, self.slip = self.targets, slip
        self.targets = targets + noise
        try:
            yield
        finally:
            self.targets, self.slip = targets, 0.0

    def set_cell(self, cell: Array) -> None:
        """Lattice vectors as rows; rows through the boundary follow."""
        self.shifts = {kind: extra + images @ cell for kind, (_, extra, _, images) in self.blocks.items()}

    # -- rows -----------------------------------------------------------------------------------

    def measure(self, x: Array) -> Array:
        """q of every row."""
        return np.concatenate([self._measure(kind, x) for kind in self.blocks] or [np.zeros(0)])

    def _measure(self, kind: str, x: Array) -> Array:
        table, _, linear, _ = self.blocks[kind]
        if kind == "linear":
            return np.einsum("kai,ai->k", linear, x)
        if kind == "gyration":
            return np.sqrt(self._spread(x)[0])
        d = table @ x + self.shifts[kind]
        if kind == "norm":
            return _length(d[0])
        s, c = (_angle if kind == "angle" else _dihedral)(*d)[:2]
        return np.arctan2(s, c)

    def _spread(self, x: Array) -> tuple[Array, Array]:
        """Sum of w |x - c|^2, and x - c, with the center c of x.

        What rounds is c, by eps |c|, and with it all of x - c, so that they are taken about their own center again:
        heavy atoms lie next to c, at a distance that may be eps |c| times 1e13 and less.
        """
        w = self.blocks["gyration"][0][0]
        about = np.broadcast_to(x, (len(w), *x.shape))
        for _ in range(2):
            about = about - np.einsum("ka,kai->ki", w, about)[:, None]
        extent = np.abs(np.where(w[..., None] != 0, about.real, 0.0)).max(axis=(1, 2), keepdims=True)
        return np.einsum("ka,kai,kai->k", w, about, about), about + self.slip * extent

    def value(self, x: Array, t: float) -> Array:
        """sigma of every row, dihedrals to the nearest turn."""
        difference = self.measure(x) - self.targets - wave(*self.waving, t)
        return np.where(self.turns, (difference + np.pi) % (2 * np.pi) - np.pi, difference)

    def jacobian(self, x: Array) -> Array:
        """A, shape (rows, 3 n)."""
        parts = [self._gradient(kind, x).reshape(-1, 3 * self.n) for kind in self.blocks]
        return np.concatenate(parts) if parts else np.zeros((0, 3 * self.n))

    def _gradient(self, kind: str, x: Array) -> Array:
        table, _, linear, _ = self.blocks[kind]
        if kind == "linear":
            return linear
        if kind == "gyration":
            square, about = self._spread(x)
            return table[0][:, :, None] * about / np.sqrt(square)[:, None, None]
        d = table @ x + self.shifts[kind]
        if kind == "norm":
            slopes = d / _length(d)[..., None]
        else:
            s, c, ds, dc = (_angle if kind == "angle" else _dihedral)(*d)
            slopes = (c[:, None] * ds - s[:, None] * dc) / (s * s + c * c)[:, None]
        return np.einsum("ska,ski->kai", table, slopes)

    def curvature(self, x: Array, v: Array) -> Array:
        """The second derivative of q along x + s v: a step of the gradient into the complex plane, without rounding."""
        return self.jacobian(x + 1e-30j * v).imag @ v.ravel() / 1e-30

    # -- mechanics ------------------------------------------------------------------------------

    def basis(self, x: Array) -> tuple[Array, Array, float]:
        """Orthonormal basis of the rows of B, A itself, and the condition of B."""
        a = self.jacobian(x)
        b = a * self.root
        size = np.linalg.norm(b, axis=1, keepdims=True)
        _, s, vh = np.linalg.svd(b / np.where(size > 0, size, 1.0), full_matrices=False)
        rank = int(np.sum(s > RANK * s.max(initial=0.0)))
        return vh[:rank], a, float(s[0] / s[rank - 1]) if rank else 1.0

    def _nearest(self, a: Array, basis: Array, wanted: Array) -> tuple[Array, Array]:
        """The least change, in the mass metric and along a basis, with `a` times it as wanted; and in the basis."""
        spread = (basis * self.root).T
        size = np.linalg.norm(a, axis=1)
        size[size == 0] = 1.0
        inside = np.linalg.lstsq((a @ spread) / size[:, None], wanted / size, rcond=1e-10)[0]
        return (spread @ inside).reshape(-1, 3), inside

    def pin(self, x: Array, t: float, derivative: int = 0) -> None:
        """Put fixed atoms where they are, or give them their velocity or acceleration, in place."""
        moved = wave(*self.waves, t, derivative)
        x[self.pinned] = moved + self.places if derivative == 0 else moved

    def solve(self, x_new: Array, x_ref: Array, t: float) -> tuple[Array, Array]:
        """x_new + M^-1 A(x_ref)^T Lambda on the rows, and that correction."""
        y = x_new.copy()
        self.pin(y, t)
        basis = self.basis(x_ref)[0]
        spread, unknown = (basis * self.root).T, np.zeros(len(basis))
        z, last = y, np.inf
        for _ in range(30):
            a, miss = self.jacobian(z), self.value(z, t)
            if not (np.all(np.isfinite(a)) and np.all(np.isfinite(miss))):
                break
            step, inside = self._nearest(a, basis, -miss)
            unknown += inside
            z = y + (spread @ unknown).reshape(-1, 3)
            length = float(np.abs(step).max(initial=0.0))
            if float(np.abs(z - y).max()) > FAR:
                break
            if length <= 1e-15 * np.abs(z).max() or (length >= last and length <= 1e-12 * np.abs(z).max()):
                a0, a = self.jacobian(x_ref), self.jacobian(z)
                cosines = np.stack([a0 * a, a0 * a * self.root**2]).sum(axis=2)
                self.ways.append((y, bool(np.any(cosines[:, (a0 * self.root).any(axis=1)] <= 0))))
                return z, (spread @ unknown).reshape(-1, 3)
            last = length
        raise NoSolution("Newton's method for positions")

    def _change(self, x: Array, y: Array, wanted: Array) -> Array:
        """From y to the nearest, in the mass metric, with A y = wanted; fixed atoms stay."""
        basis, a, _ = self.basis(x)
        change = np.zeros(y.shape)
        for _ in range(2):
            # Once more: the first is as precise as its largest part, which may be that of other molecules.
            change += self._nearest(a, basis, wanted - a @ (y + change).ravel())[0]
        return change

    def velocities(self, x: Array, v: Array, t: float) -> Array:
        """A v = c."""
        v = v.copy()
        self.pin(v, t, 1)
        return v + self._change(x, v, wave(*self.waving, t, 1))

    def _pushed(self, x: Array, v: Array, f: Array, t: float) -> tuple[Array, Array]:
        """Accelerations without constraints, but for fixed atoms, and what the least constraint force adds."""
        a = f * self.weights[:, None]
        self.pin(a, t, 2)
        return a, self._change(x, a, wave(*self.waving, t, 2) - self.curvature(x, v))

    def acceleration(self, x: Array, v: Array, f: Array, t: float) -> Array:
        """A a = b, with the least constraint force."""
        a, change = self._pushed(x, v, f, t)
        return a + change

    def force(self, x: Array, v: Array, f: Array, t: float) -> Array:
        """M a - f as A^T lambda: where masses differ much, M times the rounding of a is many times that of f."""
        a, change = self._pushed(x, v, f, t)
        gradients = self.jacobian(x)
        b = gradients * self.root
        size = np.linalg.norm(b, axis=1)
        size[size == 0] = 1.0
        weighted = change.ravel() / np.where(self.root > 0, self.root, 1.0)
        z = (gradients.T @ (np.linalg.lstsq((b / size[:, None]).T, weighted, rcond=RANK)[0] / size)).reshape(-1, 3)
        z[self.pinned] = self.masses[self.pinned, None] * a[self.pinned] - f[self.pinned]
        return z

    def restore(self, x: Array, t: float) -> Array:
        """The nearest point on the rows in the mass metric."""
        start = x.copy()
        self.pin(start, t)
        z, last = start.copy(), np.inf
        for _ in range(200):
            a = self.jacobian(z)
            wanted = a @ (z - start).ravel() - self.value(z, t)
            if not (np.all(np.isfinite(a)) and np.all(np.isfinite(wanted))):
                break
            following = start + self._nearest(a, self.basis(z)[0], wanted)[0]
            length, z = float(np.abs(following - z).max()), following
            if length <= 2e-15 * np.abs(z).max() or (length >= last and length <= 1e-12 * np.abs(z).max()):
                return z
            last = length
        raise NoSolution("the nearest point")

    def rounding(self, x: Array, stored: float) -> Array:
        """What double precision leaves of each sigma where coordinates are as large as `stored`."""
        reach = np.abs(self.jacobian(x)).sum(axis=1) * stored
        return 1e-14 * np.maximum(np.abs(self.targets), 1.0) + 8 * EPS * reach


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("...i,...i", a, b)


def _length(a: Array) -> Array:
    """Analytic, as a step into the complex plane needs it."""
    return np.sqrt(_dot(a, a))


def _angle(u: Array, w: Array) -> tuple[Array, Array, Array, Array]:
    """|u x w|, u . w, and their gradients with respect to u and w."""
    n = np.cross(u, w)
    s = _length(n)
    return s, _dot(u, w), np.stack([np.cross(w, n), np.cross(n, u)]) / s[:, None], np.stack([w, u])


def _dihedral(p: Array, q: Array, r: Array) -> tuple[Array, Array, Array, Array]:
    """|q| p . (q x r), (p x q) . (q x r), and their gradients with respect to p, q and r."""
    g, qr = _length(q), np.cross(q, r)
    triple = _dot(p, qr)
    pq_, qr_, pr_, qq = _dot(p, q)[:, None], _dot(q, r)[:, None], _dot(p, r)[:, None], _dot(q, q)[:, None]
    ds = np.stack([qr, np.cross(r, p), np.cross(p, q)]) * g[:, None]
    ds[1] += triple[:, None] * q / g[:, None]
    dc = np.stack([qr_ * q - qq * r, qr_ * p + pq_ * r - 2 * pr_ * q, pq_ * q - qq * p])
    return g * triple, (pq_ * qr_ - pr_ * qq)[:, 0], ds, dc


# -- motion -------------------------------------------------------------------------------------


def stepper_of(name: str) -> Any:
    """A stepper of the package: its fractions of kicks and drifts are the only thing that the oracle takes from it."""
    if name.startswith("Geodesic"):
        substeps = int(name[8:])
        return steppers.Splitting((0.5, 0.5), (1.0,), (1.0 / substeps,) * substeps)
    if name == "ProjectedVerlet":
        return ProjectedEquation(project=True)
    return getattr(steppers, name)()


def advance(rows: Dense, name: str, x: Array, v: Array, t: float, dt: float, force) -> tuple[Array, Array]:
    """One step of kicks and drifts; `force(x)` is that on whole molecules."""
    if name == "ProjectedVerlet":
        a = rows.acceleration(x, v, force(x), t)
        half = v + 0.5 * dt * a
        y = rows.solve(x + dt * half, x, t + dt)[0]
        v = half + 0.5 * dt * rows.acceleration(y, half + 0.5 * dt * a, force(y), t + dt)
        return y, rows.velocities(y, v, t + dt)
    stepper = stepper_of(name)
    kicks, drifts, parts = stepper.kicks, stepper.drifts, stepper.flight
    weights = rows.weights[:, None]
    end = t + dt
    v = v + kicks[0] * dt * weights * force(x)
    for kick, drift in zip(kicks[1:], drifts, strict=True):
        for part in parts:
            h = drift * part * dt
            t += h
            x, push = rows.solve(x + h * v, x, t)
            v = v + push / h
        v = v + kick * dt * weights * force(x)
    return x, rows.velocities(x, v, end)
