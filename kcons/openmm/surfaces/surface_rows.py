"""Particles that are each on one surface, as a part of an integrator: a program, checks, errors.

The value of a row, less its target, is an expression of OpenMM, which differentiates it. Two force groups carry s and
s^2/2 as energies of each particle. With f1 = -grad s and f2 = -s grad s, and G0 the gradient where the drift began, a
Newton step of s(xu + l G0) = 0 is l += (f2.G0)/(f1.G0)^2. Where all surfaces are spheres, nothing else is held
and the scheme has exact flights, drifts are great circles, which need neither.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import openmm
from openmm import unit

from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError, KconsError, NonFiniteError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.openmm.collective.coordinates import free_groups
from kcons.openmm.device.c_writer import openmm_expression
from kcons.openmm.device.held_rows import function_on_device
from kcons.openmm.integrator.part import BOND, NEAR, Part, Solver, Violation
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.system_checks import SURFACE_NAME, refuse_agents, require_context
from kcons.openmm.quantities import masses_of
from kcons.openmm.states import motion_of, positions_of

#: A start that is farther from its surface (nm), or has a larger share of its velocity across it, is refused.
START_TOLERANCE = 1e-6
CARRIER = "hold them with kcons' constraint objects instead, by the carrier (kcons.openmm.hold)"
#: Newton steps at most. The loop ends after steps of less than this (nm): the number of right digits doubles, so that
#: the last of them ends within rounding of the surface.
MOST_STEPS = 12
_LAST_STEP = 1e-9
#: Farther than this, in gradients, no Newton step goes.
_FARTHEST = 5
#: What such a step may be larger by, for each nm from the origin.
_MISSED = 1e-12
#: Positions and velocities beyond this count as not finite.
_FAR = 1e9


class SurfaceRows(Part):
    """Particles that are each on one surface, as a `Part` of an integrator.

    Parameters
    ----------
    rows : sequence of Constraint
        kcons objects over one atom a row, lengths in nm, with explicit targets that rest.
    system : openmm.System
        Gets two forces for each object, in two force groups that no other force uses.

    Raises
    ------
    UnsupportedError
        A row that is no expression; force groups that are lacking.
    """

    evaluates = True

    def __init__(self, rows: Sequence[Constraint], system: openmm.System) -> None:
        self.given = tuple(rows)
        self.atoms: IntArray = np.concatenate([item.atoms[:, 0] for item in self.given])
        self.n_particles = system.getNumParticles()
        self.alone = system.getNumConstraints() == 0
        self.flies_exactly = all(item.family == "Sphere" for item in self.given)
        pairs = [_forces(item) for item in self.given]
        self._pair = tuple(free_groups(system, 2, "these surfaces")[-2:])
        self.groups = frozenset(self._pair)
        for pair in pairs:
            for group, force in zip(self._pair, pair, strict=True):
                force.setForceGroup(group)
                force.setName(SURFACE_NAME)
                system.addForce(force)

    # -- the program ----------------------------------------------------------------------------

    def declare(self, program: Program) -> None:
        p = program
        on = np.zeros((self.n_particles, 3))
        on[self.atoms] = 1.0
        p.vector_setting("i_on", "1 for particles on a surface", on)
        p.setting("i_solved", "Newton steps of less than this (nm) are the last", _LAST_STEP)
        p.setting("i_missed", "how much larger they may be for each nm from the origin", _MISSED)
        p.vector("i_gradient", "minus gradient where the drift began")
        p.vector("i_slope", "f1, minus gradient of the row")
        p.vector("i_step", "f2, then the Newton step")
        p.vector("i_push", "way from where the particle flew to its landing")
        p.number("i_count", "Newton steps done")
        p.number("i_miss", "sum of squares of the last Newton steps, in nm^2")
        p.number("unsolved", "how many degrees of freedom found no solution")
        if self.flies_exactly:
            center, square = np.zeros((2, self.n_particles, 3))
            center[self.atoms] = np.concatenate([item.parameters() for item in self.given])
            square[self.atoms] = np.concatenate([item.target_at(0.0) ** 2 for item in self.given])[:, None]
            p.vector_setting("i_center", "centers of spheres", center)
            p.vector_setting("i_square", "squares of their radii", square)

    def take_precision(self, program: Program, precision: Precision) -> None:
        """Rows are Forces, whose gradients are of the size of 1 kJ/mol/nm."""
        missed = max(_MISSED, precision.forces, 10 * precision.force_step)
        program.set("i_missed", missed)
        program.set("i_solved", max(_LAST_STEP, 100 * missed))

    def remember(self, program: Program) -> None:
        program.each("i_gradient", f"f{self._pair[0]}", "minus the gradient")

    def land(self, program: Program, h: str) -> None:
        p = program
        p.each("i_push", f"select(step({_FAR}-abs(x)), 0, x)", "no Newton step yet; NaN or huge is left as it is")
        p.each("x", f"select(step({_FAR}-abs(x)), x, x_last)", "only finite positions may be looked at")
        p.let("i_count", "0", "no Newton step yet")
        p.let("i_miss", "1", "not yet on the surfaces")
        with p.loop(f"select(step({MOST_STEPS}-1-i_count), i_miss, 0) > i_solved^2", "Newton's method"):
            # Force groups must not appear in vector expressions.
            p.each("i_slope", f"f{self._pair[0]}", "minus gradient")
            p.each("i_step", f"f{self._pair[1]}", "minus value times gradient")
            p.each(
                "i_step",
                f"-i_on*i_gradient*min({_FARTHEST}, max(-{_FARTHEST}, "
                "dot(i_step, i_gradient)/(dot(i_slope, i_gradient)^2+1-i_on)))",
                "what a Newton step takes away from x, never far away",
            )
            p.each("x", "x-i_step", "nearer to the surface")
            p.each("i_push", "i_push-i_step", "the way so far")
            p.sum("i_miss", "i_step^2", "how far they moved")
            p.let("i_count", "i_count+1", "one more")
        small = f"step(i_solved+i_missed*abs(x)-abs(i_step))*step({_FAR}-abs(i_push))"
        p.sum(
            "unsolved", f"1-{small}*step(dot(i_slope, i_gradient))", "the last step is small, the gradient not reversed"
        )
        p.let("failed", f"select(unsolved, {self.code}, failed)", "which part has no solution")
        p.each("x", "select(failed, x_last, x)", "a failed step goes nowhere")

    def land_alone(self, program: Program, u: str, h: str) -> None:
        """No velocity is a difference of positions, whose rounding grows as 1/h."""
        if self.exact:
            self._turn(program, u, h)
            return
        self.remember(program)
        program.each("x", f"x+{h}*{u}", "fly; not on the surface")
        self.land(program, h)
        program.each("v", f"select(failed, v, {u}+i_push/{h})", "impulse of the surface")

    def _turn(self, p: Program, u: str, h: str) -> None:
        """Along great circles, exact for any h.

        d = x - c turns in the plane of d and the tangent velocity u: with w = |u|/R, x = c + d cos(wh) + u sin(wh)/w
        and v = u cos(wh) - d w sin(wh). d is brought to the length R on the way, so that rounding does not add up.
        """
        p.each("i_step", "x-i_center", "from the center")
        p.each("v", f"{u}-i_on*i_step*dot(i_step, {u})/(dot(i_step, i_step)+(1-i_on))", "along the sphere")
        p.each("i_push", "1e-30+i_on*sqrt(dot(v, v)/(i_square+(1-i_on)))", "w = |v|/R, never quite 0")
        p.each("i_step", "i_step*(1-i_on+i_on*sqrt(i_square/(dot(i_step, i_step)+(1-i_on))))", "of the length R")
        p.sum("unsolved", f"1-step({_FAR}-i_push)*step({_FAR}-abs(v))", "velocities are finite")
        p.let("failed", f"select(unsolved, {self.code}, failed)", "which part has no solution")
        p.each(
            "x",
            f"select(failed, x, i_center+i_step*cos(i_push*{h})+v*sin(i_push*{h})/i_push)",
            "turn the position",
        )
        p.each("v", f"select(failed, v, v*cos(i_push*{h})-i_on*i_step*i_push*sin(i_push*{h}))", "turn the velocity")

    def project(self, program: Program) -> None:
        p = program
        self.remember(p)
        p.each("v", "v-i_gradient*dot(i_gradient, v)/(dot(i_gradient, i_gradient)+1-i_on)", "tangent to the surface")

    # -- running --------------------------------------------------------------------------------

    def row_name(self, k: int) -> str:
        """For example 'Sphere(4)'."""
        for item in self.given:
            if k < item.n_rows:
                return item.row_name(k)
            k -= item.n_rows
        raise IndexError(k)

    def distances(self, x: FloatArray) -> FloatArray:
        """How far each atom is from its surface in nm (to first order), from positions of all particles."""
        found = []
        for item in self.given:
            r = x[item.atoms]
            slope = item.gradient(r, 0.0)[:, 0]
            found.append((item.measure(r, 0.0) - item.target_at(0.0)) / np.sqrt(np.einsum("ij,ij->i", slope, slope)))
        return np.concatenate(found)

    def normals(self, x: FloatArray) -> FloatArray:
        """Unit normals, shape (n_rows, 3)."""
        slopes = np.concatenate([item.gradient(x[item.atoms], 0.0)[:, 0] for item in self.given])
        return np.asarray(slopes / np.sqrt(np.einsum("ij,ij->i", slopes, slopes))[:, None])

    def attach(self, program: Program, context: openmm.Context) -> None:
        """Refuse another number of particles than the variables of the program have."""
        found = context.getSystem().getNumParticles()
        if found != self.n_particles:
            raise InputError(
                f"surfaces were made for {self.n_particles} particles, and the System has {found}; make them again "
                "for this one",
                item="system",
            )

    def check(self, context: openmm.Context, velocities: bool = True) -> None:
        """Raise `InputError` unless all atoms are on their surfaces with velocities along them.

        And `UnsupportedError` for a System that surfaces do not go with.
        """
        refuse_system(context.getSystem(), self.atoms)
        require_context(context)
        x, v = motion_of(context)
        miss = self._worst(x, v if velocities else None)
        if miss is None:
            return
        off = (
            f"is {abs(miss.off):.3g} nm from its surface, {miss.name}; move it there with integrator.applyConstraints("
        )
        off += "context). (Surfaces are not repeated in periodic boxes: positions must not be wrapped)"
        if miss.what == "velocities":
            off = f"has the velocity {abs(miss.off):.3g} nm/ps across its surface, {miss.name}; call "
            off += "integrator.applyVelocityConstraints(context) after velocities are set"
        raise InputError(f"particle {miss.atoms[0]} {off}", item=miss.what, atoms=miss.atoms)

    def worst_violation(self, context: openmm.Context, velocities: bool = True) -> Violation | None:
        """Distances from the surfaces and velocities across them, by the objects that were given."""
        require_context(context)
        x, v = motion_of(context)
        return self._worst(x, v if velocities else None)

    def _worst(self, x: FloatArray, v: FloatArray | None) -> Violation | None:
        first = 0
        for item in self.given:
            item.check(x[item.atoms], 0.0, first)
            first += item.n_rows
        allowed = START_TOLERANCE * np.maximum(1.0, np.abs(x[self.atoms]).max(axis=1))
        near = NEAR * np.concatenate([_length(item) for item in self.given])
        miss = Violation.worst("positions", self.distances(x), allowed, self.row_name, self._atoms_of, near)
        if miss is not None or v is None:
            return miss
        held = v[self.atoms]
        across = np.einsum("ij,ij->i", self.normals(x), held)
        speed = np.sqrt(np.einsum("ij,ij->i", held, held))
        allowed = START_TOLERANCE * np.maximum(speed, np.abs(v).max())
        return Violation.worst("velocities", across, allowed, self.row_name, self._atoms_of)

    def _atoms_of(self, row: int) -> list[int]:
        return [int(self.atoms[row])]

    def solver_at(self, context: openmm.Context) -> Solver:
        """The engine for these atoms."""
        require_context(context)
        return Solver(engine(context, self.given, positions_of(context)), self.atoms)

    def rank(self, context: openmm.Context) -> int:
        """One for each atom: rows on different atoms are independent."""
        return len(self.atoms)

    def failure(self, integrator: openmm.CustomIntegrator, step: int) -> KconsError:
        last, push = (
            np.array([[v[0], v[1], v[2]] for v in integrator.getPerDofVariableByName(name)])[self.atoms]
            for name in ("i_step", "i_push")
        )
        unknown = np.flatnonzero(~np.all(np.abs(push) <= _FAR, axis=1))  # also where it is NaN
        if len(unknown):
            atom = int(self.atoms[unknown[0]])
            return NonFiniteError(
                f"step {step}: the force on particle {atom} or its velocity is no finite number; positions and "
                "velocities are those of the last state that was finite",
                item="force",
                atom=atom,
                step=step,
            )
        miss = np.sqrt(np.einsum("ij,ij->i", last, last))
        k = int(np.argmax(miss))
        atom = int(self.atoms[k])
        return ConvergenceError(
            f"step {step}: particle {atom} finds no position on its surface, {self.row_name(k)}: time step too "
            "large; positions and velocities are those before the step",
            residual=float(miss[k]),
            row=k,
            atoms=[atom],
            step=step,
        )


def _forces(item: Constraint) -> tuple[openmm.CustomExternalForce, openmm.CustomExternalForce]:
    """s, value less target, and s^2/2 as forces on the particles of an object."""
    value = openmm_expression(function_on_device(item))
    pair = (
        openmm.CustomExternalForce(f"row_value-row_target; {value}"),
        openmm.CustomExternalForce(f"0.5*(row_value-row_target)^2; {value}"),
    )
    numbers = np.column_stack([item.target_at(0.0), item.parameters().reshape(item.n_rows, -1)])
    for force in pair:
        for name in ("row_target", *(f"row_p{k}" for k in range(numbers.shape[1] - 1))):
            force.addPerParticleParameter(name)
        for atom, values in zip(item.atoms[:, 0].tolist(), numbers.tolist(), strict=True):
            force.addParticle(atom, values)
    return pair


def _length(item: Constraint) -> FloatArray:
    """Of each row, the radius of its surface; that of a bond for planes and formulas, which have none."""
    radius = np.zeros(item.n_rows) if item.family == "Plane" else item.scale(0.0)
    return np.where(radius > 0, radius, BOND)


def engine(context: openmm.Context, rows: Sequence[Constraint], x: FloatArray) -> Motion:
    """The solver of kcons for the atoms of rows alone, in their order, at positions x of all particles."""
    system, atoms = context.getSystem(), np.concatenate([item.atoms[:, 0] for item in rows])
    new_index = np.zeros(system.getNumParticles(), dtype=np.int64)
    new_index[atoms] = np.arange(len(atoms))
    own = [item.renumbered(new_index) for item in rows]
    return Motion(ConstraintSet(own, x[atoms], masses_of(system)[atoms]), x[atoms])


def refuse_system(system: openmm.System, atoms: IntArray) -> None:
    """Raise `UnsupportedError` where the System has something that surfaces do not go with."""
    held = set(atoms.tolist())
    for k in range(system.getNumConstraints()):
        i, j, _ = system.getConstraintParameters(k)
        for atom in held & {i, j}:
            raise UnsupportedError(
                f"particle {atom} is on a surface and in the System's constraint ({i}, {j}): each would undo the "
                f"other; take that constraint out of the System and {CARRIER}"
            )
    for atom in sorted(held):
        if system.getParticleMass(atom).value_in_unit(unit.dalton) == 0:
            raise UnsupportedError(
                f"particle {atom} has no mass and is not moved by integrators: it cannot be held on a surface"
            )
    refuse_agents(system, "a surface")
