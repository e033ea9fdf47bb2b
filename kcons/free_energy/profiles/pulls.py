"""Free energies from the work of steered pulls both ways.

The work that a moving target does over a pull is the integral of its force along its path. Works of pulls from
equilibrium at both ends are tied by P_F(W)/P_B(-W) = exp((W - F)/kT) (Crooks, Phys. Rev. E 60, 2721 (1999)), which BAR
solves with the least error (Bennett, J. Comput. Phys. 22, 245 (1976); Shirts et al., Phys. Rev. Lett. 91, 140601
(2003)).

A coordinate that is held rather than pulled by a spring is where its target is: no other ensemble has to be unfolded.
What is found is the free energy of the held system. That of the coordinate, -kT ln P, has -kT ln <Z^(-1/2)> beside it,
which `Windows.pull` adds.
"""

from __future__ import annotations

import logging
import math
import warnings
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit

from kcons.constraints.arguments import FloatArray, positive
from kcons.errors import InputError, UnsupportedError
from kcons.free_energy.averages import finite
from kcons.thermostats.correlated_series import Estimate

#: Fewest pulls in a direction; overlap below which pulls tell little of each other.
MIN_PULLS, _OVERLAP = 5, 0.03
#: Standard errors by which pulls both ways may gain work before that is warned of, and kT that are rounding.
_GAIN, _NO_SPREAD = 4.0, 1e-9


class Pulled(NamedTuple):
    """What pulls both ways say of F(end) - F(start).

    Attributes
    ----------
    bar : Estimate
        By the Bennett acceptance ratio, in the unit of the works.
    overlap : float
        0 if no forward pull could have been a backward one, 1 if all could.
    """

    bar: Estimate
    overlap: float


def pull_free_energy(forward: ArrayLike, backward: ArrayLike, *, thermal_energy: float) -> Pulled:
    """Difference of free energy from the works of pulls, with the asymptotic error of BAR.

    Parameters
    ----------
    forward : array_like, shape (n,)
        Work done on the system by pulls from start to end, each from equilibrium at the start.
    backward : array_like, shape (m,)
        Work done on the system by pulls from end to start, each from equilibrium at the end.
    thermal_energy : float
        kT in the unit of the works.

    Raises
    ------
    InputError
        Fewer than 5 pulls in a direction; works that are all the same and do not fit; a NaN; kT is not positive.
    UnsupportedError
        pymbar is not installed.

    Warns
    -----
    UserWarning
        Pulls both ways overlap by less than 3 percent, or gain work, as those of the wrong sign do.
    """
    kT = positive(thermal_energy, "thermal_energy")
    ahead, back = _works(forward, "forward") / kT, _works(backward, "backward") / kT
    loud = logging.root.manager.disable
    logging.disable(logging.WARNING)  # general advice at its import
    try:
        import pymbar
    except ModuleNotFoundError:
        remedy = "python -m pip install 'kcons[free-energy]'"
        raise UnsupportedError(f"BAR is left to pymbar, which is not installed: {remedy}") from None
    finally:
        logging.disable(loud)
    lost = float(ahead.mean() + back.mean())
    if max(np.ptp(ahead), np.ptp(back)) > _NO_SPREAD:
        with np.errstate(invalid="ignore"):  # without any overlap there is no error
            difference, error = map(float, pymbar.bar(ahead, back).values())
    elif abs(lost) <= _NO_SPREAD:  # where pymbar finds no bounds
        difference, error = float(ahead.mean() - back.mean()) / 2, 0.0
    else:
        said = f"all works are the same each way, and {lost:g} kT are lost"
        raise InputError(f"{said}; start each pull from another state of equilibrium", item="forward")
    # What MBAR's overlap matrix has off its diagonal: Klimovich et al., J. Comput.-Aided Mol. Des. 29, 397 (2015).
    odds = np.concatenate([ahead, -back]) - difference + math.log(len(ahead) / len(back))
    overlap = float((expit(odds) * expit(-odds)).sum() * (1 / len(ahead) + 1 / len(back)))
    if overlap < _OVERLAP:
        warnings.warn(
            f"forward and backward pulls have an overlap of {overlap:.1%}; below {_OVERLAP:.0%} errors are not to be "
            "relied on: pull more slowly, or over a shorter way",
            stacklevel=2,
        )
    off = math.sqrt(ahead.var(ddof=1) / len(ahead) + back.var(ddof=1) / len(back))
    if lost < -max(_NO_SPREAD, _GAIN * off):
        warnings.warn(
            f"forward and backward pulls together gain {-kT * lost:.3g} where some work must be lost: give the work "
            "done on the system, of backward pulls too, not by it",
            stacklevel=2,
        )
    return Pulled(Estimate(kT * difference, kT * error), overlap)


def _works(works: ArrayLike, item: str) -> FloatArray:
    values = finite(works, item, "work")
    if values.ndim != 1 or len(values) < MIN_PULLS:
        raise InputError(f"{item} has works of shape {values.shape}; give {MIN_PULLS} pulls or more", item=item)
    return values
