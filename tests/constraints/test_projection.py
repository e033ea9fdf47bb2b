"""The dense oracle: Penrose's conditions, projectors, Gauss's principle, closed forms."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kcons.constraints import projection
from kcons.errors import ContradictionError, InputError


def near(found, expected, atol: float) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


class Problem(NamedTuple):
    """A random constrained problem: `rows` of rank `rank` on `atoms` atoms, b in the range of A."""

    A: np.ndarray
    masses: np.ndarray
    f: np.ndarray
    b: np.ndarray
    rank: int
    rng: np.random.Generator


def make_problem(seed: int, atoms: int, rows: int, rank: int, decades: float, mass_decades: float = 1.0) -> Problem:
    """Rows of given rank and moderate condition, each multiplied by up to 10^(+-decades)."""
    rng = np.random.default_rng(seed)
    n = 3 * atoms
    rank = min(rank, rows, n)
    left = np.linalg.qr(rng.normal(size=(rows, rank)))[0] if rank else np.zeros((rows, 0))
    right = np.linalg.qr(rng.normal(size=(n, rank)))[0] if rank else np.zeros((n, 0))
    A = left * rng.uniform(0.3, 1.0, rank) @ right.T
    A *= 10 ** rng.uniform(-decades, decades, (rows, 1))
    masses = 10 ** rng.uniform(-mass_decades, mass_decades, atoms)
    return Problem(A, masses, rng.normal(size=(atoms, 3)), A @ rng.normal(size=n), rank, rng)


def problems(decades: float = 0.5) -> st.SearchStrategy[Problem]:
    return st.builds(
        make_problem,
        seed=st.integers(0, 2**32 - 1),
        atoms=st.integers(1, 5),
        rows=st.integers(0, 9),
        rank=st.integers(0, 9),
        decades=st.just(decades),
    )


PROPERTY = settings(max_examples=60)
LITERAL = [
    pytest.param(np.zeros((0, 6)), 0, id="no rows"),
    pytest.param(np.zeros((2, 3)), 0, id="rows of zeros"),
    pytest.param(np.array([[0.0, 0, 0], [1.0, 2, 2]]), 1, id="a row of zeros among others"),
    pytest.param(np.array([[1.0, 2, 2], [1.0, 2, 2]]), 1, id="a row twice"),
    pytest.param(np.array([[1.0, 2, 2], [-3e6, -6e6, -6e6]]), 1, id="a row twice in other units"),
    pytest.param(np.array([[1.0, 0, 0], [0, 1.0, 0], [1.0, 1.0, 0]]), 2, id="sum of two rows"),
    pytest.param(np.vstack([np.eye(3), np.ones((4, 3))]), 3, id="more rows than columns"),
    pytest.param(np.array([[1e-150, 0, 0], [0, 1e150, 0]]), 2, id="300 decades"),
    *(pytest.param(np.array([[1.0, 2, 2], [s, 0, s], [3 * s, 0, 3 * s]]), 2, id=f"squares of {s} leave the numbers")
      for s in (1e-290, 1e-200, 1e200, 1e290)),
    pytest.param(np.array([[1.0, 0, 0], [1.0, 1e-8, 0]]), 2, id="nearly dependent, above the cut"),
    pytest.param(np.array([[1.0, 0, 0], [1.0, 1e-12, 0]]), 1, id="nearly dependent, below the cut"),
]  # fmt: skip


# -- generalized inverses ---------------------------------------------------------------------------


@pytest.mark.parametrize(("decades", "close"), [(0.5, 2e-14), (8, 2e-13)], ids=["alike", "of wildly different scale"])
@PROPERTY
@given(data=st.data())
def test_penrose_conditions(decades: float, close: float, data: st.DataObject) -> None:
    p = data.draw(problems(decades))
    inverse = projection.pseudo_inverse(p.A)
    assert inverse.rank == p.rank
    assert max(projection.penrose_residuals(p.A, inverse.matrix)) < close


@pytest.mark.parametrize(("A", "rank"), LITERAL)
def test_penrose_conditions_in_literal_cases(A: np.ndarray, rank: int) -> None:
    inverse = projection.pseudo_inverse(A)
    assert inverse.rank == rank == projection.full_rank_factors(A)[0].shape[1]
    assert projection.is_solvable(A, A @ np.ones(A.shape[1]))
    # Below the cut the discarded part itself, 1e-12, is the residual.
    cut = 1e-11 if rank == 1 and A[-1, 1] == 1e-12 else 1e-14
    assert max(projection.penrose_residuals(A, inverse.matrix)) < cut


def test_penrose_residuals_see_each_violation() -> None:
    A = np.array([[1.0, 0, 0], [0, 2.0, 0], [1.0, 2.0, 0]])
    X = np.linalg.pinv(A)
    V, W = projection.perpendicular_projector(A), projection.perpendicular_projector(A.T)
    e, g = np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.7, 0.4])
    outside_rows, outside_columns = g - V @ g, e - W @ e
    for wrong, violated in (
        (0.9 * X, [True, True, False, False]),  # A X A = A fails, and with it X A X = X; the symmetries hold
        (X + np.outer(outside_rows, outside_columns), [False, True, False, False]),
        (X + np.outer(V @ g, outside_columns), [False, False, True, False]),
        (X + np.outer(outside_rows, W @ e), [False, False, False, True]),
    ):
        residuals = np.array(projection.penrose_residuals(A, wrong))
        assert (residuals > 1e-3).tolist() == violated and residuals[~np.array(violated)].max() < 1e-14


@PROPERTY
@given(problems(decades=0.5))
def test_singular_values_and_full_rank_factors_agree(p: Problem) -> None:
    F, G = projection.full_rank_factors(p.A)
    assert F.shape == (len(p.A), p.rank)
    assert G.shape == (p.rank, p.A.shape[1])
    near(F @ G, p.A, 2e-15 * (1 + np.abs(p.A).max(initial=0)))
    ours = projection.pseudo_inverse(p.A).matrix
    theirs = projection.full_rank_pseudo_inverse(F, G)
    assert ours.shape == theirs.shape
    near(theirs, ours, 1e-11 * np.abs(ours).max(initial=1e-300))


def complex_matrix(seed: int, rows: int, columns: int, rank: int, decades: float = 2.0) -> np.ndarray:
    """A complex matrix of this rank, its rows in units of their own, some of them turned in the complex plane."""
    rng = np.random.default_rng(seed)

    def numbers(*shape: int) -> np.ndarray:
        return rng.normal(size=shape) + 1j * rng.normal(size=shape)

    return 10 ** rng.uniform(-decades, decades, (rows, 1)) * (numbers(rows, rank) @ numbers(rank, columns))


@pytest.mark.parametrize(("rows", "columns", "rank"), [(4, 3, 3), (3, 4, 3), (5, 4, 2), (2, 2, 1), (3, 3, 0)])
def test_complex_matrices(rows: int, columns: int, rank: int) -> None:
    """Penrose's conditions are stated for complex matrices (appendix A.1): every function of it keeps both parts."""
    A = complex_matrix(rows + 7 * rank, rows, columns, rank)
    rng = np.random.default_rng(1)
    inverse = projection.pseudo_inverse(A)
    assert inverse.rank == rank
    assert max(projection.penrose_residuals(A, inverse.matrix)) < 2e-14
    U = A / np.maximum(np.linalg.norm(A, axis=1, keepdims=True), 1e-300)
    X = projection.pseudo_inverse(U).matrix
    np.testing.assert_allclose(X, np.linalg.pinv(U, rcond=1e-10), atol=1e-12)
    F, G = projection.full_rank_factors(U)
    assert (F.shape, G.shape) == ((rows, rank), (rank, columns))
    np.testing.assert_allclose(F @ G, U, atol=1e-13)
    np.testing.assert_allclose(projection.full_rank_pseudo_inverse(F, G), X, atol=1e-11)
    across, along = projection.perpendicular_projector(A), projection.parallel_projector(A)
    np.testing.assert_allclose(across, X @ U, atol=1e-12)
    b, y = U @ (rng.normal(size=columns) * (1 + 2j)), rng.normal(size=columns) * (2 - 1j)
    assert projection.is_solvable(U, b)
    np.testing.assert_allclose(U @ projection.general_solution(U, b, y), b, atol=1e-12)
    np.testing.assert_allclose(projection.general_solution(U, b, X @ b + along @ y), X @ b + along @ y, atol=1e-12)
    if rank < rows:
        W = projection.row_space(U.conj().T)
        assert not projection.is_solvable(U, b + 1j * (np.eye(rows) - W @ W.conj().T) @ rng.normal(size=rows))


def test_mechanics_is_real() -> None:
    """Masses, forces and rows of a mechanical system that are complex are refused; nothing is dropped."""
    A, m, f, b = np.array([[1.0, 2.0, 0.5]]), [2.0], np.ones(3), [0.3]
    names = ("project_velocities", "multipliers", "constraint_force", "acceleration", "bott_duffin")
    calls = dict.fromkeys(names, (A, m, f, b)) | {"constrained_inverse": (A, m), "gauss_function": (f, m, f)}
    for name, arguments in calls.items():
        function = getattr(projection, name)
        function(*arguments)
        for k, argument in enumerate(arguments):
            unreal = [*arguments[:k], np.asarray(argument) * (1 + 1e-3j), *arguments[k + 1 :]]
            with pytest.raises(InputError, match="complex"):
                function(*unreal)


@PROPERTY
@given(problems())
def test_least_squares_where_there_is_no_solution(p: Problem) -> None:
    """(167), (168): with b off the range every x of (163) leaves the least residual, across the range of A."""
    b = p.A @ p.rng.normal(size=p.A.shape[1]) + p.rng.normal(size=len(p.A))
    shortest = projection.general_solution(p.A, b, np.zeros(p.A.shape[1]))
    other = projection.general_solution(p.A, b, p.rng.normal(size=p.A.shape[1]))
    residual = b - p.A @ shortest
    np.testing.assert_allclose(p.A.T @ residual, 0.0, atol=1e-10)
    np.testing.assert_allclose(p.A @ other, p.A @ shortest, atol=1e-10)


@PROPERTY
@given(problems())
def test_general_solution_solves_and_reaches_every_solution(p: Problem) -> None:
    x0 = p.rng.normal(size=p.A.shape[1])
    y = p.rng.normal(size=p.A.shape[1])
    b = p.A @ x0
    x = projection.general_solution(p.A, b, y)
    near(p.A @ x, b, 1e-13 * (1 + np.abs(b).max(initial=0)))
    # With y a solution it is that solution; with y = 0 it is the shortest one.
    near(projection.general_solution(p.A, b, x0), x0, 1e-12)
    shortest = projection.general_solution(p.A, b, np.zeros_like(y))
    assert np.linalg.norm(shortest) <= np.linalg.norm(x) * (1 + 1e-12)
    assert abs(shortest @ (x - shortest)) < 1e-12


# -- projectors -------------------------------------------------------------------------------------


@PROPERTY
@given(problems(decades=3))
def test_projectors(p: Problem) -> None:
    perpendicular, parallel = projection.perpendicular_projector(p.A), projection.parallel_projector(p.A)
    near(perpendicular + parallel, np.eye(p.A.shape[1]), 1e-15)
    for P, dimension in ((perpendicular, p.rank), (parallel, p.A.shape[1] - p.rank)):
        near(P @ P, P, 1e-14)
        near(P.T, P, 1e-15)
        assert np.trace(P) == pytest.approx(dimension, abs=1e-13)
    unit = p.A / np.maximum(np.linalg.norm(p.A, axis=1, keepdims=True), 1e-300)
    near(unit @ perpendicular, unit, 1e-13)


@PROPERTY
@given(problems())
def test_velocity_projection(p: Problem) -> None:
    m = np.repeat(p.masses, 3)
    v = p.rng.normal(size=p.f.shape)
    admissible = p.A @ p.rng.normal(size=len(m))
    projected = projection.project_velocities(p.A, p.masses, v)
    assert projected.shape == v.shape
    near(p.A @ projected.ravel(), 0, 1e-13)
    # Energy splits: orthogonal in the mass metric, so it can only decrease.
    assert abs(np.sum(m * (v - projected).ravel() * projected.ravel())) < 1e-12 * np.sum(m * v.ravel() ** 2)
    same = projection.constrained_inverse(p.A, p.masses) @ (m * v.ravel())
    near(projected.ravel(), same, 1e-12 * m.max() / m.min())
    moved = projection.project_velocities(p.A, p.masses, v, admissible)
    near(p.A @ moved.ravel(), admissible, 1e-12 * (1 + np.abs(v).max()))


# -- dynamics ---------------------------------------------------------------------------------------


@PROPERTY
@given(problems())
def test_constrained_inverse_is_the_pseudo_inverse_of_the_projected_mass(p: Problem) -> None:
    found = projection.constrained_inverse(p.A, p.masses)
    P = projection.parallel_projector(p.A)
    projected_mass = P @ np.diag(np.repeat(p.masses, 3)) @ P
    values, vectors = np.linalg.eigh(projected_mass)
    kept = values > 1e-10 * p.masses.max()
    assert kept.sum() == p.A.shape[1] - p.rank
    expected = vectors[:, kept] / values[kept] @ vectors[:, kept].T
    near(found, expected, 1e-12 * (1 / p.masses).max())


@PROPERTY
@given(seed=st.integers(0, 2**32 - 1), atoms=st.integers(1, 5), rows=st.integers(1, 15))
def test_independent_rows_give_the_formulas_with_the_inverse(seed: int, atoms: int, rows: int) -> None:
    rows = min(rows, 3 * atoms)
    p = make_problem(seed, atoms, rows, rows, decades=0.5)
    m = np.repeat(p.masses, 3)
    inverse = np.linalg.inv(p.A / m @ p.A.T)
    lam = inverse @ (p.b - p.A @ (p.f.ravel() / m))
    literal = np.diag(1 / m) - (p.A / m).T @ inverse @ (p.A / m)
    close = 1e-11 * np.abs(1 / m).max()
    near(projection.constrained_inverse(p.A, p.masses), literal, close)
    near(projection.multipliers(p.A, p.masses, p.f, p.b), lam, 1e-11 * np.abs(lam).max())
    z = p.A.T @ lam
    near(projection.constraint_force(p.A, p.masses, p.f, p.b).ravel(), z, 1e-11 * np.abs(z).max())
    a = literal @ p.f.ravel() + (p.A / m).T @ inverse @ p.b
    near(projection.acceleration(p.A, p.masses, p.f, p.b).ravel(), a, 1e-11 * np.abs(a).max())


@PROPERTY
@given(problems())
def test_equation_of_motion(p: Problem) -> None:
    """A a = b, M a = f + z, z = A^T lambda, which does no work along tangents; Bott & Duffin have the same solution."""
    a = projection.acceleration(p.A, p.masses, p.f, p.b)
    z = projection.constraint_force(p.A, p.masses, p.f, p.b)
    lam = projection.multipliers(p.A, p.masses, p.f, p.b)
    size = np.abs(a).max() + np.abs(z).max() + np.abs(p.f / p.masses[:, None]).max()
    assert a.shape == z.shape == p.f.shape
    near(p.A @ a.ravel(), p.b, 1e-13 * size * (1 + np.abs(p.A).max(initial=0)))
    near(p.masses[:, None] * a, p.f + z, 1e-13 * size * p.masses.max())
    near(p.A.T @ lam, z.ravel(), 1e-13 * size)
    anywhere = p.rng.normal(size=a.size)
    work = z.ravel() @ projection.parallel_projector(p.A) @ anywhere
    assert abs(work) <= 1e-13 * np.linalg.norm(z) * np.linalg.norm(anywhere)
    per_component = projection.acceleration(p.A, np.repeat(p.masses, 3), p.f.ravel(), p.b)
    np.testing.assert_array_equal(per_component, a.ravel())
    solution = projection.bott_duffin(p.A, p.masses, p.f, p.b)
    near(solution.acceleration, a, 1e-11 * size)
    near(solution.constraint_force, z, 1e-11 * size * max(1, p.masses.max()))


@PROPERTY
@given(problems())
def test_gauss_function_is_least_among_admissible_accelerations(p: Problem) -> None:
    a = projection.acceleration(p.A, p.masses, p.f, p.b)
    z = projection.constraint_force(p.A, p.masses, p.f, p.b)
    least = projection.gauss_function(a, p.masses, p.f)
    half = 0.5 * np.sum(z**2 / p.masses[:, None])
    assert least == pytest.approx(half, rel=1e-10, abs=1e-24)
    if p.rank == a.size:
        return  # nothing else is admissible
    # Second-order growth: G(a + h d) - G(a) = h^2 (1/2) d^T M d, with no linear term.
    d = (projection.parallel_projector(p.A) @ p.rng.normal(size=a.size)).reshape(a.shape)
    growth = 0.5 * np.sum(p.masses[:, None] * d**2)
    for h in (1.0, -1.0, 0.1, -0.1, 1e-2, -1e-2):
        change = projection.gauss_function(a + h * d, p.masses, p.f) - least
        assert change > 0
        assert change == pytest.approx(h**2 * growth, rel=1e-9, abs=1e-12 * (least + growth))


@PROPERTY
@given(problems(), st.data())
def test_dependent_rows_leave_the_motion_unique_and_the_multipliers_shortest(p: Problem, data: st.DataObject) -> None:
    if len(p.A) == 0:
        return
    extra = data.draw(st.integers(1, 4))
    mix = p.rng.uniform(-1, 1, (extra, len(p.A)))
    A, b = np.vstack([p.A, mix @ p.A]), np.concatenate([p.b, mix @ p.b])
    assert projection.pseudo_inverse(A).rank == p.rank
    z = projection.constraint_force(p.A, p.masses, p.f, p.b)
    close = 1e-11 * (np.abs(z).max() + 1e-3)
    near(projection.constraint_force(A, p.masses, p.f, b), z, close)
    lam = projection.multipliers(A, p.masses, p.f, b)
    near(A.T @ lam, z.ravel(), close)
    # Least norm: orthogonal to every combination of rows that vanishes.
    near(projection.parallel_projector(A.T) @ lam, 0, 1e-11 * np.abs(lam).max())


# -- solvability ------------------------------------------------------------------------------------


@PROPERTY
@given(problems(decades=4))
def test_right_hand_sides_in_the_range_alone_are_solvable(p: Problem) -> None:
    # b is rounded row by row; scaled to unit rows that is 1e-16 of its size.
    assert projection.is_solvable(p.A, p.b)
    projection.require_solvable(p.A, p.b)
    if 0 < p.rank < len(p.A):
        sizes = np.linalg.norm(p.A, axis=1)
        outside = projection.parallel_projector((p.A / sizes[:, None]).T) @ p.rng.normal(size=len(sizes))
        b = p.b + 1e-3 * outside / np.abs(outside).max() * sizes
        assert not projection.is_solvable(p.A, b)
        with pytest.raises(ContradictionError, match=r"contradict each other.*remove one"):
            projection.require_solvable(p.A, b)


def test_contradiction_names_its_rows() -> None:
    A = np.zeros((5, 9))
    A[[0, 1, 2, 3], [0, 4, 8, 4]] = 1.0
    A[4, 5] = 1.0
    with pytest.raises(ContradictionError) as caught:
        projection.require_solvable(A, [1.0, 2.0, 3.0, 2.5, 0.0])
    assert caught.value.rows == (1, 3)
    assert "1, 3" in str(caught.value)


def test_the_oracle_shares_no_code_with_the_engine() -> None:
    tree = ast.parse(Path(projection.__file__).read_text(encoding="utf-8"))
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    imported |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert {name for name in imported if name and name.startswith("kcons")} == {"kcons.errors"}
