"""kcons against closed forms and OpenMM: a particle on a sphere, a turning dumbbell, rigid water.

Run with ``python examples/validation.py``; some ten seconds. Each line is an error, and what it must be below.
"""

import numpy as np
import openmm.app

from kcons import ConstraintSet, Motion, State, System, constraints, run, steppers
from kcons.openmm import ProjectedIntegrator, hold, move_constraints, positions_of, velocities_of


def check(what, error, bound):
    print(f"{what:62s} {error:8.0e} < {bound:.0e}")
    assert error < bound, what


def path(held, x, v, masses, force=None):
    system, states = System(Motion(ConstraintSet(held, x, masses), x), force), []
    state = State(np.array(x, float), np.array(v, float))
    run(system, state, 0.01, 1000, stepper=steppers.BlanesMoan6(), observers=[states.append])
    return [np.array([getattr(s, name) for s in states]) for name in ("time", "positions", "velocities")]


ball = constraints.Sphere([0], [0.0, 0.0, 0.0], 2.0)
t, x, v = path(ball, [[2.0, 0.0, 0.0]], [[0.0, 3.0, 0.0]], [1.0])
turn = np.stack([np.cos(1.5 * t), np.sin(1.5 * t), 0 * t], axis=1)
check("particle on a sphere: off the great circle", abs(x[:, 0] - 2 * turn).max(), 1e-12)
check("particle on a sphere: speed off 3", abs(np.linalg.norm(v, axis=2) - 3).max(), 1e-13)
_, x, v = path(ball, [[2.0, 0.0, 0.0]], [[0.0, 1.5, 0.5]], [1.0], lambda x, t: np.array([[0.0, 0.0, -9.81]]))
check("spherical pendulum: energy changes by", np.ptp(0.5 * (v**2).sum(axis=2) + 9.81 * x[..., 2]), 1e-11)
check("spherical pendulum: angular momentum J_z changes by", np.ptp(np.cross(x, v)[..., 2]), 1e-12)
_, x, _ = path(constraints.Distance([[0, 1]]), [[2, 0, 0], [-1, 0, 0]], [[0.5, 3, 0], [0.5, -1.5, 0]], [1, 2])
exact = 0.5 * t[:, None, None] * [1.0, 0.0, 0.0] + np.stack([2 * turn, -turn], axis=1)
check("dumbbell that turns and flies: off its closed form", abs(x - exact).max(), 1e-12)
field, box = openmm.app.ForceField("tip3p.xml"), openmm.app.Modeller(openmm.app.Topology(), [])
box.addSolvent(field, boxSize=openmm.Vec3(1.6, 1.6, 1.6))  # nm
system = field.createSystem(box.topology, nonbondedMethod=openmm.app.CutoffPeriodic, nonbondedCutoff=0.75)
context = openmm.Context(system, ProjectedIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
context.setPositions(box.positions)
openmm.LocalEnergyMinimizer.minimize(context, maxIterations=50)
context.setVelocitiesToTemperature(300, 1)
x, v = positions_of(context), velocities_of(context)


def after(integrator, v, system=system, steps=20):
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(x)
    context.setVelocities(v)
    integrator.step(steps)
    return positions_of(context)


before = after(ProjectedIntegrator(0.001, tolerance=1e-13), -v, steps=1)
verlet = after(openmm.VerletIntegrator(0.001), (x - before) / 0.001)  # has velocities half a step behind
ours = after(ProjectedIntegrator(0.001, tolerance=1e-13), v)
check("rigid water: nm off OpenMM's own", abs(ours - verlet).max(), 1e-12)
rows = hold(system, move_constraints(system, keep_water=False), x)  # OpenMM rounds lengths of water to floats
own = after(ProjectedIntegrator(0.001, parts=[rows]), v)
check("rigid water, kcons' own solver: nm off OpenMM's own", abs(own - verlet).max(), 1e-7)
