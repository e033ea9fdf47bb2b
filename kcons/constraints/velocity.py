"""Rows linear in the velocities: knife edges, rolling, driven velocities (nonholonomic constraints).

A row is a(r, t) . v = target; its gradient is a, and it never fixes a position. Differentiated once,
a . acceleration = d target/dt - v . da/dt (notes, eqs. 82 and 92).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import ANY, SPEED, TAKES_TIME, atom_array, check_call, lent, numbers, positive
from kcons.constraints.constraint import Constraint, RowKind
from kcons.constraints.target import FloatArray, Target, contradiction, exact_step, first_derivative_4
from kcons.constraints.vectors import dot, first_true, norm, unit
from kcons.errors import InputError

_VECTOR = (3,)


class VelocityRows(Constraint):
    """Rows a(r, t) . v = target; zero by default."""

    holonomic = False
    held = SPEED

    def __init__(self, atoms: ArrayLike, target: Target = 0.0) -> None:
        super().__init__(atoms, 0.0 if target is None else target)

    def measure(self, r: FloatArray, time: float) -> FloatArray:
        return np.zeros(self.n_rows)

    def scale(self, time: float = 0.0) -> FloatArray:
        return np.zeros(self.n_rows)


class LinearVelocity(VelocityRows):
    """A combination of velocity components, sum_a c_a . v_a = target.

    Parameters
    ----------
    atoms : array_like of int, shape (n_rows, width) or (width,)
        Atoms of each row.
    coefficients : array_like, shape (width, 3) or (n_rows, width, 3)
        What each component is multiplied with.
    target : float, array_like, callable of time, or MovingTarget
        Speed held.

    Examples
    --------
    An atom driven along x with speed cos(t):

    >>> import numpy as np
    >>> drive = LinearVelocity(0, [[1, 0, 0]], target=np.cos)
    """

    family = "LinearVelocity"
    kind = RowKind.VELOCITY
    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"coefficients": (-1, 3)}
    coefficients: FloatArray

    def __init__(self, atoms: ArrayLike, coefficients: ArrayLike, target: Target = 0.0) -> None:
        super().__init__(atoms, target)
        self._keep(coefficients=coefficients)
        self._settle()

    def _settle(self) -> None:
        k = first_true(~np.any(self.coefficients, axis=(1, 2)))
        if k is not None:
            raise InputError(
                f"{self.row_name(k)}: all coefficients of row {k} are zero; remove the row",
                item="coefficients",
                atoms=self.atoms[k].tolist(),
            )

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        return self.coefficients

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        return np.zeros(self.n_rows)

    def parameters(self) -> FloatArray:
        return np.hstack([np.full((self.n_rows, 1), 3.0 * self.width), self.coefficients.reshape(self.n_rows, -1)])


class KnifeEdge(VelocityRows):
    """A blade that glides along itself and not sideways (skate, sleigh, the edge of a wheel).

    Parameters
    ----------
    back, front : int or array_like of int, shape (n_rows,)
        Two atoms that give the direction of each blade; hold their distance with `Distance`.
    normal : array_like, shape (3,) or (n_rows, 3)
        Normal n of the plane the blade glides on, of any length.
    contact : float or array_like of shape (n_rows,)
        Where the blade touches, 0 at `back` (default) to 1 at `front`.
    target : float, array_like, callable of time, or MovingTarget
        Sideways speed, 0 by default.

    Notes
    -----
    e is the unit vector along the part of d = r_front - r_back in the plane, l = n x e points sideways, and
    the row is l . [(1 - s) v_back + s v_front] = 0. As the blade turns with the rate w = l . d'/|d in plane|,
    dl/dt = -w e.

    References
    ----------
    S. A. Chaplygin, Math. Sb. 28, 303 (1911) (the sleigh).
    """

    family = "KnifeEdge"
    kind = RowKind.VELOCITY
    row_width = 2
    translation_invariant = True
    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"normal": _VECTOR, "contact": ()}
    normal: FloatArray
    contact: FloatArray

    def __init__(
        self,
        back: ArrayLike,
        front: ArrayLike,
        normal: ArrayLike,
        contact: ArrayLike = 0.0,
        target: Target = 0.0,
    ) -> None:
        super().__init__(_pairs(back, front, self.family), target)
        self._keep(normal=unit(normal, "normal"), contact=contact)

    def _blade(self, r: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Unit vector along the blade in the plane, and the blade's length there."""
        d = r[:, 1] - r[:, 0]
        in_plane = d - dot(d, self.normal)[:, None] * self.normal
        length = norm(in_plane)
        return in_plane / length[:, None], length

    @property
    def _shares(self) -> FloatArray:
        """Weights of the two atoms in the contact's velocity, shape (n_rows, 2)."""
        return np.stack([1 - self.contact, self.contact], axis=1)

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        sideways = np.cross(self.normal, self._blade(r)[0])
        return self._shares[:, :, None] * sideways[:, None]

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        along, length = self._blade(r)
        turning = dot(np.cross(self.normal, along), v[:, 1] - v[:, 0]) / length
        gliding = dot(along, np.einsum("ka,kai->ki", self._shares, v))
        return -turning * gliding

    def parameters(self) -> FloatArray:
        return np.hstack([self.normal, self.contact[:, None]])

    def check(self, r: FloatArray, time: float, first_row: int) -> None:
        d = r[:, 1] - r[:, 0]
        _refuse_short(self, norm(np.cross(d, self.normal)), norm(d), "the blade is normal to its plane", first_row)


class Rolling(VelocityRows):
    """An upright wheel that rolls along a fixed heading without slipping.

    Parameters
    ----------
    hub : int or array_like of int, shape (n_rows,)
        Atom at the centre of each wheel.
    rim : int or array_like of int, shape (n_rows,)
        Atom that turns with the wheel, in its plane, at any distance from the hub; hold that distance with
        `Distance`, and keep hub and rim in the plane of the wheel with `Plane`.
    radius : float or array_like of shape (n_rows,)
        Radius R of the wheel.
    heading : array_like, shape (3,) or (n_rows, 3)
        Direction h of rolling; only its part in the ground counts.
    normal : array_like, shape (3,) or (n_rows, 3)
        Normal n of the ground, pointing to the hub.
    target : float, array_like, callable of time, or MovingTarget
        Speed of slip at the contact, 0 by default.

    Notes
    -----
    s = r_rim - r_hub turns forward, from n to h, with the rate psi' = w . s', w = [(s.n) h - (s.h) n]/rho^2,
    rho^2 = (s.n)^2 + (s.h)^2. The point of the wheel at the contact moves with h . v_hub - R psi', which must
    vanish: the row is h . v_hub - R w . (v_rim - v_hub) = 0.
    Along a motion w' = [(s'.n) h - (s'.h) n]/rho^2 - 2 [(s.n)(s'.n) + (s.h)(s'.h)]/rho^2 w, and w'.s'
    gives the curvature: -R w'.s' = 2 R [(s.n)(s'.n) + (s.h)(s'.h)]/rho^2 (w.s').
    """

    family = "Rolling"
    kind = RowKind.VELOCITY
    row_width = 2
    translation_invariant = True
    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"radius": (), "heading": _VECTOR, "normal": _VECTOR}
    radius: FloatArray
    heading: FloatArray
    normal: FloatArray

    def __init__(
        self,
        hub: ArrayLike,
        rim: ArrayLike,
        radius: ArrayLike,
        heading: ArrayLike,
        normal: ArrayLike = (0.0, 0.0, 1.0),
        target: Target = 0.0,
    ) -> None:
        super().__init__(_pairs(hub, rim, self.family), target)
        self._keep(radius=radius, heading=unit(heading, "heading"), normal=unit(normal, "normal"))
        k = first_true(~(self.radius > 0))
        if k is not None:
            raise InputError(
                f"{self.row_name(k)}: radius {self.radius[k]:g} is not positive",
                item="radius",
                atoms=self.atoms[k].tolist(),
            )
        level = self.heading - dot(self.heading, self.normal)[:, None] * self.normal
        if np.any(norm(level) < 1e-7):
            raise InputError("Rolling: heading is normal to the ground; give a direction along it", item="heading")
        self._keep(heading=unit(level, "heading"))

    def _turning(self, r: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """s.n, s.h, rho^2 and w."""
        s = r[:, 1] - r[:, 0]
        up, ahead = dot(s, self.normal), dot(s, self.heading)
        square = up**2 + ahead**2
        w = (up[:, None] * self.heading - ahead[:, None] * self.normal) / square[:, None]
        return up, ahead, square, w

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        turn = self.radius[:, None] * self._turning(r)[3]
        return np.stack([self.heading + turn, -turn], axis=1)

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        up, ahead, square, w = self._turning(r)
        ds = v[:, 1] - v[:, 0]
        stretching = (up * dot(ds, self.normal) + ahead * dot(ds, self.heading)) / square
        return 2 * self.radius * stretching * dot(w, ds)

    def parameters(self) -> FloatArray:
        return np.hstack([self.radius[:, None], self.heading, self.normal])

    def check(self, r: FloatArray, time: float, first_row: int) -> None:
        s = r[:, 1] - r[:, 0]
        in_wheel = np.hypot(dot(s, self.normal), dot(s, self.heading))
        _refuse_short(self, in_wheel, norm(s), "the rim atom lies on the axle of the wheel", first_row)


class CustomVelocity(VelocityRows):
    """A row whose coefficients are a function, called once a row.

    Parameters
    ----------
    atoms : array_like of int, shape (n_rows, width) or (width,)
        Atoms of each row.
    coefficients : callable
        ``coefficients(r) -> (width, 3)`` for positions of shape (width, 3); with `time_dependent`, ``(r, t)``. It must
        depend on nothing else. Where Numba has compiled it, kernels call it without Python.
    derivative : callable, optional
        ``derivative(r, v) -> (width, 3)``, the time derivative of the coefficients along the motion; with
        `time_dependent`, ``(r, v, t)``, and the explicit time derivative included. Without it the coefficients
        are differenced along the motion, order four: about eleven digits.
    target : float, array_like, callable of time, or MovingTarget
        What the row is held at, 0 by default.
    time_dependent : bool
        Whether the functions take the time as their last argument.
    translation_invariant : bool
        Whether only differences of positions count; then minimum images apply in periodic cells.
    length, time_step : float
        Differences are taken at steps of at most 1e-3 `length`, and, with `time_dependent`, of `time_step`.
    """

    family = "CustomVelocity"
    kind = RowKind.VELOCITY
    held = ANY
    functions: ClassVar[tuple[str, ...]] = ("coefficients", "derivative")

    def __init__(
        self,
        atoms: ArrayLike,
        coefficients: Callable[..., Any],
        derivative: Callable[..., Any] | None = None,
        target: Target = 0.0,
        *,
        time_dependent: bool = False,
        translation_invariant: bool = False,
        length: float = 1.0,
        time_step: float = 1e-3,
    ) -> None:
        super().__init__(atoms, target)
        if not callable(coefficients):
            raise InputError("CustomVelocity: coefficients must be a function; see LinearVelocity", item="coefficients")
        last = ("t",) if time_dependent else ()
        check_call("CustomVelocity: coefficients", coefficients, ("r", *last), TAKES_TIME)
        check_call("CustomVelocity: derivative", derivative, ("r", "v", *last), TAKES_TIME)
        for name, size in (("length", length), ("time_step", time_step)):
            positive(size, f"CustomVelocity: {name}")
        self.coefficients = coefficients
        self.derivative = derivative
        self.time_dependent = bool(time_dependent)
        self.translation_invariant = bool(translation_invariant)
        self.length = float(length)
        self.time_step = float(time_step)

    @property
    def moving(self) -> bool:
        return super().moving or self.time_dependent

    def _call(self, function: Callable[..., Any], name: str, k: int, *arguments: Any) -> FloatArray:
        given = arguments if self.time_dependent else arguments[:-1]
        lent_to = [lent(a) if isinstance(a, np.ndarray) else a for a in given]
        result = numbers(function(*lent_to), f"{self.row_name(k)}: {name}")
        if result.shape != (self.width, 3):
            raise InputError(
                f"CustomVelocity: {name} returned shape {result.shape} for row {k}; it must return ({self.width}, 3)",
                item=name,
                atoms=self.atoms[k].tolist(),
            )
        return result

    def gradient(self, r: FloatArray, time: float) -> FloatArray:
        rows = [self._call(self.coefficients, "coefficients", k, r[k], time) for k in range(self.n_rows)]
        return np.array(rows).reshape(self.n_rows, self.width, 3)

    def row(self, k: int, r: FloatArray, time: float) -> FloatArray:
        """Coefficients of row `k` alone at `r`, shape (width, 3); for kernels."""
        return self._call(self.coefficients, "coefficients", k, r, time)

    def curvature(self, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        out = np.zeros(self.n_rows)
        for k in range(self.n_rows):
            out[k] = np.sum(self._derivative(k, r[k], v[k], time) * v[k])
        return out

    def _derivative(self, k: int, r: FloatArray, v: FloatArray, time: float) -> FloatArray:
        if self.derivative is not None:
            return self._call(self.derivative, "derivative", k, r, v, time)
        speed = float(np.sqrt(np.sum(v * v)))
        if speed == 0:
            return np.zeros_like(r)
        step = 1e-3 * self.length / speed
        if self.time_dependent:
            step = exact_step(min(step, self.time_step), time)
        return first_derivative_4(
            lambda s: self._call(self.coefficients, "coefficients", k, r + s * v, time + s), 0.0, step
        )

    def check(self, r: FloatArray, time: float, first_row: int) -> None:
        size = np.sqrt(np.sum(self.gradient(r, time) ** 2, axis=(1, 2)))
        self.refuse_singular(
            ~(np.isfinite(size) & (size > 0)),
            first_row,
            lambda k, row: f"{row}: the coefficients are zero or not finite; move the atoms",
        )
        if self.derivative is None:
            return
        # A wrong derivative would give wrong motion without any other sign.
        along = self.length * unit(np.random.default_rng(0).normal(size=(self.width, 3)), "along")
        for k in range(self.n_rows):
            self._check_derivative(k, r[k], along, 0.01, time, first_row)
            if self.time_dependent:
                self._check_derivative(k, r[k], np.zeros_like(along), self.time_step, time, first_row)

    def _check_derivative(
        self, k: int, r: FloatArray, v: FloatArray, time_step: float, time: float, first_row: int
    ) -> None:
        def given(s: float) -> FloatArray:
            return self._call(self.derivative, "derivative", k, r + s * v, v, time + s)  # type: ignore[arg-type]

        found = contradiction(given, lambda s: self.row(k, r + s * v, time + s), 0.0, time_step)
        if found is not None:
            atom, axis = divmod(found.number, 3)
            raise InputError(
                f"row {first_row + k}, {self.row_name(k)}: derivative gives {found.given:.6g} for {'xyz'[axis]} of its "
                f"atom {self.atoms[k, atom]}, but differences of the coefficients give {found.found:.6g}; correct it, "
                "or leave it out",
                item="derivative",
                atoms=self.atoms[k].tolist(),
            )


def _pairs(first: ArrayLike, second: ArrayLike, family: str) -> ArrayLike:
    a, b = atom_array(first, family), atom_array(second, family)
    if a.shape != b.shape or a.ndim != 1:
        raise InputError(f"{family}: {a.shape} and {b.shape} atoms are given; give one pair a row", item="atoms")
    return np.stack([a, b], axis=1)


def _refuse_short(item: Constraint, part: FloatArray, whole: FloatArray, what: str, first_row: int) -> None:
    item.refuse_singular(
        ~(part > 1e-7 * whole),
        first_row,
        lambda k, row: f"{row}: {what}, so its direction is undefined; move the atoms",
    )
