"""A collective variable pulled through a run: the ends of villin are drawn apart in OpenMM, and the work is counted.

Run with ``python examples/pulled_collective_variable.py``; some ten seconds. The distance is a constraint whose target
moves: it is where it should be in every step. Units are nm, ps and kJ/mol. Replace file, atoms and path by yours.
"""

from pathlib import Path

import numpy as np
from openmm import Platform, app, unit
from scipy.integrate import trapezoid

from kcons.constraints import Distance
from kcons.openmm import Langevin, ProjectedIntegrator, hold, positions_of

pdb = app.PDBFile(str(Path(app.__file__).parent / "data" / "test.pdb"))
molecule = app.Modeller(pdb.topology, pdb.positions)
molecule.deleteWater()
field = app.ForceField("amber14-all.xml", "amber14/tip3pfb.xml")
system = field.createSystem(molecule.topology, constraints=app.HBonds, hydrogenMass=3 * unit.dalton)
alphas = [atom.index for atom in molecule.topology.atoms() if atom.name == "CA"]
x = np.array(molecule.positions.value_in_unit(unit.nanometer))
ends, start, speed = [alphas[0], alphas[-1]], np.linalg.norm(x[alphas[0]] - x[alphas[-1]]), 0.2  # nm/ps

rows = hold(system, Distance([ends], lambda t: start + speed * t), x)
integrator = ProjectedIntegrator(4 * unit.femtoseconds, parts=[rows], ensemble=Langevin(300, 5.0))
simulation = app.Simulation(molecule.topology, system, integrator, Platform.getPlatformByName("CPU"))
context = simulation.context
context.setPositions(x)
integrator.minimizeEnergy(context, maxIterations=50)
integrator.setVelocitiesToTemperature(context, 300 * unit.kelvin, 1)

print("time/ps   distance/nm   mean force/(kJ/mol/nm)   work/(kJ/mol)")
forces = []
for step in range(0, 301, 5):
    if step:
        simulation.step(5)
    forces.append(rows.multipliers(context)[0])
    if step % 50 == 0:
        work = trapezoid(forces, dx=5 * 0.004 * speed)  # of the target, from the beginning
        distance = np.linalg.norm(np.subtract(*positions_of(context)[ends]))
        print(f"{step * 0.004:7.1f} {distance:13.6f} {np.mean(forces[-10:]):24.1f} {work:15.1f}")
        assert abs(distance - start - speed * step * 0.004) < 1e-9
