"""Runs of an ensemble in OpenMM."""

import numpy as np
from openmm_systems import masses_of, started


def twice_kinetic(system, v):
    return float(masses_of(system) @ np.einsum("ij,ij->i", v, v))


def run(system, integrator, x, v, steps, platform="Reference"):
    context = started(system, integrator, x, v, platform)
    integrator.step(steps)
    return context
