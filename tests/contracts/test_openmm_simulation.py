"""All that an app.Simulation does with an integrator, on each platform: report, save, load, begin anew, from files."""

from __future__ import annotations

import io

import numpy as np
import openmm
import pytest
from openmm import app
from openmm_systems import DATA, GPUS, PLATFORMS, PROPERTIES, alanine, residuals, state_of

from kcons.openmm import Isokinetic, Langevin, ProjectedIntegrator

MADE = {
    "rattle": lambda: ProjectedIntegrator(1e-3),
    "blanes-moan4": lambda: ProjectedIntegrator(1e-3, "blanes-moan4"),
    "Langevin": lambda: ProjectedIntegrator(1e-3, ensemble=Langevin(300, 1.0)),
    "Isokinetic": lambda: ProjectedIntegrator(1e-3, ensemble=Isokinetic(300, momentum="free")),
}
CASES = [
    *(pytest.param(name, "Reference", id=f"{name}-Reference") for name in MADE),
    *(pytest.param(name, "CPU", id=f"{name}-CPU") for name in ("rattle", "Langevin")),
    *(
        pytest.param(name, *p.values, id=f"{name}-{p.id}", marks=p.marks)
        for p in GPUS
        if "mixed" in p.id or "none" in p.id
        for name in ("Isokinetic",)
    ),
]


def simulation_of(integrator, platform, system=None, **given):
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    name, _, precision = platform.partition(" ")
    properties = {"Precision": precision} if precision else PROPERTIES.get(name, {})
    held = alanine("HBonds")[0] if system is None else system
    return app.Simulation(pdb.topology, held, integrator, openmm.Platform.getPlatformByName(name), properties, **given)


@pytest.mark.filterwarnings("ignore:the forces exert no torque")
@pytest.mark.parametrize(("name", "platform"), CASES)
def test_everything_that_a_simulation_does(name, platform, tmp_path):
    made = simulation_of(MADE[name](), platform)
    system, x, v = alanine("HBonds")
    made.context.setPositions(x)
    made.context.setVelocities(v)
    table = io.StringIO()
    reporters = [
        app.StateDataReporter(table, 5, step=True, time=True, totalEnergy=True, temperature=True, speed=True),
        app.DCDReporter(str(tmp_path / "a.dcd"), 5),
        app.XTCReporter(str(tmp_path / "a.xtc"), 5),
        app.PDBReporter(str(tmp_path / "a.pdb"), 25),
        app.CheckpointReporter(str(tmp_path / "a.chk"), 25),
        app.CheckpointReporter(str(tmp_path / "a.xml"), 25, writeState=True),
    ]
    made.reporters += reporters
    made.step(27)
    rows = np.array([[float(word) for word in row.split(",")[:4]] for row in table.getvalue().splitlines()[1:]])
    np.testing.assert_array_equal(rows[:, 0], [5, 10, 15, 20, 25])
    np.testing.assert_allclose(rows[:, 1], 1e-3 * rows[:, 0], rtol=1e-6)
    assert ((rows[:, 3] > 50) & (rows[:, 3] < 700)).all()
    if name in ("rattle", "blanes-moan4"):
        assert np.ptp(rows[:, 2]) < 1.0
    for file in ("a.dcd", "a.xtc", "a.pdb", "a.chk", "a.xml"):
        assert (tmp_path / file).stat().st_size > 0
    made.reporters.clear()
    made.saveCheckpoint(str(tmp_path / "now.chk"))
    made.saveState(str(tmp_path / "now.xml"))
    made.step(23)
    end = state_of(made.context)

    def go_on(simulation, noise=False, near=0.0):
        assert simulation.currentStep == 27
        assert simulation.context.getTime()._value == pytest.approx(0.027, rel=1e-9)
        simulation.step(23)
        assert simulation.currentStep == 50
        simulation.integrator.check()
        assert residuals(system, simulation.context)[0] < 2e-7
        if not (noise and name == "Langevin"):  # a State does not carry random numbers
            np.testing.assert_allclose(state_of(simulation.context)[0], end[0], rtol=0, atol=near)

    made.loadCheckpoint(str(tmp_path / "now.chk"))
    go_on(made, noise=platform == "Reference")
    made.loadState(str(tmp_path / "now.xml"))
    go_on(made, noise=True)
    made.loadState(str(tmp_path / "now.xml"))
    made.context.reinitialize(preserveState=True)
    go_on(made, noise=True)
    # What is read from a file is the bare program.
    for what, of in (("system", made.system), ("integrator", made.integrator)):
        (tmp_path / f"{what}.xml").write_text(openmm.XmlSerializer.serialize(of))
    again = simulation_of(str(tmp_path / "integrator.xml"), platform, str(tmp_path / "system.xml"))
    again.context.setState(openmm.XmlSerializer.deserialize((tmp_path / "now.xml").read_text()))
    again.step(23)
    assert residuals(system, again.context)[0] < 2e-7
    if name != "Langevin":
        # Another Context: GPUs may take particles in another order.
        np.testing.assert_allclose(
            state_of(again.context)[0], end[0], rtol=0, atol=1e-9 if platform in PLATFORMS else 2e-6
        )
