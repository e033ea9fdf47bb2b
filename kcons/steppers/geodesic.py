"""The geodesic splitting: one kick, and a drift that is much finer than the step."""

from __future__ import annotations

from kcons.errors import InputError, UnsupportedError
from kcons.steppers.splitting import Splitting
from kcons.steppers.state import System


class Geodesic(Splitting):
    """Kick by M_par^+ f, drift along the constraints in small substeps: order 2, one force evaluation.

    The drift is the free flight on the constraints (a geodesic where they rest). It is followed by `substeps`
    RATTLE substeps, which cost no force, or exactly, by great circles, where every row holds one atom on a
    sphere at rest. What is left is the error of the splitting alone: as that of velocity Verlet without
    constraints, it depends on how fast the forces vary, no longer on how fast the constrained directions turn.

    Reversible; symplectic for position rows and forces that derive from a potential. Works with moving rows, which
    are met at the time of each substep, with velocity rows, and with forces that depend on velocities.

    Not worth it where forces are cheap and vary as fast as the constrained directions turn: RATTLE with as many
    smaller steps is then better. Great circles not for rows that move or hold more than one atom.

    A rigid rotor in free flight turns by exactly n asin(omega dt/n) a step of n substeps; without a solution for
    omega dt >= n. An atom on a sphere turns by exactly omega dt.

    Parameters
    ----------
    substeps : int
        RATTLE substeps in a drift.
    great_circles : bool, optional
        None: where possible. True: insist. False: never.

    References
    ----------
    Leimkuhler and Matthews, Proc. R. Soc. A 472, 20160138 (2016); notes, eqs. 105-107.
    """

    def __init__(self, substeps: int = 8, great_circles: bool | None = None) -> None:
        if not (substeps >= 1 and float(substeps).is_integer()):
            raise InputError(f"substeps is {substeps}; give a whole number, 1 or more", item="substeps")
        self.substeps = int(substeps)
        self.great_circles = great_circles
        super().__init__(
            kicks=(0.5, 0.5),
            drifts=(1.0,),
            flight=(1.0 / int(substeps),) * int(substeps),
            exact_flight=great_circles is not False,
        )

    def __repr__(self) -> str:
        circles = "" if self.great_circles is None else f", great_circles={self.great_circles}"
        return f"Geodesic(substeps={self.substeps}{circles})"

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` if great circles are asked for where there are none."""
        if self.great_circles and system.great_circles is None:
            raise UnsupportedError(
                "great circles need rows that each hold one atom of its own on a sphere at rest (FixedAtoms may "
                "stand beside them); this set holds something else. Leave great_circles at None for RATTLE substeps"
            )
