"""Methods: one's own, those that are there, what they cannot run, and the lines of Python that run them."""

from __future__ import annotations

import functools
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import openmm
import pytest
import small_test_systems as small_test_systems  # one that moves
from openmm import unit

from kcons import steppers
from kcons.comparison import compare, observed_orders, test_systems
from kcons.comparison.methods import METHODS, STEPPERS, add_method, choose, code, on_arrays
from kcons.comparison.runs import OfStates
from kcons.comparison.test_systems.openmm_engine import OpenMMEngine, system_of
from kcons.errors import InputError
from kcons.steppers import Rattle

IN_OPENMM = {"chain": 4, "sphere-pendulum": 2, "dumbbells": 2, "rotor": 1, "alanine": 1}


@functools.cache
def built(name, size=None):
    return test_systems.build(name, size)


@pytest.fixture(params=IN_OPENMM)
def in_openmm(request):
    return built(request.param, IN_OPENMM[request.param])


@pytest.fixture
def registry():
    """Methods that are added are gone afterwards."""
    with patch.dict(METHODS):
        yield METHODS


def errors(system, *names):
    table = compare(system, names, budget=30, rounds=0)
    assert set(table.status) == {"ok"}, list(table.note)
    return table, [list(table[table.method == name].error) for name in names]


# -- one's own --------------------------------------------------------------------------------------


class Triple:
    """Yoshida's composition of RATTLE: order 4."""

    order, reversible, symplectic, force_evaluations = 4, True, True, 3
    ends = 1 / (2 - 2 ** (1 / 3))

    def check(self, system):
        pass

    def step(self, system, state, dt):
        for share in (self.ends, 1 - 2 * self.ends, self.ends):
            state = Rattle().step(system, state, share * dt)
        return state


def test_a_method_of_ones_own_is_compared(registry):
    add_method("triple", functools.partial(on_arrays, lambda dt: Triple()), title="my triple", force_evaluations=3)
    pendulum = test_systems.build("double-pendulum")
    table = compare(pendulum.with_time_steps([0.0125, 0.00625]), ["rattle", "triple"], rounds=0)
    assert observed_orders(table) == pytest.approx({"kcons RATTLE": 2.0, "my triple": 4.0}, abs=0.15)
    plain, high = (table[table.method == name] for name in ("rattle", "triple"))
    # As many forces, and steps three times as long.
    np.testing.assert_allclose(high.setting, 3 * plain.setting.to_numpy(), rtol=0.02)
    np.testing.assert_allclose(high.evaluations, plain.evaluations, rtol=0.02)
    assert high.error.iloc[-1] < 0.1 * plain.error.iloc[-1]
    assert 'METHODS["triple"].start' in code(pendulum, "triple", 0.0375, "x")


def test_a_method_that_gives_states_is_compared(registry):
    def start(system, dt):
        run = on_arrays(lambda dt: Rattle(), system, dt)

        def states():
            state = run.start
            while True:
                state = run.stepper.step(run.system, state, dt)
                yield state

        return OfStates(states, run.start)

    add_method("states", start)
    pendulum = test_systems.build("double-pendulum").with_time_steps([0.0125])
    plain, made = compare(pendulum, ["rattle", "states"], rounds=1).to_dict("records")
    assert made["status"] == "ok" and made["rounds"] >= 1
    assert (made["steps"], made["error"]) == (plain["steps"], plain["error"])


def test_what_is_wrong_with_a_method_is_said(registry):
    for options, words in (
        ({"engine": "gromacs"}, "engine is 'gromacs'; choose 'arrays', 'ASE' or 'OpenMM'"),
        ({"force_evaluations": 0}, "force_evaluations is 0; give a whole number, 1 or more"),
        *(({"name": name}, f"name is {name!r}, which stands for several") for name in ("all", "ASE", "openmm", "a,b")),
    ):
        with pytest.raises(InputError, match=words):
            add_method(**{"name": "wrong", "start": lambda system, dt: None, **options})
    assert "wrong" not in registry
    for names, words in (
        (["ratle"], r"there is no method 'ratle' \(did you mean 'rattle'"),
        ("rattle", r"give a list, such as \['rattle'\]"),
        ([], "no method is named"),
    ):
        with pytest.raises(InputError, match=words):
            choose(names)


def test_steps_cost_as_much_as_those_of_rattle():
    pendulum = built("double-pendulum")
    assert METHODS["rattle"].settings(pendulum) == pytest.approx(list(pendulum.time_steps))
    # At least two steps, and no step twice.
    assert METHODS["yoshida4"].settings(pendulum.with_time_steps([2.5, 5.0])) == pytest.approx([2.5, 1.25])


# -- on arrays and in ASE ---------------------------------------------------------------------------


def test_every_stepper_is_a_method():
    concrete = {
        item
        for name, item in vars(steppers).items()
        if isinstance(item, type) and hasattr(item, "force_evaluations") and not name.startswith("_")
    } - {steppers.Stepper, steppers.Splitting, steppers.Composition, steppers.RungeKuttaNystrom}
    assert concrete == {type(make()) for make in STEPPERS.values()}


@functools.cache
def on_dependent_rows():
    """Of 21 rows, 19 are independent; with one reference for all methods."""
    system = test_systems.build("ethanol", forces="emt").shortened(4)
    return compare(system.with_time_steps([0.5, 0.25]), [*STEPPERS, "projected-verlet", "projected-rk4"], rounds=0)


@pytest.mark.parametrize("name", [*STEPPERS, "projected-verlet", "projected-rk4"])
def test_every_stepper_runs_dependent_rows_and_finds_the_trajectory(name):
    table = on_dependent_rows()
    found = table[table.method == name]
    assert list(found.status) == ["ok", "ok"], list(found.note)
    assert found.error.iloc[-1] < 1e-4


@pytest.mark.parametrize("name", ["triple-pendulum", "rotor", "breathing"])
def test_projected_dop853_costs_no_more_forces_and_stays_on_the_constraints(name):
    table, _ = errors(built(name), "dop853", "dop853-projected")
    free, held = (table[table.method == n].reset_index() for n in ("dop853", "dop853-projected"))
    np.testing.assert_allclose(held.evaluations, free.evaluations, rtol=0.05)
    assert (held.error < free.error).all()
    assert held.sigma.max() < 1e-14 and held.tangency.max() < 1e-14
    assert held.error[0] > 100 * held.error[1] > 1e4 * held.error[2]


def test_md_engines_fix_the_atoms_of_the_slab():
    system = built("slab")
    for name in ("ase-bonds", "ase-internals", "ase-kcons"):
        run = METHODS[name].start(system, system.time_steps[0])
        run.advance()
        moved = np.abs(run.observe()[0] - system.positions).max(axis=1) > 0
        assert not moved[system.fixed].any()
        assert np.delete(moved, system.fixed).all()


@pytest.mark.parametrize("name", ["rattle", "ase-kcons", "openmm-verlet", "openmm-kcons-rattle"])
def test_a_run_goes_back_to_its_start_and_repeats(name):
    system = built("rotor")
    run = METHODS[name].start(system, system.time_steps[-1])
    ends = []
    for _ in range(2):
        run.advance(20)
        ends.append(run.observe())
        run.rewind()
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-13)
    assert run.time == pytest.approx(40 * system.time_steps[-1])


# -- in OpenMM --------------------------------------------------------------------------------------


def test_forces_masses_and_distances_are_those_of_the_system(in_openmm):
    engine = in_openmm.openmm
    context = openmm.Context(
        engine.copy(), openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName(engine.platform)
    )
    x = in_openmm.positions + 0.01 * np.random.default_rng(0).standard_normal(in_openmm.positions.shape)
    context.setPositions(x * engine.length)
    state = context.getState(forces=True, energy=True)
    forces = state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
    energy = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole) / engine.speed**2
    wanted = in_openmm.potential.forces(x)
    # Internal units of ASE and OpenMM agree to the digits that constants of nature are given with.
    np.testing.assert_allclose(forces * engine.length / engine.speed**2, wanted, rtol=0, atol=1e-9 * abs(wanted).max())
    assert energy == pytest.approx(in_openmm.potential.energy(x), rel=1e-8, abs=1e-12)
    masses = [engine.system.getParticleMass(k)._value for k in range(engine.system.getNumParticles())]
    np.testing.assert_array_equal(masses, in_openmm.masses)
    rows = [engine.system.getConstraintParameters(k) for k in range(engine.system.getNumConstraints())]
    if in_openmm.bonds is not None:
        assert [(i, j) for i, j, _ in rows] == [tuple(pair) for pair in in_openmm.bonds.tolist()]
        lengths = np.linalg.norm(np.diff(in_openmm.positions[in_openmm.bonds], axis=1)[:, 0], axis=1)
        np.testing.assert_allclose([d._value for *_, d in rows], lengths * engine.length, rtol=1e-13)
    assert engine.copy(constraints=False).getNumConstraints() == 0


def test_same_errors_as_on_arrays(in_openmm):
    system = replace(in_openmm, time_steps=in_openmm.time_steps[1:3])
    own = () if system.openmm.surfaces else ("openmm-verlet-1e-12", "openmm-kcons-rattle")
    table, (core, *others) = errors(system, "rattle", *own, "openmm-held-rattle")
    for other in others:
        assert other == pytest.approx(core, rel=1e-6)
    if "pendulum" in system.name or system.name == "alanine":  # the energy is that of OpenMM
        slopes = [table[table.method == name].slope.iloc[-1] for name in ("rattle", "openmm-held-rattle")]
        assert np.sign(slopes[0]) == np.sign(slopes[1])
    kcons = table[table.method != "openmm-verlet-1e-12"]
    assert table.sigma.max() < 2e-11 and kcons.sigma.max() < 1e-11 and kcons.tangency.max() < 1e-12


@pytest.mark.parametrize(
    ("name", "ours", "theirs"),
    [
        ("rotor", "blanes-moan6", "openmm-kcons-blanes-moan6"),
        ("alanine", "blanes-moan4", "openmm-kcons-blanes-moan4"),
        ("dumbbells", "suzuki4", "openmm-kcons-suzuki4"),
        ("sphere-pendulum", "blanes-moan6", "openmm-held-blanes-moan6"),
    ],
)
def test_higher_orders_are_the_same_scheme(name, ours, theirs):
    system = built(name, IN_OPENMM[name])
    _, (core, found) = errors(replace(system, time_steps=system.time_steps[-2:]), ours, theirs)
    # Velocities in OpenMM take up the rounding of the positions divided by a substep.
    assert found == pytest.approx(core, rel=1e-3, abs=3e-11)


def test_leapfrogs_of_openmm_and_tolerances():
    system = built("alanine", 1)
    system = replace(system, time_steps=system.time_steps[:2])
    names = ("openmm-verlet-1e-10", "openmm-middle-1e-10", "openmm-nose-hoover-1e-10")
    table, (verlet, *others) = errors(system, *names)
    for other in others:
        assert other == pytest.approx(verlet, rel=1e-6)
    assert (table.tangency > 1e-3).all()  # velocities half a step off the positions are not tangent to them
    rotor = built("rotor").shortened(4)
    rotor = replace(rotor, time_steps=rotor.time_steps[:1])
    for tolerance in (1e-4, 1e-8, 1e-12):
        found, _ = errors(rotor, f"openmm-verlet-{tolerance:.0e}".replace("e-0", "e-"))
        assert 1e-3 * tolerance < found.sigma[0] < 3 * tolerance


CALLS = []


def field(state):
    x = state.getPositions(asNumpy=True)._value
    CALLS.append(1)
    return 0.5 * float(np.sum(x * x)), -x


@pytest.mark.parametrize("name", ["verlet", "kcons-rattle", "kcons-blanes-moan6", "held-blanes-moan6"])
def test_force_evaluations_are_counted_right(name):
    plain = built("rotor")
    force = openmm.PythonForce(field)
    x, pairs = plain.positions, plain.bonds
    lengths = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    engine = OpenMMEngine(lambda: system_of(plain.masses, force, pairs=pairs, lengths=lengths), length=1.0, time=1.0)
    method, made = METHODS[f"openmm-{name}"], 0
    run = method.start(replace(plain, openmm=engine, horizon=2.0), 0.1)
    for _ in range(20):
        run.energy()  # what an onlooker asks for costs the run nothing, and saves it nothing
        before = len(CALLS)
        run.advance()
        made += len(CALLS) - before
    assert run.evaluations == 20 * method.force_evaluations
    # What a scheme evaluates at its end serves the next step; the first has one more, and each call beside parts.
    calls = 20 if "held" in name else 0
    assert run.evaluations <= made <= run.evaluations + calls + 2


def test_which_methods_run():
    at_home = choose(None, built("alanine", 1))
    assert {m.engine for m in at_home} == {"OpenMM"}
    names = [m.name for m in at_home]
    assert "openmm-verlet-1e-12" in names and "openmm-held-rattle" in names
    assert names == [m.name for m in choose(["openmm"], built("alanine", 1))]
    guests = {"rotor": ["openmm-verlet", "openmm-kcons-rattle"], "sphere": ["openmm-held-rattle"], "butane": []}
    for name, expected in guests.items():
        made = built(name, 2 if name == "sphere" else None)
        assert [m.name for m in choose(None, made) if m.engine == "OpenMM"] == expected


def test_refusals(monkeypatch):
    for method, system, reason in (
        ("openmm-verlet", "sphere", "a System holds distances only"),
        ("openmm-verlet", "butane", "no OpenMM System"),
        ("ase-bonds", "sphere", "ASE has no constraint that holds an atom on a sphere"),
    ):
        made = built(system, 2 if system == "sphere" else None)
        assert reason in METHODS[method].refusal(made)
        assert list(compare(made, [method], rounds=0).status) == ["not run"]
    monkeypatch.setattr("kcons.comparison.methods.find_spec", lambda name: None)
    assert "python -m pip install openmm" in METHODS["openmm-verlet"].refusal(built("rotor"))


# -- lines of Python --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("system", "method"),
    [
        *(("rotor", name) for name in ("blanes-moan6", "dop853", "ase-kcons", "ase-bonds")),
        *(("rotor", name) for name in ("openmm-verlet", "openmm-kcons-suzuki4", "openmm-held-rattle")),
        *(("chain", name) for name in ("rattle", "projected-rk4", "openmm-middle")),
    ],
)
def test_lines_of_python_end_where_the_run_ends(system, method):
    size = {"chain": 3}.get(system)
    made = test_systems.build(system, size, quick=True)
    chosen = METHODS[method]
    setting = 1e-6 if chosen.adaptive else chosen.settings(made)[0] / made.units.time_unit
    lines = code(made, method, np.float64(setting), f"test_systems.build({system!r}, {size}, quick=True)")
    space = {"__name__": "pasted"}
    exec(compile(lines, "pasted", "exec"), space)
    run = chosen.start(made, setting * (1.0 if chosen.adaptive else made.units.time_unit))
    while run.time < made.horizon * (1 - 1e-12):
        run.advance()
    if "context" in space:
        found = space["context"].getState(positions=True).getPositions(asNumpy=True)._value / made.openmm.length
    elif "atoms" in space:
        found = space["atoms"].positions
    else:
        found = space["end"].positions if "end" in space else space["run"].observe()[0]
    # OpenMM's own begin with velocities half a step earlier.
    apart = 0.1 if method in ("openmm-verlet", "openmm-middle") else 1e-9
    np.testing.assert_allclose(found, run.observe()[0], rtol=0, atol=apart)
