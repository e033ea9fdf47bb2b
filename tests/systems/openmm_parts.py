"""A part for tests, small enough to be seen to be right."""

from __future__ import annotations

import numpy as np

from kcons.errors import ConvergenceError, InputError
from kcons.openmm import positions_of, velocities_of
from kcons.openmm.integrator.part import Part, Violation


class HeldCoordinates(Part):
    """Particles that stay at one value of one coordinate.

    `steepest` is the largest displacement that is accepted in one drift; beyond it the part fails.
    """

    def __init__(self, particles, axis, value, n, *, steepest=np.inf, groups=()):
        self.mask = np.zeros((n, 3))
        self.mask[list(particles), axis] = 1.0
        self.value, self.steepest = value, steepest
        self.groups = frozenset(groups)
        self.particles, self.axis = list(particles), axis

    def declare(self, program):
        program.vector("held", "1 where a coordinate is held")
        program.setting("level", "where it is held", self.value)
        program.number("steepest", "longest way accepted", self.steepest)
        program.number("off", "how far off it was")
        if self.groups:
            program.vector("row", "gradient")

    def attach(self, program, context):
        program.integrator.setPerDofVariableByName("held", self.mask.tolist())

    def remember(self, program):
        for group in self.groups:
            program.each("row", f"-f{group}", "a row group")

    def land(self, program, h):
        program.sum("off", "held*(x-level)^2", "how far off")
        program.each("x", "x-held*(x-level)", "back to the level")
        program.let("failed", f"select(step(off-steepest*abs(steepest)),{self.code},failed)", "too far is a failure")

    def project(self, program):
        program.each("v", "v*(1-held)", "at rest across")

    def check(self, context, velocities=True):
        miss = np.abs(positions_of(context)[self.particles, self.axis] - self.value).max(initial=0.0)
        if miss > 1e-9:
            raise InputError(f"off the level by {miss:.3g}", item="positions")

    def worst_violation(self, context, velocities=True):
        def worst(what, off):
            return Violation.worst(what, off, 1e-9, lambda k: f"coordinate of {self.particles[k]}", lambda k: [])

        x, v = (read(context)[self.particles, self.axis] for read in (positions_of, velocities_of))
        return worst("positions", x - self.value) or (worst("velocities", v) if velocities else None)

    def apply_positions(self, context):
        x = positions_of(context).copy()
        x[self.particles, self.axis] = self.value
        context.setPositions(x)

    def apply_velocities(self, context):
        context.setVelocities(velocities_of(context) * (1 - self.mask))

    def failure(self, integrator, step):
        return ConvergenceError("too steep", step=step)

    def rank(self, context):
        return len(self.particles)
