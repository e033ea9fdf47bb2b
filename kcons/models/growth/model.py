"""Growth models: populations that multiply, and are fed.

    dx/dt = Psi(x) + G(x) phi(x),   G = diag(x),   Psi >= 0                          (notes eqs. 62, 124, 125)

phi are the relative rates of growth and Psi the sources. Where Psi = 0 the equation of ln x is d ln x/dt = phi(x):
it cannot make a population negative, and it goes on where x itself is below the smallest number of the machine.
For this reason every function here is handed `Populations`, which hold both x and ln x.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import check_call, lent, numbers, whole_number
from kcons.errors import InputError, NonFiniteError

FloatArray = NDArray[np.float64]
T = TypeVar("T")
#: A function of time and populations, arguments in SciPy's order.
OfState = Callable[[float, FloatArray], ArrayLike]


class Populations(NamedTuple):
    """The state of one system, arrays of shape (n,), or of N systems side by side, (n, N).

    Attributes
    ----------
    time : float or ndarray, shape (N,)
    x : ndarray
        Populations; may be 0 where ln x is below -745.
    log_x : ndarray
        Their logarithms, always finite.
    """

    time: float | FloatArray
    x: FloatArray
    log_x: FloatArray

    @classmethod
    def from_logarithms(cls, time: float | FloatArray, log_x: FloatArray) -> Self:
        # A trial step of an integrator may overflow; it is then rejected.
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            return cls(time, np.exp(log_x), log_x)

    @classmethod
    def from_values(cls, time: float | FloatArray, x: ArrayLike) -> Self:
        """Populations from x.

        Raises
        ------
        InputError
            If a population is negative, zero or not finite.
        """
        x = positive_populations(x)
        return cls(time, x, np.log(x))


def positive_populations(x: ArrayLike) -> FloatArray:
    """x as an array, refused if a population is negative, zero or not finite."""
    array = numbers(x, "x0").copy()
    if array.ndim not in (1, 2) or array.size == 0:
        raise InputError(f"populations have shape (n,) or (n, N), not {array.shape}", item="x0")
    if not np.all(np.isfinite(array)):
        raise InputError(f"population {_first(~np.isfinite(array))} is not finite", item="x0")
    if np.any(array < 0):
        raise InputError(
            f"population {_first(array < 0)} is negative: {array[array < 0][0]:.6g}. Populations are positive",
            item="x0",
        )
    if np.any(array == 0):
        raise InputError(
            f"population {_first(array == 0)} is zero and has no logarithm: leave that species out, start it at a "
            "small positive number, or give the start as log_x0",
            item="x0",
        )
    return array


def starting_logarithms(x0: ArrayLike | None, log_x0: ArrayLike | None) -> FloatArray:
    """ln x of a start that is given as populations or as their logarithms.

    Raises
    ------
    InputError
        Both or none; populations that are negative, zero or not finite; logarithms that are not finite.
    """
    if (x0 is None) == (log_x0 is None):
        raise InputError("give the start either as x0 or as log_x0", item="x0")
    if x0 is not None:
        return np.log(positive_populations(x0))
    start = numbers(log_x0, "log_x0").copy()
    if not np.all(np.isfinite(start)):
        raise InputError("log_x0 is not finite", item="log_x0")
    return start


class GrowthModel:
    """Relative rates phi(t, x) and sources Psi(t, x).

    Parameters
    ----------
    rates : callable (t, x) -> (n,)
        phi; arguments in the order of SciPy's ``solve_ivp``.
    sources : callable (t, x) -> (n,), optional
        Psi >= 0; left out, Psi = 0.
    n : int
        Number of species.
    vectorized : bool
        Whether both functions take x of shape (n, N) with times of shape (N,), as in ``solve_ivp``.

    Raises
    ------
    InputError
        `n` is no whole number from 1 on; functions of other arguments.
    """

    #: Shape of parameters that differ from system to system, (N,); () where none do.
    lanes: tuple[int, ...] = ()

    def __init__(self, rates: OfState, sources: OfState | None = None, *, n: int, vectorized: bool = False) -> None:
        self.n = whole_number(n, "n")
        check_call("rates", rates, ("t", "x"))
        check_call("sources", sources, ("t", "x"))
        self._rates = rates
        self._sources = sources
        self.vectorized = vectorized

    def rates(self, p: Populations) -> FloatArray:
        """phi, shape of p.x (notes eq. 62)."""
        return evaluate(self._rates, p, self.n, self.vectorized, "the rates")

    def sources(self, p: Populations) -> FloatArray | None:
        """Psi, shape of p.x, or None where there are none.

        Raises
        ------
        NonFiniteError
            If a source is negative: it would carry populations through zero.
        """
        if self._sources is None:
            return None
        psi = evaluate(self._sources, p, self.n, self.vectorized, "the sources")
        if np.any(psi < 0):
            raise NonFiniteError(
                f"source {_first(psi < 0)} is negative ({psi[psi < 0][0]:.6g}): write losses as rates, proportional to "
                "the population that is lost",
                item="sources",
            )
        return psi

    def not_finite(self, p: Populations) -> tuple[str, int] | None:
        """'rate' or 'source', and the first species of which it is not finite; None if all are."""
        for what, values in (("rate", self.rates(p)), ("source", self.sources(p))):
            if values is not None and not np.all(np.isfinite(values)):
                return what, int(np.argwhere(~np.isfinite(values))[0][0])
        return None

    def drift(self, p: Populations) -> FloatArray:
        """Psi + G phi: dx/dt without constraints (notes eq. 124)."""
        psi = self.sources(p)
        growth = p.x * self.rates(p)
        return growth if psi is None else growth + psi

    def velocity(self, t: float, x: ArrayLike) -> FloatArray:
        """dx/dt without constraints, for any x (negative ones included): the field of a phase portrait."""
        x = numbers(x, "x")
        return self.drift(Populations(t, x, np.full_like(x, np.nan)))

    def take(self, lanes: NDArray[np.intp]) -> GrowthModel:
        """The model of some of N systems side by side; itself where parameters are common to all."""
        return self


def common_lanes(**shapes: tuple[int, ...]) -> tuple[int, ...]:
    """The shape of parameters side by side, each of which is () or (N,).

    Raises
    ------
    InputError
        They are for different numbers of systems.
    """
    own = {shape for shape in shapes.values() if shape}
    if len(own) > 1:
        raise InputError(
            f"{' and '.join(shapes)} are for different numbers of systems: "
            f"{', '.join(str(shape[0]) for shape in shapes.values() if shape)}",
            item=next(iter(shapes)),
        )
    return own.pop() if own else ()


def taken(item: T, lanes: NDArray[np.intp], *names: str) -> T:
    """A copy of which arrays of one entry a system, in their last axis, hold some of the systems only."""
    part = copy.copy(item)
    for name in names:
        values = getattr(item, name)
        if np.ndim(values):
            setattr(part, name, np.asarray(values)[..., lanes])
    return part


def evaluate(function: OfState, p: Populations, n: int, vectorized: bool, what: str) -> FloatArray:
    """A user's function at one state or, column by column, at many."""
    if p.x.ndim == 1 or vectorized:
        value = numbers(function(p.time, lent(p.x)), what)  # type: ignore[arg-type]
    else:
        times = np.broadcast_to(p.time, p.x.shape[1:])
        value = np.stack(
            [numbers(function(float(t), lent(x)), what) for t, x in zip(times, p.x.T, strict=True)], axis=-1
        )
    shape = p.x.shape if n else p.x.shape[1:]
    if value.shape != shape:
        try:
            value = np.broadcast_to(value, shape)
        except ValueError:
            raise InputError(f"{what}: the function returned shape {value.shape}, not {shape}", item=what) from None
    return value


def _first(where: NDArray[np.bool_]) -> str:
    index = np.argwhere(where)[0]
    return str(index[0]) if len(index) == 1 else f"{index[0]} of system {index[1]}"
