"""Free energies from the work of steered pulls.

The work that a moving target does over a pull is the integral of its force along its path. Averages of exp(-W/kT) over
pulls from equilibrium give the difference of free energy (Jarzynski, Phys. Rev. Lett. 78, 2690 (1997)); pulls both ways
are tied by P_F(W)/P_B(-W) = exp((W - F)/kT) (Crooks, Phys. Rev. E 60, 2721 (1999)), which BAR solves with the least
error (Bennett, J. Comput. Phys. 22, 245 (1976); Shirts et al., Phys. Rev. Lett. 91, 140601 (2003)).

A coordinate that is held rather than pulled by a spring is where its target is: no other ensemble has to be unfolded.
What is found is the free energy of the held system. That of the coordinate, -kT ln P, has -kT ln <Z^(-1/2)> beside it,
which `Windows.pull` adds.
"""

from __future__ import annotations

import logging
import math
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit, logsumexp

from kcons.constraints.arguments import FloatArray, positive
from kcons.errors import InputError, UnsupportedError
from kcons.free_energy.averages import finite
from kcons.thermostats.correlated_series import FEW_INDEPENDENT, Estimate

#: Fewest pulls in a direction; samples of the bootstrap; overlap below which pulls tell little of each other.
MIN_PULLS, _SAMPLES, _OVERLAP = 5, 500, 0.03
#: Standard errors by which pulls both ways may gain work before that is warned of.
_GAIN = 4.0
#: Works over kT that differ by less are the same, but for rounding.
_NO_SPREAD = 1e-9


@dataclass(frozen=True)
class Pulled:
    """What pulls say of F(end) - F(start).

    Attributes
    ----------
    jarzynski : Estimate
        -kT ln <exp(-W/kT)> over the forward pulls.
    n_effective : float
        Forward pulls that count: (sum w)^2/sum w^2 with w = exp(-W/kT).
    bar : Estimate or None
        From pulls both ways.
    overlap : float or None
        0 if no forward pull could have been a backward one, 1 if all could.
    """

    jarzynski: Estimate
    n_effective: float
    bar: Estimate | None = None
    overlap: float | None = None

    @property
    def best(self) -> Estimate:
        """BAR if there are pulls both ways, else Jarzynski's."""
        return self.jarzynski if self.bar is None else self.bar


def pull_free_energy(forward: ArrayLike, backward: ArrayLike | None = None, *, thermal_energy: float) -> Pulled:
    """Difference of free energy from the works of pulls.

    Errors are those of a bootstrap over pulls; that of BAR is its asymptotic one.

    Parameters
    ----------
    forward : array_like, shape (n,)
        Work done on the system by pulls from start to end, each from equilibrium at the start.
    backward : array_like, shape (m,), optional
        Work done on the system by pulls from end to start, each from equilibrium at the end.
    thermal_energy : float
        kT in the unit of the works.

    Raises
    ------
    InputError
        Fewer than 5 pulls in a direction; a NaN or infinity; kT is not positive.
    UnsupportedError
        Pulls both ways, and pymbar is not installed.

    Warns
    -----
    UserWarning
        Fewer than 10 forward pulls count and there are none back, or pulls both ways overlap by less than 3 percent,
        or gain work, as those of the wrong sign do.
    """
    kT = positive(thermal_energy, "thermal_energy")
    ahead = _works(forward, "forward") / kT
    drawn = ahead[np.random.default_rng(0).integers(len(ahead), size=(_SAMPLES, len(ahead)))]
    jarzynski = Estimate(kT * float(_jarzynski(ahead)), kT * float(_jarzynski(drawn).std(ddof=1)))
    effective = math.exp(2 * logsumexp(-ahead) - logsumexp(-2 * ahead))
    if backward is None:
        if effective < FEW_INDEPENDENT:
            warnings.warn(
                f"{effective:.1f} of {len(ahead)} pulls count in the average of exp(-W/kT), and it may be off by more "
                "than its error: pull more slowly, or backward as well",
                UserWarning,
                stacklevel=2,
            )
        return Pulled(jarzynski, effective)
    back = _works(backward, "backward") / kT
    difference, error = _bar(ahead, back)
    # What MBAR's overlap matrix has off its diagonal: Klimovich et al., J. Comput.-Aided Mol. Des. 29, 397 (2015).
    odds = np.concatenate([ahead, -back]) - difference + math.log(len(ahead) / len(back))
    overlap = float((expit(odds) * expit(-odds)).sum() * (1 / len(ahead) + 1 / len(back)))
    if overlap < _OVERLAP:
        warnings.warn(
            f"forward and backward pulls have an overlap of {overlap:.1%}; below {_OVERLAP:.0%} errors are not to be "
            "relied on: pull more slowly, or over a shorter way",
            UserWarning,
            stacklevel=2,
        )
    lost = float(ahead.mean() + back.mean())
    off = math.sqrt(ahead.var(ddof=1) / len(ahead) + back.var(ddof=1) / len(back))
    if lost < -max(_NO_SPREAD, _GAIN * off):
        warnings.warn(
            f"forward and backward pulls together gain {-kT * lost:.3g} where some work must be lost: give the work "
            "done on the system, of backward pulls too, not by it",
            UserWarning,
            stacklevel=2,
        )
    return Pulled(jarzynski, effective, Estimate(kT * difference, kT * error), overlap)


def _bar(ahead: FloatArray, back: FloatArray) -> tuple[float, float]:
    """Difference and its error, over kT. Works without a spread, where pymbar finds no bounds, are the difference."""
    if max(np.ptp(ahead), np.ptp(back)) <= _NO_SPREAD:
        if abs(lost := float(ahead.mean() + back.mean())) > _NO_SPREAD:
            said = f"all works are the same each way, and {lost:g} kT are lost"
            raise InputError(f"{said}; start each pull from another state of equilibrium", item="forward")
        return float(ahead.mean() - back.mean()) / 2, 0.0
    loud = logging.root.manager.disable
    logging.disable(logging.WARNING)  # general advice at its import
    try:
        import pymbar
    except ModuleNotFoundError:
        remedy = "python -m pip install 'kcons[free-energy]'"
        raise UnsupportedError(f"BAR is left to pymbar, which is not installed: {remedy}") from None
    finally:
        logging.disable(loud)
    found = pymbar.bar(ahead, back)
    return float(found["Delta_f"]), float(found["dDelta_f"])


def _works(works: ArrayLike, item: str) -> FloatArray:
    values = finite(works, item, "work")
    if values.ndim != 1 or len(values) < MIN_PULLS:
        raise InputError(f"{item} has works of shape {values.shape}; give {MIN_PULLS} pulls or more", item=item)
    return values


def _jarzynski(works: FloatArray) -> FloatArray:
    """-ln <exp(-w)> along the last axis."""
    return np.asarray(math.log(works.shape[-1]) - logsumexp(-works, axis=-1))
