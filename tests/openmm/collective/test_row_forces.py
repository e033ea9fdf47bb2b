"""Forces as rows: terms, atoms, periods, groups."""

from __future__ import annotations

import math

import numpy as np
import openmm
import pytest
from openmm import unit

from kcons.errors import InputError, UnsupportedError
from kcons.openmm import ProjectedIntegrator
from kcons.openmm.collective import CollectiveRows
from kcons.openmm.collective.row_forces import (
    Rigid,
    Row,
    atoms_of,
    each_term,
    energy,
    found_values,
    moved_atoms,
    number,
    period_of,
    place,
    unit_of,
    used_groups,
)

X = np.array([[0.0, 0, 0], [0.14, 0.03, 0], [0.2, 0.15, 0.02], [0.1, 0.22, 0.1]])


def particles(n=4):
    system = openmm.System()
    for _ in range(n):
        system.addParticle(1.0)
    return system


def bonds(*pairs):
    force = openmm.CustomBondForce("r")
    for i, j in pairs:
        force.addBond(i, j)
    return force


def torsion(expression="theta"):
    force = openmm.CustomTorsionForce(expression)
    force.addTorsion(0, 1, 2, 3)
    return force


def compound(expression):
    force = openmm.CustomCompoundBondForce(4, expression)
    force.addBond([3, 2, 1, 0])
    return force


def variables(expression, **members):
    force = openmm.CustomCVForce(expression)
    for name, member in members.items():
        force.addCollectiveVariable(name, member)
    return force


# -- numbers ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (0.3, 0.3),
        (3 * unit.angstrom, 0.3),
        (3 * unit.angstrom**2, 0.03),
        (90 * unit.degree, math.pi / 2),
        (1 * unit.kilocalorie_per_mole, 4.184),
    ],
)
def test_units_of_the_user(value, expected):
    assert number(value, "target") == pytest.approx(expected, rel=1e-15)
    if unit.is_quantity(value):
        assert number(value / unit.femtosecond, "rate", per=unit.picosecond) == pytest.approx(1e3 * expected, rel=1e-15)


def _custom(kind, expression, *arguments):
    force = getattr(openmm, kind)(*arguments, expression)
    return force


def _as_variable(force, expression="q"):
    made = openmm.CustomCVForce(expression)
    made.addCollectiveVariable("q", force)
    return made


@pytest.mark.parametrize(
    ("force", "of"),
    [
        (lambda: _custom("CustomBondForce", "r"), unit.nanometer),
        (lambda: _custom("CustomExternalForce", " z "), unit.nanometer),
        (lambda: _custom("CustomCompoundBondForce", "distance(p1, p2)", 2), unit.nanometer),
        (lambda: _custom("CustomCentroidBondForce", "distance(g1,g2)", 2), unit.nanometer),
        (lambda: openmm.RGForce([0, 1]), unit.nanometer),
        (lambda: _as_variable(openmm.RGForce([0, 1])), unit.nanometer),
        (lambda: _custom("CustomAngleForce", "theta"), unit.radian),
        (lambda: _custom("CustomCompoundBondForce", "dihedral(p1,p2,p3,p4)", 4), unit.radian),
        (openmm.HarmonicBondForce, unit.kilojoule_per_mole),
        (lambda: _custom("CustomBondForce", "r^2"), None),
        (lambda: _as_variable(openmm.RGForce([0, 1]), "q^2"), None),
    ],
)
def test_unit_of_a_coordinate(force, of):
    assert unit_of(force()) == of


@pytest.mark.parametrize(
    ("value", "of"),
    [
        (3 * unit.kelvin, None),
        (3 * unit.picosecond, None),
        (3 * unit.kelvin, unit.nanometer),
        (90 * unit.degree, unit.nanometer),
        (3 * unit.angstrom, unit.radian),
        (3 * unit.angstrom / unit.picosecond, unit.nanometer),
    ],
)
def test_a_target_of_another_kind_is_refused(value, of):
    with pytest.raises(InputError, match=r"target is .* another kind"):
        number(value, "target", of)


def test_units_of_rows():
    system = openmm.System()
    for _ in range(2):
        system.addParticle(1.0)

    def bond():
        force = openmm.CustomBondForce("r")
        force.addBond(0, 1)
        return force

    for wrong in (
        {"target": 3 * unit.kelvin},
        {"target": 0.3, "rate": 3 * unit.nanometer},
        {"target": 0.3, "rate": 3 * unit.degree / unit.picosecond},
        {"target": 0.3, "scale": 1 * unit.radian},
        {"target": 0.3, "period": 1 * unit.radian},
        {"target": 0.3, "period": "name"},
    ):
        with pytest.raises(InputError, match="of row 0"):
            CollectiveRows(system, [Row(bond(), **wrong)])
    assert system.getNumForces() == 0
    rows = CollectiveRows(system, [Row(bond(), 3 * unit.angstrom, rate=1 * unit.nanometer / unit.nanosecond)])
    integrator = ProjectedIntegrator(0.001, parts=[rows])
    settings = integrator.program.settings
    assert [settings["target1_0"], settings["rate1_0"]] == pytest.approx([0.3, 1e-3], rel=1e-15)
    with pytest.raises(InputError, match="give it in nanometer"):
        rows.set_target(integrator, 0, 3 * unit.degree)


@pytest.mark.parametrize("value", [math.nan, math.inf, "three", None, math.inf * unit.nanometer])
def test_what_is_no_finite_number_is_refused(value):
    with pytest.raises(InputError, match="target"):
        number(value, "target")


# -- terms --------------------------------------------------------------------------------------------------


def test_terms_keep_their_parameters():
    force = openmm.CustomBondForce("k*r")
    force.addPerBondParameter("k")
    force.setUsesPeriodicBoundaryConditions(True)
    force.addBond(0, 1, [2.0])
    force.addBond(2, 3, [3.0])
    terms = each_term(force)
    assert [term.getBondParameters(0) for term in terms] == [[0, 1, (2.0,)], [2, 3, (3.0,)]]
    assert all(term.usesPeriodicBoundaryConditions() and term.getNumBonds() == 1 for term in terms)
    assert force.getNumBonds() == 2


@pytest.mark.parametrize(
    "name", ["angle", "torsion", "compound", "centroid", "external", "harmonic", "bend", "periodic", "rb"]
)
def test_the_energies_of_the_terms_add_up(name):
    force = _many(name)
    whole = found_values(particles(), [[force]], X)
    parts = found_values(particles(), [[term] for term in each_term(force)], X)
    assert len(parts) == 2
    assert parts.sum() == pytest.approx(whole[0], rel=1e-14)
    assert np.all(parts != 0.0)


def _many(name):
    if name == "angle":
        force = openmm.CustomAngleForce("theta")
        force.addAngle(0, 1, 2)
        force.addAngle(1, 2, 3)
    elif name == "torsion":
        force = torsion("cos(theta)")
        force.addTorsion(3, 1, 0, 2)
    elif name == "compound":
        force = compound("distance(p1, p2)*angle(p2, p3, p4)")
        force.addBond([0, 1, 2, 3])
    elif name == "centroid":
        force = openmm.CustomCentroidBondForce(2, "distance(g1, g2)")
        for group in ([0, 1], [2, 3], [1, 2]):
            force.addGroup(group)
        force.addBond([0, 1])
        force.addBond([1, 2])
    elif name == "external":
        force = openmm.CustomExternalForce("x+y")
        force.addParticle(1)
        force.addParticle(2)
    elif name == "harmonic":
        force = openmm.HarmonicBondForce()
        force.addBond(0, 1, 0.3, 5)
        force.addBond(2, 3, 0.1, 7)
    elif name == "bend":
        force = openmm.HarmonicAngleForce()
        force.addAngle(0, 1, 2, 1.0, 5)
        force.addAngle(1, 2, 3, 1.0, 5)
    elif name == "periodic":
        force = openmm.PeriodicTorsionForce()
        force.addTorsion(0, 1, 2, 3, 2, 0.3, 5)
        force.addTorsion(0, 1, 2, 3, 3, 0.1, 5)
    else:
        force = openmm.RBTorsionForce()
        force.addTorsion(0, 1, 2, 3, 1, 2, 3, 4, 5, 6)
        force.addTorsion(3, 1, 2, 0, 1, 2, 3, 4, 5, 6)
    return force


# -- atoms --------------------------------------------------------------------------------------------------


def test_atoms_of_each_kind():
    centroid = _many("centroid")
    centroid.addGroup([3])  # in no bond
    assert atoms_of(bonds((0, 1), (2, 1))) == {0, 1, 2}
    assert atoms_of(torsion()) == {0, 1, 2, 3}
    assert atoms_of(_many("angle")) == {0, 1, 2, 3}
    assert atoms_of(centroid) == {0, 1, 2, 3}
    assert atoms_of(_many("external")) == {1, 2}
    assert atoms_of(openmm.RGForce([2, 0])) == {0, 2}
    assert atoms_of(openmm.RMSDForce(X, [1, 3])) == {1, 3}
    assert atoms_of(variables("a+b", a=bonds((0, 1)), b=openmm.RGForce([3]))) == {0, 1, 3}


def test_atoms_that_are_all_or_unknown():
    system = particles()
    for force in (openmm.RGForce([]), openmm.NonbondedForce(), variables("a", a=openmm.RMSDForce(X, []))):
        assert atoms_of(force) is None
        assert moved_atoms(system, [force]) == {0, 1, 2, 3}


def test_bodies_that_constraints_make():
    system = particles(6)
    for pair in ((0, 1), (1, 2), (4, 5)):
        system.addConstraint(*pair, 0.1)
    rigid = Rigid(system)
    assert rigid.holds({3, 5})
    assert not rigid.holds({3})
    assert rigid.bodies({0}) == rigid.bodies({2})
    assert rigid.bodies({0, 3, 5}) != rigid.bodies({0, 3})
    assert len(rigid.bodies({0, 1, 2, 3, 4, 5})) == 3


# -- periods ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("force", "period"),
    [
        (torsion, 2 * math.pi),
        (lambda: torsion("2*theta"), 0.0),
        (lambda: compound("dihedral(p1, p2, p3, p4)"), 2 * math.pi),
        (lambda: compound("sin(dihedral(p1, p2, p3, p4))"), 0.0),
        (lambda: variables("phi", phi=torsion()), 2 * math.pi),
        (lambda: variables("phi+d", phi=torsion(), d=bonds((0, 1))), 0.0),
        (lambda: bonds((0, 1)), 0.0),
    ],
)
def test_plain_dihedrals_are_periodic(force, period):
    assert period_of(force()) == period


# -- groups -------------------------------------------------------------------------------------------------


def test_free_groups_are_taken_around_those_in_use():
    system = particles()
    first, second = bonds((0, 1)), openmm.NonbondedForce()
    first.setForceGroup(1)
    second.setForceGroup(0)
    second.setReciprocalSpaceForceGroup(3)
    for _ in range(4):
        second.addParticle(0, 1, 0)
    system.addForce(first)
    system.addForce(second)
    assert used_groups(system) == {0, 1, 3}
    assert place(system, [bonds((1, 2)), bonds((2, 3))]) == [2, 4]
    assert system.getNumForces() == 4


def test_a_force_of_the_system_keeps_a_group_of_its_own():
    system = particles()
    alone, shared, other = bonds((0, 1)), bonds((1, 2)), bonds((2, 3))
    alone.setForceGroup(5)
    for force in (alone, shared, other):
        system.addForce(force)
    assert place(system, [alone, shared]) == [5, 1]
    assert other.getForceGroup() == 0
    assert system.getNumForces() == 3


def test_forces_of_one_group_are_one_row():
    system = particles()
    for pair in ((0, 1), (2, 3)):
        force = bonds(pair)
        force.setForceGroup(7)
        system.addForce(force)
    part = CollectiveRows(system, [Row(7)], positions=X)
    expected = np.linalg.norm(X[0] - X[1]) + np.linalg.norm(X[2] - X[3])
    assert part.scales == (1.0,)
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
    context.setPositions(X)
    assert part.values(context) == pytest.approx([expected], rel=1e-14)
    assert energy(context, 7) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    ("rows", "match"),
    [
        (lambda s: [9], "has no Forces"),
        (lambda s: [s.getForce(0).getForceGroup()] * 2, "more than once"),
        (lambda s: [s.getForce(0), s.getForce(0)], "more than once"),
        (lambda s: [_owned()], "another System"),
        (lambda s: ["r"], "neither a Force"),
        (lambda s: [], "no rows"),
        (lambda s: [Row(bonds((0, 1)), math.nan)], "target of row 0"),
        (lambda s: [Row(bonds((0, 1)), "nowhere")], "no context parameter"),
        (lambda s: [Row(bonds((0, 1)), 0.1, rate="nowhere")], "needs a target with a name"),
        (lambda s: [Row(bonds((0, 1)), 0.1, scale=0.0)], "positive"),
    ],
)
def test_rows_that_make_no_sense_are_refused(rows, match):
    system = particles()
    system.addForce(bonds((0, 1)))
    system.getForce(0).setForceGroup(3)
    with pytest.raises(InputError, match=match):
        CollectiveRows(system, rows(system), positions=X)
    assert system.getNumForces() == 1


def test_a_target_to_find_needs_positions():
    system = particles()
    with pytest.raises(InputError, match="positions"):
        CollectiveRows(system, [bonds((0, 1))])
    assert system.getNumForces() == 0


_KEPT = []


def _owned():
    force = bonds((0, 1))
    other = particles()
    other.addForce(force)
    _KEPT.append(other)
    return force


def test_positions_at_which_a_target_cannot_be_found():
    system = particles()
    with pytest.raises(InputError, match="shape"):
        CollectiveRows(system, [bonds((0, 1))], positions=X[:3])
    with pytest.raises(InputError, match="row 0 is nan"):
        CollectiveRows(system, [bonds((0, 1))], positions=X * math.nan)
    assert system.getNumForces() == 0


def test_rows_that_meet_the_constraints_of_the_system_cannot_be_said_not_to():
    system = particles()
    system.addConstraint(0, 1, 0.14)
    with pytest.raises(InputError, match="meets_system"):
        CollectiveRows(system, [bonds((1, 3))], positions=X, meets_system=False)
    assert system.getNumForces() == 0
    assert CollectiveRows(system, [bonds((2, 3))], positions=X, meets_system=True).meets_system


def test_rows_on_virtual_sites_are_refused():
    system = particles(5)
    system.setParticleMass(4, 0.0)
    system.setVirtualSite(4, openmm.TwoParticleAverageSite(0, 1, 0.5, 0.5))
    with pytest.raises(UnsupportedError, match="particle 4, a virtual site"):
        CollectiveRows(system, [Row(bonds((2, 4)), 0.1)])


@pytest.mark.parametrize("row", [bonds((0, 7)), Row(bonds((0, 7)), 0.1)])
def test_rows_on_particles_that_are_not_there(row):
    system = particles()
    with pytest.raises(InputError, match=f"names particle 7; the System has {len(X)} particles") as raised:
        CollectiveRows(system, [row], positions=X)
    assert list(raised.value.atoms) == [7] and system.getNumForces() == 0
