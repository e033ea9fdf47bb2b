"""Surfaces given by a formula, differentiated by OpenMM.

Two force groups carry s and s^2/2 as energies of each particle. With f1 = -grad s and f2 = -s grad s, and G0 the
gradient where the drift began, a Newton step of s(xu + l G0) = 0 is l += (f2.G0)/(f1.G0)^2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import unit

from kcons.constraints import ImplicitSurface
from kcons.constraints.arguments import ANY, without_units
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError
from kcons.openmm.collective.coordinates import free_groups
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.system_checks import SURFACE_NAME, forces_alone
from kcons.openmm.quantities import number
from kcons.openmm.states import forces_at
from kcons.openmm.surfaces.surface_rows import SurfaceRows

#: Newton steps at most. The loop ends after steps of less than this (nm): the number of right digits doubles.
NEWTON_STEPS = 12
_SOLVED = 1e-9
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
                self._context = forces_alone(system, [[force] for force in self.forces(np.arange(len(self.atoms)))])
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
        p.setting("i_solved", "Newton steps of less than this (nm) are the last", _SOLVED)
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
        program.set("i_solved", max(_SOLVED, 100 * missed))

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
        with p.loop(f"select(step({NEWTON_STEPS}-1-i_count), i_miss, 0) > i_solved^2", "Newton's method"):
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
