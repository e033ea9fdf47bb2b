"""Several time steps in OpenMM: near forces of water every 2 fs, the whole Ewald sum every 8 fs, molecules rigid.

Run with ``python examples/several_time_steps.py``; some seconds. The fast forces have a short cutoff and a coarse
mesh; the slow ones are what the whole sum has beyond them. In so small a box that saves sums and no time. How to divide
forces: docs/long_steps.md.
"""

import copy
import time

import openmm
from openmm import app, unit

from kcons.openmm import Langevin, LangevinRespa, ProjectedIntegrator, worst_length

field = app.ForceField("tip3p.xml")
box = app.Modeller(app.Topology(), [])
box.addSolvent(field, boxSize=openmm.Vec3(1.9, 1.9, 1.9))
system = field.createSystem(box.topology, nonbondedMethod=app.PME, nonbondedCutoff=0.9 * unit.nanometer)
whole = next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))


def divided(system):
    """A copy of it with the fast forces in group 1; those of group 0 are the whole sum less these."""
    system = copy.deepcopy(system)
    fast = copy.deepcopy(whole)
    fast.setCutoffDistance(0.7)
    fast.setUseSwitchingFunction(True)
    fast.setSwitchingDistance(0.5)
    fast.setPMEParameters(4.0, 16, 16, 16)  # 1/nm, and points of the mesh
    fast.setForceGroup(1)
    less = openmm.CustomCVForce("-fast")
    less.addCollectiveVariable("fast", copy.deepcopy(fast))
    system.addForce(fast)
    system.addForce(less)
    return system


respa = LangevinRespa(300, 5.0, {0: 1, 1: 4}, slow_kicks="middle")  # K, 1/ps, steps of each group
runs = {
    "one step, 2 fs": (system, ProjectedIntegrator(0.002, ensemble=Langevin(300, 5.0)), 100),
    "8 fs outside, 2 fs inside": (divided(system), ProjectedIntegrator(0.008, ensemble=respa), 25),
}
x = box.positions
print("steps                        whole sums in 0.2 ps  potential energy/(kJ/mol)   temperature/K   off   seconds")
for name, (given, integrator, steps) in runs.items():
    simulation = app.Simulation(box.topology, given, integrator, openmm.Platform.getPlatformByName("CPU"))
    simulation.context.setPositions(x)
    simulation.minimizeEnergy(maxIterations=50)
    integrator.setVelocitiesToTemperature(simulation.context, 300 * unit.kelvin, 1)
    begin = time.process_time()
    simulation.step(steps)
    took, (_, off) = time.process_time() - begin, worst_length(simulation.context)
    state = simulation.context.getState(energy=True)
    energy, warm = state.getPotentialEnergy()._value, integrator.computeSystemTemperature()._value
    print(f"{name:28s} {steps:18d} {energy:27.0f} {warm:15.0f} {off:5.0e} {took:9.1f}")
    assert off < 1e-6 and 200 < warm < 400
