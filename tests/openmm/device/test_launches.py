"""Kernels and waits of a step on the device, as the OpenCL driver sees them, beside OpenMM's own integrators."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import openmm
import pytest
from openmm_systems import LONG

import kcons

HERE = Path(__file__).parent
_PRESENT = [openmm.Platform.getPlatform(k).getName() for k in range(openmm.Platform.getNumPlatforms())]
pytestmark = [
    LONG,
    pytest.mark.skipif("OpenCL" not in _PRESENT, reason="no OpenCL platform (pocl-opencl-icd)"),
    pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler"),
]
#: Steps of rigid water in mixed precision; what one call has more than a shorter one.
COUNTED = """
import ctypes, json, openmm
from openmm_systems import water_box
from kcons.openmm import Isokinetic, Langevin, NoseHoover, ProjectedIntegrator

counter = ctypes.CDLL(None)
counts = [ctypes.c_long.in_dll(counter, name) for name in ("kernels_launched", "reads_waited")]
system, x = water_box(27)
made = {"Verlet": openmm.VerletIntegrator(0.001)}
made["blanes-moan4"] = ProjectedIntegrator(0.001, "blanes-moan4", device=True, check_every=0)
for ensemble in (None, Langevin(300, 1.0), Isokinetic(), NoseHoover(300, 1.0)):
    name = "rattle" if ensemble is None else type(ensemble).__name__
    made[name] = ProjectedIntegrator(0.001, ensemble=ensemble, device=True, check_every=0)
found = {}
for name, integrator in made.items():
    integrator.setConstraintTolerance(1e-8)
    platform = openmm.Platform.getPlatformByName("OpenCL")
    context = openmm.Context(system, integrator, platform, {"Precision": "mixed"})
    context.setPositions(x)
    context.applyConstraints(1e-8)
    context.setVelocitiesToTemperature(300, 1)
    integrator.step(1)
    integrator.step(5)
    done = []
    for steps in (5, 15):
        before = [count.value for count in counts]
        integrator.step(steps)
        done.append([count.value - old for count, old in zip(counts, before)])
    found[name] = [(more - less) / 10 for less, more in zip(*done)]
print(json.dumps(found))
"""


def test_no_more_kernels_than_verlet_and_no_waits(tmp_path):
    counter = tmp_path / "count.so"
    build = ["g++", "-x", "c", "-shared", "-fPIC", str(HERE / "count_launches.c"), "-o", str(counter), "-ldl"]
    subprocess.run(build, check=True, capture_output=True)
    paths = os.pathsep.join([str(Path(kcons.__file__).parents[1]), str(HERE.parents[1] / "systems")])
    environment = os.environ | {"LD_PRELOAD": str(counter), "PYTHONPATH": paths}
    run = subprocess.run([sys.executable, "-c", COUNTED], capture_output=True, text=True, env=environment, check=True)
    found = json.loads(run.stdout.splitlines()[-1])
    verlet = found.pop("Verlet")[0]
    moan = found.pop("blanes-moan4")
    assert set(found) == {"rattle", "Langevin", "Isokinetic", "NoseHoover"}
    for kernels, waits in found.values():
        assert kernels <= verlet and waits == 0
    # Of each of its six evaluations, a kernel less than Verlet has beside the forces.
    assert moan[0] <= 6 * (verlet - 1) and moan[1] == 0
