"""Multipliers, Z and its change by name, against the dense theory with derivatives by complex steps."""

from __future__ import annotations

import numpy as np
import pytest
from constraint_cases import blade

from kcons import ConstraintSet, Motion
from kcons.constraints import Angle, CenterDistance, Dihedral, Distance, FixedAtoms, Formula, MovingTarget
from kcons.errors import InputError, NonFiniteError, SingularGeometryError
from kcons.free_energy import HeldCoordinates

N = 6
CHAIN = np.array(
    [[0.0, 0.1, 0.2], [1.1, 0.0, -0.1], [1.6, 1.2, 0.1], [2.7, 1.3, 0.9], [3.1, 0.4, 1.9], [2.2, -0.5, 2.4]]
)
MASSES = np.array([1.0, 12.0, 14.0, 16.0, 12.0, 1.5])


def gradient(x, kind, *atoms):
    """Of a square, a length or an angle, in all coordinates; also at complex places."""
    (first, center, *last), found = atoms, np.zeros_like(x)
    u, w = x[first] - x[center], x[atoms[-1]] - x[center]
    size, width = np.sqrt(u @ u), np.sqrt(w @ w)
    ends = [2 * u if kind == "square" else u / size]
    if kind == "angle":
        cos = u @ w / (size * width)
        ends = [(cos * u / size - w / width) / size, (cos * w / width - u / size) / width] / np.sqrt(1 - cos * cos)
    for atom, end in zip([first, *last], ends, strict=True):
        found[atom] += end
        found[center] -= end
    return found.ravel()


#: Coordinates, other constraints, and the same by name in the same order.
CASES = {
    "one, alone": ({"r": Distance([[0, 3]])}, [], [("length", 0, 3)]),
    "one beside bonds": (
        {"r": Distance([[0, 3]])},
        [Distance([[0, 1], [1, 2], [2, 3]])],
        [("length", 0, 3), ("length", 0, 1), ("length", 1, 2), ("length", 2, 3)],
    ),
    "an angle beside bonds": (
        {"angle": Angle([[0, 1, 2]])},
        [Distance([[0, 1], [1, 2], [2, 4]])],
        [("angle", 0, 1, 2), ("length", 0, 1), ("length", 1, 2), ("length", 2, 4)],
    ),
    "two that share an atom": (
        {"far": Distance([[1, 5]]), "angle": Angle([[1, 2, 3]])},
        [Distance([[1, 2], [3, 4]])],
        [("length", 1, 5), ("angle", 1, 2, 3), ("length", 1, 2), ("length", 3, 4)],
    ),
    "a square": ({"s": Formula("(x1-x2)**2 + (y1-y2)**2 + (z1-z2)**2", [[0, 4]], target=None)}, [], [("square", 0, 4)]),
}


def held(name: str) -> tuple[ConstraintSet, dict, list]:
    coordinates, others, rows = CASES[name]
    return ConstraintSet([*others, *coordinates.values()], CHAIN, MASSES), coordinates, rows


def exact_mean_force(rows, d, force, kT):
    """dF/dq of the first d rows c at CHAIN by the definition, for the measure of the other constraints alone.

    [H^-1 A M^-1 grad V]_i - kT div [H^-1 A M^-1]_i, A = grad c, H = A M^-1 A^T, V = U - kT/2 ln det H_others.
    """

    def parts(x):
        A = np.array([gradient(x, *row) for row in rows])
        weighted = A / np.repeat(MASSES, 3)
        H = weighted @ A.T
        return np.linalg.solve(H, weighted)[:d], np.log(np.linalg.det(H[d:, d:]))

    steps = [parts(CHAIN + 1e-30j * e.reshape(N, 3)) for e in np.eye(3 * N)]
    divergence = sum(inverse[:, k].imag for k, (inverse, _) in enumerate(steps)) / 1e-30
    slope = -force.ravel() - kT / 2 * np.array([log.imag for _, log in steps]) / 1e-30
    return parts(CHAIN + 0j)[0].real @ slope - kT * divergence


@pytest.mark.parametrize("case", CASES)
def test_mean_force_is_the_one_of_the_definition(case):
    """lambda averaged over velocities, and kT G, against the divergence with exact second derivatives."""
    constraint_set, coordinates, rows = held(case)
    motion = Motion(constraint_set, CHAIN)
    mine = HeldCoordinates(motion, coordinates, CHAIN)
    kT = 0.7
    force = np.random.default_rng(3).normal(size=(N, 3))
    # <v v^T> = kT M_par^+: the sum over a basis of the tangent velocities, orthonormal in the metric of masses.
    root = np.repeat(np.sqrt(MASSES), 3)
    a = constraint_set.jacobian(CHAIN).toarray() / root
    basis = np.linalg.svd(a)[2][len(a) :] / root
    kinetic = sum(mine.sample(CHAIN, v.reshape(N, 3), force).kinetic for v in basis) * kT
    sample = mine.sample(CHAIN, np.zeros((N, 3)), force)
    wanted = exact_mean_force(rows, len(mine), force, kT)
    np.testing.assert_allclose(sample.multiplier + kinetic + kT * sample.gradient, wanted, rtol=0, atol=2e-12)
    np.testing.assert_allclose(kT * sample.mean_kinetic, kinetic, rtol=0, atol=2e-12)
    assert np.abs(kinetic).min() > 1e-3 and (case == "one, alone" or np.abs(sample.gradient).min() > 1e-3)


@pytest.mark.parametrize("case", CASES)
def test_many_samples_at_once_are_those_taken_alone(case):
    constraint_set, coordinates, _ = held(case)
    mine = HeldCoordinates(constraint_set, coordinates, CHAIN, bonds=[[0, 1], [1, 2], [2, 3]])
    x, v, f = CHAIN + 0.05 * np.random.default_rng(2).normal(size=(3, 70, N, 3))
    found = mine.samples(x, v, f, list(range(70)))
    for one, each in zip(found, map(mine.sample, x, v, f, range(70)), strict=True):
        np.testing.assert_allclose(np.hstack(one), np.hstack(each), rtol=1e-12, atol=1e-12)
    x[66] = np.nan
    with pytest.raises(NonFiniteError, match=r"positions of atom . are not finite at time 66"):
        mine.samples(x, v, f, list(range(70)))


def test_names_follow_the_mapping_and_not_the_set():
    bond, turn, bend = Distance([[0, 1]]), Dihedral([[0, 1, 2, 3]]), Angle([[1, 2, 3], [2, 3, 4]])
    constraint_set = ConstraintSet([bend, bond, turn], CHAIN, MASSES)
    mine = HeldCoordinates(constraint_set, {"turn": turn, "bend": bend.select([1]), "bond": Distance([[1, 0]])}, CHAIN)
    assert mine.names == ("turn", "bend", "bond")
    assert mine.rows.tolist() == [3, 1, 2]
    sample = mine.sample(CHAIN, np.zeros((N, 3)), np.zeros((N, 3)))
    np.testing.assert_allclose(sample.value, constraint_set.measure(CHAIN)[mine.rows], rtol=1e-15)
    assert mine.periods == pytest.approx([2 * np.pi, 0, 0])
    assert repr(mine) == "<HeldCoordinates: turn, bend, bond, beside 1 rows of their clusters>"


R, BEND, BONDS = Distance([[0, 3]]), Angle([[0, 3, 4]]), Distance([[0, 1], [1, 2]])


def of_chain(*rows, x=CHAIN, masses=MASSES, named=None, **cell):
    return HeldCoordinates(ConstraintSet(rows, x, masses, **cell), named or {"r": R}, x)


def test_only_the_clusters_of_the_coordinates_are_looked_at():
    x = np.vstack([CHAIN, CHAIN + np.array([50.0, 0, 0])])
    among = of_chain(Distance([[6, 7], [7, 8]]), BONDS, R, x=x, masses=np.tile(MASSES, 2))
    assert among.atoms.tolist() == [0, 1, 2, 3]
    v, f = np.random.default_rng(0).normal(size=(2, 12, 3))
    one, two = of_chain(BONDS, R).sample(CHAIN, v[:6], f[:6]), among.sample(x, v, f)
    np.testing.assert_array_equal(np.hstack(one), np.hstack(two))


def test_redundant_constraints_beside_change_nothing():
    """All ten distances of five atoms, nine of them independent, or nine alone."""
    pairs, r = [[a, b] for a in range(5) for b in range(a)], Distance([[4, 5]])
    v, f = np.random.default_rng(5).normal(size=(2, N, 3))
    samples = [of_chain(Distance(rows), r, named={"r": r}) for rows in (pairs, pairs[:9])]
    assert [repr(s).split()[3] for s in samples] == ["10", "9"]
    tangent = Motion(ConstraintSet([Distance(pairs), r], CHAIN, MASSES), CHAIN).project_velocities(CHAIN, v)
    one, two = (s.sample(CHAIN, tangent, f) for s in samples)
    np.testing.assert_allclose(np.hstack(one[:-1]), np.hstack(two[:-1]), rtol=0, atol=1e-10)


def test_fixed_atoms_have_no_share():
    heavy, named = MASSES.copy(), {"r": R, "b": BEND}
    heavy[[0, 4]] = 1e14
    v, f = np.random.default_rng(2).normal(size=(2, N, 3))
    v[[0, 4]] = 0
    held = of_chain(FixedAtoms([0, 4]), R, BEND, named=named), of_chain(R, BEND, masses=heavy, named=named)
    one, two = (each.sample(CHAIN, v, f) for each in held)
    np.testing.assert_allclose(np.hstack(one[:-1]), np.hstack(two[:-1]), rtol=0, atol=1e-10)


def test_wrapped_molecules_and_a_new_cell():
    cell, images = np.diag([8.0, 9.0, 10.0]), np.array([0, 1, 0, -1, 2, 0])[:, None]
    v, f = np.random.default_rng(4).normal(size=(2, N, 3))
    moved, wider = (CHAIN + images * factor * cell[0] for factor in (1.0, 1.25))
    whole = np.hstack(of_chain(BONDS, R, cell=cell).sample(CHAIN, v, f))
    motion = Motion(ConstraintSet([BONDS, R], moved, MASSES, cell=cell), moved)
    mine = HeldCoordinates(motion, {"r": R}, moved)
    np.testing.assert_allclose(whole, np.hstack(mine.sample(moved, v, f)), rtol=0, atol=1e-12)
    motion.set_cell(1.25 * cell)
    np.testing.assert_allclose(whole, np.hstack(mine.sample(wider, v, f)), rtol=0, atol=1e-12)


def test_moving_targets_and_moving_constraints_beside():
    """The multipliers of the engine with everything that moves; its static part is not called kinetic."""
    start = float(np.linalg.norm(CHAIN[0] - CHAIN[3]))
    r = Distance([[0, 3]], MovingTarget(lambda t: start + 0.3 * t + t * t))
    bond = Distance([[0, 1]], MovingTarget(lambda t: float(np.linalg.norm(CHAIN[0] - CHAIN[1])) + 0.2 * t))
    constraint_set = ConstraintSet([bond, r], CHAIN, MASSES)
    motion = Motion(constraint_set, CHAIN)
    mine = HeldCoordinates(motion, {"r": Distance([[0, 3]])}, CHAIN)
    v, f = np.random.default_rng(6).normal(size=(2, N, 3))
    v = motion.project_velocities(CHAIN, v)
    sample = mine.sample(CHAIN, v, f)
    assert np.isnan(sample.mean_kinetic).all()  # velocities have a mean of their own
    np.testing.assert_allclose(sample.multiplier, motion.multipliers(CHAIN, v, f)[1:], rtol=0, atol=1e-12)
    still = motion.multipliers(CHAIN, np.zeros((N, 3)), f)[1:]
    np.testing.assert_allclose(sample.multiplier - sample.kinetic, still, rtol=0, atol=1e-12)


def test_large_clusters_have_no_mean_over_velocities():
    """A chain of 61 rows, and a center of 13 atoms: all else is there."""
    x = np.cumsum(np.random.default_rng(8).normal(size=(62, 3)), axis=0)
    v, f = np.random.default_rng(9).normal(size=(2, 62, 3))
    chain = Distance([[k, k + 1] for k in range(61)])
    for rows, name, known in (
        ([chain], {"last": chain.select([60])}, False),
        ([chain.select(range(60))], {"last": chain.select([59])}, True),
        ([CenterDistance([*range(12)], [12])], {"r": CenterDistance([*range(12)], [12])}, False),
    ):
        held = ConstraintSet(rows, x, np.ones(62))
        sample = HeldCoordinates(held, name, x).sample(x, v, f)
        assert np.isfinite(sample.mean_kinetic).all() == known and np.isfinite(sample.multiplier).all()


def test_coordinates_that_come_to_depend_on_others():
    """Straight, the far ends no longer tell their distance from the bonds."""
    side, flat = Distance([[0, 2]]), CHAIN.copy()
    flat[0] = 2 * flat[1] - flat[2] + [0.0, 0.0, 1e-9]
    with pytest.raises(SingularGeometryError, match="side depends on the other"):
        of_chain(BONDS, side, named={"side": side}).sample(flat, CHAIN, CHAIN)


def test_formulas_on_the_same_atoms_are_told_apart():
    first, second, again, third = (
        Formula(text, [[0, 3]], target=None) for text in ("x1*x2 - z1", "y1 + 3*y2", "y1 + 3*y2", "y1 + 4*y2")
    )
    assert of_chain(first, second, named={"second": again}).rows.tolist() == [1]
    with pytest.raises(InputError, match="not among"):
        of_chain(first, second, named={"third": third})


def test_what_no_coordinate_touches_may_be_anything():
    far, still = Distance([[4, 5]]), np.zeros((N, 3))
    still[2] = np.nan
    assert np.isfinite(of_chain(R).sample(CHAIN, still, still).off)
    assert len(of_chain(far, blade([0, 1]), named={"far": far})) == 1
