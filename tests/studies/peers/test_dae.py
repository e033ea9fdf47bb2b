"""Solvers of differential-algebraic equations follow their tolerance."""

from __future__ import annotations

import pytest
from peer_packages import measured

from kcons.comparison import test_systems


@pytest.mark.parametrize("name", ["dae-radau", "dae-ida"])
@pytest.mark.parametrize("system", ["rotor", "double-pendulum", "butane", "sphere-pendulum"])
def test_dae_solvers_follow_their_tolerance(name, system):
    built = test_systems.build(system, 2 if system == "sphere-pendulum" else None).shortened(2)
    found = measured(built, name)
    errors = list(found.error)
    assert errors[0] > 10 * errors[1] > 100 * errors[2]
    assert errors[-1] < 1e-5
    last = found.iloc[-1]
    # The stabilised formulation: positions and velocities stay on the constraints.
    assert last.sigma < 1e-9
    assert last.tangency < 1e-9
