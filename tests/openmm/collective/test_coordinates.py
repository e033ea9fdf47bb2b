"""Forces as coordinates: units, terms, atoms, plain ones among them, force groups; what is refused."""

from __future__ import annotations

import math

import numpy as np
import openmm
import pytest
from collective_cases import angle, bond, centers, dihedral, points, with_variable
from openmm import unit
from openmm_systems import field, loose_alanine, particles, started

from kcons import ConstraintSet
from kcons.constraints import Angle, CenterDistance, Dihedral, Distance
from kcons.errors import InputError, UnsupportedError
from kcons.openmm import CollectiveRows, ProjectedIntegrator, Row
from kcons.openmm.collective.coordinates import as_constraint, moved_atoms, period_of, unit_of

X = np.array([[0.0, 0, 0], [0.14, 0.03, 0], [0.2, 0.15, 0.02], [0.1, 0.22, 0.1]])


def torsion(text="theta"):
    force = openmm.CustomTorsionForce(text)
    force.addTorsion(0, 1, 2, 3)
    return force


def test_rows_are_in_units_of_openmm():
    system = particles([1.0] * 2)
    rows = CollectiveRows(system, [Row(bond(0, 1), 3 * unit.angstrom, rate=1 * unit.nanometer / unit.nanosecond)])
    integrator = ProjectedIntegrator(0.001, parts=[rows])
    settings = integrator.program.settings
    assert [settings["target1_0"], settings["rate1_0"]] == pytest.approx([0.3, 1e-3], rel=1e-15)
    with pytest.raises(InputError, match="give it in nm"):
        rows.set_target(integrator, 0, 3 * unit.degree)


def test_atoms_of_each_kind():
    centroid = centers([0, 1], [2, 3])
    centroid.addGroup([5])  # in no bond
    place = field("x+y", [1, 2])
    of = lambda force: moved_atoms(particles([1.0] * 6), force)  # noqa: E731
    assert of(bond(0, 1)) == {0, 1}
    assert of(torsion()) == of(points("angle(p1, p2, p3)*z4", (0, 1, 2, 3))) == of(centroid) == {0, 1, 2, 3}
    assert of(place) == {1, 2}
    assert of(openmm.RGForce([2, 0])) == {0, 2}
    assert of(openmm.RMSDForce(X, [1, 3])) == {1, 3}
    assert of(with_variable("a+b", a=bond(0, 1), b=openmm.RGForce([3]))) == {0, 1, 3}
    for force in (openmm.RGForce([]), openmm.NonbondedForce(), with_variable("a", a=openmm.RMSDForce(X, []))):
        assert of(force) == set(range(6))


def _two_terms():
    force = bond(4, 14)
    force.addBond(4, 16)
    return force


NM, RADIAN, TURN = unit.nanometer, unit.radian, 2 * math.pi


@pytest.mark.parametrize(
    ("force", "of", "period"),
    [
        (_two_terms(), NM, 0),
        (openmm.CustomExternalForce(" z "), NM, 0),
        (centers([0, 1, 2], [14, 15], (1.0, 2.0, 1.0)), NM, 0),
        (openmm.RGForce([0, 1]), NM, 0),
        (with_variable("q", q=openmm.RGForce([0, 1])), NM, 0),
        (torsion("2*theta"), None, 0),
        (torsion("cos(theta)"), None, 0),
        (points("sin(dihedral(p1, p2, p3, p4))", [3, 2, 1, 0]), None, 0),
        (points("distance(p1,p2)-distance(p2,p3)", (3, 9, 12)), None, 0),
        (with_variable("phi+d", phi=torsion(), d=bond(0, 1)), None, 0),
        (bond(4, 14, "r^2"), None, 0),
        (openmm.HarmonicBondForce(), unit.kilojoule_per_mole, 0),
    ],
)
def test_what_is_known_of_other_coordinates(force, of, period):
    assert unit_of(force) == of
    assert period_of(force) == period
    assert as_constraint(force, 0.5) is None


@pytest.mark.parametrize(
    ("force", "kind"),
    [
        (bond(4, 14), Distance),
        (angle(4, 6, 8), Angle),
        (dihedral(4, 6, 8, 14), Dihedral),
        (points("distance(p1, p2)", (3, 9)), Distance),
        (points("angle(p1,p2,p3)", (3, 9, 12)), Angle),
        (points("dihedral(p1,p2,p3,p4)", (6, 8, 14, 16)), Dihedral),
        (centers([0, 1, 2], [14, 15, 16]), CenterDistance),
        (with_variable("q", q=dihedral(4, 6, 8, 14)), Dihedral),
    ],
)
def test_the_constraint_measures_what_the_force_does(force, kind):
    system, x, _ = loose_alanine()
    rows = CollectiveRows(system, [Row(force, 0.5)])
    context = started(system, ProjectedIntegrator(1e-3, parts=[rows]), x)
    held_by = next(f for f in system.getForces() if f.getForceGroup() in rows.groups)
    row = as_constraint(held_by, 0.5)
    assert type(row) is kind
    assert unit_of(held_by) == (NM if "Distance" in kind.__name__ else RADIAN)
    assert period_of(held_by) == (TURN if kind is Dihedral else 0)
    held = ConstraintSet([row], x, [system.getParticleMass(k)._value for k in range(len(x))])
    off = held.residuals(x, None, 0.0).sigma[0]
    np.testing.assert_allclose(off, rows.residuals(context)[0])


def test_free_groups_are_taken_around_those_in_use():
    first, second = bond(0, 1), openmm.NonbondedForce()
    first.setForceGroup(1)
    second.setReciprocalSpaceForceGroup(3)
    for _ in range(4):
        second.addParticle(0, 1, 0)
    system = particles([1.0] * 4, first, second)
    assert CollectiveRows(system, [bond(1, 2), bond(2, 3)], positions=X).groups == {2, 4}
    assert system.getNumForces() == 4


def test_a_force_of_the_system_keeps_a_group_of_its_own():
    alone, shared, other = bond(0, 1), bond(1, 2), bond(2, 3)
    alone.setForceGroup(5)
    system = particles([1.0] * 4, alone, shared, other)
    assert CollectiveRows(system, [alone, shared], positions=X)._groups == (5, 1)
    assert other.getForceGroup() == 0
    assert system.getNumForces() == 3


# -- what is refused ------------------------------------------------------------------------------------

_KEPT = []


def _owned():
    _KEPT.append(particles([1.0] * 4, force := bond(0, 1)))
    return force


@pytest.mark.parametrize(
    ("rows", "options", "match"),
    [
        (lambda s: [9], {}, "9 is no Force of OpenMM"),
        (lambda s: [s.getForce(0), s.getForce(0)], {}, "more than once"),
        (lambda s: [_owned()], {}, "another System"),
        (lambda s: ["r"], {}, "is no Force of OpenMM"),
        (lambda s: Distance([[0, 3]]), {}, "is no Force of OpenMM"),
        (lambda s: [Distance([[0, 3]])], {}, r"kcons\.openmm\.hold holds constraints of kcons"),
        (lambda s: [], {}, "no rows"),
        (lambda s: [Row(bond(0, 1), math.nan)], {}, "target of row 0"),
        (lambda s: [Row(bond(0, 1), 3 * unit.kelvin)], {}, "target of row 0"),
        (lambda s: [Row(bond(0, 1), 0.3, rate=3 * unit.nanometer)], {}, "rate of row 0"),
        (lambda s: [Row(bond(0, 1), 0.3, rate=3 * unit.degree / unit.picosecond)], {}, "rate of row 0"),
        (lambda s: [Row(bond(0, 1), 0.3, period=1 * unit.radian)], {}, "period of row 0"),
        (lambda s: [Row(bond(0, 1), 0.3, period="name")], {}, "period of row 0"),
        (lambda s: [Row(bond(0, 1), "nowhere")], {}, "target of row 0"),
        (lambda s: [Row(dihedral(0, 1, 2, 3), 60.0)], {}, r"over three turns, and in radian; give 60 \* unit\.degrees"),
        (lambda s: [Row(dihedral(0, 1, 2, 3), -60)], {}, r"over three turns, and in radian; give -60 \* unit\.degrees"),
        (lambda s: [bond(0, 7)], {}, "names particle 7; the System has 5 particles"),
        (lambda s: [bond(0, 1)], {"positions": None}, "positions"),
        (lambda s: [bond(0, 1)], {"positions": X[:3]}, "shape"),
        (lambda s: [bond(0, 1)], {"positions": np.full((5, 3), math.nan)}, "row 0 is nan"),
        (lambda s: [Row(bond(0, 3), 0.3)], {"tolerance": "x"}, "tolerance"),
        (lambda s: [Row(bond(0, 3), 0.3)], {"tolerance": 0.0}, "tolerance"),
    ],
)
def test_rows_that_make_no_sense_are_refused(rows, options, match):
    system = particles([1.0] * 5, bond(0, 1))
    system.getForce(0).setForceGroup(3)
    system.addConstraint(0, 1, 0.14)
    assert CollectiveRows(particles([1.0] * 2), Row(bond(0, 1), 0.1), meets_system=True).meets_system
    with pytest.raises(InputError, match=match):
        CollectiveRows(system, rows(system), **{"positions": np.vstack([X, [1.0, 1, 1]])} | options)
    assert system.getNumForces() == 1


def test_too_many_rows_and_virtual_sites_are_refused_before_the_system_changes():
    system = particles([1.0] * 64, openmm.HarmonicBondForce())
    with pytest.raises(UnsupportedError, match="31 are free"):
        CollectiveRows(system, [Row(bond(2 * k, 2 * k + 1), 0.1) for k in range(32)])
    system.setParticleMass(4, 0.0)
    system.setVirtualSite(4, openmm.TwoParticleAverageSite(0, 1, 0.5, 0.5))
    with pytest.raises(UnsupportedError, match="particle 4, a virtual site"):
        CollectiveRows(system, [Row(bond(2, 4), 0.1)])
    assert system.getNumForces() == 1
