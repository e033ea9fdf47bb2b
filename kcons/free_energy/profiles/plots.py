"""Figures of profiles, surfaces and works."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import as_float_array
from kcons.errors import InputError
from kcons.free_energy.profiles.mean_force_surface import Surface
from kcons.free_energy.profiles.profile import Profile
from kcons.free_energy.profiles.pulls import Pulled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Color-blind safe (Okabe and Ito).
_BLUE, _RED, _GREEN, _GREY = "#0072B2", "#D55E00", "#009E73", "0.35"
#: Standard errors of bands, and points of a surface along each coordinate.
_BAND, _POINTS = 2.0, 61


def _axes(rows: int, size: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    axes = list(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])
    for each in axes:
        each.grid(True, alpha=0.3)
    return figure, axes


def plot_profile(profile: Profile, *, coordinate: str = "x", energy: str = "energy", title: str = "") -> Figure:
    """The free energy with two standard errors above; below, what it was made of: mean forces of the windows.

    `coordinate` and `energy` are what the axes say.
    """
    figure, (above, below) = _axes(2, (6.4, 6.0))
    low, high = profile.F - _BAND * profile.error, profile.F + _BAND * profile.error
    above.fill_between(profile.x, low, high, color=_BLUE, alpha=0.25, linewidth=0, label=f"± {_BAND:g} standard errors")
    above.plot(profile.x, profile.F, color=_BLUE, label="F")
    places = profile.windows[:, None] * np.ones((1, 2))
    above.plot(places.T, np.tile([[0.0], [0.04]], len(places)), color=_GREY, transform=above.get_xaxis_transform())
    above.set_ylabel(f"F / {energy}")
    above.legend(fontsize=8)
    slope = np.gradient(profile.F, profile.x)
    below.plot(profile.x, slope, color=_BLUE, linewidth=1.0, label="slope of F")
    forces = profile.mean_forces + profile.added_slope(profile.windows)
    how: dict[str, Any] = {"color": _RED, "fmt": "o", "markersize": 4, "capsize": 2, "label": "windows"}
    below.errorbar(profile.windows, forces, _BAND * profile.mean_force_errors, **how)
    below.axhline(0.0, color=_GREY, linewidth=0.8)
    below.set(xlabel=coordinate, ylabel=f"dF/dx / ({energy}/unit of x)")
    below.legend(fontsize=8)
    if title:
        figure.suptitle(title, fontsize=11)
    return figure


def plot_surface(surface: Surface, *, coordinates: tuple[str, str] = ("x", "y"), energy: str = "energy") -> Figure:
    """Contours of a free energy in two coordinates, with the windows and the minima.

    Raises
    ------
    InputError
        The surface does not have two coordinates.
    """
    if len(surface.low) != 2:
        raise InputError(f"contours need a surface in 2 coordinates, not {len(surface.low)}", item="surface")
    figure, (axes,) = _axes(1, (6.4, 5.2))
    x, y = (np.linspace(low, high, _POINTS) for low, high in zip(surface.low, surface.high, strict=True))
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    F = surface.free_energy(places)[0].reshape(len(y), len(x))
    filled = axes.contourf(x, y, F, 20, cmap="viridis")
    axes.contour(x, y, F, 20, colors="white", linewidths=0.4, alpha=0.6)
    figure.colorbar(filled, label=f"F / {energy}")
    axes.plot(*surface.windows.T, ".", color="black", markersize=3, label="windows")
    minima = surface.minima()
    if minima:
        axes.plot(*np.array([m.x for m in minima]).T, "*", color=_RED, markersize=11, label="minima")
    axes.set(xlabel=coordinates[0], ylabel=coordinates[1])
    axes.legend(fontsize=8, loc="upper right")
    return figure


def plot_works(forward: ArrayLike, backward: ArrayLike | None, found: Pulled, *, energy: str = "energy") -> Figure:
    """Histograms of W of forward pulls and of -W of backward pulls: they cross at the difference of free energy.

    Works are those that `pull_free_energy` was given; `found` is what it gave.
    """
    figure, (axes,) = _axes(1, (6.4, 4.2))
    works = [("W forward", as_float_array(forward, "forward"), _BLUE)]
    if backward is not None:
        works.append(("-W backward", -as_float_array(backward, "backward"), _GREEN))
    edges = np.histogram_bin_edges(np.concatenate([each for _, each, _ in works]), bins="auto")
    for label, values, color in works:
        axes.hist(values, edges.tolist(), density=True, color=color, alpha=0.5, label=label)
    best = found.best
    axes.axvspan(best.value - _BAND * best.error, best.value + _BAND * best.error, color=_RED, alpha=0.25, linewidth=0)
    name = "Jarzynski" if found.bar is None else "BAR"
    axes.axvline(best.value, color=_RED, label=f"{name}: {best.value:.4g} ± {best.error:.2g}")
    axes.set(xlabel=f"work / {energy}", ylabel="density")
    axes.legend(fontsize=8)
    return figure
