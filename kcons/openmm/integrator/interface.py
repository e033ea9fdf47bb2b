"""What parts, ensembles, checks and copies may ask of an integrator; `ProjectedIntegrator` answers."""

from __future__ import annotations

import openmm

from kcons.openmm.integrator.part import Part
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program
from kcons.steppers.splitting import Splitting


class Integrator(openmm.CustomIntegrator):
    """An integrator with a program of its own that holds constraints.

    Besides what stands here it has `ensemble`, `check_every`, `degrees_of_freedom(context)`,
    `applyConstraints(context)` and `applyVelocityConstraints(context)`.

    Attributes
    ----------
    scheme : Splitting or None
        None for the leapfrog.
    parts : tuple of Part
    program : Program
    row_groups : frozenset of int
        Force groups that carry rows, not forces.
    spare : bool
        Whether checks come later where they would take more than a hundredth of the time.
    unseen : bool
        Whether a Simulation is making steps: the state at the end of a call is then read through the Context only.
    """

    scheme: Splitting | None
    parts: tuple[Part, ...]
    program: Program
    row_groups: frozenset[int]
    spare: bool
    unseen: bool

    def take_precision(self, precision: Precision) -> None:
        """The Context is known: tolerances that were left open become those of its platform."""
        raise NotImplementedError
