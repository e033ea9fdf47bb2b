"""Which images rows mean: atoms stored anywhere, long bodies, frameworks, drifting apart; rows that know a place."""

from __future__ import annotations

import numpy as np
import pytest
from rows_in_cells import CHAIN, MASSES, ROWS

from kcons import ConstraintSet, Motion, State, System, run
from kcons.constraints import (
    Angle,
    CenterDistance,
    CenterOfMass,
    Custom,
    Dihedral,
    Distance,
    FixedAtoms,
    Formula,
    LinearCombination,
    MovingTarget,
    Plane,
    RadiusOfGyration,
    Sphere,
    VelocityFormula,
)
from kcons.constraints.periodic.one_piece import follow_parents, lattice_of, make_whole, spanning_tree
from kcons.errors import ImageError, InputError

CELLS = {
    "box": (np.diag([9.0, 11.0, 10.0]), (True, True, True)),
    "triclinic": (np.array([[9.0, 0, 0], [2.5, 9.5, 0], [-2.0, 1.5, 10.0]]), (True, True, True)),
    "slab": (np.array([[9.0, 0, 0], [3.0, 9.5, 0], [0.0, 0.0, 7.0]]), (True, True, False)),
    "wire": (np.diag([9.0, 4.0, 5.0]), (True, False, False)),
}


def stored(x, cell, periodic, seed):
    """`x` with every atom in an image of its own, and the shifts."""
    images = np.random.default_rng(seed).integers(-2, 3, x.shape) * np.array(periodic)
    return x + images @ cell, images @ cell


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("cell", CELLS.values(), ids=CELLS)
@pytest.mark.parametrize("rows", ROWS.values(), ids=ROWS)
def test_atoms_in_any_image_are_held_as_whole_ones(rows, cell, seed):
    lattice, periodic = cell
    fixed = [2] if isinstance(rows[0], FixedAtoms) else []
    there, shift = stored(CHAIN, lattice, periodic, seed)
    shift[fixed] = 0.0
    there[fixed] = CHAIN[fixed]
    free = Motion(ConstraintSet(rows, CHAIN, MASSES), CHAIN)
    held = ConstraintSet(rows, there, MASSES, cell=lattice, pbc=periodic)
    motion = Motion(held, there)
    rng = np.random.default_rng(seed)
    step, v, f = (rng.normal(size=CHAIN.shape) for _ in range(3))
    assert motion.rank == free.rank
    right = free.project_positions(CHAIN + 1e-2 * step, CHAIN)
    out = motion.project_positions(there + 1e-2 * step, there)
    assert np.abs(out - shift - right).max() < 1e-12
    assert np.abs(held.value(out)).max() < 1e-12
    # Also where the atoms were stored elsewhere again in between.
    again, other = stored(right, lattice, periodic, seed + 7)
    other[fixed] = 0.0
    again[fixed] = right[fixed]
    right = free.project_positions(right - 1e-2 * v, right)
    assert np.abs(motion.project_positions(again - 1e-2 * v, again) - other - right).max() < 1e-12
    tangent = free.project_velocities(CHAIN, v)
    assert np.abs(motion.project_velocities(there, v) - tangent).max() < 1e-12
    assert np.abs(motion.acceleration(there, tangent, f) - free.acceleration(CHAIN, tangent, f)).max() < 1e-11
    assert np.abs(held.measure(there) - free.constraint_set.measure(CHAIN)).max() < 1e-12


def test_a_single_rod_as_long_as_half_the_cell_stays_refused():
    x = np.array([[0.0, 0, 0], [6.0, 0, 0], [3.0, 1.0, 0]])
    with pytest.raises(InputError, match="no shorter rows tie"):
        ConstraintSet(Distance([[0, 1]], 6.0), x, np.ones(3), cell=[10.0] * 3)
    tied = ConstraintSet(Distance([[0, 1], [0, 2], [1, 2]], [6.0, 10**0.5, 10**0.5]), x, np.ones(3), cell=[10.0] * 3)
    assert tied.target()[0] == pytest.approx(6.0)


@pytest.mark.parametrize("bonds_held", [True, False])
def test_a_polymer_that_closes_through_the_boundary(bonds_held):
    n, length = 6, 6 * 1.2
    x = np.stack([1.2 * np.arange(n), 0.3 * (-1.0) ** np.arange(n), 0.2 * np.cos(2.0 * np.arange(n))], axis=1)
    bonds = [[k, (k + 1) % n] for k in range(n)]
    angles = Angle([[k, (k + 1) % n, (k + 2) % n] for k in range(n)])
    across = LinearCombination([0, 2], [[0, 0, 1.0], [0, 0, -1.0]])
    cell = np.diag([length, 9.0, 9.0])
    rows = ([Distance(bonds)] if bonds_held else [angles]) + [across]
    there, _ = stored(x, cell, (True, True, True), 1)
    held = ConstraintSet(rows, there, np.ones(n), cell=cell)
    motion = Motion(held, there)
    # The same with six more atoms, moved along, on either side.
    along = np.array([length, 0.0, 0.0])
    long = np.concatenate([x - along, x, x + along])
    inner = held.measure(there)[:n]
    if bonds_held:
        expected = [np.linalg.norm(long[n + k + 1] - long[n + k]) for k in range(n)]
    else:
        u, w = long[n : 2 * n] - long[n + 1 : 2 * n + 1], long[n + 2 : 2 * n + 2] - long[n + 1 : 2 * n + 1]
        expected = np.arccos(np.sum(u * w, axis=1) / np.linalg.norm(u, axis=1) / np.linalg.norm(w, axis=1))
    assert np.abs(inner - expected).max() < 1e-12
    step = 1e-3 * np.random.default_rng(2).normal(size=x.shape)
    out = motion.project_positions(there + step, there)
    assert np.abs(held.value(out)).max() < 1e-12
    assert np.abs(out - there).max() < 0.1


@pytest.mark.parametrize("wrapped", [False, True])
def test_atoms_that_nothing_ties_raise_before_their_image_flips(wrapped):
    x = np.array([[0.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0], [3.0, 1.0, 0]])
    row, cell = CenterDistance([0, 1], [2, 3]), np.diag([10.0, 10.0, 10.0])
    rows, free = ConstraintSet(row, x, [1.0, 3, 1, 1], cell=cell), ConstraintSet(row, x, [1.0, 3, 1, 1])
    motion = Motion(rows, x)
    system = System(motion, None)
    v = motion.project_velocities(x, np.array([[0, 0, 0.3], [0, 0, -0.3], [0, 0, 0], [0, 0, 0]]))
    state, true = State(x, v), x
    with pytest.raises(ImageError, match="half the cell apart") as caught:
        for _ in range(400):
            before = state.positions.copy()
            after = run(system, state, 0.05, 1)
            true = true + (after.positions - state.positions)
            assert abs(free.value(true)[0]) < 1e-12
            y = after.positions % 10.0 if wrapped else after.positions
            state = State(y, after.velocities, after.time)
    assert set(caught.value.atoms) <= {0, 1, 2, 3}
    assert "time step" not in str(caught.value)
    assert np.array_equal(state.positions % 10.0 if wrapped else state.positions, before)


def test_conversions_are_visible():
    x = np.array([[-1.16, 0, 0], [0, 0, 0], [1.16, 0, 0], [5.0, 0, 0]])
    motion = Motion(ConstraintSet(Distance([[0, 1], [1, 2], [0, 2]]), x, np.ones(4)), x)
    (body,) = motion.conversions
    assert str(body) == "atoms 0, 1, 2 on a line: 1 distance and 3 linear rows in place of 3 rows"
    assert f"converted: {body}" in str(motion.report(x))
    assert Motion(ConstraintSet(Distance([[0, 1]]), x, np.ones(4)), x).conversions == ()


def test_lengths_found_far_away_can_be_held_near_the_origin():
    """Stored at 3000 Å, positions are rounded to 5e-13, and so would be ten lengths of rank nine, each on its own."""
    cell, x = np.array([[7.9, 0, 0], [-0.5, 8.4, 0], [-0.5, -1.8, 8.6]]), CHAIN[:5] * 0.8
    pairs, rng = [(i, j) for i in range(5) for j in range(i)], np.random.default_rng(1)
    shift, less = (rng.integers(-far, far + 1, (5, 3)) @ cell for far in (400, 40))
    rows = ConstraintSet(Distance(pairs), x + shift, MASSES[:5], cell=cell)
    exact = ConstraintSet(Distance(pairs), x, MASSES[:5]).target()
    assert 0 < np.abs(rows.target() - exact).max() < 400 * 3 * 8.6 * 4e-16
    motion = Motion(rows, x + shift)
    found = motion.restore_positions(x)
    # Ten lengths of one shape in space fit each other: the oracle needs no cell.
    assert np.abs(rows.value(found)).max() < 4e-15
    state = run(System(motion, lambda x, t: -x), State(found, motion.project_velocities(found, x[:, ::-1])), 0.01, 20)
    assert np.abs(rows.value(state.positions)).max() < 3e-14
    # A length that is found, and the same one given.
    given = float(np.linalg.norm(x[1] - x[0]))
    both = [Distance([[1, 2], [1, 0]]), Distance([[0, 1]], given)]
    target = ConstraintSet(both, x + less, MASSES[:5], cell=cell).target()
    assert target[1] == target[2] == given and target[0] == pytest.approx(np.linalg.norm(x[2] - x[1]), abs=1e-12)


def test_a_long_distance_beside_a_free_angle_is_ambiguous():
    """Through the boundary its target fits as well, and nothing held says that the angle does not turn."""
    cell = np.diag([2.6, 2.4, 1.9])
    x = np.array([[0.0, 0.0, 0.0], [-0.12, -0.84, -1.65], [0.12, 0.02, -0.93]])
    long = float(np.linalg.norm(x[1] - x[2]))
    angle, masses = Angle([[1, 2, 0]]), np.ones(3)
    with pytest.raises(InputError, match=r"row 1, Distance\(1, 2\): target .* is not shorter than half the box"):
        ConstraintSet([angle, Distance([[1, 2]], long)], x, masses, cell=cell, pbc=True)
    wide = ConstraintSet([angle, Distance([[1, 2]], long)], x, masses, cell=3 * cell, pbc=True)
    assert abs(wide.value(x)).max() < 1e-14


@pytest.mark.parametrize("given", [False, True])
def test_off_its_row_a_distance_of_nearly_half_the_cell_is_not_that_of_another_image(given):
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.8, 0.0]])
    pairs = [[0, 2], [2, 1], [0, 1]]
    lengths = [float(np.linalg.norm(x[a] - x[b])) for a, b in pairs]
    row = Distance(pairs, lengths if given else None)
    held = ConstraintSet(row, x, np.ones(3), cell=2.1 * np.eye(3), pbc=True)  # 1.0 of 1.05
    longer = x + np.array([[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0], [0.0, 0.0, 0.0]])
    expected = ConstraintSet(row, x, np.ones(3)).value(longer)
    for images in ([0, 0, 0], [0, -1, 0], [2, 5, -3]):
        np.testing.assert_allclose(held.value(longer + 2.1 * np.array(images)[:, None]), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("turn", [0.5, 1.5, 2.5, 3.1])
def test_a_chain_of_moving_bonds_may_open_beyond_half_the_cell(turn):
    """Its ends are the nearest atoms at the start, but it is the bonds that make it whole."""

    def chain(turn):
        return np.array([[0.1, 1.1, 0.0], [0, 0, 0], [1.1, 0, 0], [1.0, 1.1 * np.cos(turn), 1.1 * np.sin(turn)]])

    still = MovingTarget(lambda t: np.linalg.norm([0.1, 1.1]), lambda t: 0.0, lambda t: 0.0)
    rows = [Distance([[0, 1], [2, 3]], still), Distance([[1, 2]]), Dihedral([[0, 1, 2, 3]])]
    held = ConstraintSet(rows, chain(0.0), np.ones(4), cell=[3.2] * 3)
    there = stored(chain(turn), 3.2 * np.eye(3), (True, True, True), 1)[0]
    np.testing.assert_allclose(np.abs(held.value(there)), [0, 0, 0, turn], rtol=0, atol=1e-14)


# -- a cell that comes, changes or is too small ------------------------------------------------------------


def test_a_first_cell_is_refused_where_images_have_to_be_found():
    rows = ConstraintSet(ROWS["relation"], CHAIN, MASSES)
    motion = Motion(rows, CHAIN)
    with pytest.raises(InputError, match="make a new ConstraintSet"):
        motion.set_cell(np.diag([9.0] * 3))
    assert rows.lattice is None
    plain = Motion(ConstraintSet(Distance([[0, 1]]), CHAIN, MASSES), CHAIN)
    plain.set_cell(np.diag([9.0] * 3))
    assert plain.lattice is not None


def test_a_cell_that_shrinks_onto_loose_atoms_is_refused():
    held = [Distance([[4, 5]]), CenterDistance([0], [5])]
    rows = ConstraintSet(held, CHAIN, MASSES, cell=np.diag([12.0] * 3))
    motion = Motion(rows, CHAIN)
    before = motion.lattice
    with pytest.raises(InputError, match="more than a tenth"):
        motion.set_cell(np.diag([12.0, 6.9, 12.0]), positions=CHAIN)
    assert motion.lattice is before
    for width in (11.0, 10.0, 9.1, 8.3, 7.6):
        motion.set_cell(np.diag([12.0, width, 12.0]), positions=CHAIN)
    before = motion.lattice
    with pytest.raises(ImageError, match=r"row #1 Center.* atoms 0 and 5"):  # not those that come along as one body
        motion.set_cell(np.diag([12.0, 6.9, 12.0]), positions=CHAIN)
    assert motion.lattice is before
    # Without positions it is found out when these come.
    motion.set_cell(np.diag([12.0, 6.9, 12.0]))
    with pytest.raises(ImageError, match=r"row #1 Center.* atoms 0 and 5"):
        motion.project_positions(CHAIN, CHAIN)


@pytest.mark.parametrize("known", [True, False])
def test_molecules_that_move_along_with_a_cell_as_a_whole_keep_their_images(known):
    """As barostats move them: 4 apart across a face of a cell that was 9 wide and is 8.4."""
    x, y = (np.array([[a, 0.0, 0.0], [a, 1.0, 0.0], [b, 0.0, 0.0], [b, 1.0, 0.0]]) for a, b in ((8, 3), (7.5, 3.1)))
    held = ConstraintSet([Distance([[0, 1], [2, 3]]), CenterDistance([0, 1], [2, 3])], x, np.ones(4), cell=[9, 9, 9])
    motion = Motion(held, x)
    motion.set_cell(np.diag([8.4, 9, 9]), positions=y if known else None)
    assert np.abs(motion.project_positions(y, y) - y).max() < 1e-14
    assert motion.constraint_set.measure(y)[2] == pytest.approx(4.0)


def test_directions_without_periodicity_do_not_count_as_a_change_of_the_cell():
    """The vectors that stand for them are any two normals, which jump where the periodic one turns a little."""
    rng = np.random.default_rng(4)
    for _ in range(200):
        cell = rng.normal(size=(3, 3)) + 9 * np.linalg.qr(rng.normal(size=(3, 3)))[0]
        rows = ConstraintSet(ROWS["relation"], CHAIN, MASSES, cell=cell, pbc=(True, False, False))
        rows.with_cell(cell @ (np.eye(3) + 0.02 * rng.uniform(-1, 1, (3, 3))), (True, False, False))


# -- what hangs together in one piece ---------------------------------------------------------------------

LATTICE = np.array([[7.0, 0, 0], [2.0, 8.0, 0], [-1.0, 3.0, 9.0]])


def test_whole_pieces_are_rounded_once():
    """An atom that need not move keeps its coordinates to the last digit, and so does the root."""
    lattice = lattice_of(LATTICE, True)
    rng = np.random.default_rng(4)
    x = np.cumsum(rng.normal(size=(30, 3)), axis=0)
    pairs = np.stack([np.arange(29), np.arange(1, 30)], axis=1)
    cells = rng.integers(-2, 3, size=(30, 3)) * (np.arange(30) % 3 == 1)[:, None]
    stored = x + cells @ LATTICE
    atoms, parents = spanning_tree(pairs, 30)
    y = make_whole(stored, atoms, parents, lattice)
    np.testing.assert_array_equal(y[cells.any(axis=1) == 0], x[cells.any(axis=1) == 0])
    np.testing.assert_allclose(y, x, rtol=0, atol=1e-14 * 60)
    np.testing.assert_array_equal(make_whole(stored, atoms, parents, None), stored)
    compiled = stored.copy()
    follow_parents(compiled, atoms, parents, lattice)
    np.testing.assert_array_equal(compiled, y)


# -- rows with a place in space -----------------------------------------------------------------------------

SKEWED = np.array([[10.0, 0, 0], [1.0, 9.0, 0], [-2.0, 1.0, 11.0]])
WHOLE = np.array([[9.8, 5.0, 5.0], [10.3, 5.1, 5.2], [10.6, 5.4, 5.0], [10.9, 5.2, 5.5], [11.2, 6.0, 5.3]])
IMAGES = np.array([[0, 0, 0], [-1, 0, 1], [2, 0, 0], [0, -1, 0], [-1, 0, 0]])
STORED = WHOLE + IMAGES @ SKEWED
WEIGHTS = np.array([12.0, 1.0, 16.0, 2.0, 3.0])
UP = np.array([0.3, -0.5, 0.8])

#: Each takes by how much its atoms are moved from the whole molecule, shape (5, 3).
PLACES = {
    "Sphere": lambda s: Sphere(1, WHOLE[1] + s[1] + UP, None),
    "Plane": lambda s: Plane(1, UP, None),
    "FixedAtoms": lambda s: FixedAtoms(1),
    "Formula": lambda s: Formula(
        "(x1 - a)**2 + (y1 - b)*(z1 - c)", 1, dict(zip("abc", s[1] + [8.0, 1.0, 2.0], strict=True)), target=None
    ),
    "Custom": lambda s: Custom(1, lambda r: float(np.sin(r[0, 0] - s[1, 0]) + r[0, 1]), target=None),
    "CenterOfMass of three": lambda s: CenterOfMass([[1, 2, 4]], axes=(0, 2)),
    "LinearCombination": lambda s: LinearCombination([[1, 3]], [[1.0, 2.0, 0.0], [0.5, 0.0, 1.0]]),
    "Custom of two": lambda s: Custom(
        [1, 2], lambda r: float(np.sum((r - s[1:3] - 8.0) ** 2)), lambda r: 2.0 * (r - s[1:3] - 8.0)
    ),
    "Formula of a fixed atom": lambda s: (
        FixedAtoms(3),
        Formula("x1*(y2 - a) - b*y2", [[1, 3]], {"a": s[3, 1], "b": s[1, 0]}, target=None),
    ),
    "Formula of a fixed atom and one that nothing ties": lambda s: (
        FixedAtoms(3),
        Formula("x1*(y2 - a) - b*y2", [[4, 3]], {"a": s[3, 1], "b": s[4, 0]}, target=None),
    ),
    "VelocityFormula": lambda s: VelocityFormula("vx1 + (x1 - a)*vy1", 1, {"a": s[1, 0]}),
}
TIES = {
    "gyration": RadiusOfGyration([[0, 1, 2]]),
    "angle": Angle([[0, 1, 2]]),
    "dihedral": Dihedral([[0, 1, 2, 3]]),
    "centers": CenterDistance([0, 3], [1, 2], None),
    "distances": Distance([[0, 1], [1, 2], [2, 3]]),
    "angle in a framework": [Distance([[1, 2], [2, 3]]), Angle([[0, 1, 2]])],
}


def near(found, expected, atol: float) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


def _systems(place: str, tie: str) -> list[tuple[Motion, np.ndarray]]:
    """The molecule in open space, and in a cell with each atom in another image; and by how much atoms are moved."""
    found = []
    for x, cell in ((WHOLE, None), (STORED, SKEWED)):
        moved = x - WHOLE
        rows = [Sphere(0, WHOLE[0] + moved[0] + [0, 1.0, 0.2], None), *_list(PLACES[place](moved)), *_list(TIES[tie])]
        found.append((Motion(ConstraintSet(rows, x, WEIGHTS, cell=cell), x), moved))
    return found


def _list(rows):
    return list(rows) if isinstance(rows, list | tuple) else [rows]


@pytest.mark.parametrize("tie", TIES)
@pytest.mark.parametrize("place", PLACES)
def test_a_molecule_is_the_same_in_the_cell_as_in_open_space(place, tie):
    (there, _), (here, moved) = _systems(place, tie)
    rng = np.random.default_rng(1)
    new, v, f = WHOLE + 0.02 * rng.normal(size=WHOLE.shape), rng.normal(size=WHOLE.shape), rng.normal(size=WHOLE.shape)
    one, other = there.constraint_set, here.constraint_set
    assert (there.rank, there.plan.kinds[0].clusters) == (here.rank, here.plan.kinds[0].clusters)
    shifted = np.concatenate([np.full(c.n_rows, not c.relative) for c in other.constraints])
    near(one.value(new), other.value(new + moved), 1e-12)
    near(one.measure(new)[~shifted], other.measure(new + moved)[~shifted], 1e-12)
    near(one.jacobian(new).toarray(), other.jacobian(new + moved).toarray(), 1e-11)
    near(one.acceleration_target(new, v), other.acceleration_target(new + moved, v), 1e-9)
    near(there.project_positions(new, WHOLE), here.project_positions(new + moved, STORED) - moved, 1e-11)
    np.testing.assert_allclose(there.restore_positions(new), here.restore_positions(new + moved) - moved, atol=1e-9)
    tangent = there.project_velocities(WHOLE, v)
    near(tangent, here.project_velocities(STORED, v), 1e-11)
    near(there.acceleration(WHOLE, tangent, f), here.acceleration(STORED, tangent, f), 1e-9)
    near(there.constraint_force(WHOLE, tangent, f), here.constraint_force(STORED, tangent, f), 1e-9)
    ends = []
    for motion, shift in ((there, np.zeros((5, 3))), (here, moved)):
        system = System(motion, lambda x, t, shift=shift: 3.0 * (WHOLE - (x - shift)))
        ends.append(run(system, system.initial_state(WHOLE + shift, 0.3 * tangent), 0.005, 40))
        assert motion.report(ends[-1].positions).residual < 1e-12
    near(ends[0].positions, ends[1].positions - moved, 1e-9)


def test_another_image_from_one_call_to_the_next():
    """A plane along the way an atom is wrapped: where it is stored does not matter, nor what ties it."""
    rows = [Plane([0, 1], [0, 0, 1.0]), Angle([[0, 1, 2]])]
    cell = np.diag([10.0, 9.0, 11.0])
    motion = Motion(ConstraintSet(rows, WHOLE, WEIGHTS, cell=cell), WHOLE)
    rng = np.random.default_rng(2)
    new, v = WHOLE + 0.02 * rng.normal(size=WHOLE.shape), rng.normal(size=WHOLE.shape)
    expected = motion.project_positions(new, WHOLE)
    for images in rng.integers(-2, 3, (20, *WHOLE.shape)):
        ahead, behind = images @ cell, rng.integers(-2, 3, WHOLE.shape) @ cell
        ahead[:2, 2] = behind[:2, 2] = 0.0
        found = motion.project_positions(new + ahead, WHOLE + behind) - ahead
        near(found, expected, 1e-12)
        near(motion.project_velocities(WHOLE + behind, v), motion.project_velocities(WHOLE, v), 1e-12)
