"""Rows linear in the velocities: knife edges, rolling (nonholonomic constraints); others by `VelocityFormula`.

A row is a(r, t) . v = target; its gradient is a, and it never fixes a position. Differentiated once,
a . acceleration = d target/dt - v . da/dt (notes, eqs. 82 and 92).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import numpy as np
from numpy import sqrt
from numpy.typing import ArrayLike

from kcons.constraints.arguments import SPEED, Directions, FloatArray, PositiveLengths, atom_table, unit
from kcons.constraints.constraint import Constraint, Fault, RowKind
from kcons.constraints.target import Target
from kcons.constraints.vectors import dot, norm
from kcons.errors import InputError

__all__ = ["KnifeEdge", "Rolling"]

_VECTOR = (3,)


class VelocityRows(Constraint, base=True):
    """Rows a(r, t) . v = target; zero by default.

    `row` is a function of the middle of a flight, where the coefficients a are taken, and of the way d, which stands
    behind it: its value is a . d, its gradient by where the flight ends is a + (da/dr)^T d/2.
    """

    holonomic = False
    kind = RowKind.VELOCITY
    held = SPEED


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
    the row is l . [(1 - s) v_back + s v_front] = 0.

    References
    ----------
    S. A. Chaplygin, Math. Sb. 28, 303 (1911) (the sleigh).
    """

    row_width = 2
    translation_invariant = True
    singular = "the blade is normal to its plane, so its direction is undefined; move the atoms"
    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"normal": _VECTOR, "contact": ()}
    normal: FloatArray

    def __init__(
        self, back: ArrayLike, front: ArrayLike, normal: Directions, contact: ArrayLike = 0.0, target: Target = 0.0
    ) -> None:
        super().__init__(_pairs(back, front, self.family), target, normal=normal, contact=contact)

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        # (1 - s) l.d_back + s l.d_front; p holds n and s.
        bx, by, bz = r[3] - r[0], r[4] - r[1], r[5] - r[2]
        up = bx * p[0] + by * p[1] + bz * p[2]
        bx, by, bz = bx - up * p[0], by - up * p[1], bz - up * p[2]
        length = sqrt(bx * bx + by * by + bz * bz)
        bx, by, bz = bx / length, by / length, bz / length
        lx, ly, lz = p[1] * bz - p[2] * by, p[2] * bx - p[0] * bz, p[0] * by - p[1] * bx
        s = p[3]
        gx, gy, gz = r[6] + s * (r[9] - r[6]), r[7] + s * (r[10] - r[7]), r[8] + s * (r[11] - r[8])
        out[0] = lx * gx + ly * gy + lz * gz
        # The blade turns by l.(change of the front less that of the back)/length, and l by that towards -e.
        half = 0.5 * (bx * gx + by * gy + bz * gz) / length
        f, g = 1.0 - s + half, s - half
        out[1], out[2], out[3] = f * lx, f * ly, f * lz
        out[4], out[5], out[6] = g * lx, g * ly, g * lz

    def faults(self, r: FloatArray, time: float) -> Iterator[Fault]:
        d = r[:, 1] - r[:, 0]
        yield ~(norm(np.cross(d, self.normal)) > 1e-7 * norm(d)), lambda k: self.singular


class Rolling(VelocityRows):
    """An upright wheel that rolls along a fixed heading without slipping.

    Parameters
    ----------
    hub : int or array_like of int, shape (n_rows,)
        Atom at the center of each wheel.
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
    """

    row_width = 2
    translation_invariant = True
    singular = "the rim atom lies on the axle of the wheel, so its direction is undefined; move the atoms"
    per_row: ClassVar[Mapping[str, tuple[int, ...]]] = {"radius": (), "heading": _VECTOR, "normal": _VECTOR}
    heading: FloatArray
    normal: FloatArray

    def __init__(
        self,
        hub: ArrayLike,
        rim: ArrayLike,
        radius: PositiveLengths,
        heading: Directions,
        normal: Directions = (0.0, 0.0, 1.0),
        target: Target = 0.0,
    ) -> None:
        super().__init__(_pairs(hub, rim, self.family), target, radius=radius, heading=heading, normal=normal)
        level = self.heading - dot(self.heading, self.normal)[:, None] * self.normal
        if np.any(norm(level) < 1e-7):
            raise InputError("Rolling: heading is normal to the ground; give a direction along it", item="heading")
        self._keep(heading=unit(level, "heading"))

    @staticmethod
    def row(r: Any, p: Any, t: Any, out: Any) -> None:
        # h.d_hub - R w.d, of s and d from hub to rim, w = [(s.n) h - (s.h) n]/rho^2; p holds R, h and n.
        sx, sy, sz = r[3] - r[0], r[4] - r[1], r[5] - r[2]
        dx, dy, dz = r[9] - r[6], r[10] - r[7], r[11] - r[8]
        ahead, up = sx * p[1] + sy * p[2] + sz * p[3], sx * p[4] + sy * p[5] + sz * p[6]
        forth, rise = dx * p[1] + dy * p[2] + dz * p[3], dx * p[4] + dy * p[5] + dz * p[6]
        f = p[0] / (ahead * ahead + up * up)
        turn = f * (up * forth - ahead * rise)
        out[0] = r[6] * p[1] + r[7] * p[2] + r[8] * p[3] - turn
        # R w, and half of what R w.d changes by with s: both have parts along h and n only.
        g = turn * f / p[0]
        a = f * up - 0.5 * f * rise - g * ahead
        b = -f * ahead + 0.5 * f * forth - g * up
        x, y, z = a * p[1] + b * p[4], a * p[2] + b * p[5], a * p[3] + b * p[6]
        out[1], out[2], out[3] = p[1] + x, p[2] + y, p[3] + z
        out[4], out[5], out[6] = -x, -y, -z

    def faults(self, r: FloatArray, time: float) -> Iterator[Fault]:
        s = r[:, 1] - r[:, 0]
        yield ~(np.hypot(dot(s, self.normal), dot(s, self.heading)) > 1e-7 * norm(s)), lambda k: self.singular


def _pairs(first: ArrayLike, second: ArrayLike, family: str) -> ArrayLike:
    a, b = atom_table(first, family, 1), atom_table(second, family, 1)
    if len(a) != len(b):
        raise InputError(f"{family}: {len(a)} and {len(b)} atoms are given; give one pair a row", item="atoms")
    return np.hstack([a, b])
