"""What a platform of OpenMM can hold: the precision of its numbers, and what follows for tolerances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import openmm

from kcons.steppers.state import START_TOLERANCE

#: The tolerance of the System's constraints unless another is asked for, by precision. In single precision velocities
#: cannot be brought closer than to some 1e-6: OpenMM's solver would go on to its last iteration.
TOLERANCES = {"double": 1e-10, "mixed": 1e-8, "single": 1e-5}
#: Unit roundoff of single numbers.
SINGLE = 2.0**-24


@dataclass(frozen=True)
class Precision:
    """The precision in which the platform of a Context computes.

    Attributes
    ----------
    platform : str
    name : {'double', 'mixed', 'single'}
        Reference and CPU integrate in double. CUDA, HIP and OpenCL have a property for it: 'mixed' computes forces in
        single and integrates in double; positions are pairs of single numbers.
    """

    platform: str
    name: str

    @classmethod
    def of(cls, context: openmm.Context) -> Precision:
        """That of a Context."""
        platform = context.getPlatform()
        given = "Precision" in platform.getPropertyNames()
        return cls(platform.getName(), platform.getPropertyValue(context, "Precision") if given else "double")

    def __str__(self) -> str:
        return f"{self.platform}, {self.name} precision"

    @property
    def rounds_lengths(self) -> bool:
        """Whether the solvers of the platform keep lengths, or their squares, as single numbers."""
        return self.platform not in ("Reference", "CPU")

    @property
    def tolerance(self) -> float:
        """The tolerance of the System's constraints unless another is asked for."""
        return TOLERANCES[self.name]

    @property
    def place(self) -> float:
        """Unit roundoff of a coordinate: in mixed precision positions are pairs of single numbers."""
        return {"double": 2.0**-53, "mixed": 2.0**-48, "single": SINGLE}[self.name]

    def grain(self, reach: float) -> float:
        """Spacing of coordinates at a distance from the origin."""
        return float(np.spacing(reach)) if self.name == "double" else 2 * self.place * reach

    @property
    def limits(self) -> tuple[float, float]:
        """What positions, of the scale of a row, and velocities, of their size, may be off."""
        return (START_TOLERANCE, START_TOLERANCE) if self.name == "double" else (self.tolerance, self.speeds)

    @property
    def solvers(self) -> float:
        """What the arithmetic of OpenMM's solvers adds to a relative distance."""
        return 5e-7 if self.name == "single" else 1e-12

    @property
    def speeds(self) -> float:
        """What is left of velocities along constraints, of their size: SHAKE on GPUs makes 15 iterations at most."""
        return 1e-6 if self.rounds_lengths else 0.0

    @property
    def forces(self) -> float:
        """Relative error of forces and of the values of Forces that are rows, after some hundred operations."""
        return 1e-13 if self.name == "double" else 5e-7

    @property
    def seen(self) -> float:
        """Unit roundoff of a coordinate as Forces see it."""
        return 2.0**-53 if self.name == "double" else SINGLE
