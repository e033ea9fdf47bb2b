"""Scripts as OpenMM's manual and examples have them, run with one line changed: the integrator."""

from __future__ import annotations

import re
import shutil
import sys
from io import StringIO
from pathlib import Path

import numpy as np
import openmm
import pytest
from openmm_systems import DATA, GPUS, LONG, residuals, started, state_of

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
#: In a long run, each script in each precision: a usual one has `test_openmm_simulation` there.
ON_GPUS = [
    pytest.param(name, *p.values, id=f"{name}-{p.id}", marks=[*p.marks, LONG]) for p in GPUS for name in SCRIPT_SWAPS
]


@pytest.fixture
def runs(monkeypatch, tmp_path):
    """Runs a script on a platform and returns its names and what it printed."""
    minimize = openmm.LocalEnergyMinimizer.minimize

    def elsewhere(context, tolerance=10, maxIterations=0, reporter=None):
        """On the CPU platform: that of OpenCL crashes on processors, that of Reference takes ten times as long."""
        if context.getPlatform().getName() == "CPU":
            minimize(context, tolerance, maxIterations, reporter)
            return
        there = started(context.getSystem(), openmm.VerletIntegrator(0.001), state_of(context)[0], None, "CPU")
        minimize(there, tolerance, maxIterations, reporter)
        context.setPositions(state_of(there)[0])

    def run(name, swap, platform):
        pattern, line = SWAPS[swap]
        text, changed = pattern.subn(line, (SCRIPTS / f"{name}.py").read_text())
        assert changed == 1
        shutil.copy(DATA / "alanine-dipeptide-implicit.pdb", tmp_path)
        monkeypatch.chdir(tmp_path)
        place, _, precision = platform.partition(" ")
        monkeypatch.setenv("OPENMM_DEFAULT_PLATFORM", place)
        monkeypatch.setattr(openmm.LocalEnergyMinimizer, "minimize", staticmethod(elsewhere))
        monkeypatch.setattr(sys, "stdout", said := StringIO())
        names = {"__name__": "__main__"}
        if precision:
            at = openmm.Platform.getPlatformByName(place)
            before = at.getPropertyDefaultValue("Precision")
            at.setPropertyDefaultValue("Precision", precision)
        try:
            exec(compile(text, name, "exec"), names)
        finally:
            if precision:
                at.setPropertyDefaultValue("Precision", before)
        monkeypatch.undo()
        assert names["simulation"].context.getPlatform().getName() == place
        return names, [row.split(",") for row in said.getvalue().splitlines() if not row.startswith("#")]

    return run


def look_at(names, rows, tmp_path, name, platform):
    """Whether the script did what it says, and everything was held."""
    simulation, system = names["simulation"], names["system"]
    context, integrator = simulation.context, simulation.integrator
    assert isinstance(integrator, ProjectedIntegrator)
    assert simulation.currentStep == 40
    integrator.check()
    held = residuals(system, context)[0]
    assert held < (1e-4 if "single" in platform else 2e-7)
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


@pytest.mark.parametrize(("name", "swap", "platform"), CASES)
def test_one_line_is_changed(name, swap, platform, runs, tmp_path):
    names, rows = runs(name, swap, platform)
    look_at(names, rows, tmp_path, name, platform)


@pytest.mark.parametrize(("name", "platform"), ON_GPUS)
def test_one_line_is_changed_on_gpus(name, platform, runs, tmp_path):
    names, rows = runs(name, SCRIPT_SWAPS[name][0], platform)
    look_at(names, rows, tmp_path, name, platform)


def test_every_script_is_run():
    assert {path.stem for path in SCRIPTS.glob("*.py")} == set(SCRIPT_SWAPS)
