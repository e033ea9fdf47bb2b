"""Rows of an integrator on the device: trajectories beside those of the host, failures, places, multipliers."""

import copy
from pathlib import Path

import numpy as np
import openmm as mm
import pytest
from openmm import app, unit
from openmm_systems import GPUS, masses_of, particles, rows_of, started
from openmm_systems import field as on_each

from kcons import ConstraintSet, Motion, State, System
from kcons.constraints import Angle, Dihedral, Distance, FixedAtoms, Formula, LinearRelation, Plane, Sphere
from kcons.errors import ContradictionError, InputError
from kcons.openmm import Isokinetic, IsokineticSpheres, Langevin, NoseHoover, ProjectedIntegrator, hold
from kcons.openmm.device import build
from kcons.steppers import Rattle

pytestmark = pytest.mark.skipif(bool(build.refusal()), reason=build.refusal())
ON_ALL = ["Reference", "CPU", *GPUS]
SINGLE = [each for each in GPUS if each.id.endswith(("single", "none"))]
MIXED = [each for each in GPUS if each.id.endswith(("mixed", "none"))]


def field(n, rng, strength=20.0):
    """A force on each particle that depends on its place."""
    force = mm.CustomExternalForce("c*sin(3*x)+c*cos(4*y+z)")
    force.addPerParticleParameter("c")
    for k in range(n):
        force.addParticle(k, [rng.normal() * strength])
    return force


def waters(n=9):
    rng, base = np.random.default_rng(0), np.array([[0, 0, 0], [0.09572, 0, 0], [-0.0239987, 0.0926627, 0]])
    turned = [base @ np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(n)]
    x = np.concatenate([water + 0.6 * np.array([k % 3, k // 3 % 3, k // 9]) for k, water in enumerate(turned)])
    held = [(3 * k + i, 3 * k + j) for k in range(n) for i, j in ((0, 1), (0, 2), (1, 2))]
    return particles([15.9994, 1.008, 1.008] * n, field(3 * n, rng), held=held, x=x), x


def start(system, x, seed=1):
    rng = np.random.default_rng(seed)
    masses = masses_of(system)
    return 0.4 * rng.normal(size=x.shape) * np.sqrt(2.494 / np.where(masses > 0, masses, np.inf))[:, None]


def run(system, x, v, platform, steps, parts=(), device=True, **options):
    """Positions after some steps, and the Context."""
    integrator = ProjectedIntegrator(0.002, parts=parts, device=device, **options)
    context = started(system, integrator, x, v, platform)
    integrator.step(steps)
    return np.array(context.getState(positions=True).getPositions(asNumpy=True)._value), context


ROWS = [
    Distance([[0, 3]]),
    Angle([[0, 3, 10]]),
    Dihedral([[9, 13, 16, 20]]),
    Plane(21, [0, 0, 1.0]),
    Sphere(24, [0.1, 0.2, 0.3]),
    Formula("z1 - a*sin(k*x1)", 18, {"a": 0.1, "k": 2.0}, target=None),
]
#: Forces of OpenCL are multiples of 2^-32 and single numbers in mixed precision, which a trajectory of 40 steps shows.
CLOSE = {"double": 3e-8, "mixed": 3e-7, "single": 2e-5}


@pytest.fixture(scope="module")
def carried():
    """The same rows by callbacks of the host."""
    system, x = waters()
    part = hold(system, ROWS, x, take="all", keep_water=False)
    return run(system, x, start(system, x), "Reference", 40, [part], device=False)


@pytest.mark.parametrize("platform", ON_ALL)
def test_rows_go_the_way_of_the_callbacks(platform, carried):
    """Waters, some joined by rows into one large cluster, others with rows on places in space."""
    system, x = waters()
    tolerance = {"single": 1e-6, "mixed": 1e-11}.get(platform.split()[-1], 1e-13)
    found, context = run(system, x, start(system, x), platform, 40, ROWS, tolerance=tolerance)
    integrator = context.getIntegrator()
    assert {shape.together for shape in integrator.rows.shapes} == {False, True}
    assert np.abs(found - carried[0]).max() < CLOSE.get(platform.split()[-1], 1e-12)
    assert integrator.parts[0].worst_violation(context) is None
    # Positions up to 1.3 nm are rounded to 6e-8 where they are single numbers, at both ends and in three coordinates.
    bound = 2e-6 if platform.endswith("single") else 1e-10
    assert np.abs(integrator.rows.set.value(found)).max() < bound
    assert integrator.degrees_of_freedom() == carried[1].getIntegrator().degrees_of_freedom() == 81 - 27 - 6


def test_rows_of_hold_go_over_to_the_device(carried):
    system, x = waters()
    part = hold(system, ROWS, x, take="all", keep_water=False)
    found, context = run(system, x, start(system, x), "Reference", 40, [part], tolerance=1e-13)
    assert np.abs(found - carried[0]).max() < 1e-12
    # Before the first step of another Context, too.
    copied = copy.deepcopy(context.getIntegrator())
    fresh = started(system, copied, x)
    with pytest.raises(InputError, match=r"call integrator\.applyConstraints\(context\) after its positions were set"):
        _ = copied.parts[0].motion
    copied.applyConstraints(fresh)
    assert copied.parts[0].motion.rank == 27 + 6
    copied.setVelocitiesToTemperature(fresh, 300, 1)
    assert copied.parts[0].worst_violation(fresh) is None
    assert copied.degrees_of_freedom(fresh) == 81 - 27 - 6


def test_parts_serve_integrators_of_other_systems():
    (one, x), (other, _) = waters(2), waters(2)
    other.setParticleMass(0, 100.0)
    first = ProjectedIntegrator(0.001, parts=[Distance([[0, 3]])], device=True)
    second = ProjectedIntegrator(0.001, parts=first.parts, device=True)
    alone = ProjectedIntegrator(0.001, parts=[Distance([[0, 3]])], device=True)
    v, found = start(one, x), []
    for integrator, system in ((first, one), (second, other), (alone, one), (first, None)):
        context = integrator.context if system is None else started(system, integrator, x)
        context.setPositions(x)
        context.setVelocities(v + np.sin(np.arange(v.size)).reshape(v.shape))
        integrator.applyVelocityConstraints()
        found.append((context, context.getState(velocities=True).getVelocities(asNumpy=True)._value))
    np.testing.assert_allclose(found[3][1], found[2][1], atol=1e-12)
    assert np.abs(found[1][1] - found[2][1]).max() > 0.01


def test_states_with_energies_of_rows_of_hold_that_move():
    system, x = waters(2)
    length = float(np.linalg.norm(x[0] - x[3]))
    part = hold(system, [Distance([[0, 3]], lambda t: length + 0.1 * t)], x)
    energies = []
    for device in (True, False):
        integrator = ProjectedIntegrator(0.001, parts=[part], device=device)
        context = started(system, integrator, x)
        integrator.applyVelocityConstraints()
        integrator.step(5)
        energies.append(context.getState(energy=True).getPotentialEnergy()._value)
        del integrator, context
    assert energies[0] == pytest.approx(energies[1], rel=1e-10)


def protein(constraints):
    """Villin without water, near its constraints."""
    pdb = app.PDBFile(str(Path(app.__file__).parent / "data" / "test.pdb"))
    model = app.Modeller(pdb.topology, pdb.positions)
    model.deleteWater()
    model.delete([atom for atom in model.topology.atoms() if len(list(atom.residue.atoms())) < 4])
    forces = app.ForceField("amber14-all.xml")
    system = forces.createSystem(model.topology, constraints=constraints, nonbondedMethod=app.NoCutoff)
    return system, np.array(model.positions.value_in_unit(unit.nanometer))


def test_a_protein_goes_the_way_of_the_engine_on_arrays():
    """582 atoms in the field of one force; all bonds are one cluster of 589 rows in 12 levels."""
    whole, x = protein(app.AllBonds)
    masses, (pairs, lengths) = masses_of(whole), rows_of(whole)
    rows = [(*pair, length) for pair, length in zip(pairs.tolist(), lengths.tolist(), strict=True)]
    system = particles(masses, on_each("20*sin(3*x)+20*cos(4*y+z)", len(x)), held=rows)
    bonds = Distance(pairs, lengths)
    held = ConstraintSet(bonds, x, masses)
    motion = Motion(held, x)
    x = motion.restore_positions(x, bonds=[])
    v = motion.project_velocities(x, start(system, x))

    def forces(y, time=0.0):
        slope = -20 * 4 * np.sin(4 * y[:, 1] + y[:, 2])
        return -np.stack([60 * np.cos(3 * y[:, 0]), slope, slope / 4], axis=1)

    state = State(x, v)
    stepper, arrays = Rattle(), System(motion, forces)
    for _ in range(20):
        state = stepper.step(arrays, state, 0.002)
    found, context = run(system, x, v, "CPU", 20, tolerance=1e-12)
    levels = [array for array in context.getIntegrator().rows.arrays if array.name == "rows_level"]
    assert [len(array.values) - 1 for array in levels] == [11]
    assert np.abs(found - state.positions).max() < 1e-10
    assert np.abs(held.value(found) / held.scale).max() < 2e-12


# -- targets, places, images ------------------------------------------------------------------------


def test_targets_move_with_time_and_with_a_parameter():
    system, x = waters(2)
    pull = Distance([[0, 3]], lambda t: 0.6 + 0.05 * t)
    level = Plane(1, [0, 0, 1.0], lambda t: contexts[0].getParameter("level") if contexts else x[1, 2])
    system.addForce(on_each("0*level*x", 0, level=x[1, 2]))
    contexts = []
    integrator = ProjectedIntegrator(0.002, parts=[pull, level], device=True)
    context = started(system, integrator, x, platform="CPU")
    contexts.append(context)
    integrator.step(700)  # longer than what is known at once
    y = context.getState(positions=True).getPositions(asNumpy=True)._value
    assert np.linalg.norm(y[3] - y[0]) == pytest.approx(0.6 + 0.05 * 1.4, abs=1e-10)
    context.setParameter("level", float(x[1, 2]) + 0.01)
    integrator.step(1)
    y = context.getState(positions=True).getPositions(asNumpy=True)._value
    assert y[1, 2] == pytest.approx(x[1, 2] + 0.01, abs=1e-10)


@pytest.mark.parametrize("platform", SINGLE)
def test_targets_move_late_in_a_long_run(platform):
    """When single numbers of the time are a step apart."""
    system, x = waters(2)
    length, begun = np.linalg.norm(x[3] - x[0]), 2e4
    pull = Distance([[0, 3]], lambda t: length + 0.05 * (t - begun))
    integrator = ProjectedIntegrator(0.002, parts=[pull], device=True, tolerance=1e-6)
    context = started(system, integrator, x, platform=platform)
    context.setTime(begun)
    for steps in (7, 8):
        integrator.step(steps)
        state = context.getState(positions=True)
        y, time = state.getPositions(asNumpy=True)._value, state.getTime()._value
        assert np.linalg.norm(y[3] - y[0]) == pytest.approx(length + 0.05 * (time - begun), abs=2e-6)


@pytest.mark.parametrize("platform", SINGLE)
def test_fixed_atoms_of_rigid_water_in_single_precision(platform):
    """Their distances are off what the System says by the rounding of their positions."""
    system, x = waters(3)
    fixed = FixedAtoms([0, 1, 2, 3, 4])
    found, context = run(system, x, start(system, x), platform, 20, [fixed, Distance([[0, 6]])], tolerance=1e-6)
    np.testing.assert_allclose(found[:5], x[:5], atol=1e-7)
    assert context.getIntegrator().parts[0].worst_violation(context) is None
    system.setConstraintParameters(0, 0, 1, 0.0958)
    with pytest.raises(ContradictionError, match="lies between fixed atoms"):
        run(system, x, start(system, x), platform, 1, [fixed], tolerance=1e-6)


@pytest.mark.parametrize("platform", ["CPU", *MIXED])
def test_rows_across_faces_and_places_in_a_box_that_openmm_sorts(platform):
    """Molecules scattered over many boxes are moved back and sorted by OpenMM; rows mean what State gives."""
    rng = np.random.default_rng(5)
    n, edge = 400, 3.0
    force = mm.NonbondedForce()
    force.setNonbondedMethod(mm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(1.0)
    grid = np.array([[i, j, k] for i in range(8) for j in range(8) for k in range(8)])[: n // 2] * edge / 8
    x = np.zeros((n, 3))
    for k in range(n):
        force.addParticle(0, 0.2, 0.5)
        x[k] = grid[k // 2] + (k % 2) * np.array([0.15, 0, 0])
    for k in range(0, n, 2):
        force.addException(k, k + 1, 0, 1, 0)
    system = particles([39.9] * n, force, held=[(k, k + 1, 0.15) for k in range(0, n, 2)])
    system.setDefaultPeriodicBoxVectors(*(edge * np.eye(3)))
    x = x + np.repeat(rng.integers(-3, 4, size=(n // 2, 3)), 2, axis=0) * edge
    rng.shuffle(pairs := np.arange(n // 2))
    x = x.reshape(-1, 2, 3)[pairs].reshape(n, 3)  # 90 % of them are not where they would be in space
    rows = [Distance([[0, 2]]), Plane(10, [0, 0, 1.0]), Distance([[20, 22]])]
    integrator = ProjectedIntegrator(0.002, parts=rows, device=True)
    context = started(system, integrator, x, start(system, x), platform)
    integrator.step(300)
    y = context.getState(positions=True).getPositions(asNumpy=True)._value
    near = y[[0, 20]] - y[[2, 22]]
    near -= edge * np.round(near / edge)
    far = x[[0, 20]] - x[[2, 22]]
    far -= edge * np.round(far / edge)
    bound = 1e-9 if platform == "CPU" else 1e-6  # what OpenMM moves back into the box it rounds to single numbers
    assert np.abs(np.linalg.norm(near, axis=1) - np.linalg.norm(far, axis=1)).max() < bound
    assert abs(y[10, 2] - x[10, 2]) < bound
    lengths = np.linalg.norm(y[::2] - y[1::2], axis=1)
    assert np.abs(lengths - 0.15).max() < bound


def test_linear_rows_of_a_straight_molecule_are_found():
    """CO2 held by three distances is converted as the engine converts it."""
    system = particles([16.0, 12.0, 16.0])
    rows = Distance([[0, 1], [1, 2], [0, 2]], [0.116, 0.116, 0.232])
    system.addForce(field(3, np.random.default_rng(2), 20.0))
    x = np.array([[0, 0, 0], [0.116, 0, 0], [0.232, 0, 0.0]])
    found, context = run(system, x, start(system, x), "CPU", 100, rows)
    assert np.linalg.norm(found[2] - found[0]) == pytest.approx(0.232, abs=1e-9)
    assert np.abs(found[1] - (found[0] + found[2]) / 2).max() < 1e-9
    assert any(isinstance(item, LinearRelation) for item in context.getIntegrator().rows.set.constraints)


# -- multipliers ------------------------------------------------------------------------------------


def pulled_apart():
    return particles([12.0] * 2, on_each("-100*x", [1]), on_each("100*x", [0]))


@pytest.mark.parametrize("platform", ["Reference", *MIXED])
def test_multipliers_are_summed_where_the_rows_are(platform):
    """A pair that is pulled apart by 100 kJ/mol/nm at each end, and a bath that adds nothing on average."""
    x = np.array([[0, 0, 0], [0.15, 0, 0]])
    _, context = run(pulled_apart(), x, 0 * x, platform, 50, Distance([[0, 1]]))
    integrator = context.getIntegrator()
    part = integrator.parts[0]
    assert part.mean_multipliers(integrator) == pytest.approx([-100.0], abs=1e-5)
    part.reset_multipliers(integrator)
    assert np.isnan(part.mean_multipliers(integrator)).all()
    integrator.step(10)
    assert part.mean_multipliers(integrator) == pytest.approx([-100.0], abs=1e-5)
    assert part.multipliers(context) == pytest.approx([-100.0], abs=1e-5)
    for time in (5.0, 0.0):  # set by a person or a State: the mean begins anew
        context.setTime(time)
        integrator.step(10)
        assert part.mean_multipliers(integrator) == pytest.approx([-100.0], abs=1e-5)


@pytest.mark.parametrize("platform", SINGLE)
def test_multipliers_in_single_precision(platform):
    """Of rows that depend on others, as on Reference; and where one impulse is little beside the sum of many."""
    rng = np.random.default_rng(2)
    x, rows = 0.15 * rng.normal(size=(5, 3)), Distance([[i, j] for i in range(5) for j in range(i)])
    system, found = particles([12.0] * 5, field(5, rng)), []
    for place in ("Reference", platform):
        _, context = run(system, x, 0 * x, place, 100, rows)
        found.append(context.getIntegrator().parts[0].mean_multipliers(context.getIntegrator()))
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-4 * np.abs(found[0]).max())
    x = np.array([[0, 0, 0], [0.15, 0, 0]])
    _, context = run(pulled_apart(), x, 0 * x, platform, 20_000, Distance([[0, 1]]))
    integrator = context.getIntegrator()
    assert integrator.parts[0].mean_multipliers(integrator) == pytest.approx([-100.0], abs=1e-4)


@pytest.mark.parametrize(
    "ensemble", [NoseHoover(300, 10.0), Isokinetic(300), IsokineticSpheres(300, 0.1)], ids=lambda e: type(e).__name__
)
def test_multipliers_of_ensembles_are_those_of_configurations(ensemble):
    """Also where forces turn velocities along the rows; by a work-item, and by a work-group (eight rows)."""
    rng = np.random.default_rng(4)
    x = np.cumsum(np.tile([[0.12, 0.09, 0.0], [0.12, -0.09, 0.0]], (6, 1)), axis=0) + 0.01 * rng.normal(size=(12, 3))
    chain = np.arange(2, 10)
    rows = Distance([[0, 1], *np.stack([chain, chain + 1], axis=1)])
    integrator = ProjectedIntegrator(0.0002, parts=rows, device=True, ensemble=ensemble)
    forces = field(12, rng, 60.0), on_each("100*z^2", range(12))
    context = started(particles([12.0] * 12, *forces), integrator, x)
    integrator.setVelocitiesToTemperature(context, 300, 1)
    integrator.step(1)
    part, found = integrator.parts[0], []
    part.reset_multipliers(integrator)
    for _ in range(200):
        integrator.step(1)
        found.append(part.multipliers(context))
    wanted = np.mean(found, axis=0)
    np.testing.assert_allclose(part.mean_multipliers(integrator), wanted, rtol=0, atol=0.02 * np.abs(wanted).max())


def test_noise_is_in_no_multiplier():
    """A free pair in a bath: the mean of lambda is minus the centrifugal force, 2 kT/3r of two directions by r."""
    system, x = particles([12.0] * 2), np.array([[0, 0, 0], [0.15, 0, 0]])
    integrator = ProjectedIntegrator(0.002, parts=Distance([[0, 1]]), device=True, ensemble=Langevin(300, 5.0))
    integrator.setRandomNumberSeed(3)
    context = started(system, integrator, x)
    integrator.setVelocitiesToTemperature(context, 300, 1)
    integrator.step(100_000)
    wanted = -2 * 8.314462618e-3 * 300 / 0.15
    assert integrator.parts[0].mean_multipliers(integrator)[0] == pytest.approx(wanted, rel=0.1)
