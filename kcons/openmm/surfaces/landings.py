"""Surfaces whose landing is known in closed form, or by Newton's method for one number.

Spheres, cylinders, planes and ellipsoids are 2 s(d) = d.Q d + 2 g.d - k = 0 with d = x - c, and G = Q d + g their
gradient. From xu along the gradient G0 where the drift began, x = xu + l G0 lies on the surface where

    A l^2 + 2 B l + S = 0,  A = G0.Q G0,  B = G0.(Q du + g),  S = du.(Q du + 2 g) - k;

l = -S/(B + sqrt(B^2 - A S)) is the root that goes to 0 with the time step, without cancellation. Where Q is a
projector (spheres, circular cylinders) or zero (planes), A = k.

OpenMM interprets scalar products in a CustomIntegrator: a third of a microsecond a particle for each. On platforms that
run on the CPU, two PythonForces can carry positions to a compiled loop instead. The first notes where the drift begins;
the 'force' of the second is the way from where a particle flew to its landing, its 'energy' 1 more than the place of a
particle that finds none, or 0.

Tori: with z = n.d and rho = sqrt(d.d - z^2) the surface is F = (rho - R)^2 + z^2 - r^2 = 0; half its gradient is
G = d - (R/rho) (d - n z), of length r. Along x = xu + l G0

    d.d = D + 2 T l + r^2 l^2,  z = Z + U l,  D = du.du, T = du.G0, Z = n.du, U = n.G0 = z where the drift began,

so that F and F' are known for any l without another look at the vectors.

Formulas: two force groups carry s and s^2/2 as energies of each particle. With f1 = -grad s and f2 = -s grad s, and G0
the gradient where the drift began, a Newton step of s(xu + l G0) = 0 is l += (f2.G0)/(f1.G0)^2.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from threading import get_ident
from typing import Any

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import unit

from kcons.constraints import Cylinder, Ellipsoid, ImplicitSurface, Plane, Sphere, Torus
from kcons.constraints.arguments import ANY, without_units
from kcons.constraints.compilation import njit
from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError
from kcons.openmm.collective.coordinates import free_groups
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.system_checks import SURFACE_NAME, forces_alone
from kcons.openmm.quantities import number
from kcons.openmm.states import forces_at
from kcons.openmm.surfaces.surface_rows import SurfaceRows

#: What `QuadricRows` holds.
QUADRICS = (Sphere, Cylinder, Plane, Ellipsoid)
#: Where drifts began; both callbacks of a System run in turn within one drift. Copies of a System, which have its key,
#: may make steps at the same time, each in a thread of its own.
_STARTS: dict[tuple[str, int], FloatArray] = {}
#: Newton steps; the number of right digits doubles with each, the first has about (flight/radius)^2.
NEWTON_STEPS = 6
#: Value of F, relative to r (R + r), that counts as solved.
_SOLVED = 1e-12


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

    def begin_program(self, code: int) -> None:
        super().begin_program(code)
        self.circles, self._a = False, "s_a"

    def declare(self, program: Program) -> None:
        p = program
        self._parameter(p, "s_c", "center of the surface", self.centers)
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
        p.vector("s_d", "where the particle would fly, from the center")
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
        p.each("s_d", "x-s_c", "from the center")
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


# -- compiled ---------------------------------------------------------------------------------------


class CompiledQuadricRows(QuadricRows):
    """As `QuadricRows`; the drift calls compiled code, where it is that of `SurfaceIntegrator` at constant energy.

    Parameters
    ----------
    rows : sequence of Constraint
    system : openmm.System
        Gets two forces, in two force groups that no other force uses.
    """

    moves = True

    def __init__(self, rows: Sequence[Constraint], system: openmm.System) -> None:
        super().__init__(rows, system.getNumParticles())
        # OpenMM takes particles in rising order.
        self._order = order = np.argsort(self.atoms)
        tables = self.matrices[order], self.centers[order], self.flats[order], self.levels[order]
        free = free_groups(system, 2, "these surfaces")[-2:]
        self._note, self._land = free
        self.groups = frozenset(free)
        key = uuid.uuid4().hex
        for group, callback in ((self._note, _Callback(key)), (self._land, _Callback(key, tables))):
            force = openmm.PythonForce(callback)
            force.setParticles(self.atoms[order].tolist())
            force.setForceGroup(group)
            force.setName(SURFACE_NAME)
            system.addForce(force)

    def _declare_solution(self, p: Program) -> None:
        super()._declare_solution(p)  # for drifts beside which there is more than surfaces
        p.number("s_seen", "0; its computation notes where the drift begins")
        p.number("s_failed", "1 more than the place of a particle without landing, 0 for none")
        if self._others:
            p.vector("s_x", "positions where the drift began")

    def fly_alone(self, p: Program, u: str, h: str) -> None:
        if self._others:
            p.each("s_x", "x", "to come back to")
        with p.when("behind = 0", "x need not be where the last drift ended"):
            p.let("s_seen", f"energy{self._note}", "note where the drift begins")
        p.each("x", f"x+{h}*{u}", "fly; not on the surface")
        p.let("s_failed", f"energy{self._land}", "solve for the landing")
        p.let("failed", f"select(s_failed, {self.code}, failed)", "whether there is one")
        p.each("v", f"select(failed, v, {u}+f{self._land}/{h})", "impulse of the surface")
        landing = f"x+f{self._land}"
        if self._others:  # those on surfaces are carried back where there is no landing
            landing = f"select(failed, s_x, {landing})"
        p.each("x", landing, "onto the surface")

    def failure(self, integrator: openmm.CustomIntegrator, step: int) -> KconsError:
        place = 0 if self.circles else int(integrator.getGlobalVariableByName("s_failed"))
        if not place:
            return super().failure(integrator, step)
        solved = np.ones(len(self.atoms))
        solved[self._order[abs(place) - 1]] = -1.0 if place > 0 else np.nan
        return self._error(solved, step, np.full(len(self.atoms), np.nan))


class _Callback:
    """Notes where the drift begins; with tables, finds the way onto the surfaces.

    Where one particle finds none, all go back to where the drift began.
    """

    def __init__(self, key: str, tables: tuple[FloatArray, ...] = ()) -> None:
        self.key, self.tables = key, tables

    def __call__(self, state: openmm.State) -> tuple[float, FloatArray]:
        x, place = _positions(state), (self.key, get_ident())
        if not self.tables:
            _STARTS[place] = x
            return 0.0, np.zeros_like(x)
        start = _STARTS.get(place)
        if start is None:
            start = x.copy()
        way = np.empty_like(x)
        failed = _land(start, x, *self.tables, way)  # type: ignore[call-arg]
        if failed:
            np.subtract(start, x, out=way)
        # The same sum as in the program: where the next drift begins if nobody moves x.
        _STARTS[place] = np.add(x, way, out=x)
        return float(failed), way


def _positions(state: Any) -> FloatArray:
    # The public getPositions makes the same call, and a Quantity, which takes 20 times as long.
    out = np.empty((state._getNumParticles(), 3))
    state._getVectorAsNumpy(openmm.State.Positions, out)
    return out


@njit(cache=True)
def _land(start, there, matrices, centers, flats, levels, way):  # type: ignore[no-untyped-def]
    """0, or 1 more than the first row without landing; negative if it is not finite."""
    d0, d = np.empty(3), np.empty(3)
    for i in range(len(levels)):
        A = B = 0.0
        S = -levels[i]
        for j in range(3):
            d0[j] = start[i, j] - centers[i, j]
            d[j] = there[i, j] - centers[i, j]
        for j in range(3):
            g0 = g = flats[i, j]
            for k in range(3):
                g0 += matrices[i, j, k] * d0[k]
                g += matrices[i, j, k] * d[k]
            way[i, j] = g0
            B += g0 * g
            S += d[j] * (g + flats[i, j])
        for j in range(3):
            for k in range(3):
                A += way[i, j] * matrices[i, j, k] * way[i, k]
        root = B * B - A * S
        if not root >= 0.0:
            return i + 1 if root < 0.0 else -i - 1
        factor = -S / (B + np.sqrt(root))
        for j in range(3):
            way[i, j] *= factor
    return 0


# -- tori -------------------------------------------------------------------------------------------


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
        self._parameter(p, "t_c", "center of the torus", self._centers)
        self._parameter(p, "t_n", "unit normal of its plane", self._axes)
        self._parameter(p, "t_major", "radius R of its core", self._major)
        self._parameter(p, "t_minor", "radius r of its tube", self._minor)
        self._parameter(p, "t_on", "1 for particles on a torus", np.ones(len(self.atoms)))
        p.setting("t_solved", "relative residual that counts as solved", _SOLVED)
        p.vector("t_u", "z and U, height over the plane")
        p.vector("t_d", "D, square of the distance from the center")
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
        p.vector("t_x", "where the particle would fly, from the center")
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


# -- formulas ---------------------------------------------------------------------------------------

#: Newton steps at most. The loop ends after steps of less than this (nm): the number of right digits doubles.
MOST_STEPS = 12
_LAST_STEP = 1e-9
#: Farther from the surface than this (nm, or this part of the distance from the origin) is no solution.
_MISSED = 1e-12
#: Positions and velocities beyond this count as not finite.
_FAR = 1e9


class ExpressionSurface:
    """Particles on the surface where a formula of x, y, z is zero.

    Parameters
    ----------
    atoms : int or array_like of int, shape (n,)
        The particles, each on the surface by itself.
    expression : str
        As for `openmm.CustomExternalForce`: of x, y, z in nm, the parameters, and intermediate values after ';'.
    parameters : mapping of str to float, Quantity or array_like, shape (n,)
        One number for all particles, or one for each.
    length : float or Quantity
        Length over which the surface bends, in nm; used for its curvature in constraint forces.

    Raises
    ------
    InputError
        Parameters of a wrong shape or not finite; a formula that OpenMM cannot read.

    Examples
    --------
    >>> paraboloid = ExpressionSurface([0, 1], "z - a*(x^2 + y^2)", {"a": [0.5, 0.7]})
    """

    def __init__(
        self,
        atoms: ArrayLike,
        expression: str,
        parameters: Mapping[str, ArrayLike] | None = None,
        *,
        length: unit.Quantity | float = 1.0,
    ) -> None:
        self.atoms: IntArray = np.atleast_1d(np.asarray(atoms, dtype=np.int64))
        self.expression = expression
        self.parameters: dict[str, FloatArray] = {}
        self.length = number(length, unit.nanometer, "length")
        for name, value in (parameters or {}).items():
            plain, _ = without_units(value, f"parameter {name!r}", ANY)
            array = np.asarray(plain, dtype=np.float64)
            if array.shape not in ((), self.atoms.shape) or not np.all(np.isfinite(array)):
                raise InputError(
                    f"parameter {name!r} of {expression!r} must be one finite number, or one for each of the "
                    f"{len(self.atoms)} particles",
                    item=name,
                )
            self.parameters[name] = np.broadcast_to(array, self.atoms.shape)
        self._context: openmm.Context | None = None

    def forces(self, atoms: IntArray) -> tuple[openmm.CustomExternalForce, openmm.CustomExternalForce]:
        """s and s^2/2 as forces on these particles."""
        # The formula may define intermediate values after its first ';'.
        value, *rest = self.expression.split(";", 1)
        tail = "".join(";" + part for part in rest)
        pair = (
            openmm.CustomExternalForce(self.expression),
            openmm.CustomExternalForce(f"0.5*kcons_value^2; kcons_value={value}{tail}"),
        )
        for force in pair:
            for name in self.parameters:
                force.addPerParticleParameter(name)
            for k, atom in enumerate(atoms):
                force.addParticle(int(atom), [float(values[k]) for values in self.parameters.values()])
        return pair

    def rows(self) -> ImplicitSurface:
        """The same as a kcons object, evaluated by OpenMM in double precision."""
        return ImplicitSurface(
            self.atoms,
            self._value,
            self._gradient,
            length=self.length,
        )

    def _value(self, r: FloatArray) -> FloatArray:
        return self._evaluate(r)[0]

    def _gradient(self, r: FloatArray) -> FloatArray:
        return self._evaluate(r)[1]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_context": None}

    def _evaluate(self, r: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Value and gradient at positions of shape (n, 3)."""
        if self._context is None:
            system = openmm.System()
            for _ in self.atoms:
                system.addParticle(1.0)
            try:
                self._context = forces_alone(system, self.forces(np.arange(len(self.atoms))))
            except openmm.OpenMMException as error:
                raise InputError(f"OpenMM cannot read {self.expression!r}: {error}", item="expression") from None
        self._context.setPositions(np.ascontiguousarray(r))
        f1, f2 = (forces_at(self._context, {group}) for group in (0, 1))
        with np.errstate(all="ignore"):
            return np.einsum("ij,ij->i", f1, f2) / np.einsum("ij,ij->i", f1, f1), -f1


class ImplicitRows(SurfaceRows):
    """Particles on surfaces given by formulas.

    Parameters
    ----------
    surfaces : sequence of ExpressionSurface
    system : openmm.System
        Gets two forces for each surface, in two force groups that no other force uses.
    """

    evaluates = True

    def __init__(self, surfaces: Sequence[ExpressionSurface], system: openmm.System) -> None:
        super().__init__([surface.rows() for surface in surfaces], system.getNumParticles())
        free = free_groups(system, 2, "these surfaces")[-2:]
        self._pair = tuple(free)
        self.groups = frozenset(free)
        for surface in surfaces:
            surface.rows().measure(np.zeros((len(surface.atoms), 1, 3)), 0.0)  # a formula that cannot be read
            for group, force in zip(free, surface.forces(surface.atoms), strict=True):
                force.setForceGroup(group)
                force.setName(SURFACE_NAME)
                system.addForce(force)

    def declare(self, program: Program) -> None:
        p = program
        self._parameter(p, "i_on", "1 for particles on a surface given by a formula", np.ones(len(self.atoms)))
        p.setting("i_solved", "Newton steps of less than this (nm) are the last", _LAST_STEP)
        p.setting("i_missed", "farther from the surface than this (nm) is no solution", _MISSED)
        p.vector("i_gradient", "minus gradient where the drift began")
        p.vector("i_slope", "f1, minus gradient of the formula")
        p.vector("i_step", "f2, then the Newton step")
        p.number("i_count", "Newton steps done")
        p.number("i_miss", "sum of squares of the last Newton steps, in nm^2")

    def take_precision(self, program: Program, precision: Precision) -> None:
        """Formulas are Forces, whose gradients are of the size of 1 kJ/mol/nm."""
        missed = max(_MISSED, precision.forces, 10 * precision.force_step)
        program.set("i_missed", missed)
        program.set("i_solved", max(_LAST_STEP, 100 * missed))

    def _look(self, p: Program) -> None:
        one, two = self._pair
        # Force groups must not appear in vector expressions.
        p.each("i_slope", f"f{one}", "minus gradient")
        p.each("i_step", f"f{two}", "minus value times gradient")
        p.each(
            "i_step",
            "-i_gradient*dot(i_step, i_gradient)/(dot(i_slope, i_gradient)^2+1-i_on)*i_on",
            "what a Newton step takes away from x",
        )

    def remember(self, program: Program) -> None:
        program.each("i_gradient", f"f{self._pair[0]}", "minus the gradient")

    def land(self, program: Program, h: str) -> None:
        p = program
        p.vector("i_push", "way from where the particle flew to its landing")
        p.each("i_push", f"select(step({_FAR}-abs(x)), 0, x)", "no Newton step yet; NaN or huge is left as it is")
        p.each("x", f"select(step({_FAR}-abs(x)), x, x_last)", "only finite positions may be looked at")
        self._solve(p)
        p.each("x", "select(failed, x_last, x)", "a failed step goes nowhere")

    def fly(self, p: Program, u: str, h: str) -> None:
        self.remember(p)
        p.vector("i_x", "positions where the drift began")
        p.vector("i_push", "way from where the particle would fly to its landing")
        p.each("i_x", "x", "to come back to")
        p.each("i_push", f"select(step({_FAR}-abs({u})), 0, {u})", "no Newton step yet; NaN or huge is left as it is")
        p.each("x", f"select(i_on*step({_FAR}-abs({u})), x+{h}*{u}, x)", "where it would fly")
        self._solve(p)
        p.each("x", "i_x", "back, until all landings are known")

    def impulse(self, h: str) -> str:
        return f"i_push/{h}"

    def _solve(self, p: Program) -> None:
        """Newton's method, x moving."""
        p.let("i_count", "0", "no Newton step yet")
        p.let("i_miss", "1", "not yet on the surfaces")
        with p.loop(f"select(step({MOST_STEPS}-1-i_count), i_miss, 0) > i_solved^2", "Newton's method"):
            self._look(p)
            p.each("x", "x-select(step(1-abs(i_step)), i_step, 0)", "nearer to the surface, never far away")
            p.each("i_push", "i_push-i_step", "the way so far")
            p.sum("i_miss", "i_step^2", "how far they moved")
            p.let("i_count", "i_count+1", "one more")
        self._look(p)
        self._fail(
            p,
            f"step(i_missed*(1+abs(x))-abs(i_step))*step({_FAR}-abs(i_push))",
            "the next Newton step moves no particle",
        )

    def project(self, program: Program) -> None:
        p = program
        self.remember(p)
        p.each("v", "v-i_gradient*dot(i_gradient, v)/(dot(i_gradient, i_gradient)+1-i_on)", "tangent to the surface")

    def failure(self, integrator: openmm.CustomIntegrator, step: int) -> KconsError:
        step_, push = (
            np.array([[v[0], v[1], v[2]] for v in integrator.getPerDofVariableByName(name)])[self.atoms]
            for name in ("i_step", "i_push")
        )
        miss = np.sqrt(np.einsum("ij,ij->i", step_, step_))
        # Also NaN where it is NaN.
        finite = np.all(np.abs(push) <= _FAR, axis=1)
        return self._error(np.where(finite, -miss, np.nan), step, miss)
