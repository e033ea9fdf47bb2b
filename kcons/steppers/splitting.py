"""Steppers made of kicks and drifts in turn: RATTLE, its compositions, the geodesic and Runge-Kutta-Nystrom splittings.

A kick changes velocities by h M^-1 f(x, t), a drift flies h along the constraints. A stepper is the fractions of its
kicks and drifts: a new one is a class that hands them to `Splitting`, or those of whole RATTLE steps to `Composition`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

from kcons.constraints.arguments import Count, checked
from kcons.errors import InputError, UnsupportedError
from kcons.steppers.interpreter import Interpreted, Interpreter
from kcons.steppers.operations import Program, mirrored, splitting
from kcons.steppers.state import State, System

__all__ = ["BlanesMoan4", "BlanesMoan6", "BlanesMoan6a", "Composition", "Geodesic", "KahanLi6", "Rattle"]
__all__ += ["RungeKuttaNystrom", "Splitting", "Suzuki4", "Yoshida4"]

_P = 1.0 / (4.0 - 4.0 ** (1.0 / 3.0))
#: Suzuki's fractal, order 4.
SUZUKI_4 = (_P, _P, 1.0 - 4.0 * _P, _P, _P)
_Y = 1.0 / (2.0 - 2.0 ** (1.0 / 3.0))
#: The triple jump, order 4, three stages: the fewest, with the largest error.
YOSHIDA_4 = (_Y, 1.0 - 2.0 * _Y, _Y)
#: Order 6 with nine stages, of Kahan and Li (their s9odr6a).
KAHAN_LI_6 = mirrored((0.39216144400731413927925056, 0.33259913678935943859974864, -0.70624617255763935980996482,
                       0.08221359629355080023149045))  # fmt: skip
#: Kicks and drifts of Blanes and Moan: SRKN_6^b, SRKN_11^b and SRKN_14^a.
SRKN_6B = (
    mirrored((0.0829844064174052, 0.396309801498368, -0.0390563049223486)),
    mirrored((0.245298957184271, 0.604872665711080), 2),
)
SRKN_11B = (
    mirrored((0.0414649985182624, 0.198128671918067, -0.0400061921041533, 0.0752539843015807, -0.0115113874206879), 2),
    mirrored((0.123229775946271, 0.290553797799558, -0.127049212625417, -0.246331761062075, 0.357208872795928)),
)
SRKN_14A = (
    mirrored((0.09171915262446165, 0.183983170005006, -0.05653436583288827, 0.004914688774712854, 0.143761127168358,
              0.328567693746804), 2),
    mirrored((0.0378593198406116, 0.102635633102435, -0.0258678882665587, 0.314241403071447, -0.130144459517415,
              0.106417700369543, -0.00879424312851058)),
)  # fmt: skip


def fractions_of(values: Sequence[float], item: str) -> tuple[float, ...]:
    """Fractions of a step; `InputError` for what is no palindrome with the sum 1."""
    g = tuple(float(x) for x in values)
    if not g or any(abs(a - b) > 1e-15 for a, b in zip(g, reversed(g), strict=True)):
        raise InputError(f"{item} {g} are no palindrome; give them so that steps can be taken back", item=item)
    if abs(math.fsum(g) - 1.0) > 1e-14:
        raise InputError(f"{item} {g} add up to {math.fsum(g):g}, not to 1; divide them by their sum", item=item)
    return g


def require_order(g: tuple[float, ...], order: int, item: str) -> None:
    """Raise `InputError` where RATTLE steps or drifts of these lengths in turn do not have an order."""
    said = f"{item} {g} do not have order {order}"
    for power in range(3, order, 2):
        if abs(math.fsum(x**power for x in g)) > 1e-14:
            raise InputError(f"{said}: their powers of {power} do not cancel", item=item)
    # The other condition of order 6, which is not the same for the same fractions in another order.
    middles = (sum(g[:k]) + 0.5 * x for k, x in enumerate(g))
    if order > 5 and abs(math.fsum(x**3 * c**2 for x, c in zip(g, middles, strict=True))) > 1e-14:
        raise InputError(f"{said}: their powers cancel, but not in this sequence", item=item)


def _rattle_kicks(drifts: Sequence[float]) -> tuple[float, ...]:
    """The kicks of RATTLE steps of these lengths, merged where they meet."""
    return tuple(a + b for a, b in itertools.pairwise(0.5 * x for x in (0.0, *drifts, 0.0)))


class Splitting(Interpreted):
    """Base of the steppers made of kicks and drifts: reversible, and symplectic for position rows and potentials.

    Parameters
    ----------
    kicks, drifts : sequence of float
        Palindromes of fractions of the step. One kick more than drifts: the step begins and ends with a kick, and
        the last force is the first of the next step. One drift more than kicks: it begins and ends with a drift.
    flight : sequence of float
        Each drift is this symmetric composition of RATTLE drifts, such as `SUZUKI_4`. On constraints a stepper has no
        order above that of its drifts.
    exact_flight : bool
        Whether to fly along great circles instead where every row allows it.

    Raises
    ------
    InputError
        What is no palindrome with the sum 1; kicks and drifts that are not in turn; a `flight` of lower order than
        the class says.
    """

    order: int = 2
    reversible = True
    symplectic = True

    def __init__(
        self,
        kicks: Sequence[float],
        drifts: Sequence[float],
        flight: Sequence[float] = (1.0,),
        exact_flight: bool = False,
    ) -> None:
        self.kicks, self.drifts = fractions_of(kicks, "kicks"), fractions_of(drifts, "drifts")
        self.flight, self.exact_flight = fractions_of(flight, "flight"), exact_flight
        if abs(len(self.kicks) - len(self.drifts)) != 1:
            raise InputError(
                f"{len(self.kicks)} kicks and {len(self.drifts)} drifts do not come in turn; give one more of one",
                item="kicks",
            )
        self.kick_first = len(self.kicks) > len(self.drifts)
        if self.kicks != _rattle_kicks(self.drifts):  # which `Composition` looks at
            require_order(self.flight, self.order, "flight")
        self._by_form: dict[tuple[bool, bool], Program] = {}

    @property
    def force_evaluations(self) -> int:
        return min(len(self.kicks), len(self.drifts))

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` for velocity-dependent forces where they take the order, as they do above 2."""
        if system.velocity_dependent and self.order > 2 and self.kicks != _rattle_kicks(self.drifts):
            raise UnsupportedError(
                f"{self!r} loses its order with forces that depend on the velocities; use Suzuki4 or KahanLi6"
            )

    def program(self, system: System | None) -> Program:
        # Whether drifts are along great circles, and whether velocities are iterated because forces depend on them.
        exact = self.exact_flight and system is not None and system.great_circles is not None
        settled = system is not None and system.velocity_dependent
        if (exact, settled) not in self._by_form:
            flight = (1.0,) if exact else self.flight
            step = splitting(self.kicks, self.drifts, flight, exact=exact, settled=settled)
            self._by_form[exact, settled] = Program(step)
        return self._by_form[exact, settled]

    def begun(self, system: System, state: State, dt: float, steps: int) -> Interpreter:
        if (state is not system.last or state.forces is None) and (self.kick_first or system.velocity_dependent):
            state = system.with_forces(state)
        return Interpreter(system, state, dt, self.program(system), steps)


class Rattle(Splitting):
    """Velocity Verlet with exactly solved constraints: order 2, one force evaluation a step.

    One step from (x0, v0) at t0 to (x1, v1) at t1 = t0 + dt::

        u  = v0 + dt/2 M^-1 (f(x0) + A(x0)^T l0)       l0 such that sigma(x1, t1) = 0
        x1 = x0 + dt u
        v1 = u + dt/2 M^-1 (f(x1) + A(x1)^T l1)        l1 such that A(x1) v1 = c(t1)

    Velocities take the multipliers themselves, never (x1 - x0)/dt, so that their accuracy does not depend
    on the distance from the origin. For targets that move with time, c is their rate.

    * **Velocity (nonholonomic) rows** a(x) . v = c have no position to fix l0. It is chosen such that the
      row holds at the middle of the drift, a((x0 + x1)/2) . u = c(t0 + dt/2): the symmetric choice, which
      keeps order 2 and reversibility. (Projecting u with the rows at x0 instead has order 1.)
    * **Velocity-dependent forces**: f(x0, v0) in the first half, f(x1, v1), solved for v1 by iteration, in
      the second; also symmetric. Each iteration evaluates the forces once.

    A rigid rotor in free flight turns by exactly asin(omega dt) a step; for omega dt >= 1 there is no
    solution and the step raises.

    Not for rows or forces that jump in time, which reduce every order to 1.

    References
    ----------
    Andersen, J. Comput. Phys. 52, 24 (1983); notes, section 4.1. Midpoint condition for velocity rows:
    McLachlan and Perlmutter, J. Nonlinear Sci. 16, 283 (2006).
    """

    def __init__(self) -> None:
        super().__init__(kicks=(0.5, 0.5), drifts=(1.0,))


class Geodesic(Splitting):
    """Kick by M_par^+ f, drift along the constraints in small substeps: order 2, one force evaluation.

    The drift is the free flight on the constraints (a geodesic where they rest). It is followed by `substeps` RATTLE
    substeps, which cost no force, or exactly, by great circles, where every row holds one atom of its own on a sphere
    at rest (`FixedAtoms` may stand beside them). What is left is the error of the splitting alone: as that of velocity
    Verlet without constraints, it depends on how fast the forces vary, no longer on how fast the constrained directions
    turn.

    Not worth it where forces are cheap and vary as fast as the constrained directions turn: RATTLE with as many
    smaller steps is then better. A rigid rotor in free flight turns by exactly n asin(omega dt/n) a step of n substeps;
    without a solution for omega dt >= n. An atom on a sphere turns by exactly omega dt.

    Parameters
    ----------
    substeps : int
        RATTLE substeps in a drift.

    References
    ----------
    Leimkuhler and Matthews, Proc. R. Soc. A 472, 20160138 (2016); notes, eqs. 105-107.
    """

    @checked
    def __init__(self, substeps: Count = 8) -> None:
        self.substeps = substeps
        super().__init__((0.5, 0.5), (1.0,), (1.0 / substeps,) * substeps, exact_flight=True)

    def __repr__(self) -> str:
        return f"Geodesic(substeps={self.substeps})"


class Composition(Splitting):
    """RATTLE steps of different length in turn, merged where they meet.

    A symmetric scheme has only odd powers of the step in its local error. Steps g_1 dt, ..., g_s dt, with sum g = 1
    and a palindrome of fractions, cancel them: sum g^3 = 0 gives order 4, three more conditions order 6. Some fractions
    must be negative: constraints, targets and forces are then asked for earlier times.

    One force evaluation a fraction, more for forces that depend on velocities. Not for targets or forces with fewer
    derivatives in time than the order, which is then lost. Where the sums of the fractions leave [0, 1], as those of
    `Yoshida4` do, not for targets or forces that begin with the run either.

    Parameters
    ----------
    fractions : sequence of float
        Lengths of the steps as fractions of the whole: a palindrome with sum 1.
    order : int
        The order these fractions reach.
    name : str, optional
        For `repr`.

    Raises
    ------
    InputError
        No palindrome, the sum is not 1, or sum g^3, ... do not vanish as the order demands.

    References
    ----------
    Suzuki, Phys. Lett. A 146, 319 (1990); Yoshida, Phys. Lett. A 150, 262 (1990); Kahan and Li, Math. Comput. 66,
    1089 (1997); Reich, SIAM J. Numer. Anal. 33, 475 (1996) on constraints.
    """

    def __init__(self, fractions: Sequence[float], order: int, name: str = "") -> None:
        self.fractions = g = fractions_of(fractions, "fractions")
        self.order, self.name = order, name
        require_order(g, order, "fractions")
        super().__init__(kicks=_rattle_kicks(g), drifts=g)

    def __repr__(self) -> str:
        return self.name or f"Composition({self.fractions}, order={self.order})"


class Suzuki4(Composition):
    """Order 4, five force evaluations, all stages within the step: the robust choice of order 4."""

    def __init__(self) -> None:
        super().__init__(SUZUKI_4, 4, "Suzuki4()")


class Yoshida4(Composition):
    """Order 4, three force evaluations: the triple jump, the fewest and with the largest error.

    Stages lie between -0.35 and 1.35 of the step. Not for targets or forces that begin with the run.
    """

    def __init__(self) -> None:
        super().__init__(YOSHIDA_4, 4, "Yoshida4()")


class KahanLi6(Composition):
    """Order 6, nine force evaluations: for high accuracy where forces depend on velocities.

    All stages lie within the step. Not where solves are tight: some of its RATTLE steps are 0.79 of the whole long.
    """

    def __init__(self) -> None:
        super().__init__(KAHAN_LI_6, 6, "KahanLi6()")


class RungeKuttaNystrom(Splitting):
    """Kicks and constrained drifts with the fractions of Blanes and Moan: the least error a force evaluation.

    Between kicks B and drifts A, [B, [B, [B, A]]] = 0: the kinetic energy is quadratic in the velocities, also on
    constraints and with rows linear in the velocities. Splittings that use this need fewer stages. They are made for
    exact drifts; a drift whose own order is that of the splitting keeps it, here a composition of RATTLE drifts, which
    costs projections and no force. Along great circles where every row allows it.

    All stages lie within the step. Not with forces that depend on the velocities: the order would be lost without any
    sign, and `check` raises. Not worth it where forces cost less than the projections of a drift, five or nine to a
    force evaluation.

    References
    ----------
    Blanes and Moan, J. Comput. Appl. Math. 142, 313 (2002), Tables 2 and 3.
    """


class BlanesMoan4(RungeKuttaNystrom):
    """Order 4, six force evaluations (SRKN_6^b), drifts by Suzuki's composition: 30 projections a step."""

    order = 4

    def __init__(self) -> None:
        super().__init__(*SRKN_6B, SUZUKI_4, exact_flight=True)


class BlanesMoan6(RungeKuttaNystrom):
    """Order 6, eleven force evaluations (SRKN_11^b), drifts by Kahan and Li's composition: 99 projections a step."""

    order = 6

    def __init__(self) -> None:
        super().__init__(*SRKN_11B, KAHAN_LI_6, exact_flight=True)


class BlanesMoan6a(RungeKuttaNystrom):
    """Order 6, fourteen force evaluations (SRKN_14^a), beginning and ending with a drift: 135 projections a step.

    Not where the forces at the end of a step are wanted: its states carry none.
    """

    order = 6

    def __init__(self) -> None:
        super().__init__(*SRKN_14A, KAHAN_LI_6, exact_flight=True)


#: By the names that `kcons compare` and `ProjectedIntegrator` know them by.
SCHEMES: dict[str, Callable[[], Splitting]] = {
    "rattle": Rattle,
    "geodesic": Geodesic,
    "suzuki4": Suzuki4,
    "yoshida4": Yoshida4,
    "kahan-li6": KahanLi6,
    "blanes-moan4": BlanesMoan4,
    "blanes-moan6": BlanesMoan6,
    "blanes-moan6a": BlanesMoan6a,
}
