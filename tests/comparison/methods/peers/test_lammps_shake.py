"""LAMMPS: clusters it can hold, rigid water, and errors of forces."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from kcons.comparison import test_systems
from kcons.comparison.methods import methods
from kcons.comparison.methods.peers import lammps_shake
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


@pytest.mark.parametrize("name", ["lammps-shake-1e-10", "lammps-rattle-1e-10"])
def test_lammps_holds_rigid_water(name):
    need(name)
    scene = test_systems.build("water", 8, forces="ase").shortened(2)
    held = lammps_shake.clusters(scene.bonds, scene.positions, scene.n_atoms)
    assert held is not None
    assert len(held.angles) == 8
    assert held.degrees == pytest.approx([104.52])
    last = measured(scene.with_time_steps([1.0]), name).measurements[-1]
    (ours,) = measure.compare(scene.with_time_steps([1.0]), methods=["rattle"]).of("rattle")
    assert last.error == pytest.approx(ours.error, rel=1e-5)
    assert last.constraint_residual < 1e-9
    assert (last.velocity_residual < 1e-9) == (name == "lammps-rattle-1e-10")


def test_clusters_of_lammps():
    x = np.array([[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.2], [2.0, 0, 0]])
    star = lammps_shake.clusters(np.array([[0, 1], [2, 0], [0, 3]]), x, 5)
    assert len(star.bonds) == 3
    np.testing.assert_allclose(star.lengths[star.bond_types], [1.0, 1.0, 1.2])
    triangle = lammps_shake.clusters(np.array([[0, 1], [1, 2], [0, 2]]), x, 5)
    assert triangle.angles.tolist() == [[1, 0, 2]]
    assert triangle.degrees == pytest.approx([90.0])
    for refused in (
        [[0, 1], [1, 4], [0, 2]],  # a chain of four
        [[0, 1], [1, 3], [0, 3]],  # a triangle with three different sides
        [[0, 1], [0, 2], [0, 3], [0, 4]],  # four partners
        [[0, 1], [0, 2], [1, 2], [0, 3]],
    ):
        assert lammps_shake.clusters(np.array(refused), x * [1.0, 1.0, 1.1], 5) is None


def test_an_error_of_the_forces_passes_through_lammps(monkeypatch):
    need("lammps")
    scene = test_systems.build("dumbbells")

    def broken(x):
        raise ZeroDivisionError("no forces today")

    monkeypatch.setattr(scene.potential, "_evaluate", broken)
    scene.potential.forget()
    with pytest.raises(ZeroDivisionError, match="no forces today"):
        methods.METHODS["lammps-rattle-1e-8"].start(scene, scene.time_steps[0])
