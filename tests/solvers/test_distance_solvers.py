"""All solvers of held distances against a dense Newton iteration, and what each of them does that others need not."""

from itertools import pairwise

import numpy as np
import pytest

from kcons import ConstraintSet, Motion
from kcons.constraints import Distance
from kcons.errors import UnsupportedError
from kcons.solvers.chains import SHORT, Chains
from kcons.solvers.cluster_solver import Request
from kcons.solvers.rigid_triangles import PAIRS, RigidTriangles
from kcons.solvers.small_clusters import SmallClusters
from kcons.solvers.sparse import elimination
from kcons.solvers.sparse.distances import SparseDistances
from kcons.solvers.sparse.elimination import make_pattern, make_triples

WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])
CELLS = [np.diag([19.0, 18.0, 20.0]), np.array([[19.0, 0, 0], [2.0, 18.0, 0], [-1.5, 2.5, 20.0]])]
CONNECTIONS = {
    "bond": [(0, 1)],
    "star2": [(0, 1), (0, 2)],
    "chain3": [(0, 1), (1, 2), (2, 3)],
    "star3": [(0, 1), (0, 2), (3, 0)],
    "ring3": [(0, 1), (1, 2), (2, 0)],
    "ring4": [(0, 1), (1, 2), (2, 3), (3, 0)],
    "star4": [(0, 1), (0, 2), (0, 3), (0, 4)],
    "chain5": [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)],
    "tetrahedron": [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)],
}
GRAPHS = {
    "comb": [(k, k + 1) for k in range(6)] + [(k, 7 + k) for k in range(7)],
    "methylene": [e for k in range(5) for e in ((3 * k, 3 * k + 1), (3 * k, 3 * k + 2), (3 * k, 3 * k + 3))],
    "methane": [(0, 1), (2, 0), (0, 3), (0, 4), (4, 5), (4, 6), (4, 7)],
    "ring": [(k, (k + 1) % 9) for k in range(9)] + [(0, 9), (10, 4)],
    "fused": [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 0), (3, 6), (6, 7), (7, 8), (8, 2), (1, 9)],
}
SIZES = {
    "one bond": [2],
    "short": [3, 7, 5],
    "nine short": [2, 9, 4, 4, 31, 12, 3, 3, 17],
    "limit": [SHORT, SHORT + 1],
    "no multiple": [37, 45, 100],
    "mixed": [64, 5, 72, 2, 33],
}


def jacobian(x, pairs):
    rows = np.zeros((len(pairs), len(x), 3))
    i, j = np.transpose(pairs)
    u = (x[i] - x[j]) / np.linalg.norm(x[i] - x[j], axis=1)[:, None]
    rows[np.arange(len(pairs)), i], rows[np.arange(len(pairs)), j] = u, -u
    return rows.reshape(len(pairs), -1)


def lattice_of(cell):
    return np.array([cell, np.linalg.inv(cell)])


def chain(n, shape, rng):
    """Atoms of a chain of n bonds between 1 and 1.6 long."""
    angle = {"straight": 0.0, "zigzag": 34.5, "bent": 2.5}.get(shape)
    bonds = rng.normal(size=(n, 3))
    if angle is not None:
        bonds[:] = np.cos(np.deg2rad(angle)), 0.0, 0.0
        bonds[:, 1] = np.sin(np.deg2rad(angle)) * (-1) ** np.arange(n)
    bonds *= (rng.uniform(1.0, 1.6, n) / np.linalg.norm(bonds, axis=1))[:, None]
    return np.vstack([np.zeros(3), np.cumsum(bonds, axis=0)])


class Clusters:
    """Clusters of shuffled atoms and rows, with a solver, where they are to go, and five bystanders."""

    def __init__(self, case, n=None, seed=0, offset=0.0, pinned=()):
        rng = np.random.default_rng(seed)
        self.kind, *name = case.split("-")
        if self.kind == "chains":
            parts = [(chain(s - 1, name[1], rng), [(k, k + 1) for k in range(s - 1)]) for s in SIZES[name[0]]]
        else:
            graph = {"triangles": PAIRS, "small": CONNECTIONS.get(name[0]), "sparse": GRAPHS.get(name[0])}[self.kind]
            size = 1 + int(np.max(graph))
            shape = rng.normal(size=(size, 3))
            shape = 1.1 * shape / np.linalg.norm(shape, axis=1)[:, None] + np.arange(size)[:, None] * [0.4, 0.2, -0.3]
            shape = WATER if self.kind == "triangles" else shape
            turns = np.linalg.qr(rng.normal(size=(n or 11, 3, 3)))[0]
            parts = [(shape @ turn + rng.uniform(0, 8, 3), graph) for turn in turns]
        first = np.cumsum([0, *(len(x) for x, _ in parts)])
        self.n_atoms = first[-1] + 5
        shuffled = rng.permutation(self.n_atoms)
        self.atoms = [shuffled[a:b] for a, b in pairwise(first)]
        self.pairs = [atoms[np.array(graph)] for atoms, (_, graph) in zip(self.atoms, parts, strict=True)]
        self.x_ref = rng.normal(size=(self.n_atoms, 3))
        for atoms, (x, _) in zip(self.atoms, parts, strict=True):
            self.x_ref[atoms] = x + offset
        #: Of every row its cluster, its two atoms, its number in the set and its length.
        self.cluster = np.repeat(np.arange(len(parts)), [len(p) for p in self.pairs])
        self.ends = np.concatenate(self.pairs)
        self.rows = 7 + rng.permutation(len(self.ends))
        self.lengths = self.lengths_of(self.x_ref)
        local = 1 / rng.uniform(1, 16, max(map(len, self.atoms)))
        self.inv_mass = 1 / rng.uniform(1, 16, self.n_atoms)
        for atoms in self.atoms if self.kind in ("triangles", "small") else ():
            self.inv_mass[atoms] = local[: len(atoms)]
        self.held = np.concatenate([atoms[list(pinned)] for atoms in self.atoms])
        self.inv_mass[self.held] = 0.0
        kick = 0.01 if self.kind == "sparse" else 0.03
        self.x_new = self.x_ref + kick * rng.normal(size=self.x_ref.shape)
        self.y, self.velocities = rng.normal(size=(2, self.n_atoms, 3))
        self.x_new[self.held], self.y[self.held] = self.x_ref[self.held], 0.0

    def lengths_of(self, x):
        return np.linalg.norm(x[self.ends[:, 0]] - x[self.ends[:, 1]], axis=1)

    def solver(self):
        atoms, n = self.atoms, len(self.atoms)
        if self.kind == "sparse":
            return SparseDistances(self.rows, self.ends, self.lengths, self.inv_mass)
        if self.kind == "chains":
            path = np.concatenate(atoms)
            return Chains(self.rows, np.cumsum([0, *map(len, atoms)]), path, self.lengths, self.inv_mass[path])
        rows, lengths, weights = self.rows.reshape(n, -1), self.lengths.reshape(n, -1), self.inv_mass[atoms[0]]
        if self.kind == "triangles":
            return RigidTriangles(rows, atoms, lengths, weights)
        return SmallClusters(rows, atoms, self.local(0), lengths, weights)

    def local(self, k):
        """The rows of a cluster by its own atoms."""
        place = {atom: n for n, atom in enumerate(self.atoms[k].tolist())}
        return np.array([[place[a] for a in pair] for pair in self.pairs[k].tolist()])

    def in_order(self, solver, values):
        """Values by row in the order of a solver's rows."""
        place = np.argsort(self.rows)
        return np.asarray(values)[place[np.searchsorted(self.rows[place], solver.rows)]]

    def by_row(self, values):
        """Values by row number of the set; rows that a solver does not have would show as NaN."""
        wanted = np.full(self.rows.max() + 1, np.nan)
        wanted[self.rows] = values
        return wanted

    def positions(self, x, solver=None, reference=None, lattice=None, velocities=None, multipliers=None):
        solver, reference = solver or self.solver(), self.x_ref if reference is None else reference
        request = Request(x, reference, self.by_row(self.lengths), lattice, velocities=velocities, inv_dt=500.0)
        return solver.positions(request, multipliers)

    def tangents(self, y, solver=None, reference=None, rates=None, lattice=None, multipliers=None):
        solver, reference = solver or self.solver(), self.x_ref if reference is None else reference
        return solver.tangents(
            Request(y, reference, None if rates is None else self.by_row(rates), lattice), multipliers
        )

    def pulls(self):
        """Of each cluster its rows, its atoms, its pairs by local atoms, and M^-1 A^T at the reference."""
        for k, atoms in enumerate(self.atoms):
            rows, pairs = np.flatnonzero(self.cluster == k), self.local(k)
            a = jacobian(self.x_ref[atoms], pairs)
            yield rows, atoms, pairs, np.repeat(self.inv_mass[atoms], 3)[:, None] * a.T


CASES = (
    [f"triangles-{n}" for n in (1, 7, 8, 9, 64)]
    + [f"small-{name}" for name in CONNECTIONS]
    + [f"chains-{name}-{shape}" for name in SIZES for shape in ("free", "zigzag", "straight")]
    + [f"sparse-{name}" for name in GRAPHS]
)
SOME = ["triangles-11", "small-bond", "small-star3", "small-ring4", "chains-mixed-free", "sparse-comb", "sparse-fused"]
#: How near to the dense solution: multipliers of long chains are large.
NEAR = {"triangles": 1e-13, "small": 1e-12, "chains": 1e-11, "sparse": 1e-11}


def clusters(case, **options):
    kind, name, *_ = case.split("-")
    return Clusters(case, int(name) if kind == "triangles" else {"sparse": 3, "small": 13}.get(kind), **options)


@pytest.mark.parametrize("case", CASES)
def test_matches_dense_newton(case):
    c = clusters(case)
    solver, x, v, found = c.solver(), c.x_new.copy(), c.velocities.copy(), np.full(len(c.rows), np.nan)
    outcome = c.positions(x, solver, velocities=v, multipliers=found)
    assert outcome.converged and outcome.residual <= 4e-15
    assert 0 <= outcome.worst_row < len(c.rows) or outcome.residual == 0.0
    expected, multipliers = c.x_new.copy(), np.zeros(len(c.rows))
    for rows, atoms, pairs, pull in c.pulls():
        for _ in range(20):
            sigma = c.lengths_of(expected)[rows] - c.lengths[rows]
            multipliers[rows] -= np.linalg.solve(jacobian(expected[atoms], pairs) @ pull, sigma)
            expected[atoms] = c.x_new[atoms] + (pull @ multipliers[rows]).reshape(-1, 3)
    near = NEAR[c.kind]
    np.testing.assert_allclose(x, expected, atol=near)
    np.testing.assert_allclose(found, c.in_order(solver, multipliers), atol=10 * near)
    np.testing.assert_allclose(v, c.velocities + 500 * (expected - c.x_new), atol=1000 * near)
    bystanders = np.setdiff1d(np.arange(c.n_atoms), np.concatenate(c.atoms))
    np.testing.assert_array_equal(x[bystanders], c.x_new[bystanders])
    assert np.abs(c.lengths_of(x) - c.lengths).max() <= max(2e-14, 4 * 2.3e-16 * np.abs(x).max() * np.sqrt(3))


@pytest.mark.parametrize("case", [case for case in CASES if "zigzag" not in case])
@pytest.mark.parametrize("driven", [False, True])
def test_tangents_match_dense_solve(driven, case):
    c = clusters(case, seed=1)
    wanted = np.random.default_rng(2).normal(size=len(c.rows)) * driven
    solver, y, found = c.solver(), c.y.copy(), np.full(len(c.rows), np.nan)
    assert c.tangents(y, solver, rates=wanted if driven else None, multipliers=found).converged
    near, multipliers = NEAR[c.kind], np.zeros(len(c.rows))
    for rows, atoms, pairs, pull in c.pulls():
        a = jacobian(c.x_ref[atoms], pairs)
        multipliers[rows] = np.linalg.solve(a @ pull, a @ c.y[atoms].ravel() - wanted[rows])
        np.testing.assert_allclose(y[atoms], c.y[atoms] - (pull @ multipliers[rows]).reshape(-1, 3), atol=10 * near)
        assert np.abs(a @ y[atoms].ravel() - wanted[rows]).max() <= 2e-14
    np.testing.assert_allclose(found, c.in_order(solver, multipliers), atol=100 * near)


@pytest.mark.parametrize("cell", CELLS, ids=["orthorhombic", "triclinic"])
@pytest.mark.parametrize("case", SOME)
def test_periodic_equals_unwrapped(case, cell):
    c = clusters(case, seed=3)
    x, y, z = c.x_new.copy(), c.y.copy(), c.y.copy()
    assert c.positions(x).converged and c.tangents(y).converged
    jumps = np.random.default_rng(4).integers(-2, 3, size=(2, c.n_atoms, 3)) @ cell
    wrapped, reference, lattice = c.x_new + jumps[0], c.x_ref + jumps[1], lattice_of(cell)
    assert c.positions(wrapped, None, reference, lattice).converged
    assert c.tangents(z, None, reference, None, lattice).converged
    np.testing.assert_allclose(wrapped - jumps[0], x, atol=1e-12)
    np.testing.assert_allclose(z, y, atol=1e-12)


@pytest.mark.parametrize(
    ("case", "pinned"),
    [("triangles-10", [0]), ("small-chain3", [0, 3]), ("chains-no multiple-free", [0, 5, 6, 36]), ("sparse-comb", [3])],
)
def test_pinned_atoms_stay_and_part_clusters(case, pinned):
    c = clusters(case, seed=5, pinned=pinned)
    x, y = c.x_new.copy(), c.y.copy()
    assert c.positions(x).converged and c.tangents(y).converged
    np.testing.assert_array_equal(x[c.held], c.x_ref[c.held])
    np.testing.assert_array_equal(y[c.held], 0.0)
    assert np.abs(c.lengths_of(x) / c.lengths - 1).max() <= 1e-13
    assert np.abs(jacobian(c.x_ref, c.ends) @ y.ravel()).max() <= 2e-14


@pytest.mark.parametrize("case", ["triangles-10", "small-star3", "chains-mixed-free", "sparse-methylene"])
def test_far_from_the_origin(case):
    c = clusters(case, offset=1e6)
    x, y = c.x_new.copy(), c.y.copy()
    assert c.positions(x).converged and c.tangents(y).converged
    assert np.abs(c.lengths_of(x) - c.lengths).max() <= 4 * 2.3e-16 * np.sqrt(3) * 1e6


BROKEN = {"triangles-29": 26, "small-bond": 10, "small-tetrahedron": 12, "chains-mixed-free": 2, "sparse-methane": 1}


DAMAGES = [(damage, case) for damage in ("far", "nan", "coincident", "turned", "impossible") for case in BROKEN]


# A chain that turns is found again on its way.
@pytest.mark.parametrize(("damage", "case"), [each for each in DAMAGES if each != ("turned", "chains-mixed-free")])
def test_failure_changes_nothing_and_names_the_cluster(damage, case):
    c, broken = clusters(case, seed=6), BROKEN[case]
    atoms = c.atoms[broken]
    i, j = c.pairs[broken][0]
    if damage == "far":
        c.x_new[i] += 60.0 * np.cross(c.x_ref[i] - c.x_ref[j], [0.3, 0.5, 0.8])
    elif damage == "nan":
        c.x_new[i, 1] = c.y[i, 2] = np.nan
    elif damage == "coincident":
        c.x_ref[i] = c.x_ref[j]
    elif damage == "turned":
        c.x_new[atoms] = -c.x_ref[atoms]
    else:
        c.lengths[np.flatnonzero(c.cluster == broken)[0]] = np.nan
    x, v, solver = c.x_new.copy(), c.velocities.copy(), c.solver()
    outcome = c.positions(x, solver, velocities=v)
    assert not outcome.converged
    assert c.in_order(solver, c.cluster)[outcome.worst_row] == broken
    np.testing.assert_array_equal(x, c.x_new)
    np.testing.assert_array_equal(v, c.velocities)
    if damage in ("nan", "coincident"):
        y = c.y.copy()
        outcome = c.tangents(y, solver)
        assert not outcome.converged and c.in_order(solver, c.cluster)[outcome.worst_row] == broken
        np.testing.assert_array_equal(y, c.y)
    # What a failure leaves in the tables must not reach the next call.
    good = clusters(case, seed=6)
    again, fresh = good.x_new.copy(), good.x_new.copy()
    assert good.positions(again, solver).converged and good.positions(fresh).converged
    np.testing.assert_array_equal(again, fresh)


# -- triangles ------------------------------------------------------------------------------------------------


def test_newton_and_a_chord_step_gain_together():
    """Of order three, a factor for both: from three hundredths of a length to rounding in five steps."""
    for seed in range(3):
        c = clusters("triangles-64", seed=seed)
        outcome = c.positions(c.x_new.copy())
        assert outcome.converged and outcome.iterations <= 6


def test_a_third_side_that_turned_round_is_no_solution():
    """The ends of a narrow triangle change places: all lengths are right, and two of the sides hardly turn."""
    c = clusters("triangles-9")
    c.x_ref[np.array(c.atoms)] = np.array([[0.0, 0, 0], [1.0, 0.3, 0], [1.0, -0.3, 0]])
    c.lengths, c.x_new = c.lengths_of(c.x_ref), c.x_ref.copy()
    assert c.positions(c.x_new.copy()).converged
    c.x_new[c.atoms[4][1:]] = c.x_new[c.atoms[4][:0:-1]]
    x = c.x_new.copy()
    outcome = c.positions(x)
    assert not outcome.converged and outcome.worst_row == 3 * 4 + PAIRS.index((1, 2))
    np.testing.assert_array_equal(x, c.x_new)


# -- chains ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["free", "zigzag", "bent", "straight"])
def test_ten_thousand_bonds(shape, monkeypatch):
    monkeypatch.setitem(SIZES, "long", [10_001])
    c = clusters(f"chains-long-{shape}")
    c.inv_mass[:] = 1 / 14
    # A long chain that is nearly straight resists all but tangent displacements.
    v, y = c.y.copy(), c.y.copy()
    assert c.tangents(v).converged
    x = c.x_ref + 0.01 * v
    outcome = c.positions(x)
    assert outcome.converged and outcome.residual <= 4e-15
    path = x[c.atoms[0]]
    reach = np.abs(path[1:]).sum(axis=1) + np.abs(path[:-1]).sum(axis=1)
    assert (np.abs(c.lengths_of(x) - c.lengths) <= np.maximum(1e-14, 2 * 2.3e-16 * reach)).all()
    assert c.tangents(y).converged
    bonds = np.diff(c.x_ref[c.atoms[0]], axis=0)
    speed = (bonds * np.diff(y[c.atoms[0]], axis=0)).sum(axis=1) / np.linalg.norm(bonds, axis=1)
    assert np.abs(speed).max() <= 5e-15 * np.sqrt(3)


# -- order and pattern of the sparse elimination ----------------------------------------------------


def test_trees_have_no_fill():
    """An alkane with all of its hydrogens."""
    pairs = np.array([e for k in range(8) for e in ((3 * k, 3 * k + 1), (3 * k, 3 * k + 2), (3 * k, 3 * k + 3))])
    pattern = make_pattern(2 * np.arange(len(pairs) + 1), pairs.ravel(), 50)
    sets = [set(pair) for pair in pairs.tolist()]
    assert len(pattern.columns) == sum(bool(a & b) for k, a in enumerate(sets) for b in sets[:k])


def test_rows_that_are_coupled_too_densely_are_refused_in_words(monkeypatch):
    monkeypatch.setattr(elimination, "MOST_UPDATES", 1e3)
    x = np.random.default_rng(1).normal(size=(31, 3))
    held = ConstraintSet(Distance([(0, k) for k in range(1, 31)]), x, np.ones(31))
    with pytest.raises(UnsupportedError, match=r"30 rows are coupled so densely .* one atom takes part in 30 rows"):
        Motion(held, x)


def test_few_rows_are_ordered_by_python_alike(monkeypatch) -> None:
    """Bit for bit what is compiled finds."""
    rng = np.random.default_rng(0)
    assert elimination._minimum_degree.py_func is not elimination._minimum_degree
    for _ in range(100):
        n, n_atoms = int(rng.integers(1, 25)), int(rng.integers(2, 25))
        members = [rng.choice(n_atoms, size=int(rng.integers(1, min(5, n_atoms + 1))), replace=False) for _ in range(n)]
        row_start, row_atoms = np.cumsum([0, *map(len, members)]), np.concatenate(members)
        eliminate_last = rng.random(n) < 0.2
        found = []
        for chosen in (lambda kernel, _: kernel, lambda kernel, _: kernel.py_func):
            monkeypatch.setattr(elimination, "plain_if_small", chosen)
            pattern = make_pattern(row_start, row_atoms, n_atoms, eliminate_last)
            triples = make_triples(pattern.start, pattern.columns, row_start, row_atoms, np.ones(n_atoms))
            found.append([*vars(pattern).values(), *triples])
        for one, two in zip(*found, strict=True):
            assert one.dtype == two.dtype
            np.testing.assert_array_equal(one, two)
