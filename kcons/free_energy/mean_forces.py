"""The mean force along held coordinates, from the multipliers that hold them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kcons.constraints.arguments import positive, refuse_other
from kcons.constraints.target import FloatArray, nearest_image
from kcons.errors import InputError
from kcons.free_energy.averages import weighted_mean
from kcons.free_energy.series import Series


@dataclass(frozen=True, eq=False)
class MeanForce:
    """dF/dq at one window, F(q) = -kT ln P(q).

    Attributes
    ----------
    names : tuple of str
    value : ndarray, shape (d,)
        Where the coordinates were held.
    force : ndarray, shape (d,)
        dF/dq.
    covariance : ndarray, shape (d, d)
        Of `force`, from the statistical inefficiency of the series.
    raw : ndarray, shape (d,)
        The plain mean of the multipliers, which is not dF/dq.
    n : int
        Samples.
    n_effective : float
        As many independent samples would give the same error.
    """

    names: tuple[str, ...]
    value: FloatArray
    force: FloatArray
    covariance: FloatArray
    raw: FloatArray
    n: int
    n_effective: float

    @property
    def error(self) -> FloatArray:
        """Standard errors, shape (d,)."""
        return np.sqrt(np.diagonal(self.covariance))

    def __str__(self) -> str:
        return "; ".join(
            f"{name} = {q:.6g}: dF/dq = {f:.6g} +- {e:.2g} (raw multiplier {raw:.6g})"
            for name, q, f, e, raw in zip(self.names, self.value, self.force, self.error, self.raw, strict=True)
        )


def thermal_multipliers(series: Series, kT: float) -> FloatArray:
    """Multipliers as canonical velocities would give them, shape (n, d); kT in the energy of the series.

    The part of lambda that is quadratic in the velocities is replaced by its mean over canonical velocities where that
    is known: those of a run have a wrong temperature in fast modes, to second order in the step. Where it is not known,
    this part is taken g/(g - 1) times of an isokinetic run.
    """
    positive(kT, "kT")
    known, g = np.isfinite(series.mean_kinetic), series.isokinetic_degrees_of_freedom
    if g == 1:
        raise InputError(
            "1 degree of freedom under an isokinetic thermostat has no temperature; at least 2 are needed",
            item="isokinetic_degrees_of_freedom",
        )
    of_run = series.kinetic / (g - 1) if g else 0.0
    return series.multiplier + np.where(known, kT * series.mean_kinetic - series.kinetic, of_run)


def local_mean_force(series: Series, kT: float) -> FloatArray:
    """What is averaged with the weights of the series to give dF/dq, shape (n, d): lambda + kT G."""
    return thermal_multipliers(series, kT) + kT * series.gradient


def mean_force(series: Series, kT: float) -> MeanForce:
    """dF/dq = <w (lambda + kT G)>/<w>, w = (det Z)^(-1/2), G half the gradient of ln det Z along each coordinate.

    Where the series has `turned` as well, whose weighted mean is the same, the mixture of both that fluctuates least is
    averaged.

    Parameters
    ----------
    series : Series
        Of coordinates at rest, with velocities of temperature kT.
    kT : float
        Temperature times Boltzmann's constant, in the energy of the series.

    References
    ----------
    Sprik and Ciccotti, J. Chem. Phys. 109, 7737 (1998), for one coordinate; den Otter and Briels, Mol. Phys. 98, 773
    (2000), for several; the page on free energies has the derivation with other constraints.
    """
    refuse_other(series, Series, "series", "a kcons.free_energy.Series")
    value = series.value
    moved = nearest_image(value - value[0], series.periods)
    allowed = 1e-5 * np.maximum(np.abs(value[0]), 1.0)
    if not np.all(np.isfinite(moved)):
        name = series.names[int(np.argmin(np.isfinite(moved).all(axis=0)))]
        raise InputError(f"values of {name} are not finite; leave these samples out", item=name)
    if np.any(np.abs(moved) > allowed):
        name = series.names[int(np.argmax((np.abs(moved) > allowed).any(axis=0)))]
        raise InputError(
            f"{name} moved by {np.abs(moved).max():.3g} during the samples; a mean force belongs to coordinates at "
            "rest (the work of moving ones is Series.work)",
            item=name,
        )
    mean = weighted_mean(_quietest(series, local_mean_force(series, kT)), series.weights)
    return MeanForce(
        series.names,
        value[0] + moved.mean(axis=0),
        mean.value,
        mean.covariance,
        series.multiplier.mean(axis=0),
        len(series),
        mean.n_effective,
    )


def _quietest(series: Series, force: FloatArray) -> FloatArray:
    """f + a (turned - f) of each torsion that could be turned, a by least squares; two estimates of one mean."""
    mixed = force.copy()
    for k, turned in enumerate(series.turned.T):
        difference = turned - force[:, k]
        spread = np.var(difference)
        if np.isfinite(spread) and spread > 0:
            away = difference - difference.mean()
            mixed[:, k] -= np.mean(away * force[:, k]) / spread * difference
    return mixed
