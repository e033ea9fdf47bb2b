"""Rows with a place in space take positions as they are stored, whatever ties their atoms: as in open space."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import ConstraintSet, Motion, System, run
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
    Plane,
    RadiusOfGyration,
    Sphere,
    VelocityFormula,
)

CELL = np.array([[10.0, 0, 0], [1.0, 9.0, 0], [-2.0, 1.0, 11.0]])
WHOLE = np.array([[9.8, 5.0, 5.0], [10.3, 5.1, 5.2], [10.6, 5.4, 5.0], [10.9, 5.2, 5.5], [11.2, 6.0, 5.3]])
IMAGES = np.array([[0, 0, 0], [-1, 0, 1], [2, 0, 0], [0, -1, 0], [-1, 0, 0]])
STORED = WHOLE + IMAGES @ CELL
MASSES = np.array([12.0, 1.0, 16.0, 2.0, 3.0])
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
    for x, cell in ((WHOLE, None), (STORED, CELL)):
        moved = x - WHOLE
        rows = [Sphere(0, WHOLE[0] + moved[0] + [0, 1.0, 0.2], None), *_list(PLACES[place](moved)), *_list(TIES[tie])]
        found.append((Motion(ConstraintSet(rows, x, MASSES, cell=cell), x), moved))
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
    motion = Motion(ConstraintSet(rows, WHOLE, MASSES, cell=cell), WHOLE)
    rng = np.random.default_rng(2)
    new, v = WHOLE + 0.02 * rng.normal(size=WHOLE.shape), rng.normal(size=WHOLE.shape)
    expected = motion.project_positions(new, WHOLE)
    for images in rng.integers(-2, 3, (20, *WHOLE.shape)):
        ahead, behind = images @ cell, rng.integers(-2, 3, WHOLE.shape) @ cell
        ahead[:2, 2] = behind[:2, 2] = 0.0
        found = motion.project_positions(new + ahead, WHOLE + behind) - ahead
        near(found, expected, 1e-12)
        near(motion.project_velocities(WHOLE + behind, v), motion.project_velocities(WHOLE, v), 1e-12)
