"""Families of constraints against numbers worked out by other means, and what each of them refuses."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from ase import Atoms
from ase.calculators.lj import LennardJones
from ase.constraints import FixInternals
from constraint_cases import APART, MASSES, ORIGIN, TRANSFER, UP, VALUES, bent, blade, scattered, twisted

from kcons import ConstraintSet, Motion
from kcons.ase import constrain, from_ase_constraints
from kcons.constraints import (
    Angle,
    CenterDistance,
    CenterOfMass,
    Custom,
    Dihedral,
    Distance,
    DistanceDifference,
    Ellipsoid,
    FixedAtoms,
    Formula,
    Line,
    LinearCombination,
    LinearRelation,
    RadiusOfGyration,
    Sphere,
    Torus,
    VelocityFormula,
    from_dict,
)
from kcons.constraints.constraint_set import rows_like
from kcons.errors import ImageError, InputError, SingularGeometryError


@pytest.mark.parametrize("name", VALUES)
def test_values(name):
    item, x, expected = VALUES[name]
    held = ConstraintSet(item.with_target(None), x, MASSES[: len(x)])
    miss = held.measure(x) - expected
    if item.period:
        miss = (miss + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(miss).max() < 4e-15 * max(1, np.abs(expected).max())


def slope(item, x):
    return item.gradient(np.asarray(x)[item.atoms], 0.0)


@pytest.mark.parametrize("degrees", [60.0, 179.0, 179.9, 179.9999])
def test_angles_near_a_line(degrees):
    """The gradient is of order one where that of the cosine vanishes; the curvature is that of arms in polar angles."""
    v = np.array([[[0.3, -0.4, 0], [0.1, 0.2, 0], [-0.5, 0.6, 0]]])
    item, r, expected = Angle([0, 1, 2]), bent(degrees, 1.3, 0.7)[None], 0.0
    for end, sign in ((0, -1), (2, 1)):
        d, w = r[0, end] - r[0, 1], v[0, end] - v[0, 1]
        expected += sign * -2 * (d @ w) * (d[0] * w[1] - d[1] * w[0]) / (d @ d) ** 2
    assert item.curvature(r, v, 0.0)[0] == pytest.approx(expected, rel=1e-8)
    size = np.linalg.norm(item.gradient(bent(degrees)[None], 0.0))
    assert size == pytest.approx(np.sqrt(4 - 2 * np.cos(np.radians(degrees))), rel=1e-9)


def test_derivatives_in_places_that_are_not_random():
    far = np.array([[[1e6, 0.0, 0.0], [1e6 + 1.0, 0.0, 0.0]]])
    across = np.array([[[0.0, 3.0, 0.0], [0.0, 0.0, 4.0]]])
    assert Distance([0, 1]).curvature(far, across, 0.0)[0] == pytest.approx(25.0, rel=1e-15)
    inside = Torus(0, ORIGIN, UP, 2.0).gradient(np.array([[[1.5, 0.0, 0.0]]]), 0.0)
    assert np.allclose(inside, [[[-1.0, 0.0, 0.0]]], atol=1e-15)
    assert Ellipsoid(0, ORIGIN, [2.0, np.inf, 0.5]).gradient(np.array([[[1.0, 5.0, 0.3]]]), 0.0)[0, 0, 1] == 0.0


def test_dihedrals_are_those_of_ase_and_smooth_through_180_degrees():
    x = np.random.default_rng(0).normal(size=(4, 3))
    ours = np.degrees(Dihedral([0, 1, 2, 3]).measure(x[None], 0.0)[0]) % 360
    assert ours == pytest.approx(Atoms("H4", x).get_dihedral(0, 1, 2, 3), abs=1e-10)
    held = ConstraintSet(Dihedral([0, 1, 2, 3], np.radians(179.9)), twisted(-179.9), np.ones(4))
    assert held.value(twisted(-179.9))[0] == pytest.approx(np.radians(0.2), rel=1e-10)
    assert held.value(twisted(179.8))[0] == pytest.approx(np.radians(-0.1), rel=1e-10)
    turned = ConstraintSet(Dihedral([0, 1, 2, 3], np.radians(30.0) + 4 * np.pi), twisted(30.0), np.ones(4))
    assert turned.value(twisted(30.0))[0] == pytest.approx(0, abs=1e-13)


@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.0, 0.0, -2.0], [1.0, 2.0, 3.0]])
def test_a_line_is_two_orthonormal_rows_normal_to_it(direction):
    point, d = np.array([0.3, 0.1, -0.2]), np.array(direction)
    item = Line([0], point, direction)
    rows = item.coefficients[:, 0]
    assert np.allclose(rows @ rows.T, np.eye(2), atol=1e-15) and np.allclose(rows @ d, 0, atol=1e-15)
    held = ConstraintSet(item, [point], np.ones(1))
    off = np.cross(d, [0.2, 0.5, 0.1])
    assert held.value([point + 2.7 * d]) == pytest.approx([0.0, 0.0], abs=1e-15)
    assert np.linalg.norm(held.value([point + off])) == pytest.approx(np.linalg.norm(off))
    free = ConstraintSet(Line([0, 1], None, [1.0, 0.0, 0.0]), APART[1:], np.ones(2))
    assert not free.value(np.add(APART[1:], [[7.0, 0, 0], [-3.0, 0, 0]])).any()


def test_targets_are_where_they_are_put():
    places = np.arange(6.0).reshape(2, 3)
    assert FixedAtoms([5, 2], places).target.tolist() == list(range(6))
    moving = CenterOfMass([[0, 1], [2, 3]], target=lambda t: places * t)
    assert moving.target_at(2.0).tolist() == (2 * places.ravel()).tolist()
    assert ConstraintSet(LinearRelation(0, [1, 2], [0.5, 0.5]), APART, np.ones(3)).target().tolist() == [0, 0, 0]
    assert ConstraintSet(Ellipsoid(0, ORIGIN, [1.0, 2.0, 4.0]), [UP], np.ones(1)).scale == pytest.approx(4 / 7**0.5)
    assert Distance([3, 4]).atoms.tolist() == [[3, 4]] and FixedAtoms(5).atoms.tolist() == [[5], [5], [5]]


def test_what_depends_on_the_origin():
    assert LinearRelation(0, [1, 2], [0.5, 0.5]).translation_invariant
    assert not LinearRelation(0, [1, 2], [0.5, 0.6]).translation_invariant
    mixed = LinearCombination([[0, 1], [2, 3]], [[UP, [0, 0, -1]], [UP, UP]])
    assert not mixed.translation_invariant and not mixed.select([0]).translation_invariant
    x = np.array([[0.1, 0.0, 0.0], [9.7, 0.0, 0.0], [0.5, 0.0, 0.0]])
    held = ConstraintSet(LinearRelation(0, [1, 2], [0.5, 0.5]), x, np.ones(3), cell=[10.0] * 3)
    assert held.value(x) == pytest.approx([0, 0, 0], abs=1e-14)


def test_groups_in_a_cell_far_away_and_of_many_atoms():
    x = np.round(scattered(2) * 64) / 64
    shift = np.array([2.0**20, -(2.0**21), 2.0**20])  # exact in binary
    wrapped, masses = np.array([[0.1, 5.0, 5.0], [9.8, 5.0, 5.0], [1.3, 5.0, 5.0], [9.1, 5.2, 5.0]]), MASSES[:4]
    whole = wrapped - [[0, 0, 0], [10.0, 0, 0], [0, 0, 0], [10.0, 0, 0]]
    for item in (CenterDistance([0, 1], [2, 3]), RadiusOfGyration([0, 1, 2, 3])):
        near = ConstraintSet(item, x, MASSES).target()
        assert ConstraintSet(item, x + shift, MASSES).target() == pytest.approx(near, rel=1e-14)
        found = ConstraintSet(item, wrapped, masses, cell=[10.0] * 3).target()
        assert found == pytest.approx(ConstraintSet(item, whole, masses).target(), rel=1e-13)
    n = 100_000
    x = np.random.default_rng(0).normal(size=(n, 3))
    held = ConstraintSet([CenterOfMass(np.arange(n)), RadiusOfGyration(np.arange(n))], x, np.ones(n))
    assert held.target() == pytest.approx([*x.mean(axis=0), np.sqrt(3 * x.var(axis=0).mean())], rel=1e-10)


@pytest.mark.parametrize("item", [RadiusOfGyration(np.arange(40)), CenterDistance(np.arange(20), np.arange(20, 40))])
def test_wide_rows_are_what_narrow_ones_would_be(item, monkeypatch):
    r, v = np.random.default_rng(0).normal(size=(2, 1, 40, 3))
    item = item.with_masses(np.arange(1.0, 41.0)[None])
    wide = (*item.value_and_gradient(r, 0.0), item.curvature(r, v, 0.0))
    monkeypatch.setattr("kcons.constraints.constraint.WIDE", 100)
    for one, other in zip(wide, (*item.value_and_gradient(r, 0.0), item.curvature(r, v, 0.0)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-14)


# -- differences of distances -------------------------------------------------------------------------------


def test_a_difference_comes_back_from_its_data():
    row = DistanceDifference([[4, 3], [4, 5]], 0.25, weights=[1.0, -2.0])
    again = from_dict(json.loads(json.dumps(row.todict())))
    x = np.random.default_rng(0).normal(size=(6, 3))
    value = math.dist(x[4], x[3]) - 2 * math.dist(x[4], x[5])
    for item in (row, again, row.select([0]), row.renumbered(np.arange(6))):
        assert item.measure(x[item.atoms], 0.0) == pytest.approx([value], abs=1e-14)
        assert item.target.tolist() == [0.25]
    held = ConstraintSet([Distance([[0, 1]]), row.with_target(None)], x, np.ones(6))
    assert rows_like(held, DistanceDifference([[4, 3], [4, 5]], weights=[1.0, -2.0]), "d") == [1]
    assert rows_like(held, Distance([1, 0]), "d") == [0]
    with pytest.raises(InputError, match="not among"):
        rows_like(held, DistanceDifference([[4, 3], [4, 5]]), "d")


def lengths_in(cell: np.ndarray, x: np.ndarray, pairs: list[list[int]]) -> np.ndarray:
    """By looking at all 27 images."""
    shifts = np.stack(np.meshgrid(*3 * [[-1, 0, 1]]), axis=-1).reshape(-1, 3) @ cell
    inside = np.linalg.solve(cell.T, x.T).T % 1.0 @ cell
    return np.array([np.linalg.norm(inside[i] - inside[j] + shifts, axis=1).min() for i, j in pairs])


#: A chain, a star, two pairs that lie anywhere, a star and a pair.
PATTERNS = {
    "chain": [[0, 1], [1, 2]],
    "star": [[1, 0], [1, 2], [1, 3]],
    "apart": [[0, 1], [2, 3]],
    "star and pair": [[0, 1], [1, 2], [3, 1], [4, 5]],
}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_each_pair_takes_its_shortest_image(pattern):
    """In random cells, atoms stored in any image, and none, one or all of the distances held: value and a motion."""
    pairs = PATTERNS[pattern]
    far = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        cell = 5.0 * np.eye(3) + 0.5 * rng.normal(size=(3, 3))
        n = 1 + max(max(pair) for pair in pairs)
        x = rng.uniform(-4, 4, size=(n, 3))
        for i, j in pairs:  # along the tree of the pattern
            step = rng.normal(size=3)
            x[max(i, j)] = x[min(i, j)] + rng.uniform(0.6, 1.8) * step / np.linalg.norm(step)
        x += rng.integers(-2, 3, size=(n, 3)) @ cell
        weights = rng.choice([-1.0, 1.0], len(pairs)) * rng.uniform(0.5, 2.0, len(pairs))
        rows = [DistanceDifference(pairs, weights=weights)]
        if seed % 3:
            rows.append(Distance(pairs[: None if seed % 3 == 2 else 1]))  # all, or one of them
        masses = rng.uniform(1, 20, n)
        held = ConstraintSet(rows, x, masses, cell=cell)
        assert held.target()[0] == pytest.approx(weights @ lengths_in(cell, x, pairs), abs=1e-12)
        motion = Motion(held, x)
        y = x + 0.02 * rng.normal(size=x.shape)
        found = motion.project_positions(y, x)
        assert weights @ lengths_in(cell, found, pairs) == pytest.approx(held.target()[0], abs=1e-11)
        far += bool(np.linalg.norm(x[0] - x[-1]) > held.half_width)
    assert far > 20


def test_pairs_of_a_row_need_not_be_near_each_other():
    """Two bonds at the two ends of a long cell: nothing says how far one may be from the other."""
    cell = np.diag([20.0, 6.0, 6.0])
    x = np.array([[0.5, 0, 0], [1.5, 0, 0], [10.4, 3.0, 3.0], [11.6, 3.0, 3.0]])
    held = ConstraintSet(DistanceDifference([[0, 1], [2, 3]]), x, np.ones(4), cell=cell)
    assert held.target() == pytest.approx([-0.2], abs=1e-14)
    motion = Motion(held, x)
    for shift in range(12):  # the second bond goes around the first
        there = x + np.array([[0, 0, 0], [0, 0, 0], [shift, 0, 0], [shift, 0, 0]])
        there[3, 0] += 0.1
        found = motion.project_positions(there, x + (there - x).round())
        assert math.dist(*found[:2]) - math.dist(*found[2:]) == pytest.approx(-0.2, abs=1e-12)


def test_a_pair_that_reaches_half_the_cell_is_refused():
    cell = 6.0 * np.eye(3)
    x = np.array([[0.0, 0, 0], [2.6, 0, 0], [2.6, 1.0, 0]])
    motion = Motion(ConstraintSet(DistanceDifference(TRANSFER), x, np.ones(3), cell=cell), x)
    with pytest.raises(ImageError, match="atoms 0 and 1"):
        motion.project_positions(x + np.array([[0, 0, 0], [0.7, 0, 0], [0.7, 0.7, 0]]), x)
    x[0, 1] = 2.6
    with pytest.raises(InputError, match="half the box"):
        ConstraintSet(DistanceDifference(TRANSFER), x, np.ones(3), cell=cell)


def proton() -> Atoms:
    atoms = Atoms("ClHBr", [[0, 0, 0], [1.45, 0.1, 0], [3.05, 0, 0.2]])
    atoms.calc = LennardJones(sigma=1.3, epsilon=0.05)
    return atoms


def test_bondcombos_become_this_row_and_go_back():
    atoms = proton()
    combos = [[None, [[0, 1, 1.0], [1, 2, -1.0]]], [3.0, [[0, 2, 1.0], [0, 1, 0.5], [1, 2, -0.25]]]]
    atoms.set_constraint(FixInternals(bondcombos=combos[:1]))
    (row,) = from_ase_constraints(atoms)
    assert row == row and row.family == "DistanceDifference" and row.target is None
    value = FixInternals.get_bondcombo(atoms, combos[0][1])
    atoms.set_constraint()
    held = constrain(atoms, row)
    assert held.constraints[0].target_at(0.0) == pytest.approx([value], abs=1e-14)
    data = held.todict()
    assert data["name"] == "FixInternals"
    ((target, pairs),) = data["kwargs"]["bondcombos"]
    assert target == pytest.approx(value, abs=1e-14) and pairs == combos[0][1]
    atoms.set_constraint(FixInternals(bondcombos=combos))
    _, other = from_ase_constraints(atoms)
    wanted = FixInternals.get_bondcombo(atoms, combos[1][1])
    assert other.target.tolist() == [3.0]
    assert other.measure(atoms.positions[other.atoms], 0.0) == pytest.approx([wanted], abs=1e-14)


def test_a_proton_goes_over_within_a_molecule_that_stays_as_it_is():
    """Malonaldehyde, halfway between its two enols: no atom but the proton moves by more than 0.03."""
    places = [[-1.29, 0.55, 0], [-0.60, 1.27, 0], [1.27, 0.75, 0], [-1.16, -0.74, 0], [0.05, -1.40, 0]]
    atoms = Atoms("OHOCCCHHH", [*places, [1.20, -0.48, 0], [-2.12, -1.26, 0], [0.10, -2.48, 0], [2.17, -1.02, 0]])
    atoms.info["bonds"] = [[0, 1], [0, 3], [3, 4], [4, 5], [5, 2], [3, 6], [4, 7], [5, 8]]
    before = atoms.positions.copy()
    constrain(atoms, DistanceDifference(TRANSFER, 0.0), project=True)
    assert atoms.get_distance(0, 1) == pytest.approx(atoms.get_distance(1, 2), abs=1e-12)
    moved = np.linalg.norm(atoms.positions - before, axis=1)
    assert moved[1] > 0.3 and np.delete(moved, 1).max() < 0.03


# -- velocities --------------------------------------------------------------------------------------------


def rate(held, x, v, time=0.0):
    """A v - target, shape (n_rows,)."""
    return held.jacobian(x, time) @ np.ravel(v) - held.velocity_target(x, time)


def test_a_blade_glides_along_itself_and_turns_about_its_contact():
    x = np.array([ORIGIN, [3.0, 4.0, 1.0]])
    held = ConstraintSet(blade([0, 1]), x, np.ones(2))
    along, sideways = np.array([0.6, 0.8, 0.0]), np.array([-0.8, 0.6, 0.0])
    # The blade's height does not count.
    for v, expected in (([along, along], 0), ([0 * along, sideways], 0), ([sideways] * 2, 1), ([UP, [0, 0, -2.0]], 0)):
        assert rate(held, x, v) == pytest.approx([expected], abs=1e-15)
    assert held.value(2 * x).tolist() == held.target().tolist() == [0.0]
    between = ConstraintSet(blade([0, 1], contact=0.25), x, np.ones(2))
    assert rate(between, x, [-sideways, 3 * sideways]) == pytest.approx([0.0], abs=1e-15)
    wrapped, whole = np.array([[9.9, 0.0, 0.0], [0.4, 0.0, 0.0]]), np.array([[-0.1, 0.0, 0.0], [0.4, 0.0, 0.0]])
    there = ConstraintSet(blade([0, 1]), wrapped, np.ones(2), cell=[10.0] * 3).jacobian(wrapped)
    assert np.allclose(there.toarray(), ConstraintSet(blade([0, 1]), whole, np.ones(2)).jacobian(whole).toarray())


def test_driven_speeds_and_coefficients_that_turn():
    x = np.eye(3)[:2]
    held = ConstraintSet(VelocityFormula("vx1 - vx2", [0, 1], target=lambda t: np.sin(2 * t)), x, np.ones(2))
    assert held.moving and not held.holonomic.any()
    assert held.velocity_target(x, 0.3) == pytest.approx([np.sin(0.6)])
    assert held.acceleration_target(x, x, 0.3) == pytest.approx([2 * np.cos(0.6)], rel=1e-11)
    # a = (cos t, sin t, 0): b = -v . da/dt, at late times as well.
    row = VelocityFormula("vx1*cos(t) + vy1*sin(t)", 0)
    x, v = np.zeros((1, 3)), np.array([[0.6, 0.8, 0.0]])
    for time in (1.0, 1e6, 1e9):
        found = ConstraintSet(row, x, [1.0]).acceleration_target(x, v, time)
        np.testing.assert_allclose(found, [0.6 * np.sin(time) - 0.8 * np.cos(time)], rtol=0, atol=1e-15)


# -- what is refused ---------------------------------------------------------------------------------------

LINE = np.array([ORIGIN, [1.0, 0, 0], [3.0, 0, 0]])
COINCIDENT = np.array([[1.0, 2, 3], [1, 2, 3], UP, [0, 1, 0]])
CROSS = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, -1.0, 0]])
BENDS = np.array([[1.0, 0, -0.3], ORIGIN, UP, [0, 0, 2.0]])
ROUNDED = np.array([[0.6, 0.0, 0.8]])
#: Where gradients are undefined, and what is said of it.
SINGULAR = [
    (Distance([[2, 3], [0, 1]]), COINCIDENT, r"row 1, Distance\(0, 1\): atoms 0 and 1 coincide: gradient undefined"),
    (Angle([0, 1, 2]), COINCIDENT, "row 0, Angle.*: atoms 0 and 1 coincide"),
    (Dihedral([2, 0, 1, 3]), COINCIDENT, "row 0, Dihedral.*: atoms 0 and 1 coincide"),
    (Dihedral([2, 0, 1, 3]), np.array([ORIGIN, [1e-200, 0, 0], UP, [0, 1, 0]]), "atoms 0 and 1 coincide"),
    (DistanceDifference([[2, 0], [0, 1]]), COINCIDENT, "row 0, .*: atoms 0 and 1 coincide"),
    # |ab| + |bc| - |ac| is 0 on a line, and least there.
    (DistanceDifference([[0, 1], [1, 2], [0, 2]], weights=[1, 1, -1]), LINE, "vanishes"),
    (Angle([0, 1, 2]), bent(180.0), r"row 0, Angle\(0, 1, 2\): .*singular at 180 deg, use a linear constraint"),
    (Angle([0, 1, 2]), bent(0.0, 1.2, 0.9), r"row 0, Angle\(0, 1, 2\): .*singular at 0 deg, use a linear constraint"),
    (Angle([0, 1, 2], np.pi), bent(100.0), "singular at 180 deg, .* has the target 180 deg"),
    (Angle([0, 1, 2], 0.0), bent(100.0), "singular at 0 deg, .* has the target 0 deg"),
    (Dihedral([0, 1, 2, 3]), BENDS, "row 0, Dihedral.*: .*atoms 1, 2, 3 are collinear"),
    (Dihedral([3, 2, 1, 0]), BENDS, "row 0, Dihedral.*: .*atoms 3, 2, 1 are collinear"),
    (Sphere(0, COINCIDENT[0]), COINCIDENT, "row 0, .*: atom 0 lies at the center of the sphere"),
    (Torus(0, ORIGIN, [1.0, 2.0, 3.0], 2.0), COINCIDENT, "atom 0 lies on the axis or on the core"),
    (Torus(1, ORIGIN, UP, 1.0), CROSS, "atom 1 lies on the axis or on the core"),
    (Ellipsoid(0, COINCIDENT[0], [1.0, 2.0, 3.0]), COINCIDENT, "atom 0 lies at the center of the ellipsoid"),
    (CenterDistance([0, 1], [2, 3]), CROSS, "row 0.*two centers coincide"),
    (RadiusOfGyration([3, 4]), CROSS, "row 0.*all of its atoms coincide"),
    (VelocityFormula("x1*vy1 - y1*vx1", 1), BENDS, "the gradient not zero"),
    (VelocityFormula("vy1/x1", 1), BENDS, "must be finite"),
    (Custom([[0], [2]], lambda r: r[0, 0] ** 2, lambda r: 2 * r * UP[::-1]), CROSS, "row 1, .*the gradient not zero"),
    # Differences leave rounding of a gradient that vanishes, in whose direction the atom was held.
    (Custom(0, lambda r: (np.sum(r * r) - 1) ** 2, target=0.0), ROUNDED, "vanishes, or the function varies faster"),
]  # fmt: skip


@pytest.mark.parametrize(("item", "x", "words"), SINGULAR, ids=lambda value: getattr(value, "family", ""))
def test_undefined_gradients_are_refused(item, x, words):
    with pytest.raises(SingularGeometryError, match=words) as caught:
        ConstraintSet(item, x, np.ones(len(x)))
    assert set(caught.value.atoms) <= set(item.atoms.ravel().tolist())


FORMULA = Formula("k*(x1 - x2)", [[0, 1]], {"k": 2.0})


@pytest.mark.parametrize("item", [*(item for item, _, _ in SINGULAR), FORMULA, FixedAtoms(0)], ids=lambda i: i.family)
def test_no_rows_hold_nothing(item):
    held = ConstraintSet(item.select(np.zeros(0, np.int64)), CROSS, np.ones(len(CROSS)))
    assert held.value(CROSS).shape == held.acceleration_target(CROSS, CROSS).shape == (0,)
    assert held.jacobian(CROSS).shape == (0, 3 * len(CROSS))


#: What is refused in `contracts/test_refusals.py`, and what to do about it.
REMEDIES = [
    (lambda: FixedAtoms([True, False]), r"of a mask give np\.flatnonzero"),
    (lambda: Formula("x1^2", 0), r"a power is written \*\*"),
    (lambda: Formula("z1 = x1**2", 0), "write what is held at zero, the left side less the right one"),
    (lambda: Formula("x1 - y", 0), "known are x1, y1, z1, x2, ..., t, pi. Give it as a parameter"),
    (lambda: Formula("x1 - vx1", 0), "'vx1' in 'x1 - vx1' is a velocity; .* is held by VelocityFormula"),
    (lambda: VelocityFormula("vx1 - x1*t", 0), "at rest it is not 0: what the sum is held at is the target"),
    (lambda: Custom(0, lambda r, t: r), r"takes \(r, t\), but is called with \(r\); what .* as a Formula"),
    (lambda: Angle([0, 1, 2], 109.5).check(bent(90.0)[None], 0.0, 0), "targets are in radian"),
    (lambda: Dihedral([0, 1, 2, 3], 60.0).check(twisted(30.0)[None], 0.0, 0), r"give np\.radians\(60\)"),
    (lambda: Distance([0, 1], lambda t: 1 - t).target_at(1.5), r"^Distance.*: target -0.5 .* at t = 1.5; .* and inf,"),
    (lambda: Angle([0, 1, 2], lambda t: t).target_at(4.0), r"^Angle.*: target 4 .* at t = 4; .* 0 and 3.14159,"),
]


@pytest.mark.parametrize(("make", "words"), REMEDIES)
def test_remedies(make, words):
    with pytest.raises(InputError, match=words):
        make()


def test_what_may_be():
    ConstraintSet(Dihedral([0, 1, 2, 3], lambda t: 60.0 + t), twisted(30.0), np.ones(4))
    held = ConstraintSet([FixedAtoms([2]), LinearCombination([2, 3], [UP, [0, 0, -1]])], twisted(30.0), [1, 1, 0, 1])
    assert held.n_rows == 4  # fixed atoms need no mass
