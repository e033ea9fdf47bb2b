"""Pickles, copies, and the way back from XML."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import openmm
import pytest
from openmm_systems import (
    dumbbell,
    holding,
    loose_alanine,
    masses_of,
    started,
    state_of,
)

from kcons.errors import InputError
from kcons.openmm import Isokinetic, ProjectedIntegrator
from kcons.openmm.ensembles.isokinetic_ensemble import GAS_CONSTANT
from kcons.openmm.integrator.schemes import SCHEMES
from kcons.openmm.integrator.states.copies import program_of
from kcons.openmm.integrator.states.serialization import read_plain
from kcons.steppers import Geodesic
from kcons.steppers.splitting import Splitting

ALL = [*SCHEMES, "leapfrog"]


# -- files and copies -------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", [*ALL, Geodesic(3), Splitting((0.3, 0.4, 0.3), (0.5, 0.5))], ids=str)
@pytest.mark.parametrize("parts", [False, True])
def test_xml_and_the_way_back(scheme, parts):
    system, x, v = loose_alanine()

    def held():
        return [holding()] if parts else []

    integrator = ProjectedIntegrator(2e-3, scheme, parts=held(), tolerance=1e-9)
    integrator.setRandomNumberSeed(5)
    integrator.setIntegrationForceGroups({0, 1, 2})
    text = openmm.XmlSerializer.serialize(integrator)
    plain = read_plain(text)
    assert type(plain) is openmm.CustomIntegrator
    every = [
        ProjectedIntegrator.from_xml(text, parts=held()),
        ProjectedIntegrator.as_projected(plain, parts=held()),
    ]
    if not parts:
        every.append(openmm.XmlSerializer.deserialize(text))
    for again in every:
        assert type(again) is ProjectedIntegrator
        assert program_of(again) == program_of(integrator)
        assert again.getStepSize() == integrator.getStepSize()
        assert again.getConstraintTolerance() == 1e-9
        assert again.getRandomNumberSeed() == 5
        assert again.getIntegrationForceGroups() == 7
    if scheme in ALL:
        assert repr(again).split(",")[0] == repr(integrator).split(",")[0]
    a, b = started(system, integrator, x, v), started(system, again, x, v)
    integrator.step(3)
    again.step(3)
    np.testing.assert_array_equal(state_of(a), state_of(b))


def test_xml_of_something_else():
    with pytest.raises(InputError, match="VerletIntegrator is no CustomIntegrator"):
        ProjectedIntegrator.from_xml(openmm.XmlSerializer.serialize(openmm.VerletIntegrator(1e-3)))
    with pytest.raises(InputError, match="no program of ProjectedIntegrator"):
        ProjectedIntegrator.from_xml(openmm.XmlSerializer.serialize(openmm.CustomIntegrator(1e-3)))
    text = openmm.XmlSerializer.serialize(ProjectedIntegrator(1e-3, parts=[holding()]))
    for read in (ProjectedIntegrator.from_xml, openmm.XmlSerializer.deserialize):
        with pytest.raises(InputError, match=r"1 parts.*the same parts"):
            read(text)


@pytest.mark.parametrize("scheme", ["rattle", "blanes-moan6", "leapfrog"])
@pytest.mark.parametrize("how", [copy.copy, copy.deepcopy, lambda i: pickle.loads(pickle.dumps(i))])
def test_copies(scheme, how):
    system, x, v = loose_alanine()
    integrator = ProjectedIntegrator(1e-3, scheme, parts=[holding()], tolerance=1e-11, check_every=17)
    context = started(system, integrator, x, v)
    integrator.setRandomNumberSeed(3)
    integrator.setGlobalVariableByName("steepest", 0.5)
    integrator.step(3)
    again = how(integrator)
    assert type(again) is ProjectedIntegrator
    assert program_of(again) == program_of(integrator)
    assert again.getConstraintTolerance() == 1e-11
    assert again.check_every == 17
    assert again.getRandomNumberSeed() == 3
    assert again.getGlobalVariableByName("steepest") == 0.5
    assert again.parts[0] is not integrator.parts[0]
    other = started(system, again, *state_of(context))
    integrator.step(3)
    again.step(3)
    if scheme in ("leapfrog", "rattle"):  # what velocities were before they were completed is not copied
        np.testing.assert_allclose(state_of(context), state_of(other), rtol=1e-9, atol=1e-12)
    else:
        np.testing.assert_array_equal(state_of(context), state_of(other))
    assert other.getStepCount() == 3


COPIES = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda integrator: pickle.loads(pickle.dumps(integrator)),
    "XML": lambda integrator: openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(integrator)),
}


@pytest.mark.parametrize("way", COPIES)
def test_the_temperature_of_a_copy_can_be_changed_before_it_has_a_context(way):
    """Although the original has run: the new one acts at the first step, and an unchanged copy goes on as it was."""
    system, x, v = dumbbell()
    integrator = ProjectedIntegrator(1e-4, ensemble=Isokinetic(300.0, momentum="free"))
    context = started(system, integrator, x, v)
    integrator.step(5)
    warmer, same = (COPIES[way](integrator) for _ in range(2))
    warmer.setTemperature(310)
    contexts = [started(system, one, *state_of(context)) for one in (warmer, same)]
    for one in (integrator, warmer, same):
        one.step(3)
    found = masses_of(system) @ np.sum(state_of(contexts[0])[1] ** 2, axis=1)
    assert found == pytest.approx(4 * GAS_CONSTANT * 310, rel=1e-12)
    np.testing.assert_allclose(state_of(contexts[1]), state_of(context), rtol=0, atol=1e-12)
