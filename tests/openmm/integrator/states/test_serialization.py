"""XML and CompoundIntegrators: integrators stay what they are, in files and among others."""

from __future__ import annotations

import copy
import gc
import json
import pickle
import re
from xml.sax.saxutils import escape

import numpy as np
import openmm
import pytest
from openmm import app, unit
from openmm_systems import DATA, alanine, started, state_of

from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.openmm import (
    Isokinetic,
    IsokineticCircles,
    Langevin,
    LangevinRespa,
    NoseHoover,
    NoseHooverMiddle,
    ProjectedIntegrator,
    RattleIntegrator,
)
from kcons.openmm.integrator.states.hearing import live
from kcons.openmm.integrator.states.serialization import read_plain

xml = openmm.XmlSerializer

MADE = {
    "rattle": lambda: ProjectedIntegrator(1e-3),
    "suzuki4": lambda: ProjectedIntegrator(1e-3, "suzuki4", tolerance=1e-11, check_every=7),
    "leapfrog": lambda: ProjectedIntegrator(1e-3, "leapfrog"),
    "Langevin": lambda: ProjectedIntegrator(1e-3, ensemble=Langevin(310, 2.0)),
    "Isokinetic": lambda: ProjectedIntegrator(1e-3, ensemble=Isokinetic(320, atoms=[0, 1, 2], momentum="free")),
    "RattleIntegrator": lambda: RattleIntegrator(1e-3),
    "RattleIntegrator, checked": lambda: RattleIntegrator(1e-3, tolerance=1e-9, check_every=30),
}
made = pytest.mark.parametrize("name", MADE)


def all_of(integrator):
    inner = getattr(integrator, "_ends", integrator)
    return (
        type(integrator),
        repr(integrator),
        inner.ensemble,
        inner.asked_tolerance,
        inner.check_every,
        inner.spare,
        integrator.getStepSize(),
        integrator.getConstraintTolerance(),
        integrator.getIntegrationForceGroups(),
    )


WAYS = {
    "XML": lambda integrator: xml.deserialize(xml.serialize(integrator)),
    "clone": xml.clone,
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda integrator: pickle.loads(pickle.dumps(integrator)),
}
ways = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)


@made
@ways
def test_everything_comes_back(name, way):
    integrator = MADE[name]()
    integrator.setIntegrationForceGroups({0, 2})
    if name == "Langevin":
        integrator.setRandomNumberSeed(11)
        integrator.setTemperature(333 * unit.kelvin)
    again = way(integrator)
    assert all_of(again) == all_of(integrator)
    if name == "Langevin":
        assert again.getRandomNumberSeed() == 11
        assert again.getTemperature() == 333 * unit.kelvin


@pytest.mark.parametrize("name", ["rattle", "Langevin", "leapfrog", "RattleIntegrator"])
def test_a_simulation_from_files_goes_on(name, tmp_path):
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    system, x, v = alanine()
    place = openmm.Platform.getPlatformByName("Reference")
    integrator = MADE[name]()
    if name == "Langevin":
        integrator.setFriction(0)
    first = app.Simulation(pdb.topology, system, integrator, place)
    first.context.setPositions(x)
    first.context.setVelocities(v)
    first.step(25)
    files = {what: str(tmp_path / f"{what}.xml") for what in ("system", "integrator", "state")}
    for what in ("system", "integrator"):
        with open(files[what], "w") as file:
            file.write(xml.serialize(getattr(first, what)))
    first.saveState(files["state"])
    second = app.Simulation(pdb.topology, files["system"], files["integrator"], place, state=files["state"])
    assert type(second.integrator) is type(integrator)
    first.step(25)
    second.step(25)
    assert second.currentStep == 50
    np.testing.assert_allclose(state_of(second.context), state_of(first.context), rtol=0, atol=1e-9)
    second.integrator.check()


def test_without_kcons_the_program_is_what_it_was():
    """What OpenMM reads of the file by itself makes the same steps."""
    system, x, v = alanine()
    for name in ("rattle", "RattleIntegrator"):
        integrator = MADE[name]()
        plain = read_plain(xml.serialize(integrator))
        assert type(plain) in (openmm.CustomIntegrator, openmm.CompoundIntegrator)
        ours, theirs = started(system, integrator, x, v), started(system, plain, x, v)
        integrator.step(10)
        plain.step(10)
        np.testing.assert_allclose(state_of(ours), state_of(theirs), rtol=0, atol=1e-9)


def test_files_of_others_and_of_other_versions():
    text = xml.serialize(ProjectedIntegrator(1e-3))
    with pytest.raises(InputError, match="names SomethingNew, which this version"):
        xml.deserialize(text.replace("ProjectedIntegrator", "SomethingNew"))
    text = xml.serialize(ProjectedIntegrator(1e-3, ensemble=Langevin(300, 1.0)))
    with pytest.raises(InputError, match="names Warmth"):
        xml.deserialize(text.replace("Langevin", "Warmth"))
    verlet = xml.deserialize(xml.serialize(openmm.VerletIntegrator(1e-3)))
    assert type(verlet) is openmm.VerletIntegrator
    of_others = copy.copy(compound(openmm.VerletIntegrator(1e-3)))
    assert type(of_others) is openmm.CompoundIntegrator
    assert of_others.getNumIntegrators() == 1


# -- CompoundIntegrator -----------------------------------------------------------------------------


def compound(*members, current=0):
    made = openmm.CompoundIntegrator()
    for member in members:
        made.addIntegrator(member)
    made.setCurrentIntegrator(current)
    return made


@ways
def test_members_stay_what_they_are(way):
    first = compound(openmm.VerletIntegrator(1e-3), MADE["Langevin"](), MADE["suzuki4"](), current=2)
    again = way(first)
    gc.collect()
    assert (again.getNumIntegrators(), again.getCurrentIntegrator()) == (3, 2)
    for k, name in ((1, "Langevin"), (2, "suzuki4")):
        member = live(again.getIntegrator(k))
        assert member is not live(first.getIntegrator(k))
        assert all_of(member) == all_of(MADE[name]())
    assert live(again.getIntegrator(0)) is None


def test_members_make_their_own_steps():
    """Rattle, then a leapfrog of OpenMM, then order 4: as by integrators in Contexts of their own."""
    system, x, v = alanine()

    def verlet():
        integrator = openmm.VerletIntegrator(1e-3)
        integrator.setConstraintTolerance(1e-10)
        return integrator

    kinds = (MADE["rattle"], verlet, MADE["suzuki4"])
    together = compound(*(kind() for kind in kinds))
    gc.collect()
    context = started(system, together, x, v)
    for k, kind in enumerate(kinds):
        alone = started(system, integrator := kind(), *state_of(context))
        together.setCurrentIntegrator(k)
        together.step(12)
        integrator.step(12)
        np.testing.assert_allclose(state_of(context), state_of(alone), rtol=0, atol=1e-9)
    assert context.getStepCount() == 36


def test_members_see_that_others_moved_x():
    """OpenMM keeps the forces of a CustomIntegrator while others make steps."""
    system, x, v = alanine()
    other = openmm.VerletIntegrator(1e-3)
    other.setConstraintTolerance(1e-10)
    together = compound(MADE["rattle"](), other)
    context = started(system, together, x, v)
    for k, steps in ((0, 2), (1, 5)):
        together.setCurrentIntegrator(k)
        together.step(steps)
    fresh = started(system, alone := MADE["rattle"](), *state_of(context))
    together.setCurrentIntegrator(0)
    together.step(1)
    alone.step(1)
    np.testing.assert_allclose(state_of(context)[0], state_of(fresh)[0], rtol=0, atol=1e-8)


def test_members_check_in_a_simulation():
    """Also those to which nobody else holds on."""
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    system, x, v = alanine()
    together = compound(ProjectedIntegrator(1e-3, check_every=10), openmm.VerletIntegrator(1e-3))
    gc.collect()
    made = app.Simulation(pdb.topology, system, together, openmm.Platform.getPlatformByName("Reference"))
    made.context.setPositions(x)
    made.context.setVelocities(v)
    made.step(30)
    assert made.currentStep == 30
    together.setConstraintTolerance(1e-9)
    assert live(together.getIntegrator(0)).asked_tolerance == 1e-9
    made.step(5)
    far = state_of(made.context)[0]
    far[6] += [0.0, 0.0, 0.15]
    made.context.setPositions(far)
    with pytest.raises((InputError, ConvergenceError), match="constraint"):
        made.step(25)
    np.testing.assert_array_equal(state_of(made.context)[0], far)


def test_a_compound_within_a_compound_is_refused():
    together = openmm.CompoundIntegrator()
    with pytest.raises(UnsupportedError, match="add a ProjectedIntegrator"):
        together.addIntegrator(RattleIntegrator(1e-3))
    assert together.getNumIntegrators() == 0


def test_step_sizes_pass_through_a_compound():
    """As in the integrator itself: OpenMM sets any."""
    system, x, v = alanine("AllBonds")
    member, compound = ProjectedIntegrator(1e-3, ensemble=NoseHoover(300, 10)), openmm.CompoundIntegrator()
    compound.addIntegrator(member)
    started(system, compound, x, v)
    with pytest.raises(InputError, match="cannot follow a time step"):
        compound.setStepSize(0.5 * unit.picosecond)
    compound.setStepSize(2 * unit.femtoseconds)
    assert member.getStepSize() == 2 * unit.femtoseconds


def test_chain_orders_of_numpy_are_written():
    made = ProjectedIntegrator(1e-3, ensemble=NoseHoover(300, 1, chain_order=np.int64(4)))
    read = openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(made))
    assert read.ensemble == made.ensemble


# -- files that others have written -----------------------------------------------------------------


def changed(integrator, change):
    """The text of a file in which what kcons says is another."""
    text = xml.serialize(integrator)
    found = re.search(r'kcons="([^"]*)"', text)
    note = change(json.loads(found[1].replace("&quot;", '"')))
    note = note if isinstance(note, str) else json.dumps(note)
    return text[: found.start(1)] + escape(note, {'"': "&quot;"}) + text[found.end(1) :]


def ensemble_of(name, **values):
    return lambda note: {**note, "ensemble": [name, values]}


BATH = {"temperature": 300, "friction": 1.0}
WRONG = {
    "-5 K": (ensemble_of("Langevin", temperature=-5, friction=1), "temperature"),
    "a friction in words": (ensemble_of("Langevin", temperature=300, friction="much"), "friction"),
    "no number": (ensemble_of("Langevin", temperature=float("nan"), friction=1), "temperature"),
    "no temperature": (ensemble_of("Langevin", friction=1), "other values than Langevin takes"),
    "one value more": (ensemble_of("Langevin", **BATH, more=1), "other values than Langevin takes"),
    "no groups": (ensemble_of("LangevinRespa", **BATH), "other values than LangevinRespa takes"),
    "an unknown ensemble": (ensemble_of("Magic"), "names Magic"),
    "a class of another kind": (ensemble_of("Value"), "give one of kcons.openmm"),
    "another ensemble": (ensemble_of("NoseHoover", temperature=300, frequency=1.0), "no program of"),
    "no ensemble": (lambda note: {k: v for k, v in note.items() if k != "ensemble"}, "names no ensemble"),
    "an ensemble in words": (lambda note: {**note, "ensemble": "Langevin"}, "names no ensemble"),
    "a tolerance in words": (lambda note: {**note, "tolerance": "a"}, "tolerance"),
    "a tolerance below zero": (lambda note: {**note, "tolerance": -1}, "tolerance"),
    "half a check": (lambda note: {**note, "check_every": 0.5}, "check_every"),
    "no tolerance": (lambda note: {k: v for k, v in note.items() if k != "tolerance"}, "lacks class, check_every or"),
    "no class": (lambda note: {**note, "class": None}, "lacks class"),
    "a base class": (lambda note: {**note, "class": "StatesOnConstraints"}, "is no integrator"),
    "a class of one kind": (lambda note: {**note, "class": "RattleIntegrator"}, "no program of a RattleIntegrator"),
    "a class of nobody": (lambda note: {**note, "class": "Popen"}, "names Popen"),
    "a list": (lambda note: [], "lacks class"),
    "cut": (lambda note: json.dumps(note)[:-9], "cannot be read"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_a_file_says_is_looked_at(name):
    change, words = WRONG[name]
    text = changed(ProjectedIntegrator(1e-3, ensemble=Langevin(300, 1.0)), change)
    with pytest.raises(InputError, match=words):
        xml.deserialize(text)


@pytest.mark.parametrize(
    "ensemble",
    [
        Langevin(0, 1.0),
        LangevinRespa(300, 1.0, {3: 1, 0: 4}, "middle"),
        IsokineticCircles(300, 1.0, {0: 1, 1: 2}),
        Isokinetic(kinetic_energy=3.0, convention="notes"),
        NoseHoover(300, 1.0, length=4, chain_order=6, repeats=2),
        NoseHooverMiddle(300, 1.0, momentum="free"),
    ],
    ids=lambda ensemble: type(ensemble).__name__,
)
def test_each_ensemble_comes_back_from_a_file(ensemble):
    again = xml.deserialize(xml.serialize(ProjectedIntegrator(1e-3, ensemble=ensemble)))
    assert again.ensemble == ensemble
