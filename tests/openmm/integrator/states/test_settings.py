"""What an integrator was made with wins over what States, checkpoints, XML and copies carry."""

from __future__ import annotations

import copy
import functools
import pickle

import numpy as np
import openmm
import pytest
from openmm import app, unit
from openmm_systems import potential_energy, started, state_of
from tied_cluster import EVERYTHING, MASSES, X, begun, cluster, thermostatted

from kcons.constraints import Distance, Plane, Sphere
from kcons.errors import InputError, KconsError, OverdeterminedError, UnsupportedError
from kcons.openmm import (
    CollectiveRows,
    Isokinetic,
    Langevin,
    NoseHooverMiddle,
    ProjectedIntegrator,
    RattleIntegrator,
    Row,
    SurfaceIntegrator,
    WaysBackIntegrator,
    hold,
)
from kcons.openmm.ensembles.isokinetic_ensemble import GAS_CONSTANT

#: The trap of `cluster` is round.
pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")

#: Radius of the sphere that holds particle 0, about a centre that is not the origin.
RADIUS, CENTRE = 0.2, X[0] - [0.2, 0, 0]


def bond(i=0, j=7):
    force = openmm.CustomBondForce("r")
    force.addBond(i, j)
    return force


def rattle(strength=200.0):
    return begun(cluster(strength, bonded=True), RattleIntegrator(0.002))


def on_a_sphere(radius=RADIUS, strength=200.0, **options):
    system = cluster(strength)
    surface = Sphere([0], CENTRE, radius)
    integrator = SurfaceIntegrator(0.002, surfaces=surface, system=system, **options)
    return begun(system, integrator, lambda context: integrator.applyConstraints(context), integrator.surfaces[0])


def row_at(target=0.30, strength=200.0, **options):
    system = cluster(strength)
    rows = CollectiveRows(system, [Row(bond(), target)], positions=X)
    return begun(system, ProjectedIntegrator(0.002, parts=[rows], **options), rows.restore, rows)


def carried_at(target=0.30, strength=200.0, **options):
    system = cluster(strength)
    part = hold(system, [Distance([[0, 7]], target)], X)
    return begun(system, ProjectedIntegrator(0.002, parts=[part], **options), part.apply_positions, part)


#: Every class and ensemble, each as often as wanted.
KINDS = {
    "constant energy": thermostatted(None),
    "suzuki4": thermostatted(None, scheme="suzuki4"),
    "leapfrog": thermostatted(None, scheme="leapfrog"),
    "Langevin": thermostatted(Langevin(300, 1.0)),
    "Isokinetic": thermostatted(Isokinetic(300)),
    "isokinetic4": thermostatted(Isokinetic(300), scheme="isokinetic4"),
    "RattleIntegrator": rattle,
    "sphere": on_a_sphere,
    "sphere, compiled": lambda **given: on_a_sphere(compiled=True, **given),
    "sphere, Langevin": lambda **given: on_a_sphere(ensemble=Langevin(300, 1.0), **given),
    "collective": row_at,
    "collective, leapfrog": lambda **given: row_at(scheme="leapfrog", **given),
    "collective, Langevin": lambda **given: row_at(ensemble=Langevin(300, 1.0), **given),
    "carried": carried_at,
    "carried, suzuki4": lambda **given: carried_at(scheme="suzuki4", **given),
}
kinds = pytest.mark.parametrize("kind", KINDS)
#: Parts beside more ensembles and schemes: what each keeps between steps has to follow the state.
PAIRS = {
    f"{held}, {name}": functools.partial(make, **chosen)
    for held, make in (("sphere", on_a_sphere), ("collective", row_at), ("carried", carried_at))
    for name, chosen in {
        "Isokinetic": {"ensemble": Isokinetic(300)},
        "isokinetic4": {"ensemble": Isokinetic(300), "scheme": "isokinetic4"},
        "NoseHooverMiddle": {"ensemble": NoseHooverMiddle(300, 5.0)},
        "blanes-moan4": {"scheme": "blanes-moan4"},
    }.items()
}


# -- a run goes on ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS | PAIRS)
@pytest.mark.parametrize("way", ["State", "XML", "checkpoint"])
def test_a_run_goes_on_bit_for_bit(kind, way):
    """In another Context with an integrator of the same settings, and again in its own; noise aside."""
    if "Langevin" in kind and way != "checkpoint":
        pytest.skip("a State does not carry random numbers")
    made, other = ((KINDS | PAIRS)[kind]() for _ in range(2))
    made.run(7)
    state, checkpoint = made.context.getState(**EVERYTHING), made.context.createCheckpoint()
    if way == "checkpoint":
        other.run(2)
        other.context.loadCheckpoint(checkpoint)
        if "Langevin" in kind:  # random numbers of the Reference platform belong to the process
            other.run(5)
            made.context.loadCheckpoint(checkpoint)
            made.run(5)
            np.testing.assert_array_equal(state_of(other.context), state_of(made.context))
            return
    else:
        text = openmm.XmlSerializer.serialize(state)
        other.context.setState(openmm.XmlSerializer.deserialize(text) if way == "XML" else state)
    assert other.context.getStepCount() == 7
    made.run(5)
    other.run(5)
    end = state_of(made.context)
    np.testing.assert_array_equal(state_of(other.context), end)
    if way == "checkpoint":
        made.context.loadCheckpoint(checkpoint)
    else:
        made.context.setState(state)
    made.run(5)
    np.testing.assert_array_equal(state_of(made.context), end)


# -- settings stay ------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", ["State", "checkpoint"])
@pytest.mark.parametrize("options", [{}, {"part": True}])
def test_friction_and_temperature_stay(way, options):
    def make(temperature, friction):
        ensemble = Langevin(temperature, friction)
        return row_at(ensemble=ensemble) if options else thermostatted(ensemble)()

    made, other = make(300, 1.0), make(400, 50.0)
    made.run(3)
    kept = made.context.createCheckpoint() if way == "checkpoint" else made.context.getState(**EVERYTHING)
    for _ in range(2):
        if way == "checkpoint":
            other.context.loadCheckpoint(kept)
        else:
            other.context.setState(kept)
        other.run()
        read = other.integrator.getGlobalVariableByName
        assert (read("friction"), read("kT")) == (50.0, GAS_CONSTANT * 400)
    other.integrator.setFriction(2 / unit.picosecond)
    other.integrator.setTemperature(350 * unit.kelvin)
    other.context.setState(made.context.getState(**EVERYTHING))
    other.run()
    assert (read("friction"), read("kT")) == (2.0, GAS_CONSTANT * 350)
    assert other.integrator.ensemble == Langevin(350, 2.0)
    other.context.reinitialize(preserveState=True)
    assert (read("friction"), read("kT")) == (2.0, GAS_CONSTANT * 350)
    other.context.reinitialize()
    assert (read("friction"), read("kT")) == (2.0, GAS_CONSTANT * 350)


@pytest.mark.parametrize("way", ["State", "checkpoint"])
def test_the_kinetic_energy_of_isokinetic_stays(way):
    made, other = thermostatted(Isokinetic(300))(), thermostatted(Isokinetic(400))()
    first = made.run(3)
    checkpoint = made.context.createCheckpoint()
    other.run(1)
    if way == "checkpoint":
        other.context.loadCheckpoint(checkpoint)
    else:
        other.context.setState(first)
    other.run(2)
    v = state_of(other.context)[1]
    count = other.integrator.ensemble.count(other.integrator)
    assert abs(MASSES @ np.sum(v**2, axis=1) / ((count - 1) * GAS_CONSTANT * 400) - 1) < 1e-12


def test_a_temperature_that_is_refused_changes_nothing():
    """Of one degree of freedom there is none, and its run goes on."""
    system, field = openmm.System(), openmm.CustomExternalForce("5*x")
    field.addParticle(system.addParticle(20.0), [])
    system.addForce(field)
    part = hold(system, [Plane([0], [0, 1, 0], 0.0), Plane([0], [0, 0, 1], 0.0)], np.zeros((1, 3)))
    bath = Isokinetic(kinetic_energy=2.0)
    integrator = ProjectedIntegrator(0.002, parts=[part], ensemble=bath)
    context = started(system, integrator, np.zeros((1, 3)), np.array([[0.1, 0, 0]]))
    integrator.step(1)
    with pytest.raises(OverdeterminedError, match="g - 1 = 0"):
        integrator.setTemperature(300)
    assert integrator.ensemble is bath
    integrator.step(1)
    assert 10 * np.sum(state_of(context)[1] ** 2) == pytest.approx(2.0)


@pytest.mark.parametrize("way", ["State", "checkpoint"])
@pytest.mark.parametrize("make", [row_at, carried_at, on_a_sphere], ids=["collective", "carried", "surface"])
def test_targets_stay(make, way):
    """A State of another target is put right in the next step, for it is nearer than a tenth of the length."""
    made, other = make(0.20), make(0.22)
    made.run(3)
    other.run(3)
    if way == "checkpoint":
        other.context.loadCheckpoint(made.context.createCheckpoint())
    else:
        other.context.setState(made.context.getState(**EVERYTHING))
    other.run(1)
    x = state_of(other.context)[0]
    length = np.linalg.norm(x[0] - CENTRE) if make is on_a_sphere else np.linalg.norm(x[0] - x[7])
    assert abs(length - 0.22) < 1e-12


def test_set_target_outlives_a_state():
    made = row_at(0.30)
    before = made.run(2)
    made.part.set_target(made.integrator, 0, 3.5 * unit.angstrom)
    made.part.restore(made.context)
    made.run(2)
    made.context.setState(before)
    with pytest.raises(KconsError, match="restore"):
        made.run()
    made.part.restore(made.context)
    made.run()
    assert abs(made.part.values(made.context)[0] - 0.35) < 1e-12
    assert copy.copy(made.integrator).program.settings == made.integrator.program.settings


def test_number_of_stages_stays():
    """A scheme of five drifts leaves a State that says where they end."""
    giver, taker, plain = carried_at(scheme="suzuki4"), carried_at(), carried_at()
    taker.context.setState(giver.run(3))
    plain.context.setState(giver.context.getState(positions=True, velocities=True))
    for one in (taker, plain):
        one.run(3)
    assert taker.integrator.getGlobalVariableByName("end_stage") == 1
    np.testing.assert_allclose(state_of(taker.context), state_of(plain.context), rtol=0, atol=1e-12)


def test_seeds_of_checkpoints():
    """Replicas that start from one checkpoint go their own ways where they were given seeds."""

    def make(seed):
        integrator = ProjectedIntegrator(0.002, ensemble=Langevin(300, 10.0))
        integrator.setRandomNumberSeed(seed)
        return begun(cluster(bonded=True), integrator)

    first = make(1)
    first.run(3)
    kept = first.context.createCheckpoint()
    ends = []
    for seed in (1, 1, 2, 2, 3):
        made = make(seed)
        made.context.loadCheckpoint(kept)
        assert made.context.getStepCount() == 3
        made.run(3)
        ends.append(state_of(made.context)[0])
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[2], ends[3])
    for a, b in ((0, 2), (2, 4), (0, 4)):
        assert np.abs(ends[a] - ends[b]).max() > 1e-5


@pytest.mark.parametrize("way", ["XML", "plain"])
def test_from_xml_takes_what_is_given(way):
    text = openmm.XmlSerializer.serialize(ProjectedIntegrator(0.002, ensemble=Langevin(300, 1.0)))
    given = openmm.XmlSerializer.deserialize(text)
    kind, ensemble = ProjectedIntegrator, Langevin(400, 50.0)
    made = kind.from_xml(text, ensemble=ensemble) if way == "XML" else kind.as_projected(given, ensemble=ensemble)
    read = made.getGlobalVariableByName
    assert (read("friction"), read("kT")) == (50.0, GAS_CONSTANT * 400)
    rows = CollectiveRows(cluster(), [Row(bond(), 0.3)])
    text = openmm.XmlSerializer.serialize(ProjectedIntegrator(0.002, parts=[rows]))
    others = CollectiveRows(cluster(), [Row(bond(), 0.35)])
    again = ProjectedIntegrator.from_xml(text, parts=[others])
    assert again.getGlobalVariableByName("target1_0") == 0.35


@kinds
@pytest.mark.parametrize("how", [copy.copy, copy.deepcopy, lambda i: pickle.loads(pickle.dumps(i))])
def test_copies_have_the_settings_of_now(kind, how):
    made = KINDS[kind]()
    if kind.startswith("carried") and how not in (copy.copy, copy.deepcopy):
        pytest.skip("a System takes carried rows along, not an integrator")
    if "Langevin" in kind:
        made.integrator.setTemperature(310)
        made.integrator.setFriction(3)
    if kind.startswith("collective"):
        made.part.set_target(made.integrator, 0, 0.31)
    again = how(made.integrator)
    if kind != "RattleIntegrator":
        assert again.program.settings == made.integrator.program.settings
        assert again.ensemble == made.integrator.ensemble
        for name, value in again.program.settings.items():
            assert again.getGlobalVariableByName(name) == value
    assert again.getStepSize() == made.integrator.getStepSize()


# -- ensembles are values -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "more"),
    # A particle on a sphere is damped least.
    [(row_at, 5000), (carried_at, 5000), (on_a_sphere, 16000), (lambda **given: thermostatted(**given)(), 5000)],
)
def test_zero_kelvin_brings_to_rest(make, more):
    """Friction without noise: all energy goes, the certificate holds with velocities of rounding alone."""
    made = make(ensemble=Langevin(0, 6.0))  # as the field damps fastest
    first = potential_energy(made.context)
    made.run(4000)
    assert np.abs(state_of(made.context)[1]).max() < 5e-3
    assert potential_energy(made.context) < first
    assert made.integrator.getTemperature() == 0 * unit.kelvin
    made.integrator.check(made.context)
    made.run(more)
    assert np.abs(state_of(made.context)[1]).max() < 1e-4


# -- States of other integrators ----------------------------------------------------------------------


def stock(integrator):
    return lambda: begun(cluster(bonded=True), integrator())


STOCK = {
    "Verlet": stock(lambda: openmm.VerletIntegrator(0.002)),
    "LangevinMiddle": stock(lambda: openmm.LangevinMiddleIntegrator(300, 1, 0.002)),
    "NoseHoover": stock(lambda: openmm.NoseHooverIntegrator(300, 1, 0.002)),
    "Custom": stock(lambda: _custom()),
    "Compound": stock(lambda: _compound()),
}


def _custom():
    integrator = openmm.CustomIntegrator(0.002)
    integrator.addGlobalVariable("stale", 0.5)
    integrator.addPerDofVariable("force", 7.0)
    integrator.addPerDofVariable("x_last", 0.0)
    integrator.addComputePerDof("x_last", "x")
    return integrator


def _compound():
    integrator = openmm.CompoundIntegrator()
    integrator.addIntegrator(openmm.VerletIntegrator(0.002))
    integrator.addIntegrator(openmm.VerletIntegrator(0.002))
    integrator.setCurrentIntegrator(1)
    return integrator


@functools.cache
def given_by(name):
    """After two steps: the whole State, positions and velocities alone, the same as arrays."""
    giver = {**KINDS, **STOCK}[name]()
    giver.run(2)
    bare = giver.context.getState(positions=True, velocities=True)
    return giver.context.getState(**EVERYTHING), bare, np.array(state_of(giver.context))


@kinds
def test_states_of_all_integrators_load(kind):
    """Each run starts as from positions and velocities alone."""
    taker, plain = KINDS[kind](), KINDS[kind]()
    if "Langevin" in kind:
        taker.integrator.setFriction(0)
        plain.integrator.setFriction(0)
    within = 1e-3 if "leapfrog" in kind else 1e-9
    for name in (*STOCK, *(name for name in KINDS if "Langevin" not in name)):
        state, bare, arrays = given_by(name)
        taker.run(2)
        taker.context.setState(state)
        np.testing.assert_array_equal(state_of(taker.context), arrays)
        assert taker.context.getStepCount() == 2
        assert taker.context.getTime() == state.getTime()
        plain.context.setState(bare)
        for one in (taker, plain):
            one.integrator.applyConstraints(one.context)
            one.run(3)
        np.testing.assert_allclose(state_of(taker.context), state_of(plain.context), rtol=0, atol=within)


def test_nvt_to_nve_and_back_through_a_simulation(tmp_path):
    topology = app.Topology()
    residue = topology.addResidue("X", topology.addChain())
    for _ in range(8):
        topology.addAtom("C", app.element.carbon, residue)
    place = openmm.Platform.getPlatformByName("Reference")

    def simulation(**given):
        made = app.Simulation(topology, cluster(bonded=True), ProjectedIntegrator(0.002, **given), place)
        return made

    warm = simulation(ensemble=Langevin(300, 1.0))
    warm.context.setPositions(X)
    warm.integrator.setVelocitiesToTemperature(warm.context, 300, 1)
    warm.step(5)
    for number, given in enumerate(({}, {"ensemble": Isokinetic(300)}, {"ensemble": Langevin(310, 2.0)}, {})):
        file = str(tmp_path / f"{number}.xml")
        warm.saveState(file)
        again = simulation(**given)
        again.loadState(file)
        np.testing.assert_array_equal(state_of(again.context), state_of(warm.context))
        again.step(5)
        warm = again
    assert warm.currentStep == 25


@pytest.mark.parametrize("kind", ["constant energy", "collective", "sphere", "RattleIntegrator"])
def test_checkpoints_of_other_programs_are_refused(kind):
    taker = KINDS[kind]()
    taker.run(2)
    before = state_of(taker.context)
    verlet = STOCK["Verlet"]()
    verlet.run(3)
    own = taker.context.createCheckpoint()
    damaged = [own[:-40] + b"{" + own[-39:], own[:-60] + own[-30:], own[-24:], own.replace(b'"seeds"', b'"sends"')]
    others = [verlet.context.createCheckpoint(), KINDS["Langevin"]().context.createCheckpoint(), b"", b"x"]
    for checkpoint in (*others, *damaged):
        with pytest.raises(InputError, match=r"another integrator.*Load a State"):
            taker.context.loadCheckpoint(checkpoint)
        np.testing.assert_array_equal(state_of(taker.context), before)
        taker.run(1)
        before = state_of(taker.context)


def test_states_into_a_compound_integrator():
    """OpenMM runs the program there, and nothing of kcons comes before its first step."""
    compound, ours = openmm.CompoundIntegrator(), ProjectedIntegrator(0.002, ensemble=Langevin(400, 50.0))
    compound.addIntegrator(ours)
    compound.addIntegrator(openmm.VerletIntegrator(0.002))
    made = begun(cluster(bonded=True), compound)
    giver = openmm.CompoundIntegrator()
    giver.addIntegrator(other := ProjectedIntegrator(0.002, ensemble=Langevin(300, 1.0)))
    giver.addIntegrator(openmm.VerletIntegrator(0.002))
    given = begun(cluster(bonded=True), giver)
    made.context.setState(given.run(2))
    compound.step(1)
    assert ours.getGlobalVariableByName("friction") == 50.0
    assert other.getGlobalVariableByName("friction") == 1.0


@pytest.mark.parametrize("groups", [{40}, [0.5], "0", 1.5, None])
def test_what_is_no_force_group_is_refused(groups):
    """Without groups that exist, no force would act."""
    integrator = ProjectedIntegrator(1e-3)
    with pytest.raises(InputError, match="group"):
        integrator.setIntegrationForceGroups(groups)
    integrator.setIntegrationForceGroups(np.int64(3))
    assert integrator.getIntegrationForceGroups() == 3


@pytest.mark.parametrize("tolerance", ["small", None, float("nan"), 1 * unit.nanometer])
def test_what_is_no_tolerance_is_refused(tolerance):
    with pytest.raises(InputError, match="tolerance"):
        ProjectedIntegrator(1e-3).setConstraintTolerance(tolerance)


# -- variables that are written by their numbers ----------------------------------------------------


def written(integrator, values):
    """As programs do that copy all variables, of `values` by name."""
    for k in range(integrator.getNumGlobalVariables()):
        name = integrator.getGlobalVariableName(k)
        integrator.setGlobalVariable(k, values.get(name, integrator.getGlobalVariable(k)))


def everything_of(integrator):
    return {
        integrator.getGlobalVariableName(k): integrator.getGlobalVariable(k)
        for k in range(integrator.getNumGlobalVariables())
    }


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "RattleIntegrator"])
def test_variables_of_a_copy_begin_a_run_anew(kind):
    """From the state where it is, with the settings that the integrator has."""
    ran, fresh = KINDS[kind](), KINDS[kind]()
    if "Langevin" in kind:
        ran.integrator.setFriction(0)
        fresh.integrator.setFriction(0)
    ran.run(5)
    written(ran.integrator, everything_of(copy.deepcopy(ran.integrator)))
    fresh.context.setState(ran.context.getState(positions=True, velocities=True))
    ran.run(5)
    fresh.run(5)
    within = 1e-3 if "leapfrog" in kind else 1e-9
    np.testing.assert_allclose(state_of(ran.context), state_of(fresh.context), rtol=0, atol=within)


def test_a_setting_that_was_written_by_its_number_is_refused_once():
    made = thermostatted(Langevin(300, 1.0))()
    made.run(2)
    before = state_of(made.context)
    written(made.integrator, dict.fromkeys(everything_of(made.integrator), 0.0))
    with pytest.raises(UnsupportedError, match=r"setGlobalVariable wrote kT, friction.*use setTemperature"):
        made.run()
    np.testing.assert_array_equal(state_of(made.context), before)
    assert made.integrator.getGlobalVariableByName("kT") == GAS_CONSTANT * 300
    made.run()
    written(made.integrator, {"kT": GAS_CONSTANT * 310})
    made.integrator.setTemperature(310)  # which writes it as well
    made.run()
    assert made.integrator.getTemperature() == 310 * unit.kelvin


def test_a_tolerance_that_was_left_open_stays_so_where_it_is_copied():
    integrator, other = ProjectedIntegrator(0.002), ProjectedIntegrator(0.002)
    integrator.setConstraintTolerance(other.getConstraintTolerance())
    assert integrator.asked_tolerance is None
    integrator.setConstraintTolerance(1e-7)
    assert integrator.asked_tolerance == integrator.getConstraintTolerance() == 1e-7
    integrator.setConstraintTolerance(1e-10)
    assert integrator.asked_tolerance == 1e-10
    assert ProjectedIntegrator(0.002, tolerance=1e-10).asked_tolerance == 1e-10


# -- time steps -------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [ProjectedIntegrator, RattleIntegrator, WaysBackIntegrator])
@pytest.mark.parametrize("step", [4, 0.0201, 2.0])
def test_a_long_time_step_without_a_unit_is_asked_about(make, step):
    with pytest.warns(UserWarning, match=f"the time step is {step:g} ps, that is .* fs: is it meant in fs") as seen:
        integrator = make(step)
    assert [warning.filename for warning in seen] == [__file__]
    with pytest.warns(UserWarning, match="is it meant in fs") as seen:
        integrator.setStepSize(step)
    assert len(seen) == 1 and seen[0].filename == __file__
    integrator.setStepSize(0.02)
    integrator.setStepSize(step * unit.picosecond)
    for again in (copy.copy(integrator), pickle.loads(pickle.dumps(integrator)), make(integrator.getStepSize())):
        assert again.getStepSize() == integrator.getStepSize()
    again = openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(integrator))
    assert again.getStepSize() == integrator.getStepSize()
