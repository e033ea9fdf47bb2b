"""The integrator: kicks and constrained drifts in turn, to order 2, 4 or 6."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import openmm
from openmm import unit

from kcons.errors import InputError, UnsupportedError
from kcons.openmm.part import Part
from kcons.openmm.program import Program
from kcons.steppers import (
    BlanesMoan4,
    BlanesMoan6,
    BlanesMoan6a,
    Geodesic,
    KahanLi6,
    Rattle,
    Splitting,
    Suzuki4,
    Yoshida4,
)

#: Schemes by name.
SCHEMES: dict[str, type[Splitting]] = {
    "rattle": Rattle,
    "geodesic": Geodesic,
    "suzuki4": Suzuki4,
    "yoshida4": Yoshida4,
    "kahan-li6": KahanLi6,
    "blanes-moan4": BlanesMoan4,
    "blanes-moan6": BlanesMoan6,
    "blanes-moan6a": BlanesMoan6a,
}
LEAPFROG = "leapfrog"


class ProjectedIntegrator(openmm.CustomIntegrator):
    """Dynamics at constant energy on the constraints of the System, and on more where asked.

    One step is that of the same stepper in `kcons.steppers`: kicks v += h f/m, drifts along the constraints, and a
    projection of v at the end. The System's own constraints are solved by OpenMM (SETTLE, CCMA, SHAKE): its
    `constrainVelocities` is the projector M_par^+ M, its `constrainPositions` the drift's solve. Only the tolerance
    limits the accuracy.

    Parameters
    ----------
    timestep : Quantity or float
        In ps if a float.
    scheme : str or Splitting
        'rattle' (velocity Verlet), 'geodesic', 'suzuki4', 'yoshida4', 'kahan-li6', 'blanes-moan4', 'blanes-moan6',
        'blanes-moan6a', or a splitting of kcons.steppers; 'leapfrog' for systems with virtual sites.
    parts : sequence of Part
        What else to hold: collective variables, surfaces, constraint objects of kcons.
    tolerance : float
        Relative tolerance of the System's constraints.

    Raises
    ------
    InputError, UnsupportedError
        A time step that is no finite number, an unknown scheme, parts that do not go together.
    """

    def __init__(
        self,
        timestep: unit.Quantity | float,
        scheme: str | Splitting = "rattle",
        *,
        parts: Sequence[Part] = (),
        tolerance: float = 1e-10,
    ) -> None:
        dt = timestep.value_in_unit(unit.picoseconds) if unit.is_quantity(timestep) else float(timestep)
        if not np.isfinite(dt):
            raise InputError(f"the time step is {timestep}; give a finite one", item="timestep")
        super().__init__(dt)
        self.setConstraintTolerance(tolerance)
        self.scheme = _scheme(scheme)
        self.parts = tuple(parts)
        if sum(part.meets_system for part in self.parts) > 1:
            raise UnsupportedError("only one part may share atoms with the constraints of the System")
        for k, part in enumerate(self.parts, start=1):
            part.code = k
        groups = frozenset().union(*(part.groups for part in self.parts)) if self.parts else frozenset()
        self.row_groups: frozenset[int] = groups
        if groups:
            self.setIntegrationForceGroups({g for g in range(32) if g not in groups})
        self.program = Program(self)
        self._write(self.program)

    # -- the program ----------------------------------------------------------------------------

    def _write(self, p: Program) -> None:
        #: Where parts evaluate row groups, the applied forces are kept here: OpenMM remembers the last groups only.
        self._kept = any(part.evaluates for part in self.parts)
        self._force = p.vector("force", "applied forces at x") if self._kept else "f"
        p.vector("xu", "positions before constraints act on them")
        for part in self.parts:
            part.declare(p)
        if not self.parts:
            p.let_others_act()
            self._write_step(p)
            return
        p.number("failed", "number of the part whose solve failed, 0 for none")
        p.number("good_steps", "steps done since the integrator was made")
        p.number("stale", "whether forces must be computed anew", 1.0)
        p.number("moved", "how far others have moved x since the last step")
        p.vector("x_last", "positions after the last good step")
        p.vector("v_last", "velocities after the last good step")
        p.let_others_act()
        with p.when("failed = 0", "after a failure nothing moves"):
            p.sum("moved", "(x-x_last)^2", "barostats and setPositions move x between steps")
            with p.when("moved + stale != 0", "others did"):
                p.each("x_last", "x", "start here")
                if self._kept:
                    p.each("force", "f", "applied forces")
            p.let("stale", "0", "forces belong to x")
            p.each("v_last", "v", "to come back to")
            self._write_step(p)
            with p.when("failed = 0", "the step is good"):
                p.each("x_last", "x", "positions of the last good step")
                p.let("good_steps", "good_steps+1", "count it")
            with p.when("failed != 0", "a solve failed"):
                p.each("x", "x_last", "back to where the step began")
                p.each("v", "v_last", "back to where the step began")
                p.let("stale", "1", "forces are those of elsewhere")

    def _write_step(self, p: Program) -> None:
        scheme = self.scheme
        if scheme is None:
            p.each("v", "v+dt*f/m", "kick from half a step before x to half a step after")
            self._drift(p, "dt")
            return
        flat = [a * w for a in scheme.drifts for w in scheme.flight]
        # Kicks before each piece of a drift, and after the last.
        kicks = [0.0] * (len(flat) + 1)
        every = len(scheme.flight)
        first = 0 if scheme.kick_first else every
        for k, b in enumerate(scheme.kicks):
            kicks[first + k * every] = b
        if len(flat) == 1:
            p.each("v", f"v+{kicks[0]!r}*dt*{self._force}/m", "kick")
            self._drift(p, "dt")
            self._evaluate(p)
            p.each("v", f"v+{kicks[1]!r}*dt*{self._force}/m", "kick")
        else:
            p.table("drift_share", flat, "length of each drift as a fraction of the step")
            p.table("kick_share", kicks, "length of the kick before drift k as a fraction of the step")
            p.number("stage", "number of the drift")
            p.number("h", "length of the drift")
            p.let("stage", "0", "first drift")
            if kicks[0]:
                p.each("v", f"v+{kicks[0]!r}*dt*{self._force}/m", "kick")
            with p.loop(f"stage < {len(flat)}", "all drifts and kicks of the scheme"):
                p.let("h", "dt*drift_share(stage)", "length of this drift")
                self._drift(p, "h")
                p.let("stage", "stage+1", "what follows")
                with p.when("kick_share(stage) != 0", "a kick follows"):
                    self._evaluate(p)
                    p.each("v", f"v+dt*kick_share(stage)*{self._force}/m", "kick")
        p.hold_velocities("tangent to the constraints of the System")
        for part in self.parts:
            part.project(p)

    def _evaluate(self, p: Program) -> None:
        if self._kept:
            p.each("force", "f", "applied forces")

    def _drift(self, p: Program, h: str) -> None:
        """Fly h along all constraints; v takes the impulse that keeps x on them."""
        for part in self.parts:
            part.remember(p)
        p.each("x", f"x+{h}*v", "fly")
        p.each("xu", "x", "unconstrained")
        apart = [part for part in self.parts if not part.meets_system]
        for part in apart:
            part.land(p, h)
        together = [part for part in self.parts if part.meets_system]
        if together:
            together[0].land(p, h)
        else:
            p.hold_positions("onto the constraints of the System")
        p.each("v", f"v+(x-xu)/{h}", "impulse of the constraints")

    # -- running --------------------------------------------------------------------------------

    def step(self, steps: int) -> None:
        """Make `steps` steps.

        Raises
        ------
        KconsError
            A solve of one of the parts failed: positions and velocities are those before that step, `error.step` is
            its number.
        """
        if not self.parts:
            super().step(steps)
            return
        for _ in range(steps):
            super().step(1)
            code = int(self.getGlobalVariableByName("failed"))
            if code:
                number = int(self.getGlobalVariableByName("good_steps")) + 1
                self.setGlobalVariableByName("failed", 0.0)
                raise self.parts[code - 1].failure(self, number)

    def listing(self) -> str:
        """The steps of the integrator, in words."""
        return self.program.listing()


def _scheme(scheme: str | Splitting) -> Splitting | None:
    if isinstance(scheme, Splitting):
        return scheme
    if scheme == LEAPFROG:
        return None
    if scheme not in SCHEMES:
        known = ", ".join((*SCHEMES, LEAPFROG))
        raise InputError(f"no scheme {scheme!r}; known: {known}", item="scheme")
    return SCHEMES[scheme]()
