"""Constraint objects of kcons in OpenMM: handed over with nothing half done, exact in motion, targets that move."""

from __future__ import annotations

from threading import Thread

import numpy as np
import openmm
import pytest
from carried_systems import PEPTIDE, begun, driven, off_target, start
from collective_cases import bond, dihedral
from openmm import app, unit
from openmm_systems import context_of, field, particles, started, state_of, with_and_without_device

from kcons.constraints import (
    Angle,
    CenterOfMass,
    Custom,
    Dihedral,
    Distance,
    FixedAtoms,
    Plane,
    RadiusOfGyration,
    Sphere,
)
from kcons.errors import ContradictionError, InputError, UnsupportedError
from kcons.openmm import CollectiveRows, ProjectedIntegrator, Row, hold, move_constraints
from kcons.steppers import System, run

TRIANGLE = np.array([[0, 0, 0], [0.09572, 0, 0], [-0.024, 0.09266, 0]])
SIDES = {(i, j): float(np.linalg.norm(TRIANGLE[i] - TRIANGLE[j])) for i, j in ((0, 1), (0, 2), (1, 2))}
WATERS = [[a + i, a + j] for a in (0, 3, 6) for i, j in SIDES]
X = np.array(PEPTIDE.positions._value)


def peptide(constraints=app.AllBonds):
    return app.ForceField("amber14-all.xml").createSystem(
        PEPTIDE.topology, constraints=constraints, rigidWater=False, removeCMMotion=False
    )


def waters(count, *forces):
    """Rigid waters in a box, and a dumbbell behind them."""
    x = [r + np.array([0.35 * k, 0.1, 0.1]) for k in range(count) for r in TRIANGLE] + [[0.1, 0.7, 0], [0.25, 0.7, 0]]
    nonbonded = openmm.NonbondedForce()
    nonbonded.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    for _ in x:
        nonbonded.addParticle(0.0, 0.1, 0.0)
    held = [(3 * k + i, 3 * k + j) for k in range(count) for i, j in SIDES]
    masses = [15.999, 1.008, 1.008] * count + [12.0, 12.0]
    system = particles(masses, nonbonded, *forces, held=[*held, (3 * count, 3 * count + 1)], x=x)
    system.setDefaultPeriodicBoxVectors([3, 0, 0], [0, 3, 0], [0, 0, 3])
    return system, np.array(x)


def molecules(system):
    return [list(atoms) for atoms in context_of(system, openmm.VerletIntegrator(0.001)).getMolecules()]


def content(system):
    return openmm.XmlSerializer.serialize(system)


# -- taking ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("constraints", [app.HBonds, app.AllBonds, app.HAngles], ids=str)
def test_all_constraints_change_hands(constraints):
    """As they were, and the energy and forces, and what is a molecule."""
    system = peptide(constraints)
    held = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    kept = []
    for taken in (False, True):
        if taken:
            (rows,) = move_constraints(system)
        state = started(system, openmm.VerletIntegrator(1e-3), X).getState(energy=True, forces=True)
        kept.append((state.getPotentialEnergy(), state.getForces(asNumpy=True)._value.tolist(), molecules(system)))
    assert kept[0] == kept[1]
    assert system.getNumConstraints() == 0
    found = {frozenset(p): d for p, d in zip(rows.atoms.tolist(), rows.target, strict=True)}
    assert found == {frozenset((i, j)): d._value for i, j, d in held}


@pytest.mark.parametrize(
    ("keep_water", "pairs", "left"),
    [(True, [[9, 10]], 9), (False, [*WATERS, [9, 10]], 0)],  # rigid water stays with OpenMM
)
def test_molecules_stay_what_they_were(keep_water, pairs, left):
    system, _ = waters(3)
    before = molecules(system)
    rows = move_constraints(system, keep_water=keep_water)
    assert sorted(sorted(p) for r in rows for p in r.atoms.tolist()) == sorted(pairs)
    assert system.getNumConstraints() == left
    assert molecules(system) == before


# -- holding --------------------------------------------------------------------------------------


def test_hold_moves_what_a_row_touches_and_nothing_else():
    system, x = waters(4)
    part = hold(system, Distance([[0, 6]]), x)
    assert system.getNumConstraints() == 7
    assert part.motion.constraint_set.n_rows == 7
    context = context_of(system, integrator := ProjectedIntegrator(0.001, parts=[part]))
    start(context, part, x)
    integrator.applyVelocityConstraints(context)
    integrator.step(100)
    part.check(context)
    there = state_of(context)[0]
    for k in range(4):
        for (i, j), length in SIDES.items():
            assert np.linalg.norm(there[3 * k + i] - there[3 * k + j]) == pytest.approx(length, abs=1e-7)


def _full(system):
    for group in range(30):
        system.addForce(force := openmm.HarmonicBondForce())
        force.setForceGroup(group)


def _with_site(system):
    system.setParticleMass(7, 0.0)
    system.setVirtualSite(7, openmm.TwoParticleAverageSite(0, 1, 0.5, 0.5))


@pytest.mark.parametrize(
    ("rows", "change", "error", "words"),
    [
        ([Distance([[0, 3]], 0.2), Distance([[3, 0]], 0.3)], None, ContradictionError, "different targets"),
        ([Distance([[0, 99]])], None, InputError, "99"),
        (["bond"], None, InputError, "no kcons constraint"),
        (None, None, InputError, "no kcons constraint"),
        ([Distance([[0, 3]], 1.9)], None, InputError, "half the box"),
        ([Distance([[0, 3]])], lambda system: system.addParticle(1.0), InputError, r"shape \(9, 3\)"),
        ([], None, InputError, "no rows"),
        ([Distance(np.zeros((0, 2), dtype=int))], None, InputError, "no rows"),
        (Distance([[0, 7]]), _with_site, UnsupportedError, "atom 7 is a virtual site"),
        (Distance([[0, 3]]), _full, UnsupportedError, "3 force groups, and 2 are free"),
    ],
)
def test_nothing_changes_when_hold_is_refused(rows, change, error, words):
    system, x = waters(2)
    if change:
        change(system)
    before = content(system)
    with pytest.raises(error, match=words):
        hold(system, rows, x)
    assert content(system) == before


def barostat():
    return openmm.MonteCarloBarostat(1.0, 300.0, 5)


@pytest.mark.parametrize(
    ("rows", "force", "words"),
    [
        (Distance([[0, 3]]), barostat(), r"MonteCarloBarostat.*row #7 Distance\(0, 3\).*join=True"),
        (Plane([6], [0, 0, 1]), barostat(), r"holds in space.*\(constant volume\)"),
        (Plane([6], [0, 0, 1]), openmm.CMMotionRemover(), r"holds in space.*removeCMMotion=False"),
        (Distance([[6, 7]]), openmm.AndersenThermostat(300, 1), "draws velocities of single atoms.* use Langevin"),
        (Distance([[6, 7]]), openmm.MonteCarloFlexibleBarostat(1, 300, 25, False), "rows are held, and .*let it scale"),
        (None, openmm.MonteCarloFlexibleBarostat(1.0, 300.0, 25, False), "has constraints, and MonteCarloFlexible"),
        # OpenMM accepts every trial then, and the box wanders.
        (None, openmm.MonteCarloBarostat(np.nan, 300), "Barostat has a pressure of nan bar.*; give a finite one"),
        (None, openmm.MonteCarloAnisotropicBarostat((1, np.inf, 1), 300), "has a pressure of .*; give a finite"),
        # OpenMM counts atoms as one molecule that a bond joins, also the bond of a row, but not those of an RGForce.
        (openmm.RGForce([0, 3]), barostat(), "MonteCarloBarostat moves molecules apart"),
        (field("x", [6]), openmm.CMMotionRemover(), r"holds in space.*removeCMMotion=False"),
    ],
)
def test_agents_that_break_rows_are_refused(rows, force, words):
    system, x = waters(2, force)
    if isinstance(rows, openmm.Force):
        parts = CollectiveRows(system, [rows], positions=x)
    else:
        parts = hold(system, rows, x, take="all", keep_water=False) if rows else ()
    context = started(system, integrator := ProjectedIntegrator(0.001, parts=parts), x)
    with pytest.raises((UnsupportedError, InputError), match=words):
        integrator.step(1)
    np.testing.assert_array_equal(state_of(context)[0], x)


def test_a_barostat_of_frequency_0_is_off():
    system, x = waters(2, openmm.MonteCarloBarostat(1.0, 300.0, 0))
    parts = hold(system, [Plane([6], [0, 0, 1]), Distance([[0, 3]])], x)
    _context = started(system, integrator := ProjectedIntegrator(0.001, parts=parts), x)
    integrator.step(1)
    next(force for force in system.getForces() if type(force) is openmm.MonteCarloBarostat).setFrequency(5)
    with pytest.raises(UnsupportedError, match="MonteCarloBarostat moves what"):
        integrator.step(1)


@pytest.mark.parametrize("kind", ["hold", "collective"])
def test_a_barostat_in_place_of_another_force_refuses_rows_through_the_faces_of_the_box(kind):
    system, x = waters(2, field("0", 1))
    x[3:6, 0] += 3.0
    (ends := bond(0, 3)).setUsesPeriodicBoundaryConditions(True)
    by_hold = kind == "hold"
    parts = hold(system, Distance([[0, 3]]), x, join=True) if by_hold else CollectiveRows(system, ends, positions=x)
    context = started(system, integrator := ProjectedIntegrator(0.001, parts=parts), x)
    integrator.step(1)
    system.removeForce(1)
    system.addForce(barostat())
    context.reinitialize(preserveState=True)
    with pytest.raises(UnsupportedError, match=r"row .* goes through its faces"):
        integrator.step(1)


def test_another_force_in_the_group_of_a_row_is_refused():
    system, x = waters(2)
    parts = CollectiveRows(system, [bond(0, 3)], positions=x)
    system.getForce(0).setForceGroup(1)
    context = started(system, integrator := ProjectedIntegrator(0.001, parts=parts), x)
    with pytest.raises(InputError, match="force group 1 carries a row: give other forces"):
        integrator.step(1)
    del context


@pytest.mark.usefixtures("without_device")
def test_rows_serve_one_thread_at_a_time():
    told, contexts = [], []

    def another():
        with pytest.raises(UnsupportedError, match=r"a Context in another thread .* System of each thread"):
            contexts[1].getIntegrator().step(1)
        told.append("refused")

    def height(r):
        if contexts and contexts[0].getStepCount() == 2 and not told:  # within a call
            told.append("asked")
            (thread := Thread(target=another)).start()
            thread.join()
        return r[0, 2]

    system = particles([1.0])
    rows = hold(system, Custom([0], height, lambda r: np.array([[0, 0, 1.0]]), lambda t: 0.5 * t), [[0, 0, 0]])
    for dt in (0.001, 0.002):
        contexts.append(started(system, ProjectedIntegrator(dt, parts=rows), [[0, 0, 0]], [[1.0, 0, 0.5]]))
    for context in contexts:
        context.getIntegrator().step(4)
    assert told == ["asked", "refused"]
    assert state_of(contexts[0])[0][0, 2] == pytest.approx(0.5 * 0.004, abs=1e-12)  # as if nobody had asked


@pytest.mark.usefixtures("without_device")
def test_two_parts_that_share_particles_are_refused():
    x = np.array([[0, 0, 0], [0.15, 0, 0], [0.2, 0.14, 0], [0.35, 0.14, 0.05]])
    system = particles([12.0] * 4)
    parts = [hold(system, Distance([pair]), x) for pair in ([0, 1], [1, 2], [2, 3])]
    with pytest.raises(UnsupportedError, match="two parts hold particle 1; give all rows"):
        ProjectedIntegrator(0.001, parts=parts)
    assert len(ProjectedIntegrator(0.001, parts=parts[::2]).parts) == 2


def test_what_is_no_system_and_no_context():
    for call in (move_constraints, lambda given: hold(given, Distance([[0, 3]]), PEPTIDE.positions)):
        with pytest.raises(InputError, match=r"system is a Topology; give the openmm\.System"):
            call(PEPTIDE.topology)
    rows = hold(peptide(None), Distance([[0, 3]]), PEPTIDE.positions)
    for call in (rows.check, rows.multipliers, rows.report, rows.apply_positions, rows.apply_velocities):
        with pytest.raises(InputError, match=r"context is a VerletIntegrator; give the Context"):
            call(openmm.VerletIntegrator(0.001))


# -- far targets: bonds of the System lead, and stay as they are --------------------------------------


@pytest.mark.parametrize("constraints", [None, app.HBonds, app.AllBonds, app.HAngles])
@pytest.mark.parametrize("kind", ["hold", "collective"])
def test_both_torsions_of_the_backbone_far_away(kind, constraints):
    """With constraints of the System that go into the rows or stay."""
    system = app.ForceField("amber14-all.xml").createSystem(PEPTIDE.topology, constraints=constraints)
    held = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    bonds = np.array([(b[0].index, b[1].index) for b in PEPTIDE.topology.bonds()])
    torsions, targets = [(4, 6, 8, 14), (6, 8, 14, 16)], np.radians([-60.0, -45.0])
    if kind == "hold":
        rows = hold(system, Dihedral(torsions, targets), X)
    else:
        rows = CollectiveRows(system, [Row(dihedral(*a), float(t)) for a, t in zip(torsions, targets, strict=True)])
    context = started(system, integrator := ProjectedIntegrator(0.001, parts=[rows]), X)
    integrator.applyConstraints(context)
    y = state_of(context)[0]
    np.testing.assert_allclose(Dihedral(torsions).measure(y[torsions], 0.0), targets, rtol=0, atol=1e-11)
    assert kind != "hold" or rows.report(context).residual < 1e-13
    length = [np.linalg.norm(z[bonds[:, 0]] - z[bonds[:, 1]], axis=1) for z in (X, y)]
    others = np.array([all({i, j} != set(b) for i, j, _ in held) for b in bonds.tolist()])
    assert np.abs(length[1] - length[0])[others].max(initial=0.0) < 0.002
    assert np.abs(length[1] - length[0]).max() < 0.004  # to the lengths of the force field
    for i, j, d in held:
        assert abs(np.linalg.norm(y[i] - y[j]) / d._value - 1) < 1e-9


# -- in motion ------------------------------------------------------------------------------------


def test_particles_without_mass_take_no_degree_of_freedom():
    """Bonds to a particle that OpenMM does not move, and one that is held there as well: two degrees go, not eight."""
    system = particles([0.0, 12.0, 12.0, 0.0])
    x = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0.5, 0.5, 0.5]])
    system.addConstraint(0, 3, 9.0)  # OpenMM ignores it
    part = hold(system, [Distance([[0, 1], [1, 2], [2, 1]]), FixedAtoms([3])], x)  # a row twice
    integrator = ProjectedIntegrator(0.001, parts=[part])
    context = started(system, integrator, x)
    assert part.rank(context) == 2
    assert integrator.degrees_of_freedom(context) == 2 * 3 - 2
    context.setVelocities([[0, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0, 0]])
    integrator.step(5)
    twice = 2 * integrator.kinetic_energy() / (4 * unit.MOLAR_GAS_CONSTANT_R)
    assert integrator.computeSystemTemperature() / unit.kelvin == pytest.approx(twice / unit.kelvin, rel=1e-12)


@with_and_without_device
def test_time_that_is_set_is_no_way_of_moving_targets(device):
    """What a step would have to go is made into velocity of all that hangs on the rows."""
    integrator, context = begun(*driven(), device=device)
    integrator.step(2)
    context.setTime(3.0)
    with pytest.raises(InputError, match="positions are off row"):
        integrator.step(1)


@pytest.mark.usefixtures("without_device")
def test_targets_move_with_the_time_after_a_new_step_size():
    """On Reference and CPU, OpenMM's clock goes on with the first step size within a call."""
    seen = []

    def target(t):
        seen.append(t)
        return 0.3 + 0.05 * t

    x = np.array([[0.0, 0, 0], [0.3, 0, 0]])
    system = particles([12.0, 12.0])
    integrator, context = begun(system, hold(system, Distance([[0, 1]], target), x), x)
    integrator.step(20)
    integrator.setStepSize(0.005)
    seen.clear()
    integrator.step(40)
    np.testing.assert_allclose(seen[:38], 0.2 + 0.005 * np.arange(1, 39), rtol=0, atol=1e-12)
    for steps in (0, 1, 2, 3):
        integrator.step(steps)
        assert off_target(context) < 1e-12


@pytest.mark.parametrize("platform", ["Reference", "CPU"])
@pytest.mark.parametrize("tie", [Angle([[0, 1, 2]]), RadiusOfGyration([[0, 1, 2]]), Distance([[0, 1], [1, 2]])])
def test_places_of_a_molecule_that_is_stored_in_several_images(platform, tie):
    """As the whole molecule without a cell, each place moved along with the image in which its atom is stored."""
    whole = np.array([[0.98, 0.5, 0.5], [1.03, 0.5, 0.55], [1.06, 0.54, 0.5]])
    ends = []
    for images in (np.zeros((3, 3)), np.array([[0, 0, 0], [-1.0, 0, 0], [-1, 2, 0]])):
        system = particles([12.0, 1.0, 16.0], field("-20*z", 3))
        system.setDefaultPeriodicBoxVectors([1, 0, 0], [0, 1, 0], [0, 0, 1])
        places = whole + images + [[0, 0.1, 0], [0, -0.1, 0], [0, 0, 0]]
        rows = [Sphere([0, 1], places[:2]), CenterOfMass([[1, 2]], axes=(0,)), tie]
        part = hold(system, rows, whole + images, periodic=bool(images.any()))
        integrator = ProjectedIntegrator(0.001, parts=[part])
        context = context_of(system, integrator, platform)
        context.setPositions(whole + images)
        context.setVelocities(part.motion.project_velocities(whole + images, np.full((3, 3), 0.3)))
        integrator.step(100)
        x, v = state_of(context)
        centers = np.linalg.norm(x[:2] - places[:2], axis=1)
        np.testing.assert_allclose(centers, np.linalg.norm((whole + images - places)[:2], axis=1), rtol=0, atol=1e-12)
        ends.append((x - images, v))
    assert np.abs(ends[0][0] - whole).max() > 0.005
    np.testing.assert_allclose(ends[0][0], ends[1][0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(ends[0][1], ends[1][1], rtol=0, atol=1e-7)


@pytest.mark.parametrize("every", [1, 50])
@pytest.mark.usefixtures("without_device")
def test_velocities_are_those_of_the_core(every):
    """To the last digits, also where somebody looks at each step; carried with x they have three digits less."""
    rng, k = np.random.default_rng(0), np.arange(12)
    masses = np.where(k % 2 == 0, 1.0, 10.0)
    x = np.stack([0.1 * k, 0.05 * (k % 2), 0.02 * np.sin(k)], axis=1) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    v = 0.1 * rng.normal(size=x.shape) / np.sqrt(masses)[:, None]
    x, v = (each - masses @ each / masses.sum() for each in (x, v))
    rows = Distance(np.stack([k[:-1], k[1:]], axis=1))
    system = particles(masses)
    part = hold(system, rows, x)
    core = System(part.motion)
    state = core.initial_state(x, v, project=True)
    integrator = ProjectedIntegrator(0.01, parts=[part])
    context = started(system, integrator, x, state.velocities)
    for _ in range(500 // every):
        integrator.step(every)
        found = state_of(context)
        state = run(core, state, 0.01, every)
    assert np.abs(found[0] - state.positions).max() <= 1e-13
    assert np.abs(found[1] - state.velocities).max() <= 1e-13
