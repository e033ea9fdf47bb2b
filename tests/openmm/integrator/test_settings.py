"""What an integrator was made with wins over what States, checkpoints and copies carry; runs go on from them."""

from __future__ import annotations

import copy
import functools
import pickle

import numpy as np
import openmm
import pytest
from collective_cases import bond
from ensemble_runs import run
from openmm import unit
from openmm_systems import field, holding, particles, potential_energy, started, state_of, with_and_without_device
from tied_cluster import EVERYTHING, KINDS, MASSES, ON_DEVICE, X, carried_at, cluster, row_at, thermostatted

from kcons.constraints import Distance, Plane
from kcons.errors import KconsError, OverdeterminedError, UnsupportedError
from kcons.openmm import (
    CollectiveRows,
    HamiltonianMonteCarlo,
    Isokinetic,
    Langevin,
    NoseHoover,
    NoseHooverMiddle,
    ProjectedIntegrator,
    Row,
    hold,
)
from kcons.openmm.quantities import GAS_CONSTANT

#: The trap of `cluster` is round.
pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")

#: Parts beside more ensembles and schemes: what each keeps between steps has to follow the state.
PAIRS = {
    f"{held}, {name}": functools.partial(make, **chosen)
    for held, make in (("collective", row_at), ("carried", carried_at))
    for name, chosen in {
        "Isokinetic": {"ensemble": Isokinetic(300)},
        "NoseHooverMiddle": {"ensemble": NoseHooverMiddle(300, 5.0)},
        "suzuki4": {"scheme": "suzuki4"},
    }.items()
    if (held, name) != ("collective", "suzuki4")  # whose program takes OpenMM ten seconds
} | {"collective, moving": functools.partial(row_at, rate=1.0), **ON_DEVICE}


@pytest.mark.parametrize("kind", KINDS | PAIRS)
def test_a_run_goes_on_bit_for_bit(kind):
    """In another Context with an integrator of the same settings, and again in its own; a State brings no noise."""
    noisy, seeded = "Langevin" in kind, kind in ON_DEVICE  # where noise belongs to particle, step and seed
    made, other = ((KINDS | PAIRS)[kind]() for _ in range(2))
    state, checkpoint = made.run(7), made.context.createCheckpoint()
    ways = ["State", "checkpoint"]
    if noisy and not seeded:  # random numbers of the Reference platform belong to the process
        ways.remove("State")
        made.run(2), other.run(2)
        made.context.loadCheckpoint(checkpoint)
    made.run(5)
    end = state_of(made.context)
    for way in ways:
        for one in (other, made):
            if way == "checkpoint":
                one.context.loadCheckpoint(checkpoint)
            else:
                one.context.setState(openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(state)))
            assert one.context.getStepCount() == 7
            one.run(5)
            same = way == "checkpoint" or not noisy or one is other
            assert np.array_equal(state_of(one.context), end) == same, way


# -- settings stay ------------------------------------------------------------------------------------


def given(made, other, way):
    """What `made` has, in the Context of `other`, and a step there."""
    if way == "checkpoint":
        other.context.loadCheckpoint(made.context.createCheckpoint())
    else:
        other.context.setState(made.context.getState(**EVERYTHING))
    other.run()


def kelvins(made):
    """The temperature at which Isokinetic keeps its kinetic energy."""
    twice = MASSES @ np.sum(state_of(made.context)[1] ** 2, axis=1)
    return twice / ((made.integrator.ensemble.count(made.integrator) - 1) * GAS_CONSTANT)


def length(made):
    x = state_of(made.context)[0]
    return np.linalg.norm(x[0] - x[7])


def bath(made, rate="friction"):
    read = made.integrator.getGlobalVariableByName
    return [read(rate), read("kT") / GAS_CONSTANT]


def chain(made):
    return bath(made, "frequency")


@pytest.mark.parametrize("way", ["State", "checkpoint"])
@pytest.mark.parametrize(
    ("make", "one", "two", "kept", "read"),
    [
        (lambda bath: thermostatted(bath)(), Langevin(300, 1.0), Langevin(400, 50.0), [50.0, 400], bath),
        (lambda bath: row_at(ensemble=bath), Langevin(300, 1.0), Langevin(400, 50.0), [50.0, 400], bath),
        (lambda bath: thermostatted(bath)(), Isokinetic(300), Isokinetic(400), 400, kelvins),
        (lambda bath: thermostatted(bath)(), NoseHoover(300, 5.0), NoseHoover(350, 2.0), [2.0, 350], chain),
        (lambda bath: thermostatted(bath, device=True)(), Langevin(300, 1.0), Langevin(400, 50.0), [50.0, 400], bath),
        (row_at, 0.20, 0.22, 0.22, length),
        (carried_at, 0.20, 0.22, 0.22, length),
    ],
    ids=["Langevin", "collective, Langevin", "Isokinetic", "NoseHoover", "device, Langevin", "collective", "carried"],
)
def test_settings_stay(make, one, two, kept, read, way):
    """A State of another target is put right in the next step, for it is nearer than a tenth of the length."""
    made, other = make(one), make(two)
    made.run(3)
    other.run(2)
    for _ in range(2):
        given(made, other, way)
        assert read(other) == pytest.approx(kept, rel=1e-12)
    if read is not bath:
        return
    other.integrator.setFriction(2 / unit.picosecond)
    other.integrator.setTemperature(350 * unit.kelvin)
    given(made, other, way)
    assert other.integrator.ensemble == Langevin(350, 2.0)
    for preserved in (None, True, False):
        if preserved is not None:
            other.context.reinitialize(preserveState=preserved)
            other.context.setPositions(X)
            other.run()
        assert bath(other) == pytest.approx([2.0, 350], rel=1e-12)


def test_a_temperature_that_is_refused_changes_nothing():
    """Of one degree of freedom there is none, and its run goes on."""
    system = particles([20.0], field("5*x", 1))
    part = hold(system, [Plane([0], [0, 1, 0], 0.0), Plane([0], [0, 0, 1], 0.0)], np.zeros((1, 3)))
    kept = Isokinetic()
    integrator = ProjectedIntegrator(0.002, parts=[part], ensemble=kept)
    context = run(system, integrator, np.zeros((1, 3)), np.array([[np.sqrt(0.2), 0, 0]]), 1)
    with pytest.raises(OverdeterminedError, match="g - 1 = 0"):
        integrator.setTemperature(300)
    assert integrator.ensemble is kept
    integrator.step(1)
    assert 10 * np.sum(state_of(context)[1] ** 2) == pytest.approx(2.0)


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


@with_and_without_device
@pytest.mark.parametrize(("ensemble", "name"), [(Langevin(300, 1.0), "kT"), (Isokinetic(300), "two_k")])
def test_a_setting_has_a_method_of_its_own(ensemble, name, device):
    """Written by its number, as programs do that copy all variables, it has its value again in the next step."""
    made = thermostatted(ensemble, device=device)()
    made.run(2)
    integrator, kept = made.integrator, made.integrator.getGlobalVariableByName(name)
    with pytest.raises(UnsupportedError, match=r"setting of the integrator: use setTemperature"):
        integrator.setGlobalVariableByName(name, 3.0)
    for k in range(integrator.getNumGlobalVariables()):
        value = integrator.getGlobalVariableByName(integrator.getGlobalVariableName(k))
        assert integrator.getGlobalVariable(k) == value
        integrator.setGlobalVariable(k, 0.0)
    made.run()
    assert integrator.getGlobalVariableByName(name) == kept > 1


def test_zero_kelvin_brings_to_rest():
    """Friction without noise: all energy goes, the certificate holds with velocities of rounding alone."""
    made = row_at(ensemble=Langevin(0, 6.0))  # as the field damps fastest
    first = potential_energy(made.context)
    made.run(4000)
    assert np.abs(state_of(made.context)[1]).max() < 5e-3
    assert potential_energy(made.context) < first
    assert made.integrator.getTemperature() == 0 * unit.kelvin
    made.integrator.check(made.context)
    made.run(5000)
    assert np.abs(state_of(made.context)[1]).max() < 1e-4


# -- ensembles are values -----------------------------------------------------------------------------


def test_ensembles_are_values():
    shared = Langevin(300, 1.0)
    one, two = thermostatted(shared)(), thermostatted(shared)()
    one.integrator.setTemperature(500)
    one.integrator.setFriction(7)
    two.run()
    assert two.integrator.getGlobalVariableByName("kT") == GAS_CONSTANT * 300
    assert (shared.temperature, shared.friction) == (300, 1.0)
    assert one.integrator.getTemperature() == 500 * unit.kelvin
    assert one.integrator.getFriction() == 7 / unit.picosecond
    for value, name in ((shared, "temperature"), (shared, "friction"), (Isokinetic(300), "temperature")):
        with pytest.raises(UnsupportedError, match="setTemperature or setFriction"):
            setattr(value, name, 400.0)
    with pytest.raises(AttributeError):
        one.integrator.ensemble = shared
    assert Langevin(300, 1.0) == shared != Langevin(300, 2.0)
    assert len({Langevin(300, 1.0), shared, Isokinetic(300), Isokinetic(300)}) == 2


def test_what_an_ensemble_lacks():
    plain, smooth = ProjectedIntegrator(0.002), ProjectedIntegrator(0.002, ensemble=Isokinetic(300))
    lacking = [(plain, name) for name in ("getTemperature", "setTemperature", "getFriction", "setFriction")]
    for one, name in (*lacking, (smooth, "getFriction"), (smooth, "setFriction")):
        assert not hasattr(one, name)
        with pytest.raises(UnsupportedError, match="ensemble=Langevin"):
            getattr(one, name)
    assert smooth.getTemperature() == 300 * unit.kelvin


def test_a_tolerance_that_was_left_open_stays_so_where_it_is_copied():
    integrator, other = ProjectedIntegrator(0.002), ProjectedIntegrator(0.002)
    integrator.setConstraintTolerance(other.getConstraintTolerance())
    assert integrator.asked_tolerance is None
    integrator.setConstraintTolerance(1e-7)
    assert integrator.asked_tolerance == integrator.getConstraintTolerance() == 1e-7
    integrator.setConstraintTolerance(1e-10)
    assert integrator.asked_tolerance == 1e-10
    assert ProjectedIntegrator(0.002, tolerance=1e-10).asked_tolerance == 1e-10


@pytest.mark.parametrize(
    ("make", "step"), [(ProjectedIntegrator, 4), (HamiltonianMonteCarlo.reversing_integrator, 0.0201)]
)
def test_a_long_time_step_without_a_unit_is_asked_about(make, step):
    with pytest.warns(UserWarning, match=f"the time step is {step:g} ps, that is .* fs: is it meant in fs") as seen:
        integrator = make(step)
    with pytest.warns(UserWarning, match="is it meant in fs") as seen:
        integrator.setStepSize(step)
    assert len(seen) == 1 and seen[0].filename == __file__
    integrator.setStepSize(0.02)
    integrator.setStepSize(step * unit.picosecond)
    for again in (copy.copy(integrator), pickle.loads(pickle.dumps(integrator)), make(integrator.getStepSize())):
        assert again.getStepSize() == integrator.getStepSize()


# -- copies and files ---------------------------------------------------------------------------------

COPIES = {"copy": copy.copy, "pickle": lambda one: pickle.loads(pickle.dumps(one)), "text": openmm.XmlSerializer.clone}


@pytest.mark.parametrize("kind", [*KINDS, "collective, moving", *ON_DEVICE])
def test_copies_have_the_settings_of_now_and_make_the_same_steps(kind):
    """The text is the bare program with all that it was made with, which runs without Python."""
    made, again = ((KINDS | PAIRS)[kind]() for _ in range(2))
    integrator = again.integrator
    for one in (made, again):
        if "Langevin" in kind:
            one.integrator.setTemperature(310)
            one.integrator.setFriction(0)
        if kind.startswith("collective"):
            one.part.set_target(one.integrator, 0, 0.31)
            one.part.restore(one.context)
        one.run(2)
    for name in made.integrator.program.memory:  # what belongs to a state a copy starts without
        made.integrator.setGlobalVariableByName(name, 0.0)
    begin = state_of(made.context)
    made.run(6)
    for how, copied in COPIES.items():
        if "carried" in kind and how == "pickle":
            with pytest.raises(UnsupportedError, match="belong to their System"):
                copied(integrator)
            continue
        other = copied(integrator)
        if how == "text":
            assert type(other) is (openmm.Integrator if kind in ON_DEVICE else openmm.CustomIntegrator)
        else:
            assert type(other) is type(integrator)
            assert other.program.settings == integrator.program.settings
            assert other.ensemble == integrator.ensemble
            for name, value in other.program.settings.items():
                assert other.getGlobalVariableByName(name) == value
        context = started(again.context.getSystem(), other, *begin)
        for part in getattr(other, "parts", ()):
            assert part is not again.part or "carried" in kind
        if (kind, how) == ("device, carried", "text"):
            with pytest.raises(openmm.OpenMMException, match="keep a reference to it"):
                other.step(1)
            continue
        other.step(6)
        np.testing.assert_allclose(state_of(context), state_of(made.context), rtol=0, atol=1e-9, err_msg=how)
        assert context.getStepCount() == 6


@pytest.mark.parametrize("how", ["copy", "pickle"])
def test_copies_are_made_with_the_same(how):
    integrator = ProjectedIntegrator(1e-3, "blanes-moan6", parts=[holding()], tolerance=1e-11, check_every=17)
    integrator.setRandomNumberSeed(3)
    integrator.setIntegrationForceGroups({0, 1, 2})
    again = COPIES[how](integrator)
    assert again.program.lines == integrator.program.lines
    assert (again.getConstraintTolerance(), again.check_every, again.getRandomNumberSeed()) == (1e-11, 17, 3)
    assert again.getIntegrationForceGroups() == 7 and again.getStepSize() == integrator.getStepSize()
    assert again.parts[0] is not integrator.parts[0]


def test_the_temperature_of_a_copy_can_be_changed_before_it_has_a_context():
    """Although the original has run: the new one acts at the first step, and an unchanged copy goes on as it was."""
    made = thermostatted(Isokinetic(300, momentum="free"))()
    made.run(5)
    warmer, same = (copy.copy(made.integrator) for _ in range(2))
    warmer.setTemperature(310)
    contexts = [started(cluster(bonded=True), one, *state_of(made.context)) for one in (warmer, same)]
    for one in (made.integrator, warmer, same):
        one.step(3)
    found, before = (MASSES @ np.sum(state_of(each)[1] ** 2, axis=1) for each in contexts)
    assert found / before == pytest.approx(310 / 300, rel=1e-12)
    np.testing.assert_allclose(state_of(contexts[1]), state_of(made.context), rtol=0, atol=1e-12)


# -- a part that serves several -----------------------------------------------------------------------


def in_turn(kind):
    """A distance of two particles."""
    system, start = cluster(), float(np.linalg.norm(X[0] - X[7]))
    if kind == "collective":
        return system, CollectiveRows(system, [Row(bond(0, 7), start)])
    return system, hold(system, Distance([[0, 7]], (lambda t: start + 0.03 * t) if kind == "moving" else start), X)


@pytest.mark.parametrize(
    ("kind", "first", "second"),
    [
        ("carried", {"ensemble": Isokinetic(300, momentum="free")}, {"ensemble": Isokinetic(200, momentum="free")}),
        ("carried", {"scheme": "suzuki4"}, {"scheme": "blanes-moan4"}),
        ("moving", {"scheme": "blanes-moan4"}, {"scheme": "rattle"}),
        ("moving", {"ensemble": Langevin(300, 0.0)}, {"scheme": "rattle"}),
        ("collective", {"ensemble": Langevin(300, 0.0)}, {"scheme": "rattle"}),
        ("collective", {"ensemble": Isokinetic(300, momentum="free")}, {"scheme": "rattle"}),
    ],
)
def test_integrators_in_turn_hold_the_same_part(kind, first, second):
    """As each does alone: to warm up with one and go on with another is what scripts do."""
    v = 0.3 * np.random.default_rng(1).normal(size=X.shape)

    def begun(made, options):
        system, part = made
        integrator = ProjectedIntegrator(0.002, parts=[part], **options)
        return integrator, started(system, integrator, X, v)

    together, alone = in_turn(kind), [in_turn(kind), in_turn(kind)]
    shared = [begun(together, options) for options in (first, second)]
    single = [begun(made, options) for made, options in zip(alone, (first, second), strict=True)]
    for steps in (3, 1, 4):
        for integrator, _ in (*shared, *single):
            integrator.step(steps)
    # A few units of the last place of 1 nm/ps: where the part was another's, the start of a step is looked at anew.
    for (_, one), (_, other) in zip(shared, single, strict=True):
        np.testing.assert_allclose(state_of(one), state_of(other), rtol=0, atol=1e-15)
