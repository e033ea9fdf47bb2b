"""Hard cases of the core (docs/hard-cases.md): bad input, H17 to H21."""

from __future__ import annotations

import numpy as np
import pytest

from hard_cases.core_systems import TRIANGLE, Array, chain, motion_of, pairs_of, refused, system_of
from kcons.constraints import Distance, FixedAtoms, LinearCombination, Plane
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InfeasibleError, InputError, NonFiniteError, OverdeterminedError, SingularGeometryError
from kcons.motion import Motion
from kcons.steppers import State, System, run

# -- bad input ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mass", [0.0, -1.0, np.nan, np.inf])
def test_H17_bad_mass(mass: float) -> None:
    x = chain(5)
    masses = np.array([1.0, 1, 1, mass, 1])
    with refused(InputError, rf"atom 3 has mass {mass:g}; constrained atoms need positive mass", x, masses):
        ConstraintSet(Distance([(2, 3)]), x, masses)
    assert Motion(ConstraintSet([FixedAtoms([3]), Distance([2, 4])], x, [1, 1, 1, 0.0, 1]), x).rank == 4


def test_H18_coincident_atoms() -> None:
    x = np.zeros((2, 3))
    with refused(SingularGeometryError, "atoms 0 and 1 coincide: distance gradient undefined", x):
        ConstraintSet(Distance([0, 1], 1.0), x, [1, 1])
    apart = np.array([[0.0, 0, 0], [1, 0, 0]])
    motion = motion_of(Distance([0, 1]), apart, [1, 1])
    v = np.ones((2, 3))
    for call in (
        lambda: motion.project_positions(apart.copy(), x),
        lambda: motion.project_velocities(x, v),
        lambda: motion.acceleration(x, v, v),
        lambda: motion.project_forces(x, v),
    ):
        with refused(SingularGeometryError, "atoms 0 and 1 coincide: distance gradient undefined", x, v):
            call()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_H19_not_finite(bad: float) -> None:
    x = chain(4)
    rows = Distance([(0, 1), (1, 2), (2, 3)])
    spoiled = x.copy()
    spoiled[2, 1] = bad
    good = np.zeros((4, 3))
    with refused(InputError, "position of atom 2 is not finite", spoiled):
        ConstraintSet(rows, spoiled, np.ones(4))
    with refused(InputError, "target"):
        Distance([0, 1], bad)
    with refused(InputError, "cell"):
        ConstraintSet(rows, x, np.ones(4), cell=[10.0, bad, 10.0])
    motion = motion_of(rows, x, np.ones(4))
    with refused(InputError, "atom 2", spoiled, x, good):
        motion.project_positions(spoiled, x, velocities=good, dt=0.1, out=spoiled)
    with refused(InputError, "atom 2", spoiled):
        motion.project_positions(x, spoiled)
    with refused(InputError, "atom 2", spoiled):
        motion.project_velocities(x, spoiled, out=spoiled)
    with refused(InputError, "atom 2", spoiled):
        motion.project_velocities(spoiled, good)
    with refused(InputError, "atom 2", spoiled):
        motion.acceleration(x, good, spoiled)
    with refused(InputError, "atom 2", spoiled):
        motion.acceleration(x, spoiled, good)
    with refused(InputError, "atom 2", spoiled):
        motion.project_forces(x, spoiled, out=spoiled)
    with refused(InputError, "atom 2", spoiled):
        motion.restore_positions(spoiled)

    def force(x: Array, t: float) -> Array:
        f = -x
        if t > 0.95:
            f[1, 0] = bad
        return f

    system = System(motion, force)
    with refused(InputError, "atom 2", spoiled):
        system.initial_state(spoiled)
    with refused(InputError, "atom 2", spoiled):
        system.initial_state(x, spoiled)
    last: list[State] = []
    with refused(NonFiniteError, "non-finite force at step 10", x) as _, np.errstate(all="raise"):
        run(system, system.initial_state(x), 0.1, 20, observers=[last.append])
    assert last[-1].step == 9 and np.isfinite(last[-1].positions).all() and np.isfinite(last[-1].velocities).all()


def test_H20_no_degree_of_freedom_left() -> None:
    """Four atoms in a plane, twelve rows: fine at rest, refused as soon as something moves."""
    x = np.array([[0.0, 0, 0], [1, 0, 0], [1.2, 1, 0], [0, 1.1, 0]])
    in_plane = [LinearCombination([a], [axis], None) for a in range(4) for axis in ([1.0, 0, 0], [0, 1.0, 0])]
    rows = [Plane([0, 1, 2, 3], normal=[0, 0, 1], offset=0.0), *in_plane]
    system = system_of(rows, x, np.ones(4), lambda x, t: np.ones((4, 3)))
    assert system.motion.rank == 12 and system.motion.degrees_of_freedom == 0
    v = 0.1 * np.ones((4, 3))
    for project in (False, True):
        with refused(OverdeterminedError, "rank 12 leaves no degree of freedom", x, v):
            system.initial_state(x, v, project=project)
    end = run(system, system.initial_state(x), 0.1, 10)
    assert np.abs(end.positions - x).max() <= 1e-15
    assert issubclass(OverdeterminedError, ValueError)


def test_H20_braced_atoms_and_more_rows_than_coordinates() -> None:
    """Fourteen consistent rows on twelve coordinates: rank 12, no freedom, no exception at rest."""
    x = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.3]])
    motion = motion_of(
        [
            Distance(pairs_of(4)),
            Plane([0, 1, 2, 3], normal=[0, 0, 1]),
            LinearCombination([[0], [1], [2], [3]], [[[0, 1.0, 0]], [[1.0, 0, 0]], [[1.0, 0, 0]], [[0.5, 1.0, 0]]]),
        ],
        x,
        np.ones(4),
    )
    assert motion.constraint_set.n_rows == 14
    assert motion.rank == 12 and motion.degrees_of_freedom == 0
    assert np.abs(motion.project_velocities(x, np.ones((4, 3)))).max() <= 1e-12


def test_H21_triangle_inequality_violated() -> None:
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0.9, 0]])
    with refused(InfeasibleError, r"infeasible: residual cannot go below 0\.333333.*sum of squares", x):
        ConstraintSet(Distance(TRIANGLE, [1.0, 1.0, 3.0]), x, np.ones(3))
    assert issubclass(InfeasibleError, RuntimeError)


def test_H21_polygon_that_cannot_close() -> None:
    """Sides 1, 1, 1, 4: each takes a quarter of the excess, sum of squares 4 (1/4)^2."""
    x = np.array([[0.0, 0, 0], [1, 0.2, 0], [2, -0.1, 0.3], [3, 0, 0]])
    motion = motion_of(Distance([(0, 1), (1, 2), (2, 3), (3, 0)], [1.0, 1.0, 1.0, 4.0]), x, np.ones(4))
    with refused(InfeasibleError, r"infeasible: residual cannot go below 0\.25", x):
        motion.restore_positions(x, out=x)
    with pytest.raises(InfeasibleError) as caught:
        motion.restore_positions(x)
    assert caught.value.iterations <= 200
