"""Order and pattern of the sparse elimination, and its sweeps against dense algebra."""

import numpy as np
import pytest

from kcons import ConstraintSet, Motion
from kcons.constraints import Distance
from kcons.errors import UnsupportedError
from kcons.solvers.sparse import elimination
from kcons.solvers.sparse.elimination import make_pattern, make_triples


def pattern_of(pairs, n_atoms):
    flat = np.asarray(pairs, dtype=np.int64)
    return make_pattern(2 * np.arange(len(flat) + 1), flat.ravel(), n_atoms)


def coupled(pairs):
    """Row pairs that share an atom."""
    sets = [set(pair) for pair in pairs]
    return {(k, l) for k in range(len(pairs)) for l in range(len(pairs)) if k != l and sets[k] & sets[l]}


TREES = {
    "path": [(k, k + 1) for k in range(30)],
    "comb": [(k, k + 1) for k in range(20)] + [(k, 21 + k) for k in range(21)],
    "alkane": [e for k in range(8) for e in ((3 * k, 3 * k + 1), (3 * k, 3 * k + 2), (3 * k, 3 * k + 3))],
    "star": [(0, k) for k in range(1, 7)],
}


@pytest.mark.parametrize("name", TREES)
def test_trees_have_no_fill(name):
    pairs = TREES[name]
    pattern = pattern_of(pairs, 50)
    assert len(pattern.columns) == len(coupled(pairs)) // 2


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
