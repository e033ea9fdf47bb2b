"""The figure of a profile."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from kcons.free_energy.profiles.profile import Profile

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Color-blind safe (Okabe and Ito).
_BLUE, _RED, _GREY = "#0072B2", "#D55E00", "0.35"
#: Standard errors of bands.
_BAND = 2.0


def plot_profile(profile: Profile, *, coordinate: str = "x", energy: str = "energy", title: str = "") -> Figure:
    """The free energy with two standard errors above; below, what it was made of: mean forces of the windows.

    `coordinate` and `energy` are what the axes say.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 6.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for each in (above, below):
        each.grid(True, alpha=0.3)
    low, high = profile.F - _BAND * profile.error, profile.F + _BAND * profile.error
    above.fill_between(profile.x, low, high, color=_BLUE, alpha=0.25, linewidth=0, label=f"± {_BAND:g} standard errors")
    above.plot(profile.x, profile.F, color=_BLUE, label="F")
    places = profile.windows[:, None] * np.ones((1, 2))
    above.plot(places.T, np.tile([[0.0], [0.04]], len(places)), color=_GREY, transform=above.get_xaxis_transform())
    above.set_ylabel(f"F / {energy}")
    above.legend(fontsize=8)
    slope = np.gradient(profile.F, profile.x)
    below.plot(profile.x, slope, color=_BLUE, linewidth=1.0, label="slope of F")
    how: dict[str, Any] = {"color": _RED, "fmt": "o", "markersize": 4, "capsize": 2, "label": "windows"}
    below.errorbar(profile.windows, profile.mean_forces, _BAND * profile.mean_force_errors, **how)
    below.axhline(0.0, color=_GREY, linewidth=0.8)
    below.set(xlabel=coordinate, ylabel=f"dF/dx / ({energy}/unit of x)")
    below.legend(fontsize=8)
    if title:
        figure.suptitle(title, fontsize=11)
    return figure
