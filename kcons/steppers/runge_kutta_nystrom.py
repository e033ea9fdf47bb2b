"""Splittings for forces that depend on positions and time only, with the least error an evaluation.

Between kicks B and drifts A, [B, [B, [B, A]]] = 0: the kinetic energy is quadratic in the velocities, also on
constraints and with rows linear in the velocities. Splittings that use this (Runge-Kutta-Nystrom) need fewer
stages. They are made for exact drifts; a drift whose own order is that of the splitting keeps it, here a
composition of RATTLE drifts, which costs projections and no force.
"""

from __future__ import annotations

from kcons.errors import UnsupportedError
from kcons.steppers.compositions import KAHAN_LI_6, SUZUKI_4
from kcons.steppers.operations import mirrored
from kcons.steppers.splitting import Splitting
from kcons.steppers.state import System

#: SRKN_6^b: seven kicks, six drifts.
KICKS_4 = mirrored((0.0829844064174052, 0.396309801498368, -0.0390563049223486))
DRIFTS_4 = mirrored((0.245298957184271, 0.604872665711080), 2)

#: SRKN_11^b: twelve kicks, eleven drifts.
KICKS_6 = mirrored(
    (0.0414649985182624, 0.198128671918067, -0.0400061921041533, 0.0752539843015807, -0.0115113874206879), 2
)
DRIFTS_6 = mirrored((0.123229775946271, 0.290553797799558, -0.127049212625417, -0.246331761062075, 0.357208872795928))

#: SRKN_14^a: fourteen kicks, fifteen drifts.
KICKS_6A = mirrored(
    (
        0.09171915262446165,
        0.183983170005006,
        -0.05653436583288827,
        0.004914688774712854,
        0.143761127168358,
        0.328567693746804,
    ),
    2,
)
DRIFTS_6A = mirrored(
    (
        0.0378593198406116,
        0.102635633102435,
        -0.0258678882665587,
        0.314241403071447,
        -0.130144459517415,
        0.106417700369543,
        -0.00879424312851058,
    )
)


class RungeKuttaNystrom(Splitting):
    """Kicks and constrained drifts with the fractions of Blanes and Moan.

    Reversible; symplectic for position rows and forces that derive from a potential. Works with moving rows and with
    rows linear in the velocities; forces may depend on time. Along great circles where every row allows it.

    Not with forces that depend on the velocities: the order would be lost without any sign, and `check` raises.
    Not worth it where forces cost less than the projections of a drift, five or nine to a force evaluation.

    References
    ----------
    Blanes and Moan, J. Comput. Appl. Math. 142, 313 (2002), Tables 2 and 3.
    """

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` for velocity-dependent forces."""
        if system.velocity_dependent:
            raise UnsupportedError(
                f"{self!r} loses its order with forces that depend on the velocities; use Suzuki4 or KahanLi6"
            )


class BlanesMoan4(RungeKuttaNystrom):
    """Order 4, six force evaluations (SRKN_6^b), drifts by Suzuki's composition: 30 projections a step.

    Reversible; symplectic for position rows and forces that derive from a potential. All stages lie within the step.
    Not for forces that depend on the velocities (raises; use Suzuki4 instead).
    """

    order = 4

    def __init__(self) -> None:
        super().__init__(KICKS_4, DRIFTS_4, flight=SUZUKI_4, exact_flight=True)


class BlanesMoan6(RungeKuttaNystrom):
    """Order 6, eleven force evaluations (SRKN_11^b), drifts by Kahan and Li's composition: 99 projections a step.

    Reversible; symplectic for position rows and forces that derive from a potential. All stages lie within the step.
    Not for forces that depend on the velocities (raises; use KahanLi6 instead).
    """

    order = 6

    def __init__(self) -> None:
        super().__init__(KICKS_6, DRIFTS_6, flight=KAHAN_LI_6, exact_flight=True)


class BlanesMoan6a(RungeKuttaNystrom):
    """Order 6, fourteen force evaluations (SRKN_14^a), beginning and ending with a drift: 135 projections a step.

    Reversible; symplectic for position rows and forces that derive from a potential. All stages lie within the step.
    Not for forces that depend on the velocities (raises; use KahanLi6 instead), nor where the forces at the end of
    a step are wanted: its states carry none.
    """

    order = 6

    def __init__(self) -> None:
        super().__init__(KICKS_6A, DRIFTS_6A, flight=KAHAN_LI_6, exact_flight=True)
