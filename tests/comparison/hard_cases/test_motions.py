"""Runs that many cases share: what they measure, and against what."""

from __future__ import annotations

import numpy as np
import pytest
from hard_case_runs import Careless

from kcons.comparison.hard_cases.contract import Frame
from kcons.comparison.hard_cases.motions import Seen, energy_off, every, flat_body, move, tumble
from kcons.comparison.hard_cases.problem import Problem
from kcons.comparison.hard_cases.programs import Core

TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
MASSES = np.array([1.0, 2.0, 3.0, 4.0])


def test_every_pair_is_there_once():
    assert every(4) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]


def test_the_largest_residual_is_kept_and_so_is_nan():
    problem = Problem([[0.0, 0, 0], [1.0, 0, 0]], [1.0, 1.0], [(0, 1)])
    seen = Seen(problem)
    for length in (1.0, 1.1, 1.01):
        seen(Frame(x=np.array([[0.0, 0, 0], [length, 0, 0]]), v=np.zeros((2, 3)), kinetic=0.0, potential=0.0))
    assert seen.residual == problem.residual(np.array([[0.0, 0, 0], [1.1, 0, 0]])) > 0.09
    for length in (np.nan, 1.0):
        seen(Frame(x=np.array([[0.0, 0, 0], [length, 0, 0]]), v=np.zeros((2, 3)), kinetic=0.0, potential=0.0))
    assert np.isnan(seen.residual)


def test_energies_are_kept_and_the_first_does_not_count():
    seen = Seen(Problem([[0.0, 0, 0], [1.0, 0, 0]], [1.0, 1.0], [(0, 1)]))
    for kinetic in (7.0, 1.0, 1.5, 0.25):
        seen(Frame(x=np.eye(3)[:2], v=np.zeros((2, 3)), kinetic=kinetic, potential=1.0))
    assert seen.energies == [8.0, 2.0, 2.5, 1.25]
    assert energy_off(seen.energies) == 0.375


@pytest.mark.parametrize(("program", "held"), [(Core(), True), (Careless(), False)])
def test_runs_tell_what_is_held_from_what_is_not(program, held):
    bent = Problem([[1.0, 0, 0], [0, 0, 0], [0, 1.0, 0]], [1.0, 2.0, 3.0], [(0, 1), (1, 2)], velocities=np.eye(3))
    square = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    found = {
        "tumble": tumble(program, TETRAHEDRON, MASSES, every(4)),
        "move": move(program, bent, 0.005, 50),
        "flat": flat_body(program, square, np.ones(4), every(4), quick=True),
    }
    for name, outcome in found.items():
        checks = {check.name: check.passed for check in outcome.checks}
        assert all(checks.values()) == held, (name, outcome)
        assert checks["residual"] == checks["position error"] == held
