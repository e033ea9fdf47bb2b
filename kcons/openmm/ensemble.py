"""How velocities change between the drifts: what a statistical ensemble adds to an integrator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from kcons.openmm.program import Program


class Ensemble(Protocol):
    """The kicks of an integrator."""

    def declare(self, program: Program) -> None:
        """Variables and tables."""
        ...

    def kick(self, program: Program, h: str, force: str, impulse: str, project: Callable[[], None]) -> None:
        """Let the applied forces act for a time.

        For h = 0 it must do nothing but add the impulse: so the constraints are applied alone.

        Parameters
        ----------
        program : Program
        h : str
            Expression of the time.
        force : str
            Name of the applied forces.
        impulse : str
            Expression that is to be added to v before (that of the drift that came before), or ''.
        project : callable
            Writes the computations that make v tangent to all constraints at x.
        """
        ...


class ConstantEnergy:
    """Newton's equations: v += h f/m."""

    def declare(self, program: Program) -> None:
        pass

    def kick(self, program: Program, h: str, force: str, impulse: str, project: Callable[[], None]) -> None:
        if impulse:
            program.each("v", f"v+{impulse}+{h}*{force}/m", "the constraint forces act, then the applied ones (kick)")
        else:
            program.each("v", f"v+{h}*{force}/m", "the applied forces act (kick)")
