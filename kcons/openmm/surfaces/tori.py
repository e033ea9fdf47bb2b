"""Tori: the landing by Newton's method for one number, from three scalar products.

With d = x - c, z = n.d and rho = sqrt(d.d - z^2) the surface is F = (rho - R)^2 + z^2 - r^2 = 0; half its gradient
is G = d - (R/rho) (d - n z), of length r. Along x = xu + l G0

    d.d = D + 2 T l + r^2 l^2,  z = Z + U l,  D = du.du, T = du.G0, Z = n.du, U = n.G0 = z where the drift began,

so that F and F' are known for any l without another look at the vectors.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import openmm

from kcons.constraints import Torus
from kcons.constraints.constraint import Constraint
from kcons.errors import KconsError
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program
from kcons.openmm.surfaces.surface_rows import SurfaceRows

#: Newton steps; the number of right digits doubles with each, the first has about (flight/radius)^2.
NEWTON_STEPS = 6
#: Value of F, relative to r (R + r), that counts as solved.
_SOLVED = 1e-12


class TorusRows(SurfaceRows):
    """Atoms on tori of any place and direction."""

    def __init__(self, rows: Sequence[Constraint], n_particles: int) -> None:
        super().__init__(rows, n_particles)
        tori = [item for item in self.rows if isinstance(item, Torus)]
        self._centers = self._gather(*(item.center for item in tori))
        self._axes = self._gather(*(item.axis for item in tori))
        self._major = self._gather(*(item.major_radius for item in tori))
        self._minor = self._gather(*(item.target_at(0.0) for item in tori))

    def declare(self, program: Program) -> None:
        p = program
        self._parameter(p, "t_c", "centre of the torus", self._centers)
        self._parameter(p, "t_n", "unit normal of its plane", self._axes)
        self._parameter(p, "t_major", "radius R of its core", self._major)
        self._parameter(p, "t_minor", "radius r of its tube", self._minor)
        self._parameter(p, "t_on", "1 for particles on a torus", np.ones(len(self.atoms)))
        p.setting("t_solved", "relative residual that counts as solved", _SOLVED)
        p.vector("t_u", "z and U, height over the plane")
        p.vector("t_d", "D, square of the distance from the centre")
        p.vector("t_z", "Z, height over the plane where the particle flew")
        p.vector("t_t", "T, du.G0")
        p.vector("t_l", "l, way back along the kept gradient")
        p.vector("t_off", "relative residual")
        p.vector("t_gradient", "half the gradient of F where the drift began")

    def take_precision(self, program: Program, precision: Precision) -> None:
        program.set("t_solved", max(_SOLVED, 10 * precision.solvers) if precision.name == "single" else _SOLVED)

    def remember(self, program: Program) -> None:
        p = program
        p.each("t_u", "dot(t_n, x-t_c)", "z")
        p.each("t_d", "dot(x-t_c, x-t_c)", "d.d")
        # 1 - t_on keeps the denominators of other particles from zero.
        bend = "t_major/(sqrt(max(0, t_d-t_u*t_u))+1-t_on)"
        p.each("t_gradient", f"t_on*(x-t_c-bend*(x-t_c-t_n*t_u)); bend={bend}", "G0")

    def land(self, program: Program, h: str) -> None:
        self._solve(program, "x-t_c")
        program.each("x", f"select({_SOLVED_EXPRESSION}, x+t_l*t_gradient, x_last)", "onto the surface")

    def fly(self, p: Program, u: str, h: str) -> None:
        self.remember(p)
        p.vector("t_x", "where the particle would fly, from the centre")
        p.each("t_x", f"x+{h}*{u}-t_c", "where it would fly")
        self._solve(p, "t_x")

    def impulse(self, h: str) -> str:
        return f"t_l/{h}*t_gradient"

    def _solve(self, p: Program, d: str) -> None:
        p.each("t_d", f"dot({d}, {d})", "D")
        p.each("t_z", f"dot(t_n, {d})", "Z")
        p.each("t_t", f"dot(t_gradient, {d})", "T")
        p.each("t_l", "0", "start from there")
        for k in range(1, NEWTON_STEPS + 1):
            p.each("t_l", f"t_l-t_on*F/(slope+1-t_on); {_VALUE}", f"Newton step {k}")
        # F relative to r (R + r); beyond the tube, where the surface looks the other way, there is no landing.
        residual = "t_on*select(step(slope), abs(F)/(t_minor*(t_major+t_minor)+1-t_on), 1)"
        p.each("t_off", f"select(step(1e30-t_d), {residual}, t_d); {_VALUE}", "residual; NaN where t_d is NaN")
        self._fail(p, _SOLVED_EXPRESSION, "F = 0 was reached")

    def project(self, program: Program) -> None:
        self.remember(program)
        program.each(
            "v", "v-t_gradient*dot(t_gradient, v)/(dot(t_gradient, t_gradient)+1-t_on)", "tangent to the torus"
        )

    def failure(self, integrator: openmm.CustomIntegrator, step: int) -> KconsError:
        off = self._values(integrator, "t_off")
        return self._error(-off, step, off)


#: F and F' at l, as definitions for an expression.
_VALUE = (
    "slope=2*((rho-t_major)*(t_t+t_minor*t_minor*t_l-z*t_u)/(rho+1-t_on)+z*t_u);"
    " F=(rho-t_major)^2+z*z-t_minor*t_minor;"
    " rho=sqrt(max(0, t_d+2*t_t*t_l+(t_minor*t_l)^2-z*z)); z=t_z+t_u*t_l"
)
_SOLVED_EXPRESSION = "step(t_solved-t_off)"
