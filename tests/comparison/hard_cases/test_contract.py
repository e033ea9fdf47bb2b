"""What a program of the hard cases shows a watcher, and when."""

import numpy as np
import pytest

from kcons.comparison.hard_cases.contract import Course, Frame, Program, together, wrapped
from kcons.comparison.hard_cases.problem import Problem

PROBLEM = Problem([[0.5, 0.0, 0.0]], [2.0], velocities=[[3.0, 0.0, 0.0]], push=[[0.0, 0.0, -1.0]])


class Flight:
    """Free flight with steps of 1; positions may be put."""

    def __init__(self):
        self.positions, self.v, self.blocks = np.array([[0.5, 0.0, 0.0]]), np.array([[3.0, 0.0, 0.0]]), []

    def march(self, steps):
        self.blocks.append(steps)
        self.positions = self.positions + steps * self.v

    def observe(self):
        return self.positions, self.v

    def put(self, x):
        self.positions = x


class Flying(Program):
    def begin(self, problem, course):
        self.course, self.flight = course, Flight()
        return self.flight


def test_frames_at_the_start_and_every_few_steps():
    program, seen, also = Flying(), [], []
    last = program.run(PROBLEM, 1.0, 7, together(lambda f: seen.append(f.x[0, 0]), also.append), every=3, project=True)
    assert program.course == Course(1.0, 7, True, None)
    assert seen == [0.5, 9.5, 18.5] and len(also) == 3
    assert program.flight.blocks == [3, 3, 1] and last.x[0, 0] == 21.5
    assert last.kinetic == 9.0 and last.energy == last.kinetic + last.potential == pytest.approx(9.0)


def test_atoms_are_put_back_after_each_step():
    program = Flying()
    last = program.run(PROBLEM.but(cell=np.eye(3) * 2.0), 1.0, 4, wrap=True, every=4)
    assert program.flight.blocks == [1, 1, 1, 1] and last.x[0, 0] == 0.5


def test_a_run_ends_where_positions_are_no_numbers():
    program, seen = Flying(), []

    def spoil(frame):
        seen.append(frame)
        program.flight.v = np.array([[np.nan, 0.0, 0.0]])

    last = program.run(PROBLEM, 1.0, 50, spoil)
    assert len(seen) == 2 and np.isnan(last.x[0, 0])


def test_wrapping_does_not_touch_what_is_inside():
    cell = [[2.0, 0, 0], [0.5, 2.0, 0], [0, 0, 3.0]]
    x = np.array([[0.3, 0.2, 0.1], [2.4, 2.1, -0.1], [-5.0, 7.0, 9.5]])
    found = wrapped(x, cell)
    parts = found @ np.linalg.inv(cell)
    assert np.array_equal(found[0], x[0]) and parts.min() >= 0 and parts.max() < 1
    shift = (found - x) @ np.linalg.inv(cell)
    np.testing.assert_allclose(shift, np.round(shift), atol=1e-12)


def test_slow_programs_run_shorter():
    program = Program()
    assert (program.length(True, 100, 10_000), program.length(False, 100, 10_000)) == (100, 10_000)
    program.pace = 0.01
    assert (program.length(True, 100, 10_000), program.length(False, 100, 10_000)) == (10, 100)
    assert Frame(np.zeros((1, 3)), np.zeros((1, 3)), 1.0, 2.0).energy == 3.0
    with pytest.raises(NotImplementedError):
        program.begin(PROBLEM, Course(1.0, 1))
