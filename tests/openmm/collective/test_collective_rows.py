"""Collective variables as rows: held, the same as other solvers, at the state of a Context, refused."""

from __future__ import annotations

import math

import numpy as np
import openmm
import pytest
from collective_cases import (
    CHAIN,
    FORCES,
    MASSES,
    angle,
    bond,
    chain_system,
    dihedral,
    energy_of,
    held_chain,
    peptide,
    some_velocities,
    spring_forces,
)
from openmm_systems import GPUS, pairs_force, particles, residuals, started, state_of

from kcons import ConstraintSet
from kcons.constraints import Angle, CenterDistance, Dihedral, Distance, RadiusOfGyration
from kcons.constraints.projection import project_velocities
from kcons.errors import (
    ConvergenceError,
    InfeasibleError,
    InputError,
    NonFiniteError,
    SingularGeometryError,
    UnsupportedError,
)
from kcons.motion import Motion
from kcons.openmm import SCHEMES, CollectiveRows, ProjectedIntegrator, Row, positions_of, velocities_of
from kcons.steppers import System, run


@pytest.mark.parametrize(
    ("kind", "constrained", "platform"),
    [*((kind, kind in ("bond", "three"), "Reference") for kind in FORCES), ("bond", True, "CPU")],
)
def test_rows_hold_in_positions_and_velocities(kind, constrained, platform):
    context, integrator, part = held_chain(FORCES[kind](), platform=platform, constrained=constrained)
    start = energy_of(context, integrator)
    for _ in range(10):
        integrator.step(20)
        assert np.abs(part.residuals(context)).max() <= 1e-12
        assert np.abs(part.rates(context)).max() <= 1e-12
    assert part.meets_system == constrained
    assert abs(energy_of(context, integrator) - start) < 0.02 * abs(start)


CORE = {
    "bond": lambda: Distance([0, 3]),
    "angle": lambda: Angle([1, 2, 4]),
    "dihedral": lambda: Dihedral([0, 1, 2, 3]),
    "centers": lambda: CenterDistance([0, 1], [3, 4, 5]),
    "gyration": lambda: RadiusOfGyration([0, 1, 2, 3, 4], mass_weighted=False),
}


@pytest.mark.parametrize(
    ("kind", "scheme"), [*((kind, "rattle") for kind in CORE), ("dihedral", "suzuki4"), ("angle", "blanes-moan4")]
)
def test_same_trajectory_and_multipliers_as_the_core(kind, scheme):
    context, integrator, part = held_chain(FORCES[kind](), scheme)
    held = ConstraintSet([CORE[kind]()], CHAIN, MASSES)
    motion = Motion(held, CHAIN)
    system = System(motion, spring_forces)
    x, v = state_of(context)
    state = system.initial_state(x, v)
    state = run(system, state, 0.002, 50, stepper=SCHEMES[scheme]())
    integrator.step(50)
    assert np.abs(state_of(context)[0] - state.positions).max() < 2e-12
    x, v = state_of(context)
    expected = motion.multipliers(x, v, spring_forces(x))
    assert part.multipliers(context) == pytest.approx(expected, rel=1e-8, abs=1e-8)


@pytest.mark.parametrize("target", [math.pi, -math.pi, 3 * math.pi])
def test_dihedral_held_across_its_jump(target):
    x = np.array([[0.0, 0.1, 0.0], [0.0, 0, 0], [0.15, 0, 0], [0.15, -0.1, 0.0]])
    system = particles([1.0, 12.0, 12.0, 1.0], held=((0, 1), (1, 2), (2, 3), (0, 2), (1, 3)), x=x)
    part = CollectiveRows(system, [Row(dihedral(0, 1, 2, 3), target)])
    assert part.periods == (2 * math.pi,)
    integrator = ProjectedIntegrator(0.001, parts=[part], tolerance=1e-13)
    context = started(system, integrator, x, np.random.default_rng(3).normal(size=x.shape))
    part.restore(context)
    for _ in range(20):
        integrator.step(5)
        assert abs(part.residuals(context)[0]) <= 1e-12
        assert abs(part.values(context)[0]) == pytest.approx(math.pi, abs=1e-11)


def test_velocities_that_are_no_numbers_are_refused():
    context, integrator, _ = held_chain([bond(0, 3)])
    integrator.step(1)
    x, v = state_of(context)
    broken = v.copy()
    broken[2, 1] = math.nan
    context.setVelocities(broken)
    with pytest.raises(NonFiniteError):
        integrator.step(1)
    assert np.isfinite(state_of(context)[0]).all()
    context.setPositions(x)
    context.setVelocities(v)
    integrator.step(1)


def test_two_parts_of_rows_in_one_integrator():
    system = chain_system()
    system.addConstraint(0, 1, float(np.linalg.norm(CHAIN[0] - CHAIN[1])))
    one = CollectiveRows(system, [bond(0, 3)], positions=CHAIN)
    two = CollectiveRows(system, [bond(4, 5)], positions=CHAIN)
    assert (one.meets_system, two.meets_system) == (True, False)
    integrator = ProjectedIntegrator(0.002, parts=[one, two], tolerance=1e-13)
    context = started(system, integrator, CHAIN, some_velocities())
    # Each is asked in the integrator that is named: in one made later it has the number of the other here.
    ProjectedIntegrator(0.002, parts=[two, one])
    before = two.targets(context)
    one.set_target(integrator, 0, 0.31)
    assert one.targets(context) == 0.31 and two.targets(context) == before


def test_what_is_no_context_and_no_integrator():
    system = chain_system()
    rows = CollectiveRows(system, bond(0, 3), positions=CHAIN)  # one row alone
    assert rows.n_rows == 1
    integrator = ProjectedIntegrator(0.001, parts=[rows])
    context = started(system, integrator, CHAIN)
    for call in (rows.values, rows.targets, rows.rank, rows.multipliers, rows.check, rows.restore):
        with pytest.raises(InputError, match=r"context is a ProjectedIntegrator; give the Context"):
            call(integrator)
    for call in (rows.work, lambda given: rows.set_target(given, 0, 0.3)):
        with pytest.raises(InputError, match="integrator is a Context; give the integrator that holds the rows"):
            call(context)
    for row in (1, -1):
        with pytest.raises(InputError, match=f"there is no row {row}; rows are numbered from 0 to 0"):
            rows.set_target(integrator, row, 0.3)
    with pytest.raises(InputError, match="without a rate"):
        rows.set_target(integrator, 0, 0.3, rate=1.0)
    with pytest.raises(InputError, match="no part of this System"):
        rows.check(started(chain_system(), openmm.VerletIntegrator(0.001), CHAIN, np.zeros((6, 3))))


def test_rows_that_become_singular_within_a_step_are_named_by_the_program():
    # The gradient of (r - 0.3)^2 vanishes as r goes to 0.3.
    system = particles([1.0, 1.0])
    part = CollectiveRows(system, [Row(bond(0, 1, "(r-0.3)^2"), 0.01, rate=-0.5)])
    integrator = ProjectedIntegrator(0.001, parts=[part])
    context = started(system, integrator, [[0, 0, 0], [0.4, 0, 0]], np.zeros((2, 3)))
    part.restore(context)
    with pytest.raises((SingularGeometryError, ConvergenceError), match="row 0"):
        integrator.step(40)
    assert np.isfinite(state_of(context)[0]).all()


def test_restore_keeps_the_constraints_of_other_molecules():
    system, x = chain_system(), np.vstack([CHAIN, [[2.0, 0, 0], [2.1, 0, 0]]])
    for _ in range(2):
        system.addParticle(12.0)
    system.addConstraint(len(CHAIN), len(CHAIN) + 1, 0.1)
    rows = CollectiveRows(system, [Row(bond(0, 1))], positions=x)
    context = started(system, ProjectedIntegrator(1e-3, parts=[rows]), x, np.sin(np.arange(x.size)).reshape(x.shape))
    rows.restore(context)
    assert max(residuals(system, context)) < 1e-9 and np.abs(rows.rates(context)).max() < 1e-9


THREE = [Distance([0, 3]), Dihedral([0, 1, 2, 3]), Angle([2, 3, 4])]


def test_gradients_and_rates():
    context, _, part = held_chain(FORCES["three"]())
    wanted = ConstraintSet(THREE, CHAIN, MASSES).jacobian(CHAIN).toarray()
    np.testing.assert_allclose(part.gradients(context).reshape(3, -1), wanted, atol=1e-10)
    np.testing.assert_allclose(part.rates(context), wanted @ velocities_of(context).ravel(), atol=1e-10)
    assert part.rank(context) == 3 and np.abs(part.residuals(context)).max() < 1e-12


@pytest.mark.parametrize("platform", ["Reference", *(p for p in GPUS if "mixed" in str(p.id))])
def test_an_angle_is_held_far_from_the_origin_of_a_wide_box(platform):
    """Forces in single precision see coordinates of 7 nm to 5e-7 nm, whatever the State has: there is a floor."""
    bonds = pairs_force(openmm.HarmonicBondForce(), (1, 0, 0.1, 1e5), (1, 2, 0.1, 1e5))
    nonbonded = openmm.NonbondedForce()
    nonbonded.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    for _ in range(3):
        nonbonded.addParticle(0.0, 0.3, 0.0)
    system = particles([12.0] * 3, bonds, nonbonded)
    system.setDefaultPeriodicBoxVectors(*(8.0 * np.eye(3)))
    x = np.array([7.1, 7.2, 7.3]) + 0.1 * np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    part = CollectiveRows(system, [Row(angle(0, 1, 2), np.pi / 2)])
    integrator = ProjectedIntegrator(0.001, parts=[part])
    context = started(system, integrator, x, platform=platform)
    part.restore(context)  # before the first step
    context.setVelocities(np.random.default_rng(1).normal(size=(3, 3)))
    part.apply_velocities(context)
    integrator.step(300)
    u, v = (positions_of(context)[j] - positions_of(context)[1] for j in (0, 2))
    off = abs(np.arccos(u @ v / np.linalg.norm(u) / np.linalg.norm(v)) - np.pi / 2)
    if platform == "Reference":
        assert off < 1e-12 and part.tolerance == 1e-13
    else:
        assert off < 3e-5 and 2e-6 < part.tolerance < 2e-5
        assert part.tolerance == part.finest(context)


@pytest.mark.parametrize(
    ("rows", "constrained", "words"),
    [
        (lambda: [bond(0, 3), Row(bond(0, 3), name="again")], False, r"row 1 \(again\)"),
        (lambda: [bond(1, 2), bond(0, 1)], True, "row 1"),  # which repeats a constraint of the System
        (lambda: [openmm.RMSDForce(CHAIN, list(range(6)))], False, "row 0"),  # without a gradient
    ],
)
def test_rows_without_a_direction_of_their_own_are_named(rows, constrained, words):
    context, integrator, part = _held_without_check(rows(), constrained)
    for call in (part.check, lambda _: integrator.step(1)):
        with pytest.raises(SingularGeometryError, match=words):
            call(context)
    assert words == "row 0" or part.rank(context) == 1


def _held_without_check(rows, constrained=False):
    system = chain_system()
    if constrained:
        system.addConstraint(0, 1, float(np.linalg.norm(CHAIN[0] - CHAIN[1])))
    part = CollectiveRows(system, rows, positions=CHAIN)
    integrator = ProjectedIntegrator(0.001, parts=[part], tolerance=1e-13)
    return started(system, integrator, CHAIN, some_velocities()), integrator, part


def test_functions_that_cannot_be_copied_are_refused():
    context, _, part = _held_without_check([Row(openmm.PythonForce(lambda state: (0.0, 0.0 * CHAIN)), 0.3)])
    with pytest.raises(UnsupportedError, match="Define the function in a module"):
        part.restore(context)


@pytest.mark.parametrize("constrained", [False, True])
def test_velocity_projection_is_the_nearest_in_the_mass_metric(constrained):
    context, _, part = held_chain([bond(0, 3), angle(2, 3, 4)], constrained=constrained)
    v = some_velocities(seed=9)
    context.setVelocities(v)
    part.apply_velocities(context)
    held = [Distance([0, 3]), Angle([2, 3, 4]), *[Distance([[0, 1], [2, 3]])] * constrained]
    A = ConstraintSet(held, CHAIN, MASSES).jacobian(CHAIN).toarray()
    assert state_of(context)[1] == pytest.approx(project_velocities(A, MASSES, v), abs=1e-12)


def test_rows_of_any_function_are_left_to_newton_and_targets_out_of_reach_refused():
    """Two atoms of one bonded chain, farther apart than its bonds and angles let them."""
    system, x, _ = peptide()
    rows = CollectiveRows(system, [Row(dihedral(4, 6, 8, 14, expression="sin(theta)"), 0.4)])
    context = started(system, ProjectedIntegrator(1e-3, parts=[rows]), x)
    rows.apply_positions(context)
    assert abs(rows.values(context)[0] - 0.4) < 1e-11
    for force, target, error in (
        (dihedral(6, 8, 14, 16, expression="sin(theta)"), 1.5, ConvergenceError),
        (bond(4, 8), 0.6, InfeasibleError),
    ):
        far = CollectiveRows(system, [Row(force, target)])
        context = started(system, openmm.VerletIntegrator(1e-3), x)
        with pytest.raises(error):
            far.apply_positions(context)
        np.testing.assert_array_equal(state_of(context)[0], x)
