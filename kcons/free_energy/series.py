"""Samples of held coordinates one after another, what records them in runs of the core, and their mean force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import positive, refuse_other
from kcons.constraints.target import FloatArray, nearest_image
from kcons.errors import InputError
from kcons.free_energy.averages import weighted_mean
from kcons.free_energy.held_coordinates import AT_ONCE, HeldCoordinates, Sample
from kcons.steppers.files import in_one_piece, stored_arrays
from kcons.steppers.state import State, System

#: Atoms of all configurations that wait to be looked at, at most.
_ATOMS = 200_000
#: What a sample has once, and not for each coordinate.
_NUMBERS = ("time", "log_det_z", "off")


def _column(field: str) -> property:
    """A quantity of all samples."""

    def column(series: Series) -> FloatArray:
        shape = (len(series),) if field in _NUMBERS else (len(series), len(series.names))
        return np.array([getattr(sample, field) for sample in series], dtype=np.float64).reshape(shape)

    return property(column)


class Series(list[Sample]):
    """Samples of held coordinates; see `Sample` for what they are. A slice is a series of some.

    Parameters
    ----------
    names : sequence of str
    periods : array_like, shape (d,), optional
        Of the coordinates; 0 for none.
    isokinetic_degrees_of_freedom : int, optional
        g of an isokinetic run, which gives the velocities (g - 1)/g of their canonical variance; `local_mean_force`
        puts that right. 0 for every other run.

    Attributes
    ----------
    time, log_det_z, off : ndarray, shape (n,)
    value, multiplier, kinetic, gradient, turned, mean_kinetic : ndarray, shape (n, d)

    Examples
    --------
    >>> series = Series(["torsion"], [6.283185307179586])
    >>> len(series), series.multiplier.shape
    (0, (0, 1))
    """

    def __init__(self, names: Sequence[str], periods: ArrayLike = 0.0, isokinetic_degrees_of_freedom: int = 0) -> None:
        super().__init__()
        self.names = tuple(names)
        self.isokinetic_degrees_of_freedom = isokinetic_degrees_of_freedom
        self.periods: FloatArray = np.broadcast_to(np.asarray(periods, dtype=np.float64), (len(self.names),)).copy()

    def __repr__(self) -> str:
        return f"<Series: {len(self)} samples of {', '.join(self.names)}>"

    def __getitem__(self, samples: Any) -> Any:
        found = super().__getitem__(samples)
        if not isinstance(samples, slice):
            return found
        part = Series(self.names, self.periods, self.isokinetic_degrees_of_freedom)
        part += found
        return part

    time, value, multiplier, kinetic, log_det_z, gradient, off, turned, mean_kinetic = map(_column, Sample._fields)

    @property
    def weights(self) -> FloatArray:
        """(det Z)^(-1/2) by its largest value, shape (n,): what turns averages into those without the coordinates held.

        For any observable O at the values held: ``sum(weights * O) / sum(weights)``.
        """
        log = -0.5 * self.log_det_z
        return np.exp(log - log.max()) if len(log) else log

    @property
    def work(self) -> FloatArray:
        """What moving targets have added to the energy, integral of lambda . dq by the trapezoid rule, shape (n,).

        Second order in the interval from one sample to the next; record every step where it matters.
        """
        return self.work_of(self.multiplier)

    def work_of(self, force: FloatArray) -> FloatArray:
        """The work of any force along the coordinates, shape (n, d), up to each sample, shape (n,)."""
        if not self:
            return np.zeros(0)
        moved = nearest_image(np.diff(self.value, axis=0), self.periods)
        return np.concatenate([[0.0], np.cumsum(np.sum((force[1:] + force[:-1]) / 2 * moved, axis=1))])

    # -- files ----------------------------------------------------------------------------------

    def save(self, file: str | PathLike[str]) -> None:
        """Write all of it in NumPy's .npz format; an interrupted write leaves the older file."""
        arrays = {field: getattr(self, field) for field in Sample._fields}
        for name in ("names", "periods", "isokinetic_degrees_of_freedom"):
            arrays[name] = np.array(getattr(self, name))
        with in_one_piece(file) as opened:
            np.savez(opened, **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, file: str | PathLike[str]) -> Series:
        """Read what `save` wrote.

        Raises
        ------
        InputError
            The file holds no series, or not all of it is as it was written.
        """
        try:
            with open(file, "rb") as opened:
                data = stored_arrays(opened)
            names = [str(name) for name in data["names"]]
            series = cls(names, data["periods"], int(data["isokinetic_degrees_of_freedom"]))
            shapes = {name: (-1,) if name in _NUMBERS else (-1, len(series.names)) for name in Sample._fields}
            columns = [data[name].reshape(shape) for name, shape in shapes.items()]
            series += map(Sample._make, zip(*columns, strict=True))
        except FileNotFoundError:
            raise
        except Exception as error:  # a damaged archive raises whatever its bytes lead to
            raise InputError(f"{file} holds no series written by Series.save: {error}", item="file") from error
        return series


class Collector:
    """Configurations of one cell that wait to be looked at together, which costs a tenth of one after another."""

    def __init__(self, coordinates: HeldCoordinates) -> None:
        self.coordinates, self._series = coordinates, Series(coordinates.names, coordinates.periods)
        self._waiting: list[tuple[FloatArray, FloatArray, FloatArray, float]] = []

    def add(self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float) -> None:
        """Positions, velocities and applied forces at a time; arrays are copied."""
        x, v, f = (np.array(array, dtype=np.float64) for array in (x, v, f))
        self._waiting.append((x, v, f, time))
        if len(self._waiting) == min(AT_ONCE, 1 + _ATOMS // len(x)):
            self.look()

    def look(self) -> None:
        """Put samples of all that waits into the series."""
        waiting, self._waiting = self._waiting, []
        for sample in self.coordinates.samples(*zip(*waiting, strict=True)) if waiting else ():
            self._series.append(sample)

    @property
    def series(self) -> Series:
        self.look()
        return self._series


class Recorder(Collector):
    """An observer of `kcons.run` that keeps a `Series`.

    Parameters
    ----------
    system : System
        Whose constraints hold the coordinates.
    coordinates : HeldCoordinates

    Attributes
    ----------
    series : Series
        Of an isokinetic run, set its `isokinetic_degrees_of_freedom`, which are not seen from here. Velocities on
        isokinetic spheres are not thermal.
    """

    def __init__(self, system: System, coordinates: HeldCoordinates) -> None:
        super().__init__(coordinates)
        self.system = system

    def __call__(self, state: State) -> None:
        x, v, forces = self.system.kernel_arrays(state)  # in the cell of the state
        if forces is None:
            forces = self.system.forces(x, v, state.time, state.step)
        self.add(x, v, forces, state.time)
        if self.system.motion.lattice is not None:  # the next may be in another cell
            self.look()


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
    if not series:
        raise InputError("the series has no samples; take some while the coordinates are held", item="series")
    value = series.value
    moved = nearest_image(value - value[0], series.periods)
    for name, first, way in zip(series.names, value[0], np.abs(moved).max(axis=0), strict=True):
        if not np.isfinite(way):
            raise InputError(f"values of {name} are not finite; leave these samples out", item=name)
        if way > 1e-5 * max(abs(first), 1.0):
            raise InputError(
                f"{name} moved by {way:.3g} during the samples; a mean force belongs to coordinates at rest (the work "
                "of moving ones is Series.work)",
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
