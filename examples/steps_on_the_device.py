"""Rigid water whose steps a compiled plugin makes, on whatever platform there is.

Run with ``python examples/steps_on_the_device.py [PLATFORM]``, such as CUDA, OpenCL or CPU; some ten seconds, and as
much again the first time, when the plugin is compiled. It needs a C++ compiler.
"""

import sys

import openmm
from openmm import Platform, app, unit

from kcons.openmm import Langevin, ProjectedIntegrator, worst_length

field = app.ForceField("tip3p.xml")
box = app.Modeller(app.Topology(), [])
box.addSolvent(field, boxSize=openmm.Vec3(1.9, 1.9, 1.9))
system = field.createSystem(
    box.topology, nonbondedMethod=app.PME, nonbondedCutoff=0.9 * unit.nanometer, rigidWater=True
)

bath = Langevin(300 * unit.kelvin, 1 / unit.picosecond)
integrator = ProjectedIntegrator(4 * unit.femtoseconds, ensemble=bath, device=True)
platform = Platform.getPlatformByName(sys.argv[1] if sys.argv[1:] else "CPU")
simulation = app.Simulation(box.topology, system, integrator, platform)
simulation.context.setPositions(box.positions)
integrator.minimizeEnergy(simulation.context, maxIterations=50)
integrator.setVelocitiesToTemperature(simulation.context, 300 * unit.kelvin, 1)

log = {"time": True, "potentialEnergy": True, "temperature": True}
simulation.reporters.append(app.StateDataReporter(sys.stdout, 50, **log, separator="  "))
simulation.step(250)

name, off = worst_length(simulation.context)
print(integrator.listing())
print(f"{system.getNumConstraints()} lengths held; {name} is off by most, {off:.0e} of its length")
assert off < 1e-5
