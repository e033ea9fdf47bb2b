"""XML and CompoundIntegrators: integrators stay what they are, in files and among others."""

from __future__ import annotations

import copy
import gc
import pickle

import numpy as np
import openmm
import pytest
from openmm import app, unit
from openmm_systems import DATA, alanine, started, state_of

from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.openmm import Isokinetic, Langevin, NoseHoover, ProjectedIntegrator, RattleIntegrator
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
