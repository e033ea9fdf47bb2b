"""Constraints of a System handed over to kcons: the same molecules, nothing half done."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import openmm
import pytest
from ase.build import molecule
from openmm import app, unit

from kcons.constraints import Dihedral, Distance, Plane
from kcons.errors import ContradictionError, InputError, UnsupportedError
from kcons.openmm import ProjectedIntegrator
from kcons.openmm.callback_rows.hold import hold, take_constraints

PEPTIDE = app.PDBFile(str(Path(__file__).parents[2] / "data" / "alanine-dipeptide-implicit.pdb"))
TRIANGLE = np.array([[0, 0, 0], [0.09572, 0, 0], [-0.024, 0.09266, 0]])


def reference(system, integrator):
    return openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))


def peptide(constraints=app.AllBonds):
    return app.ForceField("amber14-all.xml").createSystem(
        PEPTIDE.topology, constraints=constraints, rigidWater=False, removeCMMotion=False
    )


def waters(count, barostat=None):
    """Rigid waters in a box, and a dumbbell behind them."""
    system = openmm.System()
    system.setDefaultPeriodicBoxVectors([3, 0, 0], [0, 3, 0], [0, 0, 3])
    nonbonded = openmm.NonbondedForce()
    nonbonded.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    x = []
    for k in range(count):
        for m, r in zip([15.999, 1.008, 1.008], TRIANGLE, strict=True):
            system.addParticle(m)
            x.append(r + np.array([0.35 * k, 0.1, 0.1]))
        for i, j in ((0, 1), (0, 2), (1, 2)):
            system.addConstraint(3 * k + i, 3 * k + j, float(np.linalg.norm(TRIANGLE[i] - TRIANGLE[j])))
    for _ in range(2):
        system.addParticle(12.0)
    x += [[0.1, 0.7, 0], [0.25, 0.7, 0]]
    system.addConstraint(3 * count, 3 * count + 1, 0.15)
    for _ in x:
        nonbonded.addParticle(0.0, 0.1, 0.0)
    system.addForce(nonbonded)
    if barostat is not None:
        system.addForce(barostat)
    return system, np.array(x)


def molecules(system):
    context = reference(system, openmm.VerletIntegrator(0.001))
    return [list(atoms) for atoms in context.getMolecules()]


def content(system):
    return openmm.XmlSerializer.serialize(system)


# -- taking ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("constraints", [app.HBonds, app.AllBonds, app.HAngles], ids=str)
def test_all_constraints_change_hands(constraints):
    system = peptide(constraints)
    lengths = {
        frozenset(c[:2]): c[2]._value for c in map(system.getConstraintParameters, range(system.getNumConstraints()))
    }
    (rows,) = take_constraints(system)
    assert system.getNumConstraints() == 0
    assert {frozenset(p): d for p, d in zip(rows.atoms.tolist(), rows.target, strict=True)} == lengths


def test_molecules_stay_what_they_were():
    for system in (peptide(app.AllBonds), waters(4)[0]):
        before = molecules(system)
        take_constraints(system, keep_water=False)
        assert system.getNumConstraints() == 0
        assert molecules(system) == before


def test_ties_have_no_strength():
    system = peptide()
    context = reference(system, openmm.VerletIntegrator(0.001))
    context.setPositions(PEPTIDE.positions)
    before = context.getState(energy=True, forces=True)
    take_constraints(system)
    context = reference(system, openmm.VerletIntegrator(0.001))
    context.setPositions(PEPTIDE.positions)
    after = context.getState(energy=True, forces=True)
    assert after.getPotentialEnergy() == before.getPotentialEnergy()
    assert np.array_equal(after.getForces(asNumpy=True)._value, before.getForces(asNumpy=True)._value)


def test_rigid_water_stays_with_openmm():
    system, _ = waters(3)
    (rows,) = take_constraints(system)
    assert rows.atoms.tolist() == [[9, 10]]
    assert system.getNumConstraints() == 9


def test_chosen_atoms_take_their_cluster_along():
    system, _ = waters(3)
    (rows,) = take_constraints(system, [4])
    assert sorted(map(sorted, rows.atoms.tolist())) == [[3, 4], [3, 5], [4, 5]]
    assert system.getNumConstraints() == 7


def test_clusters_with_hydrogens():
    system, _ = waters(2)
    (rows,) = take_constraints(system, "hbonds", keep_water=False)
    assert rows.n_rows == 6
    assert take_constraints(system, "hbonds") == []
    assert system.getNumConstraints() == 1


def test_angles_come_back_as_angles():
    """The hydrogens' angles of HAngles are those of the force field."""
    system = peptide(app.HAngles)
    flexible = peptide(None)
    angles = next(f for f in flexible.getForces() if isinstance(f, openmm.HarmonicAngleForce))
    expected = {}
    for k in range(angles.getNumAngles()):
        i, j, m, theta, _ = angles.getAngleParameters(k)
        expected[(min(i, m), j, max(i, m))] = theta._value
    distances, bent = take_constraints(system, angles=True)
    assert (distances.family, distances.n_rows) == ("Distance", 21)
    assert (bent.family, bent.n_rows) == ("Angle", 9)
    for (i, j, m), theta in zip(bent.atoms.tolist(), bent.target, strict=True):
        assert theta == pytest.approx(expected[(min(i, m), j, max(i, m))], abs=1e-9)


def test_water_and_straight_angles_stay_distances():
    system, _ = waters(1)
    rows = take_constraints(system, keep_water=False, angles=True)
    assert [r.family for r in rows] == ["Distance"]
    system = openmm.System()
    for _ in range(4):
        system.addParticle(12.0)
    for i, j, d in ((0, 1, 0.116), (1, 2, 0.116), (0, 2, 0.232), (2, 3, 0.15)):
        system.addConstraint(i, j, d)
    (rows,) = take_constraints(system, angles=True)
    assert rows.n_rows == 4


@pytest.mark.parametrize("which", ["bonds", [99], [-1], [0.5]])
def test_unknown_choices_change_nothing(which):
    system, _ = waters(1)
    before = content(system)
    with pytest.raises(InputError):
        take_constraints(system, which)
    assert take_constraints(system, []) == []
    assert content(system) == before


# -- holding --------------------------------------------------------------------------------------


def test_hold_moves_what_a_row_touches_and_nothing_else():
    system, x = waters(4)
    part = hold(system, Distance([[0, 6]]), x)
    assert system.getNumConstraints() == 7
    assert part.motion.constraint_set.n_rows == 7
    integrator = ProjectedIntegrator(0.001, parts=[part])
    context = reference(system, integrator)
    context.setPositions(x)
    context.setVelocitiesToTemperature(300, 1)
    context.applyVelocityConstraints(1e-10)
    part.apply_velocities(context)
    part.check(context)
    integrator.step(100)
    part.check(context)
    there = context.getState(positions=True).getPositions(asNumpy=True)._value
    for k in range(4):
        for i, j in ((0, 1), (0, 2), (1, 2)):
            length = np.linalg.norm(TRIANGLE[i] - TRIANGLE[j])
            assert np.linalg.norm(there[3 * k + i] - there[3 * k + j]) == pytest.approx(length, abs=1e-7)


def test_hold_takes_more_where_asked():
    system = peptide(app.HAngles)
    part = hold(system, [Dihedral([[6, 8, 14, 16]])], PEPTIDE.positions, take="all", angles=True)
    assert system.getNumConstraints() == 0
    assert [c.family for c in part.motion.constraint_set.constraints] == ["Distance", "Angle", "Dihedral"]


def test_angle_rows_and_distance_rows_of_hangles_are_the_same_motion():
    ends = []
    for angles in (False, True):
        system = peptide(app.HAngles)
        part = hold(system, [], PEPTIDE.positions, take="all", angles=angles)
        context = reference(system, ProjectedIntegrator(0.001, parts=[part]))
        context.setPositions(PEPTIDE.positions)
        part.apply_positions(context)
        context.setVelocitiesToTemperature(300, 1)
        part.apply_velocities(context)
        context.getIntegrator().step(1)
        ends.append(context.getState(positions=True).getPositions(asNumpy=True)._value)
    # One step of RATTLE along gradients of other rows: the same up to the third order of the step.
    assert np.abs(ends[0] - ends[1]).max() <= 1e-5


def test_nothing_changes_when_hold_is_refused():
    system, x = waters(2)
    before = content(system)
    for rows, error in (
        ([Distance([[0, 3]], 0.2), Distance([[3, 0]], 0.3)], ContradictionError),
        ([Distance([[0, 99]])], InputError),
        (["bond"], InputError),
        (None, InputError),
        ([Distance([[0, 3]], 1.9)], InputError),
        ([Distance([[0, 3]], -1.0)], ValueError),
    ):
        with pytest.raises(error):
            hold(system, rows, x)
    with pytest.raises(InputError):
        hold(system, [Distance([[0, 3]])], x[:3])
    with pytest.raises(InputError, match="no rows"):
        hold(system, [], x)
    assert content(system) == before


# -- barostats ------------------------------------------------------------------------------------


def barostat():
    return openmm.MonteCarloBarostat(1.0, 300.0, 5)


def test_a_row_between_molecules_and_a_barostat_are_refused():
    system, x = waters(2, barostat())
    before = content(system)
    with pytest.raises(UnsupportedError, match=r"MonteCarloBarostat.*row #6 Distance\(0, 3\).*join=True"):
        hold(system, Distance([[0, 3]]), x)
    assert content(system) == before


def test_joined_molecules_move_as_one():
    system, x = waters(6, barostat())
    part = hold(system, Distance([[0, 3]]), x, join=True)
    integrator = ProjectedIntegrator(0.001, parts=[part])
    context = reference(system, integrator)
    assert [0, 1, 2, 3, 4, 5] in [sorted(m) for m in context.getMolecules()]
    context.setPositions(x)
    context.setVelocitiesToTemperature(300, 1)
    context.applyVelocityConstraints(1e-10)
    part.apply_velocities(context)
    part.check(context)
    edge = context.getState().getPeriodicBoxVectors()[0][0]._value
    integrator.step(300)
    part.check(context)
    assert context.getState().getPeriodicBoxVectors()[0][0]._value != edge


@pytest.mark.parametrize(
    ("rows", "force", "words"),
    [
        (Plane([6], [0, 0, 1]), openmm.MonteCarloBarostat(1.0, 300.0), "ties atoms to a place"),
        (Plane([6], [0, 0, 1]), openmm.CMMotionRemover(), "momentum is not conserved"),
        (Distance([[6, 7]]), openmm.MonteCarloFlexibleBarostat(1.0, 300.0, 25, False), "setScaleMoleculesAsRigid"),
    ],
    ids=["place", "momentum", "scaled atoms"],
)
def test_agents_that_break_rows_are_refused(rows, force, words):
    system, x = waters(2, force)
    with pytest.raises(UnsupportedError, match=words):
        hold(system, rows, x)


def test_barostat_and_rows_within_molecules_go_together():
    system, x = waters(2, barostat())
    part = hold(system, [], x, take="all", keep_water=False)
    context = reference(system, ProjectedIntegrator(0.001, parts=[part]))
    context.setPositions(x)
    part.apply_positions(context)
    context.setVelocitiesToTemperature(300, 1)
    part.apply_velocities(context)
    context.getIntegrator().step(100)
    part.check(context)
    assert len(context.getMolecules()) == 3


# -- `apply_positions` of rows from `hold`, with far targets: bonds of the System lead, and stay as they are --


DATA = Path(__file__).parents[2] / "data"
REFERENCE = openmm.Platform.getPlatformByName("Reference")


def placed(system: openmm.System, rows, x: np.ndarray) -> openmm.Context:
    context = openmm.Context(system, ProjectedIntegrator(0.001, parts=[rows]), REFERENCE)
    context.setPositions(x)
    return context


def positions(context: openmm.Context) -> np.ndarray:
    return context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)


@pytest.mark.parametrize("hydrogen", [1.008, 3.024])
@pytest.mark.parametrize("degrees", [150, 75, 30, -60])
def test_masses_alone(degrees: float, hydrogen: float) -> None:
    """A System without forces: distances say what is bonded, whatever the masses (heavy hydrogens)."""
    atoms = molecule("CH3CH2OH")
    x = 0.1 * atoms.positions
    system = openmm.System()
    for number, mass in zip(atoms.numbers, atoms.get_masses(), strict=True):
        system.addParticle(hydrogen if number == 1 else mass)
    rows = hold(system, Dihedral([[3, 2, 1, 0]], np.radians(degrees)), x)
    context = placed(system, rows, x)
    rows.apply_positions(context)
    atoms.positions = 10 * positions(context)
    assert rows.report(context).residual < 1e-13
    assert abs(atoms.get_distance(2, 3) - 10 * np.linalg.norm(x[2] - x[3])) < 1e-9
    rows.check(context)


@pytest.mark.parametrize("constraints", [None, app.HBonds, app.AllBonds, app.HAngles])
def test_alanine_dipeptide(constraints: object) -> None:
    """Both torsions of the backbone far away, with constraints of the System that go into the rows or stay."""
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    field = app.ForceField("amber14-all.xml")
    system = field.createSystem(pdb.topology, constraints=constraints)
    x = pdb.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    bonds = np.array([(b[0].index, b[1].index) for b in pdb.topology.bonds()])
    rows = hold(system, Dihedral([[4, 6, 8, 14], [6, 8, 14, 16]], np.radians([-60.0, -45.0])), x)
    context = placed(system, rows, x)
    rows.apply_positions(context)
    y = positions(context)
    assert rows.report(context).residual < 1e-13
    length = [np.linalg.norm(z[bonds[:, 0]] - z[bonds[:, 1]], axis=1) for z in (x, y)]
    held = {tuple(sorted(a)) for c in rows.motion.constraint_set.constraints for a in c.atoms.tolist() if len(a) == 2}
    others = np.array([tuple(sorted(b)) not in held for b in bonds.tolist()])
    assert np.abs(length[1] - length[0])[others].max(initial=0.0) < 0.002
    assert np.abs(length[1] - length[0]).max() < 0.004  # to the lengths of the force field


def test_what_is_no_system_and_no_context() -> None:
    for call in (take_constraints, lambda given: hold(given, Distance([[0, 3]]), PEPTIDE.positions)):
        with pytest.raises(InputError, match=r"system is a Topology; give the openmm\.System"):
            call(PEPTIDE.topology)
    rows = hold(peptide(None), Distance([[0, 3]]), PEPTIDE.positions)
    for call in (rows.check, rows.multipliers, rows.report, rows.apply_positions, rows.apply_velocities):
        with pytest.raises(InputError, match=r"context is a VerletIntegrator; give the Context"):
            call(openmm.VerletIntegrator(0.001))


def test_two_parts_that_share_particles_are_refused():
    system, x = openmm.System(), np.array([[0, 0, 0], [0.15, 0, 0], [0.2, 0.14, 0], [0.35, 0.14, 0.05]])
    for _ in x:
        system.addParticle(12.0)
    parts = [hold(system, Distance([pair]), x) for pair in ([0, 1], [1, 2], [2, 3])]
    with pytest.raises(UnsupportedError, match="two parts hold particle 1; give all rows"):
        ProjectedIntegrator(0.001, parts=parts)
    assert len(ProjectedIntegrator(0.001, parts=parts[::2]).parts) == 2
