"""The figure shows what it was given."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.free_energy import integrate, plot_profile


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
