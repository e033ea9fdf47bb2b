"""Symmetric compositions of RATTLE: orders 4 and 6, for everything that RATTLE can do.

A symmetric scheme has only odd powers of the step in its local error. Taking steps g_1 dt, ..., g_s dt, with
sum g = 1 and a palindrome of fractions, cancels them: sum g^3 = 0 gives order 4, three more conditions order 6.
Some fractions must be negative: constraints, targets and forces are then asked for earlier times.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

from kcons.errors import InputError
from kcons.steppers.operations import mirrored
from kcons.steppers.splitting import Splitting, fractions_of

_P = 1.0 / (4.0 - 4.0 ** (1.0 / 3.0))
#: Suzuki's fractal, order 4.
SUZUKI_4 = (_P, _P, 1.0 - 4.0 * _P, _P, _P)
_Y = 1.0 / (2.0 - 2.0 ** (1.0 / 3.0))
#: The triple jump, order 4, three stages: the fewest, with the largest error.
YOSHIDA_4 = (_Y, 1.0 - 2.0 * _Y, _Y)


#: Order 6 with nine stages, of Kahan and Li (their s9odr6a).
KAHAN_LI_6 = mirrored(
    (
        0.39216144400731413927925056,
        0.33259913678935943859974864,
        -0.70624617255763935980996482,
        0.08221359629355080023149045,
    )
)


class Composition(Splitting):
    """RATTLE steps of different length in turn, merged where they meet.

    Reversible; symplectic for position rows and forces that derive from a potential. One force evaluation a
    fraction, more for forces that depend on velocities.

    Works with all that `Rattle` works with: velocity rows, rows and targets that move, friction (of which the
    stages that go back see the reverse).

    Not for targets or forces with fewer derivatives in time than the order, which is then lost. Where the sums of
    the fractions leave [0, 1], as those of `Yoshida4` do, not for targets or forces that begin with the run either.

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
        g = fractions_of(fractions, "fractions")
        for power in range(3, order, 2):
            if abs(math.fsum(x**power for x in g)) > 1e-14:
                raise InputError(
                    f"fractions {g} do not have order {order}: their powers of {power} do not cancel", item="fractions"
                )
        # The other condition of order 6, which is not the same for the same fractions in another order.
        middles = (sum(g[:k]) + 0.5 * x for k, x in enumerate(g))
        if order > 5 and abs(math.fsum(x**3 * c**2 for x, c in zip(g, middles, strict=True))) > 1e-14:
            raise InputError(
                f"fractions {g} do not have order {order}: their powers cancel, but not in this sequence",
                item="fractions",
            )
        halves = [0.5 * x for x in g]
        merged = [a + b for a, b in itertools.pairwise(halves)]
        super().__init__(kicks=(halves[0], *merged, halves[-1]), drifts=g)
        self.order = order
        self.fractions = g
        self.name = name

    def __repr__(self) -> str:
        return self.name or f"Composition({self.fractions}, order={self.order})"


class Suzuki4(Composition):
    """Order 4, five force evaluations: the robust choice of order 4 for all that is held.

    Reversible; symplectic for position rows and forces that derive from a potential. All stages lie within the step.
    Not for targets or forces that are not smooth in time.
    """

    def __init__(self) -> None:
        super().__init__(SUZUKI_4, 4, "Suzuki4()")


class Yoshida4(Composition):
    """Order 4, three force evaluations: the triple jump, the fewest and with the largest error.

    Reversible; symplectic for position rows and forces that derive from a potential. Stages lie between -0.35 and
    1.35 of the step. Not for targets or forces that begin with the run, nor for strong friction.
    """

    def __init__(self) -> None:
        super().__init__(YOSHIDA_4, 4, "Yoshida4()")


class KahanLi6(Composition):
    """Order 6, nine force evaluations: for high accuracy where forces depend on velocities.

    Reversible; symplectic for position rows and forces that derive from a potential. All stages lie within the step.
    Not for targets or forces that are not smooth in time, nor where solves are tight: some of its RATTLE steps are
    0.79 of the whole step long.
    """

    def __init__(self) -> None:
        super().__init__(KAHAN_LI_6, 6, "KahanLi6()")
