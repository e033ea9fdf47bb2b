"""Figures show what they were given."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.errors import InputError
from kcons.free_energy import fit_surface, integrate, pull_free_energy
from kcons.free_energy.profiles.plots import plot_profile, plot_surface, plot_works


def test_a_profile_with_its_band_and_windows(tmp_path):
    x = np.linspace(0.0, 2.0, 6)
    profile = integrate(x, np.cos(3 * x), np.full(6, 0.05))
    figure = plot_profile(profile, coordinate="r / Å", energy="eV", title="a bond")
    above, below = figure.axes
    assert above.get_ylabel() == "F / eV" and below.get_xlabel() == "r / Å"
    F = next(line for line in above.lines if line.get_label() == "F")
    assert (F.get_ydata() == profile.F).all()
    band = above.collections[0].get_paths()[0].get_extents()
    assert band.y1 == pytest.approx((profile.F + 2 * profile.error).max())
    windows = next(each for each in below.containers if each.get_label() == "windows")
    assert (windows.lines[0].get_xdata() == profile.windows).all()
    # The slope that is drawn goes through the windows, within what two standard errors of them leave.
    slope = next(line for line in below.lines if line.get_label() == "slope of F")
    assert np.abs(np.interp(x, slope.get_xdata(), slope.get_ydata()) - profile.mean_forces)[1:-1].max() < 0.1
    figure.savefig(tmp_path / "profile.png")
    assert (tmp_path / "profile.png").stat().st_size > 10000


def test_windows_of_a_profile_without_its_jacobian_lie_on_its_slope():
    r = np.linspace(1.0, 3.0, 12)
    free = integrate(r, -2.0 / r, np.full(12, 1e-4)).without_jacobian("distance", 1.0)
    below = plot_profile(free).axes[1]
    windows = next(each for each in below.containers if each.get_label() == "windows")
    assert np.abs(windows.lines[0].get_ydata()).max() < 0.01  # two particles that do not interact


def test_a_surface_with_its_minima():
    x = np.random.default_rng(0).uniform(-1, 1, (25, 2))
    surface = fit_surface(x, x * [2.0, 3.0], np.full((25, 2), 0.01))
    axes = plot_surface(surface, coordinates=("a", "b"), energy="kJ/mol").axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    assert len(lines["windows"].get_xdata()) == 25
    assert np.abs(lines["minima"].get_xydata()).max() < 0.05
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("a", "b")
    line = fit_surface(x[:, :1], x[:, :1], np.full((25, 1), 0.01))
    with pytest.raises(InputError, match="2 coordinates"):
        plot_surface(line)


@pytest.mark.parametrize("both", [True, False])
def test_works_cross_at_the_free_energy(both):
    rng = np.random.default_rng(1)
    forward, backward = rng.normal(5.5, 1.0, 400), rng.normal(-4.5, 1.0, 300) if both else None
    found = pull_free_energy(forward, backward, thermal_energy=1.0)
    axes = plot_works(forward, backward, found, energy="kT").axes[0]
    assert len(axes.containers) == 1 + both
    widths = np.diff([patch.get_x() for patch in axes.containers[0]])[0]
    assert sum(patch.get_height() for patch in axes.containers[0]) * widths == pytest.approx(1.0)
    assert axes.lines[0].get_xdata()[0] == found.best.value
    labels = " ".join(text.get_text() for text in axes.get_legend().get_texts())
    assert ("BAR" in labels, "Jarzynski" in labels) == (both, not both)
