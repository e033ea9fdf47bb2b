"""Runs of an ensemble in OpenMM."""

import numpy as np
import openmm
import pytest
from openmm_systems import alanine, masses_of, pairs_force, particles, started, state_of

from kcons.constraints import Angle, Sphere
from kcons.openmm import CollectiveRows, ProjectedIntegrator, Row, hold


def twice_kinetic(system, v):
    return float(masses_of(system) @ np.einsum("ij,ij->i", v, v))


def run(system, integrator, x, v, steps, platform="Reference"):
    context = started(system, integrator, x, v, platform)
    integrator.step(steps)
    return context


def warm(system, integrator, x, seed):
    """A Context on the constraints, with velocities of 300 K."""
    context = started(system, integrator, x)
    integrator.applyConstraints(context)
    integrator.setVelocitiesToTemperature(context, 300, seed)
    return context


def in_calls(begun, calls, x=1e-12, v=1e-10):
    """Check that steps make one motion, however they are divided into calls: what `begun` gave for each of `calls`.

    That is an integrator, its Context, and more.
    """
    made = []
    for steps in calls:
        made.append(begun())
        for count in steps:
            made[-1][0].step(count)
        for found, wanted, near in zip(state_of(made[-1][1]), state_of(made[0][1]), (x, v), strict=True):
            np.testing.assert_allclose(found, wanted, rtol=0, atol=near)
    return made


def in_calls_of_any_length(ensemble, start=alanine):
    """The same for an ensemble, with what it conserves; an integrator that made it."""
    system, x, v = start()

    def begun():
        bath = ensemble()
        integrator = ProjectedIntegrator(1e-3, tolerance=1e-13, ensemble=bath)
        return integrator, started(system, integrator, x, v), bath

    made = in_calls(begun, ([60], [1] * 60, [7, 30, 23]))
    energies = [bath.conserved_energy(integrator) for integrator, _, bath in made]
    assert energies[1:] == pytest.approx([energies[0]] * 2, rel=1e-10)
    return made[-1][0]


def tied(masses, spring, x):
    """Particles, each tied to all others."""
    pairs = ((j, i) for i in range(len(masses)) for j in range(i))
    return particles(masses, pairs_force(openmm.CustomBondForce(spring), *pairs)), np.array(x)


def two_parts():
    """Six particles: an angle and a sphere carried by kcons, a distance as a collective row."""
    places = [[0.1, 0, 0], [0.2, 0.1, 0], [0.3, 0, 0.05], [0.8, 0.1, 0], [0.8, 0.6, 0.1], [0.0, 0.6, 0.1]]
    system, x = tied(range(12, 18), "200*(r-0.5)^2", places)
    carried = hold(system, [Angle([(0, 1, 2)], 1.9), Sphere([5], [0, 0, 0], 0.6)], positions=x)
    rows = CollectiveRows(system, [Row(pairs_force(openmm.CustomBondForce("r"), (3, 4)), 0.5)])
    return system, x, (carried, rows)


def on_their_rows(r, u):
    """Check that `two_parts` hold what they should."""
    assert abs(np.linalg.norm(r[3] - r[4]) - 0.5) < 1e-12
    assert abs(np.linalg.norm(r[5]) - 0.6) < 1e-13
    assert abs((r[3] - r[4]) @ (u[3] - u[4])) < 1e-11 and abs(r[5] @ u[5]) < 1e-11
    return r, u
