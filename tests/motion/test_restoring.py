"""Structures brought to a target: what is held is there to rounding, and no other bond or angle has changed.

Bonds and angles are measured here from the molecules' own tables, apart from the search that is tested. At the end
starts far off the constraints: the nearest point in the mass metric, or a plain refusal.
"""

from __future__ import annotations

import tracemalloc
import warnings
from itertools import combinations

import numpy as np
import pytest
from ase import Atoms
from ase.build import molecule
from ase.neighborlist import natural_cutoffs, neighbor_list

from kcons import constraints as held
from kcons.constraints import projection
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InfeasibleError, KconsError
from kcons.motion import Motion, solver_sequence
from kcons.motion.restoring import nearest_point
from kcons.motion.restoring.kept_geometry import bonds_of
from kcons.topology.topology import bonds_without_elements

#: What may change: angstrom, degrees.
BOND, ANGLE = 0.02, 2.0


def bond_table(atoms: Atoms) -> list[tuple[int, int]]:
    """Bonds by ASE's own neighbor list."""
    i, j = neighbor_list("ij", atoms, natural_cutoffs(atoms, mult=1.2))
    return [(int(a), int(b)) for a, b in zip(i, j, strict=True) if a < b]


def torsions(atoms: Atoms) -> list[tuple[int, int, int, int]]:
    """One torsion for each bond with neighbors on both sides, in molecules without rings."""
    near = {a: {y for b in bond_table(atoms) for y in b if a in b and y != a} for a in range(len(atoms))}
    inner = [(j, k) for j, k in bond_table(atoms) if len(near[j]) > 1 and len(near[k]) > 1]
    return [(min(near[j] - {k}), j, k, min(near[k] - {j})) for j, k in inner]


def shape(atoms: Atoms, x: np.ndarray, free: tuple[tuple[int, ...], ...] = ()) -> tuple[np.ndarray, np.ndarray]:
    """Lengths of all bonds and all angles in degrees, without those among `free` that a row changes."""
    bonds = bond_table(atoms)
    copy = atoms.copy()
    copy.positions = x
    near = {a: [y for b in bonds for y in b if a in b and y != a] for a in range(len(atoms))}
    angles = [(i, j, k) for j in near for i, k in combinations(near[j], 2)]
    lengths = [copy.get_distance(*b, mic=True) for b in bonds if b not in free and b[::-1] not in free]
    moved = {(t[1], end) for t in free if len(t) == 3 for end in (t[0], t[2])}
    bent = [copy.get_angle(*t, mic=True) for t in angles if not {(t[1], t[0]), (t[1], t[2])} & moved]
    return np.array(lengths), np.array(bent)


def kept(atoms: Atoms, x: np.ndarray, free: tuple[tuple[int, ...], ...] = ()) -> None:
    """No other bond, no other angle than those in `free` has changed."""
    before, after = shape(atoms, atoms.positions, free), shape(atoms, x, free)
    assert np.abs(after[0] - before[0]).max(initial=0.0) <= BOND
    assert np.abs(after[1] - before[1]).max(initial=0.0) <= ANGLE


def engine(atoms: Atoms, rows: list[held.Constraint], masses: np.ndarray | None = None) -> Motion:
    masses = atoms.get_masses() if masses is None else masses
    cell = atoms.cell.array if atoms.pbc.any() else None
    return Motion(ConstraintSet(rows, atoms.positions, masses, cell=cell), atoms.positions)


def fulfilled(whole: ConstraintSet, x: np.ndarray) -> None:
    assert np.all(np.abs(whole.value(x)) <= whole.tolerance(x))


def brought(
    atoms: Atoms, *rows: held.Constraint, free: tuple[tuple[int, ...], ...] = (), bonds=None, masses=None
) -> tuple[Motion, np.ndarray]:
    """The engine, and positions on its rows for which no bond and no angle but those in `free` has changed."""
    motion = engine(atoms, list(rows), masses)
    x = motion.restore_positions(atoms.positions, bonds=bonds)
    fulfilled(motion.constraint_set, x)
    kept(atoms, x, free)
    return motion, x


# -- torsions ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["CH3CH2OH", "trans-butane", "CH3CONH2", "CH3CH2NH2", "C2H6", "HCOOCH3", "Si2H6"])
@pytest.mark.parametrize("given", [True, False], ids=["bonds", "no bonds"])
def test_a_torsion_from_anywhere_to_anywhere(name: str, given: bool) -> None:
    """Also where it is straight through a cis arrangement, and with bonds that distances alone suggest."""
    atoms = molecule(name)
    bonds = bond_table(atoms) if given else None
    for quad in torsions(atoms):
        for degrees in range(-180, 181, 45):
            brought(atoms, held.Dihedral([quad], np.radians(degrees)), bonds=bonds)


def test_the_lighter_piece_turns_and_the_other_stays() -> None:
    atoms = molecule("CH3CH2OH")
    for masses, moves in ((atoms.get_masses(), {3}), (np.array([1, 1, 50, 50, 1, 1, 1, 1, 1.0]), {0, 4, 5, 6, 7, 8})):
        x = engine(atoms, [held.Dihedral([[3, 2, 1, 0]], 1.0)], masses).restore_positions(atoms.positions)
        away = np.linalg.norm(x - atoms.positions, axis=1)
        assert set(np.flatnonzero(away > 1e-9).tolist()) <= moves and away.max() > 0.5


def test_the_piece_without_fixed_atoms_turns() -> None:
    atoms = molecule("trans-butane")
    quad = next(q for q in torsions(atoms) if {atoms.numbers[k] for k in q} == {6})
    for fixed in (quad[0], quad[3]):
        _, x = brought(atoms, held.FixedAtoms([fixed]), held.Dihedral([quad], 1.0))
        np.testing.assert_array_equal(x[fixed], atoms.positions[fixed])
    ends = np.flatnonzero(atoms.numbers == 1)[atoms.get_distances(quad[0], np.flatnonzero(atoms.numbers == 1)) < 1.3]
    others = np.flatnonzero(atoms.numbers == 1)[atoms.get_distances(quad[3], np.flatnonzero(atoms.numbers == 1)) < 1.3]
    motion = engine(atoms, [held.FixedAtoms(np.r_[ends, others]), held.Dihedral([quad], 1.0)])
    start = atoms.positions.copy()
    with pytest.raises(InfeasibleError, match="Dihedral"):
        motion.restore_positions(start)
    np.testing.assert_array_equal(start, atoms.positions)


@pytest.mark.parametrize("seed", range(6))
def test_wrapped_into_a_small_cell(seed: int) -> None:
    """Atoms may be stored in any image and stay in theirs."""
    rng = np.random.default_rng(seed)
    atoms = molecule("CH3CH2OH")
    atoms.set_cell([[9.0, 0, 0], [2.0, 10, 0], [-1.0, 1.5, 8.5]])
    atoms.pbc = True
    atoms.positions += rng.uniform(0, 10, 3)
    atoms.wrap()
    row = held.Dihedral([[3, 2, 1, 0]], rng.uniform(-3, 3))
    _, x = brought(atoms, row, bonds=bond_table(atoms) if seed % 2 else None)
    assert np.abs(x - atoms.positions).max() < 3.0


# -- angles, bonds, distances between groups --------------------------------------------------------


@pytest.mark.parametrize("degrees", [50, 80, 130, 165])
def test_an_angle_far_off(degrees: float) -> None:
    atoms = molecule("CH3CH2OH")
    for triple in ((3, 2, 1), (2, 1, 0)):
        brought(atoms, held.Angle([triple], np.radians(degrees)), free=(triple,))


@pytest.mark.parametrize("factor", [0.7, 1.4, 2.0])
def test_a_bond_takes_what_hangs_on_it_along(factor: float) -> None:
    atoms = molecule("CH3CH2OH")
    motion, x = brought(atoms, held.Distance([[1, 2]], factor * atoms.get_distance(1, 2)), free=((1, 2),))
    np.testing.assert_allclose(motion.masses @ x, motion.masses @ atoms.positions, atol=1e-9)


@pytest.mark.parametrize("length", [3.0, 7.0, 20.0])
def test_a_distance_between_molecules_shifts_them_whole(length: float) -> None:
    pair = molecule("C6H6") + molecule("H2O")
    pair.positions[12:] += [0.4, 0.2, 4.0]
    motion, x = brought(pair, held.CenterDistance(range(12), range(12, 15), length))
    for part in (slice(0, 12), slice(12, 15)):
        move = (x - pair.positions)[part]
        np.testing.assert_allclose(move - move[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(motion.masses @ x, motion.masses @ pair.positions, atol=1e-9)


@pytest.mark.parametrize("length", [2.7, 3.0, 3.4])
def test_a_distance_within_a_molecule_turns_the_bonds_between(length: float) -> None:
    """From the extended chain, where the distance is at its largest and its slope along every torsion is 0."""
    atoms = molecule("trans-butane")
    carbons = np.flatnonzero(atoms.numbers == 6)
    ends = max(combinations(carbons.tolist(), 2), key=lambda pair: atoms.get_distance(*pair))
    brought(atoms, held.Distance([ends], length))


# -- rings, and what cannot be -----------------------------------------------------------------------


def test_a_ring_gives_way_as_far_as_it_may() -> None:
    """A torsion of benzene by 20 degrees bends its angles by less than one; by 90 it cannot be."""
    ring = molecule("C6H6")
    _, x = brought(ring, held.Dihedral([[0, 1, 2, 3]], np.radians(20)))
    motion = engine(ring, [held.Dihedral([[0, 1, 2, 3]], np.radians(90))])
    out = np.full_like(x, 5.0)
    with pytest.raises(InfeasibleError, match=r"row #0 Dihedral\(0, 1, 2, 3\).*changed from.*no row asks for"):
        motion.restore_positions(ring.positions, out=out)
    assert (out == 5.0).all()


def test_without_bonds_the_nearest_point_as_asked() -> None:
    """An empty list means that what no row holds is of no concern."""
    ring = molecule("C6H6")
    motion = engine(ring, [held.Distance([[0, 1]], 2.0)])
    with pytest.raises(InfeasibleError, match="bonds="):
        motion.restore_positions(ring.positions)
    x = motion.restore_positions(ring.positions, bonds=[])
    fulfilled(motion.constraint_set, x)
    assert set(np.flatnonzero(np.linalg.norm(x - ring.positions, axis=1) > 1e-12).tolist()) == {0, 1}


# -- bounds -------------------------------------------------------------------------------------------


def tangled(seed: int) -> tuple[Motion, np.ndarray] | None:
    """A random set on up to 12 atoms of masses 2e-3 to 1e7, and a start up to 7 off; None where it cannot be set up."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 13))
    x = np.cumsum(rng.normal(size=(n, 3)), axis=0)
    pairs = np.array(list(combinations(range(n), 2)))
    rows = [held.Distance(rng.permutation(pairs)[: rng.integers(1, 12)])]
    rows += [held.Angle([rng.permutation(n)[:3]]) for _ in range(rng.integers(0, 4))]
    rows += [held.Dihedral([rng.permutation(n)[:4]]) for _ in range(rng.integers(0, 4))]
    try:
        motion = Motion(ConstraintSet(rows, x, 10 ** rng.uniform(np.log10(2e-3), 7, n)), x)
    except KconsError:
        return None
    return motion, x + rng.uniform(0.01, 7.0) * rng.normal(size=x.shape)


def test_tangled_starts_end_soon_and_never_silently_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """Solved or refused, by thousands of looks at the constraints (2,300 at most here) and not by millions."""
    looks, look = [0], ConstraintSet.value

    def counted(held: ConstraintSet, x: np.ndarray, time: float = 0.0) -> np.ndarray:
        looks[0] += 1
        return look(held, x, time)

    monkeypatch.setattr(ConstraintSet, "value", counted)
    solved, most = 0, 0
    cases = [case for case in map(tangled, range(16)) if case is not None]
    for motion, start in cases:
        kept_start, looks[0] = start.copy(), 0
        try:
            x = motion.restore_positions(start)
        except KconsError:
            np.testing.assert_array_equal(start, kept_start)
        else:
            fulfilled(motion.constraint_set, x)
            solved += 1
        most = max(most, looks[0])
    assert len(cases) > 12 and solved >= 0.7 * len(cases)
    assert 500 < most < 10_000


# -- pieces and bonds -----------------------------------------------------------------------------------


def test_fixed_atoms_that_go_elsewhere_take_their_molecule_along() -> None:
    """Shifted by many times its size, and turned."""
    atoms = molecule("trans-butane")
    x = atoms.positions
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    for some in ([0], [0, 1], [0, 1, 2]):
        places = x[some] @ turn + [30.0, 0.0, 0.0]
        found = engine(atoms, [held.FixedAtoms(some, places)]).restore_positions(x, bonds=bond_table(atoms))
        assert np.array_equal(found[some], places)
        lengths = [np.linalg.norm(y[:, None] - y, axis=2) for y in (found, x)]
        np.testing.assert_allclose(*lengths, rtol=0, atol=1e-9)


def test_bonds_and_angles_that_rows_hold_may_change_as_the_rows_ask() -> None:
    """No row names most bonds of a flat ring that three distances and linear relations hold rigid."""
    atoms = molecule("C6H6")
    flat = atoms.positions
    bases, tied = [0, 2, 4], [1, 3, 5, 6, 7, 8, 9, 10, 11]
    corners = np.vstack([flat[bases].T, np.ones(3)])
    weights = [np.linalg.lstsq(corners, np.append(flat[k], 1.0), rcond=None)[0] for k in tied]
    rows = [held.Distance([[0, 2], [2, 4], [0, 4]]), held.LinearRelation(tied, bases, weights)]
    motion = engine(atoms, rows)
    rough = flat + 0.1 * np.random.default_rng(0).normal(size=flat.shape)
    found = motion.restore_positions(rough, bonds=bond_table(atoms))
    kept(atoms, found)


# -- bonds as they are given or found -------------------------------------------------------------------


@pytest.mark.parametrize("name", ["CH3CH2OH", "C6H6", "PH3", "NF3", "CH2SCH2", "Si2H6", "CH3SH", "C2Cl4", "H2CCO"])
@pytest.mark.parametrize("unit", [1.0, 0.1, 1.8897])
def test_bonds_by_distances_alone_are_those_by_elements(name: str, unit: float) -> None:
    atoms = molecule(name)
    every = np.arange(len(atoms))
    found = bonds_without_elements(unit * atoms.positions, None, every, every >= 0)
    assert [tuple(b) for b in found.tolist()] == sorted(bond_table(atoms))


def test_bonds_in_a_cell_do_not_hang_on_where_atoms_are_stored() -> None:
    """With the nearest neighbors as they are stored, 60 cells away, images of the whole cell took 24 GB."""
    atoms = molecule("CH3CH2OH")
    every = np.arange(len(atoms))
    cell = np.array([[7.0, 0, 0], [1.0, 6.5, 0], [-0.8, 1.0, 7.5]])
    lattice = np.stack([cell, np.linalg.inv(cell)])
    shifts = np.random.default_rng(2).integers(-60, 61, (len(atoms), 3)) @ cell
    tracemalloc.start()
    found = bonds_without_elements(atoms.positions + shifts, lattice, every, every >= 0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert [tuple(b) for b in found.tolist()] == sorted(bond_table(atoms))
    assert peak < 5e5  # 0.1 MB; with atoms as they are stored 1.7, without the bound of a cell vector 24 GB
    # Two atoms in a flat cell: nothing is nearer than images of the atom itself.
    flat = np.diag([1.0, 90.0, 90.0])
    two = np.array([[0.0, 0, 0], [0.2, 44.0, 44.0]])
    assert len(bonds_without_elements(two, np.stack([flat, np.linalg.inv(flat)]), every[:2], every[:2] >= 0)) == 0


def test_no_bonds_are_guessed_where_there_are_no_molecules() -> None:
    every = np.arange(60)
    scattered = np.random.default_rng(0).uniform(0, 4, (60, 3))
    cubic = np.stack(np.meshgrid(*3 * [np.arange(5.0)]), axis=-1).reshape(-1, 3)
    faces = cubic[cubic.sum(axis=1) % 2 == 0][:60]
    for x in (scattered, 3.8 * faces):
        assert len(bonds_without_elements(x, None, every, every >= 0)) == 0


def test_held_distances_that_are_no_bonds() -> None:
    """The third side of water, and the ends of a chain."""
    atoms = molecule("H2O")
    motion = engine(atoms, [held.Distance([[0, 1], [0, 2], [1, 2]])])
    assert bonds_of(motion.constraint_set, atoms.positions, 0.0, None).tolist() == [[0, 1], [0, 2]]
    chain = molecule("trans-butane")
    carbons = np.flatnonzero(chain.numbers == 6)
    ends = max(combinations(carbons.tolist(), 2), key=lambda pair: chain.get_distance(*pair))
    motion = engine(chain, [held.Distance([ends])])
    found = bonds_of(motion.constraint_set, chain.positions, 0.0, None)
    assert [tuple(b) for b in found.tolist()] == sorted(bond_table(chain))


# -- the nearest point in the mass metric, or a plain refusal ---------------------------------------


WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])
TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
METHANE = np.vstack([np.zeros(3), 0.629 * TETRAHEDRON])
ZIGZAG = np.cumsum(np.tile([[0.8, 0.9, 0.1], [0.9, -0.8, 0.2]], (10, 1)), axis=0)


def all_pairs(n: int) -> list[tuple[int, int]]:
    return list(combinations(range(n), 2))


SETS = {
    "water": ([held.Distance(all_pairs(3))], WATER),
    "star": ([held.Distance([(0, k) for k in range(1, 5)])], METHANE),
    "methane, dependent": ([held.Distance(all_pairs(5))], METHANE),
    "chain": ([held.Distance([(k, k + 1) for k in range(19)])], ZIGZAG),
    "chain with angles": (
        [held.Distance([(k, k + 1) for k in range(19)]), held.Angle([(k, k + 1, k + 2) for k in range(18)])],
        ZIGZAG,
    ),
    "anchored": ([held.FixedAtoms([0]), held.Distance([(k, k + 1) for k in range(4)])], ZIGZAG[:5]),
    "collective": ([held.Distance([(0, 1)]), held.RadiusOfGyration([[0, 1, 2, 3]])], METHANE[:4]),
    "surface": ([held.Torus([0, 1, 2], [0, 0, 3.0], [0, 0.2, 1], 2.5, None)], WATER),
}


def engine_of(name: str, seed: int = 0) -> tuple[Motion, ConstraintSet, np.ndarray]:
    rows, x = SETS[name]
    whole = ConstraintSet(rows, x, 10 ** np.random.default_rng(seed).uniform(0, 1.5, len(x)))
    return Motion(whole, x), whole, x


def off_the_perpendicular(whole: ConstraintSet, motion: Motion, start: np.ndarray, x: np.ndarray) -> float:
    """Part of sqrt(M) (x - start) outside the mass-weighted rows at x, relative to its size; fixed atoms apart."""
    movable = motion.plan.inverse_masses > 0
    root_m = np.sqrt(whole.masses[movable])[:, None]
    A = whole.jacobian(x).toarray().reshape(whole.n_rows, -1, 3)[motion.plan.labels >= 0][:, movable]
    V = projection.row_space((A / root_m).reshape(len(A), -1))
    y = (root_m * (x - start)[movable]).ravel()
    return float(np.linalg.norm(y - V @ (V.T @ y)) / np.linalg.norm(y))


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("seed", range(3))
def test_nearest_point(name: str, seed: int) -> None:
    motion, whole, x = engine_of(name, seed)
    start = x + 0.05 * np.random.default_rng(seed).normal(size=x.shape)
    kept = start.copy()
    found = motion.restore_positions(start)
    np.testing.assert_array_equal(start, kept)
    fulfilled(whole, found)
    assert off_the_perpendicular(whole, motion, start, found) < 1e-9
    # No point nearby on the constraints is nearer.
    movable = (motion.plan.inverse_masses > 0)[:, None]

    def distance(y: np.ndarray) -> float:
        return float(np.sum(whole.masses[:, None] * movable * (y - start) ** 2))

    for k in range(5):
        direction = motion.project_velocities(found, np.random.default_rng(k).normal(size=x.shape))
        aside = motion.project_positions(found + 1e-3 * direction, found)
        assert distance(aside) >= distance(found) * (1 - 1e-12)


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("factor", [0.8, 1.2, 0.5, 2.0])
def test_scaled_starts(name: str, factor: float) -> None:
    """All lengths 20 % or a factor of two off."""
    motion, whole, x = engine_of(name)
    start = x.mean(axis=0) + factor * (x - x.mean(axis=0)) + 0.02 * np.random.default_rng(1).normal(size=x.shape)
    fulfilled(whole, motion.restore_positions(start))


@pytest.mark.parametrize("free", [0, 10])
def test_infeasible_rows_quote_the_least_squares_optimum(free: int) -> None:
    """Two atoms held one apart, and in planes three apart, alone or after others.

    min (d - 1)^2 + a^2 + (b - 3)^2 with d = b - a along x: each is 2/3, the sum of squares 4/3.
    """
    x = np.vstack([np.arange(3.0 * free).reshape(free, 3) + 20, [[0.2, 0, 0], [0.9, 0.7, 0.1]]])
    ends = [free, free + 1]
    rows = [held.Distance(ends, 1.0), held.Plane(ends, [1.0, 0, 0], [0.0, 3.0])]
    whole = ConstraintSet(rows, x, np.ones(len(x)))
    kept = x.copy()
    out = np.full_like(x, 5.0)
    with pytest.raises(InfeasibleError, match=r"cannot go below 1\.33333 \(sum of squares\)") as caught:
        Motion(whole, x).restore_positions(x, out=out)
    np.testing.assert_array_equal(x, kept)
    assert (out == 5.0).all()
    assert caught.value.row in (0, 1, 2) and set(caught.value.atoms) <= set(ends)
    assert "Check its target" in str(caught.value)


def test_long_chain_off_by_a_fifth() -> None:
    """More rows than dense algebra takes: by sparse Gauss-Newton."""
    n = 3000
    k = np.arange(n)
    x = np.stack([0.8 * k, 0.6 * (k % 2), 0.05 * np.sin(k)], axis=1)
    whole = ConstraintSet(held.Distance(np.stack([k[:-1], k[1:]], axis=1), 1.0), x, np.ones(n))
    start = 1.2 * x + 0.05 * np.random.default_rng(0).normal(size=x.shape)
    fulfilled(whole, Motion(whole, x).restore_positions(start))


#: Bonds and next neighbors of a chain are held: it bends, and the surface of its rows with it.
BRACED = np.array([[1.25 * k, 0.45 * (-1) ** k, 0.1 * np.sin(k)] for k in range(9)])
BRACES = [(k, k + 1) for k in range(8)] + [(k, k + 2) for k in range(7)]


def _braced() -> tuple[Motion, ConstraintSet, np.ndarray]:
    whole = ConstraintSet(held.Distance(BRACES), BRACED, np.random.default_rng(13).uniform(1, 14, 9))
    return Motion(whole, BRACED), whole, BRACED


def _displaced(rng: np.random.Generator, share: float) -> np.ndarray:
    d = rng.normal(size=BRACED.shape)
    return d / np.sqrt((d**2).sum(axis=1).mean()) * share * np.linalg.norm(BRACED[1] - BRACED[0])


def test_the_nearest_point_is_found_where_the_surface_is_much_bent() -> None:
    """Curved by nearly as much as the start is away, so that plain rounds hardly gain."""
    motion, whole, x = _braced()
    rng = np.random.default_rng(13)
    rng.uniform(1, 14, 9)
    for share in np.repeat([0.05, 0.1, 0.15, 0.2, 0.25, 0.3], 14):
        start = x + _displaced(rng, share)
        found = motion.restore_positions(start, bonds=[])
        fulfilled(whole, found)
        assert off_the_perpendicular(whole, motion, start, found) < 1e-9


def test_a_search_that_ends_before_the_nearest_point_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    motion, whole, x = _braced()
    start = x + _displaced(np.random.default_rng(0), 0.15)
    monkeypatch.setattr(solver_sequence, "MOST_ITERATIONS", 2)
    for module in (solver_sequence, nearest_point):
        monkeypatch.setattr(module, "FAILED", 5)
    with pytest.warns(UserWarning, match=r"fulfil all rows, but are not the nearest.* Start nearer"):
        found = motion.restore_positions(start, bonds=[])
    fulfilled(whole, found)
    assert off_the_perpendicular(whole, motion, start, found) > 1e-6
    with warnings.catch_warnings(action="error"):
        monkeypatch.undo()
        motion.restore_positions(start, bonds=[])
