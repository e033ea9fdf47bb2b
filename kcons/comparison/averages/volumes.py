"""Volumes at constant pressure: means with errors, ratios of two distributions, and what a barostat costs."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.steppers import State, run
from kcons.thermostats import CellSystem, ConstantPressure, autocorrelation_time, mean
from kcons.thermostats.correlated_series import FEWEST

#: Stretches of `every` steps in a turn, with and without a barostat each.
STRETCHES = 6


def mean_and_error(values: ArrayLike) -> tuple[float, float]:
    """`thermostats.mean` of a series, with an error of NaN for fewer than 32 values."""
    series = np.asarray(values, dtype=float)
    return mean(series) if len(series) >= FEWEST else (float(series.mean()), float("nan"))


def compressed(volumes: ArrayLike) -> tuple[float, float]:
    """<dV^2>/<V>, which is kT times the isothermal compressibility, and its error from that of the squares."""
    series = np.asarray(volumes, dtype=float)
    square, error = mean_and_error((series - series.mean()) ** 2)
    return square / float(series.mean()), error / float(series.mean())


def pooled(pairs: Sequence[Sequence[float]]) -> tuple[float, float, float]:
    """One mean of several with errors, its error, and how many times as far as these errors they scatter.

    Parameters
    ----------
    pairs : sequence of (mean, error)

    Returns
    -------
    mean, error : float
        Weights are inverse squares of the errors.
    scatter : float
        Square root of chi^2 for each degree of freedom; 1 where the errors are right, NaN of one mean.
    """
    value, error = np.array(pairs, dtype=float).T
    w = error**-2
    middle = float((w * value).sum() / w.sum())
    more = len(value) - 1
    scatter = float(np.sqrt((w * (value - middle) ** 2).sum() / more)) if more else float("nan")
    return middle, float(w.sum() ** -0.5), scatter


def slope_between(one: Mapping[str, Any], two: Mapping[str, Any]) -> tuple[float, float, float]:
    """ln of the ratio of two distributions along V or H = U + P V: the slope found, its error, and the exact one.

    The estimate of greatest likelihood (Shirts, J. Chem. Theory Comput. 9, 909 (2013)): for two pressures along V, for
    two temperatures along the enthalpy. Series are thinned to independent values.

    Parameters
    ----------
    one, two : mapping
        With 'temperature' as kT, 'pressure', and series of equal length 'volumes' and 'energies'.

    Raises
    ------
    InputError
        Both differ in temperature and pressure, or in neither.
    """
    hotter, denser = (one[key] != two[key] for key in ("temperature", "pressure"))
    if hotter == denser:
        raise InputError("give two runs which differ either in temperature or in pressure", item="two")
    if denser:
        series = [np.asarray(found["volumes"], dtype=float) for found in (one, two)]
        exact = -(two["pressure"] - one["pressure"]) / one["temperature"]
    else:
        series = [np.asarray(f["energies"]) + f["pressure"] * np.asarray(f["volumes"]) for f in (one, two)]
        exact = 1 / one["temperature"] - 1 / two["temperature"]
    return *_logistic([values[:: int(np.ceil(autocorrelation_time(values)))] for values in series]), exact


def _logistic(series: Sequence[FloatArray]) -> tuple[float, float]:
    """Slope with error of ln of the odds that a value is of the second series."""
    x = np.concatenate(series)
    side = np.repeat([0.0, 1.0], [len(values) for values in series])
    design = np.stack([np.ones_like(x), x - x.mean()], axis=1)
    beta = np.zeros(2)
    for _ in range(50):
        p = 1 / (1 + np.exp(-design @ beta))
        hessian = design.T @ (design * (p * (1 - p))[:, None])
        beta += np.linalg.solve(hessian, design.T @ (side - p))
    return float(beta[1]), float(np.sqrt(np.linalg.inv(hessian)[1, 1]))


def added_cost(system: CellSystem, state: State, dt: float, stepper: ConstantPressure, turns: int) -> dict[str, Any]:
    """Processor time of a step with a barostat over that of one without, by turns in one process.

    Parameters
    ----------
    system : CellSystem
    state : State
        At its start.
    dt : float
    stepper : ConstantPressure
        Its own stepper is what runs without the barostat.
    turns : int
        Each is twelve stretches of as many steps as lie between two trials, with and without by turns.

    Returns
    -------
    dict
        'every', 'turns', the median 'ratio' of the turns, and its 'error'.
    """
    alone, every = stepper.stepper, stepper.barostat.every
    # Half a stretch ahead: trials are then made in the midst of one.
    state = run(system, state, dt, 3 * every + every // 2, stepper=stepper)
    ratios, ends = [], {}
    for _ in range(turns):
        spent: dict[Any, float] = {alone: 0.0, stepper: 0.0}
        for k in range(STRETCHES):
            for one in (alone, stepper) if k % 2 else (stepper, alone):
                begun = time.process_time()
                ends[one] = run(system, state, dt, every, stepper=one, check_every=0)
                spent[one] += time.process_time() - begun
            state = ends[stepper]
        ratios.append(spent[stepper] / spent[alone])
    low, middle, high = np.quantile(ratios, [0.25, 0.5, 0.75])
    # Of a median of normal values: 1.25 standard errors, and 1.35 standard deviations from quarter to quarter.
    error = 1.25 / 1.35 * (high - low) / np.sqrt(turns)
    return {"every": every, "turns": turns, "ratio": float(middle), "error": float(error)}
