"""mici's constrained leapfrog: the trajectory of RATTLE; few rows at rest only."""

from __future__ import annotations

import pytest
import small_test_systems as small_test_systems  # a system that moves
from peer_packages import check_order_two, need

from kcons.comparison import test_systems
from kcons.comparison.methods import METHODS


@pytest.mark.parametrize(
    ("name", "system"), [("mici", "sphere"), ("mici-tight", "butane"), ("mici-tight", "triple-pendulum")]
)
def test_order_two(name, system):
    check_order_two(name, system)


def test_refusals():
    need("mici")
    refuses = METHODS["mici"].refuses
    assert refuses(test_systems.build("sphere", 2)) is None
    assert "cannot move" in refuses(test_systems.build("breathing"))
    assert "dense" in refuses(test_systems.build("chain", 100))
