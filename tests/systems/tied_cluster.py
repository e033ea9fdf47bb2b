"""Eight particles tied by springs, and integrators that move them."""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import openmm
import pytest
from collective_cases import bond
from openmm_systems import field, pairs_force, particles, started

from kcons.constraints import Distance
from kcons.openmm import CollectiveRows, Isokinetic, Langevin, NoseHoover, ProjectedIntegrator, Row, hold
from kcons.openmm.device import build

X = np.random.default_rng(3).random((8, 3)) * 0.3


MASSES = np.full(8, 12.0)


EVERYTHING = {"positions": True, "velocities": True, "parameters": True, "integratorParameters": True}


def cluster(strength=200.0, bonded=False):
    """Eight particles tied by springs to one another and to a place; with `bonded`, one distance held by OpenMM."""
    springs = [(i, j, 0.3, strength) for i in range(8) for j in range(i)]
    forces = pairs_force(openmm.HarmonicBondForce(), *springs), field("50*(x^2+y^2+z^2)", 8)
    return particles(MASSES, *forces, held=[(6, 7)] * bonded, x=X)


@dataclass
class Made:
    """An integrator with its Context, and what can be asked of it."""

    integrator: Any
    context: openmm.Context
    part: Any = None

    def run(self, steps=1):
        self.integrator.step(steps)
        return self.context.getState(**EVERYTHING)


def thermostatted(ensemble, **options):
    return lambda strength=200.0: begun(cluster(strength, bonded=True), ensemble=ensemble, **options)


def begun(system, part=None, platform="Reference", **options):
    if options.get("device") and (why := build.refusal()):
        pytest.skip(why)
    integrator = ProjectedIntegrator(0.002, parts=[part] if part else [], **options)
    integrator.setRandomNumberSeed(1)
    context = started(system, integrator, X, 0.3 * np.random.default_rng(1).normal(size=X.shape), platform)
    if part:
        integrator.applyConstraints()
        integrator.applyVelocityConstraints()
    return Made(integrator, context, part)


def row_at(target=0.30, strength=200.0, rate=0.0, bonded=False, **options):
    system = cluster(strength, bonded)
    rows = CollectiveRows(system, [Row(bond(0, 7), target, rate, name="my bond")], positions=X)
    return begun(system, rows, **options)


def carried_at(target=0.30, strength=200.0, **options):
    system = cluster(strength)
    return begun(system, hold(system, [Distance([[0, 7]], target)], X), **options)


#: Every class and ensemble, each as often as wanted.
KINDS = {
    "constant energy": thermostatted(None),
    "suzuki4": thermostatted(None, scheme="suzuki4"),
    "Langevin": thermostatted(Langevin(300, 1.0)),
    "Isokinetic": thermostatted(Isokinetic(300)),
    "isokinetic4": thermostatted(Isokinetic(300), scheme="isokinetic4"),
    "collective": row_at,
    "collective, Langevin": lambda **given: row_at(ensemble=Langevin(300, 1.0), **given),
    "carried": carried_at,
    "carried, Langevin": lambda **given: carried_at(ensemble=Langevin(300, 1.0), **given),
    "carried, suzuki4": lambda **given: carried_at(scheme="suzuki4", **given),
}


#: The same by the plugin, where there can be one.
ON_DEVICE = {
    "device": thermostatted(None, device=True),
    "device, Langevin": thermostatted(Langevin(300, 1.0), device=True),
    "device, NoseHoover": thermostatted(NoseHoover(300, 5.0), device=True),
    "device, carried": functools.partial(carried_at, device=True),
}
