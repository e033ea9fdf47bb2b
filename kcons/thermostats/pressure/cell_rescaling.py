"""Stochastic cell rescaling: the cell relaxes towards the pressure, with noise, judged by the energy."""

from __future__ import annotations

from typing import Any

import numpy as np

from kcons.constraints.arguments import positive
from kcons.constraints.target import FloatArray
from kcons.steppers import State
from kcons.thermostats.pressure.barostat import Barostat, Place, Trial
from kcons.thermostats.pressure.cell_system import CellSystem
from kcons.thermostats.pressure.centre_moves import work_of_shapes
from kcons.thermostats.pressure.pieces import Pieces, lattice_of

#: Standard deviations of the noise of a trial that fit into the largest change of a length, beside its mean of one.
_WITHIN = 2.0


class CellRescaling(Barostat):
    """Stochastic cell rescaling; needs the stress of the forces.

    d e = (beta_T/tau)(P_int - P) dt + sqrt(2 kT beta_T/(V tau)) dW for e = ln V, and alike for the other modes of the
    cell, from one trial to the next, P_int being the pressure of pieces as points, N kT/V + virial/(3 V). The step is a
    proposal that is accepted by the energy as those of `MonteCarloBarostat` are: the distribution has no error of the
    step, and velocities stay as they are. Trials go in the direction of the pressure: from far away the cell
    relaxes in `tau`, and the noise is the one that belongs to the compressibility.

    Parameters
    ----------
    pressure, **kwargs
        As for `Barostat`.
    tau : float
        Time in which the volume relaxes. Where `every` steps are no longer short against it, fewer trials are accepted.
        A trial changes no length by more than 9 %: where noise alone would do so, as of a few pieces, it relaxes
        more slowly.
    compressibility : float
        beta_T; of water 4.5e-5/bar. A guess will do, it goes into the time of relaxation only.

    References
    ----------
    Bernetti and Bussi, J. Chem. Phys. 153, 114107 (2020); anisotropic: Del Tatto, Raiteri, Bernetti and Bussi, Appl.
    Sci. 12, 1139 (2022); acceptance: Roberts and Tweedie, Bernoulli 2, 341 (1996).
    """

    what = "scale cell and centres of pieces by the stress and by noise, accept by energy"
    needs_stress = True

    def __init__(self, pressure: float, tau: float, compressibility: float, **kwargs: Any) -> None:
        super().__init__(pressure, **kwargs)
        self.tau = positive(tau, "tau")
        self.compressibility = positive(compressibility, "compressibility")

    def _drift(
        self, system: CellSystem, pieces: Pieces, place: Place, time: float, thermal_energy: float, dt: float
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation of each mode's change until the next trial."""
        strains, volume = self.strains, place.volume
        generators = strains.generators_in(strains.frame(place.cell))
        rise = energy_by_strain(system, pieces, place)
        enthalpy = generators.reshape(-1, 9) @ rise.ravel() + self.pressure * volume * strains.traces
        if self.tension:
            enthalpy -= self.tension * place.area * strains.diagonals[:, :2].sum(axis=1)
        # What the measure of the states and the changing width of the noise ask for leaves N, not N + 1.
        slope = strains.diagonals @ pieces.moving - enthalpy / thermal_energy
        spread = self.compressibility * thermal_energy / (3 * strains.sizes * volume * self.tau) * self.every * abs(dt)
        spread = np.minimum(spread, 0.5 * (strains.most / _WITHIN) ** 2)
        wide = np.sqrt(2 * spread)
        # Bounded, so that from far away trials can still be taken back, and be accepted.
        return np.clip(spread * slope, -wide, wide), wide

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
        mean, wide = self._drift(system, pieces, before, state.time, thermal_energy, dt)
        e = mean + wide * rng.standard_normal(len(mean))
        return Trial(e, 0, _log_normal(e, mean, wide))

    def _reverse(
        self,
        system: CellSystem,
        pieces: Pieces,
        after: Place,
        trial: Trial,
        state: State,
        thermal_energy: float,
        dt: float,
    ) -> float:
        mean, wide = self._drift(system, pieces, after, state.time, thermal_energy, dt)
        return _log_normal(-trial.e, mean, wide)

    def acceptance(self, state: State) -> FloatArray:
        """Mean probability of acceptance so far, the same for all modes, which change together; NaN without trials."""
        return np.full(len(self.strains), super().acceptance(state)[0])


def energy_by_strain(system: CellSystem, pieces: Pieces, place: Place) -> FloatArray:
    """dU/d strain, shape (3, 3), where the cell is strained and pieces move by their centres.

    The stress is that of all atoms moving along; what they would move relative to the centre of their piece does work
    against the forces, and is taken out again.
    """
    assert place.forces is not None and place.stress is not None
    own = pieces.label, pieces.weight, pieces.open, *pieces.tree
    return place.volume * place.stress + work_of_shapes(place.positions, place.forces, *own, lattice_of(system))


def _log_normal(e: FloatArray, mean: FloatArray, wide: FloatArray) -> float:
    return float(-0.5 * (((e - mean) / wide) ** 2).sum() - np.log(wide).sum())
