"""OpenMM as an MD engine of test systems: the same system, the same trajectories, and costs that are counted right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import openmm
import pytest
from openmm import unit

from kcons.comparison import test_systems
from kcons.comparison.methods import methods
from kcons.comparison.methods import openmm as openmm_methods
from kcons.comparison.test_systems.openmm_engine import OpenMMEngine, system_of
from kcons.comparison.work_precision import measure, report

IN_OPENMM = {
    "chain": 4,
    "chain-free": 4,
    "sphere": 2,
    "sphere-pendulum": 2,
    "dumbbells": 2,
    "dumbbells-box": 8,
    "rotor": 1,
    "tennis-racket": 1,
    "alanine": 1,
}


def build(name):
    return test_systems.build(name.removesuffix("-box"), IN_OPENMM[name])


@pytest.fixture(scope="module", params=IN_OPENMM)
def in_openmm(request):
    return build(request.param)


@pytest.fixture(scope="module")
def rotor():
    return test_systems.build("rotor").shortened(4)


def errors(in_openmm, *names, **options):
    found = measure.compare(in_openmm, methods=names, **options)
    assert {m.status for m in found.measurements} <= {"ok", "thermostat"}, [m.note for m in found.measurements]
    return found, [[m.error for m in found.of(name)] for name in names]


# -- the same system --------------------------------------------------------------------------------


def test_forces_masses_and_distances_are_those_of_the_system(in_openmm):
    md_engine = in_openmm.openmm
    place = openmm.Platform.getPlatformByName(md_engine.platform)
    context = openmm.Context(md_engine.copy(), openmm.VerletIntegrator(0.001), place)
    rng = np.random.default_rng(0)
    x = in_openmm.positions + 0.01 * rng.standard_normal(in_openmm.positions.shape)
    context.setPositions(x * md_engine.length)
    state = context.getState(forces=True, energy=True)
    forces = state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
    energy = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole) / md_engine.speed**2
    wanted = in_openmm.potential.forces(x)
    # Internal units of ASE and OpenMM agree to the digits that constants of nature are given with.
    np.testing.assert_allclose(
        forces * md_engine.length / md_engine.speed**2, wanted, rtol=0, atol=1e-9 * abs(wanted).max()
    )
    assert energy == pytest.approx(in_openmm.potential.energy(x), rel=1e-8, abs=1e-12)
    system = md_engine.system
    masses = [system.getParticleMass(k).value_in_unit(unit.dalton) for k in range(system.getNumParticles())]
    np.testing.assert_array_equal(masses, in_openmm.masses)
    rows = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    if in_openmm.bonds is not None:
        assert [(i, j) for i, j, _ in rows] == [tuple(pair) for pair in in_openmm.bonds.tolist()]
        lengths = np.linalg.norm(np.diff(in_openmm.positions[in_openmm.bonds], axis=1)[:, 0], axis=1)
        np.testing.assert_allclose([d._value for *_, d in rows], lengths * md_engine.length, rtol=1e-13)
    assert md_engine.copy(constraints=False).getNumConstraints() == 0


def test_water_has_the_same_forces_in_single_precision():
    in_openmm = test_systems.build("water", 8)
    md_engine = in_openmm.openmm
    assert md_engine.platform == "CPU"
    x = in_openmm.positions
    forces = md_engine.potential().forces(x)
    wanted = in_openmm.potential.forces(x)
    np.testing.assert_allclose(forces, wanted, rtol=0, atol=1e-5 * abs(wanted).max())
    assert md_engine.system.getNumConstraints() == 24


def test_water_cut_off_by_ase_has_no_system():
    assert test_systems.build("water", 8, forces="ase").openmm is None


# -- the same trajectories --------------------------------------------------------------------------


def test_same_errors_as_on_arrays(in_openmm):
    in_openmm = replace(in_openmm, time_steps=in_openmm.time_steps[1:3])
    surfaces = bool(in_openmm.openmm.surfaces)
    own = ("openmm-surface-rattle",) if surfaces else ("openmm-verlet-1e-12", "openmm-kcons-rattle")
    found, (core, *others) = errors(in_openmm, "rattle", *own, "openmm-held-rattle")
    for other in others:
        assert other == pytest.approx(core, rel=1e-6)
    # The energy is that of OpenMM, in units of the test system.
    if "pendulum" in in_openmm.name or in_openmm.name == "alanine":
        core_slope, held_slope = (found.of(name)[-1].energy_slope for name in ("rattle", "openmm-held-rattle"))
        assert np.sign(core_slope) == np.sign(held_slope)
    for m in found.measurements:
        limit = 2e-11 if m.method == "openmm-verlet-1e-12" else 1e-11 if "kcons" in m.method else 1e-13
        assert m.constraint_residual < limit
        if m.method != "openmm-verlet-1e-12":
            assert m.velocity_residual < 1e-12


@pytest.mark.parametrize(
    ("name", "scheme"),
    [("rotor", "blanes-moan6"), ("alanine", "blanes-moan4"), ("alanine", "kahan-li6"), ("dumbbells", "suzuki4")],
)
def test_higher_orders_are_the_same_scheme(name, scheme):
    in_openmm = build(name)
    in_openmm = replace(in_openmm, time_steps=in_openmm.time_steps[-2:])
    _, (core, in_openmm) = errors(in_openmm, scheme, f"openmm-kcons-{scheme}")
    # Velocities in OpenMM take up the rounding of the positions divided by a substep.
    assert in_openmm == pytest.approx(core, rel=1e-3, abs=3e-11)
    assert in_openmm[1] < 0.1 * in_openmm[0]


@pytest.mark.parametrize("scheme", ["geodesic", "suzuki4", "blanes-moan6"])
def test_schemes_on_spheres(scheme):
    in_openmm = test_systems.build("sphere-pendulum", 2)
    in_openmm = replace(in_openmm, time_steps=in_openmm.time_steps[-2:])
    _, (core, in_openmm) = errors(in_openmm, scheme, f"openmm-surface-{scheme}")
    assert in_openmm == pytest.approx(core, rel=1e-3)


def test_built_in_integrators_without_a_bath_are_the_same_leapfrog():
    in_openmm = build("alanine")
    in_openmm = replace(in_openmm, time_steps=in_openmm.time_steps[:2])
    names = ("openmm-verlet-1e-10", "openmm-middle-1e-10", "openmm-nose-hoover-1e-10", "openmm-kcons-leapfrog")
    found, (verlet, *others) = errors(in_openmm, *names)
    for other in others:
        assert other == pytest.approx(verlet, rel=1e-6)
    # Velocities half a step off the positions are not tangent to them.
    assert all(m.velocity_residual > 1e-3 for m in found.measurements)
    assert openmm_methods.HALF_STEP in found.remarks
    assert openmm_methods.HALF_STEP in report.explanation(found)


def test_tolerance_decides_about_the_residual(rotor):
    rotor = replace(rotor, time_steps=rotor.time_steps[:1])
    names = [name for name in methods.METHODS if name.startswith("openmm-verlet")]
    tolerances = [methods.METHODS[name].tolerance for name in names]
    assert tolerances == [1e-4, 1e-5, 1e-6, 1e-8, 1e-10, 1e-12]
    found, _ = errors(rotor, *names)
    for m, tolerance in zip(found.measurements, tolerances, strict=True):
        assert 1e-3 * tolerance < m.constraint_residual < 3 * tolerance


def test_thermostats_state_no_error():
    in_openmm = build("alanine")
    in_openmm = replace(in_openmm, time_steps=in_openmm.time_steps[:1])
    names = ("openmm-middle-bath", "openmm-nose-hoover-bath")
    found, _ = errors(in_openmm, *names)
    for m in found.measurements:
        assert (m.status, m.error, m.energy_slope) == ("thermostat", None, None)
        assert m.constraint_residual < 1e-4
        assert m.step_seconds > 0
        assert m.velocity_residual > 0
    assert openmm_methods.NO_TRAJECTORY in report.explanation(found)
    assert found.of(names[0], "thermostat")


# -- costs ------------------------------------------------------------------------------------------


CALLS = []


def field(state):
    x = state.getPositions(asNumpy=True)._value
    CALLS.append(1)
    return 0.5 * float(np.sum(x * x)), -x


@pytest.fixture
def counted():
    """A rotor in a field that counts how often it is asked for."""
    plain = test_systems.build("rotor")
    force = openmm.PythonForce(field)
    x, pairs = plain.positions, plain.bonds
    lengths = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    md_engine = OpenMMEngine(lambda: system_of(plain.masses, force, pairs=pairs, lengths=lengths), length=1.0, time=1.0)
    return replace(plain, openmm=md_engine, horizon=2.0), CALLS


@pytest.mark.parametrize(
    "name",
    [
        *("openmm-verlet", "openmm-middle", "openmm-nose-hoover"),
        *("openmm-kcons-rattle", "openmm-kcons-suzuki4", "openmm-kcons-blanes-moan6", "openmm-kcons-leapfrog"),
        *("openmm-held-rattle", "openmm-held-blanes-moan6"),
    ],
)
def test_force_evaluations_are_counted_right(counted, name):
    in_openmm, calls = counted
    run = methods.METHODS[name].start(in_openmm, 0.1)
    made = steps = 0
    while not run.finished:
        # What an onlooker asks for costs the run nothing, and saves it nothing.
        run.own_energy()
        assert np.isfinite([run.positions, run.velocities]).all()
        before = len(calls)
        run.advance()
        made += len(calls) - before
        steps += run.steps
    assert steps == 20
    assert run.time == pytest.approx(2.0)
    scheme = getattr(methods.METHODS[name], "_evaluations", 1)
    assert run.own_evaluations() == 20 * scheme
    # What a scheme evaluates at its end serves the next step; the first has one more.
    assert run.own_evaluations() <= made <= run.own_evaluations() + 2


def test_baseline_repeats_its_first_step(rotor):
    run = methods.METHODS["openmm-free"].start(rotor, 0.1)
    ends = []
    for _ in range(3):
        run.rewind()
        run.advance()
        ends.append(run.positions)
    np.testing.assert_array_equal(ends[0], ends[2])
    np.testing.assert_allclose(ends[0], rotor.positions + 0.1 * rotor.velocities, rtol=0, atol=1e-14)
    assert run.time == pytest.approx(0.3)


def test_steps_are_timed_in_blocks_and_the_end_is_kept(rotor):
    method = methods.METHODS["openmm-verlet"]
    run = method.start(rotor, rotor.time_steps[-1])
    while not run.finished:
        run.advance()
    x, v = run.positions, run.velocities
    assert 0 < run.own_step_seconds() < 1e-3
    np.testing.assert_array_equal(run.positions, x)
    np.testing.assert_array_equal(run.velocities, v)


def test_constraints_are_timed_where_kcons_solves_them(rotor):
    found, _ = errors(rotor.with_time_steps([0.1]), "openmm-verlet", "openmm-held-rattle")
    own, held = found.measurements
    assert own.constraint_seconds is None
    assert 0 < held.constraint_seconds < held.step_seconds * 3  # in the run, and in blocks


def test_set_up_beyond_the_budget_is_refused_from_then_on(rotor):
    rotor.openmm._waited = 50.0
    try:
        found = measure.compare(rotor, methods=["openmm-verlet", "openmm-held-rattle"], budget=20)
    finally:
        rotor.openmm._waited = 0.0
    refused, *others = found.measurements
    assert refused.status == "not run"
    assert "OpenMM took 50 s to set up its own solver for 6 constraints, longer than the budget of 20 s" in refused.note
    assert {m.status for m in others} == {"ok"}


def test_failure_is_told(rotor):
    in_openmm = build("alanine")
    in_openmm = replace(in_openmm, time_steps=(in_openmm.horizon / 4,))
    found = measure.compare(in_openmm, methods=["openmm-kcons-rattle"])
    (m,) = found.measurements
    assert m.status == "failed"
    assert "Error" in m.note


# -- which methods run ------------------------------------------------------------------------------


def test_usual_methods_of_a_system_at_home_in_openmm():
    in_openmm = build("alanine")
    picked = methods.chosen(None, in_openmm)
    assert {m.md_engine for m in picked} == {"openmm"}
    names = [m.name for m in picked]
    assert "openmm-verlet-1e-12" in names
    assert "openmm-held-rattle" in names
    assert not any("surface" in name for name in names)
    assert names == [m.name for m in methods.chosen(["openmm"], in_openmm)]


def test_guests_on_other_test_systems(rotor):
    in_openmm = [m.name for m in methods.chosen(None, rotor) if m.md_engine == "openmm"]
    assert in_openmm == ["openmm-verlet", "openmm-kcons-rattle"]
    sphere = test_systems.build("sphere", 2)
    assert [m.name for m in methods.chosen(None, sphere) if m.md_engine == "openmm"] == ["openmm-surface-rattle"]
    assert not [m for m in methods.chosen(None, test_systems.build("butane")) if m.md_engine == "openmm"]
    assert not [m for m in methods.chosen() if m.md_engine == "openmm"]


def test_refusals(monkeypatch, rotor):
    sphere = test_systems.build("sphere", 2)
    assert methods.METHODS["openmm-verlet"].refuses(sphere) == "a System holds distances only"
    assert "no particle" in methods.METHODS["openmm-surface-rattle"].refuses(rotor)
    assert methods.METHODS["openmm-free"].refuses(sphere) is None
    assert "no OpenMM System" in methods.METHODS["openmm-verlet"].refuses(test_systems.build("butane"))
    assert "kelvin" in methods.METHODS["openmm-middle-bath"].refuses(rotor)
    monkeypatch.setattr(openmm_methods, "find_spec", lambda name: None)
    assert "not installed" in methods.METHODS["openmm-verlet"].refuses(rotor)
    assert not [m for m in methods.chosen(None, rotor) if m.md_engine == "openmm"]
    (only,) = measure.compare(rotor, methods=["openmm-verlet"]).measurements
    assert only.status == "not run"
