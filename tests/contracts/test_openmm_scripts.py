"""Scripts as OpenMM's manual and examples have them, run with one line changed: the integrator."""

from __future__ import annotations

import re
import shutil
import sys
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from openmm_systems import DATA, residuals, state_of

from kcons.openmm import Langevin, ProjectedIntegrator

SCRIPTS = Path(__file__).parent / "scripts"
#: What takes the place of the line `integrator = ...`: the arguments are those of the script.
VERLET = re.compile(r"^integrator = VerletIntegrator\((.*)\)$", re.MULTILINE)
MIDDLE = re.compile(r"^integrator = LangevinMiddleIntegrator\((.*), (.*), (.*)\)$", re.MULTILINE)
SWAPS = {
    "rattle": (VERLET, r"from kcons.openmm import *; integrator = ProjectedIntegrator(\1)"),
    "Langevin": (
        MIDDLE,
        r"from kcons.openmm import *; integrator = ProjectedIntegrator(\3, ensemble=Langevin(\1, \2))",
    ),
    "Isokinetic": (
        MIDDLE,
        r"from kcons.openmm import *; integrator = ProjectedIntegrator(\3, ensemble=Isokinetic(\1))",
    ),
}
#: Which swaps each script is run with.
SCRIPT_SWAPS = {
    "simulate_pdb": ("Langevin",),  # begins at rest, which Isokinetic refuses
    "simulate_implicit": ("rattle",),
    "simulate_gbn2": ("Langevin",),
    "simulate_tip4pew": ("rattle",),
    "simulate_npt": ("Langevin", "Isokinetic"),
    "simulate_hmr": ("Langevin",),
}
CASES = [
    *(pytest.param(name, swap, "CPU") for name, swaps in SCRIPT_SWAPS.items() for swap in swaps),
    pytest.param("simulate_implicit", "rattle", "Reference"),
]


@pytest.fixture
def runs(monkeypatch, tmp_path):
    """Runs a script on a platform and returns its names and what it printed."""

    def run(name, swap, platform):
        pattern, line = SWAPS[swap]
        text, changed = pattern.subn(line, (SCRIPTS / f"{name}.py").read_text())
        assert changed == 1
        shutil.copy(DATA / "alanine-dipeptide-implicit.pdb", tmp_path)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("OPENMM_DEFAULT_PLATFORM", platform)
        monkeypatch.setattr(sys, "stdout", said := StringIO())
        names = {"__name__": "__main__"}
        exec(compile(text, name, "exec"), names)
        monkeypatch.undo()
        assert names["simulation"].context.getPlatform().getName() == platform
        return names, [row.split(",") for row in said.getvalue().splitlines() if not row.startswith("#")]

    return run


@pytest.mark.parametrize(("name", "swap", "platform"), CASES)
def test_one_line_is_changed(name, swap, platform, runs, tmp_path):
    """The script does what it says, and everything is held."""
    names, rows = runs(name, swap, platform)
    simulation, system = names["simulation"], names["system"]
    context, integrator = simulation.context, simulation.integrator
    assert isinstance(integrator, ProjectedIntegrator)
    assert simulation.currentStep == 40
    integrator.check()
    assert residuals(system, context)[0] < 2e-7
    x, v = state_of(context)
    context.computeVirtualSites()
    np.testing.assert_allclose(state_of(context)[0], x, rtol=0, atol=1e-6)
    assert np.isfinite(v).all()
    table = np.array([[float(word) for word in row] for row in rows])
    assert table[-1, 0] == 40
    temperatures = table[:, 2] if name != "simulate_npt" else table[:, 1]
    assert (temperatures < 450).all()
    assert (temperatures > (5 if name == "simulate_pdb" else 100)).all()
    if name in ("simulate_tip4pew", "simulate_implicit"):
        kinetic = context.getState(energy=True).getKineticEnergy()._value
        assert np.ptp(table[:, 1]) < 0.03 * kinetic
    if name == "simulate_npt":
        assert len(set(table[:, 2])) > 1
        assert (abs(table[:, 3] - 1) < 0.15).all()
    else:
        assert (table[:, 1] < 0).all()
    for file in ("output.pdb", "output.dcd", "output.xtc", "restart.chk", "state.xml"):
        if file in (SCRIPTS / f"{name}.py").read_text():
            assert (tmp_path / file).stat().st_size > 0
    if isinstance(getattr(integrator, "ensemble", None), Langevin):
        assert integrator.getTemperature()._value == 300


def test_every_script_is_run():
    assert {path.stem for path in SCRIPTS.glob("*.py")} == set(SCRIPT_SWAPS)
