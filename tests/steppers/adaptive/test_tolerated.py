"""What schemes with steps of their own share: what is refused before any step, and where they end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stepper_systems import spherical_pendulum

from kcons import run
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import Extrapolation

SCHEMES = [Extrapolation]


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(
    ("options", "item"),
    [
        *(({"tolerance": bad}, "tolerance") for bad in (0.0, -1e-3, 9e-15, np.nan, np.inf)),
        *(({item: bad}, item) for item in ("length", "speed") for bad in (0.0, -1.0, np.nan, np.inf)),
    ],
)
def test_bad_numbers(scheme, options, item) -> None:
    with pytest.raises(InputError, match=f"{item} is .*; give a") as raised:
        scheme(**options)
    assert raised.value.item == item


@pytest.mark.parametrize("scheme", SCHEMES)
def test_what_is_refused_before_any_step(scheme) -> None:
    """Where `states` is called, not where its first state is asked for; `run` says that it is to be called."""
    system, state = spherical_pendulum()
    for until in (np.nan, np.inf, "1", None):
        with pytest.raises(InputError, match="until is"):
            scheme().states(system, state, until)
    with pytest.raises(InputError, match=r"it chooses its own steps: .* states\("):
        run(system, state, 0.1, 3, stepper=scheme())
    for first in (0.0, -0.1, np.nan):
        with pytest.raises(InputError, match="first_step is"):
            scheme().states(system, state, 1.0, first_step=first)
    with pytest.raises(UnsupportedError, match=f"{scheme.__name__} knows no thermostats"):
        scheme().states(system, replace(state, thermostat=np.zeros(2)), 1.0)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_end_is_met_exactly_and_no_step_before_it_is_tiny(scheme) -> None:
    system, state = spherical_pendulum()
    assert list(scheme().states(system, state, 0.0)) == []
    for until in (0.1, 1.0 / 3.0, 2.0, -0.7):
        states = list(scheme(1e-8).states(system, state, until))
        assert states[-1].time == until and states[-1].time_remainder == 0.0
        sizes = np.abs(np.diff([0.0, *(s.time for s in states)]))
        assert sizes[-1] > 0.45 * sizes[-2:].max()
