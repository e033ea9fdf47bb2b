"""Spheres, cylinders, planes and ellipsoids: the landing in closed form.

All are 2 s(d) = d.Q d + 2 g.d - k = 0 with d = x - c, and G = Q d + g their gradient. From xu along the gradient G0
where the drift began, x = xu + l G0 lies on the surface where

    A l^2 + 2 B l + S = 0,  A = G0.Q G0,  B = G0.(Q du + g),  S = du.(Q du + 2 g) - k;

l = -S/(B + sqrt(B^2 - A S)) is the root that goes to 0 with the time step, without cancellation. Where Q is a
projector (spheres, circular cylinders) or zero (planes), A = k.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import openmm

from kcons.constraints import Cylinder, Ellipsoid, Plane, Sphere
from kcons.constraints.constraint import Constraint
from kcons.constraints.target import FloatArray
from kcons.errors import KconsError
from kcons.openmm.integrator.program import Program
from kcons.openmm.surfaces.surface_rows import SurfaceRows

#: What `QuadricRows` holds.
QUADRICS = (Sphere, Cylinder, Plane, Ellipsoid)


class QuadricRows(SurfaceRows):
    """Atoms on spheres, cylinders, planes and ellipsoids of any place and direction.

    Attributes
    ----------
    spheres : bool
        Whether all are spheres, so that free flight can follow great circles.
    circles : bool
        Whether it does; set by the integrator that writes `circle`.
    """

    circles = False
    written = (*SurfaceRows.written, "circles", "_a")
    #: Name of A in the program, the curvature along the kept gradient; where velocities are tangent, the level.
    _a = "s_a"

    def __init__(self, rows: Sequence[Constraint], n_particles: int) -> None:
        super().__init__(rows, n_particles)
        parts = [_coefficients(item) for item in self.rows]
        self.matrices = np.concatenate([part[0] for part in parts])
        self.centers = np.concatenate([part[1] for part in parts])
        self.flats = np.concatenate([part[2] for part in parts])
        self.levels = np.concatenate([part[3] for part in parts])
        self.spheres = all(isinstance(item, Sphere) for item in self.rows)
        diagonal = np.einsum("kii->ki", self.matrices)
        self._tilted = bool(np.any(self.matrices != diagonal[:, :, None] * np.eye(3)))
        self._flat = bool(np.any(self.flats))
        self._projectors = not any(isinstance(item, Ellipsoid) for item in self.rows)
        self._others = len(self.atoms) < n_particles
        #: k in the program: each variable of all particles makes every scalar product slower.
        alike = not self._others and bool(np.all(self.levels == self.levels[0]))
        self._k = repr(float(self.levels[0])) if alike else "s_k"
        self._round = not self._others and not self._tilted and bool(np.all(diagonal == 1.0))

    # -- expressions ----------------------------------------------------------------------------

    def _bent(self, vector: str) -> str:
        """Q times a vector."""
        if self._tilted:
            return f"(s_qx*_x({vector})+s_qy*_y({vector})+s_qz*_z({vector}))"
        return vector if self._round else f"s_q*{vector}"

    def _slope(self, d: str, times: int = 1) -> str:
        """Q d + times g."""
        if not self._flat:
            return self._bent(d)
        return f"({self._bent(d)}+{times}*s_g)" if times > 1 else f"({self._bent(d)}+s_g)"

    @property
    def _safe(self) -> str:
        """What keeps denominators of other particles from zero."""
        return "+s_other" if self._others else ""

    @property
    def solved(self) -> str:
        """Whether there is a landing: the discriminant is not negative."""
        return f"step(s_b*s_b-{self._a}*s_s)"

    @property
    def root(self) -> str:
        """l, to be used where it is `solved`."""
        return f"(-s_s/(s_b{self._safe}+sqrt(max(0, s_b*s_b-{self._a}*s_s))))"

    # -- the program ----------------------------------------------------------------------------

    def declare(self, program: Program) -> None:
        p = program
        self._parameter(p, "s_c", "centre of the surface", self.centers)
        if self._k == "s_k":
            self._parameter(p, "s_k", "level of the quadric 2s(d) = d.Qd + 2g.d - k, d = x - c", self.levels)
        if self._tilted:
            for i, axis in enumerate("xyz"):
                self._parameter(p, f"s_q{axis}", f"column {axis} of Q", self.matrices[:, :, i])
        elif not self._round:
            self._parameter(p, "s_q", "diagonal of Q", np.einsum("kii->ki", self.matrices))
        if self._flat:
            self._parameter(p, "s_g", "normal of a plane", self.flats)
        if self._others:
            self._parameter(p, "s_other", "1 for particles on no quadric", np.zeros(len(self.atoms)), 1.0)
        if not self.circles:
            self._declare_solution(p)

    def _declare_solution(self, p: Program) -> None:
        p.vector("s_b", "B, slope along the kept gradient")
        p.vector("s_s", "S, twice the value where the particle flew")

    def _solve(self, p: Program, gradient: str, d: str) -> None:
        """A, B, S and whether there is a landing, from the kept gradient and d = xu - c."""
        if self._a == "s_a":
            p.vector("s_a", "A, curvature along the kept gradient")
            p.each("s_a", f"dot({gradient}, {self._bent(gradient)})", "A = G0.Q G0")
        p.each("s_b", f"dot({gradient}, {self._slope(d)})", "B = G0.(Q d + g)")
        p.each("s_s", f"dot({d}, {self._slope(d, 2)})-{self._k}", "S = d.(Q d + 2g) - k")
        self._fail(p, self.solved, "a landing exists where B^2 >= A S")

    def remember(self, program: Program) -> None:
        program.vector("s_gradient", "gradient of the surface where the drift began")
        program.each("s_gradient", self._slope("(x-s_c)"), "G0, gradient of the surface")

    def land(self, program: Program, h: str) -> None:
        self._solve(program, "s_gradient", "(x-s_c)")
        program.each("x", f"select({self.solved}, x+{self.root}*s_gradient, x_last)", "onto the surface along G0")

    def project(self, program: Program) -> None:
        p = program
        if self._round:
            p.each("v", f"v-(x-s_c)*dot(x-s_c, v)/{self._k}", "tangent to the spheres")
            return
        if not self._tilted:
            slope = self._slope("(x-s_c)")
            p.each("v", f"v-{slope}*dot({slope}, v)/(dot({slope}, {slope}){self._safe})", "tangent to the surface")
            return
        self.remember(p)
        p.each(
            "v", f"v-s_gradient*dot(s_gradient, v)/(dot(s_gradient, s_gradient){self._safe})", "tangent to the surface"
        )

    def fly(self, p: Program, u: str, h: str) -> None:
        p.vector("s_d", "where the particle would fly, from the centre")
        p.each("s_d", f"x+{h}*{u}-s_c", "where it would fly")
        if self._tilted:
            p.vector("s_gradient", "gradient of the surface where the drift began")
            p.each("s_gradient", self._slope("(x-s_c)"), "G0, gradient of the surface")
        self._solve(p, self._here, "s_d")

    def impulse(self, h: str) -> str:
        return f"{self.root}/{h}*{self._here}"

    def fly_alone(self, p: Program, u: str, h: str) -> None:
        if not self._projectors:
            super().fly_alone(p, u, h)
            return
        self._a = self._k
        self.fly(p, u, h)
        # v is made tangent where the drift ends: G1 = Q d + l G0 is the gradient there, and h G1.v = k - B - l k. If it
        # were not, A = k would let an error of |G0| grow where a particle turns by more than 60 degrees a step.
        k = self._k
        p.each(
            "v",
            f"select(failed, v, {u}+(s_l*{self._here}-select({k}, ({k}-s_b-s_l*{k})/{k}, 0)*({self._bent('s_d')}"
            f"+s_l*{self._here}))/{h}); s_l={self.root}",
            "impulse of the surface, before and after",
        )
        p.each("x", f"select(failed, x, s_c+s_d+{self.root}*{self._here})", "onto the surface")

    @property
    def _here(self) -> str:
        return "s_gradient" if self._tilted else self._slope("(x-s_c)")

    def circle(self, p: Program, h: str) -> None:
        """Drift along great circles, exact for any h; spheres only.

        d = x - c turns in the plane of d and the tangent velocity u: with w = |u|/R, d1 = d cos(wh) + u sin(wh)/w
        and u1 = u cos(wh) - d w sin(wh).
        """
        p.vector("s_d", "x - c")
        p.vector("s_dd", "d.d")
        p.vector("s_dv", "d.v")
        p.vector("s_w", "angular velocity w, never quite 0")
        on, safe = ("(1-s_other)*", self._safe) if self._others else ("", "")
        p.each("s_d", "x-s_c", "from the centre")
        p.each("s_dd", "dot(s_d, s_d)", "length")
        p.each("s_dv", "dot(s_d, v)", "velocity across the sphere")
        p.each("v", f"v-{on}s_d*s_dv/(s_dd{safe})", "along the sphere")
        p.each("s_w", f"1e-150+{on}sqrt(dot(v, v)/({self._k}{safe}))", "w = |v|/R")
        self._fail(p, "step(s_w)*step(1e30-s_w)", "velocities are finite")
        # d is brought to the length R on the way, so that rounding does not add up.
        size = "select(s_other, 1, sqrt(s_k/(s_dd+s_other)))" if self._others else f"sqrt({self._k}/s_dd)"
        p.each("x", f"select(failed, x, s_c+s_d*{size}*cos(s_w*{h})+v*sin(s_w*{h})/s_w)", "turn the position")
        p.each("v", f"v*cos(s_w*{h})-{on}s_d*{size}*s_w*sin(s_w*{h})", "turn the velocity")

    # -- running --------------------------------------------------------------------------------

    def failure(self, integrator: openmm.CustomIntegrator, step: int) -> KconsError:
        if self.circles:
            w = self._values(integrator, "s_w")
            return self._error(np.where(w < 1e30, w, np.nan), step, w)
        b, s = self._values(integrator, "s_b"), self._values(integrator, "s_s")
        a = self.levels if self._a == self._k else self._values(integrator, "s_a")
        return self._error((b * b - a * s) / (np.abs(a * self.levels) + np.finfo(float).tiny), step, s)


def _coefficients(item: Constraint) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Q, c, g and k of each row."""
    n = item.n_rows
    eye, none = np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))
    target = item.target_at(0.0)
    if isinstance(item, Sphere):
        return eye, item.center, none, target**2
    if isinstance(item, Cylinder):
        return eye - item.axis[:, :, None] * item.axis[:, None, :], item.point, none, target**2
    if isinstance(item, Plane):
        normal = item.coefficients[:, 0]
        return np.zeros((n, 3, 3)), normal * target[:, None], normal, np.zeros(n)
    assert isinstance(item, Ellipsoid)
    # Divided by the mean curvature, so that gradients are of the size of d.
    size = item.scale()
    columns = item.rotation * (item.inverse_axes * size[:, None])[:, None, :]
    return columns @ columns.transpose(0, 2, 1), item.center, none, (size + target) ** 2
