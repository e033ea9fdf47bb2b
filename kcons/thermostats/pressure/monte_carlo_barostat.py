"""The Monte Carlo barostat: trial cells at random, judged by the energy alone."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kcons.constraints.arguments import positive
from kcons.constraints.target import FloatArray
from kcons.steppers import State
from kcons.thermostats.pressure.barostat import Barostat, Place, Trial
from kcons.thermostats.pressure.cell_system import CellSystem
from kcons.thermostats.pressure.pieces import Pieces

#: Probability of acceptance that widths are adapted to, and how fast that fades: the mean change of ln(width) in trial
#: n is n^-FADING.
WANTED, FADING = 0.5, 0.6


class MonteCarloBarostat(Barostat):
    """Trial volumes (and shapes) at random; for any energy, no stress needed.

    One mode of the kind is drawn for each trial, and changed by e^u, u uniform within a width. Widths go to an
    acceptance of one half by steps that fade as n^-0.6, so that in the long run nothing is adapted any more.

    Parameters
    ----------
    pressure, **kwargs
        As for `Barostat`.
    width : float
        Of ln V at the start. A trial changes no length by more than 9 % (ln V by 0.27), whatever is asked for: where an
        acceptance of one half would take more, as of a few pieces, widths end there, and `acceptance` stays above one
        half. The distribution is right, and the volume takes longer to change.

    Notes
    -----
    A trial takes two energies, and one evaluation of the forces where it is accepted. Calculators that find energy and
    forces together know the first already, and the last one from the energy of the trial: one evaluation in all.

    References
    ----------
    Chow and Ferguson, Comput. Phys. Commun. 91, 283 (1995); Aqvist et al., Chem. Phys. Lett. 384, 288 (2004).
    """

    what = "scale cell and centres of pieces at random, accept by energy"

    def __init__(self, pressure: float, *, width: float = 0.01, **kwargs: Any) -> None:
        super().__init__(pressure, **kwargs)
        self.width = positive(width, "width")

    def begin(self, system: CellSystem) -> FloatArray:
        variables = super().begin(system)
        self._modes(variables)[2] = np.log(np.minimum(self.width, self.strains.most))
        return variables

    def _trial(
        self,
        system: CellSystem,
        pieces: Pieces,
        before: Place,
        state: State,
        thermal_energy: float,
        dt: float,
        rng: np.random.Generator,
    ) -> Trial:
        n = len(self.strains)
        mode = int(rng.integers(n))
        e = np.zeros(n)
        e[mode] = math.exp(self._modes(state.barostat)[2, mode]) * (2 * rng.random() - 1)
        return Trial(e, mode)

    def _adapt(self, mode: int, chance: float, tried: FloatArray, taken: FloatArray, adapted: FloatArray) -> None:
        super()._adapt(mode, chance, tried, taken, adapted)
        grown = float(adapted[mode]) + 2 * (chance - WANTED) / float(tried[mode]) ** FADING
        adapted[mode] = min(grown, math.log(self.strains.most[mode]))
