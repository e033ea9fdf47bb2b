"""Positions and corrections on their way through OpenMM: what the passage says arrives is what arrives."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm_systems import GPUS, context_of, state_of

from kcons.openmm.callback_rows.callbacks import CARRY_SCALE, Passage
from kcons.openmm.integrator.precision import Precision

ATOMS = np.array([1, 3, 4])
X = np.array([[3.0, -4.0, 5.0], [1 / 3, 2.7, -0.1], [8.0, 0.3, 1.0], [2e-3, 1.234567890123, 4.4], [-6.6, 0.7, 1e-9]])
CHANGE = 1e-3 * np.random.default_rng(0).normal(size=(3, 3))


class Messenger:
    """Takes positions down, and gives the change back."""

    def __init__(self, passage):
        self.passage, self.taken = passage, np.zeros((3, 3))

    def __call__(self, state):
        self.passage.open(state)
        self.passage.take(state, self.taken)
        return 0.0, self.passage.give(self.passage.carried(CHANGE)[0])


def sent(platform, some):
    """Where particles are after the change, and what the messenger has seen."""
    system = openmm.System()
    for _ in X:
        system.addParticle(1.0)
    passage = Passage(ATOMS, len(X))
    messenger = Messenger(passage)
    force = openmm.PythonForce(messenger)
    if some:
        force.setParticles(ATOMS.tolist())
    system.addForce(force)
    integrator = openmm.CustomIntegrator(1.0)
    integrator.addComputePerDof("x", f"x+f*{1 / CARRY_SCALE!r}")
    context = context_of(system, integrator, platform)
    passage.precision = Precision.of(context)
    context.setPositions(X)
    integrator.step(1)
    return state_of(context)[0], messenger


@pytest.mark.parametrize("platform", ["Reference", "CPU", *(p for p in GPUS if "single" not in str(p.id))])
def test_what_arrives_is_known(platform):
    there, messenger = sent(platform, some=False)
    passage = messenger.passage
    rounding = 2 * passage.precision.place * np.abs(X).max()
    assert np.abs(messenger.taken - X[ATOMS]).max() <= rounding
    expected = messenger.taken + passage.carried(CHANGE)[1]
    assert np.abs(there[ATOMS] - expected).max() <= rounding
    assert passage.same(there[ATOMS], expected)
    assert not passage.same(there[ATOMS] + 1e-10, expected)
    assert np.abs(there - X)[[0, 2]].max() <= rounding
    # A correction keeps the digits of a single number, at least.
    lost = np.abs(passage.carried(CHANGE)[1] - CHANGE) / np.abs(CHANGE)
    assert lost.max() < (2.0**-24 if passage.precision.name == "mixed" else 1e-10)


@pytest.mark.parametrize("platform", [p for p in GPUS if str(p.id).endswith(("mixed", "none"))])
def test_of_some_particles_mixed_precision_hands_over_single_numbers(platform):
    """Why the positions of all are asked for."""
    _, messenger = sent(platform, some=True)
    np.testing.assert_array_equal(messenger.taken, X[ATOMS].astype(np.float32))


def test_the_grain_of_coordinates():
    passage = Passage(ATOMS, len(X))
    assert passage.grain(5.0) == np.spacing(5.0)
    passage.precision = Precision("CUDA", "mixed")
    assert passage.grain(5.0) == pytest.approx(5 * 2.0**-47)
    assert passage.limits[0] > 1e-9
