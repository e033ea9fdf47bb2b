"""RATTLE: one kick, one drift, order 2."""

from __future__ import annotations

from kcons.steppers.splitting import Splitting


class Rattle(Splitting):
    """Velocity Verlet with exactly solved constraints: order 2, one force evaluation a step.

    Reversible; symplectic for position rows and forces that derive from a potential.

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
