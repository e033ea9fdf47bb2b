"""What the cases do not ask of the core: every call that takes numbers names what is wrong and changes no array."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from hard_cases.chains import bonds, zigzag
from hard_cases.problem import Array, Problem
from hard_cases.programs import Core
from kcons.constraints import Angle
from kcons.errors import InputError, KconsError, NonFiniteError, SingularGeometryError
from kcons.motion import Motion
from kcons.steppers import State, System, run


def motion_of(problem: Problem) -> Motion:
    return Core().system(problem).motion


@contextlib.contextmanager
def refused(error: type[KconsError], match: str, *arrays: Array):
    """The call raises a typed error with this message and leaves the arrays as they were, bit for bit."""
    before = [a.tobytes() for a in arrays]
    with pytest.raises(error, match=match):
        yield
    assert [a.tobytes() for a in arrays] == before


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_H19_every_call_names_the_atom_that_is_not_finite(bad: float) -> None:
    problem = Problem(zigzag(4), np.ones(4), bonds(4))
    x, motion, good = problem.x, motion_of(problem), np.zeros((4, 3))
    spoiled = x.copy()
    spoiled[2, 1] = bad
    system = System(motion, lambda x, t: -x * np.where((t > 0.95) & (np.arange(4) == 1), bad, 1.0)[:, None])
    for call in (
        lambda: motion.project_positions(spoiled, x, velocities=good, dt=0.1, out=spoiled),
        lambda: motion.project_positions(x, spoiled),
        lambda: motion.project_velocities(x, spoiled, out=spoiled),
        lambda: motion.project_velocities(spoiled, good),
        lambda: motion.acceleration(x, good, spoiled),
        lambda: motion.acceleration(x, spoiled, good),
        lambda: motion.project_forces(x, spoiled, out=spoiled),
        lambda: motion.restore_positions(spoiled),
        lambda: system.initial_state(spoiled),
        lambda: system.initial_state(x, spoiled),
    ):
        with refused(InputError, "atom 2", spoiled, x, good):
            call()
    last: list[State] = []
    with refused(NonFiniteError, "non-finite force at step 10", x), np.errstate(all="raise"):
        run(system, system.initial_state(x), 0.1, 20, observers=[last.append])
    assert last[-1].step == 9 and np.isfinite(last[-1].positions).all() and np.isfinite(last[-1].velocities).all()


def test_H18_every_call_names_the_atoms_that_coincide() -> None:
    motion = motion_of(Problem([[0.0, 0, 0], [1, 0, 0]], np.ones(2), [(0, 1)]))
    x, v = np.zeros((2, 3)), np.ones((2, 3))
    for call in (
        lambda: motion.project_positions(v.copy(), x),
        lambda: motion.project_velocities(x, v),
        lambda: motion.acceleration(x, v, v),
        lambda: motion.project_forces(x, v),
    ):
        with refused(SingularGeometryError, "atoms 0 and 1 coincide: distance gradient undefined", x, v):
            call()


def test_H07_rows_of_angles_keep_their_size_towards_180_degrees() -> None:
    for degrees in (170.0, 179.0, 179.9, 179.9999):
        bend = np.radians(degrees)
        x = np.array([[1, 0, 0], [0, 0, 0], [np.cos(bend), np.sin(bend), 0]])
        row = motion_of(Problem(x, np.ones(3), others=[Angle([0, 1, 2])])).constraint_set.jacobian(x).toarray()
        assert np.linalg.norm(row) == pytest.approx(np.sqrt(4 - 2 * np.cos(bend)), rel=1e-12)
