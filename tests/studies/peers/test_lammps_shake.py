"""LAMMPS: clusters it can hold, rigid water, and errors of forces."""

from __future__ import annotations

import numpy as np
import pytest
from peer_packages import check_order_two, measured, need
from peers import lammps_shake

from kcons.comparison import test_systems
from kcons.comparison.methods import METHODS


@pytest.mark.parametrize("name", ["lammps-shake-1e-10", "lammps-rattle-1e-10"])
def test_lammps_holds_rigid_water(name):
    need(name)
    system = test_systems.build("water", 8, forces="ase").shortened(2)
    held = lammps_shake.clusters(system.bonds, system.positions, system.n_atoms)
    assert held is not None
    assert len(held.angles) == 8
    assert held.degrees == pytest.approx([104.52])
    last = measured(system.with_time_steps([1.0]), name).iloc[-1]
    ours = measured(system.with_time_steps([1.0]), "rattle").iloc[0]
    assert last.error == pytest.approx(ours.error, rel=1e-5)
    assert last.sigma < 1e-9
    assert (last.tangency < 1e-9) == (name == "lammps-rattle-1e-10")


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
    system = test_systems.build("dumbbells")

    def broken(x):
        raise ZeroDivisionError("no forces today")

    monkeypatch.setattr(system.potential, "_evaluate", broken)
    system.potential.forget()
    with pytest.raises(ZeroDivisionError, match="no forces today"):
        METHODS["lammps-rattle-1e-8"].start(system, system.time_steps[0])


@pytest.mark.parametrize("name", ["lammps-shake-1e-12", "lammps-rattle-1e-12"])
def test_order_two(name):
    check_order_two(name, "dumbbells")


def test_refusals():
    chain, water = test_systems.build("chain", 6), test_systems.build("water", 8, forces="ase")
    need("lammps")
    assert "center" in METHODS["lammps-shake-1e-8"].refuses(chain)
    assert METHODS["lammps-rattle-1e-8"].refuses(water) is None
    assert "fixed" in METHODS["lammps-rattle-1e-8"].refuses(test_systems.build("slab"))
