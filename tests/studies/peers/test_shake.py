"""RATTLE by Gauss-Seidel sweeps: the trajectory of RATTLE, to its tolerance; bonds and angles only."""

from __future__ import annotations

import numpy as np
import pytest
from peer_packages import check_order_two, measured
from peers.shake import TOLERANCES

from kcons.comparison import test_systems
from kcons.comparison.methods import METHODS


@pytest.mark.parametrize("system", ["rotor", "butane", "chain", "dumbbells"])
def test_order_two(system):
    check_order_two("shake-1e-12", system)


def test_what_is_left_follows_the_tolerance():
    """No more than the tolerance, and not far less: sweeps end where it is reached."""
    rotor = test_systems.build("rotor").shortened(2)
    (dt, *_) = rotor.time_steps
    left = {}
    for tolerance in TOLERANCES:
        found = measured(rotor.with_time_steps([dt]), f"shake-{tolerance:.0e}".replace("e-0", "e-")).iloc[0]
        left[tolerance] = found.sigma
    assert all(residual <= 2 * tolerance for tolerance, residual in left.items())
    assert left[1e-4] > 1e3 * left[1e-10]


def test_a_run_goes_back_to_its_start_and_repeats():
    butane = test_systems.build("butane")
    run = METHODS["shake-1e-8"].start(butane, min(butane.time_steps))
    ends = []
    for _ in range(2):
        run.advance(20)
        ends.append(run.observe())
        run.rewind()
    np.testing.assert_array_equal(ends[0], ends[1])


def test_refusals():
    refuses = METHODS["shake-1e-8"].refuses
    assert "distances only" in refuses(test_systems.build("sphere", 2))
    assert refuses(test_systems.build("slab")) is None
