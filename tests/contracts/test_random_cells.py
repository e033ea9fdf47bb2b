"""The engine in random periodic cells: right, or refused for a reason that holds. And that the judge can tell."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import cell_judge
import numpy as np
import pytest
import random_cells
from cell_judge import judge
from cell_oracle import Dense, Row, advance
from cell_worlds import KINDS, world
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from kcons import Motion
from kcons.errors import ConvergenceError


@pytest.mark.slow
@settings(max_examples=60)
@given(seed=st.integers(10_000, 2**32 - 1), periodic=st.sampled_from([True, True, False]))
def test_molecules_that_nobody_has_seen(seed, periodic):
    """Without a cell as well: what is found in cells alone is due to the cells."""
    assume(periodic or not {"winding", "fixed pair"} & set(world(seed).kinds))
    case = judge(seed, periodic)
    assert case.outcome in ("right", "refused"), [v for v in case.verdicts if v.outcome not in ("right", "refused")]


def test_long_steps_and_strong_forces_end_on_the_rows_or_in_a_typed_error():
    for seed in range(120):
        if not {"winding", "fixed pair"} & set(world(seed).kinds):
            by = cell_judge.Judge(world(seed), seed, periodic=False)
            by.build()
            by.wild()
            assert by.verdicts == [], seed


@pytest.mark.validation
def test_ten_thousand_cases(tmp_path):
    """The same as ``python tests/contracts/random_cells.py --cases 10000 --out FILE``."""
    assert random_cells.main(["--cases", "10000", "--out", str(tmp_path / "random_cells.json")]) == 0


@pytest.mark.parametrize("seed", range(12))
def test_gradients_and_second_derivatives_of_the_oracle(seed):
    """Against central differences of the values: error h^2 with h = 1e-4, and rounding of 1e-16/h^2."""
    w = world(seed)
    rng = np.random.default_rng(seed)
    x, v = w.x + 0.01 * rng.normal(size=w.x.shape), rng.normal(size=w.x.shape)
    h = 1e-4
    ahead, here, behind = (w.rows.value(x + k * h * v, 0.0) for k in (1, 0, -1))
    np.testing.assert_allclose(w.rows.jacobian(x) @ v.ravel(), (ahead - behind) / (2 * h), rtol=0, atol=2e-5)
    np.testing.assert_allclose(w.rows.curvature(x, v), (ahead - 2 * here + behind) / h**2, rtol=0, atol=2e-4)


def test_the_oracle_turns_a_rotor_as_rattle_does():
    """Free rotor: exactly asin(omega dt) a step of RATTLE."""
    rows = Dense(
        [Row("norm", [{0: 1.0, 1: -1.0}], target=2.0)],
        np.ones(2),
        np.eye(3),
        np.zeros(0, int),
        np.zeros((0, 3)),
        np.zeros((3, 0, 3)),
    )
    x, v = np.array([[1.0, 0, 0], [-1.0, 0, 0]]), np.array([[0, 0.3, 0], [0, -0.3, 0]])
    y, u = advance(rows, "Rattle", x, v, 0.0, 1.0, np.zeros_like)
    turn = np.arcsin(0.3)
    np.testing.assert_allclose(y[0], [np.cos(turn), np.sin(turn), 0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(u[0], [-0.3 * np.sin(turn), 0.3 * np.cos(turn), 0], rtol=0, atol=1e-14)


NOTHING = np.zeros(0, int), np.zeros((0, 3)), np.zeros((3, 0, 3))


def test_the_oracle_is_as_precise_as_the_engine_where_masses_differ():
    """A heavy atom near the center that a radius of gyration is about; heavy molecules beside light ones."""
    masses = np.array([0.01, 1.0, 1e4])
    weights = {a: float(m / masses.sum()) for a, m in enumerate(masses)}
    rng = np.random.default_rng(0)
    x, v, f = rng.normal(size=(3, 6, 3))
    rows = Dense([Row("gyration", [weights])], masses, np.eye(3), *NOTHING)
    slopes = rows.jacobian(x[:3] + 10.0).reshape(3, 3)
    assert np.abs(slopes.sum(axis=0)).max() < 1e-16 < 1e-3 < np.abs(slopes).max()

    masses = np.array([0.01, 0.03, 0.01, 0.1, 80.0, 8000.0])
    pairs = [
        Row("linear", coefficients={a: c, a + 1: -c}) for a, c in zip((0, 2, 4), rng.normal(size=(3, 3)), strict=True)
    ]
    together = Dense(pairs, masses, np.eye(3), *NOTHING).force(x, v, f, 0.0)
    heavy = Dense([pairs[2].renumbered(np.arange(-4, 2))], masses[4:], np.eye(3), *NOTHING)
    np.testing.assert_allclose(together[4:], heavy.force(x[4:], v[4:], f[4:], 0.0), rtol=0, atol=1e-15)


@pytest.mark.parametrize(("rise", "turns"), [(0.001, False), (0.05, True)])
def test_the_oracle_knows_gradients_that_turn(rise, turns):
    """An angle of nearly 180 degrees whose vertex goes through the line between its ends."""
    row = Row("angle", [{0: 1.0, 1: -1.0}, {2: 1.0, 1: -1.0}], [(0, 0, 0)] * 2)
    rows = Dense([row], np.ones(3), np.eye(3), *NOTHING)
    x = np.array([[1.0, 0.01, 0], [0, 0, 0], [-1.0, 0.01, 0]])
    rows.targets = rows.measure(x)
    rows.solve(x + np.array([[0, 0, 0], [0, rise, 0], [0, 0, 0]]), x, 0.0)
    assert [turned for _, turned in rows.ways] == [turns]


@cache
def _seed_of(kind: str) -> int:
    return next(s for s in range(1000) if world(s).kinds == [kind] and judge(s).outcome == "right")


def _added(where, what):
    def fault(out, given, cell):
        out[where] += cell if what == "a cell" else what

    return fault


def _careless(out, given, cell):
    given[1][:] *= 1.0 + 1e-15


def _raising(error):
    def fault(out, given, cell):
        raise error

    return fault


@pytest.mark.parametrize(
    ("kind", "call", "fault", "said"),
    [
        ("chain", "project_positions", _added((0, 0), 1e-6), "silent: wrong result"),
        ("chain", "project_positions", _added((0, 0), np.nan), "silent: NaN"),
        # A result that is right up to a lattice vector is not the atom that was given.
        ("rigid", "project_positions", _added(-1, "a cell"), "silent: wrong result"),
        ("chain", "project_velocities", _careless, "silent: arguments were changed"),
        # There is a solution; nothing is near half the cell; and an error that is not typed.
        ("chain", "project_velocities", _raising(ConvergenceError("time step too large")), "unfounded"),
        ("chain", "project_velocities", _raising(ConvergenceError("longer than half the box")), "unfounded: half"),
        ("chain", "project_velocities", _raising(ZeroDivisionError("division by zero")), "silent: untyped"),
    ],
)
def test_the_judge_sees(kind, call, fault, said, monkeypatch):
    seed, honest = _seed_of(kind), getattr(Motion, call)
    cell = world(seed).cell[np.argmax(world(seed).pbc)]

    def spoiled(self, *given, **options):
        out = honest(self, *given, **options)
        fault(out, given, cell)
        return out

    monkeypatch.setattr(Motion, call, spoiled)
    verdicts = [f"{v.outcome}: {v.why}" for v in judge(seed).verdicts if v.operation == call]
    assert verdicts and all(verdict.startswith(said) for verdict in verdicts)


def test_the_judge_wants_the_true_remedy():
    """No smaller time step where a link nears half the cell."""
    w = world(0)
    by = cell_judge.Judge(w, 0)
    by.refusal("run", ConvergenceError("time step too large"), 1.1)
    by.refusal("run", ConvergenceError("atoms 1 and 2 come near half the box; use a larger cell"), 1.1)
    by.refusal("run", ConvergenceError("time step too large"), 1.1, solvable=False)
    assert [v.outcome for v in by.verdicts] == ["silent", "refused", "refused"]


def test_the_committed_run_has_no_faults():
    found = json.loads((Path(__file__).parents[2] / "docs" / "results" / "random_cells.json").read_text())
    assert found["cases"] == 10_000 and found["first"] == 0 and found["faults"] == {}
    assert found["outcomes"]["right"] > 8000 and found["outcomes"]["silent"] == found["outcomes"]["unfounded"] == 0
    assert set(found["kinds"]) == set(KINDS) and found["allowed"]["largest"] < 1e-5
    assert found["features"]["longer than the cell"]["right"] > 100
    assert found["features"]["places in other images"]["right"] > 100 and found["features"]["drifting"]["refused"] > 0
